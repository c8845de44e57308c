//! A run of a scan line: measurements without a jump or a large hole between them, and their running sums, from which any
//! interval's line and circle come by one subtraction.

use super::line::{Points, RayLine};
use super::view::View;
use conicflow_geometry::{ArcMoments, CircleSums, LineSums, RaySums, ScanPlane};
use std::ops::Range;

/// Number of points whose mean depth tells the variance of each.
pub(super) const SURROUNDINGS: usize = 16;
/// Fewest points whose error means anything.
pub(super) const FIRST_FIT: usize = 5;

/// Running sums of one run, beginning with nothing; the buffers are used again for the next.
#[derive(Debug, Default)]
pub(super) struct Sums {
    line: Vec<LineSums>,
    /// Most of a room is flat: these are summed only where a line has not done.
    circle: Vec<CircleSums>,
    /// The states of `circle` that are known.
    known: Range<usize>,
    /// Variances, each of as many points as are the surroundings of one.
    variances: Vec<f64>,
}

/// A run, ready for fits. Points count from its start.
#[derive(Debug)]
pub(super) struct Run<'a> {
    pub view: &'a View,
    pub line: &'a RayLine,
    pub points: Points<'a>,
    pub length: usize,
    sums: &'a mut Sums,
    stretch: f64,
}

impl Sums {
    /// The variance of each measurement is that at the mean depth of its surroundings: were it taken at the measured
    /// depth, it would go with the noise and spoil the moments that it is to correct.
    fn begin(&mut self, view: &View, points: &Points) {
        let length = points.depths.len();
        if self.line.len() <= length {
            self.line.resize(length + 1, LineSums::default());
            self.circle.resize(length + 1, CircleSums::default());
        }
        self.known = 0..0;
        self.variances.clear();
        let per_point = view.scale / SURROUNDINGS as f64;
        for from in (0..length).step_by(SURROUNDINGS) {
            let to = (from + SURROUNDINGS).min(length);
            let total = f64::from(points.depth_sums[to].wrapping_sub(points.depth_sums[from]));
            let per_point = if to - from == SURROUNDINGS { per_point } else { view.scale / (to - from) as f64 };
            self.variances.push(view.variance(total * per_point));
        }
        let mut sums = LineSums::default();
        let blocks = points.pixels.chunks(SURROUNDINGS).zip(points.depths.chunks(SURROUNDINGS));
        for ((pixels, depths), (known, variance)) in
            blocks.zip(self.line[1..].chunks_mut(SURROUNDINGS).zip(&self.variances))
        {
            for ((&pixel, &depth), known) in pixels.iter().zip(depths).zip(known) {
                sums = sums.with(view.slope(pixel), f64::from(depth) * view.scale, *variance);
                *known = sums;
            }
        }
    }
}

impl<'a> Run<'a> {
    /// A run of a line that was read.
    pub fn new(view: &'a View, line: &'a RayLine, index: usize, sums: &'a mut Sums) -> Self {
        let points = line.run(view, index);
        sums.begin(view, &points);
        Self { view, line, points, length: points.depths.len(), sums, stretch: line.plane.stretch() }
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
        let [slope, depth] = self.ray(point);
        [slope * depth, self.stretch * depth]
    }

    /// Slope of the ray of a point, and its depth in metres.
    #[inline]
    fn ray(&self, point: usize) -> [f64; 2] {
        [self.view.slope(self.points.pixels[point]), f64::from(self.points.depths[point]) * self.view.scale]
    }

    /// Moments of an interval, for lines and circles.
    #[inline]
    pub fn moments(&mut self, from: usize, to: usize) -> ArcMoments {
        self.sum_circles(from, to);
        let circle = self.sums.circle[to].since(&self.sums.circle[from]);
        circle.moments(&self.sums.line[to].since(&self.sums.line[from]), (to - from) as f64, self.stretch)
    }

    /// Makes the sums for circles known over an interval.
    #[inline]
    fn sum_circles(&mut self, from: usize, to: usize) {
        if from < self.sums.known.start || from > self.sums.known.end {
            self.sums.known = from..from;
            self.sums.circle[from] = CircleSums::default();
        }
        if to > self.sums.known.end {
            self.sum_more_circles(to);
        }
    }

    fn sum_more_circles(&mut self, to: usize) {
        let (view, square_stretch) = (self.view, self.stretch * self.stretch);
        let mut from = self.sums.known.end;
        let mut sums = self.sums.circle[from];
        while from < to {
            let end = (from - from % SURROUNDINGS + SURROUNDINGS).min(to);
            let variance = self.depth_variance(from);
            let rays = self.points.pixels[from..end].iter().zip(&self.points.depths[from..end]);
            for ((&pixel, &depth), known) in rays.zip(&mut self.sums.circle[from + 1..=end]) {
                sums = sums.with(view.slope(pixel), f64::from(depth) * view.scale, variance, square_stretch);
                *known = sums;
            }
            from = end;
        }
        self.sums.known.end = to;
    }

    /// All sums of an interval.
    pub fn all_sums(&self, from: usize, to: usize) -> RaySums {
        (from..to).fold(RaySums::default(), |sums, point| {
            let [slope, depth] = self.ray(point);
            sums.with(slope, depth, self.depth_variance(point))
        })
    }

    /// Variance of the sensor at a point, along the depth.
    #[inline]
    pub fn depth_variance(&self, point: usize) -> f64 {
        self.sums.variances[point / SURROUNDINGS]
    }

    /// Variance of the sensor in the middle of an interval, in the scan plane.
    #[inline]
    pub fn variance(&self, from: usize, to: usize) -> f64 {
        let middle = ((from + to) / 2).min(self.length - 1);
        self.depth_variance(middle) * self.stretch * self.stretch
    }

    /// Whether a line explains the points of an interval.
    #[inline]
    pub fn is_line(&self, from: usize, to: usize) -> bool {
        let sums = self.sums.line[to].since(&self.sums.line[from]);
        sums.line_square((to - from) as f64, self.stretch) <= self.limit(from, to)
    }

    /// Whether a circle explains them.
    #[inline]
    pub fn is_circle(&mut self, from: usize, to: usize) -> bool {
        let limit = self.limit(from, to);
        self.moments(from, to).is_circle_within(limit)
    }

    fn limit(&self, from: usize, to: usize) -> f64 {
        self.view.limit(self.variance(from, to), to - from)
    }

    /// Distance of the ends, in metres.
    pub fn width(&self) -> f64 {
        let (a, b) = (self.point(0), self.point(self.length - 1));
        ((a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2)).sqrt()
    }
}
