//! Tests of the pooled fits on rows of simulated points.

use super::*;
use crate::simulated::{CAMERA, Random, exact, hit, of_exact, seen};
use crate::{Conical, Scan, SpaceMoments, Sphere, Vector3};

/// A depth as a Kinect v1 measures it, and its variance: Nguyen, Izadi and Lovell (2012), and steps of the disparity.
fn kinect(z: f64, random: &mut Random) -> (f64, f64) {
    let (axial, step) = (0.0012 + 0.0019 * (z - 0.4).powi(2), 1.0 / (8.0 * 580.0 * 0.075));
    let noisy = z + axial * random.normal();
    let stepped = 1.0 / (step * (1.0 / (step * noisy)).round());
    (stepped, axial * axial + (step * z * z).powi(2) / 12.0)
}

fn can(distance: f64) -> Conical {
    Conical { point: Vector3::new(0.0, 0.0, distance), axis: Vector3::y(), radius: 0.2, slope: 0.0 }
}

/// Mean and standard deviation of the radius of a can over some frames.
fn radius_of_can(distance: f64, hidden: f64, frames: u64) -> (f64, f64) {
    let q = can(distance).coefficients();
    let half = (0.35 * CAMERA.fy / distance) as u32;
    let rows = 120 - half.min(110)..120 + half.min(110);
    let guess = Conical { axis: Vector3::new(0.05, 1.0, 0.1).normalize(), radius: 0.15, ..can(distance - 0.03) };
    let radii: Vec<_> = (0..frames)
        .map(|frame| {
            let mut random = Random(frame + 1);
            let pool = seen(&q, rows.clone(), hidden, |z| kinect(z, &mut random));
            fit_surface::<_, 5>(&pool.normalized().unwrap(), &guess, f64::INFINITY).unwrap().surface.radius
        })
        .collect();
    let mean = radii.iter().sum::<f64>() / frames as f64;
    let variance = radii.iter().map(|r| (r - mean).powi(2)).sum::<f64>() / (frames as f64 - 1.0);
    (mean, variance.sqrt())
}

#[test]
fn a_can_keeps_its_radius_with_distance_and_occlusion() {
    // The table in the description of the method, last column: distance, hidden share, mean and sigma over 20 frames.
    let table = [
        (1.0, 0.0, 0.0003, 0.0003),
        (1.0, 0.5, 0.0004, 0.0006),
        (1.0, 0.7, 0.0012, 0.0016),
        (2.0, 0.0, 0.0006, 0.0008),
        (2.0, 0.7, 0.005, 0.008),
        (3.0, 0.0, 0.0015, 0.003),
        (3.0, 0.5, 0.006, 0.016),
        (3.0, 0.7, 0.02, 0.05),
    ];
    for (distance, hidden, bias, spread) in table {
        let (mean, sigma) = radius_of_can(distance, hidden, 20);
        println!("{distance} m, {:2.0} % hidden: {mean:.4} +- {sigma:.4}", 100.0 * hidden);
        assert!((mean - 0.2).abs() < bias && sigma < spread, "{mean} {sigma} at {distance} m, {hidden} hidden");
    }
}

#[test]
fn exact_points_give_each_surface_back() {
    let sphere = Sphere { center: Vector3::new(0.1, 0.05, 1.2), radius: 0.15 };
    let pool = of_exact(&seen(&sphere.coefficients(), 90..170, 0.3, exact));
    let start = Sphere { center: pool.origin + Vector3::z() * 0.1, radius: 0.1 };
    let found = fit_surface(&pool, &start, f64::INFINITY).unwrap();
    assert!((found.surface.center - sphere.center).norm() < 1e-7, "{found:?}");
    let algebraic = pool.sphere().unwrap();
    assert!(
        (algebraic.center - sphere.center).norm() < 1e-7 && (algebraic.radius - 0.15).abs() < 1e-7,
        "{algebraic:?}"
    );

    let axis = Vector3::new(0.3, 0.9, -0.4).normalize();
    let cone = Conical { point: Vector3::new(0.1, 0.0, 1.3), axis, radius: 0.12, slope: 0.25 };
    let pool = of_exact(&seen(&cone.coefficients(), 80..160, 0.0, exact));
    let start = Conical { axis: Vector3::y(), radius: 0.1, slope: 0.0, ..cone };
    let found = fit_surface::<_, 6>(&pool, &start, f64::INFINITY).unwrap();
    let surface = found.surface.anchored(&cone.point);
    assert!((surface.radius - 0.12).abs() < 1e-6 && (surface.slope - 0.25).abs() < 1e-6, "{found:?}");
    assert!((surface.axis - axis).norm() < 1e-6 && (surface.point - cone.point).norm() < 1e-6);
}

#[test]
fn a_fit_that_cannot_be_good_enough_is_given_up() {
    let sphere = Sphere { center: Vector3::new(0.0, 0.0, 1.5), radius: 0.15 };
    let mut random = Random(7);
    let points = seen(&sphere.coefficients(), 96..144, 0.0, |z| (z + 0.003 * random.normal(), 9e-6));
    let mut pool = SpaceMoments::default();
    pool.add(&points, 1.0 / 9e-6);
    let pool = pool.normalized().unwrap();
    let count = points.weight();
    let start = Sphere { radius: 0.12, ..sphere };
    let best = fit_surface(&pool, &start, f64::INFINITY).unwrap();
    assert_eq!(fit_surface(&pool, &start, 0.2 * count), Some(best), "good enough: nothing else than without a limit");
    let can = Conical { radius: 0.12, ..can(1.5) };
    let best = fit_surface::<_, 5>(&pool, &can, f64::INFINITY).unwrap().square_sum;
    assert!(best > 0.5 * count, "{best} of {count}");
    assert_eq!(fit_surface::<_, 5>(&pool, &can, 0.2 * count), None);
    assert!(fit_surface::<_, 5>(&pool, &can, 1.1 * best).is_some());
}

#[test]
fn a_fit_from_far_away_is_not_given_up_while_each_step_brings_it_much_nearer() {
    let sphere = Sphere { center: Vector3::new(0.0, 0.0, 1.5), radius: 0.15 };
    let mut pool = SpaceMoments::default();
    pool.add(&seen(&sphere.coefficients(), 96..144, 0.0, exact), 1.0 / 9e-6);
    let pool = pool.normalized().unwrap();
    for radius in [0.02, 0.05, 0.4, 1.0] {
        let start = Sphere { radius, ..sphere };
        let best = fit_surface(&pool, &start, f64::INFINITY).unwrap();
        assert_eq!(fit_surface(&pool, &start, 1.0), Some(best), "from {radius} m");
    }
}

#[test]
fn twice_as_large_and_far_away_a_can_is_known_as_well_in_metres_and_twice_as_well_in_angles() {
    let inverse = |scale: f64| {
        let can = Conical { radius: 0.2 * scale, ..can(scale) };
        let pool = of_exact(&seen(&can.coefficients(), 60..180, 0.0, exact));
        fit_surface::<_, 5>(&pool, &can, f64::INFINITY).unwrap().inverse
    };
    let (near, far, lengths) = (inverse(1.0), inverse(2.0), <Conical as Surface<5>>::lengths());
    let unit = |i: usize| if lengths[i] { 1.0 } else { 0.5 };
    for (i, j) in (0..5).flat_map(|i| (0..5).map(move |j| (i, j))) {
        let (found, expected) = (far[(i, j)], near[(i, j)] * unit(i) * unit(j));
        assert!((found - expected).abs() < 1e-6 * (far[(i, i)] * far[(j, j)]).sqrt(), "{i} {j}: {found} {expected}");
    }
}

#[test]
fn the_covariance_is_that_of_the_errors() {
    let sphere = Sphere { center: Vector3::new(0.0, 0.0, 1.5), radius: 0.15 };
    let q = sphere.coefficients();
    let noise = 0.003_f64;
    let (mut ratios, mut square_sums) = (Vec::new(), Vec::new());
    for frame in 0..60 {
        let mut random = Random(100 + frame);
        let pool = seen(&q, 96..144, 0.0, |z| (z + noise * random.normal(), noise * noise)).normalized().unwrap();
        let found = fit_surface(&pool, &Sphere { center: sphere.center, radius: 0.14 }, f64::INFINITY).unwrap();
        let mut scatter = GradientNoise::new(&found.surface);
        for row in 96..144 {
            let plane = CAMERA.plane(Scan::Row, f64::from(row));
            let conic = crate::section_of(&q, &plane);
            let ray = |u: u32| CAMERA.ray_slope(Scan::Row, f64::from(u));
            for (x, z) in (0..320).map(ray).filter_map(|x| Some((x, hit(&conic, x, plane.stretch())?))) {
                scatter.add(&plane.to_camera([x * z, plane.stretch() * z]), noise * noise);
            }
        }
        ratios.push((found.surface.radius - 0.15) / scatter.covariance(&found, 1.0)[(3, 3)].sqrt());
        square_sums.push(found.square_sum / (pool.matrix[9][9] * noise * noise));
    }
    let scatter = (ratios.iter().map(|x| x * x).sum::<f64>() / ratios.len() as f64).sqrt();
    let mean_square = square_sums.iter().sum::<f64>() / square_sums.len() as f64;
    assert!((0.75..1.3).contains(&scatter), "{scatter}");
    assert!(mean_square.abs() < 0.02, "{mean_square}");
}

#[test]
fn lines_that_share_where_they_see_the_contour_count_as_one() {
    let surface = Sphere { center: Vector3::new(0.0, 0.0, 1.5), radius: 0.15 };
    let (inverse, contour) = (SMatrix::identity() * 0.1, SMatrix::identity() * 4.0);
    let fit = SurfaceFit { surface, square_sum: 0.0, contour_sum: 0.0, inverse, contour };
    let variance = |shared_lines: f64| GradientNoise::new(&surface).covariance(&fit, shared_lines)[(3, 3)];
    assert!((variance(1.0) - 0.04).abs() < 1e-12 && (variance(5.0) - 0.2).abs() < 1e-12);
}

#[test]
fn a_prediction_adds_what_is_not_known_of_the_place_to_what_is_not_known_of_the_size() {
    let surface = Sphere { center: Vector3::new(0.1, -0.2, 1.5), radius: 0.15 };
    let inverse = SMatrix::from_diagonal(&SVector::from([1e-4, 4e-4, 9e-4, 25e-4]));
    let prediction =
        Prediction::new(&SurfaceFit { surface, square_sum: 0.0, contour_sum: 0.0, inverse, contour: inverse });
    let on = |direction: Vector3| prediction.variance(&(surface.center + direction * surface.radius));
    assert!((on(Vector3::x()) - 26e-4).abs() < 1e-12 && (on(-Vector3::y()) - 29e-4).abs() < 1e-12);
    assert!((on(Vector3::new(0.6, 0.0, -0.8)) - (25.0 + 0.36 + 0.64 * 9.0) * 1e-4).abs() < 1e-12);
}

#[test]
fn a_damped_step_solves_the_equations_with_that_share_added_to_each_parameter() {
    let matrix = SMatrix::<f64, 2, 2>::new(4.0, 2.0, 2.0, 9.0) * 1e-6;
    let gradient = SVector::<f64, 2>::new(-12e-6, 7e-6);
    let system = System { square_sum: 0.0, contour_sum: 0.0, gradient, matrix, contour: matrix };
    // 6 x + 2 y = 12, 2 x + 13.5 y = -7
    let [x, y] = system.step(0.5).unwrap();
    assert!((x - 176.0 / 77.0).abs() < 1e-9 && (y + 66.0 / 77.0).abs() < 1e-9, "{x} {y}");
}

#[test]
fn a_direction_that_points_tell_less_than_nothing_of_is_known_badly_and_the_others_as_they_are() {
    for units in [[1.0, 1.0], [0.01, 3.0], [20.0, 0.5]] {
        let unit = SMatrix::<f64, 2, 2>::from_diagonal(&SVector::from(units));
        let matrix = unit * SMatrix::<f64, 2, 2>::new(1.0, 1.00001, 1.00001, 1.0) * unit;
        let system = System { square_sum: 0.0, contour_sum: 0.0, gradient: SVector::zeros(), matrix, contour: matrix };
        let inverse = unit * system.inverse(1.0, &[true; 2]).unwrap() * unit;
        // (x + y) / sqrt(2) has the curvature 2. That of (x - y) / sqrt(2) is negative, and is damped to about a ten thousandth
        // of it.
        let [sum, difference] = [[1.0, 1.0], [1.0, -1.0]].map(SVector::from).map(|v| v.dot(&(inverse * v)) / 2.0);
        assert!(
            (sum - 0.5).abs() < 1e-3 && (5e3..2e4).contains(&difference),
            "{sum} {difference} in units of {units:?}"
        );
    }
}

#[test]
fn the_limit_of_a_fit_may_be_near_its_best_sum() {
    let sphere = Sphere { center: Vector3::new(0.0, 0.0, 1.5), radius: 0.15 };
    let mut pool = SpaceMoments::default();
    pool.add(&seen(&sphere.coefficients(), 96..144, 0.0, exact), 1.0 / 9e-6);
    let pool = pool.normalized().unwrap();
    for radius in [0.1, 0.12, 0.2] {
        let start = Conical { radius, ..can(1.5) };
        let best = fit_surface::<_, 5>(&pool, &start, f64::INFINITY).unwrap().square_sum;
        for share in [0.2, 0.5, 0.8, 0.9, 0.95] {
            assert_eq!(fit_surface::<_, 5>(&pool, &start, share * best), None, "{share} of {best} from {radius} m");
        }
        assert!(fit_surface::<_, 5>(&pool, &start, 1.01 * best).is_some());
    }
}

#[test]
fn from_a_start_whose_first_step_goes_too_far_or_gains_little_a_fit_comes_to_its_surface_and_is_not_given_up() {
    let axis = Vector3::new(0.3, 0.9, -0.4).normalize();
    let can = Conical { point: Vector3::new(0.1, 0.0, 1.3), axis, radius: 0.12, slope: 0.0 };
    let mut pool = SpaceMoments::default();
    pool.add(&seen(&can.coefficients(), 80..160, 0.0, exact), 1.0 / 9e-6);
    let pool = pool.normalized().unwrap();
    let [u, v] = can.across();
    for (tilt, radius, behind) in [(0.3, 0.3, 0.3), (0.3, 1.0, 0.3), (0.6, 0.3, -0.1), (0.0, 0.06, -0.1)] {
        let axis = (axis + (u * 0.6 + v * 0.8) * tilt).normalize();
        let start = Conical { point: can.point + Vector3::z() * behind, axis, radius, slope: 0.0 };
        let best = fit_surface::<_, 5>(&pool, &start, f64::INFINITY).unwrap();
        let found = best.surface.anchored(&can.point);
        assert!((found.radius - 0.12).abs() < 1e-4 && found.axis.cross(&can.axis).norm() < 1e-4, "{found:?}");
        assert_eq!(fit_surface::<_, 5>(&pool, &start, 1.0), Some(best), "from {start:?}");
    }
}

#[test]
fn where_moments_tell_less_than_nothing_of_a_direction_a_fit_goes_on_in_the_others() {
    let sphere = Sphere { center: Vector3::new(0.0, 0.0, 1.5), radius: 0.15 };
    let mut pool = SpaceMoments::default();
    pool.add(&seen(&sphere.coefficients(), 96..144, 0.0, exact), 1.0 / 9e-6);
    let mut pool = pool.normalized().unwrap();
    let start = Sphere { center: Vector3::new(0.03, -0.02, 1.52), radius: 0.14 };
    // Subtracts a tenth more than the moments hold on a ball that grows as it moves away.
    let [_, _, depth, radius] = start.to_local(&pool.origin, pool.scale).derivatives();
    let both: Coefficients = std::array::from_fn(|i| depth[i] + radius[i]);
    let told = pool.times(&both);
    let factor = 1.1 / dot(&told, &both);
    for (row, of_row) in pool.matrix.iter_mut().zip(told) {
        row.iter_mut().zip(told).for_each(|(entry, of_column)| *entry -= factor * of_row * of_column);
    }
    let center = fit_surface(&pool, &start, f64::INFINITY).unwrap().surface.center;
    assert!(center.x.abs() < 0.005 && center.y.abs() < 0.005, "{center}");
}
