//! The depth noise of a sensor in a pipeline file: a name for a known sensor, or the coefficients of [`NoiseModel`]. A source
//! puts the model into the header, where later stages find it. For a sensor without a name, `noise_estimator` finds the
//! coefficients from a recording.

use conicflow_messages::NoiseModel;
use serde::de::{IntoDeserializer, value};
use serde::{Deserialize, Serialize};
use std::str::FromStr;

/// The depth noise of a sensor: `"kinect_v1"`, `"realsense_d435"`, `"time_of_flight"`, `"ideal"` or a table of
/// coefficients.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(
    untagged,
    expecting = "expected \"kinect_v1\", \"realsense_d435\", \"time_of_flight\", \"ideal\" or a table with some of the \
                 numbers `floor_m`, `growth_per_m`, `knee_m`, `step_per_m`"
)]
pub enum NoiseConfig {
    /// A sensor with a name.
    Named(NoiseName),
    /// Any other sensor.
    Coefficients(NoiseCoefficients),
}

/// A sensor whose noise is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum NoiseName {
    /// Microsoft Kinect for Xbox 360, Asus Xtion, PrimeSense Carmine.
    KinectV1,
    /// Stereo camera of the RealSense D400 series with a base line of 50 mm, at 848x480.
    RealsenseD435,
    /// Time-of-flight camera such as the Azure Kinect with its narrow field of view.
    TimeOfFlight,
    /// No noise at all.
    Ideal,
}

/// A RealSense D435: `sigma = z^2 subpixel / (f b)`, the theoretical limit in the maker's guide (Grunnet-Jepsen, Sweetser
/// and Woodfill, "Best-known methods for tuning Intel RealSense D400 depth cameras for best performance"), with the usual
/// subpixel error of 0.08 px, f = 424 px (848 columns over 90 degrees) and b = 50 mm. The steps of its disparity are far
/// below that.
pub const REALSENSE_D435: NoiseModel =
    NoiseModel { floor_m: 0.0, growth_per_m: 0.08 / (424.0 * 0.05), knee_m: 0.0, step_per_m: 0.0 };

/// A time-of-flight camera of the class of the Azure Kinect: 1 mm near, 4 mm at 3.5 m, where the light is weak. A cautious
/// choice of ours, far within the maker's bound of 17 mm, which Toelgyessy et al., "Evaluation of the Azure Kinect and its
/// comparison to Kinect v1 and Kinect v2" (Sensors 21, 2021), confirm; it depends much on the surface, so estimate yours.
pub const TIME_OF_FLIGHT: NoiseModel =
    NoiseModel { floor_m: 0.001, growth_per_m: 0.0003, knee_m: 0.5, step_per_m: 0.0 };

impl NoiseName {
    /// Returns the noise of the sensor.
    pub const fn model(self) -> NoiseModel {
        match self {
            Self::KinectV1 => NoiseModel::KINECT_V1,
            Self::RealsenseD435 => REALSENSE_D435,
            Self::TimeOfFlight => TIME_OF_FLIGHT,
            Self::Ideal => NoiseModel::IDEAL,
        }
    }
}

impl FromStr for NoiseName {
    type Err = value::Error;

    /// Returns the sensor with this name in the pipeline file.
    fn from_str(word: &str) -> Result<Self, value::Error> {
        Self::deserialize(word.into_deserializer())
    }
}

/// Coefficients of `sigma(z)^2 = (floor_m + growth_per_m (z - knee_m)^2)^2 + (step_per_m z^2)^2 / 12`; one that is left
/// out is that of a Kinect v1.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct NoiseCoefficients {
    /// Noise at the knee, in metres.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1000.0)))]
    pub floor_m: f64,
    /// Growth with the squared distance from the knee, in 1/metre.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1000.0)))]
    pub growth_per_m: f64,
    /// Depth of least noise, in metres.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1000.0)))]
    pub knee_m: f64,
    /// Depth between two neighbouring disparities, divided by the squared depth, in 1/metre.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1000.0)))]
    pub step_per_m: f64,
}

impl Default for NoiseConfig {
    fn default() -> Self {
        Self::Named(NoiseName::KinectV1)
    }
}

impl Default for NoiseCoefficients {
    fn default() -> Self {
        let NoiseModel { floor_m, growth_per_m, knee_m, step_per_m } = NoiseModel::KINECT_V1;
        Self { floor_m, growth_per_m, knee_m, step_per_m }
    }
}

impl From<NoiseConfig> for NoiseModel {
    fn from(config: NoiseConfig) -> Self {
        match config {
            NoiseConfig::Named(name) => name.model(),
            NoiseConfig::Coefficients(NoiseCoefficients { floor_m, growth_per_m, knee_m, step_per_m }) => {
                Self { floor_m, growth_per_m, knee_m, step_per_m }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Deserialize)]
    struct Stage {
        noise: NoiseConfig,
    }

    fn model(text: &str) -> Result<NoiseModel, toml::de::Error> {
        toml::from_str::<Stage>(text).map(|stage| stage.noise.into())
    }

    #[test]
    fn words_and_tables_are_understood() {
        assert_eq!(model("noise = 'kinect_v1'").unwrap(), NoiseModel::KINECT_V1);
        assert_eq!(model("noise = 'ideal'").unwrap(), NoiseModel::IDEAL);
        assert_eq!(model("noise = 'realsense_d435'").unwrap(), REALSENSE_D435);
        assert_eq!(model("noise = 'time_of_flight'").unwrap(), TIME_OF_FLIGHT);
        assert_eq!(["ideal", "kinect"].map(|word| word.parse().ok()), [Some(NoiseName::Ideal), None]);
        let table = model("noise = { floor_m = 0.002, growth_per_m = 0.0, step_per_m = 1e-4 }").unwrap();
        assert_eq!(table, NoiseModel { floor_m: 0.002, growth_per_m: 0.0, knee_m: 0.4, step_per_m: 1e-4 });
    }

    #[test]
    fn anything_else_is_refused_with_the_choices() {
        for text in ["noise = 'kinect'", "noise = { flor_m = 0.001 }", "noise = 3", "noise = { floor_m = 'much' }"] {
            let error = model(text).unwrap_err().to_string();
            assert!(
                error.contains("\"kinect_v1\", \"realsense_d435\"") && error.contains("\"ideal\" or a table"),
                "{error}"
            );
        }
    }

    #[test]
    fn stereo_is_noisy_as_the_square_of_the_distance() {
        assert!((REALSENSE_D435.sigma(1.0) - 0.00377).abs() < 1e-5);
        assert!((REALSENSE_D435.sigma(2.0) / REALSENSE_D435.sigma(1.0) - 4.0).abs() < 1e-9);
        assert!(TIME_OF_FLIGHT.sigma(0.5) < 0.0011 && TIME_OF_FLIGHT.sigma(3.5) < 0.017);
    }
}
