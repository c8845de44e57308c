//! A stage that passes on what it gets, but at one frame panics, hangs, so that it neither comes back nor listens, or writes
//! nonsense.

use conicflow_dataflow::{Context, Output, Sides, Stage, StageError, run_stage};
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
    /// The frame from which on, for three frames, it writes what is no object.
    nonsense_at: Option<u64>,
}

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
        let number = self.0.nonsense_at.and_then(|first| input.header.sequence.checked_sub(first));
        number.and_then(nonsense).into_iter().for_each(|object| output.push(object));
        Ok(())
    }
}

/// Numbers that are none, a kind that there is not, and any bits at all.
fn nonsense(number: u64) -> Option<Object> {
    let mut object = Object::default();
    match number {
        0 => object.center = [f64::NAN; 3],
        1 => object.radius = f64::INFINITY,
        2 => bytemuck::bytes_of_mut(&mut object).fill(0xff),
        _ => return None,
    }
    Some(object)
}

fn main() -> ExitCode {
    run_stage::<FaultyStage>()
}
