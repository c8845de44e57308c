//! How a pipeline file names the depth noise of a sensor: by a word for a known one, or by the coefficients of
//! [`NoiseModel`]. A source puts the model into the header, where every later stage finds it.

use conicflow_messages::NoiseModel;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The depth noise of a sensor: `"kinect_v1"`, `"ideal"` or a table of coefficients.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(
    untagged,
    expecting = "expected \"kinect_v1\", \"ideal\" or a table with some of the numbers `floor_m`, `growth_per_m`, \
                 `knee_m`, `step_per_m`"
)]
pub enum NoiseConfig {
    /// A sensor with a name.
    Named(NoiseName),
    /// Any other sensor.
    Coefficients(NoiseCoefficients),
}

/// A sensor whose noise is known.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum NoiseName {
    /// Microsoft Kinect for Xbox 360, Asus Xtion, PrimeSense Carmine.
    KinectV1,
    /// No noise at all.
    Ideal,
}

/// Coefficients of `sigma(z)^2 = (floor_m + growth_per_m (z - knee_m)^2)^2 + (step_per_m z^2)^2 / 12`; one that is left
/// out is that of a Kinect v1.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct NoiseCoefficients {
    /// Noise at the knee, in metres.
    #[schemars(range(min = 0.0))]
    pub floor_m: f64,
    /// Growth with the squared distance from the knee, in 1/metre.
    #[schemars(range(min = 0.0))]
    pub growth_per_m: f64,
    /// Depth of least noise, in metres.
    #[schemars(range(min = 0.0))]
    pub knee_m: f64,
    /// Depth between two neighbouring disparities, divided by the squared depth, in 1/metre.
    #[schemars(range(min = 0.0))]
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
            NoiseConfig::Named(NoiseName::KinectV1) => Self::KINECT_V1,
            NoiseConfig::Named(NoiseName::Ideal) => Self::IDEAL,
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
        let table = model("noise = { floor_m = 0.002, growth_per_m = 0.0, step_per_m = 1e-4 }").unwrap();
        assert_eq!(table, NoiseModel { floor_m: 0.002, growth_per_m: 0.0, knee_m: 0.4, step_per_m: 1e-4 });
    }

    #[test]
    fn anything_else_is_refused_with_the_choices() {
        for text in ["noise = 'kinect'", "noise = { flor_m = 0.001 }", "noise = 3", "noise = { floor_m = 'much' }"] {
            let error = model(text).unwrap_err().to_string();
            assert!(error.contains("\"kinect_v1\", \"ideal\" or a table"), "{error}");
        }
    }
}
