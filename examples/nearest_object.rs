//! A stage outside of this repository: passes on the objects that are nearest to the camera.
//!
//! Once built, it runs in any pipeline file, with its parameters in its table like those of the built-in nodes:
//!
//! ```toml
//! [stage.nearest]
//! program = ["target/release/examples/nearest_object"]
//! input   = "objects"
//! output  = "nearest"
//! max_objects = 1
//! ```

use conicflow_dataflow::{Context, Output, SideInputs, Stage, StageError, run_stage};
use conicflow_messages::{Message, Object};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::process::ExitCode;

/// Parameters of `nearest_object`.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
struct NearestObjectConfig {
    /// Maximum number of objects that are passed on.
    max_objects: usize,
}

impl Default for NearestObjectConfig {
    fn default() -> Self {
        Self { max_objects: 1 }
    }
}

/// Passes on the objects that are nearest to the camera, the nearest first.
struct NearestObject {
    config: NearestObjectConfig,
    by_depth: Vec<Object>,
}

impl Stage for NearestObject {
    const NAME: &'static str = "nearest_object";
    const SUMMARY: &'static str = "Passes on the objects that are nearest to the camera";
    type Config = NearestObjectConfig;
    type Input = Object;
    type Output = Object;

    fn new(config: NearestObjectConfig, _: &Context) -> Result<Self, StageError> {
        Ok(Self { config, by_depth: Vec::new() })
    }

    fn step(&mut self, input: &Message<Object>, _: &SideInputs, output: &mut Output<Object>) -> Result<(), StageError> {
        self.by_depth.clear();
        self.by_depth.extend_from_slice(input.items);
        self.by_depth.sort_by(|a, b| a.center[2].total_cmp(&b.center[2]));
        self.by_depth.iter().take(self.config.max_objects).for_each(|object| output.push(*object));
        output.count("farther objects", self.by_depth.len().saturating_sub(self.config.max_objects) as u64);
        Ok(())
    }
}

fn main() -> ExitCode {
    run_stage::<NearestObject>()
}
