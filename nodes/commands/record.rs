//! `conicflow record`: records topics of a running pipeline, as an onlooker for which no stage waits.

use super::invocation::write_to_stderr;
use super::topic::PipelineName;
use crate::NODES;
use crate::recording::files::is_recording;
use crate::recording::recorder::{Recorded, Recorder, file_at};
use crate::sinks::mcap_sink;
use anyhow::{Context as _, Result, bail};
use clap::Args;
use conicflow_dataflow::{NO_RUN, Requirements, Watching, monotonic_ns};
use conicflow_messages::{Header, Hinted, Text};
use conicflow_view::lower_priority;
use std::collections::{BTreeMap, HashSet};
use std::path::PathBuf;

/// The topics to record, and the file.
#[derive(Args)]
pub struct RecordArguments {
    /// Names of topics [default: all of the pipeline]
    topics: Vec<String>,
    /// The file to write
    #[arg(long, short, value_name = "FILE.mcap")]
    out: PathBuf,
    /// Begin another file, FILE_1.mcap and so on, after so many megabytes
    #[arg(long, value_name = "MB")]
    split_mb: Option<f64>,
    /// Begin another file after so many seconds, by the stamps of the frames
    #[arg(long, value_name = "S")]
    split_s: Option<f64>,
    /// Most megabytes of all files: the oldest is removed, or where there is but one the recording ends
    #[arg(long, value_name = "MB")]
    limit_mb: Option<f64>,
    #[command(flatten)]
    of: PipelineName,
}

/// Records until the pipeline ends, or a signal ends this program.
///
/// # Errors
/// There is no such pipeline or topic, a topic cannot be read, or the file cannot be written.
pub fn record(arguments: &RecordArguments) -> Result<()> {
    lower_priority();
    if !is_recording(&arguments.out) {
        let what = format!("`{}` does not end with `.mcap`, by which a recording is known", arguments.out.display());
        bail!(Hinted::new(what, format!("name it `{}`", arguments.out.with_extension("mcap").display())));
    }
    for (option, number) in
        [("split-mb", arguments.split_mb), ("split-s", arguments.split_s), ("limit-mb", arguments.limit_mb)]
    {
        if number.is_some_and(|number| number.is_nan() || number < 1.0) {
            bail!("`--{option}` is less than 1");
        }
    }
    let limits = mcap_sink::Config {
        split_mb: arguments.split_mb,
        split_s: arguments.split_s,
        limit_mb: arguments.limit_mb,
        ..mcap_sink::Config::default()
    };
    let limits = limits.limits();
    if let Some(earlier) = file_at(&arguments.out, &limits) {
        let what = format!("`{}` is there already", earlier.display());
        bail!(Hinted::new(what, "record into another file, or remove it"));
    }
    let running = arguments.of.find()?;
    let recorded = match &arguments.topics[..] {
        // Topics of unknown item type cannot be recorded: they are left out here, and an error if they are named.
        [] => running.topics().filter(|topic| topic.item.is_some()).collect(),
        named => {
            let mut names = HashSet::new();
            let each_once = named.iter().filter(|name| names.insert(*name));
            each_once.map(|name| running.expect_topic(name)).collect::<Result<Vec<_>, _>>()?
        }
    };
    let needs = Requirements::of(&running.plan, NODES);
    recorded.iter().try_for_each(|topic| needs.look_for_onlooker(topic))?;
    let watched = recorded.iter().map(|topic| Ok((topic.expect_item()?, *topic))).collect::<Result<Vec<_>>>()?;
    let recorder = Recorder::create(&arguments.out, limits, NO_RUN, false)?;
    let names: Vec<_> = recorded.iter().map(|topic| format!("`{}`", topic.name)).collect();
    tracing::info!("records {} into `{}`; Ctrl-C ends it", names.join(", "), arguments.out.display());
    let mut tally = Tally::default();
    let watched = running.watch::<anyhow::Error>(&watched, |topic, message| {
        tally.count(&topic.name, message.header);
        let written = recorder.write(&topic.name, &message, message.header.latency_ms(monotonic_ns()))?;
        if written == Recorded::Full {
            tracing::warn!("the recording has reached `--limit-mb`: no more is recorded");
            return Ok(Watching::Enough);
        }
        Ok(Watching::GoOn)
    });
    // Messages before an error are kept.
    let bytes = recorder.finish();
    watched.context("recording")?;
    write_to_stderr(tally.text(bytes?));
    Ok(())
}

/// Number of messages of each topic, and of those lost because this program was too slow.
#[derive(Default)]
struct Tally {
    topics: BTreeMap<String, (u64, u64)>,
    /// Number of the last message of each writer of a topic.
    last: BTreeMap<(String, Text<32>), u64>,
}

impl Tally {
    fn count(&mut self, topic: &str, header: &Header) {
        let (messages, lost) = self.topics.entry(topic.to_owned()).or_default();
        *messages += 1;
        if let Some(last) = self.last.insert((topic.to_owned(), header.writer()), header.number) {
            *lost += header.number.saturating_sub(last.saturating_add(1));
        }
    }

    fn text(&self, bytes: u64) -> String {
        let topics = self.topics.iter().map(|(topic, (messages, lost))| {
            let lost = if *lost > 0 { format!(" ({lost} missed)") } else { String::new() };
            format!("{topic} {messages}{lost}")
        });
        let topics: Vec<_> = topics.collect();
        let topics = if topics.is_empty() { "nothing came".to_owned() } else { topics.join(", ") };
        format!("recorded {:.1} MB: {topics}", bytes as f64 / 1e6)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::Hop;

    #[test]
    fn missed_messages_are_counted_by_the_numbers_of_each_writer() {
        let mut tally = Tally::default();
        for (writer, number) in [("left", 4), ("right", 0), ("left", 5), ("left", 8), ("right", 1)] {
            let mut header = Header { number, ..Header::default() };
            header.add_hop(Hop { stage: Text::new(writer), ..Hop::default() });
            tally.count("depth", &header);
        }
        assert_eq!(tally.text(1_250_000), "recorded 1.2 MB: depth 5 (2 missed)");
        assert_eq!(Tally::default().text(0), "recorded 0.0 MB: nothing came");
    }
}
