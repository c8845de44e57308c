//! The rays of a run: measurements of a scan line without a jump or a large hole between them. They suffice to recognise most
//! walls and floors.

use super::line::{Points, RayLine};
use super::view::{SURROUNDINGS, View};
use conicflow_geometry::{ArcMoments, ArcSums, LineSums, RaySums, ScanPlane};
use std::ops::Range;

/// Buffers of a run, used again for the next run.
#[derive(Debug, Default)]
pub(super) struct RayBuffers {
    slopes: Vec<f64>,
    variances: Vec<f64>,
}

/// The rays of a run. Points are counted from its start.
#[derive(Clone, Debug)]
pub(super) struct Rays<'a> {
    pub view: &'a View,
    pub line: &'a RayLine,
    pub points: Points<'a>,
    pub length: usize,
    /// All points except those at the ends, where pixels may mix two depths.
    pub inner: Range<usize>,
    pub stretch: f64,
    slopes: &'a [f64],
    /// Variances of the depths, one for each [`SURROUNDINGS`] points.
    variances: &'a [f64],
}

/// Puts the variances of the depths of a run into `variances`, one for each [`SURROUNDINGS`] points.
///
/// The variance of a measurement is that at the mean depth of its surroundings. If it were taken at the measured depth, it would
/// correlate with the noise and spoil the moments that it corrects.
///
/// Where fewer lines could be averaged than elsewhere, the variance is larger accordingly.
fn fill_variances(view: &View, points: &Points, variances: &mut Vec<f64>) {
    variances.clear();
    let (blocks, rest) = points.depths.as_chunks::<SURROUNDINGS>();
    let total = |depths: &[u16]| f64::from(depths.iter().map(|&depth| u32::from(depth)).sum::<u32>());
    let per_point = view.scale / SURROUNDINGS as f64;
    variances.extend(blocks.iter().map(|block| view.variance(total(block) * per_point)));
    if !rest.is_empty() {
        variances.push(view.variance(total(rest) * (view.scale / rest.len() as f64)));
    }
    for (variance, pairs) in variances.iter_mut().zip(points.pairs.chunks(SURROUNDINGS)) {
        *variance *= view.variance_ratio(pairs);
    }
}

impl<'a> Rays<'a> {
    /// Creates the rays of a run of a line.
    pub fn new(view: &'a View, line: &'a RayLine, index: usize, buffers: &'a mut RayBuffers) -> Self {
        let points = line.run(view, index);
        let RayBuffers { slopes, variances } = buffers;
        fill_variances(view, &points, variances);
        let (length, slopes) = (points.depths.len(), view.slopes(points.pixels, slopes));
        let ends = (view.parameters.trim_px as usize).min(length / 4);
        let (inner, stretch) = (ends..length - ends, line.plane.stretch());
        Self { view, line, points, length, inner, stretch, slopes, variances }
    }

    /// Returns the plane of the scan line.
    pub fn plane(&self) -> &ScanPlane {
        &self.line.plane
    }

    /// The pixel of a point.
    pub fn pixel(&self, point: usize) -> u32 {
        self.points.pixels[point]
    }

    /// Returns a point in the plane of the scan line, in metres.
    pub fn point(&self, point: usize) -> [f64; 2] {
        let (slope, depth) = (self.slopes[point], self.points.metres[point]);
        [slope * depth, self.stretch * depth]
    }

    /// Returns the distance between the ends, in metres.
    pub fn width(&self) -> f64 {
        let (a, b) = (self.point(0), self.point(self.length - 1));
        ((a[0] - b[0]).powi(2) + (a[1] - b[1]).powi(2)).sqrt()
    }

    /// Returns the slopes, depths and variance of some points, in parts with one variance each.
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

    /// Returns all sums over an interval.
    pub fn all_sums(&self, points: Range<usize>) -> RaySums {
        RaySums::of(self.parts(points))
    }

    /// Returns the moments of an interval for fits of lines and circles.
    pub fn moments(&self, points: Range<usize>) -> ArcMoments {
        let count = points.len() as f64;
        ArcSums::of(self.parts(points), self.stretch * self.stretch).moments(count, self.stretch)
    }

    /// Returns the sums over an interval that a line fit needs.
    pub fn line_sums(&self, points: Range<usize>) -> LineSums {
        LineSums::of(self.parts(points))
    }

    /// Returns the mean variance of some points, relative to that of points averaged over all lines.
    pub fn variance_ratio(&self, points: Range<usize>) -> f64 {
        self.view.variance_ratio(self.points.pairs.get(points).unwrap_or_default())
    }

    /// Returns the variance of the depth of a point, in square metres.
    #[inline]
    pub fn depth_variance(&self, point: usize) -> f64 {
        self.variances[point / SURROUNDINGS]
    }

    /// Returns that variance as if all lines were averaged at the point.
    pub fn averaged_variance(&self, point: usize) -> f64 {
        let from = point - point % SURROUNDINGS;
        self.depth_variance(point) / self.variance_ratio(from..(from + SURROUNDINGS).min(self.length))
    }

    /// Returns the variance of a point in the middle of an interval, in the scan plane.
    #[inline]
    pub fn variance(&self, from: usize, to: usize) -> f64 {
        let middle = ((from + to) / 2).min(self.length - 1);
        self.depth_variance(middle) * self.stretch * self.stretch
    }

    /// Returns the largest mean square error of the points of an interval that noise explains.
    #[inline]
    pub fn limit(&self, from: usize, to: usize) -> f64 {
        self.view.limit(self.variance(from, to), to - from)
    }
}

#[cfg(test)]
mod tests {
    use super::super::noise_estimate::NoiseEstimate;
    use super::super::parameters::ExtractorParameters;
    use super::*;
    use conicflow_geometry::Scan;
    use conicflow_messages::{Camera, Header, NoiseModel};

    /// The rays of row 2 of an image of 48 x 8 pixels, whose depths grow by 5 mm from pixel to pixel, starting at 1.5 m.
    /// `averaged` lines are averaged, except over the first eight pixels, above which there is something else.
    fn looked_at(averaged: u32, check: impl Fn(&View, &Rays)) {
        let camera = Camera { width: 48, height: 8, fx: 40.0, fy: 40.0, cx: 19.5, cy: -37.0 };
        let mut view = View::with(ExtractorParameters { trim_px: 2, ..ExtractorParameters::default() });
        let noise = NoiseModel { floor_m: 0.05, growth_per_m: 0.02, ..NoiseModel::IDEAL };
        let header = Header { camera, noise, depth_scale: 1e-3, ..Header::default() };
        let noise = NoiseEstimate { averaged: [averaged; 2], ..NoiseEstimate::nominal(noise) };
        view.set_up(&header, Scan::Row, &noise);
        let mut image: Vec<u16> = (0..8).flat_map(|_| (0..48).map(|x| 1500 + 5 * x)).collect();
        image[48..56].fill(5000);
        let (mut line, mut buffers) = (RayLine::default(), RayBuffers::default());
        line.read(&view, &image, 2, 0..48);
        assert_eq!((line.runs(), line.run_length(0)), (1, 48));
        check(&view, &Rays::new(&view, &line, 0, &mut buffers));
    }

    #[test]
    fn the_variance_of_a_point_is_that_at_the_mean_depth_of_its_sixteen() {
        looked_at(1, |view, rays| {
            for (points, mean) in [(0..16, 1.5375), (16..32, 1.6175), (32..48, 1.6975)] {
                for point in points {
                    assert!((rays.depth_variance(point) / view.variance(mean) - 1.0).abs() < 1e-12, "of {point}");
                    assert_eq!(rays.averaged_variance(point), rays.depth_variance(point));
                }
            }
            let in_plane = view.variance(1.6175) * rays.stretch * rays.stretch;
            assert!((rays.variance(10, 28) / in_plane - 1.0).abs() < 1e-12, "in the middle of the interval");
            assert_eq!(rays.variance(48, 48), rays.variance(47, 48), "behind the last point is that");
            assert_eq!(rays.limit(10, 28), view.limit(in_plane, 18));
        });
    }

    #[test]
    fn points_lie_in_the_plane_of_the_line_and_those_at_the_ends_are_outer_ones() {
        looked_at(1, |_, rays| {
            // The plane is 39 pixels below the principal point, with a focal length of 40.
            assert!((rays.stretch - (1.0 + (39.0_f64 / 40.0).powi(2)).sqrt()).abs() < 1e-12);
            let at = |x: f64| [(x - 19.5) / 40.0 * (1.5 + 0.005 * x), rays.stretch * (1.5 + 0.005 * x)];
            let ([x, y], [a, b], [c, d]) = (at(7.0), at(0.0), at(47.0));
            assert!((rays.point(7)[0] - x).abs() < 1e-12 && (rays.point(7)[1] - y).abs() < 1e-12);
            assert!((rays.width() - (c - a).hypot(d - b)).abs() < 1e-12);
            assert_eq!((rays.pixel(7), rays.inner.clone()), (7, 2..46));
        });
    }

    #[test]
    fn the_parts_of_an_interval_are_its_points_by_their_variances() {
        looked_at(1, |_, rays| {
            for (points, lengths) in [(5..40, vec![11, 16, 8]), (16..32, vec![16]), (3..9, vec![6]), (4..4, vec![])] {
                let parts: Vec<_> = rays.parts(points.clone()).collect();
                assert_eq!(parts.iter().map(|(_, depths, _)| depths.len()).collect::<Vec<_>>(), lengths);
                let mut from = points.start;
                for (slopes, depths, variance) in parts {
                    assert_eq!((slopes.len(), variance), (depths.len(), rays.depth_variance(from)));
                    for (slope, depth) in slopes.iter().zip(depths) {
                        assert_eq!([slope * depth, rays.stretch * depth], rays.point(from));
                        from += 1;
                    }
                }
            }
        });
    }

    #[test]
    fn where_fewer_lines_could_be_averaged_the_variance_is_as_much_greater() {
        looked_at(3, |view, rays| {
            for (point, mean, times) in [(3, 1.5375, 2.0), (12, 1.5375, 2.0), (20, 1.6175, 1.0), (47, 1.6975, 1.0)] {
                let averaged = view.variance(mean);
                assert!((rays.depth_variance(point) / averaged - times).abs() < 1e-9, "of {point}");
                assert!((rays.averaged_variance(point) / averaged - 1.0).abs() < 1e-9, "of {point}");
            }
            let parts = [0..8, 8..40, 4..10].map(|points| rays.variance_ratio(points));
            assert!((parts[0] - 3.0).abs() < 1e-9 && parts[1] == 1.0 && (parts[2] - 7.0 / 3.0).abs() < 1e-9);
        });
    }
}
