//! Converts cameras, poses and scan lines of messages to the types of `geometry`.

use conicflow_geometry::{Pinhole, Scan};
use conicflow_messages::{self as messages, Camera, ConfigFault, Ellipse};
use nalgebra::{IsometryMatrix3, Matrix3, Rotation3, Translation3};
use serde::{Deserialize, Serialize};

/// Intrinsics of a pinhole camera; pixel centres lie at whole numbers.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(deny_unknown_fields)]
pub struct Intrinsics {
    /// Focal length along x, in pixels.
    #[cfg_attr(feature = "schema", schemars(range(min = 1.0, max = 1e6)))]
    pub fx: f64,
    /// Focal length along y, in pixels.
    #[cfg_attr(feature = "schema", schemars(range(min = 1.0, max = 1e6)))]
    pub fy: f64,
    /// Principal point, x, in pixels.
    #[cfg_attr(feature = "schema", schemars(range(min = -1e6, max = 1e6)))]
    pub cx: f64,
    /// Principal point, y, in pixels.
    #[cfg_attr(feature = "schema", schemars(range(min = -1e6, max = 1e6)))]
    pub cy: f64,
}

impl Intrinsics {
    /// Returns the camera with these intrinsics and this size of images.
    pub fn camera(self, (width, height): (u32, u32)) -> Camera {
        Camera { width, height, fx: self.fx, fy: self.fy, cx: self.cx, cy: self.cy }
    }

    /// Returns whether a camera can have these numbers.
    pub fn are_usable(&self) -> bool {
        self.camera((1, 1)).has_intrinsics()
    }

    /// Returns the fault of the parameter `intrinsics`, if any.
    pub fn fault(&self) -> Option<ConfigFault> {
        let what = "need fx and fy of 1 to 1,000,000 pixels, and no larger cx and cy";
        (!self.are_usable()).then(|| ConfigFault::new("intrinsics", what, "take them from the camera's calibration"))
    }
}

/// Returns the pinhole model of a camera.
pub fn pinhole(camera: &Camera) -> Pinhole {
    Pinhole { fx: camera.fx, fy: camera.fy, cx: camera.cx, cy: camera.cy }
}

/// Returns the direction of an ellipse's scan line.
pub fn scan(ellipse: &Ellipse) -> Scan {
    match ellipse.direction() {
        messages::Scan::Row => Scan::Row,
        messages::Scan::Column => Scan::Column,
    }
}

/// Returns the code of a direction in an ellipse's message.
pub fn scan_code(scan: Scan) -> u32 {
    match scan {
        Scan::Row => messages::Scan::Row.code(),
        Scan::Column => messages::Scan::Column.code(),
    }
}

/// Returns a pose from its rows `[R | t]`; the receiver of the message has checked that R is a rotation.
pub fn isometry(rows: &[[f64; 4]; 3]) -> IsometryMatrix3<f64> {
    let rotation = Matrix3::from_fn(|row, column| rows[row][column]);
    let translation = Translation3::new(rows[0][3], rows[1][3], rows[2][3]);
    IsometryMatrix3::from_parts(translation, Rotation3::from_matrix_unchecked(rotation))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn intrinsics_that_no_camera_has_are_a_fault() {
        let kinect = Intrinsics { fx: 525.0, fy: 525.0, cx: 319.5, cy: 239.5 };
        assert!(kinect.are_usable() && kinect.fault().is_none());
        for wrong in
            [Intrinsics { fx: 0.5, ..kinect }, Intrinsics { fy: f64::NAN, ..kinect }, Intrinsics { cx: 2e6, ..kinect }]
        {
            assert!(!wrong.are_usable() && wrong.fault().is_some(), "{wrong:?}");
        }
    }
}
