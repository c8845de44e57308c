//! Sums over the observations of one object.

use super::matching::perpendicular;
use super::observation::{Observation, State};
use super::row::Statistic::{Deviation, Mean, MeanDegrees, RootMean, RootMeanDegrees};
use super::row::{Column, Row, Sums};
use crate::running_stats::RunningStats;
use nalgebra::Vector3;
use std::collections::BTreeSet;

/// Distance between the true and the observed position of an object, in metres.
fn error_m(observation: &Observation) -> Option<f64> {
    Some((observation.seen?.state.position - observation.truth?.position).norm())
}

/// Angle between the true and the observed axis, in radians; 0 if one has no axis.
fn axis_error(observation: &Observation) -> Option<f64> {
    let (truth, seen) = (observation.truth?.axis, observation.seen?.state.axis);
    let (sine, cosine) = (truth.cross(&seen).norm(), truth.dot(&seen).abs());
    if sine == 0.0 { Some(0.0) } else { Some(sine.atan2(cosine)) }
}

/// The truth, if the object was found: the means of both are over the same frames.
fn truth_of_seen(observation: &Observation) -> Option<State> {
    observation.seen.and(observation.truth)
}

fn squared(number: Option<f64>) -> Option<f64> {
    number.map(|number| number * number)
}

const FIGURES: &[Column<Observation>] = &[
    Column("distance_true_m", Mean, |it| Some(truth_of_seen(it)?.distance_m)),
    Column("distance_m", Mean, |it| Some(it.seen?.state.distance_m)),
    Column("distance_sd_m", Deviation, |it| Some(it.seen?.state.distance_m)),
    Column("radius_true_m", Mean, |it| Some(truth_of_seen(it)?.radius_m)),
    Column("radius_m", Mean, |it| Some(it.seen?.state.radius_m)),
    Column("radius_sd_m", Deviation, |it| Some(it.seen?.state.radius_m)),
    Column("half_angle_true_deg", MeanDegrees, |it| Some(truth_of_seen(it)?.half_angle)),
    Column("half_angle_deg", MeanDegrees, |it| Some(it.seen?.state.half_angle)),
    Column("speed_true_mps", Mean, |it| it.speed_mps.and(it.true_speed_mps)),
    Column("speed_mps", Mean, |it| it.speed_mps),
    Column("speed_sd_mps", Deviation, |it| it.speed_mps),
    Column("position_rms_m", RootMean, |it| squared(error_m(it))),
    Column("axis_rms_deg", RootMeanDegrees, |it| squared(axis_error(it))),
    Column("radius_sigmas", RootMean, |it| squared(it.seen?.sigmas.radius)),
    Column("center_sigmas", RootMean, |it| squared(it.seen?.sigmas.center)),
];

/// Returns the names of all columns that a row of an object, or of all of them, can have.
pub fn columns() -> impl Iterator<Item = &'static str> {
    let figures = FIGURES.iter().map(|Column(name, ..)| *name);
    let counts = ["identities", "switches", "wrong", "mota", "motp_m"];
    ["object", "frames", "n"].into_iter().chain(figures).chain(counts)
}

/// Sums over the frames in which an object had to be found.
pub struct ObjectStats {
    /// Name of the object.
    name: String,
    frames: u64,
    found: u64,
    sums: Sums<Observation>,
    error: RunningStats,
    identities: BTreeSet<u64>,
    switches: u64,
    last: Option<Last>,
    last_id: Option<u64>,
}

/// The previous frame.
#[derive(Clone, Copy)]
struct Last {
    time_s: f64,
    truth: Vector3<f64>,
    seen: Option<Vector3<f64>>,
}

impl ObjectStats {
    /// Creates sums for an object without observations.
    pub fn new(name: &str) -> Self {
        Self {
            name: name.to_owned(),
            frames: 0,
            found: 0,
            sums: Sums::new(FIGURES),
            error: RunningStats::default(),
            identities: BTreeSet::new(),
            switches: 0,
            last: None,
            last_id: None,
        }
    }

    /// Adds a frame, after setting the speeds since the previous one.
    pub fn add(&mut self, observation: &mut Observation) {
        self.set_speeds(observation);
        self.sums.add(observation);
        self.frames += 1;
        if let Some(error_m) = error_m(observation) {
            self.error.add(error_m);
        }
        let seen = observation.seen;
        self.found += u64::from(seen.is_some());
        if let Some(id) = seen.and_then(|seen| seen.id) {
            self.switches += u64::from(self.last_id.is_some_and(|last| last != id));
            self.identities.insert(id);
            self.last_id = Some(id);
        }
        self.pass(observation);
    }

    /// Notes the position of the object in a frame in which it need not be found: the next speed is the one since then.
    pub fn pass(&mut self, observation: &Observation) {
        let Observation { time_s, truth, seen, .. } = *observation;
        if let Some(truth) = truth {
            self.last = Some(Last { time_s, truth: truth.position, seen: seen.map(|seen| seen.state.position) });
        }
    }

    /// Sets the speeds: as a track reports them, or else the distance since the previous frame over the time, across the axis.
    fn set_speeds(&self, observation: &mut Observation) {
        let (Some(last), Some(truth)) = (self.last, observation.truth) else { return };
        let (dt, seen) = (observation.time_s - last.time_s, observation.seen);
        let speed = |from: Vector3<f64>, to: Vector3<f64>| perpendicular(&(to - from), &truth.axis).norm() / dt;
        // no speed between frames of the same time
        if dt > 0.0 {
            observation.true_speed_mps = Some(speed(last.truth, truth.position));
            observation.speed_mps = last.seen.zip(seen).map(|(from, seen)| speed(from, seen.state.position));
        }
        observation.speed_mps = seen.and_then(|seen| seen.stated_speed_mps).or(observation.speed_mps);
    }

    /// Returns the figures of the object.
    pub fn row(&self) -> Row {
        let mut row = self.row_of_recording(self.frames);
        row.count("identities", self.identities.len() as u64);
        row.count("switches", self.switches);
        row
    }

    /// Returns the figures of an object that was seen in a recording of this many frames.
    pub fn row_of_recording(&self, frames: u64) -> Row {
        let mut row = Row::about(&self.name, frames, self.found);
        self.sums.write(&mut row);
        row
    }
}

/// Returns the mean over the observations of all objects.
fn pooled<'a>(objects: impl Iterator<Item = &'a ObjectStats>, of: impl Fn(&ObjectStats) -> RunningStats) -> f64 {
    let known: Vec<_> = objects.map(of).filter(|sum| sum.count() > 0).collect();
    let sum: f64 = known.iter().map(|sum| sum.mean() * sum.count() as f64).sum();
    sum / known.iter().map(RunningStats::count).sum::<u64>() as f64
}

/// Adds the columns that exist only for all objects; `wrong` is the number of answers that match no object. CLEAR-MOT: `MOTA = 1
/// - (missed + wrong + switches) / objects`, and MOTP is the mean distance of the found objects.
pub fn add_fault_columns<'a>(row: &mut Row, objects: impl Iterator<Item = &'a ObjectStats> + Clone, wrong: u64) {
    let sum = |count: fn(&ObjectStats) -> u64| objects.clone().map(count).sum::<u64>();
    let (frames, found) = (sum(|object| object.frames), sum(|object| object.found));
    let faults = frames - found + wrong + sum(|object| object.switches);
    row.count("wrong", wrong);
    row.number("mota", 1.0 - faults as f64 / frames as f64);
    row.number("motp_m", pooled(objects, |object| object.error));
}

/// Returns the row about all objects; `wrong` is the number of answers that match no object.
pub fn all<'a>(objects: impl Iterator<Item = &'a ObjectStats> + Clone, wrong: u64) -> Row {
    let sum = |count: fn(&ObjectStats) -> u64| objects.clone().map(count).sum::<u64>();
    let mut row = Row::about("all", sum(|object| object.frames), sum(|object| object.found));
    row.count("identities", sum(|object| object.identities.len() as u64));
    row.count("switches", sum(|object| object.switches));
    add_fault_columns(&mut row, objects.clone(), wrong);
    for column in ["radius_sigmas", "center_sigmas"] {
        row.number(column, pooled(objects.clone(), |object| object.sums.of(column)).sqrt());
    }
    row
}

#[cfg(test)]
mod tests {
    use super::super::observation::{Sighting, State};
    use super::super::sigmas::Sigmas;
    use super::*;

    #[test]
    fn axes_differ_by_their_angle_whatever_their_sense_and_what_has_none_has_no_error() {
        let state = |axis: Vector3<f64>| {
            let position = Vector3::new(0.0, 0.0, 2.0);
            State { position, distance_m: 2.0, radius_m: 0.1, half_angle: 0.0, axis }
        };
        let error = |truth: Vector3<f64>, seen: Vector3<f64>| {
            let seen = Sighting { state: state(seen), id: None, stated_speed_mps: None, sigmas: Sigmas::default() };
            axis_error(&Observation { truth: Some(state(truth)), seen: Some(seen), ..Observation::default() }).unwrap()
        };
        let leaning = Vector3::new(0.3_f64.sin(), 0.3_f64.cos(), 0.0);
        for (truth, seen, expected) in [
            (Vector3::y(), leaning, 0.3),
            (Vector3::y(), -leaning, 0.3),
            (Vector3::y(), Vector3::z(), std::f64::consts::FRAC_PI_2),
            (Vector3::y(), Vector3::y(), 0.0),
            (Vector3::zeros(), Vector3::y(), 0.0),
        ] {
            assert!((error(truth, seen) - expected).abs() < 1e-12, "{truth} {seen}");
        }
    }

    fn sight(time_s: f64, x: f64, seen: Option<f64>) -> Observation {
        let at = |x: f64| {
            let (position, axis) = (Vector3::new(x, 0.0, 2.0), Vector3::zeros());
            State { position, distance_m: 2.0 + x, radius_m: 0.1, half_angle: 0.0, axis }
        };
        let seen = seen.map(|x| Sighting { state: at(x), id: None, stated_speed_mps: None, sigmas: Sigmas::default() });
        Observation { time_s, truth: Some(at(x)), seen, ..Observation::default() }
    }

    #[test]
    fn frames_of_one_time_tell_no_speed() {
        let mut ball = ObjectStats::new("ball");
        for (time_s, x) in [(0.0, 0.0), (0.0, 0.1), (0.5, 0.2)] {
            ball.add(&mut sight(time_s, x, Some(x)));
        }
        assert!((ball.row().number_of("speed_true_mps").unwrap() - 0.2).abs() < 1e-12, "{:?}", ball.row());
    }

    /// The object moves away, and faster, while it is not found.
    #[test]
    fn the_truth_is_told_of_the_frames_in_which_it_was_seen() {
        let mut ball = ObjectStats::new("ball");
        for (time_s, x, seen) in [(0.0, 0.0, Some(0.0)), (1.0, 0.2, Some(0.2)), (2.0, 3.0, None), (3.0, 9.0, None)] {
            ball.add(&mut sight(time_s, x, seen));
        }
        let row = ball.row();
        for (column, expected) in
            [("distance_true_m", 2.1), ("distance_m", 2.1), ("speed_true_mps", 0.2), ("speed_mps", 0.2)]
        {
            assert!((row.number_of(column).unwrap() - expected).abs() < 1e-12, "{column}: {row:?}");
        }
    }
}
