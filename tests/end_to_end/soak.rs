//! A long live run: memory, open files and shared memory do not grow. This command runs it for an hour, and prints its latencies:
//! `CONICFLOW_SOAK_S=3600 cargo test --release --test end_to_end -- soak --nocapture`

use crate::processes::{files_in_shared_memory, shared_files, shared_prefix, stages_of};
use crate::support::{Playground, Started, TRACKING, TRACKING_STAGES};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::PathBuf;
use std::time::{Duration, Instant};

const SECONDS: &str = "CONICFLOW_SOAK_S";
const DEFAULT_SECONDS: u64 = 12;
const SAMPLES: u64 = 60;
/// Number of frames after which each stage has allocated all its memory.
const WARM_UP_FRAMES: u64 = 100;
/// Permitted growth of a process in kB: a few pages that it had not touched before.
const SLACK_KB: u64 = 512;
/// Maximum resident memory of a stage in kB after the first frames.
const MOST_RESIDENT_KB: u64 = 10 * 1024;
const MOST_THREADS: usize = 3;

/// Resources that a stage uses at one moment.
#[derive(Clone, Copy, Debug)]
pub struct Usage {
    /// Private resident memory in kB.
    pub private_kb: u64,
    /// All resident memory in kB, including the program and the libraries, which all stages share.
    resident_kb: u64,
    threads: usize,
    open_files: usize,
}

pub fn usage(process: u32) -> Usage {
    let rollup = fs::read_to_string(format!("/proc/{process}/smaps_rollup")).unwrap();
    let field = |line: &str| line.split_whitespace().nth(1).unwrap().parse::<u64>().unwrap();
    let sum = |title: &str| rollup.lines().filter(|line| line.starts_with(title)).map(field).sum();
    let entries = |name: &str| fs::read_dir(format!("/proc/{process}/{name}")).unwrap().count();
    let (threads, open_files) = (entries("task"), entries("fd"));
    Usage { private_kb: sum("Private_"), resident_kb: sum("Rss:"), threads, open_files }
}

/// Number and bytes of the files in shared memory that the stages use.
fn shared(stages: &BTreeMap<String, u32>) -> (usize, u64) {
    let files: BTreeSet<PathBuf> = stages.values().flat_map(|process| shared_files(*process)).collect();
    (files.len(), files.iter().filter_map(|path| Some(path.metadata().ok()?.len())).sum())
}

struct Sample {
    stages: BTreeMap<String, Usage>,
    shared: (usize, u64),
}

fn sample(run: &Started) -> Sample {
    let stages = stages_of(run.id());
    let shared = shared(&stages);
    Sample { stages: stages.into_iter().map(|(name, process)| (name, usage(process))).collect(), shared }
}

/// Medians in milliseconds of the latencies of the first and the last tenth of the frames that follow the first tenth.
fn latencies(playground: &Playground) -> (f64, f64) {
    let lines = playground.json_lines("tracks.jsonl");
    let all: Vec<f64> = lines.iter().map(|line| line["latency_ms"].as_f64().unwrap()).collect();
    let tenth = all.len() / 10;
    let median = |part: &[f64]| {
        let mut sorted = part.to_vec();
        sorted.sort_by(f64::total_cmp);
        sorted[sorted.len() / 2]
    };
    (median(&all[tenth..2 * tenth]), median(&all[all.len() - tenth..]))
}

#[test]
fn a_long_run_uses_no_more_memory_and_files_at_its_end_than_at_its_beginning() {
    let asked = std::env::var(SECONDS).ok().map(|text| text.parse().unwrap());
    let seconds = asked.unwrap_or(DEFAULT_SECONDS);
    let live = TRACKING.replace("lossless", "latest");
    let playground = Playground::with_pipeline(&live);
    // A leak at each frame also shows with small images, which take a third of the processor time.
    let (width, height) = if asked.is_some() { (640, 480) } else { (160, 120) };
    let (focal, cx, cy) = (width * 525 / 640, f64::from(width - 1) / 2.0, f64::from(height - 1) / 2.0);
    let camera = format!("source.intrinsics={{ fx = {focal}, fy = {focal}, cx = {cx:?}, cy = {cy:?} }}");
    let size = [format!("source.width={width}"), format!("source.height={height}")];
    let sets = [&size[0], &size[1], &camera, "source.rate_hz=30", "source.scene=tabletop"];
    let sets = sets.into_iter().flat_map(|set| ["--set", set]);
    let mut run = playground.start(&["run"].into_iter().chain(sets).collect::<Vec<_>>());
    run.wait_until("the stages are warm", || playground.newest("tracks.jsonl") > WARM_UP_FRAMES);
    let prefix = shared_prefix(&playground);
    let begin = Instant::now();
    let due = |number: u64| begin + Duration::from_secs_f64(seconds as f64 * number as f64 / SAMPLES as f64);
    let mut samples = Vec::new();
    for number in 0..=SAMPLES {
        run.wait_until("the next look is due", || Instant::now() >= due(number));
        samples.push(sample(&run));
    }
    let ended = run.end();
    assert_eq!(files_in_shared_memory(&prefix), [""; 0], "left in shared memory");
    // The first fifth of the samples does not count.
    let (first, last) = (&samples[samples.len() / 5], samples.last().unwrap());
    // A stage may have a file open for a moment, so the number of open files is the minimum of several samples.
    const LOOKS: usize = 6;
    let (early, late) = (&samples[samples.len() / 5..][..LOOKS], &samples[samples.len() - LOOKS..]);
    let open_files =
        |part: &[Sample], stage: &str| part.iter().map(|sample| sample.stages[stage].open_files).min().unwrap();
    for stage in TRACKING_STAGES {
        let (before, after) = (first.stages[stage], last.stages[stage]);
        println!("{stage}: {before:?}, after {seconds} s {after:?}");
        assert!(after.private_kb <= before.private_kb + SLACK_KB, "{stage}: {before:?}, {after:?}");
        assert_eq!(open_files(late, stage), open_files(early, stage), "{stage}");
        assert!(after.threads <= MOST_THREADS, "{stage}: {after:?}");
        // The limit does not apply to a debug build, because a program without optimisation is larger.
        assert!(cfg!(debug_assertions) || after.resident_kb <= MOST_RESIDENT_KB, "{stage}: {after:?}");
        assert_eq!(ended.stage(stage).starts, 1, "{}", ended.stderr);
    }
    println!("shared memory, files and bytes: {:?}, {:?}", first.shared, last.shared);
    assert_eq!(first.shared, last.shared);
    let (early, late) = latencies(&playground);
    println!("latency from source to sink, medians: {early:.2} ms at first, {late:.2} ms at last\n{}", ended.stderr);
}
