//! One stage as the launcher sees it: its process, and whether it is to be started anew.

use super::folder::{PLAN, RunFolder};
use super::guarded::Guarded;
use super::options::RunOptions;
use super::phase::Phase;
use super::process::{LAUNCHER, ProcessError, REFUSED, as_stage};
use super::watchdog::{News, Watchdog};
use crate::pipeline::{Restart, TIME_TO_JOIN_S};
use crate::plan::{Plan, PlannedStage, Runs};
use crate::ports::Delivery;
use crate::status::{Life, Status};
use rustix::process::{Pid, Signal, kill_process, kill_process_group};
use signal_hook::consts::SIGBUS;
use std::collections::VecDeque;
use std::io;
use std::os::unix::process::{CommandExt, ExitStatusExt};
use std::process::{Command, ExitStatus, Stdio};
use std::time::{Duration, Instant};

/// A stage that dies more often than this within a minute is given up.
const MAX_RESTARTS_PER_MINUTE: usize = 10;
const MINUTE: Duration = Duration::from_secs(60);
const FIRST_BACK_OFF: Duration = Duration::from_millis(100);
const LONGEST_BACK_OFF: Duration = Duration::from_secs(5);

/// A program that has not joined the run so long after its start is named: a stage joins when it has loaded what it needs.
const NAMED_AFTER: Duration = Duration::from_secs(2);
/// What to do about a program that does not.
const HOW_TO_JOIN: &str = "a program joins by `run_stage` or `run_source` of conicflow-dataflow, in Python by conicflow.stage() \
                           or conicflow.source(); one that needs long to load may do that afterwards, or say how long: restart = \
                           { join_s = 600 }";

/// Where a stage's process is.
enum State {
    Running(Guarded),
    Waiting { until: Instant },
    Done,
    Gone,
}

/// What became of a stage at a look.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Change {
    /// Nothing to speak of.
    None,
    /// It will not come back although it should have, and the run cannot go on.
    Lost,
    /// It will not come back, as the pipeline file says; the others go on.
    Left,
}

/// What the launcher knows of the run, for those that look after a stage.
pub(crate) struct RunState<'a> {
    pub(crate) plan: &'a mut Plan,
    pub(crate) folder: &'a RunFolder,
    pub(crate) options: &'a RunOptions,
    pub(crate) phase: Phase,
    /// Whether its folder, or what its stages share, was removed: one that is started anew would not find the others.
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
    deaths: VecDeque<Instant>,
    /// The program that was named for not having joined the run.
    outsider: Option<u32>,
    /// Whether it was named for being waited for although nothing can come to it.
    is_last: bool,
    started: Instant,
    /// Whether it was started when the sources had been told to stop, and is still to be told, too.
    is_late: bool,
}

impl Supervised {
    /// Starts a stage for the first time; a fault then is one of the run.
    pub(crate) fn start(planned: PlannedStage, plan: &Plan, options: &RunOptions) -> Result<Self, ProcessError> {
        let started = Guarded::start(&mut command(&planned, plan, options), &planned);
        let process = started.map_err(|error: io::Error| ProcessError::System {
            doing: format!("stage `{}` cannot be started", planned.name),
            error,
        })?;
        let watchdog = Watchdog::new(0, Instant::now());
        let (state, deaths, started) = (State::Running(process), VecDeque::new(), Instant::now());
        Ok(Self { planned, state, watchdog, deaths, outsider: None, is_last: false, started, is_late: false })
    }

    /// Its process, if there is one.
    pub(crate) fn process(&self) -> Option<u32> {
        if let State::Running(process) = &self.state { Some(process.child.id()) } else { None }
    }

    /// Its process, if that has ended; what follows from it is for the one who asks, or for the next look.
    pub(crate) fn exit(&mut self) -> Option<u32> {
        let State::Running(Guarded { child, .. }) = &mut self.state else { return None };
        let ended = !matches!(child.try_wait(), Ok(None));
        ended.then(|| child.id())
    }

    /// Gives its place to another process, which is there already.
    pub(crate) fn take(&mut self, process: Guarded) {
        (self.state, self.started) = (State::Running(process), Instant::now());
    }

    /// Starts it anew at the next look, as `planned`.
    pub(crate) fn come_back(&mut self, planned: PlannedStage) {
        self.planned = planned;
        self.state = State::Waiting { until: Instant::now() };
    }

    /// Whether nothing of it runs, or is going to.
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
            // It may just have ended by itself.
            kill_process(process, signal).ok();
        }
    }

    /// Sends a signal to its process and to all that this has started, if there is one. The group has the number of the process as
    /// long as that is not waited for.
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

    /// Looks whether the process ended, and starts it anew where that is due. While what is under way is delivered all are
    /// needed but the sources.
    pub(crate) fn look(&mut self, run: &RunState<'_>) -> Change {
        let ending = match run.phase {
            _ if run.is_removed => true,
            Phase::Running => false,
            // What waits on its way to another machine, and what that has to hear, needs the bridge.
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
                    self.watch(run)
                }
            },
            State::Waiting { .. } if ending => self.stay_away(run),
            State::Waiting { until } if Instant::now() >= *until => {
                self.is_late = matches!(run.phase, Phase::Delivering { .. }) && self.planned.is_source();
                self.start_anew(run)
            }
            _ => Change::None,
        }
    }

    /// Tells a source that was started late to stop, as the others were; before it has joined it could not take it in.
    fn stop_if_late(&mut self, run: &RunState<'_>) {
        if self.is_late && self.process().is_some_and(|process| self.own_record(process, run).is_some()) {
            self.signal(Signal::INT);
            self.is_late = false;
        }
    }

    /// What keeps a stage from coming back, such as a program that is just being replaced, is no fault of the others: it
    /// counts as one more death.
    fn start_anew(&mut self, run: &RunState<'_>) -> Change {
        match Guarded::start(&mut command(&self.planned, run.plan, run.options), &self.planned) {
            Ok(process) => {
                (self.state, self.started) = (State::Running(process), Instant::now());
                Change::None
            }
            Err(error) => self.died(&format!("cannot be started ({error})"), run),
        }
    }

    /// Looks whether the process still gives signs of life; one that hangs is reported, and killed where the file says so.
    fn watch(&mut self, run: &RunState<'_>) -> Change {
        let Some(process) = self.process() else { return Change::None };
        let own = self.own_record(process, run);
        if let (None, Runs::Command(command)) = (&own, &self.planned.runs) {
            let command = command.join(" ");
            return self.wait_to_join(process, &command, run);
        }
        if self.outsider.take_if(|outsider| *outsider == process).is_some() {
            let seconds = self.started.elapsed().as_secs_f64();
            tracing::info!("stage `{}` has joined the run, {seconds:.1} s after its start", self.planned.name);
        }
        let limit = self.planned.hang_s.map(Duration::from_secs_f64);
        let steps = own.as_ref().map_or(0, |status| status.steps);
        let has_ended = own.as_ref().is_some_and(|status| status.life() == Life::Ended);
        let news = self.watchdog.look(process, own.map(|status| status.alive_ns), limit, Instant::now());
        news.into_iter().for_each(|news| self.tell(news, steps));
        let (Some(News::Hangs(_)), Some(_), State::Running(process)) = (news, limit, &mut self.state) else {
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

    /// Names a program that takes its time to join the run, and gives it up where the run does not go on without it for too long.
    fn wait_to_join(&mut self, process: u32, command: &str, run: &RunState<'_>) -> Change {
        let (name, waited) = (&self.planned.name, self.started.elapsed());
        let (topic, limit_s) = (self.lossless_topic(), self.planned.join_s.unwrap_or(TIME_TO_JOIN_S));
        let is_last = self.has_heard_all(run);
        if waited > NAMED_AFTER && self.outsider != Some(process) {
            let waits = topic.map(|topic| {
                format!(", and topic `{topic}` waits for it: the run ends if it has not {limit_s} s after its start")
            });
            let waits = waits.unwrap_or_default();
            tracing::warn!(
                "stage `{name}` has not joined the run: `{command}` has no part in it{waits}\n  hint: {HOW_TO_JOIN}"
            );
            self.outsider = Some(process);
        } else if waited > Duration::from_secs_f64(limit_s) && (topic.is_some() || is_last) {
            let waits = topic.map(|topic| {
                format!("`{command}` takes no part in topic `{topic}`, which is lossless and waits for it")
            });
            let waits = waits.unwrap_or_else(|| "nothing can come to it any more, and the run waits for it".to_owned());
            tracing::error!(
                "stage `{name}` has not joined the run {limit_s} s after its start: {waits}\n  hint: {HOW_TO_JOIN}"
            );
            self.kill();
            return self.give_up(run, Change::Lost);
        } else if waited > NAMED_AFTER && is_last && !self.is_last {
            tracing::warn!(
                "the run waits for stage `{name}`, which has not joined it: all that write for it have ended, and the run ends, \
                 too, if it has not {limit_s} s after its start\n  hint: {HOW_TO_JOIN}"
            );
            self.is_last = true;
        }
        Change::None
    }

    fn tell(&self, news: News, steps: u64) {
        let name = &self.planned.name;
        let (News::Hangs(silent) | News::GoesOn(silent)) = news;
        let seconds = silent.as_secs_f64();
        match (news, self.planned.hang_s) {
            (News::GoesOn(_), _) => {
                tracing::info!("stage `{name}` goes on after {seconds:.1} s without a sign of life");
            }
            (News::Hangs(_), Some(_)) => {
                tracing::error!("stage `{name}` hangs after {steps} messages, {seconds:.1} s ago, and is killed");
            }
            (News::Hangs(_), None) => tracing::warn!(
                "stage `{name}` hangs after {steps} messages: no sign of life for {seconds:.1} s\n  \
                 hint: with restart = {{ when = \"on_failure\", hang_s = 5 }} it would be started anew"
            ),
        }
    }

    /// A topic at which it must not miss a message, or its readers must not.
    fn lossless_topic(&self) -> Option<&str> {
        let wiring = &self.planned.wiring;
        let mut lossless = wiring.inputs().filter(|topic| topic.delivery_to(&self.planned.name) == Delivery::Lossless);
        let topic = lossless.next().or_else(|| wiring.output.as_ref().filter(|topic| topic.is_lossless()));
        topic.map(|topic| topic.name.as_str())
    }

    /// What a process of it has told of itself in the run.
    fn own_record(&self, process: u32, run: &RunState<'_>) -> Option<Status> {
        run.record(&self.planned.name).filter(|record| record.process == process)
    }

    /// Whether all that write its input are over: there is nothing to come back for.
    fn has_heard_all(&self, run: &RunState<'_>) -> bool {
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
                 lossless\n  hint: {HOW_TO_JOIN}"
            );
            return self.give_up(run, Change::Lost);
        }
        let comes_back = self.planned.restart == Restart::Always && running && !self.has_heard_all(run);
        if finished && !comes_back {
            self.state = State::Done;
            run.set_life(&name, Life::Ended);
            return Change::None;
        }
        if !status.success() && own == Some(Life::Gone) {
            tracing::error!("stage `{name}` could not end its work, for what it told");
            return self.give_up(run, Change::Lost);
        }
        if ending {
            return self.stay_away(run);
        }
        if status.code() == Some(i32::from(REFUSED)) {
            tracing::error!("stage `{name}` could not be made ready, for what it told");
            return self.give_up(run, Change::Lost);
        }
        self.died(&describe(status), run)
    }

    /// Sees to it that it is started anew, later with each death, unless that is not wanted or was done too often.
    fn died(&mut self, how: &str, run: &RunState<'_>) -> Change {
        let name = &self.planned.name;
        if self.planned.restart == Restart::Never {
            tracing::error!("stage `{name}` {how}, and is not started anew: its `restart` is \"never\"");
            return self.give_up(run, Change::Left);
        }
        if run.record(name).is_none() && self.has_heard_all(run) {
            tracing::error!(
                "stage `{name}` {how}, and is not started anew: it had not joined the run, and nothing can come any more"
            );
            return self.give_up(run, Change::Lost);
        }
        let now = Instant::now();
        let Some(back_off) = back_off(&mut self.deaths, now) else {
            tracing::error!(
                "stage `{name}` {how}, for the {}th time within a minute: it is given up",
                self.deaths.len()
            );
            return self.give_up(run, Change::Lost);
        };
        tracing::warn!("stage `{name}` {how}, and is started anew in {:.1} s", back_off.as_secs_f64());
        self.state = State::Waiting { until: now + back_off };
        Change::None
    }

    /// Leaves it at what it has done, as the run ends; the others are not to wait for it.
    fn stay_away(&mut self, run: &RunState<'_>) -> Change {
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

/// Whether a process that exited well, and whose record tells this, had done all its work, rather than having been told to go.
/// A program that keeps no record is believed.
fn came_to_its_end(own: Option<Life>) -> bool {
    matches!(own, None | Some(Life::Ended))
}

/// How long a stage that died `now` stays away, by its deaths in the last minute; `None`: it died too often.
fn back_off(deaths: &mut VecDeque<Instant>, now: Instant) -> Option<Duration> {
    deaths.push_back(now);
    deaths.retain(|death| now.duration_since(*death) < MINUTE);
    let doublings = (deaths.len() as u32 - 1).min(10);
    let back_off = (FIRST_BACK_OFF * 2_u32.pow(doublings)).min(LONGEST_BACK_OFF);
    (deaths.len() <= MAX_RESTARTS_PER_MINUTE).then_some(back_off)
}

/// What starts a stage. Each gets a process group of its own, so that Ctrl-C reaches the launcher alone, which ends them in
/// order, and what a program has started can be told from all else.
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
pub(super) mod tests {
    use super::super::summary::tests::stage;
    use super::super::trial_run::{TrialRun, change_record, logged};
    use super::*;
    use crate::network::BridgePlan;
    use crate::ports::{Topic, TopicReader};
    use conicflow_messages::Object;
    use std::io::{Read, Write};
    use std::process::Child;

    fn supervised(planned: PlannedStage, state: State) -> Supervised {
        let (watchdog, started) = (Watchdog::new(0, Instant::now()), Instant::now());
        let deaths = VecDeque::new();
        Supervised { planned, state, watchdog, deaths, outsider: None, is_last: false, started, is_late: false }
    }

    /// A program that gives back what it is given, and so ends when nobody gives it anything any more.
    pub fn echo() -> Child {
        Command::new("cat").stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap()
    }

    /// A stage with a process that has no part in the run.
    pub fn at_work(planned: PlannedStage) -> Supervised {
        supervised(planned, State::Running(echo().into()))
    }

    /// Whether the process of a stage [`at_work`] gives back what it is given.
    pub fn answers(stage: &mut Supervised) -> bool {
        let State::Running(Guarded { child, .. }) = &mut stage.state else { return false };
        let (Some(stdin), Some(stdout)) = (&mut child.stdin, &mut child.stdout) else { return false };
        let mut answer = [0];
        stdin.write_all(b"?").is_ok() && stdout.read_exact(&mut answer).is_ok() && answer == *b"?"
    }

    /// A stage that has done all its work.
    pub fn over(planned: PlannedStage) -> Supervised {
        supervised(planned, State::Done)
    }

    /// A stage that reads what `writer` makes, and a process of it that has ended with this exit code.
    fn ended(exit: u8, delivery: Delivery) -> (Supervised, u32) {
        let mut planned = stage::<Object>();
        let readers = vec![TopicReader { stage: planned.name.clone(), delivery, queue: 4 }];
        planned.wiring.input = Some(Topic { writers: vec!["writer".into()], readers, ..Topic::default() });
        let mut child = Command::new("sh").args(["-c", &format!("exit {exit}")]).spawn().unwrap();
        child.wait().unwrap();
        let process = child.id();
        (supervised(planned, State::Running(child.into())), process)
    }

    #[test]
    fn what_follows_from_the_end_of_a_process_depends_on_how_it_ended_on_its_record_and_on_the_run() {
        use Restart::{Always, Never, OnFailure};
        let (mut run, since) = (TrialRun::new(), Instant::now());
        let (running, delivering, stopping) =
            (Phase::Running, Phase::Delivering { delivered: 0, since }, Phase::Stopping { since });
        let (done, gone, comes_back) = ((true, false), (true, true), (false, false));
        for (exit, told, restart, phase, expected, change, life) in [
            (0, Life::Ended, OnFailure, running, done, Change::None, Life::Ended),
            (0, Life::Ended, Always, running, comes_back, Change::None, Life::Ended),
            (0, Life::Ended, Always, delivering, done, Change::None, Life::Ended),
            (0, Life::Running, OnFailure, running, comes_back, Change::None, Life::Running),
            (0, Life::Gone, OnFailure, running, comes_back, Change::None, Life::Gone),
            (1, Life::Ended, OnFailure, running, comes_back, Change::None, Life::Ended),
            (1, Life::Running, OnFailure, delivering, comes_back, Change::None, Life::Running),
            (1, Life::Running, OnFailure, stopping, done, Change::None, Life::Gone),
            (1, Life::Running, OnFailure, Phase::Killing, done, Change::None, Life::Gone),
            (1, Life::Gone, Always, running, gone, Change::Lost, Life::Gone),
            (1, Life::Running, Never, running, gone, Change::Left, Life::Gone),
            (REFUSED, Life::Starting, OnFailure, running, gone, Change::Lost, Life::Gone),
        ] {
            let (mut stage, process) = ended(exit, Delivery::Lossless);
            stage.planned.restart = restart;
            run.tell("stage", process, told);
            let state = run.state(phase);
            let how = format!("exit code {exit}, {told:?} in its record, {restart:?}, {phase:?}");
            let looked = Instant::now();
            assert_eq!(stage.look(&state), change, "{how}");
            assert!(!matches!(stage.state, State::Waiting { until } if until < looked + FIRST_BACK_OFF), "{how}");
            assert_eq!((stage.is_over(), stage.is_gone()), expected, "{how}");
            assert_eq!(state.record("stage").map(|record| record.life()), Some(life), "{how}");
        }
    }

    #[test]
    fn a_stage_that_always_comes_back_does_not_where_all_that_write_for_it_are_over() {
        let mut run = TrialRun::new();
        for (life, is_over) in [(Life::Running, false), (Life::Ended, true), (Life::Gone, true)] {
            let (mut stage, process) = ended(0, Delivery::Latest);
            stage.planned.restart = Restart::Always;
            run.tell("stage", process, Life::Ended);
            run.tell("writer", 42, life);
            stage.look(&run.state(Phase::Running));
            assert_eq!(stage.is_over(), is_over, "{life:?}");
        }
    }

    #[test]
    fn a_program_that_ends_without_a_part_in_the_run_is_missed_where_it_was_to_lose_nothing() {
        let (mut run, since) = (TrialRun::new(), Instant::now());
        for (delivery, phase, change) in [
            (Delivery::Lossless, Phase::Running, Change::Lost),
            (Delivery::Lossless, Phase::Delivering { delivered: 0, since }, Change::None),
            (Delivery::Latest, Phase::Running, Change::None),
        ] {
            let (mut stage, _) = ended(0, delivery);
            let told = (stage.look(&run.state(phase)), stage.is_over(), stage.is_gone());
            assert_eq!(told, (change, true, change == Change::Lost), "{delivery:?}");
        }
    }

    #[test]
    fn a_program_that_does_not_join_is_named_and_then_given_up_where_a_lossless_topic_or_the_end_of_the_run_waits_for_it()
     {
        let mut run = TrialRun::new();
        let (works, over) = (Life::Running, Life::Ended);
        for (delivery, writer, waited_s, is_named, change) in [
            (Delivery::Lossless, works, 1.0, false, Change::None),
            (Delivery::Lossless, works, 50.0, true, Change::None),
            (Delivery::Lossless, works, 101.0, true, Change::Lost),
            (Delivery::Latest, works, 101.0, true, Change::None),
            (Delivery::Latest, over, 50.0, true, Change::None),
            (Delivery::Latest, over, 101.0, true, Change::Lost),
        ] {
            run.tell("writer", 42, writer);
            let (Supervised { mut planned, .. }, _) = ended(0, delivery);
            planned.join_s = Some(100.0);
            let mut stage = at_work(planned);
            stage.started = Instant::now().checked_sub(Duration::from_secs_f64(waited_s)).unwrap();
            let state = run.state(Phase::Running);
            assert_eq!(stage.look(&state), Change::None);
            assert_eq!(stage.outsider, stage.process().filter(|_| is_named), "{delivery:?} after {waited_s} s");
            let told = logged(|| assert_eq!(stage.look(&state), change, "{delivery:?} after {waited_s} s"));
            let is_last = (delivery, writer) == (Delivery::Latest, over);
            assert_eq!(told.contains("the run waits for"), is_last, "{told}");
            assert_eq!((stage.is_gone(), stage.process().is_none()), (change == Change::Lost, change == Change::Lost));
            stage.kill();
        }
        let mut joined = at_work(stage::<Object>());
        joined.outsider = joined.process();
        run.tell("stage", joined.process().unwrap(), Life::Running);
        assert_eq!((joined.look(&run.state(Phase::Running)), joined.outsider), (Change::None, None));
        assert!(answers(&mut joined), "it is left at its work");
        let stopping = run.state(Phase::Stopping { since: Instant::now() });
        assert_eq!((joined.look(&stopping), joined.is_over()), (Change::None, false), "it has its time to end");
        joined.kill();
    }

    #[test]
    fn a_program_that_fails_before_it_has_joined_does_not_come_back_when_nothing_can_come_to_it() {
        let mut run = TrialRun::new();
        for (writer, change) in [(Life::Running, Change::None), (Life::Ended, Change::Lost)] {
            run.tell("writer", 42, writer);
            let (mut stage, _) = ended(1, Delivery::Latest);
            stage.planned.restart = Restart::OnFailure;
            assert_eq!(stage.look(&run.state(Phase::Running)), change, "its writer: {writer:?}");
            assert_eq!(stage.is_over(), change == Change::Lost);
        }
    }

    #[test]
    fn a_stage_that_hangs_when_it_has_ended_its_stream_is_killed_for_good_where_the_file_says_so() {
        let mut run = TrialRun::new();
        for (life, change) in [(Life::Running, Change::None), (Life::Ended, Change::Lost)] {
            let mut stage = at_work(PlannedStage { hang_s: Some(10.5), ..stage::<Object>() });
            let process = stage.process().unwrap();
            run.tell("stage", process, life);
            let state = run.state(Phase::Running);
            let sign = state.record("stage").map(|record| record.alive_ns);
            let long_ago = Instant::now().checked_sub(Duration::from_secs(60)).unwrap();
            for second in 0..=10 {
                stage.watchdog.look(process, sign, None, long_ago + Duration::from_secs(second));
            }
            assert_eq!((stage.look(&state), stage.is_gone()), (change, change == Change::Lost), "{life:?}");
            stage.kill();
        }
    }

    #[test]
    fn no_stage_of_a_run_whose_folder_was_removed_is_started_anew() {
        let mut run = TrialRun::new();
        for is_removed in [false, true] {
            let (mut stage, _) = ended(1, Delivery::Latest);
            stage.planned.restart = Restart::OnFailure;
            let state = RunState { is_removed, ..run.state(Phase::Running) };
            assert_eq!((stage.look(&state), stage.is_over()), (Change::None, is_removed));
        }
    }

    #[test]
    fn a_source_that_was_started_late_is_told_to_stop_once_it_has_joined() {
        let (mut run, since) = (TrialRun::new(), Instant::now());
        let phase = Phase::Delivering { delivered: 0, since };
        let mut late = Supervised { is_late: true, ..at_work(stage::<Object>()) };
        late.look(&run.state(phase));
        assert!(late.is_late && answers(&mut late));
        run.tell("stage", late.process().unwrap(), Life::Running);
        late.look(&run.state(phase));
        let State::Running(Guarded { child, .. }) = &mut late.state else { panic!("it is over already") };
        assert_eq!(child.wait().unwrap().signal(), Some(Signal::INT.as_raw()));
        assert!(!late.is_late);
    }

    #[test]
    fn a_stage_that_waits_to_come_back_stays_away_when_the_run_ends() {
        let (mut run, since) = (TrialRun::new(), Instant::now());
        run.tell("stage", 42, Life::Running);
        for (phase, is_over) in [(Phase::Running, false), (Phase::Stopping { since }, true)] {
            let mut stage = supervised(stage::<Object>(), State::Waiting { until: since + MINUTE });
            let state = run.state(phase);
            assert_eq!((stage.look(&state), stage.is_over()), (Change::None, is_over));
            assert_eq!(state.record("stage").map(|record| record.life() == Life::Gone), Some(is_over));
        }
    }

    #[test]
    fn a_stage_comes_back_when_it_is_time_but_a_source_of_a_run_that_ends_only_where_it_is_a_bridge() {
        let (mut run, since) = (TrialRun::new(), Instant::now());
        let options = RunOptions { program: "true".into(), ..RunOptions::default() };
        let delivering = Phase::Delivering { delivered: 0, since };
        let source = stage::<Object>;
        let mut reader = source();
        reader.wiring.input = Some(Topic::default());
        let bridge = PlannedStage { runs: Runs::Bridge(BridgePlan::default().into()), ..source() };
        for (planned, phase, comes_back, is_late) in [
            (source(), Phase::Running, true, false),
            (source(), delivering, false, false),
            (reader, delivering, true, false),
            (bridge, delivering, true, true),
        ] {
            let mut stage = supervised(planned, State::Waiting { until: since });
            let state = RunState { options: &options, ..run.state(phase) };
            assert_eq!((stage.look(&state), stage.is_over()), (Change::None, !comes_back), "{phase:?}");
            assert_eq!((stage.process().is_some(), stage.is_late), (comes_back, is_late), "{phase:?}");
            stage.kill();
        }
    }

    #[test]
    fn a_stage_that_hangs_is_named_and_killed_where_the_file_says_so_and_it_is_told_when_one_goes_on() {
        let mut run = TrialRun::new();
        let long_ago = Instant::now().checked_sub(Duration::from_secs(60)).unwrap();
        for hang_s in [None, Some(10.5)] {
            let mut stage = at_work(PlannedStage { hang_s, ..stage::<Object>() });
            let process = stage.process().unwrap();
            run.tell("stage", process, Life::Running);
            change_record(&run.folder, "stage", |status| status.steps = 12);
            let state = run.state(Phase::Running);
            let sign = state.record("stage").map(|record| record.alive_ns);
            for second in 0..=10 {
                stage.watchdog.look(process, sign, None, long_ago + Duration::from_secs(second));
            }
            let hangs = logged(|| assert_eq!(stage.look(&state), Change::None));
            assert!(hangs.contains("stage `stage` hangs after 12 messages"), "{hangs}");
            assert_eq!(hangs.contains("11.0 s ago, and is killed"), hang_s.is_some(), "{hangs}");
            assert_eq!(answers(&mut stage), hang_s.is_none());
            change_record(state.folder, "stage", |status| status.steps = 13);
            let goes_on = logged(|| assert_eq!(stage.watch(&state), Change::None));
            assert!(goes_on.contains("stage `stage` goes on after 11.0 s"), "{goes_on}");
            stage.kill();
        }
    }

    #[test]
    fn what_became_of_a_process_is_what_its_own_record_of_this_run_says() {
        let (mut run, supervised) = (TrialRun::new(), over(stage::<Object>()));
        let told = |run: &mut TrialRun| {
            let own = supervised.own_record(42, &run.state(Phase::Running)).map(|own| own.life());
            [own.is_some(), came_to_its_end(own), own == Some(Life::Gone)]
        };
        assert_eq!(told(&mut run), [false, true, false], "a program that keeps no record is believed");
        for (number, process, life, expected) in [
            (7, 42, Life::Running, [true, false, false]),
            (7, 42, Life::Ended, [true, true, false]),
            (7, 42, Life::Gone, [true, false, true]),
            (7, 43, Life::Gone, [false, true, false]),
            (8, 42, Life::Gone, [false, true, false]),
        ] {
            run.tell("stage", process, life);
            run.plan.run = number;
            assert_eq!(told(&mut run), expected, "{process} of run {number}: {life:?}");
        }
    }

    #[test]
    fn a_process_is_there_until_it_is_killed() {
        let child = echo();
        let process = child.id();
        let mut supervised = supervised(stage::<Object>(), State::Running(child.into()));
        assert_eq!((supervised.process(), supervised.exit(), supervised.is_over()), (Some(process), None, false));
        supervised.kill();
        assert_eq!((supervised.process(), supervised.exit()), (None, None));
        assert!(supervised.is_over() && !supervised.is_gone());
    }

    #[test]
    fn how_a_process_ended_is_told() {
        let told = [0x100, 9, SIGBUS].map(|status| describe(ExitStatus::from_raw(status)));
        assert_eq!(told[..2], ["ended with exit code 1", "was killed by signal 9"]);
        assert!(told[2].contains("shared memory is full"), "{}", told[2]);
    }

    #[test]
    fn a_stage_comes_back_later_with_each_death_and_is_given_up_after_ten_within_a_minute() {
        let (mut deaths, begin) = (VecDeque::new(), Instant::now());
        let mut die =
            |seconds: u64| back_off(&mut deaths, begin + Duration::from_secs(seconds)).map(|it| it.as_millis());
        let waits = [100, 200, 400, 800, 1600, 3200, 5000, 5000, 5000, 5000];
        assert_eq!([0; 10].map(&mut die), waits.map(Some));
        assert_eq!(die(59), None);
        assert_eq!(die(60), Some(200), "a minute later only the last one counts");
    }
}
