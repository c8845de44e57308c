//! A camera that moves, and one that does not tell where it is.

use super::*;
use conicflow_messages::HAS_POSE;
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
        let tracks = tracker.update(&posed_header(frame), &[still, moving]);
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
    let velocity =
        (0..9).map(|frame| tracker.update(&header(frame), &[sphere(center)])[0].velocity).next_back().unwrap();
    assert!(Vector3::from(velocity).norm() < 1e-9);
}
