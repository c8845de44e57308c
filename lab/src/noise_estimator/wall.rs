//! Residuals of blocks of the image from a plane.
//!
//! In a pinhole camera the inverse depth of a plane is linear in the pixel, `1 / z = a + b u + c v`, and an error of the
//! depth is `dz = -z^2 d(1 / z)`.

use super::fit::Spreads;
use conicflow_messages::{Header, is_measured};
use nalgebra::{Matrix3, Vector3};

/// Least share of a block's pixels that have to be measured.
const LEAST_SHARE: f64 = 0.8;

/// Adds the residual variance of each block of an image.
pub fn add(header: &Header, pixels: &[u16], block_px: u32, spreads: &mut Spreads) {
    let (columns, rows) = (header.camera.width / block_px, header.camera.height / block_px);
    for row in 0..rows {
        for column in 0..columns {
            if let Some((depth, variance)) = block(header, pixels, [column * block_px, row * block_px], block_px) {
                spreads.add(depth, variance);
            }
        }
    }
}

/// Returns the mean depth of a block and the variance about its plane, if enough pixels are measured.
fn block(header: &Header, pixels: &[u16], [left, top]: [u32; 2], size: u32) -> Option<(f64, f64)> {
    let width = header.camera.width;
    let middle = 0.5 * f64::from(size - 1);
    let (mut normal, mut right, mut squares) = (Matrix3::zeros(), Vector3::zeros(), 0.0);
    for v in 0..size {
        for u in 0..size {
            let pixel = pixels[((top + v) * width + left + u) as usize];
            if is_measured(pixel) {
                let inverse = 1.0 / (f64::from(pixel) * header.depth_scale);
                let place = Vector3::new(1.0, f64::from(u) - middle, f64::from(v) - middle);
                normal += place * place.transpose();
                right += place * inverse;
                squares += inverse * inverse;
            }
        }
    }
    let count = normal[(0, 0)];
    if count < LEAST_SHARE * f64::from(size * size) {
        return None;
    }
    let plane = normal.cholesky()?.solve(&right);
    let depth = 1.0 / plane[0];
    let variance = (squares - plane.dot(&right)).max(0.0) / (count - 3.0);
    (depth > 0.0).then(|| (depth, variance * depth.powi(4)))
}
