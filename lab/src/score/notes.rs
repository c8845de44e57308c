//! What was found in a recording, what was off, and what nobody listed, frame by frame, to be looked at; and the sums.

use super::evaluation::Score;
use super::matching::{Comparison, Fault, MatchedFrame, compare, fault};
use super::recorded::RecordedTruth;
use super::truth::TrueObject;
use crate::quantile::median;
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

    /// Notes what came of a frame.
    pub fn add(&mut self, source: &str, frame: &MatchedFrame) {
        self.text += &format!("{}\n", source.escape_debug());
        for (truth, answer) in &frame.pairs {
            let name = &truth.name;
            let Some(answer) = answer else {
                if truth.required {
                    self.text += &format!("  missed    {name}\n");
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
            self.text += &wrong(frame.pairs.iter().map(|(truth, _)| truth).find(is_about), object, *worst);
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
        let mut text = self.text.clone() + &sums(score, self.unjudged);
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

/// A wrong answer, and what it is wrong about: what is listed there, or nothing.
fn wrong(about: Option<&TrueObject>, answer: &Object, worst: Fault) -> String {
    let Object { center: [x, y, z], radius, .. } = answer;
    let told = format!("{} at ({x:.3}, {y:.3}, {z:.3}) m, radius {:.1} mm", answer.shape().name(), 1e3 * radius);
    match about.filter(|_| worst != Fault::NothingThere) {
        Some(truth) => {
            let (name, differences) = (&truth.name, differences(truth, answer));
            format!("  off       {told}; {} is wrong about {name}: {differences}\n", worst.name())
        }
        None => format!("  unlisted  {told}\n"),
    }
}

fn sums(score: &Score, unjudged: u64) -> String {
    let frames = score.frames;
    let per_frame = |count: usize| count as f64 / frames.max(1) as f64;
    let faults: Vec<Fault> = score.samples.iter().filter_map(|sample| sample.fault).collect();
    let found = score.samples.iter().filter(|sample| sample.found.is_some()).count();
    let required = score.samples.len() - faults.len();
    let unlisted = faults.iter().filter(|fault| **fault == Fault::NothingThere).count();
    let off = faults.len() - unlisted;
    let share = 100.0 * found as f64 / required.max(1) as f64;
    let median_of = |number: fn(f64, &Comparison) -> f64| {
        let numbers = score.samples.iter().filter_map(|sample| Some(number(sample.radius_m, &sample.found?.0)));
        median(numbers.collect()).unwrap_or(0.0)
    };
    format!(
        "\n{found} of {required} found ({share:.0} %) in {frames} frames; {unjudged} frames not judged\n\
         {off} answers off ({:.2} per frame), {unlisted} about what is not listed ({:.2} per frame)\n\
         medians of those found: |radius| {:.1} mm, radius {:+.1} mm, position {:.1} mm, axis {:.1} deg\n",
        per_frame(off),
        per_frame(unlisted),
        1e3 * median_of(|radius_m, found| (found.radius_m - radius_m).abs()),
        1e3 * median_of(|radius_m, found| found.radius_m - radius_m),
        1e3 * median_of(|_, found| found.position_m),
        median_of(|_, found| found.axis).to_degrees()
    )
}
