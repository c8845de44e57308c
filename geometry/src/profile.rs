//! Radius over position along the axis, the paper's (z, r) space: a straight line is a cylinder or a cone, a circle with its
//! centre on the z axis is a sphere.
//!
//! Both fits use the same moments of the pairs `(z, r)`, so one more section costs O(1).

use crate::{Fit, PlaneMoments};

/// The semicircle `r = sqrt(R^2 - (z - z0)^2)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CircleProfile {
    /// z of the centre.
    pub center: f64,
    /// Radius R.
    pub radius: f64,
    /// Root mean square distance of the pairs from the circle, with two degrees of freedom taken off.
    pub rms: f64,
    /// Standard error of `center`.
    pub center_sigma: f64,
    /// Standard error of `radius`.
    pub radius_sigma: f64,
}

impl CircleProfile {
    /// The radius of the section at `z`, zero beyond the poles.
    pub fn at(&self, z: f64) -> f64 {
        (self.radius * self.radius - (z - self.center).powi(2)).max(0.0).sqrt()
    }
}

/// Least squares of `r = value + slope (z - at)`; `None` for fewer than three pairs or no extent along z.
pub fn fit_line_profile(pairs: &PlaneMoments) -> Option<Fit> {
    let (n, mean) = (pairs.count(), pairs.mean()?);
    let [zz, zr, rr] = pairs.about(mean).covariance()?;
    if n < 3.0 || zz.is_nan() || zz <= 0.0 {
        return None;
    }
    let slope = zr / zz;
    let rms = ((rr - slope * zr).max(0.0) * n / (n - 2.0)).sqrt();
    let (value_sigma, slope_sigma) = (rms / n.sqrt(), rms / (n * zz).sqrt());
    Some(Fit { middle: mean[0], value: mean[1], slope, rms, value_sigma, slope_sigma })
}

/// Least squares of `z^2 + r^2 = 2 z0 z + K`, linear in `z0` and `K = R^2 - z0^2`; `None` for fewer than three pairs or
/// no extent along z.
pub fn fit_circle_profile(pairs: &PlaneMoments) -> Option<CircleProfile> {
    let n = pairs.count();
    // Moves the origin to the mean of z; r still counts from the axis.
    let at = pairs.mean()?[0];
    let m = pairs.about([at, 0.0]);
    let zz = m.get(2, 0);
    if n < 3.0 || zz.is_nan() || zz <= 0.0 {
        return None;
    }
    let square_mean = (zz + m.get(0, 2)) / n;
    let center = (m.get(3, 0) + m.get(1, 2)) / (2.0 * zz);
    let radius = (square_mean + center * center).sqrt();
    let total = m.get(4, 0) + 2.0 * m.get(2, 2) + m.get(0, 4);
    let residual = (total - n * square_mean * square_mean - 4.0 * center * center * zz).max(0.0);
    // The algebraic residual is 2 R times the distance.
    let rms = (residual / (n - 2.0)).sqrt() / (2.0 * radius);
    let center_sigma = rms * radius / zz.sqrt();
    // From R^2 = K + z0^2, about the mean of z, where K and z0 are independent.
    let radius_sigma = (rms / n.sqrt()).hypot(center / radius * center_sigma);
    let finite = radius.is_finite() && center.is_finite() && radius > 0.0;
    finite.then_some(CircleProfile { center: at + center, radius, rms, center_sigma, radius_sigma })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Regression;
    use crate::simulated::Random;

    fn pairs(radius: impl Fn(f64) -> f64) -> PlaneMoments {
        PlaneMoments::of([0.5, 0.1], (0..30).map(|i| 0.4 + 0.01 * f64::from(i)).map(|z| [z, radius(z)]))
    }

    #[test]
    fn a_cylinder_is_constant_and_a_cone_slopes() {
        let cylinder = fit_line_profile(&pairs(|_| 0.2)).unwrap();
        assert!((cylinder.value - 0.2).abs() < 1e-12 && cylinder.slope.abs() < 1e-9 && cylinder.rms < 1e-6);
        let cone = fit_line_profile(&pairs(|z| 0.25 * (z - 0.1))).unwrap();
        assert!((cone.slope - 0.25).abs() < 1e-9 && (cone.at(0.1)).abs() < 1e-9);
    }

    #[test]
    fn a_sphere_is_a_circle_about_the_axis() {
        let sphere = fit_circle_profile(&pairs(|z| (0.09 - (z - 0.6_f64).powi(2)).sqrt())).unwrap();
        assert!((sphere.center - 0.6).abs() < 1e-9 && (sphere.radius - 0.3).abs() < 1e-9, "{sphere:?}");
        assert!(sphere.rms < 1e-6 && (sphere.at(0.6) - 0.3).abs() < 1e-9 && sphere.at(5.0) == 0.0);
    }

    #[test]
    fn each_explains_the_other_badly() {
        assert!(fit_line_profile(&pairs(|z| (0.04 - (z - 0.5_f64).powi(2)).sqrt())).unwrap().rms > 5e-3);
        assert!(fit_circle_profile(&pairs(|z| 0.05 + 0.5 * (z - 0.4))).unwrap().rms > 2e-3);
    }

    #[test]
    fn errors_are_those_of_the_noise() {
        let noisy = pairs(|z| (0.09 - (z - 0.6_f64).powi(2)).sqrt() + 0.002 * (z * 937.0).sin());
        let sphere = fit_circle_profile(&noisy).unwrap();
        assert!((sphere.radius - 0.3).abs() < 4.0 * sphere.radius_sigma + 1e-3, "{sphere:?}");
        assert!(sphere.rms > 5e-4 && sphere.rms < 3e-3);
    }

    /// The radius of a cap depends on the estimate of its centre.
    #[test]
    fn the_sigma_of_the_radius_of_a_cap_is_that_of_its_errors() {
        let mut random = Random(3);
        let mut cap = || {
            let z = |i: u32| -0.005 + 0.125 * f64::from(i) / 39.0;
            let points = (0..40).map(|i| [z(i), (0.0225 - z(i).powi(2)).sqrt() + 0.002 * random.normal()]);
            fit_circle_profile(&PlaneMoments::of([0.0, 0.0], points)).unwrap()
        };
        let ratios = (0..200).map(|_| cap()).map(|fit| ((fit.radius - 0.15) / fit.radius_sigma).powi(2));
        let ratio = (ratios.sum::<f64>() / 200.0).sqrt();
        assert!((0.8..1.25).contains(&ratio), "{ratio}");
    }

    #[test]
    fn neither_sections_at_one_place_nor_two_of_them_have_a_profile() {
        for sections in [&[[0.0, 0.2]; 6][..], &[[0.0, 0.2], [1.0, 0.2]], &[[0.0, 0.2], [1.0, 0.3]]] {
            let moments = PlaneMoments::of([0.0, 0.0], sections.iter().copied());
            assert_eq!(fit_line_profile(&moments), None);
            assert_eq!(fit_circle_profile(&moments), None);
        }
    }

    #[test]
    fn a_line_profile_is_the_regression_of_the_radius_over_the_place() {
        for count in [3, 4, 9, 30] {
            let pairs: Vec<_> = (0..count)
                .map(|i| 0.4 + 0.01 * f64::from(i))
                .map(|z| [z, 0.1 + 0.3 * z + 0.02 * (937.0 * z).sin()])
                .collect();
            let mut sums = Regression::default();
            pairs.iter().for_each(|[z, r]| sums.add(*z, *r));
            let numbers = |fit: Fit| [fit.middle, fit.value, fit.slope, fit.rms, fit.value_sigma, fit.slope_sigma];
            let found = numbers(fit_line_profile(&PlaneMoments::of([0.5, 0.1], pairs)).unwrap());
            for (a, b) in found.into_iter().zip(numbers(sums.fit().unwrap())) {
                assert!((a - b).abs() < 1e-9, "{a} {b} of {count}");
            }
        }
    }

    #[test]
    fn the_mean_square_distance_from_a_circle_of_few_sections_is_that_of_their_noise() {
        for count in [3_u32, 6, 12] {
            let mut random = Random(11);
            let mut square = || {
                let z = |i: u32| -0.12 + 0.24 * f64::from(i) / f64::from(count - 1);
                let points = (0..count).map(|i| [z(i), (0.0225 - z(i).powi(2)).sqrt()]);
                // Noise across the circle.
                let noisy =
                    points.map(|point| (point, 1.0 + 0.001 * random.normal() / 0.15)).map(|([z, r], g)| [g * z, g * r]);
                fit_circle_profile(&PlaneMoments::of([0.0, 0.0], noisy)).unwrap().rms.powi(2)
            };
            let mean = (0..2000).map(|_| square()).sum::<f64>() / 2000.0;
            assert!((mean / 1e-6 - 1.0).abs() < 0.1, "{mean} of {count}");
        }
    }

    #[test]
    fn what_is_beyond_all_numbers_is_no_circle() {
        let far = PlaneMoments::of([0.0, 0.0], [[0.0, 1e100], [1.0, 2e100], [2.0, 5e100]]);
        assert_eq!(fit_circle_profile(&far), None);
    }
}
