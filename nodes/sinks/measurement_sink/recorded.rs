//! Figures of recorded frames, of which nobody knows the truth: how often each track, or each shape, was seen, and mean and
//! standard deviation of what was measured.

use super::row::Row;
use super::sighting::{Sighted, axis};
use crate::sinks::evaluation_sink::matching::perpendicular;
use conicflow_lab::running_stats::RunningStats;
use nalgebra::Vector3;

/// What was seen in recorded frames, one tally for each track, of objects without identity for each shape.
#[derive(Clone, Debug, Default)]
pub struct Recorded {
    /// Number of frames.
    pub frames: u64,
    tallies: Vec<RecordedTally>,
}

#[derive(Clone, Debug, Default)]
struct RecordedTally {
    name: String,
    distance: RunningStats,
    radius: RunningStats,
    half_angle: RunningStats,
}

impl Recorded {
    /// Takes in the answers to a frame.
    pub fn add(&mut self, answers: &[Sighted]) {
        self.frames += 1;
        for answer in answers {
            let kind = answer.object.shape().name();
            let tally = self.tally(&answer.id.map_or_else(|| kind.to_owned(), |id| format!("{kind} {id}")));
            let center = Vector3::from(answer.object.center);
            tally.distance.add(perpendicular(&center, &axis(&answer.object)).norm());
            tally.radius.add(answer.object.radius);
            tally.half_angle.add(answer.object.half_angle);
        }
    }

    fn tally(&mut self, name: &str) -> &mut RecordedTally {
        let index = self.tallies.iter().position(|tally| tally.name == name).unwrap_or_else(|| {
            self.tallies.push(RecordedTally { name: name.to_owned(), ..RecordedTally::default() });
            self.tallies.len() - 1
        });
        &mut self.tallies[index]
    }

    /// One row for each, in the order of their first frames.
    pub fn rows(&self) -> Vec<Row> {
        self.tallies.iter().map(|tally| tally.row(self.frames)).collect()
    }
}

impl RecordedTally {
    fn row(&self, frames: u64) -> Row {
        let mut row = Row::default();
        row.text("object", &self.name);
        row.count("frames", frames);
        row.count("n", self.radius.count());
        row.number("distance_m", self.distance.mean());
        row.number("distance_sd_m", self.distance.deviation());
        row.number("radius_m", self.radius.mean());
        row.number("radius_sd_m", self.radius.deviation());
        row.number("half_angle_deg", self.half_angle.mean().to_degrees());
        row
    }
}
