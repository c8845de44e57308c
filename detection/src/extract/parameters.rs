//! Parameters of the extraction of ellipses.

use conicflow_geometry::Scan;
use conicflow_messages::ConfigFault;
use serde::{Deserialize, Serialize};

/// Directions of the scan lines that are searched.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(rename_all = "snake_case")]
pub enum ScanLines {
    /// Rows: finds upright objects.
    Rows,
    /// Columns: finds lying ones.
    Columns,
    /// Rows, then columns.
    #[default]
    Both,
}

impl ScanLines {
    /// Returns the directions in the order in which they are searched.
    pub fn directions(self) -> &'static [Scan] {
        match self {
            Self::Rows => &[Scan::Row],
            Self::Columns => &[Scan::Column],
            Self::Both => &[Scan::Row, Scan::Column],
        }
    }
}

/// Parameters of the extraction.
#[derive(Clone, Debug, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default)]
pub struct ExtractorParameters {
    /// Scan lines to search: `rows`, `columns` (for objects that lie) or `both`.
    pub scan: ScanLines,
    /// Searches every n-th scan line; half of these in images of 960 rows and more that are so noisy that five lines are
    /// averaged.
    #[cfg_attr(feature = "schema", schemars(range(min = 1, max = 64)))]
    pub line_step: u32,
    /// Number of missing pixels that are bridged inside a run.
    #[cfg_attr(feature = "schema", schemars(range(min = 0, max = 64)))]
    pub max_hole_px: u32,
    /// Number of points taken off both ends of a run, where pixels mix two depths. The last of them is put back if its ray meets
    /// the circle through the others.
    #[cfg_attr(feature = "schema", schemars(range(min = 0, max = 16)))]
    pub trim_px: u32,
    /// Smallest radius of a circle through an arc, in metres.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.001, max = 10.0)))]
    pub min_radius_m: f64,
    /// Largest radius that is not a wall's, in metres: a line wider than twice this belongs to no object; the limits of objects
    /// are parameters of the assembler.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.001, max = 10.0)))]
    pub max_radius_m: f64,
}

impl Default for ExtractorParameters {
    fn default() -> Self {
        Self { scan: ScanLines::Both, line_step: 1, max_hole_px: 3, trim_px: 1, min_radius_m: 0.015, max_radius_m: 0.6 }
    }
}

impl ExtractorParameters {
    /// Returns the contradictions between parameters that are each in range.
    pub fn faults(&self) -> Vec<ConfigFault> {
        let (least, most) = (self.min_radius_m, self.max_radius_m);
        if least < most {
            return Vec::new();
        }
        vec![ConfigFault {
            key: "min_radius_m",
            what: format!("nothing lies between {least} m and `max_radius_m`, {most} m"),
            hint: "set it to less than `max_radius_m`".to_owned(),
        }]
    }
}
