//! Stages as separate processes, joined by shared memory and described by a pipeline file.

mod child;
mod clock;
mod folder;
pub mod in_memory;
mod inbox;
mod launcher;
#[cfg(test)]
mod loops_tests;
mod node;
mod outlet;
mod peers;
pub mod pipeline;
mod plan;
pub mod ports;
mod progress;
mod runner;
pub mod shared_memory;
#[cfg(test)]
mod shared_memory_tests;
mod side_ports;
mod sides;
mod source_loop;
mod stage;
mod stage_loop;
mod stage_process;
mod status;
mod summary;

pub use clock::monotonic_ns;
pub use folder::{FolderError, RUNTIME_DIR, RunFolder, RunLock};
pub use launcher::{LaunchError, RunOptions, run};
pub use node::{Node, Variant};
pub use plan::{Plan, PlannedStage, Runs, Wiring};
pub use runner::RunError;
pub use sides::{AnyMessage, Pick, Side, Sides};
pub use stage::{Config, ConfigFault, Context, Next, NoConfig, Output, Pace, Source, Stage, StageError, Stop};
pub use stage_process::{PIPELINE, ProcessError, run_in_run, run_planned, run_source, run_stage};
pub use status::{Counter, Durations, InputCounts, Life, Status, used};
pub use summary::{StageSummary, Summary};
