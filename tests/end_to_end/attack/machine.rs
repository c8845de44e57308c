//! A machine of a round: its run, which may be restarted, and the processes that were started beside it.

use super::round::Victim;
use crate::processes::{files_in_shared_memory, shared_files, stages_of, wait_for_shared_memory};
use crate::support::{CHECK_PERIOD, Ended, Playground, Started, TRACKING, signal, wait_until};
use rustix::process::Signal;
use std::fs;
use std::time::{Duration, Instant};

const RESULTS: &str = "tracks.jsonl";
const NEIGHBOR_RESULTS: &str = "neighbor.jsonl";

/// A machine that runs its part of the pipeline.
pub struct Machine {
    playground: Playground,
    /// Prefix of the names of all its shared memory.
    prefix: String,
    command: Vec<&'static str>,
    run: Started,
    /// Time at which the test first saw that the run had ended.
    ended: Option<Instant>,
    neighbor: Option<Started>,
    /// Number of times that its run was started.
    pub lives: usize,
    swaps: Vec<Started>,
    /// Onlookers, each with the time at which it is killed.
    onlookers: Vec<(Started, Instant)>,
    /// Stopped processes, each with a signal and the time at which it gets the signal.
    stopped: Vec<(u32, Signal, Instant)>,
    /// Time at which the last onlooker was killed.
    killed: Option<Instant>,
    /// Whether a launcher was killed while no stage had shared memory, or while all stages with shared memory were stopped and
    /// then killed with it. In both cases no process was left that could remove the rest.
    launcher_alone: bool,
}

impl Machine {
    /// Starts the run of a machine, and waits until it has shared memory.
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

    /// Starts another pipeline, which runs without an end, beside the run, and waits until it delivers.
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

    /// The files that its sink has written, one for each run.
    fn results(&self) -> impl Iterator<Item = String> {
        (1..self.lives).map(former).chain([RESULTS.to_owned()])
    }

    /// The sequence numbers in these files.
    pub fn sequences(&self) -> Vec<Vec<u64>> {
        self.results().map(|file| self.playground.sequences(&file)).collect()
    }

    /// Number of lines of these files.
    pub fn lines(&self) -> u64 {
        self.results().map(|file| self.playground.count(&file) as u64).sum()
    }

    /// Sends the signals that are due, and kills the onlookers whose time has come.
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

    /// Waits until no stage is stopped any longer.
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

    /// Ends the run by a signal, and starts it again: at once if the signal kills it, otherwise when it has ended. Returns how it
    /// ended.
    pub fn begin_again(&mut self, by: Signal) -> Ended {
        self.wake_all();
        self.signal(by);
        wait_until("the run has ended", || !self.run.is_running());
        fs::rename(self.playground.path(RESULTS), self.playground.path(&former(self.lives))).ok();
        self.lives += 1;
        let again = self.playground.start(&self.command);
        let ended = std::mem::replace(&mut self.run, again).wait();
        // A signal may be lost before the launcher handles it: programs that a script starts in the background ignore SIGINT
        // until then.
        let launcher = self.run.id();
        self.run.wait_until("it has stages", || !stages_of(launcher).is_empty());
        ended
    }

    /// Waits until the run and all processes beside it have ended, and checks that no process and no shared memory is left.
    pub fn end(mut self) -> Result<Ended, String> {
        let ended = self.run.wait();
        self.neighbor.take().map_or(Ok(()), |neighbor| expect_unfelt(neighbor, &self.playground))?;
        for (onlooker, at) in self.onlookers.drain(..) {
            if at <= Instant::now() {
                signal(onlooker.id(), Signal::KILL);
                self.killed = Some(Instant::now());
            }
            // An onlooker ends when its run has ended.
            drop(onlooker.wait());
        }
        // The files of an onlooker that is killed after the run are left behind; the next run removes them.
        let since_kill = |killed| self.ended.unwrap_or_else(Instant::now).saturating_duration_since(killed);
        let onlooker_alone = self.killed.is_some_and(|killed| since_kill(killed) < Duration::from_secs(2));
        let may_leave = onlooker_alone || (self.launcher_alone && ended.code.is_none());
        self.swaps.into_iter().for_each(|swap| drop(swap.wait()));
        expect_nothing_left(&self.playground, &self.prefix, may_leave)?;
        Ok(ended)
    }
}

/// File name of the results of an earlier run of a machine, counted from 1.
fn former(life: usize) -> String {
    format!("tracks-{life}.jsonl")
}

/// Ends a neighboring pipeline, and checks that it was not affected.
fn expect_unfelt(neighbor: Started, playground: &Playground) -> Result<(), String> {
    signal(neighbor.id(), Signal::INT);
    let ended = neighbor.wait();
    let lines = playground.sequences(NEIGHBOR_RESULTS);
    let made = ended.stages().first().map_or(0, |source| ended.stage(source).messages);
    let starts = ended.stages().iter().map(|stage| ended.stage(stage).starts).max();
    let felt_nothing = ended.code == Some(0) && starts == Some(1) && lines.iter().copied().eq(0..made);
    if felt_nothing { Ok(()) } else { Err(format!("the neighbor felt it: {lines:?}: {}", ended.stderr)) }
}

/// Checks that no process and no shared memory is left. If something may be left (`may_leave`), `doctor` has to remove all of it.
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
