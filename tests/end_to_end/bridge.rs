//! One pipeline on two machines: two launchers on this host, each with its own runtime folder, joined over loopback.

pub use crate::loopback::loopback;

use super::support::{
    Ended, FINDING, InputRow, Playground, Started, TRACKING, environment, python_with, signal, wait_until,
};
use rustix::process::Signal;
use serde_json::Value as Json;
use std::process::Command;
use std::time::Duration;

/// Machine of each stage of [`TRACKING`] in most tests.
pub const HALVES: [(&str, &str); 5] =
    [("source", "robot"), ("extractor", "robot"), ("assembler", "base"), ("tracker", "base"), ("json", "base")];

/// Adds to `text` the machine of each stage.
pub fn placed(text: &str, places: &[(&str, &str)]) -> String {
    places.iter().fold(text.to_owned(), |text, (stage, machine)| {
        let title = format!("[stage.{stage}]\n");
        assert!(text.contains(&title), "no stage `{stage}`");
        text.replace(&title, &format!("{title}machine = \"{machine}\"\n"))
    })
}

/// Adds the machines of the stages to `text`. `robot` listens at an endpoint, and `base` connects to it.
pub fn joined(text: &str, places: &[(&str, &str)], listen: &str, connect: &str) -> String {
    let text = placed(text, places);
    format!("{text}\n[machine.robot]\nlisten = [\"{listen}\"]\n[machine.base]\nconnect = [\"{connect}\"]\n")
}

/// [`TRACKING`] with its source and extractor on `robot`, and the other stages on `base`.
pub fn apart(listen: &str, connect: &str) -> String {
    joined(TRACKING, &HALVES, listen, connect)
}

/// [`FINDING`] with its sink on `base`, and the other stages on `robot`.
pub fn finding_apart(endpoint: &str) -> String {
    joined(FINDING, &[("source", "robot"), ("extractor", "robot"), ("json", "base")], endpoint, endpoint)
}

/// Two machines with the same pipeline file.
pub fn machines(text: &str) -> [Playground; 2] {
    [Playground::with_pipeline(text), Playground::with_pipeline(text)]
}

/// Rate of live sources in hertz, so low that even a busy host processes each frame.
pub const LIVE_RATE_HZ: f64 = 20.0;

/// Changes a pipeline to a live source of [`LIVE_RATE_HZ`] and inputs with `latest`.
pub fn live(text: &str) -> String {
    text.replace(", delivery = \"lossless\"", "").replace("rate_hz    = 0", &format!("rate_hz = {LIVE_RATE_HZ}"))
}

/// Two machines, joined over loopback, with a live pipeline.
fn live_machines() -> [Playground; 2] {
    let endpoint = loopback();
    machines(&live(&apart(&endpoint, &endpoint)))
}

/// Asserts that a stage of the robot processed nearly every frame although another machine had a fault. A stage that waits for
/// that machine would lose all frames in that time.
pub fn expect_unfelt(row: &InputRow) {
    assert!(row.dropped <= row.received / 4, "the robot felt it: {row:?}");
}

pub fn start(machine: &Playground, name: &str) -> Started {
    machine.start(&["run", "--machine", name])
}

/// The tracks of a playground, without times of processing.
pub fn tracks(playground: &Playground) -> Vec<Json> {
    without_times(playground, "tracks.jsonl")
}

/// The lines of a file of JSON objects, without times of processing.
pub fn without_times(playground: &Playground, file: &str) -> Vec<Json> {
    let mut lines = playground.json_lines(file);
    lines.iter_mut().for_each(|line| drop(line.as_object_mut().unwrap().remove("latency_ms")));
    lines
}

/// Row of a link in the summary: messages, lost, resent.
pub fn link(ended: &Ended, machine: &str, topic: &str) -> [u64; 3] {
    let rows = ended.stderr.lines().map(|line| line.split_whitespace().collect::<Vec<_>>());
    let row = rows.into_iter().find(|words| words.len() > 9 && words[..2] == [machine, topic]);
    let words = row.unwrap_or_else(|| panic!("no link to `{machine}` in: {}", ended.stderr));
    [3, 6, 7].map(|index| words[index].parse().unwrap())
}

/// Process of a stage.
pub fn process_of(playground: &Playground, stage: &str) -> Option<u32> {
    let of_stage = |process: &u32| environment(*process, "CONICFLOW_STAGE").as_deref() == Some(stage);
    playground.processes().into_iter().find(of_stage)
}

/// Kills the process of a stage, and waits until the next one runs.
pub fn kill(playground: &Playground, stage: &str) {
    let process = process_of(playground, stage).unwrap();
    signal(process, Signal::KILL);
    wait_until("its successor runs", || process_of(playground, stage).is_some_and(|new| new != process));
}

pub fn newest(playground: &Playground) -> u64 {
    playground.newest("tracks.jsonl")
}

/// Waits until this number of further frames has arrived at the base.
pub fn wait_for_frames(run: &mut Started, base: &Playground, frames: u64) {
    let before = newest(base);
    run.wait_until("tracks go on", || newest(base) > before + frames);
}

/// Ends both runs, and asserts that nothing is left behind.
fn end(runs: [Started; 2], machines: &[Playground; 2]) {
    drop(runs.map(Started::end));
    machines.iter().for_each(|machine| wait_until("no process is left", || machine.processes().is_empty()));
}

#[test]
fn two_machines_find_the_same_tracks_as_one_bit_for_bit_whoever_starts_first() {
    let alone = Playground::with_pipeline(TRACKING);
    alone.conicflow(&["run", "--frames", "80"]).expect_code(0);
    let expected = tracks(&alone);
    assert_eq!(expected.len(), 80);
    for robot_first in [true, false] {
        let endpoint = loopback();
        let [robot, base] = machines(&apart(&endpoint, &endpoint));
        let start_robot = || robot.start(&["run", "--machine", "robot", "--frames", "80"]);
        let (mut first, second) = if robot_first { (start_robot(), None) } else { (start(&base, "base"), Some(())) };
        first.wait_until("the first machine's bridge runs", || {
            process_of(if robot_first { &robot } else { &base }, "bridge").is_some()
        });
        let other = if second.is_some() { start_robot() } else { start(&base, "base") };
        let (robot_run, base_run) = if robot_first { (first, other) } else { (other, first) };
        let (sent, received) = (robot_run.wait().expect_code(0), base_run.wait().expect_code(0));
        assert_eq!(tracks(&base), expected, "robot first: {robot_first}");
        assert_eq!(link(&sent, "base", "ellipses")[..2], [80, 0]);
        assert_eq!(link(&received, "robot", "ellipses")[..2], [80, 0]);
    }
}

#[test]
fn messages_of_another_machine_are_listed_under_their_topic() {
    let machines = live_machines();
    let mut runs = [start(&machines[0], "robot"), start(&machines[1], "base")];
    runs[1].wait_until("tracks arrive", || newest(&machines[1]) > 20);
    let topic_output =
        |arguments: &[&str]| machines[1].conicflow(&[&["topic"], arguments].concat()).expect_code(0).stdout;
    // The rate is that of the last second, in which a busy host may have sent nothing.
    runs[1].wait_until("the list tells its rate", || {
        let list = topic_output(&["list"]);
        let row = list.lines().find(|line| line.starts_with("ellipses ")).unwrap_or_else(|| panic!("{list}"));
        let words: Vec<_> = row.split_whitespace().collect();
        assert_eq!(
            (&words[..3], &words[5..]),
            (&["ellipses", "ellipses", "bridge"][..], &["assembler", "(latest,", "queue", "2)"][..])
        );
        words[3].parse::<f64>().unwrap() > 0.0
    });
    for (figure, unit) in [("hz", "Hz"), ("bw", "MB/s")] {
        runs[1].wait_until("a second in which it carries something", || {
            let line = topic_output(&[figure, "ellipses", "--count", "1"]);
            let words: Vec<_> = line.split([' ', ',']).collect();
            assert!(words[0] == "ellipses:" && words[2] == unit, "{line}");
            words[1].parse::<f64>().unwrap() > 0.0
        });
    }
    end(runs, &machines);
}

#[test]
fn a_machine_that_is_killed_and_restarted_gets_new_messages_and_the_other_is_not_affected() {
    let machines = live_machines();
    let [robot, base] = &machines;
    let mut robot_run = start(robot, "robot");
    let base_run = start(base, "base");
    robot_run.wait_until("tracks arrive", || newest(base) > 20);
    signal(base_run.id(), Signal::KILL);
    drop(base_run);
    wait_until("no process of `base` is left", || base.processes().is_empty());
    let made = || robot.top()["stages"][0]["messages"].as_u64().unwrap();
    let target = made() + 80;
    robot_run.wait_until("the robot is alone for long", || made() > target);
    let mut again = start(base, "base");
    wait_for_frames(&mut again, base, 20);
    let robot_ended = robot_run.end();
    expect_unfelt(&robot_ended.input("depth", "extractor"));
    assert_eq!(robot_ended.stage("extractor").starts, 1);
    again.wait().expect_code(0);
    machines.iter().for_each(|machine| assert!(machine.processes().is_empty()));
}

/// Two machines, joined over loopback by a lossless edge, with a source that runs without an end.
fn lossless_machines() -> [Playground; 2] {
    let endpoint = loopback();
    machines(&apart(&endpoint, &endpoint).replace("rate_hz    = 0", &format!("rate_hz = {LIVE_RATE_HZ}")))
}

#[test]
fn a_machine_whose_run_ended_and_was_restarted_gets_new_messages_of_a_lossless_edge() {
    let [robot, base] = &lossless_machines();
    let (robot_run, mut base_run) = (start(robot, "robot"), start(base, "base"));
    wait_for_frames(&mut base_run, base, 20);
    base_run.end();
    let mut again = start(base, "base");
    wait_for_frames(&mut again, base, 20);
    let robot_ended = robot_run.end();
    let ended = again.wait().expect_code(0);
    assert_eq!(link(&robot_ended, "base", "ellipses")[1], 0, "{}", robot_ended.stderr);
    assert_eq!(ended.input("ellipses", "assembler").dropped, 0, "{}", ended.stderr);
}

#[test]
fn a_lossless_edge_goes_on_when_the_sending_machine_is_killed_and_restarted() {
    let [robot, base] = &lossless_machines();
    let (robot_run, mut base_run) = (start(robot, "robot"), start(base, "base"));
    let lines = || base.lines("tracks.jsonl").len();
    base_run.wait_until("tracks arrive", || lines() > 40);
    signal(robot_run.id(), Signal::KILL);
    drop(robot_run);
    wait_until("no process of `robot` is left", || robot.processes().is_empty());
    let before = lines();
    let again = start(robot, "robot");
    base_run.wait_until("tracks of the new run arrive", || lines() > before + 40);
    let robot_ended = again.end();
    base_run.wait().expect_code(0);
    let made = robot_ended.stage("source").messages;
    let sequences = base.sequences("tracks.jsonl");
    assert!(sequences.ends_with(&(0..made).collect::<Vec<_>>()), "{made} of the new run: {sequences:?}");
}

#[test]
fn stages_and_bridges_may_die_on_either_side() {
    let machines = live_machines();
    let [robot, base] = &machines;
    let mut runs = [start(robot, "robot"), start(base, "base")];
    for (machine, stage) in [(robot, "extractor"), (base, "assembler"), (robot, "bridge"), (base, "bridge")] {
        wait_for_frames(&mut runs[1], base, 10);
        kill(machine, stage);
    }
    wait_for_frames(&mut runs[1], base, 10);
    end(runs, &machines);
}

#[test]
fn the_stages_of_two_machines_may_be_started_one_by_one() {
    let machines = live_machines();
    let stages = HALVES.into_iter().chain([("bridge", "robot"), ("bridge", "base")]);
    let mut runs: Vec<_> = stages
        .map(|(stage, machine)| {
            let playground = &machines[usize::from(machine == "base")];
            playground.start(&["node", stage, "--machine", machine])
        })
        .collect();
    runs[4].wait_until("tracks arrive", || newest(&machines[1]) > 30);
    runs.iter().for_each(|run| signal(run.id(), Signal::INT));
    runs.into_iter().for_each(|run| drop(run.wait().expect_code(0)));
}

/// Kills the bridge of one of two machines repeatedly while lossless edges transfer frames at full speed. Returns the number of
/// frames that the base has missed.
fn kill_the_bridge_of(killed: usize) -> u64 {
    let endpoint = loopback();
    let machines = machines(&finding_apart(&endpoint));
    let mut runs = [start(&machines[0], "robot"), start(&machines[1], "base")];
    // More frames than the outbox and the queues after it hold, so that some of them were sent after the kill.
    let mut go_on = || wait_for_frames(&mut runs[1], &machines[1], 100);
    for _ in 0..3 {
        go_on();
        kill(&machines[killed], "bridge");
    }
    go_on();
    signal(runs[0].id(), Signal::INT);
    let [robot, base] = runs.map(|run| run.wait().expect_code(0));
    let sequences = machines[1].sequences("tracks.jsonl");
    let made = robot.stage("source").messages;
    assert!(sequences.is_sorted() && sequences.last() == Some(&(made - 1)), "{:?} of {made}", sequences.last());
    let missed = made - sequences.len() as u64;
    eprintln!("{missed} of {made} missed, sink: {:?}", base.input("ellipses", "json"));
    missed
}

#[test]
fn nothing_is_lost_when_the_receiving_bridge_is_killed() {
    assert_eq!(kill_the_bridge_of(1), 0);
}

#[test]
fn nothing_is_lost_when_the_sending_bridge_is_killed() {
    assert_eq!(kill_the_bridge_of(0), 0);
}

#[test]
fn messages_that_wait_for_a_machine_are_not_lost_when_the_sending_bridge_is_killed() {
    const FRAMES: u64 = 100;
    let endpoint = loopback();
    let text = apart(&endpoint, &endpoint).replace("rate_hz    = 0", &format!("rate_hz = 0\nframes = {FRAMES}"));
    let [robot, base] = machines(&text);
    let robot_run = start(&robot, "robot");
    wait_until("a full outbox waits", || top_link(&robot)["edges"][0]["messages"] == 64);
    kill(&robot, "bridge");
    let base_run = start(&base, "base");
    robot_run.wait().expect_code(0);
    let ended = base_run.wait().expect_code(0);
    let sequences = base.sequences("tracks.jsonl");
    assert!(sequences.iter().copied().eq(0..FRAMES), "{sequences:?}: {}", ended.stderr);
}

/// Kills a bridge while the last messages and the ends of streams are in transit, at different moments.
#[test]
fn a_bridge_that_is_killed_at_the_end_of_a_run_loses_nothing_and_keeps_nobody_waiting() {
    const FRAMES: u64 = 10;
    for (killed, still, after_ms) in
        [(0, false, 0), (1, false, 0), (0, true, 0), (1, true, 0), (0, true, 300), (1, false, 20), (0, false, 40)]
    {
        let round = format!("bridge {killed}, still: {still}, after {after_ms} ms");
        let endpoint = loopback();
        let text = finding_apart(&endpoint).replace("rate_hz    = 0", &format!("rate_hz = 20\nframes = {FRAMES}"));
        let machines = machines(&text);
        let mut runs = [start(&machines[0], "robot"), start(&machines[1], "base")];
        runs[1].wait_until("the last list arrives", || machines[1].count("tracks.jsonl") as u64 == FRAMES);
        std::thread::sleep(Duration::from_millis(after_ms));
        let process = process_of(&machines[killed], "bridge");
        if let Some(process) = process.filter(|_| still) {
            signal(process, Signal::STOP);
            // The other bridge has no peer in this time.
            std::thread::sleep(Duration::from_secs(1));
        }
        process.into_iter().for_each(|process| signal(process, Signal::KILL));
        let ended = runs.map(|run| run.wait().expect_code(0));
        let sequences = machines[1].sequences("tracks.jsonl");
        assert!(sequences.iter().copied().eq(0..FRAMES), "{round}: {sequences:?}: {}", ended[1].stderr);
        assert_eq!(link(&ended[0], "base", "ellipses")[1], 0, "{round}: {}", ended[0].stderr);
    }
}

/// A stage is stopped for longer than a bridge waits for readers that have ended.
#[test]
fn a_reader_that_is_stopped_for_long_misses_nothing() {
    const FRAMES: u64 = 200;
    let endpoint = loopback();
    let text = apart(&endpoint, &endpoint).replace("rate_hz    = 0", &format!("rate_hz = 100\nframes = {FRAMES}"));
    let machines = machines(&text);
    let mut runs = [start(&machines[0], "robot"), start(&machines[1], "base")];
    wait_for_frames(&mut runs[1], &machines[1], 20);
    let assembler = process_of(&machines[1], "assembler").unwrap();
    signal(assembler, Signal::STOP);
    std::thread::sleep(Duration::from_secs(7));
    assert!(newest(&machines[1]) < FRAMES - 64, "the source did not have to wait");
    signal(assembler, Signal::CONT);
    let ended = runs.map(|run| run.wait().expect_code(0));
    let sequences = machines[1].sequences("tracks.jsonl");
    assert!(sequences.iter().copied().eq(0..FRAMES), "{sequences:?}: {}", ended[1].stderr);
}

/// The end of the stream was acknowledged, and the other machine has left. Restarted processes nevertheless learn of the end.
#[test]
fn a_run_ends_although_a_reader_and_the_bridge_that_heard_the_end_are_killed() {
    let endpoint = loopback();
    let text = apart(&endpoint, &endpoint).replace("rate_hz    = 0", "rate_hz = 0\nframes = 50");
    let text = text.replace("topic = \"ellipses\", delivery = \"lossless\"", "topic = \"ellipses\"");
    let [robot, base] = machines(&text);
    let mut base_run = start(&base, "base");
    base_run.wait_until("all are at work", || {
        ["bridge", "assembler", "tracker"].iter().all(|stage| process_of(&base, stage).is_some())
    });
    // The stopped tracker keeps the assembler from ending, and the assembler keeps the bridge from ending.
    let tracker = process_of(&base, "tracker").unwrap();
    signal(tracker, Signal::STOP);
    start(&robot, "robot").wait().expect_code(0);
    ["assembler", "bridge"].iter().for_each(|stage| kill(&base, stage));
    signal(tracker, Signal::CONT);
    base_run.wait().expect_code(0);
}

#[test]
fn a_python_program_reads_objects_by_their_key() {
    let Some(python) = python_with("zenoh", "has no eclipse-zenoh; nothing was shown") else { return };
    let endpoint = loopback();
    let text = apart(&endpoint, &endpoint).replace("rate_hz    = 0", "rate_hz = 30");
    let text = text.replace("[stage.assembler]\nmachine = \"base\"", "[stage.assembler]\nmachine = \"robot\"");
    let sink = "[stage.objects]\nnode = \"json_sink\"\nmachine = \"base\"\npath = \"objects.jsonl\"\n";
    let [robot, base] =
        machines(&format!("{text}\n{sink}input = {{ topic = \"objects\", delivery = \"lossless\" }}\n"));
    let robot_run = robot.start(&["run", "--machine", "robot", "--frames", "150"]);
    let mut script = Command::new(python);
    script.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/examples/read_objects.py"));
    let mut script = Started::new({
        script.args([&endpoint, "tracking", "robot", "objects"]);
        script
    });
    // The robot keeps its messages until the base exists.
    script.wait_for_text("listening");
    let base_run = start(&base, "base");
    let printed = script.wait().expect_code(0).stdout;
    robot_run.wait().expect_code(0);
    base_run.wait().expect_code(0);
    let expected = base.json_lines("objects.jsonl");
    assert_eq!(expected.len(), 150);
    let lines: Vec<Json> = printed.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    assert!(lines.len() > 50 && lines.iter().any(|line| !line["objects"][0].is_null()), "{} lines", lines.len());
    for line in lines {
        let same = &expected[line["sequence"].as_u64().unwrap() as usize];
        let shape = |line: &Json| {
            let objects = line["objects"].as_array().unwrap().iter();
            objects
                .map(|object| (object["kind"].clone(), object["center"].clone(), object["radius"].clone()))
                .collect::<Vec<_>>()
        };
        assert_eq!(shape(&line), shape(same));
    }
}

/// Output of `top` for the only link of a machine.
pub fn top_link(machine: &Playground) -> Json {
    machine.top()["links"][0].clone()
}

/// Waits until `top` shows the only link of a machine in this state.
pub fn wait_for_link(machine: &Playground, state: &str) {
    wait_until(&format!("the link is {state}"), || top_link(machine)["state"] == state);
}

#[test]
fn messages_written_while_no_machine_wants_them_are_counted() {
    let [robot, _base] = live_machines();
    let mut run = start(&robot, "robot");
    run.wait_until("ellipses are made", || robot.top()["stages"][1]["messages"].as_u64() > Some(20));
    let ended = run.end();
    let (made, row) = (ended.stage("extractor").messages, ended.input("ellipses", "bridge"));
    assert!(row.received == 0 && (20..=made).contains(&row.dropped), "{}", ended.stderr);
}

#[test]
fn top_shows_each_link() {
    let machines = live_machines();
    let [robot, base] = &machines;
    let base_run = start(base, "base");
    wait_for_link(base, "unreachable");
    let before = top_link(base);
    assert_eq!((before["machine"].as_str(), before["was_heard"].as_bool()), (Some("robot"), Some(false)), "{before}");
    assert!(top_link(base)["state_s"].as_f64() > before["state_s"].as_f64(), "{before}");
    let mut runs = [start(robot, "robot"), base_run];
    runs[1].wait_until("tracks arrive", || newest(base) > 20);
    // The rate is that of the last second, in which a busy host may have sent nothing.
    let mut shown = Json::Null;
    runs[1].wait_until("the link is up and carries", || {
        shown = top_link(base);
        let edge = &shown["edges"][0];
        let figures = ["rate_hz", "bandwidth_mbps", "age_ms"].map(|figure| edge[figure].as_f64());
        let carried = edge["messages"].as_u64() > Some(10) && edge["wire_bytes"].as_u64() > Some(1000);
        shown["state"] == "up" && carried && figures.iter().all(|figure| *figure > Some(0.0))
    });
    // Both clocks are those of this host. The offset may be wrong by half of the round trip.
    let [offset_s, round_trip_ms] = ["clock_offset_s", "round_trip_ms"].map(|figure| shown[figure].as_f64().unwrap());
    assert!(offset_s.abs() <= round_trip_ms / 2e3 + 1e-3, "{shown}");
    let edge = &shown["edges"][0];
    assert_eq!((edge["topic"].as_str(), edge["direction"].as_str()), (Some("ellipses"), Some("in")), "{shown}");
    assert_eq!(edge["malformed"].as_u64(), Some(0), "{shown}");
    assert!(edge["lost"].is_u64() && edge["stale"].is_u64() && edge["resent"].is_u64(), "{shown}");
    let [robot_run, base_run] = runs;
    // A killed launcher does not announce its end.
    signal(robot_run.id(), Signal::KILL);
    drop(robot_run);
    wait_for_link(base, "unreachable");
    assert_eq!(top_link(base)["was_heard"], true);
    base_run.end();
    machines.iter().for_each(|machine| wait_until("no process is left", || machine.processes().is_empty()));
}
