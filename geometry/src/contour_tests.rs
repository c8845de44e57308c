//! Tests of contours on silhouettes of known surfaces.

use super::*;
use crate::simulated::{CAMERA, Random, exact, hit, of_exact, seen};
use crate::space::monomials;
use crate::{Conical, QUADRIC_TERMS, Scan, SpaceMoments, Sphere, fit_with_contour, section_of};
use std::ops::Range;

fn biased(mean: Vector4<f64>, sigmas: [f64; 2]) -> ContourBias {
    let [offset, share] = sigmas.map(|sigma| sigma * sigma);
    ContourBias { mean, covariance: Matrix4::from_diagonal(&Vector4::new(offset, share, offset, share)) }
}

fn noise() -> ContourNoise {
    let bias = biased(Vector4::zeros(), [1.0, 0.05]);
    ContourNoise { point: Vector2::new(0.25, 0.0009), shared_lines: 1.0, surface_lines: 1.0, bias }
}

fn cup() -> Conical {
    let axis = Vector3::new(0.1, 0.9, -0.3).normalize();
    Conical { point: Vector3::new(0.05, 0.02, 1.2), axis, radius: 0.05, slope: 0.12 }
}

/// The contour of `F = 0` on some rows, moved outwards along them by `outwards` pixels.
fn contour_on(rows: Range<u32>, q: &Coefficients, radius_px: f64, outwards: f64, noise: ContourNoise) -> Contour {
    let mut contour = Contour::default();
    contour.clear(noise);
    for row in rows {
        let plane = CAMERA.plane(Scan::Row, f64::from(row));
        let [ss, st, tt, s, t, one] = section_of(q, &plane);
        let k = plane.stretch();
        // the discriminant along the ray of slope x, as a polynomial of x
        let (a, b) = (s * s - 4.0 * ss * one, 2.0 * s * t * k - 4.0 * st * k * one);
        let c = t * t * k * k - 4.0 * tt * k * k * one;
        let root = (b * b - 4.0 * a * c).sqrt();
        let mut slopes = [(-b - root) / (2.0 * a), (-b + root) / (2.0 * a)];
        slopes.sort_by(f64::total_cmp);
        for (side, slope) in slopes.into_iter().enumerate() {
            let slope = slope + outwards * if side == 0 { -1.0 } else { 1.0 } / CAMERA.fx;
            let ray = plane.to_camera([slope, k]);
            let pixel = plane.s_axis() / CAMERA.fx;
            contour.add(ContourPoint { ray, pixel, across: Vector3::y() / CAMERA.fy, side });
            contour.points.last_mut().unwrap().place(1.0, radius_px, &noise);
        }
    }
    contour
}

fn contour(surface: &Conical, outwards: f64) -> Contour {
    contour_on(105..140, &surface.coefficients(), 12.0, outwards, noise())
}

/// The term of a surface in the camera frame.
fn term<S: Surface<N>, const N: usize>(contour: &Contour, surface: &S) -> ContourTerm<N> {
    contour.term(&surface.coefficients(), &surface.derivatives(), &Vector3::zeros(), 1.0)
}

fn cost(contour: &Contour, surface: &Conical) -> f64 {
    term::<_, 6>(contour, surface).square_sum
}

#[test]
fn the_true_surface_touches_its_contour() {
    let contour = contour(&cup(), 0.0);
    assert!(cost(&contour, &cup()) < 1e-12);
    let (origin, scale) = (Vector3::new(0.07, 0.1, 1.1), 0.04);
    let local = cup().to_local(&origin, scale);
    let term = contour.term::<6>(&local.coefficients(), &local.derivatives(), &origin, scale);
    assert!(term.square_sum < 1e-12, "in any frame");
}

#[test]
fn a_taper_costs_and_an_offset_hardly_does() {
    let tapered = cost(&contour(&cup(), 0.0), &Conical { slope: 0.0, ..cup() });
    let shifted = cost(&contour(&cup(), 1.0), &cup());
    assert!(tapered > 20.0 && shifted < 3.0, "{tapered} {shifted}");
}

#[test]
fn the_gradient_is_that_of_the_cost() {
    let contour = contour(&Conical { slope: 0.1, radius: 0.049, ..cup() }, 0.4);
    let surface = cup();
    let term = term::<_, 6>(&contour, &surface);
    for i in 0..6 {
        let at = |h: f64| {
            let mut step = [0.0; 6];
            step[i] = h;
            cost(&contour, &surface.moved(&step).unwrap())
        };
        let slope = (at(1e-6) - at(-1e-6)) / 4e-6;
        let scale = 1.0 + term.gradient.amax();
        assert!((slope - term.gradient[i]).abs() < 1e-4 * scale, "{i}: {slope} {}", term.gradient[i]);
    }
}

#[test]
fn an_error_is_the_way_to_the_contour_and_its_slope_that_of_the_contour_however_far_off_a_point_is() {
    let q = cup().coefficients();
    let [exact, off] = [0.0, 3.0].map(|outwards| contour(&cup(), outwards).points);
    for (exact, off) in exact.iter().zip(&off) {
        let [(none, expected), (error, slope)] = [exact, off].map(|seen| seen.point.error_gradient(&q));
        let sign = if off.point.side == 0 { -1.0 } else { 1.0 };
        assert!(none.abs() < 1e-6 && (error - 3.0 * sign).abs() < 1e-6, "{none} {error}");
        let largest = expected.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
        assert!(slope.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-6 * largest), "{slope:?} {expected:?}");
    }
}

#[test]
fn a_line_that_misses_the_outline_has_an_error_as_if_it_met_it() {
    let ball = Sphere { center: Vector3::new(0.0, 0.0, 1.2), radius: 0.1 };
    let mut contour = Contour::default();
    contour.clear(noise());
    // Its outline ends 24 pixels above the middle.
    let plane = CAMERA.plane(Scan::Row, 119.5 - 30.0);
    let pixel = plane.s_axis() / CAMERA.fx;
    let ray = plane.to_camera([8.0 / CAMERA.fx, plane.stretch()]);
    contour.add(ContourPoint { ray, pixel, across: Vector3::y() / CAMERA.fy, side: 1 });
    contour.select(&ball.coefficients(), |_| true);
    let (error, slope) = contour.points[0].point.error_gradient(&ball.coefficients());
    assert!(error > 8.0 && error.is_finite() && slope.iter().all(|x| x.is_finite()), "{error} {slope:?}");
}

#[test]
fn what_is_grazed_goes_with_the_radius_of_curvature_along_the_view() {
    let radius_px = |q: &Coefficients| {
        // The two rows beside the middle.
        let mut contour = contour_on(119..121, q, 0.0, 0.0, noise());
        contour.select(q, |_| true);
        contour.points.iter().map(|seen| seen.radius_px).sum::<f64>() / 4.0
    };
    let at = |radius: f64| radius / 1.2 * CAMERA.fx;
    let ball = Sphere { center: Vector3::new(0.0, 0.0, 1.2), radius: 0.05 };
    let expected = at(0.05);
    assert!((radius_px(&ball.coefficients()) / expected - 1.0).abs() < 0.01);
    // The more a cylinder leans towards the view, the larger is its radius of curvature along the view.
    for (sine, cosine) in [(0.0, 1.0), (0.6, 0.8), (0.8, 0.6)] {
        let axis = Vector3::new(0.0, cosine, sine);
        let can = Conical { point: ball.center, axis, radius: 0.05, slope: 0.0 };
        let seen = radius_px(&can.coefficients()) * cosine * cosine;
        assert!((seen / expected - 1.0).abs() < 0.02, "{seen} {expected}");
    }
    // The side of a cone leans to its axis: its normal sections are wider by that factor (Meusnier's theorem).
    let cone = |slope: f64| Conical { point: ball.center, axis: Vector3::y(), radius: 0.05, slope };
    let [upright, tapered] = [0.0, 0.3].map(|slope| radius_px(&cone(slope).coefficients()));
    assert!((tapered / upright - (1.0 + 0.3 * 0.3_f64).sqrt()).abs() < 0.002, "{upright} {tapered}");
}

#[test]
fn a_bias_is_across_the_outline() {
    let ball = Sphere { center: Vector3::new(0.0, 0.0, 1.5), radius: 0.15 };
    // A ball whose outline is wider by a pixel on all sides.
    let angle = (ball.radius / ball.center.z).asin();
    let wider = Sphere { radius: ball.center.z * (angle.tan() + 1.0 / CAMERA.fx).atan().sin(), ..ball };
    let bias = biased(Vector4::new(-1.0, 0.0, 1.0, 0.0), [1e-3, 1e-6]);
    let mut contour = contour_on(95..145, &wider.coefficients(), 29.0, 0.0, ContourNoise { bias, ..noise() });
    contour.select(&ball.coefficients(), |_| true);
    assert_eq!(contour.far_off(), 0);
    let rest = term(&contour, &ball).square_sum / contour.used() as f64;
    assert!(rest < 0.02, "{rest} of a variance, where the lines nearly graze the outline, too");
}

const BALL: Sphere = Sphere { center: Vector3::new(0.0, 0.0, 1.2), radius: 0.1 };

/// A ball with depths of noise `sigma` metres and a contour too wide by `outwards` pixels, fitted to both.
fn ball(sigma: f64, outwards: f64, noise: ContourNoise) -> (SurfaceFit<Sphere, 4>, Contour) {
    ball_by(&mut Random(5), sigma, outwards, noise)
}

fn ball_by(random: &mut Random, sigma: f64, outwards: f64, noise: ContourNoise) -> (SurfaceFit<Sphere, 4>, Contour) {
    let ball = BALL;
    let points = seen(&ball.coefficients(), 97..143, 0.0, |z| (z + sigma * random.normal(), sigma * sigma));
    let mut pool = SpaceMoments::default();
    pool.add(&points, 1.0 / (sigma * sigma));
    let mut contour = contour_on(97..143, &ball.coefficients(), 24.0, outwards, noise);
    contour.select(&ball.coefficients(), |_| true);
    (fit_with_contour(&pool.normalized().unwrap(), &contour, &ball).unwrap(), contour)
}

/// Gradient noise of points whose noise acts across the surface, as their weights assume.
fn even(fit: &SurfaceFit<Sphere, 4>, contour: &Contour) -> GradientNoise<4> {
    let mut scatter = GradientNoise::new(&fit.surface);
    scatter.matrix = (fit.inverse.try_inverse().unwrap() - fit.contour) * contour.noise.surface_lines;
    scatter
}

/// Gradient noise of the points of the ball, whose noise acts along their rays.
fn along_rays(fit: &SurfaceFit<Sphere, 4>, sigma: f64) -> GradientNoise<4> {
    let mut scatter = GradientNoise::new(&fit.surface);
    for plane in (97..143).map(|row| CAMERA.plane(Scan::Row, f64::from(row))) {
        let section = section_of(&BALL.coefficients(), &plane);
        for x in (0..320).map(|u| CAMERA.ray_slope(Scan::Row, f64::from(u))) {
            if let Some(z) = hit(&section, x, plane.stretch()) {
                scatter.add(&plane.to_camera([z * x, z * plane.stretch()]), 1.0 / (sigma * sigma));
            }
        }
    }
    scatter
}

/// Estimate of a bias of the first side at the radius of the ball, and its standard deviation.
fn at_the_ball(shown: Information<4>) -> (f64, f64) {
    let ContourBias { mean, covariance } = noise().bias;
    let (mean, covariance) = (shown + Information::of(&mean, &covariance).unwrap()).estimate().unwrap();
    let parts = Vector4::new(1.0, 24.0, 0.0, 0.0);
    (parts.dot(&mean), parts.dot(&(covariance * parts)).sqrt())
}

#[test]
fn what_is_told_of_the_bias_is_as_far_off_as_it_says_although_rays_graze_what_shows_it() {
    let own = biased(Vector4::zeros(), [1e-3, 1e-5]).covariance;
    let exact = ContourNoise { point: Vector2::new(1e-4, 0.0), ..noise() };
    let (mut random, mut squares, tries) = (Random(11), [0.0; 2], 100);
    for _ in 0..tries {
        let (fit, contour) = ball_by(&mut random, 0.004, 0.0, exact);
        for (square, scatter) in squares.iter_mut().zip([along_rays(&fit, 0.004), even(&fit, &contour)]) {
            let (told, sigma) = at_the_ball(contour.bias_evidence(&fit, &scatter, &own).unwrap());
            *square += (told / sigma).powi(2) / f64::from(tries);
        }
    }
    let [along, even] = squares;
    assert!((0.75..1.35).contains(&along), "{squares:?}");
    assert!(even < 0.7 * along, "as if noise moved points across the surface: {squares:?}");
}

#[test]
fn where_points_are_means_over_four_lines_the_contour_counts_as_that_of_each_line() {
    let own = biased(Vector4::zeros(), [0.05, 1e-3]).covariance;
    let bias = ContourBias { covariance: noise().bias.covariance * 0.25, ..noise().bias };
    let variance = noise().point;
    // Here points count a fourth beside a contour that counts fully. That equals a contour of a fourth of the variance, with all
    // evidence divided by four.
    let told = |noise: ContourNoise, own: &Matrix4<f64>| {
        let (fit, contour) = ball(0.004, 0.4, noise);
        contour.bias_evidence(&fit, &even(&fit, &contour), own).unwrap()
    };
    let means = told(ContourNoise { surface_lines: 4.0, ..noise() }, &own);
    let quarter = told(ContourNoise { point: variance * 0.25, bias, ..noise() }, &(own * 0.25));
    assert!((means.matrix * 4.0 - quarter.matrix).amax() < 1e-6 * quarter.matrix.amax());
    assert!((means.vector * 4.0 - quarter.vector).amax() < 1e-6 * quarter.vector.amax());
}

#[test]
fn what_points_and_contour_tell_of_the_bias_makes_the_next_fit_better() {
    let own = biased(Vector4::zeros(), [0.05, 1e-3]).covariance;
    let (well_seen, contour) = ball(0.004, 0.8, noise());
    let shown = contour.bias_evidence(&well_seen, &even(&well_seen, &contour), &own).unwrap();
    let ContourBias { mean, covariance } = noise().bias;
    let (mean, covariance) = (shown + Information::of(&mean, &covariance).unwrap()).estimate().unwrap();
    let bias = ContourBias { mean, covariance };
    let at_this_size = [mean[0] + 24.0 * mean[1], mean[2] + 24.0 * mean[3]];
    assert!((at_this_size[0] + 0.8).abs() < 0.2 && (at_this_size[1] - 0.8).abs() < 0.2, "{at_this_size:?}");

    let radius_error = |noise| (ball(0.02, 0.8, noise).0.surface.radius - 0.1).abs();
    let [before, after] = [noise(), ContourNoise { bias, ..noise() }].map(radius_error);
    assert!(after < 0.5 * before, "{before} {after}");
}

#[test]
fn the_evidence_has_slope_and_curvature_of_the_least_cost_over_the_bias() {
    let own = biased(Vector4::zeros(), [0.05, 1e-3]).covariance;
    let mean = Vector4::new(-0.5, 0.01, 0.6, 0.0);
    let at = |mean| ball(0.004, 0.8, ContourNoise { bias: ContourBias { mean, covariance: own }, ..noise() });
    let least_cost = |mean| {
        let fit = at(mean).0;
        fit.square_sum + fit.contour_sum
    };
    let (fit, contour) = at(mean);
    let Information { matrix, vector } = contour.bias_evidence(&fit, &even(&fit, &contour), &own).unwrap();
    let slope = matrix * mean - vector;
    for (i, h) in [0.05, 2e-3, 0.05, 2e-3].into_iter().enumerate() {
        let [less, same, more] = [-h, 0.0, h].map(|step| least_cost(mean + Vector4::ith(i, step)));
        let (measured, bent) = ((more - less) / (4.0 * h), (more + less - 2.0 * same) / (2.0 * h * h));
        assert!((measured / slope[i] - 1.0).abs() < 0.02, "slope along {i}: {measured} {}", slope[i]);
        let expected = matrix[(i, i)];
        assert!((bent / expected - 1.0).abs() < 0.02, "curvature along {i}: {bent} {expected}");
    }
}

#[test]
fn the_scatter_of_contours_of_two_sizes_tells_their_noise_in_pixels_and_in_radii() {
    let mut random = Random(3);
    let mut shown = Information::default();
    for object in 0..300 {
        let radius_px = [12.0, 40.0][object % 2];
        let sigma = 0.2_f64.hypot(0.01 * radius_px);
        let mut contour = contour_on(105..140, &cup().coefficients(), radius_px, 0.7, noise());
        for seen in &mut contour.points {
            seen.point.ray += seen.point.pixel * (sigma * random.normal());
        }
        shown += contour.noise_evidence::<_, 6>(&cup()).unwrap();
    }
    let (variance, covariance) = shown.estimate().unwrap();
    for (i, expected) in [0.2_f64.powi(2), 0.01_f64.powi(2)].into_iter().enumerate() {
        assert!((variance[i] / expected - 1.0).abs() < 0.15, "{i}: {} {expected}", variance[i]);
        assert!(covariance[(i, i)].sqrt() < expected, "{i}: what is expected before is far more vague");
    }
}

#[test]
fn four_lines_that_share_their_noise_tell_a_fourth_of_what_they_would_by_a_bias_that_is_known_twice_as_well() {
    let sigmas = [[1.0, 0.05], [0.3, 5e-3]];
    let told = |shared_lines: f64, factor: f64| {
        let [bias, own] = sigmas.map(|sigmas| biased(Vector4::zeros(), sigmas.map(|sigma| factor * sigma)));
        let (fit, contour) =
            ball(0.004, 0.4, ContourNoise { shared_lines, surface_lines: shared_lines, bias, ..noise() });
        let bias = contour.bias_evidence(&fit, &even(&fit, &contour), &own.covariance).unwrap();
        (bias, contour.noise_evidence(&fit.surface).unwrap())
    };
    let ((bias, noise), (bias_of_one, noise_of_one)) = (told(4.0, 1.0), told(1.0, 0.5));
    assert!((bias.matrix * 4.0 - bias_of_one.matrix).amax() < 1e-6 * bias_of_one.matrix.amax());
    assert!((bias.vector * 4.0 - bias_of_one.vector).amax() < 1e-6 * bias_of_one.vector.amax());
    assert!((noise.matrix * 4.0 - noise_of_one.matrix).amax() < 1e-6 * noise_of_one.matrix.amax());
}

#[test]
fn a_contour_is_expected_outside_by_the_mean_of_its_sides_across_the_outline() {
    let outside = |mean: [f64; 4]| {
        let bias = ContourBias { mean: mean.into(), ..noise().bias };
        let q = cup().coefficients();
        let mut contour = contour_on(105..140, &q, 12.0, 0.0, ContourNoise { bias, ..noise() });
        contour.points.iter_mut().for_each(|seen| seen.place(0.8, 12.0, &contour.noise));
        // From here on only the last side counts.
        let both = contour.outside_px();
        contour.points.iter_mut().for_each(|seen| seen.used = seen.point.side == 1);
        [both, contour.outside_px()]
    };
    for (mean, expected) in [
        ([-1.0, 0.0, 3.0, 0.0], [2.0, 3.0]),
        ([0.0, -0.25, 0.0, 0.5], [4.5, 6.0]),
        ([-1.0, 0.0, -0.5, 0.0], [0.25, 0.0]),
        ([1.0, 0.0, -3.0, 0.0], [0.0, 0.0]),
    ] {
        let shown = outside(mean);
        assert!((Vector2::from(shown) - Vector2::from(expected)).amax() < 1e-9, "{mean:?}: {shown:?}");
    }
    assert_eq!(Contour::default().outside_px().to_bits(), 0.0_f64.to_bits(), "no points");
}

#[test]
fn what_is_far_off_is_not_used() {
    for pixels in [8.0, -8.0] {
        let exact = ContourNoise { point: Vector2::new(0.01, 0.0), ..noise() };
        let mut contour = contour_on(105..140, &cup().coefficients(), 12.0, 0.0, exact);
        let [first, ..] = contour.points[..] else { panic!() };
        for far_off in 1..=3 {
            contour.add(ContourPoint { ray: first.point.ray + first.point.pixel * pixels, ..first.point });
            contour.select(&cup().coefficients(), |_| true);
            assert_eq!((contour.used() + far_off, contour.far_off()), (contour.points(), far_off));
            assert_eq!(contour.least_left_out(), far_off as f64 * GATE * GATE, "each counts up to the gate");
        }
        contour.select(&cup().coefficients(), |_| false);
        assert_eq!((contour.used(), contour.far_off(), contour.least_left_out()), (0, 0, 0.0));
    }
}

#[test]
fn what_is_seen_is_asked_of_the_point_that_the_ray_touches() {
    let q = cup().coefficients();
    let mut contour = contour(&cup(), 0.0);
    contour.select(&q, |p| dot(&q, &monomials(p)).abs() < 1e-9);
    assert_eq!(contour.used(), contour.points());
}

#[test]
fn points_count_as_near_by_their_noise_about_the_middle_of_their_side_within_its_offset() {
    let q = cup().coefficients();
    let are_used = |outwards: f64, sigma: f64, mean_px: f64| {
        let bias = biased(Vector4::new(-mean_px, 0.0, mean_px, 0.0), [0.8, 1e-6]);
        let noise = ContourNoise { point: Vector2::new(sigma * sigma, 0.0), bias, ..noise() };
        let mut contour = contour_on(105..140, &q, 12.0, outwards, noise);
        contour.select(&q, |_| true);
        contour.used()
    };
    let all = are_used(0.0, 0.1, 0.0);
    assert_eq!([1.5, -1.5].map(|outwards| are_used(outwards, 0.1, 0.0)), [all; 2], "within two sigmas of the offset");
    assert_eq!([2.3, -2.3].map(|outwards| are_used(outwards, 0.1, 0.0)), [0; 2], "seven sigmas of a point beyond");
    assert_eq!(are_used(3.0, 0.5, 0.0), all, "three of a noisy point beyond");
    assert_eq!(are_used(6.0, 0.1, 6.0), all, "where as much is expected");
}

#[test]
fn the_noise_is_what_is_left_of_a_contour_by_the_bias_that_is_expected_and_seen() {
    let surface = cup();
    let bias = biased(Vector4::new(-0.4, 0.0, 0.4, 0.0), [0.1, 1e-6]);
    let contour = contour_on(105..140, &surface.coefficients(), 12.0, 0.7, ContourNoise { bias, ..noise() });
    let Information { matrix, vector } = contour.noise_evidence::<_, 6>(&surface).unwrap();
    // 0.3 pixels of the offset are unexpected; the estimate of the bias takes up about half of them, against its prior.
    let left = (vector[0] / matrix[(0, 0)]).sqrt();
    assert!((0.05..0.25).contains(&left), "{left}");
    let variance = noise().point.dot(&Vector2::new(1.0, 144.0));
    let expected = contour.used() as f64 / (2.0 * variance * variance);
    assert!((matrix[(0, 0)] / expected - 1.0).abs() < 1e-9, "each square scatters by 2 v^2");
}

#[test]
fn the_radius_of_curvature_is_that_of_the_surface_however_long_the_ray_and_however_steep_the_function() {
    let (center, radius) = (Vector3::new(0.5, -0.4, 1.2), 0.3);
    let q = Sphere { center, radius }.coefficients();
    let sine = radius / center.norm();
    for beside in [Vector3::x(), Vector3::y()].map(|x| center.cross(&x).normalize()) {
        let ray = center.normalize() * (1.0 - sine * sine).sqrt() + beside * sine;
        for (length, factor) in [(1.0, 1.0), (2.5, 1.0), (1.0, 4.0), (0.3, 0.2)] {
            let (ray, q) = (ray * length, q.map(|q| q * factor));
            let found = Along::new(&q, &ray, &Vector3::x()).curvature_radius(&q, &ray);
            assert!((found - radius).abs() < 1e-9, "{found} of a ray of {length} and {factor} times the function");
        }
    }
}

#[test]
fn the_slope_of_an_error_is_that_by_the_coefficients_however_long_the_rays_are() {
    let q = cup().coefficients();
    for ModelledPoint { point, .. } in contour(&cup(), 0.0).points {
        let [ray, pixel, across] = [point.ray, point.pixel, point.across].map(|part| part * 1.7);
        let point = ContourPoint { ray, pixel, across, ..point };
        let (_, slope) = point.error_gradient(&q);
        let largest = slope.iter().fold(0.0, |most: f64, x| most.max(x.abs()));
        for k in 0..QUADRIC_TERMS {
            let at = |h: f64| {
                let mut changed = q;
                changed[k] += h;
                point.error_gradient(&changed).0
            };
            let measured = (at(1e-7) - at(-1e-7)) / 2e-7;
            assert!((measured - slope[k]).abs() < 1e-4 * largest, "{k}: {measured} {}", slope[k]);
        }
    }
}

#[test]
fn the_points_of_each_side_are_counted_and_their_radii_averaged() {
    let mut contour = contour(&cup(), 0.0);
    for (i, seen) in contour.points.iter_mut().enumerate() {
        let line = i / 2;
        seen.used = line < if seen.point.side == 0 { 10 } else { 4 };
        seen.radius_px = if seen.point.side == 0 { 20.0 + line as f64 } else { 7.0 };
    }
    let ((first, of_first), (last, of_last)) = (contour.used_on(0), contour.used_on(1));
    assert_eq!((first, last), (10, 4));
    assert!((of_first - 24.5).abs() < 1e-12 && (of_last - 7.0).abs() < 1e-12, "{of_first} {of_last}");
    contour.points.iter_mut().for_each(|seen| seen.used &= seen.point.side == 0);
    assert_eq!(contour.used_on(1), (0, 0.0));
}

#[test]
fn what_the_contour_tells_of_a_fit_is_in_metres_and_radians() {
    let can = Conical { slope: 0.0, ..cup() };
    let points = of_exact(&seen(&can.coefficients(), 105..140, 0.0, exact));
    let mut contour = contour_on(105..140, &can.coefficients(), 12.0, 0.3, noise());
    contour.select(&can.coefficients(), |_| true);
    let fit = fit_with_contour::<_, 5>(&points, &contour, &can).unwrap();
    let expected = term::<_, 5>(&contour, &fit.surface).matrix;
    for (i, j) in (0..5).flat_map(|i| (0..5).map(move |j| (i, j))) {
        let size = (expected[(i, i)] * expected[(j, j)]).sqrt();
        assert!((fit.contour[(i, j)] - expected[(i, j)]).abs() < 1e-6 * size, "{i} {j}: {} {expected}", fit.contour);
    }
}
