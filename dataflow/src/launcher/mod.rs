//! Starts the stages of a plan as processes, supervises them, and ends them in order.
//!
//! A run ends when all its stages have: because the sources are exhausted, its time is over, a user asks for it, or a stage is
//! lost. It then stops the sources, lets messages in flight be delivered, and escalates with time.

mod child;
mod folder;
mod guarded;
mod options;
mod phase;
mod process;
mod progress;
mod request;
mod summary;
mod swap;
#[cfg(test)]
mod trial_run;
mod watchdog;

pub use folder::{FolderError, RUNTIME_DIR, RunFolder, RunLock, user_folder};
pub(crate) use folder::{LAST_STAGES_GRACE, check_private};
pub use options::RunOptions;
pub(crate) use process::{LAUNCHER, STAGE};
pub use process::{
    PIPELINE, ProcessError, become_stage, join_as_source, join_as_stage, run_in_run, run_source, run_stage,
};
pub use request::SwapError;
use summary::Ending;
pub use summary::{StageSummary, Summary, link_table};

use crate::hangup::{ending_signals, stopping_signal};
use crate::plan::Plan;
use crate::ports::PortError;
use crate::ports::shared_memory::{Descriptors, ServiceKeeper, SharedMemory};
use crate::preflight::{InsufficientResource, Requirements};
use crate::stop::Stop;
use child::{Change, RunState, Supervised};
use phase::{DELIVERY_GRACE, Due, Phase};
use progress::Progress;
use rustix::process::Signal;
use signal_hook::consts::{SIGCHLD, SIGTSTP};
use signal_hook::iterator::Signals;
use signal_hook::low_level::emulate_default_handler;
use std::sync::mpsc::{Receiver, RecvTimeoutError, channel};
use std::time::{Duration, Instant};
use swap::Swap;

const STAGE_CHECK_PERIOD: Duration = Duration::from_millis(100);
/// Period of the checks that the shared memory still exists, and that its files are complete.
const SHARED_MEMORY_CHECK_PERIOD: Duration = Duration::from_secs(1);
/// Period of the checks while a stage is being replaced.
const SWAP_CHECK_PERIOD: Duration = Duration::from_millis(2);
/// A run in which nothing moves for this long, while a stage waits for another, is reported as stalled.
const STANDSTILL: Duration = Duration::from_secs(10);

/// Reason why a run could not begin.
#[derive(Debug, thiserror::Error)]
pub enum LaunchError {
    /// The run's folder cannot be used.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// A process could not be started.
    #[error(transparent)]
    Process(#[from] ProcessError),
    /// The shared memory cannot be used.
    #[error(transparent)]
    Port(#[from] PortError),
    /// The machine has too little of a resource.
    #[error(transparent)]
    InsufficientResource(#[from] InsufficientResource),
    /// Signals cannot be received.
    #[error("signals cannot be received: {reason}\n  hint: {hint}", reason = .0, hint = process::hint_of(.0))]
    Signals(std::io::Error),
}

impl LaunchError {
    /// Exit code of a program that could not begin the run: 1 for errors of the system, 2 for errors in the file, the arguments
    /// or the machine.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Process(error) => error.exit_code(),
            Self::Signals(_) => 1,
            Self::Folder(_) | Self::Port(_) | Self::InsufficientResource(_) => 2,
        }
    }
}

/// Runs a plan to its end.
///
/// # Errors
/// The run could not begin. A stage that is lost later is reported by [`Summary::is_complete`].
pub fn run(plan: &Plan, options: &RunOptions) -> Result<Summary, LaunchError> {
    let folder = RunFolder::open(&plan.pipeline)?;
    let lock = folder.lock(&plan.pipeline)?;
    // From here on a signal must not end this process, as its files would be left behind.
    let signals = signals()?;
    let requirements = Requirements::of(plan, options.nodes);
    // Shared memory needs open files itself. Leftovers of dead runs count as free room once they are removed.
    requirements.short_of_files().map_or(Ok(()), Err)?;
    SharedMemory::clean(folder.shared_memory())?;
    requirements.insufficient().into_iter().try_for_each(Err)?;
    folder.empty()?;
    let for_stages = Descriptors::now();
    let memory = SharedMemory::open(folder.shared_memory(), &plan.namespace(), "launcher", Stop::default())?;
    let services = memory.kept_in(folder.path()).keep_services(plan.topics())?;
    for_stages.keep_later_ones();
    // Onlookers may come as soon as there is a plan.
    folder.begin(plan)?;
    let mut launcher = Launcher::new(plan.clone(), folder, options, signals);
    let ended = launcher.supervise(&services, &lock);
    launcher.swap.take().into_iter().for_each(|swap| swap.abandon(&launcher.folder));
    launcher.stages.iter_mut().for_each(Supervised::kill);
    ended?;
    launcher.folder.settle(&launcher.plan);
    drop(services);
    let cleaned = SharedMemory::clean(launcher.folder.shared_memory());
    // If the folder was removed, its leftovers cannot be found here; `doctor` finds them.
    if !launcher.is_removed {
        cleaned?;
    }
    Ok(launcher.summary())
}

struct Launcher<'a> {
    plan: Plan,
    folder: RunFolder,
    options: &'a RunOptions,
    stages: Vec<Supervised>,
    swap: Option<Swap>,
    signals: Receiver<i32>,
    phase: Phase,
    /// A second request to end was received: messages in flight need not be delivered.
    hurried: bool,
    /// Reason why the stages were ended although not all was delivered.
    stalled: Option<String>,
    /// Last progress.
    last_movement: Option<Movement>,
    progress: Progress,
    started: Instant,
    /// Time for which the run was not paused, up to the last check.
    active_time: Duration,
    last_check: Instant,
    /// Time of the last check of the shared memory.
    last_memory_check: Instant,
    /// Whether the shared memory, or the run's folder, was removed.
    is_removed: bool,
}

/// Last progress of a run.
#[derive(Clone, Copy)]
struct Movement {
    /// Number of messages processed by all stages together at that time.
    worked_on: u64,
    since: Instant,
    /// Whether the lack of progress since then was reported.
    is_reported: bool,
}

impl<'a> Launcher<'a> {
    fn new(plan: Plan, folder: RunFolder, options: &'a RunOptions, signals: Receiver<i32>) -> Self {
        Self {
            plan,
            folder,
            options,
            stages: Vec::new(),
            swap: None,
            signals,
            phase: Phase::Running,
            hurried: false,
            stalled: None,
            last_movement: None,
            progress: Progress::new(options.quiet),
            started: Instant::now(),
            active_time: Duration::ZERO,
            last_check: Instant::now(),
            last_memory_check: Instant::now(),
            is_removed: false,
        }
    }

    fn supervise(&mut self, services: &ServiceKeeper, lock: &RunLock) -> Result<(), LaunchError> {
        for planned in &self.plan.stages {
            self.stages.push(Supervised::start(planned.clone(), &self.plan, self.options)?);
        }
        while !self.stages.iter().all(Supervised::is_over) {
            self.wait_for_events();
            // Records may be missing because the folder was removed: that is checked before the stages are.
            self.check_shared_memory(services, lock);
            self.replace();
            self.check_stages();
            self.advance_phase();
            let summary = self.summary();
            self.count_active_time(&summary);
            self.warn_of_standstill(&summary);
            self.progress.show(&summary);
        }
        self.progress.clear();
        Ok(())
    }

    /// Sleeps until a signal comes or a check is due; each request to end escalates.
    fn wait_for_events(&mut self) {
        let period = if self.swap.is_some() { SWAP_CHECK_PERIOD } else { STAGE_CHECK_PERIOD };
        match self.signals.recv_timeout(period) {
            Ok(SIGCHLD) | Err(RecvTimeoutError::Timeout) => {}
            Ok(SIGTSTP) => self.suspend_until_resumed(),
            Ok(_) | Err(RecvTimeoutError::Disconnected) => {
                self.hurried = !matches!(self.phase, Phase::Running);
                match self.phase {
                    Phase::Running => self.stop_sources(),
                    Phase::Delivering { .. } => self.stop_all(),
                    Phase::Stopping { .. } | Phase::Killing => self.kill_all(),
                }
            }
        }
    }

    /// Suspends all stages and this process, and resumes them together, like a job of a shell. The stages have process groups of
    /// their own, which Ctrl-Z and `fg` do not reach.
    fn suspend_until_resumed(&mut self) {
        self.stages.iter().for_each(|stage| stage.signal_group(Signal::STOP));
        // If the system refuses to suspend it, the run goes on at once.
        let stop = || drop(emulate_default_handler(SIGTSTP));
        self.options.around_stop.map_or_else(stop, |around| around(&stop));
        self.stages.iter().for_each(|stage| stage.signal_group(Signal::CONT));
        // The time of the suspension does not count as time of the run.
        let now = Instant::now();
        (self.last_check, self.last_movement) = (now, None);
        if let Phase::Delivering { since, .. } | Phase::Stopping { since } = &mut self.phase {
            *since = now;
        }
    }

    /// Removes files whose maker was killed before they were complete. Ends the run in order if its folder or its shared memory
    /// was removed: a restarted stage would not find the others.
    fn check_shared_memory(&mut self, services: &ServiceKeeper, lock: &RunLock) {
        if self.is_removed {
            return;
        }
        let is_running = matches!(self.phase, Phase::Running);
        let is_due = self.last_memory_check.elapsed() > SHARED_MEMORY_CHECK_PERIOD;
        if is_due {
            self.last_memory_check = Instant::now();
            services.settle();
        }
        if !lock.is_there() {
            let folder = self.folder.path().display();
            tracing::error!(
                "the run ends: its folder `{folder}`, or what is in it, was removed while it went on\n  hint: systemd removes the \
                 folder of a login when its user logs out, and old files in /tmp: set CONICFLOW_RUNTIME_DIR to a folder that \
                 stays; nobody may delete files there while a run goes on"
            );
            self.stalled.get_or_insert_with(|| "its folder was removed while it went on".to_owned());
        } else if is_due && is_running && !services.is_there() {
            let why = "what its stages share was removed while it went on";
            tracing::error!(
                "the run ends: {why}\n  hint: does systemd remove it when the user logs out (`RemoveIPC=no` in logind.conf)? \
                 nobody may delete files in /dev/shm or {} while a run goes on",
                self.folder.shared_memory().display()
            );
            self.stalled.get_or_insert_with(|| why.to_owned());
        } else {
            return;
        }
        self.is_removed = true;
        if is_running {
            self.stop_sources();
        }
    }

    /// Advances the current swap, or begins a requested one.
    fn replace(&mut self) {
        let Self { plan, folder, options, stages, swap, phase, is_removed, .. } = self;
        let mut run = RunState { plan, folder, options, phase: *phase, is_removed: *is_removed };
        *swap = match swap.take() {
            Some(under_way) => under_way.advance(stages, &mut run),
            None => run.folder.take_request().map(|request| Swap::begin(request, stages, &run)),
        };
    }

    fn check_stages(&mut self) {
        let ending = !matches!(self.phase, Phase::Running);
        let mut lost = false;
        let Self { plan, folder, options, stages, swap, phase, is_removed, .. } = self;
        let run = RunState { plan, folder, options, phase: *phase, is_removed: *is_removed };
        let leaving = swap.as_ref().filter(|swap| swap.handles_exit()).map(Swap::stage);
        for stage in stages.iter_mut().filter(|stage| leaving != Some(&stage.planned.name)) {
            lost |= stage.check(&run) == Change::Lost;
        }
        if !ending && (lost || self.all_sinks_are_over()) {
            if lost {
                tracing::error!("the run ends, because a stage is lost");
            }
            self.stop_sources();
        }
    }

    /// Whether all sinks are over, so that nobody needs further messages.
    fn all_sinks_are_over(&self) -> bool {
        let mut sinks = self.stages.iter().filter(|stage| stage.planned.is_sink()).peekable();
        sinks.peek().is_some() && sinks.all(Supervised::is_over)
    }

    /// Enters the next phase when the time of this one is over.
    fn advance_phase(&mut self) {
        let now = Instant::now();
        match self.phase.due(now, self.active_time, self.options.duration, || self.delivered()) {
            Due::Nothing => {}
            Due::StopSources => self.stop_sources(),
            Due::WaitForMore(delivered) => self.phase = Phase::Delivering { delivered, since: now },
            Due::EndStalled => self.end_stalled(),
            Due::KillAll => self.kill_all(),
        }
    }

    fn stop_sources(&mut self) {
        self.phase = Phase::Delivering { delivered: self.delivered(), since: Instant::now() };
        self.stages.iter().filter(|stage| stage.planned.is_source()).for_each(|stage| stage.signal(Signal::INT));
    }

    /// Ends a run at once that has stalled on its way to its end.
    fn end_stalled(&mut self) {
        let left = self.stages.iter().filter(|stage| !stage.is_over());
        let left: Vec<_> = left.map(|stage| format!("`{}`", stage.planned.name)).collect();
        if left.is_empty() {
            return;
        }
        let reasons = [vec![format!("waited for {}", left.join(", "))], self.summary().who_waits()].concat();
        let seconds = DELIVERY_GRACE.as_secs();
        let why = format!("nothing was delivered any more for {seconds} s: {}", reasons.join(", "));
        tracing::error!("the run is ended at once: {why}");
        self.stalled.get_or_insert(why);
        self.stop_all();
    }

    fn stop_all(&mut self) {
        self.phase = Phase::Stopping { since: Instant::now() };
        self.stages.iter().for_each(|stage| stage.signal(Signal::TERM));
    }

    fn kill_all(&mut self) {
        self.phase = Phase::Killing;
        self.stages.iter_mut().for_each(Supervised::kill);
    }

    /// Progress of the delivery: the number of messages processed, of stages that are over, and of processes that came to work or
    /// replaced one that had, as a replacement may have to wait as long again.
    fn delivered(&self) -> u64 {
        let of_stage = |stage: &Supervised| stage.counted_starts() + u64::from(stage.is_over());
        self.summary().worked_on() + self.stages.iter().map(of_stage).sum::<u64>()
    }

    /// Excludes time in which the run is paused from its duration.
    fn count_active_time(&mut self, summary: &Summary) {
        let passed = self.last_check.elapsed();
        self.last_check += passed;
        let (_, is_paused) = summary.pausing();
        self.active_time += if is_paused { Duration::ZERO } else { passed };
    }

    /// Logs once per stall which stages wait for which.
    fn warn_of_standstill(&mut self, summary: &Summary) {
        let now = Movement { worked_on: summary.worked_on(), since: Instant::now(), is_reported: false };
        let stands = matches!(self.phase, Phase::Running) && summary.is_held_up();
        let before = self.last_movement.get_or_insert(now);
        if !stands || before.worked_on != now.worked_on {
            *before = now;
        } else if !before.is_reported && before.since.elapsed() > STANDSTILL {
            before.is_reported = true;
            let waits = summary.who_waits().join(", ");
            tracing::warn!("nothing has moved for {} s: {waits}", STANDSTILL.as_secs());
        }
    }

    fn summary(&self) -> Summary {
        let complete = !self.stages.iter().any(Supervised::is_gone);
        let ending = Ending { complete, hurried: self.hurried, stalled: self.stalled.clone() };
        Summary::read(&self.plan, &self.folder, self.started.elapsed(), ending)
    }
}

fn signals() -> Result<Receiver<i32>, LaunchError> {
    let heard = ending_signals().into_iter().chain(stopping_signal()).chain([SIGCHLD]);
    let mut signals = Signals::new(heard).map_err(LaunchError::Signals)?;
    let (sender, receiver) = channel();
    let listen = move || signals.forever().take_while(|signal| sender.send(*signal).is_ok()).for_each(drop);
    let builder = std::thread::Builder::new().name("signals".to_owned());
    builder.spawn(listen).map_err(LaunchError::Signals)?;
    Ok(receiver)
}

#[cfg(test)]
mod tests {
    use super::child::tests::{at_work, over};
    use super::folder::tests::folder_at;
    use super::summary::tests::stage;
    use super::trial_run::{change_record, plan_of};
    use super::*;
    use crate::plan::PlannedStage;
    use crate::status::{Life, Pausing};
    use conicflow_messages::{Object, Text};
    use signal_hook::consts::{SIGINT, SIGTERM};
    use std::path::Path;

    #[test]
    fn an_exit_code_tells_what_the_system_refuses_from_what_is_wrong_with_the_run() {
        let error = || std::io::Error::from(std::io::ErrorKind::Other);
        for (error, code) in [
            (LaunchError::Signals(error()), 1),
            (LaunchError::Port(PortError::Stopped), 2),
            (LaunchError::Folder(FolderError::Running { name: "test".into() }), 2),
            (LaunchError::Process(ProcessError::System { doing: "a".into(), error: error() }), 1),
            (LaunchError::Process(ProcessError::NoNetwork), 2),
        ] {
            assert_eq!(error.exit_code(), code, "{error}");
        }
    }

    /// A launcher whose two stages have processed 3 and 4 messages; the second is over.
    fn launcher<'a>(files: &Path, options: &'a RunOptions, phase: Phase) -> Launcher<'a> {
        let folder = folder_at(files);
        let named = |name: &str| PlannedStage { name: name.to_owned(), ..stage::<Object>() };
        let planned = [named("first"), named("second")];
        for (planned, steps) in planned.iter().zip([3, 4]) {
            change_record(&folder, &planned.name, |status| status.steps = steps);
        }
        let plan = Plan { stages: planned.to_vec(), ..plan_of(7) };
        let [first, second] = planned;
        let (stages, progress) = (vec![at_work(first), over(second)], Progress::new(true));
        Launcher { stages, phase, progress, ..Launcher::new(plan, folder, options, channel().1) }
    }

    #[test]
    fn the_delivery_is_as_far_as_messages_are_worked_on_and_stages_are_over_or_started_anew() {
        let (files, options) = (tempfile::tempdir().unwrap(), RunOptions::default());
        let mut launcher = launcher(files.path(), &options, Phase::Running);
        assert_eq!(launcher.delivered(), 3 + 4 + 1);
        let process = launcher.stages[0].process().unwrap();
        for starts in [2, 3] {
            change_record(&launcher.folder, "first", |status| (status.process, status.starts) = (process, starts));
            launcher.check_stages();
            assert_eq!(launcher.delivered(), 3 + 4 + 1, "it has not come to work");
        }
        change_record(&launcher.folder, "first", |status| status.set_life(Life::Running));
        for _ in 0..2 {
            launcher.check_stages();
            assert_eq!(launcher.delivered(), 3 + 4 + 1 + 1, "from when it is at work on, however long that has taken");
        }
        launcher.kill_all();
        assert_eq!(launcher.delivered(), 3 + 4 + 2 + 1);
    }

    #[test]
    fn each_request_to_end_presses_harder_than_the_one_before_and_the_end_of_a_process_is_none() {
        let (files, options) = (tempfile::tempdir().unwrap(), RunOptions::default());
        let mut launcher = launcher(files.path(), &options, Phase::Running);
        let (sender, signals) = channel();
        launcher.signals = signals;
        let mut sent = |signal: i32| {
            sender.send(signal).unwrap();
            launcher.wait_for_events();
            (launcher.phase, launcher.hurried, launcher.stages[0].is_over())
        };
        assert!(matches!(sent(SIGCHLD), (Phase::Running, false, false)));
        assert!(matches!(sent(SIGINT), (Phase::Delivering { delivered: 8, .. }, false, false)));
        assert!(matches!(sent(SIGTERM), (Phase::Stopping { .. }, true, false)));
        assert!(matches!(sent(SIGINT), (Phase::Killing, true, true)));
    }

    #[test]
    fn a_run_lasts_until_all_its_stages_are_over() {
        let (files, shared) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let options = RunOptions { program: "true".into(), quiet: true, ..RunOptions::default() };
        let (_sender, signals) = channel();
        let memory = SharedMemory::open(shared.path(), "test", "launcher", Stop::default()).unwrap();
        let services = memory.keep_services(std::iter::empty()).unwrap();
        let folder = folder_at(files.path());
        let lock = folder.lock("test").unwrap();
        folder.begin(&plan_of(7)).unwrap();
        let mut launcher = Launcher::new(plan_of(7), folder, &options, signals);
        launcher.supervise(&services, &lock).unwrap();
        assert_eq!(launcher.stages.iter().map(Supervised::is_over).collect::<Vec<_>>(), [true]);
        assert!(launcher.summary().is_complete());
    }

    #[test]
    fn time_in_which_a_run_is_paused_is_none_of_that_which_it_is_to_last() {
        let (files, options) = (tempfile::tempdir().unwrap(), RunOptions::default());
        let mut launcher = launcher(files.path(), &options, Phase::Running);
        for pausing in [Pausing::Goes, Pausing::Stands] {
            change_record(&launcher.folder, "first", |status| {
                status.set_life(Life::Running);
                status.set_pausing(pausing);
            });
            let before = launcher.active_time;
            launcher.last_check = Instant::now().checked_sub(Duration::from_secs(60)).unwrap();
            launcher.count_active_time(&launcher.summary());
            assert_eq!(launcher.active_time - before >= Duration::from_secs(60), pausing == Pausing::Goes);
            assert!(launcher.last_check.elapsed() < Duration::from_secs(60), "time counts once");
        }
        launcher.kill_all();
    }

    #[test]
    fn a_run_at_work_stands_still_once_nothing_has_moved_for_ten_seconds_although_a_stage_waits_for_another() {
        let (files, options) = (tempfile::tempdir().unwrap(), RunOptions::default());
        let mut launcher = launcher(files.path(), &options, Phase::Running);
        let is_reported = |launcher: &mut Launcher<'_>, worked_on: u64, seconds: u64| {
            let since = Instant::now().checked_sub(Duration::from_secs(seconds)).unwrap();
            launcher.last_movement = Some(Movement { worked_on, since, is_reported: false });
            launcher.warn_of_standstill(&launcher.summary());
            launcher.last_movement.unwrap().is_reported
        };
        assert!(!is_reported(&mut launcher, 7, 20), "nobody waits");
        change_record(&launcher.folder, "first", |status| status.waits_for = Text::new("second"));
        assert!(is_reported(&mut launcher, 7, 20));
        assert!(!is_reported(&mut launcher, 7, 5), "not for long");
        assert!(!is_reported(&mut launcher, 6, 20), "something has moved since");
        launcher.phase = Phase::Delivering { delivered: 0, since: Instant::now() };
        assert!(!is_reported(&mut launcher, 7, 20), "it comes to its end");
        launcher.kill_all();
    }

    #[test]
    fn a_run_comes_to_its_end_when_a_stage_is_lost_or_all_sinks_are_over() {
        let (files, options) = (tempfile::tempdir().unwrap(), RunOptions::default());
        for (loses_a_stage, is_sink_over) in [(false, false), (true, false), (false, true)] {
            let mut launcher = launcher(files.path(), &options, Phase::Running);
            let topic = launcher.stages[0].planned.wiring.output.clone();
            if loses_a_stage {
                let process = launcher.stages[0].process().unwrap();
                change_record(&launcher.folder, "first", |status| {
                    status.process = process;
                    status.set_life(Life::Gone);
                });
                launcher.stages[0].signal(Signal::KILL);
            } else {
                let wiring = &mut launcher.stages[usize::from(is_sink_over)].planned.wiring;
                (wiring.input, wiring.output) = (topic, None);
            }
            let begin = Instant::now();
            while loses_a_stage && !launcher.stages[0].is_gone() && begin.elapsed() < Duration::from_secs(20) {
                launcher.check_stages();
            }
            launcher.check_stages();
            let ends = matches!(launcher.phase, Phase::Delivering { .. });
            assert_eq!(ends, loses_a_stage || is_sink_over);
            assert_eq!(launcher.summary().is_complete(), !loses_a_stage);
            launcher.kill_all();
        }
    }

    #[test]
    fn a_request_to_swap_a_stage_is_answered_and_that_of_another_run_refused() {
        let (files, options) = (tempfile::tempdir().unwrap(), RunOptions::default());
        let mut launcher = launcher(files.path(), &options, Phase::Running);
        launcher.replace();
        assert!(launcher.swap.is_none(), "nobody has asked");
        let plan = Plan { run: 6, ..launcher.plan.clone() };
        let request = request::Request { id: 5, stage: "first".into(), plan };
        launcher.folder.write_whole("swap.request", &request).unwrap();
        launcher.replace();
        assert!(launcher.swap.as_ref().is_some_and(|swap| swap.stage() == "first"));
        launcher.replace();
        assert!(launcher.swap.is_none());
        let answer = std::fs::read_to_string(files.path().join("swap.answer")).unwrap();
        assert!(answer.contains(r#""id": 5"#) && answer.contains("another run"), "{answer}");
        launcher.kill_all();
    }

    #[test]
    fn what_is_due_is_done() {
        let (files, limit) = (tempfile::tempdir().unwrap(), Duration::from_secs(10));
        let options = RunOptions { duration: Some(limit), ..RunOptions::default() };
        let long_ago = Instant::now().checked_sub(Duration::from_secs(60)).unwrap();
        let pressed = |phase: Phase, active_time: Duration| {
            let mut launcher = launcher(files.path(), &options, phase);
            launcher.active_time = active_time;
            launcher.advance_phase();
            let ended = (launcher.phase, launcher.stalled.take(), launcher.stages[0].is_over());
            launcher.kill_all();
            ended
        };
        assert!(matches!(pressed(Phase::Running, limit), (Phase::Running, None, false)));
        let over = pressed(Phase::Running, 2 * limit);
        assert!(matches!(over, (Phase::Delivering { delivered: 8, .. }, None, false)), "{over:?}");
        let delivering = pressed(Phase::Delivering { delivered: 7, since: long_ago }, limit);
        let (Phase::Delivering { delivered: 8, since }, None, false) = delivering else { panic!("{delivering:?}") };
        assert!(since > long_ago);
        let (phase, stalled, _) = pressed(Phase::Delivering { delivered: 8, since: long_ago }, limit);
        assert!(matches!(phase, Phase::Stopping { .. }), "{phase:?}");
        assert!(stalled.unwrap().contains("waited for `first`"));
        let killed = pressed(Phase::Stopping { since: long_ago }, limit);
        assert!(matches!(killed, (Phase::Killing, None, true)), "{killed:?}");
    }
}
