//! The coarse lines, which are searched as a whole, and the windows that they open in the lines between them.
//!
//! Windows open only at curved surfaces. An arc opens a window towards the next coarse line if a circle explains its points
//! better than noise explains for a straight line, or if such an arc lies beside it, in the line above or below. So most flat and
//! narrow surfaces (legs, sides of boxes, strips of wall between objects) are seen in a sixth of the lines only.

use conicflow_geometry::{PlaneMoments, ScanPlane, bulge};
use conicflow_messages::Ellipse;
use std::ops::Range;

/// Step between the lines that are searched as a whole. It is less than `min_lines` of the assembler, so that no object lies
/// between.
const COARSE_STEP: u32 = 6; // [algorithmic]
/// Least bulge of a curved arc, which opens windows, as chi squared: noise gives as much to one straight arc in 13.
const OPENS_GAP_CHI2: f64 = 2.0; // [sigmas]
/// Margin in pixels beyond both ends of an arc that is searched in the lines beside it.
const SEARCH_MARGIN_PX: u32 = 16; // [tuned]
/// Length of an arc, in pixels, for which [`SEARCH_MARGIN_PX`] grows by one pixel.
const SEARCH_MARGIN_DIVISOR: u32 = 4; // [tuned]

/// Returns the distance between coarse lines if every `step`th line is searched at all.
pub(crate) fn coarse_step(step: u32) -> u32 {
    step * (COARSE_STEP / step).max(1)
}

/// The arcs of the coarse lines of an image; the buffers are used again for the next image.
#[derive(Debug, Default)]
pub(crate) struct CoarseLines {
    /// The arcs in the order of line and pixel.
    arcs: Vec<Ellipse>,
    /// Whether each arc is curved.
    curved: Vec<bool>,
    /// The end of each line's arcs in `arcs`.
    ends: Vec<usize>,
    windows: Vec<Range<u32>>,
}

impl CoarseLines {
    pub fn clear(&mut self) {
        self.arcs.clear();
        self.curved.clear();
        self.ends.clear();
    }

    /// Adds the next line, which lies in `plane`; `find` adds its arcs.
    pub fn add(&mut self, plane: &ScanPlane, find: impl FnOnce(&mut Vec<Ellipse>)) {
        find(&mut self.arcs);
        let square_stretch = plane.stretch().powi(2);
        let is_curved = |arc: &Ellipse| {
            // Points that share their noise hold no more information than fewer independent ones.
            let variance = arc.sigma * arc.sigma * square_stretch * arc.points_per_sample();
            bulge(&PlaneMoments::from_sums(arc.origin, arc.moments), variance) >= OPENS_GAP_CHI2
        };
        self.curved.extend(self.arcs[self.curved.len()..].iter().map(is_curved));
        self.ends.push(self.arcs.len());
    }

    /// Returns the arcs of a coarse line, counted from 0; none beyond the last.
    pub fn arcs(&self, line: usize) -> &[Ellipse] {
        &self.arcs[self.indices(line)]
    }

    /// Returns the windows to be searched in the lines between a coarse line and the one before it, in order and disjoint;
    /// `length` is the number of pixels of a line.
    pub fn windows_before(&mut self, line: usize, length: u32) -> &[Range<u32>] {
        let mut windows = std::mem::take(&mut self.windows);
        windows.clear();
        for line in line.checked_sub(1).into_iter().chain([line]) {
            let worth = self.indices(line).filter(|&index| self.is_beside_curved(index, line));
            windows.extend(worth.map(|index| window_about(&self.arcs[index], length)));
        }
        unite(&mut windows);
        self.windows = windows;
        &self.windows
    }

    fn indices(&self, line: usize) -> Range<usize> {
        let end = |line: usize| self.ends.get(line).copied();
        line.checked_sub(1).map_or(Some(0), end).zip(end(line)).map_or(0..0, |(start, end)| start..end)
    }

    /// Returns whether an arc is curved, or overlaps a curved one in the line above or below.
    fn is_beside_curved(&self, index: usize, line: usize) -> bool {
        let overlaps = |other: &Ellipse| other.first <= self.arcs[index].last && other.last >= self.arcs[index].first;
        let shows_curved = |line| self.indices(line).any(|other| self.curved[other] && overlaps(&self.arcs[other]));
        self.curved[index] || line > 0 && shows_curved(line - 1) || shows_curved(line + 1)
    }
}

/// Returns the window about an arc that is searched in the lines beside it.
fn window_about(arc: &Ellipse, length: u32) -> Range<u32> {
    let margin = SEARCH_MARGIN_PX + (arc.last - arc.first) / SEARCH_MARGIN_DIVISOR;
    arc.first.saturating_sub(margin)..(arc.last + 1 + margin).min(length)
}

/// Sorts windows and merges those that overlap.
fn unite(windows: &mut Vec<Range<u32>>) {
    windows.sort_unstable_by_key(|window| window.start);
    windows.dedup_by(|next, kept| {
        let overlaps = next.start <= kept.end;
        if overlaps {
            kept.end = kept.end.max(next.end);
        }
        overlaps
    });
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_geometry::{Pinhole, Scan};

    /// Coarse lines with arcs at these pixels, curved or not.
    fn lines(lines: &[&[(Range<u32>, bool)]]) -> CoarseLines {
        let mut coarse = CoarseLines::default();
        for arcs in lines {
            for (pixels, curved) in *arcs {
                coarse.arcs.push(Ellipse { first: pixels.start, last: pixels.end - 1, ..Ellipse::default() });
                coarse.curved.push(*curved);
            }
            coarse.ends.push(coarse.arcs.len());
        }
        coarse
    }

    /// First pixels and ends of the windows before a line of 100 pixels.
    fn windows(coarse: &mut CoarseLines, line: usize) -> Vec<[u32; 2]> {
        coarse.windows_before(line, 100).iter().map(|window| [window.start, window.end]).collect()
    }

    #[test]
    fn an_arc_is_curved_by_the_points_that_share_no_noise() {
        let plane = Pinhole { fx: 500.0, fy: 500.0, cx: 300.0, cy: 200.0 }.plane(Scan::Row, 200.0);
        // An arc of a circle.
        let points = (-20..=20).map(|x| f64::from(x) * 1e-3).map(|s| [s, 2.2 - (0.04 - s * s).sqrt()]);
        let moments = PlaneMoments::of([0.0, 2.0], points);
        let arc = Ellipse {
            origin: moments.origin(),
            moments: *moments.sums(),
            sigma: 4e-4,
            points: 41,
            ..Ellipse::default()
        };
        let is_curved = |correlation_px: f64| {
            let (mut coarse, mut arc) = (CoarseLines::default(), arc);
            arc.correlation_px = correlation_px;
            coarse.add(&plane, |arcs| arcs.push(arc));
            coarse.curved[0]
        };
        let bulge = bulge(&moments, arc.sigma * arc.sigma);
        assert!((25.0..25.5).contains(&bulge), "{bulge}");
        // Of its 41 points 41, 14.3 and 3 count as independent, which leaves 25, 8.8 and 1.8 of the bulge.
        assert_eq!([1.0, 3.0, 20.0].map(is_curved), [true, true, false]);
    }

    #[test]
    fn what_is_curved_opens_the_gaps_on_both_sides() {
        let mut coarse = lines(&[&[], &[(40..60, true), (70..90, false)], &[]]);
        let gaps = [0, 1, 2, 3].map(|line| windows(&mut coarse, line));
        assert_eq!(gaps, [vec![], vec![[20, 80]], vec![[20, 80]], vec![]]);
        assert_eq!((coarse.arcs(1).len(), coarse.arcs(3).len()), (2, 0));
    }

    #[test]
    fn what_is_flat_opens_them_beside_what_is_curved() {
        let mut coarse = lines(&[&[(40..60, false)], &[(40..60, false)], &[(58..70, true)]]);
        assert_eq!(windows(&mut coarse, 1), [[20, 80]], "the second is beside the third");
        assert_eq!(windows(&mut coarse, 2), [[20, 88]], "windows that overlap are one");
        let mut apart = lines(&[&[(40..60, false)], &[(40..60, false)], &[(60..80, true)]]);
        assert_eq!(windows(&mut apart, 1), [[0; 2]; 0]);
    }

    #[test]
    fn windows_are_in_order_and_apart() {
        let mut windows = vec![3..9, 20..30, 0..4, 9..12, 25..26, 40..41];
        unite(&mut windows);
        assert_eq!(windows, [0..12, 20..30, 40..41]);
        windows.clear();
        unite(&mut windows);
        assert_eq!(windows, []);
    }
}
