//! Scores answers against the measured truth of a recording: what was found, what was off, and what nobody listed, frame
//! by frame, to be looked at.

use super::evaluation::FrameScore;
use super::matching::{Comparison, Expected, Fault, compare, fault, match_up};
use super::recorded::RecordedTruth;
use super::score::quantile;
use anyhow::{Result, bail};
use conicflow_lab::running_stats::RunningStats;
use conicflow_messages::Object;
use std::collections::BTreeMap;
use std::fmt::{self, Write};

/// Counts and notes of a recording.
pub struct RecordedScore {
    truth: RecordedTruth,
    /// Frames that were judged.
    pub frames: u64,
    /// Frames whose truth is not known.
    pub unjudged: u64,
    /// Name of the first of them.
    stranger: Option<String>,
    /// Objects that had to be found.
    pub required: u64,
    /// Right answers about them.
    pub found: u64,
    /// Answers that are next to a listed object and not right.
    pub off: u64,
    /// Answers where the list has nothing: wrong, or not listed.
    pub unlisted: u64,
    radius_errors: Vec<f64>,
    position_errors: Vec<f64>,
    axis_errors: Vec<f64>,
    /// Radii of the right answers, by the object's name.
    radii: BTreeMap<String, RunningStats>,
    notes: String,
}

impl RecordedScore {
    /// Nothing counted yet.
    pub fn new(truth: RecordedTruth) -> Self {
        Self {
            truth,
            frames: 0,
            unjudged: 0,
            stranger: None,
            required: 0,
            found: 0,
            off: 0,
            unlisted: 0,
            radius_errors: Vec::new(),
            position_errors: Vec::new(),
            axis_errors: Vec::new(),
            radii: BTreeMap::new(),
            notes: String::new(),
        }
    }

    /// Scores the answers to the frame of a file; `None` where its truth is not known.
    pub fn add<'a>(&mut self, source: &str, answers: &'a [Object]) -> Option<FrameScore<'a>> {
        let Some(expected) = self.truth.of_frame(source).map(<[Expected]>::to_vec) else {
            self.unjudged += 1;
            self.stranger.get_or_insert_with(|| source.to_owned());
            return None;
        };
        self.frames += 1;
        self.note(format_args!("{}", source.escape_debug()));
        let matching = match_up(&expected, answers);
        for (object, answer) in expected.iter().zip(&matching.answer_of) {
            self.count(object, answer.map(|index| &answers[index]));
        }
        for (index, fault) in &matching.wrong {
            self.count_wrong(&expected, &answers[*index], *fault);
        }
        Some(FrameScore { expected, answers, matching })
    }

    fn note(&mut self, line: fmt::Arguments) {
        // writing to a string cannot fail
        let _ = writeln!(self.notes, "{line}");
    }

    fn count(&mut self, object: &Expected, answer: Option<&Object>) {
        self.required += u64::from(object.required);
        let Some(answer) = answer else {
            if object.required {
                self.note(format_args!("  missed    {}", object.name));
            }
            return;
        };
        let errors = compare(&object.body, answer);
        let word = if object.required { "found" } else { "unasked" };
        self.note(format_args!("  {word:<9} {}: {}", object.name, Differences(object, errors)));
        if object.required {
            self.found += 1;
            self.radius_errors.push(errors.radius_m - object.body.radius);
            self.position_errors.push(errors.position_m);
            self.axis_errors.push(errors.axis);
            self.radii.entry(object.name.clone()).or_default().add(answer.radius);
        }
    }

    fn count_wrong(&mut self, expected: &[Expected], answer: &Object, worst: Fault) {
        let about = expected.iter().find(|object| fault(object, answer).unwrap_or(Fault::Second) == worst);
        match about.filter(|_| worst != Fault::NothingThere) {
            Some(object) => {
                self.off += 1;
                let (name, errors) = (&object.name, compare(&object.body, answer));
                let text = format!("{} is wrong about {name}: {}", worst.name(), Differences(object, errors));
                self.note(format_args!("  off       {}; {text}", Told(answer)));
            }
            None => {
                self.unlisted += 1;
                self.note(format_args!("  unlisted  {}", Told(answer)));
            }
        }
    }

    /// Makes sure that a frame could be judged.
    ///
    /// # Errors
    /// Frames came, and the truth file has none of them.
    pub fn check(&self) -> Result<()> {
        let Some(stranger) = self.stranger.as_ref().filter(|_| self.frames == 0) else { return Ok(()) };
        bail!(
            "no frame of the recording is in the truth file: the first of {} is `{}`, the file has `{}`\n  hint: it names \
             each frame as its file is named, with its ending",
            self.unjudged,
            stranger.escape_debug(),
            self.truth.some_frame().unwrap_or_default().escape_debug()
        )
    }

    /// What was found and what not, frame by frame, and the sums.
    pub fn report(&self) -> String {
        let mut text = self.notes.clone();
        // writing to a string cannot fail
        let _ = self.write_sums(&mut text);
        text
    }

    fn write_sums(&self, text: &mut String) -> fmt::Result {
        let Self { frames, unjudged, required, found, off, unlisted, .. } = self;
        let per_frame = |count: u64| count as f64 / (*frames).max(1) as f64;
        let share = 100.0 * *found as f64 / (*required).max(1) as f64;
        writeln!(
            text,
            "\n{found} of {required} found ({share:.0} %) in {frames} frames; {unjudged} frames not judged"
        )?;
        writeln!(
            text,
            "{off} answers off ({:.2} per frame), {unlisted} about what is not listed ({:.2} per frame)",
            per_frame(*off),
            per_frame(*unlisted)
        )?;
        self.write_errors(text)?;
        for (name, radii) in self.radii.iter().filter(|(_, radii)| radii.count() > 2) {
            let (mean, sd) = (1e3 * radii.mean(), 1e3 * radii.deviation());
            writeln!(text, "{name}: radius {mean:.1} +- {sd:.1} mm in {} frames", radii.count())?;
        }
        Ok(())
    }

    fn write_errors(&self, text: &mut String) -> fmt::Result {
        let median = |values: &[f64]| quantile(values.to_vec(), 0.5).unwrap_or(0.0);
        let magnitude: Vec<_> = self.radius_errors.iter().map(|error| error.abs()).collect();
        writeln!(
            text,
            "medians of those found: |radius| {:.1} mm, radius {:+.1} mm, position {:.1} mm, axis {:.1} deg",
            1e3 * median(&magnitude),
            1e3 * median(&self.radius_errors),
            1e3 * median(&self.position_errors),
            median(&self.axis_errors).to_degrees()
        )
    }
}

/// How an answer differs from the truth.
struct Differences<'a>(&'a Expected, Comparison);

impl fmt::Display for Differences<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self(object, errors) = self;
        let radius = 1e3 * (errors.radius_m - object.body.radius);
        let (position, axis) = (1e3 * errors.position_m, errors.axis.to_degrees());
        write!(f, "radius {radius:+.1} mm, position {position:.1} mm, axis {axis:.1} deg")
    }
}

/// An answer in short.
struct Told<'a>(&'a Object);

impl fmt::Display for Told<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Object { center: [x, y, z], radius, .. } = self.0;
        write!(f, "{} at ({x:.3}, {y:.3}, {z:.3}) m, radius {:.1} mm", self.0.shape().name(), 1e3 * radius)
    }
}

#[cfg(test)]
mod tests {
    use super::super::recorded::RecordedTolerances;
    use super::*;
    use conicflow_messages::ObjectKind;

    const TRUTH: &str = r#"{"units": "m", "scenes": {"a.pcd": [
        {"type": "cylinder", "what": "tin", "radius_m": 0.05, "axis_point_m": [0, 0, 1], "axis_dir": [0, 1, 0]},
        {"type": "cylinder", "what": "pot", "radius_m": 0.09, "axis_point_m": [0.3, 0, 1], "axis_dir": [0, 1, 0]}]}}"#;

    fn cylinder(x: f64, radius: f64) -> Object {
        let (kind, axis) = (ObjectKind::Cylinder.code(), [0.0, 1.0, 0.0]);
        Object { kind, center: [x, 0.02, 1.0], axis, radius, length: 0.1, ..Object::default() }
    }

    fn score() -> RecordedScore {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("truth.json");
        std::fs::write(&path, TRUTH).unwrap();
        RecordedScore::new(RecordedTruth::load(&path, &RecordedTolerances::default()).unwrap())
    }

    #[test]
    fn found_off_and_unlisted_are_told_apart() {
        let mut score = score();
        let answers = [cylinder(0.001, 0.051), cylinder(0.3, 0.097), cylinder(-0.5, 0.04)];
        let frame = score.add("a.pcd", &answers).unwrap();
        let missed: Vec<_> = frame.missed().map(|object| object.name.as_str()).collect();
        assert_eq!(missed, ["pot"]);
        assert_eq!(frame.matching.wrong, [(1, Fault::Radius), (2, Fault::NothingThere)]);
        assert!(score.add("b.pcd", &[cylinder(0.0, 0.05)]).is_none());
        assert_eq!((score.frames, score.unjudged, score.required, score.found), (1, 1, 2, 1));
        assert_eq!((score.off, score.unlisted), (1, 1));
        let report = score.report();
        assert!(report.contains("  found     tin: radius +1.0 mm, position 1.0 mm, axis 0.0 deg\n"), "{report}");
        assert!(report.contains("  missed    pot\n") && report.contains("radius is wrong about pot: radius +7.0 mm"));
        assert!(report.contains("1 of 2 found (50 %) in 1 frames; 1 frames not judged"), "{report}");
    }

    #[test]
    fn a_truth_file_of_other_frames_is_told() {
        let mut score = score();
        assert!(score.check().is_ok(), "no frame came");
        score.add("0001.png", &[]);
        let error = score.check().unwrap_err().to_string();
        assert!(error.contains("the first of 1 is `0001.png`, the file has `a.pcd`\n  hint: "), "{error}");
        score.add("a.pcd", &[]);
        assert!(score.check().is_ok());
    }

    #[test]
    fn the_radii_of_an_object_are_summed_up_from_three_frames_on() {
        let mut score = score();
        for (radius, frames) in [(0.049, 1), (0.050, 2), (0.051, 3)] {
            score.add("a.pcd", &[cylinder(0.0, radius)]);
            assert_eq!(score.report().contains("tin: radius 50.0 +- 1.0 mm in 3 frames"), frames == 3);
        }
    }
}
