//! Tests of the whole tracker on simulated detections, and their common helpers.

mod camera;
mod consistency;
mod identity;
mod motion;
mod shape;

use super::{NoPose, Tracker, TrackerParameters};
use conicflow_messages::{Header, Object, ObjectKind, ObjectSigma, Track, TrackState};
use nalgebra::{Matrix3, Vector3};

const PERIOD_S: f64 = 1.0 / 30.0;
const SIGMA_M: f64 = 0.003;

/// Normally distributed numbers from a seed: SplitMix64 (Steele, Lea, Flood 2014) and the Box-Muller transform.
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

/// Nothing is added to the sigma of the detections, which is the true one here, and their errors are independent.
fn exact() -> TrackerParameters {
    TrackerParameters { floor_center_m: 1e-9, floor_along_axis: 0.0, common_share: 0.0, ..TrackerParameters::default() }
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

#[test]
fn who_has_no_headers_gets_the_same_tracks() {
    for stamps_advance in [true, false] {
        let (mut by_header, mut by_stamp) = (Tracker::default(), Tracker::default());
        for sequence in 0..6 {
            let objects = [sphere(Vector3::new(0.1 * seconds(sequence), 0.0, 1.5))];
            let stamp_ns = if stamps_advance { header(sequence).stamp_ns } else { 0 };
            let header = Header { epoch: 0, stamp_ns, ..header(sequence) };
            assert_eq!(by_header.update_frame(&header, &objects), by_stamp.update(&objects, stamp_ns));
        }
        assert_eq!(states(by_stamp.tracks()), [TrackState::Confirmed]);
    }
}

#[test]
fn a_camera_that_tells_its_pose_may_move() {
    let mut tracker = Tracker::default();
    for sequence in 0..30 {
        let along = 0.5 * seconds(sequence);
        let pose = [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, along]];
        let ball = [sphere(Vector3::new(0.0, 0.0, 2.0 - along))];
        tracker.update_from(0, &ball, header(sequence).stamp_ns, pose).unwrap();
    }
    let velocity = Vector3::from(tracker.tracks()[0].velocity);
    assert!(velocity.norm() < 0.02, "the ball stands still: {velocity:?}");
}

#[test]
fn how_fast_something_moves_follows_from_the_stamps_where_the_camera_tells_its_pose_too() {
    let (mut tracker, still) = (Tracker::default(), [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);
    for sequence in 0..30 {
        let ball = sphere(Vector3::new(0.2 * seconds(sequence), 0.0, 1.5));
        tracker.update_from(0, &[ball], 2 * header(sequence).stamp_ns, still).unwrap();
    }
    let [along, ..] = tracker.tracks()[0].velocity;
    assert!((along - 0.1).abs() < 0.01, "the frames came half as often: {along}");
}

#[test]
fn of_several_cameras_each_is_known_by_its_number_and_none_by_what_is_no_pose() {
    let (mut tracker, still) = (Tracker::default(), [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]]);
    for sequence in 0..30 {
        for (camera, seen) in [(7, &[sphere(Vector3::new(0.0, 0.0, 2.0))][..]), (8, &[]), (9, &[])] {
            tracker.update_from(camera, seen, header(sequence).stamp_ns, still).unwrap();
        }
    }
    assert_eq!((ids(tracker.tracks()), states(tracker.tracks())), (vec![1], vec![TrackState::Confirmed]));
    let tracks = tracker.tracks().to_vec();
    for no_pose in [[[0.4; 4]; 3], [[f64::NAN; 4]; 3], still.map(|[x, y, z, _]| [x, y, z, f64::INFINITY])] {
        assert_eq!(tracker.update_from(7, &[], header(30).stamp_ns, no_pose), Err(NoPose));
    }
    assert_eq!(tracker.tracks(), tracks);
}
