//! The Kalman filters that follow one object: its motion, a size that hardly changes, the direction of its axis.
//!
//! Motion has white noise of spectral density `q` as acceleration (Bar-Shalom, Li, Kirubarajan, "Estimation with
//! Applications to Tracking and Navigation", 2001, section 6.2.2): with `x = [p; v]`,
//! `F = [I, dt I; 0, I]`, `Q = q [dt^3/3 I, dt^2/2 I; dt^2/2 I, dt I]`, `H = [I, 0]`. Two steps add up to one of their
//! length, so frames may come at any rate and be missing. The covariance is updated in Joseph's form,
//! `P = (I - K H) P (I - K H)' + K R K'`, and kept symmetric.

use nalgebra::{Cholesky, Matrix3, Matrix6, Matrix6x3, Rotation3, U3, UnitVector3, Vector3, Vector6};

/// Position and velocity of an object.
#[derive(Clone, Debug)]
pub struct Motion {
    /// Position in metres, then velocity in metres per second.
    pub state: Vector6<f64>,
    /// Covariance of `state`.
    pub covariance: Matrix6<f64>,
    /// The known acceleration, in m/s^2.
    pub acceleration: Vector3<f64>,
}

impl Motion {
    /// Creates the motion of an object seen once at `position`; `speed_sigma` is the standard deviation of its speed per axis, in
    /// m/s.
    pub fn new(position: Vector3<f64>, position_covariance: Matrix3<f64>, speed_sigma: f64) -> Self {
        let mut state = Vector6::zeros();
        state.fixed_rows_mut::<3>(0).copy_from(&position);
        let mut covariance = Matrix6::zeros();
        covariance.fixed_view_mut::<3, 3>(0, 0).copy_from(&position_covariance);
        covariance.fixed_view_mut::<3, 3>(3, 3).fill_diagonal(speed_sigma * speed_sigma);
        Self { state, covariance, acceleration: Vector3::zeros() }
    }

    /// Returns the motion of an object that follows one of several motions, with these weights: their mean `x`, with the
    /// covariance `sum w_j (P_j + (x_j - x)(x_j - x)')`.
    pub fn mixture<'a>(of: impl Iterator<Item = (f64, &'a Self)> + Clone) -> Self {
        let sum: f64 = of.clone().map(|(weight, _)| weight).sum();
        let of = of.map(|(weight, motion)| (weight / sum, motion)).filter(|(weight, _)| *weight > 0.0);
        let state = of.clone().map(|(weight, motion)| motion.state * weight).sum();
        let spread = |motion: &Self| {
            let off: Vector6<f64> = motion.state - state;
            motion.covariance + off * off.transpose()
        };
        let covariance = of.map(|(weight, motion)| spread(motion) * weight).sum();
        Self { state, covariance: symmetric(&covariance), acceleration: Vector3::zeros() }
    }

    /// Position in metres.
    pub fn position(&self) -> Vector3<f64> {
        self.state.fixed_rows::<3>(0).into()
    }

    /// Velocity in metres per second.
    pub fn velocity(&self) -> Vector3<f64> {
        self.state.fixed_rows::<3>(3).into()
    }

    /// Covariance of the position, in square metres.
    pub fn position_covariance(&self) -> Matrix3<f64> {
        self.covariance.fixed_view::<3, 3>(0, 0).into()
    }

    /// Covariance of the velocity.
    pub fn velocity_covariance(&self) -> Matrix3<f64> {
        self.covariance.fixed_view::<3, 3>(3, 3).into()
    }

    /// Predicts the motion `dt` seconds later, with acceleration noise of spectral density `density` in m^2/s^3 and no known
    /// acceleration.
    pub fn predict(&mut self, dt: f64, density: f64) {
        self.acceleration = Vector3::zeros();
        self.move_in_time(dt);
        self.blur(dt, density);
    }

    /// Adds the acceleration noise of `dt` seconds; negative for the way back: `F^-1 Q F^-T`, which is `-Q(-dt)`.
    pub fn blur(&mut self, dt: f64, density: f64) {
        self.covariance += blocks(dt.powi(3) / 3.0, dt.powi(2) / 2.0, dt) * (density * dt.signum());
    }

    /// Moves the motion by `dt` seconds, backwards if negative, without adding noise. Moving back, measuring and moving forward
    /// again is a measurement with `H = [I, -dt I]` in place of `[I, 0]`.
    pub fn move_in_time(&mut self, dt: f64) {
        let mut transition = Matrix6::identity();
        transition.fixed_view_mut::<3, 3>(0, 3).fill_diagonal(dt);
        self.state = transition * self.state;
        self.covariance = symmetric(&(transition * self.covariance * transition.transpose()));
        self.shift(&(self.acceleration * (0.5 * dt * dt)), &(self.acceleration * dt));
    }

    /// Adds a known displacement in metres and a known change of velocity in metres per second.
    pub fn shift(&mut self, displacement: &Vector3<f64>, velocity: &Vector3<f64>) {
        let mut place = self.state.fixed_rows_mut::<3>(0);
        place += displacement;
        let mut speed = self.state.fixed_rows_mut::<3>(3);
        speed += velocity;
    }

    /// Returns the motion if its velocity changed at the start of the last `dt` seconds, by an unknown amount of `speed_sigma`
    /// m/s per axis.
    pub fn kicked(&self, dt: f64, speed_sigma: f64) -> Self {
        let noise = blocks(dt * dt, dt, 1.0) * (speed_sigma * speed_sigma);
        Self { covariance: self.covariance + noise, ..self.clone() }
    }

    /// Returns whether a measured position may lie within the gate, which limits the squared Mahalanobis distance. It cannot if
    /// the squared distance exceeds the gate times the trace of the innovation's covariance. This test is faster than the
    /// Mahalanobis distance itself.
    pub fn may_be_within(&self, gate: f64, position: &Vector3<f64>, covariance: &Matrix3<f64>) -> bool {
        let residual2 = (position - self.position()).norm_squared();
        residual2 <= gate * (self.position_covariance().trace() + covariance.trace())
    }

    /// Returns the innovation of a measured position; `None` if the covariances are not positive definite.
    pub fn innovation(&self, position: &Vector3<f64>, covariance: &Matrix3<f64>) -> Option<Innovation> {
        let spread = Cholesky::new(self.position_covariance() + covariance)?;
        Some(Innovation { residual: position - self.position(), spread })
    }

    /// Updates the motion with a measured position.
    pub fn update(&mut self, innovation: &Innovation, covariance: &Matrix3<f64>) {
        let cross: Matrix6x3<f64> = self.covariance.fixed_view::<6, 3>(0, 0).into();
        let gain = cross * innovation.spread.inverse();
        self.state += gain * innovation.residual;
        let mut kept = Matrix6::identity();
        let mut left = kept.fixed_view_mut::<6, 3>(0, 0);
        left -= gain;
        self.covariance = kept * self.covariance * kept.transpose() + gain * covariance * gain.transpose();
        self.covariance = symmetric(&self.covariance);
    }
}

/// `[a I, b I; b I, c I]`.
fn blocks(a: f64, b: f64, c: f64) -> Matrix6<f64> {
    let mut matrix = Matrix6::from_diagonal(&Vector6::new(a, a, a, c, c, c));
    for i in 0..3 {
        (matrix[(i, i + 3)], matrix[(i + 3, i)]) = (b, b);
    }
    matrix
}

fn symmetric(matrix: &Matrix6<f64>) -> Matrix6<f64> {
    (matrix + matrix.transpose()) * 0.5
}

/// The innovation of a measured position.
#[derive(Clone, Debug)]
pub struct Innovation {
    residual: Vector3<f64>,
    spread: Cholesky<f64, U3>,
}

impl Innovation {
    /// Squared Mahalanobis distance (the normalised innovation squared): chi-square with 3 degrees of freedom.
    pub fn distance2(&self) -> f64 {
        self.residual.dot(&self.spread.solve(&self.residual))
    }

    /// Logarithm of the determinant of the innovation's covariance.
    pub fn ln_determinant(&self) -> f64 {
        self.spread.ln_determinant()
    }
}

/// A size that hardly changes: a random walk.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Size {
    /// Estimate of the size.
    pub value: f64,
    /// Variance of the estimate.
    pub variance: f64,
}

impl Size {
    /// Creates a size from its first measurement.
    pub fn new(value: f64, variance: f64) -> Self {
        Self { value, variance }
    }

    /// Returns the size `dt` seconds later; it drifts by `drift` per square root of a second.
    pub fn predicted(&self, dt: f64, drift: f64) -> Self {
        Self { variance: self.variance + drift * drift * dt, ..*self }
    }

    /// Returns the squared difference to a measurement, in units of its variance.
    pub fn distance2(&self, measured: Self) -> f64 {
        (measured.value - self.value).powi(2) / (self.variance + measured.variance)
    }

    /// Returns the additional variance at which the squared difference to a measurement would be `gate`; negative inside the
    /// gate.
    pub fn lacking(&self, measured: Self, gate: f64) -> f64 {
        (measured.value - self.value).powi(2) / gate - measured.variance - self.variance
    }

    /// Updates the size with a measurement.
    pub fn update(&mut self, measured: Self) {
        let gain = gain(self.variance, measured.variance);
        self.value += gain * (measured.value - self.value);
        self.variance = joseph(gain, self.variance, measured.variance);
    }
}

fn gain(variance: f64, noise: f64) -> f64 {
    variance / (variance + noise).max(f64::MIN_POSITIVE)
}

fn joseph(gain: f64, variance: f64, noise: f64) -> f64 {
    (1.0 - gain).powi(2) * variance + gain.powi(2) * noise
}

/// A direction that turns slowly: a filter in the plane tangent to the unit sphere, with the same variance all around.
#[derive(Clone, Copy, Debug)]
pub struct Axis {
    /// Estimate of the direction.
    pub direction: UnitVector3<f64>,
    /// Variance along each of the two directions across `direction`, in square radians: half of the mean square angle.
    pub variance: f64,
}

impl Axis {
    /// Creates a direction from its first measurement.
    pub fn new(direction: UnitVector3<f64>, variance: f64) -> Self {
        Self { direction, variance }
    }

    /// Returns the axis `dt` seconds later; it turns by `drift` radians per square root of a second, in each direction across.
    pub fn predicted(&self, dt: f64, drift: f64) -> Self {
        Self { variance: self.variance + drift * drift * dt, ..*self }
    }

    /// Angle to a measurement as a line, in radians; the sign does not count.
    pub fn angle(&self, measured: Self) -> f64 {
        let (sine, cosine) =
            (self.direction.cross(&measured.direction).norm(), self.direction.dot(&measured.direction));
        sine.atan2(cosine.abs())
    }

    /// Squared angle to a measurement, in units of its variance: chi-square with 2 degrees of freedom.
    pub fn distance2(&self, measured: Self) -> f64 {
        self.angle(measured).powi(2) / (self.variance + measured.variance).max(f64::MIN_POSITIVE)
    }

    /// Updates the direction with a measurement along the shorter turn: an axis is a line without a sense.
    pub fn update(&mut self, measured: Self) {
        let gain = gain(self.variance, measured.variance);
        let flip = self.direction.dot(&measured.direction) < 0.0;
        let target = if flip { -measured.direction } else { measured.direction };
        self.direction = turned(self.direction, target, gain);
        self.variance = joseph(gain, self.variance, measured.variance);
    }
}

/// Turns a direction by a share of the angle to another. The angle comes from `atan2` of sine and cosine, because an arc cosine
/// is NaN once rounding carries a product of unit vectors beyond one.
fn turned(from: UnitVector3<f64>, to: UnitVector3<f64>, share: f64) -> UnitVector3<f64> {
    let normal = from.cross(&to);
    let angle = normal.norm().atan2(from.dot(&to));
    let Some(axis) = UnitVector3::try_new(normal, 1e-12) else { return from }; // [algorithmic]
    UnitVector3::new_normalize(Rotation3::from_axis_angle(&axis, share * angle) * from.into_inner())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn isotropic(sigma: f64) -> Matrix3<f64> {
        Matrix3::from_diagonal_element(sigma * sigma)
    }

    fn measure(motion: &mut Motion, position: Vector3<f64>, covariance: &Matrix3<f64>) {
        let innovation = motion.innovation(&position, covariance).unwrap();
        motion.update(&innovation, covariance);
    }

    /// Without process noise the filter is the least-squares line through the measurements: at the last of `n`, with
    /// period T, the variances are `2 (2n - 1) r / (n (n + 1))` and `12 r / (T^2 n (n^2 - 1))`.
    #[test]
    fn without_acceleration_it_is_the_line_of_least_squares() {
        let (sigma, period, n) = (0.01, 0.1, 20_u32);
        let place = |k: u32| Vector3::new(1.0 + 0.02 * f64::from(k), (f64::from(k) * 1.7).sin() * 0.01, 2.0);
        let mut motion = Motion::new(place(0), isotropic(sigma), 1e4);
        for k in 1..n {
            motion.predict(period, 0.0);
            measure(&mut motion, place(k), &isotropic(sigma));
        }
        let (count, last) = (f64::from(n), f64::from(n - 1));
        let mean_k = last / 2.0;
        let sum = |f: &dyn Fn(u32) -> f64| (0..n).map(f).sum::<f64>();
        let mean_y = sum(&|k| place(k).y) / count;
        let slope = sum(&|k| (f64::from(k) - mean_k) * (place(k).y - mean_y)) * 12.0 / (count * (count * count - 1.0));
        assert!((motion.state[0] - (1.0 + 0.02 * last)).abs() < 1e-9);
        assert!((motion.state[3] - 0.2).abs() < 1e-8, "velocity {}", motion.state[3]);
        assert!((motion.state[1] - (mean_y + slope * (last - mean_k))).abs() < 1e-8);
        assert!((motion.state[4] - slope / period).abs() < 1e-7);
        let position_variance = 2.0 * (2.0 * count - 1.0) / (count * (count + 1.0)) * sigma * sigma;
        let velocity_variance = 12.0 * sigma * sigma / (period * period * count * (count * count - 1.0));
        assert!((motion.covariance[(1, 1)] / position_variance - 1.0).abs() < 1e-6);
        assert!((motion.covariance[(4, 4)] / velocity_variance - 1.0).abs() < 1e-6);
    }

    /// In the steady state the gains of position and velocity, `g` and `h`, leave the covariance as it was: an update takes `h
    /// p_pv`, the gain times the predicted cross term, from the variance of the velocity, and a prediction adds `q T`.
    #[test]
    fn in_the_steady_state_a_measurement_takes_what_a_step_brings() {
        let (sigma, period, density) = (0.002, 1.0 / 30.0, 0.25);
        let mut motion = Motion::new(Vector3::zeros(), isotropic(sigma), 1.0);
        for _ in 0..300 {
            motion.predict(period, density);
            measure(&mut motion, Vector3::zeros(), &isotropic(sigma));
        }
        motion.predict(period, density);
        let (position, cross) = (motion.covariance[(0, 0)], motion.covariance[(0, 3)]);
        let taken = cross * cross / (position + sigma * sigma);
        assert!((taken / (density * period) - 1.0).abs() < 1e-9, "{taken} against {}", density * period);
    }

    #[test]
    fn two_steps_are_one_of_their_length() {
        let mut once = Motion::new(Vector3::new(1.0, 2.0, 3.0), isotropic(0.01), 2.0);
        once.state[4] = 0.7;
        let mut twice = once.clone();
        once.predict(0.25, 0.8);
        twice.predict(0.1, 0.8);
        twice.predict(0.15, 0.8);
        assert!((once.state - twice.state).norm() < 1e-14);
        assert!((once.covariance - twice.covariance).norm() < 1e-14);
    }

    #[test]
    fn what_falls_goes_down_with_the_square_of_the_time_and_comes_from_where_it_was() {
        let mut motion = Motion::new(Vector3::new(1.0, 2.0, 3.0), isotropic(0.01), 2.0);
        motion.state[3] = 0.4;
        motion.acceleration = Vector3::new(0.0, 10.0, 0.0);
        let before = motion.clone();
        for (dt, fallen) in [(0.5, 1.25), (2.0, 20.0), (-1.0, 5.0)] {
            motion.move_in_time(dt);
            assert!((motion.position() - Vector3::new(1.0 + 0.4 * dt, 2.0 + fallen, 3.0)).norm() < 1e-12, "{dt} s");
            assert!((motion.velocity() - Vector3::new(0.4, 10.0 * dt, 0.0)).norm() < 1e-12, "{dt} s");
            motion.move_in_time(-dt);
            assert!(
                (motion.state - before.state).norm() < 1e-12 && (motion.covariance - before.covariance).norm() < 1e-9
            );
        }
    }

    /// An object follows one of two motions, with the probabilities 1/4 and 3/4.
    #[test]
    fn a_mixture_is_as_wide_as_its_motions_lie_apart() {
        let at = |x: f64| Motion::new(Vector3::new(x, 0.0, 2.0), isotropic(0.1), 0.5);
        let (near, far) = (at(1.0), at(3.0));
        let both = Motion::mixture([(2.0, &near), (6.0, &far), (0.0, &at(f64::NAN))].into_iter());
        assert!((both.position() - Vector3::new(2.5, 0.0, 2.0)).norm() < 1e-15);
        let expected = Vector3::new(0.01 + 0.75, 0.01, 0.01); // 1/4 of 1.5^2 and 3/4 of 0.5^2
        assert!((both.position_covariance() - Matrix3::from_diagonal(&expected)).norm() < 1e-14);
        assert!((both.velocity_covariance() - isotropic(0.5)).norm() < 1e-15);
    }

    #[test]
    fn a_place_is_ruled_out_at_once_only_outside_the_gate() {
        let covariance = Matrix3::new(9e-6, 2e-6, 0.0, 2e-6, 4e-6, 1e-6, 0.0, 1e-6, 2.5e-5);
        let motion = Motion::new(Vector3::zeros(), isotropic(0.002), 0.5);
        let mut ruled_out = 0;
        for i in 0..400 {
            let (angle, height) = (0.7 * f64::from(i), f64::from(i % 20) / 10.0 - 1.0);
            let beside = f64::sqrt(1.0 - height * height);
            let direction = Vector3::new(beside * angle.cos(), beside * angle.sin(), height);
            let place = direction * (0.0001 * f64::from(i));
            let inside = motion.innovation(&place, &covariance).unwrap().distance2() < 16.0;
            let may_be = motion.may_be_within(16.0, &place, &covariance);
            assert!(may_be || !inside, "{place}");
            ruled_out += u32::from(!may_be);
        }
        assert!((50..350).contains(&ruled_out), "{ruled_out}");
    }

    #[test]
    fn a_kick_is_an_uncertain_velocity_before_the_step() {
        let before = Motion::new(Vector3::zeros(), isotropic(0.01), 0.5);
        let mut kicked_before = Motion::new(Vector3::zeros(), isotropic(0.01), 0.5_f64.hypot(3.0));
        kicked_before.predict(0.2, 0.1);
        let mut after = before;
        after.predict(0.2, 0.1);
        assert!((after.kicked(0.2, 3.0).covariance - kicked_before.covariance).norm() < 1e-12);
    }

    #[test]
    fn covariances_that_are_none_are_refused() {
        let motion = Motion::new(Vector3::zeros(), isotropic(0.01), 1.0);
        assert!(motion.innovation(&Vector3::zeros(), &Matrix3::from_diagonal_element(-1.0)).is_none());
    }

    /// A random walk of variance `w` per step measured with variance `r` settles at `(sqrt(w^2 + 4 w r) - w) / 2`.
    #[test]
    fn a_size_and_an_axis_settle_at_the_closed_form() {
        let (drift, dt, noise) = (0.01, 0.25, 4e-4);
        let (mut size, mut axis) = (Size::new(1.0, 10.0), Axis::new(Vector3::y_axis(), 10.0));
        for _ in 0..500 {
            size = size.predicted(dt, drift);
            size.update(Size::new(1.0, noise));
            axis = axis.predicted(dt, drift);
            axis.update(Axis::new(Vector3::y_axis(), noise));
        }
        let walk: f64 = drift * drift * dt;
        let settled = ((walk * walk + 4.0 * walk * noise).sqrt() - walk) / 2.0;
        assert!([size.variance, axis.variance].iter().all(|variance| (variance / settled - 1.0).abs() < 1e-12));
    }

    #[test]
    fn with_what_it_lacks_a_size_is_at_the_gate() {
        let (size, near, far) = (Size::new(0.1, 1e-8), Size::new(0.1001, 1e-6), Size::new(0.12, 1e-6));
        assert!(size.lacking(near, 9.0) < 0.0, "inside of the gate");
        let doubted = Size::new(0.1, size.variance + size.lacking(far, 9.0));
        assert!((doubted.distance2(far) - 9.0).abs() < 1e-9);
    }

    #[test]
    fn a_constant_size_is_the_weighted_mean() {
        let mut size = Size::new(1.0, 1.0);
        size.update(Size::new(4.0, 0.5));
        assert!((size.value - 3.0).abs() < 1e-15);
        assert!((size.variance - 1.0 / 3.0).abs() < 1e-15);
        size.variance = 0.0;
        size.update(Size::new(9.0, 0.0));
        assert_eq!(size.value, 3.0, "two certainties do not divide by zero");
    }

    #[test]
    fn the_axis_of_a_line_has_no_sign_and_stays_a_unit_vector() {
        let up = UnitVector3::new_normalize(Vector3::new(0.0, -1.0, 0.0));
        let lean = UnitVector3::new_normalize(Vector3::new(0.1, 1.0, 0.0));
        let mut line = Axis::new(up, 0.01);
        line.update(Axis::new(lean, 0.01));
        let half = 0.1_f64.atan() / 2.0;
        assert!((line.direction.angle(&up) - half).abs() < 1e-12);
        assert!(line.direction.x < 0.0 && (line.variance - 0.005).abs() < 1e-15);
        for k in 0..1000 {
            let tilt = Vector3::new(f64::from(k).sin() * 0.1, -1.0, f64::from(k).cos() * 0.1);
            line = line.predicted(0.03, 0.2);
            line.update(Axis::new(UnitVector3::new_normalize(tilt), 0.01));
        }
        assert!((line.direction.norm() - 1.0).abs() < 1e-15);
        assert!(line.direction.angle(&up) < 0.11);
    }

    #[test]
    fn the_distance_of_two_axes_is_that_of_lines() {
        let lean = UnitVector3::new_normalize(Vector3::new(0.1_f64.tan(), -1.0, 0.0));
        let (axis, measured) = (Axis::new(Vector3::y_axis(), 0.001), Axis::new(lean, 0.001));
        assert!((axis.angle(measured) - 0.1).abs() < 1e-12);
        assert!((axis.distance2(measured) - 5.0).abs() < 1e-9);
    }

    #[test]
    fn an_axis_turns_by_the_share_that_its_variance_has_and_across_it_has_a_way_to_turn() {
        let mut axis = Axis::new(Vector3::y_axis(), 0.01);
        axis.update(Axis::new(Vector3::x_axis(), 0.03));
        assert!((axis.direction.angle(&Vector3::y_axis()) - std::f64::consts::FRAC_PI_8).abs() < 1e-12);
    }
}
