//! The shared memory that a run requests at its start, compared with what it uses when all readers are stopped and all queues are
//! full.

use super::processes::{shared_files, stages_of, wait_for_standstill};
use super::support::{Playground, Started, TRACKING_TOPICS, signal, tracking_behind};
use conicflow_dataflow::pipeline::{Pipeline, SourceText};
use conicflow_dataflow::{Plan, Registry, Requirements};
use conicflow_nodes::NODES;
use rustix::process::Signal;
use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

/// A pipeline with images of 640x480, the usual size. They have no noise and a low rate, so that they cost little processor time.
pub fn pipeline(delivery: &str) -> String {
    tracking_behind(
        "node = \"synthetic_source\"\nscene = \"tabletop\"\nwidth = 640\nheight = 480\nnoise = \"ideal\"\nrate_hz = 10\n",
        delivery,
    )
}

fn needs(text: &str) -> Requirements {
    let source = SourceText { name: "pipeline.toml".to_owned(), text: text.to_owned() };
    let (pipeline, _) =
        Pipeline::read(source, &std::env::temp_dir(), &[], &Registry { nodes: NODES, network: None }).unwrap();
    Requirements::of(&Plan::of(&pipeline, None, None, 1), NODES)
}

pub fn messages(playground: &Playground, stage: &str) -> u64 {
    playground.top_stage(stage)["messages"].as_u64().unwrap()
}

/// Stops the readers one after another, from the last to the first. Waits after each until the writer has filled the queue of the
/// stopped reader.
fn fill_all_queues(playground: &Playground, run: &mut Started) {
    let stages = stages_of(run.id());
    for (_, writer, reader) in TRACKING_TOPICS.iter().rev() {
        signal(stages[*reader], Signal::STOP);
        let before = messages(playground, writer);
        run.wait_until("the queue is full", || messages(playground, writer) > before + 10);
    }
}

/// Stops the last reader, and waits until each writer is blocked by the stage after it.
fn stall(playground: &Playground, run: &mut Started) {
    signal(stages_of(run.id())["json"], Signal::STOP);
    wait_for_standstill(run, playground, "json");
}

fn bytes_of(files: &BTreeSet<PathBuf>) -> u64 {
    files.iter().filter_map(|path| Some(path.metadata().ok()?.blocks() * 512)).sum()
}

/// Number of bytes of these files that a process has used, which are fewer than it has reserved.
fn touched(process: u32, files: &BTreeSet<PathBuf>) -> u64 {
    let maps = fs::read_to_string(format!("/proc/{process}/smaps")).unwrap();
    let (mut lines, mut kilobytes) = (maps.lines(), 0);
    while lines.any(|line| line.find('/').is_some_and(|start| files.contains(Path::new(&line[start..])))) {
        let resident = lines.find_map(|line| line.strip_prefix("Rss:")?.trim().strip_suffix(" kB")).unwrap();
        kilobytes += resident.parse::<u64>().unwrap();
    }
    kilobytes * 1024
}

#[test]
fn the_shared_memory_that_a_run_requests_is_enough_and_less_than_twice_what_it_uses() {
    for delivery in ["latest", "lossless"] {
        let text = pipeline(delivery);
        let needs = needs(&text);
        let playground = Playground::with_pipeline(&text);
        let mut run = playground.start(&["run"]);
        run.wait_until("tracks come", || playground.count("tracks.jsonl") > 5);
        let fill = if delivery == "latest" { fill_all_queues } else { stall };
        fill(&playground, &mut run);
        let stages = stages_of(run.id());
        let mut used = 0;
        for (topic, writer, reader) in TRACKING_TOPICS {
            let needed = needs.topics.iter().find(|needs| needs.name == topic).unwrap().bytes;
            let files = &shared_files(stages[writer]) & &shared_files(stages[reader]);
            let taken = bytes_of(&files);
            assert!(taken <= needed, "{delivery}: {topic} takes {taken} bytes, {needed} were asked for");
            used += touched(stages[writer], &files);
        }
        let all: BTreeSet<_> = stages.values().flat_map(|process| shared_files(*process)).collect();
        let (taken, needed) = (bytes_of(&all), needs.shared_memory());
        eprintln!(
            "{delivery}: of {needed} bytes of shared memory that were asked for, {taken} are taken, {used} in use"
        );
        assert!(taken <= needed && needed < 2 * used, "{delivery}: {taken} bytes are taken, {used} in use, {needs:?}");
        stages.values().for_each(|process| signal(*process, Signal::CONT));
    }
}
