//! The paper's Algorithm 1 with its pre-filter (`arcs = "conic"`): a scan line is split at holes and depth jumps into runs
//! ([`scan_line`]). Along a run a model grows point by point on running sums, and ends where no line and no ellipse explains
//! its points any more ([`growth`]); what is left of the run starts the next one, so that one pass finds all ellipses of a
//! line. Walls, specks and hollows are then turned down, each under the name of its reason ([`filter`]).

mod filter;
mod growth;
mod scan_line;
#[cfg(test)]
mod tests;

use conicflow_detection::ExtractorParameters;
use conicflow_detection::ScanLines;
use conicflow_detection::extract::ArcRejections;
use conicflow_geometry::Scan;
use conicflow_messages::{Ellipse, Header};
use scan_line::ScanLine;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters of `arcs = "conic"` alone.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ConicParameters {
    /// Largest root mean square distance of points from their line or ellipse, in standard deviations of the
    /// sensor.
    #[schemars(range(min = 0.1, max = 20.0))]
    pub max_error_sigmas: f64,
    /// Added to it, for what the noise model leaves out, in metres.
    #[schemars(range(min = 0.0, max = 0.1))]
    pub max_error_floor_m: f64,
    /// A depth step ends a run beyond this many standard deviations of the sensor ...
    #[schemars(range(min = 0.0, max = 100.0))]
    pub jump_sigmas: f64,
    /// ... plus what a surface of this slope (depth per distance across the view) would step.
    #[schemars(range(min = 0.1, max = 100.0))]
    pub jump_slope: f64,
    /// Fewest points of an ellipse.
    #[schemars(range(min = 6, max = 1000))]
    pub min_points: u32,
    /// Smallest ratio of the shorter to the longer semi-axis; flatter ellipses are walls and floors.
    #[schemars(range(min = 0.01, max = 1.0))]
    pub min_radius_ratio: f64,
    /// Smallest angle that the points span around the centre, in degrees.
    #[schemars(range(min = 0.0, max = 180.0))]
    pub min_arc_deg: f64,
}

impl Default for ConicParameters {
    fn default() -> Self {
        Self {
            max_error_sigmas: 1.3,
            max_error_floor_m: 0.0005,
            jump_sigmas: 5.0,
            jump_slope: 5.0,
            min_points: 10,
            min_radius_ratio: 0.2,
            min_arc_deg: 60.0,
        }
    }
}

/// All that the extractor goes by.
#[derive(Clone, Debug, Default)]
pub struct ConicConfig {
    /// What every extractor has.
    pub common: ExtractorParameters,
    /// What this one has alone.
    pub conic: ConicParameters,
}

impl ConicConfig {
    /// The paper's way: ellipses of the rows alone.
    pub fn of_the_paper() -> Self {
        let common = ExtractorParameters { scan: ScanLines::Rows, ..ExtractorParameters::default() };
        Self { common, conic: ConicParameters::default() }
    }
}

/// Finds the ellipses of depth images; its buffers are used again for the next.
#[derive(Debug)]
pub struct ConicExtractor {
    config: ConicConfig,
    line: ScanLine,
    ellipses: Vec<Ellipse>,
    rejections: ArcRejections,
}

impl ConicExtractor {
    /// An extractor with these parameters.
    pub fn new(config: ConicConfig) -> Self {
        Self { config, line: ScanLine::default(), ellipses: Vec::new(), rejections: ArcRejections::default() }
    }

    /// The ellipses of the depth image `pixels` (row by row, `width * height` of them), in the order of the scan lines.
    pub fn extract(&mut self, header: &Header, pixels: &[u16]) -> &[Ellipse] {
        self.ellipses.clear();
        self.rejections = ArcRejections::default();
        let line_step = self.config.common.line_step;
        for &scan in self.config.common.scan.directions() {
            let lines = match scan {
                Scan::Row => header.camera.height,
                Scan::Column => header.camera.width,
            };
            for line in (0..lines).step_by(line_step.max(1) as usize) {
                self.line.read(header, pixels, scan, line, &self.config);
                self.ellipses_of_line(header);
            }
        }
        self.ellipses.iter_mut().for_each(|ellipse| ellipse.line_step = line_step);
        &self.ellipses
    }

    /// Why arcs of the last image were turned down, and how many of them.
    pub fn rejections(&self) -> impl Iterator<Item = (&'static str, u64)> {
        self.rejections.iter()
    }

    fn ellipses_of_line(&mut self, header: &Header) {
        for run in self.line.runs() {
            let mut rest = run;
            while !rest.is_empty() {
                let arc = growth::grow(rest, &self.line.plane, &header.noise, &self.config);
                match filter::accept(&arc, &self.line, &header.noise, &self.config) {
                    Ok(ellipse) => self.ellipses.push(ellipse),
                    Err(reason) => self.rejections.count(reason),
                }
                rest = &rest[arc.points.len()..];
            }
        }
    }
}
