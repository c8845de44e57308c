//! Free fall of a thrown ball, which continues while it is unseen, with bounces. A ball at rest does not fall; its detections
//! decide between the two (`motions.rs`).

use super::filter::Motion;
use crate::gravity;
use serde::{Deserialize, Serialize};

/// Standard deviation of the speed after a bounce, relative to the speed before: no floor is level and no ball perfectly round.
const BOUNCE_SPREAD: f64 = 0.1; // [tuned]

/// How balls fall.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize, Serialize)]
#[cfg_attr(feature = "schema", derive(schemars::JsonSchema))]
#[serde(default, deny_unknown_fields)]
pub struct Ballistic {
    /// Acceleration of free fall, in m/s^2.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0)))]
    pub gravity_mps2: f64,
    /// Where up is, as a vector in the world where the frames carry a pose, else in the camera's frame; none: the world's z,
    /// [0, 0, 1], with a pose, and -y, [0, -1, 0], without.
    pub up: Option<[f64; 3]>,
    /// Height of the floor along `up`, in metres; none: nothing bounces unseen.
    pub floor_m: Option<f64>,
    /// Share of the speed that a bounce leaves.
    #[cfg_attr(feature = "schema", schemars(range(min = 0.0, max = 1.0)))]
    pub restitution: f64,
}

impl Default for Ballistic {
    fn default() -> Self {
        Self { gravity_mps2: 9.81, up: None, floor_m: None, restitution: 0.8 }
    }
}

impl Ballistic {
    /// Adds gravity, and a bounce of a ball of this radius, to a motion predicted without them over the last `dt` seconds.
    /// `has_pose`: whether the tracking frame is the world's.
    pub fn fallen(&self, mut motion: Motion, dt: f64, radius: f64, has_pose: bool) -> Motion {
        let up = gravity::unit(self.up, has_pose);
        motion.acceleration = up * -self.gravity_mps2;
        motion.shift(&(motion.acceleration * (0.5 * dt * dt)), &(motion.acceleration * dt));
        let Some(floor_m) = self.floor_m else { return motion };
        let (height, climbing) = (motion.position().dot(&up) - radius - floor_m, motion.velocity().dot(&up));
        if height >= 0.0 || climbing >= 0.0 {
            return motion;
        }
        let gain = 1.0 + self.restitution;
        motion.shift(&(up * (-height * gain)), &(up * (-climbing * gain)));
        motion.kicked(0.0, BOUNCE_SPREAD * climbing)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix3, Vector3};

    fn motion(height: f64, climbing: f64) -> Motion {
        let mut motion = Motion::new(Vector3::new(1.0, 2.0, height), Matrix3::from_diagonal_element(1e-6), 0.1);
        motion.state[5] = climbing;
        motion
    }

    #[test]
    fn a_second_of_fall_is_that_of_newton() {
        let mut fallen = motion(10.0, 2.0);
        for _ in 0..100 {
            fallen.predict(0.01, 0.0);
            fallen = Ballistic::default().fallen(fallen, 0.01, 0.1, true);
        }
        assert!((fallen.state[2] - (10.0 + 2.0 - 4.905)).abs() < 1e-9, "{}", fallen.state[2]);
        assert!((fallen.state[5] - (2.0 - 9.81)).abs() < 1e-9);
    }

    #[test]
    fn a_ball_bounces_where_it_touches_the_floor() {
        let ballistic = Ballistic { gravity_mps2: 0.0, floor_m: Some(0.5), restitution: 0.5, ..Ballistic::default() };
        let bounced = ballistic.fallen(motion(0.58, -4.0), 0.1, 0.1, true);
        assert!((bounced.state[2] - 0.61).abs() < 1e-12, "2 cm below become 1 cm above");
        assert!((bounced.state[5] - 2.0).abs() < 1e-12);
        let doubt = bounced.covariance[(5, 5)] - motion(0.0, 0.0).covariance[(5, 5)];
        assert!((doubt.sqrt() - BOUNCE_SPREAD * 4.0).abs() < 1e-12);
        let rising = ballistic.fallen(motion(0.58, 3.0), 0.1, 0.1, true);
        assert_eq!(rising.state, motion(0.58, 3.0).state);
    }
}
