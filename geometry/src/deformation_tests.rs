//! Tests of the gain of deformations on rows of simulated points.

use super::*;
use crate::simulated::{Random, exact, of_exact, seen};
use crate::{FixedSlope, FreeSlope, SpaceMoments, fit_surface};

const NOISE: f64 = 0.003;

/// Points of a quadric with noise, weighed as such.
fn noisy(q: &Coefficients, seed: u64) -> QuadricMoments {
    let mut random = Random(seed);
    let mut pool = SpaceMoments::default();
    pool.add(&seen(q, 96..144, 0.0, |z| (z + NOISE * random.normal(), NOISE * NOISE)), NOISE.powi(-2));
    pool.normalized().unwrap()
}

fn can() -> Conical {
    Conical { point: Vector3::new(0.0, 0.0, 1.5), axis: Vector3::y(), radius: 0.15, slope: 0.0 }
}

/// The can, of which every section is an ellipse: `stretch` times as far from front to back.
fn oval(stretch: f64) -> Coefficients {
    let along_view = stretch.powi(-2);
    [1.0, 0.0, along_view, 0.0, 0.0, 0.0, 0.0, 0.0, -3.0 * along_view, 2.25 * along_view - 0.0225]
}

fn gain_of_can(moments: &QuadricMoments) -> f64 {
    let fit = fit_surface(moments, &FixedSlope(can()), f64::INFINITY).unwrap();
    gain_of_deformations(moments, &fit.surface, &fit.surface.0.deformations()).unwrap()
}

fn mean_of_frames(gain: impl Fn(u64) -> f64) -> f64 {
    (0..60).map(|frame| gain(100 + frame)).sum::<f64>() / 60.0
}

#[test]
fn on_the_surface_it_is_chi_squared() {
    // Noise along the ray moves a point less across the surface, so all are below their degrees of freedom.
    let q = FixedSlope(can()).coefficients();
    let of_can = mean_of_frames(|seed| gain_of_can(&noisy(&q, seed)));
    assert!((0.5..2.0).contains(&of_can), "{of_can} of 2");

    let cone = FreeSlope(Conical { slope: 0.25, ..can() });
    let of_cone = mean_of_frames(|seed| {
        let moments = noisy(&cone.coefficients(), seed);
        let fit = fit_surface(&moments, &cone, f64::INFINITY).unwrap();
        gain_of_deformations(&moments, &fit.surface, &fit.surface.0.deformations()).unwrap()
    });
    assert!((0.5..2.0).contains(&of_cone), "{of_cone} of 2");

    let sphere = Sphere { center: can().point, radius: 0.15 };
    let of_sphere = mean_of_frames(|seed| {
        let moments = noisy(&sphere.coefficients(), seed);
        let fit = fit_surface(&moments, &sphere, f64::INFINITY).unwrap();
        gain_of_deformations(&moments, &fit.surface, &Sphere::deformations()).unwrap()
    });
    assert!((1.5..5.0).contains(&of_sphere), "{of_sphere} of 5");
}

#[test]
fn it_is_what_a_deformation_leaves_of_exact_points() {
    for stretch in [0.98, 1.02] {
        let moments = of_exact(&seen(&oval(stretch), 96..144, 0.0, exact));
        let fit = fit_surface(&moments, &FixedSlope(can()), f64::INFINITY).unwrap();
        let gain = gain_of_deformations(&moments, &fit.surface, &fit.surface.0.deformations()).unwrap();
        assert!((gain / fit.square_sum - 1.0).abs() < 0.05, "{gain} of {}", fit.square_sum);
    }
}

#[test]
fn it_tells_where_the_sum_of_squares_cannot() {
    for stretch in [0.8, 1.3] {
        let moments = noisy(&oval(stretch), 7);
        let fit = fit_surface(&moments, &FixedSlope(can()), f64::INFINITY).unwrap();
        let scatter = (2.0 * moments.matrix[9][9]).sqrt();
        assert!(fit.square_sum.abs() < 2.0 * scatter, "{} with a scatter of {scatter}", fit.square_sum);
        let gain = gain_of_can(&moments);
        assert!(gain > 25.0, "{gain}, stretched by {stretch}");
    }
}

#[test]
fn directions_of_which_the_points_tell_nothing_do_not_count() {
    let square = SMatrix::<f64, 2, 2>::new(4.0, 0.0, 0.0, 0.01);
    assert_eq!(gain(square, SVector::<f64, 2>::new(2.0, 3.0)), 1.0);
    let square = SMatrix::<f64, 2, 2>::new(4.0, 1.0, 1.0, 2.0);
    let along = SVector::<f64, 2>::new(2.0, 3.0);
    let expected = along.dot(&(square.try_inverse().unwrap() * along));
    assert!((gain(square, along) - expected).abs() < 1e-12);
}
