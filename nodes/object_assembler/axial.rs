//! Cylinders and cones: a line through the centres, and the radius over the position along it.
//!
//! The extents of a section depend on how the axis is tilted to its plane, and the centres of a cone's sections lie
//! beside its axis; both are known exactly (`conicflow_geometry::SectionShape`), so the fit starts from the line through
//! the centres and is repeated with the axis and half-angle that it gave.

use super::sections::Section;
use super::verify::{Body, Candidate, Rejection, Solid};
use conicflow_geometry::{Cone, Cylinder, Fit, Line, LineMoments, Regression, Vector3, cone_half_angle, cone_lean};

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
    let mut axis = center_line(candidate, |section| Some(section.center))?.direction;
    let mut half_angle = 0.0;
    let mut skeleton = skeleton(candidate, &axis, half_angle)?;
    for _ in 1..PASSES {
        (axis, half_angle) = lean(candidate, &skeleton, &axis)?;
        skeleton = self::skeleton(candidate, &axis, half_angle)?;
    }
    let Skeleton { line, profile } = skeleton;
    if line.rms > candidate.config.max_center_scatter * profile.value {
        return Err(Rejection::NotCollinear);
    }
    if profile.rms > candidate.config.max_radius_scatter * profile.value {
        return Err(Rejection::Profile);
    }
    if half_angle > 0.0 { cone(candidate, &line, axis, &profile) } else { Ok(cylinder(candidate, &line, &profile)) }
}

fn skeleton(candidate: &Candidate, axis: &Vector3, half_angle: f64) -> Result<Skeleton, Rejection> {
    let line = center_line(candidate, |section| section.cut(axis, half_angle).map(|(center, _)| center))?;
    let mut pairs = Regression::default();
    for section in candidate.sections() {
        let (center, radius) = section.cut(axis, half_angle).ok_or(Rejection::Tilted)?;
        pairs.add((center - line.point).dot(axis), radius);
    }
    let profile = pairs.fit().ok_or(Rejection::Degenerate)?;
    Ok(Skeleton { line, profile })
}

fn center_line(candidate: &Candidate, center: impl Fn(&Section) -> Option<Vector3>) -> Result<Line, Rejection> {
    let mut sums = LineMoments::new(candidate.middle().center);
    for section in candidate.sections() {
        sums.add(&center(section).ok_or(Rejection::Tilted)?);
    }
    let line = sums.fit().ok_or(Rejection::Degenerate)?;
    let sign = line.direction.dot(&candidate.middle().plane.normal()).signum();
    Ok(Line { direction: line.direction * sign, ..line })
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
