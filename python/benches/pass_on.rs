//! The reference for `benches/stage.py`: a stage in Rust that reads one pixel of each depth image and sends an empty list.

use conicflow_dataflow::{Context, NoConfig, Output, SideInputs, Stage, StageError, run_stage};
use conicflow_messages::{Message, Object};
use std::process::ExitCode;

struct PassOn;

impl Stage for PassOn {
    const NAME: &'static str = "pass_on";
    const SUMMARY: &'static str = "Looks at one pixel and sends an empty list";
    type Config = NoConfig;
    type Input = u16;
    type Output = Object;

    fn new(_: NoConfig, _: &Context) -> Result<Self, StageError> {
        Ok(Self)
    }

    fn step(&mut self, input: &Message<u16>, _: &SideInputs, output: &mut Output<Object>) -> Result<(), StageError> {
        output.count("measured", u64::from(input.items[0] > 0));
        Ok(())
    }
}

fn main() -> ExitCode {
    run_stage::<PassOn>()
}
