//! Compares a detector with what is possible at all: its scatter with the Cramer-Rao bounds. Each quantity of each object gives
//! one row of an `[experiment]`. The computation is in [`conicflow_lab::score::limit`].

use super::measurement_sink::write_rows;
use crate::faults::{refuse_restart, stage_error};
use conicflow_dataflow::{ConfigFault, Context, FileUse, Output, SideInputs, Stage, StageError};
use conicflow_lab::score::truth::load_scene;
use conicflow_lab::score::{Claim, Limit, RenderedTruth, Tolerances};
use conicflow_messages::{Message, Nothing, Object};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Parameters of `limit_sink`.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct LimitConfig {
    /// Scene file that the source shows, in which nothing moves; random and built-in scenes are known by the names in the frames.
    pub scene: Option<PathBuf>,
    /// Largest errors of a right answer.
    pub tolerance: Tolerances,
    /// Angle between ray and normal from which on the sensor loses points, in degrees: that of the source's noise.
    #[schemars(range(min = 0.0, max = 90.0))]
    pub dropout_angle_deg: f64,
    /// Standard deviation of a silhouette's position, in pixels: that of the source's noise.
    #[schemars(range(min = 0.0, max = 8.0))]
    pub edge_jitter_px: f64,
    /// File for the rows, as lines of JSON; none: standard output.
    pub path: Option<PathBuf>,
}

impl Default for LimitConfig {
    /// The values of the simulated Kinect v1.
    fn default() -> Self {
        Self { scene: None, tolerance: Tolerances::default(), dropout_angle_deg: 70.0, edge_jitter_px: 0.5, path: None }
    }
}

/// The stage around a [`Limit`].
pub struct LimitSink {
    limit: Limit,
    path: Option<PathBuf>,
}

impl Stage for LimitSink {
    const NAME: &'static str = "limit_sink";
    const SUMMARY: &'static str = "Measures how near objects come to the least scatter that is possible";
    type Config = LimitConfig;
    type Input = Object;
    type Output = Nothing;

    fn faults(config: &Self::Config, base: &Path) -> Vec<ConfigFault> {
        let scene = config.scene.as_ref().and_then(|path| load_scene(&base.join(path)).err());
        scene.map(|error| ConfigFault::of_file("scene", error.as_ref())).into_iter().collect()
    }

    fn reads(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        FileUse::given(base, [("scene", &config.scene)])
    }

    fn writes(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        FileUse::given(base, [("path", &config.path)])
    }

    fn new(config: LimitConfig, context: &Context) -> Result<Self, StageError> {
        refuse_restart(context, "measured")?;
        let scene = config.scene.as_ref().map(|path| load_scene(&context.resolve(path))).transpose()?;
        let truth = RenderedTruth { scene, tolerance: config.tolerance, ..RenderedTruth::default() };
        let limit = Limit::new(truth, config.dropout_angle_deg.to_radians(), config.edge_jitter_px);
        let path = config.path.as_ref().map(|path| context.resolve(path));
        Ok(Self { limit, path })
    }

    fn step(
        &mut self,
        input: &Message<Object>,
        _: &SideInputs,
        output: &mut Output<Nothing>,
    ) -> Result<(), StageError> {
        let answers: Vec<_> = input.items.iter().filter_map(Claim::answer).collect();
        output.count("missed", self.limit.add(input.header, &answers).map_err(stage_error)?);
        Ok(())
    }

    fn finish(&mut self) -> Result<(), StageError> {
        Ok(write_rows(self.path.as_deref(), &self.limit.rows())?)
    }
}
