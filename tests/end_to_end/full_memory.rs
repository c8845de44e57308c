//! Other programs that fill shared memory under a running pipeline, which needs root and `unshare`.

use super::own_memory::OwnSharedMemory;
use super::processes::stages_of;
use super::room::{messages, pipeline};
use super::support::{Playground, signal};
use rustix::fs::{FallocateFlags, fallocate, statvfs};
use rustix::process::Signal;
use std::fs::File;

/// Less than an image, and enough for lists.
const SPARE: u64 = 512 * 1024;

/// Takes what is free, but for that.
fn fill(memory: &OwnSharedMemory) {
    let free = || statvfs(memory.folder()).map(|about| about.f_bavail * about.f_frsize).unwrap();
    let file = File::create(memory.folder().join("of_another_program")).unwrap();
    fallocate(&file, FallocateFlags::empty(), 0, free() - SPARE).unwrap();
    assert!(free() <= SPARE);
}

#[test]
fn a_run_at_work_goes_on_where_others_fill_shared_memory() {
    let Some(memory) = OwnSharedMemory::new("32m") else { return };
    let playground = Playground::with_pipeline(&pipeline("latest"));
    let mut run = memory.start(&playground, &["run"]);
    run.wait_until("tracks come", || playground.lines("tracks.jsonl").len() > 5);
    fill(&memory);
    // Only now the queue fills, with images that had not been under way at once before.
    let stages = stages_of(run.id());
    signal(stages["extractor"], Signal::STOP);
    let before = messages(&playground, "source");
    run.wait_until("the queue is full", || messages(&playground, "source") > before + 20);
    signal(stages["extractor"], Signal::CONT);
    let before = playground.lines("tracks.jsonl").len();
    run.wait_until("tracks come again", || playground.lines("tracks.jsonl").len() > before + 5);
    let ended = run.end();
    stages.keys().for_each(|stage| assert_eq!(ended.stage(stage).starts, 1, "{}", ended.stderr));
    assert_eq!(memory.files(), ["of_another_program"]);
}
