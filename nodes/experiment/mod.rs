//! Experiments: a pipeline file with an `[experiment]` is run once for each combination of the values that it varies, and
//! what its `measurement_sink` and `section_sink` stages found becomes one table, beside the figures of the paper, a CSV file and a plot.

mod axes;
mod columns;
mod plot;
mod spec;
mod table;

pub use columns::check;
pub use spec::{Experiment, Variation};
pub use table::Results;

use crate::measurement_sink::{Figure, Row};
use anyhow::{Context as _, Result};
use conicflow_dataflow::pipeline::{Pipeline, Program};
use conicflow_dataflow::{StageSummary, Summary};
use std::path::{Path, PathBuf};

/// The sinks that leave rows.
const SINKS: [&str; 2] = ["measurement_sink", "section_sink"];

/// Where the sinks of one run leave their rows.
pub struct Rows {
    folder: PathBuf,
    stages: Vec<String>,
}

impl Rows {
    /// Rows of the pipeline's measuring stages, in a folder of their own.
    ///
    /// # Errors
    /// The folder cannot be made.
    pub fn of(pipeline: &Pipeline) -> Result<Self> {
        let folder = std::env::temp_dir().join(format!("conicflow-{}-{}", pipeline.name, std::process::id()));
        std::fs::create_dir_all(&folder).with_context(|| format!("cannot make `{}`", folder.display()))?;
        let measures = |program: &Program| matches!(program, Program::Node(node) if SINKS.contains(&node.name));
        let stages = pipeline.stages.iter().filter(|stage| measures(&stage.program));
        Ok(Self { folder, stages: stages.map(|stage| stage.name.clone()).collect() })
    }

    fn path(&self, stage: &str) -> PathBuf {
        self.folder.join(format!("{stage}.jsonl"))
    }

    /// What has to be set for the sinks to leave them there.
    pub fn overrides(&self) -> impl Iterator<Item = String> {
        self.stages.iter().map(|stage| format!("{stage}.path={:?}", self.path(stage).display().to_string()))
    }

    /// Reads the rows of a run: what was varied, the stage, its figures, and the times of all stages.
    ///
    /// # Errors
    /// A sink left none, or something else.
    pub fn read(&self, variation: &Variation, summary: &Summary) -> Result<Vec<Row>> {
        let mut rows = Vec::new();
        for stage in &self.stages {
            let path = self.path(stage);
            let text = std::fs::read_to_string(&path).with_context(|| format!("the stage `{stage}` left no rows"))?;
            for line in text.lines() {
                let mut row = Row(variation.names.clone());
                row.text("stage", stage);
                row.0.extend(figures(line).with_context(|| format!("the rows of the stage `{stage}`"))?);
                add_times(&mut row, summary);
                rows.push(row);
            }
        }
        Ok(rows)
    }
}

impl Drop for Rows {
    fn drop(&mut self) {
        // what is left in the folder for temporary files harms nobody
        let _ = std::fs::remove_dir_all(&self.folder);
    }
}

fn figures(line: &str) -> Result<Vec<(String, Figure)>> {
    let cells: serde_json::Map<String, serde_json::Value> = serde_json::from_str(line)?;
    cells.into_iter().map(|(column, cell)| Ok((column, serde_json::from_value(cell)?))).collect()
}

/// The median time of each stage's step, and the rate at which messages came through all of them: that of the slowest
/// writer, from its first message to its last.
fn add_times(row: &mut Row, summary: &Summary) {
    let mut longest = f64::NAN;
    for StageSummary { planned, status } in &summary.stages {
        let median = status.as_ref().and_then(|status| status.compute.quantile(0.5));
        row.number(&format!("{}_ms", planned.name), median.map_or(f64::NAN, |time| time.as_secs_f64() * 1e3));
        longest = longest.max(status.as_ref().and_then(|status| status.intervals.mean_s()).unwrap_or(f64::NAN));
    }
    row.number("frames_per_s", 1.0 / longest);
}

/// A path of the pipeline file, whose folder is made where it is missing.
fn prepared(base: &Path, path: &Path) -> Result<PathBuf> {
    let path = base.join(path);
    let made = path.parent().map_or(Ok(()), std::fs::create_dir_all);
    made.with_context(|| format!("cannot make the folder of `{}`", path.display()))?;
    Ok(path)
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_dataflow::pipeline::SourceText;

    #[test]
    fn the_pipeline_files_of_the_experiments_are_valid() {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("experiments");
        let read = |name: &str, overrides: &[String]| {
            let source = SourceText { name: name.into(), text: std::fs::read_to_string(folder.join(name)).unwrap() };
            Pipeline::read(source, &folder, overrides, &crate::REGISTRY)
        };
        assert!(read("detection.toml", &[]).is_ok());
        let size = ["source.width=640", "source.height=480", "source.scenes.groups=[\"tabletop\"]"].map(String::from);
        assert!(read("detection.toml", &size).is_ok());
        for name in ["noise.toml", "recording.toml", "recorded_tracks.toml"] {
            assert!(read(name, &["source.path=\".\"".into()]).is_ok(), "{name}");
            assert!(
                read(name, &[]).err().unwrap().to_string().contains("is missing"),
                "{name} has no frames of its own"
            );
        }
    }
}
