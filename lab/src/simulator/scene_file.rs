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
//! Further: `[[cone]]` (`base_radius`, `top_radius`), `[[bowl]]` (`center`, `radius`, `depth`), `[[box]]` (`center`,
//! `size`), `[[plane]]` (`point`, `normal`, `size`), `[[screen]]` (`before`, `hides`, `distance_m`). A cylinder or cone with
//! `open = true` is a cup. `[values]` and `"$name"` in place of a number: see [`super::scene_values`].

use super::fields::*;
use super::motion::Motion;
use super::pose::{from_quaternion, looking_along};
use super::scene::{Body, Gaze, Role, View};
use super::scene_values::Values;
use super::shapes::{Block, Bowl, Frustum, Plane, Shape, Sphere};
use anyhow::{Result, bail};
use conicflow_messages::Hinted;
use nalgebra::{Matrix3, Vector3};
use serde::Deserialize;

/// A scene file.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneFile {
    pub name: String,
    #[serde(default = "Vector3::z", deserialize_with = "direction")]
    pub up: Vector3<f64>,
    #[serde(default = "earth", deserialize_with = "not_negative")]
    pub gravity: f64,
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
    #[serde(default)]
    screen: Vec<ScreenEntry>,
    /// Read by [`super::scene_values`], and put in before this is.
    #[serde(default, rename = "values")]
    _values: Values,
}

impl SceneFile {
    /// What can be seen, solids first, and the camera.
    ///
    /// # Errors
    /// A plane's sides cannot be used.
    pub fn bodies(self) -> Result<(Vec<Body>, CameraEntry, Vec<ScreenEntry>)> {
        let up = self.up;
        let mut bodies: Vec<Body> = Vec::new();
        bodies.extend(self.sphere.into_iter().map(SphereEntry::body));
        bodies.extend(self.cylinder.into_iter().map(|entry| entry.body(&up)));
        bodies.extend(self.cone.into_iter().map(|entry| entry.body(&up)));
        bodies.extend(self.bowl.into_iter().map(|entry| entry.body(&up)));
        bodies.extend(self.block.into_iter().map(BoxEntry::body));
        for entry in self.plane {
            bodies.push(entry.body()?);
        }
        Ok((bodies, self.camera, self.screen))
    }
}

/// Gravity on earth, in m/s^2.
pub fn earth() -> f64 {
    9.81
}

/// Optical frame: x right, y down, z forward. One of `look_at` (a point that it keeps in view), `direction` and
/// `orientation` (quaternion `world_from_camera`) says where it looks; `up` (the scene's where left out) is upwards in
/// the image. `motion` moves the position, `look_at_motion` the point.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraEntry {
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
    pub fn view(self, world_up: &Vector3<f64>) -> Result<View> {
        let up = self.up.unwrap_or(*world_up);
        let gaze = match (self.look_at, self.direction, self.orientation) {
            (Some(point), None, None) => Gaze::At(point),
            (None, Some(forward), None) => Gaze::Fixed(upright(&forward, &up)?),
            (None, None, Some(quaternion)) => Gaze::Fixed(from_quaternion(quaternion)),
            _ => bail!(Hinted::new(
                "the camera needs exactly one of `look_at`, `direction` and `orientation`",
                "`look_at = [x, y, z]` is a point that it keeps in the middle of the image"
            )),
        };
        if let Gaze::At(point) = gaze {
            upright(&(point - self.position), &up)?;
        } else if self.look_at_motion.is_some() {
            bail!(Hinted::new("the camera has a `look_at_motion` and no `look_at`", "give the point that moves"));
        }
        Ok(View { position: self.position, gaze, up, motion: self.motion, gaze_motion: self.look_at_motion })
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
    #[serde(deserialize_with = "vector")]
    center: Vector3<f64>,
    #[serde(deserialize_with = "positive")]
    radius: f64,
    motion: Option<Motion>,
}

impl SphereEntry {
    fn body(self) -> Body {
        let shape = Shape::Sphere(Sphere { center: self.center, radius: self.radius });
        Body { name: self.name, shape, motion: self.motion, role: Role::Object }
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
        Body { name: self.name, shape, motion: self.motion, role: Role::Object }
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
        Body {
            name,
            shape: Shape::Frustum(Frustum { base, axis, length, base_radius, top_radius, open }),
            motion,
            role: Role::Object,
        }
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
    #[serde(default, deserialize_with = "maybe_positive")]
    depth: Option<f64>,
    motion: Option<Motion>,
}

impl BowlEntry {
    fn body(self, up: &Vector3<f64>) -> Body {
        let sphere = Sphere { center: self.center, radius: self.radius };
        let (axis, depth) = (self.axis.unwrap_or(*up), self.depth.unwrap_or(self.radius));
        Body {
            name: self.name,
            shape: Shape::Bowl(Bowl { sphere, axis, depth }),
            motion: self.motion,
            role: Role::Object,
        }
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
        Body { name: self.name, shape, motion: self.motion, role: Role::Object }
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
            bail!(Hinted::new(
                format!("the `size` of `{}` is not two numbers above zero", self.name),
                "without it the plane has no end"
            ));
        }
        let across = self.normal.cross(&self.along.unwrap_or_else(|| some_other(&self.normal)));
        let Some(second) = across.try_normalize(1e-9) else {
            bail!(Hinted::new(
                format!("`along` and `normal` of `{}` are parallel", self.name),
                "`along` lies in the plane"
            ));
        };
        let plane = Plane { point: self.point, normal: self.normal, sides: [second.cross(&self.normal), second], half };
        Ok(Body { name: self.name, shape: Shape::Plane(plane), motion: self.motion, role: Role::Object })
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
    #[serde(deserialize_with = "positive")]
    pub distance_m: f64,
}

/// The coordinate axis that is least parallel to a direction.
fn some_other(direction: &Vector3<f64>) -> Vector3<f64> {
    let mut axis = Vector3::zeros();
    axis[direction.iamin()] = 1.0;
    axis
}
