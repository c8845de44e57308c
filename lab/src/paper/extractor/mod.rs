//! The paper's Algorithm 1 with its pre-filter (`arcs = "conic"`): a scan line is split at holes and depth jumps into runs
//! ([`scan_line`]). Along a run a model grows point by point on running sums, and ends where no line and no ellipse explains
//! its points any more ([`growth`]); what is left of the run starts the next one, so that one pass finds all ellipses of a
//! line. Walls, specks and hollows are then turned down, each under the name of its reason ([`filter`]).

mod filter;
mod growth;
mod parameters;
mod rejection;
mod scan_line;
#[cfg(test)]
mod tests;

pub use parameters::{ConicConfig, ConicParameters};

use conicflow_geometry::Scan;
use conicflow_messages::{Ellipse, Header};
use rejection::ArcRejections;
use scan_line::ScanLine;

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
