//! The tables of a scene file.
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
//! Further tables: `[[cone]]` (`base_radius`, `top_radius`), `[[bowl]]` (`center`, `radius`, `depth`), `[[box]]` (`center`,
//! `size`), `[[lump]]` (`center`, `size`, `squareness`, `creases`), `[[plane]]` (`point`, `normal`, `size`), `[[screen]]`
//! (`before`, `hides`, `distance_m`). A cylinder or cone with `open = true` is a cup. `[values]`, and `"$name"` in place of a
//! number: see [`super::scene_values`].

use super::fields::*;
use super::lump::{CREASES, Crease, Lump};
use super::motion::Motion;
use super::pose::{from_quaternion, looking_along};
use super::scene::{Body, Gaze, Scene, View, earth};
use super::screen::screen;
use super::shapes::{Block, Bowl, Frustum, Plane, Shape, Sphere};
use anyhow::{Context as _, Result, anyhow, bail};
use conicflow_messages::Hinted;
use nalgebra::{Matrix3, Vector3};
use serde::Deserialize;
use std::collections::BTreeMap;
use std::path::Path;

/// The built-in scenes by name; the first one is the default.
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

/// Reads the text of a scene file.
pub fn read(path: &Path) -> Result<String> {
    std::fs::read_to_string(path).map_err(|error| {
        let names = BUILT_IN.map(|(name, _)| name).join("`, `");
        let place = path.display();
        anyhow!(Hinted::new(
            format!("cannot read the scene file `{place}`: {error}"),
            format!("a built-in scene is one of `{names}`")
        ))
    })
}

impl Scene {
    /// Returns the built-in scene of this name, if there is one.
    pub fn built_in(name: &str) -> Option<Result<Self>> {
        let (_, text) = BUILT_IN.iter().find(|(known, _)| *known == name)?;
        Some(Self::parse(text, name))
    }

    /// Parses the text of a scene file; `origin` is its name in errors.
    ///
    /// # Errors
    /// The text is not a valid scene; the error names line and column.
    pub fn parse(text: &str, origin: &str) -> Result<Self> {
        let file: SceneFile = toml::from_str(text).map_err(|error| {
            let [place, line] = error.span().map(|span| place(text, span.start)).unwrap_or_default();
            anyhow!(Hinted::new(
                format!("{origin}{place}: {}{line}", error.message()),
                "a scene file has `name`, `up`, `gravity`, `[camera]` and any number of `[[sphere]]`, \
                 `[[cylinder]]`, `[[cone]]`, `[[bowl]]`, `[[box]]`, `[[lump]]`, `[[plane]]` and `[[screen]]`"
            ))
        })?;
        Self::from_file(file, origin)
    }

    fn from_file(file: SceneFile, origin: &str) -> Result<Self> {
        let (name, up, gravity) = (file.name.clone(), file.up, file.gravity);
        let (bodies, camera, screens) = file.bodies().with_context(|| origin.to_owned())?;
        let view = camera.view(&up).with_context(|| origin.to_owned())?;
        let mut scene = Self { name, group: None, bodies, camera_shift: Vector3::zeros(), view, up, gravity };
        screens.iter().try_for_each(|entry| scene.add_screen(entry)).with_context(|| origin.to_owned())?;
        scene.check().with_context(|| origin.to_owned())?;
        Ok(scene)
    }

    /// Adds a screen as seen by the camera at time 0; one that hides nothing is left out.
    fn add_screen(&mut self, entry: &ScreenEntry) -> Result<()> {
        if entry.hides == 0.0 {
            return Ok(());
        }
        let body = self.bodies.iter().find(|body| body.name == entry.before);
        let body = body.ok_or_else(|| {
            let what = format!("`{}` stands before `{}`, which is not there", entry.name, entry.before);
            Hinted::new(what, "name a body of the scene")
        })?;
        let shape = screen(&self.shape(body, 0.0), &self.world_from_camera(0.0), entry.distance_m.0, entry.hides);
        let shape = shape.ok_or_else(|| {
            let what = format!("`{}` cannot hide `{}` at {} m", entry.name, entry.before, entry.distance_m.0);
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
}

/// A scene file.
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
    lump: Vec<LumpEntry>,
    #[serde(default)]
    plane: Vec<PlaneEntry>,
    #[serde(default)]
    screen: Vec<ScreenEntry>,
    /// Read and applied by [`super::scene_values`] before this.
    #[serde(default, rename = "values")]
    _values: BTreeMap<String, f64>,
}

impl SceneFile {
    /// Returns all visible bodies, solids first, and the camera.
    ///
    /// # Errors
    /// The sides of a plane are not valid.
    pub fn bodies(self) -> Result<(Vec<Body>, CameraEntry, Vec<ScreenEntry>)> {
        let up = self.up;
        let mut bodies: Vec<Body> = Vec::new();
        bodies.extend(self.sphere.into_iter().map(SphereEntry::body));
        bodies.extend(self.cylinder.into_iter().map(|entry| entry.body(&up)));
        bodies.extend(self.cone.into_iter().map(|entry| entry.body(&up)));
        bodies.extend(self.bowl.into_iter().map(|entry| entry.body(&up)));
        bodies.extend(self.block.into_iter().map(BoxEntry::body));
        for entry in self.lump {
            bodies.push(entry.body()?);
        }
        for entry in self.plane {
            bodies.push(entry.body()?);
        }
        Ok((bodies, self.camera, self.screen))
    }
}

/// Optical frame: x right, y down, z forward. The direction is given by one of `look_at` (a point that stays in the middle),
/// `direction` and `orientation` (quaternion `world_from_camera`); `up` (by default the scene's) is upwards in the image.
/// `motion` moves the position, `look_at_motion` the point.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraEntry {
    position: Vector,
    look_at: Option<Vector>,
    direction: Option<Direction>,
    orientation: Option<Quaternion>,
    up: Option<Direction>,
    motion: Option<Motion>,
    look_at_motion: Option<Motion>,
}

impl CameraEntry {
    pub fn view(self, world_up: &Vector3<f64>) -> Result<View> {
        let (Vector(position), Direction(up)) = (self.position, self.up.unwrap_or(Direction(*world_up)));
        let gaze = match (self.look_at, self.direction, self.orientation) {
            (Some(Vector(point)), None, None) => Gaze::At(point),
            (None, Some(Direction(forward)), None) => Gaze::Fixed(upright(&forward, &up)?),
            (None, None, Some(Quaternion(quaternion))) => Gaze::Fixed(from_quaternion(quaternion)),
            _ => bail!(Hinted::new(
                "the camera needs exactly one of `look_at`, `direction` and `orientation`",
                "`look_at = [x, y, z]` is a point that it keeps in the middle of the image"
            )),
        };
        if let Gaze::At(point) = gaze {
            upright(&(point - position), &up)?;
        } else if self.look_at_motion.is_some() {
            bail!(Hinted::new("the camera has a `look_at_motion` and no `look_at`", "give the point that moves"));
        }
        Ok(View { position, gaze, up, motion: self.motion, gaze_motion: self.look_at_motion })
    }
}

fn upright(forward: &Vector3<f64>, up: &Vector3<f64>) -> Result<Matrix3<f64>> {
    let fault = || {
        Hinted::new("the camera looks straight along `up`, so it has no upright image", "give the camera another `up`")
    };
    looking_along(forward, up).ok_or_else(|| fault().into())
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct SphereEntry {
    name: String,
    center: Vector,
    radius: Positive,
    motion: Option<Motion>,
}

impl SphereEntry {
    fn body(self) -> Body {
        let shape = Shape::Sphere(Sphere { center: self.center.0, radius: self.radius.0 });
        Body::new(self.name, shape, self.motion)
    }
}

/// `axis` points from `base`, the centre of one end, to the other end, which may be `open`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct CylinderEntry {
    name: String,
    base: Vector,
    axis: Option<Direction>,
    radius: Positive,
    length: Positive,
    #[serde(default)]
    open: bool,
    motion: Option<Motion>,
}

impl CylinderEntry {
    fn body(self, up: &Vector3<f64>) -> Body {
        let Self { name, base: Vector(base), radius: Positive(radius), length: Positive(length), open, .. } = self;
        let axis = self.axis.map_or(*up, |axis| axis.0);
        let shape = Frustum { base, axis, length, base_radius: radius, top_radius: radius, open };
        Body::new(name, Shape::Frustum(shape), self.motion)
    }
}

/// `top_radius` is 0 by default: a cone with its tip.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ConeEntry {
    name: String,
    base: Vector,
    axis: Option<Direction>,
    base_radius: Positive,
    #[serde(default, deserialize_with = "not_negative")]
    top_radius: f64,
    length: Positive,
    #[serde(default)]
    open: bool,
    motion: Option<Motion>,
}

impl ConeEntry {
    fn body(self, up: &Vector3<f64>) -> Body {
        let Self { base: Vector(base), base_radius: Positive(base_radius), top_radius, open, .. } = self;
        let (axis, length) = (self.axis.map_or(*up, |axis| axis.0), self.length.0);
        let shape = Frustum { base, axis, length, base_radius, top_radius, open };
        Body::new(self.name, Shape::Frustum(shape), self.motion)
    }
}

/// A thin shell around `center`, whose rim is `depth` (by default half of the sphere) above its bottom; `axis` points from the
/// bottom to the opening.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct BowlEntry {
    name: String,
    center: Vector,
    radius: Positive,
    axis: Option<Direction>,
    depth: Option<Positive>,
    motion: Option<Motion>,
}

impl BowlEntry {
    fn body(self, up: &Vector3<f64>) -> Body {
        let sphere = Sphere { center: self.center.0, radius: self.radius.0 };
        let (axis, depth) = (self.axis.map_or(*up, |axis| axis.0), self.depth.unwrap_or(self.radius).0);
        Body::new(self.name, Shape::Bowl(Bowl { sphere, axis, depth }), self.motion)
    }
}

/// `orientation` is a quaternion `[x, y, z, w]`, by default no rotation.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct BoxEntry {
    name: String,
    center: Vector,
    #[serde(deserialize_with = "size")]
    size: Vector3<f64>,
    orientation: Option<Quaternion>,
    motion: Option<Motion>,
}

impl BoxEntry {
    fn body(self) -> Body {
        let axes = self.orientation.map_or_else(Matrix3::identity, |orientation| from_quaternion(orientation.0));
        let shape = Shape::Block(Block { center: self.center.0, axes, half: self.size * 0.5 });
        Body::new(self.name, shape, self.motion)
    }
}

/// A superellipsoid with waves on it, by default an ellipsoid without waves: see [`Lump`].
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct LumpEntry {
    name: String,
    center: Vector,
    #[serde(deserialize_with = "size")]
    size: Vector3<f64>,
    orientation: Option<Quaternion>,
    #[serde(default = "round")]
    squareness: [u32; 2],
    #[serde(default)]
    creases: Vec<Crease>,
    motion: Option<Motion>,
}

fn round() -> [u32; 2] {
    [1, 1]
}

impl LumpEntry {
    fn body(self) -> Result<Body> {
        const SQUAREST: u32 = 6;
        if self.squareness.iter().any(|log| !(1..=SQUAREST).contains(log)) {
            bail!(Hinted::new(
                format!("the `squareness` of `{}` is {:?}", self.name, self.squareness),
                format!("two whole numbers from 1 (round) to {SQUAREST}")
            ));
        }
        let mut creases = [Crease::default(); CREASES];
        let swell: f64 = self.creases.iter().map(|crease| crease.height).sum();
        if self.creases.len() > CREASES || swell >= 1.0 {
            bail!(Hinted::new(
                format!("`{}` has {} `creases` of {swell} half-sizes together", self.name, self.creases.len()),
                format!("at most {CREASES}, lower than its half-size together")
            ));
        }
        creases[..self.creases.len()].copy_from_slice(&self.creases);
        let axes = self.orientation.map_or_else(Matrix3::identity, |orientation| from_quaternion(orientation.0));
        let lump = Lump { center: self.center.0, axes, half: self.size * 0.5, squareness: self.squareness, creases };
        Ok(Body::new(self.name, Shape::Lump(lump), self.motion))
    }
}

/// By default infinite; with `size`, a rectangle around `point` whose first side is along `along`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct PlaneEntry {
    name: String,
    point: Vector,
    normal: Direction,
    size: Option<[f64; 2]>,
    along: Option<Direction>,
    motion: Option<Motion>,
}

impl PlaneEntry {
    fn body(self) -> Result<Body> {
        let half = self.size.map_or([f64::INFINITY; 2], |size| size.map(|side| 0.5 * side));
        if !(half[0] > 0.0 && half[1] > 0.0) {
            bail!(Hinted::new(
                format!("the `size` of `{}` is not two numbers above zero", self.name),
                "without it the plane has no end"
            ));
        }
        let Direction(normal) = self.normal;
        let across = normal.cross(&self.along.map_or_else(|| some_other(&normal), |along| along.0));
        let Some(second) = across.try_normalize(1e-9) else {
            bail!(Hinted::new(
                format!("`along` and `normal` of `{}` are parallel", self.name),
                "`along` lies in the plane"
            ));
        };
        let plane = Plane { point: self.point.0, normal, sides: [second.cross(&normal), second], half };
        Ok(Body::new(self.name, Shape::Plane(plane), self.motion))
    }
}

/// A board at `distance_m` from the camera that hides the share `hides` of the width of the body named `before`.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScreenEntry {
    pub name: String,
    pub before: String,
    #[serde(deserialize_with = "share")]
    pub hides: f64,
    pub distance_m: Positive,
}

/// Returns the coordinate axis that is least parallel to a direction.
fn some_other(direction: &Vector3<f64>) -> Vector3<f64> {
    let mut axis = Vector3::zeros();
    axis[direction.iamin()] = 1.0;
    axis
}

/// Returns `:line:column` of a byte, both from 1, and that line of the text, for an error.
fn place(text: &str, byte: usize) -> [String; 2] {
    let before = &text[..byte.min(text.len())];
    let start = before.rfind('\n').map_or(0, |newline| newline + 1);
    let (line, column) = (before.matches('\n').count() + 1, before[start..].chars().count() + 1);
    let shown = text[start..].lines().next().unwrap_or_default();
    [format!(":{line}:{column}"), format!("\n  {line} | {shown}")]
}

#[cfg(test)]
#[path = "scene_file_tests.rs"]
mod tests;
