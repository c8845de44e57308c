//! Tests that the errors of the filters match the covariances that these give.

use super::super::filter::Motion;
use super::camera::{late, placed};
use super::*;
use nalgebra::{Cholesky, Matrix2, Vector2, Vector6};

/// A sum of chi-square numbers, one per run.
#[derive(Default)]
struct Consistency {
    sum: f64,
    runs: u32,
}

impl Consistency {
    fn add(&mut self, square: f64) {
        self.sum += square;
        self.runs += 1;
    }

    /// The mean of n lies within `k +- 1.96 sqrt(2 k / n)` in 95 % of all cases, for k degrees of freedom.
    fn check(&self, what: &str, degrees: f64) {
        let (mean, bound) = (self.sum / f64::from(self.runs), 1.96 * (2.0 * degrees / f64::from(self.runs)).sqrt());
        assert!(
            (mean - degrees).abs() < bound,
            "{what}: mean of the squared errors {mean}, expected {degrees} +- {bound}"
        );
    }
}

/// Moves on by `dt` seconds under white acceleration of spectral density `density`.
fn accelerate(position: &mut Vector3<f64>, velocity: &mut Vector3<f64>, dt: f64, density: f64, noise: &mut Noise) {
    let step = Matrix2::new(dt.powi(3) / 3.0, dt * dt / 2.0, dt * dt / 2.0, dt) * density;
    let step = Cholesky::new(step).unwrap().l();
    *position += *velocity * dt;
    for axis in 0..3 {
        let change = step * Vector2::new(noise.normal(), noise.normal());
        position[axis] += change.x;
        velocity[axis] += change.y;
    }
}

fn tilted(axis: Vector3<f64>, sigma: f64, noise: &mut Noise) -> Vector3<f64> {
    let tilt = noise.vector(sigma);
    (axis + tilt - axis * tilt.dot(&axis)).normalize()
}

/// The normalised estimation error squared of position and velocity together.
#[test]
fn the_whole_state_of_a_motion_is_right_within_its_covariance() {
    let (density, speed_sigma, mut noise, mut state_errors) = (0.25, 0.8, Noise(21), Consistency::default());
    let covariance = Matrix3::new(9e-6, 2e-6, 0.0, 2e-6, 4e-6, 1e-6, 0.0, 1e-6, 2.5e-5);
    let root = Cholesky::new(covariance).unwrap().l();
    for _ in 0..500 {
        let (mut position, mut velocity) = (Vector3::new(0.2, -0.1, 2.0), noise.vector(speed_sigma));
        let mut filter = Motion::new(position + root * noise.vector(1.0), covariance, speed_sigma);
        for frame in 0..25 {
            let dt = PERIOD_S * [1.0, 1.0, 2.0, 6.0][frame % 4];
            accelerate(&mut position, &mut velocity, dt, density, &mut noise);
            filter.predict(dt, density);
            let innovation = filter.innovation(&(position + root * noise.vector(1.0)), &covariance).unwrap();
            filter.update(&innovation, &covariance);
        }
        let error = filter.state - Vector6::from_iterator(position.iter().chain(&velocity).copied());
        state_errors.add(error.dot(&Cholesky::new(filter.covariance).unwrap().solve(&error)));
    }
    state_errors.check("position and velocity", 6.0);
}

/// All parameters of a cone change as the tracker expects: the error of each matches its sigma.
#[test]
fn every_parameter_of_a_track_is_right_within_its_sigma() {
    let config = TrackerParameters {
        gate: 1e9,
        max_radius_change: 1e9,
        manoeuvre_mps: 0.0,
        floor_radius_m: 1e-9,
        floor_axis_deg: 0.0,
        floor_half_angle_deg: 0.0,
        floor_length_m: 0.0,
        ..exact()
    };
    let drifts = [config.drift_radius_m, config.drift_length_m, config.drift_half_angle_deg.to_radians()];
    let (mut noise, mut errors) = (Noise(22), <[Consistency; 6]>::default());
    for _ in 0..2000 {
        let (mut tracker, mut last) = (Tracker::new(config.clone()), Track::default());
        let (mut position, mut velocity) = (Vector3::new(0.0, 0.0, 2.0), noise.vector(config.initial_speed_mps));
        let (mut sizes, mut axis) = ([0.1, 0.3, 0.2], Vector3::y());
        let sigma = cone(position).sigma;
        for frame in 0..30 {
            accelerate(&mut position, &mut velocity, PERIOD_S, config.acceleration.powi(2), &mut noise);
            axis = tilted(axis, config.drift_axis_deg.to_radians() * PERIOD_S.sqrt(), &mut noise);
            sizes.iter_mut().zip(drifts).for_each(|(size, drift)| *size += drift * PERIOD_S.sqrt() * noise.normal());
            let mut measured = cone(position + noise.vector(SIGMA_M));
            measured.radius = sizes[0] + sigma.radius * noise.normal();
            measured.length = sizes[1] + sigma.length * noise.normal();
            measured.half_angle = sizes[2] + sigma.half_angle * noise.normal();
            measured.axis = tilted(axis, sigma.axis / 2.0_f64.sqrt(), &mut noise).into();
            last = tracker.update_frame(&header(frame), &[measured])[0];
        }
        let square = |error: Vector3<f64>, covariance| error.dot(&Cholesky::new(covariance).unwrap().solve(&error));
        let (object, sigma) = (last.object, last.object.sigma);
        errors[0].add(square(Vector3::from(object.center) - position, Matrix3::from(sigma.center)));
        errors[1].add(square(Vector3::from(last.velocity) - velocity, Matrix3::from(last.velocity_covariance)));
        errors[2].add(((object.radius - sizes[0]) / sigma.radius).powi(2));
        errors[3].add(((object.length - sizes[1]) / sigma.length).powi(2));
        errors[4].add(((object.half_angle - sizes[2]) / sigma.half_angle).powi(2));
        errors[5].add(Vector3::from(object.axis).cross(&axis).norm_squared() / (0.5 * sigma.axis.powi(2)));
    }
    let parameters =
        [("position", 3.0), ("velocity", 3.0), ("radius", 1.0), ("length", 1.0), ("half-angle", 1.0), ("axis", 2.0)];
    errors.iter().zip(parameters).for_each(|(errors, (what, degrees))| errors.check(what, degrees));
}

/// The normalised innovation squared of a filter that knows the truth's statistics.
#[test]
fn innovations_are_as_large_as_the_filter_expects() {
    let (density, speed_sigma) = (0.25, 0.8);
    let covariance = Matrix3::new(9e-6, 2e-6, 0.0, 2e-6, 4e-6, 1e-6, 0.0, 1e-6, 2.5e-5);
    let root = Cholesky::new(covariance).unwrap().l();
    let mut noise = Noise(7);
    let mut position = Vector3::new(0.2, -0.1, 2.0);
    let mut velocity = noise.vector(speed_sigma);
    let mut filter = Motion::new(position + root * noise.vector(1.0), covariance, speed_sigma);
    let mut innovations = Consistency::default();
    for frame in 0..20_000 {
        let dt = PERIOD_S * [1.0, 1.0, 2.0, 6.0][frame % 4];
        accelerate(&mut position, &mut velocity, dt, density, &mut noise);
        filter.predict(dt, density);
        let innovation = filter.innovation(&(position + root * noise.vector(1.0)), &covariance).unwrap();
        innovations.add(innovation.distance2());
        filter.update(&innovation, &covariance);
    }
    innovations.check("innovations", 3.0);
}

/// The error of the velocity at the end of runs at constant velocity, in units of the covariance that the tracker gives.
#[test]
fn the_velocity_is_right_within_its_sigma() {
    let config = TrackerParameters { acceleration: 0.0, gate: 1e9, ..exact() };
    let mut noise = Noise(11);
    let (mut errors, mut largest) = (Consistency::default(), 0.0_f64);
    for _ in 0..400 {
        let velocity = noise.vector(config.initial_speed_mps);
        let mut tracker = Tracker::new(config.clone());
        let mut last = Track::default();
        for frame in 0..20 {
            let center = Vector3::new(0.0, 0.0, 2.0) + velocity * seconds(frame) + noise.vector(SIGMA_M);
            last = tracker.update_frame(&header(frame), &[sphere(center)])[0];
        }
        let error = Vector3::from(last.velocity) - velocity;
        let spread = Cholesky::new(Matrix3::from(last.velocity_covariance)).unwrap();
        errors.add(error.dot(&spread.solve(&error)));
        largest = largest.max(error.norm());
    }
    errors.check("velocity", 3.0);
    assert!(largest < 0.02, "largest error {largest} m/s");
}

#[test]
fn what_stands_still_is_known_better_than_each_measurement() {
    let mut tracker = Tracker::new(TrackerParameters { acceleration: 0.01, ..exact() });
    let mut noise = Noise(4);
    let place = Vector3::new(0.3, 0.0, 2.0);
    let (mut squares, mut given) = (0.0, 0.0);
    for frame in 0..2000 {
        let radius = 0.1 + noise.normal() * 0.001;
        let track =
            tracker.update_frame(&header(frame), &[Object { radius, ..sphere(place + noise.vector(SIGMA_M)) }])[0];
        if frame >= 100 {
            squares += (Vector3::from(track.object.center) - place).norm_squared() / 3.0 / 1900.0;
            given = track.object.sigma.center[0][0];
            assert!((track.object.radius - 0.1).abs() < 0.0007);
        }
    }
    assert!(squares.sqrt() < SIGMA_M / 2.0, "standard deviation {}", squares.sqrt());
    assert!(squares < 1.3 * given, "the filter promises {given} and keeps {squares}");
}

/// All sightings of a run share half of their variance. The sigma of a track includes that half; without it, it is far too small.
/// The filter treats all of the variance as noise, so its part is slightly larger than necessary.
#[test]
fn what_all_sights_have_in_common_is_part_of_the_sigma() {
    let errors_in_sigmas = |common_share| {
        let config = TrackerParameters { acceleration: 0.01, common_share, floor_radius_m: 1e-9, ..exact() };
        let (mut noise, mut squares) = (Noise(23), [0.0; 2]);
        let (runs, part, place) = (400, 0.5_f64.sqrt(), Vector3::new(0.1, 0.0, 2.0));
        for _ in 0..runs {
            let mut tracker = Tracker::new(config.clone());
            let (offset, wider, mut last) = (noise.vector(SIGMA_M), 0.001 * noise.normal(), Track::default());
            for frame in 0..90 {
                let center = place + (offset + noise.vector(SIGMA_M)) * part;
                let radius = 0.1 + (wider + 0.001 * noise.normal()) * part;
                last = tracker.update_frame(&header(frame), &[Object { radius, ..sphere(center) }])[0];
            }
            let (error, sigma) = (Vector3::from(last.object.center) - place, last.object.sigma);
            let spread = Cholesky::new(Matrix3::from(sigma.center)).unwrap();
            squares[0] += error.dot(&spread.solve(&error)) / 3.0 / f64::from(runs);
            squares[1] += ((last.object.radius - 0.1) / sigma.radius).powi(2) / f64::from(runs);
        }
        squares.map(f64::sqrt)
    };
    let ([position, radius], [bare_position, bare_radius]) = (errors_in_sigmas(0.5), errors_in_sigmas(0.0));
    assert!((0.85..1.05).contains(&position) && (0.85..1.05).contains(&radius), "{position}, {radius}");
    assert!(bare_position > 1.5 && bare_radius > 2.0, "{bare_position}, {bare_radius}");
}

/// Two cameras see an object that moves at random, and the frames of one are late. The test measures the errors of tracks from
/// either camera, in sigmas: the noise that past and present share is neglected, so sigmas are a little small, or large right
/// after a frame.
#[test]
fn with_a_camera_that_is_late_all_is_right_within_its_sigma() {
    for late_frames in [1_usize, 3, 9, 24] {
        let config = TrackerParameters { gate: 1e9, manoeuvre_mps: 0.0, ..exact() };
        let (mut noise, mut errors, runs, frames) = (Noise(31), [0.0; 4], 400, 60);
        for _ in 0..runs {
            let (mut position, mut velocity) = (Vector3::new(0.0, 0.0, 2.0), noise.vector(config.initial_speed_mps));
            let (mut tracker, mut truth, mut last) = (Tracker::new(config.clone()), Vec::new(), [Track::default(); 2]);
            for frame in 0..frames {
                truth.push((position, velocity));
                let from = |name: &str| placed(name, 0.0, (frame + late_frames) as u64);
                last[0] = tracker.update_frame(&from("left"), &[sphere(position + noise.vector(SIGMA_M))])[0];
                if let Some(then) = frame.checked_sub(late_frames) {
                    let seen = sphere(truth[then].0 + noise.vector(SIGMA_M));
                    last[1] = tracker.update_frame(&late(from("right"), seconds(late_frames as u64)), &[seen])[0];
                }
                accelerate(&mut position, &mut velocity, PERIOD_S, config.acceleration.powi(2), &mut noise);
            }
            let square = |error: Vector3<f64>, covariance| error.dot(&Cholesky::new(covariance).unwrap().solve(&error));
            for ((track, errors), frame) in last.iter().zip(errors.chunks_exact_mut(2)).zip([0, late_frames]) {
                let (position, velocity) = truth[frames - 1 - frame];
                let center = Vector3::from(track.object.center);
                errors[0] += square(center - position, Matrix3::from(track.object.sigma.center));
                errors[1] += square(Vector3::from(track.velocity) - velocity, Matrix3::from(track.velocity_covariance));
            }
        }
        let in_sigmas = errors.map(|sum: f64| (sum / f64::from(runs) / 3.0).sqrt());
        let [.., late_velocity] = in_sigmas;
        assert!(
            in_sigmas[..3].iter().all(|ratio| (0.7..1.1).contains(ratio)),
            "{late_frames} frames late: {in_sigmas:?}"
        );
        // The present motion says little of the motion long ago.
        assert!((0.7..1.3).contains(&late_velocity), "{late_frames} frames late: {in_sigmas:?}");
    }
}

/// Returns the root mean square error of a ball's velocity over the frames after the first `from`, and over runs: in m/s, and in
/// its sigmas.
fn velocity_errors(from: u64, motion: impl Fn(f64) -> [Vector3<f64>; 2]) -> [f64; 2] {
    let (mut noise, mut squares, runs, frames) = (Noise(41), [0.0; 2], 50, 60);
    for _ in 0..runs {
        let mut tracker = Tracker::new(exact());
        for frame in 0..frames {
            let [position, velocity] = motion(seconds(frame));
            let track = tracker.update_frame(&header(frame), &[sphere(position + noise.vector(SIGMA_M))])[0];
            assert_eq!(track.id, 1);
            let (error, spread) = (Vector3::from(track.velocity) - velocity, Matrix3::from(track.velocity_covariance));
            if frame >= from {
                squares[0] += error.norm_squared() / 3.0;
                squares[1] += error.dot(&Cholesky::new(spread).unwrap().solve(&error)) / 3.0;
            }
        }
    }
    squares.map(|sum| (sum / (f64::from(runs) * (frames - from) as f64)).sqrt())
}

/// The velocity is right for an object at rest and for one that moves evenly, and within its sigma for one that falls although no
/// fall is configured. With one acceleration for all, the first two are off by 0.05 m/s, and the last by 2 sigmas.
#[test]
fn how_fast_an_object_is_depends_on_how_it_moves() {
    let start = Vector3::new(0.1, -1.0, 2.0);
    let still = velocity_errors(20, |_| [start, Vector3::zeros()]);
    let even = velocity_errors(20, |time| [start + Vector3::x() * (0.3 * time), Vector3::x() * 0.3]);
    for [meters_per_s, in_sigmas] in [still, even] {
        assert!(meters_per_s < 0.015 && (0.3..1.0).contains(&in_sigmas), "{meters_per_s} m/s, {in_sigmas} sigmas");
    }
    let fall_s = |time: f64| (time - 1.0).max(0.0);
    let [_, in_sigmas] = velocity_errors(36, |time| {
        [start + Vector3::y() * (4.905 * fall_s(time).powi(2)), Vector3::y() * (9.81 * fall_s(time))]
    });
    assert!((0.4..1.0).contains(&in_sigmas), "{in_sigmas} sigmas of a fall");
}
