//! Solids, shells and planes that can be intersected exactly with a ray.
//!
//! A ray is `origin + t direction`. With the camera's centre as origin and `direction = ((u - cx) / fx, (v - cy) / fy, 1)`, the
//! parameter `t` is the depth `z`. Sphere and frustum are quadratic in `t`, `a t^2 + 2 b t + c = 0`; box and plane are linear; a
//! lump is intersected by steps.

pub use super::block::Block;
pub use super::lump::{Crease, Lump};
use super::pose::Pose;
pub use super::surface::Surface;
use super::surface::{ahead, first_ahead};
use nalgebra::Vector3;

/// A ball.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sphere {
    /// Its centre.
    pub center: Vector3<f64>,
    /// Its radius.
    pub radius: f64,
}

/// A cylinder, a cone or a truncated cone; closed at both ends, or a cup.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Frustum {
    /// Centre of the first end.
    pub base: Vector3<f64>,
    /// Unit vector from the first end to the second.
    pub axis: Vector3<f64>,
    /// Distance between the ends.
    pub length: f64,
    /// Radius of the first end.
    pub base_radius: f64,
    /// Radius of the second end.
    pub top_radius: f64,
    /// Whether the second end is open: a thin wall whose inside can be seen.
    pub open: bool,
}

/// A thin shell that is a part of a sphere: a bowl, seen from outside or inside.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bowl {
    /// The whole sphere.
    pub sphere: Sphere,
    /// Unit vector from its bottom to its opening.
    pub axis: Vector3<f64>,
    /// Distance of the rim from the bottom, along the axis.
    pub depth: f64,
}

/// A plane, or a rectangle of one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plane {
    /// A point on it; the middle of the rectangle.
    pub point: Vector3<f64>,
    /// Unit normal.
    pub normal: Vector3<f64>,
    /// Directions of the rectangle's sides, as unit vectors.
    pub sides: [Vector3<f64>; 2],
    /// Half of its size along each side; infinite for a plane.
    pub half: [f64; 2],
}

/// Any of the shapes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Shape {
    /// A ball.
    Sphere(Sphere),
    /// A cylinder, cone or cup.
    Frustum(Frustum),
    /// A bowl.
    Bowl(Bowl),
    /// A box.
    Block(Block),
    /// A plane or rectangle.
    Plane(Plane),
    /// Something nearly round, rounded or creased.
    Lump(Lump),
}

/// Returns both solutions of `a t^2 + 2 b t + c = 0` without cancellation; NaN if there are none.
#[inline]
fn roots(a: f64, b: f64, c: f64) -> [f64; 2] {
    let root = (b * b - a * c).sqrt();
    let q = -(b + root.copysign(b));
    [q / a, c / q]
}

impl Sphere {
    #[inline]
    fn crossings(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> [f64; 2] {
        let from_center = origin - self.center;
        let c = from_center.norm_squared() - self.radius * self.radius;
        roots(direction.norm_squared(), from_center.dot(direction), c)
    }
}

impl Surface for Sphere {
    #[inline]
    fn hit(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> f64 {
        first_ahead(self.crossings(origin, direction))
    }

    fn normal(&self, point: &Vector3<f64>) -> Vector3<f64> {
        (point - self.center) / self.radius
    }

    fn bounds(&self) -> Option<[Vector3<f64>; 2]> {
        let reach = Vector3::repeat(self.radius);
        Some([self.center - reach, self.center + reach])
    }

    fn transformed(&self, target_from_source: &Pose) -> Self {
        Self { center: target_from_source.point(&self.center), ..*self }
    }
}

impl Frustum {
    /// Change of the radius along the axis.
    #[inline]
    pub fn slope(&self) -> f64 {
        (self.top_radius - self.base_radius) / self.length
    }

    /// Radius at a distance from the first end.
    pub fn radius_at(&self, along: f64) -> f64 {
        self.base_radius + self.slope() * along
    }

    /// Distance of a point from the first end, along the axis.
    #[inline]
    pub fn along(&self, point: &Vector3<f64>) -> f64 {
        (point - self.base).dot(&self.axis)
    }

    /// Whether a point of the surface belongs to one of its two flat ends.
    pub fn is_cap(&self, point: &Vector3<f64>) -> bool {
        let along = self.along(point);
        let radius = (point - self.base - self.axis * along).norm();
        let inside = self.radius_at(along) - radius;
        along.min(self.length - along).abs() < inside.abs()
    }
}

impl Surface for Frustum {
    /// Side: `|p - h axis|^2 = (base_radius + slope h)^2` with `h = p . axis`; ends: `h = 0` and `h = length`.
    #[inline]
    fn hit(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> f64 {
        let from_base = origin - self.base;
        let (o_axial, d_axial) = (from_base.dot(&self.axis), direction.dot(&self.axis));
        let slope = self.slope();
        let (o_radius, d_radius) = (self.base_radius + slope * o_axial, slope * d_axial);
        let (dd, od, oo) = (direction.norm_squared(), from_base.dot(direction), from_base.norm_squared());
        let a = dd - d_axial * d_axial - d_radius * d_radius;
        let b = od - o_axial * d_axial - o_radius * d_radius;
        let c = oo - o_axial * o_axial - o_radius * o_radius;
        if a > 0.0 && b * b < a * c {
            return f64::INFINITY; // a line through an end also meets the side, prolonged
        }
        let side = |t: f64| if (0.0..=self.length).contains(&(o_axial + t * d_axial)) { t } else { f64::NAN };
        let end = |h: f64, radius: f64| {
            let t = (h - o_axial) / d_axial;
            if oo + t * (2.0 * od + t * dd) <= radius * radius + h * h { t } else { f64::NAN }
        };
        let sides = first_ahead(roots(a, b, c).map(side));
        let top = if self.open { f64::NAN } else { end(self.length, self.top_radius) };
        let ends = first_ahead([end(0.0, self.base_radius), top]);
        sides.min(ends)
    }

    fn normal(&self, point: &Vector3<f64>) -> Vector3<f64> {
        let along = self.along(point);
        if self.is_cap(point) {
            return if along > 0.5 * self.length { self.axis } else { -self.axis };
        }
        let outwards = (point - self.base - self.axis * along).normalize();
        (outwards - self.axis * self.slope()).normalize()
    }

    /// A disc of radius r reaches `r sqrt(1 - axis_i^2)` along coordinate i.
    fn bounds(&self) -> Option<[Vector3<f64>; 2]> {
        let reach = self.axis.map(|component| (1.0 - component * component).max(0.0).sqrt());
        let top = self.base + self.axis * self.length;
        let (at_base, at_top) = (reach * self.base_radius, reach * self.top_radius);
        Some([(self.base - at_base).inf(&(top - at_top)), (self.base + at_base).sup(&(top + at_top))])
    }

    fn transformed(&self, target_from_source: &Pose) -> Self {
        let base = target_from_source.point(&self.base);
        Self { base, axis: target_from_source.rotation * self.axis, ..*self }
    }
}

impl Bowl {
    /// Returns the height of a point above the rim.
    fn above_rim(&self, point: &Vector3<f64>) -> f64 {
        (point - self.sphere.center).dot(&self.axis) + self.sphere.radius - self.depth
    }
}

impl Surface for Bowl {
    fn hit(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> f64 {
        let wall = |t: f64| if self.above_rim(&(origin + direction * t)) <= 0.0 { t } else { f64::NAN };
        first_ahead(self.sphere.crossings(origin, direction).map(wall))
    }

    fn normal(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.sphere.normal(point)
    }

    fn bounds(&self) -> Option<[Vector3<f64>; 2]> {
        self.sphere.bounds()
    }

    fn transformed(&self, target_from_source: &Pose) -> Self {
        let sphere = self.sphere.transformed(target_from_source);
        Self { sphere, axis: target_from_source.rotation * self.axis, ..*self }
    }
}

impl Plane {
    fn is_finite(&self) -> bool {
        self.half[0].is_finite() && self.half[1].is_finite()
    }
}

impl Surface for Plane {
    #[inline]
    fn hit(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> f64 {
        let t = ahead((self.point - origin).dot(&self.normal) / direction.dot(&self.normal));
        if !self.is_finite() {
            return t;
        }
        let offset = origin + direction * t - self.point;
        let inside = (0..2).all(|i| offset.dot(&self.sides[i]).abs() <= self.half[i]);
        if inside { t } else { f64::INFINITY }
    }

    fn normal(&self, _: &Vector3<f64>) -> Vector3<f64> {
        self.normal
    }

    fn bounds(&self) -> Option<[Vector3<f64>; 2]> {
        let reach = self.sides[0].abs() * self.half[0] + self.sides[1].abs() * self.half[1];
        self.is_finite().then(|| [self.point - reach, self.point + reach])
    }

    fn transformed(&self, target_from_source: &Pose) -> Self {
        let rotation = &target_from_source.rotation;
        let sides = self.sides.map(|side| rotation * side);
        Self { point: target_from_source.point(&self.point), normal: rotation * self.normal, sides, ..*self }
    }
}

impl Surface for Shape {
    fn hit(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> f64 {
        self.surface().hit(origin, direction)
    }

    fn normal(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.surface().normal(point)
    }

    fn bounds(&self) -> Option<[Vector3<f64>; 2]> {
        self.surface().bounds()
    }

    fn transformed(&self, target_from_source: &Pose) -> Self {
        match self {
            Self::Sphere(sphere) => Self::Sphere(sphere.transformed(target_from_source)),
            Self::Frustum(frustum) => Self::Frustum(frustum.transformed(target_from_source)),
            Self::Bowl(bowl) => Self::Bowl(bowl.transformed(target_from_source)),
            Self::Block(block) => Self::Block(block.transformed(target_from_source)),
            Self::Plane(plane) => Self::Plane(plane.transformed(target_from_source)),
            Self::Lump(lump) => Self::Lump(lump.transformed(target_from_source)),
        }
    }
}

impl Shape {
    fn surface(&self) -> &dyn Surface {
        match self {
            Self::Sphere(sphere) => sphere,
            Self::Frustum(frustum) => frustum,
            Self::Bowl(bowl) => bowl,
            Self::Block(block) => block,
            Self::Plane(plane) => plane,
            Self::Lump(lump) => lump,
        }
    }

    /// Returns the point whose position a scene file gives: the centre, the middle of the first end, or the plane's point.
    pub fn anchor(&self) -> Vector3<f64> {
        match self {
            Self::Sphere(sphere) => sphere.center,
            Self::Frustum(frustum) => frustum.base,
            Self::Bowl(bowl) => bowl.sphere.center,
            Self::Block(block) => block.center,
            Self::Plane(plane) => plane.point,
            Self::Lump(lump) => lump.center,
        }
    }

    /// Whether it may hide a part of itself, because its inside is visible or it is creased.
    pub fn hides_itself(&self) -> bool {
        matches!(self, Self::Bowl(_) | Self::Frustum(Frustum { open: true, .. }) | Self::Lump(_))
    }

    /// Returns how far the shape reaches below its anchor, opposite to the unit vector `up`; infinite for an infinite plane.
    pub fn reach_below(&self, up: &Vector3<f64>) -> f64 {
        match self {
            Self::Sphere(sphere) | Self::Bowl(Bowl { sphere, .. }) => sphere.radius,
            Self::Frustum(frustum) => {
                let rise = frustum.axis.dot(up);
                let reach = (1.0 - rise * rise).max(0.0).sqrt();
                (frustum.base_radius * reach).max(frustum.top_radius * reach - frustum.length * rise)
            }
            Self::Block(block) => block.reach_along(up),
            Self::Lump(lump) => lump.hull().reach_along(up),
            Self::Plane(plane) => (0..2).map(|i| plane.sides[i].dot(up).abs() * plane.half[i]).sum(),
        }
    }
}

#[cfg(test)]
#[path = "shapes_tests.rs"]
mod tests;
