//! A score in one row: the numbers of objects to be found, found ones and wrong answers, and medians of the errors. Experiments
//! make a table of the rows of several runs.

use super::row::Row;
use super::samples::{Sample, Score};
use crate::quantile::median;

/// A column of medians, and the number of each sample, if it has one.
type Median = (&'static str, fn(&Sample) -> Option<f64>);

const COUNTS: [&str; 5] = ["frames", "to_find", "found", "wrong", "neither"];
const SHARES: [&str; 4] = ["wrong_per_frame", "recall", "precision", "f1"];
const MEDIANS: [Median; 5] = [
    ("radius_error_mm", |sample| Some(1e3 * (sample.errors()?.0.radius_m - sample.radius_m).abs())),
    ("radius_bias_mm", |sample| Some(1e3 * (sample.errors()?.0.radius_m - sample.radius_m))),
    ("position_error_mm", Sample::position_error_mm),
    ("axis_error_deg", Sample::axis_error_deg),
    ("half_angle_error_deg", Sample::half_angle_error_deg),
];

/// Returns the names of all columns that a row can have.
pub fn columns() -> impl Iterator<Item = &'static str> {
    COUNTS.into_iter().chain(SHARES).chain(MEDIANS.map(|(name, _)| name))
}

/// Returns the row of a score; unknown figures have no cell.
pub fn row(score: &Score) -> Row {
    let wrong = score.samples.iter().filter(|sample| sample.fault.is_some()).count();
    let found = score.samples.iter().filter(|sample| sample.found.is_some()).count();
    let to_find = score.samples.len() - wrong;
    let mut row = Row::default();
    let counts = [score.frames, to_find as u64, found as u64, wrong as u64, score.neither];
    COUNTS.into_iter().zip(counts).for_each(|(column, count)| row.count(column, count));
    let share = |part: usize, whole: usize| part as f64 / whole as f64;
    let shares = [
        wrong as f64 / score.frames as f64,
        share(found, to_find),
        share(found, found + wrong),
        share(2 * found, to_find + found + wrong),
    ];
    SHARES.into_iter().zip(shares).for_each(|(column, share)| row.number(column, share));
    for (column, pick) in MEDIANS {
        row.number(column, median(score.samples.iter().filter_map(pick).collect()).unwrap_or(f64::NAN));
    }
    row
}

#[cfg(test)]
mod tests {
    use super::super::matching::{Comparison, Fault};
    use super::super::sigmas::Sigmas;
    use super::*;
    use conicflow_messages::ObjectKind;

    #[test]
    fn all_is_counted_and_nothing_of_nothing_has_no_cell() {
        let can = Sample {
            group: 0,
            shape: ObjectKind::Cylinder,
            distance: 1.0,
            radius_m: 0.1,
            hidden: Some(0.0),
            found: None,
            measured: true,
            fault: None,
        };
        let found = |radius_m: f64| {
            let comparison = Comparison { position_m: 0.002, radius_m, axis: 0.1, half_angle: 0.0 };
            Sample { found: Some((comparison, Sigmas::default())), ..can }
        };
        let wrong = Sample { hidden: None, fault: Some(Fault::NothingThere), ..can };
        let samples = vec![found(0.096), found(0.101), found(0.103), can, wrong, wrong];
        let score = Score { frames: 4, samples, neither: 3, ..Score::default() };
        let row = row(&score);
        for (column, expected) in [
            ("frames", 4.0),
            ("to_find", 4.0),
            ("found", 3.0),
            ("wrong", 2.0),
            ("neither", 3.0),
            ("wrong_per_frame", 0.5),
            ("recall", 0.75),
            ("precision", 0.6),
            ("f1", 6.0 / 9.0),
            ("radius_error_mm", 3.0),
            ("radius_bias_mm", 1.0),
            ("position_error_mm", 2.0),
            ("axis_error_deg", 0.1_f64.to_degrees()),
        ] {
            let number = row.number_of(column).unwrap();
            assert!((number - expected).abs() < 1e-9, "{column}: {number}");
        }
        assert_eq!(row.get("half_angle_error_deg"), None, "no cone was found");
        assert!(row.0.iter().all(|(column, _)| columns().any(|known| known == column)));
        let nothing = super::row(&Score { frames: 3, ..Score::default() });
        assert_eq!((nothing.number_of("wrong_per_frame"), nothing.get("recall")), (Some(0.0), None));
    }
}
