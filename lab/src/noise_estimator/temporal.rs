//! Mean and variance of each pixel over time, in one pass.

use super::fit::Spreads;
use crate::running_stats::RunningStats;
use conicflow_messages::is_measured;

/// Statistics of the depths of all pixels, in metres.
#[derive(Clone, Debug, Default)]
pub struct Temporal {
    pixels: Vec<RunningStats>,
}

impl Temporal {
    /// Adds an image of the same size as those before, of `depth_scale` metres per unit.
    pub fn add(&mut self, pixels: &[u16], depth_scale: f64) {
        self.pixels.resize(pixels.len(), RunningStats::default());
        for (depths, &pixel) in self.pixels.iter_mut().zip(pixels).filter(|(_, pixel)| is_measured(**pixel)) {
            depths.add(f64::from(pixel) * depth_scale);
        }
    }

    /// Returns the variances of the pixels with enough measurements.
    pub fn spreads(&self, min_frames: u32) -> Spreads {
        let mut spreads = Spreads::default();
        for depths in self.pixels.iter().filter(|depths| depths.count() >= u64::from(min_frames)) {
            spreads.add(depths.mean(), depths.variance());
        }
        spreads
    }
}
