//! Balls that fall, bounce and lie still.

use super::super::ballistic::Ballistic;
use super::*;

#[test]
fn a_bounce_keeps_the_identity() {
    let run = |manoeuvre_mps| {
        let mut tracker = Tracker::new(TrackerParameters { manoeuvre_mps, ..TrackerParameters::default() });
        let mut noise = Noise(9);
        let (mut height, mut speed) = (0.8_f64, 0.0_f64);
        for frame in 0..60 {
            speed -= 9.81 * PERIOD_S;
            height += speed * PERIOD_S;
            if height < 0.1 {
                (height, speed) = (0.2 - height, -0.8 * speed);
            }
            tracker
                .update_frame(&header(frame), &[sphere(Vector3::new(0.0, 1.0 - height, 2.0) + noise.vector(SIGMA_M))]);
        }
        tracker.next_id - 1
    };
    assert_eq!(run(2.0), 1, "tracks in all");
    assert!(run(0.0) > 1, "a bounce lies outside the gate of a motion without pushes");
}

/// A ball that is carried along stops while it is unseen.
#[test]
fn a_push_that_nobody_sees_keeps_the_identity_for_a_short_time() {
    let run = |unseen_frames: u64| {
        let mut tracker = Tracker::new(TrackerParameters::default());
        let mut noise = Noise(4);
        let speed_mps = 2.0;
        for frame in 0..40 {
            let place = Vector3::new(-1.0 + speed_mps * seconds(frame.min(20)), 0.0, 2.0);
            let seen = [sphere(place + noise.vector(SIGMA_M))];
            let hidden = (21..21 + unseen_frames).contains(&frame);
            tracker.update_frame(&header(frame), if hidden { &[] } else { &seen });
        }
        tracker.next_id - 1
    };
    assert_eq!([0, 1, 3, 5].map(run), [1; 4], "tracks in all");
    assert_eq!(run(8), 2, "after a quarter of a second it may be another");
}

#[test]
fn a_ball_of_another_size_is_not_taken_for_one_that_was_pushed() {
    let tracks = |times_as_large: f64| {
        let mut tracker = Tracker::new(TrackerParameters::default());
        for frame in 0..40 {
            let still = sphere(Vector3::new(0.0, 0.0, 2.0));
            let other = sphere(Vector3::new(0.15, 0.0, 2.0));
            let other = Object { radius: other.radius * times_as_large, ..other };
            tracker.update_frame(&header(frame), &[if frame < 20 { still } else { other }]);
        }
        tracker.next_id - 1
    };
    assert_eq!([0.8, 1.0, 1.2].map(tracks), [2, 1, 2]);
}

/// A ball that falls, bounces and rises while it is hidden for 0.6 seconds.
#[test]
fn a_bounce_that_nobody_sees_keeps_the_identity_if_the_floor_is_known() {
    let run = |ballistic| {
        let mut tracker = Tracker::new(TrackerParameters { ballistic, ..TrackerParameters::default() });
        let mut noise = Noise(9);
        let (mut height, mut speed) = (1.2_f64, 0.0_f64);
        for frame in 0..40 {
            height += speed * PERIOD_S - 0.5 * 9.81 * PERIOD_S * PERIOD_S;
            speed -= 9.81 * PERIOD_S;
            if height < 0.1 {
                (height, speed) = (0.2 - height, -0.8 * speed);
            }
            let seen = [sphere(Vector3::new(0.5 * seconds(frame), 2.0, height) + noise.vector(SIGMA_M))];
            let hidden = (8..26).contains(&frame);
            tracker.update_frame(&header(frame), if hidden { &[] } else { &seen });
        }
        tracker.next_id - 1
    };
    assert_eq!(
        run(Some(Ballistic { floor_m: Some(0.0), up: Some([0.0, 0.0, 1.0]), ..Ballistic::default() })),
        1,
        "tracks in all"
    );
    assert!(run(None) > 1, "straight on it would go through the floor");
}

#[test]
fn a_ball_that_lies_does_not_fall() {
    let ballistic = Some(Ballistic { up: Some([0.0, 0.0, 1.0]), ..Ballistic::default() });
    let mut tracker = Tracker::new(TrackerParameters { ballistic, ..TrackerParameters::default() });
    let mut noise = Noise(6);
    let place = Vector3::new(0.0, 2.0, 0.5);
    for frame in 0..60 {
        let hidden = (30..50).contains(&frame);
        let seen = [sphere(place + noise.vector(SIGMA_M))];
        let track = tracker.update_frame(&header(frame), if hidden { &[] } else { &seen })[0];
        let off = (Vector3::from(track.object.center) - place).norm();
        assert!(track.id == 1 && off < 0.06, "frame {frame}: {off} m off");
    }
}

/// Without a pose a ball falls along the camera's y, not towards the camera.
#[test]
fn down_is_along_the_image_where_there_is_no_pose() {
    let ballistic = Some(Ballistic::default());
    let mut tracker = Tracker::new(TrackerParameters { ballistic, ..TrackerParameters::default() });
    let place = |frame: u64| Vector3::new(0.0, 4.905 * seconds(frame).powi(2) - 1.0, 2.0);
    for frame in 0..18 {
        let seen = [sphere(place(frame))];
        let track = tracker.update_frame(&header(frame), if frame < 10 { &seen } else { &[] })[0];
        let off = (Vector3::from(track.object.center) - place(frame)).norm();
        assert!(track.id == 1 && (frame < 8 || off < 0.08), "frame {frame}: {off} m off");
    }
}
