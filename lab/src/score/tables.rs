//! The tables of a score: counts and errors by shape, group, distance and hidden share, how honest the standard deviations
//! are, and what is wrong with the wrong answers.

use super::errors::{Errors, Sigmas};
use super::evaluation::{Sample, Score};
use super::matching::Fault;
use crate::quantile::{median, quantile};
use conicflow_messages::ObjectKind;
use std::collections::BTreeSet;

/// The titles of the counts and errors with the widths of their columns.
const COLUMNS: [(&str, usize); 11] = [
    ("truth", 6),
    ("found", 6),
    ("wrong", 6),
    ("recall", 8),
    ("prec.", 7),
    ("F1", 7),
    ("radius %", 10),
    ("bias %", 8),
    ("pos. mm", 9),
    ("axis deg", 10),
    ("half deg", 10),
];

/// The standard deviations that are judged, by the titles of their columns.
const SIGMAS: [(&str, fn(&Sigmas) -> Option<f64>); 4] = [
    ("radius", |sigmas| sigmas.radius),
    ("centre", |sigmas| sigmas.center),
    ("axis", |sigmas| sigmas.axis),
    ("half-angle", |sigmas| sigmas.half_angle),
];

/// All tables.
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
        text += &line(title, COLUMNS.map(|(title, width)| (title.to_owned(), width)));
        for (label, samples) in parts.iter().filter(|(_, samples)| !samples.is_empty()) {
            text += &line(label, figures(samples, title != "hidden").into_iter().zip(COLUMNS.map(|(_, width)| width)));
        }
        text += "\n";
    }
    text + &honesty_table(score) + &fault_table(score)
}

/// A line of a table: a label and cells with their widths.
fn line(label: &str, cells: impl IntoIterator<Item = (String, usize)>) -> String {
    let mut text = format!("{label:<24}");
    for (cell, width) in cells {
        text += &format!("{cell:>width$}");
    }
    text + "\n"
}

/// What a line of a table is about.
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

/// Wrong answers cannot be told apart like this.
fn by_hidden(score: &Score) -> Vec<Part<'_>> {
    const LIMITS: [f64; 6] = [-1.0, 0.1, 0.3, 0.45, 0.6, 1.0];
    let of = |limits: &[f64]| {
        let label = format!("{:.0} to {:.0} %", 100.0 * limits[0].max(0.0), 100.0 * limits[1]);
        part(score, label, |sample| sample.hidden.is_some_and(|hidden| (limits[0]..limits[1]).contains(&hidden)))
    };
    LIMITS.windows(2).map(of).collect()
}

fn count_wrong(samples: &[&Sample]) -> usize {
    samples.iter().filter(|sample| sample.fault().is_some()).count()
}

fn count_found(samples: &[&Sample]) -> usize {
    samples.iter().filter(|sample| sample.errors().is_some()).count()
}

/// The cells of a line, of which those that count wrong answers may stay empty.
fn figures(samples: &[&Sample], tells_wrong: bool) -> [String; 11] {
    let (wrong, found) = (count_wrong(samples), count_found(samples));
    let truth = samples.len() - wrong;
    let told = |text: String| if tells_wrong { text } else { String::new() };
    let median_of = |pick: &dyn Fn(&Errors) -> Option<f64>| number(median(values(samples, pick)));
    [
        truth.to_string(),
        found.to_string(),
        told(wrong.to_string()),
        share(found, truth),
        told(share(found, found + wrong)),
        told(share(2 * found, truth + found + wrong)),
        median_of(&|errors| Some((100.0 * errors.radius).abs())),
        median_of(&|errors| Some(100.0 * errors.radius)),
        median_of(&|errors| Some(1e3 * errors.position_m)),
        median_of(&|errors| errors.axis.map(f64::to_degrees)),
        median_of(&|errors| errors.half_angle.map(|angle| angle.abs().to_degrees())),
    ]
}

fn values(samples: &[&Sample], pick: impl Fn(&Errors) -> Option<f64>) -> Vec<f64> {
    samples.iter().filter_map(|sample| pick(sample.errors()?)).collect()
}

/// A part of a whole; nothing of nothing tells nothing.
fn share(part: usize, whole: usize) -> String {
    if whole == 0 { "-".to_owned() } else { format!("{:.3}", part as f64 / whole as f64) }
}

fn number(number: Option<f64>) -> String {
    number.map_or_else(|| "-".to_owned(), |number| format!("{number:.2}"))
}

fn honesty_table(score: &Score) -> String {
    let mut text = line("error / sigma", SIGMAS.map(|(title, _)| (title.to_owned(), 16)));
    for (label, samples) in by_shape(score) {
        let honesty_of = |pick: fn(&Sigmas) -> Option<f64>| honesty(&values(&samples, |errors| pick(&errors.sigmas)));
        text += &line(&label, SIGMAS.map(|(_, pick)| (honesty_of(pick), 16)));
    }
    text + "root mean square (and the 68th percentile of the magnitude); 1 is honest\n\n"
}

fn honesty(values: &[f64]) -> String {
    let mean_square = values.iter().map(|value| value * value).sum::<f64>() / values.len().max(1) as f64;
    let mut magnitudes: Vec<f64> = values.iter().map(|value| value.abs()).collect();
    let usual = quantile(&mut magnitudes, 0.68, f64::total_cmp);
    usual.map_or_else(|| "-".to_owned(), |usual| format!("{:.2} ({usual:.2})", mean_square.sqrt()))
}

/// Nothing where nothing is wrong.
fn fault_table(score: &Score) -> String {
    let faults: BTreeSet<Fault> = score.samples.iter().filter_map(Sample::fault).collect();
    if faults.is_empty() {
        return String::new();
    }
    let mut text = line("wrong answers", ObjectKind::ALL.map(|shape| (shape.name().to_owned(), 10)));
    for fault in faults {
        let is_it = |sample: &&Sample, shape| sample.fault() == Some(fault) && sample.shape == shape;
        let count = |shape| score.samples.iter().filter(|sample| is_it(sample, shape)).count();
        text += &line(fault.name(), ObjectKind::ALL.map(|shape| (count(shape).to_string(), 10)));
    }
    text
}

#[cfg(test)]
mod tests {
    use super::super::evaluation::Outcome;
    use super::*;

    fn found(radius: f64) -> Outcome {
        let sigmas = Sigmas { radius: Some(radius * 100.0), ..Sigmas::default() };
        Outcome::Found(Errors { radius, radius_m: 0.0, position_m: 0.002, axis: None, half_angle: None, sigmas })
    }

    fn score() -> Score {
        let sphere =
            |outcome| Sample { group: 0, shape: ObjectKind::Sphere, distance: 1.5, hidden: Some(0.2), outcome };
        let wrong = Sample {
            group: 0,
            shape: ObjectKind::Cone,
            distance: 2.2,
            hidden: None,
            outcome: Outcome::Wrong(Fault::NothingThere),
        };
        let spheres = [found(0.01), found(-0.02), found(-0.03), Outcome::Missed].map(sphere);
        let samples = spheres.into_iter().chain([wrong]).collect();
        Score { frames: 3, groups: vec!["standing".into()], samples, extra: 0 }
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
        assert!(report.contains("2.16 (2.00)"), "root of (1 + 4 + 9) / 3\n{report}");
    }

    #[test]
    fn nothing_to_find_and_nothing_found_is_a_report_all_the_same() {
        assert!(report(&Score::default()).starts_with("0 frames"));
    }
}
