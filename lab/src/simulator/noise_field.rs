//! Correlated noise of neighbouring pixels, as of a camera that compares windows of two images.

use conicflow_messages::Camera;

/// Returns normal deviates of variance one for each pixel: each is the sum of `window` x `window` deviates from `deviate`,
/// divided by `window`. Windows wrap around at the image's borders.
pub(super) fn noise_field(camera: &Camera, window: usize, deviate: impl Fn(usize) -> f64) -> Vec<f64> {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let deviates: Vec<f64> = (0..width * height).map(deviate).collect();
    let along = |row: &[f64], u: usize| (0..window).map(|i| row[(u + i) % width]).sum::<f64>();
    let sums: Vec<f64> = deviates.chunks_exact(width).flat_map(|row| (0..width).map(move |u| along(row, u))).collect();
    let sum = |u: usize, v: usize| (0..window).map(|i| sums[(v + i) % height * width + u]).sum::<f64>();
    (0..width * height).map(|index| sum(index % width, index / width) / window as f64).collect()
}
