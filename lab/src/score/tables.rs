//! The tables of a score: counts and errors by shape, group, distance and hidden share, checks of the standard deviations, and
//! the faults of the wrong answers.

use super::matching::Fault;
use super::samples::{Sample, Score};
use crate::quantile::{median, quantile};
use conicflow_messages::ObjectKind;
use std::collections::BTreeSet;
use std::fmt::Display;

/// A number of a sample, if it has one.
type Pairing = fn(&Sample) -> Option<f64>;

/// The titles of the counts, and the widths of their columns.
const COUNTS: [(&str, usize); 6] = [("truth", 6), ("found", 6), ("wrong", 6), ("recall", 8), ("prec.", 7), ("F1", 7)];

/// The errors whose medians follow the counts.
const ERRORS: [(&str, usize, Pairing); 5] = [
    ("radius %", 10, |sample| Some(radius_error(sample)?.abs())),
    ("bias %", 8, radius_error),
    ("pos. mm", 9, Sample::position_error_mm),
    ("axis deg", 10, Sample::axis_error_deg),
    ("half deg", 10, Sample::half_angle_error_deg),
];

/// The standard deviations that are checked.
const SIGMAS: [(&str, Pairing); 4] = [
    ("radius", |sample| sample.errors()?.1.radius),
    ("centre", |sample| sample.errors()?.1.center),
    ("axis", |sample| sample.errors()?.1.axis),
    ("half-angle", |sample| sample.errors()?.1.half_angle),
];

fn radius_error(sample: &Sample) -> Option<f64> {
    Some(100.0 * (sample.errors()?.0.radius_m / sample.radius_m - 1.0))
}

/// Returns all tables.
pub fn report(score: &Score) -> String {
    let all: Vec<&Sample> = score.samples.iter().collect();
    let (wrong, found) = (count_wrong(&all), count_found(&all));
    let (frames, objects, extra) = (score.frames, all.len() - wrong, score.extra);
    let mut text = format!(
        "{frames} frames, {objects} objects to be found: {found} found, {wrong} wrong answers, {extra} right ones about \
         others\n\n"
    );
    for (title, parts) in [
        ("shape", by_shape(score)),
        ("group", by_group(score)),
        ("shape and distance", by_distance(score)),
        ("hidden", by_hidden(score)),
    ] {
        text += &line(title, COUNTS.into_iter().chain(ERRORS.map(|(title, width, _)| (title, width))));
        for (label, samples) in parts.iter().filter(|(_, samples)| !samples.is_empty()) {
            let counts = counts(samples, title != "hidden").into_iter().zip(COUNTS.map(|(_, width)| width));
            let medians = ERRORS.map(|(_, width, pick)| (number(median(values(samples, pick))), width));
            text += &line(label, counts.chain(medians));
        }
        text += "\n";
    }
    text + &honesty_table(score) + &fault_table(score)
}

/// Formats a line of a table: a label, and cells with their widths.
fn line(label: &str, cells: impl IntoIterator<Item = (impl Display, usize)>) -> String {
    let mut text = format!("{label:<24}");
    for (cell, width) in cells {
        text += &format!("{cell:>width$}");
    }
    text + "\n"
}

/// A line of a table: its label and its samples.
type Part<'a> = (String, Vec<&'a Sample>);

fn part(score: &Score, label: impl Into<String>, is_of_it: impl Fn(&Sample) -> bool) -> Part<'_> {
    (label.into(), score.samples.iter().filter(|sample| is_of_it(sample)).collect())
}

fn by_shape(score: &Score) -> Vec<Part<'_>> {
    let mut parts: Vec<_> =
        ObjectKind::ALL.map(|shape| part(score, shape.name(), |sample| sample.shape == shape)).into();
    parts.push(part(score, "all", |_| true));
    parts
}

fn by_group(score: &Score) -> Vec<Part<'_>> {
    let groups = score.groups.iter().enumerate();
    groups.map(|(number, name)| part(score, name, |sample| sample.group == number)).collect()
}

fn by_distance(score: &Score) -> Vec<Part<'_>> {
    const LIMITS_M: [f64; 5] = [0.0, 1.25, 2.0, 2.5, f64::INFINITY];
    let mut parts = Vec::new();
    for shape in ObjectKind::ALL {
        for limits in LIMITS_M.windows(2) {
            let label = format!("{} from {:.2} m", shape.name(), limits[0]);
            let is_within = |sample: &Sample| (limits[0]..limits[1]).contains(&sample.distance);
            parts.push(part(score, label, |sample| sample.shape == shape && is_within(sample)));
        }
    }
    parts
}

/// Leaves out wrong answers, which have no hidden share.
fn by_hidden(score: &Score) -> Vec<Part<'_>> {
    const LIMITS: [f64; 6] = [-1.0, 0.1, 0.3, 0.45, 0.6, 1.0];
    let of = |limits: &[f64]| {
        let label = format!("{:.0} to {:.0} %", 100.0 * limits[0].max(0.0), 100.0 * limits[1]);
        part(score, label, |sample| sample.hidden.is_some_and(|hidden| (limits[0]..limits[1]).contains(&hidden)))
    };
    LIMITS.windows(2).map(of).collect()
}

fn count_wrong(samples: &[&Sample]) -> usize {
    samples.iter().filter(|sample| sample.fault.is_some()).count()
}

fn count_found(samples: &[&Sample]) -> usize {
    samples.iter().filter(|sample| sample.found.is_some()).count()
}

/// Returns the counts of a line; those of wrong answers are empty unless `with_wrong`.
fn counts(samples: &[&Sample], with_wrong: bool) -> [String; 6] {
    let (wrong, found) = (count_wrong(samples), count_found(samples));
    let truth = samples.len() - wrong;
    let if_wanted = |text: String| if with_wrong { text } else { String::new() };
    [
        truth.to_string(),
        found.to_string(),
        if_wanted(wrong.to_string()),
        share(found, truth),
        if_wanted(share(found, found + wrong)),
        if_wanted(share(2 * found, truth + found + wrong)),
    ]
}

fn values(samples: &[&Sample], pick: Pairing) -> Vec<f64> {
    samples.iter().filter_map(|sample| pick(sample)).collect()
}

/// Formats a ratio; `-` if the whole is zero.
fn share(part: usize, whole: usize) -> String {
    if whole == 0 { "-".to_owned() } else { format!("{:.3}", part as f64 / whole as f64) }
}

fn number(number: Option<f64>) -> String {
    number.map_or_else(|| "-".to_owned(), |number| format!("{number:.2}"))
}

fn honesty_table(score: &Score) -> String {
    let mut text = line("error / sigma", SIGMAS.map(|(title, _)| (title, 16)));
    for (label, samples) in by_shape(score) {
        text += &line(&label, SIGMAS.map(|(_, pick)| (honesty(&values(&samples, pick)), 16)));
    }
    text + "root mean square (and the 68th percentile of the magnitude); 1 is honest\n\n"
}

fn honesty(values: &[f64]) -> String {
    let mean_square = values.iter().map(|value| value * value).sum::<f64>() / values.len().max(1) as f64;
    let mut magnitudes: Vec<f64> = values.iter().map(|value| value.abs()).collect();
    let usual = quantile(&mut magnitudes, 0.68);
    usual.map_or_else(|| "-".to_owned(), |usual| format!("{:.2} ({usual:.2})", mean_square.sqrt()))
}

/// Returns the table of faults, or nothing without wrong answers.
fn fault_table(score: &Score) -> String {
    let faults: BTreeSet<Fault> = score.samples.iter().filter_map(|sample| sample.fault).collect();
    if faults.is_empty() {
        return String::new();
    }
    let mut text = line("wrong answers", ObjectKind::ALL.map(|shape| (shape.name(), 10)));
    for fault in faults {
        let is_it = |sample: &&Sample, shape| sample.fault == Some(fault) && sample.shape == shape;
        let count = |shape| score.samples.iter().filter(|sample| is_it(sample, shape)).count();
        text += &line(fault.name(), ObjectKind::ALL.map(|shape| (count(shape), 10)));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::super::matching::Comparison;
    use super::super::sigmas::Sigmas;
    use super::*;

    fn score() -> Score {
        let sphere = Sample {
            group: 0,
            shape: ObjectKind::Sphere,
            distance: 1.5,
            radius_m: 0.5,
            hidden: Some(0.2),
            found: None,
            measured: true,
            fault: None,
        };
        let found = |off: f64| {
            let comparison = Comparison { position_m: 0.002, radius_m: 0.5 * (1.0 + off), axis: 0.0, half_angle: 0.0 };
            let sigmas = Sigmas { radius: Some(100.0 * off), ..Sigmas::default() };
            Sample { found: Some((comparison, sigmas)), ..sphere }
        };
        let (shape, fault) = (ObjectKind::Cone, Some(Fault::NothingThere));
        let wrong = Sample { shape, distance: 2.2, hidden: None, fault, ..sphere };
        let samples = vec![found(0.01), found(-0.02), found(-0.03), sphere, wrong];
        Score { frames: 3, groups: ["standing".into()].into(), samples, ..Score::default() }
    }

    fn line<'a>(report: &'a str, label: &str) -> Vec<&'a str> {
        report.lines().find(|line| line.starts_with(label)).unwrap().split_whitespace().collect()
    }

    #[test]
    fn counts_and_medians_stand_in_the_tables() {
        let report = report(&score());
        assert_eq!(
            line(&report, "sphere "),
            ["sphere", "4", "3", "0", "0.750", "1.000", "0.857", "2.00", "-2.00", "2.00", "-", "-"]
        );
        assert_eq!(line(&report, "standing")[3..7], ["1", "0.750", "0.750", "0.750"]);
        assert_eq!(line(&report, "cone from 2.00 m")[4..7], ["0", "0", "1"]);
        assert_eq!(line(&report, "10 to 30 %")[4..7], ["4", "3", "0.750"]);
        assert_eq!(line(&report, "nothing there"), ["nothing", "there", "0", "0", "1"]);
        assert!(report.contains("2.16 (2.36)"), "root of (1 + 4 + 9) / 3\n{report}");
        let counted = "3 frames, 4 objects to be found: 3 found, 1 wrong answers, 0 right ones about others\n";
        assert!(report.starts_with(counted), "{report}");
    }

    #[test]
    fn an_object_counts_at_its_own_distance_and_where_as_much_of_it_is_hidden() {
        let mut score = score();
        let open = Sample { hidden: Some(0.0), distance: 3.0, ..score.samples[0] };
        score.samples.push(open);
        let report = report(&score);
        assert_eq!(line(&report, "sphere from 1.25 m")[4..6], ["4", "3"]);
        assert_eq!(line(&report, "sphere from 2.50 m")[4..6], ["1", "1"]);
        assert_eq!(line(&report, "0 to 10 %")[4..6], ["1", "1"], "nothing of it is hidden");
        for nowhere in ["sphere from 2.00 m", "cone from 1.25 m", "cone from 2.50 m", "30 to 45 %"] {
            assert!(!report.contains(nowhere), "{nowhere}\n{report}");
        }
    }

    #[test]
    fn nothing_to_find_and_nothing_found_is_a_report_all_the_same() {
        assert!(report(&Score::default()).starts_with("0 frames"));
    }
}
