//! Depth image -> ellipses: a scan line is cut where neither a line nor a circle explains its points.
//!
//! On an arc of less than half a turn, a circle decides far better than a free ellipse; the true shape is left to the fit of all
//! arcs of an object together. With unbiased moments the expected error of the right curve is zero, so its limit is the scatter
//! due to the noise of n points: `error^2 <= sigma^2 (a sqrt(2 / n) + b) + (0.1 mm)^2`.
//!
//! The files in the order of the steps: the noise of the image ([`noise_level`], [`noise_planes`]); the rows or columns of the
//! image as rays ([`view`]), where columns are rows of the transposed image ([`transposed`]), and much noise is averaged over
//! neighbouring lines ([`averaging`]); one line, split into runs at jumps and holes ([`line`]); the rays of a run, and its
//! running sums ([`rays`], [`run`]); the segments of a run that one curve explains ([`segments`]); the arc of a segment, with its
//! contour ([`arc`]); and the lines between the coarse ones ([`coarse`]). `Extractor::extract` in `method.rs` puts the steps
//! together.

mod arc;
mod averaging;
pub(crate) mod coarse;
mod line;
pub(crate) mod noise_estimate;
pub(crate) mod noise_level;
pub(crate) mod noise_planes;
mod parameters;
mod rays;
mod rejection;
mod run;
mod search;
mod segments;
#[cfg(test)]
mod tests;
pub(crate) mod transposed;
mod view;

pub use parameters::{ExtractorParameters, ScanLines};
pub(crate) use rejection::ArcRejections;

use coarse::CoarseLines;
use conicflow_messages::{Ellipse, NoiseModel};
use noise_estimate::NoiseEstimate;
use noise_level::NoiseSamples;
use noise_planes::PlaneSquares;
use search::LineSearch;
pub(crate) use view::LEAST_VARIANCE;
use view::View;

/// Finds the ellipses of depth images; its buffers are used again for the next image.
#[derive(Debug)]
pub struct Extractor {
    pub(crate) noise: NoiseEstimate,
    pub(crate) view: View,
    pub(crate) search: LineSearch,
    pub(crate) coarse: CoarseLines,
    pub(crate) samples: NoiseSamples,
    pub(crate) squares: PlaneSquares,
    /// The transposed image, whose rows are the columns.
    pub(crate) columns: Vec<u16>,
    pub(crate) ellipses: Vec<Ellipse>,
    pub(crate) rejections: ArcRejections,
}

impl Extractor {
    /// Creates an extractor with these parameters.
    pub fn new(parameters: ExtractorParameters) -> Self {
        Self {
            view: View::with(parameters),
            noise: NoiseEstimate::nominal(NoiseModel::IDEAL),
            search: LineSearch::default(),
            coarse: CoarseLines::default(),
            samples: NoiseSamples::default(),
            squares: PlaneSquares::default(),
            columns: Vec::new(),
            ellipses: Vec::new(),
            rejections: ArcRejections::default(),
        }
    }

    /// Returns the reasons for which arcs of the last image were rejected, with their numbers.
    pub fn rejections(&self) -> impl Iterator<Item = (&'static str, u64)> {
        self.rejections.iter()
    }

    /// Returns the standard deviations of near and of far depths in the last image, relative to the source's noise model.
    pub fn noise_ratios(&self) -> [f64; 2] {
        self.noise.variance_ratios.map(f64::sqrt)
    }
}
