//! The common interface of all shapes.

use super::pose::Pose;
use nalgebra::Vector3;

/// Least distance at which a ray that starts on a surface meets that surface again, in units of its direction.
pub(super) const NEAREST: f64 = 1e-6;

/// The common interface of all shapes; everything is in one frame, in metres.
pub trait Surface {
    /// Returns the first `t > 0` at which the ray meets the shape; infinite if it does not.
    fn hit(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> f64;
    /// Returns the outward unit normal at a point of the surface.
    fn normal(&self, point: &Vector3<f64>) -> Vector3<f64>;
    /// Returns the least and greatest coordinates; `None` if the shape is infinite.
    fn bounds(&self) -> Option<[Vector3<f64>; 2]>;
    /// Returns the shape in another frame.
    fn transformed(&self, target_from_source: &Pose) -> Self
    where
        Self: Sized;
}

/// Returns `t` if it is ahead, else infinity.
#[inline]
pub(super) fn ahead(t: f64) -> f64 {
    if t > NEAREST { t } else { f64::INFINITY }
}

/// Returns the smaller one of two parameters that are ahead.
#[inline]
pub(super) fn first_ahead([one, other]: [f64; 2]) -> f64 {
    ahead(one).min(ahead(other))
}
