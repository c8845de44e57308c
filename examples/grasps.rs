//! Two stages with their own item type, outside of this repository: one computes where a gripper can grasp each object, the other
//! writes down the grasps.
//!
//! The pipeline file describes the type for all programs that carry or show it without knowing it:
//!
//! ```toml
//! [item.grasps]
//! type   = "acme.Grasp.v1"
//! fields = { position = "f64[3]", width = "f64", id = "u32", shape = "text[12]" }
//!
//! [stage.planner]
//! program = ["target/release/examples/grasps", "plan"]
//! input   = "objects"
//! output  = { topic = "grasps", kind = "grasps" }
//! max_width = 0.2
//!
//! [stage.gripper]
//! program = ["target/release/examples/grasps", "take"]
//! input   = "grasps"
//! ```

use bytemuck::{Pod, Zeroable};
use conicflow_dataflow::{Context, NoConfig, Output, SideInputs, Stage, StageError, run_stage};
use conicflow_messages::{Header, Item, Malformed, Message, Nothing, Object, Text};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::Write;
use std::process::ExitCode;

/// A grasp: the fields in the order of the pipeline file.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
struct Grasp {
    /// In the camera frame, in metres.
    position: [f64; 3],
    /// Required opening of the gripper, in metres.
    width: f64,
    /// Index of the object in its list.
    id: u32,
    /// The shape of the object.
    shape: Text<12>,
}

impl Item for Grasp {
    const NAME: &'static str = "grasps";
    const TYPE_NAME: &'static str = "acme.Grasp.v1";

    fn check(_: &Header, items: &[Self]) -> Result<(), Malformed> {
        for grasp in items {
            let is_finite = grasp.position.iter().all(|number| number.is_finite());
            if !(is_finite && grasp.width >= 0.0) {
                return Err(Malformed::new(Self::NAME, format!("no gripper can take {grasp:?}")));
            }
        }
        Ok(())
    }
}

/// Parameters of the planner.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
struct PlannerConfig {
    /// Maximum width of a grasp, in metres.
    max_width: f64,
}

impl Default for PlannerConfig {
    fn default() -> Self {
        Self { max_width: 1.0 }
    }
}

/// Computes where a gripper can grasp each object.
struct Planner {
    config: PlannerConfig,
}

impl Stage for Planner {
    const NAME: &'static str = "grasp_planner";
    const SUMMARY: &'static str = "Tells where a gripper may take each object";
    type Config = PlannerConfig;
    type Input = Object;
    type Output = Grasp;

    fn new(config: PlannerConfig, _: &Context) -> Result<Self, StageError> {
        Ok(Self { config })
    }

    fn step(&mut self, input: &Message<Object>, _: &SideInputs, output: &mut Output<Grasp>) -> Result<(), StageError> {
        for (id, object) in (0..).zip(input.items) {
            let (width, shape) = (2.0 * object.radius, Text::new(object.shape().name()));
            if width <= self.config.max_width {
                output.push(Grasp { position: object.center, width, id, shape });
            }
        }
        Ok(())
    }
}

/// Writes down the grasps that it receives.
struct Gripper {
    file: File,
}

impl Stage for Gripper {
    const NAME: &'static str = "gripper";
    const SUMMARY: &'static str = "Writes down the grasps that it gets";
    type Config = NoConfig;
    type Input = Grasp;
    type Output = Nothing;

    fn new(_: NoConfig, context: &Context) -> Result<Self, StageError> {
        let path = context.base.join("taken.txt");
        Ok(Self { file: File::options().create(true).append(true).open(path)? })
    }

    fn step(&mut self, input: &Message<Grasp>, _: &SideInputs, _: &mut Output<Nothing>) -> Result<(), StageError> {
        for grasp in input.items {
            let [x, y, z] = grasp.position;
            writeln!(self.file, "{} {} {} {x} {y} {z} {}", input.header.sequence, grasp.id, grasp.shape, grasp.width)?;
        }
        Ok(())
    }
}

fn main() -> ExitCode {
    match std::env::args().nth(1).as_deref() {
        Some("take") => run_stage::<Gripper>(),
        _ => run_stage::<Planner>(),
    }
}
