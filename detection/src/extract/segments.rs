//! Segmentation: a run is cut at its creases, and where neither a line nor a circle explains its points.
//!
//! Running sums give the moments of any interval by one subtraction, so an interval grows by galloping and bisection, with a few
//! fits in place of one per point. A growing segment also takes in points of the next one as long as its curve explains them. So
//! the border between two segments then moves to where both curves together explain their points best.

use super::run::{FIRST_FIT, MIN_ARC_POINTS, Run};
use super::view::SURROUNDINGS;
use std::ops::Range;

/// Number of points on each side of a crease that are compared with the three points in it.
const WING: usize = 5; // [tuned]
/// Least depth of a crease, in standard deviations of one pixel. The depth is the difference between the mean of the three points
/// in the crease and that of the ten beside it; it scatters by 0.66, so the limit is 5.3 of its own standard deviations.
const CREASE: f64 = 3.5; // [sigmas]
/// Parts into which a unit of the image is divided for the depth of a crease, which is an integer: 30 is divisible by 3 and by
/// 10.
const CREASE_UNIT: f64 = 30.0; // [derived]
/// Steps by which the border between two segments moves, in points: 63 in total, down to single points.
const BORDER_STEPS: [usize; 6] = [32, 16, 8, 4, 2, 1]; // [algorithmic]

/// An interval of a run that one curve explains.
#[derive(Clone, Copy, Debug)]
pub(super) struct Segment {
    /// The part of the run between two creases in which the interval lies, without the ends of the run.
    pub part: [usize; 2],
    pub from: usize,
    pub to: usize,
    /// Whether the interval may be an arc: no line explains it, or it is the whole part and not too wide.
    pub is_curve: bool,
}

/// Puts the borders of the parts of a run into `cuts`: its ends, and its creases, where an object stands on a floor. Only creases
/// whose middle is farther away than their sides count, and only if no circle (such as the inside of a bowl) explains the whole
/// run.
pub(super) fn cut(run: &Run, cuts: &mut Vec<usize>, depth_sums: &mut Vec<u32>) {
    cuts.clear();
    let Range { start, end } = run.inner;
    cuts.push(start);
    if !run.is_line(start, end) && !run.is_circle(start, end) {
        add_creases(run, cuts, depth_sums);
    }
    cuts.push(end);
}

/// Returns running sums of the depths of a run, starting with 0. The sums may wrap around, but their differences do not.
fn sum_depths<'a>(depths: &[u16], sums: &'a mut Vec<u32>) -> &'a [u32] {
    sums.resize(sums.len().max(depths.len() + 1), 0);
    let mut sum = 0_u32;
    for (known, &depth) in sums[1..].iter_mut().zip(depths) {
        sum = sum.wrapping_add(u32::from(depth));
        *known = sum;
    }
    &sums[..=depths.len()]
}

/// Adds the deepest point of each crease; `depth_sums` is a buffer.
fn add_creases(run: &Run, creases: &mut Vec<usize>, depth_sums: &mut Vec<u32>) {
    let depth_sums = sum_depths(run.points.depths, depth_sums);
    let mut deepest: Option<(i32, usize)> = None;
    let start = (WING + 1).max(run.inner.start + 1);
    let end = run.length.saturating_sub(WING + 1).min(run.inner.end);
    let per_sigma = CREASE_UNIT * CREASE / run.view.scale;
    for first in (0..end).step_by(SURROUNDINGS) {
        let block = first.max(start)..(first + SURROUNDINGS).min(end);
        if block.is_empty() {
            continue;
        }
        let least = (per_sigma * run.depth_variance(first).sqrt()) as i32;
        let depths = crease_depths(depth_sums, block.clone());
        if !depths.clone().fold(false, |any, depth| any | (depth > least)) {
            creases.extend(deepest.take().map(|(_, at)| at));
            continue;
        }
        for (depth, at) in depths.zip(block) {
            if depth > least {
                deepest = deepest.filter(|(most, _)| *most >= depth).or(Some((depth, at)));
            } else {
                creases.extend(deepest.take().map(|(_, at)| at));
            }
        }
    }
    creases.extend(deepest.map(|(_, at)| at));
}

/// Returns by how much the three points about each of `block` lie deeper than those on both sides, in units of `1 / CREASE_UNIT`.
fn crease_depths(sums: &[u32], block: Range<usize>) -> impl Iterator<Item = i32> + Clone {
    // (P[2] - P[-1]) / 3 - (P[-1] - P[-6]) / 10 - (P[7] - P[2]) / 10 of the running sums P, times 30.
    let shifted = |by: usize| sums[block.start + by - WING - 1..].iter().take(block.len());
    let (wings, middles) = (shifted(0).zip(shifted(2 * WING + 3)), shifted(WING).zip(shifted(WING + 3)));
    wings.zip(middles).map(|((before, behind), (from, to))| {
        let (wings, middle) = (behind.wrapping_sub(*before), to.wrapping_sub(*from));
        // 13 middle - 3 wings, in operations that every processor does four at a time.
        (middle << 4).wrapping_sub(middle.wrapping_add(wings).wrapping_mul(3)).cast_signed()
    })
}

/// Cuts a part of a run between two creases into segments and puts them into `segments`, in order.
pub(super) fn cut_part(run: &Run, part: &Range<usize>, segments: &mut Vec<Segment>) {
    segments.clear();
    let mut from = part.start;
    while let Some(segment) = next_segment(run, part, from) {
        from = segment.to;
        segments.push(segment);
    }
    for right in 1..segments.len() {
        if segments[right - 1].is_curve || segments[right].is_curve {
            let border = border(run, &segments[right - 1], &segments[right]);
            segments[right - 1].to = border;
            segments[right].from = border;
        }
    }
}

/// Returns the border between two segments at which the sum of their square errors is least.
fn border(run: &Run, left: &Segment, right: &Segment) -> usize {
    let error = |from: usize, to: usize, is_curve: bool| {
        let square = if is_curve { run.moments(from, to).circle_square() } else { run.line_square(from, to) };
        (to - from) as f64 * square
    };
    let both = |at: usize| error(left.from, at, left.is_curve) + error(at, right.to, right.is_curve);
    let (mut border, mut least) = (left.to, both(left.to));
    for step in BORDER_STEPS {
        for at in [border.saturating_sub(step), border + step] {
            let are_enough = at >= left.from + FIRST_FIT && at + FIRST_FIT <= right.to;
            let error = if are_enough { both(at) } else { f64::INFINITY };
            if error < least {
                (border, least) = (at, error);
            }
        }
    }
    border
}

/// Returns the segment that starts at `from`, in a part of a run between two creases; `None` where too few points are left.
pub(super) fn next_segment(run: &Run, part: &Range<usize>, from: usize) -> Option<Segment> {
    let most = part.end - from;
    let segment =
        |length: usize, is_curve: bool| Segment { part: [part.start, part.end], from, to: from + length, is_curve };
    if most < MIN_ARC_POINTS {
        None
    } else if run.is_line(from, part.end) {
        Some(segment(most, from == part.start && run.width() < 2.0 * run.view.parameters.max_radius_m))
    } else if run.is_circle(from, part.end) {
        Some(segment(most, true))
    } else {
        let line = gallop(FIRST_FIT.min(most), most, |length| run.is_line(from, from + length));
        let circle = gallop(line, most, |length| run.is_circle(from, from + length));
        // A circle has one parameter more, so it also explains one point more of a line.
        Some(segment(circle, circle > line + 1))
    }
}

/// Returns the greatest length up to `most` that is explained; `least` is known to be, and the explained lengths have no gaps.
fn gallop(least: usize, most: usize, mut explained: impl FnMut(usize) -> bool) -> usize {
    let (mut good, mut bad) = (least.min(most), most + 1);
    while good + 1 < bad {
        let trial = if bad > most { (good + good / 2 + 1).min(most) } else { (good + bad) / 2 };
        if explained(trial) {
            good = trial;
        } else {
            bad = trial;
        }
        if good == most {
            break;
        }
    }
    good
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn galloping_finds_how_far_a_curve_explains_the_points_with_few_trials() {
        for most in [5, 6, 17, 100] {
            for greatest in 5..=most {
                let mut trials = 0;
                let found = gallop(5, most, |length| {
                    trials += 1;
                    assert!((6..=most).contains(&length), "the least is known to be explained");
                    length <= greatest
                });
                assert_eq!(found, greatest, "of {most}");
                assert!(trials <= 14, "{trials} trials for {greatest} of {most}");
            }
        }
        assert_eq!(gallop(5, 4, |_| unreachable!()), 4, "there are no more");
    }

    #[test]
    fn a_crease_is_as_deep_as_three_points_lie_behind_the_mean_of_ten_beside_them() {
        let depths: Vec<u16> = (0..40_u16).map(|i| 40_000 + i * i * 13 % 997).collect();
        let mut sums = Vec::new();
        let sums = sum_depths(&depths, &mut sums);
        assert_eq!((sums.len(), sums[0]), (41, 0));
        let found: Vec<i32> = crease_depths(sums, 9..34).collect();
        let sum = |range: Range<usize>| depths[range].iter().map(|&depth| i32::from(depth)).sum::<i32>();
        let expected = |at: usize| 10 * sum(at - 1..at + 2) - 3 * (sum(at - 6..at - 1) + sum(at + 2..at + 7));
        assert_eq!(found, (9..34).map(expected).collect::<Vec<_>>());
    }
}
