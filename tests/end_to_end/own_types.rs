//! Item types of a user's programs, which the pipeline file describes and `conicflow` itself does not know.

use crate::bridge::{joined, link, loopback, machines, start, without_times};
use crate::support::{Playground, TRACKING, example};
use serde_json::Value as Json;

const FIELDS: &str = r#"{ position = "f64[3]", width = "f64", id = "u32", shape = "text[12]" }"#;

/// [`TRACKING`] up to the objects. The program `grasps` turns these into items of its own type with these fields, and reads them
/// again.
fn with_grasps(fields: &str) -> String {
    let (before, _) = TRACKING.split_once("[stage.tracker]").unwrap();
    let program = example("grasps");
    format!(
        r#"{before}
[item.grasps]
type   = "acme.Grasp.v1"
fields = {fields}

[stage.planner]
program = ["{program}", "plan"]
input   = {{ topic = "objects", delivery = "lossless" }}
output  = {{ topic = "grasps", kind = "grasps" }}

[stage.gripper]
program = ["{program}", "take"]
input   = {{ topic = "grasps", delivery = "lossless" }}

[stage.objects]
node  = "json_sink"
input = {{ topic = "objects", delivery = "lossless" }}
path  = "objects.jsonl"

[stage.json]
node  = "json_sink"
input = {{ topic = "grasps", delivery = "lossless" }}
path  = "grasps.jsonl"
"#
    )
}

/// A grasp: a text with the number of its frame, its own number and its shape, and its numeric values.
type GraspInWords = (String, Vec<f64>);

fn number(value: &Json) -> f64 {
    value.as_f64().unwrap()
}

fn grasp_in_words(line: &Json, id: &Json, shape: &Json, place: &Json, width: f64) -> GraspInWords {
    let words = format!("{} {id} {}", line["sequence"], shape.as_str().unwrap());
    (words, place.as_array().unwrap().iter().map(number).chain([width]).collect())
}

/// The grasps that the planner derives from a line of objects.
fn planned(line: &Json) -> Vec<GraspInWords> {
    let objects = line["objects"].as_array().unwrap().iter().enumerate();
    let plan = |(id, object): (usize, &Json)| {
        grasp_in_words(line, &id.into(), &object["kind"], &object["center"], 2.0 * number(&object["radius"]))
    };
    objects.map(plan).collect()
}

/// The grasps in a line of JSON.
fn written(line: &Json) -> Vec<GraspInWords> {
    let grasps = line["grasps"].as_array().unwrap().iter();
    let grasp_of =
        |grasp: &Json| grasp_in_words(line, &grasp["id"], &grasp["shape"], &grasp["position"], number(&grasp["width"]));
    grasps.map(grasp_of).collect()
}

/// The grasp in a line of the gripper: frame, number, shape, and four numbers.
fn noted(line: &str) -> GraspInWords {
    let words: Vec<_> = line.split(' ').collect();
    (words[..3].join(" "), words[3..].iter().map(|number| number.parse().unwrap()).collect())
}

/// Asserts that both are equal up to the last digit, which may change when a number is read from JSON.
fn expect_same(some: &[GraspInWords], others: &[GraspInWords]) {
    assert_eq!(some.len(), others.len());
    for ((words, numbers), (other_words, other_numbers)) in some.iter().zip(others) {
        assert_eq!((words, numbers.len()), (other_words, other_numbers.len()));
        let close = numbers.iter().zip(other_numbers).all(|(number, other)| (number - other).abs() < 1e-12);
        assert!(close, "{numbers:?} {other_numbers:?}");
    }
}

#[test]
fn an_item_type_of_the_user_is_checked_carried_and_written_with_its_fields() {
    let playground = Playground::with_pipeline(&with_grasps(FIELDS));
    playground.conicflow(&["validate"]).expect_code(0);
    playground.conicflow(&["run", "--frames", "20"]).expect_code(0);
    let (objects, grasps) = (playground.json_lines("objects.jsonl"), playground.json_lines("grasps.jsonl"));
    assert_eq!((objects.len(), grasps.len()), (20, 20));
    assert!(grasps.iter().any(|line| line["grasps"][0]["shape"] == "sphere"), "{grasps:?}");
    assert_eq!(playground.sequences("grasps.jsonl"), (0..20).collect::<Vec<_>>());
    let of_all = |lines: &[Json], grasps_of: fn(&Json) -> Vec<GraspInWords>| {
        lines.iter().flat_map(grasps_of).collect::<Vec<_>>()
    };
    expect_same(&of_all(&grasps, written), &of_all(&objects, planned));
    let notes: Vec<_> = playground.lines("taken.txt").iter().map(|line| noted(line)).collect();
    expect_same(&notes, &of_all(&grasps, written));
}

#[test]
fn the_topic_command_shows_an_item_type_of_the_user() {
    let playground = Playground::with_pipeline(&with_grasps(FIELDS));
    let mut run = playground.start(&["run", "--set", "source.rate_hz=50"]);
    run.wait_until("it delivers", || !playground.lines("grasps.jsonl").is_empty());
    let list = playground.conicflow(&["topic", "list"]).expect_code(0).stdout;
    assert!(list.lines().any(|line| line.starts_with("grasps ") && line.contains(" grasps ")), "{list}");
    let echo = playground.conicflow(&["topic", "echo", "grasps", "--count", "3"]).expect_code(0).stdout;
    let echoed: Vec<Json> = echo.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    run.end();
    let lines = playground.json_lines("grasps.jsonl");
    assert_eq!(echoed.len(), 3);
    for line in echoed {
        let same = lines.iter().find(|written| written["sequence"] == line["sequence"]).unwrap();
        assert_eq!(same["grasps"], line["grasps"]);
    }
}

#[test]
fn an_item_type_of_the_user_crosses_to_another_machine_bit_for_bit() {
    let alone = Playground::with_pipeline(&with_grasps(FIELDS));
    alone.conicflow(&["run", "--frames", "100"]).expect_code(0);
    let expected = without_times(&alone, "grasps.jsonl");
    let (on_robot, on_base) = (["source", "extractor", "assembler", "planner", "objects"], ["gripper", "json"]);
    let places: Vec<_> =
        on_robot.map(|stage| (stage, "robot")).into_iter().chain(on_base.map(|stage| (stage, "base"))).collect();
    let endpoint = loopback();
    let [robot, base] = machines(&joined(&with_grasps(FIELDS), &places, &endpoint, &endpoint));
    let receiving = start(&base, "base");
    let sent = robot.conicflow(&["run", "--machine", "robot", "--frames", "100"]).expect_code(0);
    receiving.wait().expect_code(0);
    assert_eq!(link(&sent, "base", "grasps")[..2], [100, 0]);
    assert_eq!(without_times(&base, "grasps.jsonl"), expected);
    assert_eq!(base.lines("taken.txt"), alone.lines("taken.txt"));
}

#[test]
fn fields_that_are_not_those_of_the_program_end_the_run() {
    let other = r#"{ position = "f32[3]", width = "f32", id = "u32", shape = "text[12]" }"#;
    let playground = Playground::with_pipeline(&with_grasps(other));
    let ended = playground.conicflow(&["run", "--frames", "3"]).expect_code(1);
    let expected = "topic `grasps` carries another type of message than `acme.Grasp.v1`, 48 bytes, aligned to 8: the pipeline \
                file says `acme.Grasp.v1`, 32 bytes, aligned to 4\n  hint: let `type` and `fields` under [item.grasps] be \
                those of the program";
    ended.expect_texts(&[expected]);
}
