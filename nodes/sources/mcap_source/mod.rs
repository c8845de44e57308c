//! Plays back recordings of robots: MCAP files with ROS 2 messages of any program, and recordings of `mcap_sink` and `conicflow
//! record`, whose frames and lists come back bit by bit.
//!
//! A frame that cannot be read is logged, counted as `frames unreadable` and skipped; so is an unreadable part of a file, counted
//! as `damaged places`.

mod channels;
mod config;
#[cfg(test)]
mod fixtures;
#[cfg(test)]
mod own_tests;
mod replay;
#[cfg(test)]
mod tests;

pub use channels::has_own;
pub use config::Config;
pub use replay::{Replay, Replayed};

use crate::faults::stage_error;
use config::DEPTH;
use conicflow_dataflow::{ConfigFault, Context, FileUse, Next, Output, SideInputs, Source, StageError};
use conicflow_messages::AnyByte;
use std::path::Path;

/// Sends the messages of a recording.
pub struct McapSource {
    replay: Replay,
    rate_hz: Option<f64>,
}

impl Source for McapSource {
    const NAME: &'static str = "mcap_source";
    const SUMMARY: &'static str = "Plays back MCAP recordings: depth images of ROS 2, and what conicflow has recorded";
    type Config = Config;
    type Output = AnyByte;

    fn faults(config: &Self::Config, base: &Path) -> Vec<ConfigFault> {
        config.faults(base)
    }

    fn reads(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        config.reads(base, "path")
    }

    fn new(config: Config, context: &Context) -> Result<Self, StageError> {
        let item = context.output.clone().unwrap_or(DEPTH);
        let replay = Replay::resume(&config, &context.base, &item, context.resume_at, &context.stop)?;
        Ok(Self { replay, rate_hz: config.rate_hz })
    }

    fn message_length(config: &Config, base: &Path) -> Option<usize> {
        // A recording that cannot be opened is reported when the stage starts.
        Replay::open(config, base, &DEPTH).ok()?.pixels()
    }

    fn rate_hz(&self) -> f64 {
        self.rate_hz.unwrap_or(0.0)
    }

    fn keeps_stamps(&self) -> bool {
        self.rate_hz.is_none()
    }

    fn can_pause(&self) -> bool {
        true
    }

    fn next(&mut self, _: &SideInputs, output: &mut Output<AnyByte>) -> Result<Next, StageError> {
        let next = self.replay.next_message();
        output.count_all(self.replay.take_counts());
        let Some(message) = next.map_err(stage_error)? else { return Ok(Next::End) };
        let items = output.loan(message.items.len() / self.replay.item().size())?;
        bytemuck::cast_slice_mut(items).copy_from_slice(&message.items);
        output.header = message.header;
        Ok(Next::Message)
    }
}
