//! A run of a scan line: measurements without a jump or a large hole between them, and their running sums, from which any
//! interval's line and circle come by one subtraction.

use super::line::{Points, RayLine};
use super::view::View;
use conicflow_geometry::{ArcMoments, ArcSums, RaySums, ScanPlane};

/// Number of points whose mean depth tells the variance of each.
pub(super) const SURROUNDINGS: usize = 16;
/// Fewest points whose error means anything.
pub(super) const FIRST_FIT: usize = 5;

/// Rays and running sums of one run; the buffers are used again for the next.
#[derive(Debug, Default)]
pub(super) struct Sums {
    /// Slope of the ray of each point, ...
    slopes: Vec<f64>,
    /// ... its depth in metres, ...
    depths: Vec<f64>,
    /// ... and the variances of the depths, each of as many points as are the surroundings of one.
    variances: Vec<f64>,
    /// Running sums, beginning with nothing.
    arc: Vec<ArcSums>,
}

/// A run, ready for fits. Points count from its start.
#[derive(Debug)]
pub(super) struct Run<'a> {
    pub view: &'a View,
    pub line: &'a RayLine,
    pub points: Points<'a>,
    pub length: usize,
    sums: &'a Sums,
    stretch: f64,
}

impl Sums {
    fn begin(&mut self, view: &View, points: &Points, square_stretch: f64) {
        view.slopes_of(points.pixels, &mut self.slopes);
        self.depths.clear();
        self.depths.extend(points.depths.iter().map(|&depth| f64::from(depth) * view.scale));
        self.weigh(view, points.depth_sums);
        if self.arc.len() <= self.depths.len() {
            self.arc.resize(self.depths.len() + 1, ArcSums::default());
        }
        let rays = self.slopes.chunks(SURROUNDINGS).zip(self.depths.chunks(SURROUNDINGS));
        let mut sums = ArcSums::default();
        for ((rays, variance), known) in rays.zip(&self.variances).zip(self.arc[1..].chunks_mut(SURROUNDINGS)) {
            sums = add_block(&sums, rays, *variance, square_stretch, known);
        }
    }

    /// The variance of each measurement is that at the mean depth of its surroundings: were it taken at the measured
    /// depth, it would go with the noise and spoil the moments that it is to correct.
    fn weigh(&mut self, view: &View, depth_sums: &[u32]) {
        self.variances.clear();
        let length = depth_sums.len() - 1;
        let per_point = view.scale / SURROUNDINGS as f64;
        for from in (0..length).step_by(SURROUNDINGS) {
            let to = (from + SURROUNDINGS).min(length);
            let total = f64::from(depth_sums[to].wrapping_sub(depth_sums[from]));
            let per_point = if to - from == SURROUNDINGS { per_point } else { view.scale / (to - from) as f64 };
            self.variances.push(view.variance(total * per_point));
        }
    }
}

/// Adds points of one variance to the running sums, and keeps every state.
#[inline]
fn add_block(
    sums: &ArcSums,
    (slopes, depths): (&[f64], &[f64]),
    variance: f64,
    square_stretch: f64,
    known: &mut [ArcSums],
) -> ArcSums {
    let mut sums = *sums;
    let ((x_pairs, x_rest), (z_pairs, z_rest)) = (slopes.as_chunks(), depths.as_chunks());
    let (pairs, rest) = known[..depths.len()].as_chunks_mut();
    for ((&x, &z), known) in x_pairs.iter().zip(z_pairs).zip(pairs) {
        *known = sums.with_two(x, z, variance, square_stretch);
        sums = known[1];
    }
    if let (&[x], &[z], [known]) = (x_rest, z_rest, rest) {
        [*known, _] = sums.with_two([x; 2], [z; 2], variance, square_stretch);
    }
    sums
}

impl<'a> Run<'a> {
    /// A run of a line that was read.
    pub fn new(view: &'a View, line: &'a RayLine, index: usize, sums: &'a mut Sums) -> Self {
        let points = line.run(view, index);
        let stretch = line.plane.stretch();
        sums.begin(view, &points, stretch * stretch);
        Self { view, line, points, length: points.depths.len(), sums, stretch }
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
        let (slope, depth) = (self.sums.slopes[point], self.sums.depths[point]);
        [slope * depth, self.stretch * depth]
    }

    /// Moments of an interval, for lines and circles.
    #[inline]
    pub fn moments(&self, from: usize, to: usize) -> ArcMoments {
        self.sums_between(from, to).moments((to - from) as f64, self.stretch)
    }

    #[inline]
    fn sums_between(&self, from: usize, to: usize) -> ArcSums {
        self.sums.arc[to].since(&self.sums.arc[from])
    }

    /// All sums of an interval.
    pub fn all_sums(&self, from: usize, to: usize) -> RaySums {
        let (mut sums, mut from) = (RaySums::default(), from);
        while from < to {
            let end = (from - from % SURROUNDINGS + SURROUNDINGS).min(to);
            let variance = self.depth_variance(from);
            sums.add(&self.sums.slopes[from..end], &self.sums.depths[from..end], variance);
            from = end;
        }
        sums
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
        self.sums_between(from, to).line_square((to - from) as f64, self.stretch) <= self.limit(from, to)
    }

    /// Whether a circle explains them.
    #[inline]
    pub fn is_circle(&self, from: usize, to: usize) -> bool {
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
