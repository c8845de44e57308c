//! Runs experiments: a pipeline file with an `[experiment]` runs once for each combination of the varied values, and the rows of
//! its measuring sinks become one table.

use anyhow::{Context as _, Result, bail, ensure};
use conicflow_dataflow::pipeline::{Pipeline, Program};
use conicflow_dataflow::{FileUse, StageSummary, Summary, Table};
use conicflow_lab::experiment::{Experiment, Results, Variation};
use conicflow_lab::score::{Figure, Row, Sections, limit, measured_columns, summary};
use conicflow_messages::Hinted;
use indexmap::IndexSet;
use std::path::PathBuf;
use tempfile::TempDir;

/// Name of a sink that writes rows, and the function that returns their columns.
type RowSink = (&'static str, fn() -> Vec<&'static str>);

const SINKS: [RowSink; 4] = [
    ("measurement_sink", || measured_columns().collect()),
    ("section_sink", || Sections::columns().collect()),
    ("evaluation_sink", || summary::columns().collect()),
    ("limit_sink", || limit::columns().collect()),
];

/// Returns the columns of the rows that a stage writes, if it writes some.
fn columns_of(program: &Program) -> Option<Vec<&'static str>> {
    let Program::Node(node) = program else { return None };
    SINKS.iter().find(|(name, _)| *name == node.name).map(|(_, columns)| columns())
}

/// Refuses columns that no row has or that are there twice, experiments without a stage that writes rows, and a table or plot
/// over an input file.
///
/// # Errors
/// The experiment is refused. The error names the key of a wrong column and the possible columns, or the wrong file.
pub fn check(experiment: &Experiment, pipeline: &Pipeline) -> Result<()> {
    let plot = experiment.plot.as_ref().map(|plot| plot.path.clone());
    for files in FileUse::given(&pipeline.base, [("csv", &experiment.csv), ("plot.path", &plot)]) {
        let over = pipeline.over_what_it_reads(&files, &format!("`{}` of the experiment", files.key));
        over.map_or(Ok(()), Err)?;
    }
    experiment.check_columns(&columns(experiment, pipeline)?)
}

/// Returns all columns: the varied values, the figures of the sinks, and the times of all stages.
fn columns(experiment: &Experiment, pipeline: &Pipeline) -> Result<Vec<String>> {
    let measured: Vec<_> = pipeline.stages.iter().filter_map(|stage| columns_of(&stage.program)).flatten().collect();
    ensure!(
        !measured.is_empty(),
        Hinted::new(
            "the experiment has no stage that leaves rows for its table",
            "measure with a `measurement_sink`, a `section_sink`, an `evaluation_sink` or a `limit_sink`"
        )
    );
    let times = pipeline.stages.iter().map(|stage| format!("{}_ms", stage.name));
    let fixed = ["stage"].into_iter().chain(measured).chain(["frames_per_s"]).map(str::to_owned);
    let found: IndexSet<_> = fixed.chain(times).collect();
    let varied: Vec<_> = experiment.vary.iter().map(|vary| vary.name.clone()).collect();
    if let Some(taken) = varied.iter().find(|name| found.contains(*name)) {
        bail!(Hinted::new(
            format!("`vary` has the name `{taken}`, as a column has that is measured"),
            "give what is varied another name"
        ));
    }
    Ok(varied.into_iter().chain(found).collect())
}

/// Returns the tables that are printed.
pub fn tables(experiment: &Experiment, results: &Results) -> String {
    let below = results.spread().into_iter().chain(results.sums()).map(|table| format!("\n{}", laid_out(table)));
    format!("{}\n\n{}{}", experiment.title, laid_out(results.table()), below.collect::<String>())
}

fn laid_out((titles, rows): (Vec<String>, Vec<Vec<String>>)) -> Table {
    let mut table = Table::new(&titles.iter().map(String::as_str).collect::<Vec<_>>());
    rows.into_iter().for_each(|row| table.row(row.into_iter()));
    table
}

/// The rows of one run, which its sinks write into a temporary folder.
pub struct Rows {
    folder: TempDir,
    stages: Vec<String>,
}

impl Rows {
    /// Creates a folder for the rows of the pipeline's measuring stages.
    ///
    /// # Errors
    /// The folder cannot be created.
    pub fn of(pipeline: &Pipeline) -> Result<Self> {
        let folder = tempfile::tempdir().context("cannot make a temporary folder")?;
        let stages = pipeline.stages.iter().filter(|stage| columns_of(&stage.program).is_some());
        Ok(Self { folder, stages: stages.map(|stage| stage.name.clone()).collect() })
    }

    fn path(&self, stage: &str) -> PathBuf {
        self.folder.path().join(format!("{stage}.jsonl"))
    }

    /// Returns the parameters that make the sinks write their rows there.
    pub fn overrides(&self) -> impl Iterator<Item = String> {
        self.stages.iter().map(|stage| format!("{stage}.path={:?}", self.path(stage).display().to_string()))
    }

    /// Reads the rows of a run: the varied values, the stage, its figures, and the times of all stages.
    ///
    /// # Errors
    /// A sink has written no rows, or they cannot be parsed.
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

fn figures(line: &str) -> Result<Vec<(String, Figure)>> {
    let cells: serde_json::Map<String, serde_json::Value> = serde_json::from_str(line)?;
    cells.into_iter().map(|(column, cell)| Ok((column, serde_json::from_value(cell)?))).collect()
}

/// Adds the median time of each stage's step, and the message rate of the whole pipeline: that of the slowest writer, from its
/// first message to its last.
fn add_times(row: &mut Row, summary: &Summary) {
    let mut longest = f64::NAN;
    for StageSummary { planned, status } in &summary.stages {
        let median = status.as_ref().and_then(|status| status.compute.quantile(0.5));
        row.number(&format!("{}_ms", planned.name), median.map_or(f64::NAN, |time| time.as_secs_f64() * 1e3));
        longest = longest.max(status.as_ref().and_then(|status| status.intervals.mean_s()).unwrap_or(f64::NAN));
    }
    row.number("frames_per_s", 1.0 / longest);
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_dataflow::pipeline::SourceText;
    use std::path::Path;

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
        for name in ["noise.toml", "recording.toml", "flipped_recording.toml", "recorded_tracks.toml"] {
            assert!(read(name, &["source.path=\".\"".into()]).is_ok(), "{name}");
            assert!(
                read(name, &[]).err().unwrap().to_string().contains("is missing"),
                "{name} has no frames of its own"
            );
        }
    }

    fn checked(name: &str, replaced: (&str, &str)) -> Result<()> {
        let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("experiments");
        let text = std::fs::read_to_string(folder.join(name)).unwrap().replace(replaced.0, replaced.1);
        let source = SourceText { name: name.into(), text };
        let (pipeline, _) = Pipeline::read(source, &folder, &[], &crate::REGISTRY).unwrap();
        check(&Experiment::read(pipeline.experiment.as_ref().unwrap()).unwrap(), &pipeline)
    }

    #[test]
    fn the_columns_of_the_experiments_are_known() {
        for name in [
            "accuracy",
            "basic",
            "bouncing_ball",
            "cost",
            "crossing_balls",
            "ellipse_noise",
            "follow",
            "limit",
            "occlusion",
            "ransac",
        ] {
            checked(&format!("{name}.toml"), ("", "")).unwrap_or_else(|error| panic!("{name}: {error}"));
        }
    }

    #[test]
    fn a_column_that_is_not_known_is_refused_with_those_that_are() {
        for (name, replaced, expected) in [
            ("accuracy.toml", ("\"radius_sd_m\"]", "\"radius_std_m\"]"), "columns`: there is no column `radius_std_m`"),
            ("accuracy.toml", ("x = \"distance\"", "x = \"distanse\""), "plot.x`: there is no column `distanse`"),
            ("follow.toml", ("x = \"time_s\"", "x = \"n\""), "plot.x`: there is no column `n`"),
            ("cost.toml", ("[\"extractor_ms\", \"assembler_ms\"]", "[\"extract_ms\"]"), "no column `extract_ms`"),
        ] {
            let error = checked(name, replaced).unwrap_err().to_string();
            assert!(error.contains(expected) && error.contains("\n  hint: columns: `"), "{error}");
        }
        let section =
            "\"section_sink\"\ninput  = { topic = \"ellipses\", delivery = \"lossless\" }\ncenter = [0.0, 2.0]";
        let json = "\"json_sink\"\ninput  = { topic = \"ellipses\", delivery = \"lossless\" }";
        let error = checked("ellipse_noise.toml", (section, json)).unwrap_err().to_string();
        assert!(error.starts_with("the experiment has no stage that leaves rows"), "{error}");
    }
}
