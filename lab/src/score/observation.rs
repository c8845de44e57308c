//! The observation of one object in one frame: the sample that a measurement sums up.

use super::matching::{Answer, perpendicular, radius_at};
use super::sigmas::Sigmas;
use super::truth::TrueObject;
use conicflow_detection::camera::isometry;
use conicflow_messages::{Header, Object};
use nalgebra::{IsometryMatrix3, Point3, Vector3};

/// An object in one frame, in the world frame, and what was found of it.
#[derive(Clone, Debug, Default)]
pub struct Observation {
    /// Time of the frame in seconds.
    pub time_s: f64,
    /// Position of the camera, in metres.
    pub camera: Vector3<f64>,
    /// Name of the object.
    pub name: String,
    /// The truth, if it is known.
    pub truth: Option<State>,
    /// The answer about it, if there is one.
    pub seen: Option<Sighting>,
    /// True speed across its axis since the frame before, in m/s.
    pub true_speed_mps: Option<f64>,
    /// The measured speed, in m/s.
    pub speed_mps: Option<f64>,
}

/// A measured or true state of an object.
#[derive(Clone, Copy, Debug)]
pub struct State {
    /// Centre of a sphere, else the point of the axis nearest to the true middle, in metres.
    pub position: Vector3<f64>,
    /// Distance from the camera to the centre of a sphere, else to the axis, in metres.
    pub distance_m: f64,
    /// Radius in metres; of a cone, at the true middle.
    pub radius_m: f64,
    /// Half-angle of a cone, in radians.
    pub half_angle: f64,
    /// Unit vector along the axis; zero for a sphere.
    pub axis: Vector3<f64>,
}

/// The answer about an object.
#[derive(Clone, Copy, Debug)]
pub struct Sighting {
    /// Its state.
    pub state: State,
    /// Identity of the track.
    pub id: Option<u64>,
    /// Speed that a track reports, across its axis, in m/s.
    pub stated_speed_mps: Option<f64>,
    /// Errors in units of the reported standard deviations.
    pub sigmas: Sigmas,
}

impl Observation {
    /// Creates the observation from an answer to a true object, both in the camera frame.
    pub fn new(
        time_s: f64,
        truth: &TrueObject,
        answer: Option<&Answer>,
        world_from_camera: &IsometryMatrix3<f64>,
    ) -> Self {
        let state = |object: &Object| State::of(object, &truth.body.center.into(), world_from_camera);
        let seen = answer.map(|Answer { object, id, velocity }| Sighting {
            state: state(object),
            id: *id,
            stated_speed_mps: velocity.map(|velocity| perpendicular(&velocity, &axis(object)).norm()),
            sigmas: Sigmas::of(&truth.body, object),
        });
        let (camera, name) = (world_from_camera.translation.vector, truth.name.clone());
        Self { time_s, camera, name, truth: Some(state(&truth.body)), seen, ..Self::default() }
    }

    /// Creates the observation from an answer without a known truth; the name of a track has its identity.
    pub fn without_truth(time_s: f64, answer: &Answer) -> Self {
        let Answer { object, id, .. } = answer;
        let kind = object.shape().name();
        let name = id.map_or_else(|| kind.to_owned(), |id| format!("{kind} {id}"));
        let state = State::of(object, &object.center.into(), &IsometryMatrix3::identity());
        let seen = Some(Sighting { state, id: *id, stated_speed_mps: None, sigmas: Sigmas::default() });
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
    if object.shape().has_axis() { object.axis.into() } else { Vector3::zeros() }
}

/// Returns the pose of a header's camera; the identity if it has none.
pub fn world_from_camera(header: &Header) -> IsometryMatrix3<f64> {
    header.pose().map_or_else(IsometryMatrix3::identity, isometry)
}

#[cfg(test)]
mod tests {
    use super::super::matching::tests::{cone, expected, sphere};
    use super::*;
    use conicflow_messages::HAS_POSE;

    /// The header of a camera whose x is the world's y, and whose y is opposite to the world's x.
    fn turned() -> Header {
        let world_from_camera = [[0.0, -1.0, 0.0, 3.0], [1.0, 0.0, 0.0, 4.0], [0.0, 0.0, 1.0, 5.0]];
        Header { flags: HAS_POSE, world_from_camera, ..Header::default() }
    }

    fn answer(object: Object) -> Answer {
        Answer { object, id: Some(7), velocity: Some(Vector3::new(0.3, 9.0, 0.4)) }
    }

    #[test]
    fn what_is_seen_is_told_in_the_world_where_the_true_middle_is() {
        let lower = Object { center: [0.01, 0.08, 1.0], radius: 0.108, ..cone() };
        let observation = Observation::new(2.5, &expected(cone()), Some(&answer(lower)), &world_from_camera(&turned()));
        let (truth, seen) = (observation.truth.unwrap(), observation.seen.unwrap());
        assert_eq!((observation.time_s, &*observation.name), (2.5, "thing"));
        assert!((observation.camera - Vector3::new(3.0, 4.0, 5.0)).norm() < 1e-12);
        for (state, place, distance) in
            [(truth, Vector3::new(3.0, 4.0, 6.0), 1.0), (seen.state, Vector3::new(3.0, 4.01, 6.0), 0.01_f64.hypot(1.0))]
        {
            assert!(
                (state.position - place).norm() < 1e-12 && (state.distance_m - distance).abs() < 1e-12,
                "{state:?}"
            );
            assert!((state.radius_m - 0.1).abs() < 1e-12, "{state:?}");
            assert!((state.axis + Vector3::x()).norm() < 1e-12 && state.half_angle == cone().half_angle, "{state:?}");
        }
        assert!((seen.stated_speed_mps.unwrap() - 0.5).abs() < 1e-12, "across its axis");
        assert_eq!((seen.id, seen.sigmas), (Some(7), Sigmas::of(&cone(), &lower)));
        let missed = Observation::new(2.5, &expected(cone()), None, &IsometryMatrix3::identity());
        assert!(missed.seen.is_none() && missed.truth.is_some());
    }

    #[test]
    fn a_sphere_is_as_far_as_its_center_and_has_no_axis() {
        let ball = Object { axis: [0.0, 1.0, 0.0], center: [0.0, 0.6, 0.8], ..sphere(0.0) };
        let state = State::of(&ball, &Vector3::new(0.0, 5.0, 1.0), &IsometryMatrix3::identity());
        assert!((state.distance_m - 1.0).abs() < 1e-12 && state.radius_m == 0.1);
        assert_eq!((state.axis, state.position), (Vector3::zeros(), Vector3::new(0.0, 0.6, 0.8)));
    }

    #[test]
    fn what_has_no_truth_is_told_by_its_identity_or_its_shape() {
        let object = Object { center: [0.0, 0.3, 1.0], ..cone() };
        let named = |id: Option<u64>| Observation::without_truth(1.5, &Answer { id, ..answer(object) });
        assert_eq!([named(Some(7)).name, named(None).name], ["cone 7", "cone"]);
        let seen = named(Some(7)).seen.unwrap();
        assert_eq!((seen.id, seen.stated_speed_mps, seen.state.radius_m), (Some(7), None, 0.1));
        assert!((seen.state.position - Vector3::new(0.0, 0.3, 1.0)).norm() < 1e-12 && named(None).time_s == 1.5);
    }
}
