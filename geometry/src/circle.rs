//! The circle through points of which the moments are known.
//!
//! Taubin's fit minimises `sum F^2 / sum |grad F|^2` over all circles; the eigenvalue comes from Newton's iteration as
//! in Chernov, "Circular and Linear Regression" (2010), section 5.10. On a short arc it is far less biased than a free
//! ellipse.

use crate::PlaneMoments;

/// A circle in a plane, in metres.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Circle {
    /// Centre `(s, t)`.
    pub center: [f64; 2],
    /// Radius.
    pub radius: f64,
}

#[cfg(test)]
impl Circle {
    /// The circle as a conic.
    pub(crate) fn to_conic(self) -> crate::Conic {
        crate::Conic { origin: self.center, coefficients: [1.0, 0.0, 1.0, 0.0, 0.0, -self.radius * self.radius] }
    }
}

/// The circle of least distance; `None` where the points are fewer than three or on a line.
pub fn fit_circle(moments: &PlaneMoments) -> Option<Circle> {
    if moments.count() < 3.0 {
        return None;
    }
    let (mean, spread, m) = moments.normalized()?;
    let (xx, xy, yy) = (m.get(2, 0), m.get(1, 1), m.get(0, 2));
    let xz = m.get(3, 0) + m.get(1, 2);
    let yz = m.get(2, 1) + m.get(0, 3);
    let zz = m.get(4, 0) + 2.0 * m.get(2, 2) + m.get(0, 4);
    let z = xx + yy;
    let covariance = xx * yy - xy * xy;
    let variance = zz - z * z;
    let cubic = [
        xz * (xz * yy - yz * xy) + yz * (yz * xx - xz * xy) - variance * covariance,
        variance * z + 4.0 * covariance * z - xz * xz - yz * yz,
        -3.0 * z * z - zz,
        4.0 * z,
    ];
    let eta = smallest_root(&cubic);
    let determinant = eta * eta - eta * z + covariance;
    if determinant.abs() < 1e-12 {
        return None;
    }
    let x = (xz * (yy - eta) - yz * xy) / (2.0 * determinant);
    let y = (yz * (xx - eta) - xz * xy) / (2.0 * determinant);
    let radius = spread * (x * x + y * y + z).sqrt();
    let circle = Circle { center: [mean[0] + spread * x, mean[1] + spread * y], radius };
    circle.radius.is_finite().then_some(circle)
}

/// The smallest root >= 0 of `c0 + c1 x + c2 x^2 + c3 x^3`, by Newton's iteration from 0.
fn smallest_root(c: &[f64; 4]) -> f64 {
    let value = |x: f64| c[0] + x * (c[1] + x * (c[2] + x * c[3]));
    let (mut x, mut y) = (0.0, c[0]);
    for _ in 0..30 {
        let next = x - y / (c[1] + x * (2.0 * c[2] + x * 3.0 * c[3]));
        let below = value(next);
        if !next.is_finite() || next == x || below.abs() >= y.abs() {
            break;
        }
        (x, y) = (next, below);
    }
    x
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
