//! `conicflow topic`: shows the traffic on the topics of a running pipeline, without changing it.
//!
//! `list`, `hz` and `bw` read the records that the stages keep, and do not attach to the topics. `echo` is a further subscriber,
//! in a place that is reserved for it, and no publisher waits for it.

use crate::NODES;
use clap::{Args, Subcommand};
use conicflow_dataflow::ports::{Delivery, Topic};
use conicflow_dataflow::{
    PipelineActivity, Requirements, RunningPipeline, Table, TopicActivity, WatchError, Watching, monotonic_ns, observe,
};
use conicflow_view::lower_priority;
use std::io::{Write, stdout};
use std::thread::sleep;
use std::time::Duration;

const PERIOD: Duration = Duration::from_secs(1);

/// The views of topics.
#[derive(Subcommand)]
pub enum TopicCommand {
    /// List the topics with their item types, writers, readers and rates
    List {
        #[command(flatten)]
        of: PipelineName,
    },
    /// Print each message as a line of JSON, as json_sink does; of depth images a summary
    Echo(TopicArguments),
    /// Print once a second how many messages are sent, and how regularly
    Hz(TopicArguments),
    /// Print once a second how many bytes are sent
    Bw(TopicArguments),
}

/// The topic, and how much of it to show.
#[derive(Args)]
pub struct TopicArguments {
    /// Name of the topic
    topic: String,
    /// End after so many messages; hz and bw: after so many seconds
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    count: Option<u64>,
    #[command(flatten)]
    of: PipelineName,
}

/// The pipeline, if several run.
#[derive(Args)]
pub struct PipelineName {
    /// Name of the pipeline, where several run
    #[arg(long, value_name = "NAME")]
    pipeline: Option<String>,
}

/// Runs the subcommand.
///
/// # Errors
/// There is no such pipeline or topic, it cannot be read, or standard output cannot be written.
pub fn topic(command: &TopicCommand) -> anyhow::Result<()> {
    lower_priority();
    match command {
        TopicCommand::List { of } => list(&of.find()?),
        TopicCommand::Echo(arguments) => echo(arguments),
        TopicCommand::Hz(arguments) => each_second(arguments, rate_line),
        TopicCommand::Bw(arguments) => each_second(arguments, bandwidth_line),
    }
}

impl PipelineName {
    /// Returns the pipeline of this name, or the only one that runs.
    pub(crate) fn find(&self) -> Result<RunningPipeline, WatchError> {
        RunningPipeline::find(self.pipeline.as_deref(), "--pipeline NAME")
    }

    /// Returns the given name, if any, after checking that such a pipeline runs.
    pub(crate) fn named(&self) -> Result<Option<String>, WatchError> {
        self.pipeline.as_ref().map(|_| Ok(self.find()?.plan.pipeline)).transpose()
    }
}

fn list(running: &RunningPipeline) -> anyhow::Result<()> {
    let mut table = Table::new(&["TOPIC", "KIND", "WRITER", "Hz", "MB/s", "READERS"]);
    let activities = activities(running, None)?;
    for topic in running.topics() {
        let named = [topic.name.as_str(), topic.kind().unwrap_or("?")].map(str::to_owned);
        let mut written: Vec<_> = activities.iter().filter(|activity| activity.topic == topic.name).map(row).collect();
        if written.is_empty() {
            written.push(["-", "-", "-"].map(str::to_owned));
        }
        for cells in written {
            table.row(named.iter().cloned().chain(cells).chain([readers(topic)]));
        }
    }
    write!(stdout(), "{table}")?;
    Ok(())
}

/// Returns writer, rate and bandwidth of a topic.
fn row(activity: &TopicActivity) -> [String; 3] {
    let [rate, bandwidth] = [activity.rate_hz, activity.bandwidth_mbps].map(|figure| format!("{figure:.2}"));
    [activity.writer.clone(), rate, bandwidth]
}

fn readers(topic: &Topic) -> String {
    let readers = topic.readers.iter().map(|reader| {
        let delivery = if reader.delivery == Delivery::Lossless { "lossless" } else { "latest" };
        format!("{} ({delivery}, queue {})", reader.stage, reader.queue)
    });
    readers.collect::<Vec<_>>().join(", ")
}

/// Observes the writers of one topic, or of all, for a second.
fn activities(running: &RunningPipeline, only: Option<&str>) -> anyhow::Result<Vec<TopicActivity>> {
    let before = observe()?;
    sleep(PERIOD);
    let observed = observe()?.since(&before);
    let own = |observed: &PipelineActivity| observed.pipeline == running.plan.pipeline;
    let written = observed.into_iter().filter(own).flat_map(|observed| observed.topics);
    Ok(written.filter(|activity| only.is_none_or(|name| activity.topic == name)).collect())
}

/// Prints a line per second and writer, until the count is reached or the pipeline has ended.
fn each_second(arguments: &TopicArguments, line: fn(&TopicActivity) -> String) -> anyhow::Result<()> {
    let running = arguments.of.find()?;
    let topic = running.expect_topic(&arguments.topic)?;
    let mut left = arguments.count.unwrap_or(u64::MAX);
    while left > 0 && running.still_runs() {
        let activities = activities(&running, Some(&topic.name))?;
        if activities.is_empty() {
            writeln!(stdout(), "{}: nobody writes it now", topic.name)?;
        }
        for activity in activities {
            let writer = if topic.writers.len() > 1 { format!(" from {}", activity.writer) } else { String::new() };
            writeln!(stdout(), "{}{writer}: {}", topic.name, line(&activity))?;
        }
        left -= 1;
    }
    Ok(())
}

fn rate_line(activity: &TopicActivity) -> String {
    let time = |time: Option<f64>| time.map_or_else(|| "-".to_owned(), |time| format!("{time:.2} ms"));
    let [min, max, std] = [activity.interval_min_ms, activity.interval_max_ms, activity.interval_std_ms].map(time);
    format!("{:.2} Hz, interval min {min}, max {max}, std {std}", activity.rate_hz)
}

fn bandwidth_line(activity: &TopicActivity) -> String {
    format!("{:.3} MB/s, {:.2} Hz", activity.bandwidth_mbps, activity.rate_hz)
}

fn echo(arguments: &TopicArguments) -> anyhow::Result<()> {
    let running = arguments.of.find()?;
    let topic = running.expect_topic(&arguments.topic)?;
    Requirements::of(&running.plan, NODES).look_for_onlooker(topic)?;
    let item = topic.expect_item()?;
    let mut left = arguments.count.unwrap_or(u64::MAX);
    running.watch::<anyhow::Error>(&[(item, topic)], |_, message| {
        let mut line = Vec::new();
        message.write_json(message.header.latency_ms(monotonic_ns()), &mut line)?;
        line.push(b'\n');
        stdout().write_all(&line)?;
        stdout().flush()?;
        left -= 1;
        Ok(if left == 0 { Watching::Enough } else { Watching::GoOn })
    })
}
