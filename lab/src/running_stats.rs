//! Mean and standard deviation of numbers that are added one by one.
//!
//! B. P. Welford, "Note on a method for calculating corrected sums of squares and products", Technometrics 4, 1962.

/// Running sums.
#[derive(Clone, Copy, Debug, Default)]
pub struct RunningStats {
    count: u64,
    mean: f64,
    squares: f64,
}

impl RunningStats {
    /// Adds a number.
    pub fn add(&mut self, number: f64) {
        self.count += 1;
        let offset = number - self.mean;
        self.mean += offset / self.count as f64;
        self.squares += offset * (number - self.mean);
    }

    /// Number of numbers added.
    pub fn count(&self) -> u64 {
        self.count
    }

    /// Mean; NaN if there are none.
    pub fn mean(&self) -> f64 {
        if self.count == 0 { f64::NAN } else { self.mean }
    }

    /// Variance with n - 1; NaN for fewer than two numbers.
    pub fn variance(&self) -> f64 {
        if self.count < 2 { f64::NAN } else { self.squares / (self.count - 1) as f64 }
    }

    /// Standard deviation.
    pub fn deviation(&self) -> f64 {
        self.variance().sqrt()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn mean_and_deviation_are_those_of_the_formulas() {
        let mut spread = RunningStats::default();
        assert!(spread.mean().is_nan() && spread.deviation().is_nan());
        [2.0, 4.0, 4.0, 6.0].iter().for_each(|number| spread.add(*number));
        assert_eq!((spread.count(), spread.mean()), (4, 4.0));
        assert!((spread.deviation() - (8.0_f64 / 3.0).sqrt()).abs() < 1e-15);
    }
}
