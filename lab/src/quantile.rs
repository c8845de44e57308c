//! Quantiles: the one place that defines their position among the values.

use std::cmp::Ordering;

/// Returns the value at position `rank` of the sorted values; `None` if there are not so many. Reorders the values.
pub fn at_rank<T: Copy>(values: &mut [T], rank: usize, compare: impl FnMut(&T, &T) -> Ordering) -> Option<T> {
    if rank >= values.len() {
        return None;
    }
    Some(*values.select_nth_unstable_by(rank, compare).1)
}

/// Returns the value below which a share (0 to 1) of the values lies, with linear interpolation between two values; `None` if
/// there are none. Reorders the values.
pub fn quantile(values: &mut [f64], share: f64) -> Option<f64> {
    let place = values.len().saturating_sub(1) as f64 * share;
    let lower = at_rank(values, place.floor() as usize, f64::total_cmp)?;
    let upper = at_rank(values, place.ceil() as usize, f64::total_cmp)?;
    // the difference of infinities is NaN
    Some(if lower == upper { lower } else { lower + (upper - lower) * place.fract() })
}

/// Returns the median; of an even number of values, the mean of the two in the middle.
pub fn median(mut values: Vec<f64>) -> Option<f64> {
    quantile(&mut values, 0.5)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_quantile_is_one_of_the_values_or_between_two() {
        assert_eq!(median(vec![3.0, 1.0, 2.0]), Some(2.0));
        assert_eq!(median(vec![3.0, 1.0]), Some(2.0));
        assert_eq!(median(vec![9.0, 1.0, 2.0, 5.0]), Some(3.5));
        assert_eq!(median(vec![f64::INFINITY; 2]), Some(f64::INFINITY));
        assert_eq!(quantile(&mut [5.0, 1.0], 0.25), Some(2.0));
        assert_eq!(quantile(&mut [3.0, 1.0], 1.0), Some(3.0));
        assert_eq!(quantile(&mut [5.0, 1.0, 4.0, 2.0, 3.0], 0.25), Some(2.0));
        assert_eq!(median(Vec::new()), None);
        assert_eq!((at_rank(&mut [5, 1, 4], 2, i32::cmp), at_rank(&mut [5, 1, 4], 3, i32::cmp)), (Some(5), None));
    }
}
