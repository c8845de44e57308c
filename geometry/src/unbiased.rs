//! Moments of noisy points whose expectation is that of the points without noise.
//!
//! A depth sensor errs along the ray: `z + e` with `e ~ N(0, v)`. Every in-plane monomial of degree n is
//! `x^p k^q z^n`, and the Hermite polynomials `h1 = z`, `h2 = z^2 - v`, `h3 = z^3 - 3 z v`, `h4 = z^4 - 6 z^2 v + 3 v^2`
//! are unbiased estimates of the powers of z. With them the fits are adjusted least squares (Kukush, Markovsky and Van
//! Huffel, "Consistent estimation in an implicit quadratic measurement error model", 2004).

use crate::arc_fit::smaller_eigenvalue;
use crate::{ArcMoments, MOMENTS, PlaneMoments};

/// Unbiased estimates of `[1, z, z^2, z^3, z^4]` from a measurement of variance `variance`.
#[inline]
pub fn unbiased_powers(z: f64, variance: f64) -> [f64; 5] {
    let z2 = z * z;
    [1.0, z, z2 - variance, z * (z2 - 3.0 * variance), z2 * (z2 - 6.0 * variance) + 3.0 * variance * variance]
}

/// Sums `sum x^p h_n(z)` over the rays of a scan line, x the slope of the ray; p <= n <= 4, in the order of
/// [`PlaneMoments::from_sums`] with n = p + q.
///
/// They do not depend on the scan plane, and the difference of two running sums is the sum over what lies between.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RaySums(pub [f64; MOMENTS]);

impl RaySums {
    /// These sums and one more measurement: slope x, depth z, variance of the depth.
    #[inline]
    #[must_use]
    pub fn with(&self, x: f64, z: f64, variance: f64) -> Self {
        let [one, h1, h2, h3, h4] = unbiased_powers(z, variance);
        let (x2, xh2, xh3, xh4) = (x * x, x * h2, x * h3, x * h4);
        let terms =
            [one, x * h1, h1, x * xh2, xh2, h2, x2 * xh3, x * xh3, xh3, h3, x2 * (x * xh4), x2 * xh4, x * xh4, xh4, h4];
        Self(std::array::from_fn(|i| self.0[i] + terms[i]))
    }

    /// The measurements between an earlier state of the running sums and this one.
    #[inline]
    #[must_use]
    pub fn since(&self, earlier: &Self) -> Self {
        Self(std::array::from_fn(|i| self.0[i] - earlier.0[i]))
    }

    /// The plane moments about `(0, 0)` in a scan plane of stretch `k`: `t = k z`.
    #[inline]
    pub fn moments(&self, k: f64) -> PlaneMoments {
        let (k2, s) = (k * k, &self.0);
        let (k3, k4) = (k2 * k, k2 * k2);
        let scaled = [
            s[0],
            s[1],
            k * s[2],
            s[3],
            k * s[4],
            k2 * s[5],
            s[6],
            k * s[7],
            k2 * s[8],
            k3 * s[9],
            s[10],
            k * s[11],
            k2 * s[12],
            k3 * s[13],
            k4 * s[14],
        ];
        PlaneMoments::from_sums([0.0, 0.0], scaled)
    }
}

/// What a line asks of the rays of a scan line, and no more: the sums of `[x h1, h1, x^2 h2, x h2, h2]`.
///
/// As those of [`RaySums`], they are free of the noise, and the difference of two running sums is the sum over what lies
/// between.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LineSums(pub [f64; 5]);

/// What a circle asks on top of it, in a scan plane of stretch k: with `c = x^2 + k^2`, the sums of
/// `[x c h3, c h3, c^2 h4]`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct CircleSums(pub [f64; 3]);

impl LineSums {
    /// These sums and one more measurement: slope x, depth z, variance of the depth.
    #[inline]
    #[must_use]
    pub fn with(&self, x: f64, z: f64, variance: f64) -> Self {
        let h2 = z * z - variance;
        let xh2 = x * h2;
        let terms = [x * z, z, x * xh2, xh2, h2];
        Self(std::array::from_fn(|i| self.0[i] + terms[i]))
    }

    /// The measurements between an earlier state of the running sums and this one.
    #[inline]
    #[must_use]
    pub fn since(&self, earlier: &Self) -> Self {
        Self(std::array::from_fn(|i| self.0[i] - earlier.0[i]))
    }

    /// Mean square distance of `count` points from their line, in a scan plane of stretch k.
    #[inline]
    pub fn line_square(&self, count: f64, k: f64) -> f64 {
        let per_point = 1.0 / count;
        let [x, y, xx, xy, yy] = self.0.map(|sum| sum * per_point);
        smaller_eigenvalue(xx - x * x, k * (xy - x * y), k * k * (yy - y * y))
    }
}

impl CircleSums {
    /// These sums and one more measurement: slope x, depth z, variance of the depth, and the square of the stretch.
    #[inline]
    #[must_use]
    pub fn with(&self, x: f64, z: f64, variance: f64, square_stretch: f64) -> Self {
        let [_, _, _, h3, h4] = unbiased_powers(z, variance);
        let c = x * x + square_stretch;
        let terms = [x * (c * h3), c * h3, c * (c * h4)];
        Self(std::array::from_fn(|i| self.0[i] + terms[i]))
    }

    /// The measurements between an earlier state of the running sums and this one.
    #[inline]
    #[must_use]
    pub fn since(&self, earlier: &Self) -> Self {
        Self(std::array::from_fn(|i| self.0[i] - earlier.0[i]))
    }

    /// The moments of `count` points, of which `line` are the other sums, in a scan plane of stretch k.
    #[inline]
    pub fn moments(&self, line: &LineSums, count: f64, k: f64) -> ArcMoments {
        let per_point = 1.0 / count;
        let [x, y, xx, xy, yy] = line.0.map(|sum| sum * per_point);
        let [xq, yq, qq] = self.0.map(|sum| sum * per_point);
        ArcMoments::from_means(count, [x, k * y], [xx, k * xy, k * k * yy], [xq, k * yq], qq)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn without_noise_they_are_the_moments_of_the_points() {
        let rays = (0..30).map(|i| (0.01 * f64::from(i) - 0.1, 1.5 + 0.02 * f64::from(i % 5)));
        let (mut sums, k) = (RaySums::default(), 1.1);
        let earlier = sums.with(0.3, 1.0, 0.1);
        sums = rays.clone().fold(earlier, |sums, (x, z)| sums.with(x, z, 0.0)).since(&earlier);
        let direct = PlaneMoments::of([0.0, 0.0], rays.map(|(x, z)| [x * z, k * z]));
        for (a, b) in sums.moments(k).sums().iter().zip(direct.sums()) {
            assert!((a - b).abs() < 1e-11 * (1.0 + b.abs()), "{a} {b}");
        }
    }

    #[test]
    fn the_sums_for_lines_and_circles_say_the_same_as_all_of_them() {
        let rays = (0..30).map(|i| (0.01 * f64::from(i) - 0.1, 1.5 + 0.02 * f64::from(i % 5)));
        let (variance, k) = (1e-3, 1.1);
        let all = rays.clone().fold(RaySums::default(), |sums, (x, z)| sums.with(x, z, variance)).moments(k);
        let line = LineSums::default().with(0.3, 1.0, variance);
        let circle = CircleSums::default().with(0.3, 1.0, variance, k * k);
        let lines = rays.clone().fold(line, |sums, (x, z)| sums.with(x, z, variance)).since(&line);
        let circles = rays.fold(circle, |sums, (x, z)| sums.with(x, z, variance, k * k)).since(&circle);
        let (few, expected) = (circles.moments(&lines, 30.0, k), ArcMoments::of(&all).unwrap());
        for (a, b) in few.numbers().into_iter().zip(expected.numbers()) {
            assert!((a - b).abs() < 1e-12 * (1.0 + b.abs()), "{few:?} {expected:?}");
        }
        assert!((lines.line_square(30.0, k) - expected.line_square()).abs() < 1e-13);
    }

    #[test]
    fn the_noise_leaves_their_mean_in_place() {
        // Gauss-Hermite quadrature with three nodes is exact up to degree 5.
        let (z, v) = (1.7, 0.02_f64);
        let nodes = [(-(3.0 * v).sqrt(), 1.0 / 6.0), (0.0, 2.0 / 3.0), ((3.0 * v).sqrt(), 1.0 / 6.0)];
        for n in 0..5 {
            let mean: f64 = nodes.iter().map(|(e, weight)| weight * unbiased_powers(z + e, v)[n]).sum();
            assert!((mean - z.powi(n as i32)).abs() < 1e-12);
        }
    }
}
