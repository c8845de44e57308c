//! The circle through points with known moments: Taubin's ([`ArcMoments::fit`]), which has far less bias on a short arc than a
//! free ellipse.

use crate::{ArcMoments, PlaneMoments};

/// A circle in a plane, in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Circle {
    /// Centre `(s, t)`.
    pub center: [f64; 2],
    /// Radius.
    pub radius: f64,
}

/// Radius beyond which a circle counts as a line, in spreads of its points.
const STRAIGHT: f64 = 1e6; // [algorithmic]

/// Returns the circle of least distance; `None` for fewer than three points, or points on a line.
pub fn fit_circle(moments: &PlaneMoments) -> Option<Circle> {
    if moments.count() < 3.0 {
        return None;
    }
    let (mean, spread, unit) = moments.normalized()?;
    let Circle { center, radius } = ArcMoments::of(&unit)?.fit().circle;
    let place = |axis: usize| mean[axis] + spread * center[axis];
    (radius < STRAIGHT).then(|| Circle { center: [place(0), place(1)], radius: spread * radius })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn arc(from: f64, to: f64, count: u32) -> impl Iterator<Item = [f64; 2]> {
        (0..count)
            .map(move |i| from + (to - from) * f64::from(i) / f64::from(count - 1))
            .map(|a| [3.0 + 0.2 * a.cos(), 2.0 + 0.2 * a.sin()])
    }

    #[test]
    fn exact_points_give_the_circle_back() {
        for (from, to) in [(0.0, 6.0), (4.0, 5.0), (-2.0, -1.6)] {
            let found = fit_circle(&PlaneMoments::of([3.0, 1.8], arc(from, to, 25))).unwrap();
            assert!((found.radius - 0.2).abs() < 1e-7, "{found:?}");
            assert!((found.center[0] - 3.0).hypot(found.center[1] - 2.0) < 1e-7);
        }
    }

    #[test]
    fn three_points_have_a_circle_and_two_have_none() {
        let found = |count| fit_circle(&PlaneMoments::of([3.0, 1.8], arc(4.0, 5.0, count)));
        assert!((found(3).unwrap().radius - 0.2).abs() < 1e-7);
        assert_eq!(found(2), None);
    }

    #[test]
    fn noise_on_a_short_arc_shrinks_it_little() {
        let points = arc(3.9, 5.5, 200).enumerate().map(|(i, [s, t])| [s, t + 0.004 * (i as f64 * 2.4).sin()]);
        let found = fit_circle(&PlaneMoments::of([3.0, 1.8], points)).unwrap();
        assert!((found.radius - 0.2).abs() < 0.006, "{found:?}");
    }

    #[test]
    fn lines_and_single_points_are_no_circles() {
        let line = (0..40).map(|i| f64::from(i) * 0.02).map(|x| [x, 1.0 + 0.5 * x]);
        assert_eq!(fit_circle(&PlaneMoments::of([0.0, 1.0], line)), None);
        assert_eq!(fit_circle(&PlaneMoments::of([0.0, 1.0], [[2.0, 3.0]; 8])), None);
        assert_eq!(fit_circle(&PlaneMoments::of([0.0, 1.0], [[2.0, 3.0], [2.0, 4.0]])), None);
    }
}
