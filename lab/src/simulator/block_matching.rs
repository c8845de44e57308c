//! Disparities of two rectified images by block matching: for each pixel, the shift at which the sum of absolute differences
//! between the window around it and the other image is least.
//!
//! All shifts are tried, with running sums along rows and columns, so that the time does not depend on the window's size (as in
//! K. Konolige, "Small vision systems: hardware and implementation", 1998, from which the left-right check and the uniqueness
//! check are, too). Shifts may be required to be smooth along scan lines from the left, the right and above (H. Hirschmüller,
//! "Stereo processing by semiglobal matching and mutual information", 2008): that allows small windows, which keep silhouettes
//! sharp. Disparities are averaged with their neighbours of the same surface, which correlates the noise over a longer distance
//! without blurring silhouettes. All sums are of whole numbers, so that the bits are the same on every machine.

/// Largest brightness of a pixel.
pub const BRIGHTEST: i16 = 63;

/// Number of directions along which shifts can be smooth.
const PATHS: u32 = 3;

/// Largest number of pixels in a window; the costs of a window and its penalties along all paths then fit into 16 bits.
pub const LARGEST_WINDOW: u32 = (i16::MAX as u32 / PATHS - LARGEST_PENALTY as u32) / BRIGHTEST as u32;

/// Largest penalty of a step.
const LARGEST_PENALTY: i16 = 2000;

/// Two images, row by row; the second one extends farther to the left, by the largest shift.
#[derive(Clone, Debug, Default)]
pub struct ImagePair {
    /// Width and height of the first.
    pub size: [usize; 2],
    /// Number of additional pixels of the second image, at its left end.
    pub reach: usize,
    /// The first image.
    pub left: Vec<i16>,
    /// The second image, each row from right to left, so that shifts ascend in memory.
    pub right: Vec<i16>,
}

impl ImagePair {
    /// Returns the index in `right` of a pixel of the second image; `u` is at least `-reach`.
    #[inline]
    pub fn right_index(&self, u: i64, v: usize) -> usize {
        v * (self.size[0] + self.reach) + (self.size[0] as i64 - 1 - u) as usize
    }
}

/// Parameters of the matching.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Matching {
    /// Columns and rows of the window.
    pub window: [usize; 2],
    /// Least and greatest shift.
    pub shifts: [usize; 2],
    /// Costs of a step of the shift by one pixel, and by more, along a scan line, in units of brightness; none: each pixel is
    /// matched independently.
    pub penalties: Option<[i16; 2]>,
    /// Share by which the least difference has to be below that of all other shifts but its neighbours.
    pub uniqueness: f64,
    /// Largest difference from the shift that the other image finds; none: no left-right check.
    pub left_right_px: Option<usize>,
    /// Regions of fewer pixels are removed.
    pub smallest_region_px: usize,
    /// Columns and rows of the window over which disparities of one surface are averaged; `[1, 1]`: no averaging.
    pub smoothing: [usize; 2],
}

/// Largest difference between the disparities of neighbours on one surface, in pixels.
const ONE_SURFACE_PX: f32 = 1.0;

/// Returns the disparity of each pixel; NaN where there is none.
pub fn disparities(images: &ImagePair, matching: &Matching) -> Vec<f32> {
    let [width, height] = images.size;
    let mut disparities = vec![f32::NAN; width * height];
    let mut sums = RowSums::default();
    for (v, row) in disparities.chunks_exact_mut(width).enumerate() {
        sums.sum_columns(images, matching, v);
        sums.sum_windows(matching, width);
        if let Some(penalties) = matching.penalties {
            sums.add_up_paths(shift_count(matching), penalties, v == 0);
        }
        if matching.left_right_px.is_some() {
            sums.look_from_the_right(images, matching);
        }
        for (u, disparity) in row.iter_mut().enumerate() {
            *disparity = sums.best(matching, width, u).unwrap_or(f32::NAN);
        }
    }
    remove_small_regions(images.size, matching.smallest_region_px, &mut disparities);
    if matching.smoothing != [1, 1] {
        smooth(width, matching.smoothing, &mut disparities);
    }
    disparities
}

/// Sums of a row, and of the rows above.
#[derive(Default)]
struct RowSums {
    /// Sum of differences over the window's rows, for each column and shift.
    columns: Vec<i16>,
    /// Sum of differences over the window, for each column and shift.
    sums: Vec<i16>,
    /// Least costs of paths from above and from the side, for each column and shift.
    from_above: Vec<i16>,
    last_row: Vec<i16>,
    from_left: Vec<i16>,
    from_right: Vec<i16>,
    /// For each pixel of the second image's row, the least difference and its shift.
    least_right: Vec<i16>,
    shift_right: Vec<i16>,
}

impl RowSums {
    /// Updates the sums over the window's rows around row `v`; beyond the image's border, the last row is repeated.
    fn sum_columns(&mut self, images: &ImagePair, matching: &Matching, v: usize) {
        let [width, height] = images.size;
        let rows = matching.window[1] as i64;
        let row = |offset: i64| (v as i64 - rows / 2 + offset).clamp(0, height as i64 - 1) as usize;
        if v == 0 {
            self.columns.clear();
            self.columns.resize(width * shift_count(matching), 0);
            (0..rows).for_each(|offset| self.add_row(images, matching, row(offset), None));
        } else {
            self.add_row(images, matching, row(rows - 1), Some(row(-1)));
        }
    }

    /// Adds the differences of one row, and subtracts those of another.
    fn add_row(&mut self, images: &ImagePair, matching: &Matching, added: usize, removed: Option<usize>) {
        let (width, count) = (images.size[0], shift_count(matching));
        let place = |u: usize, v: usize| images.right_index(u as i64 - matching.shifts[0] as i64, v);
        for (u, sums) in self.columns.chunks_exact_mut(count).enumerate() {
            let (one, others) = (images.left[added * width + u], &images.right[place(u, added)..][..count]);
            match removed {
                None => sums.iter_mut().zip(others).for_each(|(sum, other)| *sum += (one - other).abs()),
                Some(removed) => {
                    let old = images.left[removed * width + u];
                    let olds = &images.right[place(u, removed)..][..count];
                    for ((sum, other), old_other) in sums.iter_mut().zip(others).zip(olds) {
                        *sum += (one - other).abs() - (old - old_other).abs();
                    }
                }
            }
        }
    }

    /// Sums up the columns of each window in the row.
    fn sum_windows(&mut self, matching: &Matching, width: usize) {
        let count = shift_count(matching);
        let columns = matching.window[0] as i64;
        let Self { columns: of_column, sums, .. } = self;
        let column = |u: i64| &of_column[u.clamp(0, width as i64 - 1) as usize * count..][..count];
        sums.clear();
        sums.resize(width * count, 0);
        for offset in -(columns / 2)..columns - columns / 2 {
            sums[..count].iter_mut().zip(column(offset)).for_each(|(sum, added)| *sum += added);
        }
        for u in 1..width as i64 {
            let (before, here) = sums.split_at_mut(u as usize * count);
            let last = &before[(u as usize - 1) * count..];
            let (added, removed) = (column(u + columns - 1 - columns / 2), column(u - 1 - columns / 2));
            for (((sum, last), added), removed) in here[..count].iter_mut().zip(last).zip(added).zip(removed) {
                *sum = last + added - removed;
            }
        }
    }

    /// Replaces the costs of the row's windows by those of the best paths that end there; the `first` row has none from above.
    fn add_up_paths(&mut self, count: usize, penalties: [i16; 2], first: bool) {
        let Self { sums, from_above, last_row, from_left, from_right, .. } = self;
        from_left.clone_from(sums);
        from_right.clone_from(sums);
        if first {
            from_above.clone_from(sums);
        } else {
            last_row.clone_from(from_above);
            from_above.clone_from(sums);
            for (path, last) in from_above.chunks_exact_mut(count).zip(last_row.chunks_exact(count)) {
                go_on(last, path, penalties);
            }
        }
        for end in (2 * count..=sums.len()).step_by(count) {
            let (before, here) = from_left[..end].split_at_mut(end - count);
            go_on(&before[end - 2 * count..], here, penalties);
        }
        for start in (0..sums.len() - count).step_by(count).rev() {
            let (here, after) = from_right[start..].split_at_mut(count);
            go_on(&after[..count], here, penalties);
        }
        for (sum, ((above, left), right)) in sums.iter_mut().zip(from_above.iter().zip(&*from_left).zip(&*from_right)) {
            *sum = above + left + right;
        }
    }

    /// Finds the best shift of each pixel of the second image.
    fn look_from_the_right(&mut self, images: &ImagePair, matching: &Matching) {
        let (width, count) = (images.size[0], shift_count(matching));
        let Self { sums, least_right, shift_right, .. } = self;
        least_right.clear();
        least_right.resize(width + images.reach, i16::MAX);
        shift_right.clear();
        shift_right.resize(width + images.reach, 0);
        for (u, sums) in sums.chunks_exact(count).enumerate() {
            let first = images.right_index(u as i64 - matching.shifts[0] as i64, 0);
            let others = least_right[first..].iter_mut().zip(&mut shift_right[first..]);
            for ((shift, sum), (least, best)) in (0..).zip(sums).zip(others) {
                let better = sum < least;
                *least = if better { *sum } else { *least };
                *best = if better { shift } else { *best };
            }
        }
    }

    /// Returns the shift of a pixel in the row, with a fraction of a pixel.
    fn best(&self, matching: &Matching, width: usize, u: usize) -> Option<f32> {
        let count = shift_count(matching);
        let sums = &self.sums[u * count..][..count];
        let least = least_of(sums);
        let best = sums.iter().position(|sum| *sum == least)?;
        if best == 0 || best + 1 == count {
            return None;
        }
        let second = least_of(&sums[..best - 1]).min(least_of(sums.get(best + 2..).unwrap_or(&[])));
        if f64::from(least) > (1.0 - matching.uniqueness) * f64::from(second) {
            return None;
        }
        if let Some(limit) = matching.left_right_px {
            let back = self.shift_right[width - 1 - u + best + matching.shifts[0]] as usize;
            if back.abs_diff(best) > limit {
                return None;
            }
        }
        Some((best + matching.shifts[0]) as f32 + between(sums[best - 1], least, sums[best + 1]))
    }
}

/// Replaces each disparity by the mean of its neighbours on the same surface.
fn smooth(width: usize, [columns, rows]: [usize; 2], disparities: &mut [f32]) {
    let (rough, height) = (disparities.to_vec(), disparities.len() / width);
    let near = |at: usize, side: usize, size: usize| at.saturating_sub(side / 2)..(at + side - side / 2).min(size);
    for (index, disparity) in disparities.iter_mut().enumerate().filter(|(_, disparity)| !disparity.is_nan()) {
        let (mut sum, mut count) = (0.0, 0.0);
        for v in near(index / width, rows, height) {
            for other in &rough[v * width..][near(index % width, columns, width)] {
                if (other - rough[index]).abs() <= ONE_SURFACE_PX {
                    sum += other;
                    count += 1.0;
                }
            }
        }
        *disparity = sum / count;
    }
}

/// Removes small regions: matches that agree with few neighbours are chance.
fn remove_small_regions([width, height]: [usize; 2], smallest: usize, disparities: &mut [f32]) {
    let mut seen = vec![false; disparities.len()];
    for start in 0..disparities.len() {
        if seen[start] || disparities[start].is_nan() {
            continue;
        }
        seen[start] = true;
        let (mut region, mut next) = (vec![start], 0);
        while let Some(&index) = region.get(next) {
            next += 1;
            let (u, v) = (index % width, index / width);
            let sides = [
                (u > 0).then(|| index - 1),
                (u + 1 < width).then_some(index + 1),
                (v > 0).then(|| index - width),
                (v + 1 < height).then_some(index + width),
            ];
            for side in sides.into_iter().flatten() {
                if !seen[side] && (disparities[side] - disparities[index]).abs() <= ONE_SURFACE_PX {
                    seen[side] = true;
                    region.push(side);
                }
            }
        }
        if region.len() < smallest {
            region.iter().for_each(|&index| disparities[index] = f32::NAN);
        }
    }
}

/// Adds to a pixel's costs those of the best path from its neighbour, minus what all paths have in common.
#[inline]
fn go_on(neighbor: &[i16], sums: &mut [i16], [small, large]: [i16; 2]) {
    let least = least_of(neighbor);
    let count = sums.len();
    let step = |sum: &mut i16, from: i16| *sum += from.min(least + large) - least;
    let last = count - 1;
    step(&mut sums[0], neighbor[0].min(neighbor[1] + small));
    step(&mut sums[last], neighbor[last].min(neighbor[last - 1] + small));
    for (sum, about) in sums[1..last].iter_mut().zip(neighbor.windows(3)) {
        step(sum, about[1].min(about[0].min(about[2]) + small));
    }
}

fn shift_count(matching: &Matching) -> usize {
    matching.shifts[1] + 1 - matching.shifts[0]
}

/// Returns the least sum; the largest number for an empty slice.
#[inline]
fn least_of(sums: &[i16]) -> i16 {
    sums.iter().fold(i16::MAX, |least, sum| least.min(*sum))
}

/// Returns the position of the minimum relative to the least sum, in pixels. A parabola through three sums is biased towards
/// whole shifts, and two straight lines of opposite slopes towards halves; their mean has little bias.
fn between(before: i16, least: i16, after: i16) -> f32 {
    let (before, least, after) = (f32::from(before), f32::from(least), f32::from(after));
    let (curvature, slope) = (before + after - 2.0 * least, before.max(after) - least);
    if slope > 0.0 { 0.25 * (before - after) * (1.0 / curvature + 1.0 / slope) } else { 0.0 }
}

#[cfg(test)]
#[path = "block_matching_tests.rs"]
mod tests;
