//! Splits the points of one scan line into runs without holes and depth jumps.

use super::parameters::ConicConfig;
use crate::scan_line::{Point, ScanLine};
use conicflow_detection::camera::pinhole;
use conicflow_messages::Header;

/// Returns the points between holes or jumps, run by run.
pub(super) fn runs<'a>(
    line: &'a ScanLine,
    header: &'a Header,
    config: &'a ConicConfig,
) -> impl Iterator<Item = &'a [Point]> {
    let pitch = pinhole(&header.camera).pixel_pitch(line.plane.scan());
    let trim = config.common.trim_px as usize;
    let runs = line.points.chunk_by(move |a, b| connected(a, b, header, pitch, config));
    runs.filter(move |run| run.len() > 2 * trim).map(move |run| &run[trim..run.len() - trim])
}

/// Whether two neighbouring measurements can lie on one surface.
fn connected(a: &Point, b: &Point, header: &Header, pitch: f64, config: &ConicConfig) -> bool {
    let pixels = b.pixel - a.pixel;
    let near = a.depth.min(b.depth);
    let slope = config.conic.jump_slope * pitch * near * f64::from(pixels);
    let step = (b.depth - a.depth).abs();
    // The noise is only needed if the slope alone does not explain the step.
    let sigma = || header.noise.sigma(near).max(header.depth_scale / 12.0_f64.sqrt());
    let explained = || step <= slope + config.conic.jump_sigmas * sigma();
    pixels <= config.common.max_hole_px + 1 && (step <= slope || explained())
}
