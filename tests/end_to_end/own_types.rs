//! Item types of programs of one's own, which the pipeline file describes and `conicflow` itself does not know.

use crate::bridge::{link, loopback, machines, placed, start, without_times};
use crate::support::{Playground, TRACKING, example, signal};
use rustix::process::Signal;
use serde_json::{Value as Json, json};

const FIELDS: &str = r#"{ position = "f64[3]", width = "f64", id = "u32", shape = "text[12]" }"#;

/// [`TRACKING`] up to the objects, which the program `grasps` turns into items of its own type, of these fields, and reads.
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

/// What the planner makes of a line of objects.
fn grasps_of(line: &Json) -> Json {
    let objects = line["objects"].as_array().unwrap().iter().enumerate();
    let grasps = objects.map(|(id, object)| {
        let width = 2.0 * object["radius"].as_f64().unwrap();
        json!({ "position": object["center"], "width": width, "id": id, "shape": object["kind"] })
    });
    grasps.collect()
}

/// What the gripper notes of a line of grasps.
fn notes_of(line: &Json) -> Vec<String> {
    let note = |grasp: &Json| {
        let words = [&grasp["id"], &grasp["shape"]].map(|value| value.to_string().replace('"', ""));
        let numbers = grasp["position"].as_array().unwrap().iter().chain([&grasp["width"]]);
        let numbers: Vec<_> = numbers.map(|number| number.as_f64().unwrap().to_string()).collect();
        format!("{} {} {}", line["sequence"], words.join(" "), numbers.join(" "))
    };
    line["grasps"].as_array().unwrap().iter().map(note).collect()
}

#[test]
fn a_type_of_ones_own_is_checked_carried_and_written_with_its_fields() {
    let playground = Playground::with_pipeline(&with_grasps(FIELDS));
    playground.conicflow(&["validate"]).expect_code(0);
    playground.conicflow(&["run", "--frames", "20"]).expect_code(0);
    let (objects, grasps) = (playground.json_lines("objects.jsonl"), playground.json_lines("grasps.jsonl"));
    assert_eq!((objects.len(), grasps.len()), (20, 20));
    assert!(grasps.iter().any(|line| line["grasps"][0]["shape"] == "sphere"), "{grasps:?}");
    for (line, made) in objects.iter().zip(&grasps) {
        assert_eq!((&made["sequence"], &made["grasps"]), (&line["sequence"], &grasps_of(line)));
    }
    let notes: Vec<_> = grasps.iter().flat_map(notes_of).collect();
    assert_eq!(playground.lines("taken.txt"), notes);
}

#[test]
fn who_looks_on_sees_it_as_well() {
    let playground = Playground::with_pipeline(&with_grasps(FIELDS));
    let mut run = playground.start(&["run", "--set", "source.rate_hz=50"]);
    run.wait_until("it delivers", || !playground.lines("grasps.jsonl").is_empty());
    let list = playground.conicflow(&["topic", "list"]).expect_code(0).stdout;
    assert!(list.lines().any(|line| line.starts_with("grasps ") && line.contains(" grasps ")), "{list}");
    let echo = playground.conicflow(&["topic", "echo", "grasps", "--count", "3"]).expect_code(0).stdout;
    let seen: Vec<Json> = echo.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    signal(run.id(), Signal::INT);
    run.wait().expect_code(0);
    let written = playground.json_lines("grasps.jsonl");
    assert_eq!(seen.len(), 3);
    for line in seen {
        let same = written.iter().find(|written| written["sequence"] == line["sequence"]).unwrap();
        assert_eq!(same["grasps"], line["grasps"]);
    }
}

#[test]
fn it_crosses_to_another_machine_bit_for_bit() {
    let alone = Playground::with_pipeline(&with_grasps(FIELDS));
    alone.conicflow(&["run", "--frames", "100"]).expect_code(0);
    let expected = without_times(&alone, "grasps.jsonl");
    let (on_robot, on_base) = (["source", "extractor", "assembler", "planner", "objects"], ["gripper", "json"]);
    let places: Vec<_> =
        on_robot.map(|stage| (stage, "robot")).into_iter().chain(on_base.map(|stage| (stage, "base"))).collect();
    let endpoint = loopback();
    let text = placed(&with_grasps(FIELDS), &places);
    let text =
        format!("{text}\n[machine.robot]\nlisten = [\"{endpoint}\"]\n[machine.base]\nconnect = [\"{endpoint}\"]\n");
    let [robot, base] = machines(&text);
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
    let told = "topic `grasps` carries another type of message than `acme.Grasp.v1`, 48 bytes, aligned to 8: the pipeline \
                file says `acme.Grasp.v1`, 32 bytes, aligned to 4\n  hint: let `type` and `fields` under [item.grasps] be \
                those of the program";
    assert!(ended.stderr.contains(told), "{}", ended.stderr);
}
