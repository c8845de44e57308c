//! The report on a verified model, with the uncertainty that the noise of the sensor gives it.

use super::arcs::Arc;
use super::contours::{FLATTENED_PX, SYSTEMATIC, SYSTEMATIC_PX};
use super::model::Model;
use super::region::Region;
use super::verify::{self, Measured};
use conicflow_geometry::{Conical, GradientNoise, ScanPlane, Surface, SurfaceFit, Vector3, section_of};
use conicflow_messages::{Object, ObjectKind, ObjectSigma};
use nalgebra::{Matrix3, SMatrix};
use std::f64::consts::SQRT_2;

/// Number of points along an arc at which its noise is evaluated.
const SAMPLES: usize = 5; // [algorithmic]
/// Approximate number of arcs of an object at which its noise is evaluated.
const ARCS: usize = 16; // [algorithmic]
/// Systematic error of radius and centre of a cone, in pixels. Its slope depends on the silhouette, so it is larger.
const SYSTEMATIC_CONE_PX: f64 = 0.06; // [tuned]
/// Systematic error of axis and half-angle, in radians.
const SYSTEMATIC_ANGLE: f64 = 0.001; // [tuned]

/// Lower bound of the cosine between an axis and the normal of the scan planes: it keeps the spacing along the axis finite.
const MOST_OBLIQUE: f64 = 0.2; // [tuned]
/// Standard deviation of the end of an object, in scan lines: noise and rims take some lines.
const END_LINES: f64 = 1.5; // [tuned]

/// Distance along an axis, in metres, between neighbouring planes of lines, which are `spacing` apart across.
pub(super) fn spacing_along(spacing: f64, plane: &ScanPlane, axis: &Vector3) -> f64 {
    spacing / axis.dot(&plane.normal()).abs().max(MOST_OBLIQUE)
}

/// Standard deviation of an end along the axis, in metres, where neighbouring scan lines are `spacing` metres apart across.
pub fn end_sigma(spacing: f64, plane: &ScanPlane, axis: &Vector3) -> f64 {
    END_LINES * spacing_along(spacing, plane, axis)
}

/// What is told of a region that was verified.
pub(super) fn report(region: &Region, measured: &Measured) -> Object {
    let center = verify::middle(region, measured);
    let object = Object {
        kind: region.model.kind().code(),
        points: measured.count,
        rows: measured.lines,
        center: center.into(),
        rms: (measured.misfit.max(0.0) * measured.variance).sqrt(),
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
            let surface = fit.surface.0;
            let covariance = covariance.fixed_view::<5, 5>(0, 0).into_owned();
            let sigma = conical_sigma(&surface, &covariance, measured, end(&surface));
            let length = measured.extent[1] - measured.extent[0];
            Object { radius: surface.radius, axis: surface.axis.into(), length, sigma, ..object }
        }
        Model::Cone(fit) => {
            let covariance = covariance(region, fit);
            let surface = fit.surface.0;
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
    with_faults(object, first.pitch)
}

/// The object with what the faults of sensors add to its standard deviations; `pixel` is the size of one there.
fn with_faults(mut object: Object, pixel: f64) -> Object {
    let is_cone = object.kind == ObjectKind::Cone.code();
    let pixels = if is_cone { SYSTEMATIC_CONE_PX } else { SYSTEMATIC_PX };
    let error = (SYSTEMATIC * object.radius).hypot(pixels * pixel);
    add_to_size(&mut object, error);
    if object.kind != ObjectKind::Sphere.code() {
        object.sigma.axis = object.sigma.axis.hypot(SYSTEMATIC_ANGLE);
    }
    if is_cone {
        object.sigma.half_angle = object.sigma.half_angle.hypot(SYSTEMATIC_ANGLE);
    }
    object
}

/// Adds an error of some metres to the standard deviations of radius and centre.
fn add_to_size(object: &mut Object, error: f64) {
    object.sigma.radius = object.sigma.radius.hypot(error);
    (0..3).for_each(|i| object.sigma.center[i][i] += error * error);
}

/// Adds to the standard deviations of an object what the sensor flattens of it at its silhouettes; `arc` is one of its arcs.
pub(super) fn add_flattening(object: &mut Object, arc: &Arc) {
    let error = FLATTENED_PX * (arc.shared_px - 1.0) * arc.pitch;
    add_to_size(object, error);
    if object.kind != ObjectKind::Sphere.code() {
        // Both ends may be off, each by as much.
        object.sigma.axis = object.sigma.axis.hypot(SQRT_2 * error / object.length);
    }
}

fn cone(object: Object, surface: &Conical, half_angle: f64, sigma: ObjectSigma, measured: &Measured) -> Object {
    let [from, to] = measured.extent;
    // At the apex rounding may make it a little less than nothing.
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

/// Parameters: two tilts, two shifts across, the radius.
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

/// Covariance of a fit's parameters, from points along its arcs.
fn covariance<S: Surface<N>, const N: usize>(region: &Region, fit: &SurfaceFit<S, N>) -> SMatrix<f64, N, N> {
    let q = region.model.coefficients();
    let stride = region.members.len().div_ceil(ARCS);
    let mut noise = GradientNoise::new(&fit.surface);
    for arc in region.arcs().step_by(stride) {
        let weight = 1.0 / (arc.variance * region.model.excess(arc).unwrap_or(1.0).powi(2));
        let along_z = arc.variance / arc.plane.stretch().powi(2);
        let section = section_of(&q, &arc.plane);
        let share = stride as f64 * region.shared_lines() * arc.points / SAMPLES as f64;
        for sample in 0..SAMPLES {
            let part = (sample as f64 + 0.5) / SAMPLES as f64;
            let x = arc.rays[0] + part * (arc.rays[1] - arc.rays[0]);
            if let Some(z) = arc.hit(&section, x) {
                noise.add(&arc.point(x, z), share * weight * weight * along_z);
            }
        }
    }
    noise.covariance(fit, region.shared_lines())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::assemble::arcs::Arcs;
    use conicflow_messages::{Camera, Ellipse, Header};

    /// An arc of 20 points, one metre away, that share their noise among so many.
    fn arc(shared_px: f64) -> Arc {
        let camera = Camera { width: 640, height: 480, fx: 500.0, fy: 500.0, cx: 319.5, cy: 239.5 };
        let mut ellipse = Ellipse {
            line: 240,
            first: 310,
            last: 329,
            points: 20,
            shared_px,
            origin: [0.0, 1.0],
            ..Ellipse::default()
        };
        ellipse.moments[0] = 20.0;
        let mut arcs = Arcs::default();
        arcs.read(&Header { camera, ..Header::default() }, &[ellipse]);
        arcs.arcs[0]
    }

    #[test]
    fn what_windows_flatten_is_an_error_of_the_size_and_of_the_axis() {
        let sigma = ObjectSigma { radius: 0.0003, axis: 0.01, ..ObjectSigma::default() };
        let can = Object { kind: ObjectKind::Cylinder.code(), radius: 0.04, length: 0.1, sigma, ..Object::default() };
        let told = |shared_px: f64| {
            let mut object = can;
            add_flattening(&mut object, &arc(shared_px));
            object.sigma
        };
        assert_eq!(told(1.0), sigma, "each pixel has noise of its own");
        // 11 pixels: 0.6 pixels of 2 mm.
        let flattened = told(11.0);
        assert!((flattened.radius - 0.0012_f64.hypot(0.0003)).abs() < 1e-6, "{flattened:?}");
        assert!((flattened.center[1][1].sqrt() - 0.0012).abs() < 1e-6 && flattened.center[0][1] == 0.0);
        assert!((flattened.axis - 0.01_f64.hypot(0.01697)).abs() < 1e-4, "{flattened:?}");
    }
}
