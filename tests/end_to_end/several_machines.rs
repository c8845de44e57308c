//! More than one edge between two machines: in both directions, three machines, and several pipelines. The results are the same
//! as on one machine to the bit.

use super::bridge::{
    HALVES, LIVE_RATE_HZ, apart, joined, link, loopback, machines, newest, placed, start, tracks, wait_for_frames,
    without_times,
};
use super::support::{Playground, Started, TRACKING, signal, wait_until};
use rustix::process::Signal;
use serde_json::Value as Json;

/// [`TRACKING`] with this number of frames.
fn finite(frames: u32) -> String {
    TRACKING.replace("rate_hz    = 0", &format!("rate_hz    = 0\nframes     = {frames}"))
}

/// Runs the pipeline on one machine. Returns the results in these files.
fn alone<const N: usize>(text: &str, files: [&str; N]) -> [Vec<Json>; N] {
    let playground = Playground::with_pipeline(text);
    playground.conicflow(&["run"]).expect_code(0);
    files.map(|file| without_times(&playground, file))
}

/// Runs the pipeline on all machines, and waits until all runs have ended.
fn run_on<const N: usize>(text: &str, names: [&str; N]) -> [Playground; N] {
    let machines = names.map(|_| Playground::with_pipeline(text));
    let runs: Vec<_> = machines.iter().zip(names).map(|(machine, name)| start(machine, name)).collect();
    runs.into_iter().for_each(|run| drop(run.wait().expect_code(0)));
    machines.iter().for_each(|machine| assert!(machine.processes().is_empty()));
    machines
}

#[test]
fn every_hop_may_cross_there_and_back() {
    let text = finite(80);
    let [expected] = alone(&text, ["tracks.jsonl"]);
    assert_eq!(expected.len(), 80);
    let places =
        [("source", "robot"), ("extractor", "base"), ("assembler", "robot"), ("tracker", "base"), ("json", "robot")];
    let endpoint = loopback();
    let [robot, _] = run_on(&joined(&text, &places, &endpoint, &endpoint), ["robot", "base"]);
    assert!(without_times(&robot, "tracks.jsonl") == expected);
}

#[test]
fn three_machines_share_topics_pair_by_pair() {
    let more = r#"
[stage.again]
node   = "row_ellipse_extractor"
input  = { topic = "depth", delivery = "lossless", compression = "lz4" }
output = "found_again"

[stage.ellipses]
node  = "json_sink"
input = { topic = "found_again", delivery = "lossless" }
path  = "ellipses.jsonl"
"#;
    let text = finite(80) + more;
    let files = ["tracks.jsonl", "ellipses.jsonl"];
    let expected = alone(&text, files);
    let places = [
        ("source", "robot"),
        ("extractor", "base"),
        ("assembler", "desk"),
        ("tracker", "desk"),
        ("json", "desk"),
        ("again", "desk"),
        ("ellipses", "desk"),
    ];
    let (robot, base) = (loopback(), loopback());
    let ends = format!(
        "\n[machine.robot]\nlisten = [\"{robot}\"]\n[machine.base]\nlisten = [\"{base}\"]\nconnect = [\"{robot}\"]\n\
         [machine.desk]\nconnect = [\"{robot}\", \"{base}\"]\n"
    );
    let [_, _, desk] = run_on(&(placed(&text, &places) + &ends), ["robot", "base", "desk"]);
    assert!(files.map(|file| without_times(&desk, file)) == expected);
}

#[test]
fn pipelines_beside_each_other_on_the_same_machines_do_not_meet() {
    // The rate is so low that both pipelines run on both machines at the same time.
    let paced = |frames| finite(frames).replace("rate_hz    = 0", "rate_hz    = 20");
    let other = paced(30).replace("\"tracking\"", "\"other\"").replace("width", "seed = 7\nwidth");
    let texts = [paced(40), other.replace("tracks.jsonl", "other.jsonl")];
    let expected = [alone(&texts[0], ["tracks.jsonl"]), alone(&texts[1], ["other.jsonl"])];
    assert_ne!(expected[0][0][..30], expected[1][0]);
    let endpoints = [loopback(), loopback()];
    let [robot, base] = [Playground::new(), Playground::new()];
    let mut runs = Vec::new();
    for (text, own) in texts.iter().zip(&endpoints) {
        // Both sessions of the base connect to both sessions of the robot, so that only the keys distinguish the pipelines.
        let ends = format!("\n[machine.robot]\nlisten = [\"{own}\"]\n[machine.base]\nconnect = {endpoints:?}\n");
        let file = format!("{}.toml", runs.len());
        for (machine, name) in [(&robot, "robot"), (&base, "base")] {
            machine.write(&file, &(placed(text, &HALVES) + &ends));
            runs.push(machine.start(&["run", &file, "--machine", name]));
        }
    }
    runs.into_iter().for_each(|run| drop(run.wait().expect_code(0)));
    assert!(["tracks.jsonl", "other.jsonl"].map(|file| [without_times(&base, file)]) == expected);
}

#[test]
fn files_and_programs_of_other_machines_need_not_exist_on_this_one() {
    const TEXT: &str = r#"
name = "apart"

[machine]
robot = { zenoh = "robot.json5" }
base  = { zenoh = "base.json5" }

[stage]
source    = { machine = "robot", node = "image_source", path = "frames/", output = "depth" }
own       = { machine = "robot", program = ["./own"], input = "depth" }
extractor = { machine = "base", node = "row_ellipse_extractor", input = "depth", output = "ellipses" }
json      = { machine = "base", node = "json_sink", input = "ellipses", path = "." }
"#;
    let playground = Playground::with_pipeline(TEXT);
    let faults = |arguments: &[&str]| {
        let stderr = playground.conicflow(arguments).expect_code(2).stderr;
        ["robot.json5", "frames", "own", "base.json5", "is a folder"]
            .map(|file| stderr.lines().any(|line| line.starts_with("error") && line.contains(file)))
    };
    assert_eq!(faults(&["validate"]), [true; 5]);
    for command in ["run", "validate", "graph", "doctor"] {
        assert_eq!(faults(&[command, "--machine", "robot"]), [true, true, true, false, false], "{command}");
        assert_eq!(faults(&[command, "--machine", "base"]), [false, false, false, true, true], "{command}");
    }
}

#[test]
fn the_pipeline_for_two_machines_runs_as_the_readme_says() {
    const TEXT: &str = include_str!("../../pipeline.two-machines.toml");
    let port = loopback().rsplit(':').next().unwrap().to_owned();
    // The port is replaced, because another test may use the port of the file.
    let [robot, base] = machines(&TEXT.replace("7447", &port));
    robot.conicflow(&["validate"]).expect_code(0);
    let smaller = ["--set", "source.width=160", "--set", "source.height=120"];
    let shorter = ["--set", "console.period_s=0.1"];
    let base_run = base.start(&[&["run", "--machine", "base"], &shorter[..]].concat());
    let runs = [robot.start(&[&["run", "--machine", "robot", "--frames", "60"], &smaller[..]].concat()), base_run];
    let [robot_ended, base_ended] = runs.map(|run| run.wait().expect_code(0));
    let [sent, lost, _] = link(&robot_ended, "base", "ellipses");
    assert!(sent > 20 && lost == 0, "{}", robot_ended.stderr);
    assert!(base_ended.stdout.lines().count() > 5, "{}", base_ended.stdout);
}

#[test]
fn a_missing_machine_is_waited_for_during_the_outage_and_the_messages_it_misses_are_reported() {
    const FRAMES: u64 = 300;
    let endpoint = loopback();
    let text = apart(&endpoint, &endpoint).replace("[machine.robot]\n", "[machine.robot]\noutage_s = 1\n");
    let [robot, base] = machines(&text.replace("rate_hz    = 0", &format!("rate_hz = 100\nframes = {FRAMES}")));
    let (robot_run, mut base_run) = (start(&robot, "robot"), start(&base, "base"));
    base_run.wait_until("tracks arrive", || newest(&base) > 30);
    signal(base_run.id(), Signal::KILL);
    drop(base_run);
    wait_until("no process of `base` is left", || base.processes().is_empty());
    let ended = robot_run.wait().expect_code(1);
    let [sent, lost, _] = link(&ended, "base", "ellipses");
    let received = tracks(&base).len() as u64;
    // Messages in transit at the kill may be counted as arrived or as lost.
    let arrived = sent - lost;
    assert!(sent == FRAMES && lost > 100 && arrived.abs_diff(received) < 64, "{received} came, {lost} of {sent} lost");
    let loss = format!("{lost} messages of the lossless topic `ellipses` did not reach all machines that read it");
    let incomplete =
        format!("not complete: machine `base` lost {lost} of {FRAMES} messages of the lossless topic `ellipses`");
    ended.expect_texts(&[&loss, &incomplete]);
}

/// A lossless edge from `robot` to `base`, which `listens` or connects, with a source without an end.
fn endless(base_listens: bool) -> String {
    let endpoint = loopback();
    let text = apart(&endpoint, &endpoint).replace("rate_hz    = 0", &format!("rate_hz = {LIVE_RATE_HZ}"));
    let exchanged = || text.replace("listen = [", "@").replace("connect = [", "listen = [").replace('@', "connect = [");
    if base_listens { exchanged() } else { text }
}

#[test]
fn of_two_runs_that_send_as_one_machine_the_first_counts_until_it_ends_and_all_machines_report_it() {
    let text = endless(true);
    let ([first, base], second) = (machines(&text), Playground::with_pipeline(&text));
    let (first_run, mut base_run) = (start(&first, "robot"), start(&base, "base"));
    wait_for_frames(&mut base_run, &base, 20);
    let mut second_run = start(&second, "robot");
    base_run.wait_for_text(
        "machine `robot` runs twice; what counts is the run that was heard first, as long as it is heard",
    );
    second_run
        .wait_for_text("machine `base` hears another run of machine `robot`, too; what counts there is the run that ");
    wait_for_frames(&mut base_run, &base, 20);
    let sequences = || base.sequences("tracks.jsonl");
    assert!(sequences().into_iter().zip(0..).all(|(sequence, at)| sequence == at), "those of the first alone");
    assert!(first_run.stderr().contains("machine `base` hears another run of machine `robot`, too"));
    signal(first_run.id(), Signal::KILL);
    drop(first_run);
    wait_until("no process of the first is left", || first.processes().is_empty());
    let lines = || base.lines("tracks.jsonl").len();
    let before = lines();
    base_run.wait_until("tracks of the second arrive", || lines() > before + 20);
    let made = second_run.end().stage("source").messages;
    base_run.wait().expect_code(0);
    let sequences = sequences();
    let of_first = sequences.len() - made as usize;
    assert!(sequences.iter().copied().eq((0..of_first as u64).chain(0..made)), "{of_first}, {made}: {sequences:?}");
}

#[test]
fn of_two_runs_that_receive_as_one_machine_the_first_gets_all_and_all_machines_report_it() {
    let text = endless(false);
    let ([robot, first], second) = (machines(&text), Playground::with_pipeline(&text));
    let (mut robot_run, mut first_run) = (start(&robot, "robot"), start(&first, "base"));
    wait_for_frames(&mut first_run, &first, 20);
    let mut second_run = start(&second, "base");
    robot_run.wait_for_text(
        "machine `base` runs twice; what counts is the run that was heard first, as long as it is heard",
    );
    for run in [&mut first_run, &mut second_run] {
        run.wait_for_text(
            "machine `robot` hears another run of machine `base`, too; what counts there is the run that ",
        );
    }
    // The second run of the base is stopped. This must not block the first run.
    second.processes().into_iter().for_each(|process| signal(process, Signal::STOP));
    wait_for_frames(&mut first_run, &first, 80);
    let made = robot_run.end().stage("source").messages;
    first_run.wait().expect_code(0);
    assert!(first.sequences("tracks.jsonl").into_iter().eq(0..made));
    second.processes().into_iter().for_each(|process| signal(process, Signal::KILL));
}

/// Starts both machines again in either order, after both were ended in that order or killed.
fn begin_both_anew(is_killed: bool, robot_first: bool) {
    let round = format!("killed: {is_killed}, robot first: {robot_first}");
    let [robot, base] = machines(&endless(false));
    let order = if robot_first { [(&robot, "robot"), (&base, "base")] } else { [(&base, "base"), (&robot, "robot")] };
    for _ in 0..2 {
        // The next run replaces this file.
        std::fs::remove_file(base.path("tracks.jsonl")).ok();
        let mut runs = order.map(|(machine, name)| start(machine, name));
        runs[0].wait_until("tracks arrive", || newest(&base) > 20);
        let mut made = None;
        if is_killed {
            runs.iter().for_each(|run| signal(run.id(), Signal::KILL));
            drop(runs);
        } else if robot_first {
            let [robot_run, base_run] = runs;
            made = Some(robot_run.end().stage("source").messages);
            base_run.wait().expect_code(0);
        } else {
            drop(runs.map(Started::end));
        }
        order.iter().for_each(|(machine, _)| wait_until("no process is left", || machine.processes().is_empty()));
        let sequences = base.sequences("tracks.jsonl");
        let expected = made.unwrap_or(sequences.len() as u64);
        assert!(sequences.iter().copied().eq(0..expected), "{round}: {made:?} in {sequences:?}");
    }
}

#[test]
fn both_machines_may_be_ended_and_restarted_in_either_order_and_no_message_of_a_run_is_lost() {
    [true, false].into_iter().for_each(|robot_first| begin_both_anew(false, robot_first));
}

#[test]
fn both_machines_may_be_killed_and_restarted_in_either_order_and_no_message_of_a_run_is_lost() {
    [true, false].into_iter().for_each(|robot_first| begin_both_anew(true, robot_first));
}
