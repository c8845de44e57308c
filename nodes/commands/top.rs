//! `conicflow top`: shows the activity of running pipelines, as a screen that is redrawn every second, or once as JSON.

use super::topic::PipelineName;
use conicflow_dataflow::{PipelineActivity, StageActivity, Table, link_table, observe};
use conicflow_view::lower_priority;
use rustix::termios::tcgetwinsize;
use serde_json::json;
use std::io::{IsTerminal, Write, stdout};
use std::thread::sleep;
use std::time::Duration;

const PERIOD: Duration = Duration::from_secs(1);
/// Time without a sign of life after which a stage is pointed out.
const SILENT_S: f64 = 2.0;

/// Redraws the screen until a signal ends it, of all pipelines or of one; without a terminal or if `once`, prints JSON once.
///
/// # Errors
/// The runs cannot be read, no pipeline of this name runs, or standard output cannot be written.
pub fn top(once: bool, of: &PipelineName) -> anyhow::Result<()> {
    lower_priority();
    let name = of.named()?;
    let mut before = observe()?;
    loop {
        sleep(PERIOD);
        let now = observe()?;
        let mut activity = now.since(&before);
        activity.retain(|pipeline| name.as_ref().is_none_or(|name| pipeline.pipeline == *name));
        before = now;
        if once || !stdout().is_terminal() {
            writeln!(stdout(), "{}", serde_json::to_string_pretty(&json!({ "pipelines": activity }))?)?;
            return Ok(());
        }
        let rows = tcgetwinsize(stdout()).map_or(0, |size| size.ws_row.into());
        write!(stdout(), "\x1b[H\x1b[2J{}", fitting(&screen(&activity), rows))?;
        stdout().flush()?;
    }
}

/// Returns the part of a text that fits into a window of this many rows, or all of it if the window's size is unknown.
fn fitting(text: &str, rows: usize) -> String {
    let lines: Vec<_> = text.lines().collect();
    if rows < 2 || lines.len() < rows {
        return text.to_owned();
    }
    let (shown, more) = (&lines[..rows - 1], lines.len() + 1 - rows);
    format!("{}\n({more} lines more: enlarge the window, or name one with --pipeline)", shown.join("\n"))
}

/// Returns the tables of all pipelines, within 80 columns.
fn screen(pipelines: &[PipelineActivity]) -> String {
    if pipelines.is_empty() {
        return "no pipeline runs; start one with `conicflow run`\n".to_owned();
    }
    let parts = pipelines.iter().map(|pipeline| {
        let links =
            if pipeline.links.is_empty() { String::new() } else { format!("\n{}", link_table(&pipeline.links)) };
        let standing = standing(pipeline);
        let tables = [stages(pipeline), topics(pipeline), inputs(pipeline)].map(|table| table.to_string());
        format!("{}\n{}\n{standing}{}{links}\n", pipeline.pipeline, found(pipeline), tables.join("\n"))
    });
    parts.collect()
}

/// Returns a line with the number of objects per frame that the last detecting or tracking stage now finds.
fn found(pipeline: &PipelineActivity) -> String {
    let Some(stage) = pipeline.stages.iter().rev().find(|stage| !stage.found_per_message.is_empty()) else {
        return String::new();
    };
    let found = stage.found_per_message.iter().map(|(name, count)| format!("{name} {count:.1}"));
    let line = format!("{}, in a frame: {}", clip(&stage.stage, 14), found.collect::<Vec<_>>().join(", "));
    format!("{}\n", clip(&line, 80))
}

/// Returns a line for each stage that seems to hang, is paused or waits for another one, and for each input that got malformed
/// messages.
fn standing(pipeline: &PipelineActivity) -> String {
    let line = |stage: &StageActivity| match &stage.waits_for {
        _ if stage.silent_s > SILENT_S => Some(format!("no sign of life for {:.0} s", stage.silent_s)),
        _ if stage.paused => Some("paused".to_owned()),
        Some(reader) if stage.rate_hz == 0.0 => Some(format!("waits for {} to take its messages", clip(reader, 14))),
        _ => None,
    };
    let stages = pipeline.stages.iter().filter_map(|stage| Some((&stage.stage, line(stage)?)));
    let inputs = pipeline.inputs.iter().filter(|input| input.malformed > 0).map(|input| {
        (&input.reader, format!("{} messages of {} made no sense", input.malformed, clip(&input.topic, 22)))
    });
    stages.chain(inputs).map(|(stage, line)| format!("{}: {line}\n", clip(stage, 14))).collect()
}

fn stages(pipeline: &PipelineActivity) -> Table {
    let mut table = Table::new(&["STAGE", "NODE", "Hz", "CPU %", "MB", "p50 ms", "p99 ms", "STARTS"]);
    for stage in &pipeline.stages {
        let names = [clip(&stage.stage, 14), clip(&stage.node, 22)];
        let figures = [stage.rate_hz, stage.cpu_percent, stage.memory_mb].map(|figure| format!("{figure:.1}"));
        let times = [stage.compute_p50_ms, stage.compute_p99_ms].map(time);
        table.row(names.into_iter().chain(figures).chain(times).chain([stage.starts.to_string()]));
    }
    table
}

fn topics(pipeline: &PipelineActivity) -> Table {
    let mut table = Table::new(&["TOPIC", "WRITER", "SENT", "Hz", "MB/s"]);
    for topic in &pipeline.topics {
        let names = [clip(&topic.topic, 22), clip(&topic.writer, 14), topic.sent.to_string()];
        table.row(names.into_iter().chain([topic.rate_hz, topic.bandwidth_mbps].map(|figure| format!("{figure:.2}"))));
    }
    table
}

fn inputs(pipeline: &PipelineActivity) -> Table {
    let mut table = Table::new(&["TOPIC", "READER", "RECEIVED", "DROPPED", "GAPS", "hop ms", "p99", "age ms", "p99"]);
    for input in &pipeline.inputs {
        let names = [clip(&input.topic, 12), clip(&input.reader, 12)];
        let counts = [input.received, input.dropped, input.gaps].map(|count| count.to_string());
        let times = [input.hop_p50_ms, input.hop_p99_ms, input.latency_p50_ms, input.latency_p99_ms].map(time);
        table.row(names.into_iter().chain(counts).chain(times));
    }
    table
}

fn time(milliseconds: Option<f64>) -> String {
    milliseconds.map_or_else(|| "-".to_owned(), |time| format!("{time:.2}"))
}

/// Cuts a text to `width` characters; a cut one ends in a dot.
fn clip(text: &str, width: usize) -> String {
    if text.chars().count() <= width { text.to_owned() } else { text.chars().take(width - 1).chain(['.']).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_dataflow::InputActivity;

    #[test]
    fn an_input_with_malformed_messages_has_a_line() {
        let input = |reader: &str, malformed| InputActivity {
            topic: "objects".to_owned(),
            reader: reader.to_owned(),
            malformed,
            ..InputActivity::default()
        };
        let pipeline = PipelineActivity { inputs: vec![input("tracker", 3), input("json", 0)], ..Default::default() };
        assert_eq!(standing(&pipeline), "tracker: 3 messages of objects made no sense\n");
    }

    #[test]
    fn a_window_shows_the_lines_that_fit_and_the_number_of_the_others() {
        let text = "a\nb\nc\nd\n";
        for rows in [0, 1, 5, 24] {
            assert_eq!(fitting(text, rows), text);
        }
        assert_eq!(fitting(text, 4), "a\nb\nc\n(1 lines more: enlarge the window, or name one with --pipeline)");
        assert!(fitting(text, 2).starts_with("a\n(3 lines more: "));
    }
}
