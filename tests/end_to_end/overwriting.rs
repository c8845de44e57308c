//! A run never changes the files that it reads, whatever paths its sinks are given.

use crate::processes::wait_for_lines;
use crate::support::{Playground, RECORDING, TRACKING};
use conicflow_lab::simulator::scene::Scene;
use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::symlink;
use std::path::{Path, PathBuf};

/// A sink of [`RECORDING`] and of [`REPLAY`], whose sources have the same topics.
const JSON: &str = "\n[stage.sink]\nnode = \"json_sink\"\ninput = { topic = \"ellipses\", delivery = \"lossless\" }\n";
const PICTURES: &str =
    "\n[stage.sink]\nnode = \"picture_sink\"\ninput = { topic = \"ellipses\", delivery = \"lossless\" }\n";
const MCAP: &str = "\n[stage.sink]\nnode = \"mcap_sink\"\ninput = { topic = \"ellipses\", delivery = \"lossless\" }\n";

/// Replays the recording of [`record`].
const REPLAY: &str = r#"
name = "replay"

[stage.source]
node    = "mcap_source"
output  = "depth"
path    = "run.mcap"
rate_hz = 0

[stage.extractor]
node   = "row_ellipse_extractor"
input  = { topic = "depth", delivery = "lossless" }
output = "ellipses"
"#;

/// Records three frames in `frames/`, and creates `link`, a symbolic link to this folder.
fn frames() -> Playground {
    let playground = Playground::new();
    playground.record_with_camera(Scene::built_in("tabletop").unwrap().unwrap(), 5, 3);
    symlink("frames", playground.path("link")).unwrap();
    playground
}

/// Creates the files of [`frames`], and records the frames in `run.mcap`.
fn record() -> Playground {
    let playground = frames();
    let depth = "inputs = { depth = { topic = \"depth\", delivery = \"lossless\" } }\n";
    playground.write("pipeline.toml", &format!("{RECORDING}{MCAP}{depth}path = \"run.mcap\"\n"));
    playground.conicflow(&["run", "--quiet"]).expect_code(0);
    playground
}

/// All files in a folder and its subfolders, with their bytes.
fn contents(folder: &Path) -> BTreeMap<PathBuf, Vec<u8>> {
    let paths = fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    paths
        .flat_map(|path| match path.is_dir() && !path.is_symlink() {
            true => contents(&path),
            false => BTreeMap::from([(path.clone(), fs::read(&path).unwrap_or_default())]),
        })
        .collect()
}

/// Asserts that a pipeline is refused with this text, and that nothing is written.
fn expect_refused(playground: &Playground, pipeline: &str, expected: &str) {
    playground.write("pipeline.toml", pipeline);
    let before = contents(&playground.path(""));
    for command in ["validate", "run"] {
        let ended = playground.conicflow(&[command]).expect_code(2);
        assert!(ended.stderr.contains(expected) && ended.stderr.contains("\n  hint: "), "{expected}: {}", ended.stderr);
        assert!(contents(&playground.path("")) == before, "{command} has changed something: {pipeline}");
    }
}

#[test]
fn no_stage_writes_over_frames_or_what_belongs_to_them() {
    let playground = frames();
    fs::copy(playground.path("frames/0.png"), playground.path("frames/frame_000004.png")).unwrap();
    // The target of this link does not exist yet. If a sink created it, the source would read it with the frames.
    symlink("frames/depth.txt", playground.path("dangling")).unwrap();
    for (sink, parameters, expected) in [
        (PICTURES, "path = \"frames\"", "from which `path` of stage `source` reads"),
        (JSON, "path = \"frames/1.png\"", "frames/1.png`, which `path` of stage `source` reads"),
        (JSON, "path = \"link/1.png\"", "link/1.png`, which `path` of stage `source` reads"),
        (JSON, "path = \"new/../frames/1.png\"", "frames/1.png`, which `path` of stage `source` reads"),
        (JSON, "path = \"frames/camera.json\"", "frames/camera.json`, which `path` of stage `source` reads"),
        (JSON, "path = \"frames/depth.txt\"", "frames/depth.txt`, which `path` of stage `source` reads"),
        (JSON, "path = \"dangling\"", "dangling`, which `path` of stage `source` reads"),
        (JSON, "path = \"pipeline.toml\"", "pipeline.toml`, which this pipeline reads"),
        (PICTURES, "moving = \"frames/1.png\"", "`moving` of stage `sink` writes the file"),
        (PICTURES, "path = \"frames\"\nnames = \"source\"", "from which `path` of stage `source` reads"),
        (PICTURES, "path = \"link/.\"\nnames = \"stage\"", "from which `path` of stage `source` reads"),
    ] {
        expect_refused(&playground, &format!("{RECORDING}{sink}{parameters}\n"), expected);
    }
}

#[test]
fn no_stage_writes_over_the_poses_of_frames() {
    let playground = frames();
    playground.write("poses.log", "");
    let posed = RECORDING.replace("rate_hz = 0", "rate_hz = 0\nposes = \"poses.log\"");
    let expected = "poses.log`, which `poses` of stage `source` reads";
    expect_refused(&playground, &format!("{posed}{JSON}path = \"poses.log\"\n"), expected);
}

#[test]
fn no_two_stages_write_one_file() {
    let playground = frames();
    let twice = "`path` of stage `sink` writes what `path` of stage `json` writes, too";
    expect_refused(&playground, &format!("{RECORDING}{JSON}path = \"./objects.jsonl\"\n"), twice);
    let others = PICTURES.replace("stage.sink", "stage.others");
    let twice = "`path` of stage `others` writes what `path` of stage `sink` writes, too";
    expect_refused(&playground, &format!("{RECORDING}{PICTURES}path = \"a\"\n{others}path = \"a\"\n"), twice);
}

#[test]
fn no_two_pipelines_that_run_write_one_file() {
    let playground = Playground::with_pipeline(TRACKING);
    let mut run = playground.start(&["run", "--set", "source.rate_hz=30"]);
    wait_for_lines(&mut run, &playground);
    playground.write("second.toml", &TRACKING.replace("\"tracking\"", "\"second\""));
    let refused = playground.conicflow(&["run", "second.toml"]).expect_code(2);
    refused.expect_texts(&[
        "`path` of stage `json` writes what `path` of stage `json` of the running pipeline `tracking` writes",
    ]);
    playground.conicflow(&["run", "second.toml", "--frames", "3", "--set", "json.path=other.jsonl"]).expect_code(0);
    run.end();
}

#[test]
fn a_recording_that_is_played_is_not_recorded_over() {
    let playground = record();
    fs::copy(playground.path("run.mcap"), playground.path("again_2.mcap")).unwrap();
    for (source, sink, expected) in [
        ("run.mcap", "run.mcap", "writes the file"),
        (".", "new.mcap", "into the folder that `path` of stage `source` reads"),
        ("again_2.mcap", "again.mcap\"\nsplit_mb = \"100", "from which `path` of stage `source` reads"),
    ] {
        let replay = REPLAY.replace("run.mcap", source);
        let sink = format!("path = \"{sink}\"\n").replace("\"100\"", "100");
        expect_refused(&playground, &format!("{replay}{MCAP}{sink}"), expected);
    }
}

#[test]
fn detect_writes_over_nothing_that_it_reads() {
    let playground = record();
    for arguments in [
        &["frames", "--pictures", "frames"][..],
        &["frames", "--pictures", "link"],
        &["frames/1.png", "--pictures", "frames"],
        &["frames", "--out", "frames/1.png"],
        &["frames", "--out", "frames/camera.json"],
        &["link/1.png", "--out", "frames/1.png"],
        &["frames", "--moving", "frames/1.png"],
        &["run.mcap", "--out", "run.mcap"],
        &["run.mcap", "--moving", "./run.mcap"],
        &["frames", "--out", "both", "--moving", "both"],
    ] {
        let before = contents(&playground.path(""));
        let ended = playground.conicflow(&[&["detect"], arguments].concat());
        assert_eq!((ended.code, ended.stdout.as_str()), (Some(2), ""), "{arguments:?}: {}", ended.stderr);
        assert!(ended.stderr.contains("\n  hint: "), "{arguments:?}: {}", ended.stderr);
        assert!(contents(&playground.path("")) == before, "{arguments:?} has changed something");
    }
}

/// A second run may also overwrite the files that the first run has written.
#[test]
fn files_that_no_stage_reads_may_be_written_beside_the_frames() {
    let playground = frames();
    let frames = contents(&playground.path("frames"));
    let nowhere = "path = \"/dev/null\"\n";
    let others = format!("{JSON}{nowhere}{}{nowhere}", JSON.replace("stage.sink", "stage.other"));
    let beside = "[stage.pictures]\nnode = \"picture_sink\"\ninput = { topic = \"objects\", delivery = \"lossless\" }\n\
                  path = \"pictures\"\nmoving = \"pictures/all.png\"\n";
    let recording = RECORDING.replace("\"objects.jsonl\"", "\"frames/objects.jsonl\"");
    playground.write("pipeline.toml", &format!("{recording}{others}{beside}"));
    for _ in 0..2 {
        playground.conicflow(&["run", "--quiet"]).expect_code(0);
        let detect = ["detect", "frames", "--moving", "frames/moving.png", "--out", "frames/out.jsonl"];
        playground.conicflow(&detect).expect_code(0);
    }
    let after = contents(&playground.path("frames"));
    assert!(frames.iter().all(|(path, bytes)| after.get(path) == Some(bytes)));
    assert_eq!(after.len(), frames.len() + 3);
}
