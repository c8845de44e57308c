//! The search for ellipses: each trial passes through four random points, and the one with the most points on it wins.
//!
//! An ellipse along the axes of the scan plane, `a s^2 + c t^2 + d s + e t = 0` about one of its points, has three free ratios,
//! which three more points determine. A point lies on it if its Sampson distance `|F| / |grad F|` is within a limit.

use super::RansacParameters;
use crate::random::CounterRng;
use conicflow_geometry::{Conic, Ellipse, Vector3};

/// Number of points that determine an ellipse along the axes.
pub(super) const SAMPLE: usize = 4;

/// A measurement in the plane of its scan line.
#[derive(Clone, Copy, Debug)]
pub(super) struct Point {
    /// Its pixel along the line.
    pub pixel: u32,
    /// In-plane coordinates, in metres.
    pub st: [f64; 2],
    /// Square of its largest distance from its ellipse, in square metres.
    pub limit2: f64,
}

/// The random numbers of one frame, in the order of their use.
#[derive(Debug)]
pub(super) struct Draws {
    dice: CounterRng,
    count: u64,
}

impl Draws {
    /// Starts with the first number.
    pub fn new(dice: CounterRng) -> Self {
        Self { dice, count: 0 }
    }

    fn below(&mut self, end: usize) -> usize {
        self.count += 1;
        ((self.dice.uniform(self.count) * end as f64) as usize).min(end - 1)
    }

    /// Draws different numbers below `end >= SAMPLE`; all sets are equally likely (Floyd's algorithm, CACM 1987).
    fn sample(&mut self, end: usize) -> [usize; SAMPLE] {
        let mut sample = [end; SAMPLE];
        for (place, most) in (end - SAMPLE..end).enumerate() {
            let drawn = self.below(most + 1);
            sample[place] = if sample.contains(&drawn) { most } else { drawn };
        }
        sample
    }
}

/// Removes the points on the best ellipse from `points` and returns them in the order of their pixels; `None` if no ellipse has
/// enough points.
pub(super) fn take_consensus(
    points: &mut Vec<Point>,
    config: &RansacParameters,
    draws: &mut Draws,
) -> Option<Vec<Point>> {
    let best = best_ellipse(points, config, draws)?;
    Some(points.extract_if(.., |point| lies_on(&best, point)).collect())
}

/// Returns the ellipse with the most points on it; among equals the first.
fn best_ellipse(points: &[Point], config: &RansacParameters, draws: &mut Draws) -> Option<Conic> {
    let (mut best, mut most) = (None, config.conic.min_points as usize - 1);
    if points.len() <= most.max(SAMPLE) {
        return None;
    }
    for _ in 0..config.trials() {
        let sample = draws.sample(points.len()).map(|index| points[index].st);
        let conic = through(sample);
        // the camera sees the near side
        let is_seen = |ellipse: &Ellipse| sample.iter().all(|[_, t]| *t < ellipse.center[1]);
        if conic.to_ellipse().is_none_or(|ellipse| !config.admits(&ellipse) || !is_seen(&ellipse)) {
            continue;
        }
        let count = points.iter().filter(|point| lies_on(&conic, point)).count();
        if count > most {
            (best, most) = (Some(conic), count);
        }
    }
    best
}

/// Returns the conic `a s^2 + c t^2 + d s + e t = 0` through four points, about the first: the null vector of three equations.
fn through([origin, others @ ..]: [[f64; 2]; SAMPLE]) -> Conic {
    let from_origin = others.map(|[s, t]| [s - origin[0], t - origin[1]]);
    let column = |term: fn([f64; 2]) -> f64| Vector3::from(from_origin.map(term));
    let (ss, tt) = (column(|[s, _]| s * s), column(|[_, t]| t * t));
    let (s, t) = (column(|[s, _]| s), column(|[_, t]| t));
    let triple = |x: &Vector3, y: &Vector3, z: &Vector3| x.dot(&y.cross(z));
    let [a, c, d, e] = [triple(&tt, &s, &t), -triple(&ss, &s, &t), triple(&ss, &tt, &t), -triple(&ss, &tt, &s)];
    Conic { origin, coefficients: [a, 0.0, c, d, e, 0.0] }
}

/// Whether a point lies on an ellipse of [`through`].
#[inline]
fn lies_on(conic: &Conic, point: &Point) -> bool {
    let [a, _, c, d, e, _] = conic.coefficients;
    let (s, t) = (point.st[0] - conic.origin[0], point.st[1] - conic.origin[1]);
    let value = (a * s + d) * s + (c * t + e) * t;
    let gradient2 = (2.0 * a * s + d).powi(2) + (2.0 * c * t + e).powi(2);
    value * value <= point.limit2 * gradient2
}

#[cfg(test)]
mod tests {
    use super::*;

    const CENTER: [f64; 2] = [0.3, 2.0];
    const SEMI_AXES: [f64; 2] = [0.4, 0.2];

    fn on_ellipse(angle: f64) -> [f64; 2] {
        [CENTER[0] + SEMI_AXES[0] * angle.cos(), CENTER[1] - SEMI_AXES[1] * angle.sin()]
    }

    #[test]
    fn four_points_determine_the_ellipse() {
        let ellipse = through([0.3, 1.0, 1.7, 2.9].map(on_ellipse)).to_ellipse().unwrap();
        for (found, expected) in ellipse.center.iter().chain(&ellipse.semi_axes).zip([0.3, 2.0, 0.4, 0.2]) {
            assert!((found - expected).abs() < 1e-12, "{ellipse:?}");
        }
    }

    #[test]
    fn points_on_a_line_determine_none() {
        let on_line = [0.0, 0.1, 0.5, 0.7].map(|s| [s, 3.0 + 0.2 * s]);
        assert!(through(on_line).to_ellipse().is_none_or(|ellipse| ellipse.semi_axes[0] > 1e3));
    }

    #[test]
    fn the_limit_is_a_distance_in_metres() {
        let conic = through([0.3, 1.0, 1.7, 2.9].map(on_ellipse));
        let beside = |distance: f64| {
            let st = [CENTER[0], CENTER[1] - SEMI_AXES[1] - distance];
            lies_on(&conic, &Point { pixel: 0, st, limit2: 0.01_f64.powi(2) })
        };
        assert!(beside(0.0095) && beside(-0.0095) && !beside(0.0110) && !beside(-0.0110));
    }

    #[test]
    fn samples_are_of_different_points_and_reach_all() {
        let mut draws = Draws::new(CounterRng::new(1, 0));
        let mut times = [0; 6];
        for _ in 0..3000 {
            let mut sample = draws.sample(6);
            sample.iter().for_each(|&index| times[index] += 1);
            sample.sort_unstable();
            assert!(sample.windows(2).all(|pair| pair[0] < pair[1]), "{sample:?}");
        }
        assert!(times.iter().all(|times| (1850..2150).contains(times)), "{times:?}, expected 2000 each");
    }

    #[test]
    fn what_most_points_lie_on_is_found_among_outliers() {
        let limit2 = 0.002_f64.powi(2);
        let mut points: Vec<Point> = (0..40)
            .map(|pixel| Point { pixel, st: on_ellipse(0.2 + 0.07 * f64::from(pixel)), limit2 })
            .chain((40..100).map(|pixel| Point { pixel, st: [0.05 * (f64::from(pixel) - 70.0), 3.0], limit2 }))
            .collect();
        let (config, mut draws) = (RansacParameters::default(), Draws::new(CounterRng::new(1, 0)));
        let inliers = take_consensus(&mut points, &config, &mut draws).unwrap();
        assert_eq!(inliers.iter().map(|point| point.pixel).collect::<Vec<_>>(), (0..40).collect::<Vec<_>>());
        assert!(take_consensus(&mut points, &config, &mut draws).is_none(), "the wall is none");
        assert_eq!(points.len(), 60);
    }
}
