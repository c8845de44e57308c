//! Algorithm 1 of the paper: a model grows along a run until its error exceeds the threshold.
//!
//! The paper fits after each point. The sums are as they would be then, but we fit only where the answer may change:
//! steps grow with the model by an eighth of its points, and where a step fails, the last point that fits is found by
//! bisection. As long as the error does not fall again once it is too great, the result is the same.

use super::parameters::ConicConfig;
use crate::scan_line::Point;
use conicflow_geometry::{Conic, PlaneMoments, ScanPlane, fit_ellipse, line_rms};
use conicflow_messages::NoiseModel;

/// Fewest points that determine an ellipse with one to spare.
const FIRST_FIT: usize = 6;

/// The points that one line or ellipse explains.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arc<'a> {
    pub points: &'a [Point],
    pub moments: PlaneMoments,
}

/// The longest start of `run` that one line or ellipse explains; at least six points, or all there are.
pub(super) fn grow<'a>(run: &'a [Point], plane: &ScanPlane, noise: &NoiseModel, config: &ConicConfig) -> Arc<'a> {
    let mut length = run.len().min(FIRST_FIT);
    let mut moments = PlaneMoments::of(run[0].st, run[..length].iter().map(|point| point.st));
    let mut fails_at = run.len() + 1;
    while length + 1 < fails_at {
        let step =
            if fails_at > run.len() { (length / 8).clamp(1, run.len() - length) } else { (fails_at - length) / 2 };
        let mut trial = moments;
        run[length..length + step].iter().for_each(|point| trial.add(point.st));
        if is_explained(&trial, plane, noise, config) {
            (length, moments) = (length + step, trial);
        } else {
            fails_at = length + step;
        }
    }
    Arc { points: &run[..length], moments }
}

/// Largest error that the noise of the sensor accounts for at the depth of these points, in metres.
pub(super) fn max_error(moments: &PlaneMoments, plane: &ScanPlane, noise: &NoiseModel, config: &ConicConfig) -> f64 {
    let depth = moments.mean().map_or(0.0, |[_, t]| t / plane.stretch());
    config.conic.max_error_floor_m + config.conic.max_error_sigmas * noise.sigma(depth)
}

/// The ellipse through the points and their distance from it.
pub(super) fn fit(moments: &PlaneMoments) -> Option<(Conic, f64)> {
    let conic = fit_ellipse(moments)?;
    Some((conic, conic.rms(moments)?))
}

fn is_explained(moments: &PlaneMoments, plane: &ScanPlane, noise: &NoiseModel, config: &ConicConfig) -> bool {
    let limit = max_error(moments, plane, noise, config);
    // A line is a flat ellipse that costs little to fit; most of a room ends here.
    line_rms(moments).is_none_or(|rms| rms <= limit) || fit(moments).is_some_and(|(_, rms)| rms <= limit)
}
