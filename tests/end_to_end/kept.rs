//! Kills stages with lossless inputs: they restart and get their unfinished messages again, and the results are those of a run
//! without kills.

use crate::bridge::tracks;
use crate::processes::{UNDER_WAY, at_work, stages_of};
use crate::programs::program;
use crate::support::{Ended, Playground, RECORDING, Started, TRACKING, TRACKING_TOPICS, signal};
use conicflow_lab::simulator::scene::Scene;
use rustix::process::Signal;

/// Interrupts a run and waits until everything is delivered. Returns the result and the number of frames.
fn end(run: Started) -> (Ended, u64) {
    let ended = run.end();
    let made = ended.stage("source").messages;
    (ended, made)
}

/// Kills a stage after the results have reached a position, and waits until another process has replaced it. Returns the position
/// that the results reach only after the new process has worked. A test must not kill a neighbouring stage before that: messages
/// that only these two stages held would be lost.
fn kill(run: &mut Started, stage: &str, newest: impl Fn() -> u64, after: u64) -> u64 {
    run.wait_until("it is as far", || newest() >= after);
    let (launcher, before) = (run.id(), stages_of(run.id())[stage]);
    signal(before, Signal::KILL);
    let at = newest();
    run.wait_until("the stage is back", || stages_of(launcher).get(stage).is_some_and(|process| *process != before));
    at + UNDER_WAY
}

/// Kills the stages one after another. Each kill waits until the replacement of the stage killed before has worked. Waits for the
/// last replacement, too.
fn kill_in_turn(run: &mut Started, stages: &[&str], newest: impl Fn() -> u64) {
    let after = stages.iter().fold(40, |after, stage| kill(run, stage, &newest, after));
    run.wait_until("all have worked", || newest() >= after);
}

fn expect_nothing_lost(ended: &Ended, made: u64) {
    for (topic, _, reader) in TRACKING_TOPICS {
        let row = ended.input(topic, reader);
        assert_eq!((row.received, row.dropped, row.gaps), (made, 0, 0), "{topic}: {}", ended.stderr);
    }
}

#[test]
fn a_stage_that_is_killed_again_and_again_loses_nothing() {
    // An assembler that uses the contours of earlier frames would lose them when it is killed.
    let forgetful =
        TRACKING.replacen("\"object_assembler\"", "\"object_assembler\"\npooled = { contour_memory = 0 }", 1);
    let (playground, mut run) = at_work(&forgetful, 100);
    kill_in_turn(&mut run, &["assembler"; 4], || playground.newest("tracks.jsonl"));
    let (ended, made) = end(run);
    expect_nothing_lost(&ended, made);
    assert_eq!(ended.stage("assembler").starts, 5, "{}", ended.stderr);
    let found = tracks(&playground);
    assert_eq!(found.len() as u64, made);
    std::fs::remove_file(playground.path("tracks.jsonl")).unwrap();
    let arguments = ["run", "--set", "source.rate_hz=100", "--frames", &made.to_string()];
    playground.conicflow(&arguments).expect_code(0);
    assert!(found == tracks(&playground), "{}", ended.stderr);
}

#[test]
fn a_sink_and_stages_with_a_state_get_each_frame_once() {
    let (playground, mut run) = at_work(TRACKING, 100);
    let stages = ["json", "tracker", "extractor", "json", "json"];
    kill_in_turn(&mut run, &stages, || playground.newest("tracks.jsonl"));
    let ended = run.end();
    expect_nothing_lost(&ended, playground.expect_each_frame(&ended));
}

#[test]
fn messages_for_a_stopped_stage_are_kept_beyond_its_death_and_the_end_of_the_stream() {
    let (playground, mut run) = at_work(TRACKING, 40);
    run.wait_until("it delivers", || playground.newest("tracks.jsonl") > 20);
    // The first kill comes while the queues before the stage are full.
    let launcher = run.id();
    let before = stages_of(launcher)["assembler"];
    signal(before, Signal::STOP);
    run.wait_until("the queues are full", || playground.top()["stages"][0]["waits_for"] == "extractor");
    signal(before, Signal::KILL);
    run.wait_until("it is back", || stages_of(launcher).get("assembler").is_some_and(|process| *process != before));
    let after = playground.newest("tracks.jsonl") + UNDER_WAY;
    run.wait_until("it has worked", || playground.newest("tracks.jsonl") >= after);
    // The second kill comes after the source has been interrupted: only messages that wait in queues are left.
    let before = stages_of(launcher)["assembler"];
    signal(before, Signal::STOP);
    signal(launcher, Signal::INT);
    std::thread::sleep(std::time::Duration::from_millis(700));
    signal(before, Signal::KILL);
    let ended = run.wait().expect_code(0);
    expect_nothing_lost(&ended, playground.expect_each_frame(&ended));
    assert_eq!(ended.stage("assembler").starts, 3, "{}", ended.stderr);
}

#[test]
fn a_stage_that_is_killed_while_the_run_ends_in_order_still_delivers() {
    let (playground, mut run) = at_work(TRACKING, 100);
    run.wait_until("it delivers", || playground.newest("tracks.jsonl") > 20);
    let tracker = stages_of(run.id())["tracker"];
    signal(tracker, Signal::STOP);
    signal(run.id(), Signal::INT);
    std::thread::sleep(std::time::Duration::from_millis(300));
    signal(tracker, Signal::KILL);
    let ended = run.wait().expect_code(0);
    playground.expect_each_frame(&ended);
    assert_eq!(ended.stage("tracker").starts, 2, "{}", ended.stderr);
}

#[test]
fn side_inputs_are_repeated_with_their_frame() {
    let pairing = program("pairing_sink");
    let inputs = "depth = { topic = \"depth\", delivery = \"lossless\" }, \
                  ellipses = { topic = \"ellipses\", delivery = \"lossless\" }";
    let sink = format!(
        "\n[stage.pairing]\nprogram = {pairing}\npath = \"pairs.txt\"\ndelay_ms = 5\n\
         input = {{ topic = \"objects\", delivery = \"lossless\" }}\ninputs = {{ {inputs} }}\n"
    );
    let (playground, mut run) = at_work(&format!("{TRACKING}{sink}"), 100);
    // Both sinks have to reach this position.
    let newest = || {
        let last = playground.lines("pairs.txt").pop();
        let paired = last.map_or(0, |line| line.split(' ').next().unwrap().parse().unwrap());
        playground.newest("tracks.jsonl").min(paired)
    };
    kill_in_turn(&mut run, &["pairing", "assembler", "pairing", "extractor", "pairing"], newest);
    let (ended, made) = end(run);
    let mut pairs = playground.lines("pairs.txt");
    // This sink writes a line before its delay, so a restarted sink may write the same line again.
    pairs.dedup();
    let expected: Vec<_> = (0..made).map(|frame| format!("{frame} {frame} {frame}")).collect();
    assert_eq!(pairs, expected, "{}", ended.stderr);
}

#[test]
fn a_recording_is_read_once_whichever_process_is_killed() {
    const FRAMES: u64 = 120;
    const RECORDED: u64 = 40;
    let playground = Playground::with_pipeline(RECORDING);
    playground.record_with_camera(Scene::built_in("tabletop").unwrap().unwrap(), 3, RECORDED);
    // Only the number of images matters, not their content.
    for frame in RECORDED..FRAMES {
        let path = |frame: u64| playground.path(&format!("frames/{frame}.png"));
        std::fs::hard_link(path(frame % RECORDED), path(frame)).unwrap();
    }
    let mut run = playground.start(&["run", "--set", "source.rate_hz=15"]);
    let newest = || playground.newest("objects.jsonl");
    let mut after = 5;
    for stage in ["extractor", "source", "assembler"] {
        after = kill(&mut run, stage, newest, after);
    }
    let ended = run.wait().expect_code(0);
    assert!(playground.sequences("objects.jsonl").into_iter().eq(0..FRAMES), "{}", ended.stderr);
}
