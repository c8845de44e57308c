//! The columns that an experiment's table can have: a misspelt one is refused before anything runs.

use super::SINKS;
use super::spec::Experiment;
use crate::measurement_sink::{MEASURED, SECTION, TRACED};
use anyhow::{Result, bail, ensure};
use conicflow_dataflow::pipeline::{Pipeline, Program};

/// Refuses columns that no row will have, and an experiment without a stage that leaves rows.
///
/// # Errors
/// The key that names such a column, with those that there are.
pub fn check(experiment: &Experiment, pipeline: &Pipeline) -> Result<()> {
    let known = known(experiment, pipeline)?;
    let Experiment { columns, paper, plot, exponent, .. } = experiment;
    look("columns", columns, &known)?;
    if let Some(paper) = paper {
        look("paper.match", &paper.r#match, &known)?;
        look("paper.columns", &paper.columns, &known)?;
    }
    if let Some(exponent) = exponent {
        look("exponent.x", [&exponent.x], &known)?;
        look("exponent.y", &exponent.y, &known)?;
    }
    let Some(plot) = plot else { return Ok(()) };
    let traced = TRACED.split(',').map(str::to_owned).collect();
    let drawn = if plot.trace.is_some() { &traced } else { &known };
    look("plot.x", [&plot.x], drawn)?;
    look("plot.y", &plot.y, drawn)?;
    look("plot.lines", &plot.lines, drawn)?;
    look("plot.only", plot.only.keys(), &known)
}

/// What is varied, what the sinks leave, and the times of all stages.
fn known(experiment: &Experiment, pipeline: &Pipeline) -> Result<Vec<String>> {
    let of_sink = |program: &Program| match program {
        Program::Node(node) if node.name == SINKS[0] => MEASURED.as_slice(),
        Program::Node(node) if node.name == SINKS[1] => SECTION.as_slice(),
        _ => &[],
    };
    let measured: Vec<&str> = pipeline.stages.iter().flat_map(|stage| of_sink(&stage.program)).copied().collect();
    ensure!(
        !measured.is_empty(),
        "the experiment has no stage that leaves rows for its table\n  hint: measure with a `measurement_sink` or a \
         `section_sink`; an `evaluation_sink` prints its own tables, without `[experiment]`"
    );
    let varied = experiment.vary.iter().map(|vary| vary.name.clone());
    let times = pipeline.stages.iter().map(|stage| format!("{}_ms", stage.name));
    let fixed = ["stage"].into_iter().chain(measured).chain(["frames_per_s"]).map(str::to_owned);
    let mut known: Vec<String> = Vec::new();
    for column in varied.chain(fixed).chain(times) {
        if !known.contains(&column) {
            known.push(column);
        }
    }
    Ok(known)
}

fn look<'a>(key: &str, columns: impl IntoIterator<Item = &'a String>, known: &[String]) -> Result<()> {
    for column in columns {
        if !known.contains(column) {
            let known: Vec<_> = known.iter().map(|column| format!("`{column}`")).collect();
            bail!("`experiment.{key}`: there is no column `{column}`\n  hint: columns: {}", known.join(", "));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_dataflow::pipeline::SourceText;
    use std::path::Path;

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
            "occlusion",
            "ransac",
        ] {
            checked(&format!("{name}.toml"), ("", "")).unwrap_or_else(|error| panic!("{name}: {error}"));
        }
    }

    #[test]
    fn a_column_that_is_not_known_is_refused_with_those_that_are() {
        for (name, replaced, told) in [
            ("accuracy.toml", ("\"radius_sd_m\"]", "\"radius_std_m\"]"), "columns`: there is no column `radius_std_m`"),
            ("accuracy.toml", ("x = \"distance\"", "x = \"distanse\""), "plot.x`: there is no column `distanse`"),
            ("follow.toml", ("x = \"time_s\"", "x = \"n\""), "plot.x`: there is no column `n`"),
            ("cost.toml", ("[\"extractor_ms\", \"assembler_ms\"]", "[\"extract_ms\"]"), "no column `extract_ms`"),
        ] {
            let error = checked(name, replaced).unwrap_err().to_string();
            assert!(error.contains(told) && error.contains("\n  hint: columns: `"), "{error}");
        }
        let section =
            "\"section_sink\"\ninput  = { topic = \"ellipses\", delivery = \"lossless\" }\ncenter = [0.0, 2.0]";
        let json = "\"json_sink\"\ninput  = { topic = \"ellipses\", delivery = \"lossless\" }";
        let error = checked("ellipse_noise.toml", (section, json)).unwrap_err().to_string();
        assert!(error.starts_with("the experiment has no stage that leaves rows"), "{error}");
    }
}
