//! The rows of all runs: as a table, as CSV, as a plot, and their power laws.

use super::definition::{Experiment, Exponent, Grouping};
use super::{output_file, plot};
use crate::quantile::quantile;
use crate::score::{Figure, Row};
use anyhow::Result;
use conicflow_geometry::Regression;
use indexmap::{IndexMap, IndexSet};
use std::fmt::Write;
use std::ops::Add as _;
use std::path::Path;

/// The results of an experiment so far.
pub struct Results<'a> {
    experiment: &'a Experiment,
    rows: Vec<Row>,
}

impl<'a> Results<'a> {
    /// Creates empty results.
    pub fn new(experiment: &'a Experiment) -> Self {
        Self { experiment, rows: Vec::new() }
    }

    /// Adds the rows of a run about the wanted objects.
    pub fn add(&mut self, rows: Vec<Row>) {
        let wanted = &self.experiment.objects;
        let is_wanted = |row: &Row| match row.get("object") {
            Some(Figure::Text(name)) => wanted.is_empty() || wanted.contains(name),
            _ => true,
        };
        self.rows.extend(rows.into_iter().filter(is_wanted));
    }

    /// Returns the columns that identify a row: the varied ones, and stage and object if there are several.
    fn keys(&self) -> Vec<&str> {
        let several = |column: &&str| self.rows.iter().any(|row| row.get(column) != self.rows[0].get(column));
        let varied = self.experiment.vary.iter().map(|vary| vary.name.as_str());
        varied.chain(["stage", "object"].into_iter().filter(several)).collect()
    }

    /// Returns titles and rows of the printed table, with the paper's figures beside their columns.
    pub fn table(&self) -> (Vec<String>, Vec<Vec<String>>) {
        let paper = self.experiment.paper.as_ref();
        let mut titles: Vec<String> = self.keys().iter().map(|&key| key.to_owned()).collect();
        for column in &self.experiment.columns {
            titles.push(column.clone());
            if paper.is_some_and(|paper| paper.columns.contains(column)) {
                titles.push(format!("paper {column}"));
            }
        }
        let cell = |row: &Row, title: &String| {
            let figure = match (title.strip_prefix("paper "), paper) {
                (Some(column), Some(paper)) => paper.figure(row, column).cloned(),
                _ => row.get(title).cloned(),
            };
            figure.map_or("-".to_owned(), |figure| shown(&figure))
        };
        let rows = self.rows.iter().map(|row| titles.iter().map(|title| cell(row, title)).collect()).collect();
        (titles, rows)
    }

    /// Returns titles and rows of the table of least, median and greatest figures, if the experiment has one; leaves out rows
    /// without a figure.
    pub fn spread(&self) -> Option<(Vec<String>, Vec<Vec<String>>)> {
        let Grouping { by, columns } = self.experiment.spread.as_ref()?;
        let titles = [by, "of all rows"].map(str::to_owned).into_iter().chain(columns.iter().cloned()).collect();
        let rows = self.groups(by).into_iter().flat_map(|(group, rows)| {
            [("least", 0.0), ("median", 0.5), ("greatest", 1.0)].map(|(name, share)| {
                let cell = |column: &String| shown_number(quantile(&mut numbers_of(&rows, column), share));
                [group.clone(), name.to_owned()].into_iter().chain(columns.iter().map(cell)).collect()
            })
        });
        Some((titles, rows.collect()))
    }

    /// Returns titles and rows of the tables of sums; the last row of each is the sum of all. Leaves out rows without a figure.
    pub fn sums(&self) -> impl Iterator<Item = (Vec<String>, Vec<Vec<String>>)> {
        self.experiment.sums.iter().map(|Grouping { by, columns }| {
            let titles = std::iter::once(by).chain(columns).cloned().collect();
            let all = ("all".to_owned(), self.rows.iter().collect());
            let rows = self.groups(by).into_iter().chain([all]).map(|(name, rows)| {
                let sum = |column: &String| shown_number(numbers_of(&rows, column).into_iter().reduce(f64::add));
                std::iter::once(name).chain(columns.iter().map(sum)).collect()
            });
            (titles, rows.collect())
        })
    }

    /// Returns the rows grouped by their cell in a column, in the order of each group's first row.
    fn groups(&self, by: &str) -> IndexMap<String, Vec<&Row>> {
        let mut groups: IndexMap<_, Vec<_>> = IndexMap::new();
        for row in &self.rows {
            if let Some(group) = row.get(by) {
                groups.entry(exact(group)).or_default().push(row);
            }
        }
        groups
    }

    /// Returns one line for each power law: `y ~ x^exponent`, by least squares of the logarithms.
    pub fn exponents(&self) -> String {
        let mut text = String::new();
        let Some(Exponent { x, y }) = &self.experiment.exponent else { return text };
        for column in y {
            let mut regression = Regression::default();
            let pairs = self.rows.iter().filter_map(|row| Some((row.number_of(x)?, row.number_of(column)?)));
            pairs.for_each(|(x, y)| regression.add(x.ln(), y.ln()));
            if let Some(fit) = regression.fit() {
                // writing to a string cannot fail
                let _ = writeln!(text, "{column} ~ {x}^{:.2} (standard error {:.2})", fit.slope, fit.slope_sigma);
            }
        }
        text
    }

    /// Writes the CSV file and the plot, if the experiment has them.
    ///
    /// # Errors
    /// A file cannot be written, or the trace for the plot cannot be read.
    pub fn write(&self, base: &Path) -> Result<()> {
        self.write_csv(base)?;
        plot::draw(self.experiment, &self.rows, base)
    }

    /// Writes all columns of all rows.
    fn write_csv(&self, base: &Path) -> Result<()> {
        let Some(path) = &self.experiment.csv else { return Ok(()) };
        let columns: IndexSet<&str> =
            self.rows.iter().flat_map(|row| &row.0).map(|(column, _)| column.as_str()).collect();
        let mut lines = csv::Writer::from_writer(Vec::new());
        lines.write_record(&columns)?;
        for row in &self.rows {
            lines.write_record(columns.iter().map(|column| row.get(column).map_or(String::new(), exact)))?;
        }
        output_file::write(base, path, lines.into_inner()?)
    }
}

/// Returns the numbers in a column.
fn numbers_of(rows: &[&Row], column: &str) -> Vec<f64> {
    rows.iter().filter_map(|row| row.number_of(column)).collect()
}

/// Formats a figure with all digits.
fn exact(figure: &Figure) -> String {
    match figure {
        Figure::Number(number) => number.to_string(),
        Figure::Text(text) => text.clone(),
    }
}

/// Formats a number; `-` if there is none.
fn shown_number(number: Option<f64>) -> String {
    number.map_or("-".to_owned(), |number| shown(&Figure::Number(number)))
}

/// Formats a figure with four significant digits; counts in full.
fn shown(figure: &Figure) -> String {
    match figure {
        Figure::Text(text) => text.clone(),
        Figure::Number(number) if number.fract() == 0.0 && number.abs() < 1e9 => format!("{number}"),
        Figure::Number(number) if number.abs() < 0.01 => format!("{number:.2e}"),
        Figure::Number(number) => {
            let decimals = 3 - number.abs().log10().floor() as i32;
            let text = format!("{number:.*}", decimals.clamp(0, 5) as usize);
            let whole = number.to_string();
            if whole.len() < text.len() { whole } else { text }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn row(distance: f64, radius: f64) -> Row {
        let mut row = Row::default();
        row.number("distance", distance);
        row.text("object", "can");
        row.number("radius_m", radius);
        row
    }

    fn experiment() -> Experiment {
        let text = r#"
            title   = "a can"
            columns = ["radius_m"]
            vary    = [{ name = "distance", set = ["source.values.d"], values = [1.0, 4.0] }]
            exponent = { x = "distance", y = ["radius_m"] }
            [paper]
            match   = ["distance"]
            columns = ["radius_m"]
            rows    = [[4.0, 0.15]]"#;
        toml::from_str(text).unwrap()
    }

    #[test]
    fn the_papers_figures_stand_beside_ours() {
        let experiment = experiment();
        let mut results = Results::new(&experiment);
        results.add(vec![row(1.0, 0.2), row(4.0, 0.4)]);
        let (titles, rows) = results.table();
        assert_eq!(titles, ["distance", "radius_m", "paper radius_m"]);
        assert_eq!(rows, [["1", "0.2", "-"], ["4", "0.4", "0.15"]]);
        assert_eq!(results.exponents(), "", "two points leave no standard error");
    }

    #[test]
    fn the_spread_of_a_column_is_told_group_by_group() {
        let spread = Some(Grouping { by: "object".into(), columns: vec!["radius_m".into(), "sd".into()] });
        let experiment = Experiment { spread, ..experiment() };
        let mut results = Results::new(&experiment);
        let mut ball = Row::default();
        ball.text("object", "ball");
        results.add([0.4, 0.1, 0.2].map(|radius| row(1.0, radius)).into());
        results.add(vec![ball]);
        let (titles, rows) = results.spread().unwrap();
        assert_eq!(titles, ["object", "of all rows", "radius_m", "sd"]);
        let expected = [["least", "0.1"], ["median", "0.2"], ["greatest", "0.4"]];
        assert_eq!(rows[..3], expected.map(|[name, radius]| ["can", name, radius, "-"]));
        assert_eq!(rows[4], ["ball", "median", "-", "-"]);
        assert!(Results::new(&Experiment::default()).spread().is_none());
    }

    #[test]
    fn columns_are_summed_up_group_by_group_and_over_all() {
        let by_distance = Grouping { by: "distance".into(), columns: vec!["radius_m".into(), "sd".into()] };
        let experiment = Experiment { sums: vec![by_distance], ..experiment() };
        let mut results = Results::new(&experiment);
        let mut without = row(4.0, f64::NAN);
        without.number("sd", 0.5);
        results.add(vec![row(4.0, 0.25), row(1.0, 0.5), row(4.0, 1.0), without]);
        let tables: Vec<_> = results.sums().collect();
        let [(titles, rows)] = &tables[..] else { panic!("{tables:?}") };
        assert_eq!(titles, &["distance", "radius_m", "sd"]);
        assert_eq!(rows, &[["4", "1.25", "0.5"], ["1", "0.5", "-"], ["all", "1.75", "0.5"]]);
    }

    #[test]
    fn a_power_law_is_found() {
        let experiment = experiment();
        let mut results = Results::new(&experiment);
        results.add([1.0, 2.0, 4.0, 8.0_f64].map(|x| row(x, 3.0 * x.powf(1.5))).into());
        assert!(results.exponents().starts_with("radius_m ~ distance^1.50 "), "{}", results.exponents());
    }

    #[test]
    fn numbers_are_shown_with_four_digits() {
        let texts = [0.19999, 12.3456, 61.0, 0.000123, 1234.56].map(|number| shown(&Figure::Number(number)));
        assert_eq!(texts, ["0.2000", "12.35", "61", "1.23e-4", "1235"]);
    }
}
