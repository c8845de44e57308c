//! Full disks and unreadable files: the stage fails for good, with exit code 1 and one sentence that gives the reason.

use crate::processes::at_work;
use crate::support::{Ended, Playground, Started, TRACKING, read_png};
use conicflow_lab::simulator::scene::Scene;
use rustix::process::geteuid;
use std::fs;
use std::process::{Command, Stdio};

/// The camera of the frames that [`Playground::record`] writes.
const CAMERA: &str = "262.5,262.5,159.5,119.5";

/// Asserts that a run ended because of one stage, which reported the reason once and did not restart.
fn expect_failed_for_good(ended: Ended, stage: &str, why: &str) -> Ended {
    let ended = ended.expect_code(1);
    let errors = ended.stderr.lines().filter(|line| line.starts_with("error: ") && line.contains(why));
    assert_eq!(errors.count(), 1, "{}", ended.stderr);
    assert!(ended.stderr.contains(&format!("stage `{stage}` failed at the end of its work: see its error above")));
    assert!(!ended.stderr.contains("is started anew"), "{}", ended.stderr);
    ended.expect_texts(&["\nnot complete: a stage was lost, see above"]);
    ended
}

#[test]
fn lines_that_do_not_fit_on_the_disk_end_the_run() {
    let playground = Playground::with_pipeline(TRACKING);
    let ended = playground.conicflow(&["run", "--for", "10min", "--set", "json.path=/dev/full"]);
    let ended = expect_failed_for_good(ended, "json", "cannot write to `/dev/full`: No space left on device");
    ended.expect_texts(&["\n  hint: free some space, or write to another disk\n"]);
}

/// Runs [`TRACKING`] with a further sink, which writes to its own disk of this size. The files of that disk are in the folder
/// `left` afterwards. Without the right to create a disk, prints that the test is skipped, and returns `None`.
fn on_a_small_disk(size: &str, sink: &str) -> Option<(Playground, Ended)> {
    let playground = Playground::with_pipeline(&format!("{TRACKING}{sink}"));
    let ended = with_a_small_disk(size, &playground, &["run", "--for", "10min"])?;
    Some((playground, ended))
}

/// Runs `conicflow` with a disk of this size at the folder `disk`. Its files are in the folder `left` afterwards.
fn with_a_small_disk(size: &str, playground: &Playground, arguments: &[&str]) -> Option<Ended> {
    fs::create_dir(playground.path("disk")).unwrap();
    let script =
        format!("mount -t tmpfs -o size={size} tmpfs disk && {{ \"$@\"; code=$?; cp -a disk left; exit $code; }}");
    let inner = playground.command(arguments);
    let mut command = Command::new("unshare");
    command.args(["--mount", "sh", "-c", &script, "sh"]).arg(inner.get_program()).args(inner.get_args());
    command.current_dir(inner.get_current_dir().unwrap()).stdin(Stdio::null());
    command.env("CONICFLOW_RUNTIME_DIR", playground.runtime());
    let may_mount = || Command::new("unshare").args(["--mount", "mount", "-t", "tmpfs", "tmpfs", "/mnt"]).status();
    if !geteuid().is_root() || !may_mount().is_ok_and(|status| status.success()) {
        eprintln!("SKIPPED: a small disk of one's own needs root and `unshare`; nothing was shown");
        return None;
    }
    Some(Started::new(command).wait())
}

#[test]
fn a_full_disk_holds_only_whole_lines() {
    let playground = Playground::with_pipeline(TRACKING);
    let arguments = ["run", "--for", "10min", "--set", "json.path=disk/tracks.jsonl"];
    let Some(ended) = with_a_small_disk("64k", &playground, &arguments) else { return };
    let ended = expect_failed_for_good(ended, "json", "No space left on device");
    ended.expect_texts(&[": cannot write to `", "\n  hint: free some space, or write to another disk\n"]);
    assert!(playground.json_lines("left/tracks.jsonl").len() > 10);
    assert!(fs::read_to_string(playground.path("left/tracks.jsonl")).unwrap().ends_with("}\n"));
}

fn names(playground: &Playground) -> Vec<String> {
    let entries = fs::read_dir(playground.path("left")).unwrap();
    entries.map(|entry| entry.unwrap().file_name().into_string().unwrap()).collect()
}

#[test]
fn pictures_that_do_not_fit_on_the_disk_end_the_run_and_earlier_ones_are_whole() {
    let sink = r#"
[stage]
pictures = { node = "picture_sink", input = { topic = "tracks", delivery = "lossless" }, inputs = { depth = "depth" }, path = "disk" }
"#;
    let Some((playground, ended)) = on_a_small_disk("256k", sink) else { return };
    let ended = expect_failed_for_good(ended, "pictures", "cannot be written: No space left on device");
    ended.expect_texts(&["\n  hint: free some space, or write to another disk\n"]);
    let names = names(&playground);
    assert!(!names.is_empty());
    for name in names {
        assert!(name.ends_with(".png"), "{name} is left behind");
        read_png(&playground.path("left").join(&name));
    }
}

#[test]
fn a_recording_that_does_not_fit_on_the_disk_ends_the_run_and_keeps_earlier_messages() {
    let sink = r#"
[stage]
recorder = { node = "mcap_sink", input = { topic = "tracks", delivery = "lossless" }, inputs = { depth = "depth" }, path = "disk/run.mcap" }
"#;
    let Some((playground, ended)) = on_a_small_disk("2m", sink) else { return };
    expect_failed_for_good(ended, "recorder", "No space left on device");
    assert_eq!(names(&playground), ["run.mcap"]);
    let found = playground.conicflow(&["detect", "left/run.mcap", "--out", "found.jsonl"]).expect_code(0);
    assert!(!playground.lines("found.jsonl").is_empty(), "{}", found.stderr);
}

#[test]
fn the_record_command_reports_a_full_disk_and_the_run_goes_on() {
    let (playground, mut run) = at_work(TRACKING, 60);
    let arguments = ["record", "-o", "disk/run.mcap"];
    let Some(recorded) = with_a_small_disk("1m", &playground, &arguments) else { return };
    let recorded = recorded.expect_code(1);
    let errors = recorded.stderr.lines().filter(|line| line.starts_with("error: ") && line.contains("No space left"));
    assert_eq!(errors.count(), 1, "{}", recorded.stderr);
    let at = playground.newest("tracks.jsonl");
    run.wait_until("the run goes on", || playground.newest("tracks.jsonl") > at + 60);
    let found = playground.conicflow(&["detect", "left/run.mcap", "--out", "found.jsonl"]).expect_code(0);
    assert!(!playground.lines("found.jsonl").is_empty(), "{}", found.stderr);
}

/// Runs `detect` on the folder `frames` with these arguments, with a limit for the size of files, in blocks of 512 bytes.
fn detect_in_small_files(playground: &Playground, blocks: u32, arguments: &[&str]) -> Ended {
    let inner = playground.command(&[&["detect", "frames", "--camera", CAMERA], arguments].concat());
    let mut command = Command::new("sh");
    command
        .args(["-c", "ulimit -f $0; exec \"$@\"", &blocks.to_string()])
        .arg(inner.get_program())
        .args(inner.get_args());
    // Standard error is a pipe: a file of the test would exceed the limit, too, and end the program.
    command.current_dir(inner.get_current_dir().unwrap()).stdin(Stdio::null()).stderr(Stdio::piped());
    let output = command.stdout(Stdio::piped()).output().unwrap();
    let text = |bytes: &[u8]| String::from_utf8_lossy(bytes).into_owned();
    Ended { code: output.status.code(), stdout: text(&output.stdout), stderr: text(&output.stderr) }
}

/// Asserts that a program ended with exit code 1 and printed one sentence that gives the reason, with a hint.
fn expect_reported_once(ended: Ended, why: &str, hint: &str) {
    let ended = ended.expect_code(1);
    let reports = ended.stderr.lines().filter(|line| line.contains(why));
    assert_eq!(reports.count(), 1, "{}", ended.stderr);
    ended.expect_texts(&[&format!("\n  hint: {hint}")]);
}

#[test]
fn detect_reports_a_full_disk_and_leaves_no_incomplete_file() {
    let playground = Playground::new();
    playground.record(Scene::built_in("tabletop").unwrap().unwrap(), 1, 4);
    let found = playground.conicflow(&["detect", "frames", "--camera", CAMERA]).expect_code(0).stdout;
    let free = "free some space, or write to another disk";
    let full = playground.conicflow(&["detect", "frames", "--camera", CAMERA, "--out", "/dev/full"]);
    expect_reported_once(full, "error: cannot write to `/dev/full`: No space left on device", free);

    // The limit leaves room for two lines and a part of the third.
    let ends: Vec<_> = found.match_indices('\n').map(|(at, _)| at + 1).collect();
    let blocks = (ends[1] as u32 + 1).div_ceil(512);
    assert!(ends[2] > 512 * blocks as usize, "the third line goes beyond");
    let limited = detect_in_small_files(&playground, blocks, &["--out", "found.jsonl"]);
    let raise = "raise the limit of a file's size (`ulimit -f`), or write less";
    expect_reported_once(limited, "error: cannot write to `found.jsonl`: File too large", raise);
    let left = fs::read_to_string(playground.path("found.jsonl")).unwrap();
    assert_eq!((left.lines().count(), left.ends_with('\n')), (2, true), "{left}");

    for arguments in [["--moving", "small/moving.png"], ["--pictures", "small"]] {
        fs::create_dir_all(playground.path("small")).unwrap();
        let limited = detect_in_small_files(&playground, 8, &arguments);
        expect_reported_once(limited, "cannot be written: File too large", raise);
        assert_eq!(fs::read_dir(playground.path("small")).unwrap().count(), 0, "{arguments:?}: something is left");
    }
}

#[test]
fn a_comparison_reports_that_its_pictures_do_not_fit_on_the_disk() {
    let playground = Playground::with_pipeline(TRACKING);
    let compare = ["compare", "--frames", "3", "--b", "extractor.scan=rows", "--pictures", "disk"];
    let Some(ended) = with_a_small_disk("12k", &playground, &compare) else { return };
    expect_reported_once(ended, "No space left on device", "free some space, or write to another disk");
    assert!(names(&playground).iter().all(|name| name.ends_with(".png")), "{:?}", names(&playground));
}

#[test]
fn a_recording_of_which_no_frame_can_be_read_ends_the_run_at_once() {
    let playground = Playground::with_pipeline(crate::support::RECORDING);
    playground.record(Scene::built_in("tabletop").unwrap().unwrap(), 1, 3);
    for number in 0..3 {
        let path = playground.path(&format!("frames/{number}.png"));
        let bytes = fs::read(&path).unwrap();
        fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    }
    let camera = "source.intrinsics={ fx = 300, fy = 300, cx = 159.5, cy = 119.5 }";
    let ended = playground.conicflow(&["run", "--for", "10min", "--set", camera]);
    expect_failed_for_good(ended, "source", "none of the 3 frames can be read; the last: ");
}

#[test]
fn text_from_files_is_escaped_and_shortened_for_a_terminal() {
    let playground = Playground::new();
    fs::create_dir_all(playground.path("frames/depth")).unwrap();
    let long = "x".repeat(20_000_000);
    playground.write("frames/depth.txt", &format!("1.0 \u{1b}[2J\u{9b}31m{long}\nERROR forged\n"));
    let ended = playground.conicflow(&["detect", "frames", "--camera", "300,300,159.5,119.5"]);
    assert!(ended.code != Some(0) && !ended.stderr.contains(['\u{1b}', '\u{9b}']), "{}", &ended.stderr[..2000]);
    assert!(ended.stderr.len() < 5000, "{} bytes", ended.stderr.len());
    assert!(!ended.stderr.lines().any(|line| line.starts_with("ERROR forged")), "{}", ended.stderr);
    playground.write("long.toml", &format!("name = \"a\"\n{long} \u{1b}[31m = 3\n"));
    let ended = playground.conicflow(&["validate", "long.toml"]).expect_code(2);
    assert!(ended.stderr.len() < 5000, "{} bytes", ended.stderr.len());
    let name = "frames/a\nERROR forged\u{1b}[31m.png";
    let ended = playground.conicflow(&["detect", name, "--camera", "300,300,159.5,119.5"]);
    assert!(ended.code != Some(0) && !ended.stderr.contains('\u{1b}'), "{}", ended.stderr);
    assert!(!ended.stderr.lines().any(|line| line.starts_with("ERROR forged")), "{}", ended.stderr);
}
