//! The paper's Algorithm 1 with its pre-filter (`arcs = "conic"`): a scan line is split at holes and depth jumps into runs
//! ([`runs`]). Along a run a model grows point by point on running sums, until no line and no ellipse explains its points any
//! more ([`growth`]). The rest of the run starts the next model, so that one pass finds all ellipses of a line. Walls, specks and
//! hollows are then rejected, each with its reason ([`filter`]).

mod filter;
mod growth;
mod parameters;
mod rejection;
mod runs;
#[cfg(test)]
mod tests;

pub use parameters::{ConicConfig, ConicParameters};

use crate::scan_line::ScanLine;
use conicflow_messages::{Ellipse, Header};
use rejection::ArcRejections;

/// Finds the ellipses of depth images.
#[derive(Debug)]
pub struct ConicExtractor {
    config: ConicConfig,
    ellipses: Vec<Ellipse>,
    rejections: ArcRejections,
}

impl ConicExtractor {
    /// Creates an extractor with these parameters.
    pub fn new(config: ConicConfig) -> Self {
        Self { config, ellipses: Vec::new(), rejections: ArcRejections::default() }
    }

    /// Returns the ellipses of the depth image `pixels` (row by row, `width * height` of them), in the order of the scan lines.
    pub fn extract(&mut self, header: &Header, pixels: &[u16]) -> &[Ellipse] {
        self.ellipses.clear();
        self.rejections = ArcRejections::default();
        let config = &self.config;
        for line in ScanLine::all(header, pixels, config.common.scan, config.common.line_step) {
            for mut rest in runs::runs(&line, header, config) {
                while !rest.is_empty() {
                    let arc = growth::grow(rest, &line.plane, &header.noise, config);
                    match filter::accept(&arc, &line, &header.noise, config) {
                        Ok(ellipse) => self.ellipses.push(ellipse),
                        Err(reason) => self.rejections.count(reason),
                    }
                    rest = &rest[arc.points.len()..];
                }
            }
        }
        &self.ellipses
    }

    /// Returns the reasons for rejected arcs of the last image, and their counts.
    pub fn rejections(&self) -> impl Iterator<Item = (&'static str, u64)> {
        self.rejections.iter()
    }
}
