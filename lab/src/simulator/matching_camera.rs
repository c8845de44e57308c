//! A depth camera that compares two images of a projected dot pattern: those of two eyes (stereo), or that of one eye with the
//! stored pattern (structured light).
//!
//! The images are rendered from the scene and matched block by block. This alone produces correlated noise of neighbours,
//! silhouettes shifted by a part of a window, the band that the second eye or the projector does not see, and holes where a
//! surface is too steep or too thin. Two effects are added that matching does not produce: a constant bend of the lens
//! ([`waves`]), and steps of the disparity.

use super::block_matching::{BRIGHTEST, ImagePair, LARGEST_WINDOW, Matching, disparities};
use super::dot_pattern::DotPattern;
use super::pose::Pose;
use super::raster::{NO_OWNER, Raster};
use super::shadow;
use super::shapes::{Shape, Surface};
use super::waves::waves;
use crate::random::CounterRng;
use conicflow_messages::{Camera, NoiseModel};
use nalgebra::Vector3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Brightness of an image without a dot, so that its noise is not clipped at black.
const AMBIENT: f32 = 8.0;
/// Brightness that a full dot adds; overlapping dots may saturate.
const DOT: f32 = 44.0;
/// Dots of the pattern per pixel of the image.
const DOTS_PER_PX: f64 = 0.1;
/// Costs of a step of the disparity by one pixel, and by more, along a scan line.
const STEP_PENALTIES: [i16; 2] = [(0.7 * DOT) as i16, (4.0 * DOT) as i16];
/// Share by which the best match has to be better than all others; else there is no measurement.
const UNIQUENESS: f64 = 0.1;
/// Largest difference in pixels of the match from the second eye back; else there is no measurement.
const LEFT_RIGHT_PX: usize = 1;
/// Regions of fewer pixels are not measured.
const SMALLEST_REGION_PX: usize = 100;
/// Standard deviation of the disparity on planes in the frames' noise model, in pixels: that of real cameras of both kinds.
const HEADER_NOISE_PX: f64 = 0.075;
/// Number of the random sequence for the camera itself, distinct from those of its frames.
const OF_THE_CAMERA: u64 = u64::MAX;

/// Numbers of a camera of one's own; one that is left out is that of the RealSense D400 series, or of a Kinect v1.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MatchingNumbers {
    /// Place of the second eye, or of the projector where there is one eye, to the right of the eye whose depth image it is, in
    /// metres; none: 0.055, with one eye 0.075.
    #[schemars(range(min = 0.001, max = 1.0))]
    pub baseline_m: Option<f64>,
    /// Columns and rows of the window that is compared, in pixels of the image, at most 141 in all; none: 7 and 7.
    pub window_px: Option<[u32; 2]>,
    /// Noise of the images, of a dot's brightness; none: 0.06, with one eye 0.09.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub image_noise: Option<f64>,
}

impl MatchingNumbers {
    /// Returns what is wrong with the window, if anything.
    pub fn fault(&self) -> Option<String> {
        let [columns, rows] = self.window_px?;
        let fits = columns > 0 && rows > 0 && columns.saturating_mul(rows) <= LARGEST_WINDOW;
        let what = || format!("has a window of {columns} times {rows} pixels, expected 1 to {LARGEST_WINDOW} in all");
        (!fits).then(what)
    }
}

/// The design of a camera.
#[derive(Clone, Copy, Debug)]
struct Design {
    /// Whether the second image is that of a second eye, and not the stored pattern.
    second_eye: bool,
    baseline_m: f64,
    /// Position of the projector to the right of the first eye, in metres.
    projector_m: f64,
    window_px: [u32; 2],
    /// Columns and rows of the window over which the camera averages disparities of one surface, in pixels of the image.
    smoothing_px: [usize; 2],
    /// Steps of the disparity per pixel.
    steps_per_px: f64,
    /// Size of a dot, as the standard deviation of its brightness, in pixels.
    dot_sigma_px: f64,
    image_noise: f64,
    /// Constant bend of the lens, as a standard deviation of the disparity in pixels.
    bend_px: f64,
    /// Length of the bend's waves, in pixels of the image.
    bend_length_px: f64,
    /// Least and greatest measured depth, in metres.
    range_m: [f64; 2],
}

/// A camera of the RealSense D400 series. Window, smoothing, noise and bend are chosen so that planes have the sigma and the
/// autocorrelation of recordings of a table by such a camera (`conicflow run experiments/planes.toml`, and
/// `experiments/noise.toml` for recordings), and a tin has the recorded profile.
const STEREO: Design = Design {
    second_eye: true,
    baseline_m: 0.055,
    projector_m: 0.03,
    window_px: [7, 7],
    smoothing_px: [11, 1],
    steps_per_px: 32.0,
    dot_sigma_px: 0.9,
    image_noise: 0.06,
    bend_px: 0.05,
    bend_length_px: 30.0,
    range_m: [0.28, 10.0],
};

/// A Kinect v1. Window, smoothing, noise and bend are chosen as for [`STEREO`], from recordings of three such cameras.
const STRUCTURED_LIGHT: Design = Design {
    second_eye: false,
    baseline_m: 0.075,
    projector_m: 0.075,
    window_px: [7, 7],
    smoothing_px: [3, 3],
    steps_per_px: 8.0,
    dot_sigma_px: 0.8,
    image_noise: 0.09,
    bend_px: 0.03,
    bend_length_px: 24.0,
    range_m: [0.4, 8.0],
};

impl Design {
    fn with(self, numbers: MatchingNumbers) -> Self {
        let baseline_m = numbers.baseline_m.unwrap_or(self.baseline_m);
        Self {
            baseline_m,
            // With one eye, the base line leads from it to the projector.
            projector_m: if self.second_eye { self.projector_m } else { baseline_m },
            window_px: numbers.window_px.unwrap_or(self.window_px),
            image_noise: numbers.image_noise.unwrap_or(self.image_noise),
            ..self
        }
    }
}

/// The camera.
#[derive(Clone, Debug)]
pub struct MatchingCamera {
    design: Design,
    matching: Matching,
    pattern: DotPattern,
    /// Bend of the disparity, in pixels.
    bend: Vec<f64>,
    /// The image of the second eye, which is wider than the first.
    second: Raster,
    images: ImagePair,
}

impl MatchingCamera {
    /// Creates a camera with two eyes; its pattern and its bend follow from the seed.
    pub fn stereo(numbers: MatchingNumbers, camera: &Camera, seed: u64) -> Self {
        Self::new(STEREO.with(numbers), camera, seed)
    }

    /// Creates a camera with one eye that knows the pattern.
    pub fn structured_light(numbers: MatchingNumbers, camera: &Camera, seed: u64) -> Self {
        Self::new(STRUCTURED_LIGHT.with(numbers), camera, seed)
    }

    fn new(design: Design, camera: &Camera, seed: u64) -> Self {
        let [nearest, farthest] = design.range_m.map(|depth| camera.fx * design.baseline_m / depth);
        let matching = Matching {
            window: design.window_px.map(|side| side as usize),
            shifts: [(farthest as usize).saturating_sub(1), nearest.ceil() as usize + 1],
            penalties: design.second_eye.then_some(STEP_PENALTIES),
            uniqueness: UNIQUENESS,
            left_right_px: design.second_eye.then_some(LEFT_RIGHT_PX),
            smallest_region_px: SMALLEST_REGION_PX,
            smoothing: design.smoothing_px,
        };
        let reach = matching.shifts[1];
        let size = [camera.width as usize, camera.height as usize];
        let wide = Camera { width: camera.width + reach as u32, cx: camera.cx + reach as f64, ..*camera };
        let pattern = DotPattern::new(DOTS_PER_PX, design.dot_sigma_px, &CounterRng::new(seed, OF_THE_CAMERA));
        let dice = CounterRng::new(seed, OF_THE_CAMERA - 1);
        let deviates = waves([camera.width, camera.height], design.bend_length_px, &dice);
        let bend = deviates.into_iter().map(|deviate| design.bend_px * deviate).collect();
        let images =
            ImagePair { size, reach, left: vec![0; size[0] * size[1]], right: vec![0; (size[0] + reach) * size[1]] };
        let mut this = Self { design, matching, pattern, bend, second: Raster::new(wide), images };
        if !design.second_eye {
            this.store_the_pattern();
        }
        this
    }

    /// Returns the depth noise for the frames' headers, for a focal length in pixels.
    pub fn noise_model(&self, fx: f64) -> NoiseModel {
        let Design { baseline_m, steps_per_px, .. } = self.design;
        let step_per_m = 1.0 / (steps_per_px * fx * baseline_m);
        NoiseModel { floor_m: 0.0, growth_per_m: HEADER_NOISE_PX / (fx * baseline_m), knee_m: 0.0, step_per_m }
    }

    /// Measures a rendered image of `shapes` (camera frame); returns the depth of each pixel in metres, NaN without a
    /// measurement.
    pub fn measure(&mut self, raster: &Raster, shapes: &[Shape], dice: &CounterRng) -> Vec<f64> {
        self.look(raster, shapes, dice);
        let Design { baseline_m, steps_per_px, range_m: [least, greatest], .. } = self.design;
        let scale = raster.camera.fx * baseline_m;
        let depth = |(disparity, bend): (&f32, &f64)| {
            let disparity = ((f64::from(*disparity) + bend) * steps_per_px).round() / steps_per_px;
            let depth = scale / disparity;
            if (least..=greatest).contains(&depth) { depth } else { f64::NAN }
        };
        disparities(&self.images, &self.matching).iter().zip(&self.bend).map(depth).collect()
    }

    /// Renders both images.
    fn look(&mut self, raster: &Raster, shapes: &[Shape], dice: &CounterRng) {
        let Design { second_eye, baseline_m, projector_m: projector, image_noise, .. } = self.design;
        let shadow = shadow::cast(raster, shapes, projector);
        let [width, height] = self.images.size;
        for index in 0..width * height {
            let light = light(&self.pattern, raster, &shadow, index, projector);
            self.images.left[index] = exposed(light, image_noise, dice, index as u64);
        }
        if !second_eye {
            return;
        }
        let moved = Pose::shift(Vector3::new(-baseline_m, 0.0, 0.0));
        let shapes: Vec<Shape> = shapes.iter().map(|shape| shape.transformed(&moved)).collect();
        self.second.render(&shapes);
        let shadow = shadow::cast(&self.second, &shapes, projector - baseline_m);
        let (wide, count) = (width + self.images.reach, (width * height) as u64);
        for index in 0..wide * height {
            let light = light(&self.pattern, &self.second, &shadow, index, projector - baseline_m);
            let (v, from_right) = (index / wide, wide - 1 - index % wide);
            self.images.right[v * wide + from_right] = exposed(light, image_noise, dice, count + index as u64);
        }
    }

    /// Renders the second image of a camera that knows its pattern.
    fn store_the_pattern(&mut self) {
        let [width, height] = self.images.size;
        let camera = &self.second.camera;
        let cx = camera.cx - self.images.reach as f64;
        for v in 0..height {
            for u in -(self.images.reach as i64)..width as i64 {
                let light = pattern_at(&self.pattern, camera, u as f64 - cx, v);
                let index = self.images.right_index(u, v);
                self.images.right[index] = (AMBIENT + DOT * light).min(f32::from(BRIGHTEST)) as i16;
            }
        }
    }
}

/// Returns the light of the pattern at a pixel, from a projector `projector_m` metres to the right of the eye. The decrease of
/// light with the squared distance is left out, as cameras compare contrasts.
fn light(pattern: &DotPattern, raster: &Raster, shadow: &[bool], index: usize, projector_m: f64) -> f32 {
    if raster.owner[index] == NO_OWNER || shadow[index] {
        return 0.0;
    }
    let camera = &raster.camera;
    let width = camera.width as usize;
    let (u, v) = ((index % width) as f64, index / width);
    let shift = camera.fx * projector_m / raster.depth[index];
    pattern_at(pattern, camera, u - camera.cx - shift, v)
}

/// Returns the pattern `x` pixels to the right of the projector's axis; rows are scaled to columns, so that dots are round.
fn pattern_at(pattern: &DotPattern, camera: &Camera, x: f64, v: usize) -> f32 {
    pattern.at(x, (v as f64 - camera.cy) * (camera.fx / camera.fy))
}

/// Returns the brightness of a pixel for this light.
fn exposed(light: f32, noise: f64, dice: &CounterRng, counter: u64) -> i16 {
    let noisy = light + (noise * dice.gaussian(counter)) as f32;
    (AMBIENT + DOT * noisy + 0.5).clamp(0.0, f32::from(BRIGHTEST)) as i16
}
