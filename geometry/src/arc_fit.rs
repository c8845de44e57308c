//! Line and circle through the points of an arc, and how far the points are off each.
//!
//! The circle is Taubin's (Chernov, "Circular and Linear Regression" (2010), section 5.10), whose eigenvalue is the mean
//! square distance. With unbiased moments both mean squares are free of the noise: about zero for the right curve, and
//! as often below zero as above.

use crate::{Circle, PlaneMoments};

/// Line and circle through one arc.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ArcFit {
    /// Mean square distance from the line of least squares, in square metres.
    pub line_square: f64,
    /// Mean square distance from the circle.
    pub circle_square: f64,
    /// The circle; its radius is not finite where the points are on a line.
    pub circle: Circle,
}

/// Mean square distance of the points from their line; the points are as many as `moments` count.
#[inline]
pub fn line_square(moments: &PlaneMoments) -> f64 {
    let [ss, st, tt] = moments.covariance().unwrap_or_default();
    0.5 * (ss + tt) - (0.25 * (ss - tt) * (ss - tt) + st * st).sqrt()
}

impl ArcFit {
    /// Fits both; `None` where there are fewer than three points.
    pub fn new(moments: &PlaneMoments) -> Option<Self> {
        if moments.count() < 3.0 {
            return None;
        }
        let mean = moments.mean()?;
        let centred = moments.about(mean);
        let per_point = 1.0 / moments.count();
        let m = |p, q| centred.get(p, q) * per_point;
        let (xx, xy, yy) = (m(2, 0), m(1, 1), m(0, 2));
        let (xz, yz) = (m(3, 0) + m(1, 2), m(2, 1) + m(0, 3));
        let zz = m(4, 0) + 2.0 * m(2, 2) + m(0, 4);
        let (z, covariance) = (xx + yy, xx * yy - xy * xy);
        let variance = zz - z * z;
        let cubic = [
            xz * (xz * yy - yz * xy) + yz * (yz * xx - xz * xy) - variance * covariance,
            (variance + 4.0 * covariance) * z - xz * xz - yz * yz,
            -3.0 * z * z - zz,
            4.0 * z,
        ];
        let line_square = 0.5 * z - (0.25 * (xx - yy) * (xx - yy) + xy * xy).sqrt();
        let eta = root_near_zero(&cubic);
        let half = 0.5 / (eta * eta - eta * z + covariance);
        let (x, y) = ((xz * (yy - eta) - yz * xy) * half, (yz * (xx - eta) - xz * xy) * half);
        let circle = Circle { center: [mean[0] + x, mean[1] + y], radius: (x * x + y * y + z).sqrt() };
        Some(Self { line_square, circle_square: eta, circle })
    }
}

/// The root of `c0 + c1 x + c2 x^2 + c3 x^3` that Newton's iteration finds from 0.
fn root_near_zero(c: &[f64; 4]) -> f64 {
    let mut x = 0.0;
    for _ in 0..12 {
        let value = c[0] + x * (c[1] + x * (c[2] + x * c[3]));
        let step = value / (c[1] + x * (2.0 * c[2] + x * 3.0 * c[3]));
        if !step.is_finite() {
            break;
        }
        x -= step;
        if step.abs() <= 1e-6 * x.abs() + 1e-14 {
            break;
        }
    }
    x
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{fit_circle, fit_plane_line};

    fn arc(from: f64, to: f64) -> impl Iterator<Item = [f64; 2]> {
        (0..40).map(move |i| from + (to - from) * f64::from(i) / 39.0).map(|a| [0.2 * a.cos(), 2.0 + 0.2 * a.sin()])
    }

    #[test]
    fn it_agrees_with_the_single_fits() {
        let noisy = arc(3.9, 5.5).enumerate().map(|(i, [s, t])| [s, t + 0.003 * (i as f64 * 2.4).sin()]);
        let moments = PlaneMoments::of([0.0, 0.0], noisy);
        let fit = ArcFit::new(&moments).unwrap();
        let (circle, line) = (fit_circle(&moments).unwrap(), fit_plane_line(&moments).unwrap());
        assert!((fit.circle.radius - circle.radius).abs() < 1e-6, "{fit:?} {circle:?}");
        assert!((fit.circle_square.sqrt() - circle.rms(&moments).unwrap()).abs() < 1e-4, "{fit:?}");
        assert!((fit.line_square.sqrt() - line.rms).abs() < 1e-6, "{fit:?} {line:?}");
        assert!((line_square(&moments) - fit.line_square).abs() < 1e-9);
    }

    #[test]
    fn a_line_has_no_distance_from_its_line() {
        let line = (0..40).map(|i| f64::from(i) * 0.02).map(|x| [x, 1.0 + 0.5 * x]);
        let fit = ArcFit::new(&PlaneMoments::of([0.0, 1.0], line)).unwrap();
        assert!(fit.line_square.abs() < 1e-12, "{fit:?}");
    }
}
