//! Sensors whose measuring principle is simulated, not only their noise: cameras that match blocks of images, and time-of-flight
//! cameras.

use super::matching_camera::{MatchingCamera, MatchingNumbers};
use super::raster::Raster;
use super::sensor;
use super::shapes::Shape;
use super::time_of_flight::{TimeOfFlight, TimeOfFlightCamera};
use crate::random::CounterRng;
use conicflow_messages::{Camera, ConfigFault, NoiseModel};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Which sensor: a word for one of the usual numbers, or a table with some of its own.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(
    untagged,
    expecting = "expected \"stereo\", \"structured_light\", \"time_of_flight\" or a table such as \
                 `{ stereo = { baseline_m = 0.05 } }`"
)]
pub enum SimulatedSensor {
    /// A sensor with its usual numbers.
    Named(SensorKind),
    /// A sensor with its own numbers.
    Table(SensorNumbers),
}

/// A kind of sensor.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SensorKind {
    /// Two eyes and a dot pattern, as a RealSense of the D400 series.
    Stereo,
    /// One eye and a dot pattern that it knows, as a Kinect v1.
    StructuredLight,
    /// Time of flight, as an Azure Kinect.
    TimeOfFlight,
}

/// The numbers of one kind of sensor; the usual ones by default.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SensorNumbers {
    /// Two eyes and a dot pattern.
    Stereo(MatchingNumbers),
    /// One eye and a dot pattern that it knows.
    StructuredLight(MatchingNumbers),
    /// Time of flight.
    TimeOfFlight(TimeOfFlight),
}

impl SimulatedSensor {
    fn numbers(self) -> SensorNumbers {
        match self {
            Self::Named(SensorKind::Stereo) => SensorNumbers::Stereo(MatchingNumbers::default()),
            Self::Named(SensorKind::StructuredLight) => SensorNumbers::StructuredLight(MatchingNumbers::default()),
            Self::Named(SensorKind::TimeOfFlight) => SensorNumbers::TimeOfFlight(TimeOfFlight::default()),
            Self::Table(numbers) => numbers,
        }
    }

    /// Returns what is wrong with the parameters, if anything.
    pub fn fault(self) -> Option<ConfigFault> {
        let what = match self.numbers() {
            SensorNumbers::Stereo(numbers) | SensorNumbers::StructuredLight(numbers) => numbers.fault(),
            SensorNumbers::TimeOfFlight(_) => None,
        };
        let hint = "leave the numbers out, for the usual ones".into();
        what.map(|what| ConfigFault { key: "sensor", what, hint })
    }
}

#[derive(Clone, Debug)]
enum Kind {
    Matching(Box<MatchingCamera>),
    TimeOfFlight(TimeOfFlightCamera),
}

/// A simulated sensor, which turns scenes into pixels.
#[derive(Clone, Debug)]
pub struct SensorSimulation {
    kind: Kind,
    units_per_metre: f64,
}

impl SensorSimulation {
    /// Creates a sensor with `depth_scale` metres per unit of its pixels; the seed determines the random properties of the
    /// device.
    pub fn new(sensor: SimulatedSensor, camera: &Camera, depth_scale: f64, seed: u64) -> Self {
        let matching = |camera: MatchingCamera| Kind::Matching(Box::new(camera));
        let kind = match sensor.numbers() {
            SensorNumbers::Stereo(numbers) => matching(MatchingCamera::stereo(numbers, camera, seed)),
            SensorNumbers::StructuredLight(numbers) => {
                matching(MatchingCamera::structured_light(numbers, camera, seed))
            }
            SensorNumbers::TimeOfFlight(table) => Kind::TimeOfFlight(TimeOfFlightCamera::new(table)),
        };
        Self { kind, units_per_metre: 1.0 / depth_scale }
    }

    /// Returns the noise model for the frames' headers.
    pub fn noise_model(&self, camera: &Camera) -> NoiseModel {
        match &self.kind {
            Kind::Matching(matching) => matching.noise_model(camera.fx),
            Kind::TimeOfFlight(time_of_flight) => time_of_flight.noise_model(),
        }
    }

    /// Measures a rendered image of `shapes` (camera frame) into `pixels`.
    pub fn measure(&mut self, raster: &Raster, shapes: &[Shape], dice: &CounterRng, pixels: &mut [u16]) {
        let depths = match &mut self.kind {
            Kind::Matching(camera) => camera.measure(raster, shapes, dice),
            Kind::TimeOfFlight(camera) => camera.measure(raster, shapes, dice),
        };
        for (pixel, depth) in pixels.iter_mut().zip(depths) {
            *pixel = sensor::pixel(depth * self.units_per_metre);
        }
    }
}

#[cfg(test)]
#[path = "simulated_sensor_tests.rs"]
mod tests;
