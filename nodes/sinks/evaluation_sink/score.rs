//! Counts and errors of many frames, and their tables.

use super::errors::{Errors, Sigmas};
use super::matching::Fault;
use conicflow_messages::ObjectKind;
use std::collections::BTreeSet;
use std::fmt::{self, Write};

/// A true object that had to be found.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// Number of its group.
    pub group: usize,
    /// Its shape.
    pub shape: ObjectKind,
    /// Distance of its middle from the camera, in metres.
    pub distance: f64,
    /// Share of it that is hidden.
    pub hidden: f64,
    /// Errors of the answer that is right about it, if there is one.
    pub errors: Option<Errors>,
}

/// A wrong answer.
#[derive(Clone, Copy, Debug)]
pub struct WrongAnswer {
    /// Number of its group.
    pub group: usize,
    /// The shape that it claims.
    pub shape: ObjectKind,
    /// Distance from the camera at which it claims that, in metres.
    pub distance: f64,
    /// What comes nearest to it.
    pub fault: Fault,
}

/// All that was counted.
#[derive(Clone, Debug, Default)]
pub struct Score {
    /// Number of frames.
    pub frames: u64,
    /// Names of the groups, in the order of their first frames.
    pub groups: Vec<String>,
    /// The true objects that had to be found.
    pub samples: Vec<Sample>,
    /// The answers that were right about nothing.
    pub wrong: Vec<WrongAnswer>,
    /// Number of right answers about objects that need not be found.
    pub extra: u64,
}

/// A line of a table: what part of the truth and of the wrong answers it is about.
struct Line<'a> {
    label: String,
    samples: Vec<&'a Sample>,
    /// `None`: wrong answers cannot be told apart like this.
    wrong: Option<usize>,
}

impl Score {
    /// The number of a group.
    pub fn group(&mut self, name: &str) -> usize {
        self.groups.iter().position(|known| known == name).unwrap_or_else(|| {
            self.groups.push(name.to_owned());
            self.groups.len() - 1
        })
    }

    fn found(&self) -> usize {
        self.samples.iter().filter(|sample| sample.errors.is_some()).count()
    }

    fn line(
        &self,
        label: impl Into<String>,
        sample: impl Fn(&Sample) -> bool,
        wrong: Option<&dyn Fn(&WrongAnswer) -> bool>,
    ) -> Line<'_> {
        let samples = self.samples.iter().filter(|candidate| sample(candidate)).collect();
        let wrong = wrong.map(|wrong| self.wrong.iter().filter(|candidate| wrong(candidate)).count());
        Line { label: label.into(), samples, wrong }
    }

    fn by_shape(&self) -> Vec<Line<'_>> {
        let of = |shape: ObjectKind| self.line(shape.name(), |s| s.shape == shape, Some(&|w| w.shape == shape));
        let mut lines: Vec<_> = ObjectKind::ALL.map(of).into();
        lines.push(self.line("all", |_| true, Some(&|_| true)));
        lines
    }

    fn by_group(&self) -> Vec<Line<'_>> {
        let of = |(number, name): (usize, &String)| {
            self.line(name, |sample| sample.group == number, Some(&|wrong| wrong.group == number))
        };
        self.groups.iter().enumerate().map(of).collect()
    }

    fn by_distance(&self) -> Vec<Line<'_>> {
        const LIMITS_M: [f64; 5] = [0.0, 1.25, 2.0, 2.5, f64::INFINITY];
        let mut lines = Vec::new();
        for shape in ObjectKind::ALL {
            for limits in LIMITS_M.windows(2) {
                let within = |distance: f64| (limits[0]..limits[1]).contains(&distance);
                lines.push(self.line(
                    format!("{} from {:.2} m", shape.name(), limits[0]),
                    |sample| sample.shape == shape && within(sample.distance),
                    Some(&|wrong| wrong.shape == shape && within(wrong.distance)),
                ));
            }
        }
        lines
    }

    fn by_hidden(&self) -> Vec<Line<'_>> {
        const LIMITS: [f64; 6] = [-1.0, 0.1, 0.3, 0.45, 0.6, 1.0];
        let of = |limits: &[f64]| {
            let within = |hidden: f64| limits[0] <= hidden && hidden < limits[1];
            let label = format!("{:.0} to {:.0} %", 100.0 * limits[0].max(0.0), 100.0 * limits[1]);
            self.line(label, |sample| within(sample.hidden), None)
        };
        LIMITS.windows(2).map(of).collect()
    }

    /// All tables.
    pub fn report(&self) -> String {
        let mut text = String::new();
        // writing to a string cannot fail
        let _ = self.write_report(&mut text);
        text
    }

    fn write_report(&self, text: &mut String) -> fmt::Result {
        let (frames, objects, wrong, extra) = (self.frames, self.samples.len(), self.wrong.len(), self.extra);
        let found = self.found();
        writeln!(
            text,
            "{frames} frames, {objects} objects to be found: {found} found, {wrong} wrong answers, {extra} right ones \
             about others\n"
        )?;
        for (title, lines) in [
            ("shape", self.by_shape()),
            ("group", self.by_group()),
            ("shape and distance", self.by_distance()),
            ("hidden", self.by_hidden()),
        ] {
            write_table(text, title, &lines)?;
        }
        self.write_sigmas(text)?;
        self.write_wrong(text)
    }

    fn write_sigmas(&self, text: &mut String) -> fmt::Result {
        writeln!(text, "{:<24}{:>16}{:>16}{:>16}{:>16}", "error / sigma", "radius", "centre", "axis", "half-angle")?;
        for line in self.by_shape() {
            write!(text, "{:<24}", line.label)?;
            let pick: [fn(&Sigmas) -> Option<f64>; 4] =
                [|sigmas| sigmas.radius, |sigmas| sigmas.center, |sigmas| sigmas.axis, |sigmas| sigmas.half_angle];
            for pick in pick {
                write!(text, "{:>16}", honesty(line.values(|errors| pick(&errors.sigmas))))?;
            }
            writeln!(text)?;
        }
        writeln!(text, "root mean square (and the 68th percentile of the magnitude); 1 is honest\n")
    }

    fn write_wrong(&self, text: &mut String) -> fmt::Result {
        let there: BTreeSet<Fault> = self.wrong.iter().map(|wrong| wrong.fault).collect();
        if there.is_empty() {
            return Ok(());
        }
        write!(text, "{:<24}", "wrong answers")?;
        ObjectKind::ALL.iter().try_for_each(|shape| write!(text, "{:>10}", shape.name()))?;
        writeln!(text)?;
        for fault in there {
            write!(text, "{:<24}", fault.name())?;
            for shape in ObjectKind::ALL {
                let count = self.wrong.iter().filter(|wrong| wrong.fault == fault && wrong.shape == shape).count();
                write!(text, "{count:>10}")?;
            }
            writeln!(text)?;
        }
        Ok(())
    }
}

impl Line<'_> {
    fn values(&self, pick: impl Fn(&Errors) -> Option<f64>) -> Vec<f64> {
        self.samples.iter().filter_map(|sample| pick(sample.errors.as_ref()?)).collect()
    }
}

fn write_table(text: &mut String, title: &str, lines: &[Line]) -> fmt::Result {
    writeln!(
        text,
        "{title:<24}{:>6}{:>6}{:>6}{:>8}{:>7}{:>7}{:>10}{:>8}{:>9}{:>10}{:>10}",
        "truth", "found", "wrong", "recall", "prec.", "F1", "radius %", "bias %", "pos. mm", "axis deg", "half deg"
    )?;
    for line in lines.iter().filter(|line| !line.samples.is_empty() || line.wrong.is_some_and(|wrong| wrong > 0)) {
        write_line(text, line)?;
    }
    writeln!(text)
}

fn write_line(text: &mut String, line: &Line) -> fmt::Result {
    let radius = line.values(|errors| Some(100.0 * errors.radius));
    let (truth, found) = (line.samples.len(), radius.len());
    let recall = part_text(found, truth);
    write!(text, "{:<24}{truth:>6}{found:>6}", line.label)?;
    match line.wrong {
        Some(wrong) => {
            let (precision, f1) = (part_text(found, found + wrong), part_text(2 * found, truth + found + wrong));
            write!(text, "{wrong:>6}{recall:>8}{precision:>7}{f1:>7}")?;
        }
        None => write!(text, "{:>6}{recall:>8}{:>7}{:>7}", "", "", "")?,
    }
    let position = line.values(|errors| Some(1e3 * errors.position_m));
    let axis = line.values(|errors| errors.axis.map(f64::to_degrees));
    let half_angle = line.values(|errors| errors.half_angle.map(|angle| angle.abs().to_degrees()));
    let magnitude = radius.iter().map(|value| value.abs()).collect();
    write!(text, "{:>10}{:>8}", median_text(magnitude, 2), median_text(radius, 2))?;
    writeln!(text, "{:>9}{:>10}{:>10}", median_text(position, 2), median_text(axis, 2), median_text(half_angle, 2))
}

/// The value below which a share of the values lies.
pub fn quantile(mut values: Vec<f64>, share: f64) -> Option<f64> {
    let index = ((values.len() as f64 - 1.0).max(0.0) * share).round() as usize;
    (!values.is_empty()).then(|| *values.select_nth_unstable_by(index, f64::total_cmp).1)
}

/// A part of a whole; nothing of nothing tells nothing.
fn part_text(part: usize, whole: usize) -> String {
    if whole == 0 { "-".to_owned() } else { format!("{:.3}", part as f64 / whole as f64) }
}

fn median_text(values: Vec<f64>, digits: usize) -> String {
    quantile(values, 0.5).map_or_else(|| "-".to_owned(), |median| format!("{median:.digits$}"))
}

fn honesty(values: Vec<f64>) -> String {
    let mean_square = values.iter().map(|value| value * value).sum::<f64>() / values.len().max(1) as f64;
    let magnitudes = values.iter().map(|value| value.abs()).collect();
    quantile(magnitudes, 0.68).map_or_else(|| "-".to_owned(), |usual| format!("{:.2} ({usual:.2})", mean_square.sqrt()))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn errors(radius: f64) -> Errors {
        let sigmas = Sigmas { radius: Some(radius * 100.0), ..Sigmas::default() };
        Errors { radius, position_m: 0.002, axis: None, half_angle: None, sigmas }
    }

    fn score() -> Score {
        let mut score = Score { frames: 3, ..Score::default() };
        let group = score.group("standing");
        let sample = |radius: Option<f64>| Sample {
            group,
            shape: ObjectKind::Sphere,
            distance: 1.5,
            hidden: 0.2,
            errors: radius.map(errors),
        };
        score.samples = [Some(0.01), Some(-0.02), Some(-0.03), None].map(sample).into();
        let wrong = WrongAnswer { group, shape: ObjectKind::Cone, distance: 2.2, fault: Fault::NothingThere };
        score.wrong = vec![wrong];
        score
    }

    fn line<'a>(report: &'a str, label: &str) -> Vec<&'a str> {
        report.lines().find(|line| line.starts_with(label)).unwrap().split_whitespace().collect()
    }

    #[test]
    fn counts_and_medians_stand_in_the_tables() {
        let report = score().report();
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
        assert!(Score::default().report().starts_with("0 frames"));
    }

    #[test]
    fn a_quantile_is_one_of_the_values() {
        assert_eq!(quantile(vec![3.0, 1.0, 2.0], 0.5), Some(2.0));
        assert_eq!(quantile(vec![3.0, 1.0], 1.0), Some(3.0));
        assert_eq!(quantile(Vec::new(), 0.5), None);
    }
}
