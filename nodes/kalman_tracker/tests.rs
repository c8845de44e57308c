//! Tests of the tracker as a whole, on simulated detections.

use super::ballistic::Ballistic;
use super::filter::Motion;
use super::{KalmanTrackerConfig, Tracker};
use conicflow_messages::{HAS_POSE, Header, Object, ObjectKind, ObjectSigma, Track, TrackState};
use nalgebra::{Cholesky, Matrix2, Matrix3, Rotation3, Vector2, Vector3};

const PERIOD_S: f64 = 1.0 / 30.0;
const SIGMA_M: f64 = 0.003;

/// Normally distributed numbers from a seed: SplitMix64 (Steele, Lea, Flood 2014) and the transform of Box and Muller.
struct Noise(u64);

impl Noise {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut bits = (self.0 ^ (self.0 >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        bits = (bits ^ (bits >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((bits ^ (bits >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
    }

    fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }

    fn vector(&mut self, sigma: f64) -> Vector3<f64> {
        Vector3::from_fn(|_, _| self.normal() * sigma)
    }
}

/// Without additions to the sigma of the detections, which here is the true one.
fn exact() -> KalmanTrackerConfig {
    KalmanTrackerConfig { floor_center_m: 1e-9, floor_along_axis: 0.0, ..KalmanTrackerConfig::default() }
}

fn header(sequence: u64) -> Header {
    Header { epoch: 1, sequence, stamp_ns: (sequence as f64 * PERIOD_S * 1e9) as u64, ..Header::default() }
}

fn seconds(sequence: u64) -> f64 {
    sequence as f64 * PERIOD_S
}

fn sphere(center: Vector3<f64>) -> Object {
    let variance = SIGMA_M * SIGMA_M;
    let center_covariance = Matrix3::from_diagonal_element(variance).into();
    let sigma = ObjectSigma { center: center_covariance, radius: 0.001, ..ObjectSigma::default() };
    let kind = ObjectKind::Sphere.code();
    Object {
        kind,
        points: 500,
        rows: 30,
        center: center.into(),
        radius: 0.1,
        sigma,
        rms: 0.002,
        arc: 2.0,
        ..Object::default()
    }
}

fn cylinder(center: Vector3<f64>) -> Object {
    let sigma = ObjectSigma { axis: 0.01, length: 0.005, ..sphere(center).sigma };
    Object { kind: ObjectKind::Cylinder.code(), axis: [0.0, -1.0, 0.0], length: 0.3, sigma, ..sphere(center) }
}

fn cone(center: Vector3<f64>) -> Object {
    let (half_angle, sigma) = (0.2, ObjectSigma { half_angle: 0.01, ..cylinder(center).sigma });
    Object { kind: ObjectKind::Cone.code(), axis: [0.0, 1.0, 0.0], half_angle, sigma, ..cylinder(center) }
}

fn ids(tracks: &[Track]) -> Vec<u64> {
    tracks.iter().map(|track| track.id).collect()
}

fn states(tracks: &[Track]) -> Vec<TrackState> {
    tracks.iter().map(Track::track_state).collect()
}

/// The squared innovations of a filter that knows the truth's statistics are chi-square with 3 degrees of freedom: the
/// mean of n lies within `3 +- 1.96 sqrt(6 / n)` in 95 % of all runs.
#[test]
fn innovations_are_as_large_as_the_filter_expects() {
    let (frames, density, speed_sigma) = (20_000, 0.25, 0.8);
    let covariance = Matrix3::new(9e-6, 2e-6, 0.0, 2e-6, 4e-6, 1e-6, 0.0, 1e-6, 2.5e-5);
    let root = Cholesky::new(covariance).unwrap().l();
    let mut noise = Noise(7);
    let mut position = Vector3::new(0.2, -0.1, 2.0);
    let mut velocity = noise.vector(speed_sigma);
    let mut filter = Motion::new(position + root * noise.vector(1.0), covariance, speed_sigma);
    let mut sum = 0.0;
    for frame in 0..frames {
        let dt = PERIOD_S * [1.0, 1.0, 2.0, 6.0][frame % 4];
        let step = Matrix2::new(dt.powi(3) / 3.0, dt * dt / 2.0, dt * dt / 2.0, dt) * density;
        let step = Cholesky::new(step).unwrap().l();
        position += velocity * dt;
        for axis in 0..3 {
            let change = step * Vector2::new(noise.normal(), noise.normal());
            position[axis] += change.x;
            velocity[axis] += change.y;
        }
        filter.predict(dt, density);
        let innovation = filter.innovation(&(position + root * noise.vector(1.0)), &covariance).unwrap();
        sum += innovation.distance2();
        filter.update(&innovation, &covariance);
    }
    let (mean, bound) = (sum / frames as f64, 1.96 * (6.0 / frames as f64).sqrt());
    assert!((mean - 3.0).abs() < bound, "mean of the squared innovations {mean}, expected 3 +- {bound}");
}

/// Over many runs at constant velocity, the squared error of the velocity in units of the covariance that the tracker
/// gives has a mean of 3, within `1.96 sqrt(6 / n)`.
#[test]
fn the_velocity_is_right_within_its_sigma() {
    let runs = 400;
    let config = KalmanTrackerConfig { acceleration: 0.0, gate: 1e9, ..exact() };
    let mut noise = Noise(11);
    let (mut sum, mut largest) = (0.0, 0.0_f64);
    for _ in 0..runs {
        let velocity = noise.vector(config.initial_speed_mps);
        let mut tracker = Tracker::new(config.clone());
        let mut last = Track::default();
        for frame in 0..20 {
            let center = Vector3::new(0.0, 0.0, 2.0) + velocity * seconds(frame) + noise.vector(SIGMA_M);
            last = tracker.update(&header(frame), &[sphere(center)])[0];
        }
        let error = Vector3::from(last.velocity) - velocity;
        let spread = Cholesky::new(Matrix3::from(last.velocity_covariance)).unwrap();
        sum += error.dot(&spread.solve(&error));
        largest = largest.max(error.norm());
    }
    let (mean, bound) = (sum / f64::from(runs), 1.96 * (6.0 / f64::from(runs)).sqrt());
    assert!((mean - 3.0).abs() < bound, "mean of the squared errors {mean}, expected 3 +- {bound}");
    assert!(largest < 0.02, "largest error {largest} m/s");
}

#[test]
fn an_identity_survives_five_frames_unseen() {
    let mut tracker = Tracker::new(KalmanTrackerConfig::default());
    let mut noise = Noise(3);
    let place = |frame| Vector3::new(-0.5 + 0.9 * seconds(frame), 0.0, 1.5);
    for frame in 0..30 {
        let seen = [sphere(place(frame) + noise.vector(SIGMA_M))];
        let unseen = (15..20).contains(&frame);
        let track = tracker.update(&header(frame), if unseen { &[] } else { &seen })[0];
        let error = (Vector3::from(track.object.center) - place(frame)).norm();
        assert_eq!((track.id, u64::from(track.age)), (1, frame));
        assert!(error < if unseen { 0.03 } else { 0.015 }, "frame {frame}: {error} m off");
        match frame {
            0..2 => assert_eq!(track.track_state(), TrackState::Tentative),
            15..20 => {
                assert_eq!((track.track_state(), u64::from(track.misses)), (TrackState::Coasting, frame - 14));
                assert_eq!((track.object.points, track.object.arc), (0, 0.0));
            }
            _ => assert_eq!((track.track_state(), track.misses, track.object.points), (TrackState::Confirmed, 0, 500)),
        }
    }
}

#[test]
fn an_identity_survives_dropped_frames() {
    let mut tracker = Tracker::new(KalmanTrackerConfig::default());
    for frame in [0, 1, 2, 3, 9, 10, 16, 22, 23] {
        let center = Vector3::new(-0.5 + 1.2 * seconds(frame), 0.1, 1.5);
        let tracks = tracker.update(&header(frame), &[sphere(center)]);
        assert_eq!(ids(tracks), [1], "frame {frame}");
    }
}

#[test]
fn what_is_unseen_for_too_long_comes_back_as_another() {
    let config = KalmanTrackerConfig { max_coast_s: 0.5, ..KalmanTrackerConfig::default() };
    let mut tracker = Tracker::new(config);
    let seen = [sphere(Vector3::new(0.0, 0.0, 1.0))];
    for frame in 0..5 {
        tracker.update(&header(frame), &seen);
    }
    let alive = (5..40).take_while(|&frame| !tracker.update(&header(frame), &[]).is_empty()).count();
    assert_eq!(alive, 15, "frames in half a second");
    assert_eq!(ids(tracker.update(&header(40), &seen)), [2]);
}

#[test]
fn crossing_objects_keep_their_identities() {
    for second in [cylinder, sphere] {
        let mut tracker = Tracker::new(KalmanTrackerConfig::default());
        let mut noise = Noise(5);
        for frame in 0..60 {
            let x = -0.6 + 0.6 * seconds(frame);
            let left_to_right = sphere(Vector3::new(x, 0.0, 1.5) + noise.vector(SIGMA_M));
            let right_to_left = second(Vector3::new(-x, 0.0, 1.5) + noise.vector(SIGMA_M));
            let swapped = [right_to_left, left_to_right];
            let given = [left_to_right, right_to_left];
            let tracks = tracker.update(&header(frame), if frame % 2 == 0 { &given } else { &swapped });
            assert_eq!(ids(tracks), [1, 2], "frame {frame}");
            assert_eq!(tracks[1].object.kind, right_to_left.kind);
            if frame > 20 {
                assert!(tracks[0].velocity[0] > 0.4 && tracks[1].velocity[0] < -0.4, "frame {frame}: {tracks:?}");
            }
        }
    }
}

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

#[test]
fn a_bounce_keeps_the_identity() {
    let run = |manoeuvre_mps| {
        let mut tracker = Tracker::new(KalmanTrackerConfig { manoeuvre_mps, ..KalmanTrackerConfig::default() });
        let mut noise = Noise(9);
        let (mut height, mut speed) = (0.8_f64, 0.0_f64);
        for frame in 0..60 {
            speed -= 9.81 * PERIOD_S;
            height += speed * PERIOD_S;
            if height < 0.1 {
                (height, speed) = (0.2 - height, -0.8 * speed);
            }
            tracker.update(&header(frame), &[sphere(Vector3::new(0.0, 1.0 - height, 2.0) + noise.vector(SIGMA_M))]);
        }
        tracker.next_id - 1
    };
    assert_eq!(run(2.0), 1, "tracks in all");
    assert!(run(0.0) > 1, "a bounce lies outside the gate of a motion without pushes");
}

/// A ball that falls, bounces and rises while it is hidden for 0.6 seconds.
#[test]
fn a_bounce_that_nobody_sees_keeps_the_identity_if_the_floor_is_known() {
    let run = |ballistic| {
        let mut tracker = Tracker::new(KalmanTrackerConfig { ballistic, ..KalmanTrackerConfig::default() });
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
            tracker.update(&header(frame), if hidden { &[] } else { &seen });
        }
        tracker.next_id - 1
    };
    assert_eq!(run(Some(Ballistic { floor_m: Some(0.0), ..Ballistic::default() })), 1, "tracks in all");
    assert!(run(None) > 1, "straight on it would go through the floor");
}

#[test]
fn a_ball_that_lies_does_not_fall() {
    let ballistic = Some(Ballistic::default());
    let mut tracker = Tracker::new(KalmanTrackerConfig { ballistic, ..KalmanTrackerConfig::default() });
    let mut noise = Noise(6);
    let place = Vector3::new(0.0, 2.0, 0.5);
    for frame in 0..60 {
        let hidden = (30..50).contains(&frame);
        let seen = [sphere(place + noise.vector(SIGMA_M))];
        let track = tracker.update(&header(frame), if hidden { &[] } else { &seen })[0];
        let off = (Vector3::from(track.object.center) - place).norm();
        assert!(track.id == 1 && off < 0.06, "frame {frame}: {off} m off");
    }
}

/// CLEAR-MOT of three balls that cross at one place at the same time, two of them hidden there, over many runs of noise.
#[test]
fn crossing_balls_are_not_mixed_up() {
    for seed in 0..20 {
        let mut tracker = Tracker::new(KalmanTrackerConfig::default());
        let mut noise = Noise(100 + seed);
        let (mut found, mut there) = (0, 0);
        for frame in 0..120 {
            let way = -1.0 + 0.5 * seconds(frame);
            let places = [Vector3::new(way, 0.0, 1.5), Vector3::new(-way, 0.02, 1.6), Vector3::new(0.0, way, 1.7)];
            let seen = places.iter().enumerate().filter(|(index, _)| *index == 0 || way.abs() > 0.15);
            let objects: Vec<_> = seen.map(|(_, place)| sphere(place + noise.vector(SIGMA_M))).collect();
            let tracks = tracker.update(&header(frame), &objects);
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

#[test]
fn a_track_is_confirmed_once_and_an_identity_given_once() {
    let mut tracker = Tracker::new(KalmanTrackerConfig::default());
    let (near, far) = (Vector3::new(0.0, 0.0, 1.0), Vector3::new(1.0, 0.0, 3.0));
    let mut confirmed = Vec::new();
    for frame in 0..100 {
        let objects = [sphere(near), cylinder(far)];
        let visible = match frame {
            0..2 => &objects[1..],
            10..60 => &objects[..1],
            _ => &objects,
        };
        let tracks = tracker.update(&header(frame), visible);
        assert!(ids(tracks).is_sorted());
        confirmed.extend_from_slice(tracker.newly_confirmed());
    }
    assert_eq!(confirmed, [ObjectKind::Cylinder, ObjectKind::Sphere, ObjectKind::Cylinder]);
    assert_eq!(ids(tracker.update(&header(100), &[])), [2, 3]);
}

#[test]
fn a_false_alarm_is_never_confirmed() {
    let mut tracker = Tracker::new(KalmanTrackerConfig::default());
    let far_apart = |frame: u64| sphere(Vector3::new(frame as f64 * 3.0, 0.0, 2.0));
    for frame in 0..40 {
        let tracks = tracker.update(&header(frame), &[far_apart(frame)]);
        assert!(states(tracks).iter().all(|state| *state == TrackState::Tentative));
        assert!(tracks.len() <= 3, "tentative tracks go after three misses");
        assert_eq!(ids(tracks).last(), Some(&(frame + 1)), "no identity is given again");
    }
}

#[test]
fn a_source_started_anew_keeps_its_tracks_only_if_it_goes_on() {
    let mut tracker = Tracker::new(KalmanTrackerConfig::default());
    let seen = [sphere(Vector3::new(0.0, 0.0, 1.0))];
    for frame in 0..10 {
        tracker.update(&header(frame), &seen);
    }
    let goes_on = Header { epoch: 2, stamp_ns: 0, ..header(12) };
    assert_eq!(ids(tracker.update(&goes_on, &seen)), [1]);
    let begins = Header { epoch: 3, ..header(0) };
    let tracks = tracker.update(&begins, &seen);
    assert_eq!((ids(tracks), states(tracks)), (vec![2], vec![TrackState::Tentative]));
}

#[test]
fn the_sign_of_a_cylinders_axis_is_kept() {
    let mut tracker = Tracker::new(KalmanTrackerConfig::default());
    let axis = Vector3::new(0.05, 1.0, 0.0).normalize();
    for frame in 0..60 {
        let sign = if frame % 3 == 0 { 1.0 } else { -1.0 };
        let tilt = if frame == 0 { Vector3::y() } else { axis };
        let object = Object { axis: (tilt * sign).into(), ..cylinder(Vector3::new(0.0, 0.0, 1.0)) };
        let track = tracker.update(&header(frame), &[object])[0];
        let off = (Vector3::from(track.object.axis) - axis).norm();
        assert!(off < if frame < 30 { 0.06 } else { 1e-6 }, "frame {frame}: {off}");
    }
}

#[test]
fn a_sphere_in_the_place_of_a_cylinder_is_another_object() {
    let mut tracker = Tracker::new(KalmanTrackerConfig::default());
    let place = Vector3::new(0.0, 0.0, 1.0);
    for frame in 0..5 {
        tracker.update(&header(frame), &[cylinder(place)]);
    }
    let tracks = tracker.update(&header(5), &[sphere(place)]);
    assert_eq!(ids(tracks), [1, 2]);
    assert_eq!(states(tracks), [TrackState::Coasting, TrackState::Tentative]);
}

/// A track seen once is near to everything in units of its own uncertainty; that must not win it what belongs to another.
#[test]
fn a_new_track_does_not_take_the_sights_of_an_old_one() {
    let mut tracker = Tracker::new(exact());
    let (old, new) = (Vector3::new(0.0, 0.0, 1.0), Vector3::new(0.06, 0.0, 1.0));
    for frame in 0..20 {
        tracker.update(&header(frame), &[sphere(old)]);
    }
    tracker.update(&header(20), &[sphere(old), sphere(new)]);
    let tracks = tracker.update(&header(21), &[sphere(old + Vector3::new(3.0 * SIGMA_M, 0.0, 0.0))]);
    assert_eq!((tracks[0].misses, tracks[1].misses), (0, 1));
}

#[test]
fn the_shape_is_the_one_seen_most_often() {
    let mut tracker = Tracker::new(KalmanTrackerConfig::default());
    let place = Vector3::new(0.0, 0.0, 1.0);
    let seen = [cylinder(place), cone(place), cone(place), cylinder(place), cone(place)];
    let kinds = [ObjectKind::Cylinder, ObjectKind::Cylinder, ObjectKind::Cone, ObjectKind::Cone, ObjectKind::Cone];
    for (frame, (object, kind)) in (0..).zip(seen.iter().zip(kinds)) {
        let track = tracker.update(&header(frame), &[*object])[0];
        assert_eq!((track.id, track.object.shape()), (1, kind));
        assert!((track.object.axis[1].abs() - 1.0).abs() < 1e-12);
        assert_eq!(track.object.axis[1] > 0.0, kind == ObjectKind::Cone, "a cone points from apex to base");
    }
}

#[test]
fn a_cone_fits_together() {
    let mut tracker = Tracker::new(KalmanTrackerConfig::default());
    let mut noise = Noise(2);
    let mut last = Object::default();
    for frame in 0..10 {
        let place = Vector3::new(0.1, 0.2, 1.0) + noise.vector(SIGMA_M);
        let half_angle = 0.2 + noise.normal() * 0.01;
        last = tracker.update(&header(frame), &[Object { half_angle, ..cone(place) }])[0].object;
    }
    let from_apex = Vector3::from(last.center) - Vector3::from(last.apex);
    assert!((from_apex.norm() * last.half_angle.tan() - last.radius).abs() < 1e-12);
    assert!((from_apex.normalize() - Vector3::from(last.axis)).norm() < 1e-12);
    assert!((last.base_radius - last.top_radius - last.length * last.half_angle.tan()).abs() < 1e-12);
    assert!((last.half_angle - 0.2).abs() < 0.01 && last.sigma.half_angle < 0.01);
}

#[test]
fn what_stands_still_is_known_better_than_each_measurement() {
    let mut tracker = Tracker::new(KalmanTrackerConfig { acceleration: 0.01, ..exact() });
    let mut noise = Noise(4);
    let place = Vector3::new(0.3, 0.0, 2.0);
    let (mut squares, mut given) = (0.0, 0.0);
    for frame in 0..2000 {
        let radius = 0.1 + noise.normal() * 0.001;
        let track = tracker.update(&header(frame), &[Object { radius, ..sphere(place + noise.vector(SIGMA_M)) }])[0];
        if frame >= 100 {
            squares += (Vector3::from(track.object.center) - place).norm_squared() / 3.0 / 1900.0;
            given = track.object.sigma.center[0][0];
            assert!((track.object.radius - 0.1).abs() < 0.0007);
        }
    }
    assert!(squares.sqrt() < SIGMA_M / 2.0, "standard deviation {}", squares.sqrt());
    assert!(squares < 1.3 * given, "the filter promises {given} and keeps {squares}");
}
