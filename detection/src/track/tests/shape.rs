//! Shape, axis and half-angle of a track.

use super::super::detection::Detection;
use super::super::target::Target;
use super::super::timeline::Advance;
use super::*;
use nalgebra::IsometryMatrix3;

#[test]
fn the_sign_of_a_cylinders_axis_is_kept() {
    let mut tracker = Tracker::new(TrackerParameters::default());
    let axis = Vector3::new(0.05, 1.0, 0.0).normalize();
    for frame in 0..60 {
        let sign = if frame % 3 == 0 { 1.0 } else { -1.0 };
        let tilt = if frame == 0 { Vector3::y() } else { axis };
        let object = Object { axis: (tilt * sign).into(), ..cylinder(Vector3::new(0.0, 0.0, 1.0)) };
        let track = tracker.update_frame(&header(frame), &[object])[0];
        let off = (Vector3::from(track.object.axis) - axis).norm();
        assert!(off < if frame < 30 { 0.06 } else { 1e-6 }, "frame {frame}: {off}");
    }
}

#[test]
fn what_has_another_shape_radius_or_axis_than_a_track_in_its_place_is_another_object() {
    let place = Vector3::new(0.0, 0.0, 1.0);
    let wide = |radius: f64, sigma: f64| Object {
        radius,
        sigma: ObjectSigma { radius: sigma, ..sphere(place).sigma },
        ..sphere(place)
    };
    let leaning = |degrees: f64, sigma: f64| Object {
        axis: [degrees.to_radians().sin(), -degrees.to_radians().cos(), 0.0],
        sigma: ObjectSigma { axis: sigma, ..cylinder(place).sigma },
        ..cylinder(place)
    };
    for (first, then, is_same) in [
        (cylinder(place), sphere(place), false),
        (sphere(place), wide(0.12, 0.001), true),
        (sphere(place), wide(0.13, 0.001), false),
        (sphere(place), wide(0.13, 0.01), true),
        (cylinder(place), leaning(25.0, 0.01), true),
        (cylinder(place), leaning(35.0, 0.01), false),
        (cylinder(place), leaning(35.0, 0.3), true),
    ] {
        let mut tracker = Tracker::new(TrackerParameters::default());
        (0..5).for_each(|frame| _ = tracker.update_frame(&header(frame), &[first]));
        let seen = states(tracker.update_frame(&header(5), &[then]));
        let other = vec![TrackState::Coasting, TrackState::Tentative];
        assert_eq!(seen, if is_same { vec![TrackState::Confirmed] } else { other }, "{then:?}");
    }
}

#[test]
fn of_two_in_one_place_the_one_of_its_shape_belongs_to_a_track() {
    let place = Vector3::new(0.0, 0.0, 1.0);
    for (own, other) in [(cylinder(place), cone(place)), (cone(place), cylinder(place))] {
        let mut tracker = Tracker::new(TrackerParameters::default());
        (0..5).for_each(|frame| _ = tracker.update_frame(&header(frame), &[own]));
        let tracks = tracker.update_frame(&header(5), &[other, own]);
        assert_eq!((tracks[0].misses, tracks[1].object.kind), (0, other.kind));
    }
}

/// The cost is `d' S^-1 d + ln det S` of the place, `d^2 / s + ln s` of the radius, and `d^2 / s + 2 ln s` of the axis, which may
/// lean in two directions.
#[test]
fn what_a_pair_costs_is_minus_twice_the_logarithm_of_its_likelihood() {
    let (config, place) = (TrackerParameters::default(), Vector3::new(0.0, 0.0, 1.0));
    let (angle, wider) = (0.02_f64, 0.001);
    let seen = cylinder(place + Vector3::new(0.002, 0.001, -0.002));
    let seen = Object { axis: [angle.sin(), -angle.cos(), 0.0], radius: seen.radius + wider, ..seen };
    let [first, then] =
        [cylinder(place), seen].map(|object| Detection::new(&object, &IsometryMatrix3::identity(), &config));
    let (spread, offset) = (first.covariance + then.covariance, then.position - first.position);
    let expected_of_place = offset.dot(&(spread.try_inverse().unwrap() * offset)) + spread.determinant().ln();
    let radius = first.shape.radius.variance + then.shape.radius.variance;
    let axis = first.shape.axis.unwrap().variance + then.shape.axis.unwrap().variance;
    let expected = expected_of_place + wider * wider / radius + radius.ln() + angle * angle / axis + 2.0 * axis.ln();
    let time = Advance { source: 0, at_ns: 0, elapsed_s: 0.0, usual_s: f64::INFINITY, new_run: false };
    let cost = Target::born(1, &first, &time, &config).cost(&then, &config).unwrap();
    assert!((cost - expected).abs() < 1e-6, "{cost}, expected {expected}");
}

#[test]
fn the_shape_is_the_one_seen_most_often() {
    let mut tracker = Tracker::new(TrackerParameters::default());
    let place = Vector3::new(0.0, 0.0, 1.0);
    let seen = [cylinder(place), cone(place), cone(place), cylinder(place), cone(place)];
    let kinds = [ObjectKind::Cylinder, ObjectKind::Cylinder, ObjectKind::Cone, ObjectKind::Cone, ObjectKind::Cone];
    for (frame, (object, kind)) in (0..).zip(seen.iter().zip(kinds)) {
        let track = tracker.update_frame(&header(frame), &[*object])[0];
        assert_eq!((track.id, track.object.shape()), (1, kind));
        assert!((track.object.axis[1].abs() - 1.0).abs() < 1e-12);
        assert_eq!(track.object.axis[1] > 0.0, kind == ObjectKind::Cone, "a cone points from apex to base");
    }
}

#[test]
fn a_cone_seen_as_a_cylinder_once_is_no_surer_of_its_half_angle() {
    let mut tracker = Tracker::new(TrackerParameters::default());
    let place = Vector3::new(0.0, 0.0, 1.0);
    let mut sigmas = [cone, cone, cone, cone, cone, cylinder].iter().zip(0..).map(|(seen, frame)| {
        let track = tracker.update_frame(&header(frame), &[seen(place)])[0];
        assert_eq!(track.object.shape(), ObjectKind::Cone);
        track.object.sigma.half_angle
    });
    let [as_cone, as_cylinder] = [sigmas.nth(4), sigmas.next()].map(Option::unwrap);
    assert!((as_cylinder / as_cone - 1.0).abs() < 0.02, "{as_cone} {as_cylinder}");
}

#[test]
fn a_cone_seen_as_a_cylinder_keeps_the_sense_of_its_axis() {
    let mut tracker = Tracker::new(TrackerParameters::default());
    let place = Vector3::new(0.0, 0.0, 1.0);
    (0..5).for_each(|frame| _ = tracker.update_frame(&header(frame), &[cone(place)]));
    let turned = Object { axis: Vector3::new(0.1, -1.0, 0.0).normalize().into(), ..cylinder(place) };
    let axis = tracker.update_frame(&header(5), &[turned])[0].object.axis;
    assert!(axis[1] > 0.99 && axis[0] < 0.0, "{axis:?}");
}

#[test]
fn what_is_seen_as_a_cone_the_other_way_round_stays_where_it_is() {
    let place = Vector3::new(0.0, 0.0, 1.0);
    let upside_down = Object { axis: Vector3::new(0.1, -1.0, 0.0).normalize().into(), ..cone(place) };
    for seen in [cone(place), Object { axis: [0.0, 1.0, 0.0], ..cylinder(place) }] {
        let mut tracker = Tracker::new(TrackerParameters::default());
        (0..5).for_each(|frame| _ = tracker.update_frame(&header(frame), &[seen]));
        let track = tracker.update_frame(&header(5), &[upside_down])[0];
        assert_eq!((track.id, track.object.kind), (1, seen.kind));
        assert!((0.99..1.0).contains(&track.object.axis[1]), "{:?}", track.object.axis);
    }
}

/// The direction is one or the other, and never between.
#[test]
fn the_axis_of_a_cone_points_as_it_was_seen_most_often_of_late() {
    let place = Vector3::new(0.0, 0.0, 1.0);
    let seen = [cone(place), Object { axis: [0.0, -1.0, 0.0], ..cone(place) }];
    for (before, until_it_turns) in [(1, 2), (4, 5), (30, 11)] {
        let mut tracker = Tracker::new(TrackerParameters::default());
        let sights = std::iter::repeat_n(seen[0], before).chain([seen[1]; 20]);
        let ways = sights.zip(0..).map(|(seen, frame)| {
            let track = tracker.update_frame(&header(frame), &[seen])[0];
            assert_eq!(track.id, 1);
            track.object.axis[1]
        });
        let ways: Vec<_> = ways.skip(before).collect();
        let (up, down) = ways.split_at(until_it_turns - 1);
        assert!(up.iter().all(|way| *way > 0.999) && down.iter().all(|way| *way < -0.999), "{before}: {ways:?}");
    }
}

#[test]
fn a_cone_fits_together() {
    let mut tracker = Tracker::new(TrackerParameters::default());
    let mut noise = Noise(2);
    let mut last = Object::default();
    for frame in 0..10 {
        let place = Vector3::new(0.1, 0.2, 1.0) + noise.vector(SIGMA_M);
        let half_angle = 0.2 + noise.normal() * 0.01;
        last = tracker.update_frame(&header(frame), &[Object { half_angle, ..cone(place) }])[0].object;
    }
    let from_apex = Vector3::from(last.center) - Vector3::from(last.apex);
    assert!((from_apex.norm() * last.half_angle.tan() - last.radius).abs() < 1e-12);
    assert!((from_apex.normalize() - Vector3::from(last.axis)).norm() < 1e-12);
    assert!((last.base_radius - last.top_radius - last.length * last.half_angle.tan()).abs() < 1e-12);
    assert!((last.half_angle - 0.2).abs() < 0.01 && last.sigma.half_angle < 0.0115);
}

/// A step that `max_radius_change` accepts, far outside the noise that the sigma covers.
#[test]
fn a_step_of_the_radius_leaves_an_honest_sigma() {
    let mut tracker = Tracker::new(exact());
    let (place, before, after) = (Vector3::new(0.0, 0.0, 1.0), 0.1, 0.115);
    for frame in 0..60 {
        tracker.update_frame(&header(frame), &[Object { radius: before, ..sphere(place) }]);
    }
    let track = tracker.update_frame(&header(60), &[Object { radius: after, ..sphere(place) }])[0];
    let (error, sigma) = ((track.object.radius - after).abs(), track.object.sigma.radius);
    assert!(track.id == 1 && error < 4.5 * sigma, "{error} m off, sigma {sigma} m");
    assert!(error > 0.01, "it may be an outlier");
    let track = tracker.update_frame(&header(61), &[Object { radius: before, ..sphere(place) }])[0];
    let (error, sigma) = ((track.object.radius - before).abs(), track.object.sigma.radius);
    assert!(error < 4.5 * sigma && sigma < 0.001, "{error} m off, sigma {sigma} m");
}
