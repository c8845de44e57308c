//! Log messages about a source's frames, each logged once.

use conicflow_messages::{Camera, is_measured, median_depth};
use std::ops::Range;

/// Plausible range of a median depth in metres; a value outside of it suggests a wrong `depth_scale`.
const PLAUSIBLE_DEPTH_M: Range<f64> = 0.1..20.0;
/// Counter of measurements that are left out of a frame because they exceed the range of a 16-bit pixel.
pub const TOO_FAR: &str = "points too far";

/// Logs properties of the frames by the pixels of one of them, so that a wrong scale is noticed. Returns whether any pixel is
/// measured.
pub fn report_frame(what: &str, name: &str, camera: &Camera, depth_scale: f64, pixels: &[u16]) -> bool {
    let median_m = median_depth(pixels).map(|median| f64::from(median) * depth_scale);
    median_m.inspect(|median_m| report_median(what, name, camera, *median_m)).is_some()
}

/// Logs properties of the frames: their camera, and the median depth of one of them, so that a wrong scale is noticed.
pub fn report_median(what: &str, name: &str, camera: &Camera, median_m: f64) {
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

/// Reports why frames have no measurement, each reason once.
#[derive(Clone, Copy, Debug, Default)]
pub struct EmptyFrames {
    told_unmeasured: bool,
    told_too_far: bool,
}

impl EmptyFrames {
    /// One that reports nothing.
    pub fn silent() -> Self {
        Self { told_unmeasured: true, told_too_far: true }
    }

    /// Checks the pixels of a frame and the number of its measurements that were left out as too far. Returns the message to log,
    /// if any.
    pub fn look(&mut self, name: &str, pixels: &[u16], too_far: u64) -> Option<String> {
        let is_reported = if too_far > 0 { &mut self.told_too_far } else { &mut self.told_unmeasured };
        if *is_reported || pixels.iter().any(|&pixel| is_measured(pixel)) {
            return None;
        }
        *is_reported = true;
        let why = match too_far {
            0 => "no pixel is measured, all are 0, 65535 or not a number\n  hint: nothing can be found there; was the camera \
                  covered, or too near?"
                .to_owned(),
            _ => format!(
                "all {too_far} points are too far away and left out\n  hint: if they are in millimetres, write `depth_scale = \
                 0.001`, to `conicflow detect` `--scale 0.001`"
            ),
        };
        tracing::warn!("`{name}`: {why}");
        Some(why)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_frames_without_a_measurement_each_reason_is_told_once() {
        let mut empty = EmptyFrames::default();
        assert_eq!(empty.look("a", &[0, 1200, 65535], 1), None);
        assert!(empty.look("b", &[0, 0, 65535], 0).unwrap().starts_with("no pixel is measured"));
        assert!(empty.look("c", &[0, 65535], 2).unwrap().starts_with("all 2 points are too far away"));
        assert_eq!([0, 2].map(|too_far| empty.look("d", &[0], too_far)), [None, None]);
        assert_eq!([0, 2].map(|too_far| EmptyFrames::silent().look("e", &[0], too_far)), [None, None]);
    }
}
