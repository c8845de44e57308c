//! Measures what was found of each true object of a rendered scene, by mean and standard deviation, and how well identities were
//! kept. Each object gives one row. For recorded frames no truth is known here: each track, or each shape, gives a row.

use super::matching::{Answer, Matcher};
use super::object_stats::{ObjectStats, add_fault_columns, all};
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
    /// By name, in the order of their first frames.
    objects: IndexMap<String, ObjectStats>,
    /// Number of answers that match no object.
    wrong: u64,
    recording: Option<Recording>,
}

/// Frames without a known truth.
struct Recording {
    first_s: f64,
    frames: u64,
}

impl Measurement {
    /// Creates a measurement that leaves out the frames before `from_s`: in simulated time, or for recorded frames since the
    /// first.
    pub fn new(truth: RenderedTruth, from_s: f64) -> Self {
        Self { truth, from_s, matcher: Matcher::default(), objects: IndexMap::new(), wrong: 0, recording: None }
    }

    /// Adds the answers to a frame, and returns an observation of each true object that had to be found.
    ///
    /// # Errors
    /// The frame shows an unknown scene.
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

    /// Returns one row for each object, in the order of their first frames. With several objects, one more row is about all; with
    /// one, its row has these columns, too. For recorded frames, returns one row for each track, or each shape.
    pub fn rows(&self) -> Vec<Row> {
        if let Some(Recording { frames, .. }) = self.recording {
            return self.objects.values().map(|object| object.row_of_recording(frames)).collect();
        }
        let mut rows: Vec<Row> = self.objects.values().map(ObjectStats::row).collect();
        if let [row] = &mut rows[..] {
            add_fault_columns(row, self.objects.values(), self.wrong);
        } else {
            rows.push(all(self.objects.values(), self.wrong));
        }
        rows
    }
}
