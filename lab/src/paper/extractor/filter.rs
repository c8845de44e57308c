//! The pre-filter: accepts arcs as ellipses, or rejects them with a reason.

use super::growth::{self, Arc};
use super::parameters::ConicConfig;
use super::rejection::ArcRejection;
use crate::scan_line::{ScanLine, span};
use conicflow_geometry::{self as geometry, line_rms};
use conicflow_messages::{Ellipse, NoiseModel};

/// Returns the ellipse of an arc, or the reason to reject it.
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
    let (first, last) = arc.points.first().zip(arc.points.last()).ok_or(ArcRejection::FewPoints)?;
    let angle = span(&ellipse, [first.st, last.st]);
    if angle < config.conic.min_arc_deg.to_radians() {
        return Err(ArcRejection::ShortArc);
    }
    Ok(line.message(&ellipse, [first.pixel, last.pixel], &arc.moments, rms, angle))
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
