//! The table `[experiment]` of a pipeline file, and the combinations of values that it varies.

use super::output_file;
use crate::score::trace::TITLES;
use crate::score::{Figure, Row};
use anyhow::{Context as _, Result, bail, ensure};
use conicflow_messages::Hinted;
use serde::Deserialize;
use serde_json::Value as Json;
use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};

/// An experiment.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Experiment {
    /// Title of the table; that of the plot ends at the first semicolon.
    pub title: String,
    /// The columns that are shown, after those that identify a row.
    pub columns: Vec<String>,
    /// The true objects whose rows are shown; none: all.
    pub objects: Vec<String>,
    /// The varied parameters; the first one changes slowest.
    pub vary: Vec<Vary>,
    /// The figures that the paper reports.
    pub paper: Option<Reference>,
    /// File for all columns of all rows.
    pub csv: Option<PathBuf>,
    /// The plot to draw.
    pub plot: Option<Plot>,
    /// The exponents of power laws between columns.
    pub exponent: Option<Exponent>,
    /// Columns whose least, median and greatest figures are printed below the table.
    pub spread: Option<Grouping>,
    /// Columns whose sums are printed below that: a table for each entry.
    pub sums: Vec<Grouping>,
}

/// A variation of one parameter, or of several together.
#[derive(Clone, Debug, Default, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Vary {
    /// Its column.
    pub name: String,
    /// The parameters, as `STAGE.KEY`, that take the `values`.
    pub set: Vec<String>,
    /// The values, one for each run.
    pub values: Vec<Json>,
    /// Instead of `set` and `values`: the parameters of each case.
    pub cases: Vec<Case>,
}

/// One case of a variation of several parameters.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Case {
    /// Its name in the table.
    pub name: Figure,
    /// Values by `STAGE.KEY`.
    #[serde(default)]
    pub set: BTreeMap<String, Json>,
}

/// Figures to compare with.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Reference {
    /// Columns by which its rows are matched.
    pub r#match: Vec<String>,
    /// Columns for which it has figures.
    pub columns: Vec<String>,
    /// The cells of `match`, then those of `columns`.
    pub rows: Vec<Vec<Figure>>,
}

/// A plot.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Plot {
    /// The SVG file.
    pub path: PathBuf,
    /// Column along x.
    pub x: String,
    /// Label of the x axis; default: the column's name, with the unit at its end.
    #[serde(default)]
    pub x_label: Option<String>,
    /// Columns along y, one line each.
    pub y: Vec<String>,
    /// Columns that identify a line.
    #[serde(default)]
    pub lines: Vec<String>,
    /// Cells that a row must have to be drawn.
    #[serde(default)]
    pub only: BTreeMap<String, Figure>,
    /// A trace file of the last run, which is drawn instead of the table.
    #[serde(default)]
    pub trace: Option<PathBuf>,
    /// Whether both axes are logarithmic.
    #[serde(default)]
    pub logarithmic: bool,
}

/// A power law to fit.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Exponent {
    /// The column x.
    pub x: String,
    /// The columns y, each with its own exponent of x.
    pub y: Vec<String>,
}

/// A further table: statistics of columns, for the rows that agree in another column.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Grouping {
    /// The column whose cells form the groups.
    pub by: String,
    /// The columns of the statistics.
    pub columns: Vec<String>,
}

/// One combination of the varied values.
#[derive(Clone, Debug, Default)]
pub struct Variation {
    /// Its cells in the table.
    pub names: Vec<(String, Figure)>,
    /// Its parameters as `STAGE.KEY=VALUE`.
    pub overrides: Vec<String>,
}

impl Experiment {
    /// Reads the table of a pipeline file.
    ///
    /// # Errors
    /// The table is not valid; the error says what is wrong.
    pub fn read(json: &Json) -> Result<Self> {
        let experiment: Self = serde_json::from_value(json.clone()).map_err(|error| {
            let what = format!("`[experiment]` cannot be read: {error}");
            Hinted::new(what, "the files of experiments/ show what it may hold")
        })?;
        for vary in &experiment.vary {
            let either = vary.cases.is_empty() != (vary.values.is_empty() || vary.set.is_empty());
            ensure!(
                !vary.name.is_empty() && either,
                Hinted::new(
                    format!("`vary` wants a `name` and either `set` and `values` or `cases`, got `{}`", vary.name),
                    "for example { name = \"distance\", set = [\"source.values.distance\"], values = [1.0, 2.0] }"
                )
            );
        }
        experiment.check_varied()?;
        if let Some(paper) = &experiment.paper {
            let width = paper.r#match.len() + paper.columns.len();
            let odd = paper.rows.iter().position(|row| row.len() != width);
            ensure!(
                odd.is_none(),
                Hinted::new(
                    format!("row {} of `experiment.paper` has not {width} cells", odd.unwrap_or_default() + 1),
                    "first those of `match`, then those of `columns`"
                )
            );
        }
        Ok(experiment)
    }

    /// Refuses column names and parameters that occur in two entries of `vary`.
    fn check_varied(&self) -> Result<()> {
        let mut names = BTreeSet::new();
        if let Some(twice) = self.vary.iter().find(|vary| !names.insert(&vary.name)) {
            bail!(Hinted::new(
                format!("two entries of `vary` have the name `{}`", twice.name),
                "each is a column of the table: give them different names"
            ));
        }
        let mut by_parameter = BTreeMap::new();
        for vary in &self.vary {
            let of_cases: BTreeSet<_> = vary.cases.iter().flat_map(|case| case.set.keys()).collect();
            for parameter in vary.set.iter().chain(of_cases) {
                if let Some(other) = by_parameter.insert(parameter, &vary.name) {
                    bail!(Hinted::new(
                        format!("`vary` sets `{parameter}` twice, in `{other}` and in `{}`", vary.name),
                        "of two values for one run the last would count: vary each parameter once"
                    ));
                }
            }
        }
        Ok(())
    }

    /// Checks that the files of the results can be written, before anything is measured.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn check_files(&self, base: &Path) -> Result<()> {
        let files = self.csv.iter().chain(self.plot.as_ref().map(|plot| &plot.path));
        files.into_iter().try_for_each(|path| output_file::check(base, path))
    }

    /// Refuses columns that are not `known`, as no row will have them.
    ///
    /// # Errors
    /// The error names the key with such a column, and the known columns.
    pub fn check_columns(&self, known: &[String]) -> Result<()> {
        let mut wanted: Vec<(&str, Vec<&String>)> = vec![("columns", self.columns.iter().collect())];
        if let Some(paper) = &self.paper {
            wanted.push(("paper.match", paper.r#match.iter().collect()));
            wanted.push(("paper.columns", paper.columns.iter().collect()));
        }
        if let Some(exponent) = &self.exponent {
            wanted.push(("exponent.x", vec![&exponent.x]));
            wanted.push(("exponent.y", exponent.y.iter().collect()));
        }
        let spread = self.spread.iter().map(|grouping| ("spread.by", "spread.columns", grouping));
        let sums = self.sums.iter().map(|grouping| ("sums.by", "sums.columns", grouping));
        for (by, columns, grouping) in spread.chain(sums) {
            wanted.push((by, vec![&grouping.by]));
            wanted.push((columns, grouping.columns.iter().collect()));
        }
        look(&wanted, known)?;
        let Some(plot) = &self.plot else { return Ok(()) };
        let traced: Vec<String> = TITLES.map(str::to_owned).into();
        let drawn = if plot.trace.is_some() { &traced } else { known };
        let lines = plot.lines.iter().collect();
        look(&[("plot.x", vec![&plot.x]), ("plot.y", plot.y.iter().collect()), ("plot.lines", lines)], drawn)?;
        look(&[("plot.only", plot.only.keys().collect())], known)
    }

    /// Returns all combinations of the varied values; a single empty one if nothing varies.
    ///
    /// # Errors
    /// A value cannot be written in a pipeline file.
    pub fn variations(&self) -> Result<Vec<Variation>> {
        let mut variations = vec![Variation::default()];
        for vary in &self.vary {
            let cases = vary.cases()?;
            variations =
                variations.iter().flat_map(|before| cases.iter().map(|case| before.and(&vary.name, case))).collect();
        }
        Ok(variations)
    }
}

fn look(wanted: &[(&str, Vec<&String>)], known: &[String]) -> Result<()> {
    for (key, columns) in wanted {
        for column in columns {
            if !known.contains(column) {
                let known: Vec<_> = known.iter().map(|column| format!("`{column}`")).collect();
                bail!(Hinted::new(
                    format!("`experiment.{key}`: there is no column `{column}`"),
                    format!("columns: {}", known.join(", "))
                ));
            }
        }
    }
    Ok(())
}

impl Vary {
    fn cases(&self) -> Result<Vec<(Figure, Vec<String>)>> {
        let of_values = self.values.iter().map(|value| {
            let name = serde_json::from_value(value.clone()).unwrap_or_else(|_| Figure::Text(value.to_string()));
            let set = self.set.iter().map(|key| assignment(key, value));
            Ok((name, set.collect::<Result<_>>()?))
        });
        let of_cases = self.cases.iter().map(|case| {
            // a change of the node drops the parameters before it, so it has to come first
            let (nodes, others): (Vec<_>, Vec<_>) = case.set.iter().partition(|(key, _)| key.ends_with(".node"));
            let set = nodes.into_iter().chain(others).map(|(key, value)| assignment(key, value));
            Ok((case.name.clone(), set.collect::<Result<_>>()?))
        });
        of_values.chain(of_cases).collect()
    }
}

fn assignment(key: &str, value: &Json) -> Result<String> {
    let value = toml::Value::try_from(value).with_context(|| format!("`{key}` cannot be set to {value}"))?;
    Ok(format!("{key}={value}"))
}

impl Variation {
    fn and(&self, name: &str, (figure, set): &(Figure, Vec<String>)) -> Self {
        let mut variation = self.clone();
        variation.names.push((name.to_owned(), figure.clone()));
        variation.overrides.extend(set.iter().cloned());
        variation
    }
}

impl Reference {
    /// Returns the reference figure for a row and column, if there is one.
    pub fn figure(&self, row: &Row, column: &str) -> Option<&Figure> {
        let index = self.r#match.len() + self.columns.iter().position(|known| known == column)?;
        let goes_with = |cells: &&Vec<Figure>| {
            self.r#match.iter().zip(cells.iter()).all(|(column, cell)| row.get(column) == Some(cell))
        };
        self.rows.iter().find(goes_with)?.get(index)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn experiment(text: &str) -> Result<Experiment> {
        Experiment::read(&serde_json::to_value(toml::from_str::<toml::Table>(text).unwrap()).unwrap())
    }

    #[test]
    fn all_combinations_are_run_the_first_the_slowest() {
        let text = r#"
            vary = [
                { name = "distance", set = ["source.values.distance", "sink.from"], values = [1.0, 2.5] },
                { name = "method", cases = [{ name = "ours" }, { name = "paper", set = { "a.method" = "profile" } }] },
            ]"#;
        let overrides: Vec<_> =
            experiment(text).unwrap().variations().unwrap().into_iter().map(|v| v.overrides).collect();
        let [near, far] = ["1.0", "2.5"].map(|d| vec![format!("source.values.distance={d}"), format!("sink.from={d}")]);
        let profile = |set: &Vec<String>| [set.clone(), vec!["a.method=\"profile\"".to_owned()]].concat();
        assert_eq!(overrides, [near.clone(), profile(&near), far.clone(), profile(&far)]);
    }

    #[test]
    fn a_case_sets_the_node_before_its_parameters() {
        let text =
            "vary = [{ name = \"n\", cases = [{ name = \"b\", set = { \"x.gain\" = 2, \"x.node\" = \"b\" } }] }]";
        let variation = experiment(text).unwrap().variations().unwrap().remove(0);
        assert_eq!(variation.overrides, ["x.node=\"b\"", "x.gain=2"]);
    }

    #[test]
    fn nothing_varied_is_one_run() {
        assert_eq!(experiment("").unwrap().variations().unwrap().len(), 1);
    }

    #[test]
    fn what_cannot_be_is_refused() {
        assert!(experiment("vary = [{ name = \"d\", set = [\"a.b\"] }]").is_err(), "no values");
        assert!(experiment("colums = []").is_err());
        let twice = |first: &str, second: &str| {
            let of = |(name, key)| format!("{{ name = \"{name}\", set = [\"{key}\"], values = [1, 2] }}");
            let [first, second] = [first, second].map(|entry| of(entry.split_once(' ').unwrap()));
            experiment(&format!("vary = [{first}, {second}]"))
                .map(drop)
                .map_err(|error| error.to_string().lines().next().unwrap().to_owned())
        };
        assert_eq!(twice("n a.b", "m a.c"), Ok(()));
        assert_eq!(twice("n a.b", "m a.b"), Err("`vary` sets `a.b` twice, in `n` and in `m`".into()));
        assert_eq!(twice("n a.b", "n a.c"), Err("two entries of `vary` have the name `n`".into()));
        let odd = "paper = { match = [\"d\"], columns = [\"r\"], rows = [[1.0, 2.0], [1.0]] }";
        assert!(experiment(odd).unwrap_err().to_string().starts_with("row 2 of"));
    }
}
