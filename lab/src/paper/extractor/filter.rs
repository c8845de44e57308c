//! The pre-filter: which arcs go on as ellipses, and why the others do not.

use super::growth::{self, Arc};
use super::parameters::ConicConfig;
use super::scan_line::{Point, ScanLine};
use conicflow_detection::extract::ArcRejection;
use conicflow_geometry::{self as geometry, Scan, line_rms};
use conicflow_messages::{Ellipse, NoiseModel};

/// The ellipse of an arc, or why it is none.
pub(super) fn accept(
    arc: &Arc,
    line: &ScanLine,
    noise: &NoiseModel,
    config: &ConicConfig,
) -> Result<Ellipse, ArcRejection> {
    if arc.points.len() < config.conic.min_points as usize {
        return Err(ArcRejection::FewPoints);
    }
    let limit = growth::max_error(&arc.moments, &line.plane, noise, config);
    if line_rms(&arc.moments).is_none_or(|rms| rms <= limit) {
        return Err(ArcRejection::Line);
    }
    let (conic, rms) = growth::fit(&arc.moments).ok_or(ArcRejection::NoEllipse)?;
    let ellipse = conic.to_ellipse().filter(|_| rms <= limit).ok_or(ArcRejection::NoEllipse)?;
    check_shape(&ellipse, arc, config)?;
    let angle = span(&ellipse, arc.points);
    if angle < config.conic.min_arc_deg.to_radians() {
        return Err(ArcRejection::ShortArc);
    }
    Ok(message(&ellipse, arc, line, rms, angle))
}

fn check_shape(ellipse: &geometry::Ellipse, arc: &Arc, config: &ConicConfig) -> Result<(), ArcRejection> {
    let [long, short] = ellipse.semi_axes;
    if arc.moments.mean().is_none_or(|[_, t]| ellipse.center[1] <= t) {
        Err(ArcRejection::Concave)
    } else if short < config.common.min_radius_m || long > config.common.max_radius_m {
        Err(ArcRejection::Radius)
    } else if short < config.conic.min_radius_ratio * long {
        Err(ArcRejection::Elongated)
    } else {
        Ok(())
    }
}

/// The angle between the first and the last point as seen from the centre, over the side that faces the camera.
fn span(ellipse: &geometry::Ellipse, points: &[Point]) -> f64 {
    let from_front = |point: &Point| (point.st[0] - ellipse.center[0]).atan2(ellipse.center[1] - point.st[1]);
    match (points.first(), points.last()) {
        (Some(first), Some(last)) => (from_front(last) - from_front(first)).abs(),
        _ => 0.0,
    }
}

fn message(ellipse: &geometry::Ellipse, arc: &Arc, line: &ScanLine, rms: f64, span: f64) -> Ellipse {
    let pixel = |point: Option<&Point>| point.map_or(0, |point| point.pixel);
    Ellipse {
        scan: if line.scan == Scan::Row { 0 } else { 1 },
        line: line.number,
        first: pixel(arc.points.first()),
        last: pixel(arc.points.last()),
        points: arc.points.len() as u32,
        center: line.plane.to_camera(ellipse.center).into(),
        plane_center: ellipse.center,
        semi_axes: ellipse.semi_axes,
        angle: ellipse.angle,
        half_width: ellipse.half_extents[0],
        half_depth: ellipse.half_extents[1],
        rms,
        arc: span,
        origin: arc.moments.origin(),
        moments: *arc.moments.sums(),
        ..Ellipse::default()
    }
}
