//! The estimated noise of an image.

use conicflow_geometry::Scan;
use conicflow_messages::NoiseModel;

/// The noise of an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct NoiseEstimate {
    /// The variance of a depth is that of this model times `level`.
    pub model: NoiseModel,
    pub level: f64,
    /// Noise of neighbours on different surfaces: at least that of the source's model, because a driver smooths only within
    /// surfaces.
    pub neighbour_model: NoiseModel,
    /// Variances at a near and at a far depth, in variances of the source's model.
    pub variance_ratios: [f64; 2],
    /// Number of neighbours along rows, and along columns, that share the noise (`noise_planes.rs`), at least 1.
    pub correlation_px: [f64; 2],
    /// Number of neighbouring rows, and of columns, that are averaged to reduce the noise (`averaging.rs`); 1: none.
    pub averaged: [u32; 2],
}

impl NoiseEstimate {
    /// Returns the noise of the source's model, unchanged.
    pub fn nominal(model: NoiseModel) -> Self {
        Self::of_level(model, 1.0)
    }

    /// Returns the noise of a model with `level` times its variances.
    pub fn of_level(model: NoiseModel, level: f64) -> Self {
        Self {
            model,
            level,
            neighbour_model: model.times(level.max(1.0).sqrt()),
            variance_ratios: [level; 2],
            correlation_px: [1.0; 2],
            averaged: [1; 2],
        }
    }

    /// Returns the number of pixels along a line, and of lines, that share the noise, and the number of lines that are averaged.
    pub fn along(&self, scan: Scan) -> ([f64; 2], u32) {
        let ([rows, columns], [of_rows, of_columns]) = (self.correlation_px, self.averaged);
        match scan {
            Scan::Row => ([rows, columns], of_rows),
            Scan::Column => ([columns, rows], of_columns),
        }
    }
}
