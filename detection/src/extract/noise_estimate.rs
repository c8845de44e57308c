//! What is known of the noise of an image.

use conicflow_geometry::Scan;
use conicflow_messages::NoiseModel;

/// The noise of an image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct NoiseEstimate {
    /// Its variance, times `level`, is that of a depth.
    pub model: NoiseModel,
    pub level: f64,
    /// By how much neighbours of different surfaces scatter: no less than the source told, as a driver that smooths does so
    /// within surfaces.
    pub neighbour_model: NoiseModel,
    /// Variances of what is near and what is far, in those that the source told.
    pub variance_ratios: [f64; 2],
    /// How many neighbours in a row, and in a column, share it (`noise_planes.rs`), at least 1.
    pub correlation_px: [f64; 2],
    /// How many neighbouring rows, and how many columns, are averaged against it (`averaging.rs`); 1: none.
    pub averaged: [u32; 2],
}

impl NoiseEstimate {
    /// As the source told it.
    pub fn nominal(model: NoiseModel) -> Self {
        Self::of_level(model, 1.0)
    }

    /// A model whose variances are `level` times as large.
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

    /// How many pixels along a line, and how many lines, share the noise, and how many lines are averaged.
    pub fn seen_along(&self, scan: Scan) -> ([f64; 2], u32) {
        let ([rows, columns], [of_rows, of_columns]) = (self.correlation_px, self.averaged);
        match scan {
            Scan::Row => ([rows, columns], of_rows),
            Scan::Column => ([columns, rows], of_columns),
        }
    }
}
