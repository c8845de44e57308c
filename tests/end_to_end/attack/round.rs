//! The actions of a round, drawn from its seed.

use crate::bridge::{HALVES, loopback, placed};
use crate::support::{TRACKING, TRACKING_STAGES};
use rustix::process::Signal;
use std::fmt::Write;

/// Machine of each stage of [`TRACKING`] in a round with three machines.
const THIRDS: [(&str, &str); 5] =
    [("source", "robot"), ("extractor", "base"), ("assembler", "desk"), ("tracker", "desk"), ("json", "desk")];

/// A stage, or the bridge of a machine.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Victim {
    pub machine: usize,
    pub stage: &'static str,
}

/// An action against a run.
#[derive(Clone, Copy, Debug)]
pub enum Blow {
    Kill(Victim),
    /// Stops the stage for this number of milliseconds, and then sends it this signal, which continues or kills it.
    Stop(Victim, u64, Signal),
    Swap(Victim),
    /// Starts an onlooker of a topic on the last machine, and kills it after this number of milliseconds.
    LookOn(&'static str, u64),
    KillLauncher(usize),
    /// Interrupts all runs, as Ctrl-C does.
    End,
    /// Kills the run of a machine, or interrupts it and waits for its end; then starts it again.
    Again(usize, Signal),
    /// Sends copies of genuine messages with a few bytes changed.
    Forge,
}

/// Which frames of a run have to arrive.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Whole {
    FromStart,
    FromSomewhere,
}

/// A round.
#[derive(Debug)]
pub struct Round {
    pub frames: u64,
    rate_hz: u64,
    /// Delivery and queue length of the input of each stage except the source.
    inputs: Vec<(&'static str, usize)>,
    machines: &'static [&'static str],
    /// Whether another pipeline runs in the same runtime folder.
    pub has_neighbor: bool,
    /// The actions, each with the number of lines of results after which it is done.
    pub blows: Vec<(u64, Blow)>,
}

impl Round {
    pub fn draw(seed: u64) -> Self {
        let mut random = fastrand::Rng::with_seed(seed);
        let machines: &[_] = match random.u8(0..20) {
            0..4 => &["robot", "base"],
            4 | 5 => &["robot", "base", "desk"],
            _ => &["robot"],
        };
        let has_neighbor = machines.len() == 1 && random.u8(0..4) == 0;
        let frames = random.u64(20..120);
        let all_lossless = random.bool();
        let mut input = |_| {
            let is_lossless = all_lossless || random.bool();
            (if is_lossless { "lossless" } else { "latest" }, random.usize(1..6))
        };
        let inputs = TRACKING_STAGES[1..].iter().map(&mut input).collect();
        let rate_hz = *random.choice(&[0, 20, 100]).unwrap_or(&100);
        let mut round = Self { frames, rate_hz, inputs, machines, has_neighbor, blows: Vec::new() };
        let mut blows: Vec<_> =
            (0..random.usize(1..5)).map(|_| (random.u64(0..frames + 5), round.draw_blow(&mut random))).collect();
        blows.sort_by_key(|(after, _)| *after);
        // A second interrupt means that messages under way need not be delivered.
        let mut ends = blows.iter().filter(|(_, blow)| matches!(blow, Blow::End)).count();
        blows.retain(|(_, blow)| {
            let is_end = matches!(blow, Blow::End);
            ends -= usize::from(is_end);
            !is_end || ends == 0
        });
        round.blows = blows;
        round
    }

    fn draw_blow(&self, random: &mut fastrand::Rng) -> Blow {
        let machine = random.usize(..self.machines.len());
        let stage = random.usize(..TRACKING_STAGES.len() + usize::from(self.has_link()));
        let victim = TRACKING_STAGES.get(stage).map_or(Victim { machine, stage: "bridge" }, |stage| self.victim(stage));
        let dies = random.bool();
        let milliseconds = random.u64(0..1500);
        // Some stops last longer than a bridge waits for a silent peer, but not as long as a run waits for its end.
        let still = if random.u8(0..6) == 0 { 5200 + milliseconds / 2 } else { milliseconds };
        match random.u8(0..24) {
            0..6 => Blow::Kill(victim),
            6..10 => Blow::Stop(victim, still, if dies { Signal::KILL } else { Signal::CONT }),
            10..14 => Blow::Swap(self.victim(TRACKING_STAGES[random.usize(1..5)])),
            14..17 => Blow::LookOn(["depth", "ellipses", "objects", "tracks"][random.usize(..4)], milliseconds / 2),
            17 => Blow::KillLauncher(machine),
            18 => Blow::End,
            19..23 => Blow::Again(machine, if dies { Signal::KILL } else { Signal::INT }),
            _ if self.has_link() => Blow::Forge,
            _ => Blow::Kill(victim),
        }
    }

    pub fn has_link(&self) -> bool {
        self.machines.len() > 1
    }

    fn places(&self) -> &[(&'static str, &'static str)] {
        if self.machines.len() == 2 { &HALVES } else { &THIRDS }
    }

    /// A stage together with its machine.
    fn victim(&self, stage: &'static str) -> Victim {
        let place = self.places().iter().find(|(own, _)| *own == stage).filter(|_| self.has_link());
        let machine = self.machines.iter().position(|machine| place.is_some_and(|(_, place)| place == machine));
        Victim { machine: machine.unwrap_or(0), stage }
    }

    /// Arguments of `conicflow` that start the run of each machine.
    pub fn commands(&self) -> Vec<Vec<&'static str>> {
        if !self.has_link() {
            return vec![vec!["run"]];
        }
        self.machines.iter().map(|machine| vec!["run", "--machine", machine]).collect()
    }

    /// The pipeline file. Successive machines are joined at these endpoints.
    pub fn text(&self, endpoints: &[String]) -> String {
        let mut text = TRACKING.replace("rate_hz    = 0", &format!("rate_hz = {}", self.rate_hz));
        text = text.replace("width      = 64", &format!("width = 64\nframes = {}", self.frames));
        for (stage, (delivery, queue)) in TRACKING_STAGES[1..].iter().zip(&self.inputs) {
            let (before, after) = text.split_once(&format!("[stage.{stage}]")).unwrap();
            let after =
                after.replacen("delivery = \"lossless\"", &format!("delivery = \"{delivery}\", queue = {queue}"), 1);
            text = format!("{before}[stage.{stage}]{after}");
        }
        if !self.has_link() {
            return text;
        }
        let mut text = placed(&text, self.places());
        for (index, machine) in self.machines.iter().enumerate() {
            writeln!(text, "[machine.{machine}]").unwrap();
            let earlier = index.checked_sub(1).and_then(|index| endpoints.get(index));
            for (key, endpoint) in [("listen", endpoints.get(index)), ("connect", earlier)] {
                endpoint.into_iter().for_each(|endpoint| writeln!(text, "{key} = [\"{endpoint}\"]").unwrap());
            }
        }
        text
    }

    /// One endpoint for each machine except the last.
    pub fn endpoints(&self) -> Vec<String> {
        self.machines[1..].iter().map(|_| loopback()).collect()
    }

    pub fn is_lossless(&self, reader: &str) -> bool {
        let index = TRACKING_STAGES.iter().position(|stage| *stage == reader).unwrap();
        self.inputs[index - 1].0 == "lossless"
    }

    pub fn is_all_lossless(&self) -> bool {
        TRACKING_STAGES[1..].iter().all(|stage| self.is_lossless(stage))
    }

    /// The first frame from which on all have to arrive if a run was started again. This is known if no input has `latest`, no
    /// process was killed except with its whole run, and no run was interrupted. If the source was started again last, its
    /// readers receive its first frame, too.
    pub fn whole_from(&self) -> Option<Whole> {
        let is_harmless = |blow: &Blow| {
            matches!(
                blow,
                Blow::Again(..) | Blow::Swap(_) | Blow::LookOn(..) | Blow::Forge | Blow::Stop(_, _, Signal::CONT)
            )
        };
        let last = self.blows.iter().rev().find_map(|(_, blow)| match blow {
            Blow::Again(machine, _) => Some(*machine),
            _ => None,
        })?;
        let is_whole = self.is_all_lossless() && self.blows.iter().all(|(_, blow)| is_harmless(blow));
        is_whole.then_some(if last == 0 { Whole::FromStart } else { Whole::FromSomewhere })
    }

    /// Number of times that a machine in between was started again during the last run of the source. Each time the messages that
    /// it held are lost.
    pub fn relays_begun_again(&self) -> usize {
        let again = self.blows.iter().rev().filter_map(|(_, blow)| match blow {
            Blow::Again(machine, _) => Some(*machine),
            _ => None,
        });
        again.take_while(|&machine| machine > 0).filter(|machine| machine + 1 < self.machines.len()).count()
    }

    /// Removes the actions before the last restart of a run.
    pub fn forget_former_runs(&mut self) {
        let last = self.blows.iter().rposition(|(_, blow)| matches!(blow, Blow::Again(..)));
        self.blows.drain(..last.map_or(0, |last| last + 1));
    }

    /// Number of times that a stage is killed.
    pub fn kills_of(&self, stage: &str) -> u64 {
        let kills = |blow: &Blow| match blow {
            Blow::Kill(own) | Blow::Stop(own, _, Signal::KILL) => own.stage == stage,
            _ => false,
        };
        self.blows.iter().filter(|(_, blow)| kills(blow)).count() as u64
    }

    pub fn has(&self, is: impl Fn(&Blow) -> bool) -> bool {
        self.blows.iter().any(|(_, blow)| is(blow))
    }
}
