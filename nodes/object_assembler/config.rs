//! Parameters of the assembler.

use super::PooledConfig;
use super::rejection::Rejection;
use conicflow_dataflow::{Config, ConfigFault};
use conicflow_messages::ObjectKind;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// How objects are found in a list of ellipses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// The paper's: lines and circles through the centres, radius over position along the axis.
    Profile,
    /// Models fitted to the pooled moments of all arcs of an object.
    #[default]
    Pooled,
}

/// What is taken for the section of a body by a scan plane.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum SectionFit {
    /// The ellipse as the extractor found it, as in the paper. The paper names the radius r2, along the view; but what it
    /// measures at a distance is what the other one gives, and that is taken.
    Ellipse,
    /// An ellipse of the axis ratio that the axis of the body implies, fitted anew to the arc's moments.
    #[default]
    Circle,
}

/// Smallest and largest radius of a shape.
#[derive(Clone, Copy, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct RadiusLimits {
    /// Smallest radius, in metres.
    #[schemars(range(min = 0.001, max = 100.0))]
    pub min_m: f64,
    /// Largest radius, in metres.
    #[schemars(range(min = 0.001, max = 100.0))]
    pub max_m: f64,
}

/// Smallest and largest radius and visible length of a cylinder or cone.
#[derive(Clone, Copy, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct AxialLimits {
    /// Smallest radius, in metres; of a cone in the middle of its visible part.
    #[schemars(range(min = 0.001, max = 100.0))]
    pub min_m: f64,
    /// Largest radius, in metres.
    #[schemars(range(min = 0.001, max = 100.0))]
    pub max_m: f64,
    /// Smallest visible length, in metres.
    #[serde(default)]
    #[schemars(range(min = 0.0, max = 100.0))]
    pub min_length_m: f64,
    /// Largest visible length, in metres.
    #[serde(default = "unlimited_m")]
    #[schemars(range(min = 0.0, max = 100.0))]
    pub max_length_m: f64,
}

/// More than any camera sees.
fn unlimited_m() -> f64 {
    100.0
}

/// Parameters of the assembler.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct AssemblerConfig {
    /// How objects are found: by `pooled` moments of arcs (`arcs = "moments"` of the extractor), or by the paper's `profile`
    /// of ellipses (`arcs = "conic"`).
    pub method: Method,
    /// Sections as found by the extractor (`ellipse`, as in the paper) or of the axis ratio that the axis implies (`circle`).
    pub section_fit: SectionFit,
    /// The paper's phi: largest distance of the centres of neighbouring ellipses, in metres ...
    #[schemars(range(min = 0.0, max = 1.0))]
    pub max_center_step_m: f64,
    /// ... plus this many times their radius.
    #[schemars(range(min = 0.0, max = 2.0))]
    pub max_center_step_radii: f64,
    /// The paper's k: number of neighbours that an ellipse is compared with, and of noisy ones that an object survives.
    #[schemars(range(min = 1, max = 64))]
    pub neighbors: u32,
    /// Largest difference of the numbers of neighbouring scan lines; of those that the extractor looks at, as wherever lines
    /// are counted.
    #[schemars(range(min = 1, max = 64))]
    pub max_gap_lines: u32,
    /// Largest scatter of centres about their line or circle, as a part of the radius.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub max_center_scatter: f64,
    /// Largest scatter of radii about their profile, as a part of the radius.
    #[schemars(range(min = 0.0, max = 1.0))]
    pub max_radius_scatter: f64,
    /// Half-angle up to which a profile counts as constant, that of a cylinder, in degrees; of `pooled` see there.
    #[schemars(range(min = 0.0, max = 45.0))]
    pub min_half_angle_deg: f64,
    /// Largest half-angle of a cone, in degrees, whatever the method.
    #[schemars(range(min = 0.0, max = 45.0))]
    pub max_half_angle_deg: f64,
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
    /// Largest root mean square distance of the points from the surface, in standard deviations of the sensor ...
    #[schemars(range(min = 0.1, max = 20.0))]
    pub max_rms_sigmas: f64,
    /// ... plus this many radii, for the error of the radius; of `section_fit = "ellipse"` that is known, and this has no
    /// effect.
    #[schemars(range(min = 0.0, max = 0.5))]
    pub max_rms_radii: f64,
    /// Least root mean square distance of the points of a section from a straight line, in standard deviations of the
    /// sensor: a flatter one may be a plane.
    #[schemars(range(min = 0.0, max = 20.0))]
    pub min_bulge_sigmas: f64,
    /// Parameters of `method = "pooled"`; those above, `method` and `max_half_angle_deg` aside, are about `profile`.
    pub pooled: PooledConfig,
    /// Limits on the radius of a sphere.
    pub sphere: RadiusLimits,
    /// Limits on the radius and the visible length of a cylinder.
    pub cylinder: AxialLimits,
    /// Limits on the radius, in the middle of its visible part, and the visible length of a cone.
    pub cone: AxialLimits,
}

impl Default for AssemblerConfig {
    fn default() -> Self {
        let (min_m, max_m) = (0.015, 0.5);
        let axial = AxialLimits { min_m, max_m, min_length_m: 0.0, max_length_m: unlimited_m() };
        Self {
            method: Method::Pooled,
            section_fit: SectionFit::Circle,
            max_center_step_m: 0.01,
            max_center_step_radii: 0.35,
            neighbors: 4,
            max_gap_lines: 4,
            max_center_scatter: 0.2,
            max_radius_scatter: 0.15,
            min_half_angle_deg: 5.0,
            max_half_angle_deg: 30.0,
            cone_gain: 0.8,
            min_rows: 12,
            min_coverage: 0.6,
            min_length_radii: 0.4,
            min_sphere_height_radii: 0.8,
            min_arc_deg: 75.0,
            max_rms_sigmas: 1.3,
            max_rms_radii: 0.02,
            min_bulge_sigmas: 2.2,
            pooled: PooledConfig::default(),
            sphere: RadiusLimits { min_m, max_m },
            cylinder: axial,
            cone: axial,
        }
    }
}

impl AssemblerConfig {
    /// The paper's method.
    pub fn of_the_paper() -> Self {
        Self { method: Method::Profile, section_fit: SectionFit::Ellipse, ..Self::default() }
    }
}

impl Config for AssemblerConfig {
    fn faults(&self, _: &Path) -> Vec<ConfigFault> {
        let sphere = fault("sphere", "m", self.sphere.min_m, self.sphere.max_m);
        let axial = [("cylinder", &self.cylinder), ("cone", &self.cone)].into_iter().flat_map(|(key, limits)| {
            let radius = fault(key, "m", limits.min_m, limits.max_m);
            radius.into_iter().chain(fault(key, "length_m", limits.min_length_m, limits.max_length_m))
        });
        let mut faults: Vec<_> = sphere.into_iter().chain(axial).collect();
        faults.extend(self.fault_of_half_angles());
        faults
    }

    fn idle(&self) -> Vec<ConfigFault> {
        let idle = |key, other: &str, needed: &str| ConfigFault {
            key,
            what: format!("has no effect with `{other}`"),
            hint: format!("leave it out, or write `{needed}`"),
        };
        let (pooled, profile) = ("method = \"pooled\"", "method = \"profile\"");
        match (self.method, self.section_fit) {
            (Method::Pooled, _) => OF_PROFILE.iter().map(|key| idle(key, pooled, profile)).collect(),
            (Method::Profile, SectionFit::Circle) => vec![idle("pooled", profile, pooled)],
            (Method::Profile, SectionFit::Ellipse) => {
                let radii = idle("max_rms_radii", "section_fit = \"ellipse\"", "section_fit = \"circle\"");
                vec![idle("pooled", profile, pooled), radii]
            }
        }
    }
}

/// Parameters that `method = "profile"` alone has.
const OF_PROFILE: [&str; 17] = [
    "section_fit",
    "max_center_step_m",
    "max_center_step_radii",
    "neighbors",
    "max_gap_lines",
    "max_center_scatter",
    "max_radius_scatter",
    "min_half_angle_deg",
    "cone_gain",
    "min_rows",
    "min_coverage",
    "min_length_radii",
    "min_sphere_height_radii",
    "min_arc_deg",
    "max_rms_sigmas",
    "max_rms_radii",
    "min_bulge_sigmas",
];

/// What is wrong with the limits `min_UNIT` and `max_UNIT` of a shape.
fn fault(key: &'static str, unit: &str, min: f64, max: f64) -> Option<ConfigFault> {
    (min > max).then(|| ConfigFault {
        key,
        what: format!("min_{unit}, {min}, is more than max_{unit}, {max}"),
        hint: "both are in metres".to_owned(),
    })
}

impl AssemblerConfig {
    /// Half-angles of cones that exclude each other, of the method that is used.
    fn fault_of_half_angles(&self) -> Option<ConfigFault> {
        let (key, least) = match self.method {
            Method::Profile => ("min_half_angle_deg", self.min_half_angle_deg),
            Method::Pooled => ("pooled", self.pooled.min_half_angle_deg),
        };
        let most = self.max_half_angle_deg;
        (least > most).then(|| ConfigFault {
            key,
            what: format!("min_half_angle_deg, {least}, is more than max_half_angle_deg, {most}"),
            hint: "what is steeper than the one and flatter than the other is a cone".to_owned(),
        })
    }

    /// Why an object of this size is not reported.
    pub(super) fn wrong_size(&self, shape: ObjectKind, radius: f64, length: f64) -> Option<Rejection> {
        let axial = match shape {
            ObjectKind::Sphere => {
                let RadiusLimits { min_m, max_m } = self.sphere;
                return (!(min_m..=max_m).contains(&radius)).then_some(Rejection::Radius);
            }
            ObjectKind::Cylinder => &self.cylinder,
            ObjectKind::Cone => &self.cone,
        };
        if !(axial.min_m..=axial.max_m).contains(&radius) {
            return Some(Rejection::Radius);
        }
        (!(axial.min_length_m..=axial.max_length_m).contains(&length)).then_some(Rejection::Length)
    }
}
