//! Tracks keep their identities when stages before the tracker are killed or replaced, which costs only frames.

use crate::processes::{stages_of, wait_for_lines};
use crate::support::{Playground, Started, TRACKING, signal};
use rustix::process::Signal;
use serde_json::Value as Json;
use std::collections::BTreeSet;

/// A ball that swings to and fro, is always in view, and is slow enough at its turning points to be associated again after
/// seconds without a frame.
const SCENE: &str = r#"
name = "to and fro"

[camera]
position  = [0.0, 0.0, 0.0]
direction = [0.0, 1.0, 0.0]

[[sphere]]
name   = "ball"
center = [-0.08, 1.5, 0.0]
radius = 0.08
motion.path = { points = [{ t_s = 0, offset = [0, 0, 0] }, { t_s = 20, offset = [0.16, 0, 0] }], then = "return" }
"#;

fn start(playground: &Playground) -> Started {
    playground.write("scene.toml", SCENE);
    let mut run = playground.start(&["run", "--set", "source.rate_hz=50", "--set", "source.scene=scene.toml"]);
    run.wait_until("a track is confirmed", || !confirmed(&playground.json_lines("tracks.jsonl")).is_empty());
    run
}

/// The identities of the confirmed tracks.
fn confirmed(frames: &[Json]) -> BTreeSet<u64> {
    let tracks = frames.iter().flat_map(|frame| frame["tracks"].as_array().unwrap());
    tracks.filter(|track| track["state"] != "tentative").map(|track| track["id"].as_u64().unwrap()).collect()
}

/// Kills and replaces each stage before the tracker; then the tracker, which gives new identities.
fn restart_what_comes_before(delivery: &str) {
    let playground = Playground::with_pipeline(&TRACKING.replace("lossless", delivery));
    let mut run = start(&playground);
    let first = confirmed(&playground.json_lines("tracks.jsonl"));
    for stage in ["source", "extractor", "assembler"] {
        let before = stages_of(run.id())[stage];
        signal(before, Signal::KILL);
        let launcher = run.id();
        run.wait_until("it is started anew", || stages_of(launcher).get(stage).is_some_and(|now| *now != before));
        wait_for_lines(&mut run, &playground);
        playground.conicflow(&["swap", stage]).expect_code(0);
        wait_for_lines(&mut run, &playground);
    }
    let frames = playground.json_lines("tracks.jsonl");
    assert_eq!((first.len(), confirmed(&frames)), (1, first), "{}", run.stderr());
    playground.conicflow(&["swap", "tracker"]).expect_code(0);
    let seen = frames.len();
    let later = || confirmed(&playground.json_lines("tracks.jsonl")).into_iter().max();
    run.wait_until("the new tracker confirms", || later() > confirmed(&frames).into_iter().max());
    signal(run.id(), Signal::INT);
    let ended = run.wait().expect_survived();
    for stage in ["source", "extractor", "assembler"] {
        assert_eq!(ended.stage(stage).starts, 3, "{}", ended.stderr);
    }
    assert!(playground.lines("tracks.jsonl").len() > seen);
}

#[test]
fn identities_are_kept_across_a_restart_on_lossless_topics() {
    restart_what_comes_before("lossless");
}

#[test]
fn identities_are_kept_across_a_restart_with_latest() {
    restart_what_comes_before("latest");
}
