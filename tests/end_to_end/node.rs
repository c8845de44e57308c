//! Tests of `conicflow node`, which starts a single stage by hand.

use crate::outside_stage::with_nearest_object;
use crate::processes::at_work;
use crate::support::{Ended, Playground, TRACKING, TRACKING_STAGES};
use std::fs;

/// [`TRACKING`] with three frames.
fn three_frames() -> String {
    TRACKING.replace("rate_hz    = 0", "rate_hz = 0\nframes = 3")
}

/// Starts these stages of a pipeline, each with its own command, and waits until all have ended.
fn run_each(playground: &Playground, stages: &[&str]) -> Vec<Ended> {
    let started: Vec<_> = stages.iter().map(|stage| playground.start(&["node", stage])).collect();
    started.into_iter().map(|stage| stage.wait().expect_code(0)).collect()
}

#[test]
fn stages_that_are_started_one_by_one_a_second_time_start_afresh() {
    let playground = Playground::with_pipeline(&three_frames());
    for round in 0..2 {
        run_each(&playground, &TRACKING_STAGES);
        assert_eq!(playground.sequences("tracks.jsonl"), [0, 1, 2], "round {round}");
        fs::remove_file(playground.path("tracks.jsonl")).unwrap();
    }
}

#[test]
fn a_program_that_is_a_stage_finds_its_place_without_a_run() {
    let playground = with_nearest_object("");
    let text = fs::read_to_string(playground.path("pipeline.toml")).unwrap();
    playground.write("pipeline.toml", &text.replace("rate_hz    = 0", "rate_hz = 0\nframes = 3"));
    run_each(&playground, &[&TRACKING_STAGES[..], &["nearest", "objects", "passed_on"]].concat());
    assert_eq!(playground.sequences("nearest.jsonl"), [0, 1, 2]);
}

#[test]
fn a_stage_gets_the_environment_that_the_file_names() {
    let program = r#"
[stage]
painter = { program = ["sh", "-c", "echo $COLOUR > colour.txt"], input = "tracks", env = { COLOUR = "red" } }
"#;
    let playground = Playground::with_pipeline(&format!("{TRACKING}{program}"));
    playground.conicflow(&["node", "painter"]).expect_code(0);
    assert_eq!(playground.lines("colour.txt"), ["red"]);

    let node = "[stage.extractor]\nenv = { CONICFLOW_LOG = \"debug\" }\n";
    let playground = Playground::with_pipeline(&three_frames().replace("[stage.extractor]\n", node));
    let ended = run_each(&playground, &TRACKING_STAGES);
    let debugs = |stage: &Ended| stage.stderr.contains("DEBUG stage `");
    assert_eq!(ended.iter().map(debugs).collect::<Vec<_>>(), [false, true, false, false, false], "{ended:?}");
}

#[test]
fn no_stage_is_started_by_hand_into_a_run() {
    let (playground, _run) = at_work(TRACKING, 50);
    let ended = playground.conicflow(&["node", "tracker"]).expect_code(2);
    assert!(ended.stderr.starts_with("error: a pipeline named `tracking` is running already"), "{}", ended.stderr);
}
