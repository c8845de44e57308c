//! Conics: the direct ellipse fit from moments, the distance of points from a conic, and the axes and extents of an ellipse.
//!
//! A conic is `F(s, t) = a s^2 + b s t + c t^2 + d s + e t + f = 0`. The fit minimises `sum F^2` under `4ac - b^2 = 1`:
//! Fitzgibbon, Pilu, Fisher, "Direct least square fitting of ellipses" (PAMI 1999), in the numerically stable form of
//! Halir & Flusser, "Numerically stable direct least squares fitting of ellipses" (WSCG 1998).

use crate::PlaneMoments;
use nalgebra::{Matrix3, Vector3};

/// Coefficients `[a, b, c, d, e, f]` of a conic, about an origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Conic {
    /// Origin `(s, t)` of the coordinates in which the coefficients hold.
    pub origin: [f64; 2],
    /// `a s^2 + b s t + c t^2 + d s + e t + f`.
    pub coefficients: [f64; 6],
}

/// An ellipse in a plane, in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ellipse {
    /// Centre `(s, t)`.
    pub center: [f64; 2],
    /// Semi-axes, the longer first.
    pub semi_axes: [f64; 2],
    /// Angle of the longer axis from the s axis, in (-pi/2, pi/2].
    pub angle: f64,
    /// Half the extent along s and along t: half the bounding box.
    pub half_extents: [f64; 2],
}

impl Conic {
    /// Returns `sum F^2` over the points of `moments`: the quadratic form `q' M q` of the coefficients.
    pub fn square_sum(&self, moments: &PlaneMoments) -> f64 {
        let moved;
        let moments = if moments.origin() == self.origin {
            moments
        } else {
            moved = moments.about(self.origin);
            &moved
        };
        let [a, b, c, d, e, f] = self.coefficients;
        // The square of the polynomial, in the order of the moments.
        let square = [
            f * f,
            2.0 * d * f,
            2.0 * e * f,
            d * d + 2.0 * a * f,
            2.0 * (b * f + d * e),
            e * e + 2.0 * c * f,
            2.0 * a * d,
            2.0 * (a * e + b * d),
            2.0 * (b * e + c * d),
            2.0 * c * e,
            a * a,
            2.0 * a * b,
            b * b + 2.0 * a * c,
            2.0 * b * c,
            c * c,
        ];
        square.iter().zip(moments.sums()).map(|(factor, moment)| factor * moment).sum()
    }

    /// Returns `sum |grad F|^2` over the points of `moments`.
    pub fn gradient_square_sum(&self, moments: &PlaneMoments) -> f64 {
        let [a, b, c, d, e, _] = self.coefficients;
        let moments = moments.about(self.origin);
        let part = |x: f64, y: f64, z: f64| {
            x * x * moments.get(2, 0)
                + y * y * moments.get(0, 2)
                + z * z * moments.get(0, 0)
                + 2.0 * (x * y * moments.get(1, 1) + x * z * moments.get(1, 0) + y * z * moments.get(0, 1))
        };
        part(2.0 * a, b, d) + part(b, 2.0 * c, e)
    }

    /// Returns the root mean square distance of the points from the curve, to first order: `sqrt(sum F^2 / sum |grad F|^2)`.
    ///
    /// This is Taubin's approximate mean square distance (PAMI 1991): Sampson's distance `F / |grad F|` with the mean of the
    /// gradient in place of each point's own, which follows from moments in O(1). `None` where the gradient vanishes.
    pub fn rms(&self, moments: &PlaneMoments) -> Option<f64> {
        let gradient = self.gradient_square_sum(moments);
        let ratio = self.square_sum(moments).max(0.0) / gradient;
        (gradient > 0.0 && ratio.is_finite()).then(|| ratio.sqrt())
    }

    /// Returns the centre, the axes and the extents; `None` if the conic is not a real ellipse.
    pub fn to_ellipse(&self) -> Option<Ellipse> {
        let [a, b, c, d, e, f] = self.coefficients;
        let determinant = a * c - b * b / 4.0;
        if determinant.is_nan() || determinant <= 0.0 {
            return None;
        }
        let (s, t) = ((b * e / 2.0 - c * d) / (2.0 * determinant), (b * d / 2.0 - a * e) / (2.0 * determinant));
        let level = -(f + (d * s + e * t) / 2.0);
        let (mean, half_gap) = ((a + c) / 2.0, ((a - c) / 2.0).hypot(b / 2.0));
        // Of the two eigenvalues of the quadratic part, the one with the greater magnitude is free of cancellation.
        let steep = mean + half_gap.copysign(mean);
        let shallow = determinant / steep;
        let squares = [level / shallow, level / steep, level * c / determinant, level * a / determinant];
        if !squares.iter().all(|square| square.is_finite() && *square > 0.0) {
            return None;
        }
        let [long, short, width, depth] = squares.map(f64::sqrt);
        let center = [self.origin[0] + s, self.origin[1] + t];
        Some(Ellipse { center, semi_axes: [long, short], angle: long_axis(a, b, c), half_extents: [width, depth] })
    }

    /// Returns the same curve with coefficients about another origin.
    #[must_use]
    pub fn about(&self, origin: [f64; 2]) -> Self {
        let [a, b, c, d, e, f] = self.coefficients;
        let (s, t) = (origin[0] - self.origin[0], origin[1] - self.origin[1]);
        let constant = (a * s + b * t + d) * s + (c * t + e) * t + f;
        let coefficients = [a, b, c, d + 2.0 * a * s + b * t, e + b * s + 2.0 * c * t, constant];
        Self { origin, coefficients }
    }

    /// Returns the same curve scaled by a factor.
    fn scaled(&self, scale: f64) -> Self {
        let [a, b, c, d, e, f] = self.coefficients;
        let square = scale * scale;
        Self { origin: self.origin, coefficients: [a / square, b / square, c / square, d / scale, e / scale, f] }
    }
}

/// Returns the direction of the longer axis of an ellipse with quadratic part `a s^2 + b s t + c t^2`.
fn long_axis(a: f64, b: f64, c: f64) -> f64 {
    let sign = if a + c < 0.0 { -1.0 } else { 1.0 };
    // The quadratic part is least along the longer axis; `-0.0` would turn an angle of pi/2 into -pi/2.
    let angle = 0.5 * (-sign * b + 0.0).atan2(sign * (c - a));
    if angle <= -std::f64::consts::FRAC_PI_2 { angle + std::f64::consts::PI } else { angle }
}

/// Fits an ellipse to points with known moments; `None` for fewer than six points, points on a line, or points that do not
/// determine an ellipse.
///
/// With `D1 = [s^2, s t, t^2]`, `D2 = [s, t, 1]`: `S1 = D1'D1`, `S2 = D1'D2`, `S3 = D2'D2`, `T = -S3^-1 S2'`; the
/// quadratic part is the eigenvector of `C1^-1 (S1 + S2 T)` to its one positive eigenvalue, the rest is `T` times it.
pub fn fit_ellipse(moments: &PlaneMoments) -> Option<Conic> {
    if moments.count() < 6.0 {
        return None;
    }
    let (mean, spread, m) = moments.normalized()?;
    let linear = linear_part(&m)?;
    let scatter = reduced_scatter(&m, &linear);
    let quadratic = ellipse_eigenvector(&scatter)?;
    let rest = linear * quadratic;
    let coefficients = [quadratic.x, quadratic.y, quadratic.z, rest.x, rest.y, rest.z];
    Some(Conic { origin: mean, coefficients }.scaled(spread))
}

/// `T = -S3^-1 S2'` of moments with mean zero, where S3 falls into a 2x2 block and a one.
fn linear_part(m: &PlaneMoments) -> Option<Matrix3<f64>> {
    let (ss, st, tt) = (m.get(2, 0), m.get(1, 1), m.get(0, 2));
    let determinant = ss * tt - st * st;
    // Points on a line, but for rounding. [algorithmic]
    if determinant < 1e-13 {
        return None;
    }
    let solve = |x: f64, y: f64| [(st * y - tt * x) / determinant, (st * x - ss * y) / determinant];
    let columns = [
        solve(m.get(3, 0), m.get(2, 1)), //
        solve(m.get(2, 1), m.get(1, 2)),
        solve(m.get(1, 2), m.get(0, 3)),
    ];
    let [[a, d], [b, e], [c, f]] = columns;
    Some(Matrix3::new(a, b, c, d, e, f, -ss, -st, -tt))
}

/// `S1 + S2 T`, symmetric.
fn reduced_scatter(m: &PlaneMoments, linear: &Matrix3<f64>) -> Matrix3<f64> {
    // The exponents of s and t in D1 and D2.
    let (d1, d2) = ([[2, 0], [1, 1], [0, 2]], [[1, 0], [0, 1], [0, 0]]);
    let products = |d: [[usize; 2]; 3]| Matrix3::from_fn(|i, j| m.get(d1[i][0] + d[j][0], d1[i][1] + d[j][1]));
    let (s1, s2) = (products(d1), products(d2));
    let sum = s1 + s2 * linear;
    (sum + sum.transpose()) * 0.5
}

/// Returns the solution of `S a = lambda C1 a` with `4ac - b^2 > 0`.
///
/// C1 has one positive and two negative eigenvalues, and S has no negative one. So the pencil has exactly one eigenvalue >= 0,
/// the greatest; Newton's iteration from above converges to it without overshooting.
fn ellipse_eigenvector(scatter: &Matrix3<f64>) -> Option<Vector3<f64>> {
    let s = scatter;
    let m = Matrix3::from_rows(&[s.row(2) * 0.5, -s.row(1), s.row(0) * 0.5]);
    let lambda = greatest_eigenvalue(&m);
    let mut shifted = *s;
    shifted[(0, 2)] -= 2.0 * lambda;
    shifted[(2, 0)] -= 2.0 * lambda;
    shifted[(1, 1)] += lambda;
    let vector = null_vector(&shifted)?;
    (4.0 * vector.x * vector.z - vector.y * vector.y > 0.0).then_some(vector)
}

/// Greatest eigenvalue of a 3x3 matrix all of whose eigenvalues are real.
fn greatest_eigenvalue(m: &Matrix3<f64>) -> f64 {
    let trace = m.trace();
    let minors = m[(0, 0)] * m[(1, 1)] - m[(0, 1)] * m[(1, 0)] + m[(0, 0)] * m[(2, 2)] - m[(0, 2)] * m[(2, 0)]
        + m[(1, 1)] * m[(2, 2)]
        - m[(1, 2)] * m[(2, 1)];
    let determinant = m.determinant();
    // Start: Laguerre's bound on the roots of a cubic with three real ones.
    let mut x = (trace + 2.0 * (trace * trace - 3.0 * minors).max(0.0).sqrt()) / 3.0;
    let most_steps = 60; // [algorithmic]
    for _ in 0..most_steps {
        let value = ((x - trace) * x + minors) * x - determinant;
        let slope = (3.0 * x - 2.0 * trace) * x + minors;
        let next = x - value / slope;
        // As near as rounding permits. [algorithmic]
        if !next.is_finite() || next >= x || (x - next) < 1e-15 * x.abs() {
            break;
        }
        x = next;
    }
    x
}

/// The unit vector that a singular symmetric matrix maps to zero: the greatest cross product of two of its rows.
fn null_vector(m: &Matrix3<f64>) -> Option<Vector3<f64>> {
    let rows = [0, 1, 2].map(|i| Vector3::new(m[(i, 0)], m[(i, 1)], m[(i, 2)]));
    let candidates = [rows[0].cross(&rows[1]), rows[1].cross(&rows[2]), rows[2].cross(&rows[0])];
    let best = candidates.into_iter().max_by(|a, b| a.norm_squared().total_cmp(&b.norm_squared()))?;
    best.try_normalize(0.0).filter(|vector| vector.iter().all(|x| x.is_finite()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::MOMENTS;
    use std::f64::consts::{FRAC_PI_2, PI};

    /// Points on an ellipse from one parameter angle to another.
    fn arc(ellipse: &Ellipse, from: f64, to: f64, count: u32) -> Vec<[f64; 2]> {
        let (sin, cos) = ellipse.angle.sin_cos();
        (0..count)
            .map(|i| from + (to - from) * f64::from(i) / f64::from(count - 1))
            .map(|a| (ellipse.semi_axes[0] * a.cos(), ellipse.semi_axes[1] * a.sin()))
            .map(|(x, y)| [ellipse.center[0] + cos * x - sin * y, ellipse.center[1] + sin * x + cos * y])
            .collect()
    }

    fn sample(semi_axes: [f64; 2], angle: f64, center: [f64; 2]) -> Ellipse {
        let (sin, cos) = angle.sin_cos();
        let width = (semi_axes[0] * cos).hypot(semi_axes[1] * sin);
        let depth = (semi_axes[0] * sin).hypot(semi_axes[1] * cos);
        Ellipse { center, semi_axes, angle, half_extents: [width, depth] }
    }

    fn assert_close(found: &Ellipse, expected: &Ellipse, tolerance: f64) {
        let numbers = |e: &Ellipse| {
            // Axes have no sign: an angle of pi/2 equals one of -pi/2.
            let direction = (2.0 * e.angle).sin();
            [e.center[0], e.center[1], e.semi_axes[0], e.semi_axes[1], e.half_extents[0], e.half_extents[1], direction]
        };
        for (x, y) in numbers(found).into_iter().zip(numbers(expected)) {
            assert!((x - y).abs() < tolerance, "{found:?} is not {expected:?}");
        }
    }

    /// Deterministic noise with mean 0 and standard deviation about 1.
    fn noise(i: usize) -> f64 {
        let hash = |n: usize| ((n as f64 * 12.9898).sin() * 43758.5453).rem_euclid(1.0);
        (hash(3 * i + 1) + hash(3 * i + 2) + hash(3 * i + 3) - 1.5) * 2.0
    }

    #[test]
    fn exact_points_give_the_ellipse_back() {
        for (index, angle) in [0.0, 0.4, 1.2, FRAC_PI_2, -0.9].into_iter().enumerate() {
            let truth = sample([0.4, 0.2], angle, [1.0, 3.0 + index as f64]);
            let points = arc(&truth, 0.2, 2.8, 30);
            let moments = PlaneMoments::of(points[0], points);
            let conic = fit_ellipse(&moments).unwrap();
            assert_close(&conic.to_ellipse().unwrap(), &truth, 1e-6);
            assert!(conic.rms(&moments).unwrap() < 1e-8);
        }
    }

    #[test]
    fn a_small_ellipse_far_from_the_origin_is_found() {
        let truth = sample([0.05, 0.04], 0.3, [900.0, -700.0]);
        let points = arc(&truth, 0.0, 4.0, 40);
        let found = fit_ellipse(&PlaneMoments::of(points[0], points)).unwrap().to_ellipse().unwrap();
        assert_close(&found, &truth, 1e-5);
    }

    #[test]
    fn a_whole_noisy_ellipse_is_found_as_in_the_papers_noise_test() {
        let truth = sample([40.0, 20.0], 0.0, [100.0, 50.0]);
        let mut points = arc(&truth, 0.0, 2.0 * PI, 400);
        for (i, point) in points.iter_mut().enumerate() {
            point[0] += 2.0 * noise(2 * i);
            point[1] += 2.0 * noise(2 * i + 1);
        }
        let moments = PlaneMoments::of([100.0, 50.0], points);
        let conic = fit_ellipse(&moments).unwrap();
        let found = conic.to_ellipse().unwrap();
        assert!((found.semi_axes[0] - 40.0).abs() < 1.0 && (found.semi_axes[1] - 20.0).abs() < 1.0, "{found:?}");
        assert!((conic.rms(&moments).unwrap() - 2.0).abs() < 0.3);
    }

    #[test]
    fn degenerate_points_give_no_ellipse_and_no_nan() {
        let line = |i: u32| [f64::from(i) * 0.01, 1.0 + f64::from(i) * 0.02];
        for points in [
            Vec::new(),
            vec![[1.0, 2.0]; 50],
            (0..2).map(line).collect(),
            (0..5).map(line).collect(),
            (0..80).map(line).collect(),
        ] {
            assert_eq!(fit_ellipse(&PlaneMoments::of([0.1, 0.9], points)), None);
        }
        let nan = PlaneMoments::of([0.0, 0.0], (0..9).map(|_| [f64::NAN, 1.0]));
        assert_eq!(fit_ellipse(&nan), None);
    }

    #[test]
    fn points_of_a_hyperbola_still_give_an_ellipse() {
        let points = (-20..=20).map(|i| f64::from(i) * 0.05).map(|x| [x, (1.0 + x * x).sqrt()]);
        let conic = fit_ellipse(&PlaneMoments::of([0.0, 1.0], points)).unwrap();
        assert!(conic.to_ellipse().is_some());
    }

    #[test]
    fn the_distance_of_points_beside_a_circle_is_their_distance() {
        let circle = Conic { origin: [1.0, 2.0], coefficients: [1.0, 0.0, 1.0, 0.0, 0.0, -0.04] };
        let outside = arc(&sample([0.203, 0.203], 0.0, [1.0, 2.0]), 0.0, 3.0, 50);
        let moments = PlaneMoments::of([0.5, 0.5], outside);
        for origin in [[1.0, 2.0], [0.0, 0.0], [1.2, 1.5]] {
            let rms = circle.about(origin).rms(&moments).unwrap();
            assert!((rms - 0.003).abs() < 5e-5, "{rms} with coefficients about {origin:?}");
        }
    }

    #[test]
    fn other_conics_are_no_ellipses() {
        for coefficients in [
            [1.0, 0.0, -1.0, 0.0, 0.0, -1.0],
            [1.0, 0.0, 1.0, 0.0, 0.0, 1.0],
            [1.0, 0.0, 0.0, 0.0, 1.0, 0.0],
            [0.0; 6],
            [f64::NAN; 6],
        ] {
            assert_eq!(Conic { origin: [0.0, 0.0], coefficients }.to_ellipse(), None);
        }
    }

    #[test]
    fn the_sign_of_the_coefficients_does_not_matter() {
        let conic = Conic { origin: [0.0, 0.0], coefficients: [1.0, 0.3, 4.0, 0.0, 0.1, -1.0] };
        let negated = Conic { coefficients: conic.coefficients.map(|x| -x), ..conic };
        assert_close(&negated.to_ellipse().unwrap(), &conic.to_ellipse().unwrap(), 1e-12);
    }

    /// Noisy points of an ellipse that leans, seen on one side.
    fn noisy_arc(semi_axes: [f64; 2], angle: f64, sigma: f64) -> PlaneMoments {
        let points = arc(&sample(semi_axes, angle, [0.3, 1.2]), 0.3, 4.0, 60).into_iter().enumerate();
        PlaneMoments::of([0.1, 1.0], points.map(|(i, [s, t])| [s + sigma * noise(2 * i), t + sigma * noise(2 * i + 1)]))
    }

    #[test]
    fn of_all_conics_of_one_discriminant_the_fit_has_the_least_sum_of_squares() {
        for (angle, sigma) in [(0.5, 0.03), (-1.1, 0.05), (0.8, 0.1), (2.0, 0.1), (0.0, 0.2)] {
            let moments = noisy_arc([0.4, 0.25], angle, sigma);
            let conic = fit_ellipse(&moments).unwrap();
            let cost = |coefficients: [f64; 6]| {
                let [a, b, c, ..] = coefficients;
                Conic { coefficients, ..conic }.square_sum(&moments) / (4.0 * a * c - b * b)
            };
            let best = cost(conic.coefficients);
            let size = conic.coefficients.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
            for (i, h) in (0..6).flat_map(|i| [1e-3, -1e-3, 3e-2, -3e-2].map(|h| (i, h))) {
                let mut other = conic.coefficients;
                other[i] += h * size;
                assert!(cost(other) > best, "{i} by {h}, at {angle}");
            }
        }
    }

    #[test]
    fn five_points_are_too_few_for_an_ellipse_and_six_of_one_give_it() {
        let truth = sample([0.4, 0.2], 0.7, [1.0, 2.0]);
        let some = |count| fit_ellipse(&PlaneMoments::of([1.0, 2.0], arc(&truth, 0.0, 5.0, count)));
        assert_eq!(some(5), None);
        assert_close(&some(6).unwrap().to_ellipse().unwrap(), &truth, 1e-6);
    }

    #[test]
    fn points_on_a_line_of_any_slope_give_no_ellipse() {
        for i in 0..200 {
            let (sin, cos) = (0.0157 * f64::from(i)).sin_cos();
            let line = (0..30).map(|j| 0.013 * f64::from(j)).map(|x| [0.3 + cos * x, 1.1 + sin * x]);
            assert_eq!(fit_ellipse(&PlaneMoments::of([0.5, 1.3], line)), None, "{i}");
        }
    }

    #[test]
    fn a_thin_ellipse_is_found_however_it_leans() {
        for angle in [0.785, -0.785, 0.3, 1.3, -0.2] {
            let truth = sample([0.4, 0.02], angle, [0.3, 1.2]);
            let found = fit_ellipse(&PlaneMoments::of([0.3, 1.2], arc(&truth, 0.0, 5.0, 60))).unwrap();
            assert_close(&found.to_ellipse().unwrap(), &truth, 1e-6);
        }
    }

    #[test]
    fn moments_of_no_points_give_an_ellipse_or_nothing() {
        let mut some = 0;
        for i in 0..400 {
            let mut sums = *noisy_arc([0.4, 0.25], 0.4, 0.05).about([0.3, 1.2]).sums();
            // The correction may subtract more noise than there is.
            (10..MOMENTS).for_each(|k| sums[k] -= 0.02 * (1.0 + noise(MOMENTS * i + k)));
            if let Some(conic) = fit_ellipse(&PlaneMoments::from_sums([0.3, 1.2], sums)) {
                let [a, b, c, ..] = conic.coefficients;
                assert!(4.0 * a * c > b * b, "{conic:?}");
                some += 1;
            }
        }
        assert!((40..360).contains(&some), "{some}");
    }

    #[test]
    fn a_function_has_its_values_and_gradients_wherever_its_coefficients_are_taken() {
        let conic = Conic { origin: [0.4, -0.3], coefficients: [1.3, -0.7, 2.1, 0.4, -0.9, 0.6] };
        let value = |conic: &Conic, [s, t]: [f64; 2]| {
            let (s, t) = (s - conic.origin[0], t - conic.origin[1]);
            conic.coefficients.iter().zip([s * s, s * t, t * t, s, t, 1.0]).map(|(a, b)| a * b).sum::<f64>()
        };
        let points = arc(&sample([0.4, 0.2], 0.7, [1.0, 2.0]), 0.0, 5.0, 20);
        let moved = conic.about([-0.8, 1.7]);
        for point in &points {
            assert!((value(&moved, *point) - value(&conic, *point)).abs() < 1e-12);
        }
        let slope = |[s, t]: [f64; 2]| {
            let difference = |ds, dt| (value(&conic, [s + ds, t + dt]) - value(&conic, [s - ds, t - dt])) / 2e-4;
            difference(1e-4, 0.0).powi(2) + difference(0.0, 1e-4).powi(2)
        };
        let expected: f64 = points.iter().map(|point| slope(*point)).sum();
        let found = conic.gradient_square_sum(&PlaneMoments::of([0.1, 0.2], points));
        assert!((found / expected - 1.0).abs() < 1e-9, "{found} {expected}");
    }

    #[test]
    fn where_no_gradient_is_left_there_is_no_distance() {
        let square = Conic { origin: [0.0, 0.0], coefficients: [1.0, 0.0, 0.0, 0.0, 0.0, 0.0] };
        let mut sums = [0.0; MOMENTS];
        (sums[0], sums[3], sums[10]) = (1.0, -1.0, 4.0);
        assert_eq!(
            square.rms(&PlaneMoments::from_sums([0.0, 0.0], sums)),
            None,
            "more noise was taken off than there was"
        );
        let huge = Conic { origin: [0.0, 0.0], coefficients: [0.0, 0.0, 0.0, 1.0, 0.0, 1e200] };
        assert_eq!(huge.rms(&PlaneMoments::of([0.0, 0.0], [[0.0, 0.0]; 3])), None, "beyond all numbers");
    }

    #[test]
    fn the_angle_is_that_of_the_longer_axis_and_that_of_an_upright_one_is_half_pi() {
        let of = |coefficients| Conic { origin: [0.0, 0.0], coefficients }.to_ellipse().unwrap();
        for angle in [0.0, 0.3, 1.2, 1.57, FRAC_PI_2, -0.3, -1.2, -1.57] {
            let (sin, cos) = f64::sin_cos(angle);
            // ((cos s + sin t) / 2)^2 + (cos t - sin s)^2 = 1
            let (a, b, c) = (cos * cos / 4.0 + sin * sin, 2.0 * sin * cos * (0.25 - 1.0), sin * sin / 4.0 + cos * cos);
            for sign in [1.0, -1.0] {
                let ellipse = of([a, b, c, 0.0, 0.0, -1.0].map(|x| sign * x));
                assert!((ellipse.angle - angle).abs() < 1e-12, "{} {angle}", ellipse.angle);
            }
        }
        for lean in [0.0, -0.0, 1e-300, -1e-300] {
            for sign in [1.0, -1.0] {
                assert_eq!(of([4.0, lean, 1.0, 0.0, 0.0, -1.0].map(|x| sign * x)).angle, FRAC_PI_2, "{lean}");
                assert!(of([1.0, lean, 4.0, 0.0, 0.0, -1.0].map(|x| sign * x)).angle.abs() < 1e-300, "{lean}");
            }
        }
    }
}
