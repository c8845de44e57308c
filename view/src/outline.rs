//! The outlines of spheres, cylinders and cones as a pinhole camera sees them.
//!
//! A point p of a surface with normal n belongs to the outline where the line of sight is tangent to the surface: `n'p = 0`.
//! - Sphere, centre c, radius R, d = |c|: a circle around `c (1 - R^2/d^2)` of radius `R sqrt(d^2 - R^2) / d`.
//! - Cylinder and cone, `p = c + t a + (r + m t) u`, unit axis a, radial unit vector u, slope m: `n = u - m a`, hence `u'c = m
//!   a'c - r`: two straight lines, drawn together with the circles at both ends.

use conicflow_messages::{Camera, Object, ObjectKind};
use nalgebra::Vector3;
use std::f64::consts::TAU;

const CIRCLE_STEPS: u32 = 72;
/// Nearer parts are not drawn, in metres.
const NEAREST_M: f64 = 0.02;

type Point = Vector3<f64>;

/// A segment of an outline in the image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Segment {
    /// The start in pixels (u, v).
    pub from: [f64; 2],
    /// The end in pixels (u, v).
    pub to: [f64; 2],
    /// Whether the segment lies on the far side of the object.
    pub hidden: bool,
}

/// Writes the outline of an object to `segments`, which is cleared first.
pub fn trace(object: &Object, camera: &Camera, segments: &mut Vec<Segment>) {
    segments.clear();
    let mut tracer = Tracer { camera, segments };
    match object.shape() {
        ObjectKind::Sphere => tracer.sphere(object.center.into(), object.radius),
        ObjectKind::Cylinder => tracer.frustum(&Frustum::new(object, object.radius, object.radius)),
        ObjectKind::Cone => tracer.frustum(&Frustum::new(object, object.top_radius, object.base_radius)),
    }
}

/// Projects a point to a pixel, if it lies in front of the camera.
pub fn project(camera: &Camera, point: &Point) -> Option<[f64; 2]> {
    let [x, y, z] = [point.x, point.y, point.z];
    (z > NEAREST_M).then(|| [camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy])
}

/// A cylinder or a frustum of a cone.
struct Frustum {
    axis: Point,
    /// The centres and radii of its ends, along the axis.
    ends: [(Point, f64); 2],
    /// Growth of the radius along the axis.
    slope: f64,
}

impl Frustum {
    fn new(object: &Object, start_radius: f64, end_radius: f64) -> Self {
        let (center, axis) = (Point::from(object.center), Point::from(object.axis));
        let half = axis * (object.length / 2.0);
        let slope = if object.length > 1e-6 { (end_radius - start_radius) / object.length } else { 0.0 };
        Self { axis, ends: [(center - half, start_radius), (center + half, end_radius)], slope }
    }

    /// Two directions perpendicular to the axis: towards the camera, and sideways.
    fn across(&self) -> (Point, Point) {
        let center = self.ends[0].0;
        let toward = -(center - self.axis * self.axis.dot(&center));
        let toward = toward.try_normalize(1e-9).unwrap_or_else(|| any_perpendicular(&self.axis));
        (toward, self.axis.cross(&toward))
    }

    /// The radial directions of the two lines of the outline; `None` if the camera looks along the axis.
    fn limbs(&self) -> Option<[Point; 2]> {
        let (center, radius) = self.ends[0];
        let (toward, beside) = self.across();
        let distance = -toward.dot(&center);
        let cosine = (radius - self.slope * self.axis.dot(&center)) / distance;
        let sine = (1.0 - cosine * cosine).sqrt();
        sine.is_finite().then(|| [toward * cosine + beside * sine, toward * cosine - beside * sine])
    }
}

fn any_perpendicular(axis: &Point) -> Point {
    let other = if axis.x.abs() < 0.7 { Point::x() } else { Point::y() };
    axis.cross(&other).normalize()
}

struct Tracer<'a> {
    camera: &'a Camera,
    segments: &'a mut Vec<Segment>,
}

impl Tracer<'_> {
    fn segment(&mut self, from: &Point, to: &Point, hidden: bool) {
        if let Some((from, to)) = project(self.camera, from).zip(project(self.camera, to)) {
            self.segments.push(Segment { from, to, hidden });
        }
    }

    /// Draws a circle; `hidden` says for a radial direction and a point whether the point is hidden.
    fn circle(
        &mut self,
        center: Point,
        radius: f64,
        (e1, e2): (Point, Point),
        hidden: impl Fn(&Point, &Point) -> bool,
    ) {
        let radial = |step: u32| {
            let (sine, cosine) = (TAU * f64::from(step) / f64::from(CIRCLE_STEPS)).sin_cos();
            e1 * cosine + e2 * sine
        };
        for step in 0..CIRCLE_STEPS {
            let (from, to) = (radial(step), radial(step + 1));
            let middle = (from + to) / 2.0;
            let is_hidden = hidden(&middle, &(center + middle * radius));
            self.segment(&(center + from * radius), &(center + to * radius), is_hidden);
        }
    }

    fn sphere(&mut self, center: Point, radius: f64) {
        let distance = center.norm();
        if distance <= radius {
            return;
        }
        let toward = center / distance;
        let touching = center * (1.0 - (radius / distance).powi(2));
        let touching_radius = radius * (1.0 - (radius / distance).powi(2)).sqrt();
        let e1 = any_perpendicular(&toward);
        self.circle(touching, touching_radius, (e1, toward.cross(&e1)), |_, _| false);
    }

    fn frustum(&mut self, frustum: &Frustum) {
        let (axis, slope) = (frustum.axis, frustum.slope);
        for ((center, radius), outward) in frustum.ends.into_iter().zip([-axis, axis]) {
            let end_is_seen = outward.dot(&center) < 0.0;
            let turned_away = |radial: &Point, point: &Point| (radial - axis * slope).dot(point) > 0.0;
            self.circle(center, radius, frustum.across(), |radial, point| !end_is_seen && turned_away(radial, point));
        }
        let [(start, start_radius), (end, end_radius)] = frustum.ends;
        for radial in frustum.limbs().into_iter().flatten() {
            self.segment(&(start + radial * start_radius), &(end + radial * end_radius), false);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Camera = Camera { width: 640, height: 480, fx: 500.0, fy: 500.0, cx: 320.0, cy: 240.0 };

    fn traced(object: &Object) -> Vec<Segment> {
        let mut segments = Vec::new();
        trace(object, &CAMERA, &mut segments);
        segments
    }

    /// The smallest and the largest pixel along an axis.
    fn extent(segments: &[Segment], axis: usize) -> (f64, f64) {
        let pixels = segments.iter().flat_map(|segment| [segment.from[axis], segment.to[axis]]);
        pixels.fold((f64::MAX, f64::MIN), |(low, high), pixel| (low.min(pixel), high.max(pixel)))
    }

    fn close(got: (f64, f64), expected: (f64, f64)) -> bool {
        (got.0 - expected.0).abs() < 0.3 && (got.1 - expected.1).abs() < 0.3
    }

    fn object(kind: ObjectKind, radius: f64) -> Object {
        Object {
            kind: kind.code(),
            center: [0.0, 0.0, 2.0],
            axis: [0.0, 1.0, 0.0],
            radius,
            length: 0.4,
            ..Object::default()
        }
    }

    #[test]
    fn a_sphere_is_as_wide_as_its_tangents() {
        let segments = traced(&object(ObjectKind::Sphere, 0.5));
        let tangent = 500.0 * (0.25_f64).asin().tan();
        assert!(close(extent(&segments, 0), (320.0 - tangent, 320.0 + tangent)));
        assert!(close(extent(&segments, 1), (240.0 - tangent, 240.0 + tangent)));
        assert!(segments.iter().all(|segment| !segment.hidden));
    }

    #[test]
    fn an_upright_cylinder_is_as_wide_as_its_tangents() {
        let segments = traced(&object(ObjectKind::Cylinder, 0.5));
        let tangent = 500.0 * (0.25_f64).asin().tan();
        assert!(close(extent(&segments, 0), (320.0 - tangent, 320.0 + tangent)));
        // The ends lie 0.2 m off the axis; their nearest points are 1.5 m away.
        assert!(close(extent(&segments, 1), (240.0 - 500.0 * 0.2 / 1.5, 240.0 + 500.0 * 0.2 / 1.5)));
        let limbs = &segments[segments.len() - 2..];
        assert!(limbs.iter().all(|limb| (limb.from[0] - limb.to[0]).abs() < 1e-9), "the limbs are upright");
        assert!(segments.iter().any(|segment| segment.hidden), "the back of the ends");
    }

    #[test]
    fn the_limbs_of_a_cone_touch_its_surface() {
        let half_angle = 0.3_f64;
        let apex = Point::new(0.1, -0.5, 2.0);
        let axis = Point::new(0.2, 0.9, -0.3).normalize();
        let radius_at = |h: f64| h * half_angle.tan();
        let cone = Object {
            center: (apex + axis * 0.4).into(),
            axis: axis.into(),
            length: 0.4,
            top_radius: radius_at(0.2),
            base_radius: radius_at(0.6),
            ..object(ObjectKind::Cone, radius_at(0.4))
        };
        let frustum = Frustum::new(&cone, cone.top_radius, cone.base_radius);
        for radial in frustum.limbs().unwrap() {
            let normal = radial - axis * half_angle.tan();
            let point = frustum.ends[1].0 + radial * frustum.ends[1].1;
            assert!(normal.dot(&point).abs() < 1e-12);
            assert!(radial.dot(&axis).abs() < 1e-12);
        }
        assert_eq!(traced(&cone).len(), 2 * 72 + 2);
    }

    #[test]
    fn seen_along_the_axis_the_outline_has_circles_only() {
        let along = Object { axis: [0.0, 0.0, 1.0], ..object(ObjectKind::Cylinder, 0.3) };
        let segments = traced(&along);
        assert_eq!(segments.len(), 2 * 72);
        assert!(close(extent(&segments[..72], 0), (320.0 - 500.0 * 0.3 / 1.8, 320.0 + 500.0 * 0.3 / 1.8)));
    }

    #[test]
    fn objects_behind_or_around_the_camera_are_not_drawn() {
        assert!(traced(&Object { center: [0.0, 0.0, -2.0], ..object(ObjectKind::Sphere, 0.5) }).is_empty());
        assert!(traced(&object(ObjectKind::Sphere, 3.0)).is_empty());
        let degenerate = Object { length: 0.0, axis: [0.0; 3], ..object(ObjectKind::Cylinder, 0.1) };
        assert!(traced(&degenerate).iter().all(|segment| segment.from[0].is_finite()));
    }
}
