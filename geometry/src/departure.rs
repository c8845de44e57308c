//! The departure of points and contour from a sphere, cylinder or cone towards other quadrics: an oval section, an ellipsoid.

use crate::pooled::System;
use crate::surface::gradient;
use crate::{Coefficients, Contour, QuadricMoments, Surface, SurfaceFit, Vector3};
use nalgebra::{SMatrix, SVector};

/// Estimates how far points and contour depart from a surface fitted to both, towards other quadrics near it. Returns the x with
/// which `F + x_1 E_1 + ... + x_K E_K` has the least sum of squares, with the N parameters of F free as well; and the covariance
/// of x, if the distances of the points are independent and have a variance of one over their weights. `forms` returns the E of a
/// surface, in the frame of that surface; x has no unit. M is N + K. `None` where the sum of squares has no minimum.
///
/// F is a distance only where its gradient is 1, and a quadric with a vanishing gradient would have vanishing squares. So a
/// multiple of F is subtracted from each allowed change, such that the gradient in the middle of the visible part stays the same.
/// Points are linear in the rest, so one step suffices; the contour is nearly linear.
pub fn departure<S: Surface<N>, const N: usize, const K: usize, const M: usize>(
    moments: &QuadricMoments,
    contour: &Contour,
    fit: &SurfaceFit<S, N>,
    forms: impl FnOnce(&S) -> [Coefficients; K],
) -> Option<(SVector<f64, K>, SMatrix<f64, K, K>)> {
    const { assert!(M == N + K, "M counts all parameters") };
    let surface = fit.surface.to_local(&moments.origin, moments.scale);
    let (q, derivatives, forms) = (surface.coefficients(), surface.derivatives(), forms(&surface));
    // The origin is the mean of the points. There F equals its constant, which is about the distance from the surface.
    let middle = -gradient(&q, &Vector3::zeros()).normalize() * q[9];
    let slope = gradient(&q, &middle);
    let keeps_gradient = |change: &Coefficients| -> Coefficients {
        let part = gradient(change, &middle).dot(&slope) / slope.norm_squared();
        std::array::from_fn(|i| change[i] - part * q[i])
    };
    let all = || std::array::from_fn(|i| keeps_gradient(if i < N { &derivatives[i] } else { &forms[i - N] }));
    let system = System::<M>::below(f64::INFINITY, moments, Some(contour), &q, all)?;
    let inverse = system.inverse(1.0, &[false; M])?;
    let step = inverse * -system.gradient;
    let covariance = inverse.fixed_view::<K, K>(N, N) / (moments.scale * moments.scale);
    Some((step.fixed_rows::<K>(N).into_owned(), covariance))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulated::{Random, exact, of_exact, seen};
    use crate::{Conical, SpaceMoments, Sphere, fit_surface};

    fn can() -> Conical {
        let axis = Vector3::new(0.2, 1.0, 0.1).normalize();
        Conical { point: Vector3::new(0.1, 0.05, 1.3), axis, radius: 0.15, slope: 0.0 }
    }

    /// A surface that departs from its shape by the forms times `by`.
    fn departed(q: Coefficients, forms: &[Coefficients], by: &[f64]) -> Coefficients {
        std::array::from_fn(|i| q[i] + forms.iter().zip(by).map(|(form, by)| form[i] * by).sum::<f64>())
    }

    #[test]
    fn what_departs_tells_by_how_much_and_what_is_round_that_it_does_not() {
        for by in [[0.0, 0.0], [0.1, 0.0], [-0.04, 0.07]] {
            let q = departed(can().coefficients(), &can().departures(), &by);
            let points = of_exact(&seen(&q, 90..150, 0.0, exact));
            let round = fit_surface(&points, &can(), f64::INFINITY).unwrap();
            let (x, _) = departure::<_, 5, 2, 7>(&points, &Contour::default(), &round, Conical::departures).unwrap();
            // The radius of the round fit differs, and the directions across turn with its axis.
            let [found, expected] = [x.norm(), SVector::from(by).norm()];
            assert!((found - expected).abs() < 0.1 * expected + 1e-3, "{found} {expected}");
        }
        let ball = Sphere { center: Vector3::new(0.1, 0.05, 1.3), radius: 0.15 };
        for by in [[0.0; 5], [0.05, -0.03, 0.04, 0.02, -0.06]] {
            let points = of_exact(&seen(&departed(ball.coefficients(), &ball.departures(), &by), 60..180, 0.0, exact));
            let round = fit_surface(&points, &ball, f64::INFINITY).unwrap();
            let (x, _) = departure::<_, 4, 5, 9>(&points, &Contour::default(), &round, Sphere::departures).unwrap();
            assert!((x - SVector::from(by)).norm() < 0.01, "{x:?} {by:?}");
        }
    }

    #[test]
    fn a_part_of_what_is_round_is_not_explained_by_a_quadric_that_is_flat_there() {
        let (sigma, mut greatest): (f64, f64) = (0.004, 0.0);
        for frame in 0..20 {
            let mut random = Random(frame + 1);
            let noisy = |z: f64| (z + sigma * random.normal(), sigma * sigma);
            let mut points = SpaceMoments::default();
            points.add(&seen(&can().coefficients(), 90..150, 0.6, noisy), sigma.powi(-2));
            let points = points.normalized().unwrap();
            let round = fit_surface(&points, &can(), f64::INFINITY).unwrap();
            let (x, _) = departure::<_, 5, 2, 7>(&points, &Contour::default(), &round, Conical::departures).unwrap();
            greatest = greatest.max(x.norm());
        }
        println!("departs by up to {greatest:.2}");
        assert!(greatest < 1.0, "with 1 it is no closed section any more: {greatest}");
    }

    /// Noise along the ray moves points less across the surface where the ray grazes it, which the covariance ignores.
    #[test]
    fn departures_of_what_is_round_scatter_no_more_than_their_covariance_tells() {
        let (sigma, frames): (f64, u64) = (0.002, 60);
        let cone = Conical { slope: 0.2, ..can() };
        let mut square = 0.0;
        for frame in 0..frames {
            let mut random = Random(frame + 1);
            let noisy = |z: f64| (z + sigma * random.normal(), sigma * sigma);
            let mut points = SpaceMoments::default();
            points.add(&seen(&cone.coefficients(), 90..150, 0.0, noisy), sigma.powi(-2));
            let points = points.normalized().unwrap();
            let round = fit_surface(&points, &cone, f64::INFINITY).unwrap();
            let (x, covariance) =
                departure::<_, 6, 2, 8>(&points, &Contour::default(), &round, Conical::departures).unwrap();
            square += x.dot(&(covariance.try_inverse().unwrap() * x)) / frames as f64;
        }
        println!("chi squared of two numbers: {square:.2}");
        assert!((0.3..2.0).contains(&square), "{square}");
    }

    /// A ball with noise, and the fit to it.
    fn noisy_ball() -> (QuadricMoments, SurfaceFit<Sphere, 4>) {
        let ball = Sphere { center: Vector3::new(0.1, 0.05, 1.3), radius: 0.15 };
        let mut random = Random(3);
        let points = of_exact(&seen(&ball.coefficients(), 60..180, 0.0, |z| (z + 0.01 * random.normal(), 0.0)));
        let round = fit_surface(&points, &ball, f64::INFINITY).unwrap();
        (points, round)
    }

    #[test]
    fn a_form_departs_as_much_whatever_part_of_the_surface_itself_is_in_it() {
        let (points, round) = noisy_ball();
        let found = |part: f64| {
            let forms = |ball: &Sphere| ball.departures().map(|form| departed(form, &[ball.coefficients()], &[part]));
            departure::<_, 4, 5, 9>(&points, &Contour::default(), &round, forms).unwrap().0
        };
        let expected = found(0.0);
        for part in [-2.5, 0.3, 4.0] {
            assert!((found(part) - expected).norm() < 1e-6 * expected.norm(), "{part}");
        }
    }

    /// The expected departure is a Gauss-Newton step of F over its gradient where the surface is nearest to the mean of the
    /// points, with numerical derivatives.
    #[test]
    fn departures_are_the_least_squares_of_what_has_the_gradient_of_the_surface_in_the_middle() {
        let (points, round) = noisy_ball();
        let ball = round.surface.to_local(&points.origin, points.scale);
        let middle = ball.center - ball.center.normalize() * ball.radius;
        let at = |i: usize, h: f64| -> Coefficients {
            let step = std::array::from_fn(|k| if k == i { h } else { 0.0 });
            let moved = ball.moved(&step).unwrap().coefficients();
            let q = if i < 4 { moved } else { departed(moved, &[ball.departures()[i - 4]], &[h]) };
            q.map(|x| x / gradient(&q, &middle).norm())
        };
        let slopes: [Coefficients; 9] = std::array::from_fn(|i| {
            let (more, less) = (at(i, 1e-5), at(i, -1e-5));
            std::array::from_fn(|k| (more[k] - less[k]) / 2e-5)
        });
        let product = |a: &Coefficients, b: &Coefficients| crate::space::dot(&points.times(a), b);
        let matrix = SMatrix::<f64, 9, 9>::from_fn(|i, j| product(&slopes[i], &slopes[j]));
        let half_gradient = SVector::<f64, 9>::from_fn(|i, _| product(&slopes[i], &at(i, 0.0)));
        let expected = (matrix.try_inverse().unwrap() * -half_gradient).fixed_rows::<5>(4).into_owned();
        let (found, _) = departure::<_, 4, 5, 9>(&points, &Contour::default(), &round, Sphere::departures).unwrap();
        // `departure` knows the middle only to first order.
        assert!((found - expected).norm() < 0.3 * expected.norm(), "{found} {expected}");
    }
}
