//! Rigid transforms, and the frame of a camera that looks in a direction.

use nalgebra::{Matrix3, Vector3};

/// A rigid transform `target_from_source`: `p -> rotation p + translation`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pose {
    /// Orthonormal.
    pub rotation: Matrix3<f64>,
    /// Metres.
    pub translation: Vector3<f64>,
}

impl Pose {
    /// Returns a translation without a rotation.
    pub fn shift(translation: Vector3<f64>) -> Self {
        Self { rotation: Matrix3::identity(), translation }
    }

    /// Returns a point in the target frame.
    pub fn point(&self, point: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * point + self.translation
    }

    /// Returns `source_from_target`.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// Returns the row-major `[R | t]` of a header.
    pub fn rows(&self) -> [[f64; 4]; 3] {
        let (r, t) = (&self.rotation, &self.translation);
        [0, 1, 2].map(|i| [r[(i, 0)], r[(i, 1)], r[(i, 2)], t[i]])
    }
}

/// Returns the `world_from_camera` rotation of an optical frame (x right, y down, z forward) that looks along `forward`, with
/// `up` upwards in the image; `None` if the two are parallel.
pub fn looking_along(forward: &Vector3<f64>, up: &Vector3<f64>) -> Option<Matrix3<f64>> {
    let z = forward.try_normalize(1e-9)?;
    let x = z.cross(up).try_normalize(1e-9)?;
    Some(Matrix3::from_columns(&[x, z.cross(&x), z]))
}

/// Returns the rotation of a unit quaternion `[x, y, z, w]`.
pub fn from_quaternion([x, y, z, w]: [f64; 4]) -> Matrix3<f64> {
    Matrix3::new(
        1.0 - 2.0 * (y * y + z * z),
        2.0 * (x * y - z * w),
        2.0 * (x * z + y * w),
        2.0 * (x * y + z * w),
        1.0 - 2.0 * (x * x + z * z),
        2.0 * (y * z - x * w),
        2.0 * (x * z - y * w),
        2.0 * (y * z + x * w),
        1.0 - 2.0 * (x * x + y * y),
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_level_camera_sees_up_as_minus_y() {
        let rotation = looking_along(&Vector3::new(0.0, 2.0, 0.0), &Vector3::z()).unwrap();
        assert_eq!(rotation.transpose() * Vector3::z(), -Vector3::y());
        assert_eq!(rotation.transpose() * Vector3::x(), Vector3::x());
        assert!((rotation.determinant() - 1.0).abs() < 1e-12);
        assert!(looking_along(&Vector3::z(), &Vector3::z()).is_none());
    }

    #[test]
    fn a_pose_and_its_inverse_cancel() {
        let rotation = from_quaternion([0.1, 0.7, 0.5, 0.5]);
        let pose = Pose { rotation, translation: Vector3::new(1.0, 2.0, 3.0) };
        assert!((rotation * rotation.transpose() - Matrix3::identity()).norm() < 1e-12);
        let point = Vector3::new(0.3, -0.2, 5.0);
        assert!((pose.inverse().point(&pose.point(&point)) - point).norm() < 1e-12);
    }
}
