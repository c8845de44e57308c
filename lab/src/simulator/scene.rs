//! A scene, from a scene file or a random one: the bodies, their motions, and the camera.

use super::motion::{Motion, Setting};
use super::pose::{Pose, looking_along};
use super::shapes::{Shape, Surface};
use nalgebra::{Matrix3, Vector3};

/// Bodies and a camera in a world frame, as functions of time.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Name of the frames' source.
    pub name: String,
    /// The group of a random scene.
    pub group: Option<&'static str>,
    /// All visible bodies, solids first, in the order of the file's tables.
    pub bodies: Vec<Body>,
    /// Displacement of the camera from its position in the file, in metres; driving the camera adds to it.
    pub camera_shift: Vector3<f64>,
    pub(super) view: View,
    pub(super) up: Vector3<f64>,
    pub(super) gravity: f64,
}

/// A visible thing with a name.
#[derive(Clone, Debug)]
pub struct Body {
    /// Unique in the scene.
    pub name: String,
    pub(super) shape: Shape,
    pub(super) motion: Option<Motion>,
    pub(super) role: Role,
}

/// The meaning of a body for a detector.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Role {
    /// An object of its own.
    #[default]
    Object,
    /// A part of something that is no object: a limb, a leg of a chair. It need not be found, but a right answer about a round
    /// part is not wrong.
    Part,
    /// A part without depth.
    Glass,
}

impl Body {
    /// Creates an object of its own.
    pub(super) fn new(name: impl Into<String>, shape: Shape, motion: Option<Motion>) -> Self {
        Self { name: name.into(), shape, motion, role: Role::Object }
    }

    /// Creates a body without motion.
    pub fn still(name: impl Into<String>, shape: Shape) -> Self {
        Self::new(name, shape, None)
    }

    /// Returns the body in another role.
    pub fn as_a(self, role: Role) -> Self {
        Self { role, ..self }
    }
}

/// Gravity on Earth, in m/s^2.
pub(super) fn earth() -> f64 {
    9.81
}

/// The camera's position and orientation.
#[derive(Clone, Debug)]
pub(super) struct View {
    pub position: Vector3<f64>,
    pub gaze: Gaze,
    pub up: Vector3<f64>,
    pub motion: Option<Motion>,
    pub gaze_motion: Option<Motion>,
}

#[derive(Clone, Copy, Debug)]
pub(super) enum Gaze {
    /// At a point.
    At(Vector3<f64>),
    /// In a direction: `world_from_camera`.
    Fixed(Matrix3<f64>),
}

impl Scene {
    /// Creates a scene in which nothing moves: z is up, and the camera at `position` looks at a point, with `camera_up` upwards
    /// in the image. The bodies' names have to be unique.
    pub fn still(
        name: String,
        bodies: Vec<Body>,
        position: Vector3<f64>,
        look_at: Vector3<f64>,
        camera_up: Vector3<f64>,
    ) -> Self {
        let view = View { position, gaze: Gaze::At(look_at), up: camera_up, motion: None, gaze_motion: None };
        let (group, up) = (None, Vector3::z());
        Self { name, group, bodies, camera_shift: Vector3::zeros(), view, up, gravity: earth() }
    }

    pub(super) fn setting(&self, shape: &Shape) -> Setting {
        Setting { up: self.up, gravity: self.gravity, anchor: shape.anchor(), reach_below: shape.reach_below(&self.up) }
    }

    /// Returns a body at a time (seconds), in the world frame.
    pub fn shape(&self, body: &Body, time_s: f64) -> Shape {
        let Some(motion) = &body.motion else { return body.shape };
        body.shape.transformed(&Pose::shift(motion.displacement(time_s, &self.setting(&body.shape))))
    }

    /// Returns the pose of the camera, `world_from_camera`, at a time (seconds).
    pub fn world_from_camera(&self, time_s: f64) -> Pose {
        let view = &self.view;
        let moved = |point: Vector3<f64>, motion: &Option<Motion>| {
            let setting = Setting { up: self.up, gravity: self.gravity, anchor: point, reach_below: 0.0 };
            point + motion.as_ref().map_or_else(Vector3::zeros, |motion| motion.displacement(time_s, &setting))
        };
        let translation = moved(view.position, &view.motion);
        let rotation = match view.gaze {
            Gaze::Fixed(rotation) => rotation,
            Gaze::At(point) => {
                let forward = moved(point, &view.gaze_motion) - translation;
                // at the moment when the camera passes exactly above its target, any orientation is as good
                looking_along(&forward, &view.up).unwrap_or_else(Matrix3::identity)
            }
        };
        Pose { rotation, translation: translation + self.camera_shift }
    }

    /// Returns all bodies in the camera's frame at a time (seconds), in the order of `bodies`.
    pub fn shapes_in_camera(&self, time_s: f64) -> impl Iterator<Item = Shape> {
        let camera_from_world = self.world_from_camera(time_s).inverse();
        self.bodies.iter().map(move |body| self.shape(body, time_s).transformed(&camera_from_world))
    }
}
