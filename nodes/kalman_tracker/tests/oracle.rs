//! The motion filter against `adskalman`, which was written by others and knows nothing of its structure.

use super::super::filter::Motion;
use super::*;
use adskalman::{KalmanFilterNoControl, ObservationModel, StateAndCovariance, TransitionModelLinearNoControl};
use nalgebra::{Cholesky, Matrix2, Matrix3x6, Matrix6, Matrix6x3, RowVector2, U3, U6, Vector6};

struct ConstantVelocity {
    transition: Matrix6<f64>,
    transposed: Matrix6<f64>,
    noise: Matrix6<f64>,
}

impl ConstantVelocity {
    fn over(dt: f64, density: f64) -> Self {
        let noise = Matrix2::new(dt.powi(3) / 3.0, dt * dt / 2.0, dt * dt / 2.0, dt) * density;
        let transition = Matrix2::new(1.0, dt, 0.0, 1.0).kronecker(&Matrix3::identity());
        Self { transition, transposed: transition.transpose(), noise: noise.kronecker(&Matrix3::identity()) }
    }
}

impl TransitionModelLinearNoControl<f64, U6> for ConstantVelocity {
    fn F(&self) -> &Matrix6<f64> {
        &self.transition
    }

    fn FT(&self) -> &Matrix6<f64> {
        &self.transposed
    }

    fn Q(&self) -> &Matrix6<f64> {
        &self.noise
    }
}

struct Place {
    observation: Matrix3x6<f64>,
    transposed: Matrix6x3<f64>,
    noise: Matrix3<f64>,
}

impl Place {
    fn with(noise: Matrix3<f64>) -> Self {
        let observation = RowVector2::new(1.0, 0.0).kronecker(&Matrix3::identity());
        Self { observation, transposed: observation.transpose(), noise }
    }
}

impl ObservationModel<f64, U6, U3> for Place {
    fn H(&self) -> &Matrix3x6<f64> {
        &self.observation
    }

    fn HT(&self) -> &Matrix6x3<f64> {
        &self.transposed
    }

    fn R(&self) -> &Matrix3<f64> {
        &self.noise
    }
}

/// A covariance of some millimetres, another each time.
fn some_covariance(noise: &mut Noise) -> Matrix3<f64> {
    let root = Matrix3::from_fn(|_, _| 0.003 * noise.normal());
    root * root.transpose() + Matrix3::from_diagonal_element(1e-6)
}

#[test]
fn the_motion_filter_agrees_with_another_implementation() {
    let (density, mut noise) = (0.25, Noise(31));
    let mut position = Vector3::new(0.2, -0.1, 2.0);
    let first = some_covariance(&mut noise);
    let mut motion = Motion::new(position, first, 1.5);
    let mut estimate = StateAndCovariance::new(motion.state, motion.covariance);
    for frame in 0..300 {
        let dt = PERIOD_S * [1.0, 2.0, 1.0, 5.0][frame % 4];
        position += noise.vector(0.02);
        let covariance = some_covariance(&mut noise);
        motion.predict(dt, density);
        let innovation = motion.innovation(&position, &covariance).unwrap();
        motion.update(&innovation, &covariance);
        let (way, place) = (ConstantVelocity::over(dt, density), Place::with(covariance));
        estimate = KalmanFilterNoControl::new(&way, &place).step(&estimate, &position).unwrap();
        let spread = Cholesky::new(*estimate.covariance()).unwrap();
        let off: Vector6<f64> = motion.state - estimate.state();
        assert!(off.dot(&spread.solve(&off)) < 1e-18, "frame {frame}: {off}");
        let wide = (motion.covariance - estimate.covariance()).norm() / estimate.covariance().norm();
        assert!(wide < 1e-9, "frame {frame}: {wide}");
    }
}
