//! Measures a whole pipeline of five processes: the number of small frames per second that it processes without loss, the cost of
//! an onlooker at this rate, the time of a 640x480 frame from source to sink, the compute time of the stages, and the resources
//! of each process.
//!
//! `cargo bench --bench pipeline`

use serde_json::Value as Json;
use std::error::Error;
use std::fs::{self, File};
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};

type Outcome<T> = Result<T, Box<dyn Error>>;

const ROUNDS: usize = 3;
const SMALL_FRAMES: usize = 3000;
const LIVE_SECONDS: u64 = 10;
/// Number of turns with an onlooker, which is also the number of turns without one. They alternate, and each takes [`TURN`].
const TURNS: usize = 9;
const TURN: Duration = Duration::from_millis(1500);
/// Number of bytes at the end of a file of tracks that contain at least one complete line.
const LAST_LINES: u64 = 16 * 1024;
const ONLOOKERS: [[&str; 3]; 4] =
    [["topic", "echo", "depth"], ["topic", "echo", "tracks"], ["topic", "hz", "depth"], ["topic", "bw", "depth"]];

const PIPELINE: &str = r#"
name = "bench"

[stage.source]
node   = "synthetic_source"
output = "depth"
scene  = "tabletop"

[stage.extractor]
node   = "row_ellipse_extractor"
input  = { topic = "depth", delivery = "DELIVERY" }
output = "ellipses"

[stage.assembler]
node   = "object_assembler"
input  = { topic = "ellipses", delivery = "DELIVERY" }
output = "objects"

[stage.tracker]
node   = "kalman_tracker"
input  = { topic = "objects", delivery = "DELIVERY" }
output = "tracks"

[stage.json]
node  = "json_sink"
input = { topic = "tracks", delivery = "DELIVERY" }
path  = "tracks.jsonl"
"#;

fn main() -> Outcome<()> {
    let folder = tempfile::tempdir()?;
    let rates = (0..ROUNDS).map(|_| lossless_rate(folder.path())).collect::<Outcome<Vec<_>>>()?;
    println!("lossless, 64x48, five processes: {:.0} frames per second (median of {ROUNDS})", median(rates));
    onlookers(folder.path())?;
    live(folder.path())
}

fn conicflow(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_conicflow"));
    let runtime = folder.join("run");
    command.args(arguments).current_dir(folder).env("CONICFLOW_RUNTIME_DIR", runtime).stdin(Stdio::null());
    command
}

/// Frames per second of a lossless run.
fn lossless_rate(folder: &Path) -> Outcome<f64> {
    fs::write(folder.join("pipeline.toml"), PIPELINE.replace("DELIVERY", "lossless"))?;
    let frames = SMALL_FRAMES.to_string();
    let small = ["run", "--frames", &frames, "--set", "source.rate_hz=0", "--set", "source.width=64"];
    let output = conicflow(folder, &[&small[..], &["--set", "source.height=48"]].concat()).output()?;
    let summary = String::from_utf8(output.stderr)?;
    let rate = summary.split_once('(').and_then(|(_, rest)| rest.split_once(" Hz")).map(|(rate, _)| rate);
    Ok(rate.ok_or_else(|| format!("no rate in: {summary}"))?.parse()?)
}

/// Prints the cost of an onlooker for a lossless run at full speed: the CPU time of the stages per frame, alternately without and
/// with an onlooker.
fn onlookers(folder: &Path) -> Outcome<()> {
    println!(
        "\nlossless, 64x48, flat out; processor time of the five stages in us per frame, medians of {TURNS} turns"
    );
    println!(
        "{:<20}{:>9}{:>9}{:>8}{:>16}{:>18}",
        "onlooker", "without", "with", "ratio", "frames per s", "its own CPU %"
    );
    for arguments in ONLOOKERS {
        let endless = ["run", "--set", "source.rate_hz=0", "--set", "source.width=64", "--set", "source.height=48"];
        let mut run = Ended(conicflow(folder, &endless).stderr(Stdio::null()).spawn()?);
        sleep(TURN);
        let stages = children(run.0.id())?;
        let (mut without, mut with, mut ratios) = (Vec::new(), Vec::new(), Vec::new());
        for _ in 0..TURNS {
            let alone = turn(folder, &stages, None)?;
            let mut onlooker = Ended(conicflow(folder, &arguments).stdout(Stdio::null()).spawn()?);
            sleep(TURN / 3);
            let watched = turn(folder, &stages, Some(onlooker.0.id()))?;
            onlooker.end()?;
            ratios.push(watched[0] / alone[0]);
            without.push(alone);
            with.push(watched);
        }
        let middle = |turns: &[[f64; 3]], index: usize| median(turns.iter().map(|turn| turn[index]).collect());
        println!(
            "{:<20}{:>9.1}{:>9.1}{:>8.3}{:>16}{:>18.1}",
            arguments[1..].join(" "),
            middle(&without, 0),
            middle(&with, 0),
            median(ratios),
            format!("{:.0}, {:.0}", middle(&without, 1), middle(&with, 1)),
            middle(&with, 2)
        );
        run.end()?;
    }
    Ok(())
}

/// Measures, for one turn, the CPU time of the stages per frame in us, the frames per second, and the CPU load of the onlooker in
/// per cent of a core.
fn turn(folder: &Path, stages: &[u32], onlooker: Option<u32>) -> Outcome<[f64; 3]> {
    let time_of_all = || stages.iter().map(|stage| processor_ns(*stage)).sum::<Outcome<u64>>();
    let own_time = || onlooker.map_or(Ok(0), processor_ns);
    let (since, before) = (Instant::now(), (time_of_all()?, own_time()?, newest(folder)?));
    sleep(TURN);
    let after = (time_of_all()?, own_time()?, newest(folder)?);
    let (seconds, frames) = (since.elapsed().as_secs_f64(), (after.2 - before.2) as f64);
    Ok([(after.0 - before.0) as f64 * 1e-3 / frames, frames / seconds, (after.1 - before.1) as f64 * 1e-7 / seconds])
}

/// The stages of a run: processes whose parent is its launcher.
fn children(launcher: u32) -> Outcome<Vec<u32>> {
    let text = fs::read_to_string(format!("/proc/{launcher}/task/{launcher}/children"))?;
    Ok(text.split_whitespace().map(str::parse).collect::<Result<_, _>>()?)
}

/// The CPU time of a process in nanoseconds.
fn processor_ns(process: u32) -> Outcome<u64> {
    let mut sum = 0;
    for thread in fs::read_dir(format!("/proc/{process}/task"))? {
        let text = fs::read_to_string(thread?.path().join("schedstat"))?;
        sum += text.split_whitespace().next().unwrap_or_default().parse::<u64>()?;
    }
    Ok(sum)
}

/// The sequence number of the newest frame at the sink.
fn newest(folder: &Path) -> Outcome<u64> {
    let mut file = File::open(folder.join("tracks.jsonl"))?;
    let length = file.seek(SeekFrom::End(0))?;
    file.seek(SeekFrom::Start(length.saturating_sub(LAST_LINES)))?;
    let mut text = String::new();
    file.read_to_string(&mut text)?;
    let line = text.rsplit('\n').nth(1).unwrap_or_default();
    let sequence = serde_json::from_str::<Json>(line)?["sequence"].as_u64();
    Ok(sequence.ok_or("a line without a sequence number")?)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Prints the times and resources of a live run at 30 Hz.
fn live(folder: &Path) -> Outcome<()> {
    fs::write(folder.join("pipeline.toml"), PIPELINE.replace("DELIVERY", "latest"))?;
    let large = ["run", "--set", "source.rate_hz=30", "--set", "source.width=640"];
    let log = File::create(folder.join("summary.txt"))?;
    let mut command = conicflow(folder, &[&large[..], &["--set", "source.height=480"]].concat());
    let mut run = Ended(command.stderr(log).spawn()?);
    sleep(Duration::from_secs(LIVE_SECONDS));
    let look = conicflow(folder, &["top", "--once"]).output()?;
    let seen: Json = serde_json::from_slice(&look.stdout)?;
    let pipeline = &seen["pipelines"][0];
    println!("\nlive, 640x480 at 30 Hz; times are medians (99th percentiles) in ms");
    println!(
        "{:<11}{:>7}{:>18}{:>18}{:>8}{:>9}{:>9}{:>9}",
        "stage", "Hz", "compute", "hop", "CPU %", "RSS MB", "own MB", "threads"
    );
    let mut compute = 0.0;
    for stage in pipeline["stages"].as_array().into_iter().flatten() {
        let name = stage["stage"].as_str().unwrap_or_default();
        let driven = |input: &&Json| input["reader"] == stage["stage"] && input["hop_p50_ms"].is_number();
        let input = pipeline["inputs"].as_array().into_iter().flatten().find(driven);
        let pair = |of: &Json, what: &str| {
            let time = |part: &str| of[format!("{what}_{part}_ms")].as_f64().unwrap_or(f64::NAN);
            format!("{:.3} ({:.2})", time("p50"), time("p99"))
        };
        let hop = input.map_or_else(String::new, |input| pair(input, "hop"));
        let (own_mb, threads) = process(&stage["process"].to_string())?;
        let figure = |key: &str| stage[key].as_f64().unwrap_or(f64::NAN);
        println!(
            "{name:<11}{:>7.1}{:>18}{hop:>18}{:>8.1}{:>9.1}{own_mb:>9.1}{threads:>9}",
            figure("rate_hz"),
            pair(stage, "compute"),
            figure("cpu_percent"),
            figure("memory_mb")
        );
        compute += if name == "source" { 0.0 } else { figure("compute_p50_ms") };
        if name == "json" {
            let latency = input.map_or_else(String::new, |input| pair(input, "latency"));
            println!("from source to sink {latency}; the stages between compute {compute:.3}");
        }
    }
    run.end()
}

/// Private memory of a process in MB, and its number of threads.
fn process(id: &str) -> Outcome<(f64, usize)> {
    let text = fs::read_to_string(format!("/proc/{id}/smaps_rollup"))?;
    let private = text.lines().filter(|line| line.starts_with("Private_"));
    let kb: f64 = private.filter_map(|line| line.split_whitespace().nth(1)?.parse::<f64>().ok()).sum();
    Ok((kb / 1e3, fs::read_dir(format!("/proc/{id}/task"))?.count()))
}

/// A child process that is interrupted when this value is dropped.
struct Ended(Child);

impl Ended {
    fn end(&mut self) -> Outcome<()> {
        let process = rustix::process::Pid::from_child(&self.0);
        rustix::process::kill_process(process, rustix::process::Signal::INT)?;
        self.0.wait()?;
        Ok(())
    }
}

impl Drop for Ended {
    fn drop(&mut self) {
        self.end().ok();
    }
}
