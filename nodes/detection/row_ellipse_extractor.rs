//! Depth images -> ellipses: the extractor of the detection, or the paper's, as a stage.

use conicflow_dataflow::{ConfigFault, Context, Output, SideInputs, Stage, StageError};
use conicflow_detection::{Extractor, ExtractorParameters};
use conicflow_lab::paper::extractor::{ConicConfig, ConicExtractor, ConicParameters};
use conicflow_messages::{Ellipse, Message};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::ops::RangeInclusive;
use std::path::Path;

/// The method that cuts a scan line into arcs.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum ArcFinder {
    /// The paper's way: an ellipse grows point by point.
    Conic,
    /// Lines and circles through moments that are free of the noise's bias, for the pooled fits of the assembler.
    #[default]
    Moments,
}

/// Parameters of the extractor.
#[derive(Clone, Debug, Default, Deserialize, Serialize, JsonSchema)]
#[serde(default)]
pub struct RowEllipseConfig {
    /// Method that cuts a scan line into arcs: `moments`, for `method = "pooled"` of the assembler, or `conic`, the paper's way.
    /// With `conic` the limits of the radius are those of the semi-axes of ellipses, and no point is put back.
    pub arcs: ArcFinder,
    /// Parameters of both methods.
    #[serde(flatten)]
    pub common: ExtractorParameters,
    /// Parameters of `arcs = "conic"`.
    pub conic: ConicParameters,
}

/// Ratios of an image's standard deviation to that of its noise model for which there is no warning.
const USUAL_RATIOS: RangeInclusive<f64> = 0.32..=1.41;

/// The stage.
pub struct RowEllipseExtractor {
    extractor: AnyExtractor,
    /// Whether the warning about the noise model was already logged.
    warned: bool,
}

enum AnyExtractor {
    Moments(Box<Extractor>),
    Conic(Box<ConicExtractor>),
}

impl Stage for RowEllipseExtractor {
    const NAME: &'static str = "row_ellipse_extractor";
    const SUMMARY: &'static str = "Finds ellipses in the scan lines of a depth image, with the moments of their points";
    type Config = RowEllipseConfig;
    type Input = u16;
    type Output = Ellipse;

    fn faults(config: &Self::Config, _: &Path) -> Vec<ConfigFault> {
        config.common.faults()
    }

    fn new(config: Self::Config, _: &Context) -> Result<Self, StageError> {
        let RowEllipseConfig { arcs, common, conic } = config;
        let extractor = match arcs {
            ArcFinder::Moments => AnyExtractor::Moments(Box::new(Extractor::new(common))),
            ArcFinder::Conic => AnyExtractor::Conic(Box::new(ConicExtractor::new(ConicConfig { common, conic }))),
        };
        Ok(Self { extractor, warned: false })
    }

    fn step(&mut self, input: &Message<u16>, _: &SideInputs, output: &mut Output<Ellipse>) -> Result<(), StageError> {
        match &mut self.extractor {
            AnyExtractor::Moments(extractor) => {
                output.extend(extractor.extract(input.header, input.items));
                output.count_all(extractor.rejections());
                let ratios = extractor.noise_ratios();
                self.warn_of_noise(ratios);
            }
            AnyExtractor::Conic(extractor) => {
                output.extend(extractor.extract(input.header, input.items));
                output.count_all(extractor.rejections());
            }
        }
        Ok(())
    }
}

impl RowEllipseExtractor {
    /// Warns once if the noise model does not match the images.
    fn warn_of_noise(&mut self, [near, far]: [f64; 2]) {
        if self.warned || (USUAL_RATIOS.contains(&near) && USUAL_RATIOS.contains(&far)) {
            return;
        }
        self.warned = true;
        tracing::warn!(
            "what is near is {near:.1} and what is far {far:.1} times as noisy as the source's noise model says: it is \
             taken as it is, but less will be found\n  hint: find the sensor's own coefficients with the node \
             `noise_estimator`, and write them into the source's `noise`"
        );
    }
}
