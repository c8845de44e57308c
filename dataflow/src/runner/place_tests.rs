//! Tests of a stage's start, handover and end.

use super::handover::tests::successor;
use super::place_trial::{Trial, ball, end_of, from, mark, send, send_items, taken, taken_until_end, topic};
use super::{RunError, is_stopped};
use crate::clock::until;
use crate::ports::{Delivery, PortError, Reader, Transport, Wiring, Writer};
use crate::status::{Life, used};
use conicflow_messages::{Object, Text};

#[test]
fn the_record_of_a_stage_tells_what_came_what_was_sent_and_how_long_it_took() {
    let trial = Trial::of("stage");
    let (input, output) = (trial.input(Delivery::Lossless), trial.output());
    let (mut writer, viewer) = (trial.writer(&input), trial.viewer());
    let wiring = Wiring { input: Some(input), output: Some(output), ..Wiring::default() };
    let (result, sent) = trial.run(wiring, || {
        send(&mut writer, (0..3).map(|number| from("upstream", number)).chain([end_of("upstream", 3)]));
        taken_until_end(viewer)
    });
    result.unwrap();
    assert_eq!((sent, writer.unfinished("stage")), (vec![0, 1, 2], 0));
    let record = trial.record();
    assert_eq!((record.life(), record.had_enough, record.steps, record.sent), (Life::Ended, 0, 3, 3));
    assert_eq!(record.inputs[0].received, 3);
    assert_eq!([record.compute.count(), record.hop.count(), record.latency.count()], [3; 3]);
    assert_eq!(used(&record.found).collect::<Vec<_>>(), [("sphere", 3)]);
}

#[test]
fn a_process_writes_itself_into_the_record_which_goes_on_with_each_start() {
    let trial = Trial::of("stage");
    let mut runtimes = [(); 2].map(|()| trial.runtime(Wiring { frames: Some(5), ..Wiring::default() }));
    runtimes[0].record.status.set_life(Life::Gone);
    runtimes[0].enter();
    let record = trial.record();
    assert_eq!((record.process, record.starts, record.life()), (std::process::id(), 1, Life::Starting));
    assert_eq!(record.stage, Text::new("stage"));
    runtimes[0].begin(Some(9));
    assert_eq!((trial.record().life(), trial.record().total), (Life::Running, 5));
    runtimes[1].enter();
    assert_eq!((trial.record().starts, trial.record().total), (2, 5));
}

#[test]
fn the_side_inputs_of_a_stage_are_told_apart_by_name_and_finished_with_the_step() {
    let trial = Trial::of("stage");
    let input = trial.input(Delivery::Lossless);
    let sides =
        ["partner", "newest"].map(|name| (name.to_owned(), topic(name, &["side"], "stage", Delivery::Lossless)));
    let [mut writer, mut partner, mut newest] = [&input, &sides[0].1, &sides[1].1].map(|topic| trial.writer(topic));
    let wiring = Wiring { input: Some(input), side_inputs: sides.into(), ..Wiring::default() };
    let (result, ()) = trial.run(wiring, || {
        assert!(until(|| [&writer, &partner, &newest].iter().all(|writer| !writer.connected().is_empty())));
        for number in 0..2 {
            send_items(&mut partner, from("upstream", number), &[ball()]);
            send_items(&mut newest, from("upstream", number), &[ball(); 2]);
        }
        send(&mut writer, [from("upstream", 0), from("upstream", 1), end_of("upstream", 2)]);
    });
    result.unwrap();
    assert_eq!(["partner", "newest"].map(|name| trial.counter(name)), [2, 4]);
    let record = trial.record();
    assert_eq!([0, 1, 2].map(|input| record.inputs[input].topic.to_string()), ["in", "newest", "partner"]);
    assert_eq!(record.inputs[2].received, 2);
}

#[test]
fn a_stage_ends_when_each_stage_before_it_has_said_so_or_is_gone() {
    let trial = Trial { life: |stage| (stage == "killed").then_some(Life::Gone), ..Trial::of("stage") };
    let input = topic("in", &["killed", "upstream"], "stage", Delivery::Lossless);
    let (mut writer, viewer) = (trial.writer(&input), trial.viewer());
    let wiring = Wiring { input: Some(input), output: Some(trial.output()), ..Wiring::default() };
    let (result, sent) = trial.run(wiring, || {
        send(&mut writer, [from("killed", 0), from("upstream", 0)]);
        assert!(until(|| trial.has_done(2)));
        assert_eq!(trial.record().life(), Life::Running, "one of them is at work");
        send(&mut writer, [end_of("upstream", 1)]);
        taken_until_end(viewer)
    });
    result.unwrap();
    assert_eq!(sent, [0, 1]);
    assert_eq!((trial.record().life(), trial.record().had_enough), (Life::Ended, 0));
}

#[test]
fn a_stage_that_is_to_leave_works_on_what_its_successor_does_not_get_and_tells_no_end() {
    let trial = Trial::of("stage");
    let input = trial.input(Delivery::Lossless);
    let (mut writer, mut viewer) = (trial.writer(&input), trial.viewer());
    let wiring = Wiring { input: Some(input), output: Some(trial.output()), ..Wiring::default() };
    let (mut next, _launcher) = successor(trial.folder.path(), "stage");
    next.report_ready(&mark(2)).unwrap();
    trial.stop.leave();
    let (result, ()) = trial.run(wiring, || send(&mut writer, (0..4).map(|number| from("upstream", number))));
    result.unwrap();
    assert_eq!(taken(&mut viewer), (vec![0, 1], false));
    assert_eq!(trial.handover().last().unwrap().numbers, mark(1).numbers);
    assert_eq!((trial.record().life(), trial.record().steps), (Life::Running, 2));
    assert_eq!(writer.unfinished("stage"), 2);
}

#[test]
fn a_stage_that_is_to_leave_when_its_input_has_ended_ends_itself() {
    let trial = Trial::of("stage");
    let input = trial.input(Delivery::Lossless);
    let (mut writer, viewer) = (trial.writer(&input), trial.viewer());
    let wiring = Wiring { input: Some(input), output: Some(trial.output()), ..Wiring::default() };
    let (mut next, _launcher) = successor(trial.folder.path(), "stage");
    next.report_ready(&mark(9)).unwrap();
    trial.stop.leave();
    let (result, sent) = trial.run(wiring, || {
        send(&mut writer, [from("upstream", 0), end_of("upstream", 1)]);
        taken_until_end(viewer)
    });
    result.unwrap();
    assert_eq!((sent, trial.record().life()), (vec![0], Life::Ended));
    assert_eq!(trial.handover().last(), None);
}

#[test]
fn a_stage_that_is_to_leave_when_the_run_ends_ends_itself() {
    let trial = Trial::of("stage");
    let input = trial.input(Delivery::Lossless);
    let (mut writer, viewer) = (trial.writer(&input), trial.viewer());
    let wiring = Wiring { input: Some(input), output: Some(trial.output()), ..Wiring::default() };
    let (mut next, _launcher) = successor(trial.folder.path(), "stage");
    next.report_ready(&mark(9)).unwrap();
    trial.stop.leave();
    let (result, sent) = trial.run(wiring, || {
        send(&mut writer, [from("upstream", 0)]);
        assert!(until(|| trial.has_done(1)));
        trial.stop.request();
        taken_until_end(viewer)
    });
    result.unwrap();
    assert_eq!((sent, trial.record().life(), trial.handover().last()), (vec![0], Life::Ended, None));
}

#[test]
fn a_stage_that_is_asked_to_end_has_had_enough_and_one_that_is_stopped_at_once_tells_no_end() {
    let trial = Trial::of("stage");
    let wiring =
        || Wiring { input: Some(trial.input(Delivery::Lossless)), output: Some(trial.output()), ..Wiring::default() };
    trial.stop.request();
    let viewer = trial.viewer();
    let (result, sent) = trial.run(wiring(), || taken_until_end(viewer));
    result.unwrap();
    assert_eq!((sent, trial.record().life(), trial.record().had_enough), (vec![], Life::Ended, 1));
    trial.stop.force();
    let mut viewer = trial.viewer();
    let (result, ()) = trial.run(wiring(), || ());
    result.unwrap();
    assert_eq!((taken(&mut viewer), trial.record().life()), ((vec![], false), Life::Running));
}

#[test]
fn only_a_failure_that_lasts_is_noted_in_the_record_so_that_nobody_starts_the_stage_anew() {
    let failure = |stage: &str| {
        let trial = Trial::of(stage);
        let input = trial.input(Delivery::Lossless);
        let mut writer = trial.writer(&input);
        let wiring = Wiring { input: Some(input), ..Wiring::default() };
        let (result, ()) = trial.run(wiring, || send(&mut writer, [from("upstream", 4)]));
        (matches!(result.unwrap_err(), RunError::Lasting { frame: 4, .. }), trial.record().life())
    };
    assert_eq!(["full", "failing"].map(failure), [(true, Life::Gone), (false, Life::Running)]);
}

#[test]
fn a_message_that_two_processes_died_of_is_finished_when_it_is_left_out() {
    let trial = Trial::of("stage");
    let input = trial.input(Delivery::Lossless);
    let mut writer = trial.writer(&input);
    let mut killed = trial.memory.reader::<Object>(&input, "stage").unwrap();
    (0..2).for_each(|_| _ = killed.begin(Text::new("upstream"), 0));
    drop(killed);
    let wiring = Wiring { input: Some(input), ..Wiring::default() };
    let (result, ()) = trial.run(wiring, || {
        send(&mut writer, [from("upstream", 0)]);
        assert!(until(|| writer.unfinished("stage") == 0));
        assert_eq!((trial.record().inputs[0].dropped, trial.record().steps), (1, 0));
        send(&mut writer, [from("upstream", 1), end_of("upstream", 2)]);
    });
    result.unwrap();
    assert_eq!((trial.record().inputs[0].received, trial.record().steps), (1, 1));
}

#[test]
fn a_run_that_ends_while_something_is_sent_is_no_fault_and_all_else_is() {
    assert!(!is_stopped(Ok(())).unwrap());
    assert!(is_stopped(Err(PortError::Stopped)).unwrap());
    let fault = PortError::TooManyOnlookers { topic: "objects".to_owned(), limit: 8 };
    assert!(is_stopped(Err(fault)).is_err());
}
