//! Stages that are killed where no message may be missed: they come back, are handed again what they had not finished, and the
//! results are those of a run in which nobody was killed.

use crate::processes::stages_of;
use crate::programs::program;
use crate::support::{Ended, Playground, RECORDING, Started, TRACKING, TRACKING_STAGES, signal};
use conicflow_lab::simulator::scene::Scene;
use rustix::process::Signal;
use serde_json::Value as Json;

const FRAMES: u64 = 300;

/// The lines of results, but for the times in them.
fn lines(playground: &Playground, name: &str) -> Vec<Json> {
    let without_time = |mut line: Json| {
        line["latency_ms"] = Json::Null;
        line
    };
    playground.json_lines(name).into_iter().map(without_time).collect()
}

fn run(playground: &Playground, rate_hz: u64) -> Started {
    let (frames, rate) = (FRAMES.to_string(), format!("source.rate_hz={rate_hz}"));
    playground.start(&["run", "--frames", &frames, "--set", &rate])
}

/// Kills a stage after it has got so far, and waits until another process is at work in its place.
fn kill(run: &mut Started, playground: &Playground, stage: &str, name: &str, after: u64) {
    run.wait_until("it is as far", || playground.newest(name) >= after);
    let before = stages_of(run.id())[stage];
    signal(before, Signal::KILL);
    let launcher = run.id();
    run.wait_until("the stage is back", || stages_of(launcher).get(stage).is_some_and(|process| *process != before));
}

fn expect_nothing_lost(ended: &Ended) {
    for (pair, topic) in TRACKING_STAGES.windows(2).zip(["depth", "ellipses", "objects", "tracks"]) {
        let row = ended.input(topic, pair[1]);
        assert_eq!((row.received, row.dropped, row.gaps), (FRAMES, 0, 0), "{topic}: {}", ended.stderr);
    }
}

#[test]
fn a_stage_that_is_killed_again_and_again_loses_nothing() {
    let playground = Playground::with_pipeline(TRACKING);
    run(&playground, 100).wait().expect_code(0);
    let expected = lines(&playground, "tracks.jsonl");
    assert_eq!(expected.len() as u64, FRAMES);
    std::fs::remove_file(playground.path("tracks.jsonl")).unwrap();
    let mut run = run(&playground, 100);
    for index in 0..4 {
        kill(&mut run, &playground, "assembler", "tracks.jsonl", 40 + 50 * index);
    }
    let ended = run.wait().expect_code(0);
    expect_nothing_lost(&ended);
    assert_eq!(ended.stage("assembler").starts, 5, "{}", ended.stderr);
    assert!(lines(&playground, "tracks.jsonl") == expected, "{}", ended.stderr);
}

#[test]
fn a_sink_and_stages_with_a_memory_get_each_frame_once() {
    let playground = Playground::with_pipeline(TRACKING);
    let mut run = run(&playground, 100);
    for (index, stage) in ["json", "tracker", "extractor", "json", "json"].into_iter().enumerate() {
        kill(&mut run, &playground, stage, "tracks.jsonl", 40 + 60 * index as u64);
    }
    let ended = run.wait().expect_code(0);
    expect_nothing_lost(&ended);
    assert!(playground.sequences("tracks.jsonl").into_iter().eq(0..FRAMES), "{}", ended.stderr);
}

#[test]
fn what_waits_for_a_stage_that_stands_still_outlives_it_and_the_end_of_the_stream() {
    let playground = Playground::with_pipeline(TRACKING);
    let mut run = run(&playground, 40);
    run.wait_until("it delivers", || playground.newest("tracks.jsonl") > 20);
    // Once with full queues before it, and once when nothing more than these is to come.
    for after in [20, FRAMES - 12] {
        run.wait_until("it is as far", || playground.newest("tracks.jsonl") >= after);
        let (launcher, before) = (run.id(), stages_of(run.id())["assembler"]);
        signal(before, Signal::STOP);
        std::thread::sleep(std::time::Duration::from_millis(700));
        signal(before, Signal::KILL);
        run.wait_until("it is back", || stages_of(launcher).get("assembler").is_some_and(|process| *process != before));
    }
    let ended = run.wait().expect_code(0);
    expect_nothing_lost(&ended);
    assert!(playground.sequences("tracks.jsonl").into_iter().eq(0..FRAMES), "{}", ended.stderr);
}

#[test]
fn a_stage_that_is_killed_while_the_run_ends_in_order_still_delivers() {
    let playground = Playground::with_pipeline(TRACKING);
    let mut run = playground.start(&["run", "--set", "source.rate_hz=100"]);
    run.wait_until("it delivers", || playground.newest("tracks.jsonl") > 20);
    let tracker = stages_of(run.id())["tracker"];
    signal(tracker, Signal::STOP);
    signal(run.id(), Signal::INT);
    std::thread::sleep(std::time::Duration::from_millis(300));
    signal(tracker, Signal::KILL);
    let ended = run.wait().expect_code(0);
    let made = ended.stage("source").messages;
    assert!(playground.sequences("tracks.jsonl").into_iter().eq(0..made), "{}", ended.stderr);
    assert_eq!(ended.stage("tracker").starts, 2, "{}", ended.stderr);
}

#[test]
fn side_inputs_come_again_with_their_frame() {
    let pairing = program("pairing_sink");
    let inputs = "depth = { topic = \"depth\", delivery = \"lossless\" }, \
                  ellipses = { topic = \"ellipses\", delivery = \"lossless\" }";
    let sink = format!(
        "\n[stage.pairing]\nprogram = {pairing}\npath = \"pairs.txt\"\ndelay_ms = 5\n\
         input = {{ topic = \"objects\", delivery = \"lossless\" }}\ninputs = {{ {inputs} }}\n"
    );
    let playground = Playground::with_pipeline(&format!("{TRACKING}{sink}"));
    let mut run = run(&playground, 100);
    for (index, stage) in ["pairing", "assembler", "pairing", "extractor", "pairing"].into_iter().enumerate() {
        kill(&mut run, &playground, stage, "tracks.jsonl", 40 + 50 * index as u64);
    }
    let ended = run.wait().expect_code(0);
    let mut pairs = playground.lines("pairs.txt");
    // This sink writes a line before it spends its time, and does not look which ones are there.
    pairs.dedup();
    let expected: Vec<_> = (0..FRAMES).map(|frame| format!("{frame} {frame} {frame}")).collect();
    assert_eq!(pairs, expected, "{}", ended.stderr);
}

#[test]
fn a_recording_is_read_once_whoever_is_killed() {
    let playground = Playground::with_pipeline(RECORDING);
    let camera = playground.record(Scene::built_in("tabletop").unwrap().unwrap(), 3, 60);
    let set = format!(
        "source.intrinsics={{ fx = {:?}, fy = {:?}, cx = {:?}, cy = {:?} }}",
        camera.fx, camera.fy, camera.cx, camera.cy
    );
    let mut run = playground.start(&["run", "--set", "source.rate_hz=30", "--set", &set]);
    for (after, stage) in [(10, "extractor"), (20, "source"), (35, "assembler")] {
        kill(&mut run, &playground, stage, "objects.jsonl", after);
    }
    let ended = run.wait().expect_code(0);
    assert!(playground.sequences("objects.jsonl").into_iter().eq(0..60), "{}", ended.stderr);
}
