//! Spheres: sections by a pencil of planes, with their centres at the feet of the perpendiculars from the sphere's centre.
//!
//! Let the centre have the distance rho from the pencil's axis and the angle theta_C, and a plane the angle theta_i. Then the
//! section's centre is at `t_i = rho cos(theta_i - theta_C)`, its distance from the sphere's centre is `z_i = rho sin(theta_i -
//! theta_C)`, and its radius is `sqrt(R^2 - z_i^2)`: the paper's circle in (z, r). The angle theta_C is unknown at first: it
//! starts at the middle of the sections, and each pass moves it to the centre of the fitted circle.

use super::parameters::SectionFit;
use super::rejection::Rejection;
use super::sections::Section;
use super::verify::{Body, Candidate, Solid};
use conicflow_geometry::{CircleProfile, Conical, PlaneMoments, Regression, ScanPlane, Vector3, fit_circle_profile};
use conicflow_messages::ObjectKind;

/// Number of passes; the first-order result is exact to a few parts in a thousand.
const PASSES: usize = 4;

/// Fits a sphere.
pub(super) fn fit(candidate: &Candidate) -> Result<Body, Rejection> {
    let mut angle = candidate.middle().plane.angle();
    for _ in 1..PASSES {
        let shift = circle(candidate, angle)?.center / mean_distance(candidate, angle);
        angle += shift.clamp(-1.0, 1.0).asin();
    }
    let profile = circle(candidate, angle)?;
    if profile.rms > candidate.config.profile.max_radius_scatter * profile.radius {
        return Err(Rejection::Profile);
    }
    check_extent(candidate, &profile, angle)?;
    body(candidate, &profile, angle)
}

/// Returns the distance of the sphere's centre from the axis of the pencil, according to one section.
fn distance(section: &Section, angle: f64) -> f64 {
    section.plane_center[1] / (section.plane.angle() - angle).cos()
}

fn mean_distance(candidate: &Candidate, angle: f64) -> f64 {
    candidate.mean(|section| distance(section, angle))
}

/// Fits a circle to radii over positions, counted from the plane at `angle`.
fn circle(candidate: &Candidate, angle: f64) -> Result<CircleProfile, Rejection> {
    let distance = mean_distance(candidate, angle);
    let pairs = candidate.sections().map(|section| {
        let position = distance * (section.plane.angle() - angle).sin();
        [position, section.radius]
    });
    fit_circle_profile(&PlaneMoments::of([0.0, 0.0], pairs)).ok_or(Rejection::Degenerate)
}

/// Rejects caps, which determine too little: the sections have to reach both sides of the centre, and far enough.
fn check_extent(candidate: &Candidate, profile: &CircleProfile, angle: f64) -> Result<(), Rejection> {
    let distance = mean_distance(candidate, angle);
    let positions = candidate.ends().map(|section| distance * (section.plane.angle() - angle).sin());
    let low = positions[0].min(positions[1]);
    let high = positions[0].max(positions[1]);
    let enough = high - low >= candidate.config.profile.min_sphere_height_radii * profile.radius;
    if low < 0.0 && high > 0.0 && enough { Ok(()) } else { Err(Rejection::Cap) }
}

fn body(candidate: &Candidate, profile: &CircleProfile, angle: f64) -> Result<Body, Rejection> {
    let (mut sides, mut distances) = (Regression::default(), Regression::default());
    let mean = mean_distance(candidate, angle);
    for section in candidate.sections() {
        // As for axial bodies, the front of the arc is known better than its radius.
        let position = mean * (section.plane.angle() - angle).sin();
        let shift = if section.fit == SectionFit::Circle { profile.at(position) - section.radius } else { 0.0 };
        let cosine = (section.plane.angle() - angle).cos();
        sides.add(section.plane.angle(), section.plane_center[0]);
        distances.add(section.plane.angle(), (section.plane_center[1] + shift) / cosine);
    }
    let scatter = sides.deviation().hypot(distances.deviation());
    if scatter > candidate.config.profile.max_center_scatter * profile.radius {
        return Err(Rejection::NotConcyclic);
    }
    let plane = ScanPlane::new(candidate.middle().plane.scan(), angle.tan());
    let center = plane.to_camera([sides.mean(), distances.mean()]);
    let surface = Conical { point: center, axis: Vector3::zeros(), radius: profile.radius, slope: 0.0 };
    Ok(Body {
        solid: Solid { shape: ObjectKind::Sphere, surface },
        length: 0.0,
        radius_sigma: profile.radius_sigma,
        half_angle_sigma: 0.0,
        axis_sigma: 0.0,
        across_sigma: scatter.hypot(profile.center_sigma * candidate.count().sqrt()) / candidate.count().sqrt(),
    })
}
