//! Fits of a line and a circle to the points of an arc, with the mean square distances of the points from both.
//!
//! The circle is Taubin's (Chernov, "Circular and Linear Regression" (2010), section 5.10), whose eigenvalue is the mean square
//! distance. With unbiased moments both mean squares are free of the noise: for the right curve they are about zero, and negative
//! as often as positive.

use crate::{Circle, PlaneMoments};

/// The moments of an arc about its mean that determine line and circle, per point; with `z = x^2 + y^2`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArcMoments {
    count: f64,
    mean: [f64; 2],
    xx: f64,
    xy: f64,
    yy: f64,
    xz: f64,
    yz: f64,
    zz: f64,
}

/// Line and circle through one arc.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArcFit {
    /// Mean square distance from the line of least squares, in square metres.
    pub line_square: f64,
    /// Mean square distance from the circle.
    pub circle_square: f64,
    /// The circle; its radius is not finite where the points are on a line.
    pub circle: Circle,
}

/// Returns the gain of a circle, whose centre lies behind the points of an arc, over a line: the difference of the mean square
/// distances, in points times variances. It is 0 where the arc is concave, or where the circle is no better.
///
/// On a straight line noise of that variance bends one arc of two backwards; for the others the bulge is chi squared with one
/// degree of freedom.
pub fn bulge(moments: &PlaneMoments, variance: f64) -> f64 {
    let Some(arc) = ArcMoments::of(moments) else { return 0.0 };
    let ArcFit { line_square, circle_square, circle } = arc.fit();
    let is_hollow = circle.center[1] <= arc.mean[1];
    if is_hollow { 0.0 } else { (line_square - circle_square).max(0.0) * arc.count / variance }
}

impl ArcMoments {
    /// Returns the moments of points whose plane moments are known; `None` without points.
    pub fn of(moments: &PlaneMoments) -> Option<Self> {
        let mean = moments.mean()?;
        let centred = moments.about(mean);
        let per_point = 1.0 / moments.count();
        let m = |p, q| centred.get(p, q) * per_point;
        Some(Self {
            count: moments.count(),
            mean,
            xx: m(2, 0),
            xy: m(1, 1),
            yy: m(0, 2),
            xz: m(3, 0) + m(1, 2),
            yz: m(2, 1) + m(0, 3),
            zz: m(4, 0) + 2.0 * m(2, 2) + m(0, 4),
        })
    }

    /// Returns the moments from the means of `(x, y)`, of `(x^2, x y, y^2)`, of `(x q, y q)` and of `q^2`, with `q = x^2 + y^2`.
    #[inline]
    pub fn from_means(count: f64, mean: [f64; 2], squares: [f64; 3], cubes: [f64; 2], fourth: f64) -> Self {
        let ([x, y], [sxx, sxy, syy]) = (mean, squares);
        let (xx, xy, yy) = (sxx - x * x, sxy - x * y, syy - y * y);
        let (q, m) = (sxx + syy, x * x + y * y);
        // z = q - 2 (mean . p) + m, about the mean.
        let xz = cubes[0] - x * q - 2.0 * (x * xx + y * xy);
        let yz = cubes[1] - y * q - 2.0 * (x * xy + y * yy);
        let along = x * (x * sxx + 2.0 * y * sxy) + y * y * syy;
        let zz = fourth - 4.0 * (x * cubes[0] + y * cubes[1] - along) + m * (2.0 * q - 3.0 * m);
        Self { count, mean, xx, xy, yy, xz, yz, zz }
    }

    /// Returns the mean of the points, in metres.
    pub fn mean(&self) -> [f64; 2] {
        self.mean
    }

    /// Returns the mean square distance from the line of least squares.
    #[inline]
    pub fn line_square(&self) -> f64 {
        smaller_eigenvalue(self.xx, self.xy, self.yy)
    }

    /// Returns whether the mean square distance from the best circle is at most `square`, without fitting the circle.
    ///
    /// The polynomial of the eigenvalues rises through its smallest root; a line is a circle too.
    #[inline]
    pub fn is_circle_within(&self, square: f64) -> bool {
        let c = self.eigenvalue_polynomial();
        c[0] + square * (c[1] + square * (c[2] + square * c[3])) >= 0.0 || self.line_square() <= square
    }

    /// Returns the cubic whose smallest root is the mean square distance from the circle.
    #[inline]
    fn eigenvalue_polynomial(&self) -> [f64; 4] {
        let Self { xx, xy, yy, xz, yz, zz, .. } = *self;
        let (z, covariance) = (xx + yy, xx * yy - xy * xy);
        let variance = zz - z * z;
        [
            xz * (xz * yy - yz * xy) + yz * (yz * xx - xz * xy) - variance * covariance,
            (variance + 4.0 * covariance) * z - xz * xz - yz * yz,
            -3.0 * z * z - zz,
            4.0 * z,
        ]
    }

    /// Returns the mean square distance from the best circle.
    #[inline]
    pub fn circle_square(&self) -> f64 {
        root_near_zero(&self.eigenvalue_polynomial())
    }

    /// Fits a line and a circle.
    pub fn fit(&self) -> ArcFit {
        let Self { xx, xy, yy, xz, yz, .. } = *self;
        let (z, covariance) = (xx + yy, xx * yy - xy * xy);
        let eta = self.circle_square();
        let half = 0.5 / (eta * eta - eta * z + covariance);
        let (x, y) = ((xz * (yy - eta) - yz * xy) * half, (yz * (xx - eta) - xz * xy) * half);
        let circle = Circle { center: [self.mean[0] + x, self.mean[1] + y], radius: (x * x + y * y + z).sqrt() };
        ArcFit { line_square: self.line_square(), circle_square: eta, circle }
    }

    #[cfg(test)]
    pub(crate) fn numbers(&self) -> [f64; 9] {
        let Self { count, mean, xx, xy, yy, xz, yz, zz } = *self;
        [count, mean[0], mean[1], xx, xy, yy, xz, yz, zz]
    }
}

/// Returns the smaller eigenvalue of `[[xx, xy], [xy, yy]]`.
#[inline]
pub(crate) fn smaller_eigenvalue(xx: f64, xy: f64, yy: f64) -> f64 {
    0.5 * (xx + yy) - (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt()
}

/// Returns the root of `c0 + c1 x + c2 x^2 + c3 x^3` that Newton's iteration finds from 0.
fn root_near_zero(c: &[f64; 4]) -> f64 {
    let most_steps = 12; // [algorithmic]
    let (mut x, mut step) = (0.0, c[0] / c[1]);
    for _ in 0..most_steps {
        if !step.is_finite() {
            break;
        }
        x -= step;
        // Convergence is quadratic: the error is the square of the step. [algorithmic]
        if step.abs() <= 1e-4 * x.abs() + 1e-13 {
            break;
        }
        let value = c[0] + x * (c[1] + x * (c[2] + x * c[3]));
        step = value / (c[1] + x * (2.0 * c[2] + x * 3.0 * c[3]));
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Conic, fit_circle, line_rms};

    fn arc(from: f64, to: f64) -> impl Iterator<Item = [f64; 2]> + Clone {
        (0..40).map(move |i| from + (to - from) * f64::from(i) / 39.0).map(|a| [0.2 * a.cos(), 2.0 + 0.2 * a.sin()])
    }

    #[test]
    fn it_agrees_with_the_single_fits() {
        let noisy = arc(3.9, 5.5).enumerate().map(|(i, [s, t])| [s, t + 0.003 * (i as f64 * 2.4).sin()]);
        let moments = PlaneMoments::of([0.0, 0.0], noisy);
        let fit = ArcMoments::of(&moments).unwrap().fit();
        let (circle, line) = (fit_circle(&moments).unwrap(), line_rms(&moments).unwrap());
        assert!((fit.circle.radius - circle.radius).abs() < 1e-6, "{fit:?} {circle:?}");
        let coefficients = [1.0, 0.0, 1.0, 0.0, 0.0, -circle.radius * circle.radius];
        let rms = Conic { origin: circle.center, coefficients }.rms(&moments).unwrap();
        assert!((fit.circle_square.sqrt() - rms).abs() < 1e-4, "{fit:?}");
        let (mean, expected_mean) = (ArcMoments::of(&moments).unwrap().mean(), moments.mean().unwrap());
        assert!((mean[0] - expected_mean[0]).abs() + (mean[1] - expected_mean[1]).abs() < 1e-12, "{mean:?}");
        assert!((fit.line_square.sqrt() - line).abs() < 1e-6, "{fit:?} {line:?}");
        let expected = 40.0 * (fit.line_square - fit.circle_square) / 1e-6;
        assert!((bulge(&moments, 1e-6) - expected).abs() < 1e-9 * expected);
        let hollow = PlaneMoments::of([0.0, 0.0], arc(0.8, 2.4));
        assert_eq!(bulge(&hollow, 1e-6), 0.0);
    }

    #[test]
    fn the_square_of_the_circle_is_that_of_the_distances_of_the_points_from_it_wherever_it_is_open() {
        for (turn, noise) in [(0.0, 0.003), (1.1, 0.02), (2.5, 0.04), (4.0, 0.003)] {
            let noisy = arc(turn, turn + 2.0).enumerate();
            let points = noisy.map(|(i, [s, t])| [s + noise * (f64::from(i as u32) * 1.7).cos(), t]);
            let points: Vec<_> = points.collect();
            let fit = ArcMoments::of(&PlaneMoments::of([0.0, 2.0], points.iter().copied())).unwrap().fit();
            let Circle { center: [x, y], radius } = fit.circle;
            // The distance to first order, as in the fit: (d^2 - r^2) / 2r.
            let distance = |[s, t]: [f64; 2]| ((s - x).powi(2) + (t - y).powi(2) - radius * radius) / (2.0 * radius);
            let square = points.iter().map(|point| distance(*point).powi(2)).sum::<f64>() / points.len() as f64;
            assert!((fit.circle_square - square).abs() < 1e-6 * square, "{fit:?} {square}");
        }
    }

    #[test]
    fn short_arcs_full_of_noise_do_not_speak_against_a_circle() {
        for n in 6..16 {
            for seed in 0..200_u32 {
                // Even steps across; the depths come from the "quick and dirty" generator of Numerical Recipes.
                let mut state = seed.wrapping_mul(16).wrapping_add(n);
                let points = (0..n).map(|i| {
                    state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                    [4.0 / 525.0 * f64::from(i), 4.0 + 0.05 * (f64::from(state >> 8) / f64::from(1 << 24) - 0.5)]
                });
                assert!(bulge(&PlaneMoments::of([0.0, 4.0], points), 2e-4) >= 0.0);
            }
        }
    }

    #[test]
    fn a_circle_within_a_distance_needs_no_fit() {
        let [front, most] = [[3.9, 5.5], [0.0, 5.5]];
        for (i, ([from, to], noise)) in
            [(front, 0.0), (front, 0.001), (front, 0.003), (front, 0.01), (most, 0.04), (most, 0.08)]
                .into_iter()
                .enumerate()
        {
            let phase = i as f64;
            let noisy = arc(from, to).enumerate().map(|(i, [s, t])| [s, t + noise * (i as f64 * 2.4 + phase).sin()]);
            let arc = ArcMoments::of(&PlaneMoments::of([0.0, 0.0], noisy)).unwrap();
            let square = arc.fit().circle_square;
            for (factor, within) in [(0.5, false), (0.95, false), (1.05, true), (3.0, true)] {
                let limit = factor * square + if within { 1e-12 } else { -1e-12 };
                assert_eq!(arc.is_circle_within(limit), within, "{factor} of {square}");
            }
        }
    }

    #[test]
    fn means_about_the_camera_give_the_moments_about_the_mean() {
        let points: Vec<_> = arc(4.0, 5.0).collect();
        let mean = |f: &dyn Fn(f64, f64) -> f64| points.iter().map(|[s, t]| f(*s, *t)).sum::<f64>() / 40.0;
        let q = |s: f64, t: f64| s * s + t * t;
        let cubes = [mean(&|s, t| s * q(s, t)), mean(&|s, t| t * q(s, t))];
        let squares = [mean(&|s, _| s * s), mean(&|s, t| s * t), mean(&|_, t| t * t)];
        let plain = [mean(&|s, _| s), mean(&|_, t| t)];
        let arc = ArcMoments::from_means(40.0, plain, squares, cubes, mean(&|s, t| q(s, t).powi(2)));
        let expected = ArcMoments::of(&PlaneMoments::of([0.0, 0.0], points.iter().copied())).unwrap();
        for (a, b) in arc.numbers().into_iter().zip(expected.numbers()) {
            assert!((a - b).abs() < 1e-13, "{arc:?} {expected:?}");
        }
    }

    #[test]
    fn a_line_has_no_distance_from_its_line() {
        let line = (0..40).map(|i| f64::from(i) * 0.02).map(|x| [x, 1.0 + 0.5 * x]);
        let fit = ArcMoments::of(&PlaneMoments::of([0.0, 1.0], line)).unwrap().fit();
        assert!(fit.line_square.abs() < 1e-12, "{fit:?}");
    }

    #[test]
    fn the_roots_of_cubics_are_found_to_all_digits_also_where_they_bend_much_before_them() {
        for [a, b, c] in [[0.1, 1.0, 2.0], [0.4, 1.0, 2.0], [0.9, 1.0, 1.1], [0.5, 0.7, 30.0], [-0.1, 0.9, 1.5]] {
            let root = root_near_zero(&[-a * b * c, a * b + b * c + c * a, -(a + b + c), 1.0]);
            assert!((root - a).abs() < 1e-8, "{root} {a}");
        }
    }

    #[test]
    fn a_circle_is_as_far_from_a_ring_and_its_middle_as_from_any_points() {
        // The best circle about as many points in the middle as on the ring of radius 1 has the radius 1/sqrt(2): to first order
        // all points are off by 1/(2 sqrt(2)).
        let ring = (0..12).map(|i| f64::from(i) * std::f64::consts::PI / 6.0).map(|a| [a.cos(), 2.0 + a.sin()]);
        let arc = ArcMoments::of(&PlaneMoments::of([0.0, 2.0], ring.chain([[0.0, 2.0]; 12]))).unwrap();
        assert!((arc.circle_square() - 0.125).abs() < 1e-9 && (arc.line_square() - 0.25).abs() < 1e-9, "{arc:?}");
        assert!(arc.is_circle_within(0.126) && !arc.is_circle_within(0.124));
    }
}
