//! Stages as separate processes, joined by shared memory and described by a pipeline file.

mod clock;
pub mod in_memory;
mod inbox;
mod node;
mod outlet;
mod peers;
pub mod pipeline;
pub mod ports;
mod runner;
pub mod shared_memory;
mod side_ports;
mod sides;
mod source_loop;
mod stage;
mod stage_loop;
mod status;

pub use clock::monotonic_ns;
pub use node::{Node, Variant};
pub use runner::RunError;
pub use sides::{AnyMessage, Pick, Side, Sides};
pub use stage::{Config, ConfigFault, Context, Next, NoConfig, Output, Pace, Source, Stage, StageError, Stop};
