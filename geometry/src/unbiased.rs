//! Moments of noisy points whose expectation is that of the points without noise.
//!
//! A depth sensor errs along the ray: `z + e` with `e ~ N(0, v)`. Every in-plane monomial of degree n is
//! `x^p k^q z^n`, and the Hermite polynomials `h1 = z`, `h2 = z^2 - v`, `h3 = z^3 - 3 z v`, `h4 = z^4 - 6 z^2 v + 3 v^2`
//! are unbiased estimates of the powers of z. With them the fits are adjusted least squares (Kukush, Markovsky and Van
//! Huffel, "Consistent estimation in an implicit quadratic measurement error model", 2004).

use crate::arc_fit::smaller_eigenvalue;
use crate::{ArcMoments, MOMENTS, PlaneMoments};
use std::ops::{Add, Mul, Sub};
use wide::f64x2;

/// A number, or two side by side.
trait Number: Copy + From<f64> + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> {}
impl Number for f64 {}
impl Number for f64x2 {}

/// Returns unbiased estimates of `[1, z, z^2, z^3, z^4]` from a measurement of variance `variance`.
#[inline]
fn powers<T: Number>(z: T, variance: T) -> [T; 5] {
    let (z2, [one, three, six]) = (z * z, [1.0, 3.0, 6.0].map(T::from));
    [one, z, z2 - variance, z * (z2 - three * variance), z2 * (z2 - six * variance) + three * variance * variance]
}

/// Sums `sum x^p h_n(z)` over the rays of a scan line, x the slope of the ray; p <= n <= 4, in the order of
/// [`PlaneMoments::from_sums`] with n = p + q.
///
/// These sums do not depend on the scan plane.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct RaySums(pub [f64; MOMENTS]);

impl RaySums {
    /// Returns the sums of some measurements.
    #[inline]
    pub fn of<'a>(parts: impl Iterator<Item = RayPart<'a>>) -> Self {
        let mut count = 0;
        let terms = sum::<_, 1>(parts.inspect(|(_, depths, _)| count += depths.len()), ray_terms);
        Self(std::array::from_fn(|i| i.checked_sub(1).map_or(count as f64, |term| terms[term])))
    }

    /// Returns the plane moments about `(0, 0)` in a scan plane of stretch `k`: `t = k z`.
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

/// Measurements of one variance: the slopes of the rays, the depths, and the variance of a depth.
pub type RayPart<'a> = (&'a [f64], &'a [f64], f64);

/// Sums terms of slope, depth and variance over measurements, two at a time. `PAIRS` pairs have separate sums, so that an
/// addition need not wait for the previous one.
#[inline]
fn sum<'a, const N: usize, const PAIRS: usize>(
    parts: impl Iterator<Item = RayPart<'a>>,
    terms: impl Fn(f64x2, f64x2, f64x2) -> [f64x2; N],
) -> [f64; N] {
    let mut sums = [[f64x2::ZERO; N]; PAIRS];
    for (slopes, depths, variance) in parts {
        let ((x_pairs, x_rest), (z_pairs, z_rest)) = (slopes.as_chunks(), depths.as_chunks());
        let variance = f64x2::splat(variance);
        let add = |sums: &mut [f64x2; N], x, z| {
            sums.iter_mut().zip(terms(x, z, variance)).for_each(|(sum, term)| *sum += term);
        };
        let ((x_many, x_few), (z_many, z_few)) = (x_pairs.as_chunks::<PAIRS>(), z_pairs.as_chunks::<PAIRS>());
        for (x_pairs, z_pairs) in x_many.iter().zip(z_many) {
            for (sums, (&x, &z)) in sums.iter_mut().zip(x_pairs.iter().zip(z_pairs)) {
                add(sums, f64x2::new(x), f64x2::new(z));
            }
        }
        for (&x, &z) in x_few.iter().zip(z_few) {
            add(&mut sums[0], f64x2::new(x), f64x2::new(z));
        }
        if let (&[x], &[z]) = (x_rest, z_rest) {
            let (terms, one) = (terms(f64x2::splat(x), f64x2::splat(z), variance), f64x2::new([1.0, 0.0]));
            sums[0].iter_mut().zip(terms).for_each(|(sum, term)| *sum += term * one);
        }
    }
    std::array::from_fn(|i| sums.iter().fold(f64x2::ZERO, |all, sums| all + sums[i]).reduce_add())
}

/// Returns the terms of [`RaySums`] without the first, which is a count.
#[inline]
fn ray_terms(x: f64x2, z: f64x2, variance: f64x2) -> [f64x2; MOMENTS - 1] {
    let [_, h1, h2, h3, h4] = powers(z, variance);
    let (x2, xh2, xh3, xh4) = (x * x, x * h2, x * h3, x * h4);
    [x * h1, h1, x * xh2, xh2, h2, x2 * xh3, x * xh3, xh3, h3, x2 * (x * xh4), x2 * xh4, x * xh4, xh4, h4]
}

#[inline]
fn line_terms(x: f64x2, z: f64x2, variance: f64x2) -> [f64x2; 5] {
    let h2 = z * z - variance;
    let xh2 = x * h2;
    [x * z, z, x * xh2, xh2, h2]
}

#[inline]
fn arc_terms(x: f64x2, z: f64x2, variance: f64x2, square_stretch: f64x2) -> [f64x2; 8] {
    let [_, h1, h2, h3, h4] = powers(z, variance);
    let (xh2, c) = (x * h2, x * x + square_stretch);
    let (ch3, ch4) = (c * h3, c * h4);
    [x * h1, h1, x * xh2, xh2, h2, c * ch4, x * ch3, ch3]
}

/// The sums over the rays of a scan line that a line fit needs: those of `[x h1, h1, x^2 h2, x h2, h2]`.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct LineSums([f64; 5]);

impl LineSums {
    /// Returns the sums of some measurements.
    #[inline]
    pub fn of<'a>(parts: impl Iterator<Item = RayPart<'a>>) -> Self {
        Self(sum::<_, 2>(parts, line_terms))
    }

    /// Returns the sums without some of the measurements.
    #[must_use]
    pub fn without(&self, some: &Self) -> Self {
        Self(std::array::from_fn(|i| self.0[i] - some.0[i]))
    }

    /// Returns the mean square distance of `count` points from their line, in a scan plane of stretch k.
    #[inline]
    pub fn line_square(&self, count: f64, k: f64) -> f64 {
        mean_square(self.0.map(|sum| sum / count), k)
    }
}

/// Returns the mean square distance from the line, given the means of `[x h1, h1, x^2 h2, x h2, h2]`.
#[inline]
fn mean_square([x, y, xx, xy, yy]: [f64; 5], k: f64) -> f64 {
    smaller_eigenvalue(xx - x * x, k * (xy - x * y), k * k * (yy - y * y))
}

/// The sums over the rays of a scan line that fits of lines and circles need: with `c = x^2 + k^2` in a scan plane of stretch k,
/// those of `[x h1, h1, x^2 h2, x h2, h2, c^2 h4, x c h3, c h3]`, in pairs.
///
/// Like [`RaySums`] they are free of the bias of noise. The difference of two running sums is the sum over the interval between.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ArcSums([f64x2; 4]);

impl ArcSums {
    /// Returns these sums with one, and with both, of two more measurements: slopes x, depths z, variance of the depths, and the
    /// square of the stretch.
    #[inline]
    #[must_use]
    pub fn with_two(&self, x: [f64; 2], z: [f64; 2], variance: f64, square_stretch: f64) -> [Self; 2] {
        let [variance, square_stretch] = [variance, square_stretch].map(f64x2::splat);
        let [a, b, c, d, e, f, g, h] = arc_terms(f64x2::new(x), f64x2::new(z), variance, square_stretch);
        let terms = [[a, b], [c, d], [e, f], [g, h]].map(f64x2::transpose);
        let first: [f64x2; 4] = std::array::from_fn(|i| self.0[i] + terms[i][0]);
        [Self(first), Self(std::array::from_fn(|i| first[i] + terms[i][1]))]
    }

    /// Returns the sums of some measurements in a scan plane with this square of the stretch.
    #[inline]
    pub fn of<'a>(parts: impl Iterator<Item = RayPart<'a>>, square_stretch: f64) -> Self {
        let square_stretch = f64x2::splat(square_stretch);
        let [a, b, c, d, e, f, g, h] = sum::<_, 1>(parts, |x, z, variance| arc_terms(x, z, variance, square_stretch));
        Self([[a, b], [c, d], [e, f], [g, h]].map(f64x2::new))
    }

    /// Returns the sums over the measurements between an earlier state of the running sums and this one.
    #[inline]
    #[must_use]
    pub fn since(&self, earlier: &Self) -> Self {
        Self(std::array::from_fn(|i| self.0[i] - earlier.0[i]))
    }

    /// Returns the mean square distance of `count` points from their line, in a scan plane of stretch k.
    #[inline]
    pub fn line_square(&self, count: f64, k: f64) -> f64 {
        let [[x, y], [xx, xy], [yy, _], _] = self.means(count);
        mean_square([x, y, xx, xy, yy], k)
    }

    /// Returns the moments of `count` points in a scan plane of stretch k.
    #[inline]
    pub fn moments(&self, count: f64, k: f64) -> ArcMoments {
        let [[x, y], [xx, xy], [yy, qq], [xq, yq]] = self.means(count);
        ArcMoments::from_means(count, [x, k * y], [xx, k * xy, k * k * yy], [xq, k * yq], qq)
    }

    #[inline]
    fn means(&self, count: f64) -> [[f64; 2]; 4] {
        self.0.map(|sum| (sum * f64x2::splat(1.0 / count)).to_array())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SLOPES: [f64; 31] = {
        let mut slopes = [0.0; 31];
        let mut i = 0;
        while i < 31 {
            slopes[i] = 0.01 * i as f64 - 0.1;
            i += 1;
        }
        slopes
    };

    fn depths() -> [f64; 31] {
        std::array::from_fn(|i| 1.5 + 0.02 * (i % 5) as f64)
    }

    /// The measurements in three parts of odd length.
    fn parts<'a>(slopes: &'a [f64; 31], depths: &'a [f64; 31], variance: f64) -> [RayPart<'a>; 3] {
        let part = |range: std::ops::Range<usize>| (&slopes[range.clone()], &depths[range], variance);
        [part(0..7), part(7..16), part(16..31)]
    }

    #[test]
    fn without_noise_they_are_the_moments_of_the_points() {
        let k = 1.1;
        let sums = RaySums::of(parts(&SLOPES, &depths(), 0.0).into_iter());
        let points = SLOPES.into_iter().zip(depths()).map(|(x, z)| [x * z, k * z]);
        let direct = PlaneMoments::of([0.0, 0.0], points);
        for (a, b) in sums.moments(k).sums().iter().zip(direct.sums()) {
            assert!((a - b).abs() < 1e-11 * (1.0 + b.abs()), "{a} {b}");
        }
    }

    #[test]
    fn the_sums_for_lines_and_circles_say_the_same_as_all_of_them() {
        let (variance, k, depths) = (1e-3, 1.1, depths());
        let all = RaySums::of(parts(&SLOPES, &depths, variance).into_iter());
        let expected = ArcMoments::of(&all.moments(k)).unwrap();
        let check = |few: ArcSums| {
            for (a, b) in few.moments(31.0, k).numbers().into_iter().zip(expected.numbers()) {
                assert!((a - b).abs() < 1e-12 * (1.0 + b.abs()), "{few:?} {expected:?}");
            }
            assert!((few.line_square(31.0, k) - expected.line_square()).abs() < 1e-13);
        };
        check(ArcSums::of(parts(&SLOPES, &depths, variance).into_iter(), k * k));
        let with_two = |sums: &ArcSums, x, z| sums.with_two(x, z, variance, k * k);
        let [before, _] = with_two(&ArcSums::default(), [0.3, 7.0], [1.0, 7.0]);
        let pairs = SLOPES.as_chunks().0.iter().zip(depths.as_chunks().0);
        let even = pairs.fold(before, |sums, (&x, &z)| with_two(&sums, x, z)[1]);
        check(with_two(&even, [SLOPES[30], 7.0], [depths[30], 7.0])[0].since(&before));

        let some = (&[0.3, 0.4, 0.5][..], &[1.0, 2.0, 3.0][..], variance);
        let line = LineSums::of(std::iter::once(some).chain(parts(&SLOPES, &depths, variance)));
        let rest = line.without(&LineSums::of(std::iter::once(some)));
        assert!((rest.line_square(31.0, k) - expected.line_square()).abs() < 1e-13);
    }

    #[test]
    fn the_noise_leaves_their_mean_in_place() {
        // Gauss-Hermite quadrature with three nodes is exact up to degree 5.
        let (z, v) = (1.7, 0.02_f64);
        let nodes = [(-(3.0 * v).sqrt(), 1.0 / 6.0), (0.0, 2.0 / 3.0), ((3.0 * v).sqrt(), 1.0 / 6.0)];
        for n in 0..5 {
            let mean: f64 = nodes.iter().map(|(e, weight)| weight * powers(z + e, v)[n]).sum();
            assert!((mean - z.powi(n as i32)).abs() < 1e-12);
        }
    }
}
