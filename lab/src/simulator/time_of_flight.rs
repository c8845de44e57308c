//! A time-of-flight camera: a pixel measures the mean depth of everything that it sees, weighted by the returned light. At a
//! silhouette that is a depth between the two surfaces, a flying pixel. The noise is that of the light, and correlated as far as
//! neighbours are smoothed together.
//!
//! The returned light is `cos(a) / z^2`, with the angle a between ray and normal; the noise grows as the light decreases.

use super::noise_field::noise_field;
use super::raster::{Raster, is_jump};
use super::shapes::{Shape, Surface};
use crate::random::CounterRng;
use conicflow_detection::noise::TIME_OF_FLIGHT;
use conicflow_messages::NoiseModel;
use nalgebra::Vector3;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Samples per pixel at a silhouette, along each side.
const SAMPLES: i64 = 5;

/// The numbers of a time-of-flight camera; by default those of the Azure Kinect's class.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct TimeOfFlight {
    /// Noise at the knee, in metres.
    #[schemars(range(min = 0.0))]
    pub floor_m: f64,
    /// Growth of the noise with the squared distance from the knee, in 1/metre.
    #[schemars(range(min = 0.0))]
    pub growth_per_m: f64,
    /// Depth of least noise, in metres.
    #[schemars(range(min = 0.0))]
    pub knee_m: f64,
    /// Side of the window over which the noise is smoothed, in pixels of the image.
    #[schemars(range(min = 1, max = 15))]
    pub noise_window_px: u32,
    /// Side of the square that a pixel sees, in pixels: above 1 where the lens is not sharp.
    #[schemars(range(min = 0.1, max = 5.0))]
    pub footprint_px: f64,
    /// Angle between ray and normal from which on too little light comes back, in degrees.
    #[schemars(range(min = 0.0, max = 90.0))]
    pub dropout_angle_deg: f64,
    /// Least depth that is measured, in metres.
    #[schemars(range(min = 0.0))]
    pub min_range_m: f64,
    /// Greatest depth that is measured, in metres.
    #[schemars(range(min = 0.0))]
    pub max_range_m: f64,
}

impl Default for TimeOfFlight {
    fn default() -> Self {
        let NoiseModel { floor_m, growth_per_m, knee_m, .. } = TIME_OF_FLIGHT;
        Self {
            floor_m,
            growth_per_m,
            knee_m,
            noise_window_px: 5,
            footprint_px: 1.5,
            dropout_angle_deg: 80.0,
            min_range_m: 0.25,
            max_range_m: 5.5,
        }
    }
}

/// The camera.
#[derive(Clone, Debug)]
pub struct TimeOfFlightCamera {
    table: TimeOfFlight,
    /// Correlated deviates.
    noise: Vec<f64>,
    /// The surfaces around a pixel.
    owners: Vec<u16>,
}

/// The light that returns to a pixel, and its depth.
#[derive(Clone, Copy, Default)]
struct Light {
    amount: f64,
    /// Sum of depth times amount.
    moment: f64,
}

impl Light {
    fn add(&mut self, shape: &Shape, point: &Vector3<f64>) {
        let amount = cosine(shape, point) / (point.z * point.z);
        self.amount += amount;
        self.moment += amount * point.z;
    }
}

/// Cosine of the angle between the ray to a point and the normal there.
fn cosine(shape: &Shape, point: &Vector3<f64>) -> f64 {
    shape.normal(point).dot(point).abs() / point.norm()
}

impl TimeOfFlightCamera {
    /// Creates a camera that has seen nothing.
    pub fn new(table: TimeOfFlight) -> Self {
        Self { table, noise: Vec::new(), owners: Vec::new() }
    }

    /// Returns the noise model for the frames' headers.
    pub fn noise_model(&self) -> NoiseModel {
        let TimeOfFlight { floor_m, growth_per_m, knee_m, .. } = self.table;
        NoiseModel { floor_m, growth_per_m, knee_m, step_per_m: 0.0 }
    }

    /// Measures a rendered image of `shapes` (camera frame); returns the depth of each pixel in metres, NaN without a
    /// measurement.
    pub fn measure(&mut self, raster: &Raster, shapes: &[Shape], dice: &CounterRng) -> Vec<f64> {
        let window = self.table.noise_window_px.max(1) as usize;
        self.noise = noise_field(&raster.camera, window, |index| dice.gaussian(index as u64));
        let (width, height) = (i64::from(raster.camera.width), i64::from(raster.camera.height));
        let pixels = (0..height).flat_map(|v| (0..width).map(move |u| [u, v]));
        pixels.map(|pixel| self.depth(raster, shapes, pixel).unwrap_or(f64::NAN)).collect()
    }

    fn depth(&mut self, raster: &Raster, shapes: &[Shape], at: [i64; 2]) -> Option<f64> {
        let light = if self.is_edge(raster, at) { self.mixed(raster, shapes, at) } else { plain(raster, shapes, at) };
        let exact = light.moment / light.amount;
        let returned = light.amount * exact * exact;
        if returned.is_nan() || returned < libm::cos(self.table.dropout_angle_deg.to_radians()) {
            return None;
        }
        let sigma = self.noise_model().sigma(exact) / returned.min(1.0);
        let depth = exact + sigma * self.noise[raster.index(at[0], at[1])];
        (self.table.min_range_m..=self.table.max_range_m).contains(&depth).then_some(depth)
    }

    /// Whether a pixel may see several surfaces; notes them.
    fn is_edge(&mut self, raster: &Raster, [u, v]: [i64; 2]) -> bool {
        let reach = (0.5 * self.table.footprint_px).ceil() as i64;
        let (width, height) = (i64::from(raster.camera.width), i64::from(raster.camera.height));
        let here = raster.depth[raster.index(u, v)];
        self.owners.clear();
        let mut jumps = false;
        for row in (v - reach).max(0)..=(v + reach).min(height - 1) {
            for column in (u - reach).max(0)..=(u + reach).min(width - 1) {
                let index = raster.index(column, row);
                let depth = raster.depth[index];
                jumps |= is_jump(here, depth);
                if !self.owners.contains(&raster.owner[index]) {
                    self.owners.push(raster.owner[index]);
                }
            }
        }
        jumps || self.owners.len() > 1
    }

    /// Returns the light of all noted surfaces in a pixel, as the mean of its samples.
    fn mixed(&self, raster: &Raster, shapes: &[Shape], [u, v]: [i64; 2]) -> Light {
        let camera = &raster.camera;
        let offset = |i: i64| self.table.footprint_px * ((i as f64 + 0.5) / SAMPLES as f64 - 0.5);
        let seen = || self.owners.iter().filter_map(|owner| shapes.get(usize::from(*owner)));
        let mut light = Light::default();
        for j in 0..SAMPLES {
            for i in 0..SAMPLES {
                let x = (u as f64 + offset(i) - camera.cx) / camera.fx;
                let y = (v as f64 + offset(j) - camera.cy) / camera.fy;
                let ray = Vector3::new(x, y, 1.0);
                let hits = seen().map(|shape| (shape, shape.hit(&Vector3::zeros(), &ray)));
                if let Some((shape, z)) = hits.min_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, z)| z.is_finite()) {
                    light.add(shape, &(ray * z));
                }
            }
        }
        let count = (SAMPLES * SAMPLES) as f64;
        Light { amount: light.amount / count, moment: light.moment / count }
    }
}

/// Returns the light of a pixel with a single surface.
fn plain(raster: &Raster, shapes: &[Shape], [u, v]: [i64; 2]) -> Light {
    let mut light = Light::default();
    if let Some(shape) = shapes.get(usize::from(raster.owner[raster.index(u, v)])) {
        light.add(shape, &raster.point(u, v));
    }
    light
}
