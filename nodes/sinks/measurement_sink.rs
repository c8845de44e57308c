//! Measures what was found of each true object of a rendered scene, by mean and standard deviation, and how well identities were
//! kept. Each object gives one row, of which `conicflow run` makes a table if the pipeline file has an `[experiment]`; else the
//! rows go to standard output. The computation is in [`conicflow_lab::score::measurement`].
//!
//! The tolerances are wide: a radius far off is to be measured, not to be rejected.

use super::json_lines::JsonLines;
use crate::faults::{refuse_restart, stage_error};
use anyhow::Result;
use conicflow_dataflow::{ConfigFault, Context, FileUse, Output, SideInputs, Stage, StageError};
use conicflow_lab::score::truth::load_scene;
use conicflow_lab::score::{Claim, Measurement, RenderedTruth, Row, Tolerances, Trace, VisibilityCriteria};
use conicflow_messages::{Message, Nothing};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::marker::PhantomData;
use std::path::{Path, PathBuf};

/// Parameters of `measurement_sink`.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct MeasurementConfig {
    /// Scene file that the source shows; random and built-in scenes are known by the names in the frames.
    pub scene: Option<PathBuf>,
    /// Criteria for the true objects that are measured: enough of them has to be visible.
    pub required: VisibilityCriteria,
    /// Largest errors of an answer that counts as one about an object.
    pub tolerance: Tolerances,
    /// Frames before this time are left out, for a filter to settle, in seconds; of recorded frames since the first.
    #[schemars(range(min = 0.0))]
    pub from_s: f64,
    /// File for the rows, as lines of JSON; none: standard output.
    pub path: Option<PathBuf>,
    /// File for the observations in each frame, as CSV, world frame; none: not written.
    pub trace_path: Option<PathBuf>,
}

impl Default for MeasurementConfig {
    fn default() -> Self {
        Self {
            scene: None,
            required: VisibilityCriteria {
                max_hidden: 0.95,
                min_extent_px: 4,
                min_arc_deg: 5.0,
                min_view_angle_deg: 10.0,
            },
            tolerance: Tolerances { position_m: 0.3, radius: 0.8, axis_deg: 30.0, half_angle_deg: 15.0 },
            from_s: 0.0,
            path: None,
            trace_path: None,
        }
    }
}

/// The stage around a [`Measurement`].
pub struct MeasurementSink<T> {
    measurement: Measurement,
    trace: Option<Trace>,
    path: Option<PathBuf>,
    items: PhantomData<T>,
}

impl<T: Claim> Stage for MeasurementSink<T> {
    const NAME: &'static str = "measurement_sink";
    const SUMMARY: &'static str =
        "Measures objects or confirmed tracks against the rendered truth: mean, standard deviation, identities";
    type Config = MeasurementConfig;
    type Input = T;
    type Output = Nothing;

    fn faults(config: &Self::Config, base: &Path) -> Vec<ConfigFault> {
        let scene = config.scene.as_ref().and_then(|path| load_scene(&base.join(path)).err());
        scene.map(|error| ConfigFault::of_file("scene", error.as_ref())).into_iter().collect()
    }

    fn reads(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        FileUse::given(base, [("scene", &config.scene)])
    }

    fn writes(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        FileUse::given(base, [("path", &config.path), ("trace_path", &config.trace_path)])
    }

    fn new(config: MeasurementConfig, context: &Context) -> Result<Self, StageError> {
        refuse_restart(context, "measured")?;
        let scene = config.scene.as_ref().map(|path| load_scene(&context.resolve(path))).transpose()?;
        let truth = RenderedTruth { scene, required: config.required, tolerance: config.tolerance };
        let trace = config.trace_path.as_ref().map(|path| Trace::create(&context.resolve(path))).transpose()?;
        let path = config.path.as_ref().map(|path| context.resolve(path));
        let measurement = Measurement::new(truth, config.from_s);
        Ok(Self { measurement, trace, path, items: PhantomData })
    }

    fn step(&mut self, input: &Message<T>, _: &SideInputs, output: &mut Output<Nothing>) -> Result<(), StageError> {
        let answers: Vec<_> = input.items.iter().filter_map(Claim::answer).collect();
        let observations = self.measurement.add(input.header, &answers).map_err(stage_error)?;
        output.count("missed", observations.iter().filter(|observation| observation.seen.is_none()).count() as u64);
        if let Some(trace) = &mut self.trace {
            trace.write(&observations)?;
        }
        Ok(())
    }

    fn finish(&mut self) -> Result<(), StageError> {
        if let Some(trace) = &mut self.trace {
            trace.flush()?;
        }
        Ok(write_rows(self.path.as_deref(), &self.measurement.rows())?)
    }
}

/// Writes rows as lines of JSON, to standard output if there is no path.
pub(super) fn write_rows(path: Option<&Path>, rows: &[Row]) -> Result<()> {
    let mut lines = match path {
        Some(path) => JsonLines::open(path, false)?,
        None => JsonLines::standard_output(),
    };
    lines.begin()?;
    for row in rows {
        lines.write(row)?;
    }
    Ok(())
}
