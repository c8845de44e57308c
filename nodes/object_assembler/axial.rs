//! Cylinders and cones: a line through the centres, and the radius over the position along it.
//!
//! The extents of a section depend on how the axis is tilted to its plane, and the centres of a cone's sections lie
//! beside its axis; both are known exactly (`conicflow_geometry::SectionShape`), so the fit starts from the line through
//! the centres and is repeated with the axis and half-angle that it gave.

use super::sections::Section;
use super::verify::{Body, Candidate, Rejection, Solid};
use conicflow_geometry::{Cone, Cylinder, Fit, Line, PencilMoments, Regression, Vector3, cone_half_angle, cone_lean};

/// Repetitions of the fit; each takes the error of axis and half-angle down by far more than a factor of ten.
const PASSES: usize = 4;

/// The centres and radii of a candidate, seen with one axis and half-angle.
#[derive(Clone, Copy, Debug)]
struct Skeleton {
    /// The line through the centres, towards growing line numbers.
    line: Line,
    /// The semi-minor axes of the sections over their position along the axis.
    profile: Fit,
}

/// Fits a cylinder or a cone, whichever the slope of the profile asks for.
pub(super) fn fit(candidate: &Candidate) -> Result<Body, Rejection> {
    let mut line = raw_line(candidate)?;
    let (mut axis, mut half_angle) = (line.direction, 0.0);
    let mut profile = profile(candidate, &line, &axis, half_angle)?;
    for _ in 0..PASSES {
        line = center_line(candidate, &Skeleton { line, profile }, &axis, half_angle)?;
        (axis, half_angle) = lean(candidate, &Skeleton { line, profile }, &axis)?;
        profile = self::profile(candidate, &line, &axis, half_angle)?;
    }
    if line.rms > candidate.config.max_center_scatter * profile.value {
        return Err(Rejection::NotCollinear);
    }
    if profile.rms > candidate.config.max_radius_scatter * profile.value {
        return Err(Rejection::Profile);
    }
    if half_angle > 0.0 { cone(candidate, &line, axis, &profile) } else { Ok(cylinder(candidate, &line, &profile)) }
}

/// Radii over positions; a section stands where its plane meets the line so far.
fn profile(candidate: &Candidate, line: &Line, axis: &Vector3, half_angle: f64) -> Result<Fit, Rejection> {
    let mut pairs = Regression::default();
    for section in candidate.sections() {
        let cut = section.cut(axis, half_angle).ok_or(Rejection::Tilted)?;
        pairs.add(section.position(line, axis), cut.radius);
    }
    pairs.fit().ok_or(Rejection::Degenerate)
}

/// The line through the centres as found.
fn raw_line(candidate: &Candidate) -> Result<Line, Rejection> {
    let mut sums = PencilMoments::new(candidate.middle().scan);
    candidate.sections().for_each(|section| sums.add(&section.plane, section.plane_center));
    sums.fit().ok_or(Rejection::Degenerate)
}

/// The line through the centres, each put behind the front of its arc by the radius that the profile gives it: an arc
/// tells its front far better than its radius, and an error of the radius would move the centre as much.
fn center_line(candidate: &Candidate, so_far: &Skeleton, axis: &Vector3, half_angle: f64) -> Result<Line, Rejection> {
    let mut sums = PencilMoments::new(candidate.middle().scan);
    for section in candidate.sections() {
        let cut = section.cut(axis, half_angle).ok_or(Rejection::Tilted)?;
        let position = section.position(&so_far.line, axis);
        let radius = if half_angle > 0.0 { so_far.profile.at(position) } else { so_far.profile.value };
        sums.add(&section.plane, cut.behind_front(radius));
    }
    sums.fit().ok_or(Rejection::Degenerate)
}

/// Axis and half-angle that the slope of the profile asks for; half-angle 0 for a cylinder.
fn lean(candidate: &Candidate, skeleton: &Skeleton, axis: &Vector3) -> Result<(Vector3, f64), Rejection> {
    let Skeleton { line, profile } = skeleton;
    let normal = candidate.middle().plane.normal();
    let cosine = axis.dot(&normal).abs();
    let tilt = (1.0 - cosine * cosine).max(0.0).sqrt() / cosine;
    let half_angle = cone_half_angle(profile.slope, tilt);
    if half_angle < candidate.config.min_half_angle_deg.to_radians() {
        return Ok((line.direction, 0.0));
    }
    if half_angle > candidate.config.max_half_angle_deg.to_radians() {
        return Err(Rejection::HalfAngle);
    }
    // Away from the apex; `axis` points towards growing line numbers or, from the second pass on, away from the apex.
    let outwards = axis * profile.slope.signum();
    let direction = line.direction * line.direction.dot(&outwards).signum();
    let facing = normal * normal.dot(&outwards).signum();
    Ok((cone_lean(&direction, &facing, half_angle), half_angle))
}

fn cylinder(candidate: &Candidate, line: &Line, profile: &Fit) -> Body {
    let axis = line.direction;
    let (from, to) = candidate.extent(&line.point, &axis);
    let center = line.point + axis * (0.5 * (from + to));
    let solid = Solid::Cylinder(Cylinder { point: center, axis, radius: profile.value });
    Body {
        solid,
        center,
        axis,
        length: to - from,
        radius: profile.value,
        slope: 0.0,
        radius_sigma: profile.value_sigma,
        half_angle_sigma: 0.0,
        axis_sigma: line.direction_sigma(),
        across_sigma: line.rms / line.count.sqrt(),
    }
}

fn cone(candidate: &Candidate, line: &Line, axis: Vector3, profile: &Fit) -> Result<Body, Rejection> {
    // All centres lie on a line through the apex, where the radius is zero.
    let apex_position = profile.at - profile.value / profile.slope;
    let apex = line.point + line.direction * (apex_position / line.direction.dot(&axis));
    let normal = candidate.middle().plane.normal();
    let cosine = axis.dot(&normal).abs();
    let tilt = (1.0 - cosine * cosine).max(0.0).sqrt() / cosine;
    let half_angle = cone_half_angle(profile.slope, tilt);
    let (from, to) = candidate.extent(&apex, &axis);
    if from < 0.0 {
        return Err(Rejection::BeyondApex);
    }
    let middle = 0.5 * (from + to);
    let slope = half_angle.tan();
    Ok(Body {
        solid: Solid::Cone(Cone { apex, axis, half_angle }),
        center: apex + axis * middle,
        axis,
        length: to - from,
        radius: slope * middle,
        slope,
        radius_sigma: profile.value_sigma,
        half_angle_sigma: profile.slope_sigma * half_angle.cos().powi(2),
        axis_sigma: line.direction_sigma(),
        across_sigma: line.rms / line.count.sqrt(),
    })
}
