//! `conicflow node`: stages that are started one by one, each by hand.

use crate::support::{Ended, Playground, TRACKING, TRACKING_STAGES};
use std::fs;

/// [`TRACKING`] over three frames.
fn three_frames() -> String {
    TRACKING.replace("rate_hz    = 0", "rate_hz = 0\nframes = 3")
}

/// Starts these stages of a playground's pipeline, each by a command of its own, and waits until all have ended.
fn run_each(playground: &Playground, stages: &[&str]) -> Vec<Ended> {
    let started: Vec<_> = stages.iter().map(|stage| playground.start(&["node", stage])).collect();
    started.into_iter().map(|stage| stage.wait().expect_code(0)).collect()
}

#[test]
fn stages_that_are_started_one_by_one_a_second_time_begin_anew() {
    let playground = Playground::with_pipeline(&three_frames());
    for round in 0..2 {
        run_each(&playground, &TRACKING_STAGES);
        assert_eq!(playground.sequences("tracks.jsonl"), [0, 1, 2], "round {round}");
        fs::remove_file(playground.path("tracks.jsonl")).unwrap();
    }
}
