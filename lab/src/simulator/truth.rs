//! The truth: the spheres, cylinders and cones of a rendered scene as [`Object`]s in the camera's frame, with the visible part of
//! each, and their lines in the truth file.

use super::motion::Motion;
use super::raster::{Raster, Window, ray};
use super::scene::{Role, Scene};
use super::shapes::{Bowl, Frustum, Shape, Surface};
use conicflow_messages::{Camera, Fields, Named, Object, ObjectKind};
use nalgebra::Vector3;
use serde::Serialize;

/// A true sphere, cylinder or cone.
#[derive(Clone, Debug, PartialEq)]
pub struct Truth {
    /// Its name in the scene.
    pub name: String,
    /// Its visible part as an ideal detector would report it: `points` is the number of visible pixels, `rows` the number of
    /// their rows. If nothing is visible: the whole, with no points.
    pub object: Object,
    /// The whole object: `center` and `length` are those of the whole body.
    pub body: Object,
    /// Share of the pixels that it would cover alone which are hidden by others or outside of the image; 1 if it is behind the
    /// camera.
    pub hidden: f64,
    /// Columns and rows from the first to the last visible pixel.
    pub extent_px: [u32; 2],
    /// Whether it is a bowl: its outside is a part of a sphere and may be detected as one, but its inside may not.
    pub bowl: bool,
    /// Whether it is a part of something that is no object.
    pub part: bool,
    /// Velocity over ground, in the camera's axes, in m/s.
    pub velocity: [f64; 3],
}

/// Returns the truth of a scene at a time (seconds), as seen by a camera at the scene's pose.
pub fn truth_at(scene: &Scene, camera: Camera, time_s: f64) -> Vec<Truth> {
    let shapes: Vec<Shape> = scene.shapes_in_camera(time_s).collect();
    truth_of(scene, time_s, &Raster::of(camera, &shapes), &shapes)
}

/// Returns the truth of a rendered scene; `shapes` are its bodies in the camera's frame.
pub fn truth_of(scene: &Scene, time_s: f64, raster: &Raster, shapes: &[Shape]) -> Vec<Truth> {
    let seen = look(raster, shapes);
    let mut truths = Vec::new();
    for (index, (body, shape)) in scene.bodies.iter().zip(shapes).enumerate() {
        let Some(whole) = object(shape) else { continue };
        let alone = raster.alone[index] + covered_outside(&raster.camera, shape);
        let visible = f64::from(seen[index].points) / f64::from(alone.max(1));
        truths.push(Truth {
            name: body.name.clone(),
            object: visible_part(whole, shape, &seen[index]),
            body: whole,
            hidden: 1.0 - visible,
            extent_px: seen[index].extent_px(),
            bowl: matches!(shape, Shape::Bowl(_)),
            part: body.role != Role::Object,
            velocity: velocity(scene, index, time_s),
        });
    }
    truths
}

/// The visible extent of a shape.
#[derive(Clone, Copy, Debug)]
struct VisibleExtent {
    points: u32,
    rows: u32,
    last_row: i64,
    u: Span,
    v: Span,
    along: Span,
    angle: Span,
}

#[derive(Clone, Copy, Debug)]
struct Span {
    least: f64,
    most: f64,
}

impl Span {
    const EMPTY: Self = Self { least: f64::INFINITY, most: f64::NEG_INFINITY };

    fn add(&mut self, value: f64) {
        *self = Self { least: self.least.min(value), most: self.most.max(value) };
    }

    fn width(self) -> f64 {
        (self.most - self.least).max(0.0)
    }
}

fn look(raster: &Raster, shapes: &[Shape]) -> Vec<VisibleExtent> {
    let (u, v, along, angle) = (Span::EMPTY, Span::EMPTY, Span::EMPTY, Span::EMPTY);
    let nothing = VisibleExtent { points: 0, rows: 0, last_row: -1, u, v, along, angle };
    let mut seen = vec![nothing; shapes.len()];
    for v in 0..i64::from(raster.camera.height) {
        for u in 0..i64::from(raster.camera.width) {
            let owner = usize::from(raster.owner[raster.index(u, v)]);
            let Some(shape) = shapes.get(owner) else { continue };
            if matches!(shape, Shape::Sphere(_) | Shape::Frustum(_) | Shape::Bowl(_)) {
                seen[owner].add(shape, [u, v], &raster.point(u, v));
            }
        }
    }
    seen
}

impl VisibleExtent {
    fn add(&mut self, shape: &Shape, [u, v]: [i64; 2], point: &Vector3<f64>) {
        self.points += 1;
        self.rows += u32::from(v != self.last_row);
        self.last_row = v;
        self.u.add(u as f64);
        self.v.add(v as f64);
        if shape.normal(point).dot(point) > 0.0 {
            return; // the inside of a cup or bowl
        }
        match shape {
            Shape::Sphere(sphere) | Shape::Bowl(Bowl { sphere, .. }) => {
                self.angle.add(angle_about(&sphere.center, &across(&sphere.center), point));
            }
            Shape::Frustum(frustum) if !frustum.is_cap(point) => {
                self.along.add(frustum.along(point));
                self.angle.add(angle_about(&frustum.base, &frustum.axis, point));
            }
            _ => {}
        }
    }

    fn extent_px(&self) -> [u32; 2] {
        [self.u, self.v].map(|span| if self.points > 0 { span.width() as u32 + 1 } else { 0 })
    }
}

/// Returns the angle of a point about an axis, from the direction to the camera.
fn angle_about(center: &Vector3<f64>, axis: &Vector3<f64>, point: &Vector3<f64>) -> f64 {
    let to_camera = axis * center.dot(axis) - center;
    let outwards = point - center;
    axis.cross(&to_camera).dot(&outwards).atan2(to_camera.dot(&outwards))
}

/// Returns the direction perpendicular to the line of sight that is nearest to the image's vertical.
fn across(center: &Vector3<f64>) -> Vector3<f64> {
    center.cross(&Vector3::x()).try_normalize(1e-9).unwrap_or_else(Vector3::y)
}

/// Returns the whole shape as an object; `None` for boxes and planes.
fn object(shape: &Shape) -> Option<Object> {
    match shape {
        Shape::Sphere(sphere) | Shape::Bowl(Bowl { sphere, .. }) => Some(Object {
            kind: ObjectKind::Sphere.code(),
            center: sphere.center.into(),
            radius: sphere.radius,
            ..Object::default()
        }),
        Shape::Frustum(frustum) => Some(part_of(frustum, 0.0, frustum.length)),
        Shape::Block(_) | Shape::Plane(_) | Shape::Lump(_) => None,
    }
}

/// Returns the part of a frustum between two distances from its first end; with equal radii it is a cylinder.
fn part_of(frustum: &Frustum, from: f64, to: f64) -> Object {
    let middle = 0.5 * (from + to);
    let whole = Object {
        kind: ObjectKind::Cylinder.code(),
        center: (frustum.base + frustum.axis * middle).into(),
        axis: frustum.axis.into(),
        radius: frustum.radius_at(middle),
        length: to - from,
        ..Object::default()
    };
    let slope = frustum.slope();
    if slope == 0.0 {
        return whole;
    }
    let ends = [frustum.radius_at(from), frustum.radius_at(to)];
    Object {
        kind: ObjectKind::Cone.code(),
        axis: (frustum.axis * slope.signum()).into(),
        half_angle: slope.abs().atan(),
        base_radius: ends[0].max(ends[1]),
        top_radius: ends[0].min(ends[1]),
        apex: (frustum.base - frustum.axis * (frustum.base_radius / slope)).into(),
        ..whole
    }
}

fn visible_part(whole: Object, shape: &Shape, seen: &VisibleExtent) -> Object {
    let part = match shape {
        Shape::Frustum(frustum) if seen.along.width() > 0.0 => part_of(frustum, seen.along.least, seen.along.most),
        _ => whole,
    };
    Object { points: seen.points, rows: seen.rows, arc: seen.angle.width(), ..part }
}

/// Returns the number of pixels that a shape would cover beside the image, up to one image's size away.
fn covered_outside(camera: &Camera, shape: &Shape) -> u32 {
    let Some(window) = Window::of_bounds(camera, shape.bounds()) else { return 0 };
    let image = Window::image(camera, 0);
    let Some(around) = window.and(Window::image(camera, 1)) else { return 0 };
    if around.and(image) == Some(around) {
        return 0;
    }
    let inside = |u: i64, v: i64| (image.u[0]..image.u[1]).contains(&u) && (image.v[0]..image.v[1]).contains(&v);
    let row = |v: i64| {
        (around.u[0]..around.u[1])
            .filter(|&u| !inside(u, v) && shape.hit(&Vector3::zeros(), &ray(camera, u, v)).is_finite())
            .count() as u32
    };
    (around.v[0]..around.v[1]).map(row).sum()
}

/// Returns the velocity: on a path that of the path, which may jump; else a central difference over a millisecond.
fn velocity(scene: &Scene, index: usize, time_s: f64) -> [f64; 3] {
    const HALF_STEP_S: f64 = 0.0005;
    let body = &scene.bodies[index];
    let place = |time_s: f64| scene.shape(body, time_s).anchor();
    let over_ground = match &body.motion {
        Some(Motion::Path(path)) => path.velocity(time_s),
        _ => (place(time_s + HALF_STEP_S) - place(time_s - HALF_STEP_S)) / (2.0 * HALF_STEP_S),
    };
    scene.world_from_camera(time_s).rotation.tr_mul(&over_ground).into()
}

/// One line of the truth file: the objects of one frame, in the camera frame, with metres, radians and seconds.
#[derive(Clone, Debug, Serialize)]
pub struct TruthLine {
    /// Number of the frame.
    pub sequence: u64,
    /// Name of the scene.
    pub source: String,
    /// Simulated time in nanoseconds.
    pub stamp_ns: u64,
    /// All spheres, cylinders and cones of the scene, including those outside of the image (with `points` = 0).
    pub objects: Vec<TruthObject>,
}

/// A true object in the truth file: its visible part like a detected object in JSON, without the estimate's uncertainties, and
/// what only the scene knows.
#[derive(Clone, Debug, Serialize)]
pub struct TruthObject {
    /// Its name in the scene.
    name: String,
    /// `sphere`, `cylinder`, `cone`, or `bowl`: a shell whose outside is a part of the given sphere.
    kind: &'static str,
    /// Whether it is a part of something that is no object: a limb, the leg of a chair.
    #[serde(skip_serializing_if = "std::ops::Not::not")]
    part: bool,
    #[serde(flatten)]
    visible: Fields<'static>,
    /// Share of the pixels that it would cover alone which are hidden or outside of the image.
    hidden: f64,
    /// Velocity over ground, in the camera's axes.
    velocity: [f64; 3],
    /// Centre of the whole body.
    body_center: [f64; 3],
    /// Length of the whole body; 0 for a sphere.
    body_length: f64,
}

impl From<&Truth> for TruthObject {
    fn from(truth: &Truth) -> Self {
        let Fields(mut visible) = truth.object.fields();
        visible.retain(|(name, _)| !["kind", "sigma", "rms"].contains(name));
        Self {
            name: truth.name.clone(),
            kind: if truth.bowl { "bowl" } else { truth.object.shape().name() },
            part: truth.part,
            visible: Fields(visible),
            hidden: truth.hidden,
            velocity: truth.velocity,
            body_center: truth.body.center,
            body_length: truth.body.length,
        }
    }
}

#[cfg(test)]
#[path = "truth_tests.rs"]
mod tests;
