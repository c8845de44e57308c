//! Interacting multiple models of motion (Blom, Bar-Shalom, IEEE Transactions on Automatic Control, 1988; Bar-Shalom, Li,
//! Kirubarajan 2001, section 11.6.6). How an object moves is not known beforehand: it stands or moves evenly, is carried, is
//! thrown about, or falls. Each of these is a model with its own filter, and the detections determine the probability of each.
//!
//! An object that is seen starts to follow a new model at the rate `r`, any of the `N` that it may follow. So after `dt` seconds
//! model `j` has the probability `c_j = h w_j + (1 - h) / N` with `h = exp(-r dt)`, and its filter continues from a mixture of
//! its own motion, of weight `h w_j`, and of the mean over all models. A detection `z` then gives `w_j ~ c_j N(z; H x_j, S_j)`.

use super::ballistic::Ballistic;
use super::detection::Detection;
use super::filter::{Innovation, Motion};
use super::parameters::TrackerParameters;
use nalgebra::Matrix3;

/// Rate at which an object starts to move in another way, per second.
const CHANGES_PER_S: f64 = 0.5; // [tuned]

/// A way to move.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Manner {
    /// With hardly any acceleration; this includes standing still.
    Uniform,
    IsCarried,
    IsThrown,
    Falls,
}

impl Manner {
    /// All but the fall, which only some objects may follow.
    const COMMON: [Self; 3] = [Self::Uniform, Self::IsCarried, Self::IsThrown];

    /// Returns its acceleration in units of `acceleration`, the usual one: the steps of ten leave no motion far from a model.
    fn strength(self) -> f64 {
        match self {
            Self::Uniform => 0.1, // [tuned]
            Self::IsCarried | Self::Falls => 1.0,
            Self::IsThrown => 10.0, // [tuned]
        }
    }

    /// Spectral density of the random acceleration, in m^2/s^3.
    fn density(self, config: &TrackerParameters) -> f64 {
        (self.strength() * config.acceleration).powi(2)
    }

    /// Standard deviation of the speed at the first detection, per axis, in m/s. Most objects that move evenly stand still.
    fn initial_speed(self, config: &TrackerParameters) -> f64 {
        self.strength().min(1.0) * config.initial_speed_mps
    }
}

/// One model: the motion of the object in this manner.
#[derive(Clone, Debug)]
struct Model {
    manner: Manner,
    /// Probability that the object moves in this manner; 0 if it cannot.
    probability: f64,
    motion: Motion,
}

/// The fall of a ball.
#[derive(Clone, Copy, Debug)]
pub struct Fall {
    /// Gravity, and the floor on which the ball bounces.
    pub ballistic: Ballistic,
    /// The radius of the ball, in metres.
    pub radius: f64,
    /// Whether the tracking frame is the world's.
    pub has_pose: bool,
}

/// The motion of one object by each model.
#[derive(Clone, Debug)]
pub struct Motions {
    models: [Model; Manner::COMMON.len() + 1],
    /// Whether a detection came in time after the last prediction: only then is it known how the object moved.
    updated_in_time: bool,
}

impl Motions {
    /// Creates the motion of an object that was seen once; `falls`: it may fall.
    pub fn new(first: &Detection, falls: bool, config: &TrackerParameters) -> Self {
        let model = |manner: Manner| Model {
            manner,
            probability: f64::from(u8::from(falls || manner != Manner::Falls)),
            motion: Motion::new(first.position, first.covariance, manner.initial_speed(config)),
        };
        let [a, b, c] = Manner::COMMON.map(model);
        let mut motions = Self { models: [a, b, c, model(Manner::Falls)], updated_in_time: true };
        motions.normalise();
        motions
    }

    /// Returns the mean over all models.
    pub fn mean(&self) -> Motion {
        Motion::mixture(self.models.iter().map(|model| (model.probability, &model.motion)))
    }

    /// Predicts the motion `dt` seconds later; `fall`: the fall of the object, if it may fall. The models of an unseen object
    /// keep their probabilities.
    pub fn predict(&mut self, dt: f64, fall: Option<Fall>, config: &TrackerParameters) {
        self.mix(if self.updated_in_time { dt } else { 0.0 }, fall.is_some());
        self.updated_in_time = false;
        for model in &mut self.models {
            model.motion.predict(dt, model.manner.density(config));
            if let Some(Fall { ballistic, radius, has_pose }) = fall.filter(|_| model.manner == Manner::Falls) {
                model.motion = ballistic.fallen(model.motion.clone(), dt, radius, has_pose);
            }
        }
    }

    /// Moves the motion back by `dt` seconds, to before its last detection, with the noise of that time.
    pub fn look_back(&mut self, dt: f64, config: &TrackerParameters) {
        self.move_in_time(-dt);
        self.models.iter_mut().for_each(|model| model.motion.blur(-dt, model.manner.density(config)));
    }

    /// Mixes the models, because the object may have started to follow another one within `dt` seconds; `falls`: also a fall.
    fn mix(&mut self, dt: f64, falls: bool) {
        let mean = self.mean();
        let stays = (-CHANGES_PER_S * dt).exp();
        let possible = (Manner::COMMON.len() + usize::from(falls)) as f64;
        // Never 0: a model that seemed impossible may be all that is left.
        let begins = ((1.0 - stays) / possible).max(f64::MIN_POSITIVE);
        for model in &mut self.models {
            if model.manner == Manner::Falls && !falls {
                model.probability = 0.0;
                continue;
            }
            let kept = stays * model.probability;
            model.motion = Motion::mixture([(kept, &model.motion), (begins, &mean)].into_iter());
            model.probability = kept + begins;
        }
        self.normalise();
    }

    /// Moves the motions by `dt` seconds, backwards if negative, without adding noise.
    pub fn move_in_time(&mut self, dt: f64) {
        self.models.iter_mut().for_each(|model| model.motion.move_in_time(dt));
    }

    /// Returns the motions of an object that was pushed at the start of the last `dt` seconds.
    #[must_use]
    pub fn kicked(mut self, dt: f64, config: &TrackerParameters) -> Self {
        self.models.iter_mut().for_each(|model| model.motion = model.motion.kicked(dt, config.manoeuvre_mps));
        self
    }

    /// Returns minus twice the logarithm of the likelihood of a detection's position, up to a constant; `None` outside the gate
    /// of every model. `is_recent`: the object was seen recently. If not, the model of a throw is left out, because a throw may
    /// have taken it anywhere.
    pub fn cost(&self, seen: &Detection, is_recent: bool, config: &TrackerParameters) -> Option<f64> {
        let models = self.models.iter().filter(|model| is_recent || model.manner != Manner::IsThrown);
        let near =
            models.filter(|model| model.motion.may_be_within(config.gate, &seen.position, &model.noise(seen, config)));
        let costs = near.filter_map(|model| {
            let innovation = model.innovation(seen, config)?;
            (innovation.distance2() < config.gate).then(|| model.cost(&innovation))
        });
        costs.reduce(|a, b| a.min(b) - 2.0 * (-0.5 * (a - b).abs()).exp().ln_1p())
    }

    /// Updates the motions with a detection.
    pub fn see(&mut self, seen: &Detection, config: &TrackerParameters) {
        let mut costs = [f64::INFINITY; Manner::COMMON.len() + 1];
        for (model, cost) in self.models.iter_mut().zip(&mut costs) {
            if let Some(innovation) = model.innovation(seen, config) {
                *cost = model.cost(&innovation);
                model.motion.update(&innovation, &model.noise(seen, config));
            }
        }
        let least = costs.iter().copied().fold(f64::INFINITY, f64::min);
        // The update with a late detection ignores the correlation of the present state with the acceleration since then. The
        // error grows with the acceleration of a model, so a late detection leaves the probabilities as they are.
        if least.is_finite() && seen.late_s == 0.0 {
            self.updated_in_time = true;
            let models = self.models.iter_mut().zip(costs);
            models.for_each(|(model, cost)| model.probability = (-0.5 * (cost - least)).exp());
            self.normalise();
        }
    }

    /// Scales the probabilities to a sum of one.
    fn normalise(&mut self) {
        let sum: f64 = self.models.iter().map(|model| model.probability).sum();
        self.models.iter_mut().for_each(|model| model.probability /= sum);
    }
}

impl Model {
    /// Returns the covariance of a detection's position for this model. A late detection is less certain about the present: the
    /// noise `Q` of acceleration in the time since then adds `[I, -dt I] Q [I, -dt I]' = q dt^3 / 3`.
    fn noise(&self, seen: &Detection, config: &TrackerParameters) -> Matrix3<f64> {
        let spread = self.manner.density(config) * seen.late_s.powi(3) / 3.0;
        seen.covariance + Matrix3::from_diagonal_element(spread)
    }

    /// Returns the innovation; `None` for a model that the object cannot follow.
    fn innovation(&self, seen: &Detection, config: &TrackerParameters) -> Option<Innovation> {
        let may_be = self.probability > 0.0;
        may_be.then(|| self.motion.innovation(&seen.position, &self.noise(seen, config)))?
    }

    fn cost(&self, innovation: &Innovation) -> f64 {
        innovation.distance2() + innovation.ln_determinant() - 2.0 * self.probability.ln()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::{Object, ObjectKind};
    use nalgebra::{IsometryMatrix3, Vector3};

    const PERIOD_S: f64 = 1.0 / 30.0;

    fn config() -> TrackerParameters {
        TrackerParameters { floor_center_m: 0.002, ..TrackerParameters::default() }
    }

    fn ball(center: [f64; 3]) -> Detection {
        let ball = Object { kind: ObjectKind::Sphere.code(), center, radius: 0.1, ..Object::default() };
        Detection::new(&ball, &IsometryMatrix3::identity(), &config())
    }

    /// The most probable manner of a ball that was seen at `place` in each frame, and all of its motions.
    fn after(fall: Option<Fall>, frames: u32, place: impl Fn(f64) -> [f64; 3]) -> (Manner, Motions) {
        let mut motions = Motions::new(&ball(place(0.0)), fall.is_some(), &config());
        for frame in 1..frames {
            motions.predict(PERIOD_S, fall, &config());
            motions.see(&ball(place(f64::from(frame) * PERIOD_S)), &config());
        }
        let best = motions.models.iter().max_by(|a, b| a.probability.total_cmp(&b.probability)).unwrap();
        (best.manner, motions)
    }

    #[test]
    fn what_is_seen_tells_how_an_object_moves() {
        let fall = Fall { ballistic: Ballistic::default(), radius: 0.1, has_pose: false };
        let still = |_| [0.0, 0.0, 2.0];
        let carried = |time: f64| [0.1 * (5.0 * time).sin(), 0.0, 2.0];
        let shaken = |time: f64| [0.1 * (20.0 * time).sin(), 0.0, 2.0];
        let falling = |time: f64| [0.0, 4.905 * time * time, 2.0];
        for fall in [None, Some(fall)] {
            assert_eq!(after(fall, 30, still).0, Manner::Uniform);
            assert_eq!(after(fall, 30, |time| [0.4 * time, 0.0, 2.0]).0, Manner::Uniform);
            assert_eq!(after(fall, 30, carried).0, Manner::IsCarried);
            assert_eq!(after(fall, 30, shaken).0, Manner::IsThrown);
        }
        assert_eq!(after(Some(fall), 30, falling).0, Manner::Falls);
        assert_eq!(after(None, 30, falling).0, Manner::IsThrown);
    }

    #[test]
    fn probabilities_add_up_to_one_and_none_is_ever_without_hope() {
        let (_, mut motions) = after(None, 60, |_| [0.0, 0.0, 2.0]);
        for far in [0.0, 1.0, 1e6] {
            motions.predict(PERIOD_S, None, &config());
            motions.see(&ball([far, 0.0, 2.0]), &config());
            let sum: f64 = motions.models.iter().map(|model| model.probability).sum();
            assert!((sum - 1.0).abs() < 1e-12);
        }
        // A ball that surely falls turns out to be a tin, in a frame at the same time.
        motions
            .models
            .iter_mut()
            .for_each(|model| model.probability = f64::from(u8::from(model.manner == Manner::Falls)));
        motions.predict(0.0, None, &config());
        assert!(motions.models.iter().all(|model| model.probability.is_finite()));
        assert!(motions.mean().state.iter().all(|number| number.is_finite()));
    }

    /// Compares with the density of a mixture, for models that differ and for models that are alike.
    #[test]
    fn the_cost_of_a_place_is_minus_twice_the_logarithm_of_its_likelihood() {
        let (_, mut motions) = after(None, 9, |time| [0.4 * time, 0.0, 2.0]);
        motions.predict(PERIOD_S, None, &config());
        let cost = |seen: &Detection, is_recent| motions.cost(seen, is_recent, &config());
        for off in [0.0, 0.003, -0.01] {
            let seen = ball([0.12 + off, 0.0, 2.0]);
            let of = |model: &Model| {
                let spread = model.motion.position_covariance() + seen.covariance;
                let residual: Vector3<f64> = seen.position - model.motion.position();
                let distance2 = residual.dot(&(spread.try_inverse().unwrap() * residual));
                model.probability * (-0.5 * distance2).exp() / spread.determinant().sqrt()
            };
            let likelihood = |count| motions.models[..count].iter().map(of).sum::<f64>();
            assert!((cost(&seen, true).unwrap() + 2.0 * likelihood(3).ln()).abs() < 1e-9);
            assert!((cost(&seen, false).unwrap() + 2.0 * likelihood(2).ln()).abs() < 1e-9, "no throw");
        }
        assert!(cost(&ball([0.19, 0.0, 2.0]), true).is_some(), "only a throw comes so far");
        assert_eq!(cost(&ball([0.19, 0.0, 2.0]), false), None);
        assert_eq!(cost(&ball([0.9, 0.0, 2.0]), true), None);
    }

    #[test]
    fn what_is_unseen_goes_on_as_it_did() {
        let (_, mut motions) = after(None, 30, |_| [0.0, 0.0, 2.0]);
        let of = |motions: &Motions| motions.models.each_ref().map(|model| model.probability);
        motions.predict(PERIOD_S, None, &config());
        let before = of(&motions);
        motions.predict(1.0, None, &config());
        assert!(of(&motions).iter().zip(before).all(|(now, before)| (now - before).abs() < 1e-12));
        // A late detection shows where the object was, but not how it moves.
        motions.see(&ball([0.0, 0.0, 2.0]).delayed(0.5, &config()), &config());
        assert!(of(&motions).iter().zip(before).all(|(now, before)| (now - before).abs() < 1e-12));
    }
}
