//! Replaces a running stage: starts its successor beside it, asks the stage to leave once the successor is ready, and hands over.
//!
//! Before the stage is asked to leave, any failure leaves it running. Afterwards the successor takes the place however the stage
//! ended; a successor that cannot start hands the place back.

use super::child::{RunState, Supervised, command};
use super::folder::RunFolder;
use super::guarded::Guarded;
use super::options::RunOptions;
use super::phase::Phase;
use super::process::ProcessError;
use super::request::Request;
use crate::plan::{Plan, PlannedStage};
use crate::runner::handover::{Handover, SUCCESSOR};
use crate::status::{Life, Status};
use rustix::process::Signal;
use std::fmt::Display;
use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::os::unix::net::UnixStream;
use std::time::{Duration, Instant};

/// Time within which a successor has to be ready.
const READY_TIMEOUT: Duration = Duration::from_secs(15);
/// A stage that has not left this long after it was asked to is killed.
const LEAVE_GRACE: Duration = Duration::from_secs(30);
/// A dismissed successor has this time to end by itself.
const DISMISS_GRACE: Duration = Duration::from_secs(2);

/// A swap under way.
pub(crate) struct Swap {
    request: Request,
    step: Step,
    since: Instant,
}

enum Step {
    /// The successor opens its ports beside the stage at work.
    Preparing(Successor),
    /// The stage at work was asked to leave.
    Leaving(Successor),
    /// The successor has taken over, and will report that it works. Keeps the previous plan of the stage.
    Beginning(Box<PlannedStage>),
    /// The swap is over. The answer to the requester is still to be written, which may take until the disk has room.
    Over { outcome: Result<(), String>, is_late: bool },
}

impl Step {
    const fn over(outcome: Result<(), String>) -> Self {
        Self::Over { outcome, is_late: false }
    }

    /// Whether this step has taken too long.
    fn is_overdue(&self, taken: Duration) -> bool {
        match self {
            Self::Preparing(_) => taken > READY_TIMEOUT,
            Self::Leaving(_) => taken > LEAVE_GRACE,
            Self::Beginning(_) | Self::Over { .. } => false,
        }
    }
}

/// The process that is to replace a stage.
struct Successor {
    process: Guarded,
    /// Its standard input.
    control: UnixStream,
}

impl Successor {
    fn start(planned: &PlannedStage, plan: &Plan, options: &RunOptions) -> Result<Self, ProcessError> {
        let fault =
            |error| ProcessError::System { doing: format!("stage `{}` cannot be replaced", planned.name), error };
        let (control, input) = UnixStream::pair().map_err(fault)?;
        control.set_nonblocking(true).map_err(fault)?;
        let mut command = command(planned, plan, options);
        let process = Guarded::start(command.env(SUCCESSOR, "1").stdin(OwnedFd::from(input)), planned);
        Ok(Self { process: process.map_err(fault)?, control })
    }

    /// Whether it is ready; an error if it has ended.
    fn is_ready(&mut self) -> Result<bool, ()> {
        match self.control.read(&mut [0]) {
            Ok(0) => Err(()),
            Ok(_) => Ok(true),
            // Nothing was received yet.
            Err(_) => Ok(false),
        }
    }

    /// Tells it to begin.
    fn begin(mut self) -> Guarded {
        // If it has died meanwhile, the next check finds out.
        self.control.write_all(b"b").ok();
        self.process
    }

    /// Lets it end in order, so that it leaves nothing behind.
    fn dismiss(self) {
        self.end_within(DISMISS_GRACE);
    }

    /// Closes its control connection, so that it ends, and kills it if it has not ended in time.
    fn end_within(self, grace: Duration) {
        let Self { mut process, control } = self;
        drop(control);
        let child = &mut process.child;
        let deadline = Instant::now() + grace;
        while matches!(child.try_wait(), Ok(None)) && Instant::now() < deadline {
            std::thread::sleep(Duration::from_millis(5));
        }
        child.kill().ok();
        child.wait().ok();
    }
}

impl Swap {
    /// Begins a swap.
    pub(crate) fn begin(request: Request, stages: &[Supervised], run: &RunState<'_>) -> Self {
        let step = match Self::prepare(&request, stages, run) {
            Ok(successor) => Step::Preparing(successor),
            Err(fault) => refused(&request.stage, fault),
        };
        Self { request, step, since: Instant::now() }
    }

    fn prepare(request: &Request, stages: &[Supervised], run: &RunState<'_>) -> Result<Successor, String> {
        let name = &request.stage;
        let other_run = || "it was asked for another run\n  hint: try again".to_owned();
        let planned = request.plan.stage(name).filter(|_| request.plan.run == run.plan.run).ok_or_else(other_run)?;
        let stage = stages.iter().find(|stage| stage.planned.name == *name).ok_or_else(other_run)?;
        if !matches!(run.phase, Phase::Running) || stage.process().is_none() || !is_at_work(run.folder, stage) {
            return Err(format!("stage `{name}` is not at work\n  hint: `conicflow top` shows which stages are"));
        }
        Handover::of(run.folder.path(), name).clear();
        run.folder.change_plan(&request.plan).map_err(|error| error.to_string())?;
        let successor = Successor::start(planned, &request.plan, run.options).map_err(|error| {
            run.take_plan_back();
            error.to_string()
        })?;
        tracing::info!("stage `{name}` is being replaced");
        Ok(successor)
    }

    /// Name of the stage.
    pub(crate) fn stage(&self) -> &str {
        &self.request.stage
    }

    /// Whether the exit of the stage's process is part of the swap, so that it is not restarted.
    pub(crate) fn handles_exit(&self) -> bool {
        matches!(self.step, Step::Leaving(_) | Step::Beginning(_))
    }

    /// Advances the swap; `None` when it is over and the requester has its answer.
    pub(crate) fn advance(self, stages: &mut [Supervised], run: &mut RunState<'_>) -> Option<Self> {
        let Self { request, step, since } = self;
        if let Step::Over { outcome, is_late } = step {
            let error = run.folder.answer(request.id, &outcome).err()?;
            if !is_late {
                tracing::warn!("the result of a swap cannot be reported, of stage `{}`: {error}", request.stage);
            }
            return Some(Self { request, step: Step::Over { outcome, is_late: true }, since });
        }
        let stage = stages.iter_mut().find(|stage| stage.planned.name == request.stage)?;
        let is_overdue = step.is_overdue(since.elapsed());
        let (step, since) = match step {
            Step::Preparing(mut successor) => match check_successor(&mut successor, stage, run, is_overdue) {
                Ok(false) => (Step::Preparing(successor), since),
                Ok(true) => {
                    stage.signal(Signal::USR1);
                    (Step::Leaving(successor), Instant::now())
                }
                Err(fault) => {
                    successor.dismiss();
                    run.take_plan_back();
                    (refused(&request.stage, fault), since)
                }
            },
            Step::Leaving(successor) => {
                if is_overdue {
                    stage.signal(Signal::KILL);
                }
                match stage.exit() {
                    None => (Step::Leaving(successor), since),
                    Some(process) if came_to_its_end(run.folder, &request.stage, process) => {
                        successor.dismiss();
                        run.take_plan_back();
                        let fault = "the stage came to its end\n  hint: nothing is left to do";
                        (refused(&request.stage, fault), since)
                    }
                    Some(_) => (take_place(successor, stage, &request, run), Instant::now()),
                }
            }
            Step::Beginning(before) => {
                if is_at_work(run.folder, stage) {
                    tracing::info!("stage `{}` was replaced", request.stage);
                    (Step::over(Ok(())), since)
                } else if stage.exit().is_none() || matches!(run.phase, Phase::Killing) {
                    (Step::Beginning(before), since)
                } else {
                    let own = run.plan.stages.iter_mut().filter(|own| own.name == before.name);
                    own.for_each(|own| *own = (*before).clone());
                    stage.restart_as(*before);
                    run.take_plan_back();
                    let fault = "the new stage could not begin, and the old one comes back\n  \
                                 hint: the launcher's log says why";
                    (refused(&request.stage, fault), since)
                }
            }
            over @ Step::Over { .. } => (over, since),
        };
        Some(Self { request, step, since })
    }

    /// Ends the processes that it has started, at the end of the run.
    pub(crate) fn abandon(self, folder: &RunFolder) {
        let ended = || Err("the run ended\n  hint: start it anew".to_owned());
        let outcome = match self.step {
            Step::Over { outcome, .. } => outcome,
            Step::Preparing(successor) | Step::Leaving(successor) => {
                successor.dismiss();
                ended()
            }
            Step::Beginning(_) => ended(),
        };
        // Without an answer the requester sees that the run is over.
        folder.answer(self.request.id, &outcome).ok();
    }
}

/// Whether the successor is ready; an error gives the reason to call off the swap.
fn check_successor(
    successor: &mut Successor,
    stage: &mut Supervised,
    run: &RunState<'_>,
    is_overdue: bool,
) -> Result<bool, &'static str> {
    if !matches!(run.phase, Phase::Running) {
        return Err("the run ends\n  hint: start it anew");
    }
    if stage.process().is_none() {
        return Err("the stage died meanwhile\n  hint: try again when it is back");
    }
    if is_overdue {
        return Err(
            "the new stage is not ready: no message reached it\n  hint: try again when its writers send something",
        );
    }
    successor.is_ready().map_err(|()| "the new stage could not start\n  hint: the launcher's log says why")
}

fn take_place(successor: Successor, stage: &mut Supervised, request: &Request, run: &mut RunState<'_>) -> Step {
    let before = Box::new(stage.planned.clone());
    *run.plan = request.plan.clone();
    if let Some(planned) = run.plan.stage(&request.stage) {
        stage.planned = planned.clone();
    }
    stage.replace_process(successor.begin());
    match run.phase {
        Phase::Delivering { .. } if stage.planned.is_source() => stage.signal(Signal::INT),
        Phase::Stopping { .. } => stage.signal(Signal::TERM),
        _ => {}
    }
    Step::Beginning(before)
}

fn refused(stage: &str, fault: impl Display) -> Step {
    tracing::warn!("stage `{stage}` is not replaced: {fault}");
    Step::over(Err(format!("stage `{stage}` is not replaced: {fault}")))
}

impl RunState<'_> {
    /// Restores the plan from before the swap, for stages that restart.
    fn take_plan_back(&self) {
        self.folder.take_plan_back().unwrap_or_else(|error| tracing::error!("{error}"));
    }
}

/// Whether the stage's record says that its process is, or has been, at work.
fn is_at_work(folder: &RunFolder, stage: &Supervised) -> bool {
    let record = Status::read(&folder.status(&stage.planned.name));
    record.is_some_and(|record| Some(record.process) == stage.process() && record.life() != Life::Starting)
}

fn came_to_its_end(folder: &RunFolder, stage: &str, process: u32) -> bool {
    let record = Status::read(&folder.status(stage));
    record.is_some_and(|record| record.process == process && record.life() == Life::Ended)
}

#[cfg(test)]
mod tests {
    use super::super::child::tests::{answers, at_work, echo};
    use super::super::summary::tests::stage;
    use super::super::trial_run::{TrialRun, logged};
    use super::*;
    use crate::ports::Topic;
    use conicflow_messages::Object;
    use rustix::process::{Pid, test_kill_process};
    use std::process::{Command, Stdio};

    fn successor() -> Successor {
        let (control, input) = UnixStream::pair().unwrap();
        let child = Command::new("cat").stdin(OwnedFd::from(input)).stdout(Stdio::null()).spawn().unwrap();
        Successor { process: child.into(), control }
    }

    #[test]
    fn a_stage_that_was_told_to_leave_is_killed_when_its_time_is_over_and_not_before() {
        let (mut stage, mut run, request) = to_replace();
        let leaving = |seconds: u64| {
            let request = request.clone();
            let since = Instant::now().checked_sub(Duration::from_secs(seconds)).unwrap();
            let successor = successor();
            let process = successor.process.child.id();
            (Swap { request, step: Step::Leaving(successor), since }, process)
        };
        let mut state = run.state(Phase::Running);
        let before = leaving(0).0.advance(std::slice::from_mut(&mut stage), &mut state).unwrap();
        assert!(answers(&mut stage) && matches!(before.step, Step::Leaving(_)), "it has time left");
        before.abandon(state.folder);
        let (swap, successor) = leaving(31);
        let swap = go_on_to(swap, &mut stage, &mut state, |step| !matches!(step, Step::Leaving(_)));
        assert!(matches!(swap.step, Step::Beginning(_)) && stage.process() == Some(successor));
        stage.kill();
    }

    /// A successor that is ready at once, and works until it is killed.
    fn ready_successor() -> Successor {
        let (control, input) = UnixStream::pair().unwrap();
        control.set_nonblocking(true).unwrap();
        let (input, output) = (OwnedFd::from(input.try_clone().unwrap()), OwnedFd::from(input));
        let mut command = Command::new("sh");
        command.args(["-c", "printf r; exec sleep 60"]).stdin(input).stdout(output).stderr(Stdio::null());
        let child = command.spawn().unwrap();
        Successor { process: child.into(), control }
    }

    /// A stage and its run; the run's folder has the plan of the replacement, and keeps the previous one.
    fn to_replace() -> (Supervised, TrialRun, Request) {
        let run = TrialRun::new();
        let mut plan = run.plan.clone();
        plan.stages[0].hang_s = Some(9.0);
        run.folder.begin(&run.plan).unwrap();
        run.folder.change_plan(&plan).unwrap();
        (at_work(stage::<Object>()), run, Request { id: 1, stage: "stage".into(), plan })
    }

    /// Advances a swap until it reaches a step for which `is_there` is true.
    fn go_on_to(swap: Swap, stage: &mut Supervised, state: &mut RunState<'_>, is_there: fn(&Step) -> bool) -> Swap {
        let (mut swap, begin) = (swap, Instant::now());
        while !is_there(&swap.step) {
            assert!(begin.elapsed() < Duration::from_secs(20), "it does not come to that");
            swap = swap.advance(std::slice::from_mut(stage), state).unwrap();
        }
        swap
    }

    #[test]
    fn a_successor_that_is_ready_takes_the_place_of_the_stage_and_who_asked_is_told_when_it_works() {
        let (mut stage, mut run, request) = to_replace();
        let (successor, since) = (ready_successor(), Instant::now());
        let process = successor.process.child.id();
        run.write_record("stage", stage.process().unwrap(), Life::Running);
        let swap = Swap { request, step: Step::Preparing(successor), since };
        assert!(!swap.handles_exit());
        let mut state = run.state(Phase::Running);
        let swap = go_on_to(swap, &mut stage, &mut state, |step| matches!(step, Step::Beginning(_)));
        assert!(swap.handles_exit() && stage.process() == Some(process));
        assert_eq!([stage.planned.hang_s, state.plan.stages[0].hang_s], [Some(9.0); 2]);
        let mut advance = |swap: Swap, run: &mut TrialRun| {
            swap.advance(std::slice::from_mut(&mut stage), &mut run.state(Phase::Running))
        };
        let swap = advance(swap, &mut run).unwrap();
        assert!(matches!(swap.step, Step::Beginning(_)), "the record is that of the process before");
        run.write_record("stage", process, Life::Starting);
        let swap = advance(swap, &mut run).unwrap();
        assert!(matches!(swap.step, Step::Beginning(_)), "it does not work yet");
        run.write_record("stage", process, Life::Running);
        let swap = advance(swap, &mut run).unwrap();
        assert!(matches!(&swap.step, Step::Over { outcome: Ok(()), .. }) && !swap.handles_exit());
        assert!(advance(swap, &mut run).is_none());
        let answer = std::fs::read_to_string(run.files.path().join("swap.answer")).unwrap();
        assert!(answer.contains(r#""id": 1"#) && answer.contains(r#""fault": null"#), "{answer}");
        stage.kill();
    }

    #[test]
    fn a_stage_that_came_to_its_end_is_not_replaced_and_one_comes_back_whose_successor_could_not_begin() {
        for life in [Life::Ended, Life::Running] {
            let (mut stage, mut run, request) = to_replace();
            run.write_record("stage", stage.process().unwrap(), life);
            let mut state = run.state(Phase::Running);
            let swap = Swap { request, step: Step::Leaving(successor()), since: Instant::now() };
            stage.signal(Signal::KILL);
            let is_next = |step: &Step| matches!(step, Step::Beginning(_) | Step::Over { .. });
            let swap = go_on_to(swap, &mut stage, &mut state, is_next);
            assert_eq!(matches!(swap.step, Step::Over { .. }), life == Life::Ended);
            stage.signal(Signal::KILL);
            let swap = go_on_to(swap, &mut stage, &mut state, |step| matches!(step, Step::Over { .. }));
            let Step::Over { outcome: Err(fault), .. } = swap.step else { panic!("it was replaced") };
            let why = if life == Life::Ended { "came to its end" } else { "the old one comes back" };
            assert!(fault.contains(why), "{fault}");
            let kept = run.folder.plan().unwrap();
            let left = [&stage.planned, &run.plan.stages[0], &kept.stages[0]].map(|planned| planned.hang_s);
            assert_eq!((left, stage.is_over()), ([None; 3], false));
        }
    }

    #[test]
    fn no_stage_is_replaced_when_the_run_ends_or_the_stage_or_its_successor_is_not_there() {
        let since = Instant::now();
        let ending = Phase::Delivering { delivered: 0, since };
        for (phase, kill_stage, kill_successor, why) in [
            (ending, false, false, "the run ends"),
            (Phase::Running, true, false, "the stage died meanwhile"),
            (Phase::Running, false, true, "could not start"),
        ] {
            let (mut stage, mut run, request) = to_replace();
            let mut successor = successor();
            if kill_successor {
                successor.process.child.kill().unwrap();
                successor.process.child.wait().unwrap();
            }
            if kill_stage {
                stage.kill();
            }
            let swap = Swap { request, step: Step::Preparing(successor), since };
            let swap = swap.advance(std::slice::from_mut(&mut stage), &mut run.state(phase)).unwrap();
            let Step::Over { outcome: Err(fault), .. } = swap.step else { panic!("it goes on") };
            assert!(fault.contains(why), "{fault}");
            assert_eq!(run.folder.plan().unwrap().stages[0].hang_s, None);
            stage.kill();
        }
    }

    #[test]
    fn a_successor_is_waited_for_until_it_says_that_it_is_ready_or_is_gone() {
        let (control, mut input) = UnixStream::pair().unwrap();
        control.set_nonblocking(true).unwrap();
        let mut successor = Successor { process: echo().into(), control };
        assert_eq!(successor.is_ready(), Ok(false));
        input.write_all(b"r").unwrap();
        assert_eq!(successor.is_ready(), Ok(true));
        drop(input);
        // Processes that other tests fork hold a copy of the socket until they exec.
        let begin = Instant::now();
        while successor.is_ready() == Ok(false) {
            assert!(begin.elapsed() < Duration::from_secs(20), "it is waited for although it is gone");
        }
        assert_eq!(successor.is_ready(), Err(()));
        successor.end_within(Duration::ZERO);
    }

    #[test]
    fn a_successor_that_is_not_wanted_is_gone_whether_it_ends_by_itself_or_not() {
        let stays = Successor { process: echo().into(), control: UnixStream::pair().unwrap().0 };
        for (successor, grace) in [(successor(), DISMISS_GRACE), (stays, Duration::ZERO)] {
            let process = Pid::from_child(&successor.process.child);
            test_kill_process(process).unwrap();
            successor.end_within(grace);
            test_kill_process(process).unwrap_err();
        }
    }

    #[test]
    fn the_end_of_a_run_leaves_no_successor_behind_and_tells_who_asked_for_a_swap_what_became_of_it() {
        let (mut stage, run, request) = to_replace();
        stage.kill();
        let successors = [successor(), successor()];
        let processes = successors.each_ref().map(|successor| Pid::from_child(&successor.process.child));
        let [preparing, leaving] = successors;
        for (step, fault) in [
            (Step::Preparing(preparing), r#""the run ended"#),
            (Step::Leaving(leaving), r#""the run ended"#),
            (Step::Beginning(Box::new(stage.planned.clone())), r#""the run ended"#),
            (Step::over(Err("it came to its end".to_owned())), r#""it came to its end"#),
            (Step::over(Ok(())), "null"),
        ] {
            Swap { request: request.clone(), step, since: Instant::now() }.abandon(&run.folder);
            let file = run.files.path().join("swap.answer");
            let answer = std::fs::read_to_string(&file).unwrap();
            assert!(answer.contains(&format!(r#""fault": {fault}"#)), "{answer}");
            std::fs::remove_file(file).unwrap();
        }
        assert!(processes.into_iter().all(|process| test_kill_process(process).is_err()));
    }

    #[test]
    fn an_answer_that_cannot_be_written_is_written_later_and_the_log_says_so_once() {
        let (mut stage, mut run, request) = to_replace();
        stage.kill();
        let file = run.files.path().join("swap.answer");
        std::fs::create_dir(&file).unwrap();
        let mut swap = Some(Swap { request, step: Step::over(Ok(())), since: Instant::now() });
        let mut advance = || {
            let under_way = swap.take().unwrap();
            let log =
                logged(|| swap = under_way.advance(std::slice::from_mut(&mut stage), &mut run.state(Phase::Running)));
            (swap.is_some(), log.contains("the result of a swap cannot be reported, of stage `stage`"))
        };
        assert_eq!([advance(), advance()], [(true, true), (true, false)]);
        std::fs::remove_dir(&file).unwrap();
        assert_eq!(advance(), (false, false));
        assert!(file.exists());
    }

    #[test]
    fn a_successor_that_is_not_wanted_has_the_time_to_end_in_order() {
        let files = tempfile::tempdir().unwrap();
        let (control, input) = UnixStream::pair().unwrap();
        let mut command = Command::new("sh");
        let (input, output) = (OwnedFd::from(input.try_clone().unwrap()), OwnedFd::from(input));
        command
            .args(["-c", "printf r; read -r turn; : > in_order"])
            .current_dir(files.path())
            .stdin(input)
            .stdout(output);
        let mut successor = Successor { process: command.spawn().unwrap().into(), control };
        drop(command);
        assert_eq!(successor.is_ready(), Ok(true));
        // On a busy machine it may need more time than a run allows.
        successor.end_within(Duration::from_secs(60));
        assert!(files.path().join("in_order").exists());
    }

    #[test]
    fn a_successor_that_takes_the_place_when_the_run_ends_is_told_so_where_the_others_were() {
        let since = Instant::now();
        let delivering = Phase::Delivering { delivered: 0, since };
        for (phase, is_source, ends) in
            [(delivering, true, true), (delivering, false, false), (Phase::Stopping { since }, false, true)]
        {
            let (mut stage, mut run, mut request) = to_replace();
            stage.kill();
            request.plan.stages[0].wiring.input = Some(Topic::default()).filter(|_| !is_source);
            let successor = Successor { process: echo().into(), control: UnixStream::pair().unwrap().0 };
            take_place(successor, &mut stage, &request, &mut run.state(phase));
            assert_eq!(answers(&mut stage), !ends, "{phase:?}");
            stage.kill();
        }
    }

    #[test]
    fn a_swap_is_asked_for_of_a_stage_at_work_in_this_run() {
        let ending = Phase::Delivering { delivered: 0, since: Instant::now() };
        for (number, name, phase, life, why) in [
            (8, "stage", Phase::Running, Life::Running, "another run"),
            (7, "other", Phase::Running, Life::Running, "another run"),
            (7, "stage", ending, Life::Running, "is not at work"),
            (7, "stage", Phase::Running, Life::Starting, "is not at work"),
        ] {
            let (mut stage, mut run, mut request) = to_replace();
            run.write_record("stage", stage.process().unwrap(), life);
            (request.plan.run, request.stage) = (number, name.to_owned());
            let swap = Swap::begin(request, std::slice::from_ref(&stage), &run.state(phase));
            assert_eq!(swap.stage(), name);
            let Step::Over { outcome: Err(fault), .. } = swap.step else { panic!("it begins") };
            assert!(fault.contains(why), "{fault}");
            stage.kill();
        }
    }

    #[test]
    fn a_successor_is_to_be_ready_within_15_seconds_and_a_stage_to_leave_within_30() {
        let is_overdue = |step: &Step| {
            [15, 30].map(|seconds| {
                let grace = Duration::from_secs(seconds);
                [grace, grace + Duration::from_millis(1)].map(|taken| step.is_overdue(taken))
            })
        };
        let steps = [Step::Preparing(successor()), Step::Leaving(successor()), Step::over(Ok(()))];
        let told = steps.each_ref().map(is_overdue);
        assert_eq!(told, [[[false, true], [true, true]], [[false, false], [false, true]], [[false; 2]; 2]]);
        for step in steps {
            if let Step::Preparing(successor) | Step::Leaving(successor) = step {
                successor.dismiss();
            }
        }
    }
}
