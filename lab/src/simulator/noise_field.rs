//! Noise that neighbouring pixels share, as of a camera that compares windows of two images.

use conicflow_messages::Camera;

/// Normal deviates of variance one for each pixel of an image, each the sum of `window` times `window` of those that `deviate`
/// gives, over `window`. What leaves the image on one side comes back on the other.
pub(super) fn noise_field(camera: &Camera, window: usize, deviate: impl Fn(usize) -> f64) -> Vec<f64> {
    let (width, height) = (camera.width as usize, camera.height as usize);
    let deviates: Vec<f64> = (0..width * height).map(deviate).collect();
    let along = |row: &[f64], u: usize| (0..window).map(|i| row[(u + i) % width]).sum::<f64>();
    let sums: Vec<f64> = deviates.chunks_exact(width).flat_map(|row| (0..width).map(move |u| along(row, u))).collect();
    let sum = |u: usize, v: usize| (0..window).map(|i| sums[(v + i) % height * width + u]).sum::<f64>();
    (0..width * height).map(|index| sum(index % width, index / width) / window as f64).collect()
}
