//! Puts ellipses together to spheres, cylinders and cones.
//!
//! `method = "pooled"` ([`pooled`]): models are fitted to the moments of all arcs of an object at once.
//!
//! The paper's way (`method = "profile"`): ellipses of neighbouring scan lines with near centres form chains
//! ([`chains`]); along a chain the centres have to stay on a line or a circle and the radii on a straight or a circular
//! profile, else the object ends and a new one begins ([`sequence`]); what held together is fitted as a cylinder, a cone
//! ([`axial`]) or a sphere ([`spherical`]) and verified against the points, of which the ellipses carry the moments
//! ([`verify`]). No point is seen again.

mod axial;
mod chains;
mod pooled;
mod sections;
mod sequence;
mod spherical;
#[cfg(test)]
mod tests;
mod verify;

use chains::Chains;
use conicflow_dataflow::{Config, ConfigFault, Context, Output, Sides, Stage, StageError};
use conicflow_messages::{Ellipse, Header, Message, NoiseModel, Object, ObjectKind};
pub use pooled::PooledConfig;

use pooled::Pooled;
use schemars::JsonSchema;
use sections::Section;
use sequence::Sequences;
use serde::{Deserialize, Serialize};
use std::ops::Range;
use std::path::Path;
use verify::{Body, Candidate, Rejection, Rejections, Solid};

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
    /// Largest number of scan lines between neighbours.
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
    /// Largest half-angle of a cone, in degrees.
    #[schemars(range(min = 0.0, max = 80.0))]
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
    /// ... plus this many radii, for the error of the paper's radius.
    #[schemars(range(min = 0.0, max = 0.5))]
    pub max_rms_radii: f64,
    /// Least root mean square distance of the points of a section from a straight line, in standard deviations of the
    /// sensor: a flatter one may be a plane.
    #[schemars(range(min = 0.0, max = 20.0))]
    pub min_bulge_sigmas: f64,
    /// Parameters of `method = "pooled"`; those above, `method` and half-angles aside, are about `profile`.
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
        Self { method: Method::Profile, ..Self::default() }
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
        if self.min_half_angle_deg > self.max_half_angle_deg {
            faults.push(ConfigFault {
                key: "min_half_angle_deg",
                what: format!(
                    "{} is more than max_half_angle_deg, {}",
                    self.min_half_angle_deg, self.max_half_angle_deg
                ),
                hint: "what is steeper than the one and flatter than the other is a cone".to_owned(),
            });
        }
        faults
    }
}

/// What is wrong with the limits `min_UNIT` and `max_UNIT` of a shape.
fn fault(key: &'static str, unit: &str, min: f64, max: f64) -> Option<ConfigFault> {
    (min > max).then(|| ConfigFault {
        key,
        what: format!("min_{unit}, {min}, is more than max_{unit}, {max}"),
        hint: "both are in metres".to_owned(),
    })
}

impl AssemblerConfig {
    /// Why an object of this size is not reported.
    fn wrong_size(&self, shape: ObjectKind, radius: f64, length: f64) -> Option<Rejection> {
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

/// Finds the objects in a list of ellipses.
#[derive(Debug)]
pub struct ObjectAssembler {
    config: AssemblerConfig,
    sections: Vec<Section>,
    chains: Chains,
    sequences: Sequences,
    pooled: Pooled,
    inliers: Vec<usize>,
    objects: Vec<Object>,
    rejections: Rejections,
    /// Whether it was said that the ellipses are not those that the method is made for.
    warned: bool,
}

impl ObjectAssembler {
    /// An assembler with these parameters.
    pub fn with(config: AssemblerConfig) -> Self {
        Self {
            config,
            sections: Vec::new(),
            chains: Chains::default(),
            sequences: Sequences::default(),
            pooled: Pooled::default(),
            inliers: Vec::new(),
            objects: Vec::new(),
            rejections: Rejections::default(),
            warned: false,
        }
    }

    /// The objects that the ellipses of one image form.
    pub fn assemble(&mut self, header: &Header, ellipses: &[Ellipse]) -> &[Object] {
        self.objects.clear();
        self.rejections = Rejections::default();
        match self.config.method {
            Method::Pooled => {
                let (objects, rejections) = (&mut self.objects, &mut self.rejections);
                self.pooled.assemble(header, ellipses, &self.config, objects, rejections);
            }
            Method::Profile => self.by_profile(header, ellipses),
        }
        &self.objects
    }

    fn by_profile(&mut self, header: &Header, ellipses: &[Ellipse]) {
        sections::read(header, ellipses, self.config.section_fit, &mut self.sections);
        self.chains.link(&self.sections, &self.config);
        for chain in self.chains.iter() {
            self.sequences.split(&self.sections, chain, &self.config);
            for members in self.sequences.iter() {
                let search = Search { sections: &self.sections, noise: &header.noise, config: &self.config };
                search.run(members, &mut self.inliers, &mut self.objects, &mut self.rejections);
            }
        }
        verify::drop_doubles(&mut self.objects, &mut self.rejections);
    }

    /// Says once that the ellipses are of the other kind than the method is made for.
    fn warn_of_mismatch(&mut self, ellipses: &[Ellipse]) {
        let is_pooled = self.config.method == Method::Pooled;
        if self.warned || ellipses.iter().all(|ellipse| (ellipse.unbiased == 1) == is_pooled) {
            return;
        }
        self.warned = true;
        let (method, arcs) = if is_pooled { ("pooled", "moments") } else { ("profile", "conic") };
        tracing::warn!(
            "the ellipses are not made for `method = \"{method}\"`: fewer objects will be found, and with larger errors\n  \
             hint: write `arcs = \"{arcs}\"` in the extractor's table"
        );
    }

    /// Why candidates of the last image were turned down, and how many of them.
    pub fn rejections(&self) -> impl Iterator<Item = (&'static str, u64)> {
        self.rejections.iter()
    }
}

/// What is the same for all sequences of an image.
struct Search<'a> {
    sections: &'a [Section],
    noise: &'a NoiseModel,
    config: &'a AssemblerConfig,
}

impl Search<'_> {
    /// Adds the objects of a sequence: what lies before and after one is looked at again.
    fn run(&self, members: &[usize], inliers: &mut Vec<usize>, objects: &mut Vec<Object>, rejections: &mut Rejections) {
        let candidate = Candidate::new(self.sections, members, self.noise, self.config);
        match candidate.and_then(|candidate| object(&candidate, inliers)) {
            Ok((object, range)) => {
                objects.push(object);
                for rest in [&members[..range.start], &members[range.end..]] {
                    if rest.len() >= self.config.min_rows as usize {
                        self.run(rest, inliers, objects, rejections);
                    }
                }
            }
            Err(reason) => rejections.count(reason),
        }
    }
}

/// Parts of a sequence that a fit starts from, where the whole is spoilt by its ends: a rim, a foot on the floor.
const SEEDS: [(f64, f64); 4] = [(0.0, 1.0), (0.25, 0.75), (0.0, 0.5), (0.5, 1.0)];

/// The first object that a sequence of sections forms, and where in the sequence, or why it forms none.
///
/// The first seed that forms one is fitted again with all sections around it that it explains; `inliers` is a buffer for
/// them.
fn object(candidate: &Candidate, inliers: &mut Vec<usize>) -> Result<(Object, Range<usize>), Rejection> {
    let mut whole = None;
    for (from, to) in SEEDS {
        let seed = candidate.part(from, to);
        match candidate.only(seed.clone()).and_then(|seed| best(&seed)) {
            Ok((object, solid)) => {
                let range = candidate.inliers(&solid, object.rms, seed, inliers);
                let refined = candidate.with(inliers).and_then(|all| best(&all));
                return Ok((refined.map_or(object, |(refined, _)| refined), range));
            }
            Err(reason) => whole = whole.or(Some(reason)),
        }
    }
    Err(whole.unwrap_or(Rejection::Degenerate))
}

/// The shape that explains the points best, among those that explain them at all.
///
/// A cone has one parameter more than a cylinder: it has to explain the points clearly better than the others.
fn best(candidate: &Candidate) -> Result<(Object, Solid), Rejection> {
    let verified = |body: Body| candidate.verify(&body).map(|object| (object, body.solid));
    let cylinder = axial::fit_cylinder(candidate).and_then(verified);
    let sphere = spherical::fit(candidate).and_then(verified);
    let cone = axial::fit_cone(candidate).and_then(verified);
    better(better(cylinder, sphere, 1.0), cone, candidate.config.cone_gain)
}

/// The second of two where its residual is less than `gain` times that of the first, or the first is none.
fn better<T>(
    first: Result<(Object, T), Rejection>,
    second: Result<(Object, T), Rejection>,
    gain: f64,
) -> Result<(Object, T), Rejection> {
    match (first, second) {
        (Ok(first), Ok(second)) => Ok(if second.0.rms < gain * first.0.rms { second } else { first }),
        (first, second) => first.or_else(|reason| second.map_err(|_| reason)),
    }
}

impl Stage for ObjectAssembler {
    const NAME: &'static str = "object_assembler";
    const SUMMARY: &'static str = "Puts ellipses of neighbouring scan lines together to spheres, cylinders and cones";
    type Config = AssemblerConfig;
    type Input = Ellipse;
    type Output = Object;

    fn new(config: Self::Config, _: &Context) -> Result<Self, StageError> {
        Ok(Self::with(config))
    }

    fn step(&mut self, input: &Message<Ellipse>, _: &Sides, output: &mut Output<Object>) -> Result<(), StageError> {
        self.warn_of_mismatch(input.items);
        self.assemble(input.header, input.items);
        self.objects.iter().for_each(|&object| output.push(object));
        self.rejections.iter().for_each(|(reason, times)| output.count(reason, times));
        Ok(())
    }
}
