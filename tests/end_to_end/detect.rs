//! `conicflow detect`: one command on recorded frames, compared with the pipeline on the same frames.

use crate::support::{Playground, RECORDING, read_png};
use conicflow_lab::simulator::scene::Scene;
use rustix::fs::{CWD, Mode, mkfifoat};
use serde_json::Value as Json;
use std::fs;

/// Writes frames of a built-in scene with their camera. Returns the argument of `--camera`.
fn record(playground: &Playground, frames: u64) -> String {
    record_scene(playground, "tabletop", frames)
}

/// Like [`record`], of another scene.
fn record_scene(playground: &Playground, scene: &str, frames: u64) -> String {
    let camera = playground.record_with_camera(Scene::built_in(scene).unwrap().unwrap(), 5, frames);
    format!("{},{},{},{}", camera.fx, camera.fy, camera.cx, camera.cy)
}

/// Lines of JSON without the values that differ from run to run.
fn results(text: &str) -> Vec<Json> {
    let line = |line: &str| {
        let mut line: Json = serde_json::from_str(line).unwrap();
        assert!(line["latency_ms"].take().as_f64().is_some_and(|latency_ms| latency_ms > 0.0), "{line}");
        line
    };
    text.lines().map(line).collect()
}

#[test]
fn detect_finds_what_the_pipeline_finds_bit_for_bit() {
    let playground = Playground::with_pipeline(&RECORDING.replace("noise   = \"ideal\"\n", ""));
    let camera = record(&playground, 12);
    playground.conicflow(&["run", "--quiet"]).expect_code(0);
    let piped = results(&fs::read_to_string(playground.path("objects.jsonl")).unwrap());
    let ended = playground.conicflow(&["detect", "frames", "--camera", &camera]).expect_code(0);
    let detected = results(&ended.stdout);
    assert_eq!(detected.len(), 12);
    // The stamps follow `rate_hz`. Without a rate, both commands use 30 frames per second.
    assert_eq!(detected, piped);
    let printed = playground.conicflow(&["detect", "frames", "--camera", &camera, "--out", "-"]).expect_code(0);
    assert_eq!(results(&printed.stdout), detected);
    assert!(!playground.path("-").exists());
    let objects: usize = detected.iter().map(|line| line["objects"].as_array().unwrap().len()).sum();
    assert!(objects >= 12, "{objects} objects in 12 frames");
    ended.expect_texts(&["in 12 frames: ", "cylinder"]);
}

#[test]
fn options_for_pictures_are_refused_without_pictures() {
    let playground = Playground::new();
    let camera = record(&playground, 2);
    for how in [["--zoom", "2"], ["--every", "2"], ["--moving-width", "100"], ["--sheet", "2"]] {
        let ended = playground.conicflow(&[&["detect", "frames", "--camera", &camera], &how[..]].concat());
        ended.expect_code(2).expect_texts(&["the following required arguments were not provided"]);
    }
    let gif = playground.conicflow(&["detect", "frames", "--camera", &camera, "--moving", "m.gif"]).expect_code(2);
    gif.expect_texts(&["`m.gif` will be a PNG that moves (APNG)\n  hint: name it `m.png`"]);
}

#[test]
fn frames_in_deeper_folders_and_broken_links_are_reported() {
    let playground = Playground::new();
    fs::create_dir_all(playground.path("nest/seq")).unwrap();
    std::os::unix::fs::symlink("/nowhere/seq", playground.path("nest/next")).unwrap();
    playground.conicflow(&["detect", "nest"]).expect_code(2).expect_texts(&[
        "and no other files; 1 folders are in it, such as `seq`: name that which has them; 1 links lead nowhere",
    ]);
    let taken_for_a_file = playground.conicflow(&["run", "nest"]).expect_code(2);
    taken_for_a_file.expect_texts(&["hint: `conicflow detect` takes frames and recordings"]);
    std::os::unix::fs::symlink("/nowhere/1.png", playground.path("nest/1.png")).unwrap();
    playground.conicflow(&["detect", "nest"]).expect_code(2).expect_texts(&["1.png`: a link that leads nowhere"]);
}

#[test]
fn results_and_pictures_are_written_to_the_requested_places() {
    let playground = Playground::new();
    let camera = record(&playground, 2);
    let what = ["detect", "frames/1.png", "--camera", &camera, "--noise", "kinect_v1", "--scale", "0.001"];
    let places = ["--pictures", "pictures", "--out", "out/objects.jsonl"];
    let ended = playground.conicflow(&[&what[..], &places].concat()).expect_code(0);
    assert_eq!(ended.stdout, "");
    let lines = playground.json_lines("out/objects.jsonl");
    assert_eq!((lines.len(), lines[0]["source"].as_str()), (1, Some("1.png")));
    let (info, _) = read_png(&playground.path("pictures/1.png"));
    assert_eq!((info.width, info.height, info.color_type), (320, 240, png::ColorType::Rgb));
}

#[test]
fn a_moving_picture_is_small_and_shows_every_second_frame() {
    let playground = Playground::new();
    let camera = record_scene(&playground, "tilted_cones", 6);
    let what =
        ["detect", "frames", "--camera", &camera, "--every", "2", "--pictures", "pictures", "--out", "objects.jsonl"];
    playground.conicflow(&[&what[..], &["--moving", "moving.png", "--moving-width", "160"]].concat()).expect_code(0);
    let file = std::io::BufReader::new(fs::File::open(playground.path("moving.png")).unwrap());
    let mut reader = png::Decoder::new(file).read_info().unwrap();
    let info = reader.info().clone();
    assert_eq!((info.width, info.height, info.animation_control().unwrap().num_frames), (160, 120, 3));
    let mut numbers = vec![0; 160 * 120];
    let unchanged = |numbers: &[u8]| numbers.iter().filter(|number| **number == 0).count();
    reader.next_frame(&mut numbers).unwrap();
    assert_eq!(unchanged(&numbers), 0, "the first is whole");
    assert_eq!(reader.info().frame_control().unwrap().delay_num, 66, "two frames of 30 in a second");
    reader.next_frame(&mut numbers).unwrap();
    assert!((numbers.len() / 2..numbers.len()).contains(&unchanged(&numbers)), "little moves: {}", unchanged(&numbers));
    assert_eq!(fs::read_dir(playground.path("pictures")).unwrap().count(), 3);
}

#[test]
fn a_frame_without_objects_has_a_line_and_a_reason() {
    let playground = Playground::new();
    fs::create_dir(playground.path("frames")).unwrap();
    playground.write_depth_png("frames/wall.png", 320, &[2000; 320 * 240]);
    let ended = playground.conicflow(&["detect", "frames", "--camera", "290,290,159.5,119.5"]).expect_code(0);
    assert_eq!(results(&ended.stdout)[0]["objects"], serde_json::json!([]));
    let (_, why) = ended.stderr.split_once("in 1 frames: nothing was found\n  ").unwrap();
    let count = why.strip_suffix(" arcs that a line explains\n").unwrap();
    assert!(count.parse::<u32>().unwrap() >= 40, "each sixth row and column is a line, {why}");
}

#[test]
fn an_input_without_frames_is_an_error_with_a_hint() {
    let playground = Playground::new();
    playground.record(Scene::built_in("tabletop").unwrap().unwrap(), 5, 1);
    for name in ["pipe.png", "pipe.mcap"] {
        mkfifoat(CWD, playground.path(name), Mode::RUSR | Mode::WUSR).unwrap();
    }
    fs::write(playground.path("run.mcap"), "").unwrap();
    for (arguments, what) in [
        (&["detect", "nowhere"][..], "nowhere"),
        (&["detect", "pipe.png"], "`pipe.png` is neither a file nor a folder"),
        (&["detect", "pipe.mcap"], "`pipe.mcap` is neither a file nor a folder"),
        (&["view", "pipe.mcap"], "`pipe.mcap` is no file"),
        (&["validate", "/dev/zero"], "cannot read the pipeline file `/dev/zero`: it is longer than 16777216 bytes"),
        (&["detect", "run.mcap", "--poses", "none"], "`--poses` is for images"),
        (&["detect", "frames", "--topic", "depth"], "`--topic` is for recordings"),
        (&["detect", "frames"], "intrinsics"),
        (&["detect", "frames", "--camera", "525,525,319.5"], "expected four numbers"),
        (&["detect", "frames", "--camera", "0,525,319.5,239.5"], "focal lengths are 1 to 1,000,000 pixels"),
        (&["detect", "frames", "--camera", "290,290,159.5,119.5", "--scale", "0"], "depth_scale"),
        (&["detect", "frames", "--noise", "kinect"], "unknown variant `kinect`, expected one of `kinect_v1`"),
    ] {
        let ended = playground.conicflow(arguments);
        assert!(ended.stderr.contains(what), "{arguments:?}: {}", ended.stderr);
        assert_eq!((ended.code, ended.stdout.as_str()), (Some(2), ""), "{arguments:?}: {}", ended.stderr);
    }
}
