//! A whole pipeline of five processes: how many small frames a second it passes on without loss, how long a 640x480 frame
//! takes from source to sink beside what the stages compute, and what each process uses.
//!
//! `cargo bench --bench pipeline`

use serde_json::Value as Json;
use std::error::Error;
use std::fs::{self, File};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::thread::sleep;
use std::time::Duration;

type Outcome<T> = Result<T, Box<dyn Error>>;

const ROUNDS: usize = 3;
const SMALL_FRAMES: usize = 3000;
const LIVE_SECONDS: u64 = 10;

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
    let mut rates = (0..ROUNDS).map(|_| lossless_rate(folder.path())).collect::<Outcome<Vec<_>>>()?;
    rates.sort_by(f64::total_cmp);
    println!("lossless, 64x48, five processes: {:.0} frames per second (median of {ROUNDS})", rates[ROUNDS / 2]);
    live(folder.path())
}

fn conicflow(folder: &Path, arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_conicflow"));
    let runtime = folder.join("run");
    command.args(arguments).current_dir(folder).env("CONICFLOW_RUNTIME_DIR", runtime).stdin(Stdio::null());
    command
}

/// Frames per second of a run that passes on each.
fn lossless_rate(folder: &Path) -> Outcome<f64> {
    fs::write(folder.join("pipeline.toml"), PIPELINE.replace("DELIVERY", "lossless"))?;
    let frames = SMALL_FRAMES.to_string();
    let small = ["run", "--frames", &frames, "--set", "source.rate_hz=0", "--set", "source.width=64"];
    let output = conicflow(folder, &[&small[..], &["--set", "source.height=48"]].concat()).output()?;
    let summary = String::from_utf8(output.stderr)?;
    let rate = summary.split_once('(').and_then(|(_, rest)| rest.split_once(" Hz")).map(|(rate, _)| rate);
    Ok(rate.ok_or_else(|| format!("no rate in: {summary}"))?.parse()?)
}

/// Prints what a live run at 30 Hz needs.
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

/// Memory that is a process's own, in MB, and how many threads it has.
fn process(id: &str) -> Outcome<(f64, usize)> {
    let text = fs::read_to_string(format!("/proc/{id}/smaps_rollup"))?;
    let private = text.lines().filter(|line| line.starts_with("Private_"));
    let kb: f64 = private.filter_map(|line| line.split_whitespace().nth(1)?.parse::<f64>().ok()).sum();
    Ok((kb / 1e3, fs::read_dir(format!("/proc/{id}/task"))?.count()))
}

/// A run that ends with this program.
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
