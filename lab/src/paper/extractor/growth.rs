//! Algorithm 1 of the paper: a model grows along a run until its error exceeds the threshold.
//!
//! The paper fits after each point. Here the sums are the same, but a fit is only made where its result may matter: steps grow
//! with the model, by an eighth of its points, and where a step fails, bisection finds the last point that fits. The result is
//! the same as long as an error that has become too large stays too large.

use super::parameters::ConicConfig;
use crate::scan_line::Point;
use conicflow_geometry::{Conic, PlaneMoments, ScanPlane, fit_ellipse, line_rms};
use conicflow_messages::NoiseModel;

/// Least number of points for an ellipse, with one to spare.
const FIRST_FIT: usize = 6;

/// The points of one line or ellipse.
#[derive(Clone, Copy, Debug)]
pub(super) struct Arc<'a> {
    pub points: &'a [Point],
    pub moments: PlaneMoments,
}

/// Returns the longest start of `run` that one line or ellipse explains; at least six points, or all of them.
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

/// Returns the largest error that the sensor's noise explains at the depth of these points, in metres.
pub(super) fn max_error(moments: &PlaneMoments, plane: &ScanPlane, noise: &NoiseModel, config: &ConicConfig) -> f64 {
    let depth = moments.mean().map_or(0.0, |[_, t]| t / plane.stretch());
    config.conic.max_error_floor_m + config.conic.max_error_sigmas * noise.sigma(depth)
}

/// Fits an ellipse to the points, and returns it with their rms distance.
pub(super) fn fit(moments: &PlaneMoments) -> Option<(Conic, f64)> {
    let conic = fit_ellipse(moments)?;
    Some((conic, conic.rms(moments)?))
}

fn is_explained(moments: &PlaneMoments, plane: &ScanPlane, noise: &NoiseModel, config: &ConicConfig) -> bool {
    let limit = max_error(moments, plane, noise, config);
    // A line is a flat ellipse that is cheap to fit; most of a room ends here.
    line_rms(moments).is_none_or(|rms| rms <= limit) || fit(moments).is_some_and(|(_, rms)| rms <= limit)
}
