//! Arcs for the pooled fits of the assembler: a scan line is cut where neither a line nor a circle explains its points.
//!
//! On an arc of less than half a turn a circle is a far better judge than a free ellipse; the true shape is left to the
//! pooled fit. Unbiased moments put the expected error of the right curve at zero, so the limit is what the noise of n
//! points scatters: `error^2 <= sigma^2 (a sqrt(2 / n) + b) + (0.1 mm)^2`.
//!
//! Most of a room is flat, so the image is looked at from coarse to fine: every sixth line as a whole ([`line`],
//! [`rays`], [`run`], [`segments`], [`acceptance`]), those between only about what is curved in the coarse lines above and
//! below ([`coarse`]).

mod acceptance;
mod coarse;
mod line;
mod rays;
mod run;
mod seen_noise;
mod segments;
mod shared_noise;
#[cfg(test)]
mod tests;
mod view;

use super::RowEllipseConfig;
use super::filter::{Rejection, Rejections};
use acceptance::{accept, accept_line};
use coarse::CoarseLines;
use conicflow_geometry::{ArcSums, Scan};
use conicflow_messages::{Ellipse, Header};
use line::RayLine;
use rays::{RayBuffers, Rays};
use run::{FIRST_FIT, Run};
use seen_noise::Hints;
pub(super) use seen_noise::SeenNoise;
use segments::{cut, next_segment};
use std::ops::Range;
use view::View;

/// One line in so many is searched as a whole. It is less than `min_lines` of the assembler, so that no object lies between.
const COARSE_STEP: u32 = 6; // [algorithmic]

/// Finds the arcs of depth images; its buffers are used again for the next.
#[derive(Debug)]
pub(super) struct Arcs {
    view: View,
    line: RayLine,
    search: LineSearch,
    hints: Hints,
    coarse: CoarseLines,
}

/// The search for arcs in one line.
#[derive(Debug, Default)]
struct LineSearch {
    rays: RayBuffers,
    sums: Vec<ArcSums>,
    /// Where a run is cut, its ends included.
    cuts: Vec<usize>,
    depth_sums: Vec<u32>,
}

impl Arcs {
    pub fn with(config: RowEllipseConfig) -> Self {
        Self {
            view: View::with(config),
            line: RayLine::default(),
            search: LineSearch::default(),
            hints: Hints::default(),
            coarse: CoarseLines::default(),
        }
    }

    /// How noisy an image is.
    pub fn seen_noise(&mut self, header: &Header, image: &[u16]) -> SeenNoise {
        self.view.turn(header, Scan::Row, &SeenNoise::as_told(header.noise));
        let noise = seen_noise::seen_noise(&self.view, image, &mut self.line, &mut self.search, &mut self.hints);
        self.view.turn(header, Scan::Row, &noise);
        SeenNoise { shared_px: shared_noise::shared_px(&self.view, image), ..noise }
    }

    /// Adds the arcs of the rows or columns of an image to `ellipses`, in the order of line and pixel.
    pub fn find(
        &mut self,
        header: &Header,
        image: &[u16],
        (scan, noise): (Scan, &SeenNoise),
        ellipses: &mut Vec<Ellipse>,
        rejections: &mut Rejections,
    ) {
        self.view.turn(header, scan, noise);
        let Self { view, line, search, coarse, .. } = self;
        let step = view.config.line_step.max(1);
        let coarse_step = step * (COARSE_STEP / step).max(1);
        coarse.clear();
        for number in (0..view.lines).step_by(coarse_step as usize) {
            line.read(view, image, number, 0..view.length);
            coarse.add(line, |arcs| search.arcs_of(view, image, line, arcs, rejections));
        }
        for (index, number) in (0..view.lines + coarse_step).step_by(coarse_step as usize).enumerate() {
            let between = (number + step).saturating_sub(coarse_step)..number.min(view.lines);
            let windows = coarse.windows_before(index, view.length);
            for number in between.step_by(step as usize) {
                for window in windows {
                    line.read(view, image, number, window.clone());
                    search.arcs_of(view, image, line, ellipses, rejections);
                }
            }
            ellipses.extend_from_slice(coarse.arcs(index));
        }
    }
}

impl LineSearch {
    /// Adds the arcs of a line, or of a window of it, that was read.
    fn arcs_of(
        &mut self,
        view: &View,
        image: &[u16],
        line: &RayLine,
        ellipses: &mut Vec<Ellipse>,
        rejections: &mut Rejections,
    ) {
        for index in 0..line.runs() {
            if line.run_length(index) < FIRST_FIT {
                rejections.count(Rejection::FewPoints);
                continue;
            }
            let rays = Rays::new(view, line, index, &mut self.rays);
            if let Some(arc) = accept_line(&rays, image) {
                arc.map_or_else(|why| rejections.count(why), |arc| ellipses.push(arc));
                continue;
            }
            let run = Run::new(rays, &mut self.sums);
            cut(&run, &mut self.cuts, &mut self.depth_sums);
            for ends in self.cuts.windows(2) {
                arcs_of_part(&run, image, ends[0]..ends[1], ellipses, rejections);
            }
        }
    }
}

fn arcs_of_part(
    run: &Run,
    image: &[u16],
    part: Range<usize>,
    ellipses: &mut Vec<Ellipse>,
    rejections: &mut Rejections,
) {
    let mut from = part.start;
    while let Some(segment) = next_segment(run, &part, from) {
        match if segment.is_curve { accept(run, image, &segment) } else { Err(Rejection::Line) } {
            Ok(arc) => ellipses.push(arc),
            Err(reason) => rejections.count(reason),
        }
        from = segment.to;
    }
}
