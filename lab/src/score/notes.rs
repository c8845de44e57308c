//! What was found in a recording, what was off, and what nobody listed, frame by frame, to be looked at; and the sums.

use super::matching::{Comparison, Fault, MatchedFrame, compare, fault};
use super::recorded::RecordedTruth;
use super::samples::Score;
use super::summary;
use super::truth::TrueObject;
use crate::running_stats::RunningStats;
use anyhow::{Result, bail};
use conicflow_messages::{Hinted, Object};
use std::collections::BTreeMap;

/// Notes on a recording.
#[derive(Clone, Debug, Default)]
pub struct Notes {
    /// Number of frames whose truth is not known, and the name of the first of them.
    unjudged: u64,
    stranger: Option<String>,
    /// Radii of the right answers, by the object's name.
    radii: BTreeMap<String, RunningStats>,
    text: String,
}

impl Notes {
    /// Counts a frame whose truth is not known.
    pub fn add_unjudged(&mut self, source: &str) {
        self.unjudged += 1;
        self.stranger.get_or_insert_with(|| source.to_owned());
    }

    /// Notes what came of a frame; `not_wanted` tells what an answer sits on that is no right one.
    pub fn add<'a>(&mut self, source: &str, frame: &MatchedFrame, not_wanted: impl Fn(&Object) -> Option<&'a str>) {
        self.text += &format!("{}\n", source.escape_debug());
        for (truth, answer) in &frame.pairs {
            let name = &truth.name;
            let Some(answer) = answer else {
                if truth.required {
                    self.text += &format!("  missed    {name}: {}\n", told(&truth.body));
                }
                continue;
            };
            let word = if truth.required { "found" } else { "unasked" };
            self.text += &format!("  {word:<9} {name}: {}\n", differences(truth, &answer.object));
            if truth.required {
                self.radii.entry(name.clone()).or_default().add(answer.object.radius);
            }
        }
        for (object, worst) in &frame.wrong {
            let is_about = |truth: &&TrueObject| fault(truth, object).unwrap_or(Fault::Second) == *worst;
            let about = frame.pairs.iter().map(|(truth, _)| truth).find(is_about);
            self.text += &wrong(about, object, *worst, not_wanted(object));
        }
        for (object, what) in &frame.neither {
            self.text += &format!("  neither   {}; on what was not measured: {what}\n", told(object));
        }
    }

    /// The notes and the sums.
    ///
    /// # Errors
    /// Frames came, and the truth file has none of them.
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
        for (name, radii) in self.radii.iter().filter(|(_, radii)| radii.count() > 2) {
            let (mean, sd) = (1e3 * radii.mean(), 1e3 * radii.deviation());
            text += &format!("{name}: radius {mean:.1} +- {sd:.1} mm in {} frames\n", radii.count());
        }
        Ok(text)
    }
}

/// How an answer differs from the truth.
fn differences(truth: &TrueObject, answer: &Object) -> String {
    let Comparison { position_m, radius_m, axis, .. } = compare(&truth.body, answer);
    let (radius, position, axis) = (1e3 * (radius_m - truth.body.radius), 1e3 * position_m, axis.to_degrees());
    format!("radius {radius:+.1} mm, position {position:.1} mm, axis {axis:.1} deg")
}

/// Kind, place and radius of an object.
fn told(object: &Object) -> String {
    let Object { center: [x, y, z], radius, .. } = object;
    format!("{} at ({x:.3}, {y:.3}, {z:.3}) m, radius {:.1} mm", object.shape().name(), 1e3 * radius)
}

/// A wrong answer, and what it is wrong about: what is listed there, or nothing; and what it sits on that is not wanted.
fn wrong(about: Option<&TrueObject>, answer: &Object, worst: Fault, not_wanted: Option<&str>) -> String {
    let told = told(answer) + &not_wanted.map_or_else(String::new, |what| format!(", on {what}"));
    match about.filter(|_| worst != Fault::NothingThere) {
        Some(truth) => {
            let (name, differences) = (&truth.name, differences(truth, answer));
            format!("  off       {told}; {} is wrong about {name}: {differences}\n", worst.name())
        }
        None => format!("  unlisted  {told}\n"),
    }
}

fn sums(score: &Score, unjudged: u64) -> String {
    let row = summary::row(score);
    let number = |column| row.number_of(column).unwrap_or(0.0);
    let faults = score.samples.iter().filter_map(|sample| sample.fault);
    let unlisted = faults.filter(|fault| *fault == Fault::NothingThere).count() as f64;
    let (frames, off) = (number("frames"), number("wrong") - unlisted);
    let per_frame = |count: f64| count / frames.max(1.0);
    format!(
        "\n{} of {} found ({:.0} %) in {frames} frames; {unjudged} frames not judged\n\
         {off} answers off ({:.2} per frame), {unlisted} about what is not listed ({:.2} per frame), {} about what was not \
         measured\n\
         medians of those found: |radius| {:.1} mm, radius {:+.1} mm, position {:.1} mm, axis {:.1} deg\n",
        number("found"),
        number("to_find"),
        100.0 * number("recall"),
        per_frame(off),
        per_frame(unlisted),
        number("neither"),
        number("radius_error_mm"),
        number("radius_bias_mm"),
        number("position_error_mm"),
        number("axis_error_deg")
    )
}
