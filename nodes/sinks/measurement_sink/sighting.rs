//! What one frame says of one true object.

use crate::sinks::evaluation_sink::errors::{Errors, Sigmas};
use crate::sinks::evaluation_sink::matching::{Expected, perpendicular, radius_at};
use conicflow_detection::camera::isometry;
use conicflow_messages::{Header, Object, ObjectKind, Track, TrackState};
use nalgebra::{IsometryMatrix3, Point3, Vector3};

/// An answer: an object, and where it is a track its identity and velocity.
#[derive(Clone, Copy, Debug)]
pub struct Sighted {
    /// The object, in the camera frame.
    pub object: Object,
    /// Identity of a track.
    pub id: Option<u64>,
    /// Velocity of a track, in m/s along the camera's axes.
    pub velocity: Option<Vector3<f64>>,
    /// Whether it is claimed to be seen in this frame.
    pub is_meant: bool,
}

impl From<&Object> for Sighted {
    fn from(object: &Object) -> Self {
        Self { object: *object, id: None, velocity: None, is_meant: true }
    }
}

impl From<&Track> for Sighted {
    fn from(track: &Track) -> Self {
        let is_meant = track.track_state() == TrackState::Confirmed;
        Self { object: track.object, id: Some(track.id), velocity: Some(track.velocity.into()), is_meant }
    }
}

/// A true object in one frame, in the world frame, with what was seen of it.
#[derive(Clone, Debug)]
pub struct Sighting {
    /// Time of the frame in seconds.
    pub time_s: f64,
    /// Place of the camera, in metres.
    pub camera: Vector3<f64>,
    /// Name of the object.
    pub name: String,
    /// The truth.
    pub truth: State,
    /// What was seen, if it was.
    pub seen: Option<Seen>,
}

/// An object as measured or as it is.
#[derive(Clone, Copy, Debug)]
pub struct State {
    /// Centre of a sphere, else the point of the axis that is nearest to the true middle, in metres.
    pub position: Vector3<f64>,
    /// Distance from the camera to the centre of a sphere, else to the axis, in metres.
    pub distance_m: f64,
    /// Radius in metres; of a cone at the true middle.
    pub radius_m: f64,
    /// Half-angle of a cone, in radians.
    pub half_angle: f64,
    /// Unit vector along the axis; zero for a sphere.
    pub axis: Vector3<f64>,
}

/// What was seen of an object.
#[derive(Clone, Copy, Debug)]
pub struct Seen {
    /// Its state.
    pub state: State,
    /// Identity of the track.
    pub id: Option<u64>,
    /// Speed that a track states, across its axis, in m/s.
    pub speed_mps: Option<f64>,
    /// Errors in units of the standard deviations that came with them.
    pub sigmas: Sigmas,
}

impl Sighting {
    /// The answer to a true object, both in the camera frame.
    pub fn new(time_s: f64, truth: &Expected, answer: Option<&Sighted>, pose: &IsometryMatrix3<f64>) -> Self {
        let middle = Vector3::from(truth.body.center);
        let state = |object: &Object| State::of(object, &middle, pose);
        let seen = answer.map(|answer| Seen {
            state: state(&answer.object),
            id: answer.id,
            speed_mps: answer.velocity.map(|velocity| perpendicular(&velocity, &axis(&answer.object)).norm()),
            sigmas: Errors::of(truth, &answer.object).sigmas,
        });
        Self { time_s, camera: pose.translation.vector, name: truth.name.clone(), truth: state(&truth.body), seen }
    }
}

impl State {
    fn of(object: &Object, middle: &Vector3<f64>, pose: &IsometryMatrix3<f64>) -> Self {
        let (center, axis) = (Vector3::from(object.center), axis(object));
        let foot = center + axis * (middle - center).dot(&axis);
        Self {
            position: (pose * Point3::from(foot)).coords,
            distance_m: perpendicular(&center, &axis).norm(),
            radius_m: if axis == Vector3::zeros() { object.radius } else { radius_at(object, middle) },
            half_angle: object.half_angle,
            axis: pose.rotation * axis,
        }
    }
}

/// Unit vector along the axis of an object; zero for a sphere.
pub fn axis(object: &Object) -> Vector3<f64> {
    if object.shape() == ObjectKind::Sphere { Vector3::zeros() } else { object.axis.into() }
}

/// The pose of a header's camera; that of the world where it tells none.
pub fn world_from_camera(header: &Header) -> IsometryMatrix3<f64> {
    header.pose().map_or_else(IsometryMatrix3::identity, isometry)
}
