//! Memory that runs out: other programs fill shared memory under a running pipeline, which needs root and `unshare`, and a stage
//! exceeds its limit.

use super::own_memory::OwnSharedMemory;
use super::processes::stages_of;
use super::room::{messages, pipeline};
use super::support::{Playground, TRACKING, signal, wait_until};
use rustix::fs::{FallocateFlags, fallocate, statvfs};
use rustix::process::Signal;
use std::fs::File;

/// Number of free bytes that the test leaves in shared memory: too few for an image, and enough for lists.
const SPARE: u64 = 512 * 1024;

/// Fills shared memory, except [`SPARE`] bytes.
fn fill(memory: &OwnSharedMemory) {
    let free = || statvfs(memory.folder()).map(|about| about.f_bavail * about.f_frsize).unwrap();
    let file = File::create(memory.folder().join("of_another_program")).unwrap();
    fallocate(&file, FallocateFlags::empty(), 0, free() - SPARE).unwrap();
    assert!(free() <= SPARE);
}

#[test]
fn a_run_goes_on_when_other_programs_fill_shared_memory() {
    let Some(memory) = OwnSharedMemory::new("32m") else { return };
    let playground = Playground::outside_shared_memory().and_pipeline(&pipeline("latest"));
    let mut run = memory.start(&playground, &["run"]);
    run.wait_until("tracks come", || playground.count("tracks.jsonl") > 5);
    fill(&memory);
    // The stopped extractor lets the queue fill up while memory is full: more images are under way at once than before.
    let stages = stages_of(run.id());
    signal(stages["extractor"], Signal::STOP);
    let before = messages(&playground, "source");
    run.wait_until("the queue is full", || messages(&playground, "source") > before + 20);
    signal(stages["extractor"], Signal::CONT);
    let before = playground.count("tracks.jsonl");
    run.wait_until("tracks come again", || playground.count("tracks.jsonl") > before + 5);
    let ended = run.end();
    stages.keys().for_each(|stage| assert_eq!(ended.stage(stage).starts, 1, "{}", ended.stderr));
    assert_eq!(memory.files(), ["of_another_program"]);
}

/// Only the process of the stage has a memory limit, which the shell sets with `ulimit`.
#[test]
fn a_stage_that_takes_more_memory_than_it_may_have_is_named_and_the_others_deliver_all() {
    const FRAMES: u64 = 60;
    let eater = r#"
[stage.eater]
program = ["sh", "-c", "ulimit -v 100000; x=xxxxxxxx; while :; do x=$x$x; done"]
input   = "objects"
restart = "never"
"#;
    let text = TRACKING.replace("rate_hz    = 0", &format!("rate_hz = 50\nframes = {FRAMES}")) + eater;
    let playground = Playground::with_pipeline(&text);
    let ended = playground.conicflow(&["run"]).expect_code(1);
    let died: Vec<_> = ended.stderr.lines().filter(|line| line.contains("ERROR stage `")).collect();
    assert!(died.len() == 1 && died[0].contains("stage `eater` "), "{}", ended.stderr);
    // Depending on the shell, the process is killed by a signal or ends with an exit code.
    let says_of_what = ["was killed by signal ", "ended with exit code "].iter().any(|what| died[0].contains(what));
    assert!(says_of_what && died[0].contains(", and is not started anew: its `restart` is "), "{}", ended.stderr);
    ended.expect_texts(&["not complete: a stage was lost, see above"]);
    assert_eq!(playground.expect_each_frame(&ended), FRAMES);
    for stage in ["source", "extractor", "assembler", "tracker", "json"] {
        assert_eq!(ended.stage(stage).starts, 1, "{}", ended.stderr);
    }
    wait_until("no process is left", || playground.processes().is_empty());
}
