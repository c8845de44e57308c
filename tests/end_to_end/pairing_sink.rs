//! A sink that writes, for each list of objects that it gets, its frame's number, and those of the image and of the ellipses
//! that came with it as further inputs of the same frame.

use conicflow_dataflow::{Context, Output, Side, Sides, Stage, StageError, run_stage};
use conicflow_messages::{Ellipse, Header, Message, Nothing, Object};
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
struct PairingSinkConfig {
    /// File for the numbers, one line per list.
    path: PathBuf,
    /// Time spent on each list, in milliseconds.
    delay_ms: u64,
}

impl Default for PairingSinkConfig {
    fn default() -> Self {
        Self { path: "pairs.txt".into(), delay_ms: 0 }
    }
}

struct PairingSink {
    file: File,
    delay: Duration,
}

impl Stage for PairingSink {
    const NAME: &'static str = "pairing_sink";
    const SUMMARY: &'static str = "Writes which messages came together";
    type Config = PairingSinkConfig;
    type Input = Object;
    type Output = Nothing;

    fn new(config: PairingSinkConfig, context: &Context) -> Result<Self, StageError> {
        let file = File::options().create(true).append(true).open(context.resolve(&config.path))?;
        Ok(Self { file, delay: Duration::from_millis(config.delay_ms) })
    }

    fn sides() -> &'static [Side] {
        const { &[Side::same_frame::<u16>("depth"), Side::same_frame::<Ellipse>("ellipses")] }
    }

    fn step(&mut self, input: &Message<Object>, sides: &Sides, _: &mut Output<Nothing>) -> Result<(), StageError> {
        let number = |header: Option<&Header>| header.map_or("-".to_owned(), |header| header.sequence.to_string());
        let (depth, ellipses) = (sides.get::<u16>("depth"), sides.get::<Ellipse>("ellipses"));
        let sides = [number(depth.map(|image| image.header)), number(ellipses.map(|list| list.header))];
        writeln!(self.file, "{} {}", input.header.sequence, sides.join(" "))?;
        std::thread::sleep(self.delay);
        Ok(())
    }
}

fn main() -> ExitCode {
    run_stage::<PairingSink>()
}
