//! Runs from their start to their end: their output, its order, and the summary.

use crate::programs::program;
use crate::support::{
    Playground, RECORDING, StageRow, Started, TRACKING, TRACKING_STAGES, TRACKING_TOPICS, TRIES, hearing_hangups,
    read_png, signal, within,
};
use conicflow_lab::simulator::scene::Scene;
use rustix::process::Signal;
use serde_json::Value as Json;
use std::fs;
use std::io::BufRead;
use std::ops::Range;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

/// A pipeline of a source and a slow sink, which reads only the latest frame.
fn slow_pipeline(delay_ms: u64) -> Playground {
    let program = program("slow_sink");
    Playground::with_pipeline(&format!(
        r#"
name = "slow"

[stage]
source = {{ node = "synthetic_source", output = "depth", width = 32, height = 24, rate_hz = 0 }}
sink   = {{ program = {program}, input = "depth", path = "numbers.txt", delay_ms = {delay_ms} }}
"#
    ))
}

#[test]
fn a_run_ends_by_itself_when_one_reader_is_lossless_and_another_slow() {
    let playground = slow_pipeline(60);
    let extractor = "
[stage.extractor]
node   = \"row_ellipse_extractor\"
input  = { topic = \"depth\", delivery = \"lossless\" }
output = \"ellipses\"
";
    let text = playground.lines("pipeline.toml").join("\n") + extractor;
    playground.write("pipeline.toml", &text);
    let ended = playground.conicflow(&["run", "--frames", "200"]).expect_code(0);
    assert_eq!(ended.stage("extractor").messages, 200);
    let slow = ended.input("depth", "sink");
    assert!(slow.received > 0 && slow.received < 200, "{}", ended.stderr);
}

#[test]
fn the_default_pipeline_tracks_and_its_summary_names_all_stages() {
    let small = ["--set", "source.width=160", "--set", "source.height=120", "--set", "source.rate_hz=0"];
    let sets = [&small[..], &["--set", "source.frames=5"]].concat();
    let ended = Playground::new().conicflow(&[&["run"][..], &sets].concat()).expect_code(0);
    let last = ended.stdout.lines().last().unwrap();
    assert!(last.ends_with("  frame 4  bouncing_ball"), "{}", ended.stdout);
    assert_eq!(ended.stages(), ["source", "extractor", "assembler", "tracker", "console"]);
    assert_eq!(ended.stage("source").messages, 5);
    ended.expect_texts(&["\ndefault: 5 frames in "]);
    assert!(ended.stages().iter().all(|stage| ended.stage(stage).starts == 1), "{}", ended.stderr);
}

/// When a terminal closes, all processes that were started at it get SIGHUP.
#[test]
fn a_run_started_with_nohup_outlives_its_terminal() {
    let playground = Playground::with_pipeline(TRACKING);
    let run = ["run", "--quiet", "--set", "source.rate_hz=100"];
    let mut run = Started::new(within(Command::new("nohup"), &playground.command(&run)));
    run.wait_until("the first frames", || playground.newest("tracks.jsonl") >= 3);
    playground.processes().into_iter().for_each(|process| signal(process, Signal::HUP));
    let then = playground.newest("tracks.jsonl");
    run.wait_until("100 frames more", || playground.newest("tracks.jsonl") >= then + 100);
    let ended = run.end();
    assert!(!ended.stderr.contains("started anew"), "{}", ended.stderr);
    let sequences = playground.sequences("tracks.jsonl");
    assert!(sequences.iter().copied().eq(0..sequences.len() as u64), "each frame once");
}

#[test]
fn a_run_started_without_nohup_ends_with_its_terminal() {
    let playground = Playground::with_pipeline(TRACKING);
    let mut run =
        Started::new(hearing_hangups(&playground.command(&["run", "--quiet", "--set", "source.rate_hz=100"])));
    run.wait_until("the first frames", || playground.newest("tracks.jsonl") >= 3);
    signal(run.id(), Signal::HUP);
    run.wait();
}

#[test]
fn quiet_runs_log_nothing() {
    let playground = Playground::with_pipeline(TRACKING);
    let ended = playground.conicflow(&["run", "--quiet", "--frames", "3"]).expect_code(0);
    assert_eq!((ended.stdout.as_str(), ended.stderr.as_str()), ("", ""));
    assert_eq!(playground.sequences("tracks.jsonl"), [0, 1, 2]);
}

/// The lines of a run of [`TRACKING`] over 500 frames, without times of processing.
fn lossless_run() -> Vec<Json> {
    let playground = Playground::with_pipeline(TRACKING);
    let ended = playground.conicflow(&["run", "--set", "source.frames=500"]).expect_code(0);
    for stage in TRACKING_STAGES {
        let row = ended.stage(stage);
        assert_eq!((row.messages, row.starts), (500, 1), "{stage}");
    }
    TRACKING_TOPICS.iter().for_each(|(topic, _, reader)| ended.expect_all(topic, reader, 500));
    let mut lines = playground.json_lines("tracks.jsonl");
    for line in &mut lines {
        let latency = line.as_object_mut().unwrap().remove("latency_ms").unwrap();
        assert!(latency.as_f64().unwrap() > 0.0, "{line}");
    }
    lines
}

#[test]
fn lossless_delivers_each_frame_once_in_order_and_the_same_bits_each_time() {
    let first = lossless_run();
    let sequences: Vec<_> = first.iter().map(|line| line["sequence"].as_u64().unwrap()).collect();
    assert!(sequences.into_iter().eq(0..500));
    assert!(first.iter().any(|line| line["tracks"][0]["id"].is_u64()), "nothing was tracked");
    let text = |lines: &[Json]| lines.iter().map(Json::to_string).collect::<Vec<_>>();
    assert_eq!(text(&first), text(&lossless_run()));
}

#[test]
fn a_slow_reader_loses_frames_and_each_of_them_is_counted() {
    let playground = slow_pipeline(20);
    let ended = playground.conicflow(&["run", "--frames", "300"]).expect_code(0);
    let taken: Vec<u64> = playground.lines("numbers.txt").iter().map(|line| line.parse().unwrap()).collect();
    let input = ended.input("depth", "sink");
    assert_eq!(input.received, taken.len() as u64);
    assert!(input.dropped > 0, "nothing was lost, so that nothing is shown");
    // Messages that the source sent before the sink had joined do not count as lost. The sink may nevertheless have received some
    // of them.
    let (sent, counted) = (ended.stage("source").messages, input.received + input.dropped);
    assert!((sent - taken[0]..=sent).contains(&counted), "{counted} of {sent}, the first was {}", taken[0]);
    assert_eq!(input.late, 0);
    assert_eq!(input.gaps, input.dropped, "the only loss is before the only reader");
    assert!(taken.is_sorted_by(|a, b| a < b), "{taken:?}");
    assert_eq!(taken.last(), Some(&299), "the newest frame is never lost");
}

#[test]
fn a_source_that_surveys_a_hundred_thousand_files_does_not_count_as_hanging() {
    let text = RECORDING.replace("rate_hz = 0", "rate_hz = 0\nrestart = { when = \"on_failure\", hang_s = 1 }");
    let playground = Playground::in_memory().and_pipeline(&text);
    playground.record_with_camera(Scene::built_in("tabletop").unwrap().unwrap(), 5, 2);
    // Some file systems limit the number of names of a file, so these names are divided between two files.
    let frame = |number: u32| playground.path(&format!("frames/{number}.png"));
    (2..100_000).for_each(|number| fs::hard_link(frame(number % 2), frame(number)).unwrap());
    let comes_through = |_| {
        fs::remove_file(playground.path("objects.jsonl")).ok();
        let ended = playground.conicflow(&["run", "--frames", "20"]);
        eprintln!("{}", ended.stderr);
        let is_whole = || playground.sequences("objects.jsonl").into_iter().eq(0..20);
        ended.stage("source") == StageRow { messages: 20, starts: 1 } && ended.code == Some(0) && is_whole()
    };
    assert!((0..TRIES).any(comes_through), "it is started anew each time");
}

#[test]
fn a_slow_reader_holds_a_lossless_writer_back() {
    let playground = slow_pipeline(5);
    let lossless = "sink.input={ topic = \"depth\", delivery = \"lossless\", queue = 2 }";
    playground.conicflow(&["run", "--frames", "60", "--set", lossless]).expect_code(0);
    assert!(playground.lines("numbers.txt").into_iter().eq((0..60).map(|number: u64| number.to_string())));
}

#[test]
fn a_single_frame_arrives_even_where_only_the_newest_is_wanted() {
    let playground = Playground::with_pipeline(&TRACKING.replace("lossless", "latest"));
    playground.conicflow(&["run", "--set", "source.frames=1"]).expect_code(0);
    assert_eq!(playground.sequences("tracks.jsonl"), [0]);
}

#[test]
fn a_run_ends_after_its_time_limit() {
    let playground = Playground::with_pipeline(TRACKING);
    let begun = Instant::now();
    let ended = playground.conicflow(&["run", "--for", "1s", "--set", "source.rate_hz=50"]).expect_code(0);
    assert!(begun.elapsed() >= Duration::from_secs(1));
    assert!(playground.expect_each_frame(&ended) > 0);
}

#[test]
fn pipelines_of_different_names_do_not_meet() {
    let playground = Playground::new();
    let scenes = [("bouncing_ball", 40), ("empty_room", 60)];
    let runs = scenes.map(|(scene, frames)| {
        let text = TRACKING.replace("\"tracking\"", &format!("\"{scene}\"")).replace("tracks.jsonl", scene);
        playground.write(&format!("{scene}.toml"), &text);
        let (file, scene) = (format!("{scene}.toml"), format!("source.scene={scene}"));
        let paced = ["--set", "source.rate_hz=50", "--frames", &frames.to_string()].map(str::to_owned);
        let arguments = [["run", &file, "--set", &scene].map(str::to_owned), paced].concat();
        playground.start(&arguments.iter().map(String::as_str).collect::<Vec<_>>())
    });
    runs.into_iter().for_each(|run| drop(run.wait().expect_code(0)));
    for (scene, frames) in scenes {
        assert!(playground.sequences(scene).into_iter().eq(0..frames), "{scene}");
        assert!(playground.json_lines(scene).iter().all(|line| line["source"] == scene), "{scene}");
    }
}

#[test]
fn a_name_runs_once_at_a_time() {
    let playground = Playground::with_pipeline(TRACKING);
    let mut first = playground.start(&["run", "--set", "source.rate_hz=50"]);
    first.wait_until("the first run delivers", || !playground.lines("tracks.jsonl").is_empty());
    let second = playground.conicflow(&["run", "--set", "json.path=second.jsonl"]).expect_code(2);
    assert_eq!(
        second.stderr,
        "error: a pipeline named `tracking` is running already on this machine\n  \
         hint: end it first, give this one another `name` in its file, or, if it is another machine's part of the same \
         pipeline, another CONICFLOW_RUNTIME_DIR\n"
    );
    assert!(!playground.path("second.jsonl").exists());
    let before = playground.lines("tracks.jsonl").len();
    first.wait_until("the first run goes on", || playground.lines("tracks.jsonl").len() > before + 5);
}

#[test]
fn a_run_whose_reader_has_seen_enough_ends_well() {
    let playground = Playground::with_pipeline(TRACKING);
    let (run, mut output) = Started::piped(playground.command(&["run", "--quiet", "--set", "json.path=-"]));
    output.read_line(&mut String::new()).unwrap();
    drop(output);
    assert_eq!(run.wait().expect_code(0).stderr, "");
}

#[test]
fn pictures_show_the_depth_of_each_frame() {
    let pictures = r#"
[stage.pictures]
node   = "picture_sink"
input  = { topic = "objects", delivery = "lossless" }
inputs = { depth = "depth", ellipses = "ellipses" }
path   = "pictures/"
labels = false
legend = false
"#;
    let playground = Playground::with_pipeline(&format!("{TRACKING}{pictures}"));
    let ended = playground.conicflow(&["run", "--frames", "12"]).expect_code(0);
    let written: Vec<_> = (0..12).map(|number| format!("frame_{number:06}.png")).collect();
    let mut names: Vec<_> = fs::read_dir(playground.path("pictures")).unwrap().map(name).collect();
    names.sort();
    assert_eq!(names, written);
    ["depth", "ellipses", "objects"].iter().for_each(|topic| ended.expect_all(topic, "pictures", 12));
    for name in names {
        let shades = shades(&playground.path("pictures").join(&name));
        assert!(shades.len() > 64 * 48 / 2, "{name}: {} pixels with depth", shades.len());
        assert!(shades.iter().max() > shades.iter().min(), "{name}: all at one depth");
    }
}

fn name(entry: std::io::Result<fs::DirEntry>) -> String {
    entry.unwrap().file_name().into_string().unwrap()
}

/// The shades of a picture of 64x48 pixels, without pixels that were not measured or not painted.
fn shades(path: &Path) -> Vec<u8> {
    let (info, bytes) = read_png(path);
    assert_eq!((info.width, info.height, info.color_type), (64, 48, png::ColorType::Rgb));
    let pixels =
        bytes.chunks_exact(3).filter(|pixel| ![[0, 0, 0], [10, 13, 19]].contains(&[pixel[0], pixel[1], pixel[2]]));
    pixels.map(|pixel| pixel[0]).collect()
}

const WIDTH: u32 = 160;
const HEIGHT: u32 = 120;
const FOCAL: f64 = 150.0;
const METRES_PER_UNIT: f64 = 0.0005;
const RADIUS: f64 = 0.1;

/// Depth image of a ball of [`RADIUS`] before a wall. Its centre lies on the optical axis at `distance` metres.
fn ball(distance: f64) -> Vec<u16> {
    let pixel = |column: u32, row: u32| {
        let x = (f64::from(column) - f64::from(WIDTH - 1) / 2.0) / FOCAL;
        let y = (f64::from(row) - f64::from(HEIGHT - 1) / 2.0) / FOCAL;
        // The smaller z for which |z (x, y, 1) - (0, 0, distance)| is the radius.
        let squared = x * x + y * y + 1.0;
        let below_root = distance * distance - squared * (distance * distance - RADIUS * RADIUS);
        let z = if below_root < 0.0 { 1.5 } else { (distance - below_root.sqrt()) / squared };
        (z / METRES_PER_UNIT).round() as u16
    };
    (0..HEIGHT).flat_map(|row| (0..WIDTH).map(move |column| pixel(column, row))).collect()
}

/// A recording of a ball that comes nearer with each frame, with its camera.
fn recording(numbers: Range<u32>) -> Playground {
    let playground = Playground::with_pipeline(RECORDING);
    fs::create_dir(playground.path("frames")).unwrap();
    let (cx, cy) = (f64::from(WIDTH - 1) / 2.0, f64::from(HEIGHT - 1) / 2.0);
    let camera = serde_json::json!({
        "width": WIDTH, "height": HEIGHT, "fx": FOCAL, "fy": FOCAL, "cx": cx, "cy": cy, "depth_scale": METRES_PER_UNIT,
    });
    playground.write("frames/camera.json", &camera.to_string());
    for number in numbers {
        playground.write_depth_png(&format!("frames/img{number}.png"), WIDTH, &ball(distance(number)));
    }
    playground
}

fn distance(number: u32) -> f64 {
    1.0 - 0.02 * f64::from(number)
}

/// Asserts that the ball was found at its place in each of the frames with these numbers, and in no others.
fn expect_balls(playground: &Playground, numbers: &[u32]) {
    let lines = playground.json_lines("objects.jsonl");
    let sources: Vec<_> = lines.iter().map(|line| line["source"].as_str().unwrap().to_owned()).collect();
    assert_eq!(sources, numbers.iter().map(|number| format!("img{number}.png")).collect::<Vec<_>>());
    assert!(playground.sequences("objects.jsonl").into_iter().eq(0..numbers.len() as u64));
    for (line, &number) in lines.iter().zip(numbers) {
        let object = &line["objects"][0];
        let (z, radius) = (object["center"][2].as_f64().unwrap(), object["radius"].as_f64().unwrap());
        assert_eq!(object["kind"], "sphere", "{line}");
        assert!((z - distance(number)).abs() < 0.01 && (radius - RADIUS).abs() < 0.01, "frame {number}: {line}");
    }
}

#[test]
fn a_folder_of_pngs_is_played_in_natural_order_with_the_camera_beside_it() {
    let playground = recording(8..12);
    let ended = playground.conicflow(&["run"]).expect_code(0);
    expect_balls(&playground, &[8, 9, 10, 11]);
    ended.expect_texts(&["4 frames of 160x120, fx 150.00 fy 150.00 cx 79.50 cy 59.50"]);
}

#[test]
fn a_bad_frame_among_good_ones_is_passed_over_and_counted() {
    let playground = recording(0..6);
    playground.write("frames/img2.png", "this is no picture");
    let good = fs::read(playground.path("frames/img4.png")).unwrap();
    fs::write(playground.path("frames/img4.png"), &good[..good.len() / 2]).unwrap();
    let ended = playground.conicflow(&["run"]).expect_code(0);
    expect_balls(&playground, &[0, 1, 3, 5]);
    ended.expect_texts(&["source: frames unreadable: 2\n"]);
    for name in ["img2.png", "img4.png"] {
        assert!(
            ended.stderr.lines().any(|line| line.contains("passed over") && line.contains(name)),
            "{}",
            ended.stderr
        );
    }
}

#[test]
fn a_run_whose_recording_disappears_reports_how_much_was_read_and_fails() {
    let playground = recording(0..40);
    let mut run = playground.start(&["run", "--set", "source.rate_hz=20"]);
    run.wait_until("it delivers", || playground.lines("objects.jsonl").len() > 3);
    fs::remove_dir_all(playground.path("frames")).unwrap();
    let ended = run.wait().expect_code(1);
    let sent = ended.stage("source").messages;
    assert!((4..40).contains(&sent) && playground.lines("objects.jsonl").len() as u64 == sent, "{}", ended.stderr);
    let report = format!("{} of 40 frames could not be read any more when their turn came, {sent} were: `", 40 - sent);
    ended.expect_texts(&[&report, "No such file or directory", "not complete: a stage was lost"]);
}

#[test]
fn a_run_that_fails_before_its_first_line_leaves_the_lines_of_the_last_run() {
    let playground = recording(8..10);
    playground.conicflow(&["run"]).expect_code(0);
    let lines = playground.lines("objects.jsonl");
    assert_eq!(lines.len(), 2);
    playground.write(
        "pipeline.toml",
        r#"
        name = "fails"
        [stage.source]
        program = ["false"]
        output  = { topic = "objects", kind = "objects" }
        restart = "never"
        [stage.json]
        node  = "json_sink"
        input = "objects"
        path  = "objects.jsonl"
        "#,
    );
    let ended = playground.conicflow(&["run"]);
    assert_eq!(playground.lines("objects.jsonl"), lines, "{}", ended.stderr);
    ended.expect_texts(&["nothing came to be written: `", "objects.jsonl` still holds what an earlier run wrote"]);
}

#[test]
fn the_level_of_the_log_is_that_of_the_stages_as_well() {
    let playground = recording(8..10);
    let log = |level: &str| playground.conicflow(&["run", "--log", level]).expect_code(0).stderr;
    let (usual, all, faults) = (log("info"), log("debug"), log("error"));
    assert!(usual.contains("2 frames of 160x120") && !usual.contains("DEBUG"), "{usual}");
    assert!(all.contains("2 frames of 160x120"), "{all}");
    for frame in [0, 1] {
        let begins = format!("DEBUG stage `extractor`, frame {frame}: ");
        let reasons = all.lines().find_map(|line| line.trim_start().strip_prefix(begins.as_str()));
        let reasons = reasons.unwrap_or_else(|| panic!("{all}"));
        assert!(
            reasons
                .split(", ")
                .all(|part| part.rsplit_once(": ").is_some_and(|(_, count)| count.parse::<u64>().is_ok())),
            "{all}"
        );
    }
    assert!(!faults.contains("2 frames of 160x120"), "{faults}");
}

#[test]
fn a_run_that_finds_objects_lists_its_reasons_with_the_level_debug_alone() {
    let playground = Playground::with_pipeline(TRACKING);
    let reasons = |level: &str| {
        let ended = playground.conicflow(&["run", "--frames", "10", "--log", level]).expect_code(0);
        assert!(ended.stderr.contains("assembler found in 10 frames: "), "{}", ended.stderr);
        ended.stderr.lines().filter(|line| line.starts_with("  extractor: ")).count()
    };
    assert_eq!(["error", "info"].map(reasons), [0, 0]);
    assert!(reasons("debug") > 0);
}

#[test]
fn a_log_has_the_time_of_each_line_on_request() {
    let playground = recording(8..10);
    for (setting, is_timed) in [("1", true), ("", false)] {
        let output = playground.command(&["run"]).env("CONICFLOW_LOG_TIME", setting).output().unwrap();
        let stderr = String::from_utf8(output.stderr).unwrap();
        let line =
            stderr.lines().find(|line| line.contains("2 frames of 160x120")).unwrap_or_else(|| panic!("{stderr}"));
        let begin = line.split(" INFO").next().unwrap();
        assert_eq!(begin.len() > 20 && begin.starts_with("20") && begin.trim_end().ends_with('Z'), is_timed, "{line}");
    }
}
