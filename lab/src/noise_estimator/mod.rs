//! Estimates the noise of a sensor from a recording, as a line for the pipeline file.
//!
//! In a static scene, only noise changes the depth of a pixel from frame to frame ([`temporal`]). On flat walls and floors, each
//! block of the image is a plane except for noise ([`wall`]). The latter includes constant errors, which a fit to a surface meets
//! as well. Both give variances over depth, to which [`fit`] fits a noise model. In addition, [`planes`] measures the correlation
//! of the noise of neighbouring pixels, in recorded and simulated frames, and [`contours`] how far the sensor shifts silhouettes.

mod contours;
mod fit;
mod levels;
mod planes;
mod temporal;
#[cfg(test)]
mod tests;
mod wall;

pub use contours::Contours;
pub use fit::{NoiseEstimate, Spread};
pub use planes::Planes;

use anyhow::bail;
use conicflow_messages::{Header, Hinted};
use fit::Spreads;
use levels::Levels;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use temporal::Temporal;

/// The content of the recording.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Recorded {
    /// A static scene seen by a camera that does not move.
    #[default]
    StaticScene,
    /// Flat walls and floors; camera and walls may move.
    FlatWall,
}

/// Parameters of `noise_estimator`.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct NoiseEstimatorParameters {
    /// Content of the recording: `static_scene` (nothing moves) or `flat_wall` (walls and floors fill most of the image).
    pub recorded: Recorded,
    /// Least number of measurements of a pixel of a static scene.
    #[schemars(range(min = 3))]
    pub min_frames: u32,
    /// Side of the blocks in which a wall counts as flat, in pixels.
    #[schemars(range(min = 4, max = 128))]
    pub block_px: u32,
}

impl Default for NoiseEstimatorParameters {
    fn default() -> Self {
        Self { recorded: Recorded::StaticScene, min_frames: 20, block_px: 12 }
    }
}

/// Collects the noise of depth images.
pub struct NoiseEstimator {
    config: NoiseEstimatorParameters,
    /// Width and height of the first frame.
    size: Option<(u32, u32)>,
    /// Number of frames.
    frames: u32,
    levels: Levels,
    temporal: Temporal,
    spreads: Spreads,
    planes: Planes,
    contours: Contours,
}

impl NoiseEstimator {
    /// Creates an estimator without data.
    pub fn with(config: NoiseEstimatorParameters) -> Self {
        let (levels, temporal, spreads) = (Levels::default(), Temporal::default(), Spreads::default());
        let (planes, contours) = (Planes::default(), Contours::default());
        Self { config, size: None, frames: 0, levels, temporal, spreads, planes, contours }
    }

    /// Adds a depth image. Its scale may differ from earlier ones, as that of a recorded point cloud depends on its largest
    /// depth.
    ///
    /// # Errors
    /// The image has another size than the first one.
    pub fn add(&mut self, header: &Header, pixels: &[u16]) -> anyhow::Result<()> {
        let size = (header.camera.width, header.camera.height);
        if *self.size.get_or_insert(size) != size {
            let name = header.source.as_str().unwrap_or_default().escape_debug();
            bail!(Hinted::new(
                format!("frame {} of `{name}` has another size than the first one", header.sequence),
                "estimate the noise of one sensor at a time"
            ));
        }
        self.frames += 1;
        self.levels.add(pixels, header.depth_scale);
        self.planes.add(header, pixels, self.config.recorded == Recorded::StaticScene);
        self.contours.add(header, pixels);
        match self.config.recorded {
            Recorded::StaticScene => self.temporal.add(pixels, header.depth_scale),
            Recorded::FlatWall => wall::add(header, pixels, self.config.block_px, &mut self.spreads),
        }
        Ok(())
    }

    /// Returns the correlation of the noise of neighbouring pixels on the planes.
    pub fn planes(&self) -> &Planes {
        &self.planes
    }

    /// Returns the errors of the objects' contours.
    pub fn contours(&self) -> &Contours {
        &self.contours
    }

    /// Returns the noise model that explains the measured noise.
    ///
    /// # Errors
    /// There is too little data.
    pub fn estimate(&self) -> anyhow::Result<NoiseEstimate> {
        if self.size.is_none() {
            bail!(Hinted::new("no frame was seen, so the noise cannot be estimated", "give a recording"));
        }
        let (frames, min_frames) = (self.frames, self.config.min_frames);
        let is_static = self.config.recorded == Recorded::StaticScene;
        if is_static && frames < min_frames {
            bail!(Hinted::new(
                format!("the recording has {frames} frames, but a static scene needs `min_frames` = {min_frames}"),
                "record more frames; a few of flat walls do with `recorded = \"flat_wall\"`"
            ));
        }
        let temporal = is_static.then(|| self.temporal.spreads(min_frames));
        fit::fit(temporal.as_ref().unwrap_or(&self.spreads), self.levels.step_per_m())
    }
}
