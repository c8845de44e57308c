//! One object that is followed: the filters of its parameters, its shape and its life.

use super::ballistic::Ballistic;
use super::detection::{Detection, ShapeParameters, rotated};
use super::filter::{Motion, Size};
use super::life::Life;
use super::motions::{Fall, Motions};
use super::parameters::TrackerParameters;
use super::timeline::Advance;
use conicflow_messages::{Object, ObjectKind, ObjectSigma, Track, TrackState};
use nalgebra::{IsometryMatrix3, Matrix3, Point3, Vector3};

/// What a cylinder that was seen as a cone, or the reverse, costs more than one seen as itself: minus twice the
/// logarithm of one in seven.
const KIND_CHANGE_COST: f64 = 4.0; // [tuned]

/// How long a target may have been looked for in vain, in seconds, and still be found off its way by a push: after that it
/// may be anywhere.
const MANOEUVRE_UNSEEN_S: f64 = 0.2; // [tuned]

/// After so many sights it takes as many and one more to turn the axis of a cone over, however often it was seen.
const SURE_OF_SENSE: u32 = 10; // [algorithmic]

/// The least half-angle that a cone is given, in radians: its apex stays finite.
const MIN_HALF_ANGLE: f64 = 1e-6; // [algorithmic]

/// An object that is followed, in the frame of tracking.
#[derive(Clone, Debug)]
pub struct Target {
    id: u64,
    /// The newest frame that it has taken in, by its time in nanoseconds.
    at_ns: i128,
    /// What it was seen as most often.
    pub kind: ObjectKind,
    /// How long and how often it was seen.
    pub life: Life,
    votes: [u32; ObjectKind::ALL.len()],
    motions: Motions,
    shape: ShapeParameters,
    /// So many more sights had the axis of a cone this way than the other way round. An opposite sight at 0 turns it over.
    sense: u32,
    common: CommonError,
    last_seen: Object,
    /// The source that saw it last.
    pub seen_by: usize,
    /// When that was, in nanoseconds.
    seen_at_ns: i128,
}

/// Covariance of the error that successive sights have in common.
///
/// The filters take errors for independent. To consider one that is not (Schmidt 1966; Bar-Shalom et al., section 8.2.5) is
/// simple here: an offset `b` of all sights is an offset `b` of the position and none of the velocity, since with the sensitivity
/// `S = [I; 0]` an update leaves `S = (I - K H) S + K` as it is. So `P` and the covariance of `b` add up.
#[derive(Clone, Copy, Debug)]
struct CommonError {
    position: Matrix3<f64>,
    radius: f64,
    half_angle: f64,
}

impl CommonError {
    fn of(sight: &Detection, share: f64) -> Self {
        let half_angle = sight.shape.half_angle.map_or(0.0, |half_angle| half_angle.variance * share);
        Self { position: sight.covariance * share, radius: sight.shape.radius.variance * share, half_angle }
    }

    /// That after one more sight; one as a cylinder tells nothing of a cone's half-angle.
    fn after(&self, sight: &Detection, share: f64) -> Self {
        let now = Self::of(sight, share);
        if sight.shape.half_angle.is_some() { now } else { Self { half_angle: self.half_angle, ..now } }
    }
}

impl Target {
    /// A target at its first sight.
    pub fn born(id: u64, first: &Detection, time: &Advance, config: &TrackerParameters) -> Self {
        let mut votes = [0; ObjectKind::ALL.len()];
        votes[first.kind.code() as usize] = 1;
        Self {
            id,
            at_ns: time.at_ns,
            kind: first.kind,
            life: Life::born(config),
            votes,
            motions: Motions::new(first, may_fall(first.kind, config).is_some(), config),
            shape: first.shape,
            sense: 1,
            common: CommonError::of(first, config.common_share),
            last_seen: first.object,
            seen_by: time.source,
            seen_at_ns: time.at_ns,
        }
    }

    /// The target at the time of a frame, before that is looked at; `has_pose`: whether the frame of tracking is the world's.
    pub fn at(&self, time: &Advance, has_pose: bool, config: &TrackerParameters) -> Self {
        let mut then = self.clone();
        let dt = (time.at_ns - self.at_ns) as f64 * 1e-9;
        if dt < 0.0 {
            then.motions.look_back(-dt, config);
        } else {
            then.motions.predict(dt, self.fall(has_pose, config), config);
            then.at_ns = time.at_ns;
        }
        then.shape = then.shape.predicted(dt.abs(), config);
        then
    }

    /// Keeps what became of it in a frame, `then`, in which it was seen or not.
    ///
    /// A late sight is taken in at its own time, with the noise since then added to it, and the motion then goes forward again.
    /// Where another camera saw it last and this one did not, its motion stays: that camera may yet tell of a time before.
    pub fn keep(&mut self, then: &Self, seen: Option<&Detection>, time: &Advance, config: &TrackerParameters) {
        let lag_s = (self.at_ns - time.at_ns).max(0) as f64 * 1e-9;
        match seen {
            Some(seen) if lag_s > 0.0 => {
                self.motions.move_in_time(-lag_s);
                self.see(&seen.told_later(lag_s, config), time, config);
                self.motions.move_in_time(lag_s);
            }
            None if lag_s > 0.0 || then.seen_by != time.source => self.life = then.life.clone(),
            _ => self.clone_from(then),
        }
    }

    /// How it falls, if it may.
    fn fall(&self, has_pose: bool, config: &TrackerParameters) -> Option<Fall> {
        let ballistic = may_fall(self.kind, config)?;
        Some(Fall { ballistic, radius: self.shape.radius.value, has_pose })
    }

    /// Minus twice the logarithm of the likelihood that `detection` is this target, up to a constant; `None` outside the
    /// gate or where shape or radius do not fit.
    pub fn cost(&self, detection: &Detection, config: &TrackerParameters) -> Option<f64> {
        self.cost_of(&self.motions, detection, config)
    }

    /// The same for a target that changed its velocity when it was last seen. Only its size tells it from others, and so has to fit.
    pub fn cost_of_manoeuvre(&self, detection: &Detection, time: &Advance, config: &TrackerParameters) -> Option<f64> {
        let looks_alike =
            self.kind == detection.kind && self.shape.radius.distance2(detection.shape.radius) < config.gate;
        let may_be = self.is_recent() && looks_alike && config.manoeuvre_mps > 0.0;
        may_be.then(|| self.cost_of(&self.pushed(time, config), detection, config))?
    }

    /// Whether it was seen so lately that a push or a throw has not taken it just anywhere.
    fn is_recent(&self) -> bool {
        self.life.misses == 0 || self.life.unseen_s <= MANOEUVRE_UNSEEN_S
    }

    /// Its motions if it changed its velocity when it was last seen.
    fn pushed(&self, time: &Advance, config: &TrackerParameters) -> Motions {
        let since_s = (time.at_ns - self.seen_at_ns).max(0) as f64 * 1e-9;
        self.motions.clone().kicked(since_s, config)
    }

    fn cost_of(&self, motions: &Motions, detection: &Detection, config: &TrackerParameters) -> Option<f64> {
        let kind_cost = kind_cost(self.kind, detection.kind)?;
        let radius_cost = self.radius_cost(detection.shape.radius, config)?;
        let axis_cost = self.axis_cost(detection, config)?;
        let place_cost = motions.cost(detection, self.is_recent(), config)?;
        Some(place_cost + radius_cost + axis_cost + kind_cost + self.life.cost_of_return())
    }

    /// An outlier of the radius costs no more than one at the gate.
    fn radius_cost(&self, measured: Size, config: &TrackerParameters) -> Option<f64> {
        let radius = self.shape.radius;
        let distance2 = radius.distance2(measured);
        let passes = (measured.value - radius.value).abs() <= config.max_radius_change * radius.value;
        let spread = (radius.variance + measured.variance).ln();
        (distance2 < config.gate || passes).then(|| distance2.min(config.gate) + spread)
    }

    /// The same of the axis, for both directions across it. Nothing is known of it where one has none.
    fn axis_cost(&self, detection: &Detection, config: &TrackerParameters) -> Option<f64> {
        let Some((axis, seen)) = self.shape.axis.zip(detection.shape.axis) else { return Some(0.0) };
        let distance2 = axis.distance2(seen);
        let passes = axis.angle(seen) <= config.max_axis_change_deg.to_radians();
        let spread = 2.0 * (axis.variance + seen.variance).max(f64::MIN_POSITIVE).ln();
        (distance2 < config.gate || passes).then(|| distance2.min(config.gate) + spread)
    }

    /// Whether it was seen often enough to be sure of it.
    pub fn is_confirmed(&self) -> bool {
        self.life.state() != TrackState::Tentative
    }

    /// Takes in a sight.
    pub fn see(&mut self, detection: &Detection, time: &Advance, config: &TrackerParameters) {
        if self.cost(detection, config).is_none() {
            self.motions = self.pushed(time, config);
        }
        self.motions.see(detection, config);
        if time.at_ns >= self.seen_at_ns {
            (self.seen_by, self.seen_at_ns) = (time.source, time.at_ns);
        }
        self.shape.radius.update(detection.shape.radius);
        self.shape.length.update(detection.shape.length);
        self.vote(detection);
        self.turn(detection);
        update_or_begin(&mut self.shape.half_angle, detection.shape.half_angle);
        self.common = self.common.after(detection, config.common_share);
        // What `max_radius_change` let pass is a step or an outlier: no noise, so the sigma has to cover it.
        self.common.radius = self.common.radius.max(self.shape.radius.lacking(detection.shape.radius, config.gate));
        self.last_seen = detection.object;
        self.life.seen();
    }

    /// Goes on through a frame in which it was not seen. Where another camera saw it last, that says nothing.
    pub fn miss(&mut self, time: &Advance) {
        if time.source == self.seen_by {
            self.life.missed(time.elapsed_s);
        } else {
            self.life.unwatched(time.elapsed_s);
        }
    }

    /// The shape is the one seen most often; a cylinder that turns out to be a cone takes the sign of its axis.
    fn vote(&mut self, detection: &Detection) {
        let seen = detection.kind.code() as usize;
        self.votes[seen] = self.votes[seen].saturating_add(1);
        if self.votes[seen] <= self.votes[self.kind.code() as usize] || self.kind == detection.kind {
            return;
        }
        self.kind = detection.kind;
        if let (Some(axis), Some(seen)) = (&mut self.shape.axis, detection.shape.axis)
            && axis.direction.dot(&seen.direction) < 0.0
        {
            axis.direction = -axis.direction;
        }
        self.sense = 0;
    }

    /// The direction of the axis is filtered as that of a line. Which way the axis of a cone points is not a matter of more or less:
    /// that holds which was seen most often of late.
    fn turn(&mut self, detection: &Detection) {
        let Some(seen) = detection.shape.axis else { return };
        let Some(axis) = &mut self.shape.axis else {
            self.shape.axis = Some(seen);
            return;
        };
        let agrees = axis.direction.dot(&seen.direction) >= 0.0;
        axis.update(seen);
        if !self.kind.has_half_angle() || !detection.kind.has_half_angle() {
            return;
        }
        match (agrees, self.sense) {
            (true, sense) => self.sense = SURE_OF_SENSE.min(sense + 1),
            (false, 0) => {
                axis.direction = -axis.direction;
                self.sense = 1;
            }
            (false, sense) => self.sense = sense - 1,
        }
    }

    /// The track as it is sent, in the camera frame.
    pub fn track(&self, camera_from_world: &IsometryMatrix3<f64>) -> Track {
        let (rotation, motion) = (&camera_from_world.rotation, self.motions.mean());
        Track {
            id: self.id,
            state: self.life.state().code(),
            age: self.life.age,
            misses: self.life.misses,
            object: self.object(&motion, camera_from_world),
            velocity: (rotation * motion.velocity()).into(),
            velocity_covariance: rotated(&motion.velocity_covariance(), rotation).transpose().into(),
            ..Track::default()
        }
    }

    /// The filtered object. What supports it is that of its last sight, and nothing while it is unseen.
    fn object(&self, motion: &Motion, camera_from_world: &IsometryMatrix3<f64>) -> Object {
        let unseen = Object { points: 0, rows: 0, arc: 0.0, ..self.last_seen };
        let seen = if self.life.misses == 0 { self.last_seen } else { unseen };
        let rotation = &camera_from_world.rotation;
        let center = camera_from_world * Point3::from(motion.position());
        let covariance = motion.position_covariance() + self.common.position;
        let sphere = Object {
            kind: self.kind.code(),
            points: seen.points,
            rows: seen.rows,
            center: center.coords.into(),
            radius: self.shape.radius.value,
            sigma: ObjectSigma {
                center: rotated(&covariance, rotation).transpose().into(),
                radius: (self.shape.radius.variance + self.common.radius).sqrt(),
                ..ObjectSigma::default()
            },
            rms: seen.rms,
            arc: seen.arc,
            confidence: seen.confidence,
            ..Object::default()
        };
        let Some(axis) = self.shape.axis.filter(|_| self.kind.has_axis()) else { return sphere };
        let cylinder = Object {
            axis: (rotation * axis.direction.into_inner()).normalize().into(), // a pose is rounded
            length: self.shape.length.value,
            sigma: ObjectSigma {
                axis: (2.0 * axis.variance).sqrt(),
                length: self.shape.length.variance.sqrt(),
                ..sphere.sigma
            },
            ..sphere
        };
        let Some(half_angle) = self.shape.half_angle.filter(|_| self.kind.has_half_angle()) else { return cylinder };
        let variance = half_angle.variance + self.common.half_angle;
        with_half_angle(cylinder, Size { variance, ..half_angle })
    }
}

/// The cone whose middle is `cylinder`: apex and end radii follow from its radius there and its half-angle.
fn with_half_angle(cylinder: Object, half_angle: Size) -> Object {
    let slope = half_angle.value.max(MIN_HALF_ANGLE).tan();
    let apex = Vector3::from(cylinder.center) - Vector3::from(cylinder.axis) * (cylinder.radius / slope);
    let widening = slope * cylinder.length / 2.0;
    Object {
        half_angle: half_angle.value,
        base_radius: cylinder.radius + widening,
        top_radius: (cylinder.radius - widening).max(0.0),
        apex: apex.into(),
        sigma: ObjectSigma { half_angle: half_angle.variance.sqrt(), ..cylinder.sigma },
        ..cylinder
    }
}

/// How an object of a shape falls, if it may.
fn may_fall(kind: ObjectKind, config: &TrackerParameters) -> Option<Ballistic> {
    config.ballistic.filter(|_| kind == ObjectKind::Sphere)
}

/// Cost of a target of one shape being seen as another; only cylinders and cones are taken for each other.
fn kind_cost(tracked: ObjectKind, seen: ObjectKind) -> Option<f64> {
    if tracked == seen {
        return Some(0.0);
    }
    (tracked.has_axis() && seen.has_axis()).then_some(KIND_CHANGE_COST)
}

fn update_or_begin(size: &mut Option<Size>, measured: Option<Size>) {
    match (size.as_mut(), measured) {
        (Some(size), Some(measured)) => size.update(measured),
        (None, measured) => *size = measured,
        (Some(_), None) => {}
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn ball(config: &TrackerParameters) -> Detection {
        let ball =
            Object { kind: ObjectKind::Sphere.code(), center: [0.0, 0.0, 2.0], radius: 0.1, ..Object::default() };
        Detection::new(&ball, &IsometryMatrix3::identity(), config)
    }

    fn time(at_ms: i128) -> Advance {
        let (source, elapsed_s, usual_s, new_run) = (0, 0.0, f64::INFINITY, false);
        Advance { source, at_ns: at_ms * 1_000_000, elapsed_s, usual_s, new_run }
    }

    #[test]
    fn what_its_own_camera_had_no_chance_to_see_may_have_been_pushed() {
        let config = TrackerParameters::default();
        let mut target = Target::born(1, &ball(&config), &time(0), &config);
        for (source, expected) in [(1, true), (0, false)] {
            target.miss(&Advance { source, elapsed_s: 2.0 * MANOEUVRE_UNSEEN_S, ..time(0) });
            assert_eq!(target.is_recent(), expected, "camera {source}");
        }
    }

    /// Frames of cameras that are late by different times.
    #[test]
    fn a_push_is_as_long_ago_as_the_frame_in_which_it_was_seen_last() {
        let config = TrackerParameters::default();
        let first = ball(&config);
        let mut target = Target::born(1, &first, &time(100), &config);
        // Another camera saw it before, and tells so now.
        let before = Advance { source: 1, ..time(60) };
        target.keep(&target.at(&before, false, &config), Some(&first), &before, &config);
        assert_eq!(target.seen_by, 0, "who saw it last can miss it");
        for (at_ms, since_s) in [(240, 0.14), (220, 0.12), (80, 0.0)] {
            let expected = target.motions.clone().kicked(since_s, &config).mean();
            let off = target.pushed(&time(at_ms), &config).mean().covariance - expected.covariance;
            assert!(off.norm() < 1e-12, "{since_s} s ago");
        }
    }
}
