//! Replaces a stage of a running pipeline: nothing is lost, no other stage is affected, and nothing is left behind.

use crate::processes::{at_work, shared_files, stages_of, wait_for_lines};
use crate::soak::usage;
use crate::support::{Playground, Started, TRACKING, TRACKING_STAGES, TRACKING_TOPICS, signal};
use conicflow_lab::simulator::scene::Scene;
use rustix::process::Signal;
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::PathBuf;

/// Replaces a stage, and asserts that its process is another one and that all other processes are the same.
pub fn replace(playground: &Playground, run: &Started, arguments: &[&str]) {
    let before = stages_of(run.id());
    playground.conicflow(&[&["swap"], arguments].concat()).expect_code(0);
    let mut after = stages_of(run.id());
    let replaced = after.insert(arguments[0].to_owned(), before[arguments[0]]);
    assert_ne!(replaced, Some(before[arguments[0]]), "`{}` was not replaced", arguments[0]);
    assert_eq!(after, before, "only `{}` was to be replaced", arguments[0]);
}

/// Replaces a stage, and waits until the run delivers further tracks.
fn swap(playground: &Playground, run: &mut Started, arguments: &[&str]) {
    replace(playground, run, arguments);
    wait_for_lines(run, playground);
}

#[test]
fn a_lossless_pipeline_loses_nothing_when_each_of_its_stages_is_replaced() {
    let (playground, mut run) = at_work(TRACKING, 200);
    for stage in TRACKING_STAGES.into_iter().chain(TRACKING_STAGES) {
        swap(&playground, &mut run, &[stage]);
    }
    let ended = run.end();
    let made = playground.expect_each_frame(&ended);
    for (topic, _, reader) in TRACKING_TOPICS {
        ended.expect_all(topic, reader, made);
        assert_eq!(ended.stage(reader).starts, 3, "{}", ended.stderr);
    }
}

/// The largest number of frames that are missing between two successive ones.
pub fn longest_gap(frames: &[u64]) -> u64 {
    assert!(frames.is_sorted(), "frames went back: {frames:?}");
    frames.windows(2).map(|pair| pair[1] - pair[0] - 1).max().unwrap()
}

/// Number of frames that a live pipeline may lose at a swap.
const LIVE_GAP: u64 = 3;
/// Maximum number of swaps until one loses no more than [`LIVE_GAP`] frames: on a busy machine most swaps may lose more.
const TRIES: usize = 9;

/// Replaces a stage until a live pipeline loses no more frames than it may. `swap` does a swap and returns the number of lost
/// frames.
pub fn expect_a_quick_swap(stage: &str, mut swap: impl FnMut() -> u64) {
    let mut missed = Vec::new();
    while missed.len() < TRIES {
        missed.push(swap());
        if missed[missed.len() - 1] <= LIVE_GAP {
            return;
        }
    }
    panic!("frames missing at each swap of {stage}: {missed:?}");
}

#[test]
fn a_live_pipeline_misses_three_frames_at_most() {
    let (playground, mut run) = at_work(&TRACKING.replace("lossless", "latest"), 30);
    for stage in ["extractor", "assembler", "tracker"] {
        expect_a_quick_swap(stage, || {
            let before = playground.count("tracks.jsonl");
            swap(&playground, &mut run, &[stage]);
            longest_gap(&playground.sequences_from("tracks.jsonl", before - 1))
        });
    }
    run.end();
}

#[test]
fn a_stage_is_replaced_by_one_with_other_parameters_and_by_another_node() {
    let (playground, mut run) = at_work(TRACKING, 30);
    playground.conicflow(&["swap", "json", "--set", "path=other.jsonl"]).expect_code(0);
    run.wait_until("the other file grows", || playground.lines("other.jsonl").len() > 3);
    playground.conicflow(&["swap", "json", "--node", "console_sink"]).expect_code(0);
    playground.conicflow(&["swap", "json", "--node", "json_sink", "--set", "path=third.jsonl"]).expect_code(0);
    run.wait_until("the third file grows", || playground.lines("third.jsonl").len() > 3);
    let ended = run.end();
    let files = ["tracks.jsonl", "other.jsonl", "third.jsonl"].map(|name| playground.sequences(name));
    assert_eq!(files[0].last().unwrap() + 1, files[1][0], "{}", ended.stderr);
    assert!(files[1].last() < files[2].first() && files[2].is_sorted(), "{}", ended.stderr);
    assert_eq!(ended.input("tracks", "json").received, ended.stage("source").messages, "{}", ended.stderr);
}

#[test]
fn a_replacement_that_is_invalid_or_cannot_start_leaves_the_stage_at_work() {
    let (playground, mut run) = at_work(TRACKING, 30);
    let (before, plan) = (stages_of(run.id()), playground.runtime().join("run/tracking/plan.json"));
    let planned = fs::read(&plan).unwrap();
    let refused = [
        (vec!["tracker", "--set", "gatte=3"], "gatte"),
        (vec!["tracker", "--node", "row_ellipse_extractor"], "carries objects"),
        (vec!["json", "--set", "path=pipeline.toml/x.jsonl"], "could not start"),
        (vec!["json", "--set", "input=objects"], "cannot join stage `json` to other topics"),
        (vec!["trackr"], "did you mean `tracker`"),
    ];
    for (arguments, expected) in refused {
        let ended = playground.conicflow(&[&["swap"], &arguments[..]].concat()).expect_code(2);
        assert!(ended.stderr.contains(expected) && ended.stderr.contains("hint: "), "{arguments:?}: {}", ended.stderr);
        wait_for_lines(&mut run, &playground);
        assert_eq!(stages_of(run.id()), before, "{arguments:?}");
        assert!(
            fs::read(&plan).unwrap() == planned,
            "a stage that starts anew would not be what it was: {arguments:?}"
        );
    }
    let ended = run.end();
    playground.expect_each_frame(&ended);
    assert_eq!(ended.stage("json").starts, 1);
}

#[test]
fn a_source_that_cannot_start_gives_its_place_back() {
    let (playground, mut run) = at_work(TRACKING, 30);
    fs::create_dir(playground.path("frames")).unwrap();
    let refused = playground.conicflow(&["swap", "source", "--node", "image_source", "--set", "path=frames/"]);
    assert!(refused.expect_code(2).stderr.contains("the old one comes back"));
    wait_for_lines(&mut run, &playground);
    playground.expect_each_frame(&run.end());
}

#[test]
fn a_new_source_whose_frames_were_all_sent_before_reports_it() {
    let (playground, run) = at_work(TRACKING, 30);
    playground.record_with_camera(Scene::built_in("tabletop").unwrap().unwrap(), 5, 2);
    playground.conicflow(&["swap", "source", "--node", "image_source", "--set", "path=frames"]).expect_code(0);
    let ended = run.wait().expect_code(0);
    ended.expect_texts(&["stage `source` ends with nothing made: ", "goes on behind what that has sent"]);
    playground.expect_each_frame(&ended);
}

#[test]
fn an_answer_that_cannot_be_written_is_written_later_and_ends_no_run() {
    let (playground, mut run) = at_work(TRACKING, 30);
    let in_the_way = playground.runtime().join("run/tracking/swap.answer.new");
    fs::create_dir(&in_the_way).unwrap();
    let swap = playground.start(&["swap", "tracker"]);
    run.wait_for_text("the result of a swap cannot be reported, of stage `tracker`");
    wait_for_lines(&mut run, &playground);
    fs::remove_dir(&in_the_way).unwrap();
    swap.wait().expect_code(0);
    assert_eq!(run.end().stage("tracker").starts, 2);
}

/// The files in shared memory that the stages of a run use.
fn used(stages: &BTreeMap<String, u32>) -> BTreeSet<PathBuf> {
    stages.values().flat_map(|process| shared_files(*process)).collect()
}

/// Permitted growth of the memory of a neighbouring stage in kB: a few pages that the stage had not touched before.
const SLACK_KB: u64 = 512;

/// The limit of three frames applies to the median over all swaps.
#[test]
fn a_hundred_swaps_of_a_live_run_cost_no_memory_and_three_frames_each_at_most() {
    let (playground, mut run) = at_work(&TRACKING.replace("lossless", "latest"), 30);
    swap(&playground, &mut run, &["assembler"]);
    let stages = stages_of(run.id());
    let neighbours = || ["source", "json"].map(|name| usage(stages[name]).private_kb);
    let (first, before, mut all, mut missed) = (used(&stages), neighbours(), BTreeSet::new(), Vec::new());
    for stage in ["extractor", "assembler", "tracker", "assembler"].repeat(25) {
        let lines = playground.count("tracks.jsonl");
        swap(&playground, &mut run, &[stage]);
        missed.push(longest_gap(&playground.sequences_from("tracks.jsonl", lines - 1)));
        all.extend(used(&stages_of(run.id())));
    }
    assert!(all.len() > first.len() + 100, "only {} files were used, which shows little", all.len());
    let existing = all.iter().filter(|path| path.exists()).count();
    assert!(existing <= first.len(), "{existing} files are there, {} were before", first.len());
    let after = neighbours();
    missed.sort_unstable();
    eprintln!("frames missing at a swap: median {}, at most {}", missed[50], missed[99]);
    eprintln!("memory of the neighbours, kB: {before:?}, after a hundred swaps {after:?}");
    assert!(before.iter().zip(after).all(|(before, after)| after <= before + SLACK_KB), "{before:?}, {after:?}");
    assert!(missed[50] <= 3, "{missed:?}");
    let ended = run.end();
    assert_eq!((ended.stage("source").starts, ended.stage("json").starts), (1, 1), "{}", ended.stderr);
}

#[test]
fn the_death_of_a_stage_or_its_launcher_amid_a_swap_leaves_nothing_behind() {
    let (playground, mut run) = at_work(TRACKING, 30);
    for stage in ["tracker", "source"] {
        let old = stages_of(run.id())[stage];
        let swap = playground.start(&["swap", stage]);
        signal(old, Signal::KILL);
        drop(swap.wait());
        wait_for_lines(&mut run, &playground);
        let launcher = run.id();
        run.wait_until("all are back", || stages_of(launcher).len() == 5);
    }
    let swap = playground.start(&["swap", "extractor"]);
    signal(run.id(), Signal::KILL);
    let _ = swap.wait();
    drop(run.wait());
    crate::support::wait_until("all processes are gone", || playground.processes().is_empty());
    playground.conicflow(&["run", "--frames", "3", "--set", "json.path=next.jsonl"]).expect_code(0);
    assert_eq!(playground.sequences("next.jsonl"), [0, 1, 2]);
}
