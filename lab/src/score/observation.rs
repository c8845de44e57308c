//! What one frame says of one object: the sample that a measurement sums up.

use super::matching::{Answer, perpendicular, radius_at};
use super::sigmas::Sigmas;
use super::truth::TrueObject;
use conicflow_detection::camera::isometry;
use conicflow_messages::{Header, Object, ObjectKind};
use nalgebra::{IsometryMatrix3, Point3, Vector3};

/// An object in one frame, in the world frame, with what was seen of it.
#[derive(Clone, Debug, Default)]
pub struct Observation {
    /// Time of the frame in seconds.
    pub time_s: f64,
    /// Place of the camera, in metres.
    pub camera: Vector3<f64>,
    /// Name of the object.
    pub name: String,
    /// The truth, where it is known.
    pub truth: Option<State>,
    /// What was seen, if it was.
    pub seen: Option<Seen>,
    /// True speed across its axis since the frame before, in m/s.
    pub true_speed_mps: Option<f64>,
    /// The speed that was measured.
    pub speed_mps: Option<f64>,
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
    pub stated_speed_mps: Option<f64>,
    /// Errors in units of the standard deviations that came with them.
    pub sigmas: Sigmas,
}

impl Observation {
    /// The answer to a true object, both in the camera frame.
    pub fn new(
        time_s: f64,
        truth: &TrueObject,
        answer: Option<&Answer>,
        world_from_camera: &IsometryMatrix3<f64>,
    ) -> Self {
        let state = |object: &Object| State::of(object, &truth.body.center.into(), world_from_camera);
        let seen = answer.map(|Answer { object, id, velocity }| Seen {
            state: state(object),
            id: *id,
            stated_speed_mps: velocity.map(|velocity| perpendicular(&velocity, &axis(object)).norm()),
            sigmas: Sigmas::of(&truth.body, object),
        });
        let (camera, name) = (world_from_camera.translation.vector, truth.name.clone());
        Self { time_s, camera, name, truth: Some(state(&truth.body)), seen, ..Self::default() }
    }

    /// An answer about something of which nobody knows the truth; tracks are told apart by their identities.
    pub fn without_truth(time_s: f64, answer: &Answer) -> Self {
        let Answer { object, id, .. } = answer;
        let kind = object.shape().name();
        let name = id.map_or_else(|| kind.to_owned(), |id| format!("{kind} {id}"));
        let state = State::of(object, &object.center.into(), &IsometryMatrix3::identity());
        let seen = Some(Seen { state, id: *id, stated_speed_mps: None, sigmas: Sigmas::default() });
        Self { time_s, name, seen, ..Self::default() }
    }
}

impl State {
    fn of(object: &Object, middle: &Vector3<f64>, world_from_camera: &IsometryMatrix3<f64>) -> Self {
        let (center, axis) = (Vector3::from(object.center), axis(object));
        let foot = center + axis * (middle - center).dot(&axis);
        Self {
            position: (world_from_camera * Point3::from(foot)).coords,
            distance_m: perpendicular(&center, &axis).norm(),
            radius_m: if axis == Vector3::zeros() { object.radius } else { radius_at(object, middle) },
            half_angle: object.half_angle,
            axis: world_from_camera.rotation * axis,
        }
    }
}

/// Unit vector along the axis of an object; zero for a sphere.
fn axis(object: &Object) -> Vector3<f64> {
    if object.shape() == ObjectKind::Sphere { Vector3::zeros() } else { object.axis.into() }
}

/// The pose of a header's camera; that of the world where it tells none.
pub fn world_from_camera(header: &Header) -> IsometryMatrix3<f64> {
    header.pose().map_or_else(IsometryMatrix3::identity, isometry)
}
