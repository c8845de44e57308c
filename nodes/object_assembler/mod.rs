//! Puts ellipses together to spheres, cylinders and cones.
//!
//! `method = "pooled"` ([`pooled`]): models are fitted to the moments of all arcs of an object at once. `method = "profile"`
//! ([`profile`]): the paper's way, section by section.

mod config;
mod pooled;
mod profile;
mod rejection;
#[cfg(test)]
mod tests;

pub use config::{AssemblerConfig, AxialLimits, Method, RadiusLimits, SectionFit};
pub use pooled::PooledConfig;

use conicflow_dataflow::{Context, Output, Sides, Stage, StageError};
use conicflow_geometry::{ScanPlane, Vector3};
use conicflow_messages::{Ellipse, Header, Message, Object};
use pooled::Pooled;
use profile::Profile;
use rejection::Rejections;

/// Finds the objects in a list of ellipses.
#[derive(Debug)]
pub struct ObjectAssembler {
    config: AssemblerConfig,
    pooled: Pooled,
    profile: Profile,
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
            pooled: Pooled::default(),
            profile: Profile::default(),
            objects: Vec::new(),
            rejections: Rejections::default(),
            warned: false,
        }
    }

    /// The objects that the ellipses of one image form.
    pub fn assemble(&mut self, header: &Header, ellipses: &[Ellipse]) -> &[Object] {
        self.objects.clear();
        self.rejections = Rejections::default();
        let Self { config, pooled, profile, objects, rejections, .. } = self;
        match config.method {
            Method::Pooled => pooled.assemble(header, ellipses, config, objects, rejections),
            Method::Profile => profile.assemble(header, ellipses, config, objects, rejections),
        }
        &self.objects
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

/// Lower bound of the cosine between an axis and the normal of the scan planes: it keeps the spacing along the axis finite.
const MOST_OBLIQUE: f64 = 0.2; // [tuned]
/// Standard deviation of the end of an object, in scan lines: noise and rims take some lines.
const END_LINES: f64 = 1.5; // [tuned]

/// Distance along an axis, in metres, between neighbouring planes of lines, which are `spacing` apart across.
fn spacing_along(spacing: f64, plane: &ScanPlane, axis: &Vector3) -> f64 {
    spacing / axis.dot(&plane.normal()).abs().max(MOST_OBLIQUE)
}

/// Standard deviation of an end along the axis, in metres.
fn end_sigma(spacing: f64, plane: &ScanPlane, axis: &Vector3) -> f64 {
    END_LINES * spacing_along(spacing, plane, axis)
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
