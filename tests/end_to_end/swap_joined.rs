//! Replaces stages with more than one neighbour: with several inputs of the same frame, on topics with several writers, and on
//! both sides of a bridge.

use super::bridge::{apart, loopback, machines, newest, start, wait_for_frames};
use super::programs::program;
use super::support::{Playground, Started, TRACKING, TRACKING_STAGES};
use super::swap::{expect_a_quick_swap, longest_gap, replace};

/// Queue length of the image input: more images than there are frames under way.
const SIDE_QUEUE: usize = 20;

/// [`TRACKING`] with a sink that reads the objects, the image and the ellipses of each frame.
fn paired(delivery: &str) -> String {
    let topic = |name: &str| format!("{{ topic = \"{name}\", delivery = \"{delivery}\", queue = {SIDE_QUEUE} }}");
    let (depth, ellipses) = (topic("depth"), topic("ellipses"));
    let objects = format!("{{ topic = \"objects\", delivery = \"{delivery}\" }}");
    let inputs = format!("{{ depth = {depth}, ellipses = {ellipses} }}");
    let program = program("pairing_sink");
    let sink = format!("[stage.pairs]\nprogram = {program}\ninput = {objects}\ninputs = {inputs}\n");
    format!("{}\n{sink}", TRACKING.replace("lossless", delivery))
}

/// The lines of the sink: the numbers of the objects, of the image and of the ellipses of each frame.
fn pairs(playground: &Playground) -> Vec<[Option<u64>; 3]> {
    let row = |line: &String| {
        let numbers: Vec<_> = line.split(' ').map(|word| word.parse().ok()).collect();
        numbers.try_into().unwrap()
    };
    playground.lines("numbers.txt").iter().map(row).collect()
}

fn wait_for_pairs(run: &mut Started, playground: &Playground) {
    let before = pairs(playground).len();
    run.wait_until("pairs come", || pairs(playground).len() > before + 5);
}

#[test]
fn inputs_of_the_same_frame_stay_together_and_none_is_lost() {
    let playground = Playground::with_pipeline(&paired("lossless"));
    // The sink is the slowest stage, so that all queues before it are full, and images arrive well before the objects found in
    // them.
    let mut run = playground.start(&["run", "--set", "pairs.delay_ms=10"]);
    wait_for_pairs(&mut run, &playground);
    for stage in ["pairs", "extractor", "pairs", "source", "pairs", "assembler", "pairs"] {
        replace(&playground, &run, &[stage]);
        wait_for_pairs(&mut run, &playground);
    }
    let ended = run.end();
    let made = ended.stage("source").messages;
    let expected: Vec<_> = (0..made).map(|frame| [Some(frame); 3]).collect();
    let torn = pairs(&playground).into_iter().zip(&expected).find(|(found, expected)| found != *expected);
    assert_eq!((torn, pairs(&playground).len() as u64), (None, made), "{}", ended.stderr);
    ["objects", "depth", "ellipses"].iter().for_each(|topic| ended.expect_all(topic, "pairs", made));
}

#[test]
fn live_inputs_of_the_same_frame_are_together_again_after_three_frames() {
    let playground = Playground::with_pipeline(&paired("latest"));
    let mut run = playground.start(&["run", "--set", "source.rate_hz=30"]);
    wait_for_pairs(&mut run, &playground);
    let whole = |rows: &[[Option<u64>; 3]]| -> Vec<u64> {
        rows.iter().filter(|row| row[0] == row[1] && row[0] == row[2]).filter_map(|row| row[0]).collect()
    };
    expect_a_quick_swap("pairs", || {
        let before = pairs(&playground).len();
        replace(&playground, &run, &["pairs"]);
        wait_for_pairs(&mut run, &playground);
        longest_gap(&whole(&pairs(&playground)[before - 1..]))
    });
    run.end();
}

/// Two cameras that write the same topic. Only one of the two extractors writes `ellipses`: if both did, each would send every
/// frame, and the sink would take it only once.
const TWO_CAMERAS: &str = r#"
name = "cameras"

[stage]
left      = { node = "synthetic_source", scene = "bouncing_ball", output = "depth", width = 64, height = 48, rate_hz = 50 }
right     = { node = "synthetic_source", scene = "tabletop", output = "depth", width = 64, height = 48, rate_hz = 10 }
extractor = { node = "row_ellipse_extractor", input = { topic = "depth", delivery = "lossless" }, output = "ellipses" }
again     = { node = "row_ellipse_extractor", input = { topic = "depth", delivery = "lossless" }, output = "more" }
json      = { node = "json_sink", input = { topic = "ellipses", delivery = "lossless" }, path = "ellipses.jsonl" }
"#;

/// The camera stages and their scenes.
const CAMERAS: [(&str, &str); 2] = [("left", "bouncing_ball"), ("right", "tabletop")];

/// The frame numbers of a scene, in the order of their lines.
fn frames_of(playground: &Playground, source: &str) -> Vec<u64> {
    let lines = playground.json_lines("ellipses.jsonl");
    lines.iter().filter(|line| line["source"] == source).map(|line| line["sequence"].as_u64().unwrap()).collect()
}

#[test]
fn readers_and_writers_of_a_topic_with_several_writers_are_replaced_without_loss() {
    let playground = Playground::with_pipeline(TWO_CAMERAS);
    let mut run = playground.start(&["run"]);
    let wait = |run: &mut Started| {
        // Counts lines, because reading all numbers each time would take processor time from the stages.
        let count = || {
            let lines = playground.lines("ellipses.jsonl");
            CAMERAS.map(|(_, scene)| lines.iter().filter(|line| line.contains(scene)).count())
        };
        let before = count();
        run.wait_until("both cameras deliver", || {
            let now = count();
            now[0] > before[0] + 3 && now[1] > before[1] + 3
        });
    };
    wait(&mut run);
    for stage in ["extractor", "left", "json", "right", "extractor", "again", "left"] {
        replace(&playground, &run, &[stage]);
        wait(&mut run);
    }
    let ended = run.end();
    let mut sum = 0;
    for (source, scene) in CAMERAS {
        let made = ended.stage(source).messages;
        assert!(frames_of(&playground, scene).into_iter().eq(0..made), "{source}: {}", ended.stderr);
        sum += made;
    }
    for (topic, reader) in [("depth", "extractor"), ("ellipses", "json"), ("depth", "again")] {
        ended.expect_all(topic, reader, sum);
    }
}

/// The machine (0 robot, 1 base) of each stage of [`TRACKING`] in [`apart`].
const PLACES: [(&str, usize); 5] = [("source", 0), ("extractor", 0), ("assembler", 1), ("tracker", 1), ("json", 1)];

fn start_both([robot, base]: &[Playground; 2]) -> [Started; 2] {
    let mut runs = [start(robot, "robot"), start(base, "base")];
    runs[1].wait_until("tracks arrive", || newest(base) > 10);
    runs
}

#[test]
fn stages_on_both_sides_of_a_bridge_are_replaced_without_loss() {
    let endpoint = loopback();
    let machines = machines(&apart(&endpoint, &endpoint).replace("rate_hz    = 0", "rate_hz = 100"));
    let mut runs = start_both(&machines);
    for (stage, machine) in PLACES.into_iter().chain(PLACES) {
        replace(&machines[machine], &runs[machine], &[stage]);
        wait_for_frames(&mut runs[1], &machines[1], 10);
    }
    let [robot, base] = runs;
    let (robot, base) = (robot.end(), base.wait().expect_code(0));
    let made = robot.stage("source").messages;
    assert!(machines[1].sequences("tracks.jsonl").into_iter().eq(0..made), "{}\n{}", robot.stderr, base.stderr);
    for (topic, reader) in [("ellipses", "assembler"), ("objects", "tracker"), ("tracks", "json")] {
        base.expect_all(topic, reader, made);
    }
    assert_eq!(TRACKING_STAGES.len(), PLACES.len());
}

#[test]
fn a_live_pipeline_on_two_machines_misses_three_frames_at_most() {
    let endpoint = loopback();
    let text = apart(&endpoint, &endpoint).replace(", delivery = \"lossless\"", "");
    let machines = machines(&text.replace("rate_hz    = 0", "rate_hz = 30"));
    let mut runs = start_both(&machines);
    for (stage, machine) in [("extractor", 0), ("assembler", 1), ("tracker", 1)] {
        expect_a_quick_swap(stage, || {
            let before = machines[1].lines("tracks.jsonl").len();
            replace(&machines[machine], &runs[machine], &[stage]);
            wait_for_frames(&mut runs[1], &machines[1], 10);
            longest_gap(&machines[1].sequences_from("tracks.jsonl", before - 1))
        });
    }
    runs.into_iter().for_each(|run| drop(run.end()));
}
