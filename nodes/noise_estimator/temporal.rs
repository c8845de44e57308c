//! Mean and variance of each pixel over time, in one pass.
//!
//! B. P. Welford, "Note on a method for calculating corrected sums of squares and products", Technometrics 4, 1962.

use super::fit::Spreads;
use conicflow_messages::is_measured;

/// Running sums of one pixel, in units of the depth image.
#[derive(Clone, Copy, Debug, Default)]
struct Pixel {
    count: u32,
    mean: f64,
    squares: f64,
}

/// Running sums of all pixels.
#[derive(Clone, Debug, Default)]
pub struct Temporal {
    pixels: Vec<Pixel>,
}

impl Temporal {
    /// Adds an image of the same size as those before.
    pub fn add(&mut self, pixels: &[u16]) {
        self.pixels.resize(pixels.len(), Pixel::default());
        for (sums, &depth) in self.pixels.iter_mut().zip(pixels).filter(|(_, depth)| is_measured(**depth)) {
            sums.count += 1;
            let from_mean = f64::from(depth) - sums.mean;
            sums.mean += from_mean / f64::from(sums.count);
            sums.squares += from_mean * (f64::from(depth) - sums.mean);
        }
    }

    /// The variances of the pixels that were measured often enough.
    pub fn spreads(&self, depth_scale: f64, min_frames: u32) -> Spreads {
        let mut spreads = Spreads::default();
        for pixel in self.pixels.iter().filter(|pixel| pixel.count >= min_frames) {
            let variance = pixel.squares / f64::from(pixel.count - 1);
            spreads.add(pixel.mean * depth_scale, variance * depth_scale * depth_scale);
        }
        spreads
    }
}
