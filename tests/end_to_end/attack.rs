//! Attacks on runs: kills, stops and swaps of stages, launchers and bridges, onlookers that come and die, messages that are
//! forged from true ones. Each round is drawn from one seed, which is printed with all that it does:
//! `CONICFLOW_ATTACK_SEED=123 cargo test --test end_to_end -- attack --nocapture` does that round again, and
//! `CONICFLOW_ATTACK_ROUNDS=3000` as many others.
//!
//! Whatever happens: a run comes to its end, no message comes twice or out of order, with a lossless reader that is killed
//! nothing is lost, unless its writer was killed as well, what is missing is counted, exit code 1 says that something lossless
//! was lost and nothing else does, and no process and no file stays behind.

use super::bridge::{HALVES, joined, loopback};
use super::processes::{files_in_shared_memory, shared_files, shared_prefix, stages_of, wait_for_shared_memory};
use super::routers::session;
use super::support::{Ended, Playground, Started, TRACKING, TRACKING_STAGES, TRACKING_TOPICS, signal, wait_until};
use rustix::process::Signal;
use std::any::Any;
use std::fmt::Write;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::time::{Duration, Instant};
use zenoh::Wait;
use zenoh::sample::Locality;

const ROUNDS: &str = "CONICFLOW_ATTACK_ROUNDS";
const SEED: &str = "CONICFLOW_ATTACK_SEED";
/// No round lasts longer, unless it stands still: frames are few, and nobody is stopped for long.
const LONGEST: Duration = Duration::from_secs(120);
const LOOK: Duration = Duration::from_millis(2);
/// A minute on two busy cores.
const DEFAULT_ROUNDS: u64 = 16;
/// What is drawn with the first seed is different from what [`stress`](super::stress) does.
const FIRST_SEED: u64 = 1000;

/// Something that is done to a run.
#[derive(Clone, Copy, Debug)]
enum Blow {
    Kill(&'static str),
    /// The stage is stopped for so many milliseconds, and then goes on, or is killed.
    Stop(&'static str, u64, Signal),
    Swap(&'static str),
    /// Somebody looks at a topic, and is killed after so many milliseconds.
    LookOn(&'static str, u64),
    KillLauncher,
    /// Asks for the end, as Ctrl-C does.
    End,
    /// Messages are put onto the link that are true but for a few bytes.
    Forge,
}

/// One round, as it was drawn.
#[derive(Debug)]
struct Round {
    frames: u64,
    rate_hz: u64,
    /// Delivery and length of the queue, of each stage but the source.
    inputs: Vec<(&'static str, usize)>,
    has_two_machines: bool,
    /// After so many lines of results.
    blows: Vec<(u64, Blow)>,
}

impl Round {
    fn draw(seed: u64) -> Self {
        let mut random = fastrand::Rng::with_seed(seed);
        let has_two_machines = random.u8(0..5) == 0;
        let frames = random.u64(20..120);
        let all_lossless = random.bool();
        let mut input = |_| {
            let is_lossless = all_lossless || random.bool();
            (if is_lossless { "lossless" } else { "latest" }, random.usize(1..6))
        };
        let inputs = TRACKING_STAGES[1..].iter().map(&mut input).collect();
        let mut blows: Vec<_> = (0..random.usize(1..5))
            .map(|_| (random.u64(0..frames + 5), Blow::draw(&mut random, has_two_machines)))
            .collect();
        blows.sort_by_key(|(after, _)| *after);
        // Who asks for the end a second time does not want to wait for what is under way.
        let mut ends = blows.iter().filter(|(_, blow)| matches!(blow, Blow::End)).count();
        blows.retain(|(_, blow)| {
            let is_end = matches!(blow, Blow::End);
            ends -= usize::from(is_end);
            !is_end || ends == 0
        });
        let rate_hz = *random.choice(&[0, 20, 100]).unwrap_or(&100);
        Self { frames, rate_hz, inputs, has_two_machines, blows }
    }

    fn text(&self) -> String {
        let mut text = TRACKING.replace("rate_hz    = 0", &format!("rate_hz = {}", self.rate_hz));
        text = text.replace("width      = 64", &format!("width = 64\nframes = {}", self.frames));
        for (stage, (delivery, queue)) in TRACKING_STAGES[1..].iter().zip(&self.inputs) {
            let (before, after) = text.split_once(&format!("[stage.{stage}]")).unwrap();
            let after =
                after.replacen("delivery = \"lossless\"", &format!("delivery = \"{delivery}\", queue = {queue}"), 1);
            text = format!("{before}[stage.{stage}]{after}");
        }
        text
    }

    fn is_lossless(&self, reader: &str) -> bool {
        let index = TRACKING_STAGES.iter().position(|stage| *stage == reader).unwrap();
        self.inputs[index - 1].0 == "lossless"
    }

    /// How often a stage is killed.
    fn kills_of(&self, stage: &str) -> u64 {
        let kills = |blow: &Blow| match blow {
            Blow::Kill(own) | Blow::Stop(own, _, Signal::KILL) => *own == stage,
            _ => false,
        };
        self.blows.iter().filter(|(_, blow)| kills(blow)).count() as u64
    }

    fn has(&self, is: impl Fn(&Blow) -> bool) -> bool {
        self.blows.iter().any(|(_, blow)| is(blow))
    }
}

impl Blow {
    fn draw(random: &mut fastrand::Rng, has_two_machines: bool) -> Self {
        let bridged = if has_two_machines { &["bridge"][..] } else { &[] };
        let stages: Vec<_> = TRACKING_STAGES.iter().chain(bridged).copied().collect();
        let stage = stages[random.usize(..stages.len())];
        match random.u8(0..20) {
            0..6 => Self::Kill(stage),
            6..10 => {
                let then = if random.bool() { Signal::KILL } else { Signal::CONT };
                Self::Stop(stage, random.u64(10..1500), then)
            }
            10..14 => Self::Swap(TRACKING_STAGES[random.usize(1..5)]),
            14..17 => Self::LookOn(["depth", "ellipses", "objects", "tracks"][random.usize(..4)], random.u64(0..800)),
            17 => Self::KillLauncher,
            18 => Self::End,
            _ if has_two_machines => Self::Forge,
            _ => Self::Kill(stage),
        }
    }
}

/// What was started beside a run: swaps, and who looks on.
#[derive(Default)]
struct Beside {
    swaps: Vec<Started>,
    /// Who is killed, and when.
    onlookers: Vec<(Started, Instant)>,
    /// Who gets a signal, and when.
    stopped: Vec<(u32, Signal, Instant)>,
    /// When the last onlooker was killed.
    killed: Option<Instant>,
    /// Whether a launcher was killed when no stage had shared memory, so that nobody was left who could remove what was there.
    launcher_alone: bool,
}

impl Beside {
    /// Does what is due.
    fn settle(&mut self) {
        let now = Instant::now();
        for (process, then, _) in self.stopped.extract_if(.., |(_, _, at)| *at <= now) {
            signal(process, then);
        }
        for (onlooker, _) in self.onlookers.extract_if(.., |(_, at)| *at <= now) {
            signal(onlooker.id(), Signal::KILL);
            self.killed = Some(now);
        }
    }

    /// Waits until nobody is left; who looks on ends by himself when there is nothing to look at.
    fn end(self) {
        self.onlookers.into_iter().for_each(|(onlooker, _)| drop(onlooker.wait()));
        self.swaps.into_iter().for_each(|swap| drop(swap.wait()));
    }
}

fn strike(blow: Blow, machines: &[(Playground, Started)], link: Option<&zenoh::Session>, beside: &mut Beside) {
    let machine_of = |stage: &str| {
        let has = |(_, run): &&(Playground, Started)| stages_of(run.id()).contains_key(stage);
        machines.iter().find(has)
    };
    let process_of = |stage: &str| machine_of(stage).and_then(|(_, run)| stages_of(run.id()).get(stage).copied());
    let later = |milliseconds| Instant::now() + Duration::from_millis(milliseconds);
    match blow {
        Blow::Kill(stage) => process_of(stage).into_iter().for_each(|process| signal(process, Signal::KILL)),
        Blow::Stop(stage, milliseconds, then) => {
            if let Some(process) = process_of(stage) {
                signal(process, Signal::STOP);
                beside.stopped.push((process, then, later(milliseconds)));
            }
        }
        Blow::Swap(stage) => {
            beside.swaps.extend(machine_of(stage).map(|(playground, _)| playground.start(&["swap", stage])));
        }
        Blow::LookOn(topic, milliseconds) => {
            let (playground, _) = &machines[machines.len() - 1];
            beside.onlookers.push((playground.start(&["topic", "echo", topic]), later(milliseconds)));
        }
        Blow::KillLauncher => {
            let launcher = machines[machines.len() - 1].1.id();
            beside.launcher_alone |= stages_of(launcher).values().all(|stage| shared_files(*stage).is_empty());
            signal(launcher, Signal::KILL);
        }
        Blow::End => machines.iter().for_each(|(_, run)| signal(run.id(), Signal::INT)),
        Blow::Forge => link.into_iter().for_each(forge),
    }
}

/// Listens to the link for a moment, and puts what was heard back onto it with a few bytes changed.
fn forge(link: &zenoh::Session) {
    let subscriber = link.declare_subscriber("conicflow/**").allowed_origin(Locality::Remote);
    let (heard, until) = (subscriber.wait().unwrap(), Instant::now() + Duration::from_millis(300));
    let mut random = fastrand::Rng::with_seed(7);
    while Instant::now() < until
        && let Ok(Some(sample)) = heard.recv_deadline(until)
    {
        let mut bytes = sample.payload().to_bytes().into_owned();
        for _ in 0..random.usize(1..4) {
            let index = random.usize(..bytes.len().clamp(1, 60));
            if let Some(byte) = bytes.get_mut(index) {
                *byte = random.u8(..);
            }
        }
        link.put(sample.key_expr(), bytes).wait().unwrap();
    }
}

fn eavesdropper(endpoint: &str) -> zenoh::Session {
    session("peer", &[("connect/endpoints", &format!("[\"{endpoint}\"]")), ("connect/timeout_ms", "5000")])
}

/// Starts what a round needs, until it has shared memory: one machine, or two and who listens to their link.
fn begin(round: &Round) -> (Vec<(Playground, Started)>, Option<zenoh::Session>) {
    let start = |text: &str, arguments: &[&str]| {
        let playground = Playground::with_pipeline(text);
        let mut run = playground.start(arguments);
        wait_for_shared_memory(&mut run, &playground);
        (playground, run)
    };
    if !round.has_two_machines {
        return (vec![start(&round.text(), &["run"])], None);
    }
    let endpoint = loopback();
    let text = joined(&round.text(), &HALVES, &endpoint, &endpoint);
    let machines = ["robot", "base"].map(|name| start(&text, &["run", "--machine", name]));
    let forges = round.has(|blow| matches!(blow, Blow::Forge));
    let listens = || std::net::TcpStream::connect(&endpoint[4..]).is_ok();
    let link = forges.then(|| {
        wait_until("the link is there", listens);
        eavesdropper(&endpoint)
    });
    (machines.into(), link)
}

/// Does one round; what was found wrong.
fn attack(round: &Round) -> Result<String, String> {
    let (mut machines, link) = begin(round);
    let prefixes: Vec<_> = machines.iter().map(|(playground, _)| shared_prefix(playground)).collect();
    let (mut beside, begun) = (Beside::default(), Instant::now());
    let count = |machines: &[(Playground, Started)]| machines[machines.len() - 1].0.lines("tracks.jsonl").len() as u64;
    for (after, blow) in &round.blows {
        while count(&machines) < *after && machines.iter_mut().all(|(_, run)| run.is_running()) {
            beside.settle();
            if begun.elapsed() > LONGEST {
                let told: Vec<_> = machines.iter().map(|(_, run)| run.stderr()).collect();
                return Err(format!("it stands still: {told:?}"));
            }
            std::thread::sleep(LOOK);
        }
        strike(*blow, &machines, link.as_ref(), &mut beside);
    }
    while !beside.stopped.is_empty() {
        beside.settle();
        std::thread::sleep(LOOK);
    }
    let was_cut = round.has(|blow| matches!(blow, Blow::KillLauncher));
    if was_cut {
        // The other machine would wait for this one.
        machines.iter().for_each(|(_, run)| signal(run.id(), Signal::INT));
    }
    let (playgrounds, runs): (Vec<_>, Vec<_>) = machines.into_iter().unzip();
    let ended: Vec<_> = runs.into_iter().map(Started::wait).collect();
    beside.settle();
    // Who is killed when nobody else is there leaves what it had; the next run removes that.
    let onlooker_alone = beside.killed.is_some_and(|killed| killed.elapsed() < Duration::from_secs(2));
    let was_killed = ended.last().is_some_and(|launcher| launcher.code.is_none());
    let may_leave = onlooker_alone || (beside.launcher_alone && was_killed);
    beside.end();
    let last = playgrounds.len() - 1;
    for (index, (machine, prefix)) in playgrounds.iter().zip(&prefixes).enumerate() {
        // Launchers and onlookers are killed on the last machine alone.
        expect_nothing_left(machine, prefix, may_leave && index == last)?;
    }
    let sequences = playgrounds[playgrounds.len() - 1].sequences("tracks.jsonl");
    if !sequences.is_sorted_by(|earlier, later| earlier < later) {
        return Err(format!("twice or out of order: {sequences:?}"));
    }
    if was_cut {
        return Ok("cut off".to_owned());
    }
    let lost = if round.has_two_machines { 0 } else { expect_counted(round, &ended[0], sequences.len() as u64)? };
    Ok(format!("{} lines, {lost} lost", sequences.len()))
}

/// Makes sure that no process is left, and nothing in shared memory; nothing but what `doctor` removes, where something may be.
fn expect_nothing_left(playground: &Playground, prefix: &str, may_leave: bool) -> Result<(), String> {
    wait_until("no process is left", || playground.processes().is_empty());
    let left = files_in_shared_memory(prefix);
    if !left.is_empty() && !may_leave {
        return Err(format!("left in shared memory: {left:?}"));
    }
    playground.conicflow(&["doctor", "--clean"]);
    let left = files_in_shared_memory(prefix);
    if left.is_empty() { Ok(()) } else { Err(format!("left in shared memory by `doctor --clean`: {left:?}")) }
}

/// Makes sure that each edge has counted what it lost, and that the exit code says whether that was to be; how many.
fn expect_counted(round: &Round, ended: &Ended, lines: u64) -> Result<u64, String> {
    // A run that is told to end before its first stage has joined it has nothing to count.
    if ended.stages().is_empty() {
        let nothing_was_to_be = round.has(|blow| matches!(blow, Blow::End)) && lines == 0 && ended.code == Some(0);
        return if nothing_was_to_be { Ok(0) } else { Err(format!("no stage joined: {}", ended.stderr)) };
    }
    let (mut lost_in_all, mut lossless_lost) = (0, 0);
    for (topic, writer, reader) in TRACKING_TOPICS {
        let (sent, row) = (ended.stage(writer).messages, ended.input(topic, reader));
        // A stage that is killed when it has sent a message and not yet counted it makes and counts it again where it gets that
        // input again. One that wants the newest only gets another, and its next message has the same number.
        let doubtful = if writer == "source" || round.is_lossless(writer) { 0 } else { round.kills_of(writer) };
        // One that wants the newest only does not know what was sent before it looked for the first time.
        let counted = row.received + row.dropped;
        if counted > sent + doubtful || (counted < sent && round.is_lossless(reader)) {
            return Err(format!("`{writer}` sent {sent}, `{reader}` has {row:?}: {}", ended.stderr));
        }
        lost_in_all += row.dropped;
        if round.is_lossless(reader) && row.dropped > 0 {
            lossless_lost += row.dropped;
            expect_reason(round, [writer, reader], ended)?;
        }
    }
    let expected = i32::from(lossless_lost > 0);
    let made = ended.stage("source").messages;
    if ended.code != Some(expected) {
        return Err(format!("exit code {:?}, {lossless_lost} lossless messages lost: {}", ended.code, ended.stderr));
    }
    // A source that is killed when it has sent a frame and not yet counted it, and the run ends, does not come back to count it.
    let doubtful = round.kills_of("source");
    let is_known = TRACKING_STAGES[1..].iter().all(|stage| round.is_lossless(stage));
    if is_known && (lines + lost_in_all).abs_diff(made) > doubtful {
        return Err(format!("{made} made, {lines} lines, {lost_in_all} lost: {}", ended.stderr));
    }
    Ok(lost_in_all)
}

/// Makes sure that what was lost between a stage and its lossless reader had a reason: both were killed, so that nobody was left
/// who had it, or the reader was killed twice over the same frame.
fn expect_reason(round: &Round, [writer, reader]: [&str; 2], ended: &Ended) -> Result<(), String> {
    let left_out = ended.stderr.contains(&format!("stage `{reader}` leaves out frame "));
    let both_died = round.kills_of(writer) > 0 && round.kills_of(reader) > 0;
    if both_died || (left_out && round.kills_of(reader) > 1) {
        return Ok(());
    }
    Err(format!("`{reader}` lost messages of `{writer}`, which lives: {}", ended.stderr))
}

#[test]
fn attacks_lose_nothing_uncounted_and_leave_nothing_behind() {
    let number = |name: &str| std::env::var(name).ok().map(|text| text.parse::<u64>().unwrap());
    let (first, rounds) = match number(SEED) {
        Some(seed) => (seed, number(ROUNDS).unwrap_or(1)),
        None => (FIRST_SEED, number(ROUNDS).unwrap_or(DEFAULT_ROUNDS)),
    };
    let mut wrong = String::new();
    for seed in first..first + rounds {
        let round = Round::draw(seed);
        println!("{SEED}={seed} {round:?}");
        let attacked = catch_unwind(AssertUnwindSafe(|| attack(&round)));
        let text = |panic: Box<dyn Any + Send>| panic.downcast_ref::<String>().cloned().unwrap_or_default();
        match attacked.unwrap_or_else(|panic| Err(text(panic))) {
            Ok(told) => println!("  {told}"),
            Err(found) => {
                println!("  WRONG: {found}");
                writeln!(wrong, "{SEED}={seed}: {found}\n{round:?}").unwrap();
            }
        }
    }
    assert_eq!(wrong, "");
}
