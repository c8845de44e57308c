//! What the frames say of one true object, summed up.

use super::row::Row;
use super::sighting::{Seen, Sighting};
use crate::sinks::evaluation_sink::matching::perpendicular;
use conicflow_lab::running_stats::RunningStats;
use nalgebra::Vector3;
use std::collections::BTreeSet;

/// Sums over the frames in which an object had to be found.
#[derive(Clone, Debug, Default)]
pub struct Tally {
    /// Name of the object.
    pub name: String,
    frames: u64,
    true_distance: RunningStats,
    true_radius: RunningStats,
    true_half_angle: RunningStats,
    true_speed: RunningStats,
    distance: RunningStats,
    radius: RunningStats,
    half_angle: RunningStats,
    speed: RunningStats,
    squared_error: RunningStats,
    error: RunningStats,
    squared_axis: RunningStats,
    squared_radius_sigmas: RunningStats,
    squared_center_sigmas: RunningStats,
    identities: BTreeSet<u64>,
    switches: u64,
    last: Option<Last>,
    last_id: Option<u64>,
}

/// The frame before.
#[derive(Clone, Copy, Debug)]
struct Last {
    time_s: f64,
    truth: Vector3<f64>,
    seen: Option<Vector3<f64>>,
}

impl Tally {
    /// An object that was not seen yet.
    pub fn new(name: &str) -> Self {
        Self { name: name.to_owned(), ..Self::default() }
    }

    /// Takes in one frame.
    pub fn add(&mut self, sighting: &Sighting) {
        let truth = &sighting.truth;
        self.frames += 1;
        self.true_distance.add(truth.distance_m);
        self.true_radius.add(truth.radius_m);
        self.true_half_angle.add(truth.half_angle);
        self.move_on(sighting);
        let Some(seen) = &sighting.seen else { return };
        let error = (seen.state.position - truth.position).norm();
        self.distance.add(seen.state.distance_m);
        self.radius.add(seen.state.radius_m);
        self.half_angle.add(seen.state.half_angle);
        self.error.add(error);
        self.squared_error.add(error * error);
        self.squared_axis.add(angle(&truth.axis, &seen.state.axis).powi(2));
        seen.sigmas.radius.into_iter().for_each(|error| self.squared_radius_sigmas.add(error * error));
        seen.sigmas.center.into_iter().for_each(|error| self.squared_center_sigmas.add(error * error));
        self.identify(seen);
    }

    /// Speeds: as a track states them, else the way since the frame before over the time, across the axis.
    fn move_on(&mut self, sighting: &Sighting) {
        let (truth, seen) = (&sighting.truth, sighting.seen.as_ref());
        if let Some(last) = self.last {
            let dt = sighting.time_s - last.time_s;
            let way = |from: Vector3<f64>, to: Vector3<f64>| perpendicular(&(to - from), &truth.axis).norm();
            // Frames of one time tell no speed.
            let speed = |from, to| (dt > 0.0).then(|| way(from, to) / dt);
            speed(last.truth, truth.position).into_iter().for_each(|speed| self.true_speed.add(speed));
            let moved = last.seen.zip(seen).and_then(|(from, seen)| speed(from, seen.state.position));
            let measured = seen.and_then(|seen| seen.speed_mps).or(moved);
            measured.into_iter().for_each(|speed| self.speed.add(speed));
        }
        let place = seen.map(|seen| seen.state.position);
        self.last = Some(Last { time_s: sighting.time_s, truth: truth.position, seen: place });
    }

    fn identify(&mut self, seen: &Seen) {
        let Some(id) = seen.id else { return };
        self.switches += u64::from(self.last_id.is_some_and(|last| last != id));
        self.identities.insert(id);
        self.last_id = Some(id);
    }

    fn found(&self) -> u64 {
        self.error.count()
    }

    /// The figures of the object.
    pub fn row(&self) -> Row {
        let degrees = |spread: &RunningStats| spread.mean().to_degrees();
        let mut row = Row::default();
        row.text("object", &self.name);
        row.count("frames", self.frames);
        row.count("n", self.found());
        row.number("distance_true_m", self.true_distance.mean());
        row.number("distance_m", self.distance.mean());
        row.number("distance_sd_m", self.distance.deviation());
        row.number("radius_true_m", self.true_radius.mean());
        row.number("radius_m", self.radius.mean());
        row.number("radius_sd_m", self.radius.deviation());
        row.number("half_angle_true_deg", degrees(&self.true_half_angle));
        row.number("half_angle_deg", degrees(&self.half_angle));
        row.number("speed_true_mps", self.true_speed.mean());
        row.number("speed_mps", self.speed.mean());
        row.number("speed_sd_mps", self.speed.deviation());
        row.number("position_rms_m", self.squared_error.mean().sqrt());
        row.number("axis_rms_deg", self.squared_axis.mean().sqrt().to_degrees());
        row.number("radius_sigmas", self.squared_radius_sigmas.mean().sqrt());
        row.number("center_sigmas", self.squared_center_sigmas.mean().sqrt());
        row.count("identities", self.identities.len() as u64);
        row.count("switches", self.switches);
        row
    }
}

/// The columns of all rows of a `measurement_sink`.
pub const COLUMNS: [&str; 23] = [
    "object",
    "frames",
    "n",
    "distance_true_m",
    "distance_m",
    "distance_sd_m",
    "radius_true_m",
    "radius_m",
    "radius_sd_m",
    "half_angle_true_deg",
    "half_angle_deg",
    "speed_true_mps",
    "speed_mps",
    "speed_sd_mps",
    "position_rms_m",
    "axis_rms_deg",
    "radius_sigmas",
    "center_sigmas",
    "identities",
    "switches",
    "wrong",
    "mota",
    "motp_m",
];

/// The mean over the sights of all objects.
fn pooled(tallies: &[Tally], of: fn(&Tally) -> &RunningStats) -> f64 {
    let known = || tallies.iter().map(of).filter(|spread| spread.count() > 0);
    known().map(|spread| spread.mean() * spread.count() as f64).sum::<f64>()
        / known().map(RunningStats::count).sum::<u64>() as f64
}

/// Angle between two lines, in radians; 0 where one has no direction.
fn angle(a: &Vector3<f64>, b: &Vector3<f64>) -> f64 {
    let (sine, cosine) = (a.cross(b).norm(), a.dot(b).abs());
    if sine == 0.0 { 0.0 } else { sine.atan2(cosine) }
}

/// What is counted over all objects.
#[derive(Clone, Debug, Default)]
pub struct Total {
    /// Answers that were about nothing.
    pub wrong: u64,
}

impl Total {
    /// CLEAR-MOT: `MOTA = 1 - (missed + wrong + switches) / objects`, MOTP is the mean distance of what was found.
    pub fn row(&self, tallies: &[Tally]) -> Row {
        let sum = |count: fn(&Tally) -> u64| tallies.iter().map(count).sum::<u64>();
        let (frames, found) = (sum(|tally| tally.frames), sum(Tally::found));
        let switches = sum(|tally| tally.switches);
        let faults = frames - found + self.wrong + switches;
        let errors = tallies.iter().map(|tally| tally.error.mean() * tally.found() as f64);
        let motp = errors.filter(|error| error.is_finite()).sum::<f64>() / found as f64;
        let mut row = Row::default();
        row.text("object", "all");
        row.count("frames", frames);
        row.count("n", found);
        row.count("identities", sum(|tally| tally.identities.len() as u64));
        row.count("switches", switches);
        row.count("wrong", self.wrong);
        row.number("mota", 1.0 - faults as f64 / frames as f64);
        row.number("motp_m", motp);
        row.number("radius_sigmas", pooled(tallies, |tally| &tally.squared_radius_sigmas).sqrt());
        row.number("center_sigmas", pooled(tallies, |tally| &tally.squared_center_sigmas).sqrt());
        row
    }
}

#[cfg(test)]
mod tests {
    use super::super::sighting::State;
    use super::*;

    #[test]
    fn frames_of_one_time_tell_no_speed() {
        let mut tally = Tally::new("ball");
        for (time_s, x) in [(0.0, 0.0), (0.0, 0.1), (0.5, 0.2)] {
            let position = Vector3::new(x, 0.0, 2.0);
            let axis = Vector3::zeros();
            let truth = State { position, distance_m: 2.0, radius_m: 0.1, half_angle: 0.0, axis };
            let (camera, name) = (Vector3::zeros(), "ball".to_owned());
            tally.add(&Sighting { time_s, camera, name, truth, seen: None });
        }
        assert!((tally.true_speed.mean() - 0.2).abs() < 1e-12, "{:?}", tally.true_speed);
    }
}
