//! A stage that passes on what it gets, but at one frame panics, or hangs: it neither comes back nor listens.

use conicflow_dataflow::{Config, Context, Output, Sides, Stage, StageError, run_stage};
use conicflow_messages::{Message, Object};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::process::ExitCode;

/// Parameters of the stage.
#[derive(Clone, Debug, Default, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
struct FaultyStageConfig {
    /// The frame at which it panics.
    panic_at: Option<u64>,
    /// The frame at which it hangs.
    hang_at: Option<u64>,
}

impl Config for FaultyStageConfig {}

struct FaultyStage(FaultyStageConfig);

impl Stage for FaultyStage {
    const NAME: &'static str = "faulty_stage";
    const SUMMARY: &'static str = "Panics or hangs at one frame";
    type Config = FaultyStageConfig;
    type Input = Object;
    type Output = Object;

    fn new(config: FaultyStageConfig, _: &Context) -> Result<Self, StageError> {
        Ok(Self(config))
    }

    fn step(&mut self, input: &Message<Object>, _: &Sides, output: &mut Output<Object>) -> Result<(), StageError> {
        let frame = Some(input.header.sequence);
        assert!(frame != self.0.panic_at, "this frame is too much");
        if frame == self.0.hang_at {
            loop {
                std::thread::park();
            }
        }
        input.items.iter().for_each(|object| output.push(*object));
        Ok(())
    }
}

fn main() -> ExitCode {
    run_stage::<FaultyStage>()
}
