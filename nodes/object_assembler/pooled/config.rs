//! Parameters of the pooled method.

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// What an object has to be for `method = "pooled"` to report it.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct PooledConfig {
    /// Fewest scan lines of an object; of those that the extractor looks at, as wherever lines are counted.
    #[schemars(range(min = 7, max = 1000))]
    pub min_lines: u32,
    /// Smallest visual angle of an object across its scan lines, in degrees: a finer image shows more of what is too small
    /// to tell.
    #[schemars(range(min = 0.0, max = 45.0))]
    pub min_view_deg: f64,
    /// Scan lines without a part of the object that are bridged in any case; while the first few are put together, one less.
    #[schemars(range(min = 1, max = 64))]
    pub max_gap_lines: u32,
    /// Smallest part of the scan lines from first to last that support the object.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub min_coverage: f64,
    /// Smallest visible part of the circumference, in degrees.
    #[schemars(range(min = 0.0, max = 180.0))]
    pub min_arc_deg: f64,
    /// Shortest visible part of a cylinder or cone, in radii.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub min_length_radii: f64,
    /// Least height of the visible part of a sphere, in radii.
    #[schemars(range(min = 0.0, max = 2.0))]
    pub min_cap_radii: f64,
    /// Half-angle from which on something may be a cone and not a cylinder, in degrees.
    #[schemars(range(min = 0.0, max = 45.0))]
    pub min_half_angle_deg: f64,
}

impl Default for PooledConfig {
    fn default() -> Self {
        Self {
            min_lines: 10,
            min_view_deg: 1.4,
            max_gap_lines: 4,
            min_coverage: 0.6,
            min_arc_deg: 30.0,
            min_length_radii: 0.5,
            min_cap_radii: 0.5,
            min_half_angle_deg: 2.5,
        }
    }
}
