//! A depth camera that compares two images of a projected dot pattern: those of two eyes (stereo), or that of one eye with
//! the pattern itself, which it has stored (structured light).
//!
//! Both are rendered from the scene and matched block by block. Noise that neighbours share, silhouettes off by a part of a
//! window, the band that the second eye or the projector does not see, and holes where a surface is too steep or too thin
//! come from that alone. What matching cannot make is added: a bend of the lens that stays ([`waves`]), and whole steps of
//! the disparity.

use super::block_matching::{BRIGHTEST, ImagePair, LARGEST_PENALTY, LARGEST_WINDOW, Matching, disparities};
use super::dot_pattern::DotPattern;
use super::pose::Pose;
use super::raster::{NOBODY, Raster};
use super::shadow;
use super::shapes::{Shape, Surface};
use super::waves::waves;
use crate::random::CounterRng;
use conicflow_messages::{Camera, NoiseModel};
use nalgebra::Vector3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Brightness of an image where no dot falls, so that its noise is not cut off at black.
const AMBIENT: f32 = 8.0;
/// Brightness that a full dot adds; two that meet may be too bright.
const DOT: f32 = 44.0;
/// Standard deviation of the disparity on planes that the frames tell of, in pixels: that of real cameras of both kinds.
const TOLD_NOISE_PX: f64 = 0.075;
/// What the dice of the camera itself are drawn under, apart from those of its frames.
const OF_THE_CAMERA: u64 = u64::MAX;

/// Two eyes and a projector; one that is left out is that of a camera of the RealSense D400 series.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Stereo {
    /// Place of the second eye to the right of the first, whose depth image it is, in metres.
    #[schemars(range(min = 0.001, max = 1.0))]
    pub baseline_m: f64,
    /// Place of the projector to the right of the first eye, in metres.
    #[schemars(range(min = -1.0, max = 1.0))]
    pub projector_m: f64,
    /// Columns and rows of the window that is compared, in pixels of the image; at most 141 in all.
    pub window_px: [u32; 2],
    /// What a step of the disparity by one pixel, and by more, costs along a scan line, in the brightness of a dot: at most 45.
    pub step_penalty: [f64; 2],
    /// Columns and rows of the window over which the camera averages disparities of one surface, in pixels of the image.
    pub smoothing_px: [u32; 2],
    /// Steps of the disparity to a pixel; 0: none.
    #[schemars(range(max = 256))]
    pub steps_per_px: u32,
    /// Dots of the pattern to a pixel of the image.
    #[schemars(range(min = 0.001, max = 1.0))]
    pub dots_per_px: f64,
    /// Size of a dot, as the standard deviation of its brightness, in pixels.
    #[schemars(range(min = 0.4, max = 4.0))]
    pub dot_sigma_px: f64,
    /// Noise of the images, of a dot's brightness.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub image_noise: f64,
    /// By what share the best match has to be better than all others, else nothing is measured.
    #[schemars(range(min = 0.0, max = 0.9))]
    pub uniqueness: f64,
    /// By how many pixels the match from the second eye back may differ, else nothing is measured.
    #[schemars(range(max = 64))]
    pub left_right_px: u32,
    /// Regions of fewer pixels are not measured.
    pub smallest_region_px: u32,
    /// Bend of the lens that stays from frame to frame, as a standard deviation of the disparity in pixels.
    #[schemars(range(min = 0.0, max = 4.0))]
    pub bend_px: f64,
    /// How far the bend's waves reach, in pixels of the image.
    #[schemars(range(min = 4.0, max = 1000.0))]
    pub bend_length_px: f64,
    /// Least depth that is measured, in metres.
    #[schemars(range(min = 0.05))]
    pub min_range_m: f64,
    /// Greatest depth that is measured, in metres.
    #[schemars(range(min = 0.1, max = 60.0))]
    pub max_range_m: f64,
}

/// Window, smoothing, noise and bend give planes the sigma and the autocorrelation of the recordings of a table by a camera of
/// this class (`conicflow run experiments/planes.toml`, and `experiments/noise.toml` for recordings), and the profile across a
/// tin.
impl Default for Stereo {
    fn default() -> Self {
        Self {
            baseline_m: 0.055,
            projector_m: 0.03,
            window_px: [7, 7],
            step_penalty: [0.7, 4.0],
            smoothing_px: [11, 1],
            steps_per_px: 32,
            dots_per_px: 0.1,
            dot_sigma_px: 0.9,
            image_noise: 0.06,
            uniqueness: 0.1,
            left_right_px: 1,
            smallest_region_px: 100,
            bend_px: 0.05,
            bend_length_px: 30.0,
            min_range_m: 0.28,
            max_range_m: 10.0,
        }
    }
}

/// One eye and a projector; one that is left out is that of a Kinect v1.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct StructuredLight {
    /// Place of the projector to the right of the camera, in metres.
    #[schemars(range(min = 0.001, max = 1.0))]
    pub baseline_m: f64,
    /// Columns and rows of the window that is compared, in pixels of the image; at most 141 in all.
    pub window_px: [u32; 2],
    /// Columns and rows of the window over which the camera averages disparities of one surface, in pixels of the image.
    pub smoothing_px: [u32; 2],
    /// Steps of the disparity to a pixel; 0: none.
    #[schemars(range(max = 256))]
    pub steps_per_px: u32,
    /// Dots of the pattern to a pixel of the image.
    #[schemars(range(min = 0.001, max = 1.0))]
    pub dots_per_px: f64,
    /// Size of a dot, as the standard deviation of its brightness, in pixels.
    #[schemars(range(min = 0.4, max = 4.0))]
    pub dot_sigma_px: f64,
    /// Noise of the image, of a dot's brightness.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub image_noise: f64,
    /// By what share the best match has to be better than all others, else nothing is measured.
    #[schemars(range(min = 0.0, max = 0.9))]
    pub uniqueness: f64,
    /// Regions of fewer pixels are not measured.
    pub smallest_region_px: u32,
    /// Bend of the lens that stays from frame to frame, as a standard deviation of the disparity in pixels.
    #[schemars(range(min = 0.0, max = 4.0))]
    pub bend_px: f64,
    /// How far the bend's waves reach, in pixels of the image.
    #[schemars(range(min = 4.0, max = 1000.0))]
    pub bend_length_px: f64,
    /// Least depth that is measured, in metres.
    #[schemars(range(min = 0.05))]
    pub min_range_m: f64,
    /// Greatest depth that is measured, in metres.
    #[schemars(range(min = 0.1, max = 60.0))]
    pub max_range_m: f64,
}

/// Window, smoothing, noise and bend as for [`Stereo`], from recordings of three cameras of this kind.
impl Default for StructuredLight {
    fn default() -> Self {
        Self {
            baseline_m: 0.075,
            window_px: [7, 7],
            smoothing_px: [3, 3],
            steps_per_px: 8,
            dots_per_px: 0.1,
            dot_sigma_px: 0.8,
            image_noise: 0.09,
            uniqueness: 0.1,
            smallest_region_px: 100,
            bend_px: 0.03,
            bend_length_px: 24.0,
            min_range_m: 0.4,
            max_range_m: 8.0,
        }
    }
}

impl From<StructuredLight> for Stereo {
    /// The projector in place of the second eye, which sees what the first one has stored.
    fn from(table: StructuredLight) -> Self {
        Self {
            baseline_m: table.baseline_m,
            projector_m: table.baseline_m,
            window_px: table.window_px,
            smoothing_px: table.smoothing_px,
            steps_per_px: table.steps_per_px,
            dots_per_px: table.dots_per_px,
            dot_sigma_px: table.dot_sigma_px,
            image_noise: table.image_noise,
            uniqueness: table.uniqueness,
            smallest_region_px: table.smallest_region_px,
            bend_px: table.bend_px,
            bend_length_px: table.bend_length_px,
            min_range_m: table.min_range_m,
            max_range_m: table.max_range_m,
            ..Self::default()
        }
    }
}

impl Stereo {
    /// What is wrong with windows, the range or the penalties of steps.
    pub fn fault(&self) -> Option<String> {
        for [columns, rows] in [self.window_px, self.smoothing_px] {
            if columns == 0 || rows == 0 || columns.saturating_mul(rows) > LARGEST_WINDOW {
                return Some(format!(
                    "has a window of {columns} times {rows} pixels, expected 1 to {LARGEST_WINDOW} in all"
                ));
            }
        }
        let (least, most) = (self.min_range_m, self.max_range_m);
        if least >= most {
            return Some(format!("measures from {least} to {most} m, which is nothing"));
        }
        let is_possible = |step: f64| step >= 0.0 && brightness(step) <= LARGEST_PENALTY;
        let [one, more] = self.step_penalty;
        let most = LARGEST_PENALTY / brightness(1.0);
        (!self.step_penalty.into_iter().all(is_possible) || one > more).then(|| {
            format!("has a step_penalty of {one} and {more}, expected two numbers from 0 to {most} that ascend")
        })
    }
}

/// So many full dots, in the units of an image.
fn brightness(dots: f64) -> i16 {
    (dots * f64::from(DOT)) as i16
}

/// The camera.
#[derive(Clone, Debug)]
pub struct MatchingCamera {
    table: Stereo,
    /// Whether the second image is a second eye's, not the stored pattern.
    second_eye: bool,
    matching: Matching,
    pattern: DotPattern,
    /// Bend of the disparity, in pixels.
    bend: Vec<f64>,
    /// What the second eye sees; wider than the image.
    second: Raster,
    images: ImagePair,
}

impl MatchingCamera {
    /// A camera of two eyes; its pattern and its bend are those of a seed.
    pub fn stereo(table: Stereo, camera: &Camera, seed: u64) -> Self {
        Self::new(table, true, camera, seed)
    }

    /// A camera of one eye that knows the pattern.
    pub fn structured_light(table: StructuredLight, camera: &Camera, seed: u64) -> Self {
        Self::new(table.into(), false, camera, seed)
    }

    fn new(table: Stereo, second_eye: bool, camera: &Camera, seed: u64) -> Self {
        let shift = |depth: f64| camera.fx * table.baseline_m / depth;
        let shifts = [shift(table.max_range_m) as usize, shift(table.min_range_m).ceil() as usize];
        let matching = Matching {
            window: table.window_px.map(|side| side as usize),
            shifts: [shifts[0].saturating_sub(1), shifts[1] + 1],
            penalties: second_eye.then(|| table.step_penalty.map(brightness)),
            uniqueness: table.uniqueness,
            left_right_px: second_eye.then_some(table.left_right_px as usize),
            smallest_region_px: table.smallest_region_px as usize,
            smoothing: table.smoothing_px.map(|side| side as usize),
        };
        let reach = matching.shifts[1];
        let size = [camera.width as usize, camera.height as usize];
        let wide = Camera { width: camera.width + reach as u32, cx: camera.cx + reach as f64, ..*camera };
        let pattern = DotPattern::new(table.dots_per_px, table.dot_sigma_px, &CounterRng::new(seed, OF_THE_CAMERA));
        let bend = match table.bend_px {
            0.0 => vec![0.0; size[0] * size[1]],
            bend_px => {
                let dice = CounterRng::new(seed, OF_THE_CAMERA - 1);
                let deviates = waves([camera.width, camera.height], table.bend_length_px, &dice);
                deviates.into_iter().map(|deviate| bend_px * deviate).collect()
            }
        };
        let images =
            ImagePair { size, reach, left: vec![0; size[0] * size[1]], right: vec![0; (size[0] + reach) * size[1]] };
        let mut this = Self { table, second_eye, matching, pattern, bend, second: Raster::new(wide), images };
        if !second_eye {
            this.store_the_pattern();
        }
        this
    }

    /// The depth noise that the frames tell of, for a focal length in pixels.
    pub fn noise_model(&self, fx: f64) -> NoiseModel {
        let step_per_m = match self.table.steps_per_px {
            0 => 0.0,
            steps => 1.0 / (f64::from(steps) * fx * self.table.baseline_m),
        };
        NoiseModel { floor_m: 0.0, growth_per_m: TOLD_NOISE_PX / (fx * self.table.baseline_m), knee_m: 0.0, step_per_m }
    }

    /// Measures a rendered image of `shapes` (camera frame): the depth of each pixel in metres, not a number where there is
    /// none.
    pub fn measure(&mut self, raster: &Raster, shapes: &[Shape], dice: &CounterRng) -> Vec<f64> {
        self.look(raster, shapes, dice);
        let scale = raster.camera.fx * self.table.baseline_m;
        let depth = |(disparity, bend): (&f32, &f64)| {
            let disparity = self.in_steps(f64::from(*disparity) + bend);
            let depth = scale / disparity;
            if (self.table.min_range_m..=self.table.max_range_m).contains(&depth) { depth } else { f64::NAN }
        };
        disparities(&self.images, &self.matching).iter().zip(&self.bend).map(depth).collect()
    }

    fn in_steps(&self, disparity: f64) -> f64 {
        match f64::from(self.table.steps_per_px) {
            0.0 => disparity,
            steps => (disparity * steps).round() / steps,
        }
    }

    /// Takes the images.
    fn look(&mut self, raster: &Raster, shapes: &[Shape], dice: &CounterRng) {
        let projector = self.table.projector_m;
        let shadow = shadow::cast(raster, shapes, projector);
        let [width, height] = self.images.size;
        for index in 0..width * height {
            let light = light(&self.pattern, raster, &shadow, index, projector);
            self.images.left[index] = exposed(light, self.table.image_noise, dice, index as u64);
        }
        if !self.second_eye {
            return;
        }
        let place = self.table.baseline_m;
        let moved = Pose::shift(Vector3::new(-place, 0.0, 0.0));
        let shapes: Vec<Shape> = shapes.iter().map(|shape| shape.transformed(&moved)).collect();
        self.second.render(&shapes);
        let shadow = shadow::cast(&self.second, &shapes, projector - place);
        let (wide, count) = (width + self.images.reach, (width * height) as u64);
        for index in 0..wide * height {
            let light = light(&self.pattern, &self.second, &shadow, index, projector - place);
            let (v, from_right) = (index / wide, wide - 1 - index % wide);
            self.images.right[v * wide + from_right] =
                exposed(light, self.table.image_noise, dice, count + index as u64);
        }
    }

    /// The second image of a camera that knows its pattern.
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

/// Light of the pattern that a pixel sees, from a projector at a place to the right of it. That light falls with the squared
/// distance does not show: cameras compare contrasts.
fn light(pattern: &DotPattern, raster: &Raster, shadow: &[bool], index: usize, projector_m: f64) -> f32 {
    if raster.owner[index] == NOBODY || shadow[index] {
        return 0.0;
    }
    let camera = &raster.camera;
    let width = camera.width as usize;
    let (u, v) = ((index % width) as f64, index / width);
    let shift = camera.fx * projector_m / raster.depth[index];
    pattern_at(pattern, camera, u - camera.cx - shift, v)
}

/// The pattern so many pixels to the right of the projector's axis; rows count in the unit of columns, so that dots are round.
fn pattern_at(pattern: &DotPattern, camera: &Camera, x: f64, v: usize) -> f32 {
    pattern.at(x, (v as f64 - camera.cy) * (camera.fx / camera.fy))
}

/// The brightness that an eye makes of light.
fn exposed(light: f32, noise: f64, dice: &CounterRng, counter: u64) -> i16 {
    let noisy = light + (noise * dice.gaussian(counter)) as f32;
    (AMBIENT + DOT * noisy + 0.5).clamp(0.0, f32::from(BRIGHTEST)) as i16
}
