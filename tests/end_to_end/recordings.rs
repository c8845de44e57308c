//! Recordings: the replay of a recording gives the same bits from any stage on, also if the recorder was killed; an onlooker that
//! records does not affect the run; other programs can read the recordings, and `conicflow` can read theirs.

use crate::bridge::without_times;
use crate::processes::{at_work, stages_of, wait_for_lines};
use crate::support::{Playground, Started, TRACKING, TRIES, python_with, read_png, signal, wait_until};
use rustix::process::Signal;
use serde_json::Value as Json;
use std::collections::HashSet;
use std::fs;
use std::path::Path;
use std::process::Command;
use std::time::{Duration, Instant};

/// Number of frames of the runs.
const FRAMES: &str = "60";

/// A run that records all its topics, and writes the tracks as lines.
fn recording() -> String {
    format!(
        r#"{TRACKING}
[stage]
objects_json = {{ node = "json_sink", input = {{ topic = "objects", delivery = "lossless" }}, path = "objects.jsonl" }}

[stage.recorder]
node   = "mcap_sink"
input  = {{ topic = "tracks", delivery = "lossless" }}
inputs = {{ depth = "depth", ellipses = "ellipses", objects = "objects" }}
path   = "run.mcap"
"#
    )
}

/// Replaces the camera of a pipeline by a recording.
fn replay(text: &str) -> String {
    let (before, after) = text.split_once("[stage.source]").unwrap();
    let rest = after.split_once("[stage.extractor]").unwrap().1;
    let source = "node = \"mcap_source\"\noutput = \"depth\"\npath = \"run.mcap\"\nrate_hz = 0\n";
    format!("{before}[stage.source]\n{source}\n[stage.extractor]{rest}")
}

/// The stages after the extractor, with recorded ellipses as their input.
const FROM_ELLIPSES: &str = r#"
name = "again"

[stage]
replay    = { node = "mcap_source", output = "ellipses", path = "run.mcap", rate_hz = 0 }
assembler = { node = "object_assembler", input = { topic = "ellipses", delivery = "lossless" }, output = "objects" }
json      = { node = "json_sink", input = { topic = "objects", delivery = "lossless" }, path = "again.jsonl" }
"#;

#[test]
fn a_recorded_run_is_replayed_bit_for_bit_from_any_stage_on() {
    let playground = Playground::with_pipeline(&recording());
    playground.conicflow(&["run", "--frames", FRAMES]).expect_code(0);
    let (objects, tracks) = (without_times(&playground, "objects.jsonl"), without_times(&playground, "tracks.jsonl"));
    assert_eq!((objects.len(), tracks.len()), (60, 60));
    assert!(objects.iter().filter(|line| !line["objects"].as_array().unwrap().is_empty()).count() > 30, "{objects:?}");

    let again = replay(TRACKING).replace("tracks.jsonl", "again.jsonl");
    playground.write("replay.toml", &again);
    let ended = playground.conicflow(&["run", "replay.toml"]).expect_code(0);
    assert_eq!(ended.stage("source").messages, 60);
    assert_eq!(without_times(&playground, "again.jsonl"), tracks);

    playground.write("ellipses.toml", FROM_ELLIPSES);
    playground.conicflow(&["run", "ellipses.toml"]).expect_code(0);
    assert_eq!(without_times(&playground, "again.jsonl"), objects);

    playground.conicflow(&["detect", "run.mcap", "--out", "detected.jsonl"]).expect_code(0);
    assert_eq!(without_times(&playground, "detected.jsonl"), objects);
}

#[test]
fn the_recording_of_a_killed_recorder_is_replayed() {
    let playground = Playground::with_pipeline(&recording());
    let run = playground.start(&["run", "--set", "source.rate_hz=100", "--set", "recorder.split_s=1000"]);
    let size = || fs::metadata(playground.path("run.mcap")).map_or(0, |about| about.len());
    // A chunk is written when it is full, or after a second.
    wait_until("some of it is in the file", || size() > 50_000);
    signal(stages_of(run.id())["recorder"], Signal::KILL);
    // The recorder restarts, and writes another file beside the first.
    wait_until("it records again", || playground.path("run_1.mcap").exists());
    signal(run.id(), Signal::INT);
    run.wait();
    playground.write("replay.toml", &replay(TRACKING).replace("tracks.jsonl", "again.jsonl"));
    let ended = playground.conicflow(&["run", "replay.toml"]).expect_code(0);
    let (tracks, again) = (without_times(&playground, "tracks.jsonl"), without_times(&playground, "again.jsonl"));
    assert!(!again.is_empty() && !tracks.is_empty(), "{}", ended.stderr);
    let both = again.len().min(tracks.len());
    assert_eq!(again[..both], tracks[..both]);
    ended.expect_texts(&["ends in the middle: its first "]);
}

#[test]
fn a_recording_without_an_index_may_begin_with_many_unused_messages() {
    let playground = Playground::with_pipeline(&recording());
    playground.conicflow(&["run", "--quiet", "--frames", FRAMES]).expect_code(0);
    let recorded = fs::read(playground.path("run.mcap")).unwrap();
    let record = |opcode: u8, parts: &[&[u8]]| {
        let content = parts.concat();
        [&[opcode][..], &(content.len() as u64).to_le_bytes(), &content].concat()
    };
    // A channel without a schema, and a message of this channel: channel number, sequence number, two times and eight bytes of
    // content.
    let channel = record(4, &[&u16::MAX.to_le_bytes(), &[0; 2], &[1, 0, 0, 0, b'x'], &[0; 4], &[0; 4]]);
    let message = record(5, &[&u16::MAX.to_le_bytes(), &[0; 4 + 8 + 8 + 8]]);
    // The messages follow directly after the header. The last eight bytes of the file are missing, so that its index is not used.
    let header = 8 + 9 + u64::from_le_bytes(recorded[9..17].try_into().unwrap()) as usize;
    let (before, after) = recorded[..recorded.len() - 8].split_at(header);
    let patient = "rate_hz = 0\nrestart = { when = \"on_failure\", hang_s = 1 }\n";
    let text = replay(TRACKING).replacen("rate_hz = 0\n", patient, 1).replace("tracks.jsonl", "again.jsonl");
    playground.write("replay.toml", &text);
    let mut many = 500_000;
    let comes_through = |_| {
        fs::remove_file(playground.path("again.jsonl")).ok();
        fs::write(playground.path("run.mcap"), [before, &channel, &message.repeat(many), after].concat()).unwrap();
        let begun = Instant::now();
        let ended = playground.conicflow(&["run", "replay.toml"]).expect_code(0);
        if begun.elapsed() < Duration::from_secs(2) {
            // The source has read the recording so fast that it would not have been killed as hanging. The next recording is
            // twice as long.
            many *= 2;
            return false;
        }
        assert_eq!(without_times(&playground, "again.jsonl"), without_times(&playground, "tracks.jsonl"));
        eprintln!("{}", ended.stderr);
        ended.stage("source").starts == 1
    };
    assert!((0..TRIES).any(comes_through), "it is started anew each time, or the last {many} were read at once");
}

#[test]
fn a_recorder_that_is_replaced_leaves_two_recordings_and_no_empty_file() {
    let playground = Playground::with_pipeline(&recording());
    let mut run = playground.start(&["run", "--set", "source.rate_hz=100"]);
    wait_for_lines(&mut run, &playground);
    playground.conicflow(&["swap", "recorder"]).expect_code(0);
    wait_for_lines(&mut run, &playground);
    run.end();
    let entries = fs::read_dir(playground.path("")).unwrap().map(|entry| entry.unwrap().file_name());
    let mut files: Vec<_> = entries.map(|name| name.into_string().unwrap()).collect();
    files.retain(|name| name.ends_with(".mcap"));
    files.sort();
    assert_eq!(files, ["run.mcap", "run_1.mcap"]);
    for file in files {
        assert!(fs::metadata(playground.path(&file)).unwrap().len() > 10_000, "`{file}` has messages in it");
    }
}

/// Existing files do not change.
#[test]
fn a_recording_that_begins_with_a_swap_has_its_own_path_and_continues_no_other_file() {
    let playground = Playground::with_pipeline(TRACKING);
    playground.write("earlier.jsonl", "{\"sequence\": 7}\n");
    let mut run = playground.start(&["run", "--set", "source.rate_hz=100"]);
    wait_for_lines(&mut run, &playground);
    let swap = ["swap", "json", "--set"];
    let refused = playground.conicflow(&[&swap[..], &["path=earlier.jsonl"]].concat()).expect_code(2);
    refused.expect_texts(&["would go on with", "earlier.jsonl`, which is there already\n  hint: name another file"]);
    playground.conicflow(&[&swap[..], &["path=run.mcap", "--node", "mcap_sink"]].concat()).expect_code(0);
    run.wait_until("it is recorded", || {
        fs::metadata(playground.path("run.mcap")).is_ok_and(|about| about.len() > 10_000)
    });
    run.end();
    assert!(!playground.path("run_1.mcap").exists());
    assert_eq!(playground.lines("earlier.jsonl").len(), 1);
}

#[test]
fn the_record_command_ends_at_its_size_limit() {
    let (playground, run) = at_work(TRACKING, 500);
    let recorded = playground.conicflow(&["record", "-o", "part.mcap", "--limit-mb", "1"]).expect_code(0);
    recorded.expect_texts(&["the recording has reached `--limit-mb`: no more is recorded", "recorded 1."]);
    run.end();
}

#[test]
fn the_record_command_records_a_running_pipeline_until_it_ends() {
    // The rate is low, because an onlooker records only the messages for which it has time, and the machine may be busy.
    let (playground, mut run) = at_work(TRACKING, 25);
    let mut recorder = playground.start(&["record", "depth", "objects", "depth", "-o", "part.mcap"]);
    recorder.wait_for_text("records `depth`, `objects` into `part.mcap`");
    let refused = playground.conicflow(&["record", "-o", "part.mcap"]).expect_code(2);
    refused.expect_texts(&["`part.mcap` is there already\n  hint: "]);
    let unnamed = playground.conicflow(&["record", "-o", "other.txt"]).expect_code(2);
    unnamed.expect_texts(&["`other.txt` does not end with `.mcap`", "hint: name it `other.mcap`"]);
    let unknown = playground.conicflow(&["record", "object", "-o", "other.mcap"]).expect_code(2);
    unknown.expect_texts(&["has no topic `object`\n  hint: did you mean `objects`?"]);
    let newest = playground.newest("tracks.jsonl");
    run.wait_until("frames pass", || playground.newest("tracks.jsonl") > newest + 100);
    let made = run.end().stage("source").messages;
    let log = recorder.wait().expect_code(0).stderr;
    assert!(log.contains("recorded ") && log.contains("MB: depth "), "{log}");
    // The log contains the number of recorded messages, and in brackets the number of messages for which the recorder had no
    // time.
    let (_, objects) = log.rsplit_once(", objects ").unwrap();
    let numbers = objects
        .lines()
        .next()
        .unwrap()
        .split(|c: char| !c.is_ascii_digit())
        .filter_map(|number| number.parse::<usize>().ok());
    let numbers: Vec<_> = numbers.take(2).collect();
    assert!(numbers.iter().sum::<usize>() > 50, "{log}");

    // The recording begins in the middle of the run, and has the run's frame numbers.
    let part = FROM_ELLIPSES.lines().filter(|line| !line.starts_with("assembler")).collect::<Vec<_>>().join("\n");
    let part = part.replace("run.mcap", "part.mcap");
    let part = part.replace("output = \"ellipses\"", "output = { topic = \"objects\", kind = \"objects\" }");
    playground.write("part.toml", &part);
    playground.conicflow(&["run", "part.toml"]).expect_code(0);
    let sequences = playground.sequences("again.jsonl");
    assert!(sequences.len() == numbers[0] && sequences.len() > 1 && sequences[0] > 0, "{log}: {sequences:?}");
    assert!(sequences.is_sorted() && *sequences.last().unwrap() < made, "{sequences:?}");
}

#[test]
fn recordings_that_cannot_be_replayed_are_reported() {
    let playground = Playground::with_pipeline(&replay(TRACKING));
    let none = playground.conicflow(&["validate"]).expect_code(2);
    none.expect_texts(&["run.mcap` does not exist"]);
    playground.write("run.mcap", "this is no recording, for all its name says");
    let wrong = playground.conicflow(&["run"]).expect_code(1);
    wrong.expect_texts(&["run.mcap", "hint: "]);
    playground.write("old.bag", "#ROSBAG V2.0\n");
    let bag = playground.conicflow(&["detect", "old.bag"]).expect_code(2);
    let command = "hint: pip install rosbags && rosbags-convert --src 'old.bag' --dst 'old' --dst-storage mcap";
    bag.expect_texts(&[command]);
    // A path relative to the folder of the bag does not contain the name of the bag.
    playground.write("bag_0.db3", "SQLite format 3");
    let folder = playground.path(".").canonicalize().unwrap();
    let to = format!("rosbags-convert --src '.' --dst '{}.mcap' --dst-storage mcap", folder.display());
    playground.conicflow(&["detect", "bag_0.db3"]).expect_code(2).expect_texts(&[&to]);
}

/// A Python with `rosbags`, `mcap` and `mcap-ros2-support`. Without one, prints that the test is skipped, and returns `None`.
fn other_programs() -> Option<String> {
    let lacks = "has no rosbags, mcap and mcap-ros2-support; recordings were not exchanged with other programs";
    python_with("mcap.reader, mcap_ros2.decoder, rosbags", lacks)
}

/// Output of `recordings.py`.
fn script(python: &str, arguments: &[&Path]) -> String {
    let mut command = Command::new(python);
    let (mode, files) = arguments.split_first().unwrap();
    command.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/end_to_end/recordings.py")).arg(mode).args(files);
    Started::new(command).wait().expect_code(0).stdout
}

/// Exit code of `timeout` if the program did not end in time, and SIGTERM ended it, so that SIGKILL was not needed.
const TIMED_OUT: i32 = 124;
/// A screenshot that shows the depth image has more than this number of colours, because the window around the image is grey.
const COLOURS: usize = 1000;

#[test]
fn other_programs_read_recordings() {
    let Some(python) = other_programs() else { return };
    // The images are wide, so that objects of all three kinds are found.
    let wide = recording().replace("width      = 64\nheight     = 48", "width      = 320\nheight     = 240");
    let playground = Playground::with_pipeline(&wide.replace("intrinsics = {", "# {"));
    playground.conicflow(&["run", "--frames", "30"]).expect_code(0);
    let kinds = playground.lines("tracks.jsonl").last().cloned().unwrap();
    assert!(["sphere", "cylinder", "cone"].iter().all(|kind| kinds.contains(kind)), "{kinds}");
    let (run, lines) = (playground.path("run.mcap"), playground.path("tracks.jsonl"));
    let printed = script(&python, &[Path::new("read"), &run, &lines]);
    assert!(printed.contains("30 frames, "), "{printed}");
    let rerun = Path::new(&python).with_file_name("rerun");
    if !rerun.is_file() {
        eprintln!("SKIPPED: there is no `rerun` beside `{python}`; its check of recordings was not run");
        return;
    }
    let rerun = |arguments: &[&str]| {
        let mut command = Command::new("timeout");
        command
            .args(["--kill-after=5", "40"])
            .arg(&rerun)
            .args(arguments)
            .current_dir(playground.path("."))
            .env("HOME", playground.path("."));
        Started::new(command).wait()
    };
    let checked = rerun(&["mcap", "check", "run.mcap"]).expect_code(0).stdout;
    let channels: Vec<_> = checked.lines().filter(|line| line.contains("/source/")).collect();
    assert!(channels.len() > 10 && channels.iter().all(|line| line.trim_start().starts_with("ok")), "{checked}");
    let shown = ["run.mcap", "--headless", "--bind", "127.0.0.1", "--port", "0", "--window-size", "800x500"];
    let mut most = None;
    // On a busy machine Rerun may take the screenshot before it has read the file. It may also give up a screenshot that takes
    // more than ten seconds, and then it does not end.
    for _ in 0..5 {
        let shot = rerun(&[&shown[..], &["--screenshot-to", "shot.png"]].concat());
        if shot.stderr.contains("No graphics adapter") {
            eprintln!(
                "SKIPPED: Rerun has no graphics card here, not even one of software; what it draws was not shown"
            );
            return;
        }
        if matches!(shot.code, None | Some(TIMED_OUT)) {
            continue;
        }
        let log = shot.expect_code(0).stderr;
        let warned = log.lines().filter(|line| line.contains("does not specify a schema"));
        assert_eq!(warned.count(), 0, "{log}");
        let (info, pixels) = read_png(&playground.path("shot.png"));
        most = most.max(Some(pixels.chunks_exact(info.color_type.samples()).collect::<HashSet<_>>().len()));
        if most > Some(COLOURS) {
            break;
        }
    }
    let Some(most) = most else {
        eprintln!("SKIPPED: this machine is too busy for Rerun to draw by software; what it draws was not shown");
        return;
    };
    eprintln!("Rerun draws in {most} colours");
    assert!(most > COLOURS, "{most} colours");
    if let Ok(folder) = std::env::var("CONICFLOW_PICTURES") {
        fs::copy(playground.path("shot.png"), format!("{folder}/rerun.png")).unwrap();
    }
}

/// The objects of each frame, and their stamps.
fn detected(playground: &Playground, path: &str) -> (Vec<Json>, Vec<u64>) {
    let ended = playground.conicflow(&["detect", path]).expect_code(0);
    let lines: Vec<Json> = ended.stdout.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let objects = lines.iter().map(|line| line["objects"].clone()).collect();
    (objects, lines.iter().map(|line| line["stamp_ns"].as_u64().unwrap()).collect())
}

#[test]
fn recordings_of_other_programs_are_read_in_every_encoding() {
    let Some(python) = other_programs() else { return };
    let playground = Playground::new();
    script(&python, &[Path::new("write"), &playground.path("others")]);
    let (expected, _) = detected(&playground, "others/frames");
    assert!(expected.len() == 4 && expected.iter().all(|objects| objects[0]["kind"] == "sphere"), "{expected:?}");
    let stamps: Vec<u64> = (0..4).map(|number| 1_700_000_000_000_000_000 + number * 100_000_000).collect();
    let names = fs::read_dir(playground.path("others")).unwrap();
    let names: Vec<_> = names.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect();
    let begins = |begin: &'static str| names.iter().filter(move |name| name.starts_with(begin));
    assert_eq!((begins("same").count(), begins("near").count(), begins("old").count()), (7, 4, 2), "{names:?}");
    for name in begins("same") {
        let (objects, stamped) = detected(&playground, &format!("others/{name}"));
        assert_eq!((objects, stamped), (expected.clone(), stamps.clone()), "{name}");
    }
    for name in begins("near") {
        let (objects, stamped) = detected(&playground, &format!("others/{name}"));
        assert_eq!((objects.len(), stamped), (4, stamps.clone()), "{name}");
        for (objects, expected) in objects.iter().zip(&expected) {
            let number = |objects: &Json, key: &str| objects[0].pointer(key).and_then(Json::as_f64).unwrap();
            let off = |key: &str| (number(objects, key) - number(expected, key)).abs();
            let worst = ["/center/0", "/center/1", "/center/2", "/radius"].map(off).into_iter().fold(0.0, f64::max);
            assert!(objects.as_array().unwrap().len() == 1 && worst < 1e-3, "{name}: {worst} m off: {objects}");
        }
    }
    for name in begins("old") {
        // The error contains the command that converts the recording; the test runs this command.
        let refused = playground.conicflow(&["detect", &format!("others/{name}")]).expect_code(2).stderr;
        let command = refused.split_once("pip install rosbags && ").unwrap().1.lines().next().unwrap();
        let into = command.split_once("--dst '").unwrap().1.split('\'').next().unwrap();
        let mut shell = Command::new("sh");
        let programs = Path::new(&python).parent().unwrap().display();
        shell.args(["-c", &format!("PATH='{programs}':\"$PATH\"; {command}")]).current_dir(playground.path("."));
        Started::new(shell).wait().expect_code(0);
        assert_eq!(detected(&playground, into), (expected.clone(), stamps.clone()), "{name}");
    }
}
