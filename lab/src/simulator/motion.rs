//! The motion of a scene's objects and camera: positions are functions of time alone, so that any frame can be made without the
//! earlier ones.

use super::fields::{not_negative, share, vector};
use nalgebra::Vector3;
use serde::Deserialize;
use serde::de::{Deserializer, Error};

/// A motion in a scene file: `motion.linear`, `motion.ballistic` or `motion.path`.
#[derive(Clone, Debug, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Motion {
    /// At constant velocity.
    Linear(Linear),
    /// Thrown, and bouncing on a floor.
    Ballistic(Ballistic),
    /// Along way points.
    Path(Path),
}

/// At constant velocity from time 0 on.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Linear {
    /// Metres per second.
    #[serde(deserialize_with = "vector")]
    pub velocity: Vector3<f64>,
}

/// Thrown at time 0, falling, and bouncing on a level floor until it rests there.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Ballistic {
    /// Velocity at time 0, in metres per second.
    #[serde(deserialize_with = "vector")]
    pub velocity: Vector3<f64>,
    /// Share of the speed after a bounce: with 1 it bounces for ever, with 0 it stays down.
    #[serde(default = "most", deserialize_with = "share")]
    pub restitution: f64,
    /// Height of the floor, along the scene's `up`, in metres.
    #[serde(default)]
    pub floor_m: f64,
    /// Two points: it is reflected without loss at the vertical planes through them.
    #[serde(default)]
    pub between: Option<[[f64; 3]; 2]>,
}

fn most() -> f64 {
    0.8
}

/// Along way points.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Path {
    /// Way points, in order of their times.
    #[serde(deserialize_with = "way_points")]
    pub points: Vec<WayPoint>,
    /// Interpolates the way points by a cubic instead of straight lines.
    #[serde(default)]
    pub smooth: bool,
    /// The motion after the last way point.
    #[serde(default)]
    pub then: Then,
}

/// A position at a time.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WayPoint {
    /// Seconds.
    #[serde(deserialize_with = "not_negative")]
    pub t_s: f64,
    /// Displacement from the position in the scene file, in metres.
    #[serde(deserialize_with = "vector")]
    pub offset: Vector3<f64>,
}

/// The motion after the last way point of a [`Path`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Then {
    /// Stays at the last way point.
    #[default]
    Stay,
    /// Starts again at the first way point.
    Repeat,
    /// Goes back and forth along the path.
    Return,
}

fn way_points<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Vec<WayPoint>, D::Error> {
    let points = Vec::<WayPoint>::deserialize(deserializer)?;
    if points.is_empty() {
        return Err(D::Error::custom("expected at least one way point"));
    }
    match points.windows(2).find(|pair| pair[0].t_s >= pair[1].t_s) {
        Some(pair) => Err(D::Error::custom(format!(
            "expected way points in order of time, got `t_s = {}` after `t_s = {}`",
            pair[1].t_s, pair[0].t_s
        ))),
        None => Ok(points),
    }
}

/// The properties of the moving thing and its surroundings that a motion needs.
#[derive(Clone, Copy, Debug)]
pub struct Setting {
    /// Unit vector.
    pub up: Vector3<f64>,
    /// Acceleration of free fall, in m/s^2.
    pub gravity: f64,
    /// The point whose position the scene file gives.
    pub anchor: Vector3<f64>,
    /// Distance that the thing reaches below that point, in metres.
    pub reach_below: f64,
}

impl Motion {
    /// Returns the displacement at a time from the position in the scene file, in metres.
    pub fn displacement(&self, time_s: f64, setting: &Setting) -> Vector3<f64> {
        match self {
            Self::Linear(linear) => linear.velocity * time_s,
            Self::Ballistic(ballistic) => ballistic.displacement(time_s, setting),
            Self::Path(path) => path.offset(time_s),
        }
    }

    /// Returns why the motion is impossible, if it is.
    pub fn fault(&self, setting: &Setting) -> Option<String> {
        let Self::Ballistic(ballistic) = self else { return None };
        let height = ballistic.height_over_floor(setting);
        if !height.is_finite() {
            return Some("a plane without `size` cannot be thrown".into());
        }
        if height < -1e-9 {
            return Some(format!("it starts {:.3} m below its floor (`floor_m`)", -height));
        }
        let (start, _, width) = ballistic.lane(setting)?;
        (!(0.0..=width).contains(&start)).then(|| "it does not start `between` the two points".into())
    }
}

impl Ballistic {
    fn height_over_floor(&self, setting: &Setting) -> f64 {
        setting.anchor.dot(&setting.up) - setting.reach_below - self.floor_m
    }

    /// Returns the distance from the first vertical plane, the unit vector to the second, and the distance between them.
    fn lane(&self, setting: &Setting) -> Option<(f64, Vector3<f64>, f64)> {
        let [first, second] = self.between?.map(Vector3::from);
        let across = second - first;
        let level = across - setting.up * across.dot(&setting.up);
        let width = level.norm();
        let normal = level / width;
        Some(((setting.anchor - first).dot(&normal), normal, width))
    }

    fn displacement(&self, time_s: f64, setting: &Setting) -> Vector3<f64> {
        let upwards = self.velocity.dot(&setting.up);
        let height = self.height_over_floor(setting).max(0.0);
        let risen = bounce(height, upwards, setting.gravity, self.restitution, time_s) - height;
        let level = (self.velocity - setting.up * upwards) * time_s;
        let straight = level + setting.up * risen;
        match self.lane(setting) {
            Some((start, normal, width)) => {
                let ahead = start + level.dot(&normal);
                straight + normal * (to_and_fro(ahead, width) - ahead)
            }
            None => straight,
        }
    }
}

/// Returns the height at a time of a point that starts at `height >= 0` with an upward speed, under gravity, above a floor at 0.
///
/// Between two bounces `h(t) = h0 + v t - g t^2 / 2`; a bounce turns the speed `v` into `restitution v`.
fn bounce(height: f64, upwards: f64, gravity: f64, restitution: f64, time_s: f64) -> f64 {
    let fly = |height: f64, upwards: f64, t: f64| (height + (upwards - 0.5 * gravity * t) * t).max(0.0);
    if gravity <= 0.0 {
        return fly(height, upwards, time_s);
    }
    let impact = (upwards * upwards + 2.0 * gravity * height).sqrt();
    let first = (upwards + impact) / gravity;
    if time_s < first {
        return fly(height, upwards, time_s);
    }
    let (mut speed, mut left) = (impact * restitution, time_s - first);
    if restitution >= 1.0 {
        return fly(0.0, speed, if speed > 0.0 { left % (2.0 * speed / gravity) } else { 0.0 });
    }
    const RESTS: f64 = 1e-4; // m/s, a bounce of less than a nanometre
    while speed > RESTS && left > 2.0 * speed / gravity {
        left -= 2.0 * speed / gravity;
        speed *= restitution;
    }
    if speed > RESTS { fly(0.0, speed, left) } else { 0.0 }
}

/// Folds a distance along a line into [0, width], as if reflected at both ends.
fn to_and_fro(distance: f64, width: f64) -> f64 {
    let turn = distance.rem_euclid(2.0 * width);
    turn.min(2.0 * width - turn)
}

impl Path {
    fn offset(&self, time_s: f64) -> Vector3<f64> {
        let (time_s, _) = self.on_the_way(time_s);
        let next = self.points.partition_point(|point| point.t_s <= time_s);
        match (next.checked_sub(1), self.points.get(next)) {
            (None, _) => self.points[0].offset,
            (Some(previous), None) => self.points[previous].offset,
            (Some(previous), Some(_)) if self.smooth => self.cubic(previous, time_s)[0],
            (Some(previous), Some(to)) => {
                let from = self.points[previous];
                from.offset.lerp(&to.offset, (time_s - from.t_s) / (to.t_s - from.t_s))
            }
        }
    }

    /// Returns the velocity at a time, in metres per second; at a sudden change, the later one.
    pub fn velocity(&self, time_s: f64) -> Vector3<f64> {
        let (time_s, pace) = self.on_the_way(time_s);
        let next = self.points.partition_point(|point| point.t_s <= time_s);
        match (next.checked_sub(1), self.points.get(next)) {
            (Some(previous), Some(_)) if self.smooth => self.cubic(previous, time_s)[1] * pace,
            (Some(previous), Some(to)) => {
                let from = self.points[previous];
                (to.offset - from.offset) * (pace / (to.t_s - from.t_s))
            }
            _ => Vector3::zeros(),
        }
    }

    /// Returns the time within the range of the way points, and its rate: 1, -1 on the way back, 0 at rest.
    fn on_the_way(&self, time_s: f64) -> (f64, f64) {
        let (first, last) = (self.points[0].t_s, self.points[self.points.len() - 1].t_s);
        let (span, since) = (last - first, time_s - first);
        let is_beyond = since > 0.0 && span > 0.0;
        match self.then {
            Then::Repeat if is_beyond => (first + since % span, 1.0),
            Then::Return if is_beyond => {
                let pace = if since % (2.0 * span) < span { 1.0 } else { -1.0 };
                (first + to_and_fro(since, span), pace)
            }
            _ => (time_s.clamp(first, last), if (first..last).contains(&time_s) { 1.0 } else { 0.0 }),
        }
    }

    /// Returns position and velocity on a cubic Hermite spline, whose velocity at a way point is the mean one between its
    /// neighbours (Catmull and Rom, 1974); at rest at both ends.
    fn cubic(&self, previous: usize, time_s: f64) -> [Vector3<f64>; 2] {
        let (from, to) = (self.points[previous], self.points[previous + 1]);
        let span = to.t_s - from.t_s;
        let s = (time_s - from.t_s) / span;
        let (start, end) = (self.velocity_at_point(previous) * span, self.velocity_at_point(previous + 1) * span);
        let step = to.offset - from.offset;
        let (square, cube) = (step * 3.0 - start * 2.0 - end, start + end - step * 2.0);
        let place = from.offset + start * s + square * (s * s) + cube * (s * s * s);
        [place, (start + square * (2.0 * s) + cube * (3.0 * s * s)) / span]
    }

    fn velocity_at_point(&self, index: usize) -> Vector3<f64> {
        match (index.checked_sub(1).map(|i| self.points[i]), self.points.get(index + 1)) {
            (Some(before), Some(after)) => (after.offset - before.offset) / (after.t_s - before.t_s),
            _ => Vector3::zeros(),
        }
    }
}

#[cfg(test)]
#[path = "motion_tests.rs"]
mod tests;
