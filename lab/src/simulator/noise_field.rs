//! Noise that neighbouring pixels share, as of a camera that compares windows of two images.

use conicflow_messages::Camera;

/// Normal deviates of variance one for each pixel of an image; the buffers are used again for the next.
#[derive(Clone, Debug, Default)]
pub(super) struct NoiseField {
    deviates: Vec<f64>,
    /// Sums along the rows.
    sums: Vec<f64>,
}

impl NoiseField {
    /// Draws one of which each pixel is the sum of `window` times `window` deviates, over `window`. What leaves the image on
    /// one side comes back on the other.
    pub fn draw(&mut self, camera: &Camera, window: usize, deviate: impl Fn(usize) -> f64) {
        let (width, height) = (camera.width as usize, camera.height as usize);
        let Self { deviates, sums } = self;
        deviates.clear();
        deviates.extend((0..width * height).map(deviate));
        sums.clear();
        for row in deviates.chunks_exact(width) {
            sums.extend((0..width).map(|u| (0..window).map(|i| row[(u + i) % width]).sum::<f64>()));
        }
        let sum = |u: usize, v: usize| (0..window).map(|i| sums[(v + i) % height * width + u]).sum::<f64>();
        for (index, deviate) in deviates.iter_mut().enumerate() {
            *deviate = sum(index % width, index / width) / window as f64;
        }
    }

    /// That of a pixel of the last image.
    pub fn deviate(&self, index: usize) -> f64 {
        self.deviates[index]
    }
}
