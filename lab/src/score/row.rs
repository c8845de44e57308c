//! Rows of figures with the names of their columns, of which experiments make tables. A [`Column`] has a name, a statistic, and
//! the number that is summed up.

use crate::running_stats::RunningStats;
use serde::{Deserialize, Serialize};

/// One cell.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Figure {
    /// A number, or a count.
    Number(f64),
    /// A name.
    Text(String),
}

/// Cells in the order in which they were added; unknown figures have no cell.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Row(pub Vec<(String, Figure)>);

impl Row {
    /// Creates a row with the name of an object, the number of frames in which it was searched, and in which it was found.
    pub fn about(name: &str, frames: u64, found: u64) -> Self {
        let mut row = Self::default();
        row.text("object", name);
        row.count("frames", frames);
        row.count("n", found);
        row
    }

    /// Adds a name.
    pub fn text(&mut self, column: &str, text: &str) {
        self.0.push((column.to_owned(), Figure::Text(text.to_owned())));
    }

    /// Adds a number, if it is finite.
    pub fn number(&mut self, column: &str, number: f64) {
        if number.is_finite() {
            self.0.push((column.to_owned(), Figure::Number(number)));
        }
    }

    /// Adds a count.
    pub fn count(&mut self, column: &str, count: u64) {
        self.number(column, count as f64);
    }

    /// The cell of a column.
    pub fn get(&self, column: &str) -> Option<&Figure> {
        self.0.iter().find(|(name, _)| name == column).map(|(_, figure)| figure)
    }

    /// The number in a column.
    pub fn number_of(&self, column: &str) -> Option<f64> {
        if let Some(Figure::Number(number)) = self.get(column) { Some(*number) } else { None }
    }
}

impl Serialize for Row {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(self.0.iter().map(|(column, figure)| (column, figure)))
    }
}

/// The statistic in a column.
#[derive(Clone, Copy, Debug)]
pub enum Statistic {
    /// The mean.
    Mean,
    /// The mean of angles in radians, in degrees.
    MeanDegrees,
    /// The standard deviation.
    Deviation,
    /// The root of the mean of squares.
    RootMean,
    /// The root of the mean of squared angles in radians, in degrees.
    RootMeanDegrees,
}

/// A column: its name, its statistic, and the number that a sample adds to it, if it has one.
pub struct Column<S>(pub &'static str, pub Statistic, pub fn(&S) -> Option<f64>);

/// The sums of several columns.
pub struct Sums<S: 'static> {
    columns: &'static [Column<S>],
    sums: Vec<RunningStats>,
}

impl<S> Sums<S> {
    /// Creates empty sums.
    pub fn new(columns: &'static [Column<S>]) -> Self {
        Self { columns, sums: vec![RunningStats::default(); columns.len()] }
    }

    /// Adds a sample.
    pub fn add(&mut self, sample: &S) {
        for (Column(_, _, number), sum) in self.columns.iter().zip(&mut self.sums) {
            if let Some(number) = number(sample) {
                sum.add(number);
            }
        }
    }

    /// Returns the sum of a column.
    pub fn of(&self, name: &str) -> RunningStats {
        let index = self.columns.iter().position(|Column(known, ..)| *known == name);
        index.map_or_else(RunningStats::default, |index| self.sums[index])
    }

    /// Appends the figures of all columns to a row.
    pub fn write(&self, row: &mut Row) {
        for (Column(name, statistic, _), sum) in self.columns.iter().zip(&self.sums) {
            let number = match statistic {
                Statistic::Mean => sum.mean(),
                Statistic::MeanDegrees => sum.mean().to_degrees(),
                Statistic::Deviation => sum.deviation(),
                Statistic::RootMean => sum.mean().sqrt(),
                Statistic::RootMeanDegrees => sum.mean().sqrt().to_degrees(),
            };
            row.number(name, number);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Columns of a sample's number, all but the first only if its flag is set.
    const COLUMNS: &[Column<(f64, bool)>] = &[
        Column("mean", Statistic::Mean, |it| Some(it.0)),
        Column("mean_deg", Statistic::MeanDegrees, |it| it.1.then_some(it.0)),
        Column("sd", Statistic::Deviation, |it| it.1.then_some(it.0)),
        Column("rms", Statistic::RootMean, |it| it.1.then_some(it.0 * it.0)),
        Column("rms_deg", Statistic::RootMeanDegrees, |it| it.1.then_some(it.0 * it.0)),
    ];

    #[test]
    fn each_column_has_its_statistic_of_the_samples_that_have_a_number() {
        let (mut sums, mut row) = (Sums::new(COLUMNS), Row::default());
        [(1.0, true), (7.0, true), (10.0, false)].iter().for_each(|sample| sums.add(sample));
        sums.write(&mut row);
        for (column, expected) in [
            ("mean", 6.0),
            ("mean_deg", 4_f64.to_degrees()),
            ("sd", 18_f64.sqrt()),
            ("rms", 5.0),
            ("rms_deg", 5_f64.to_degrees()),
        ] {
            let number = row.number_of(column).unwrap();
            assert!((number - expected).abs() < 1e-12, "{column}: {number}, not {expected}");
        }
        assert_eq!([sums.of("mean").count(), sums.of("sd").count(), sums.of("unknown").count()], [3, 2, 0]);
    }

    #[test]
    fn what_is_not_known_has_no_cell_and_a_name_is_no_number() {
        let mut row = Row::about("ball", 9, 3);
        row.number("speed_mps", f64::NAN);
        assert_eq!(row.get("object"), Some(&Figure::Text("ball".into())));
        assert_eq!(
            (row.number_of("object"), row.number_of("frames"), row.number_of("n")),
            (None, Some(9.0), Some(3.0))
        );
        assert_eq!(row.get("speed_mps"), None);
        assert_eq!(serde_json::to_string(&row).unwrap(), r#"{"object":"ball","frames":9.0,"n":3.0}"#);
    }
}
