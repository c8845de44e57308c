//! Boxes; rays are intersected with them as slabs (Kay and Kajiya, "Ray tracing complex scenes", 1986).

use super::pose::Pose;
use super::surface::{Surface, first_ahead};
use nalgebra::{Matrix3, Vector3};

/// A box of any orientation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Block {
    /// Its centre.
    pub center: Vector3<f64>,
    /// Directions of its edges, as columns.
    pub axes: Matrix3<f64>,
    /// Half of its size along each edge.
    pub half: Vector3<f64>,
}

impl Block {
    /// Returns where a ray enters and leaves the box.
    #[inline]
    pub(super) fn crossings(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> Option<[f64; 2]> {
        let (origin, direction) = (self.axes.tr_mul(&(origin - self.center)), self.axes.tr_mul(direction));
        let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
        for i in 0..3 {
            let near = (-self.half[i] - origin[i]) / direction[i];
            let far = (self.half[i] - origin[i]) / direction[i];
            enter = enter.max(near.min(far));
            leave = leave.min(near.max(far));
        }
        (enter <= leave).then_some([enter, leave])
    }

    /// Returns how far the box reaches from its centre along a unit vector.
    pub(super) fn reach_along(&self, direction: &Vector3<f64>) -> f64 {
        self.axes.tr_mul(direction).abs().dot(&self.half)
    }
}

impl Surface for Block {
    #[inline]
    fn hit(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> f64 {
        self.crossings(origin, direction).map_or(f64::INFINITY, first_ahead)
    }

    fn normal(&self, point: &Vector3<f64>) -> Vector3<f64> {
        let local = self.axes.tr_mul(&(point - self.center));
        let face = (local.abs() - self.half).imax();
        self.axes.column(face) * local[face].signum()
    }

    fn bounds(&self) -> Option<[Vector3<f64>; 2]> {
        let reach = self.axes.abs() * self.half;
        Some([self.center - reach, self.center + reach])
    }

    fn transformed(&self, target_from_source: &Pose) -> Self {
        let center = target_from_source.point(&self.center);
        Self { center, axes: target_from_source.rotation * self.axes, ..*self }
    }
}
