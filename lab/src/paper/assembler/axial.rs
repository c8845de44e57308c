//! Cylinders and cones: a line through the centres, and the radius over the position along it.
//!
//! The extents of a section depend on the tilt of the axis to its plane, and the centres of a cone's sections lie beside its
//! axis; both are known exactly (`conicflow_geometry::SectionShape`). So the fit starts with the line through the centres, and is
//! repeated with the resulting axis and half-angle. It is then the line through the points where the axis pierces the planes, and
//! the radius is exactly linear in the position.

use super::rejection::Rejection;
use super::verify::{Body, Candidate, Solid};
use conicflow_geometry::{Conical, Line, PencilMoments, Regression, Vector3};
use conicflow_messages::ObjectKind;

/// Number of passes; each reduces the error of axis and half-angle by far more than a factor of ten.
const PASSES: usize = 6;
/// Largest half-angle of a pass in radians, unless the limit plus a tenth is larger: the first pass may overshoot while the axis
/// is far off.
const BLUNTEST: f64 = 0.6;

/// The current axis and half-angle; half-angle 0 for a cylinder.
#[derive(Clone, Copy, Debug)]
struct Pose {
    axis: Vector3,
    half_angle: f64,
}

/// The centres and radii of a candidate for one pose.
#[derive(Clone, Copy, Debug)]
struct Skeleton {
    /// The line through the centres, in the direction of growing line numbers.
    line: Line,
    /// The radii of the sections over their position along the axis.
    profile: Regression,
}

/// Fits a cylinder, which has the same radius all along the axis.
pub(super) fn fit_cylinder(candidate: &Candidate) -> Result<Body, Rejection> {
    let (pose, skeleton) = fit(candidate, |_, skeleton| Ok(Pose { axis: skeleton.line.direction, half_angle: 0.0 }))?;
    let scatter = skeleton.profile.deviation();
    check_scatter(candidate, &skeleton, scatter)?;
    Ok(cylinder(candidate, &skeleton, &pose))
}

/// Fits a cone, if the profile has a slope.
pub(super) fn fit_cone(candidate: &Candidate) -> Result<Body, Rejection> {
    let [least, most] =
        [candidate.config.profile.min_half_angle_deg, candidate.config.common.max_half_angle_deg].map(f64::to_radians);
    let bluntest = BLUNTEST.max(1.1 * most);
    let (pose, skeleton) = fit(candidate, |pose, skeleton| lean(skeleton, pose, bluntest))?;
    if pose.half_angle < least {
        return Err(Rejection::Constant);
    }
    if pose.half_angle > most {
        return Err(Rejection::HalfAngle);
    }
    let line = skeleton.profile.fit().ok_or(Rejection::Degenerate)?;
    check_scatter(candidate, &skeleton, line.rms)?;
    cone(candidate, &skeleton, &pose)
}

/// Fits axis and profile, from the line through the raw centres; `turn` gives axis and half-angle of the next pass.
fn fit(
    candidate: &Candidate,
    turn: impl Fn(&Pose, &Skeleton) -> Result<Pose, Rejection>,
) -> Result<(Pose, Skeleton), Rejection> {
    let line = raw_line(candidate)?;
    let mut pose = Pose { axis: line.direction, half_angle: 0.0 };
    let mut skeleton = Skeleton { line, profile: profile(candidate, &line, &pose)? };
    for _ in 0..PASSES {
        skeleton.line = axis_line(candidate, &skeleton, &pose)?;
        pose = turn(&pose, &skeleton)?;
        skeleton.profile = profile(candidate, &skeleton.line, &pose)?;
    }
    Ok((pose, skeleton))
}

fn check_scatter(candidate: &Candidate, skeleton: &Skeleton, radius_scatter: f64) -> Result<(), Rejection> {
    let radius = skeleton.profile.mean();
    if skeleton.line.rms > candidate.config.profile.max_center_scatter * radius {
        Err(Rejection::NotCollinear)
    } else if radius_scatter > candidate.config.profile.max_radius_scatter * radius {
        Err(Rejection::Profile)
    } else {
        Ok(())
    }
}

/// Returns radii over positions; the position of a section is where its plane meets the current line.
fn profile(candidate: &Candidate, line: &Line, pose: &Pose) -> Result<Regression, Rejection> {
    let mut pairs = Regression::default();
    for section in candidate.sections() {
        let cut = section.cut(&pose.axis, pose.half_angle).ok_or(Rejection::Tilted)?;
        pairs.add(section.position(line, &pose.axis), cut.radius);
    }
    Ok(pairs)
}

/// Returns the line through the centres as the extractor found them.
fn raw_line(candidate: &Candidate) -> Result<Line, Rejection> {
    let mut sums = PencilMoments::new(candidate.middle().plane.scan());
    candidate.sections().for_each(|section| sums.add(&section.plane, section.plane_center));
    sums.fit().ok_or(Rejection::Degenerate)
}

/// Returns the axis, as the line through the piercing points. Each is placed behind the front of its arc by the radius of the
/// profile: an arc determines its front far better than its radius, whose error would move the centre by the same amount.
fn axis_line(candidate: &Candidate, so_far: &Skeleton, pose: &Pose) -> Result<Line, Rejection> {
    let profile = so_far.profile.fit().ok_or(Rejection::Degenerate)?;
    let mut sums = PencilMoments::new(candidate.middle().plane.scan());
    for section in candidate.sections() {
        let cut = section.cut(&pose.axis, pose.half_angle).ok_or(Rejection::Tilted)?;
        let position = section.position(&so_far.line, &pose.axis);
        let radius = if pose.half_angle > 0.0 { profile.at(position) } else { profile.value };
        sums.add(&section.plane, cut.pierced(radius));
    }
    sums.fit().ok_or(Rejection::Degenerate)
}

/// Returns axis and half-angle according to the slope of the profile; the axis of a cone points away from its apex.
fn lean(skeleton: &Skeleton, pose: &Pose, bluntest: f64) -> Result<Pose, Rejection> {
    let slope = skeleton.profile.fit().ok_or(Rejection::Degenerate)?.slope;
    let half_angle = slope.abs().atan().min(bluntest);
    // Positions count along the pose's axis, but the line points towards growing line numbers.
    let outwards = pose.axis * slope.signum();
    let direction = skeleton.line.direction;
    Ok(Pose { axis: direction * direction.dot(&outwards).signum(), half_angle })
}

fn cylinder(candidate: &Candidate, skeleton: &Skeleton, pose: &Pose) -> Body {
    let Skeleton { line, profile } = skeleton;
    let (from, to) = candidate.extent(&line.point, &pose.axis);
    let point = line.point + pose.axis * (0.5 * (from + to));
    let surface = Conical { point, axis: pose.axis, radius: profile.mean(), slope: 0.0 };
    Body {
        solid: Solid { shape: ObjectKind::Cylinder, surface },
        length: to - from,
        radius_sigma: profile.deviation() / profile.count().sqrt(),
        half_angle_sigma: 0.0,
        axis_sigma: line.direction_sigma(),
        across_sigma: line.rms / line.count.sqrt(),
    }
}

fn cone(candidate: &Candidate, skeleton: &Skeleton, pose: &Pose) -> Result<Body, Rejection> {
    let Skeleton { line, profile } = skeleton;
    let Pose { axis, half_angle } = *pose;
    let profile = profile.fit().ok_or(Rejection::Degenerate)?;
    let apex = line.point + axis * (profile.middle - profile.value / profile.slope);
    let (from, to) = candidate.extent(&apex, &axis);
    if from < 0.0 {
        return Err(Rejection::BeyondApex);
    }
    let (middle, slope) = (0.5 * (from + to), half_angle.tan());
    let surface = Conical { point: apex + axis * middle, axis, radius: slope * middle, slope };
    Ok(Body {
        solid: Solid { shape: ObjectKind::Cone, surface },
        length: to - from,
        radius_sigma: profile.value_sigma,
        half_angle_sigma: profile.slope_sigma * half_angle.cos().powi(2),
        axis_sigma: line.direction_sigma(),
        across_sigma: line.rms / line.count.sqrt(),
    })
}
