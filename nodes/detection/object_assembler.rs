//! Ellipses -> objects: the assembler of the detection, or the paper's, as a stage.

use conicflow_dataflow::ports::Delivery;
use conicflow_dataflow::{ConfigFault, Context, Output, SideInputs, Stage, StageError};
use conicflow_detection::{Assembler, AssemblerParameters};
use conicflow_lab::paper::assembler::{ProfileAssembler, ProfileConfig, ProfileParameters};
use conicflow_messages::{Ellipse, Message, Object};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;

/// Default time budget for one image of a live stage, in milliseconds. Of the 33 ms between images at 30 Hz it leaves three for
/// sending the objects, and for the candidate that is being tried when the budget ends: with `budget_ms = 5`, recordings of
/// 640x480 and 960x540 pixels took up to 6.7 ms (p99 of the summary, in a build for tests).
const LIVE_BUDGET_MS: f64 = 30.0; // [measured]

/// The method that finds objects in a list of ellipses.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Method {
    /// The paper's: lines and circles through the centres, radius over position along the axis.
    Profile,
    /// Models fitted to the pooled moments of all arcs of an object.
    #[default]
    Pooled,
}

/// Parameters of the assembler.
#[derive(Clone, Debug, Default, Deserialize, Serialize, JsonSchema)]
#[serde(default)]
pub struct ObjectAssemblerConfig {
    /// Method that finds objects: by `pooled` moments of arcs (`arcs = "moments"` of the extractor), or by the paper's `profile`
    /// of ellipses (`arcs = "conic"`). The table `pooled` holds for the former, the table `profile` for the latter.
    pub method: Method,
    /// Parameters of both methods.
    #[serde(flatten)]
    pub common: AssemblerParameters,
    /// Parameters of `method = "profile"`.
    pub profile: ProfileParameters,
}

/// The stage.
pub struct ObjectAssembler {
    assembler: AnyAssembler,
    /// Whether the warning about mismatching ellipses was already logged.
    warned: bool,
}

enum AnyAssembler {
    Pooled(Box<Assembler>),
    Profile(Box<ProfileAssembler>),
}

impl Stage for ObjectAssembler {
    const NAME: &'static str = "object_assembler";
    const SUMMARY: &'static str = "Puts ellipses of neighbouring scan lines together to spheres, cylinders and cones";
    type Config = ObjectAssemblerConfig;
    type Input = Ellipse;
    type Output = Object;

    fn faults(config: &Self::Config, _: &Path) -> Vec<ConfigFault> {
        let ObjectAssemblerConfig { method, common, profile } = config;
        let (key, least) = match method {
            Method::Pooled => ("pooled", common.pooled.min_half_angle_deg),
            Method::Profile => ("profile", profile.min_half_angle_deg),
        };
        let mut faults = common.faults();
        faults.extend(common.fault_of_half_angle(key, least));
        faults
    }

    fn new(config: Self::Config, context: &Context) -> Result<Self, StageError> {
        let ObjectAssemblerConfig { method, mut common, profile } = config;
        common.pooled.budget_ms = budget_ms(common.pooled.budget_ms, context.delivery);
        let assembler = match method {
            Method::Pooled => AnyAssembler::Pooled(Box::new(Assembler::new(common))),
            Method::Profile => {
                AnyAssembler::Profile(Box::new(ProfileAssembler::new(ProfileConfig { common, profile })))
            }
        };
        Ok(Self { assembler, warned: false })
    }

    fn step(
        &mut self,
        input: &Message<Ellipse>,
        _: &SideInputs,
        output: &mut Output<Object>,
    ) -> Result<(), StageError> {
        self.warn_of_mismatch(input.items);
        match &mut self.assembler {
            AnyAssembler::Pooled(assembler) => {
                output.extend(assembler.assemble(input.header, input.items));
                output.count_all(assembler.rejections());
            }
            AnyAssembler::Profile(assembler) => {
                output.extend(assembler.assemble(input.header, input.items));
                output.count_all(assembler.rejections());
            }
        }
        Ok(())
    }
}

/// Returns the configured time budget, or the default one of a live stage.
fn budget_ms(given_ms: Option<f64>, delivery: Option<Delivery>) -> Option<f64> {
    given_ms.or((delivery == Some(Delivery::Latest)).then_some(LIVE_BUDGET_MS))
}

impl ObjectAssembler {
    /// Warns once if the ellipses are not those that the method expects.
    fn warn_of_mismatch(&mut self, ellipses: &[Ellipse]) {
        let is_pooled = matches!(self.assembler, AnyAssembler::Pooled(_));
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
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_a_live_stage_has_a_budget_by_default() {
        let deliveries = [Some(Delivery::Latest), Some(Delivery::Lossless), None];
        assert_eq!(deliveries.map(|delivery| budget_ms(None, delivery)), [Some(LIVE_BUDGET_MS), None, None]);
        for given_ms in [0.0, 7.0] {
            assert_eq!(deliveries.map(|delivery| budget_ms(Some(given_ms), delivery)), [Some(given_ms); 3]);
        }
    }

    #[test]
    fn limits_that_exclude_each_other_are_faults() {
        use conicflow_detection::assemble::{AxialLimits, PooledParameters, RadiusLimits};
        let common = AssemblerParameters {
            sphere: RadiusLimits { min_m: 0.5, max_m: 0.1 },
            cone: AxialLimits { min_m: 0.1, max_m: 0.2, min_length_m: 2.0, max_length_m: 1.0 },
            max_half_angle_deg: 20.0,
            pooled: PooledParameters { min_half_angle_deg: 30.0, ..PooledParameters::default() },
            ..AssemblerParameters::default()
        };
        // The smallest half-angle of the chosen method counts, not that of the other.
        for (method, profile_deg, keys) in [
            (Method::Pooled, 5.0, &["sphere", "cone", "pooled"][..]),
            (Method::Profile, 5.0, &["sphere", "cone"]),
            (Method::Profile, 40.0, &["sphere", "cone", "profile"]),
        ] {
            let profile = ProfileParameters { min_half_angle_deg: profile_deg, ..ProfileParameters::default() };
            let config = ObjectAssemblerConfig { method, common: common.clone(), profile };
            let faults = ObjectAssembler::faults(&config, Path::new(""));
            assert!(faults.iter().map(|fault| fault.key).eq(keys.iter().copied()), "{method:?}: {faults:?}");
        }
        assert_eq!(ObjectAssembler::faults(&ObjectAssemblerConfig::default(), Path::new("")), []);
    }
}
