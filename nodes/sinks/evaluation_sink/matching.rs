//! Which answer is right about which true object.
//!
//! An answer is right if its shape is the true one and position, radius, axis and half-angle are within the tolerance:
//! of a sphere the distance of the centres; else the distance of the true middle from the answer's axis, and the radii
//! there. Pairs are taken one to one, the nearest first.

use conicflow_messages::{Object, ObjectKind};
use nalgebra::Vector3;

/// How far an answer may be off.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Tolerance {
    /// Distance, in metres.
    pub position_m: f64,
    /// Least and greatest radius, in metres; of a cone at its true middle.
    pub radius_m: [f64; 2],
    /// Angle between the axes, in radians.
    pub axis: f64,
    /// Difference of the half-angles, in radians.
    pub half_angle: f64,
}

/// A true object, and what a detector owes it.
#[derive(Clone, Debug)]
pub struct Expected {
    /// Its name in the scene.
    pub name: String,
    /// All of it: `center` is its middle.
    pub body: Object,
    /// Share of it that cannot be seen.
    pub hidden: f64,
    /// Whether it must be found; else a right answer is neither counted nor held against the detector.
    pub required: bool,
    /// What counts as right.
    pub tolerance: Tolerance,
}

/// What an answer and a true object have to do with each other.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Comparison {
    /// Distance in metres: of the centres of spheres, else of the true middle from the answer's axis.
    pub position_m: f64,
    /// Radius of the answer, of a cone at the true middle.
    pub radius_m: f64,
    /// Angle between the axes, in radians; 0 of spheres.
    pub axis: f64,
    /// Half-angle of the answer minus the true one, in radians.
    pub half_angle: f64,
}

/// Why an answer is not right about an object.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fault {
    /// It is right, but another answer was nearer.
    Second,
    /// The half-angle is off.
    HalfAngle,
    /// The radius is off.
    Radius,
    /// The axis is off.
    Axis,
    /// Another shape is there.
    Shape,
    /// An object is there, but its middle is elsewhere.
    Position,
    /// There is no such object.
    NothingThere,
}

impl Fault {
    /// All of them.
    pub const ALL: [Self; 7] =
        [Self::Second, Self::HalfAngle, Self::Radius, Self::Axis, Self::Shape, Self::Position, Self::NothingThere];

    /// The words for it.
    pub const fn name(self) -> &'static str {
        match self {
            Self::Second => "second answer",
            Self::HalfAngle => "half-angle",
            Self::Radius => "radius",
            Self::Axis => "axis",
            Self::Shape => "other shape",
            Self::Position => "position",
            Self::NothingThere => "nothing there",
        }
    }
}

fn vector(numbers: [f64; 3]) -> Vector3<f64> {
    numbers.into()
}

/// Radius of an object at the foot of a point on its axis.
pub fn radius_at(object: &Object, point: &Vector3<f64>) -> f64 {
    let along = (point - vector(object.center)).dot(&vector(object.axis));
    object.radius + along * object.half_angle.tan()
}

/// The part of an offset that is perpendicular to a unit vector.
pub fn perpendicular(offset: &Vector3<f64>, axis: &Vector3<f64>) -> Vector3<f64> {
    offset - axis * offset.dot(axis)
}

/// Compares an answer with the truth; shapes may differ.
pub fn compare(truth: &Object, answer: &Object) -> Comparison {
    let (middle, center) = (vector(truth.center), vector(answer.center));
    let (true_axis, axis) = (vector(truth.axis), vector(answer.axis));
    let cosine = true_axis.dot(&axis);
    // the axis of a cone has a sense, that of a cylinder has none
    let both_cones = truth.shape() == ObjectKind::Cone && answer.shape() == ObjectKind::Cone;
    let cosine = if both_cones { cosine } else { cosine.abs() };
    let sine = true_axis.cross(&axis).norm();
    Comparison {
        position_m: perpendicular(&(middle - center), &axis).norm(),
        radius_m: radius_at(answer, &middle),
        axis: if sine == 0.0 && cosine == 0.0 { 0.0 } else { sine.atan2(cosine) },
        half_angle: answer.half_angle - truth.half_angle,
    }
}

/// Why an answer is not right about a true object; `None`: it is right.
pub fn fault(expected: &Expected, answer: &Object) -> Option<Fault> {
    let Tolerance { position_m, radius_m: [least, most], axis, half_angle } = expected.tolerance;
    let comparison = compare(&expected.body, answer);
    let wrong_shape = answer.shape() != expected.body.shape();
    if wrong_shape || comparison.position_m >= position_m {
        let fault = if wrong_shape { Fault::Shape } else { Fault::Position };
        Some(if is_near(&expected.body, answer) { fault } else { Fault::NothingThere })
    } else if comparison.axis >= axis {
        Some(Fault::Axis)
    } else if !(least..=most).contains(&comparison.radius_m) {
        Some(Fault::Radius)
    } else if comparison.half_angle.abs() >= half_angle {
        Some(Fault::HalfAngle)
    } else {
        None
    }
}

/// Whether the middle of an answer lies within a true object, or next to it.
fn is_near(truth: &Object, answer: &Object) -> bool {
    const MARGIN_M: f64 = 0.05;
    let offset = vector(answer.center) - vector(truth.center);
    let axis = vector(truth.axis);
    let beyond_end = offset.dot(&axis).abs() - 0.5 * truth.length;
    let widest = truth.radius.max(truth.base_radius);
    perpendicular(&offset, &axis).norm() < widest + MARGIN_M && beyond_end < MARGIN_M
}

/// The outcome of a frame: for each true object the answer that is right about it, for each other answer why it is not
/// right about any.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Matching {
    /// As many as there are true objects: index of the answer.
    pub answer_of: Vec<Option<usize>>,
    /// The answers that are right about nothing.
    pub wrong: Vec<(usize, Fault)>,
}

/// Matches answers and true objects, one to one, the nearest pair first.
pub fn match_up(expected: &[Expected], answers: &[Object]) -> Matching {
    let mut pairs = Vec::new();
    for (truth, object) in expected.iter().enumerate() {
        let right = answers.iter().enumerate().filter(|(_, answer)| fault(object, answer).is_none());
        pairs.extend(right.map(|(index, answer)| (compare(&object.body, answer).position_m, truth, index)));
    }
    pairs.sort_by(|a, b| a.0.total_cmp(&b.0).then((a.1, a.2).cmp(&(b.1, b.2))));
    let mut answer_of = vec![None; expected.len()];
    let mut used = vec![false; answers.len()];
    for (_, truth, index) in pairs {
        if answer_of[truth].is_none() && !used[index] {
            (answer_of[truth], used[index]) = (Some(index), true);
        }
    }
    let unused = answers.iter().enumerate().filter(|(index, _)| !used[*index]);
    let wrong = unused.map(|(index, answer)| (index, mildest_fault(expected, answer))).collect();
    Matching { answer_of, wrong }
}

/// What is wrong with an answer as compared with the object that it comes nearest to.
fn mildest_fault(expected: &[Expected], answer: &Object) -> Fault {
    let faults = expected.iter().map(|object| fault(object, answer).unwrap_or(Fault::Second));
    faults.min().unwrap_or(Fault::NothingThere)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;

    const WIDE: Tolerance = Tolerance { position_m: 0.05, radius_m: [0.08, 0.12], axis: 0.35, half_angle: 0.14 };

    pub fn expected(body: Object) -> Expected {
        Expected { name: "thing".into(), body, hidden: 0.0, required: true, tolerance: WIDE }
    }

    pub fn sphere(x: f64) -> Object {
        Object { kind: ObjectKind::Sphere.code(), center: [x, 0.0, 1.0], radius: 0.1, ..Object::default() }
    }

    pub fn cone() -> Object {
        Object {
            kind: ObjectKind::Cone.code(),
            center: [0.0, 0.0, 1.0],
            axis: [0.0, 1.0, 0.0],
            radius: 0.1,
            base_radius: 0.12,
            length: 0.2,
            half_angle: 0.1_f64.atan(),
            ..Object::default()
        }
    }

    #[test]
    fn a_cone_seen_at_another_height_is_compared_at_its_middle() {
        let lower = Object { center: [0.0, 0.08, 1.0], radius: 0.108, ..cone() };
        let comparison = compare(&cone(), &lower);
        assert!((comparison.radius_m - 0.1).abs() < 1e-12 && comparison.position_m < 1e-12);
        assert_eq!(fault(&expected(cone()), &lower), None);
    }

    #[test]
    fn each_tolerance_is_kept() {
        let truth = expected(cone());
        let tilted = |angle: f64| [0.0, angle.cos(), angle.sin()];
        for (answer, expected) in [
            (Object { center: [0.049, 0.0, 1.0], ..cone() }, None),
            (Object { center: [0.051, 0.0, 1.0], ..cone() }, Some(Fault::Position)),
            (Object { center: [0.9, 0.0, 1.0], ..cone() }, Some(Fault::NothingThere)),
            (Object { axis: tilted(0.34), ..cone() }, None),
            (Object { axis: tilted(0.36), ..cone() }, Some(Fault::Axis)),
            (Object { axis: [0.0, -1.0, 0.0], ..cone() }, Some(Fault::Axis)),
            (Object { radius: 0.119, ..cone() }, None),
            (Object { radius: 0.121, ..cone() }, Some(Fault::Radius)),
            (Object { half_angle: 0.1_f64.atan() + 0.15, ..cone() }, Some(Fault::HalfAngle)),
            (Object { kind: ObjectKind::Cylinder.code(), ..cone() }, Some(Fault::Shape)),
        ] {
            assert_eq!(fault(&truth, &answer), expected, "{answer:?}");
        }
    }

    #[test]
    fn a_cylinder_has_no_sense_and_its_place_along_the_axis_is_free() {
        let cylinder = Object { kind: ObjectKind::Cylinder.code(), half_angle: 0.0, base_radius: 0.0, ..cone() };
        let answer = Object { axis: [0.0, -1.0, 0.0], center: [0.0, 0.3, 1.0], ..cylinder };
        assert_eq!(fault(&expected(cylinder), &answer), None);
    }

    #[test]
    fn pairs_are_one_to_one_and_the_nearest_wins() {
        let truths = [expected(sphere(0.0)), expected(sphere(0.06))];
        let answers = [sphere(0.045), sphere(0.03), sphere(0.061), sphere(0.5)];
        let matching = match_up(&truths, &answers);
        assert_eq!(matching.answer_of, [Some(1), Some(2)]);
        assert_eq!(matching.wrong, [(0, Fault::Second), (3, Fault::NothingThere)]);
    }

    #[test]
    fn all_is_wrong_where_nothing_is() {
        assert_eq!(match_up(&[], &[sphere(0.0)]).wrong, [(0, Fault::NothingThere)]);
    }
}
