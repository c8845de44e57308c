//! The report on a verified model, with the standard deviations that follow from the noise of the sensor.

use super::arcs::Arc;
use super::contours::{FLATTENED_PX, SYSTEMATIC, SYSTEMATIC_PX};
use super::model::Model;
use super::region::Region;
use super::verify::{self, Measured};
use conicflow_geometry::{Conical, ScanPlane, Surface, SurfaceFit, Vector3};
use conicflow_messages::{Object, ObjectKind, ObjectSigma};
use nalgebra::{Matrix3, SMatrix};
use std::f64::consts::SQRT_2;

/// Lower bound of the cosine between an axis and the normal of the scan planes, which keeps the spacing along the axis finite.
const MOST_OBLIQUE: f64 = 0.2; // [algorithmic]
/// Standard deviation of the end of an object, in scan lines: noise and rims cost some lines. With this value the errors of
/// lengths in simulated frames, in units of their reported sigma, scatter by (half of the 16th to the 84th percentile, by a
/// script that is not kept): cylinders 0.7 (Kinect at 320x240), 1.1 (D435 there) and 1.1 (Kinect at 640x480), cones 1.4, 1.9 and
/// 1.1. The narrow end of a cone is lost where its radius is below about six pixels.
const END_LINES: f64 = 1.5; // [measured]

/// Returns the distance along an axis, in metres, between neighbouring scan planes, whose perpendicular distance is `spacing`.
pub(super) fn spacing_along(spacing: f64, plane: &ScanPlane, axis: &Vector3) -> f64 {
    spacing / axis.dot(&plane.normal()).abs().max(MOST_OBLIQUE)
}

/// Returns the standard deviation of an end along the axis, in metres; `spacing` is the perpendicular distance of scan planes in
/// metres.
pub fn end_sigma(spacing: f64, plane: &ScanPlane, axis: &Vector3) -> f64 {
    END_LINES * spacing_along(spacing, plane, axis)
}

/// Returns the object that reports a verified region.
pub(super) fn report(region: &Region, measured: &Measured) -> Object {
    let center = verify::middle(region, measured);
    let object = Object {
        kind: region.model.kind().code(),
        points: measured.count,
        rows: measured.lines,
        center: center.into(),
        rms: (measured.residual.max(0.0) * measured.variance).sqrt(),
        arc: measured.angle,
        ..Object::default()
    };
    let first = region.ends()[0];
    let end = |surface: &Conical| end_sigma(first.spacing, &first.plane, &surface.axis);
    let object = match &region.model {
        Model::Sphere(fit) => {
            let covariance = covariance(region, fit);
            let sigma = ObjectSigma {
                center: [0, 1, 2].map(|i| [0, 1, 2].map(|j| covariance[(i, j)])),
                radius: covariance[(3, 3)].max(0.0).sqrt(),
                ..ObjectSigma::default()
            };
            Object { radius: fit.surface.radius, sigma, ..object }
        }
        Model::Cylinder(fit) => {
            let covariance = covariance(region, fit);
            let surface = fit.surface;
            let sigma = conical_sigma(&surface, &covariance, measured, end(&surface));
            let length = measured.extent[1] - measured.extent[0];
            Object { radius: surface.radius, axis: surface.axis.into(), length, sigma, ..object }
        }
        Model::Cone(fit) => {
            let covariance = covariance(region, fit);
            let surface = fit.surface;
            let half_angle = surface.half_angle();
            let as_cylinder = covariance.fixed_view::<5, 5>(0, 0).into_owned();
            let mut sigma = conical_sigma(&surface, &as_cylinder, measured, end(&surface));
            let middle = 0.5 * (measured.extent[0] + measured.extent[1]);
            let [radius, mixed, slope] = [(4, 4), (4, 5), (5, 5)].map(|place| covariance[place]);
            sigma.radius = (radius + middle * (2.0 * mixed + middle * slope)).max(0.0).sqrt();
            sigma.half_angle = slope.max(0.0).sqrt() * half_angle.cos().powi(2);
            cone(object, &surface, half_angle, sigma, measured)
        }
    };
    with_systematic_errors(object, first.pitch)
}

/// Adds the systematic errors of sensors to the standard deviations of an object; `pixel` is the size of a pixel there, in
/// metres.
fn with_systematic_errors(mut object: Object, pixel: f64) -> Object {
    let error = (SYSTEMATIC * object.radius).hypot(SYSTEMATIC_PX * pixel);
    add_error(&mut object, error);
    object
}

/// Adds to the standard deviations of an object the flattening of its silhouettes by the sensor; `arc` is one of its arcs.
pub(super) fn add_flattening(object: &mut Object, arc: &Arc) {
    add_error(object, FLATTENED_PX * (arc.correlation_px - 1.0) * arc.pitch);
}

/// Adds a systematic error in metres to the standard deviations of the radius, the centre and the angles: both ends may be off,
/// each by `error`, which turns the axis by `sqrt(2) error / length`.
fn add_error(object: &mut Object, error: f64) {
    let sigma = &mut object.sigma;
    sigma.radius = sigma.radius.hypot(error);
    (0..3).for_each(|i| sigma.center[i][i] += error * error);
    let angle = SQRT_2 * error / object.length;
    if object.kind != ObjectKind::Sphere.code() {
        sigma.axis = sigma.axis.hypot(angle);
    }
    if object.kind == ObjectKind::Cone.code() {
        sigma.half_angle = sigma.half_angle.hypot(angle);
    }
}

fn cone(object: Object, surface: &Conical, half_angle: f64, sigma: ObjectSigma, measured: &Measured) -> Object {
    let [from, to] = measured.extent;
    // At the apex rounding may make the radius slightly negative.
    let radius = |along: f64| (surface.radius + surface.slope * along).max(0.0);
    Object {
        kind: ObjectKind::Cone.code(),
        axis: surface.axis.into(),
        radius: radius(0.5 * (from + to)),
        length: to - from,
        half_angle,
        base_radius: radius(to),
        top_radius: radius(from),
        apex: surface.apex().into(),
        sigma,
        ..object
    }
}

/// Returns the standard deviations of a cylinder or cone from the covariance of two tilts, two shifts across the axis, and the
/// radius.
fn conical_sigma(surface: &Conical, covariance: &SMatrix<f64, 5, 5>, measured: &Measured, end: f64) -> ObjectSigma {
    let middle = 0.5 * (measured.extent[0] + measured.extent[1]);
    let across = surface.across();
    let mut center = surface.axis * surface.axis.transpose() * (0.5 * end * end);
    for (i, u) in across.iter().enumerate() {
        for (j, v) in across.iter().enumerate() {
            let tilt = covariance[(i, j)] * middle * middle;
            let mixed = middle * (covariance[(i, 2 + j)] + covariance[(2 + i, j)]);
            center += u * v.transpose() * (covariance[(2 + i, 2 + j)] + mixed + tilt);
        }
    }
    let center: Matrix3<f64> = (center + center.transpose()) * 0.5;
    ObjectSigma {
        center: [0, 1, 2].map(|i| [0, 1, 2].map(|j| center[(i, j)])),
        axis: (covariance[(0, 0)] + covariance[(1, 1)]).max(0.0).sqrt(),
        radius: covariance[(4, 4)].max(0.0).sqrt(),
        length: (2.0 * end * end).sqrt(),
        half_angle: 0.0,
    }
}

/// Returns the covariance of a fit's parameters.
fn covariance<S: Surface<N>, const N: usize>(region: &Region, fit: &SurfaceFit<S, N>) -> SMatrix<f64, N, N> {
    region.gradient_noise(fit).covariance(fit, region.shared_lines())
}

#[cfg(test)]
mod tests {
    use super::super::arcs::Arcs;
    use super::super::model;
    use super::super::tests::{arcs_by, arcs_of, rows_of};
    use super::*;
    use conicflow_geometry::{Pinhole, Scan};
    use conicflow_lab::rendered::{KINECT_HALF, frustum, sphere};
    use conicflow_messages::{Camera, Ellipse, Header, NoiseModel};

    #[test]
    fn lines_lie_farther_apart_along_an_axis_that_leans_and_an_end_is_known_by_lines() {
        let plane = Pinhole { fx: 500.0, fy: 500.0, cx: 0.0, cy: 0.0 }.plane(Scan::Row, 0.0);
        let leaning = |degrees: f64| Vector3::new(degrees.to_radians().sin(), degrees.to_radians().cos(), 0.0);
        let along = |degrees: f64| spacing_along(0.002, &plane, &leaning(degrees));
        for (degrees, expected) in [(0.0, 0.002), (60.0, 0.004), (180.0, 0.002), (90.0, 0.01)] {
            assert!((along(degrees) - expected).abs() < 1e-9, "{degrees} degrees");
            let end = end_sigma(0.002, &plane, &leaning(degrees));
            assert!((end - 1.5 * expected).abs() < 1e-9, "{end} at {degrees} degrees");
        }
    }

    fn measured(extent: [f64; 2]) -> Measured {
        let (count, points, lines, angle) = (1000, 900.0, 50, 2.0);
        Measured { count, points, lines, variance: 4e-6, residual: 0.25, curvature: 100.0, angle, extent }
    }

    /// A covariance in which all six parameters are correlated.
    fn correlated() -> SMatrix<f64, 6, 6> {
        let root = SMatrix::<f64, 6, 6>::from_fn(|i, j| 1e-3 * (1.7 * i as f64 + 2.9 * j as f64 + 0.3).sin());
        root * root.transpose()
    }

    /// Compares with the derivatives of the middle `point + z (axis + u a + v b) + u c + v d` by two tilts, a and b, and two
    /// shifts, c and d.
    #[test]
    fn the_sigma_of_a_middle_is_that_of_tilts_and_shifts_and_along_the_axis_of_both_ends() {
        let axis = Vector3::new(0.2, 0.9, -0.3).normalize();
        let surface = Conical { point: Vector3::new(0.1, 0.2, 1.5), axis, radius: 0.1, slope: 0.0 };
        let covariance = correlated().fixed_view::<5, 5>(0, 0).into_owned();
        let (z, end, [u, v]) = (0.7, 0.003, surface.across());
        let sigma = conical_sigma(&surface, &covariance, &measured([z - 0.2, z + 0.2]), end);
        let by = SMatrix::<f64, 3, 5>::from_columns(&[u * z, v * z, u, v, Vector3::zeros()]);
        let expected = by * covariance * by.transpose() + axis * axis.transpose() * (end * end / 2.0);
        for (i, j) in (0..3).flat_map(|i| (0..3).map(move |j| (i, j))) {
            assert!((sigma.center[i][j] - expected[(i, j)]).abs() < 1e-15, "{:?}, not {expected}", sigma.center);
        }
        assert!((sigma.axis.powi(2) - covariance[(0, 0)] - covariance[(1, 1)]).abs() < 1e-15);
        assert!((sigma.radius.powi(2) - covariance[(4, 4)]).abs() < 1e-15);
        assert!((sigma.length - 0.003 * SQRT_2).abs() < 1e-12 && sigma.half_angle == 0.0);
    }

    #[test]
    fn what_sensors_do_wrong_is_part_of_the_sigmas() {
        let sigma = ObjectSigma { radius: 0.001, axis: 0.001, half_angle: 0.001, ..ObjectSigma::default() };
        let of = |kind: ObjectKind| {
            let object = Object { kind: kind.code(), radius: 0.2, length: 0.1, sigma, ..Object::default() };
            with_systematic_errors(object, 0.005).sigma
        };
        let error = (SYSTEMATIC * 0.2).hypot(SYSTEMATIC_PX * 0.005);
        let angle = 0.001_f64.hypot(SQRT_2 * error / 0.1);
        for (kind, axis, half_angle) in
            [(ObjectKind::Sphere, 0.001, 0.001), (ObjectKind::Cylinder, angle, 0.001), (ObjectKind::Cone, angle, angle)]
        {
            let told = of(kind);
            assert!((told.radius - error.hypot(0.001)).abs() < 1e-12, "{kind:?}");
            assert!((told.center[2][2] - error * error).abs() < 1e-15 && told.center[0][1] == 0.0, "{kind:?}");
            assert_eq!((told.axis, told.half_angle), (axis, half_angle), "{kind:?}");
        }
    }

    #[test]
    fn a_cone_is_told_by_its_ends_its_middle_and_its_apex() {
        let surface = Conical { point: Vector3::new(0.0, 0.0, 1.5), axis: Vector3::y(), radius: 0.1, slope: 0.5 };
        let told = |extent| cone(Object::default(), &surface, 0.4, ObjectSigma::default(), &measured(extent));
        let whole = told([-0.3, 0.1]);
        assert!((whole.base_radius - 0.15).abs() < 1e-12 && whole.top_radius == 0.0, "{whole:?}");
        assert!((whole.radius - 0.05).abs() < 1e-12 && (whole.length - 0.4).abs() < 1e-12, "{whole:?}");
        assert_eq!((whole.shape(), whole.half_angle, whole.axis), (ObjectKind::Cone, 0.4, [0.0, 1.0, 0.0]));
        assert!((Vector3::from(whole.apex) - Vector3::new(0.0, -0.2, 1.5)).norm() < 1e-12);
        assert!((told([-0.1, 0.1]).top_radius - 0.05).abs() < 1e-12);
    }

    /// The rows of a cone at a distance of two metres. They cover its middle 0.6 m.
    fn rows_of_a_cone() -> (Arcs, Vec<usize>) {
        let center = Vector3::new(0.0, 0.0, 2.0);
        let arcs = arcs_of(&[frustum(center, Vector3::y(), 0.2, 0.2, 0.7)]);
        let is_of_it = |&index: &usize| arcs.arcs[index].scan == Scan::Row && arcs.arcs[index].mean.y.abs() < 0.3;
        let members = (0..arcs.arcs.len()).filter(is_of_it).collect();
        (arcs, members)
    }

    fn fitted<'a>(arcs: &'a Arcs, members: &'a [usize], kind: ObjectKind) -> Region<'a> {
        let model = model::fit(kind, &arcs.of(members), None, f64::INFINITY).unwrap();
        Region { arcs, model, members }
    }

    /// The fit weights points as if their noise acted across the surface; noise along the ray moves a leaning surface less.
    #[test]
    fn the_covariance_is_less_than_that_of_the_fit_by_the_slope_of_the_surface_and_grows_with_lines_that_share_noise() {
        let (mut arcs, members) = rows_of_a_cone();
        let middle = members.len() / 2;
        let mut ratio = |members: &[usize], shared_lines: f64| {
            arcs.arcs.iter_mut().for_each(|arc| arc.shared_lines = shared_lines);
            let region = fitted(&arcs, members, ObjectKind::Cone);
            let Model::Cone(fit) = &region.model else { unreachable!() };
            covariance(&region, fit)[(4, 4)] / fit.inverse[(4, 4)]
        };
        let (many, few) = (ratio(&members, 1.0), ratio(&members[middle - 7..middle + 7], 1.0));
        assert!((0.25..0.35).contains(&many) && (0.25..0.35).contains(&few), "{many} of all arcs, {few} of 14");
        assert!((ratio(&members, 4.0) / many - 4.0).abs() < 1e-9);
    }

    /// Compares the radius in the middle and the half-angle of a cone with their derivatives.
    #[test]
    fn the_sigmas_of_a_cone_are_those_in_its_middle() {
        let (arcs, members) = rows_of_a_cone();
        let region = fitted(&arcs, &members, ObjectKind::Cone);
        let Model::Cone(fit) = &region.model else { unreachable!() };
        let (told, z) = (report(&region, &measured([-0.1, 0.5])), 0.2);
        let (covariance, slope) = (covariance(&region, fit), fit.surface.slope);
        let by = SMatrix::<f64, 1, 6>::from_row_slice(&[0.0, 0.0, 0.0, 0.0, 1.0, z]);
        let radius = (by * covariance * by.transpose())[0].sqrt();
        let error = (SYSTEMATIC * told.radius).hypot(SYSTEMATIC_PX * region.ends()[0].pitch);
        assert!((told.sigma.radius - radius.hypot(error)).abs() < 1e-12, "{} {radius}", told.sigma.radius);
        let steeper = slope + covariance[(5, 5)].sqrt() * 1e-3;
        let half_angle = 1e3 * (steeper.atan() - slope.atan());
        assert!((told.sigma.half_angle / half_angle.hypot(SQRT_2 * error / 0.6) - 1.0).abs() < 1e-4);
        assert!((told.radius - (fit.surface.radius + z * slope)).abs() < 1e-12);
        assert!((told.rms - 0.001).abs() < 1e-12, "half the noise of 2 mm");
        assert_eq!((told.points, told.rows, told.arc), (1000, 50, 2.0));
    }

    #[test]
    fn the_length_of_a_cylinder_is_that_of_its_extent() {
        let (arcs, members) = rows_of_a_cone();
        let told = report(&fitted(&arcs, &members, ObjectKind::Cylinder), &measured([-0.1, 0.5]));
        assert!((told.length - 0.6).abs() < 1e-12 && told.shape() == ObjectKind::Cylinder);
    }

    /// An arc of 20 points at a distance of one metre, of which `correlation_px` share their noise.
    fn arc(correlation_px: f64) -> Arc {
        let camera = Camera { width: 640, height: 480, fx: 500.0, fy: 500.0, cx: 319.5, cy: 239.5 };
        let mut ellipse = Ellipse {
            line: 240,
            first: 310,
            last: 329,
            points: 20,
            correlation_px,
            origin: [0.0, 1.0],
            ..Ellipse::default()
        };
        ellipse.moments[0] = 20.0;
        let mut arcs = Arcs::default();
        arcs.read(&Header { camera, ..Header::default() }, &[ellipse]);
        arcs.arcs[0].clone()
    }

    #[test]
    fn what_windows_flatten_is_an_error_of_the_size_and_of_the_axis() {
        let sigma = ObjectSigma { radius: 0.0003, axis: 0.01, ..ObjectSigma::default() };
        let can = Object { kind: ObjectKind::Cylinder.code(), radius: 0.04, length: 0.1, sigma, ..Object::default() };
        let told = |correlation_px: f64| {
            let mut object = can;
            add_flattening(&mut object, &arc(correlation_px));
            object.sigma
        };
        assert_eq!(told(1.0), sigma, "each pixel has noise of its own");
        // 10 further pixels of 2 mm share the noise, 0.06 of each counts: 1.2 mm.
        let flattened = told(11.0);
        assert!((flattened.radius - 0.0012_f64.hypot(0.0003)).abs() < 1e-6, "{flattened:?}");
        assert!((flattened.center[1][1].sqrt() - 0.0012).abs() < 1e-6 && flattened.center[0][1] == 0.0);
        assert!((flattened.axis - 0.01_f64.hypot(0.01697)).abs() < 1e-4, "{flattened:?}");
    }

    /// Along its rays a ball has the same noise and the same slopes wherever it is. By symmetry its radius does not depend on how
    /// far it lies to one side.
    #[test]
    fn noise_tells_as_much_of_a_ball_below_the_view_as_of_one_straight_ahead() {
        let radius = |below: f64| {
            // The image of this camera begins far below its optical axis.
            let camera = Camera { cy: KINECT_HALF.cy - below * KINECT_HALF.fy, ..KINECT_HALF };
            let center = Vector3::new(0.0, below, 1.0).normalize() * 1.5;
            let mut arcs = arcs_by(camera, NoiseModel::KINECT_V1, &[sphere(center, 0.2)]);
            arcs.arcs.iter_mut().for_each(|arc| arc.shared_lines = 1.0);
            let rows = rows_of(&arcs, |_| true);
            let region = fitted(&arcs, &rows, ObjectKind::Sphere);
            let Model::Sphere(fit) = &region.model else { unreachable!() };
            let of = covariance(&region, fit);
            let together = of[(0, 3)] / (of[(0, 0)] * of[(3, 3)]).sqrt();
            assert!(together.abs() < 0.05, "{together}");
            of[(3, 3)] / fit.inverse[(3, 3)]
        };
        let [ahead, below] = [0.0, 1.0].map(radius);
        assert!((below / ahead - 1.0).abs() < 0.1, "{below} {ahead}");
    }
}
