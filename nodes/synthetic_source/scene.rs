//! Scene files: what stands where, how it moves, and where the camera is.
//!
//! TOML, metres and seconds, in a world frame of the scene's choosing (`up` says where up is; z by default):
//! ```toml
//! name = "ball on a can"
//! [camera]
//! position = [0, 0, 1]
//! look_at  = [0, 1.5, 0.4]              # or `direction = [..]`, or `orientation = [x, y, z, w]`
//! [[cylinder]]
//! name   = "can"
//! base   = [0, 1.5, 0]                  # `axis` is `up` where left out
//! radius = 0.18
//! length = 0.5
//! [[sphere]]
//! name   = "ball"
//! center = [0, 1.5, 1.0]
//! radius = 0.1
//! motion.ballistic = { velocity = [0, 0, 0], floor_m = 0.5 }
//! ```
//! Further: `[[cone]]` (`base_radius`, `top_radius`), `[[bowl]]` (`center`, `radius`, `depth`), `[[box]]` (`center`,
//! `size`), `[[plane]]` (`point`, `normal`, `size`). A cylinder or cone with `open = true` is a cup.

use super::fields::*;
use super::motion::{Motion, Setting};
use super::pose::{Pose, from_quaternion, looking_along};
use super::shapes::{Block, Bowl, Frustum, Plane, Shape, Sphere, Surface};
use anyhow::{Context as _, Result, anyhow, bail};
use nalgebra::{Matrix3, Vector3};
use serde::Deserialize;
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
    /// What can be seen; solids first, in the order of the file's tables.
    pub bodies: Vec<Body>,
    view: View,
    up: Vector3<f64>,
    gravity: f64,
}

/// Something with a name that can be seen.
#[derive(Clone, Debug)]
pub struct Body {
    /// Unlike those of all others in the scene.
    pub name: String,
    shape: Shape,
    motion: Option<Motion>,
}

impl Body {
    /// Something that stands still.
    pub fn still(name: impl Into<String>, shape: Shape) -> Self {
        Self { name: name.into(), shape, motion: None }
    }
}

#[derive(Clone, Debug)]
struct View {
    position: Vector3<f64>,
    gaze: Gaze,
    up: Vector3<f64>,
    motion: Option<Motion>,
    gaze_motion: Option<Motion>,
}

#[derive(Clone, Copy, Debug)]
enum Gaze {
    At(Vector3<f64>),
    Fixed(Matrix3<f64>),
}

impl Scene {
    /// Reads a scene file.
    ///
    /// # Errors
    /// The file cannot be read, or what is wrong with it at which line and column.
    pub fn load(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path).map_err(|error| {
            let names = BUILT_IN.map(|(name, _)| name).join("`, `");
            let place = path.display();
            anyhow!("cannot read the scene file `{place}`: {error}\n  hint: a built-in scene is one of `{names}`")
        })?;
        Self::parse(&text, &path.display().to_string())
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
            anyhow!(
                "{origin}{place}: {}\n  hint: a scene file has `name`, `up`, `gravity`, `[camera]` and any number of \
                 `[[sphere]]`, `[[cylinder]]`, `[[cone]]`, `[[bowl]]`, `[[box]]` and `[[plane]]`",
                error.to_string().trim_end()
            )
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
        Self { name, bodies, view, up: Vector3::z(), gravity: earth() }
    }

    fn from_file(file: SceneFile, origin: &str) -> Result<Self> {
        let up = file.up;
        let mut bodies: Vec<Body> = Vec::new();
        bodies.extend(file.sphere.into_iter().map(SphereEntry::body));
        bodies.extend(file.cylinder.into_iter().map(|entry| entry.body(&up)));
        bodies.extend(file.cone.into_iter().map(|entry| entry.body(&up)));
        bodies.extend(file.bowl.into_iter().map(|entry| entry.body(&up)));
        bodies.extend(file.block.into_iter().map(BoxEntry::body));
        for entry in file.plane {
            bodies.push(entry.body().with_context(|| origin.to_owned())?);
        }
        let view = file.camera.view(&up).with_context(|| origin.to_owned())?;
        let scene = Self { name: file.name, bodies, view, up, gravity: file.gravity };
        scene.check().with_context(|| origin.to_owned())?;
        Ok(scene)
    }

    fn check(&self) -> Result<()> {
        for (index, body) in self.bodies.iter().enumerate() {
            if self.bodies[..index].iter().any(|other| other.name == body.name) {
                bail!("two things are named `{}`\n  hint: give each a name of its own", body.name);
            }
            let fault = body.motion.as_ref().and_then(|motion| motion.fault(&self.setting(&body.shape)));
            if let Some(fault) = fault {
                bail!("`{}` cannot move like this: {fault}\n  hint: move it, or change its motion", body.name);
            }
        }
        match self.bodies.len() < usize::from(u16::MAX) {
            true => Ok(()),
            false => bail!("{} things in one scene\n  hint: at most {} are possible", self.bodies.len(), u16::MAX - 1),
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
        Pose { rotation, translation }
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

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SceneFile {
    name: String,
    #[serde(default = "Vector3::z", deserialize_with = "direction")]
    up: Vector3<f64>,
    #[serde(default = "earth", deserialize_with = "not_negative")]
    gravity: f64,
    camera: CameraEntry,
    #[serde(default)]
    sphere: Vec<SphereEntry>,
    #[serde(default)]
    cylinder: Vec<CylinderEntry>,
    #[serde(default)]
    cone: Vec<ConeEntry>,
    #[serde(default)]
    bowl: Vec<BowlEntry>,
    #[serde(default, rename = "box")]
    block: Vec<BoxEntry>,
    #[serde(default)]
    plane: Vec<PlaneEntry>,
}

fn earth() -> f64 {
    9.81
}

/// Optical frame: x right, y down, z forward. One of `look_at` (a point that it keeps in view), `direction` and
/// `orientation` (quaternion `world_from_camera`) says where it looks; `up` (the scene's where left out) is upwards in
/// the image. `motion` moves the position, `look_at_motion` the point.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CameraEntry {
    #[serde(deserialize_with = "vector")]
    position: Vector3<f64>,
    #[serde(default, deserialize_with = "maybe_vector")]
    look_at: Option<Vector3<f64>>,
    #[serde(default, deserialize_with = "maybe_direction")]
    direction: Option<Vector3<f64>>,
    #[serde(default, deserialize_with = "maybe_quaternion")]
    orientation: Option<[f64; 4]>,
    #[serde(default, deserialize_with = "maybe_direction")]
    up: Option<Vector3<f64>>,
    motion: Option<Motion>,
    look_at_motion: Option<Motion>,
}

impl CameraEntry {
    fn view(self, world_up: &Vector3<f64>) -> Result<View> {
        let up = self.up.unwrap_or(*world_up);
        let gaze = match (self.look_at, self.direction, self.orientation) {
            (Some(point), None, None) => Gaze::At(point),
            (None, Some(forward), None) => Gaze::Fixed(upright(&forward, &up)?),
            (None, None, Some(quaternion)) => Gaze::Fixed(from_quaternion(quaternion)),
            _ => bail!(
                "the camera needs exactly one of `look_at`, `direction` and `orientation`\n  hint: `look_at = [x, y, z]` \
                 is a point that it keeps in the middle of the image"
            ),
        };
        if let Gaze::At(point) = gaze {
            upright(&(point - self.position), &up)?;
        } else if self.look_at_motion.is_some() {
            bail!("the camera has a `look_at_motion` and no `look_at`\n  hint: give the point that moves");
        }
        Ok(View { position: self.position, gaze, up, motion: self.motion, gaze_motion: self.look_at_motion })
    }
}

fn upright(forward: &Vector3<f64>, up: &Vector3<f64>) -> Result<Matrix3<f64>> {
    let fault =
        "the camera looks straight along `up`, so it has no upright image\n  hint: give the camera another `up`";
    looking_along(forward, up).context(fault)
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SphereEntry {
    name: String,
    #[serde(deserialize_with = "vector")]
    center: Vector3<f64>,
    #[serde(deserialize_with = "positive")]
    radius: f64,
    motion: Option<Motion>,
}

impl SphereEntry {
    fn body(self) -> Body {
        let shape = Shape::Sphere(Sphere { center: self.center, radius: self.radius });
        Body { name: self.name, shape, motion: self.motion }
    }
}

/// `axis` points from `base`, the centre of one end, to the other end, which may be `open`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CylinderEntry {
    name: String,
    #[serde(deserialize_with = "vector")]
    base: Vector3<f64>,
    #[serde(default, deserialize_with = "maybe_direction")]
    axis: Option<Vector3<f64>>,
    #[serde(deserialize_with = "positive")]
    radius: f64,
    #[serde(deserialize_with = "positive")]
    length: f64,
    #[serde(default)]
    open: bool,
    motion: Option<Motion>,
}

impl CylinderEntry {
    fn body(self, up: &Vector3<f64>) -> Body {
        let (base, axis) = (self.base, self.axis.unwrap_or(*up));
        let (base_radius, top_radius) = (self.radius, self.radius);
        let (length, open) = (self.length, self.open);
        let shape = Shape::Frustum(Frustum { base, axis, length, base_radius, top_radius, open });
        Body { name: self.name, shape, motion: self.motion }
    }
}

/// `top_radius` is 0 where left out: a cone with its tip.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ConeEntry {
    name: String,
    #[serde(deserialize_with = "vector")]
    base: Vector3<f64>,
    #[serde(default, deserialize_with = "maybe_direction")]
    axis: Option<Vector3<f64>>,
    #[serde(deserialize_with = "positive")]
    base_radius: f64,
    #[serde(default, deserialize_with = "not_negative")]
    top_radius: f64,
    #[serde(deserialize_with = "positive")]
    length: f64,
    #[serde(default)]
    open: bool,
    motion: Option<Motion>,
}

impl ConeEntry {
    fn body(self, up: &Vector3<f64>) -> Body {
        let Self { name, base, base_radius, top_radius, length, open, motion, .. } = self;
        let axis = self.axis.unwrap_or(*up);
        Body { name, shape: Shape::Frustum(Frustum { base, axis, length, base_radius, top_radius, open }), motion }
    }
}

/// A thin shell about `center`, whose rim is `depth` (half of the sphere where left out) above its bottom; `axis` points
/// from the bottom to the opening.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct BowlEntry {
    name: String,
    #[serde(deserialize_with = "vector")]
    center: Vector3<f64>,
    #[serde(deserialize_with = "positive")]
    radius: f64,
    #[serde(default, deserialize_with = "maybe_direction")]
    axis: Option<Vector3<f64>>,
    depth: Option<f64>,
    motion: Option<Motion>,
}

impl BowlEntry {
    fn body(self, up: &Vector3<f64>) -> Body {
        let sphere = Sphere { center: self.center, radius: self.radius };
        let (axis, depth) = (self.axis.unwrap_or(*up), self.depth.unwrap_or(self.radius));
        Body { name: self.name, shape: Shape::Bowl(Bowl { sphere, axis, depth }), motion: self.motion }
    }
}

/// `orientation` is a quaternion `[x, y, z, w]`, none where left out.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct BoxEntry {
    name: String,
    #[serde(deserialize_with = "vector")]
    center: Vector3<f64>,
    #[serde(deserialize_with = "size")]
    size: Vector3<f64>,
    #[serde(default, deserialize_with = "maybe_quaternion")]
    orientation: Option<[f64; 4]>,
    motion: Option<Motion>,
}

impl BoxEntry {
    fn body(self) -> Body {
        let axes = self.orientation.map_or_else(Matrix3::identity, from_quaternion);
        let shape = Shape::Block(Block { center: self.center, axes, half: self.size * 0.5 });
        Body { name: self.name, shape, motion: self.motion }
    }
}

/// Without `size` it has no end; with it, it is a rectangle about `point` whose first side goes along `along`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PlaneEntry {
    name: String,
    #[serde(deserialize_with = "vector")]
    point: Vector3<f64>,
    #[serde(deserialize_with = "direction")]
    normal: Vector3<f64>,
    size: Option<[f64; 2]>,
    #[serde(default, deserialize_with = "maybe_direction")]
    along: Option<Vector3<f64>>,
    motion: Option<Motion>,
}

impl PlaneEntry {
    fn body(self) -> Result<Body> {
        let half = self.size.map_or([f64::INFINITY; 2], |size| size.map(|side| 0.5 * side));
        if !(half[0] > 0.0 && half[1] > 0.0) {
            bail!(
                "the `size` of `{}` is not two numbers above zero\n  hint: without it the plane has no end",
                self.name
            );
        }
        let across = self.normal.cross(&self.along.unwrap_or_else(|| some_other(&self.normal)));
        let Some(second) = across.try_normalize(1e-9) else {
            bail!("`along` and `normal` of `{}` are parallel\n  hint: `along` lies in the plane", self.name);
        };
        let plane = Plane { point: self.point, normal: self.normal, sides: [second.cross(&self.normal), second], half };
        Ok(Body { name: self.name, shape: Shape::Plane(plane), motion: self.motion })
    }
}

/// The coordinate axis that is least parallel to a direction.
fn some_other(direction: &Vector3<f64>) -> Vector3<f64> {
    let mut axis = Vector3::zeros();
    axis[direction.iamin()] = 1.0;
    axis
}

#[cfg(test)]
#[path = "scene_tests.rs"]
mod tests;
