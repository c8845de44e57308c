//! How far a right answer is off, and how that compares with the standard deviations it came with.

use super::matching::{compare, perpendicular, radius_at};
use conicflow_messages::{Object, ObjectKind};
use nalgebra::{Matrix3, Vector3};

/// Errors of an answer; those of parameters that a shape does not have are `None`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Errors {
    /// Radius (of a cone at its true middle) minus the true one, as a share of the true one.
    pub radius: f64,
    /// The same in metres.
    pub radius_m: f64,
    /// Distance of the centres of spheres, else of the true middle from the axis, in metres.
    pub position_m: f64,
    /// Angle between the axes, in radians.
    pub axis: Option<f64>,
    /// Difference of the half-angles, in radians.
    pub half_angle: Option<f64>,
    /// Errors in units of their standard deviations.
    pub sigmas: Sigmas,
}

/// Errors in units of the standard deviations that came with the answer: each has the mean square 1 if these are honest.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Sigmas {
    /// Of the radius, of a cone at the middle of its visible part.
    pub radius: Option<f64>,
    /// Of the centre, per coordinate; of cylinders and cones across the axis.
    pub center: Option<f64>,
    /// Of the axis, as an angle.
    pub axis: Option<f64>,
    /// Of the half-angle.
    pub half_angle: Option<f64>,
}

impl Errors {
    /// The errors of an answer that has the true shape.
    pub fn of(truth: &Object, answer: &Object) -> Self {
        let comparison = compare(truth, answer);
        let shape = truth.shape();
        let axis = (shape != ObjectKind::Sphere).then_some(comparison.axis);
        let half_angle = (shape == ObjectKind::Cone).then_some(comparison.half_angle);
        let sigma = &answer.sigma;
        let radius_there = radius_at(truth, &answer.center.into());
        Self {
            radius: comparison.radius_m / truth.radius - 1.0,
            radius_m: comparison.radius_m - truth.radius,
            position_m: comparison.position_m,
            axis,
            half_angle,
            sigmas: Sigmas {
                radius: ratio(answer.radius - radius_there, sigma.radius),
                center: center_ratio(truth, answer),
                axis: axis.and_then(|angle| ratio(angle, sigma.axis)),
                half_angle: half_angle.and_then(|angle| ratio(angle, sigma.half_angle)),
            },
        }
    }
}

fn ratio(error: f64, sigma: f64) -> Option<f64> {
    (sigma > 0.0).then(|| error / sigma)
}

/// Root of `d' C^-1 d / n`, where `d` is the error of the centre, of cylinders and cones without its part along the true
/// axis, and `n` the number of coordinates that are left.
fn center_ratio(truth: &Object, answer: &Object) -> Option<f64> {
    let offset = Vector3::from(answer.center) - Vector3::from(truth.center);
    let covariance = Matrix3::from(answer.sigma.center).transpose();
    if truth.shape() == ObjectKind::Sphere {
        return mahalanobis_squared(&covariance, &offset).map(|square| (square / 3.0).sqrt());
    }
    let axis = Vector3::from(truth.axis);
    let projection = Matrix3::identity() - axis * axis.transpose();
    // along the axis the error is 0, so that any variance may stand there
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
    use conicflow_messages::ObjectSigma;

    fn variances(numbers: [f64; 3]) -> [[f64; 3]; 3] {
        [[numbers[0], 0.0, 0.0], [0.0, numbers[1], 0.0], [0.0, 0.0, numbers[2]]]
    }

    #[test]
    fn a_sphere_has_no_axis_and_its_errors_are_weighed() {
        let sigma = ObjectSigma { center: variances([1e-4, 1e-6, 1e-6]), radius: 0.002, ..ObjectSigma::default() };
        let answer = Object { center: [0.02, 0.001, 1.0], radius: 0.101, sigma, ..sphere(0.0) };
        let errors = Errors::of(&sphere(0.0), &answer);
        assert!((errors.radius - 0.01).abs() < 1e-12);
        assert!((errors.sigmas.radius.unwrap() - 0.5).abs() < 1e-12);
        assert!((errors.sigmas.center.unwrap() - ((4.0 + 1.0) / 3.0_f64).sqrt()).abs() < 1e-12);
        assert_eq!((errors.axis, errors.half_angle, errors.sigmas.axis), (None, None, None));
    }

    #[test]
    fn a_cone_is_judged_across_its_axis_and_at_its_own_height() {
        let sigma =
            ObjectSigma { center: variances([4e-6, 1.0, 1e-6]), radius: 0.001, axis: 0.01, ..Default::default() };
        let answer = Object { center: [0.002, 0.05, 1.001], radius: 0.107, sigma, ..cone() };
        let errors = Errors::of(&cone(), &answer);
        assert!((errors.radius - 0.02).abs() < 1e-12, "0.107 - 0.05 * 0.1 is 2 % above 0.1");
        assert!((errors.sigmas.radius.unwrap() - 2.0).abs() < 1e-9);
        assert!((errors.sigmas.center.unwrap() - 1.0).abs() < 1e-9);
        assert_eq!(errors.sigmas.axis, Some(0.0));
        assert_eq!(errors.sigmas.half_angle, None, "no standard deviation came with it");
    }

    #[test]
    fn an_answer_without_covariance_is_not_judged_by_it() {
        assert_eq!(Errors::of(&sphere(0.0), &sphere(0.01)).sigmas.center, None);
    }
}
