//! A camera that moves, and one without a pose.

use super::super::ballistic::Ballistic;
use super::super::worlds::Worlds;
use super::*;
use conicflow_messages::{HAS_POSE, Hop, Text};
use nalgebra::Rotation3;

/// A pose that moves and turns, as `[R | t]`.
fn pose(time: f64) -> (Rotation3<f64>, Vector3<f64>) {
    (
        Rotation3::from_euler_angles(0.2 * time, -0.5 * time, 0.1),
        Vector3::new(0.4 * time, 0.1 * time.sin(), -0.3 * time),
    )
}

fn posed_header(frame: u64) -> Header {
    let (rotation, translation) = pose(seconds(frame));
    let row = |r: usize| [rotation[(r, 0)], rotation[(r, 1)], rotation[(r, 2)], translation[r]];
    Header { flags: HAS_POSE, world_from_camera: [row(0), row(1), row(2)], ..header(frame) }
}

#[test]
fn a_moving_camera_does_not_move_what_stands_still() {
    let mut tracker = Tracker::new(exact());
    let (start, velocity) = (Vector3::new(0.5, 0.1, 3.0), Vector3::new(0.3, -0.2, 0.1));
    let axis_in_world = Vector3::new(0.1, -1.0, 0.2).normalize();
    for frame in 0..60 {
        let (rotation, translation) = pose(seconds(frame));
        let seen_at = |place: Vector3<f64>| rotation.inverse() * (place - translation);
        let still = Object { axis: (rotation.inverse() * axis_in_world).into(), ..cylinder(seen_at(start)) };
        let moving = sphere(seen_at(-start + velocity * seconds(frame)));
        let tracks = tracker.update_frame(&posed_header(frame), &[still, moving]);
        assert_eq!(ids(tracks), [1, 2]);
        for (track, object) in tracks.iter().zip([still, moving]) {
            assert!((Vector3::from(track.object.center) - Vector3::from(object.center)).norm() < 0.002);
        }
        assert!(Vector3::from(tracks[0].velocity).norm() < 1e-9, "frame {frame}: {:?}", tracks[0].velocity);
        assert!((Vector3::from(tracks[0].object.axis) - Vector3::from(still.axis)).norm() < 1e-9);
        if frame > 30 {
            let expected = rotation.inverse() * velocity;
            assert!((Vector3::from(tracks[1].velocity) - expected).norm() < 1e-3);
        }
    }
}

#[test]
fn without_a_pose_the_camera_is_where_it_was() {
    let mut tracker = Tracker::new(exact());
    let center = Vector3::new(0.0, 0.0, 2.0);
    let header = |frame: u64| if frame == 0 { posed_header(40) } else { header(40 + frame) };
    for frame in 0..9 {
        let velocity = tracker.update_frame(&header(frame), &[sphere(center)])[0].velocity;
        assert!(Vector3::from(velocity).norm() < 1e-9, "frame {frame}: {velocity:?}");
    }
}

/// The same frame, from the source `name`.
fn from(name: &str, mut header: Header) -> Header {
    header.add_hop(Hop { stage: Text::new(name), ..Hop::default() });
    header
}

/// A header of a camera at `x`, looking along the world's z.
pub(super) fn placed(name: &str, x: f64, frame: u64) -> Header {
    let world_from_camera = [[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    from(name, Header { flags: HAS_POSE, world_from_camera, ..header(frame) })
}

#[test]
fn two_cameras_do_not_miss_what_only_the_other_sees() {
    let mut tracker = Tracker::new(TrackerParameters::default());
    let (left, right) = (Vector3::new(0.0, 0.0, 2.0), Vector3::new(0.3, 0.0, 2.5));
    for frame in 0..20 {
        tracker.update_frame(&placed("left", 0.0, frame), &[sphere(left)]);
        let tracks = tracker.update_frame(&placed("right", 5.0, frame), &[sphere(right)]);
        let expected = if frame < 2 { TrackState::Tentative } else { TrackState::Confirmed };
        assert_eq!((ids(tracks), states(tracks)), (vec![1, 2], vec![expected; 2]), "frame {frame}");
        assert_eq!(tracks[0].misses, 0);
        assert!((Vector3::from(tracks[0].object.center) - left + Vector3::x() * 5.0).norm() < 1e-6, "its own pose");
        assert!((Vector3::from(tracks[1].object.center) - right).norm() < 1e-6);
    }
    // The left camera sees nothing more, then falls silent.
    let tracks = tracker.update_frame(&placed("left", 0.0, 20), &[]);
    assert_eq!((tracks[0].misses, tracks[1].misses), (1, 0));
    for frame in 20..60 {
        let known = ids(tracker.update_frame(&placed("right", 5.0, frame), &[sphere(right)]));
        assert_eq!(known, if frame < 50 { vec![1, 2] } else { vec![2] }, "frame {frame}");
    }
}

#[test]
fn a_camera_that_begins_again_takes_no_tracks_from_the_other() {
    let mut tracker = Tracker::new(TrackerParameters::default());
    let (left, right) = (Vector3::new(0.0, 0.0, 2.0), Vector3::new(0.3, 0.0, 2.5));
    for frame in 0..9 {
        tracker.update_frame(&placed("left", 0.0, frame), &[sphere(left)]);
        tracker.update_frame(&placed("right", 5.0, frame), &[sphere(right)]);
    }
    let anew = Header { epoch: 2, ..placed("left", 0.0, 0) };
    assert_eq!(ids(tracker.update_frame(&anew, &[sphere(left)])), [2, 3]);
}

#[test]
fn what_one_camera_hands_over_keeps_its_identity() {
    let mut tracker = Tracker::new(TrackerParameters::default());
    for frame in 0..40 {
        let place = Vector3::new(0.02 * frame as f64, 0.0, 2.0);
        let seen = [sphere(place)];
        tracker.update_frame(&placed("left", 0.0, frame), if frame < 20 { &seen } else { &[] });
        let seen = [sphere(place - Vector3::x())];
        let tracks = tracker.update_frame(&placed("right", 1.0, frame), if frame < 20 { &[] } else { &seen });
        assert_eq!((ids(tracks), tracks[0].misses), (vec![1], 0), "frame {frame}");
    }
}

#[test]
fn cameras_that_do_not_know_where_they_are_share_nothing_but_identities() {
    let mut worlds = Worlds::with_first_id(TrackerParameters::default(), 7);
    let place = Vector3::new(0.0, 0.0, 2.0);
    for frame in 0..9 {
        assert_eq!(ids(worlds.update(&from("left", header(frame)), &[sphere(place)]).tracks()), [7]);
        assert_eq!(ids(worlds.update(&from("right", header(frame)), &[sphere(place)]).tracks()), [8]);
    }
    let right = worlds.update(&from("right", header(9)), &[]).tracks();
    assert_eq!((ids(right), right[0].misses), (vec![8], 1));
    assert_eq!(worlds.update(&from("left", header(9)), &[sphere(place)]).tracks()[0].misses, 0);
    // From then on, cameras with poses share a world.
    assert_eq!(ids(worlds.update(&placed("left", 0.0, 10), &[sphere(place)]).tracks()), [9]);
    assert_eq!(ids(worlds.update(&placed("right", 0.0, 10), &[sphere(place)]).tracks()), [9]);
    assert_eq!(ids(worlds.update(&from("right", header(11)), &[sphere(place)]).tracks()), [9]);
}

/// The same header `late_s` seconds earlier.
pub(super) fn late(header: Header, late_s: f64) -> Header {
    Header { stamp_ns: header.stamp_ns - (late_s * 1e9) as u64, ..header }
}

/// The frames of the right camera are late by a tenth of a second, and every third does not show the ball; in the end the ball is
/// hidden from the left camera.
#[test]
fn a_late_frame_is_compared_with_where_things_were_then() {
    let late_s = 0.1;
    let straight = |time: f64| Vector3::new(1.5 * time, 0.0, 2.0);
    let thrown = |time: f64| Vector3::new(2.0 * time, 4.905 * time * time - 4.0 * time, 2.0);
    let falls = Some(Ballistic { up: Some([0.0, -1.0, 0.0]), ..Ballistic::default() });
    let runs: [(&dyn Fn(f64) -> Vector3<f64>, _); 2] = [(&straight, None), (&thrown, falls)];
    for (place, ballistic) in runs {
        let mut tracker = Tracker::new(TrackerParameters { ballistic, ..TrackerParameters::default() });
        for frame in 3..30 {
            let now_s = seconds(frame);
            let seen = [sphere(place(now_s))];
            let seen = if frame < 20 { &seen } else { &[][..] };
            let in_time = tracker.update_frame(&placed("left", 0.0, frame), seen)[0];
            let seen = [sphere(place(now_s - late_s))];
            let seen = if frame % 3 == 0 { &[][..] } else { &seen };
            let afterwards = tracker.update_frame(&late(placed("right", 0.0, frame), late_s), seen)[0];
            assert_eq!(tracker.next_id, 2, "frame {frame}: a second track");
            for (track, time) in [(in_time, now_s), (afterwards, now_s - late_s)] {
                let off = (Vector3::from(track.object.center) - place(time)).norm();
                let velocity = (place(time + 1e-6) - place(time)) / 1e-6;
                let too_fast = (Vector3::from(track.velocity) - velocity).norm();
                assert!(frame < 10 || too_fast < 0.1, "frame {frame}: {too_fast} m/s off");
                assert!(frame < 10 || off < 0.005, "frame {frame}: {off} m off");
            }
        }
    }
}
