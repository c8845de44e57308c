//! The rays of a run: measurements of a scan line without a jump or a large hole between them. That is enough to tell
//! most of the walls and floors, of which nothing else has to be known.

use super::line::{Points, RayLine};
use super::view::View;
use conicflow_geometry::{ArcMoments, ArcSums, LineSums, RaySums, ScanPlane};
use std::ops::Range;

/// Number of neighbouring points that share one variance, that at their mean depth.
pub(super) const SURROUNDINGS: usize = 16; // [algorithmic]

/// Buffers of a run, used again for the next.
#[derive(Debug, Default)]
pub(super) struct RayBuffers {
    slopes: Vec<f64>,
    variances: Vec<f64>,
}

/// The rays of a run. Points count from its start.
#[derive(Clone, Debug)]
pub(super) struct Rays<'a> {
    pub view: &'a View,
    pub line: &'a RayLine,
    pub points: Points<'a>,
    pub length: usize,
    /// All but those at the ends, where pixels may mix two depths.
    pub inner: Range<usize>,
    pub stretch: f64,
    slopes: &'a [f64],
    /// Variances of the depths, each of as many points as are the surroundings of one.
    variances: &'a [f64],
}

/// Puts the variances of the depths of a run into `variances`, each of as many points as are the surroundings of one.
///
/// The variance of each measurement is that at the mean depth of its surroundings: were it taken at the measured depth,
/// it would go with the noise and spoil the moments that it is to correct.
///
/// Where fewer lines could be averaged than elsewhere, it is as much greater.
fn weigh(view: &View, points: &Points, variances: &mut Vec<f64>) {
    variances.clear();
    let (blocks, rest) = points.depths.as_chunks::<SURROUNDINGS>();
    let total = |depths: &[u16]| f64::from(depths.iter().map(|&depth| u32::from(depth)).sum::<u32>());
    let per_point = view.scale / SURROUNDINGS as f64;
    variances.extend(blocks.iter().map(|block| view.variance(total(block) * per_point)));
    if !rest.is_empty() {
        variances.push(view.variance(total(rest) * (view.scale / rest.len() as f64)));
    }
    for (variance, pairs) in variances.iter_mut().zip(points.pairs.chunks(SURROUNDINGS)) {
        *variance *= view.unaveraged(pairs);
    }
}

impl<'a> Rays<'a> {
    /// Those of a run of a line that was read.
    pub fn new(view: &'a View, line: &'a RayLine, index: usize, buffers: &'a mut RayBuffers) -> Self {
        let points = line.run(view, index);
        let RayBuffers { slopes, variances } = buffers;
        weigh(view, &points, variances);
        let (length, slopes) = (points.depths.len(), view.slopes(points.pixels, slopes));
        let ends = (view.parameters.trim_px as usize).min(length / 4);
        let (inner, stretch) = (ends..length - ends, line.plane.stretch());
        Self { view, line, points, length, inner, stretch, slopes, variances }
    }

    /// The plane of the scan line.
    pub fn plane(&self) -> &ScanPlane {
        &self.line.plane
    }

    /// The pixel of a point.
    pub fn pixel(&self, point: usize) -> u32 {
        self.points.pixels[point]
    }

    /// A point in the plane of the scan line, in metres.
    pub fn point(&self, point: usize) -> [f64; 2] {
        let (slope, depth) = (self.slopes[point], self.points.metres[point]);
        [slope * depth, self.stretch * depth]
    }

    /// Distance of the ends, in metres.
    pub fn width(&self) -> f64 {
        let (a, b) = (self.point(0), self.point(self.length - 1));
        ((a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2)).sqrt()
    }

    /// Slopes, depths and variance of some points, in parts of one variance each.
    #[inline]
    pub fn parts(&self, points: Range<usize>) -> impl Iterator<Item = (&'a [f64], &'a [f64], f64)> {
        let (rays, mut from) = (self, points.start);
        std::iter::from_fn(move || {
            let part = from..(from - from % SURROUNDINGS + SURROUNDINGS).min(points.end);
            from = part.end;
            let variance = *rays.variances.get(part.start / SURROUNDINGS).filter(|_| !part.is_empty())?;
            Some((&rays.slopes[part.clone()], &rays.points.metres[part], variance))
        })
    }

    /// All sums of an interval.
    pub fn all_sums(&self, points: Range<usize>) -> RaySums {
        RaySums::of(self.parts(points))
    }

    /// Moments of an interval, for lines and circles.
    pub fn moments(&self, points: Range<usize>) -> ArcMoments {
        let count = points.len() as f64;
        ArcSums::of(self.parts(points), self.stretch * self.stretch).moments(count, self.stretch)
    }

    /// What a line asks of an interval.
    pub fn line_sums(&self, points: Range<usize>) -> LineSums {
        LineSums::of(self.parts(points))
    }

    /// Mean variance of some points, in that of those over which all lines were averaged.
    pub fn unaveraged(&self, points: Range<usize>) -> f64 {
        self.view.unaveraged(self.points.pairs.get(points).unwrap_or_default())
    }

    /// Variance of the sensor at a point, along the depth.
    #[inline]
    pub fn depth_variance(&self, point: usize) -> f64 {
        self.variances[point / SURROUNDINGS]
    }

    /// The same, were all lines averaged over it.
    pub fn averaged_variance(&self, point: usize) -> f64 {
        let from = point - point % SURROUNDINGS;
        self.depth_variance(point) / self.unaveraged(from..(from + SURROUNDINGS).min(self.length))
    }

    /// Variance of the sensor in the middle of an interval, in the scan plane.
    #[inline]
    pub fn variance(&self, from: usize, to: usize) -> f64 {
        let middle = ((from + to) / 2).min(self.length - 1);
        self.depth_variance(middle) * self.stretch * self.stretch
    }

    /// Largest mean square error of the points of an interval that noise accounts for.
    #[inline]
    pub fn limit(&self, from: usize, to: usize) -> f64 {
        self.view.limit(self.variance(from, to), to - from)
    }
}
