//! Supervision of a process that ends, does not join, or hangs.

use super::super::summary::tests::stage;
use super::super::trial_run::{TrialRun, change_record, logged};
use super::*;
use crate::network::BridgePlan;
use crate::ports::{Topic, TopicReader};
use conicflow_messages::Object;
use std::io::{BufRead, BufReader, Read, Write};
use std::os::unix::process::CommandExt;
use std::process::Child;

fn supervised(planned: PlannedStage, state: State) -> Supervised {
    let (watchdog, started) = (Watchdog::new(0, Instant::now()), Instant::now());
    let (deaths, reported_unjoined, at_work, counted_starts) = (0, None, None, 0);
    let [join_hint_logged, is_awaited_alone, is_late] = [false; 3];
    Supervised {
        planned,
        state,
        watchdog,
        deaths,
        reported_unjoined,
        join_hint_logged,
        at_work,
        counted_starts,
        is_awaited_alone,
        started,
        is_late,
    }
}

/// A program that echoes its input, and ends at the end of its input.
pub fn echo() -> Child {
    // A script that starts the tests in the background makes its processes ignore SIGINT; once this one answers, it no longer
    // does.
    let hearing = ["--default-signal=INT", "cat"];
    let mut child = Command::new("env").args(hearing).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
    assert!(gives_back(&mut child));
    child
}

/// A stage with a process that has not joined the run.
pub fn at_work(planned: PlannedStage) -> Supervised {
    supervised(planned, State::Running(echo().into()))
}

/// Whether the process of a stage [`at_work`] echoes its input.
pub fn answers(stage: &mut Supervised) -> bool {
    let State::Running(Guarded { child, .. }) = &mut stage.state else { return false };
    gives_back(child)
}

fn gives_back(child: &mut Child) -> bool {
    let (Some(stdin), Some(stdout)) = (&mut child.stdin, &mut child.stdout) else { return false };
    let mut answer = [0];
    stdin.write_all(b"?").is_ok() && stdout.read_exact(&mut answer).is_ok() && answer == *b"?"
}

/// A stage that has done all its work.
pub fn over(planned: PlannedStage) -> Supervised {
    supervised(planned, State::Done)
}

/// A stage that reads from `writer`, whose process has ended with this exit code.
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
        run.write_record("stage", process, told);
        let state = run.state(phase);
        let how = format!("exit code {exit}, {told:?} in its record, {restart:?}, {phase:?}");
        let last_check = Instant::now();
        assert_eq!(stage.check(&state), change, "{how}");
        assert!(!matches!(stage.state, State::Waiting { until } if until < last_check + FIRST_BACK_OFF), "{how}");
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
        run.write_record("stage", process, Life::Ended);
        run.write_record("writer", 42, life);
        stage.check(&run.state(Phase::Running));
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
        let told = (stage.check(&run.state(phase)), stage.is_over(), stage.is_gone());
        assert_eq!(told, (change, true, change == Change::Lost), "{delivery:?}");
    }
}

#[test]
fn a_program_that_does_not_join_is_named_and_then_given_up_where_a_lossless_topic_or_the_end_of_the_run_waits_for_it() {
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
        run.write_record("writer", 42, writer);
        let (Supervised { mut planned, .. }, _) = ended(0, delivery);
        planned.join_s = Some(100.0);
        let mut stage = at_work(planned);
        stage.started = Instant::now().checked_sub(Duration::from_secs_f64(waited_s)).unwrap();
        let state = run.state(Phase::Running);
        assert_eq!(stage.check(&state), Change::None);
        assert_eq!(stage.reported_unjoined, stage.process().filter(|_| is_named), "{delivery:?} after {waited_s} s");
        let told = logged(|| assert_eq!(stage.check(&state), change, "{delivery:?} after {waited_s} s"));
        let is_awaited_alone = (delivery, writer) == (Delivery::Latest, over);
        assert_eq!(told.contains("the run waits for"), is_awaited_alone, "{told}");
        assert_eq!((stage.is_gone(), stage.process().is_none()), (change == Change::Lost, change == Change::Lost));
        stage.kill();
    }
    let mut joined = at_work(stage::<Object>());
    joined.reported_unjoined = joined.process();
    run.write_record("stage", joined.process().unwrap(), Life::Running);
    assert_eq!((joined.check(&run.state(Phase::Running)), joined.reported_unjoined), (Change::None, None));
    assert!(answers(&mut joined), "it is left at its work");
    let stopping = run.state(Phase::Stopping { since: Instant::now() });
    assert_eq!((joined.check(&stopping), joined.is_over()), (Change::None, false), "it has its time to end");
    joined.kill();
}

#[test]
fn a_stage_is_brought_on_by_a_process_that_comes_to_work_and_by_the_one_after_it_but_by_no_other() {
    let (mut run, mut stage) = (TrialRun::new(), at_work(stage::<Object>()));
    let options = RunOptions { program: "true".into(), ..RunOptions::default() };
    let mut counted_starts = |life: Life| {
        run.write_record("stage", stage.process().unwrap(), life);
        (0..2).for_each(|_| assert_eq!(stage.check_heartbeat(&run.state(Phase::Running)), Change::None));
        let at_work = stage.counted_starts();
        stage.kill();
        assert_eq!(stage.restart(&RunState { options: &options, ..run.state(Phase::Running) }), Change::None);
        [at_work, stage.counted_starts()]
    };
    let [starting, running] = [Life::Starting, Life::Running];
    assert_eq!([starting, running, starting, starting].map(&mut counted_starts), [[0, 0], [1, 2], [2, 2], [2, 2]]);
    stage.kill();
}

#[test]
fn a_program_that_never_joins_is_named_each_time_it_is_started_and_how_it_could_is_told_once() {
    let (mut run, mut stage) = (TrialRun::new(), at_work(ended(0, Delivery::Latest).0.planned));
    let mut hints = Vec::new();
    for _ in 0..3 {
        stage.started = Instant::now().checked_sub(Duration::from_secs(50)).unwrap();
        let told = logged(|| assert_eq!(stage.check(&run.state(Phase::Running)), Change::None));
        assert!(told.contains("has not joined the run"), "{told}");
        hints.push(told.contains(JOIN_HINT));
        stage.kill();
        stage.state = State::Running(echo().into());
    }
    stage.kill();
    assert_eq!(hints, [true, false, false]);
}

#[test]
fn a_program_that_fails_before_it_has_joined_does_not_come_back_when_nothing_can_come_to_it() {
    let mut run = TrialRun::new();
    for (writer, change) in [(Life::Running, Change::None), (Life::Ended, Change::Lost)] {
        run.write_record("writer", 42, writer);
        let (mut stage, _) = ended(1, Delivery::Latest);
        stage.planned.restart = Restart::OnFailure;
        assert_eq!(stage.check(&run.state(Phase::Running)), change, "its writer: {writer:?}");
        assert_eq!(stage.is_over(), change == Change::Lost);
    }
}

#[test]
fn a_stage_that_hangs_when_it_has_ended_its_stream_is_killed_for_good_where_the_file_says_so() {
    let mut run = TrialRun::new();
    for (life, change) in [(Life::Running, Change::None), (Life::Ended, Change::Lost)] {
        let mut stage = at_work(PlannedStage { hang_s: Some(10.5), ..stage::<Object>() });
        let process = stage.process().unwrap();
        run.write_record("stage", process, life);
        let state = run.state(Phase::Running);
        let sign = state.record("stage").map(|record| record.alive_ns);
        let long_ago = Instant::now().checked_sub(Duration::from_secs(60)).unwrap();
        for second in 0..=10 {
            stage.watchdog.check(process, sign, None, long_ago + Duration::from_secs(second));
        }
        assert_eq!((stage.check(&state), stage.is_gone()), (change, change == Change::Lost), "{life:?}");
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
        assert_eq!((stage.check(&state), stage.is_over()), (Change::None, is_removed));
    }
}

#[test]
fn a_source_that_was_started_late_is_told_to_stop_once_it_has_joined() {
    let (mut run, since) = (TrialRun::new(), Instant::now());
    let phase = Phase::Delivering { delivered: 0, since };
    let mut late = Supervised { is_late: true, ..at_work(stage::<Object>()) };
    late.check(&run.state(phase));
    assert!(late.is_late && answers(&mut late));
    run.write_record("stage", late.process().unwrap(), Life::Running);
    late.check(&run.state(phase));
    let State::Running(Guarded { child, .. }) = &mut late.state else { panic!("it is over already") };
    assert_eq!(child.wait().unwrap().signal(), Some(Signal::INT.as_raw()));
    assert!(!late.is_late);
}

#[test]
fn a_stage_that_waits_to_come_back_stays_away_when_the_run_ends() {
    let (mut run, since) = (TrialRun::new(), Instant::now());
    run.write_record("stage", 42, Life::Running);
    for (phase, is_over) in [(Phase::Running, false), (Phase::Stopping { since }, true)] {
        let mut stage = supervised(stage::<Object>(), State::Waiting { until: since + WORKED_WELL });
        let state = run.state(phase);
        assert_eq!((stage.check(&state), stage.is_over()), (Change::None, is_over));
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
        assert_eq!((stage.check(&state), stage.is_over()), (Change::None, !comes_back), "{phase:?}");
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
        run.write_record("stage", process, Life::Running);
        change_record(&run.folder, "stage", |status| status.steps = 12);
        let state = run.state(Phase::Running);
        let sign = state.record("stage").map(|record| record.alive_ns);
        for second in 0..=10 {
            stage.watchdog.check(process, sign, None, long_ago + Duration::from_secs(second));
        }
        let hangs = logged(|| assert_eq!(stage.check(&state), Change::None));
        assert!(hangs.contains("stage `stage` hangs after 12 messages"), "{hangs}");
        assert_eq!(hangs.contains("11.0 s ago, and is killed"), hang_s.is_some(), "{hangs}");
        assert_eq!(answers(&mut stage), hang_s.is_none());
        change_record(state.folder, "stage", |status| status.steps = 13);
        let goes_on = logged(|| assert_eq!(stage.check_heartbeat(&state), Change::None));
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
        run.write_record("stage", process, life);
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

/// Number of restarts of a stage with this `restart` whose processes all end with `exit` after `lived_s` seconds, and its last
/// log message; `None`: it is always restarted.
fn comes_back(exit: u8, restart: Restart, lived_s: u64) -> Option<(usize, String)> {
    let mut run = TrialRun::new();
    let mut stage = supervised(stage::<Object>(), State::Done);
    stage.planned.restart = restart;
    let (mut times, long_ago) = (0, Instant::now().checked_sub(Duration::from_secs(lived_s)).unwrap());
    while times < 100 {
        let (Supervised { state, .. }, process) = ended(exit, Delivery::Latest);
        (stage.state, stage.started) = (state, long_ago);
        run.write_record("stage", process, Life::Ended);
        let mut change = Change::None;
        let told = logged(|| change = stage.check(&run.state(Phase::Running)));
        if change == Change::Lost {
            return Some((times, told));
        }
        assert!(!stage.is_over(), "{told}");
        times += 1;
    }
    None
}

#[test]
fn a_stage_that_dies_every_few_seconds_is_given_up_and_one_that_worked_for_a_minute_lives_for_ever() {
    use Restart::{Always, OnFailure};
    for lived_s in [0, 7, 59] {
        let (times, told) = comes_back(1, OnFailure, lived_s).unwrap();
        assert_eq!(times, 10, "{lived_s} s");
        let why = "stage `stage` ended with exit code 1, for the 11th time in a row, and never worked for long: it is given up";
        assert!(told.contains(why) && told.contains("hint: "), "{told}");
    }
    assert!([60, 3600].iter().all(|lived_s| comes_back(1, OnFailure, *lived_s).is_none()));
    assert_eq!(comes_back(0, Always, 0).map(|(times, _)| times), Some(10));
    assert_eq!(comes_back(0, Always, 7), None, "its work may take so long");
}

#[test]
fn a_stage_comes_back_later_with_each_death_in_a_row() {
    let waits = [100, 200, 400, 800, 1600, 3200, 5000, 5000, 5000, 5000].map(Some);
    assert_eq!([1, 2, 3, 4, 5, 6, 7, 8, 9, 10].map(|deaths| back_off(deaths).map(|it| it.as_millis())), waits);
    assert_eq!(back_off(11), None);
}

#[test]
fn a_signal_to_the_group_of_a_stage_reaches_what_it_has_started() {
    let mut command = Command::new("sh");
    command.args(["-c", "sleep 1000 & echo ready; wait"]).process_group(0).stdin(Stdio::null()).stdout(Stdio::piped());
    let mut child = command.spawn().unwrap();
    let mut output = BufReader::new(child.stdout.take().unwrap());
    output.read_line(&mut String::new()).unwrap();
    let mut stage = supervised(stage::<Object>(), State::Running(child.into()));
    stage.signal_group(Signal::KILL);
    assert_eq!(output.read_to_end(&mut Vec::new()).unwrap(), 0, "nobody has it open any more");
    stage.kill();
}
