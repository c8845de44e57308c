//! How much of the noise model's variance there is in an image, at most all of it.
//!
//! To correct moments for noise that is not there would be as wrong as not to correct them. The errors of lines and
//! circles are free of noise if the model is right, and below zero by its excess if it is not.

use super::LineSearch;
use super::line::RayLine;
use super::rays::Rays;
use super::run::Run;
use super::segments::{Segment, next_segment};
use super::view::View;

/// About how many lines are looked at; the median is over some errors of each.
const LINES: u32 = 12;
/// Fewest points of a curve that tells how noisy the sensor is.
const TELLING: usize = 12;

/// The part of the noise model's variance that there is in an image, seen by a view that takes the model as it is.
pub(super) fn noise_level(
    view: &View,
    image: &[u16],
    line: &mut RayLine,
    search: &mut LineSearch,
    errors: &mut Vec<f64>,
) -> f64 {
    errors.clear();
    for number in (0..view.lines).step_by((view.lines / LINES).max(1) as usize) {
        line.read(view, image, number, 0..view.length);
        for index in 0..line.runs() {
            if line.run_length(index) >= TELLING {
                let rays = Rays::new(view, line, index, &mut search.rays);
                add_errors(&Run::new(rays, &mut search.sums), errors);
            }
        }
    }
    let middle = errors.len() / 2;
    let median = if errors.is_empty() { 0.0 } else { *errors.select_nth_unstable_by(middle, f64::total_cmp).1 };
    (1.0 + median).clamp(0.0, 1.0)
}

/// Adds the errors of the lines and circles of a run, in variances of the sensor.
fn add_errors(run: &Run, errors: &mut Vec<f64>) {
    let (whole, mut from) = (0..run.length, 0);
    while let Some(Segment { to, .. }) = next_segment(run, &whole, from) {
        if to - from >= TELLING {
            let fit = run.moments(from, to).fit();
            errors.push(fit.line_square.min(fit.circle_square) / run.variance(from, to));
        }
        from = to;
    }
}
