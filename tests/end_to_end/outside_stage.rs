//! Stages that are programs of other repositories: one in the middle of a pipeline, and a camera at its beginning.

use crate::support::{Ended, Playground, StageRow, Started, TRACKING, example};
use rustix::fs::{CWD, Mode, mkfifoat};
use serde_json::Value as Json;
use std::fs;
use std::io::Write as _;
use std::os::unix::fs::DirBuilderExt;
use std::process::Command;

/// A pipeline that tracks objects, with `nearest_object` before the tracker, and a record of that stage's input.
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

[stage]
objects   = {{ node = "json_sink", input = {{ topic = "objects", delivery = "lossless" }}, path = "objects.jsonl" }}
passed_on = {{ node = "json_sink", input = {{ topic = "nearest", delivery = "lossless", kind = "objects" }}, path = "nearest.jsonl" }}

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
fn a_program_of_the_user_works_in_the_middle_of_a_pipeline_with_parameters_from_its_file() {
    for (keys, most) in [("", 1), ("max_objects = 2", 2)] {
        let playground = with_nearest_object(keys);
        let ended = run(&playground).expect_code(0);
        assert_eq!(ended.stage("nearest"), StageRow { messages: 12, starts: 1 });
        let (all, passed_on) = (playground.json_lines("objects.jsonl"), playground.json_lines("nearest.jsonl"));
        assert_eq!((all.len(), passed_on.len()), (12, 12));
        assert!(all.iter().any(|line| objects(line).len() >= 2), "there is nothing to choose from");
        for (before, after) in all.iter().zip(&passed_on) {
            assert_eq!(before["sequence"], after["sequence"]);
            assert_eq!(objects(after), by_depth(before).into_iter().take(most).collect::<Vec<_>>());
        }
    }
}

#[test]
fn a_program_of_the_user_logs_as_the_other_stages_do() {
    let ended = run(&with_nearest_object("env = { CONICFLOW_LOG = \"debug\" }")).expect_code(0);
    let of_stages: Vec<_> = ended.stderr.lines().filter_map(|line| line.split_once("DEBUG stage `")).collect();
    assert!(
        !of_stages.is_empty() && of_stages.iter().all(|(_, line)| line.starts_with("nearest`")),
        "{}",
        ended.stderr
    );
}

#[test]
fn parameters_unknown_to_the_program_end_the_run() {
    let ended = run(&with_nearest_object("max_object = 2")).expect_code(1);
    ended.expect_texts(&[
        "error: unknown key `max_object` in `parameters`\n  hint: did you mean `max_objects`?",
        "the run ends, because a stage is lost",
    ]);
}

#[test]
fn a_program_that_takes_another_kind_of_message_ends_the_run() {
    let playground = with_nearest_object("");
    let sets = ["--set", "nearest.input=depth", "--frames", "3"];
    let ended = playground.conicflow(&[&["run"][..], &sets].concat()).expect_code(1);
    ended.expect_texts(&["topic `depth` carries another type of message"]);
}

#[test]
fn a_stage_that_is_started_by_hand_says_how_to_start_it() {
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
    let expected = "were built from different versions of conicflow (layout ";
    assert!(ended.stderr.contains(expected) && ended.stderr.contains(", 99)\n  hint: "), "{ended:?}");
}

/// A pipeline that finds objects in the frames that `raw_camera` reads from `depth.z16`.
fn with_raw_camera() -> Playground {
    let program = example("raw_camera");
    let (_, after) = TRACKING.split_once("[stage.extractor]").unwrap();
    let text = format!(
        r#"name = "raw"

[stage.camera]
program     = ["{program}"]
output      = "depth"
path        = "depth.z16"
camera      = {{ width = 160, height = 120, fx = 150.0, fy = 150.0, cx = 79.5, cy = 59.5 }}
depth_scale = 0.001
noise       = {{ floor_m = 0.0005, growth_per_m = 0.0, knee_m = 0.0, step_per_m = 0.0 }}
restart     = "never"

[stage.extractor]{after}"#
    );
    Playground::with_pipeline(&text)
}

/// Depth image in millimetres of a ball of radius 0.15 m before a wall; the optical axis goes through the middle of the image.
pub fn ball_before_a_wall(width: usize, height: usize, focal_px: f64) -> Vec<u16> {
    let depth = |pixel: usize| {
        let from_middle = |index: usize, count: usize| (index as f64 - (count as f64 - 1.0) / 2.0) / focal_px;
        let (x, y) = (from_middle(pixel % width, width), from_middle(pixel / width, height));
        let square = x * x + y * y + 1.0;
        let root = 1.0 - square * (1.0 - 0.15 * 0.15);
        let depth_m = if root > 0.0 { (1.0 - root.sqrt()) / square } else { 2.0 };
        (depth_m * 1000.0).round() as u16
    };
    (0..width * height).map(depth).collect()
}

/// The bytes of a frame that `raw_camera` reads.
fn frame() -> Vec<u8> {
    ball_before_a_wall(160, 120, 150.0).into_iter().flat_map(u16::to_le_bytes).collect()
}

#[test]
fn a_camera_program_of_the_user_sends_images_through_a_pipe() {
    let playground = with_raw_camera();
    let pipe = playground.path("depth.z16");
    mkfifoat(CWD, &pipe, Mode::RUSR | Mode::WUSR).unwrap();
    // A pipe without a reader blocks its writer. A thread writes the frames, so that the test is not blocked and can fail.
    let camera = std::thread::spawn(move || {
        let mut writer = fs::OpenOptions::new().write(true).open(&pipe).unwrap();
        (0..5).for_each(|_| writer.write_all(&frame()).unwrap());
    });
    let ended = playground.conicflow(&["run"]).expect_code(0);
    camera.join().unwrap();
    assert_eq!(ended.stage("camera").messages, 5);
    let tracks = playground.json_lines("tracks.jsonl");
    let [ball] = &tracks.last().unwrap()["tracks"].as_array().unwrap()[..] else { panic!("{tracks:?}") };
    assert_eq!(ball["kind"], "sphere");
    assert!((ball["radius"].as_f64().unwrap() - 0.15).abs() < 0.002, "{ball}");
}

#[test]
fn a_stream_that_ends_within_a_frame_is_reported() {
    let playground = with_raw_camera();
    fs::write(playground.path("depth.z16"), &frame()[..1000]).unwrap();
    let ended = playground.conicflow(&["run"]).expect_code(1);
    assert!(ended.stderr.contains("the stream ends 37400 bytes before the end of a frame\n  hint: "), "{ended:?}");
}
