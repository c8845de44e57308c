//! Quantiles of numbers: the one place that says which of the values that is.

use std::cmp::Ordering;

/// The value that comes after `rank` smaller ones. `None` if there are not so many; their order changes.
pub fn at_rank<T: Copy>(values: &mut [T], rank: usize, compare: impl FnMut(&T, &T) -> Ordering) -> Option<T> {
    if rank >= values.len() {
        return None;
    }
    Some(*values.select_nth_unstable_by(rank, compare).1)
}

/// The value below which a share (0 to 1) of the values lies: the one at the nearest rank, of two the larger one. `None` of
/// no values; their order changes.
pub fn quantile(values: &mut [f64], share: f64) -> Option<f64> {
    let rank = (values.len().saturating_sub(1) as f64 * share).round() as usize;
    at_rank(values, rank, f64::total_cmp)
}

/// The median of numbers.
pub fn median(mut values: Vec<f64>) -> Option<f64> {
    quantile(&mut values, 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quantile_is_one_of_the_values() {
        assert_eq!(median(vec![3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(vec![3.0, 1.0]), Some(3.0), "of two in the middle the larger one");
        assert_eq!(quantile(&mut [3.0, 1.0], 1.0), Some(3.0));
        assert_eq!(quantile(&mut [5.0, 1.0, 4.0, 2.0, 3.0], 0.25), Some(2.0));
        assert_eq!(median(Vec::new()), None);
        assert_eq!((at_rank(&mut [5, 1, 4], 2, i32::cmp), at_rank(&mut [5, 1, 4], 3, i32::cmp)), (Some(5), None));
    }
}
