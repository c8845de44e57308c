//! Parameters of the paper's method, `method = "profile"`.

use conicflow_detection::AssemblerParameters;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The shape that is fitted to a body's section by a scan plane.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SectionFit {
    /// The ellipse as the extractor found it, as in the paper. The paper names the radius r2, along the view; but the figures
    /// that it reports follow from the other one, which is used.
    Ellipse,
    /// An ellipse with the axis ratio that follows from the body's axis, fitted anew to the arc's moments.
    #[default]
    Circle,
}

/// Parameters of `method = "profile"` alone.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct ProfileParameters {
    /// Sections as found by the extractor (`ellipse`, as in the paper) or of the axis ratio that the axis implies (`circle`).
    pub section_fit: SectionFit,
    /// The paper's phi: largest distance of the centres of neighbouring ellipses, in metres.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub max_center_step_m: f64,
    /// Added to `max_center_step_m`, in radii of the smaller ellipse.
    #[schemars(range(min = 0.0, max = 2.0))]
    pub max_center_step_radii: f64,
    /// The paper's k: number of neighbours that an ellipse is compared with, and of noisy ones that an object survives.
    #[schemars(range(min = 1, max = 64))]
    pub neighbors: u32,
    /// Largest difference of the numbers of neighbouring scan lines, among those that the extractor uses.
    #[schemars(range(min = 1, max = 64))]
    pub max_gap_lines: u32,
    /// Largest scatter of centres about their line or circle, as a part of the radius.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub max_center_scatter: f64,
    /// Largest scatter of radii about their profile, as a part of the radius.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub max_radius_scatter: f64,
    /// Half-angle up to which a profile counts as constant, that of a cylinder, in degrees.
    #[schemars(range(min = 0.0, max = 45.0))]
    pub min_half_angle_deg: f64,
    /// Residual of a cone, as a part of the cylinder's or sphere's, below which it is called a cone.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub cone_gain: f64,
    /// Fewest scan lines of an object.
    #[schemars(range(min = 3, max = 1000))]
    pub min_rows: u32,
    /// Smallest part of the scan lines from first to last that support the object.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub min_coverage: f64,
    /// Shortest cylinder or cone, in radii.
    #[schemars(range(min = 0.0, max = 10.0))]
    pub min_length_radii: f64,
    /// Least height of the seen part of a sphere, in radii.
    #[schemars(range(min = 0.0, max = 2.0))]
    pub min_sphere_height_radii: f64,
    /// Smallest visible part of the circumference, in degrees.
    #[schemars(range(min = 0.0, max = 180.0))]
    pub min_arc_deg: f64,
    /// Largest root mean square distance of the points from the surface, in standard deviations of the sensor.
    #[schemars(range(min = 0.1, max = 20.0))]
    pub max_rms_sigmas: f64,
    /// Added to `max_rms_sigmas`, in radii, for the error of the radius; no effect with `section_fit = "ellipse"`.
    #[schemars(range(min = 0.0, max = 0.5))]
    pub max_rms_radii: f64,
    /// Least root mean square distance of the points of a section from a straight line, in standard deviations of the
    /// sensor: a flatter one may be a plane.
    #[schemars(range(min = 0.0, max = 20.0))]
    pub min_bulge_sigmas: f64,
}

impl Default for ProfileParameters {
    fn default() -> Self {
        Self {
            section_fit: SectionFit::Circle,
            max_center_step_m: 0.01,
            max_center_step_radii: 0.35,
            neighbors: 4,
            max_gap_lines: 4,
            max_center_scatter: 0.2,
            max_radius_scatter: 0.15,
            min_half_angle_deg: 5.0,
            cone_gain: 0.8,
            min_rows: 12,
            min_coverage: 0.6,
            min_length_radii: 0.4,
            min_sphere_height_radii: 0.8,
            min_arc_deg: 75.0,
            max_rms_sigmas: 1.3,
            max_rms_radii: 0.02,
            min_bulge_sigmas: 2.2,
        }
    }
}

/// All parameters of the assembler.
#[derive(Clone, Debug, Default)]
pub struct ProfileConfig {
    /// The parameters of every assembler.
    pub common: AssemblerParameters,
    /// The parameters of this one only.
    pub profile: ProfileParameters,
}

impl ProfileConfig {
    /// Returns the parameters of the paper's method, with sections as the extractor found them.
    pub fn of_the_paper() -> Self {
        let profile = ProfileParameters { section_fit: SectionFit::Ellipse, ..ProfileParameters::default() };
        Self { common: AssemblerParameters::default(), profile }
    }
}
