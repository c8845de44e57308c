//! Cameras, poses and scan lines of messages, as the mathematics wants them.

use conicflow_geometry::{Pinhole, Scan};
use conicflow_messages::{self as messages, Camera, Ellipse};
use nalgebra::{IsometryMatrix3, Matrix3, Rotation3, Translation3};

/// The rays of a camera.
pub fn pinhole(camera: &Camera) -> Pinhole {
    Pinhole { fx: camera.fx, fy: camera.fy, cx: camera.cx, cy: camera.cy }
}

/// The direction of an ellipse's scan line.
pub fn scan(ellipse: &Ellipse) -> Scan {
    match ellipse.direction() {
        messages::Scan::Row => Scan::Row,
        messages::Scan::Column => Scan::Column,
    }
}

/// A pose from its rows `[R | t]`, whose R is a rotation: the border has checked that.
pub fn isometry(rows: &[[f64; 4]; 3]) -> IsometryMatrix3<f64> {
    let rotation = Matrix3::from_fn(|row, column| rows[row][column]);
    let translation = Translation3::new(rows[0][3], rows[1][3], rows[2][3]);
    IsometryMatrix3::from_parts(translation, Rotation3::from_matrix_unchecked(rotation))
}
