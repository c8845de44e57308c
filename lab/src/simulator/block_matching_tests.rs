use super::*;
use crate::random::CounterRng;

const MATCHING: Matching = Matching {
    window: [7, 7],
    smoothing: [1, 1],
    shifts: [2, 30],
    penalties: None,
    uniqueness: 0.1,
    left_right_px: Some(1),
    smallest_region_px: 1,
};

/// Random images; the first is the second shifted, row by row.
fn shifted(shift: impl Fn(usize) -> i64) -> ImagePair {
    let (size, reach) = ([100, 40], 31);
    let mut images =
        ImagePair { size, reach, left: vec![0; size[0] * size[1]], right: vec![0; (size[0] + reach) * size[1]] };
    let dice = CounterRng::new(1, 1);
    let texture = |u: i64, v: usize| (dice.uniform((v as i64 * 1000 + u + 100) as u64) * f64::from(BRIGHTEST)) as i16;
    for v in 0..size[1] {
        for u in -(reach as i64)..size[0] as i64 {
            let index = images.right_index(u, v);
            images.right[index] = texture(u, v);
        }
        for u in 0..size[0] {
            images.left[v * size[0] + u] = texture(u as i64 - shift(u), v);
        }
    }
    images
}

#[test]
fn a_shift_is_found_in_each_pixel() {
    for shift in [4, 17, 29] {
        let disparities = disparities(&shifted(|_| shift), &MATCHING);
        let inside = disparities.chunks_exact(100).flat_map(|row| &row[4..96]);
        assert!(inside.clone().all(|disparity| (disparity - shift as f32).abs() < 0.2), "{shift}");
    }
}

#[test]
fn a_shift_outside_of_the_range_is_not_found() {
    let disparities = disparities(&shifted(|_| 40), &Matching { smallest_region_px: 30, ..MATCHING });
    let found = disparities.iter().filter(|disparity| !disparity.is_nan()).count();
    assert!(found * 50 < disparities.len(), "{found}");
}

#[test]
fn sums_that_run_on_are_those_of_each_window() {
    let (images, window) = (shifted(|u| if u < 50 { 6 } else { 20 }), [5, 4]);
    let matching = Matching { window, left_right_px: None, uniqueness: 0.0, ..MATCHING };
    let mut sums = RowSums::default();
    for v in 0..40 {
        sums.sum_columns(&images, &matching, v);
        sums.sum_windows(&matching, 100);
        for (u, shift) in [(0, 0), (1, 5), (49, 4), (50, 18), (99, 28)] {
            let mut sum = 0;
            for (i, j) in (0..5).flat_map(|i| (0..4).map(move |j| (i, j))) {
                let column = (u as i64 + i - 2).clamp(0, 99) as usize;
                let row = (v as i64 + j - 2).clamp(0, 39) as usize;
                let other = images.right_index(column as i64 - (shift as i64 + 2), row);
                sum += (images.left[row * 100 + column] - images.right[other]).abs();
            }
            assert_eq!(sums.sums[u * 29 + shift], sum, "({u}, {v}), shift {shift}");
        }
    }
}

#[test]
fn a_path_goes_on_with_the_least_penalty() {
    let mut sums = [100, 200, 300, 400];
    go_on(&[7, 17, 57, 9], &mut sums, [3, 20]);
    // the same shift; one step from the left; one step from the right; two steps cost the same as a large one
    assert_eq!(sums, [100, 203, 305, 402]);
}

/// Smooth paths allow small windows, in which many shifts look alike.
#[test]
fn smooth_paths_leave_fewer_false_matches() {
    let step = |u: usize| if u < 50 { 6 } else { 20 };
    let images = shifted(step);
    let false_matches = |penalties| {
        let matching = Matching { window: [1, 1], penalties, uniqueness: 0.0, left_right_px: None, ..MATCHING };
        let disparities = disparities(&images, &matching);
        let is_false = |(index, disparity): (usize, &f32)| {
            let u = index % 100;
            (30..95).contains(&u) && !(45..55).contains(&u) && (disparity - step(u) as f32).abs() > 0.5
        };
        disparities.iter().enumerate().filter(|pixel| is_false(*pixel)).count()
    };
    let (alone, along) = (false_matches(None), false_matches(Some([10, 60])));
    assert!(alone > 50 && along * 10 < alone, "{alone} and {along} false matches");
}

#[test]
fn smoothing_leaves_a_step_sharp() {
    let step = |u: usize| if u < 50 { 6 } else { 20 };
    let smooth = Matching { smoothing: [9, 9], ..MATCHING };
    let disparities = disparities(&shifted(step), &smooth);
    let between = disparities.iter().filter(|disparity| (7.0..19.0).contains(*disparity)).count();
    assert!(between < 20, "{between}");
}

#[test]
fn small_regions_are_removed() {
    let none = f32::NAN;
    let mut disparities = [5.0, 5.5, none, 9.0, 6.0, none, none, none, 6.5, none, 2.0, 2.0];
    remove_small_regions([4, 3], 4, &mut disparities);
    let left: Vec<usize> = (0..12).filter(|&index| !disparities[index].is_nan()).collect();
    assert_eq!(left, [0, 1, 4, 8]);
}
