//! A machine of a round: its run, which may be begun again, and what was started beside it.

use super::round::Victim;
use crate::processes::{files_in_shared_memory, shared_files, stages_of, wait_for_shared_memory};
use crate::support::{CHECK_PERIOD, Ended, Playground, Started, TRACKING, signal, wait_until};
use rustix::process::Signal;
use std::fs;
use std::time::{Duration, Instant};

const RESULTS: &str = "tracks.jsonl";
const NEIGHBOR_RESULTS: &str = "neighbor.jsonl";

/// A machine that runs its part of the pipeline, for the first time or again.
pub struct Machine {
    playground: Playground,
    /// What the names of all its shared memory begin with.
    prefix: String,
    command: Vec<&'static str>,
    run: Started,
    /// When the run was first seen to have ended.
    ended: Option<Instant>,
    neighbor: Option<Started>,
    /// How often its run has been begun.
    pub lives: usize,
    swaps: Vec<Started>,
    /// Who is killed, and when.
    onlookers: Vec<(Started, Instant)>,
    /// Who gets a signal, and when.
    stopped: Vec<(u32, Signal, Instant)>,
    /// When the last onlooker was killed.
    killed: Option<Instant>,
    /// Whether a launcher was killed when no stage had shared memory, or all that had were stopped and die with it: nobody was left
    /// who could remove what was there.
    launcher_alone: bool,
}

impl Machine {
    /// Begins the run of a machine, until it has shared memory.
    pub fn start(text: &str, command: Vec<&'static str>) -> Self {
        let playground = Playground::with_pipeline(text);
        let mut run = playground.start(&command);
        let prefix = wait_for_shared_memory(&mut run, &playground);
        Self {
            playground,
            prefix,
            command,
            run,
            ended: None,
            neighbor: None,
            lives: 1,
            swaps: Vec::new(),
            onlookers: Vec::new(),
            stopped: Vec::new(),
            killed: None,
            launcher_alone: false,
        }
    }

    /// Starts another pipeline beside the run, which goes on for ever, until it delivers.
    pub fn start_neighbor(&mut self) {
        let text = TRACKING.replace("\"tracking\"", "\"neighbor\"").replace(RESULTS, NEIGHBOR_RESULTS);
        self.playground.write("neighbor.toml", &text);
        let mut run = self.playground.start(&["run", "neighbor.toml", "--set", "source.rate_hz=50"]);
        run.wait_until("the neighbor delivers", || self.playground.count(NEIGHBOR_RESULTS) > 3);
        self.neighbor = Some(run);
    }

    pub fn is_running(&mut self) -> bool {
        let is_running = self.run.is_running();
        self.ended = if is_running { None } else { self.ended.or_else(|| Some(Instant::now())) };
        is_running
    }

    pub fn signal(&self, by: Signal) {
        signal(self.run.id(), by);
    }

    pub fn stderr(&self) -> String {
        self.run.stderr()
    }

    /// The files that its sink has written, run by run.
    fn results(&self) -> impl Iterator<Item = String> {
        (1..self.lives).map(former).chain([RESULTS.to_owned()])
    }

    /// The sequence numbers in these files.
    pub fn sequences(&self) -> Vec<Vec<u64>> {
        self.results().map(|file| self.playground.sequences(&file)).collect()
    }

    /// How many lines these files have so far.
    pub fn lines(&self) -> u64 {
        self.results().map(|file| self.playground.count(&file) as u64).sum()
    }

    /// Does what is due.
    pub fn settle(&mut self) {
        let now = Instant::now();
        for (process, then, _) in self.stopped.extract_if(.., |(_, _, at)| *at <= now) {
            signal(process, then);
        }
        for (onlooker, _) in self.onlookers.extract_if(.., |(_, at)| *at <= now) {
            signal(onlooker.id(), Signal::KILL);
            self.killed = Some(now);
        }
    }

    /// Waits until no stage is stopped any more.
    pub fn wake_all(&mut self) {
        while !self.stopped.is_empty() {
            self.settle();
            std::thread::sleep(CHECK_PERIOD);
        }
    }

    fn process_of(&self, victim: Victim) -> Option<u32> {
        stages_of(self.run.id()).get(victim.stage).copied()
    }

    pub fn kill(&self, victim: Victim) {
        self.process_of(victim).into_iter().for_each(|process| signal(process, Signal::KILL));
    }

    pub fn stop(&mut self, victim: Victim, milliseconds: u64, then: Signal) {
        if let Some(process) = self.process_of(victim) {
            signal(process, Signal::STOP);
            self.stopped.push((process, then, Instant::now() + Duration::from_millis(milliseconds)));
        }
    }

    pub fn swap(&mut self, victim: Victim) {
        if self.process_of(victim).is_some() {
            self.swaps.push(self.playground.start(&["swap", victim.stage, "--pipeline", "tracking"]));
        }
    }

    pub fn look_on(&mut self, topic: &str, milliseconds: u64) {
        let onlooker = self.playground.start(&["topic", "echo", topic, "--pipeline", "tracking"]);
        self.onlookers.push((onlooker, Instant::now() + Duration::from_millis(milliseconds)));
    }

    pub fn kill_launcher(&mut self) {
        let launcher = self.run.id();
        let is_stopped = |stage: u32| self.stopped.iter().any(|(process, ..)| *process == stage);
        let removes = |stage: u32| !shared_files(stage).is_empty() && !is_stopped(stage);
        self.launcher_alone |= !stages_of(launcher).values().any(|stage| removes(*stage));
        signal(launcher, Signal::KILL);
        wait_until("the launcher is gone", || !self.run.is_running());
    }

    /// Ends the run by a signal, and begins it again: at once where it is killed, else when it has come to its end; how it ended.
    pub fn begin_again(&mut self, by: Signal) -> Ended {
        self.wake_all();
        self.signal(by);
        wait_until("the run has ended", || !self.run.is_running());
        fs::rename(self.playground.path(RESULTS), self.playground.path(&former(self.lives))).ok();
        self.lives += 1;
        let again = self.playground.start(&self.command);
        let ended = std::mem::replace(&mut self.run, again).wait();
        // A signal before the launcher listens may be lost: what a script starts in the background ignores SIGINT until then.
        let launcher = self.run.id();
        self.run.wait_until("it has stages", || !stages_of(launcher).is_empty());
        ended
    }

    /// Waits for the end of the run and of all beside it, and makes sure that no process is left, and nothing in shared memory.
    pub fn end(mut self) -> Result<Ended, String> {
        let ended = self.run.wait();
        self.neighbor.take().map_or(Ok(()), |neighbor| expect_unfelt(neighbor, &self.playground))?;
        for (onlooker, at) in self.onlookers.drain(..) {
            if at <= Instant::now() {
                signal(onlooker.id(), Signal::KILL);
                self.killed = Some(Instant::now());
            }
            // Who looks on ends by himself when there is nothing to look at.
            drop(onlooker.wait());
        }
        // Who is killed when nobody else is there leaves what it had; the next run removes that.
        let since_kill = |killed| self.ended.unwrap_or_else(Instant::now).saturating_duration_since(killed);
        let onlooker_alone = self.killed.is_some_and(|killed| since_kill(killed) < Duration::from_secs(2));
        let may_leave = onlooker_alone || (self.launcher_alone && ended.code.is_none());
        self.swaps.into_iter().for_each(|swap| drop(swap.wait()));
        expect_nothing_left(&self.playground, &self.prefix, may_leave)?;
        Ok(ended)
    }
}

/// What a machine's former run has written, counted from 1.
fn former(life: usize) -> String {
    format!("tracks-{life}.jsonl")
}

/// Ends a neighbor and makes sure that it has felt nothing.
fn expect_unfelt(neighbor: Started, playground: &Playground) -> Result<(), String> {
    signal(neighbor.id(), Signal::INT);
    let ended = neighbor.wait();
    let lines = playground.sequences(NEIGHBOR_RESULTS);
    let made = ended.stages().first().map_or(0, |source| ended.stage(source).messages);
    let starts = ended.stages().iter().map(|stage| ended.stage(stage).starts).max();
    let felt_nothing = ended.code == Some(0) && starts == Some(1) && lines.iter().copied().eq(0..made);
    if felt_nothing { Ok(()) } else { Err(format!("the neighbor felt it: {lines:?}: {}", ended.stderr)) }
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
