//! What every shape can tell.

use super::pose::Pose;
use nalgebra::Vector3;

/// A ray that starts on a surface does not meet that surface again within this distance, in units of its direction.
pub(super) const NEAREST: f64 = 1e-6;

/// What every shape can tell; all in one frame, metres.
pub trait Surface {
    /// The first `t > 0` at which the ray meets it; infinite where it does not.
    fn hit(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> f64;
    /// Unit normal, outwards, at a point of the surface.
    fn normal(&self, point: &Vector3<f64>) -> Vector3<f64>;
    /// Least and greatest coordinates; `None`: without end.
    fn bounds(&self) -> Option<[Vector3<f64>; 2]>;
    /// The same shape in another frame.
    fn transformed(&self, target_from_source: &Pose) -> Self
    where
        Self: Sized;
}

/// A `t` that lies ahead, else infinity.
#[inline]
pub(super) fn ahead(t: f64) -> f64 {
    if t > NEAREST { t } else { f64::INFINITY }
}

/// The smaller of those that lie ahead.
#[inline]
pub(super) fn first_ahead([one, other]: [f64; 2]) -> f64 {
    ahead(one).min(ahead(other))
}
