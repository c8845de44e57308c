//! Observes running pipelines from outside: reads the records of their stages and the kernel's data of their processes.
//!
//! It attaches to no topic, so it slows nothing down and adds no reader. To read the messages, use [`watch`].

pub(crate) mod watch;

use crate::clock::monotonic_ns;
use crate::launcher::{FolderError, RunFolder, user_folder};
use crate::network::link_report::{EdgeReport, LinkReport, read_links};
use crate::pipeline::BRIDGE;
use crate::plan::{Plan, PlannedStage};
use crate::status::{Durations, Life, Pausing, Status, used};
use serde::Serialize;
use std::collections::BTreeMap;
use std::ffi::OsStr;
use std::fs;
use std::time::{Duration, Instant};

/// The pipelines that run at one moment.
pub struct Observation {
    taken: Instant,
    runs: Vec<RunRecord>,
}

/// Counts of one pipeline's run so far, for users that keep a history and compute rates themselves.
#[derive(Default)]
pub struct RunRecord {
    pipeline: String,
    run: u64,
    /// Its stages, in the order of the file.
    pub stages: Vec<StageRecord>,
    /// The links to other machines.
    pub links: Vec<LinkReport>,
}

/// Counts of a stage so far, and the resources that its process uses.
pub struct StageRecord {
    /// The stage, as it is planned.
    pub planned: PlannedStage,
    /// Its counts, which continue after a restart.
    pub status: Box<Status>,
    /// Resources of the running process, if there is one.
    pub usage: Option<Usage>,
}

/// Resources that a process uses.
#[derive(Clone, Copy, Debug)]
pub struct Usage {
    /// Processor time since it was started.
    pub cpu: Duration,
    /// Memory in use, shared memory included.
    pub resident_bytes: u64,
    /// Time since the stage's last heartbeat.
    pub silent: Duration,
}

/// Activity of a pipeline between two moments.
#[derive(Debug, Default, Serialize)]
pub struct PipelineActivity {
    /// Its name.
    pub pipeline: String,
    /// Its running stages, in the order of the file.
    pub stages: Vec<StageActivity>,
    /// Topics that they write.
    pub topics: Vec<TopicActivity>,
    /// Inputs that they read.
    pub inputs: Vec<InputActivity>,
    /// The links to other machines.
    pub links: Vec<LinkReport>,
}

/// Activity of a stage between two moments.
#[derive(Debug, Serialize)]
pub struct StageActivity {
    /// Its name.
    pub stage: String,
    /// Its node or program.
    pub node: String,
    /// Its process.
    pub process: u32,
    /// How often it was started in this run.
    pub starts: u64,
    /// Messages processed in total.
    pub messages: u64,
    /// Messages processed per second.
    pub rate_hz: f64,
    /// Processor time, in percent of one core.
    pub cpu_percent: f64,
    /// Memory in use, shared memory included, in MB.
    pub memory_mb: f64,
    /// Time since its last heartbeat, in seconds; about 0.1 at most for a stage that waits.
    pub silent_s: f64,
    /// The stage that it waits for to take its messages, if it has waited for a tenth of a second.
    pub waits_for: Option<String>,
    /// Whether it can stand still while the run is paused.
    pub can_pause: bool,
    /// Whether it stands still now, because the run is paused.
    pub paused: bool,
    /// Time of a step, median, since the run began.
    pub compute_p50_ms: Option<f64>,
    /// Time of a step, 99th percentile, since the run began.
    pub compute_p99_ms: Option<f64>,
    /// Items sent since the run began, by label.
    pub found: BTreeMap<String, u64>,
    /// Items sent per message processed between the two moments, by label.
    pub found_per_message: BTreeMap<String, f64>,
    /// The stage's own counters since the run began, such as reasons why something was not found.
    pub counters: BTreeMap<String, u64>,
}

/// Traffic into a topic between two moments.
#[derive(Debug, Default, Serialize)]
pub struct TopicActivity {
    /// Its name.
    pub topic: String,
    /// The stage that writes it; [`BRIDGE`] for messages from another machine.
    pub writer: String,
    /// Messages sent in total.
    pub sent: u64,
    /// Messages per second.
    pub rate_hz: f64,
    /// Megabytes per second.
    pub bandwidth_mbps: f64,
    /// Shortest time between two messages; unknown for messages from another machine.
    pub interval_min_ms: Option<f64>,
    /// Longest time between two messages.
    pub interval_max_ms: Option<f64>,
    /// Standard deviation of the time between two messages.
    pub interval_std_ms: Option<f64>,
}

/// Traffic from a topic to one stage.
#[derive(Debug, Default, Serialize)]
pub struct InputActivity {
    /// Name of the topic.
    pub topic: String,
    /// The stage that reads it.
    pub reader: String,
    /// Messages processed.
    pub received: u64,
    /// Messages missed: replaced by newer ones, or lost.
    pub dropped: u64,
    /// Frames missing in the sequence.
    pub gaps: u64,
    /// Messages that came twice or out of order.
    pub late: u64,
    /// Messages that were malformed.
    pub malformed: u64,
    /// Time from sending to receiving, median; of the driving input.
    pub hop_p50_ms: Option<f64>,
    /// Time from sending to receiving, 99th percentile.
    pub hop_p99_ms: Option<f64>,
    /// Time from the source to here, median; of the driving input.
    pub latency_p50_ms: Option<f64>,
    /// Time from the source to here, 99th percentile.
    pub latency_p99_ms: Option<f64>,
}

/// Observes all running pipelines of this user.
///
/// # Errors
/// The user's folder cannot be read.
pub fn observe() -> Result<Observation, FolderError> {
    let runs = RunFolder::all(&user_folder())?.into_iter().filter_map(|folder| RunRecord::read(&folder));
    let lives = |run: &RunRecord| run.stages.iter().any(|stage| stage.usage.is_some());
    Ok(Observation { taken: Instant::now(), runs: runs.filter(lives).collect() })
}

/// Reads the records of this pipeline's run; a stage that has not begun has none.
///
/// # Errors
/// The user's folder cannot be read.
pub fn records(pipeline: &str) -> Result<RunRecord, FolderError> {
    let is_of_it = |folder: &RunFolder| folder.path().file_name() == Some(OsStr::new(pipeline));
    let folder = RunFolder::all(&user_folder())?.into_iter().find(is_of_it);
    Ok(folder.as_ref().and_then(RunRecord::read).unwrap_or_default())
}

/// Resources that a stage's process uses while it works; a record may outlive its process.
fn usage(status: &Status) -> Option<Usage> {
    let (cpu, resident_bytes) = process_usage(status.process).filter(|_| status.life() == Life::Running)?;
    let silent = Duration::from_nanos(monotonic_ns().saturating_sub(status.alive_ns));
    Some(Usage { cpu, resident_bytes, silent })
}

/// Processor time and resident memory of a process, from /proc; `None` if there is none.
fn process_usage(process: u32) -> Option<(Duration, u64)> {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // The name stands in parentheses and may contain anything; the fields after the last parenthesis are 3 and on.
    let fields: Vec<&str> = stat.rsplit_once(')')?.1.split_whitespace().collect();
    let ticks: u64 = fields.get(11)?.parse::<u64>().ok()? + fields.get(12)?.parse::<u64>().ok()?;
    let pages: u64 = fields.get(21)?.parse().ok()?;
    let per_second = rustix::param::clock_ticks_per_second();
    let cpu = Duration::from_secs_f64(ticks as f64 / per_second as f64);
    Some((cpu, pages * rustix::param::page_size() as u64))
}

impl Observation {
    /// Activity since an earlier observation.
    pub fn since(&self, earlier: &Self) -> Vec<PipelineActivity> {
        let seconds = self.taken.duration_since(earlier.taken).as_secs_f64().max(1e-3);
        self.runs.iter().map(|run| run.activity(earlier, seconds)).collect()
    }

    fn find(&self, run: u64, process: u32) -> Option<(&Status, Usage)> {
        let stages = self.runs.iter().filter(|known| known.run == run).flat_map(|known| &known.stages);
        stages.filter_map(StageRecord::living).find(|(status, _)| status.process == process)
    }
}

impl RunRecord {
    /// Reads the counts of the run in this folder; `None` without a plan.
    fn read(folder: &RunFolder) -> Option<Self> {
        let Plan { pipeline, run, stages, .. } = folder.plan().ok()?;
        let record = |planned: PlannedStage| {
            let status = Box::new(folder.record(&planned.name, run)?);
            Some(StageRecord { planned, usage: usage(&status), status })
        };
        let stages = stages.into_iter().filter_map(record).collect();
        Some(Self { pipeline, run, stages, links: read_links(folder.path(), run) })
    }

    fn activity(&self, earlier: &Observation, seconds: f64) -> PipelineActivity {
        let (mut stages, mut topics, mut inputs) = (Vec::new(), Vec::new(), Vec::new());
        for record in &self.stages {
            let (Some((now, usage)), planned) = (record.living(), &record.planned) else { continue };
            let span = Span { before: earlier.find(self.run, now.process), now, usage, seconds };
            stages.push(span.stage(planned));
            topics.extend(planned.wiring.output.as_ref().map(|topic| span.topic(&topic.name, &planned.name)));
            if planned.is_bridge() {
                topics.extend(self.links.iter().flat_map(|link| &link.edges).filter(|edge| edge.comes()).map(arriving));
            }
            inputs.extend(input_activity(now, &planned.name, !planned.is_source()));
        }
        PipelineActivity { pipeline: self.pipeline.clone(), stages, topics, inputs, links: self.links.clone() }
    }
}

impl StageRecord {
    /// Its counts and the usage of its process, if it runs.
    fn living(&self) -> Option<(&Status, Usage)> {
        Some((&self.status, self.usage?))
    }
}

/// Traffic into a topic from another machine, as the bridge last reported it; bytes are those in shared memory, as for every
/// topic.
fn arriving(edge: &EdgeReport) -> TopicActivity {
    let bytes_per_message = edge.memory_bytes as f64 / edge.messages.max(1) as f64;
    TopicActivity {
        topic: edge.topic.clone(),
        writer: BRIDGE.to_owned(),
        sent: edge.messages,
        rate_hz: edge.rate_hz,
        bandwidth_mbps: edge.rate_hz * bytes_per_message / 1e6,
        ..TopicActivity::default()
    }
}

/// A stage at two moments; at only one if it was started in between.
struct Span<'a> {
    before: Option<(&'a Status, Usage)>,
    now: &'a Status,
    usage: Usage,
    seconds: f64,
}

impl Span<'_> {
    fn per_second(&self, count: fn(&Status) -> u64) -> f64 {
        let counted = self.before.map_or(0, |(before, _)| count(self.now).saturating_sub(count(before)));
        counted as f64 / self.seconds
    }

    /// Average number of items found per message.
    fn found_per_message(&self) -> BTreeMap<String, f64> {
        let Some((before, _)) = self.before else { return BTreeMap::new() };
        let messages = self.now.steps.saturating_sub(before.steps);
        let count_before = |name: &str| used(&before.found).find(|(known, _)| *known == name).map_or(0, |(_, n)| n);
        let found = used(&self.now.found).filter(|_| messages > 0);
        found
            .map(|(name, n)| (name.to_owned(), n.saturating_sub(count_before(name)) as f64 / messages as f64))
            .collect()
    }

    fn stage(&self, planned: &PlannedStage) -> StageActivity {
        let status = self.now;
        let cpu = self.before.map_or(Duration::ZERO, |(_, before)| self.usage.cpu.saturating_sub(before.cpu));
        StageActivity {
            stage: planned.name.clone(),
            node: planned.runs.name().to_owned(),
            process: status.process,
            starts: status.starts,
            messages: status.steps,
            rate_hz: self.per_second(|status| status.steps),
            cpu_percent: cpu.as_secs_f64() / self.seconds * 100.0,
            memory_mb: self.usage.resident_bytes as f64 / 1e6,
            silent_s: self.usage.silent.as_secs_f64(),
            waits_for: Some(status.waits_for.to_string()).filter(|stage| !stage.is_empty()),
            can_pause: status.pausing() != Pausing::Cannot,
            paused: status.pausing() == Pausing::Stands,
            compute_p50_ms: milliseconds(&status.compute, 0.5),
            compute_p99_ms: milliseconds(&status.compute, 0.99),
            found: used(&status.found).map(|(name, count)| (name.to_owned(), count)).collect(),
            found_per_message: self.found_per_message(),
            counters: used(&status.counters).map(|(name, count)| (name.to_owned(), count)).collect(),
        }
    }

    fn topic(&self, topic: &str, writer: &str) -> TopicActivity {
        let intervals = self.before.map(|(before, _)| self.now.intervals.since(&before.intervals));
        let range = intervals.and_then(|intervals| intervals.range());
        TopicActivity {
            topic: topic.to_owned(),
            writer: writer.to_owned(),
            sent: self.now.sent,
            rate_hz: self.per_second(|status| status.sent),
            bandwidth_mbps: self.per_second(|status| status.sent_bytes) / 1e6,
            interval_min_ms: range.map(|(shortest, _)| shortest.as_secs_f64() * 1e3),
            interval_max_ms: range.map(|(_, longest)| longest.as_secs_f64() * 1e3),
            interval_std_ms: intervals.and_then(|intervals| intervals.standard_deviation_s()).map(|std| std * 1e3),
        }
    }
}

fn input_activity(status: &Status, reader: &str, driven: bool) -> Vec<InputActivity> {
    let rows = status.used_inputs().enumerate().map(|(index, input)| {
        let drives = driven && index == 0;
        let time = |durations: &Durations, quantile| milliseconds(durations, quantile).filter(|_| drives);
        InputActivity {
            topic: input.topic.to_string(),
            reader: reader.to_owned(),
            received: input.received,
            dropped: input.dropped,
            gaps: input.gaps,
            late: input.late,
            malformed: input.malformed,
            hop_p50_ms: time(&status.hop, 0.5),
            hop_p99_ms: time(&status.hop, 0.99),
            latency_p50_ms: time(&status.latency, 0.5),
            latency_p99_ms: time(&status.latency, 0.99),
        }
    });
    rows.collect()
}

fn milliseconds(durations: &Durations, quantile: f64) -> Option<f64> {
    durations.quantile(quantile).map(|time| time.as_secs_f64() * 1e3)
}
