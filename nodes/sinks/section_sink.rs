//! Measures ellipses against one true section: how often it was found, and mean and standard deviation of its semi-axes
//! ([`Sections`]). Its row is one of an `[experiment]`, like those of `measurement_sink`.

use super::measurement_sink::write_rows;
use crate::faults::refuse_restart;
use conicflow_dataflow::{Context, FileUse, Output, SideInputs, Stage, StageError};
use conicflow_lab::score::Sections;
use conicflow_messages::{Ellipse, Message, Nothing};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Parameters of `section_sink`.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SectionConfig {
    /// Centre of the true section in the plane of its scan line: across the view and away from the camera, in metres.
    pub center: [f64; 2],
    /// Distance of the centres up to which an ellipse is about that section, in metres.
    #[schemars(range(min = 0.0))]
    pub max_offset_m: f64,
    /// File for the row, as a line of JSON; none: standard output.
    pub path: Option<PathBuf>,
}

impl Default for SectionConfig {
    fn default() -> Self {
        Self { center: [0.0, 2.0], max_offset_m: 0.25, path: None }
    }
}

/// The stage around [`Sections`].
pub struct SectionSink {
    sections: Sections,
    path: Option<PathBuf>,
}

impl Stage for SectionSink {
    const NAME: &'static str = "section_sink";
    const SUMMARY: &'static str = "Measures ellipses against one true section: found, semi-axes, their deviations";
    type Config = SectionConfig;
    type Input = Ellipse;
    type Output = Nothing;

    fn writes(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        FileUse::given(base, [("path", &config.path)])
    }

    fn new(config: SectionConfig, context: &Context) -> Result<Self, StageError> {
        refuse_restart(context, "measured")?;
        let path = config.path.as_ref().map(|path| context.resolve(path));
        Ok(Self { sections: Sections::new(config.center, config.max_offset_m), path })
    }

    fn step(&mut self, input: &Message<Ellipse>, _: &SideInputs, _: &mut Output<Nothing>) -> Result<(), StageError> {
        self.sections.add(input.items);
        Ok(())
    }

    fn finish(&mut self) -> Result<(), StageError> {
        Ok(write_rows(self.path.as_deref(), &[self.sections.row()])?)
    }
}
