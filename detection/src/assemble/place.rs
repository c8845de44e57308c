//! Whether two objects would be in one place.
//!
//! A part of a thing, such as the lug of a pot or the curve between its rim and its side, may have a shape of its own that explains
//! it. Where that would lie in what is known to be an object, or about it, it is none.

use conicflow_geometry::Vector3;
use conicflow_messages::{Object, ObjectKind};
use nalgebra::Matrix3;

/// Standard deviations by which the middle of one lies in the other. Things that stand on each other touch, and a ball that is cut off
/// by a can has its middle where the can ends.
const WITHIN: f64 = 3.0; // [sigmas]

/// Whether the middle of one of two objects surely lies in the other.
pub(crate) fn overlap(one: &Object, other: &Object) -> bool {
    holds(one, other) || holds(other, one)
}

/// Whether the middle of `inner` surely lies in `outer`: each surface of that is so many standard deviations away from it.
fn holds(outer: &Object, inner: &Object) -> bool {
    let covariance = [outer, inner].map(|object| Matrix3::from(object.sigma.center)).iter().sum::<Matrix3<f64>>();
    let away = Vector3::from(inner.center) - Vector3::from(outer.center);
    let is_deep = |depth: f64, along: Vector3, sigma: f64| {
        let variance = along.dot(&(covariance * along)) + sigma * sigma;
        depth > WITHIN * variance.sqrt()
    };
    let is_in_side = |radius: f64, across: Vector3| {
        let direction = across.try_normalize(0.0).unwrap_or_default();
        is_deep(radius - across.norm(), direction, outer.sigma.radius)
    };
    if outer.shape() == ObjectKind::Sphere {
        return is_in_side(outer.radius, away);
    }
    let axis = Vector3::from(outer.axis);
    let along = away.dot(&axis);
    let radius = outer.radius + along * outer.half_angle.tan();
    let is_between_ends = is_deep(0.5 * outer.length - along.abs(), axis, 0.5 * outer.sigma.length);
    is_between_ends && is_in_side(radius, away - axis * along)
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::ObjectSigma;

    /// One of this shape and radius with its middle there, known to a millimetre; what has an axis is 0.2 m long, along y.
    fn thing(kind: ObjectKind, radius: f64, center: [f64; 3]) -> Object {
        let covariance = Matrix3::from_diagonal_element(1e-6).into();
        let sigma = ObjectSigma { center: covariance, radius: 1e-3, length: 2e-3, ..ObjectSigma::default() };
        let axis = if kind == ObjectKind::Sphere { [0.0; 3] } else { [0.0, 1.0, 0.0] };
        Object { kind: kind.code(), radius, center, axis, length: 0.2, sigma, ..Object::default() }
    }

    #[test]
    fn one_thing_is_in_another_if_its_middle_is_deeper_in_it_than_noise_explains() {
        // The deviation of three of a millimetre each together is 1.7 mm, three times that 5.2 mm.
        let ball = thing(ObjectKind::Sphere, 0.01, [0.0; 3]);
        let can = |center: [f64; 3]| thing(ObjectKind::Cylinder, 0.1, center);
        for (other, overlaps) in [
            (can([0.0; 3]), true),
            (can([0.094, 0.0, 0.0]), true),
            (can([0.096, 0.0, 0.0]), false),
            (can([0.0, 0.094, 0.0]), true),
            (can([0.0, 0.096, 0.0]), false),
            (thing(ObjectKind::Sphere, 0.1, [0.0, 0.0, 0.094]), true),
            (thing(ObjectKind::Sphere, 0.1, [0.0, 0.0, 0.096]), false),
        ] {
            assert_eq!([overlap(&ball, &other), overlap(&other, &ball)], [overlaps; 2], "{other:?}");
        }
        let mut unsure = ball;
        unsure.sigma.center = Matrix3::from_diagonal_element(1e-3).into();
        assert!(!overlap(&unsure, &can([0.05, 0.0, 0.0])));
    }

    #[test]
    fn a_cone_is_as_wide_as_it_is_at_that_height() {
        let cone = Object { half_angle: 0.5, ..thing(ObjectKind::Cone, 0.06, [0.0; 3]) };
        let at = |y: f64| overlap(&cone, &thing(ObjectKind::Sphere, 0.01, [0.06, y, 0.0]));
        assert_eq!([at(0.05), at(-0.05)], [true, false]);
    }
}
