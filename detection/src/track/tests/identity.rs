//! Identities: how they begin, last and end.

use super::*;

#[test]
fn an_identity_survives_five_frames_unseen() {
    let mut tracker = Tracker::new(TrackerParameters::default());
    let mut noise = Noise(3);
    let place = |frame| Vector3::new(-0.5 + 0.9 * seconds(frame), 0.0, 1.5);
    for frame in 0..30 {
        let seen = [Object { confidence: 0.9, ..sphere(place(frame) + noise.vector(SIGMA_M)) }];
        let support = |object: &Object| (object.points, object.rows, object.rms, object.arc, object.confidence);
        let unseen = (15..20).contains(&frame);
        let track = tracker.update_frame(&header(frame), if unseen { &[] } else { &seen })[0];
        let error = (Vector3::from(track.object.center) - place(frame)).norm();
        assert_eq!((track.id, u64::from(track.age)), (1, frame));
        assert!(error < if unseen { 0.03 } else { 0.015 }, "frame {frame}: {error} m off");
        match frame {
            0..2 => assert_eq!(track.track_state(), TrackState::Tentative),
            15..20 => {
                assert_eq!((track.track_state(), u64::from(track.misses)), (TrackState::Coasting, frame - 14));
                assert_eq!((track.object.points, track.object.arc), (0, 0.0));
            }
            _ => {
                assert_eq!((track.track_state(), track.misses), (TrackState::Confirmed, 0));
                assert_eq!(support(&track.object), support(&seen[0]));
            }
        }
    }
}

#[test]
fn an_identity_survives_dropped_frames() {
    let mut tracker = Tracker::new(TrackerParameters::default());
    for frame in [0, 1, 2, 3, 9, 10, 16, 22, 23] {
        let center = Vector3::new(-0.5 + 1.2 * seconds(frame), 0.1, 1.5);
        let tracks = tracker.update_frame(&header(frame), &[sphere(center)]);
        assert_eq!(ids(tracks), [1], "frame {frame}");
    }
}

#[test]
fn what_is_unseen_for_too_long_comes_back_as_another() {
    let config = TrackerParameters { max_coast_s: 0.5, ..TrackerParameters::default() };
    let mut tracker = Tracker::new(config);
    let seen = [sphere(Vector3::new(0.0, 0.0, 1.0))];
    for frame in 0..5 {
        tracker.update_frame(&header(frame), &seen);
    }
    let alive = (5..40).take_while(|&frame| !tracker.update_frame(&header(frame), &[]).is_empty()).count();
    assert_eq!(alive, 15, "frames in half a second");
    assert_eq!(ids(tracker.update_frame(&header(40), &seen)), [2]);
}

#[test]
fn a_gap_in_the_frames_hands_no_identity_to_another() {
    let mut tracker = Tracker::new(TrackerParameters::default());
    let [first, second] = [0.0, 2.0].map(|x| sphere(Vector3::new(x, 0.0, 2.0)));
    for frame in 0..60 {
        assert_eq!(ids(tracker.update_frame(&header(frame), &[first])), [1]);
    }
    assert_eq!(ids(tracker.update_frame(&header(60 + 5 * 30), &[second])), [2]);
}

#[test]
fn a_camera_slower_than_tracks_may_coast_keeps_identities() {
    let mut tracker = Tracker::new(TrackerParameters { max_coast_s: 1.0, ..TrackerParameters::default() });
    for frame in [0, 61, 120, 181, 240, 300, 361] {
        let place = Vector3::new(0.05 * seconds(frame), 0.0, 2.0);
        assert_eq!(ids(tracker.update_frame(&header(frame), &[sphere(place)])), [1], "frame {frame}");
    }
}

/// Frames at intervals of two seconds.
#[test]
fn a_gap_is_usual_that_is_at_most_half_as_long_again_as_the_one_before() {
    for (gap, id) in [(84, 1), (96, 2)] {
        let mut tracker = Tracker::new(TrackerParameters { max_coast_s: 0.5, ..TrackerParameters::default() });
        for frame in [0, 60, 120, 180, 180 + gap] {
            tracker.update_frame(&header(frame), &[sphere(Vector3::new(0.0, 0.0, 2.0))]);
        }
        assert_eq!(ids(tracker.tracks()), [id], "after {} s", seconds(gap));
    }
}

#[test]
fn crossing_objects_keep_their_identities() {
    for second in [cylinder, sphere] {
        let mut tracker = Tracker::new(TrackerParameters::default());
        let mut noise = Noise(5);
        for frame in 0..60 {
            let x = -0.6 + 0.6 * seconds(frame);
            let left_to_right = sphere(Vector3::new(x, 0.0, 1.5) + noise.vector(SIGMA_M));
            let right_to_left = second(Vector3::new(-x, 0.0, 1.5) + noise.vector(SIGMA_M));
            let swapped = [right_to_left, left_to_right];
            let given = [left_to_right, right_to_left];
            let tracks = tracker.update_frame(&header(frame), if frame % 2 == 0 { &given } else { &swapped });
            assert_eq!(ids(tracks), [1, 2], "frame {frame}");
            assert_eq!(tracks[1].object.kind, right_to_left.kind);
            if frame > 20 {
                assert!(tracks[0].velocity[0] > 0.4 && tracks[1].velocity[0] < -0.4, "frame {frame}: {tracks:?}");
            }
        }
    }
}

/// Counts how often consecutive sightings of one of `count` equal balls, 3 cm apart, belong to different tracks, in 20 runs of
/// two and a half seconds. `sigma_m` is the noise across and along the view, `is_hidden` says which ball is hidden when.
fn switches(count: u32, rate_hz: f64, sigma_m: [f64; 2], is_hidden: impl Fn(u32, f64) -> bool) -> u32 {
    let mut switches = 0;
    for seed in 0..20 {
        let (mut tracker, mut noise) = (Tracker::new(TrackerParameters::default()), Noise(300 + seed));
        let mut before = vec![None; count as usize];
        for frame in 0..(2.5 * rate_hz) as u64 {
            let time = frame as f64 / rate_hz;
            let seen = (0..count).filter(|ball| !is_hidden(*ball, time)).map(|ball| {
                let [x, y, z] = [sigma_m[0], sigma_m[0], sigma_m[1]].map(|sigma| sigma * noise.normal());
                let center = Vector3::new(0.03 * f64::from(ball) + x, y, 1.5 + z);
                let variances = [sigma_m[0], sigma_m[0], sigma_m[1]].map(|sigma| sigma * sigma);
                let mut object = Object { points: ball, radius: 0.01 + 0.001 * noise.normal(), ..sphere(center) };
                object.sigma.center = Matrix3::from_diagonal(&variances.into()).into();
                object
            });
            let objects: Vec<_> = seen.collect();
            let tracks = tracker.update(&objects, 1 + (time * 1e9) as u64);
            for track in tracks.iter().filter(|track| track.misses == 0) {
                let before = before[track.object.points as usize].replace(track.id);
                switches += u32::from(before.is_some_and(|before| before != track.id));
            }
        }
    }
    switches
}

#[test]
fn equal_balls_that_stand_close_keep_their_identities_from_the_first_frame_on() {
    assert_eq!(switches(5, 30.0, [0.001, 0.003], |_, _| false), 0);
}

#[test]
fn what_is_hidden_does_not_take_the_sights_of_its_neighbour() {
    let switches = switches(2, 100.0, [0.005, 0.02], |ball, time| ball == 1 && (1.0..1.9).contains(&time));
    assert!(switches < 20, "{switches} switches");
}

/// Three balls cross at one place at the same time, two of them hidden there, over many runs of noise; measured by CLEAR-MOT.
#[test]
fn crossing_balls_are_not_mixed_up() {
    for seed in 0..20 {
        let mut tracker = Tracker::new(TrackerParameters::default());
        let mut noise = Noise(100 + seed);
        let (mut found, mut there) = (0, 0);
        for frame in 0..120 {
            let way = -1.0 + 0.5 * seconds(frame);
            let places = [Vector3::new(way, 0.0, 1.5), Vector3::new(-way, 0.02, 1.6), Vector3::new(0.0, way, 1.7)];
            let seen = places.iter().enumerate().filter(|(index, _)| *index == 0 || way.abs() > 0.15);
            let objects: Vec<_> = seen.map(|(_, place)| sphere(place + noise.vector(SIGMA_M))).collect();
            let tracks = tracker.update_frame(&header(frame), &objects);
            there += objects.len();
            let right = |track: &&Track| {
                let place = places.get(track.id as usize - 1).unwrap_or(&places[0]);
                track.track_state() == TrackState::Confirmed
                    && (Vector3::from(track.object.center) - place).norm() < 0.03
            };
            found += tracks.iter().filter(right).count();
            assert!(tracks.iter().all(|track| track.id <= 3), "seed {seed}, frame {frame}: a fourth identity");
        }
        let share = found as f64 / there as f64;
        assert!(share > 0.97, "seed {seed}: {share} of the sights under their first identity");
    }
}

/// Two pipes of one radius that pass through each other, one upright and one lying.
#[test]
fn crossing_pipes_are_told_apart_by_their_axes() {
    for seed in 0..20 {
        let mut tracker = Tracker::new(TrackerParameters::default());
        let mut noise = Noise(200 + seed);
        for frame in 0..60 {
            let way = 0.2 * (seconds(frame) - 1.0);
            let pipe = |x: f64, axis, noise: &mut Noise| Object {
                axis,
                ..cylinder(Vector3::new(x, 0.0, 1.5) + noise.vector(SIGMA_M))
            };
            let upright = pipe(way, [0.0, 1.0, 0.0], &mut noise);
            let lying = pipe(-way, [1.0, 0.0, 0.0], &mut noise);
            let tracks = tracker.update_frame(&header(frame), &[upright, lying]);
            assert_eq!(ids(tracks), [1, 2], "seed {seed}, frame {frame}");
            let leaning = tracks[0].object.axis[1].abs();
            assert!(leaning > 0.99, "seed {seed}, frame {frame}: the first is the other one, {leaning}");
        }
    }
}

#[test]
fn a_track_is_confirmed_once_and_an_identity_given_once() {
    let mut tracker = Tracker::new(TrackerParameters::default());
    let (near, far) = (Vector3::new(0.0, 0.0, 1.0), Vector3::new(1.0, 0.0, 3.0));
    let mut confirmed = Vec::new();
    for frame in 0..100 {
        let objects = [sphere(near), cylinder(far)];
        let visible = match frame {
            0..2 => &objects[1..],
            10..60 => &objects[..1],
            _ => &objects,
        };
        let tracks = tracker.update_frame(&header(frame), visible);
        assert!(ids(tracks).is_sorted());
        confirmed.extend(tracker.newly_confirmed().iter().map(|kind| (frame, *kind)));
    }
    assert_eq!(confirmed, [(2, ObjectKind::Cylinder), (4, ObjectKind::Sphere), (62, ObjectKind::Cylinder)]);
    assert_eq!(ids(tracker.update_frame(&header(100), &[])), [2, 3]);
}

#[test]
fn a_false_alarm_is_never_confirmed() {
    let mut tracker = Tracker::new(TrackerParameters::default());
    let far_apart = |frame: u64| sphere(Vector3::new(frame as f64 * 3.0, 0.0, 2.0));
    for frame in 0..40 {
        let tracks = tracker.update_frame(&header(frame), &[far_apart(frame)]);
        assert!(states(tracks).iter().all(|state| *state == TrackState::Tentative));
        assert!(tracks.len() <= 3, "tentative tracks go after three misses");
        assert_eq!(ids(tracks).last(), Some(&(frame + 1)), "no identity is given again");
    }
}

#[test]
fn a_source_started_anew_keeps_its_tracks_only_if_it_goes_on() {
    let mut tracker = Tracker::new(TrackerParameters::default());
    let seen = [sphere(Vector3::new(0.0, 0.0, 1.0))];
    for frame in 0..10 {
        tracker.update_frame(&header(frame), &seen);
    }
    let goes_on = Header { epoch: 2, stamp_ns: 0, ..header(12) };
    assert_eq!(ids(tracker.update_frame(&goes_on, &seen)), [1]);
    let begins = Header { epoch: 3, ..header(0) };
    let tracks = tracker.update_frame(&begins, &seen);
    assert_eq!((ids(tracks), states(tracks)), (vec![2], vec![TrackState::Tentative]));
}

/// A track with one sighting is near to everything in units of its own uncertainty; that must not win it the sightings of
/// another.
#[test]
fn a_new_track_does_not_take_the_sights_of_an_old_one() {
    let mut tracker = Tracker::new(exact());
    let (old, new) = (Vector3::new(0.0, 0.0, 1.0), Vector3::new(0.06, 0.0, 1.0));
    for frame in 0..20 {
        tracker.update_frame(&header(frame), &[sphere(old)]);
    }
    tracker.update_frame(&header(20), &[sphere(old), sphere(new)]);
    let tracks = tracker.update_frame(&header(21), &[sphere(old + Vector3::new(3.0 * SIGMA_M, 0.0, 0.0))]);
    assert_eq!((tracks[0].misses, tracks[1].misses), (0, 1));
}
