//! Pairs the objects of two answers to the same frame, so that two variants of a detector can be compared without a truth.
//!
//! Two objects are paired if the middle of one lies within the other, or next to it, and neither is more than twice as wide;
//! their differences say how well they agree. Pairs are taken one to one. Pairs of one kind go before those of two, then the
//! nearest pair goes first.

use super::matching::{Comparison, compare, is_near, one_to_one};
use conicflow_messages::Object;

/// Largest ratio of the widths of a pair: a ball in front of a wall is not the wall.
const WIDEST: f64 = 2.0;

/// The pairing of two answers to one frame, by index in their lists.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Paired {
    /// Objects in both lists.
    pub both: Vec<(usize, usize)>,
    /// Objects only in the first list.
    pub only_a: Vec<usize>,
    /// Objects only in the second list.
    pub only_b: Vec<usize>,
}

/// The difference of a second object from a first one of the same kind.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Difference {
    /// Distance in metres: of the centres of spheres, else of the first's middle from the second's axis.
    pub position_m: f64,
    /// Radius of the second minus that of the first, at the first's middle.
    pub radius_m: f64,
    /// Angle between the axes, in radians; 0 for spheres.
    pub axis: f64,
    /// Half-angle of the second minus that of the first, in radians.
    pub half_angle: f64,
    /// Ratio of the second's standard deviation of the radius to the first's; NaN if the first reports none.
    pub radius_sigma: f64,
}

impl Difference {
    /// Compares two objects.
    pub fn of(a: &Object, b: &Object) -> Self {
        let Comparison { position_m, radius_m, axis, half_angle } = compare(a, b);
        let radius_sigma = if a.sigma.radius > 0.0 { b.sigma.radius / a.sigma.radius } else { f64::NAN };
        Self { position_m, radius_m: radius_m - a.radius, axis, half_angle, radius_sigma }
    }
}

/// Pairs the objects of two lists.
pub fn pair_up(a: &[Object], b: &[Object]) -> Paired {
    let mut pairs = Vec::new();
    for (first, one) in a.iter().enumerate() {
        for (second, other) in b.iter().enumerate() {
            if is_same_thing(one, other) {
                let distance = compare(one, other).position_m + compare(other, one).position_m;
                pairs.push((one.kind != other.kind, distance, first, second));
            }
        }
    }
    let mut both = one_to_one(pairs);
    both.sort_unstable();
    let only_a = (0..a.len()).filter(|number| both.iter().all(|(first, _)| first != number)).collect();
    let only_b = (0..b.len()).filter(|number| both.iter().all(|(_, second)| second != number)).collect();
    Paired { both, only_a, only_b }
}

fn is_same_thing(a: &Object, b: &Object) -> bool {
    let widths = [a, b].map(|object| object.radius.max(object.base_radius));
    let are_alike = widths[0] <= WIDEST * widths[1] && widths[1] <= WIDEST * widths[0];
    are_alike && (is_near(a, b) || is_near(b, a))
}

#[cfg(test)]
mod tests {
    use super::super::matching::tests::{cone, sphere};
    use super::*;
    use conicflow_messages::{ObjectKind, ObjectSigma};

    fn wide(x: f64, radius: f64) -> Object {
        Object { radius, ..sphere(x) }
    }

    #[test]
    fn pairs_are_one_to_one_and_the_nearest_goes_first() {
        let (a, b) = ([sphere(0.0), sphere(0.1), sphere(1.0)], [sphere(0.08), sphere(2.0)]);
        let expected = Paired { both: vec![(1, 0)], only_a: vec![0, 2], only_b: vec![1] };
        assert_eq!(pair_up(&a, &b), expected);
        let turned = Paired { both: vec![(0, 1)], only_a: vec![1], only_b: vec![0, 2] };
        assert_eq!(pair_up(&b, &a), turned, "whoever is asked first");
        assert_eq!(pair_up(&[], &b).only_b, [0, 1]);
    }

    #[test]
    fn one_of_the_same_kind_goes_before_a_nearer_one_of_another() {
        let (a, b) = ([sphere(0.0)], [cone(), sphere(0.05)]);
        assert_eq!(pair_up(&a, &b).both, [(0, 1)]);
        assert_eq!(pair_up(&a, &b[..1]).both, [(0, 0)], "alone, the other kind is the same thing");
    }

    #[test]
    fn what_is_far_wider_is_another_thing() {
        assert_eq!(pair_up(&[wide(0.0, 0.1)], &[wide(0.0, 0.2)]).both, [(0, 0)]);
        assert_eq!(pair_up(&[wide(0.0, 0.2)], &[wide(0.0, 0.1)]).both, [(0, 0)]);
        assert_eq!(pair_up(&[wide(0.0, 0.1)], &[wide(0.0, 0.201)]).both, []);
        assert_eq!(pair_up(&[wide(0.0, 0.201)], &[wide(0.0, 0.1)]).both, []);
    }

    fn can(center: [f64; 3], axis: [f64; 3], length: f64) -> Object {
        let kind = ObjectKind::Cylinder.code();
        Object { kind, half_angle: 0.0, base_radius: 0.0, center, axis, length, ..cone() }
    }

    /// The end of a long pipe, seen alone, is far from the middle of the pipe.
    #[test]
    fn a_part_is_the_same_thing_as_the_whole_whoever_is_asked_first() {
        let pipe = can([0.0, 0.0, 1.0], [0.0, 1.0, 0.0], 0.8);
        let end = can([0.0, 0.35, 1.0], [0.0, 1.0, 0.0], 0.1);
        assert_eq!(pair_up(&[pipe], &[end]).both, [(0, 0)]);
        assert_eq!(pair_up(&[end], &[pipe]).both, [(0, 0)]);
    }

    /// The middle of the first object lies on the axis of a leaning one, whose own middle is 8 cm beside the first's axis. The
    /// other one is 3 cm beside it, either way.
    #[test]
    fn the_distance_is_that_from_either_to_the_other() {
        let leaning = [0.5_f64.sqrt(), 0.5_f64.sqrt(), 0.0];
        let (upright, length) = ([0.0, 1.0, 0.0], 0.4);
        let a = [can([0.0, 0.0, 1.0], upright, length)];
        let b = [can([0.08, 0.08, 1.0], leaning, length), can([0.03, 0.0, 1.0], upright, length)];
        assert!(compare(&a[0], &b[0]).position_m < 1e-12);
        assert_eq!(pair_up(&a, &b).both, [(0, 1)]);
        assert_eq!(pair_up(&b, &a).both, [(1, 0)]);
    }

    /// A ball on top of a can lies on its axis, but beyond its end.
    #[test]
    fn a_ball_on_a_can_is_not_the_can() {
        let can = can([0.0, 0.0, 1.0], [0.0, 1.0, 0.0], 0.2);
        let ball = Object { center: [0.0, -0.2, 1.0], ..sphere(0.0) };
        assert_eq!(pair_up(&[can], &[ball]).both, []);
    }

    #[test]
    fn differences_are_those_of_the_second_from_the_first() {
        let sigma = |radius: f64| ObjectSigma { radius, ..ObjectSigma::default() };
        let a = Object { sigma: sigma(0.002), ..sphere(0.0) };
        let b = Object { sigma: sigma(0.003), radius: 0.09, ..sphere(0.01) };
        let difference = Difference::of(&a, &b);
        let close = |number: f64, expected: f64| (number - expected).abs() < 1e-12;
        assert!(close(difference.position_m, 0.01) && close(difference.radius_m, -0.01));
        assert!(close(difference.radius_sigma, 1.5) && Difference::of(&sphere(0.0), &b).radius_sigma.is_nan());
        // The same cone, seen lower, where it is wider.
        let lower = Object { center: [0.0, 0.08, 1.0], radius: 0.108, ..cone() };
        assert!(close(Difference::of(&cone(), &lower).radius_m, 0.0));
    }
}
