//! Finds ellipses in the scan lines of a depth image by random sample consensus, with which the paper compares its extractor; it
//! can replace that extractor's stage.
//!
//! Fischler, Bolles, "Random sample consensus" (CACM 1981): four random points of a line determine an ellipse along the axes of
//! the scan plane. Of `k = ln(1 - p) / ln(1 - w^4)` such ellipses, the one with the most points on it is fitted to all of these
//! ([`consensus`]). Its points are removed, and the next ellipse is searched among the rest. The points of an arc need not be
//! connected: points of a wall that are far apart may support a flat ellipse.

mod consensus;
#[cfg(test)]
mod tests;

use crate::random::CounterRng;
use crate::scan_line::{self, ScanLine, span};
use conicflow_detection::ScanLines;
use conicflow_geometry::{self as geometry, PlaneMoments, fit_ellipse};
use conicflow_messages::{Ellipse, Header, NoiseModel};
use consensus::{Draws, Point, take_consensus};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Parameters of `ransac_ellipse_extractor`.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RansacParameters {
    /// Scan lines to look at: `rows`, `columns` (for objects that lie) or `both`.
    pub scan: ScanLines,
    /// Looks at every n-th scan line.
    #[schemars(range(min = 1, max = 64))]
    pub line_step: u32,
    /// Seed of the random numbers; with the number of the frame it determines all of them.
    pub seed: u64,
    /// Probability p of drawing four points of an ellipse at least once, where there is one.
    #[schemars(range(min = 0.01, max = 0.9999))]
    pub confidence: f64,
    /// Share w of a line's points that lie on an ellipse; the number of trials follows from it and `confidence`.
    #[schemars(range(min = 0.1, max = 0.99))]
    pub inlier_ratio: f64,
    /// Largest distance of a point from an ellipse that it lies on, in standard deviations of the sensor.
    #[schemars(range(min = 0.1, max = 20.0))]
    pub max_distance_sigmas: f64,
    /// Added to `max_distance_sigmas`, for what the noise model leaves out, in metres.
    #[schemars(range(min = 0.0, max = 0.1))]
    pub max_distance_floor_m: f64,
    /// Largest number of ellipses in a line.
    #[schemars(range(min = 1, max = 100))]
    pub max_ellipses: u32,
    /// Smallest semi-axis of an ellipse, in metres.
    #[schemars(range(min = 0.001, max = 10.0))]
    pub min_radius_m: f64,
    /// Largest semi-axis of an ellipse, in metres.
    #[schemars(range(min = 0.001, max = 10.0))]
    pub max_radius_m: f64,
    /// Limits on an ellipse; the same table as of `row_ellipse_extractor`.
    pub conic: EllipseLimits,
}

/// Limits on an ellipse.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct EllipseLimits {
    /// Fewest points of an ellipse.
    #[schemars(range(min = 6, max = 1000))]
    pub min_points: u32,
    /// Smallest ratio of the shorter to the longer semi-axis; flatter ellipses are walls and floors.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub min_radius_ratio: f64,
}

impl Default for EllipseLimits {
    fn default() -> Self {
        Self { min_points: 10, min_radius_ratio: 0.4 }
    }
}

impl Default for RansacParameters {
    fn default() -> Self {
        Self {
            scan: ScanLines::Rows,
            line_step: 1,
            seed: 0,
            confidence: 0.95,
            inlier_ratio: 0.3,
            max_distance_sigmas: 2.5,
            max_distance_floor_m: 0.0005,
            max_ellipses: 3,
            min_radius_m: 0.015,
            max_radius_m: 0.6,
            conic: EllipseLimits::default(),
        }
    }
}

impl RansacParameters {
    /// Returns the number of trials after which one has drawn four points of an ellipse with probability `confidence`.
    pub fn trials(&self) -> u32 {
        let right = self.inlier_ratio.powi(consensus::SAMPLE as i32);
        ((1.0 - self.confidence).ln() / (1.0 - right).ln()).ceil() as u32
    }

    /// Returns a measurement with its largest distance from an ellipse.
    fn limited(&self, &scan_line::Point { pixel, depth, st }: &scan_line::Point, noise: &NoiseModel) -> Point {
        let limit = self.max_distance_floor_m + self.max_distance_sigmas * noise.sigma(depth);
        Point { pixel, st, limit2: limit * limit }
    }

    /// Whether size and shape of an ellipse are within the limits.
    fn admits(&self, ellipse: &geometry::Ellipse) -> bool {
        let [long, short] = ellipse.semi_axes;
        short >= self.min_radius_m && long <= self.max_radius_m && short >= self.conic.min_radius_ratio * long
    }
}

/// Finds the ellipses of a depth image.
#[derive(Debug)]
pub struct RansacEllipseExtractor {
    config: RansacParameters,
    ellipses: Vec<Ellipse>,
    rejections: BTreeMap<&'static str, u64>,
}

impl RansacEllipseExtractor {
    /// Creates an extractor with these parameters.
    pub fn new(config: RansacParameters) -> Self {
        Self { config, ellipses: Vec::new(), rejections: BTreeMap::new() }
    }

    /// Returns the ellipses of the depth image `pixels` (row by row, `width * height` of them), in the order of the scan lines.
    pub fn extract(&mut self, header: &Header, pixels: &[u16]) -> &[Ellipse] {
        self.ellipses.clear();
        self.rejections.clear();
        let config = &self.config;
        let mut draws = Draws::new(CounterRng::new(config.seed, header.sequence));
        for line in ScanLine::all(header, pixels, config.scan, config.line_step) {
            let mut points = line.points.iter().map(|point| config.limited(point, &header.noise)).collect();
            for _ in 0..config.max_ellipses {
                let Some(inliers) = take_consensus(&mut points, config, &mut draws) else { break };
                match fitted(&inliers, &line, config) {
                    Ok(ellipse) => self.ellipses.push(ellipse),
                    Err(reason) => *self.rejections.entry(reason).or_default() += 1,
                }
            }
        }
        &self.ellipses
    }

    /// Returns the reasons for rejected consensus sets of the last image, and their counts.
    pub fn rejections(&self) -> impl Iterator<Item = (&'static str, u64)> {
        self.rejections.iter().map(|(reason, times)| (*reason, *times))
    }
}

/// Returns the ellipse of all points of a consensus, or the reason to reject it.
fn fitted(points: &[Point], line: &ScanLine, config: &RansacParameters) -> Result<Ellipse, &'static str> {
    let (first, last) = points.first().zip(points.last()).ok_or("consensus of no points")?;
    let moments = PlaneMoments::of(first.st, points.iter().map(|point| point.st));
    let none = "consensus without ellipse";
    let (conic, [_, depth]) = fit_ellipse(&moments).zip(moments.mean()).ok_or(none)?;
    let (ellipse, rms) = conic.to_ellipse().zip(conic.rms(&moments)).ok_or(none)?;
    if !config.admits(&ellipse) {
        return Err("fitted ellipses beyond the limits");
    }
    if ellipse.center[1] <= depth {
        return Err("concave arcs");
    }
    let arc = span(&ellipse, [first.st, last.st]);
    Ok(line.message(&ellipse, [first.pixel, last.pixel], &moments, rms, arc))
}
