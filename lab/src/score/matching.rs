//! Matches answers with true objects: the one rule by which everything is scored.
//!
//! An answer is right if its shape is the true one (or another allowed one) and position, radius, axis and half-angle are within
//! the tolerances. The position error of a sphere is the distance of the centres; else it is the distance of the true middle from
//! the answer's axis, where the radii are compared, too. Only a part may be visible along the axis: there, one of the two has to
//! reach to the middle of the other. Pairs are taken one to one. An object keeps its identity as long as that is right, as in
//! CLEAR-MOT (Bernardin and Stiefelhagen 2008). Then objects that have to be found go before the others, for example a label
//! before the glass that it sticks to. Then the nearest pair goes first.

use super::truth::{Tolerance, TrueObject};
use conicflow_messages::{Header, Item, Object, Track, TrackState};
use nalgebra::Vector3;
use serde_json::json;
use std::collections::BTreeMap;

/// An answer of a detector or tracker about a frame: an object is there.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Answer {
    /// The object, in the camera frame.
    pub object: Object,
    /// Identity of a track.
    pub id: Option<u64>,
    /// Velocity of a track, in m/s along the camera's axes.
    pub velocity: Option<Vector3<f64>>,
}

/// An item that may claim that an object is there.
pub trait Claim: Item {
    /// Returns the claim, if the item makes one.
    fn answer(&self) -> Option<Answer>;
}

impl Claim for Object {
    fn answer(&self) -> Option<Answer> {
        Some(Answer { object: *self, id: None, velocity: None })
    }
}

impl Claim for Track {
    /// A tentative or coasting track does not claim to see the object in this frame.
    fn answer(&self) -> Option<Answer> {
        if self.track_state() != TrackState::Confirmed {
            return None;
        }
        Some(Answer { object: self.object, id: Some(self.id), velocity: Some(self.velocity.into()) })
    }
}

/// The comparison of an answer with a true object.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Comparison {
    /// Distance in metres: of the centres of spheres, else of the true middle from the answer's axis.
    pub position_m: f64,
    /// Radius of the answer; of a cone, at the true middle.
    pub radius_m: f64,
    /// Angle between the axes, in radians; 0 for spheres.
    pub axis: f64,
    /// Half-angle of the answer minus the true one, in radians.
    pub half_angle: f64,
}

/// The reason why an answer is wrong about an object, the mildest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fault {
    /// The answer is right, but another one is nearer.
    Second,
    /// The half-angle is off.
    HalfAngle,
    /// The radius is off.
    Radius,
    /// The axis is off.
    Axis,
    /// An object of another shape is there.
    Shape,
    /// An object is there, but its middle is elsewhere.
    Position,
    /// There is no such object.
    NothingThere,
}

impl Fault {
    /// Returns the name of the fault.
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

/// Returns the radius of an object at the foot of a point on its axis.
pub fn radius_at(object: &Object, point: &Vector3<f64>) -> f64 {
    let along = (point - Vector3::from(object.center)).dot(&Vector3::from(object.axis));
    object.radius + along * object.half_angle.tan()
}

/// Returns the part of an offset that is perpendicular to a unit vector.
pub fn perpendicular(offset: &Vector3<f64>, axis: &Vector3<f64>) -> Vector3<f64> {
    offset - axis * offset.dot(axis)
}

/// Compares an answer with the truth; shapes may differ.
pub fn compare(truth: &Object, answer: &Object) -> Comparison {
    let (middle, center) = (Vector3::from(truth.center), Vector3::from(answer.center));
    let (true_axis, axis) = (Vector3::from(truth.axis), Vector3::from(answer.axis));
    let cosine = true_axis.dot(&axis);
    // the axis of a cone has a direction, that of a cylinder does not
    let both_cones = truth.shape().has_half_angle() && answer.shape().has_half_angle();
    let cosine = if both_cones { cosine } else { cosine.abs() };
    let sine = true_axis.cross(&axis).norm();
    Comparison {
        position_m: perpendicular(&(middle - center), &axis).norm(),
        radius_m: radius_at(answer, &middle),
        axis: if sine == 0.0 && cosine == 0.0 { 0.0 } else { sine.atan2(cosine) },
        half_angle: answer.half_angle - truth.half_angle,
    }
}

/// Returns why an answer is wrong about a true object; `None` if it is right.
pub fn fault(truth: &TrueObject, answer: &Object) -> Option<Fault> {
    let Tolerance { shapes, position_m, radius_m: [least, most], axis, half_angle } = truth.tolerance;
    let comparison = compare(&truth.body, answer);
    let wrong_shape = !shapes.contains(&answer.shape());
    // other allowed shapes have other half-angles
    let same_shape = answer.shape() == truth.body.shape();
    // The ends of an object that was not measured well are not known.
    let is_beyond = truth.measured && is_beyond_end(&truth.body, answer);
    if wrong_shape || comparison.position_m >= position_m || is_beyond {
        let fault = if wrong_shape { Fault::Shape } else { Fault::Position };
        Some(if is_near(&truth.body, answer) { fault } else { Fault::NothingThere })
    } else if comparison.axis >= axis {
        Some(Fault::Axis)
    } else if !(least..=most).contains(&comparison.radius_m) {
        Some(Fault::Radius)
    } else if same_shape && comparison.half_angle.abs() >= half_angle {
        Some(Fault::HalfAngle)
    } else {
        None
    }
}

/// Whether neither of two bodies reaches to the middle of the other along the true axis. The middle of a visible part lies within
/// the whole object; of two cans on each other, each only reaches to the end of the other. Never true for spheres.
fn is_beyond_end(truth: &Object, answer: &Object) -> bool {
    let axis = Vector3::from(truth.axis);
    let along = (Vector3::from(answer.center) - Vector3::from(truth.center)).dot(&axis).abs();
    let have_axes = truth.shape().has_axis() && answer.shape().has_axis();
    have_axes && along > 0.5 * truth.length.max(answer.length)
}

/// Whether the middle of an answer lies within a true object, or next to it.
pub fn is_near(truth: &Object, answer: &Object) -> bool {
    const MARGIN_M: f64 = 0.05;
    let offset = Vector3::from(answer.center) - Vector3::from(truth.center);
    let axis = Vector3::from(truth.axis);
    let beyond_end = offset.dot(&axis).abs() - 0.5 * truth.length;
    let widest = truth.radius.max(truth.base_radius);
    perpendicular(&offset, &axis).norm() < widest + MARGIN_M && beyond_end < MARGIN_M
}

/// A frame whose answers and true objects are matched.
#[derive(Clone, Debug)]
pub struct MatchedFrame {
    /// Each true object with the right answer about it, if there is one.
    pub pairs: Vec<(TrueObject, Option<Answer>)>,
    /// The wrong answers, with the mildest fault compared with any true object.
    pub wrong: Vec<(Object, Fault)>,
    /// Answers at something unmeasured, with its name: they are neither right nor wrong.
    pub neither: Vec<(Object, String)>,
}

/// Matches answers with true objects, and remembers the identity of each object.
#[derive(Clone, Debug, Default)]
pub struct Matcher {
    identities: BTreeMap<String, u64>,
}

impl Matcher {
    /// Matches the answers to a frame with the true objects.
    pub fn match_up(&mut self, truths: Vec<TrueObject>, answers: &[Answer]) -> MatchedFrame {
        let mut right = Vec::new();
        for (index, truth) in truths.iter().enumerate() {
            let known = self.identities.get(&truth.name).copied();
            for (number, answer) in answers.iter().enumerate() {
                if fault(truth, &answer.object).is_none() {
                    let is_new = answer.id.is_none() || answer.id != known;
                    let position_m = compare(&truth.body, &answer.object).position_m;
                    right.push(((is_new, !truth.required), position_m, index, number));
                }
            }
        }
        let (mut answer_of, mut used) = (vec![None; truths.len()], vec![false; answers.len()]);
        for (index, number) in one_to_one(right) {
            (answer_of[index], used[number]) = (Some(answers[number]), true);
            if let Some(id) = answers[number].id {
                self.identities.insert(truths[index].name.clone(), id);
            }
        }
        let unused = answers.iter().zip(used).filter(|(_, used)| !used).map(|(answer, _)| answer.object);
        let wrong = unused.map(|object| (object, mildest_fault(&truths, &object))).collect();
        MatchedFrame { pairs: truths.into_iter().zip(answer_of).collect(), wrong, neither: Vec::new() }
    }
}

/// Selects pairs of indices in two lists so that no index occurs twice: the least rank first, then the nearest.
pub(super) fn one_to_one<R: Ord>(mut pairs: Vec<(R, f64, usize, usize)>) -> Vec<(usize, usize)> {
    pairs.sort_by(|a, b| a.0.cmp(&b.0).then(a.1.total_cmp(&b.1)).then((a.2, a.3).cmp(&(b.2, b.3))));
    let mut taken: Vec<(usize, usize)> = Vec::new();
    for (_, _, first, second) in pairs {
        if taken.iter().all(|pair| pair.0 != first && pair.1 != second) {
            taken.push((first, second));
        }
    }
    taken
}

/// Returns the mildest fault of an answer compared with any true object.
fn mildest_fault(truths: &[TrueObject], answer: &Object) -> Fault {
    let faults = truths.iter().map(|truth| fault(truth, answer).unwrap_or(Fault::Second));
    faults.min().unwrap_or(Fault::NothingThere)
}

impl MatchedFrame {
    /// Moves wrong answers from `wrong` to `neither` if they are at something unmeasured, which `unmeasured` names.
    pub fn excuse<'a>(&mut self, unmeasured: impl Fn(&Object) -> Option<&'a str>) {
        self.wrong.retain(|(object, _)| {
            let what = unmeasured(object);
            self.neither.extend(what.map(|what| (*object, what.to_owned())));
            what.is_none()
        });
    }

    /// Returns the objects that had to be found and were not.
    pub fn missed(&self) -> impl Iterator<Item = &TrueObject> {
        self.pairs.iter().filter(|(truth, answer)| truth.required && answer.is_none()).map(|(truth, _)| truth)
    }

    /// Returns the missed objects and the wrong answers as a JSON object.
    pub fn details(&self, header: &Header) -> serde_json::Value {
        let describe = |object: &Object| {
            json!({
                "kind": object.shape().name(), "center": object.center, "radius": object.radius, "axis": object.axis,
                "half_angle_deg": object.half_angle.to_degrees(), "length": object.length, "rows": object.rows,
            })
        };
        let missed =
            |truth: &TrueObject| json!({"name": truth.name, "hidden": truth.hidden, "is": describe(&truth.body)});
        let wrong = |(object, fault): &(Object, Fault)| json!({"why": fault.name(), "is": describe(object)});
        let neither = |(object, what): &(Object, String)| json!({"on": what, "is": describe(object)});
        json!({
            "sequence": header.sequence,
            "scene": header.source.as_str(),
            "missed": self.missed().map(missed).collect::<Vec<_>>(),
            "wrong": self.wrong.iter().map(wrong).collect::<Vec<_>>(),
            "neither": self.neither.iter().map(neither).collect::<Vec<_>>(),
        })
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::truth::only;
    use super::*;
    use conicflow_messages::ObjectKind;

    pub fn expected(body: Object) -> TrueObject {
        let shapes = only(body.shape());
        let tolerance = Tolerance { shapes, position_m: 0.05, radius_m: [0.08, 0.12], axis: 0.35, half_angle: 0.14 };
        TrueObject { name: "thing".into(), body, hidden: 0.0, required: true, measured: true, tolerance }
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

    /// The answers of a detector that finds these objects.
    pub fn answers(objects: &[Object]) -> Vec<Answer> {
        objects.iter().filter_map(Claim::answer).collect()
    }

    /// Returns the positions of the right answer about each object, and of the wrong answers.
    fn places(frame: &MatchedFrame) -> (Vec<Option<f64>>, Vec<(f64, Fault)>) {
        let right = frame.pairs.iter().map(|(_, answer)| Some(answer.as_ref()?.object.center[0]));
        (right.collect(), frame.wrong.iter().map(|(object, fault)| (object.center[0], *fault)).collect())
    }

    #[test]
    fn a_cone_seen_at_another_height_is_compared_at_its_middle() {
        let lower = Object { center: [0.0, 0.08, 1.0], radius: 0.108, ..cone() };
        let comparison = compare(&cone(), &lower);
        assert!((comparison.radius_m - 0.1).abs() < 1e-12 && comparison.position_m < 1e-12);
        assert_eq!(fault(&expected(cone()), &lower), None);
    }

    #[test]
    fn each_tolerance_is_kept_on_both_sides() {
        let truth = expected(cone());
        let tilted = |angle: f64| [0.0, angle.cos(), angle.sin()];
        let half_angle = |off: f64| 0.1_f64.atan() + off;
        for (answer, expected) in [
            (Object { center: [0.049, 0.0, 1.0], ..cone() }, None),
            (Object { center: [0.051, 0.0, 1.0], ..cone() }, Some(Fault::Position)),
            (Object { center: [-0.051, 0.0, 1.0], ..cone() }, Some(Fault::Position)),
            (Object { center: [0.9, 0.0, 1.0], ..cone() }, Some(Fault::NothingThere)),
            (Object { axis: tilted(0.34), ..cone() }, None),
            (Object { axis: tilted(0.36), ..cone() }, Some(Fault::Axis)),
            (Object { axis: tilted(-0.36), ..cone() }, Some(Fault::Axis)),
            (Object { axis: [0.0, -1.0, 0.0], ..cone() }, Some(Fault::Axis)),
            (Object { axis: [1.0, 0.0, 0.0], ..cone() }, Some(Fault::Axis)),
            (Object { radius: 0.119, ..cone() }, None),
            (Object { radius: 0.121, ..cone() }, Some(Fault::Radius)),
            (Object { radius: 0.081, ..cone() }, None),
            (Object { radius: 0.079, ..cone() }, Some(Fault::Radius)),
            (Object { radius: 0.0, ..cone() }, Some(Fault::Radius)),
            (Object { half_angle: half_angle(0.13), ..cone() }, None),
            (Object { half_angle: half_angle(0.15), ..cone() }, Some(Fault::HalfAngle)),
            (Object { half_angle: half_angle(-0.09), ..cone() }, None),
            (Object { half_angle: half_angle(-0.15), ..cone() }, Some(Fault::HalfAngle)),
            (Object { kind: ObjectKind::Cylinder.code(), ..cone() }, Some(Fault::Shape)),
        ] {
            assert_eq!(fault(&truth, &answer), expected, "{answer:?}");
        }
    }

    /// A bowl may be called a cone. Half-angle and axis, which a sphere does not have, are not compared, but position and radius
    /// are.
    #[test]
    fn another_shape_that_is_allowed_is_right_where_place_and_radius_are() {
        let mut bowl = expected(sphere(0.0));
        assert_eq!(fault(&bowl, &cone()), Some(Fault::Shape));
        bowl.tolerance.shapes = &[ObjectKind::Sphere, ObjectKind::Cone];
        assert_eq!(fault(&bowl, &cone()), None);
        assert_eq!(fault(&bowl, &Object { radius: 0.13, ..cone() }), Some(Fault::Radius));
        assert_eq!(fault(&bowl, &Object { center: [0.06, 0.0, 1.0], ..cone() }), Some(Fault::Position));
        assert_eq!(fault(&bowl, &Object { kind: ObjectKind::Cylinder.code(), ..cone() }), Some(Fault::Shape));
    }

    fn can(along: f64, length: f64) -> Object {
        let (kind, center) = (ObjectKind::Cylinder.code(), [0.0, along, 1.0]);
        Object { kind, half_angle: 0.0, base_radius: 0.0, center, length, ..cone() }
    }

    #[test]
    fn a_cylinder_has_no_sense_and_any_part_of_it_may_be_seen() {
        let answer = Object { axis: [0.0, -1.0, 0.0], ..can(0.09, 0.02) };
        assert_eq!(fault(&expected(can(0.0, 0.2)), &answer), None);
        let mut tapered = expected(cone());
        tapered.tolerance.shapes = &ObjectKind::ALL;
        assert_eq!(fault(&tapered, &answer), None, "nor where a cone may be called one");
    }

    /// A can of 20 cm, and answers along its axis.
    #[test]
    fn what_does_not_reach_along_the_axis_is_another_thing() {
        for (along, length, expected) in [
            (0.0, 0.2, None),
            (-0.09, 0.02, None),
            (0.19, 0.4, None),
            (0.11, 0.2, Some(Fault::Position)),
            (-0.11, 0.02, Some(Fault::Position)),
            (0.2, 0.2, Some(Fault::NothingThere)),
            (3.0, 0.2, Some(Fault::NothingThere)),
            (-3.0, 0.2, Some(Fault::NothingThere)),
        ] {
            assert_eq!(
                fault(&self::expected(can(0.0, 0.2)), &can(along, length)),
                expected,
                "{along} m, {length} m long"
            );
        }
    }

    #[test]
    fn of_two_cans_on_each_other_the_lower_one_answered_twice_is_one() {
        let truths = vec![expected(can(-0.1, 0.2)), expected(can(0.1, 0.2))];
        let matched = Matcher::default().match_up(truths, &answers(&[can(0.1, 0.2), can(0.1, 0.2)]));
        let found: Vec<_> = matched.pairs.iter().map(|(_, answer)| answer.is_some()).collect();
        let faults: Vec<_> = matched.wrong.iter().map(|(_, fault)| *fault).collect();
        assert_eq!((found, faults), (vec![false, true], vec![Fault::Second]));
        let presence = TrueObject { measured: false, ..expected(can(-0.1, 0.2)) };
        assert_eq!(fault(&presence, &can(0.1, 0.2)), None, "where it ends is not known well");
    }

    /// Within 5 cm of its side at the widest place, and of its ends.
    #[test]
    fn near_an_object_is_what_lies_within_it_or_next_to_it() {
        for (aside, along, expected) in [
            (0.169, 0.0, true),
            (0.171, 0.0, false),
            (-0.171, 0.0, false),
            (0.0, 0.149, true),
            (0.0, 0.151, false),
            (0.0, -0.151, false),
        ] {
            let answer = Object { center: [aside, along, 1.0], ..cone() };
            assert_eq!(is_near(&cone(), &answer), expected, "{aside} m aside, {along} m along the axis");
        }
    }

    #[test]
    fn pairs_are_one_to_one_and_the_nearest_wins() {
        let truths = vec![expected(sphere(0.0)), expected(sphere(0.06))];
        let answers = answers(&[sphere(0.045), sphere(0.03), sphere(0.061), sphere(0.5)]);
        let matched = Matcher::default().match_up(truths, &answers);
        let (right, wrong) = places(&matched);
        assert_eq!(right, [Some(0.03), Some(0.061)]);
        assert_eq!(wrong, [(0.045, Fault::Second), (0.5, Fault::NothingThere)]);
    }

    #[test]
    fn an_answer_that_is_right_about_two_objects_has_found_the_nearer_one_only() {
        let truths = vec![expected(sphere(0.0)), expected(sphere(0.06))];
        let answers = answers(&[sphere(0.035)]);
        let matched = Matcher::default().match_up(truths, &answers);
        assert_eq!(places(&matched), (vec![None, Some(0.035)], vec![]));
        assert_eq!(matched.missed().count(), 1);
    }

    #[test]
    fn what_has_to_be_found_goes_before_what_need_not() {
        let glass = TrueObject { required: false, ..expected(sphere(0.0)) };
        let truths = vec![glass, expected(sphere(0.04))];
        let found = |answers: &[Object]| places(&Matcher::default().match_up(truths.clone(), &self::answers(answers)));
        assert_eq!(found(&[sphere(0.01)]), (vec![None, Some(0.01)], vec![]));
        assert_eq!(found(&[sphere(0.01), sphere(0.02)]), (vec![Some(0.01), Some(0.02)], vec![]));
    }

    #[test]
    fn all_is_wrong_where_nothing_is() {
        let answers = answers(&[sphere(0.0)]);
        let matched = Matcher::default().match_up(Vec::new(), &answers);
        assert_eq!(places(&matched), (vec![], vec![(0.0, Fault::NothingThere)]));
    }

    #[test]
    fn only_confirmed_tracks_are_answers() {
        let track = |state: TrackState| Track { state: state.code(), ..Track::default() };
        assert!(track(TrackState::Confirmed).answer().is_some());
        assert!(track(TrackState::Tentative).answer().is_none());
        assert!(track(TrackState::Coasting).answer().is_none());
    }
}
