//! What a source says once of its frames.

use conicflow_messages::{Camera, median_depth};
use std::ops::Range;

/// Median depths outside of this, in metres, speak for a wrong `depth_scale`.
const PLAUSIBLE_DEPTH_M: Range<f64> = 0.1..20.0;

/// Says what frames are like by the pixels of one of them, so that a wrong scale is seen; whether any of these is measured.
pub fn tell_frame(what: &str, name: &str, camera: &Camera, depth_scale: f64, pixels: &[u16]) -> bool {
    let median_m = median_depth(pixels).map(|median| f64::from(median) * depth_scale);
    median_m.inspect(|median_m| tell_median(what, name, camera, *median_m)).is_some()
}

/// Says what frames are like, by their camera and the median depth of one of them, so that a wrong scale is seen.
pub fn tell_median(what: &str, name: &str, camera: &Camera, median_m: f64) {
    tracing::info!(
        "{what} of {}x{}, fx {:.2} fy {:.2} cx {:.2} cy {:.2}; `{name}` has a median depth of {median_m:.3} m",
        camera.width,
        camera.height,
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy
    );
    if !PLAUSIBLE_DEPTH_M.contains(&median_m) {
        tracing::warn!(
            "a median depth of {median_m:.3} m is not plausible\n  hint: `depth_scale` is in metres per unit: 0.001 \
             for millimetres, 0.0002 for TUM"
        );
    }
}
