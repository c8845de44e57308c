//! A tracked object: the filters of its parameters, its shape and its life.

use super::ballistic::Ballistic;
use super::detection::{Detection, ShapeParameters, rotated};
use super::filter::{Motion, Size};
use super::life::Life;
use super::motions::{Fall, Motions};
use super::parameters::TrackerParameters;
use super::timeline::Advance;
use conicflow_messages::{Object, ObjectKind, ObjectSigma, Track, TrackState};
use nalgebra::{IsometryMatrix3, Matrix3, Point3, Vector3};

/// Cost of a cylinder that was seen as a cone, or the reverse, over one seen as itself: minus twice the logarithm of one in
/// seven.
const KIND_CHANGE_COST: f64 = 4.0; // [tuned]

/// Longest time for which a target may be unseen and still be found as one that was pushed, in seconds: after that it may be
/// anywhere.
const MANOEUVRE_UNSEEN_S: f64 = 0.2; // [tuned]

/// Upper bound of `Target::sense`: however often the axis of a cone was seen one way, this many opposite sightings and one more
/// turn it over.
const SURE_OF_SENSE: u32 = 10; // [tuned]

/// Lower bound of the half-angle from which the apex of a cone is computed, in radians, which keeps the apex finite.
const MIN_HALF_ANGLE: f64 = 1e-6; // [algorithmic]

/// A tracked object, in the tracking frame.
#[derive(Clone, Debug)]
pub struct Target {
    id: u64,
    /// Time of the state: that of the newest frame taken in, in nanoseconds.
    at_ns: i128,
    /// Kind as which the object was seen most often.
    pub kind: ObjectKind,
    /// Life cycle of the track: how long and how often it was seen.
    pub life: Life,
    votes: [u32; ObjectKind::ALL.len()],
    motions: Motions,
    shape: ShapeParameters,
    /// By how many sightings the present direction of a cone's axis leads over the opposite one. An opposite sighting at 0 turns
    /// the axis over.
    sense: u32,
    common: CommonError,
    last_seen: Object,
    /// Source that saw the object last.
    pub seen_by: usize,
    /// Time when `seen_by` saw the object, in nanoseconds.
    seen_at_ns: i128,
}

/// Covariance of the error that successive sightings share.
///
/// The filters assume independent errors. The shared error is considered separately (Schmidt 1966; Bar-Shalom et al., section
/// 8.2.5), which is simple here: an offset `b` of all sightings is an offset `b` of the position and none of the velocity, since
/// an update leaves the sensitivity `S = [I; 0]` as it is, `S = (I - K H) S + K`. So `P` and the covariance of `b` add up.
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

    /// Returns the covariance after one more sighting. A sighting as a cylinder leaves that of a cone's half-angle as it is.
    fn after(&self, sight: &Detection, share: f64) -> Self {
        let now = Self::of(sight, share);
        if sight.shape.half_angle.is_some() { now } else { Self { half_angle: self.half_angle, ..now } }
    }
}

impl Target {
    /// Creates a target from its first sighting.
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

    /// Returns the target predicted to the time of a frame, before that frame is used; `has_pose`: whether the tracking frame is
    /// the world's.
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

    /// Keeps the state `predicted` after a frame in which the target was seen or not.
    ///
    /// A late sighting is taken in at its own time, with the process noise since then added to it, and the motion is moved
    /// forward again. If another camera saw the target last and this one missed it, its motion stays, because that camera may
    /// still send an earlier frame.
    pub fn commit(&mut self, predicted: &Self, seen: Option<&Detection>, time: &Advance, config: &TrackerParameters) {
        let lag_s = (self.at_ns - time.at_ns).max(0) as f64 * 1e-9;
        match seen {
            Some(seen) if lag_s > 0.0 => {
                self.motions.move_in_time(-lag_s);
                self.see(&seen.delayed(lag_s, config), time, config);
                self.motions.move_in_time(lag_s);
            }
            None if lag_s > 0.0 || predicted.seen_by != time.source => self.life = predicted.life.clone(),
            _ => self.clone_from(predicted),
        }
    }

    /// Returns the model of the target's fall, if it may fall.
    fn fall(&self, has_pose: bool, config: &TrackerParameters) -> Option<Fall> {
        let ballistic = may_fall(self.kind, config)?;
        Some(Fall { ballistic, radius: self.shape.radius.value, has_pose })
    }

    /// Returns minus twice the logarithm of the likelihood that `detection` is this target, up to a constant; `None` outside the
    /// gate or where shape or radius do not match.
    pub fn cost(&self, detection: &Detection, config: &TrackerParameters) -> Option<f64> {
        self.cost_of(&self.motions, detection, config)
    }

    /// Returns the cost of a pair, as [`Self::cost`] does, for a target that changed its velocity when it was last seen. Only its
    /// size distinguishes it from others, so the size has to pass the gate.
    pub fn cost_of_manoeuvre(&self, detection: &Detection, time: &Advance, config: &TrackerParameters) -> Option<f64> {
        let looks_alike =
            self.kind == detection.kind && self.shape.radius.distance2(detection.shape.radius) < config.gate;
        let may_be = self.is_recent() && looks_alike && config.manoeuvre_mps > 0.0;
        may_be.then(|| self.cost_of(&self.pushed(time, config), detection, config))?
    }

    /// Returns whether the target was seen so recently that a push cannot have moved it anywhere.
    fn is_recent(&self) -> bool {
        self.life.misses == 0 || self.life.unseen_s <= MANOEUVRE_UNSEEN_S
    }

    /// Returns the motions of the target if it changed its velocity when it was last seen.
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

    /// Returns the cost of the radius; an outlier costs no more than a radius at the gate.
    fn radius_cost(&self, measured: Size, config: &TrackerParameters) -> Option<f64> {
        let radius = self.shape.radius;
        let distance2 = radius.distance2(measured);
        let passes = (measured.value - radius.value).abs() <= config.max_radius_change * radius.value;
        let spread = (radius.variance + measured.variance).ln();
        (distance2 < config.gate || passes).then(|| distance2.min(config.gate) + spread)
    }

    /// Returns the cost of the axis, for both directions across it, where an outlier costs no more than an axis at the gate; 0
    /// where target or detection has no axis.
    fn axis_cost(&self, detection: &Detection, config: &TrackerParameters) -> Option<f64> {
        let Some((axis, seen)) = self.shape.axis.zip(detection.shape.axis) else { return Some(0.0) };
        let distance2 = axis.distance2(seen);
        let passes = axis.angle(seen) <= config.max_axis_change_deg.to_radians();
        let spread = 2.0 * (axis.variance + seen.variance).max(f64::MIN_POSITIVE).ln();
        (distance2 < config.gate || passes).then(|| distance2.min(config.gate) + spread)
    }

    /// Returns whether the target was seen often enough to be confirmed.
    pub fn is_confirmed(&self) -> bool {
        self.life.state() != TrackState::Tentative
    }

    /// Updates the target with a sighting.
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
        // A change that `max_radius_change` let pass is a step or an outlier, not noise, so the sigma has to cover it.
        self.common.radius = self.common.radius.max(self.shape.radius.lacking(detection.shape.radius, config.gate));
        self.last_seen = detection.object;
        self.life.seen();
    }

    /// Records a frame in which the target was not seen. If another camera saw it last, the frame is no miss.
    pub fn miss(&mut self, time: &Advance) {
        if time.source == self.seen_by {
            self.life.missed(time.elapsed_s);
        } else {
            self.life.not_observed(time.elapsed_s);
        }
    }

    /// Counts the shape of a sighting: the target's shape is the one seen most often. A cylinder that becomes a cone takes the
    /// direction of the cone's axis.
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

    /// Filters the direction of the axis as that of a line. For a cone the sense of the axis is the one that was seen most often
    /// of late.
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

    /// Returns the track as it is published, in the camera frame.
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

    /// Returns the filtered object. Its points, rows and arc are those of the last sighting, or 0 while it is unseen.
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

/// Returns the cone whose middle is `cylinder`: apex and end radii follow from the radius there and the half-angle.
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

/// Returns the ballistic model of a shape that may fall.
fn may_fall(kind: ObjectKind, config: &TrackerParameters) -> Option<Ballistic> {
    config.ballistic.filter(|_| kind == ObjectKind::Sphere)
}

/// Returns the cost of seeing a target of one shape as another; only cylinders and cones may be confused.
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

    /// The frames of the cameras are late by different times.
    #[test]
    fn a_push_is_as_long_ago_as_the_frame_in_which_it_was_seen_last() {
        let config = TrackerParameters::default();
        let first = ball(&config);
        let mut target = Target::born(1, &first, &time(100), &config);
        // Another camera saw it earlier, and its frame arrives now.
        let before = Advance { source: 1, ..time(60) };
        target.commit(&target.at(&before, false, &config), Some(&first), &before, &config);
        assert_eq!(target.seen_by, 0, "who saw it last can miss it");
        for (at_ms, since_s) in [(240, 0.14), (220, 0.12), (80, 0.0)] {
            let expected = target.motions.clone().kicked(since_s, &config).mean();
            let off = target.pushed(&time(at_ms), &config).mean().covariance - expected.covariance;
            assert!(off.norm() < 1e-12, "{since_s} s ago");
        }
    }
}
