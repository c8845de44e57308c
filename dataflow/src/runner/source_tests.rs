//! Tests of a source's start, handover and end.

use super::RunError;
use super::handover::tests::successor;
use super::place_trial::{LONG, Making, RUN, STAMPS_APART, Trial, from, is_ready, send, taken, taken_until_end, topic};
use super::source_loop::run_source;
use super::untyped::NewSource;
use crate::log::tests::logged;
use crate::ports::{Delivery, Wiring, Writer};
use crate::status::{Life, StatusFile, status_path, used};
use crate::stop::Stop;
use serde_json::json;
use std::io::Write;
use std::time::Instant;
use tracing::Level;

#[test]
fn a_source_records_what_it_made_and_ends() {
    let trial = Trial::of("source");
    let wiring = Wiring { output: Some(trial.output()), ..Wiring::default() };
    let viewer = trial.viewer();
    let (result, sent) = trial.run_source(wiring, None, || taken_until_end(viewer));
    result.unwrap();
    assert_eq!(sent, [0, 1, 2]);
    let record = trial.record();
    assert_eq!((record.life(), record.steps, record.sent, record.total), (Life::Ended, 3, 3, 3));
    assert_eq!(record.compute.count(), 3);
    assert_eq!(used(&record.found).collect::<Vec<_>>(), [("sphere", 3)]);
    assert_eq!(trial.counter("none left"), 1, "what the last step counted, which made nothing, is kept, too");
}

#[test]
fn a_source_that_cannot_end_its_work_ends_its_stream_and_is_not_started_anew() {
    let trial = Trial::of("failing");
    let wiring = Wiring { output: Some(trial.output()), ..Wiring::default() };
    let viewer = trial.viewer();
    let (result, sent) = trial.run_source(wiring, None, || taken_until_end(viewer));
    assert!(matches!(result, Err(RunError::Unfinished(_))));
    assert_eq!((sent.len(), trial.record().life()), (3, Life::Gone));
}

#[test]
fn a_source_that_leaves_its_place_or_is_stopped_at_once_tells_no_end() {
    for (end, made) in [(Stop::leave as fn(&Stop), 3), (Stop::force, 0)] {
        let trial = Trial::of("source");
        let wiring = Wiring { output: Some(trial.output()), ..Wiring::default() };
        let mut viewer = trial.viewer();
        end(&trial.stop);
        trial.run_source(wiring, None, || ()).0.unwrap();
        let (numbers, has_ended) = taken(&mut viewer);
        assert_eq!((numbers.len(), has_ended, trial.record().life()), (made, false, Life::Running));
    }
}

#[test]
fn a_source_that_replaces_another_makes_nothing_before_its_turn_and_goes_on_behind_that() {
    let trial = Trial::of("source");
    let wiring = || Wiring { output: Some(trial.output()), ..Wiring::default() };
    let (next, mut launcher) = successor(trial.folder.path(), "source");
    let mut viewer = trial.viewer();
    let mut record = StatusFile::open(&status_path(trial.folder.path(), "source"), RUN).unwrap();
    let (result, sent) = trial.run_source(wiring(), Some(next), || {
        assert!(is_ready(&mut launcher, LONG));
        assert_eq!(taken(&mut viewer), (vec![], false));
        record.status.sent = 2;
        record.write();
        launcher.write_all(b"t").unwrap();
        taken_until_end(viewer)
    });
    result.unwrap();
    assert_eq!((sent, trial.record().starts, trial.record().sent), (vec![2], 1, 3));
    let (next, mut launcher) = successor(trial.folder.path(), "source");
    let mut viewer = trial.viewer();
    let (result, ()) = trial.run_source(wiring(), Some(next), || {
        assert!(is_ready(&mut launcher, LONG));
        drop(launcher);
    });
    result.unwrap();
    assert_eq!((taken(&mut viewer), trial.record().starts), ((vec![], false), 1), "it was not wanted any more");
}

#[test]
fn a_source_that_was_started_anew_warns_where_it_had_nothing_more_to_make() {
    let warns = |stage: &str, sent: u64, frames: Option<u64>, is_stopped: bool| {
        let trial = Trial::of(stage);
        let mut runtime = trial.runtime(Wiring { frames, ..Wiring::default() });
        runtime.record.status.sent = sent;
        if is_stopped {
            trial.stop.request();
        }
        let new = NewSource::of::<Making>(json!({})).unwrap();
        logged(Level::WARN, || run_source(&new, runtime).unwrap()).contains("ends with nothing made")
    };
    assert!(warns("source", 3, None, false) && warns("source", 3, Some(9), false));
    assert!(!warns("source", 2, None, false), "it has made one");
    assert!(!warns("source", 3, Some(3), false), "no more were wanted");
    assert!(!warns("source", 3, None, true), "it was stopped");
    assert!(!warns("empty", 0, None, false), "it is the first");
}

#[test]
fn a_source_reads_its_side_inputs_before_each_message_and_finishes_what_it_has_read() {
    let trial = Trial::of("source");
    let side = topic("side", &["side"], "source", Delivery::Lossless);
    let mut writer = trial.writer(&side);
    // The stream of the source begins once a reader is connected.
    let wiring =
        Wiring { side_inputs: vec![("newest".to_owned(), side)], output: Some(trial.output()), ..Wiring::default() };
    let (result, ()) = trial.run_source(wiring, None, || {
        send(&mut writer, [from("side", 0), from("side", 1)]);
        taken_until_end(trial.viewer());
    });
    result.unwrap();
    assert_eq!((trial.record().inputs[0].received, writer.unfinished("source")), (1, 0));
    assert!(trial.counter("newest") >= 3, "in the first step that follows, and in all others");
}

#[test]
fn a_source_that_keeps_to_its_stamps_sends_as_far_apart_as_these_are() {
    let trial = Trial::of("stamped");
    let begin = Instant::now();
    let (result, ()) = trial.run_source(Wiring::default(), None, || ());
    result.unwrap();
    assert!(begin.elapsed() >= 2 * STAMPS_APART);
    assert_eq!(trial.record().steps, 3);
}
