//! The follower: turns tracks into a velocity command for a robot, which drives towards an object and stops before it.
//!
//! The command is the velocity of the camera along its own axes; without a command the robot stands still. A source closes the
//! loop by reading it as a side input, as latest value.

use conicflow_dataflow::{ConfigFault, Context, Output, SideInputs, Stage, StageError};
use conicflow_detection::gravity;
use conicflow_messages::{Frame, Header, Message, ObjectKind, Text, Track, TrackState, Velocity};
use nalgebra::{Matrix3, Vector3};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;
use std::path::Path;

/// The shape to follow.
#[derive(Deserialize, Serialize, JsonSchema)]
#[serde(remote = "ObjectKind", rename_all = "snake_case")]
#[schemars(rename = "TargetShape")]
enum TargetShape {
    /// A sphere.
    Sphere,
    /// A cylinder.
    Cylinder,
    /// A cone.
    Cone,
}

/// Parameters of `follower`.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct FollowerConfig {
    /// The shape that is followed: the nearest of its kind, and then that one until it is lost.
    #[serde(with = "TargetShape")]
    pub quarry: ObjectKind,
    /// Distance over ground at which the robot stands still, in metres.
    #[schemars(range(min = 0.0))]
    pub stop_distance_m: f64,
    /// Speed per metre of distance beyond `stop_distance_m`, in 1/s.
    #[schemars(range(min = 0.0))]
    pub gain: f64,
    /// Greatest speed, in m/s.
    #[schemars(range(min = 0.0))]
    pub max_speed_mps: f64,
    /// Up direction, as a vector in the world where the frames carry a pose, else in the camera's frame; none: the world's z, [0,
    /// 0, 1], with a pose, and -y, [0, -1, 0], without. The robot does not leave the ground.
    pub up: Option<[f64; 3]>,
}

impl Default for FollowerConfig {
    fn default() -> Self {
        Self { quarry: ObjectKind::Sphere, stop_distance_m: 1.0, gain: 1.5, max_speed_mps: 0.8, up: None }
    }
}

/// Follows one track.
pub struct Follower {
    config: FollowerConfig,
    followed: Option<u64>,
    /// Last known rotation of each camera, `world_from_camera`.
    rotations: BTreeMap<Text<32>, Matrix3<f64>>,
}

impl Follower {
    /// Creates a follower that has seen nothing.
    pub fn new(config: FollowerConfig) -> Self {
        Self { config, followed: None, rotations: BTreeMap::new() }
    }

    /// Returns the velocity towards the followed track, if there is one.
    pub fn command(&mut self, header: &Header, tracks: &[Track]) -> Option<Velocity> {
        let up = self.up_in_camera(header);
        let known = tracks.iter().find(|track| Some(track.id) == self.followed);
        let track = known.or_else(|| self.nearest(tracks));
        self.followed = track.map(|track| track.id);
        let linear = self.velocity(&up, track?).into();
        Some(Velocity { linear, frame: Frame::Camera.code(), ..Velocity::default() })
    }

    fn nearest<'a>(&self, tracks: &'a [Track]) -> Option<&'a Track> {
        let fitting = tracks.iter().filter(|track| track.object.shape() == self.config.quarry);
        let sure = fitting.filter(|track| track.track_state() == TrackState::Confirmed);
        let distance = |track: &Track| Vector3::from(track.object.center).norm();
        sure.min_by(|a, b| distance(a).total_cmp(&distance(b)))
    }

    /// Returns a velocity along the camera's axes, proportional to the distance over ground beyond `stop_distance_m`.
    fn velocity(&self, up: &Vector3<f64>, track: &Track) -> Vector3<f64> {
        let center = Vector3::from(track.object.center);
        let level = center - up * center.dot(up);
        let distance = level.norm();
        let limit = self.config.max_speed_mps;
        let speed = (self.config.gain * (distance - self.config.stop_distance_m)).clamp(-limit, limit);
        level.try_normalize(1e-9).map_or_else(Vector3::zeros, |ahead| ahead * speed)
    }

    /// Returns the up direction in the camera's frame, by the camera's pose or, if the frame has none, the last known one.
    fn up_in_camera(&mut self, header: &Header) -> Vector3<f64> {
        let camera = header.origin();
        if let Some(rows) = header.pose() {
            self.rotations.insert(camera, Matrix3::from_fn(|row, column| rows[row][column]));
        }
        let rotation = self.rotations.get(&camera);
        let up = gravity::unit(self.config.up, rotation.is_some());
        rotation.map_or(up, |rotation| rotation.tr_mul(&up))
    }
}

impl Stage for Follower {
    const NAME: &'static str = "follower";
    const SUMMARY: &'static str = "Turns tracks into a velocity command: towards an object, and to a halt before it";
    type Config = FollowerConfig;
    type Input = Track;
    type Output = Velocity;

    fn faults(config: &Self::Config, _: &Path) -> Vec<ConfigFault> {
        gravity::fault("up", config.up).into_iter().collect()
    }

    fn new(config: FollowerConfig, _: &Context) -> Result<Self, StageError> {
        Ok(Self::new(config))
    }

    fn step(
        &mut self,
        input: &Message<Track>,
        _: &SideInputs,
        output: &mut Output<Velocity>,
    ) -> Result<(), StageError> {
        if let Some(command) = self.command(input.header, input.items) {
            output.push(command);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::{HAS_POSE, Object};

    /// The header of a camera that looks along the world's y, with z up.
    fn header() -> Header {
        let world_from_camera = [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.5]];
        Header { flags: HAS_POSE, world_from_camera, ..Header::default() }
    }

    fn ball(id: u64, z: f64) -> Track {
        let object = Object { center: [0.0, 0.35, z], radius: 0.15, ..Object::default() };
        Track { id, state: TrackState::Confirmed.code(), object, velocity: [9.0; 3], ..Track::default() }
    }

    #[test]
    fn it_drives_ahead_over_ground_and_halts() {
        let mut follower = Follower::new(FollowerConfig::default());
        let velocity = |follower: &mut Follower, z| follower.command(&header(), &[ball(1, z)]).unwrap().linear;
        let close = |velocity: [f64; 3], ahead: f64| (Vector3::from(velocity) - Vector3::z() * ahead).norm() < 1e-12;
        assert!(close(velocity(&mut follower, 3.0), 0.8), "no faster than it may");
        assert!(close(velocity(&mut follower, 1.2), 0.3));
        assert!(close(velocity(&mut follower, 1.0), 0.0));
        assert!(close(velocity(&mut follower, 0.8), -0.3), "backs off from what comes too near");
    }

    #[test]
    fn without_a_pose_it_drives_ahead_as_well() {
        let mut follower = Follower::new(FollowerConfig::default());
        let velocity = follower.command(&Header::default(), &[ball(1, 3.0)]).unwrap().linear;
        assert!((Vector3::from(velocity) - Vector3::z() * 0.8).norm() < 1e-12, "{velocity:?}");
    }

    /// `up` is a vector in the world, and a different one in the frame of a camera that lies on its side.
    #[test]
    fn a_frame_without_pose_uses_that_of_the_frame_before() {
        let mut follower = Follower::new(FollowerConfig { up: Some([0.0, 0.0, 1.0]), ..FollowerConfig::default() });
        let mut velocity = |header: &Header| follower.command(header, &[ball(1, 3.0)]).unwrap().linear;
        let with_pose = velocity(&header());
        assert!(with_pose[2] > 0.5);
        assert_eq!(velocity(&Header::default()), with_pose);
    }

    #[test]
    fn a_zero_vector_is_refused_as_the_direction_up() {
        let faults = |up| {
            let config = FollowerConfig { up: Some(up), ..FollowerConfig::default() };
            Follower::faults(&config, Path::new("."))
        };
        assert_eq!(faults([0.0; 3]).len(), 1);
        assert_eq!(faults([0.0, -1.0, 0.0]), []);
    }

    #[test]
    fn it_follows_one_ball_until_that_is_lost() {
        let mut follower = Follower::new(FollowerConfig::default());
        let mut id = |tracks: &[Track]| {
            let command = follower.command(&header(), tracks);
            assert_eq!(command.is_some(), follower.followed.is_some());
            follower.followed
        };
        let tentative = Track { state: TrackState::Tentative.code(), ..ball(5, 0.5) };
        let cylinder =
            Track { object: Object { kind: ObjectKind::Cylinder.code(), ..ball(6, 0.4).object }, ..ball(6, 0.4) };
        assert_eq!(id(&[ball(1, 3.0), ball(2, 2.0), tentative, cylinder]), Some(2));
        assert_eq!(id(&[ball(1, 1.0), Track { state: TrackState::Coasting.code(), ..ball(2, 2.0) }]), Some(2));
        assert_eq!(id(&[ball(1, 1.0)]), Some(1));
        assert_eq!(id(&[]), None);
    }
}
