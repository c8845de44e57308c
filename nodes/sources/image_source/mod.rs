//! Plays back recorded depth frames: folders of 16-bit PNGs, TIFF or NPY files, TUM RGB-D folders, organised PCD
//! files.
//!
//! A frame that cannot be read is logged, counted as `frames unreadable` and skipped; its place in time is kept. It is an error
//! if no frame can be read, if frames differ in size, and at the end if frames that were readable at the beginning no longer were
//! when their turn came.

mod config;
mod depth_png;
mod faulty;
mod intrinsics;
mod layout;
mod npy;
mod pcd;
mod pinhole;
pub(crate) mod playback;
mod poses;
mod raster;
pub(crate) mod reading;
mod recording;
mod trajectory;
mod tum;

#[cfg(test)]
mod fixtures;

pub(crate) use config::USUAL_RATE_HZ;
pub use config::{Config, PosesConfig};
pub use playback::Playback;
pub use recording::Recording;

use crate::faults::stage_error;
use conicflow_dataflow::{ConfigFault, Context, FileUse, Next, Output, SideInputs, Source, StageError};
use playback::UNREADABLE;
use std::path::Path;
use std::time::{Duration, Instant};

/// Period of the log lines about progress with the files of a recording.
const TELL: Duration = Duration::from_secs(5);

/// Sends the frames of a recording.
pub struct ImageSource(Playback);

impl Source for ImageSource {
    const NAME: &'static str = "image_source";
    const SUMMARY: &'static str =
        "Plays back recorded depth frames: 16-bit PNGs, TIFF, NPY, TUM RGB-D folders, organised PCD files";
    type Config = Config;
    type Output = u16;

    fn faults(config: &Self::Config, base: &Path) -> Vec<ConfigFault> {
        config.faults(base)
    }

    fn reads(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        reading::files(config, base, "path", "poses")
    }

    fn new(config: Config, context: &Context) -> Result<Self, StageError> {
        let counted = context.counted.get(UNREADABLE).copied().unwrap_or(0);
        let mut last_logged = Instant::now();
        let mut progress = |seen: usize, all: usize| {
            // The call shows the launcher that the stage is alive.
            context.stop.requested();
            if last_logged.elapsed() > TELL {
                last_logged = Instant::now();
                tracing::info!("looked at {seen} of {all} files of the recording");
            }
        };
        let from = (context.resume_at, counted);
        Ok(Self(Playback::open_with_progress(&config, &context.base, from, &mut progress)?))
    }

    fn message_length(config: &Config, base: &Path) -> Option<usize> {
        // A recording that cannot be opened is reported when the stage starts.
        Recording::pixels_of(&base.join(config.path.as_ref()?))
    }

    fn rate_hz(&self) -> f64 {
        self.0.rate_hz()
    }

    fn total(&self) -> Option<u64> {
        self.0.total()
    }

    fn can_pause(&self) -> bool {
        true
    }

    fn next(&mut self, _: &SideInputs, output: &mut Output<u16>) -> Result<Next, StageError> {
        while let Some(loaded) = self.0.load().map_err(stage_error)? {
            let pixels = output.loan(loaded.pixels())?;
            let header = self.0.decode(&loaded, pixels).map_err(stage_error)?;
            output.count_all(self.0.take_counts());
            if let Some(header) = header {
                output.header = header;
                return Ok(Next::Message);
            }
        }
        output.count_all(self.0.take_counts());
        Ok(Next::End)
    }

    fn finish(&mut self) -> Result<(), StageError> {
        self.0.finish().map_err(stage_error)
    }
}

#[cfg(test)]
mod tests;
