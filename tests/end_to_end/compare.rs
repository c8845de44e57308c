//! `conicflow compare`: two variants of a pipeline on the same frames.

use crate::support::{Playground, read_png, signal, tracking_behind};
use crate::view::{Page, items};
use conicflow_lab::simulator::scene::Scene;
use rustix::process::Signal;
use serde_json::{Value as Json, json};
use std::fs;

/// A simulated table. Its sinks must not run in a comparison, and its stages have inputs with `latest`.
pub fn simulated() -> String {
    tracking_behind(TABLETOP, "latest")
}

const TABLETOP: &str = r#"
node    = "synthetic_source"
scene   = "tabletop"
width   = 320
height  = 240
rate_hz = 0
frames  = 8
"#;

/// The settings of the paper's way.
pub const PAPER: [&str; 3] = ["extractor.arcs=conic", "extractor.scan=rows", "assembler.method=profile"];

fn compared(playground: &Playground, arguments: &[&str]) -> Json {
    let ended = playground.conicflow(&[&["compare", "--json"], arguments].concat()).expect_code(0);
    serde_json::from_str(&ended.stdout).unwrap_or_else(|error| panic!("{error}: {}", ended.stdout))
}

/// Sum of a column over all kinds of objects.
fn sum(compared: &Json, column: &str) -> u64 {
    compared["found"].as_object().unwrap().values().map(|counts| counts[column].as_u64().unwrap()).sum()
}

#[test]
fn the_same_variant_under_another_name_is_identical_bit_for_bit() {
    let playground = Playground::with_pipeline(&simulated());
    let compared = compared(&playground, &["--b", "extractor.scan=both"]);
    assert_eq!((compared["frames"].as_u64(), compared["same_frames"].as_u64()), (Some(8), Some(8)));
    assert_eq!((sum(&compared, "a"), sum(&compared, "both")), (sum(&compared, "b"), sum(&compared, "a")));
    assert!(sum(&compared, "a") >= 8, "{compared}");
    assert_eq!(compared["differences"]["position_mm"]["greatest"], 0.0);
    assert!(compared["unlike"].as_array().unwrap().is_empty());
    assert!(!playground.path("tracks.jsonl").exists(), "the sinks of the file do not run");
}

#[test]
fn the_papers_method_differs_and_both_are_scored_as_by_an_evaluation_sink() {
    let playground = Playground::with_pipeline(&simulated());
    let compared = compared(&playground, &[&["--a"], &PAPER[..], &["--b", "extractor.scan=rows"]].concat());
    assert_eq!(compared["same_frames"], 0);
    for [variant, alone] in [["a", "only_a"], ["b", "only_b"]] {
        let of_other_kind: u64 =
            compared["other_kind"].as_array().unwrap().iter().map(|row| row["times"].as_u64().unwrap()).sum();
        let counted = sum(&compared, "both") + sum(&compared, alone) + of_other_kind;
        assert_eq!(sum(&compared, variant), counted, "{compared}");
    }
    assert!(compared["differences"]["position_mm"]["greatest"].as_f64().unwrap() > 0.1);
    assert!(["extractor", "assembler"].iter().all(|stage| {
        ["a", "b"].iter().all(|variant| compared[variant]["times_ms"][stage]["p50"].as_f64().unwrap() > 0.0)
    }));
    let score = "[stage.score]\nnode = \"evaluation_sink\"\npath = \"score.jsonl\"\n\
                 input = { topic = \"objects\", delivery = \"lossless\" }\n";
    playground.write("scored.toml", &(tracking_behind(TABLETOP, "lossless") + score));
    playground.conicflow(&["run", "scored.toml", "--quiet", "--set", "extractor.scan=rows"]).expect_code(0);
    let score = playground.json_lines("score.jsonl").remove(0);
    for column in ["to_find", "found", "wrong", "f1", "radius_error_mm"] {
        assert!(score[column].is_number(), "{score}");
        assert_eq!(compared["b"]["score"][column], score[column], "{column}");
    }
    assert_ne!(compared["a"]["score"]["radius_error_mm"], score["radius_error_mm"]);
}

#[test]
fn recorded_frames_without_a_truth_are_compared_in_tables_and_pictures() {
    let source = "node = \"image_source\"\npath = \"frames\"\nposes = \"none\"\nrate_hz = 0\n";
    let playground = Playground::with_pipeline(&tracking_behind(source, "latest"));
    playground.record_with_camera(Scene::built_in("tabletop").unwrap().unwrap(), 5, 3);
    let what = ["compare", "--b", "extractor.node=ransac_ellipse_extractor", "--frames", "2"];
    let ended = playground.conicflow(&[&what[..], &["--pictures", "pictures", "--zoom", "2"]].concat()).expect_code(0);
    let text = &ended.stdout;
    assert!(
        text.starts_with("a: the file as it stands\nb: extractor.node=ransac_ellipse_extractor\n2 frames, "),
        "{text}"
    );
    assert!(text.contains("\nFOUND ") && text.contains("\nTIME ") && !text.contains("TRUTH"), "{text}");
    let names: Vec<_> = fs::read_dir(playground.path("pictures")).unwrap().map(|entry| entry.unwrap().path()).collect();
    assert_eq!(names.len(), 2);
    let (info, _) = read_png(&names[0]);
    assert_eq!((info.width, info.height), (2 * 640 + 4, 480));
}

#[test]
fn both_recordings_are_shown_together_and_matched_as_they_were_compared() {
    let playground = Playground::with_pipeline(&simulated());
    let compared = compared(&playground, &[&["--record", "kept", "--a"], &PAPER[..]].concat());
    let page = Page::open(&playground, &["kept/a.mcap", "kept/b.mcap"]);
    page.send_command(&json!({ "do": "pause" }));
    page.send_command(&json!({ "do": "seek", "at_s": 0.0 }));
    let (mut both, mut alone) = (0, [0, 0]);
    for sequence in 0..8 {
        let is_it = |json: &Json| json["frame"]["sequence"] == sequence && json["player"]["plays"] == false;
        let (json, pixels) = page.frame("the frame", is_it);
        assert_eq!(json["about"]["variants"], json!(["a.mcap", "b.mcap"]));
        assert!(json["frame"]["compared"] == true && !pixels.is_empty());
        let found = items(&json);
        let paired = |item: &&Json| item["pair"].is_u64();
        for item in found.iter().filter(paired) {
            let other = &found[item["pair"].as_u64().unwrap() as usize];
            assert!(other["variant"] != item["variant"] && other["difference"] == item["difference"], "{item}");
        }
        both += found.iter().filter(paired).count() as u64 / 2;
        for (count, variant) in alone.iter_mut().zip(["a", "b"]) {
            *count += found.iter().filter(|item| item["variant"] == variant && !paired(item)).count() as u64;
        }
        page.send_command(&json!({ "do": "step", "by": 1 }));
    }
    let of_other_kind: u64 =
        compared["other_kind"].as_array().unwrap().iter().map(|row| row["times"].as_u64().unwrap()).sum();
    assert_eq!(both, sum(&compared, "both") + of_other_kind, "{compared}");
    assert_eq!(alone, [sum(&compared, "only_a"), sum(&compared, "only_b")], "{compared}");

    let (page, first) = (Page::open(&playground, &["kept/a.mcap", "kept/a.mcap"]), |_: &Json| true);
    let (json, _) = page.frame("a recording beside itself", first);
    assert!(items(&json).iter().all(|item| item["difference"]["position_m"] == 0.0), "{json}");
    fs::write(playground.path("none.mcap"), b"").unwrap();
    let refused = playground.conicflow(&["view", "kept/a.mcap", "none.mcap"]);
    assert!(refused.code != Some(0) && refused.stderr.contains("none.mcap"), "{}", refused.stderr);
}

#[test]
fn tracks_are_compared_on_request() {
    let playground = Playground::with_pipeline(&simulated());
    let compared = compared(&playground, &["--topic", "tracks", "--b", "tracker.acceleration=9.0"]);
    assert_eq!(compared["topic"], "tracks");
    assert!(compared["b"]["times_ms"]["tracker"]["p50"].is_number() && sum(&compared, "both") > 0, "{compared}");
}

#[test]
fn errors_name_the_variant_that_they_are_in() {
    let playground = Playground::with_pipeline(&simulated());
    let log = |arguments: &[&str], code: i32| {
        let ended = playground.conicflow(&[&["compare"], arguments].concat()).expect_code(code);
        assert_eq!(ended.stdout, "");
        ended.stderr
    };
    let wrong_b = log(&["--a", "extractor.scan=rows", "--b", "extractor.scna=rows"], 2);
    assert!(
        wrong_b.starts_with("variant b, extractor.scna=rows:\nerror: --set:1:1: ") && wrong_b.contains("`scan`?"),
        "{wrong_b}"
    );
    let wrong_both = log(&["--set", "extractor.scna=rows", "--b", "extractor.line_step=2"], 2);
    assert!(wrong_both.starts_with("error: --set:1:1: unknown key `scna`"), "{wrong_both}");
    assert!(log(&[], 2).starts_with("error: the variants are the same\n  hint: "));
    let topic = log(&["--topic", "cones", "--b", "extractor.scan=rows"], 2);
    assert!(
        topic.contains("no stage writes objects or tracks to a topic `cones`") && topic.contains("`tracks`"),
        "{topic}"
    );
    let other_frames = log(&["--b", "source.scene=bouncing_ball"], 2);
    assert!(other_frames.contains("did not see the same frames: a has frame 0 of `tabletop`"), "{other_frames}");
}

#[test]
fn a_comparison_that_is_interrupted_early_reports_that_there_is_nothing_to_compare() {
    let playground = Playground::with_pipeline(&simulated());
    let paced = ["--set", "source.rate_hz=20", "--set", "source.frames=100000"];
    let mut compare = playground.start(&[&["compare", "--b", "extractor.scan=rows"][..], &paced].concat());
    // At this time five processes run: `conicflow compare` and the four stages of its first run.
    compare.wait_until("the first variant runs", || playground.processes().len() >= 5);
    signal(compare.id(), Signal::INT);
    let ended = compare.wait().expect_code(1);
    assert!(
        ended.stdout.is_empty() && ended.stderr.contains("variant a was disturbed, or not finished"),
        "{}",
        ended.stderr
    );
    assert!(!ended.stderr.contains("variant b"), "{}", ended.stderr);
    assert!(ended.stderr.contains("hint: `--frames N` ends both variants"), "{}", ended.stderr);
}
