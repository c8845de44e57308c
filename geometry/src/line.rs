//! Lines: of least squared distance in a scan plane or in space, and through one point on each plane of a pencil.

use crate::arc_fit::smaller_eigenvalue;
use crate::{PlaneMoments, Regression, Scan, ScanPlane, Vector3};
use nalgebra::{Matrix3, SymmetricEigen};

/// Returns the root mean square distance of points in a plane from their line of least squares, in metres; `None` for fewer than
/// two points, or where all are the same.
pub fn line_rms(moments: &PlaneMoments) -> Option<f64> {
    let [ss, st, tt] = moments.about(moments.mean()?).covariance()?;
    let is_line = moments.count() >= 2.0 && ss + tt > 0.0;
    is_line.then(|| smaller_eigenvalue(ss, st, tt).max(0.0).sqrt())
}

/// Running sums over points in space: one more point is O(1).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LineMoments {
    origin: Vector3,
    count: f64,
    sum: Vector3,
    outer: Matrix3<f64>,
}

/// A line in space.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Line {
    /// The mean of the points, which lies on the line.
    pub point: Vector3,
    /// Unit vector along the line; its sign means nothing.
    pub direction: Vector3,
    /// Root mean square distance of the points from the line.
    pub rms: f64,
    /// Standard deviation of the points along the line.
    pub spread: f64,
    /// Number of points.
    pub count: f64,
}

impl Line {
    /// Distance of a point from the line.
    pub fn distance(&self, point: &Vector3) -> f64 {
        (point - self.point).cross(&self.direction).norm()
    }

    /// Position of a point along the line, from the mean of the points.
    pub fn position(&self, point: &Vector3) -> f64 {
        (point - self.point).dot(&self.direction)
    }

    /// Root mean square of the angle between `direction` and the true direction, in radians.
    pub fn direction_sigma(&self) -> f64 {
        self.rms / (self.spread * self.count.sqrt())
    }

    /// Standard deviation of a further point's distance from the line at a position along it.
    pub fn prediction_sigma(&self, position: f64) -> f64 {
        self.rms * (1.0 + (1.0 + (position / self.spread).powi(2)) / self.count).sqrt()
    }
}

impl LineMoments {
    /// Starts without points; `origin` should be near them.
    pub fn new(origin: Vector3) -> Self {
        Self { origin, count: 0.0, sum: Vector3::zeros(), outer: Matrix3::zeros() }
    }

    /// Adds a point.
    pub fn add(&mut self, point: &Vector3) {
        let offset = point - self.origin;
        self.count += 1.0;
        self.sum += offset;
        self.outer += offset * offset.transpose();
    }

    /// Number of points.
    pub fn count(&self) -> f64 {
        self.count
    }

    /// Returns the line of least squared distance; `None` for fewer than two points, or where all are the same.
    pub fn fit(&self) -> Option<Line> {
        if self.count < 2.0 {
            return None;
        }
        let mean = self.sum / self.count;
        let scatter = self.outer / self.count - mean * mean.transpose();
        if !scatter.iter().all(|x| x.is_finite()) {
            return None;
        }
        let eigen = SymmetricEigen::new(scatter);
        let longest = eigen.eigenvalues.imax();
        let along = eigen.eigenvalues[longest];
        // A variance as small as rounding leaves for equal points. [algorithmic]
        if along <= 1e-14 * mean.norm_squared().max(f64::MIN_POSITIVE) {
            return None;
        }
        let across = (scatter.trace() - along).max(0.0);
        let direction = eigen.eigenvectors.column(longest).into_owned();
        Some(Line { point: self.origin + mean, direction, rms: across.sqrt(), spread: along.sqrt(), count: self.count })
    }
}

/// Running sums for a line through points that lie on known scan planes: one more point is O(1).
///
/// Along the image of a line, inverse depth and `s / z` are exactly linear in the slope of the scan plane. So two regressions
/// give the line. Unlike the line of least squared distance, it is not turned towards the view by noise along the view where the
/// extent of the points is smaller than their scatter.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PencilMoments {
    scan: Scan,
    inverse_depth: Regression,
    side: Regression,
}

impl PencilMoments {
    /// Starts without points.
    pub fn new(scan: Scan) -> Self {
        Self { scan, inverse_depth: Regression::default(), side: Regression::default() }
    }

    /// Adds the point `(s, t)` of a plane of the pencil.
    pub fn add(&mut self, plane: &ScanPlane, [s, t]: [f64; 2]) {
        let depth = t / plane.stretch();
        self.inverse_depth.add(plane.slope(), 1.0 / depth);
        self.side.add(plane.slope(), s / depth);
    }

    /// Returns the line, directed towards growing slopes; `None` for fewer than three points, where all are on one plane, or
    /// where the line is not in front of the camera.
    pub fn fit(&self) -> Option<Line> {
        let (inverse, side) = (self.inverse_depth.fit()?, self.side.fit()?);
        let point = |slope: f64| {
            let depth = 1.0 / inverse.at(slope);
            let plane = ScanPlane::new(self.scan, slope);
            (depth > 0.0).then(|| plane.to_camera([side.at(slope) * depth, plane.stretch() * depth]))
        };
        // The ends are a standard deviation of the slopes away on either side.
        let half = self.inverse_depth.spread();
        let (from, to, middle) = (point(inverse.middle - half)?, point(inverse.middle + half)?, point(inverse.middle)?);
        let spread = 0.5 * (to - from).norm();
        let depth = 1.0 / inverse.value;
        let rms = (depth * depth * inverse.rms).hypot(depth * side.rms);
        let direction = (to - from).try_normalize(0.0)?;
        direction.iter().all(|x| x.is_finite()).then_some(Line {
            point: middle,
            direction,
            rms,
            spread,
            count: self.side.count(),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_line_in_a_plane_is_found_at_any_angle() {
        for angle in [0.0_f64, 0.7, -1.2, std::f64::consts::FRAC_PI_2] {
            let (sin, cos) = angle.sin_cos();
            let points = (0..30).map(|i| (f64::from(i) * 0.01, if i % 2 == 0 { 0.002 } else { -0.002 }));
            let moments =
                PlaneMoments::of([50.0, 2.0], points.map(|(a, b)| [50.0 + cos * a - sin * b, 2.0 + sin * a + cos * b]));
            let rms = line_rms(&moments).unwrap();
            assert!((rms - 0.002).abs() < 1e-4, "{rms}");
        }
    }

    #[test]
    fn one_point_is_no_line() {
        assert_eq!(line_rms(&PlaneMoments::of([0.0, 0.0], [[1.0, 2.0]])), None);
        assert_eq!(line_rms(&PlaneMoments::of([1.0, 2.0], [[1.0, 2.0]; 4])), None);
        let mut sums = LineMoments::new(Vector3::zeros());
        assert_eq!(sums.fit(), None);
        for _ in 0..5 {
            sums.add(&Vector3::new(1.0, 2.0, 3.0));
        }
        assert_eq!(sums.fit(), None);
    }

    #[test]
    fn a_line_in_space_is_found_with_its_scatter() {
        let direction = Vector3::new(1.0, -2.0, 0.5).normalize();
        let across = direction.cross(&Vector3::z()).normalize();
        let mut sums = LineMoments::new(Vector3::new(10.0, 0.0, 2.0));
        for i in 0..40 {
            let side = if i % 2 == 0 { 0.003 } else { -0.003 };
            sums.add(&(Vector3::new(10.0, 0.3, 2.0) + direction * (f64::from(i) * 0.01) + across * side));
        }
        let line = sums.fit().unwrap();
        assert!(line.direction.cross(&direction).norm() < 5e-3);
        assert!((line.rms - 0.003).abs() < 1e-4);
        assert!(line.distance(&Vector3::new(10.0, 0.3, 2.0)) < 5e-3);
        assert!((line.spread - 0.115).abs() < 1e-3);
    }

    #[test]
    fn a_line_is_known_best_in_the_middle_of_its_points_and_the_less_the_farther_out() {
        let line = Line { point: Vector3::zeros(), direction: Vector3::x(), rms: 0.003, spread: 0.2, count: 16.0 };
        for (spreads, variance) in [(0.0, 17.0 / 16.0), (1.0, 18.0 / 16.0), (-3.0, 26.0 / 16.0)] {
            let expected = 0.003 * f64::sqrt(variance);
            assert!((line.prediction_sigma(0.2 * spreads) - expected).abs() < 1e-12, "{spreads}");
        }
        assert!((line.direction_sigma() - 0.003 / (0.2 * 4.0)).abs() < 1e-12);
    }

    #[test]
    fn a_line_across_a_pencil_is_exact_and_not_drawn_towards_the_view() {
        let (foot, direction) = (Vector3::new(0.1, 0.2, 1.5), Vector3::new(0.2, 0.8, -0.5).normalize());
        for noise in [0.0, 0.004] {
            let mut sums = PencilMoments::new(Scan::Row);
            for i in 0..40 {
                let plane = ScanPlane::new(Scan::Row, 0.12 + 0.0005 * f64::from(i));
                let normal = plane.normal();
                let [s, t] = plane.to_plane(&(foot - direction * (foot.dot(&normal) / direction.dot(&normal))));
                sums.add(&plane, [s, t + if i % 2 == 0 { noise } else { -noise }]);
            }
            let line = sums.fit().unwrap();
            assert!(line.direction.cross(&direction).norm() < 1e-9 + 10.0 * noise, "{line:?}");
            assert!(line.distance(&foot) < 1e-9 + noise);
            assert!((line.rms - noise).abs() < 1e-9 + 0.2 * noise);
        }
    }

    #[test]
    fn points_of_one_plane_or_behind_the_camera_give_no_pencil_line() {
        let mut sums = PencilMoments::new(Scan::Row);
        (0..9).for_each(|_| sums.add(&ScanPlane::new(Scan::Row, 0.1), [0.0, 1.0]));
        assert_eq!(sums.fit(), None);
        let mut behind = PencilMoments::new(Scan::Column);
        (0..9).for_each(|i| behind.add(&ScanPlane::new(Scan::Column, 0.1 * f64::from(i)), [0.0, -1.0]));
        assert_eq!(behind.fit(), None);
    }

    #[test]
    fn a_point_is_so_far_along_a_line_and_so_far_beside_it() {
        let (point, direction) = (Vector3::new(1.0, -2.0, 3.0), Vector3::new(2.0, -1.0, 2.0) / 3.0);
        let line = Line { point, direction, rms: 0.1, spread: 1.0, count: 9.0 };
        let beside = Vector3::new(1.0, 2.0, 0.0).normalize();
        for along in [0.7, -0.4] {
            let other = point + direction * along + beside * 0.3;
            assert!((line.position(&other) - along).abs() < 1e-12);
            assert!((line.distance(&other) - 0.3).abs() < 1e-12);
        }
    }

    #[test]
    fn two_points_are_on_a_line_and_count_as_two() {
        let [a, b] = [Vector3::new(1.0, 2.0, 3.0), Vector3::new(1.0, 2.4, 3.3)];
        let mut sums = LineMoments::new(Vector3::new(1.0, 2.0, 2.0));
        [a, b].iter().for_each(|point| sums.add(point));
        assert_eq!(sums.count(), 2.0);
        let line = sums.fit().unwrap();
        assert!((line.point - (a + b) / 2.0).norm() < 1e-12 && (line.spread - 0.25).abs() < 1e-12, "{line:?}");
        assert!(line.direction.cross(&(b - a)).norm() < 1e-7 && line.rms < 1e-7);
    }

    #[test]
    fn what_rounding_leaves_of_equal_points_is_no_line_and_what_is_as_small_near_the_origin_is_one() {
        for i in 0..20 {
            let mut same = LineMoments::new(Vector3::zeros());
            (0..7).for_each(|_| same.add(&Vector3::new(1000.1 + f64::from(i) / 3.0, 2000.2, 3000.3)));
            assert_eq!(same.fit(), None, "{i}");
        }
        let mut small = LineMoments::new(Vector3::zeros());
        (0..9).for_each(|i| small.add(&(Vector3::new(1.0, 2.0, 2.0) * (1e-6 * f64::from(i)))));
        assert!(small.fit().unwrap().rms < 1e-12);
    }

    #[test]
    fn the_spread_of_a_line_across_a_pencil_is_that_of_its_points() {
        let (foot, direction) = (Vector3::new(0.1, 0.2, 1.5), Vector3::new(0.2, 0.8, -0.5).normalize());
        let mut sums = PencilMoments::new(Scan::Column);
        let mut along = Regression::default();
        for i in 0..40 {
            let plane = ScanPlane::new(Scan::Column, 0.12 + 0.0005 * f64::from(i));
            let normal = plane.normal();
            let position = -foot.dot(&normal) / direction.dot(&normal);
            sums.add(&plane, plane.to_plane(&(foot + direction * position)));
            along.add(position, 0.0);
        }
        let line = sums.fit().unwrap();
        assert!((line.spread / along.spread() - 1.0).abs() < 0.01, "{line:?} {}", along.spread());
        assert!((line.direction - direction).norm() < 1e-9, "towards growing slopes");
    }
}
