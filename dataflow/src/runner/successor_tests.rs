//! Tests of a process that replaces another.

use super::RunError;
use super::handover::Watermark;
use super::handover::tests::successor;
use super::place_trial::{
    LONG, Passing, RUN, SHORT, Taking, Trial, ball, end_of, from, is_ready, mark, send, send_items, taken_until_end,
    topic,
};
use crate::Stage;
use crate::clock::until;
use crate::ports::{Delivery, Reader, Transport, Wiring, Writer};
use crate::status::{InputCounts, Life, StatusFile, status_path};
use conicflow_messages::{Object, Text};
use std::fs;
use std::io::Write;
use std::time::Duration;

#[test]
fn a_successor_is_ready_when_it_has_heard_each_writer_and_goes_on_after_its_predecessor() {
    let trial = Trial { life: |stage| (stage == "over").then_some(Life::Ended), ..Trial::of("stage") };
    let input = topic("in", &["upstream", "other", "over"], "stage", Delivery::Lossless);
    let (mut writer, viewer) = (trial.writer(&input), trial.viewer());
    let wiring = Wiring { input: Some(input), output: Some(trial.output()), ..Wiring::default() };
    let (next, mut launcher) = successor(trial.folder.path(), "stage");
    let (result, sent) = trial.run_after::<Passing, _>(wiring, Some(next), || {
        send(&mut writer, (3..6).map(|number| from("upstream", number)));
        assert!(!is_ready(&mut launcher, SHORT), "the other one has sent nothing");
        send(&mut writer, [from("other", 0)]);
        assert!(is_ready(&mut launcher, LONG));
        let first = ["upstream", "other"].map(Text::new).into_iter().zip([3, 0]).collect();
        assert_eq!(trial.handover().first().numbers, first);
        trial.handover().leave(&mark(4)).unwrap();
        assert!(trial.is_unwritten(), "it has not taken its place yet");
        launcher.write_all(b"t").unwrap();
        send(&mut writer, [end_of("upstream", 6), end_of("other", 1)]);
        taken_until_end(viewer)
    });
    result.unwrap();
    assert_eq!((sent.len(), trial.record().steps, trial.record().starts), (2, 2, 1));
    assert_eq!((trial.record().inputs[0].late, trial.record().inputs[0].dropped), (0, 0));
}

#[test]
fn a_successor_whose_predecessor_was_killed_works_on_all_that_was_not_finished() {
    let trial = Trial::of("stage");
    let input = trial.input(Delivery::Lossless);
    let mut writer = trial.writer(&input);
    let mut killed = trial.memory.reader::<Object>(&input, "stage").unwrap();
    send(&mut writer, (0..3).map(|number| from("upstream", number)));
    killed.acknowledge(Text::new("upstream"), 1);
    drop(killed);
    let mut record = StatusFile::open(&status_path(trial.folder.path(), "stage"), RUN).unwrap();
    record.status.steps = 1;
    record.status.inputs[0] = InputCounts { topic: Text::new("in"), received: 1, ..InputCounts::default() };
    record.write();
    let wiring = Wiring { input: Some(input), ..Wiring::default() };
    let (next, mut launcher) = successor(trial.folder.path(), "stage");
    let (result, ()) = trial.run_after::<Passing, _>(wiring, Some(next), || {
        send(&mut writer, [from("upstream", 3)]);
        assert!(is_ready(&mut launcher, LONG));
        launcher.write_all(b"t").unwrap();
        assert!(until(|| {
            writer.catch_up();
            trial.has_done(4)
        }));
        send(&mut writer, [end_of("upstream", 4)]);
    });
    result.unwrap();
    assert_eq!((writer.unfinished("stage"), trial.record().inputs[0].received), (0, 4));
}

#[test]
fn a_successor_for_which_nothing_is_kept_works_on_what_it_has_heard_where_its_predecessor_was_killed() {
    let trial = Trial::of("stage");
    let input = trial.input(Delivery::Latest);
    let mut writer = trial.writer(&input);
    let wiring = Wiring { input: Some(input), ..Wiring::default() };
    let (next, mut launcher) = successor(trial.folder.path(), "stage");
    let (result, ()) = trial.run_after::<Passing, _>(wiring, Some(next), || {
        send(&mut writer, [from("upstream", 5)]);
        assert!(is_ready(&mut launcher, LONG));
        launcher.write_all(b"t").unwrap();
        assert!(until(|| trial.has_done(1)));
        send(&mut writer, [end_of("upstream", 6)]);
    });
    result.unwrap();
}

#[test]
fn a_successor_waits_for_the_first_message_for_a_while_or_as_long_as_it_takes_where_none_may_be_lost() {
    let is_ready_without = |delivery, patience: Duration| {
        let trial = Trial::of("stage");
        let wiring = Wiring { input: Some(trial.input(delivery)), ..Wiring::default() };
        let (mut next, mut launcher) = successor(trial.folder.path(), "stage");
        next.patience = patience;
        let (result, ready) = trial.run_after::<Passing, _>(wiring, Some(next), || {
            let is_late = patience.is_zero() && delivery == Delivery::Latest;
            let ready = is_ready(&mut launcher, if is_late { LONG } else { SHORT });
            drop(launcher);
            ready
        });
        result.unwrap();
        assert!(trial.is_unwritten(), "it was not wanted any more");
        ready
    };
    let patiences = [Duration::ZERO, LONG];
    assert_eq!(patiences.map(|patience| is_ready_without(Delivery::Latest, patience)), [true, false]);
    assert_eq!(patiences.map(|patience| is_ready_without(Delivery::Lossless, patience)), [false, false]);
}

#[test]
fn a_successor_takes_no_message_of_which_a_side_input_lacks_its_part() {
    let is_ready_with = |side_delivery, life: fn(&str) -> Option<Life>| {
        let trial = Trial { life, ..Trial::of("stage") };
        let input = trial.input(Delivery::Lossless);
        let side = topic("side", &["side"], "stage", side_delivery);
        let [mut writer, mut partner] = [&input, &side].map(|topic| trial.writer(topic));
        let wiring =
            Wiring { input: Some(input), side_inputs: vec![("partner".to_owned(), side)], ..Wiring::default() };
        let (next, mut launcher) = successor(trial.folder.path(), "stage");
        let (result, ready) = trial.run_after::<Passing, _>(wiring, Some(next), || {
            send(&mut writer, [from("upstream", 4)]);
            let before = is_ready(&mut launcher, SHORT);
            send_items(&mut partner, from("upstream", 5), &[ball()]);
            send(&mut writer, [from("upstream", 5)]);
            let then = before || is_ready(&mut launcher, LONG);
            let first = trial.handover().first().numbers[&Text::new("upstream")];
            drop(launcher);
            (before, then, first)
        });
        result.unwrap();
        ready
    };
    for delivery in [Delivery::Lossless, Delivery::Latest] {
        assert_eq!(is_ready_with(delivery, |_| None), (false, true, 5));
        let over = |stage: &str| (stage == "side").then_some(Life::Ended);
        assert_eq!(is_ready_with(delivery, over), (true, true, 4), "nothing more comes of it");
    }
}

#[test]
fn a_stage_that_is_to_replace_another_is_made_ready_before_and_a_sink_anew_in_its_place() {
    fn made<S: Stage>() -> [usize; 2] {
        let trial = Trial::of("stage");
        let input = trial.input(Delivery::Lossless);
        let mut writer = trial.writer(&input);
        let wiring = Wiring { input: Some(input), ..Wiring::default() };
        let (next, mut launcher) = successor(trial.folder.path(), "stage");
        let made = || fs::read(trial.folder.path().join("made")).unwrap().len();
        let (result, before) = trial.run_after::<S, _>(wiring, Some(next), || {
            send(&mut writer, [from("upstream", 0)]);
            assert!(is_ready(&mut launcher, LONG));
            let before = made();
            trial.handover().leave(&Watermark::default()).unwrap();
            launcher.write_all(b"t").unwrap();
            send(&mut writer, [end_of("upstream", 1)]);
            before
        });
        result.unwrap();
        [before, made()]
    }
    assert_eq!((made::<Passing>(), made::<Taking>()), ([1, 1], [1, 2]));
}

#[test]
fn a_stage_that_cannot_be_made_ready_never_takes_a_place() {
    let trial = Trial::of("refused");
    let wiring = Wiring { input: Some(trial.input(Delivery::Latest)), ..Wiring::default() };
    let (next, mut launcher) = successor(trial.folder.path(), "refused");
    let (result, ready) = trial.run_after::<Passing, _>(wiring, Some(next), || is_ready(&mut launcher, LONG));
    assert!(matches!(result, Err(RunError::Refused(_))) && !ready && trial.is_unwritten());
}
