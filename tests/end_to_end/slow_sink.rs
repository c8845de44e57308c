//! A sink that takes its time over each depth image, so that a test can be sure that frames are lost before it; it writes
//! the sequence numbers of those that it gets.

use conicflow_dataflow::{Context, Output, Sides, Stage, StageError, run_stage};
use conicflow_messages::{Message, Nothing};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::time::Duration;

/// Parameters of the sink.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
struct SlowSinkConfig {
    /// File for the sequence numbers, one per line.
    path: PathBuf,
    /// Time spent on each image, in milliseconds.
    delay_ms: u64,
}

impl Default for SlowSinkConfig {
    fn default() -> Self {
        Self { path: "sequences.txt".into(), delay_ms: 50 }
    }
}

struct SlowSink {
    file: File,
    delay: Duration,
}

impl Stage for SlowSink {
    const NAME: &'static str = "slow_sink";
    const SUMMARY: &'static str = "Takes its time over each depth image";
    type Config = SlowSinkConfig;
    type Input = u16;
    type Output = Nothing;

    fn new(config: SlowSinkConfig, context: &Context) -> Result<Self, StageError> {
        let file = File::options().create(true).append(true).open(context.resolve(&config.path))?;
        Ok(Self { file, delay: Duration::from_millis(config.delay_ms) })
    }

    fn step(&mut self, input: &Message<u16>, _: &Sides, _: &mut Output<Nothing>) -> Result<(), StageError> {
        writeln!(self.file, "{}", input.header.sequence)?;
        std::thread::sleep(self.delay);
        Ok(())
    }
}

fn main() -> ExitCode {
    run_stage::<SlowSink>()
}
