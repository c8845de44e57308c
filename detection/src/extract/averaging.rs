//! Averages each line with its neighbours, where noise hides the jumps of a single line.
//!
//! A line is split where neighbouring pixels differ by more than one surface and the noise explain. Where the noise exceeds the
//! step of a steep surface, an object merges with its background. Neighbouring lines show the same objects, and the mean of k
//! lines of independent noise has a k-th of its variance. Neighbouring means share their noise, as with a camera that compares
//! windows: all lines of an object together hold the same information as before.
//!
//! Each pixel is averaged over as many lines as bring its noise down to that step and no more, because the mean lies behind a
//! surface that bends across the lines. The two pixels at one distance on either side both count, or neither does, so a slope
//! does not shift the mean. Pixels beyond a jump do not count, so silhouettes stay in place.

use super::view::{LeastStep, SURROUNDINGS};
use conicflow_messages::is_measured;

/// Largest number of lines that are averaged: the contour of a small object changes from line to line.
pub(super) const MAX_LINES: u32 = 5; // [tuned]
/// If [`MAX_LINES`] are averaged, only every second line is searched, provided that at least this many lines remain: the lines
/// between add little, but the smallest objects have to be seen in enough lines. If every line is searched, 389 in place of 390
/// objects are found in the first 15 scenes of each group, seen by a Kinect and by a D435 at 1280x960
/// (`experiments/detection.toml`); with 240 in place of 480 each sensor finds 11 fewer of 1426 at 640x480.
const ENOUGH: u32 = 480; // [tuned]
/// If more neighbouring lines than this share their noise, none are averaged: their mean would keep most of it. Averages harm
/// simulated structured light (F1 0.831 to 0.809, `experiments/simulated_sensors.toml`, seeds 0 to 9).
const INDEPENDENT: f64 = 2.0; // [tuned]
/// Number of pixels that are averaged together.
const MEAN_BATCH: usize = 32; // [algorithmic]
/// Largest difference of a pixel that counts, in units of the image: the sum of four differences fits into 16 bits.
const MOST_OFF: u16 = 8191; // [algorithmic]
/// The largest raw depth that is a measurement; the least is 1.
const MOST_MEASURED: u16 = u16::MAX - 1; // [derived]
/// Denominator of the shares of a pixel in a mean.
const WHOLE: u32 = 1 << 16; // [algorithmic]

/// Returns how many lines are averaged: as many as bring the noise down to the step of a steep surface between pixels. `excess`
/// is the noise of one line in units of that step, and `shared_lines` neighbouring lines share it. The number is odd; 1 means
/// none.
pub(super) fn lines(excess: f64, shared_lines: f64) -> u32 {
    if shared_lines > INDEPENDENT {
        return 1;
    }
    (1..MAX_LINES).step_by(2).find(|&lines| excess * excess * variance(lines, shared_lines) <= 1.0).unwrap_or(MAX_LINES)
}

/// Returns the variance of the mean of some lines relative to that of one line, where `shared_lines` neighbouring lines share
/// their noise.
///
/// The correlation of lines at the distance i is taken as `r^i`, so that `(1 + r) / (1 - r)` of them count as one.
pub(super) fn variance(lines: u32, shared_lines: f64) -> f64 {
    let correlation = (shared_lines - 1.0) / (shared_lines + 1.0);
    let apart = |i: u32| 2.0 * f64::from(lines - i) * correlation.powi(i.cast_signed());
    (f64::from(lines) + (1..lines).map(apart).sum::<f64>()) / f64::from(lines * lines)
}

/// Returns the step between the lines that are searched, given the number of averaged rows and columns, and of all rows and
/// columns.
pub(super) fn step(averaged: [u32; 2], lines: [u32; 2]) -> u32 {
    let steps = averaged.into_iter().zip(lines).map(|(averaged, lines)| (averaged / 2).min(lines / ENOUGH));
    steps.min().unwrap_or(1).max(1)
}

/// The weights of an average over lines.
#[derive(Clone, Debug, Default)]
pub(super) struct Averaging {
    /// For each line on either side, from the nearest on: standard deviation of the mean of all lines nearer than it, relative to
    /// that of one line, times [`WHOLE`]. 0 for lines that never count.
    mean_sigmas: [u16; (MAX_LINES / 2) as usize],
    /// Largest number of lines on either side that count.
    reach: u32,
    /// Variance of a pixel averaged over 0, 1, ... lines on either side, relative to that of one averaged over all.
    variances: Vec<f64>,
    /// The mean of [`SURROUNDINGS`] equal values of each of `variances`, with the rounding of their sum, for bitwise the same
    /// results.
    mean_of_equal: Vec<f64>,
}

impl Averaging {
    /// Sets up the mean of at most `lines` lines, of which `shared_lines` share their noise.
    pub fn set(&mut self, lines: u32, shared_lines: f64) {
        let reach = lines / 2;
        let of = |pairs: u32| variance(2 * pairs + 1, shared_lines);
        self.reach = reach;
        self.mean_sigmas = [0; _];
        for (nearer, sigma) in (0..reach).zip(&mut self.mean_sigmas) {
            *sigma = (of(nearer).sqrt() * f64::from(WHOLE)) as u16;
        }
        self.variances.clear();
        self.variances.extend((0..=reach).map(|pairs| of(pairs) / of(reach)));
        let mean = |variance: &f64| [*variance; SURROUNDINGS].iter().sum::<f64>() / SURROUNDINGS as f64;
        self.mean_of_equal.clear();
        self.mean_of_equal.extend(self.variances.iter().map(mean));
    }

    /// Returns the largest number of lines on either side that count.
    pub fn reach(&self) -> u32 {
        self.reach
    }

    /// Returns the mean variance of pixels relative to that of pixels averaged over all lines, given the number of lines on
    /// either side over which each was averaged; 1 without pixels.
    pub fn variance(&self, pairs: &[u16]) -> f64 {
        let Some(&first) = pairs.first() else { return 1.0 };
        if *pairs == [first; SURROUNDINGS] {
            return self.mean_of_equal[usize::from(first)];
        }
        pairs.iter().map(|&pairs| self.variances[usize::from(pairs)]).sum::<f64>() / pairs.len() as f64
    }

    /// Computes for each pixel the mean of a line and of at most `reach` lines on either side, and the number of lines on either
    /// side that count. `line(by)` returns the pixels of the line at the distance `by`, as many as `means` and `pairs` have;
    /// `jump` limits the differences between pixels of one surface.
    pub fn average<'a>(
        &self,
        jump: &LeastStep,
        reach: u32,
        line: impl Fn(i64) -> &'a [u16],
        means: &mut [u16],
        pairs: &mut [u16],
    ) {
        // The last batch ends with the line, and overlaps the batch before it.
        let (length, last) = (means.len().min(MEAN_BATCH), means.len().saturating_sub(MEAN_BATCH));
        for first in (0..means.len()).step_by(MEAN_BATCH).map(|first| first.min(last)) {
            let here = first..first + length;
            let (of_means, of_pairs) =
                self.average_batch(jump, reach, |by| batch_of(&line(i64::from(by))[here.clone()]));
            means[here.clone()].copy_from_slice(&of_means[..length]);
            pairs[here].copy_from_slice(&of_pairs[..length]);
        }
    }

    /// Averages a batch of pixels as [`Self::average`] does, from differences in integers, of which processors handle eight at a
    /// time.
    #[inline]
    fn average_batch(
        &self,
        jump: &LeastStep,
        reach: u32,
        line: impl Fn(i32) -> [u16; MEAN_BATCH],
    ) -> ([u16; MEAN_BATCH], [u16; MEAN_BATCH]) {
        let middle = line(0);
        // For each pixel: the largest difference that counts, and the number of lines on either side; 0 without a measurement.
        let (mut limits, mut reaches) = ([0; MEAN_BATCH], [0_u16; MEAN_BATCH]);
        for (at, &depth) in middle.iter().enumerate() {
            let [noise, slope] = jump.noise_and_slope(depth);
            // Every depth within this limit of the pixel is a measurement.
            limits[at] = noise
                .saturating_add(slope)
                .min(MOST_OFF)
                .min(depth.wrapping_sub(1))
                .min(MOST_MEASURED.wrapping_sub(depth));
            let noise = if is_measured(depth) { noise } else { 0 };
            for sigma in self.mean_sigmas {
                let of_mean = ((u32::from(noise) * u32::from(sigma)) >> 16) as u16;
                reaches[at] += u16::from(of_mean > slope);
            }
        }
        if reaches.iter().fold(true, |none, &reach| none & (reach == 0)) {
            return (middle, [0; MEAN_BATCH]);
        }
        // For each pixel: all ones until a jump is met, the sum of the differences that count, and the share of one of them.
        let (mut goes_on, mut off, mut share) = ([u16::MAX; MEAN_BATCH], [0_u16; MEAN_BATCH], [0_u16; MEAN_BATCH]);
        let (mut pairs, mut share_before) = ([0_u16; MEAN_BATCH], 0);
        for by in 1..=reach as u16 {
            let (before, behind) = (line(-i32::from(by)), line(i32::from(by)));
            let of_so_many = (WHOLE / (2 * u32::from(by) + 1)) as u16;
            let change = of_so_many.wrapping_sub(share_before);
            share_before = of_so_many;
            for at in 0..MEAN_BATCH {
                let (before, behind, middle) = (before[at], behind[at], middle[at]);
                let too_far = |depth: u16| depth.abs_diff(middle).saturating_sub(limits[at]);
                let ends = too_far(before) | too_far(behind) | by.saturating_sub(reaches[at]);
                goes_on[at] &= u16::from(ends == 0).wrapping_neg();
                let pair = before.wrapping_sub(middle).wrapping_add(behind.wrapping_sub(middle));
                off[at] = off[at].wrapping_add(pair & goes_on[at]);
                share[at] = share[at].wrapping_add(change & goes_on[at]);
                pairs[at] = pairs[at].wrapping_sub(goes_on[at]);
            }
        }
        let mut means = middle;
        for ((mean, &off), &share) in means.iter_mut().zip(&off).zip(&share) {
            let whole = (i32::from(off.cast_signed()) * i32::from(share.cast_signed())) >> 16;
            // Rounds by the highest bit of the fraction.
            *mean = mean.wrapping_add(whole as u16).wrapping_add(off.wrapping_mul(share) >> 15);
        }
        (means, pairs)
    }
}

/// Returns some pixels, filled up to a batch with unmeasured ones.
#[inline]
fn batch_of(pixels: &[u16]) -> [u16; MEAN_BATCH] {
    pixels.first_chunk().copied().unwrap_or_else(|| {
        let mut batch = [0; MEAN_BATCH];
        batch[..pixels.len()].copy_from_slice(pixels);
        batch
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::NoiseModel;

    #[test]
    fn as_many_lines_are_averaged_as_bring_the_noise_down_to_the_step() {
        let of = |excess: f64| lines(excess, 1.0);
        assert_eq!([0.0, 1.0, 1.01, 1.7, 1.75, 9.0].map(of), [1, 1, 3, 3, 5, MAX_LINES]);
        assert_eq!(
            [1.0, 1.5, INDEPENDENT].map(|shared| lines(1.6, shared)),
            [3, 5, MAX_LINES],
            "what is shared is kept"
        );
        assert_eq!(lines(9.0, 1.01 * INDEPENDENT), 1);
    }

    #[test]
    fn the_mean_keeps_what_its_lines_share() {
        assert_eq!([1, 3, 5].map(|lines| variance(lines, 1.0)), [1.0, 1.0 / 3.0, 0.2]);
        // Neighbours have the correlation 1/2: (3 + 2 (2/2 + 1/4)) / 9.
        assert!((variance(3, 3.0) - 5.5 / 9.0).abs() < 1e-12);
        assert!((0.99..1.0).contains(&variance(5, 1000.0)));
    }

    #[test]
    fn means_that_overlap_are_looked_at_at_every_second_line_of_a_large_image() {
        let sizes = [[480, 640], [958, 1280], [960, 1280], [2160, 3840]];
        assert_eq!(sizes.map(|size| step([5; 2], size)), [1, 1, 2, 2]);
        assert_eq!([[3, 5], [1, 1]].map(|averaged| step(averaged, [960, 1280])), [1, 1]);
    }

    /// The mean of the middle one of five lines, with a limit of 10 units of noise and one of slope on steps within a surface;
    /// and the number of lines on either side that count.
    fn mean(lines: &[[u16; 6]; 5]) -> ([u16; 6], [u16; 6]) {
        let jump = LeastStep::new(&NoiseModel { floor_m: 0.0026, ..NoiseModel::IDEAL }, 0.001, 0.0005);
        assert_eq!(jump.noise_and_slope(1000), [10, 1]);
        let (mut means, mut pairs) = ([0; 6], [9; 6]);
        let mut averaging = Averaging::default();
        averaging.set(5, 1.0);
        averaging.average(&jump, 2, |by| &lines[(2 + by) as usize], &mut means, &mut pairs);
        (means, pairs)
    }

    #[test]
    fn pairs_count_up_to_the_first_jump() {
        let lines = [
            [1009, 991, 1009, 1003, 65535, 1010],
            [1004, 995, 1300, 1004, 1005, 1000],
            [1000, 1000, 1000, 0, 1000, 65535],
            [1003, 1005, 1003, 1003, 1005, 1000],
            [1009, 1009, 1009, 1004, 1005, 1010],
        ];
        // All five lines, whose sum is off by 25; a slope; beyond a jump; not measured; three lines, as an outer one is not
        // measured.
        assert_eq!(mean(&lines), ([1005, 1000, 1000, 0, 1003, 65535], [2, 2, 0, 0, 1, 0]));
    }

    #[test]
    fn means_are_rounded_to_the_nearest_unit() {
        let of = |ends: [u16; 4]| mean(&[[ends[0]; 6], [ends[1]; 6], [1000; 6], [ends[2]; 6], [ends[3]; 6]]).0[0];
        assert_eq!(of([1000, 1001, 1001, 1000]), 1000, "0.4");
        assert_eq!(of([1001, 1001, 1001, 1000]), 1001, "0.6");
        assert_eq!(of([999, 999, 999, 1000]), 999, "-0.6");
        assert_eq!(of([999, 999, 1000, 1000]), 1000, "-0.4");
    }
}
