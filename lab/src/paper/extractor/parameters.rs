//! Parameters of the paper's extractor, `arcs = "conic"`.

use conicflow_detection::{ExtractorParameters, ScanLines};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// Parameters of `arcs = "conic"` alone.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ConicParameters {
    /// Largest root mean square distance of points from their line or ellipse, in standard deviations of the
    /// sensor.
    #[schemars(range(min = 0.1, max = 20.0))]
    pub max_error_sigmas: f64,
    /// Added to `max_error_sigmas`, for what the noise model leaves out, in metres.
    #[schemars(range(min = 0.0, max = 0.1))]
    pub max_error_floor_m: f64,
    /// Largest depth step within a run, beyond that of `jump_slope`, in standard deviations of the sensor.
    #[schemars(range(min = 0.0, max = 100.0))]
    pub jump_sigmas: f64,
    /// Slope of a surface (depth per distance across the view) whose depth steps never end a run.
    #[schemars(range(min = 0.1, max = 100.0))]
    pub jump_slope: f64,
    /// Fewest points of an ellipse.
    #[schemars(range(min = 6, max = 1000))]
    pub min_points: u32,
    /// Smallest ratio of the shorter to the longer semi-axis; flatter ellipses are walls and floors.
    #[schemars(range(min = 0.01, max = 1.0))]
    pub min_radius_ratio: f64,
    /// Smallest angle that the points span around the centre, in degrees.
    #[schemars(range(min = 0.0, max = 180.0))]
    pub min_arc_deg: f64,
}

impl Default for ConicParameters {
    fn default() -> Self {
        Self {
            max_error_sigmas: 1.3,
            max_error_floor_m: 0.0005,
            jump_sigmas: 5.0,
            jump_slope: 5.0,
            min_points: 10,
            min_radius_ratio: 0.2,
            min_arc_deg: 60.0,
        }
    }
}

/// All parameters of the extractor.
#[derive(Clone, Debug, Default)]
pub struct ConicConfig {
    /// The parameters of every extractor.
    pub common: ExtractorParameters,
    /// The parameters of this one only.
    pub conic: ConicParameters,
}

impl ConicConfig {
    /// Returns the parameters of the paper's method: ellipses of the rows only.
    pub fn of_the_paper() -> Self {
        let common = ExtractorParameters { scan: ScanLines::Rows, ..ExtractorParameters::default() };
        Self { common, conic: ConicParameters::default() }
    }
}
