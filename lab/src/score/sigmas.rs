//! Errors of an answer in units of its reported standard deviations.

use super::matching::{compare, perpendicular, radius_at};
use conicflow_messages::Object;
use nalgebra::{Matrix3, Vector3};

/// Errors in units of their standard deviations: each has the mean square 1 if these are correct. `None` for parameters that the
/// shape does not have, or without a standard deviation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sigmas {
    /// Of the radius; of a cone, at the middle of its visible part.
    pub radius: Option<f64>,
    /// Of the centre, per coordinate; of cylinders and cones, across the axis.
    pub center: Option<f64>,
    /// Of the axis, as an angle.
    pub axis: Option<f64>,
    /// Of the half-angle.
    pub half_angle: Option<f64>,
}

impl Sigmas {
    /// Returns the errors of an answer that has the true shape.
    pub fn of(truth: &Object, answer: &Object) -> Self {
        let (errors, sigma, shape) = (compare(truth, answer), &answer.sigma, truth.shape());
        let mut sigmas = Self {
            radius: ratio(answer.radius - radius_at(truth, &answer.center.into()), sigma.radius),
            center: center_ratio(truth, answer),
            ..Self::default()
        };
        if shape.has_axis() {
            sigmas.axis = ratio(errors.axis, sigma.axis);
        }
        if shape.has_half_angle() {
            sigmas.half_angle = ratio(errors.half_angle, sigma.half_angle);
        }
        sigmas
    }
}

fn ratio(error: f64, sigma: f64) -> Option<f64> {
    (sigma > 0.0).then(|| error / sigma)
}

/// Returns the root of `d' C^-1 d / n`. `d` is the error of the centre, for cylinders and cones without its part along the true
/// axis, and `n` is the number of remaining coordinates.
fn center_ratio(truth: &Object, answer: &Object) -> Option<f64> {
    let offset = Vector3::from(answer.center) - Vector3::from(truth.center);
    let covariance = Matrix3::from(answer.sigma.center).transpose();
    if !truth.shape().has_axis() {
        return mahalanobis_squared(&covariance, &offset).map(|square| (square / 3.0).sqrt());
    }
    let axis = Vector3::from(truth.axis);
    let projection = Matrix3::identity() - axis * axis.transpose();
    // the error along the axis is 0, so that any variance will do there
    let trace = covariance.trace();
    let across = projection * covariance * projection + axis * axis.transpose() * trace;
    mahalanobis_squared(&across, &perpendicular(&offset, &axis)).map(|square| (square / 2.0).sqrt())
}

fn mahalanobis_squared(covariance: &Matrix3<f64>, offset: &Vector3<f64>) -> Option<f64> {
    Some(covariance.cholesky()?.solve(offset).dot(offset))
}

#[cfg(test)]
mod tests {
    use super::super::matching::tests::{cone, sphere};
    use super::*;
    use conicflow_messages::{ObjectKind, ObjectSigma};

    fn variances(numbers: [f64; 3]) -> [[f64; 3]; 3] {
        [[numbers[0], 0.0, 0.0], [0.0, numbers[1], 0.0], [0.0, 0.0, numbers[2]]]
    }

    #[test]
    fn a_sphere_has_no_axis_and_its_errors_are_weighed() {
        let sigma = ObjectSigma { center: variances([1e-4, 1e-6, 1e-6]), radius: 0.002, ..ObjectSigma::default() };
        let answer = Object { center: [0.02, 0.001, 1.0], radius: 0.101, sigma, ..sphere(0.0) };
        assert!((compare(&sphere(0.0), &answer).radius_m - 0.101).abs() < 1e-12);
        let sigmas = Sigmas::of(&sphere(0.0), &answer);
        assert!((sigmas.radius.unwrap() - 0.5).abs() < 1e-12);
        assert!((sigmas.center.unwrap() - ((4.0 + 1.0) / 3.0_f64).sqrt()).abs() < 1e-12);
        assert_eq!((sigmas.axis, sigmas.half_angle), (None, None));
    }

    #[test]
    fn a_cone_is_judged_across_its_axis_and_at_its_own_height() {
        let sigma =
            ObjectSigma { center: variances([4e-6, 1.0, 1e-6]), radius: 0.001, axis: 0.01, ..Default::default() };
        let answer = Object { center: [0.002, 0.05, 1.001], radius: 0.107, sigma, ..cone() };
        assert!((compare(&cone(), &answer).radius_m - 0.102).abs() < 1e-12, "0.107 - 0.05 * 0.1");
        let sigmas = Sigmas::of(&cone(), &answer);
        assert!((sigmas.radius.unwrap() - 2.0).abs() < 1e-9);
        assert!((sigmas.center.unwrap() - 1.0).abs() < 1e-9);
        assert_eq!(sigmas.axis, Some(0.0));
        assert_eq!(sigmas.half_angle, None, "no standard deviation came with it");
    }

    #[test]
    fn a_half_angle_is_judged_of_cones_alone_and_an_axis_of_all_that_have_one() {
        let sigma = ObjectSigma { half_angle: 0.01, axis: 0.1, ..ObjectSigma::default() };
        let wider =
            Object { half_angle: cone().half_angle + 0.02, axis: [0.0, 0.2_f64.cos(), 0.2_f64.sin()], sigma, ..cone() };
        let cylinder = |object: Object| Object { kind: ObjectKind::Cylinder.code(), ..object };
        let tapered = Sigmas::of(&cone(), &wider);
        assert!((tapered.half_angle.unwrap() - 2.0).abs() < 1e-9 && (tapered.axis.unwrap() - 2.0).abs() < 1e-9);
        let straight = Sigmas::of(&cylinder(cone()), &cylinder(wider));
        assert!(straight.half_angle.is_none() && (straight.axis.unwrap() - 2.0).abs() < 1e-9);
    }

    /// The errors across and along the axis are correlated, as for a cone with one end more visible than the other.
    #[test]
    fn what_is_unsure_along_the_axis_does_not_count_across_it() {
        let center = [[4e-6, 3e-5, 0.0], [3e-5, 4e-4, 1e-5], [0.0, 1e-5, 1e-6]];
        let sigma = ObjectSigma { center, ..ObjectSigma::default() };
        let answer = Object { center: [0.002, 0.3, 1.001], sigma, ..cone() };
        assert!((Sigmas::of(&cone(), &answer).center.unwrap() - 1.0).abs() < 1e-9);
    }

    #[test]
    fn an_answer_without_covariance_is_not_judged_by_it() {
        assert_eq!(Sigmas::of(&sphere(0.0), &sphere(0.01)).center, None);
    }
}
