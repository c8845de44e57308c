//! Stages as separate processes, joined by shared memory and described by a pipeline file.

mod clock;
mod sides;
mod stage;

pub use clock::monotonic_ns;
pub use sides::{AnyMessage, Pick, Side, Sides};
pub use stage::{Config, ConfigFault, Context, Next, NoConfig, Output, Pace, Source, Stage, StageError, Stop};
