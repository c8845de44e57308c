//! Scene files: what stands where, how it moves, and where the camera is.
//!
//! The tables of the file are read by [`super::scene_file`].

use super::motion::{Motion, Setting};
use super::pose::{Pose, looking_along};
use super::scene_file::{SceneFile, ScreenEntry, earth};
use super::scene_values::{SceneTemplate, Values};
use super::screen::screen;
use super::shapes::{Shape, Surface};
use anyhow::{Context as _, Result, anyhow, bail};
use conicflow_messages::Hinted;
use nalgebra::{Matrix3, Vector3};
use std::path::Path;

/// The scenes that are built in, by their names; the first one is the default.
pub const BUILT_IN: [(&str, &str); 8] = [
    ("bouncing_ball", include_str!("scenes/bouncing_ball.toml")),
    ("passing_cylinder", include_str!("scenes/passing_cylinder.toml")),
    ("ball_on_cylinder", include_str!("scenes/ball_on_cylinder.toml")),
    ("tilted_cones", include_str!("scenes/tilted_cones.toml")),
    ("occluded_cylinder", include_str!("scenes/occluded_cylinder.toml")),
    ("tabletop", include_str!("scenes/tabletop.toml")),
    ("drive_to_ball", include_str!("scenes/drive_to_ball.toml")),
    ("empty_room", include_str!("scenes/empty_room.toml")),
];

/// Objects and a camera in a world frame, all of them functions of time.
#[derive(Clone, Debug)]
pub struct Scene {
    /// What the frames call their source.
    pub name: String,
    /// The group of a random scene: those that are drawn alike.
    pub group: Option<&'static str>,
    /// What can be seen; solids first, in the order of the file's tables.
    pub bodies: Vec<Body>,
    /// How far the camera is from where the file would have it, in metres: who drives it adds to it.
    pub camera_shift: Vector3<f64>,
    view: View,
    up: Vector3<f64>,
    gravity: f64,
}

/// Something with a name that can be seen.
#[derive(Clone, Debug)]
pub struct Body {
    /// Unlike those of all others in the scene.
    pub name: String,
    pub(super) shape: Shape,
    pub(super) motion: Option<Motion>,
    pub(super) role: Role,
}

/// What a body is to who looks for objects.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Role {
    /// A thing of its own.
    #[default]
    Object,
    /// A part of something that is none: a limb, a leg of a chair. It need not be found, nor is it wrong to find it if it is
    /// round.
    Part,
    /// A part that gives no depth.
    Glass,
}

impl Body {
    /// Something that stands still.
    pub fn still(name: impl Into<String>, shape: Shape) -> Self {
        Self { name: name.into(), shape, motion: None, role: Role::Object }
    }

    /// The same body in another role.
    pub fn as_a(self, role: Role) -> Self {
        Self { role, ..self }
    }
}

/// Where the camera is and looks.
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
    /// Reads a scene file.
    ///
    /// # Errors
    /// The file cannot be read, or what is wrong with it at which line and column.
    pub fn load(path: &Path) -> Result<Self> {
        SceneTemplate::load(path)?.scene(&Values::new())
    }

    /// The text of a scene file.
    pub(super) fn read(path: &Path) -> Result<String> {
        std::fs::read_to_string(path).map_err(|error| {
            let names = BUILT_IN.map(|(name, _)| name).join("`, `");
            let place = path.display();
            anyhow!(Hinted::new(
                format!("cannot read the scene file `{place}`: {error}"),
                format!("a built-in scene is one of `{names}`")
            ))
        })
    }

    /// A scene that is built into the program, if there is one of that name.
    pub fn built_in(name: &str) -> Option<Result<Self>> {
        let (_, text) = BUILT_IN.iter().find(|(known, _)| *known == name)?;
        Some(Self::parse(text, name))
    }

    /// Reads the text of a scene file; `origin` is what errors call it.
    ///
    /// # Errors
    /// What is wrong at which line and column.
    pub fn parse(text: &str, origin: &str) -> Result<Self> {
        let file: SceneFile = toml::from_str(text).map_err(|error| {
            let place = error.span().map(|span| line_and_column(text, span.start)).unwrap_or_default();
            anyhow!(Hinted::new(
                format!("{origin}{place}: {}", error.to_string().trim_end()),
                "a scene file has `name`, `up`, `gravity`, `[camera]` and any number of `[[sphere]]`, \
                 `[[cylinder]]`, `[[cone]]`, `[[bowl]]`, `[[box]]`, `[[plane]]` and `[[screen]]`"
            ))
        })?;
        Self::from_file(file, origin)
    }

    /// A scene in which nothing moves: z is up, and the camera at `position` looks at a point, with `camera_up` upwards in
    /// the image. The names of the bodies are unlike each other.
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

    fn from_file(file: SceneFile, origin: &str) -> Result<Self> {
        let (name, up, gravity) = (file.name.clone(), file.up, file.gravity);
        let (bodies, camera, screens) = file.bodies().with_context(|| origin.to_owned())?;
        let view = camera.view(&up).with_context(|| origin.to_owned())?;
        let mut scene = Self { name, group: None, bodies, camera_shift: Vector3::zeros(), view, up, gravity };
        screens.iter().try_for_each(|entry| scene.put_up(entry)).with_context(|| origin.to_owned())?;
        scene.check().with_context(|| origin.to_owned())?;
        Ok(scene)
    }

    /// Puts up a screen for the camera at time 0; one that hides nothing is left out.
    fn put_up(&mut self, entry: &ScreenEntry) -> Result<()> {
        if entry.hides == 0.0 {
            return Ok(());
        }
        let body = self.bodies.iter().find(|body| body.name == entry.before);
        let body = body.ok_or_else(|| {
            let what = format!("`{}` stands before `{}`, which is not there", entry.name, entry.before);
            Hinted::new(what, "name a body of the scene")
        })?;
        let shape = screen(&self.shape(body, 0.0), &self.world_from_camera(0.0), entry.distance_m, entry.hides);
        let shape = shape.ok_or_else(|| {
            let what = format!("`{}` cannot hide `{}` at {} m", entry.name, entry.before, entry.distance_m);
            Hinted::new(what, "the camera has to look at it, from farther away")
        })?;
        self.bodies.push(Body::still(entry.name.clone(), shape));
        Ok(())
    }

    fn check(&self) -> Result<()> {
        for (index, body) in self.bodies.iter().enumerate() {
            if self.bodies[..index].iter().any(|other| other.name == body.name) {
                bail!(Hinted::new(format!("two things are named `{}`", body.name), "give each a name of its own"));
            }
            let fault = body.motion.as_ref().and_then(|motion| motion.fault(&self.setting(&body.shape)));
            if let Some(fault) = fault {
                bail!(Hinted::new(
                    format!("`{}` cannot move like this: {fault}", body.name),
                    "move it, or change its motion"
                ));
            }
        }
        match self.bodies.len() < usize::from(u16::MAX) {
            true => Ok(()),
            false => bail!(Hinted::new(
                format!("{} things in one scene", self.bodies.len()),
                format!("at most {} are possible", u16::MAX - 1)
            )),
        }
    }

    fn setting(&self, shape: &Shape) -> Setting {
        Setting { up: self.up, gravity: self.gravity, anchor: shape.anchor(), reach_below: shape.reach_below(&self.up) }
    }

    /// Where a body is at a time (seconds), in the world frame.
    pub fn shape(&self, body: &Body, time_s: f64) -> Shape {
        let Some(motion) = &body.motion else { return body.shape };
        body.shape.transformed(&Pose::shift(motion.displacement(time_s, &self.setting(&body.shape))))
    }

    /// Pose of the camera, `world_from_camera`, at a time (seconds).
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
                // at the one moment when it moves through the line above its point, any view is as good
                looking_along(&forward, &view.up).unwrap_or_else(Matrix3::identity)
            }
        };
        Pose { rotation, translation: translation + self.camera_shift }
    }

    /// All bodies in the camera's frame at a time (seconds), in the order of `bodies`, written over `shapes`.
    pub fn shapes_in_camera(&self, time_s: f64, shapes: &mut Vec<Shape>) {
        let camera_from_world = self.world_from_camera(time_s).inverse();
        shapes.clear();
        shapes.extend(self.bodies.iter().map(|body| self.shape(body, time_s).transformed(&camera_from_world)));
    }
}

/// `:line:column` of a byte, both from 1.
fn line_and_column(text: &str, byte: usize) -> String {
    let before = &text[..byte.min(text.len())];
    let line_start = before.rfind('\n').map_or(0, |newline| newline + 1);
    format!(":{}:{}", before.matches('\n').count() + 1, before[line_start..].chars().count() + 1)
}

#[cfg(test)]
#[path = "scene_tests.rs"]
mod tests;
