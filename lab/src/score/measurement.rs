//! Measures what was found of each true object of a rendered scene, in mean and standard deviation, and how well identities
//! were kept. Each object gives one row of figures. Of recorded frames nobody knows the truth here: of them each track, or each
//! shape, gives a row.

use super::matching::{Answer, Matcher};
use super::object_stats::{ObjectStats, all, tell_faults};
use super::observation::{Observation, world_from_camera};
use super::row::Row;
use super::truth::RenderedTruth;
use anyhow::Result;
use conicflow_messages::Header;
use indexmap::IndexMap;

/// Measures objects or tracks.
pub struct Measurement {
    truth: RenderedTruth,
    from_s: f64,
    matcher: Matcher,
    /// By their names, in the order of their first frames.
    objects: IndexMap<String, ObjectStats>,
    /// Answers that were about nothing.
    wrong: u64,
    recording: Option<Recording>,
}

/// Frames without a known truth.
struct Recording {
    first_s: f64,
    frames: u64,
}

impl Measurement {
    /// A measurement that leaves out the frames before `from_s`: simulated time, of recorded frames since the first.
    pub fn new(truth: RenderedTruth, from_s: f64) -> Self {
        Self { truth, from_s, matcher: Matcher::default(), objects: IndexMap::new(), wrong: 0, recording: None }
    }

    /// Takes in the answers to a frame; what was seen of each true object that had to be.
    ///
    /// # Errors
    /// The frame shows a scene that is not known.
    pub fn add(&mut self, header: &Header, answers: &[Answer]) -> Result<Vec<Observation>> {
        let time_s = header.stamp_ns as f64 * 1e-9;
        if header.is_recorded() {
            self.add_recorded(time_s, answers);
            return Ok(Vec::new());
        }
        let truths = self.truth.objects(header, &self.truth.scene_of(header)?);
        let frame = self.matcher.match_up(truths, answers);
        if time_s < self.from_s {
            return Ok(Vec::new());
        }
        self.wrong += frame.wrong.len() as u64;
        let pose = world_from_camera(header);
        let mut observations = Vec::new();
        for (truth, answer) in &frame.pairs {
            let mut observation = Observation::new(time_s, truth, answer.as_ref(), &pose);
            if !truth.required {
                self.objects.get_mut(&truth.name).into_iter().for_each(|object| object.pass(&observation));
                continue;
            }
            self.object(&truth.name).add(&mut observation);
            observations.push(observation);
        }
        Ok(observations)
    }

    fn add_recorded(&mut self, time_s: f64, answers: &[Answer]) {
        let recording = self.recording.get_or_insert(Recording { first_s: time_s, frames: 0 });
        if time_s - recording.first_s < self.from_s {
            return;
        }
        recording.frames += 1;
        for answer in answers {
            let mut observation = Observation::without_truth(time_s, answer);
            self.object(&observation.name.clone()).add(&mut observation);
        }
    }

    fn object(&mut self, name: &str) -> &mut ObjectStats {
        self.objects.entry(name.to_owned()).or_insert_with(|| ObjectStats::new(name))
    }

    /// One row for each object that was there, in the order of their first frames; of several one more for all, of one it tells
    /// what is told of all. Of recorded frames one for each track, or each shape.
    pub fn rows(&self) -> Vec<Row> {
        if let Some(Recording { frames, .. }) = self.recording {
            return self.objects.values().map(|object| object.row_of_recording(frames)).collect();
        }
        let mut rows: Vec<Row> = self.objects.values().map(ObjectStats::row).collect();
        if let [row] = &mut rows[..] {
            tell_faults(row, self.objects.values(), self.wrong);
        } else {
            rows.push(all(self.objects.values(), self.wrong));
        }
        rows
    }
}
