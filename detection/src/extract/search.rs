//! The search for arcs along one scan line: runs, their segments, and the round ones among these.

use super::arc::{accept, accept_line};
use super::line::RayLine;
use super::rays::{RayBuffers, Rays};
use super::rejection::{ArcRejection, ArcRejections};
use super::run::{FIRST_FIT, Run};
use super::segments::{Segment, cut, cut_part};
use super::view::View;
use conicflow_geometry::ArcSums;
use conicflow_messages::Ellipse;
use std::ops::Range;

/// The search for arcs in one line.
#[derive(Debug, Default)]
pub(crate) struct LineSearch {
    pub(super) line: RayLine,
    pub(super) curves: CurveSearch,
}

/// The search for curves in a line that was read.
#[derive(Debug, Default)]
pub(super) struct CurveSearch {
    pub(super) rays: RayBuffers,
    pub(super) sums: Vec<ArcSums>,
    /// Points at which a run is cut, with its ends.
    cuts: Vec<usize>,
    /// The segments between two cuts.
    segments: Vec<Segment>,
    depth_sums: Vec<u32>,
}

impl LineSearch {
    /// Cuts the pixels `window` of a scan line into arcs and adds them to `ellipses`. The line is split into runs at jumps and
    /// holes; a run is cut at its creases and where no single curve explains it; a round segment is an arc.
    pub fn arcs_of(
        &mut self,
        view: &View,
        image: &[u16],
        (number, window): (u32, Range<u32>),
        ellipses: &mut Vec<Ellipse>,
        rejections: &mut ArcRejections,
    ) {
        let Self { line, curves } = self;
        line.read(view, image, number, window);
        for index in 0..line.runs() {
            curves.arcs_of_run(view, image, (line, index), ellipses, rejections);
        }
    }
}

impl CurveSearch {
    fn arcs_of_run(
        &mut self,
        view: &View,
        image: &[u16],
        (line, index): (&RayLine, usize),
        ellipses: &mut Vec<Ellipse>,
        rejections: &mut ArcRejections,
    ) {
        if line.run_length(index) < FIRST_FIT {
            rejections.count(ArcRejection::FewPoints);
            return;
        }
        let mut keep = |arc: Result<Ellipse, ArcRejection>| match arc {
            Ok(arc) => ellipses.push(arc),
            Err(reason) => rejections.count(reason),
        };
        let rays = Rays::new(view, line, index, &mut self.rays);
        if let Some(arc) = accept_line(&rays, image) {
            keep(arc);
            return;
        }
        let run = Run::new(rays, &mut self.sums);
        cut(&run, &mut self.cuts, &mut self.depth_sums);
        for ends in self.cuts.windows(2) {
            cut_part(&run, &(ends[0]..ends[1]), &mut self.segments);
            for segment in &self.segments {
                keep(if segment.is_curve { accept(&run, image, segment) } else { Err(ArcRejection::Line) });
            }
        }
    }
}
