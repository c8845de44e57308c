//! Shape, axis and half-angle of a track.

use super::*;

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
fn a_sphere_in_the_place_of_a_cylinder_is_another_object() {
    let mut tracker = Tracker::new(TrackerParameters::default());
    let place = Vector3::new(0.0, 0.0, 1.0);
    for frame in 0..5 {
        tracker.update_frame(&header(frame), &[cylinder(place)]);
    }
    let tracks = tracker.update_frame(&header(5), &[sphere(place)]);
    assert_eq!(ids(tracks), [1, 2]);
    assert_eq!(states(tracks), [TrackState::Coasting, TrackState::Tentative]);
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

/// A step that `max_radius_change` lets pass, far outside of what the sigma has for noise.
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
