//! Whether two objects are in the same place.
//!
//! A part of an object, such as the lug of a pot or the curve between its rim and its side, may have a shape of its own that
//! explains it. A candidate that lies in a known object, or around it, is such a part; but one that is seen inside of it is
//! another object.

use conicflow_geometry::Vector3;
use conicflow_messages::{Object, ObjectKind};
use nalgebra::Matrix3;

/// Standard deviations by which the middle of one object has to lie inside the other. Objects that stand on each other touch, and
/// a ball that a can cuts off has its middle where the can ends.
const INSIDE_SIGMAS: f64 = 3.0; // [sigmas]

/// Returns whether the middle of one of two objects surely lies in the other, unless the candidate is seen inside of the known
/// object: a fruit in a bowl shows that the bowl is hollow. If the known object lies inside the candidate, it explains the
/// candidate.
pub(crate) fn overlap(known: &Object, candidate: &Object) -> bool {
    let middle = |object: &Object| Vector3::from(object.center);
    let is_in_it = holds(known, candidate, middle(candidate));
    let is_content = is_in_it && holds(known, candidate, front(candidate));
    (is_in_it || holds(candidate, known, middle(known))) && !is_content
}

/// Returns the point of an object's surface, at its middle, that is nearest to the camera.
fn front(object: &Object) -> Vector3 {
    let (middle, axis) = (Vector3::from(object.center), Vector3::from(object.axis));
    let across = middle - axis * middle.dot(&axis);
    middle - across.try_normalize(0.0).unwrap_or_default() * object.radius
}

/// Returns whether this point of `inner` surely lies in `outer`: at least [`INSIDE_SIGMAS`] standard deviations away from each
/// surface of `outer`.
fn holds(outer: &Object, inner: &Object, point: Vector3) -> bool {
    let covariance = [outer, inner].map(|object| Matrix3::from(object.sigma.center)).iter().sum::<Matrix3<f64>>();
    let away = point - Vector3::from(outer.center);
    let is_deep = |depth: f64, along: Vector3, sigma: f64| {
        let variance = along.dot(&(covariance * along)) + sigma * sigma;
        depth > INSIDE_SIGMAS * variance.sqrt()
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

    /// An object of this shape and radius with its middle at `center`, known to a millimetre. A cylinder or cone is 0.2 m long,
    /// along y.
    fn thing(kind: ObjectKind, radius: f64, center: [f64; 3]) -> Object {
        let covariance = Matrix3::from_diagonal_element(1e-6).into();
        let sigma = ObjectSigma { center: covariance, radius: 1e-3, length: 2e-3, ..ObjectSigma::default() };
        let axis = if kind == ObjectKind::Sphere { [0.0; 3] } else { [0.0, 1.0, 0.0] };
        Object { kind: kind.code(), radius, center, axis, length: 0.2, sigma, ..Object::default() }
    }

    #[test]
    fn one_thing_is_in_another_if_its_middle_is_deeper_in_it_than_noise_explains() {
        // Three standard deviations of a millimetre each add up to 1.7 mm; three times that is 5.2 mm.
        let ball = |z: f64| thing(ObjectKind::Sphere, 0.05, [0.0, 0.0, z]);
        let can = |center: [f64; 3]| thing(ObjectKind::Cylinder, 0.1, center);
        for (one, other, overlaps) in [
            (ball(0.95), can([0.0, 0.0, 1.0]), true),
            (ball(0.906), can([0.0, 0.0, 1.0]), true),
            (ball(0.904), can([0.0, 0.0, 1.0]), false),
            (ball(0.95), can([0.0, 0.094, 1.0]), true),
            (ball(0.95), can([0.0, 0.096, 1.0]), false),
            (ball(0.906), thing(ObjectKind::Sphere, 0.1, [0.0, 0.0, 1.0]), true),
            (ball(0.904), thing(ObjectKind::Sphere, 0.1, [0.0, 0.0, 1.0]), false),
        ] {
            assert_eq!(overlap(&other, &one), overlaps, "{one:?} {other:?}");
        }
        let mut unsure = ball(0.95);
        unsure.sigma.center = Matrix3::from_diagonal_element(1e-3).into();
        assert!(!overlap(&unsure, &can([0.0, 0.0, 1.0])));
    }

    #[test]
    fn what_is_surely_seen_inside_of_another_thing_is_none_of_its_parts() {
        for outer in [ObjectKind::Sphere, ObjectKind::Cylinder].map(|kind| thing(kind, 0.1, [0.0, 0.0, 1.0])) {
            for inner in [ObjectKind::Sphere, ObjectKind::Cylinder] {
                // Its front is 4 mm, or 6 mm, behind that of the other object.
                for (radius, overlaps) in [(0.096, true), (0.094, false)] {
                    let inner = Object { length: 0.02, ..thing(inner, radius, [0.0, 0.0, 1.0]) };
                    assert_eq!([overlap(&outer, &inner), overlap(&inner, &outer)], [overlaps, true], "{inner:?}");
                }
            }
        }
    }

    #[test]
    fn the_front_of_what_leans_away_lies_across_its_axis() {
        let leaning = Object { axis: [0.0, 0.6, 0.8], ..thing(ObjectKind::Cylinder, 0.1, [0.0, 0.0, 1.0]) };
        assert!((front(&leaning) - Vector3::new(0.0, 0.08, 0.94)).norm() < 1e-12, "{}", front(&leaning));
        assert_eq!(front(&thing(ObjectKind::Sphere, 0.1, [0.0, 0.0, 1.0])), Vector3::new(0.0, 0.0, 0.9));
    }

    #[test]
    fn a_cone_is_as_wide_as_it_is_at_that_height() {
        let cone = Object { half_angle: 0.5, ..thing(ObjectKind::Cone, 0.06, [0.0, 0.0, 1.0]) };
        let at = |y: f64| overlap(&cone, &thing(ObjectKind::Sphere, 0.07, [0.06, y, 1.0]));
        assert_eq!([at(0.05), at(-0.05)], [true, false]);
    }
}
