//! Supervision of one stage by the launcher: its process, and whether to restart it.

use super::folder::{PLAN, RunFolder};
use super::guarded::Guarded;
use super::options::RunOptions;
use super::phase::Phase;
use super::process::{LAUNCHER, ProcessError, REFUSED, as_stage};
use super::watchdog::{HangReport, Watchdog};
use crate::pipeline::{Restart, TIME_TO_JOIN_S};
use crate::plan::{Plan, PlannedStage, Runs};
use crate::ports::Delivery;
use crate::status::{Life, Status};
use rustix::process::{Pid, Signal, kill_process, kill_process_group};
use signal_hook::consts::SIGBUS;
use std::io;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

/// Maximum number of restarts in a row; a stage that has worked for long enough starts to count again, however often it has died.
const MAX_RESTARTS: u32 = 10;
/// Time after which a process counts as having worked. A stage that dies once an hour is always restarted, one that dies every
/// few seconds is not.
const WORKED_WELL: Duration = Duration::from_secs(60);
/// Pause before the first restart; it doubles with each further death in a row.
const FIRST_BACK_OFF: Duration = Duration::from_millis(100);
/// Longest pause before a restart. A program that has finished after at least this time counts as having worked.
const LONGEST_BACK_OFF: Duration = Duration::from_secs(5);

/// A program that has not joined the run this long after its start is reported: a stage joins when it has loaded what it needs.
const REPORT_UNJOINED_AFTER: Duration = Duration::from_secs(2);
/// Hint for a program that does not join.
const JOIN_HINT: &str = "a program joins by `run_stage` or `run_source` of conicflow-dataflow, in Python by conicflow.stage() \
                           or conicflow.source(); one that needs long to load may do that afterwards, or say how long: restart = \
                           { join_s = 600 }";

/// State of a stage's process.
enum State {
    Running(Guarded),
    Waiting { until: Instant },
    Done,
    Gone,
}

/// Change of a stage since the last check.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Change {
    /// Nothing to act on.
    None,
    /// The stage failed for good, and the run cannot go on.
    Lost,
    /// The stage will not be restarted, as the pipeline file says; the others go on.
    Left,
}

/// State of the run, for the code that supervises a stage.
pub(crate) struct RunState<'a> {
    pub(crate) plan: &'a mut Plan,
    pub(crate) folder: &'a RunFolder,
    pub(crate) options: &'a RunOptions,
    pub(crate) phase: Phase,
    /// Whether the run's folder or its shared memory was removed: a restarted stage would not find the others.
    pub(crate) is_removed: bool,
}

impl RunState<'_> {
    fn record(&self, stage: &str) -> Option<Status> {
        self.folder.record(stage, self.plan.run)
    }

    fn set_life(&self, stage: &str, life: Life) {
        self.folder.set_life(self.plan.run, stage, life);
    }
}

/// A stage and its process.
pub(crate) struct Supervised {
    pub(crate) planned: PlannedStage,
    state: State,
    watchdog: Watchdog,
    /// Number of processes that died in a row before they had worked for long enough.
    deaths: u32,
    /// The process that was reported as not having joined the run.
    reported_unjoined: Option<u32>,
    /// Whether the hint on how to join was logged already.
    join_hint_logged: bool,
    /// The process that was seen at work since the last start.
    at_work: Option<u32>,
    /// Number of processes that were seen at work, or were started after one that was.
    counted_starts: u64,
    /// Whether it was logged already that the run waits only for this stage to join, as all its writers have ended.
    is_awaited_alone: bool,
    started: Instant,
    /// Whether it was started after the sources had been asked to stop, and still has to be asked, too.
    is_late: bool,
}

impl Supervised {
    /// Starts a stage for the first time; an error ends the run.
    pub(crate) fn start(planned: PlannedStage, plan: &Plan, options: &RunOptions) -> Result<Self, ProcessError> {
        let started = Guarded::start(&mut command(&planned, plan, options), &planned);
        let process = started.map_err(|error: io::Error| ProcessError::System {
            doing: format!("stage `{}` cannot be started", planned.name),
            error,
        })?;
        let watchdog = Watchdog::new(0, Instant::now());
        let (state, deaths, started) = (State::Running(process), 0, Instant::now());
        Ok(Self {
            planned,
            state,
            watchdog,
            deaths,
            reported_unjoined: None,
            join_hint_logged: false,
            at_work: None,
            counted_starts: 0,
            is_awaited_alone: false,
            started,
            is_late: false,
        })
    }

    /// Process id of the stage, if it runs.
    pub(crate) fn process(&self) -> Option<u32> {
        if let State::Running(process) = &self.state { Some(process.child.id()) } else { None }
    }

    /// Number of its processes that came to work, or were started after one that had.
    pub(crate) fn counted_starts(&self) -> u64 {
        self.counted_starts
    }

    /// Id of its process, if that has ended. The state does not change: the caller, or the next check, acts on it.
    pub(crate) fn exit(&mut self) -> Option<u32> {
        let State::Running(Guarded { child, .. }) = &mut self.state else { return None };
        let ended = !matches!(child.try_wait(), Ok(None));
        ended.then(|| child.id())
    }

    /// Hands its place to another process, which runs already.
    pub(crate) fn replace_process(&mut self, process: Guarded) {
        (self.state, self.started) = (State::Running(process), Instant::now());
    }

    /// Makes the next check restart it, as `planned`.
    pub(crate) fn restart_as(&mut self, planned: PlannedStage) {
        self.planned = planned;
        self.state = State::Waiting { until: Instant::now() };
    }

    /// Whether it neither runs nor will be restarted.
    pub(crate) fn is_over(&self) -> bool {
        matches!(self.state, State::Done | State::Gone)
    }

    /// Whether it was given up.
    pub(crate) fn is_gone(&self) -> bool {
        matches!(self.state, State::Gone)
    }

    /// Sends a signal to its process, if there is one.
    pub(crate) fn signal(&self, signal: Signal) {
        if let Some(process) = self.process().and_then(|process| Pid::from_raw(process.cast_signed())) {
            // The process may just have ended by itself.
            kill_process(process, signal).ok();
        }
    }

    /// Sends a signal to its process, if there is one, and to all that this has started. The id of the group stays that of the
    /// process until the process is waited for.
    pub(crate) fn signal_group(&self, signal: Signal) {
        if let Some(process) = self.process().and_then(|process| Pid::from_raw(process.cast_signed())) {
            kill_process_group(process, signal).ok();
        }
    }

    /// Kills the process, if there is one, and waits until it is gone.
    pub(crate) fn kill(&mut self) {
        if let State::Running(Guarded { child, .. }) = &mut self.state {
            child.kill().ok();
            child.wait().ok();
        }
        if !self.is_gone() {
            self.state = State::Done;
        }
    }

    /// Checks whether the process has ended, and restarts it where due. While frames in flight are delivered, every stage but the
    /// sources is needed.
    pub(crate) fn check(&mut self, run: &RunState<'_>) -> Change {
        let ending = match run.phase {
            _ if run.is_removed => true,
            Phase::Running => false,
            // The bridge still has to send messages to other machines, and to receive their acknowledgements.
            Phase::Delivering { .. } => self.planned.is_source() && !self.planned.is_bridge(),
            Phase::Stopping { .. } | Phase::Killing => true,
        };
        match &mut self.state {
            State::Running(Guarded { child, .. }) => match child.try_wait() {
                Ok(Some(status)) => {
                    let process = child.id();
                    self.ended(process, status, run, ending)
                }
                _ => {
                    self.stop_if_late(run);
                    self.check_heartbeat(run)
                }
            },
            State::Waiting { .. } if ending => self.stay_ended(run),
            State::Waiting { until } if Instant::now() >= *until => {
                self.is_late = matches!(run.phase, Phase::Delivering { .. }) && self.planned.is_source();
                self.restart(run)
            }
            _ => Change::None,
        }
    }

    /// Asks a source that was started late to stop, like the others; before it has joined it would not handle the signal.
    fn stop_if_late(&mut self, run: &RunState<'_>) {
        if self.is_late && self.process().is_some_and(|process| self.own_record(process, run).is_some()) {
            self.signal(Signal::INT);
            self.is_late = false;
        }
    }

    /// Starts the process again. A failure to start, as of a program that is just being replaced, does not end the run: it counts
    /// as one more death.
    fn restart(&mut self, run: &RunState<'_>) -> Change {
        match Guarded::start(&mut command(&self.planned, run.plan, run.options), &self.planned) {
            Ok(process) => {
                (self.state, self.started) = (State::Running(process), Instant::now());
                self.counted_starts += u64::from(self.at_work.take().is_some());
                Change::None
            }
            Err(error) => self.died(&format!("cannot be started ({error})"), false, run),
        }
    }

    /// Checks the heartbeat of the process. One that hangs is reported, and killed where the file says so.
    fn check_heartbeat(&mut self, run: &RunState<'_>) -> Change {
        let Some(process) = self.process() else { return Change::None };
        let own = self.own_record(process, run);
        if let (None, Runs::Command(command)) = (&own, &self.planned.runs) {
            let command = command.join(" ");
            return self.wait_to_join(process, &command, run);
        }
        if self.reported_unjoined.take_if(|reported_unjoined| *reported_unjoined == process).is_some() {
            let seconds = self.started.elapsed().as_secs_f64();
            tracing::info!("stage `{}` has joined the run, {seconds:.1} s after its start", self.planned.name);
        }
        if self.at_work != Some(process) && own.as_ref().is_some_and(|own| own.life() != Life::Starting) {
            (self.at_work, self.counted_starts) = (Some(process), self.counted_starts + 1);
        }
        let limit = self.planned.hang_s.map(Duration::from_secs_f64);
        let steps = own.as_ref().map_or(0, |status| status.steps);
        let has_ended = own.as_ref().is_some_and(|status| status.life() == Life::Ended);
        let report = self.watchdog.check(process, own.map(|status| status.alive_ns), limit, Instant::now());
        report.into_iter().for_each(|report| self.log_report(report, steps));
        let (Some(HangReport::Hangs(_)), Some(_), State::Running(process)) = (report, limit, &mut self.state) else {
            return Change::None;
        };
        process.child.kill().ok();
        if has_ended {
            tracing::error!("stage `{}` had ended its stream, and is not started anew", self.planned.name);
            self.kill();
            return self.give_up(run, Change::Lost);
        }
        Change::None
    }

    /// Reports a program that has not joined the run, and gives it up when the run has waited for it too long.
    fn wait_to_join(&mut self, process: u32, command: &str, run: &RunState<'_>) -> Change {
        let (name, waited) = (&self.planned.name, self.started.elapsed());
        let (topic, limit_s) = (self.lossless_topic(), self.planned.join_s.unwrap_or(TIME_TO_JOIN_S));
        let is_awaited_alone = self.has_no_more_input(run);
        if waited > REPORT_UNJOINED_AFTER && self.reported_unjoined != Some(process) {
            let waits = topic.map(|topic| {
                format!(", and topic `{topic}` waits for it: the run ends if it has not {limit_s} s after its start")
            });
            let waits = waits.unwrap_or_default();
            let hint = if self.join_hint_logged { String::new() } else { format!("\n  hint: {JOIN_HINT}") };
            tracing::warn!("stage `{name}` has not joined the run: `{command}` has no part in it{waits}{hint}");
            (self.reported_unjoined, self.join_hint_logged) = (Some(process), true);
        } else if waited > Duration::from_secs_f64(limit_s) && (topic.is_some() || is_awaited_alone) {
            let waits = topic.map(|topic| {
                format!("`{command}` takes no part in topic `{topic}`, which is lossless and waits for it")
            });
            let waits = waits.unwrap_or_else(|| "nothing can come to it any more, and the run waits for it".to_owned());
            tracing::error!(
                "stage `{name}` has not joined the run {limit_s} s after its start: {waits}\n  hint: {JOIN_HINT}"
            );
            self.kill();
            return self.give_up(run, Change::Lost);
        } else if waited > REPORT_UNJOINED_AFTER && is_awaited_alone && !self.is_awaited_alone {
            tracing::warn!(
                "the run waits for stage `{name}`, which has not joined it: all that write for it have ended, and the run ends, \
                 too, if it has not {limit_s} s after its start\n  hint: {JOIN_HINT}"
            );
            self.is_awaited_alone = true;
        }
        Change::None
    }

    fn log_report(&self, report: HangReport, steps: u64) {
        let name = &self.planned.name;
        let (HangReport::Hangs(silent) | HangReport::Recovered(silent)) = report;
        let seconds = silent.as_secs_f64();
        match (report, self.planned.hang_s) {
            (HangReport::Recovered(_), _) => {
                tracing::info!("stage `{name}` goes on after {seconds:.1} s without a sign of life");
            }
            (HangReport::Hangs(_), Some(_)) => {
                tracing::error!("stage `{name}` hangs after {steps} messages, {seconds:.1} s ago, and is killed");
            }
            (HangReport::Hangs(_), None) => tracing::warn!(
                "stage `{name}` hangs after {steps} messages: no sign of life for {seconds:.1} s\n  \
                 hint: with restart = {{ when = \"on_failure\", hang_s = 5 }} it would be started anew"
            ),
        }
    }

    /// A topic on which this stage, or its readers, must not miss a message.
    fn lossless_topic(&self) -> Option<&str> {
        let wiring = &self.planned.wiring;
        let mut lossless = wiring.inputs().filter(|topic| topic.delivery_to(&self.planned.name) == Delivery::Lossless);
        let topic = lossless.next().or_else(|| wiring.output.as_ref().filter(|topic| topic.is_lossless()));
        topic.map(|topic| topic.name.as_str())
    }

    /// The record that this process of the stage has written in the run, if any.
    fn own_record(&self, process: u32, run: &RunState<'_>) -> Option<Status> {
        run.record(&self.planned.name).filter(|record| record.process == process)
    }

    /// Whether all writers of its input are over, so that a restart is pointless.
    fn has_no_more_input(&self, run: &RunState<'_>) -> bool {
        let is_over = |stage: &String| run.record(stage).is_some_and(|record| record.life().is_over());
        let writers = self.planned.wiring.input.as_ref().map(|topic| &topic.writers).filter(|all| !all.is_empty());
        writers.is_some_and(|writers| writers.iter().all(is_over))
    }

    fn ended(&mut self, process: u32, status: ExitStatus, run: &RunState<'_>, ending: bool) -> Change {
        let running = matches!(run.phase, Phase::Running);
        let name = self.planned.name.clone();
        let own = self.own_record(process, run).map(|own| own.life());
        let finished = status.success() && came_to_its_end(own);
        if finished
            && running
            && own.is_none()
            && let Some(topic) = self.lossless_topic()
        {
            tracing::error!(
                "stage `{name}` has ended without having joined the run: nobody took part in topic `{topic}` for it, which is \
                 lossless\n  hint: {JOIN_HINT}"
            );
            return self.give_up(run, Change::Lost);
        }
        let comes_back = self.planned.restart == Restart::Always && running && !self.has_no_more_input(run);
        if finished && !comes_back {
            self.state = State::Done;
            run.set_life(&name, Life::Ended);
            return Change::None;
        }
        if !status.success() && own == Some(Life::Gone) {
            tracing::error!("stage `{name}` failed at the end of its work: see its error above");
            return self.give_up(run, Change::Lost);
        }
        if ending {
            return self.stay_ended(run);
        }
        if status.code() == Some(i32::from(REFUSED)) {
            tracing::error!("stage `{name}` could not start: see its error above");
            return self.give_up(run, Change::Lost);
        }
        // A program with `restart = "always"` may do its work quickly.
        let long_enough = if finished { LONGEST_BACK_OFF } else { WORKED_WELL };
        self.died(&describe(status), self.started.elapsed() >= long_enough, run)
    }

    /// Schedules a restart, with a back-off that grows with each death, unless restarts are disabled or exhausted.
    fn died(&mut self, how: &str, has_worked_well: bool, run: &RunState<'_>) -> Change {
        let name = &self.planned.name;
        if self.planned.restart == Restart::Never {
            tracing::error!("stage `{name}` {how}, and is not started anew: its `restart` is \"never\"");
            return self.give_up(run, Change::Left);
        }
        if run.record(name).is_none() && self.has_no_more_input(run) {
            tracing::error!(
                "stage `{name}` {how}, and is not started anew: it had not joined the run, and nothing can come any more"
            );
            return self.give_up(run, Change::Lost);
        }
        self.deaths = if has_worked_well { 1 } else { self.deaths + 1 };
        let Some(back_off) = back_off(self.deaths) else {
            tracing::error!(
                "stage `{name}` {how}, for the {}th time in a row, and never worked for long: it is given up\n  \
                 hint: what it told each time before it ended says why",
                self.deaths
            );
            return self.give_up(run, Change::Lost);
        };
        tracing::warn!("stage `{name}` {how}, and is started anew in {:.1} s", back_off.as_secs_f64());
        self.state = State::Waiting { until: Instant::now() + back_off };
        Change::None
    }

    /// Does not restart it, as the run ends; the others are not to wait for it.
    fn stay_ended(&mut self, run: &RunState<'_>) -> Change {
        self.state = State::Done;
        run.set_life(&self.planned.name, Life::Gone);
        Change::None
    }

    fn give_up(&mut self, run: &RunState<'_>, change: Change) -> Change {
        self.state = State::Gone;
        run.set_life(&self.planned.name, Life::Gone);
        change
    }
}

/// Whether a process that exited with success had finished its work, by its record, rather than having been asked to stop. A
/// program without a record is believed.
fn came_to_its_end(own: Option<Life>) -> bool {
    matches!(own, None | Some(Life::Ended))
}

/// Back-off after this many deaths in a row; `None` after too many.
fn back_off(deaths: u32) -> Option<Duration> {
    let back_off = || (FIRST_BACK_OFF * 2_u32.pow(deaths.saturating_sub(1))).min(LONGEST_BACK_OFF);
    (deaths <= MAX_RESTARTS).then(back_off)
}

/// Command that starts a stage. Each stage has its own process group, so that Ctrl-C reaches only the launcher, which ends the
/// stages in order, and so that processes started by a program can be identified.
pub(crate) fn command(planned: &PlannedStage, plan: &Plan, options: &RunOptions) -> Command {
    let mut command = as_stage(planned, plan, PLAN, options);
    command.env(LAUNCHER, std::process::id().to_string()).stdin(Stdio::null()).process_group(0);
    command
}

fn describe(status: ExitStatus) -> String {
    match (status.code(), status.signal()) {
        (Some(code), _) => format!("ended with exit code {code}"),
        (None, Some(SIGBUS)) => "was killed by SIGBUS: shared memory is full, see `conicflow doctor`".to_owned(),
        (None, Some(signal)) => format!("was killed by signal {signal}"),
        (None, None) => "ended".to_owned(),
    }
}

#[cfg(test)]
pub(super) mod tests;
