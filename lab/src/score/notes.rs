//! Notes on a recording, frame by frame: what was found, what was off, and what is not in the truth file; and the sums.

use super::matching::{Comparison, Fault, MatchedFrame, compare, fault};
use super::recorded::{RecordedTruth, file_name};
use super::samples::Score;
use super::summary;
use super::truth::TrueObject;
use crate::running_stats::RunningStats;
use anyhow::{Result, bail};
use conicflow_messages::{Hinted, Object};
use std::collections::{BTreeMap, BTreeSet};

/// Notes on a recording.
#[derive(Clone, Debug, Default)]
pub struct Notes {
    /// Number of frames without a known truth, and the name of the first one.
    unjudged: u64,
    stranger: Option<String>,
    /// The names of the judged frames.
    judged: BTreeSet<String>,
    /// Radii of the right answers by the object's name; those of cones at the true middle.
    radii: BTreeMap<String, RunningStats>,
    text: String,
}

impl Notes {
    /// Counts a frame without a known truth.
    pub fn add_unjudged(&mut self, source: &str) {
        self.unjudged += 1;
        self.stranger.get_or_insert_with(|| source.to_owned());
    }

    /// Notes the result of a frame; `not_wanted` names what a wrong answer is on.
    pub fn add<'a>(&mut self, source: &str, frame: &MatchedFrame, not_wanted: impl Fn(&Object) -> Option<&'a str>) {
        self.text += &format!("{}\n", source.escape_debug());
        self.judged.insert(file_name(source).to_owned());
        for (truth, answer) in &frame.pairs {
            let name = &truth.name;
            let Some(answer) = answer else {
                if truth.required {
                    self.text += &format!("  missed    {name}: {}\n", describe(&truth.body));
                }
                continue;
            };
            let word = if truth.required { "found" } else { "unasked" };
            self.text += &format!("  {word:<9} {name}: {}\n", differences(truth, &answer.object));
            if truth.required {
                self.radii.entry(name.clone()).or_default().add(compare(&truth.body, &answer.object).radius_m);
            }
        }
        for (object, worst) in &frame.wrong {
            let is_about = |truth: &&TrueObject| fault(truth, object).unwrap_or(Fault::Second) == *worst;
            let about = frame.pairs.iter().map(|(truth, _)| truth).find(is_about);
            self.text += &wrong(about, object, *worst, not_wanted(object));
        }
        for (object, what) in &frame.neither {
            self.text += &format!("  neither   {}; on what was not measured: {what}\n", describe(object));
        }
    }

    /// Returns the notes and the sums.
    ///
    /// # Errors
    /// There were frames, but none of them is in the truth file.
    pub fn report(&self, score: &Score, truth: &RecordedTruth) -> Result<String> {
        if let (Some(stranger), 0) = (&self.stranger, score.frames) {
            bail!(Hinted::new(
                format!(
                    "no frame of the recording is in the truth file: the first of {} is `{}`, the file has `{}`",
                    self.unjudged,
                    stranger.escape_debug(),
                    truth.some_frame().unwrap_or_default().escape_debug()
                ),
                "it names each frame as its file is named, with its ending"
            ));
        }
        let mut text = format!("\n== by {}\n\n{}", truth.origin(), self.text) + &sums(score, self.unjudged);
        let absent = truth.judged_frames().filter(|name| !self.judged.contains(*name)).count();
        if absent > 0 {
            text += &format!("{absent} frames of the truth file did not come\n");
        }
        for (name, radii) in self.radii.iter().filter(|(_, radii)| radii.count() > 2) {
            let (mean, sd) = (1e3 * radii.mean(), 1e3 * radii.deviation());
            text += &format!("{name}: radius {mean:.1} +- {sd:.1} mm in {} frames\n", radii.count());
        }
        Ok(text)
    }
}

/// Describes how an answer differs from the truth.
fn differences(truth: &TrueObject, answer: &Object) -> String {
    let Comparison { position_m, radius_m, axis, .. } = compare(&truth.body, answer);
    let (radius, position, axis) = (1e3 * (radius_m - truth.body.radius), 1e3 * position_m, axis.to_degrees());
    format!("radius {radius:+.1} mm, position {position:.1} mm, axis {axis:.1} deg")
}

/// Describes kind, position and radius of an object.
fn describe(object: &Object) -> String {
    let Object { center: [x, y, z], radius, .. } = object;
    format!("{} at ({x:.3}, {y:.3}, {z:.3}) m, radius {:.1} mm", object.shape().name(), 1e3 * radius)
}

/// Describes a wrong answer: the true object that it is wrong about, if there is one, and the unwanted thing that it is on.
fn wrong(about: Option<&TrueObject>, answer: &Object, worst: Fault, not_wanted: Option<&str>) -> String {
    let answer_text = describe(answer) + &not_wanted.map_or_else(String::new, |what| format!(", on {what}"));
    match about.filter(|_| worst != Fault::NothingThere) {
        Some(truth) => {
            let (name, differences) = (&truth.name, differences(truth, answer));
            format!("  off       {answer_text}; {} is wrong about {name}: {differences}\n", worst.name())
        }
        None => format!("  unlisted  {answer_text}\n"),
    }
}

fn sums(score: &Score, unjudged: u64) -> String {
    let row = summary::row(score);
    let number = |column| row.number_of(column).unwrap_or(0.0);
    let or_dash = |number: Option<String>| number.unwrap_or_else(|| "-".to_owned());
    let median = |column| or_dash(row.number_of(column).map(|number| format!("{number:.1}")));
    let faults = score.samples.iter().filter_map(|sample| sample.fault);
    let unlisted = faults.filter(|fault| *fault == Fault::NothingThere).count() as f64;
    let (frames, off) = (number("frames"), number("wrong") - unlisted);
    let per_frame = |count: f64| count / frames.max(1.0);
    format!(
        "\n{} of {} found ({:.0} %) in {frames} frames; {unjudged} frames not judged\n\
         {off} answers off ({:.2} per frame), {unlisted} about what is not listed ({:.2} per frame), {} about what was not \
         measured\n\
         medians of those found: |radius| {} mm, radius {} mm, position {} mm, axis {} deg\n",
        number("found"),
        number("to_find"),
        100.0 * number("recall"),
        per_frame(off),
        per_frame(unlisted),
        number("neither"),
        median("radius_error_mm"),
        or_dash(row.number_of("radius_bias_mm").map(|bias| format!("{bias:+.1}"))),
        median("position_error_mm"),
        median("axis_error_deg")
    )
}

#[cfg(test)]
mod tests {
    use super::super::matching::Claim;
    use super::super::truth::{Tolerance, only};
    use super::*;
    use conicflow_messages::ObjectKind;

    fn tin(radius: f64) -> Object {
        let (center, axis) = ([0.0, 0.0, 1.0], [0.0, 1.0, 0.0]);
        Object { kind: ObjectKind::Cylinder.code(), center, axis, radius, length: 0.1, ..Object::default() }
    }

    fn truth(name: &str, body: Object, required: bool) -> TrueObject {
        let (shapes, radius_m) = (only(body.shape()), [body.radius - 0.005, body.radius + 0.005]);
        let tolerance = Tolerance { shapes, position_m: 0.01, radius_m, axis: 0.1, half_angle: 0.1 };
        TrueObject { name: name.to_owned(), body, hidden: 0.0, required, measured: true, tolerance }
    }

    /// Returns an answer 3 mm beside that object, whose axis leans by two degrees.
    fn beside(object: Object) -> Object {
        let (sine, cosine) = 2_f64.to_radians().sin_cos();
        Object { center: [0.003, 0.0, 1.0], axis: [0.0, cosine, sine], ..object }
    }

    fn frame(pairs: &[(TrueObject, Option<Object>)], wrong: &[(Object, Fault)]) -> MatchedFrame {
        let answered =
            |(truth, object): &(TrueObject, Option<Object>)| (truth.clone(), object.and_then(|it| it.answer()));
        MatchedFrame { pairs: pairs.iter().map(answered).collect(), wrong: wrong.to_vec(), neither: Vec::new() }
    }

    #[test]
    fn what_came_of_a_frame_is_told_line_by_line() {
        let ball = Object { radius: 0.04, length: 0.0, ..Object { kind: ObjectKind::Sphere.code(), ..tin(0.04) } };
        let mut noted = frame(
            &[
                (truth("tin", tin(0.05), true), Some(beside(tin(0.052)))),
                (truth("ball", ball, true), None),
                (truth("glass", tin(0.05), false), Some(tin(0.048))),
                (truth("vase", ball, false), None),
            ],
            &[(beside(tin(0.058)), Fault::Radius), (ball, Fault::NothingThere), (tin(0.05), Fault::Second)],
        );
        noted.neither.push((ball, "handle".to_owned()));
        let mut notes = Notes::default();
        notes.add("a\n.png", &noted, |object| (object.shape() == ObjectKind::Sphere).then_some("carton"));
        let told = [
            "a\\n.png",
            "  found     tin: radius +2.0 mm, position 3.0 mm, axis 2.0 deg",
            "  missed    ball: sphere at (0.000, 0.000, 1.000) m, radius 40.0 mm",
            "  unasked   glass: radius -2.0 mm, position 0.0 mm, axis 0.0 deg",
            "  off       cylinder at (0.003, 0.000, 1.000) m, radius 58.0 mm; radius is wrong about tin: radius +8.0 mm, \
             position 3.0 mm, axis 2.0 deg",
            "  unlisted  sphere at (0.000, 0.000, 1.000) m, radius 40.0 mm, on carton",
            "  off       cylinder at (0.000, 0.000, 1.000) m, radius 50.0 mm; second answer is wrong about tin: radius +0.0 mm, \
             position 0.0 mm, axis 0.0 deg",
            "  neither   sphere at (0.000, 0.000, 1.000) m, radius 40.0 mm; on what was not measured: handle",
        ];
        assert_eq!(notes.text.lines().collect::<Vec<_>>(), told);
    }

    #[test]
    fn answers_that_are_off_and_those_about_nothing_are_counted_apart_for_each_frame() {
        let mut score = Score::default();
        let nowhere = (tin(0.05), Fault::NothingThere);
        let wrong = [nowhere, (tin(0.058), Fault::Radius), nowhere];
        for wrong in [&wrong[..], &[], &[], &[]] {
            score.add("all", &frame(&[(truth("tin", tin(0.05), true), None)], wrong));
        }
        let told = sums(&score, 3);
        assert!(told.contains("0 of 4 found (0 %) in 4 frames; 3 frames not judged\n"), "{told}");
        let counted = "\n1 answers off (0.25 per frame), 2 about what is not listed (0.50 per frame), 0 about";
        assert!(told.contains(counted), "{told}");
        let medians = "\nmedians of those found: |radius| - mm, radius - mm, position - mm, axis - deg\n";
        assert!(told.contains(medians), "{told}");
    }

    /// The answer is 2 cm lower, where the cone is 2 mm wider.
    #[test]
    fn the_radius_of_a_cone_is_that_at_its_true_middle() {
        let cone = Object { kind: ObjectKind::Cone.code(), half_angle: 0.1_f64.atan(), ..tin(0.05) };
        let lower = Object { center: [0.0, 0.02, 1.0], radius: 0.052, ..cone };
        let mut notes = Notes::default();
        notes.add("a.png", &frame(&[(truth("cone", cone, true), Some(lower))], &[]), |_| None);
        assert!((notes.radii["cone"].mean() - 0.05).abs() < 1e-12);
    }
}
