//! The message of an ellipse that a baseline has fitted to points of one scan line.

use conicflow_geometry::{self as geometry, PlaneMoments, Scan, ScanPlane};
use conicflow_messages::Ellipse;

/// The ellipse of the points with these moments, the first and the last of which are at these pixels of line `number`.
pub(crate) fn message(
    ellipse: &geometry::Ellipse,
    (plane, number): (&ScanPlane, u32),
    [first, last]: [u32; 2],
    moments: &PlaneMoments,
    rms: f64,
    arc: f64,
) -> Ellipse {
    Ellipse {
        scan: if plane.scan() == Scan::Row { 0 } else { 1 },
        line: number,
        first,
        last,
        points: moments.count() as u32,
        center: plane.to_camera(ellipse.center).into(),
        plane_center: ellipse.center,
        semi_axes: ellipse.semi_axes,
        angle: ellipse.angle,
        half_width: ellipse.half_extents[0],
        half_depth: ellipse.half_extents[1],
        rms,
        arc,
        origin: moments.origin(),
        moments: *moments.sums(),
        ..Ellipse::default()
    }
}

/// The angle between two points of the arc of an ellipse as seen from its centre, over the side that faces the camera.
pub(crate) fn span(ellipse: &geometry::Ellipse, [first, last]: [[f64; 2]; 2]) -> f64 {
    let from_front = |[s, t]: [f64; 2]| (s - ellipse.center[0]).atan2(ellipse.center[1] - t);
    (from_front(last) - from_front(first)).abs()
}
