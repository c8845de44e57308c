//! Finds ellipses in the scan lines of a depth image.
//!
//! `arcs = "moments"` ([`arcs`]): a line is cut where neither a line nor a circle explains its points; what is round goes
//! on with moments that are free of the noise's bias, for the pooled fits of the assembler.
//!
//! `arcs = "conic"`, the paper's Algorithm 1 with its pre-filter: a scan line is split at holes and depth jumps into
//! runs ([`scan_line`]). Along a run a model grows point by point on running sums, and ends where no line and no ellipse
//! explains its points any more ([`growth`]); what is left of the run starts the next one, so that one pass finds all
//! ellipses of a line. Walls, specks and hollows are then turned down, each under the name of its reason ([`filter`]).

mod arcs;
mod filter;
mod growth;
#[cfg(test)]
pub(crate) mod rendered;
mod scan_line;
#[cfg(test)]
mod tests;

use arcs::{Arcs, SeenNoise};
use conicflow_dataflow::{Config, ConfigFault, Context, Output, Sides, Stage, StageError};
use conicflow_geometry::Scan;
use conicflow_messages::{Ellipse, Header, Message, NoiseModel};
use filter::Rejections;
use scan_line::ScanLine;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;
use std::path::Path;

/// Which scan lines are looked at.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ScanLines {
    /// Rows: finds upright objects.
    Rows,
    /// Columns: finds lying ones.
    Columns,
    /// Rows, then columns.
    #[default]
    Both,
}

/// How a scan line is cut into arcs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ArcFinder {
    /// The paper's way: an ellipse grows point by point.
    Conic,
    /// Lines and circles through moments that are free of the noise's bias, for the pooled fits of the assembler.
    #[default]
    Moments,
}

/// Parameters of the extractor.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct RowEllipseConfig {
    /// How a scan line is cut into arcs: `moments`, for `method = "pooled"` of the assembler, or `conic`, the paper's way.
    pub arcs: ArcFinder,
    /// Scan lines to look at: `rows`, `columns` (for objects that lie) or `both`.
    pub scan: ScanLines,
    /// Looks at every n-th scan line.
    #[schemars(range(min = 1, max = 64))]
    pub line_step: u32,
    /// Of `conic`: largest root mean square distance of points from their line or ellipse, in standard deviations of the
    /// sensor. (`moments` follows the noise model alone.)
    #[schemars(range(min = 0.1, max = 20.0))]
    pub max_error_sigmas: f64,
    /// Of `conic`: added to it, for what the noise model leaves out, in metres.
    #[schemars(range(min = 0.0, max = 0.1))]
    pub max_error_floor_m: f64,
    /// Of `conic`: a depth step ends a run beyond this many standard deviations of the sensor ...
    #[schemars(range(min = 0.0, max = 100.0))]
    pub jump_sigmas: f64,
    /// Of `conic`: ... plus what a surface of this slope (depth per distance across the view) would step.
    #[schemars(range(min = 0.1, max = 100.0))]
    pub jump_slope: f64,
    /// Number of missing pixels that are bridged inside a run.
    #[schemars(range(min = 0, max = 64))]
    pub max_hole_px: u32,
    /// Number of points taken off both ends of a run, where pixels mix two depths; `moments` puts the last of them back
    /// where its ray meets the circle through the others.
    #[schemars(range(min = 0, max = 16))]
    pub trim_px: u32,
    /// Of `conic`: fewest points of an ellipse.
    #[schemars(range(min = 6, max = 1000))]
    pub min_points: u32,
    /// Smallest semi-axis of an ellipse, in metres; of `moments` smallest radius of a circle.
    #[schemars(range(min = 0.001, max = 10.0))]
    pub min_radius_m: f64,
    /// Largest semi-axis of an ellipse, in metres. Of `moments` what is wider than twice this is a wall; the circle through a
    /// short arc is uncertain and may be four times as large.
    #[schemars(range(min = 0.001, max = 10.0))]
    pub max_radius_m: f64,
    /// Of `conic`: smallest ratio of the shorter to the longer semi-axis; flatter ellipses are walls and floors.
    #[schemars(range(min = 0.01, max = 1.0))]
    pub min_radius_ratio: f64,
    /// Of `conic`: smallest angle that the points span around the centre, in degrees.
    #[schemars(range(min = 0.0, max = 180.0))]
    pub min_arc_deg: f64,
}

impl Default for RowEllipseConfig {
    fn default() -> Self {
        Self {
            arcs: ArcFinder::Moments,
            scan: ScanLines::Both,
            line_step: 1,
            max_error_sigmas: 1.3,
            max_error_floor_m: 0.0005,
            jump_sigmas: 5.0,
            jump_slope: 5.0,
            max_hole_px: 3,
            trim_px: 1,
            min_points: 10,
            min_radius_m: 0.015,
            max_radius_m: 0.6,
            min_radius_ratio: 0.2,
            min_arc_deg: 60.0,
        }
    }
}

impl Config for RowEllipseConfig {
    fn faults(&self, _: &Path) -> Vec<ConfigFault> {
        let (least, most) = (self.min_radius_m, self.max_radius_m);
        let fault = || ConfigFault {
            key: "min_radius_m",
            what: format!("nothing lies between {least} m and `max_radius_m`, {most} m"),
            hint: "set it to less than `max_radius_m`".to_owned(),
        };
        (least >= most).then(fault).into_iter().collect()
    }

    fn idle(&self) -> Vec<ConfigFault> {
        let of_conic = if self.arcs == ArcFinder::Moments { &OF_CONIC[..] } else { &[] };
        let idle = |&key| ConfigFault {
            key,
            what: "has no effect with `arcs = \"moments\"`".to_owned(),
            hint: "leave it out, or write `arcs = \"conic\"`".to_owned(),
        };
        of_conic.iter().map(idle).collect()
    }
}

/// Parameters that `arcs = "conic"` alone has.
const OF_CONIC: [&str; 7] = [
    "max_error_sigmas",
    "max_error_floor_m",
    "jump_sigmas",
    "jump_slope",
    "min_points",
    "min_radius_ratio",
    "min_arc_deg",
];

impl RowEllipseConfig {
    /// The paper's way: ellipses of the rows alone.
    pub fn of_the_paper() -> Self {
        Self { arcs: ArcFinder::Conic, scan: ScanLines::Rows, ..Self::default() }
    }
}

/// Variances of an image, in those of its noise model, that need not be spoken of.
const USUAL_LEVELS: RangeInclusive<f64> = 0.1..=2.0;

/// Finds the ellipses of a depth image.
#[derive(Debug)]
pub struct RowEllipseExtractor {
    config: RowEllipseConfig,
    line: ScanLine,
    arcs: Arcs,
    noise: SeenNoise,
    warned: bool,
    ellipses: Vec<Ellipse>,
    rejections: Rejections,
}

impl RowEllipseExtractor {
    /// An extractor with these parameters.
    pub fn with(config: RowEllipseConfig) -> Self {
        Self {
            arcs: Arcs::with(config.clone()),
            config,
            line: ScanLine::default(),
            noise: SeenNoise::as_told(NoiseModel::IDEAL),
            warned: false,
            ellipses: Vec::new(),
            rejections: Rejections::default(),
        }
    }

    /// The ellipses of the depth image `pixels` (row by row, `width * height` of them), in the order of the scan lines.
    pub fn extract(&mut self, header: &Header, pixels: &[u16]) -> &[Ellipse] {
        self.ellipses.clear();
        self.rejections = Rejections::default();
        if self.config.arcs == ArcFinder::Moments {
            self.noise = self.arcs.seen_noise(header, pixels);
            self.warn_of_noise();
        }
        if self.config.scan != ScanLines::Columns {
            self.scan(header, pixels, Scan::Row);
        }
        if self.config.scan != ScanLines::Rows {
            self.scan(header, pixels, Scan::Column);
        }
        self.ellipses.iter_mut().for_each(|ellipse| ellipse.line_step = self.config.line_step);
        &self.ellipses
    }

    /// Says once that the noise model is not that of the sensor.
    fn warn_of_noise(&mut self) {
        let [near, far] = self.noise.told.map(f64::sqrt);
        if self.warned || self.noise.told.iter().all(|level| USUAL_LEVELS.contains(level)) {
            return;
        }
        self.warned = true;
        tracing::warn!(
            "what is near is {near:.1} and what is far {far:.1} times as noisy as the source's noise model says: it is \
             taken as it is, but less will be found\n  hint: find the sensor's own coefficients with the node \
             `noise_estimator`, and write them into the source's `noise`"
        );
    }

    /// Why arcs of the last image were turned down, and how many of them.
    pub fn rejections(&self) -> impl Iterator<Item = (&'static str, u64)> {
        self.rejections.iter()
    }

    fn scan(&mut self, header: &Header, pixels: &[u16], scan: Scan) {
        match self.config.arcs {
            ArcFinder::Conic => self.conics(header, pixels, scan),
            ArcFinder::Moments => {
                let how = (scan, &self.noise);
                self.arcs.find(header, pixels, how, &mut self.ellipses, &mut self.rejections);
            }
        }
    }

    fn conics(&mut self, header: &Header, pixels: &[u16], scan: Scan) {
        let lines = match scan {
            Scan::Row => header.camera.height,
            Scan::Column => header.camera.width,
        };
        for line in (0..lines).step_by(self.config.line_step.max(1) as usize) {
            self.line.read(header, pixels, scan, line, &self.config);
            self.ellipses_of_line(header);
        }
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

impl Stage for RowEllipseExtractor {
    const NAME: &'static str = "row_ellipse_extractor";
    const SUMMARY: &'static str = "Finds ellipses in the scan lines of a depth image, with the moments of their points";
    type Config = RowEllipseConfig;
    type Input = u16;
    type Output = Ellipse;

    fn new(config: Self::Config, _: &Context) -> Result<Self, StageError> {
        Ok(Self::with(config))
    }

    fn step(&mut self, input: &Message<u16>, _: &Sides, output: &mut Output<Ellipse>) -> Result<(), StageError> {
        self.extract(input.header, input.items);
        self.ellipses.iter().for_each(|&ellipse| output.push(ellipse));
        self.rejections.iter().for_each(|(reason, times)| output.count(reason, times));
        Ok(())
    }
}
