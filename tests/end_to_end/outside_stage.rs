//! Stages from outside this repository: a program of its own in the middle of a pipeline.

use crate::support::{Ended, Playground, StageRow, Started, TRACKING, example};
use serde_json::Value as Json;
use std::fs;
use std::os::unix::fs::DirBuilderExt;
use std::process::Command;

/// What tracks objects, with `nearest_object` before the tracker and a record of what went into it.
pub fn with_nearest_object(keys: &str) -> Playground {
    let program = example("nearest_object");
    let (before, after) = TRACKING.split_once("[stage.tracker]").unwrap();
    let after = after.replacen("\"objects\"", "\"nearest\"", 1);
    let text = format!(
        r#"{before}
[stage.nearest]
program = ["{program}"]
input   = {{ topic = "objects", delivery = "lossless" }}
output  = "nearest"
{keys}

[stage.objects]
node  = "json_sink"
input = {{ topic = "objects", delivery = "lossless" }}
path  = "objects.jsonl"

[stage.passed_on]
node  = "json_sink"
input = {{ topic = "nearest", delivery = "lossless", kind = "objects" }}
path  = "nearest.jsonl"

[stage.tracker]{after}"#
    );
    Playground::with_pipeline(&text)
}

fn run(playground: &Playground) -> Ended {
    let wide = "source.intrinsics={ fx = 110, fy = 110, cx = 79.5, cy = 59.5 }";
    let sets = ["source.width=160", "source.height=120", wide].into_iter().flat_map(|set| ["--set", set]);
    let arguments: Vec<_> = ["run", "--frames", "12"].into_iter().chain(sets).collect();
    playground.conicflow(&arguments)
}

fn objects(line: &Json) -> Vec<Json> {
    line["objects"].as_array().unwrap().clone()
}

fn by_depth(line: &Json) -> Vec<Json> {
    let mut sorted = objects(line);
    sorted.sort_by(|a, b| a["center"][2].as_f64().unwrap().total_cmp(&b["center"][2].as_f64().unwrap()));
    sorted
}

#[test]
fn a_program_of_ones_own_works_in_the_middle_of_a_pipeline() {
    let playground = with_nearest_object("");
    let ended = run(&playground).expect_code(0);
    assert_eq!(ended.stage("nearest"), StageRow { messages: 12, starts: 1 });
    let (all, passed_on) = (playground.json_lines("objects.jsonl"), playground.json_lines("nearest.jsonl"));
    assert_eq!((all.len(), passed_on.len()), (12, 12));
    assert!(all.iter().any(|line| objects(line).len() > 1), "there is nothing to choose from");
    for (before, after) in all.iter().zip(&passed_on) {
        assert_eq!(before["sequence"], after["sequence"]);
        assert_eq!(objects(after), by_depth(before).into_iter().take(1).collect::<Vec<_>>());
    }
}

#[test]
fn its_parameters_come_from_the_pipeline_file() {
    let playground = with_nearest_object("max_objects = 2");
    run(&playground).expect_code(0);
    let (all, passed_on) = (playground.json_lines("objects.jsonl"), playground.json_lines("nearest.jsonl"));
    assert!(passed_on.iter().any(|line| objects(line).len() == 2), "the parameter makes no difference");
    for (before, after) in all.iter().zip(&passed_on) {
        assert_eq!(objects(after), by_depth(before).into_iter().take(2).collect::<Vec<_>>());
    }
}

#[test]
fn parameters_that_it_does_not_know_end_the_run() {
    let ended = run(&with_nearest_object("max_object = 2")).expect_code(1);
    assert!(ended.stderr.contains("error: unknown field `max_object`, expected `max_objects`"), "{}", ended.stderr);
    assert!(ended.stderr.contains("the run ends, because a stage is lost"), "{}", ended.stderr);
}

#[test]
fn a_program_that_takes_another_kind_of_message_ends_the_run() {
    let playground = with_nearest_object("");
    let sets = ["--set", "nearest.input=depth", "--frames", "3"];
    let ended = playground.conicflow(&[&["run"][..], &sets].concat()).expect_code(1);
    assert!(ended.stderr.contains("topic `depth` carries another type of message"), "{}", ended.stderr);
}

#[test]
fn a_stage_that_nobody_started_says_how_it_is_started() {
    let playground = Playground::new();
    let mut command = Command::new(example("nearest_object"));
    command.env_remove("CONICFLOW_PIPELINE").env("CONICFLOW_RUNTIME_DIR", playground.runtime());
    let ended = Started::new(command).wait().expect_code(2);
    assert!(ended.stderr.starts_with("error: the environment variable `CONICFLOW_PIPELINE` is not set\n  hint: "));
}

#[test]
fn a_stage_of_another_version_than_its_launcher_says_so() {
    let playground = Playground::new();
    let folder = playground.runtime().join("run/other");
    fs::DirBuilder::new().recursive(true).mode(0o700).create(&folder).unwrap();
    fs::write(folder.join("plan.json"), r#"{ "layout": 99, "stages": "in other words" }"#).unwrap();
    let mut command = Command::new(example("nearest_object"));
    let variables = [("CONICFLOW_PIPELINE", "other"), ("CONICFLOW_STAGE", "nearest")];
    command.envs(variables).env("CONICFLOW_RUNTIME_DIR", playground.runtime());
    let ended = Started::new(command).wait().expect_code(2);
    assert!(
        ended.stderr.contains("were built from different versions of conicflow (layout 1, 99)\n  hint: "),
        "{ended:?}"
    );
}
