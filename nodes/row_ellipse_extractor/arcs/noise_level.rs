//! How noisy an image is, as a multiple of the variance of its noise model.
//!
//! All limits and the correction of the moments rest on the noise, and a sensor may well be noisier than its model says, or
//! quieter where a driver smooths. Limits that are too narrow are the worse mistake: from a tenth more noise on, fewer
//! and fewer surfaces would be found.
//!
//! Pixels that lie close together show the noise that they do not have in common, whatever the surface ([`scatter`]); that
//! is all, unless a driver smooths. If there is less of it than the model says, the errors of lines and circles tell the
//! whole ([`share`]): they are free of noise if the model is right, and below zero by its excess.

use super::LineSearch;
use super::line::RayLine;
use super::rays::Rays;
use super::run::Run;
use super::segments::{Segment, next_segment};
use super::view::View;
use conicflow_messages::is_measured;

/// About how many lines are looked at.
const LINES: u32 = 12;
/// Fewest points of a curve that tells how noisy the sensor is.
const TELLING: usize = 12;
/// Pixels from one of three to the next that are compared: farther ones lie on different surfaces too often.
const APART: usize = 3;
/// Fewest threes that tell anything.
const FEWEST: usize = 64;
/// Standard deviations beyond which three pixels do not lie on one smooth surface ...
const WITHIN: f64 = 2.5;
/// ... and the mean square of a normal deviate inside of them.
const SQUARE_WITHIN: f64 = 0.911_26;
/// Growth of the level below which it has settled.
const SETTLED: f64 = 1.01;
/// Scatter in variances of the model above which neighbours have no noise in common.
const UNSMOOTHED: f64 = 0.85;
/// Above this it is no longer noise.
const MOST: f64 = 16.0;

/// Variance of the depths of an image, in variances of the model that a view takes as it is.
pub(super) fn noise_level(
    view: &View,
    image: &[u16],
    line: &mut RayLine,
    search: &mut LineSearch,
    errors: &mut Vec<f64>,
) -> f64 {
    let scatter = scatter(view, image, errors);
    if scatter > UNSMOOTHED { scatter.max(1.0) } else { share(view, image, line, search, errors) }
}

/// The variance that neighbours show, in variances of the model; less than there is, where they have noise in common.
///
/// Along a line of the image a plane's inverse depth is linear, so `b (b / a + b / c - 2)` of three depths in even steps is
/// noise alone, of six times the variance of one. Silhouettes and creases are out of reach: the level grows from that of
/// the model only as far as the mean square of those within reach confirms it.
fn scatter(view: &View, image: &[u16], squares: &mut Vec<f64>) -> f64 {
    squares.clear();
    for line in lines(view) {
        let depths = view.row(image, line).windows(2 * APART + 1).step_by(APART);
        let threes = depths.map(|depths| [depths[0], depths[APART], depths[2 * APART]]);
        squares.extend(threes.filter(|depths| depths.iter().all(|&depth| is_measured(depth))).map(|depths| {
            let [a, b, c] = depths.map(|depth| f64::from(depth) * view.scale);
            let off = b * (b / a + b / c - 2.0);
            off * off / (6.0 * view.variance(b))
        }));
    }
    if squares.len() < FEWEST {
        return 1.0;
    }
    let mut level = 1.0;
    loop {
        let limit = WITHIN * WITHIN * level;
        let add =
            |(sum, count), &square: &f64| if square <= limit { (sum + square, count + 1.0) } else { (sum, count) };
        let (sum, count) = squares.iter().fold((0.0, 0.0_f64), add);
        let last = std::mem::replace(&mut level, sum / (count.max(1.0) * SQUARE_WITHIN));
        if level < last * SETTLED || level > MOST {
            return level.min(MOST);
        }
    }
}

/// The part of the model's variance, at most all, that lines and circles show.
fn share(view: &View, image: &[u16], line: &mut RayLine, search: &mut LineSearch, errors: &mut Vec<f64>) -> f64 {
    errors.clear();
    for number in lines(view) {
        line.read(view, image, number, 0..view.length);
        for index in 0..line.runs() {
            if line.run_length(index) >= TELLING {
                let rays = Rays::new(view, line, index, &mut search.rays);
                add_errors(&Run::new(rays, &mut search.sums), errors);
            }
        }
    }
    (1.0 + median(errors)).clamp(0.0, 1.0)
}

fn lines(view: &View) -> impl Iterator<Item = u32> {
    (0..view.lines).step_by((view.lines / LINES).max(1) as usize)
}

/// The median, whose place the values change; 0 of none.
fn median(values: &mut [f64]) -> f64 {
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f64::total_cmp).1 }
}

/// Adds the errors of the lines and circles of a run, in variances of the sensor.
fn add_errors(run: &Run, errors: &mut Vec<f64>) {
    let mut from = run.inner.start;
    while let Some(Segment { to, .. }) = next_segment(run, &run.inner, from) {
        if to - from >= TELLING {
            let fit = run.moments(from, to).fit();
            errors.push(fit.line_square.min(fit.circle_square) / run.variance(from, to));
        }
        from = to;
    }
}
