//! The errors of a structured-light sensor, added to an exact depth image: noise along the ray, steps of the disparity, jitter of
//! silhouettes, the projector's shadow, lost points on surfaces at a grazing angle, and limits of range.
//!
//! Axial noise, its growth with the angle, and steps: Nguyen, Izadi and Lovell, "Modeling Kinect sensor noise for improved 3D
//! reconstruction and tracking" (2012), in the form of [`NoiseModel`]. The same paper finds an uncertainty of silhouettes of
//! about 0.8 pixels at 640x480, and noise that grows without bounds from 70 to 80 degrees on.

use super::noise_field::noise_field;
use super::raster::{Raster, is_jump};
use super::shadow;
use super::shapes::{Shape, Surface};
use crate::random::CounterRng;
use conicflow_detection::noise::{NoiseConfig, NoiseName, REALSENSE_D435, TIME_OF_FLIGHT};
use conicflow_messages::{Camera, INVALID_FAR, INVALID_NEAR, NoiseModel};
use nalgebra::Vector3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::f64::consts::FRAC_PI_2;

/// Least angle between ray and surface in the growth of the noise, in radians.
const LEAST_GRAZE: f64 = 0.05;

/// Errors of the sensor: `"kinect_v1"`, `"realsense_d435"`, `"time_of_flight"`, `"ideal"` or a table.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(
    untagged,
    expecting = "expected \"kinect_v1\", \"realsense_d435\", \"time_of_flight\", \"ideal\" or a table with some of the \
                 numbers `floor_m`, `growth_per_m`, `knee_m`, `step_per_m`, `noise_window_px`, `grazing_noise`, \
                 `edge_jitter_px`, `shadow_baseline_m`, `dropout_angle_deg`, `min_range_m`, `max_range_m`"
)]
pub enum SensorConfig {
    /// A sensor with a name.
    Named(NoiseName),
    /// Any other sensor.
    Table(SensorTable),
}

impl Default for SensorConfig {
    fn default() -> Self {
        Self::Named(NoiseName::KinectV1)
    }
}

/// Coefficients of a sensor; one that is left out is that of a Kinect v1.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SensorTable {
    /// Noise at the knee, in metres.
    #[schemars(range(min = 0.0))]
    pub floor_m: f64,
    /// Growth with the squared distance from the knee, in 1/metre.
    #[schemars(range(min = 0.0))]
    pub growth_per_m: f64,
    /// Depth of least noise, in metres.
    #[schemars(range(min = 0.0))]
    pub knee_m: f64,
    /// Depth between two neighbouring disparities, divided by the squared depth, in 1/metre; 0: no steps.
    #[schemars(range(min = 0.0))]
    pub step_per_m: f64,
    /// Side of the window of the image from which a depth comes, in pixels: the noise of neighbours is correlated as far as their
    /// windows overlap; 1: it is independent. A Kinect v1 has about 3 at 640x480.
    #[schemars(range(min = 1, max = 15))]
    pub noise_window_px: u32,
    /// Additional noise where the angle a between ray and normal is large: `grazing_noise / sqrt(z) a^2 / (pi / 2 - a)^2` in
    /// metres, a in radians; 0: none. A Kinect v1 has 0.0001, but no header includes it.
    #[schemars(range(min = 0.0))]
    pub grazing_noise: f64,
    /// Standard deviation of a silhouette's position, in pixels of the image; 0: exact silhouettes.
    #[schemars(range(min = 0.0, max = 8.0))]
    pub edge_jitter_px: f64,
    /// Position of the projector to the right of the camera, in metres; 0: no shadow.
    #[schemars(range(min = -1.0, max = 1.0))]
    pub shadow_baseline_m: f64,
    /// Angle between ray and normal beyond which points may be lost, as all of them are at 90, in degrees; 90: none.
    #[schemars(range(min = 0.0, max = 90.0))]
    pub dropout_angle_deg: f64,
    /// Least depth that is measured, in metres.
    #[schemars(range(min = 0.0))]
    pub min_range_m: f64,
    /// Greatest depth that is measured, in metres.
    #[schemars(range(min = 0.0))]
    pub max_range_m: f64,
}

impl SensorTable {
    const KINECT_V1: Self = Self {
        edge_jitter_px: 0.5,
        shadow_baseline_m: 0.075,
        dropout_angle_deg: 70.0,
        min_range_m: 0.4,
        max_range_m: 8.0,
        ..Self::with(NoiseModel::KINECT_V1)
    };

    /// Stereo camera. The depth image is that of the left eye; points that the right eye does not see are not measured.
    const REALSENSE_D435: Self = Self {
        edge_jitter_px: 1.0,
        shadow_baseline_m: 0.05,
        dropout_angle_deg: 75.0,
        min_range_m: 0.2,
        max_range_m: 10.0,
        ..Self::with(REALSENSE_D435)
    };

    /// Time-of-flight camera. The light is next to the lens, so that there is no shadow.
    const TIME_OF_FLIGHT: Self = Self {
        edge_jitter_px: 0.5,
        dropout_angle_deg: 75.0,
        min_range_m: 0.25,
        max_range_m: 5.5,
        ..Self::with(TIME_OF_FLIGHT)
    };

    const IDEAL: Self = Self::with(NoiseModel::IDEAL);

    /// Returns a sensor with this noise and no other errors.
    const fn with(noise: NoiseModel) -> Self {
        let NoiseModel { floor_m, growth_per_m, knee_m, step_per_m } = noise;
        Self {
            floor_m,
            growth_per_m,
            knee_m,
            step_per_m,
            noise_window_px: 1,
            grazing_noise: 0.0,
            edge_jitter_px: 0.0,
            shadow_baseline_m: 0.0,
            dropout_angle_deg: 90.0,
            min_range_m: 0.0,
            max_range_m: 1e3,
        }
    }

    const fn named(name: NoiseName) -> Self {
        match name {
            NoiseName::KinectV1 => Self::KINECT_V1,
            NoiseName::RealsenseD435 => Self::REALSENSE_D435,
            NoiseName::TimeOfFlight => Self::TIME_OF_FLIGHT,
            NoiseName::Ideal => Self::IDEAL,
        }
    }
}

impl Default for SensorTable {
    fn default() -> Self {
        Self::KINECT_V1
    }
}

impl From<NoiseConfig> for SensorConfig {
    /// Returns a sensor with this depth noise; by coefficients, it has no other errors.
    fn from(noise: NoiseConfig) -> Self {
        match noise {
            NoiseConfig::Named(name) => Self::Named(name),
            NoiseConfig::Coefficients(_) => Self::Table(SensorTable::with(noise.into())),
        }
    }
}

/// A depth sensor, which turns exact depths into pixels.
#[derive(Clone, Debug)]
pub struct Sensor {
    table: SensorTable,
    units_per_metre: f64,
    /// Cosine of the angle from which points may be lost; 0 if none is.
    dropout_cosine: f64,
    /// Two standard deviations of the jitter, in pixels.
    edge_reach: i64,
    shadow: Vec<bool>,
    /// Correlated deviates, if the noise is correlated.
    noise: Vec<f64>,
}

/// The random numbers of a pixel.
#[derive(Clone, Copy)]
enum Draw {
    Axial,
    Dropout,
    EdgeU,
    EdgeV,
}

impl Draw {
    fn counter(self, index: usize) -> u64 {
        4 * index as u64 + self as u64
    }
}

impl Sensor {
    /// Creates a sensor with `depth_scale` metres per unit of its pixels.
    pub fn new(config: SensorConfig, depth_scale: f64) -> Self {
        let table = match config {
            SensorConfig::Named(name) => SensorTable::named(name),
            SensorConfig::Table(table) => table,
        };
        let grazing = table.dropout_angle_deg < 90.0;
        let dropout_cosine = if grazing { libm::cos(table.dropout_angle_deg.to_radians()) } else { 0.0 };
        let edge_reach = (2.0 * table.edge_jitter_px).ceil() as i64;
        Self {
            table,
            units_per_metre: 1.0 / depth_scale,
            dropout_cosine,
            edge_reach,
            shadow: Vec::new(),
            noise: Vec::new(),
        }
    }

    /// Returns the part of the errors that the header describes.
    pub fn noise_model(&self) -> NoiseModel {
        let SensorTable { floor_m, growth_per_m, knee_m, step_per_m, .. } = self.table;
        NoiseModel { floor_m, growth_per_m, knee_m, step_per_m }
    }

    /// Measures a rendered image of `shapes` (camera frame) into `pixels`.
    pub fn measure(&mut self, raster: &Raster, shapes: &[Shape], dice: &CounterRng, pixels: &mut [u16]) {
        self.shadow = shadow::cast(raster, shapes, self.table.shadow_baseline_m);
        if self.table.noise_window_px > 1 {
            let deviate = |index: usize| dice.gaussian(Draw::Axial.counter(index));
            self.noise = noise_field(&raster.camera, self.table.noise_window_px as usize, deviate);
        }
        let (width, height) = (i64::from(raster.camera.width), i64::from(raster.camera.height));
        for v in 0..height {
            for u in 0..width {
                let index = raster.index(u, v);
                let depth = self.depth(raster, shapes, dice, [u, v]);
                pixels[index] = depth.map_or(INVALID_NEAR, |depth| pixel(depth * self.units_per_metre));
            }
        }
    }

    /// Returns the measured depth of a pixel in metres, if there is a measurement.
    fn depth(&self, raster: &Raster, shapes: &[Shape], dice: &CounterRng, at: [i64; 2]) -> Option<f64> {
        let index = raster.index(at[0], at[1]);
        let [u, v] = if self.at_edge(raster, at) { self.jittered(raster, dice, at) } else { at };
        let seen = raster.index(u, v);
        let exact = raster.depth[seen];
        if !exact.is_finite() || self.shadow[seen] {
            return None;
        }
        let shape = &shapes[usize::from(raster.owner[seen])];
        if self.dropout_cosine > 0.0 && self.gets_lost(shape, &raster.point(u, v), dice, index) {
            return None;
        }
        let mut sigma = self.axial_sigma(exact);
        if self.table.grazing_noise > 0.0 {
            sigma += self.grazing_sigma(shape, &raster.point(u, v));
        }
        let deviate = match self.table.noise_window_px {
            0 | 1 => dice.gaussian(Draw::Axial.counter(index)),
            _ => self.noise[index],
        };
        let depth = self.in_steps(exact + sigma * deviate);
        (self.table.min_range_m..=self.table.max_range_m).contains(&depth).then_some(depth)
    }

    /// Whether a point is lost because of the angle of its surface; the probability rises from 0 to 1, linearly in the cosine
    /// between ray and normal.
    #[inline]
    fn gets_lost(&self, shape: &Shape, point: &Vector3<f64>, dice: &CounterRng, index: usize) -> bool {
        let projection = shape.normal(point).dot(point);
        let limit = self.dropout_cosine * self.dropout_cosine * point.norm_squared();
        if projection * projection >= limit {
            return false;
        }
        dice.uniform(Draw::Dropout.counter(index)) * limit.sqrt() > projection.abs()
    }

    fn axial_sigma(&self, z: f64) -> f64 {
        let from_knee = z - self.table.knee_m;
        self.table.floor_m + self.table.growth_per_m * from_knee * from_knee
    }

    fn grazing_sigma(&self, shape: &Shape, point: &Vector3<f64>) -> f64 {
        let angle = libm::acos((shape.normal(point).dot(point).abs() / point.norm()).min(1.0));
        let growth = angle / (FRAC_PI_2 - angle).max(LEAST_GRAZE);
        self.table.grazing_noise / point.z.sqrt() * growth * growth
    }

    /// Returns the nearest depth whose disparity is a whole number of steps: `1 / z = n step_per_m`.
    fn in_steps(&self, z: f64) -> f64 {
        let step = self.table.step_per_m;
        if step > 0.0 { 1.0 / (f64::from(nearest_whole(1.0 / (z * step))) * step) } else { z }
    }

    /// Whether another surface is within reach of the jitter.
    #[inline]
    fn at_edge(&self, raster: &Raster, [u, v]: [i64; 2]) -> bool {
        if self.edge_reach == 0 {
            return false;
        }
        let reach = self.edge_reach;
        let owner = raster.owner[raster.index(u, v)];
        let differs = |u, v| {
            let [u, v] = inside(&raster.camera, u, v);
            raster.owner[raster.index(u, v)] != owner
        };
        differs(u - reach, v) || differs(u + reach, v) || differs(u, v - reach) || differs(u, v + reach)
    }

    /// Returns the pixel beyond the silhouette whose depth this one takes, or the pixel itself: only silhouettes jitter, not
    /// smooth surfaces.
    fn jittered(&self, raster: &Raster, dice: &CounterRng, [u, v]: [i64; 2]) -> [i64; 2] {
        let index = raster.index(u, v);
        let shift = |draw: Draw| (self.table.edge_jitter_px * dice.gaussian(draw.counter(index))).round() as i64;
        let beyond = inside(&raster.camera, u + shift(Draw::EdgeU), v + shift(Draw::EdgeV));
        let other = raster.index(beyond[0], beyond[1]);
        let jumps = is_jump(raster.depth[index], raster.depth[other]);
        if jumps && raster.owner[index] != raster.owner[other] { beyond } else { [u, v] }
    }
}

/// Returns the pixel for a depth in units; NaN and depths out of range are no measurement.
pub(super) fn pixel(units: f64) -> u16 {
    u16::try_from(nearest_whole(units)).ok().filter(|units| *units != INVALID_FAR).unwrap_or(INVALID_NEAR)
}

/// Rounds a positive number; one call less per pixel than `f64::round`.
#[inline]
fn nearest_whole(number: f64) -> u32 {
    (number + 0.5) as u32
}

/// Returns the pixel of the image nearest to `(u, v)`.
#[inline]
fn inside(camera: &Camera, u: i64, v: i64) -> [i64; 2] {
    [u.clamp(0, i64::from(camera.width) - 1), v.clamp(0, i64::from(camera.height) - 1)]
}

#[cfg(test)]
#[path = "sensor_tests.rs"]
mod tests;
