//! Least squares of `y = a + b x` with running sums, and their standard errors.

/// Running sums over pairs: one more pair is O(1).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Regression {
    count: f64,
    mean_x: f64,
    mean_y: f64,
    xx: f64,
    xy: f64,
    yy: f64,
}

/// A straight line `y = value + slope (x - middle)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Fit {
    /// Mean of x, where `value` is known best.
    pub middle: f64,
    /// Value of y at `middle`.
    pub value: f64,
    /// Change of y with x.
    pub slope: f64,
    /// Root mean square residual, with two degrees of freedom taken off.
    pub rms: f64,
    /// Standard error of `value`.
    pub value_sigma: f64,
    /// Standard error of `slope`.
    pub slope_sigma: f64,
}

impl Fit {
    /// Value of y at `x`.
    pub fn at(&self, x: f64) -> f64 {
        self.value + self.slope * (x - self.middle)
    }

    /// Standard deviation of the y of a further pair at `x`, from the fit and from the pair's own scatter.
    pub fn prediction_sigma(&self, x: f64) -> f64 {
        let slope_part = self.slope_sigma * (x - self.middle);
        (self.rms * self.rms + self.value_sigma * self.value_sigma + slope_part * slope_part).sqrt()
    }
}

impl Regression {
    /// Adds a pair (Welford's update of means and central sums, which does not cancel).
    pub fn add(&mut self, x: f64, y: f64) {
        self.count += 1.0;
        let (dx, dy) = (x - self.mean_x, y - self.mean_y);
        self.mean_x += dx / self.count;
        self.mean_y += dy / self.count;
        self.xx += dx * (x - self.mean_x);
        self.xy += dx * (y - self.mean_y);
        self.yy += dy * (y - self.mean_y);
    }

    /// Number of pairs.
    pub fn count(&self) -> f64 {
        self.count
    }

    /// Standard deviation of x about its mean, 0 where there are no pairs.
    pub fn spread(&self) -> f64 {
        if self.count > 0.0 { (self.xx / self.count).max(0.0).sqrt() } else { 0.0 }
    }

    /// Mean of y.
    pub fn mean(&self) -> f64 {
        self.mean_y
    }

    /// Standard deviation of y about its mean.
    pub fn deviation(&self) -> f64 {
        if self.count > 1.0 { (self.yy / (self.count - 1.0)).max(0.0).sqrt() } else { 0.0 }
    }

    /// Returns the line of least squares; `None` for fewer than three pairs or where all x are the same.
    pub fn fit(&self) -> Option<Fit> {
        if self.count < 3.0 || self.xx.is_nan() || self.xx <= 0.0 {
            return None;
        }
        let slope = self.xy / self.xx;
        let rms = ((self.yy - slope * self.xy).max(0.0) / (self.count - 2.0)).sqrt();
        let (value_sigma, slope_sigma) = (rms / self.count.sqrt(), rms / self.xx.sqrt());
        Some(Fit { middle: self.mean_x, value: self.mean_y, slope, rms, value_sigma, slope_sigma })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_line_is_found_far_from_zero() {
        let mut sums = Regression::default();
        for i in 0..50 {
            let x = 1e6 + f64::from(i) * 0.1;
            sums.add(x, 3.0 - 0.25 * (x - 1e6) + if i % 2 == 0 { 0.01 } else { -0.01 });
        }
        let fit = sums.fit().unwrap();
        assert!((fit.slope + 0.25).abs() < 1e-3 && (fit.at(1e6) - 3.0).abs() < 5e-3);
        assert!((fit.rms - 0.01).abs() < 5e-4);
        assert!((fit.value_sigma - 0.01 / 50.0_f64.sqrt()).abs() < 1e-4);
        assert!(fit.slope_sigma > 5e-4 && fit.slope_sigma < 2e-3);
    }

    #[test]
    fn what_comes_next_is_known_the_worse_the_farther_it_is_from_the_pairs() {
        let fit = Fit { middle: 2.0, value: 1.0, slope: 0.5, rms: 0.4, value_sigma: 0.3, slope_sigma: 0.6 };
        assert!((fit.prediction_sigma(2.0) - 0.5).abs() < 1e-12);
        assert!([0.0, 4.0].iter().all(|x| (fit.prediction_sigma(*x) - 1.3).abs() < 1e-12));
    }

    #[test]
    fn pairs_without_extent_have_no_line() {
        let mut sums = Regression::default();
        assert_eq!(sums.fit(), None);
        for _ in 0..9 {
            sums.add(2.0, 3.0);
        }
        assert_eq!(sums.fit(), None);
        assert_eq!((sums.count(), sums.mean(), sums.deviation()), (9.0, 3.0, 0.0));
    }

    #[test]
    fn three_pairs_have_one_degree_of_freedom_left_for_their_scatter() {
        let mut sums = Regression::default();
        for (x, y) in [(10.0, 0.0), (11.0, 1.0)] {
            sums.add(x, y);
            assert_eq!(sums.fit(), None);
        }
        sums.add(12.0, 0.0);
        let fit = sums.fit().unwrap();
        // The residuals are -1/3, 2/3, -1/3, and the outer x are 1 off their mean.
        let rms = (6.0_f64 / 9.0).sqrt();
        let expected = [11.0, 1.0 / 3.0, 0.0, rms, rms / 3.0_f64.sqrt(), rms / 2.0_f64.sqrt()];
        let found = [fit.middle, fit.value, fit.slope, fit.rms, fit.value_sigma, fit.slope_sigma];
        assert!(found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{fit:?}");
    }

    #[test]
    fn the_spread_of_x_is_that_of_these_and_the_deviation_of_y_that_of_all_they_are_drawn_from() {
        let mut sums = Regression::default();
        assert_eq!((sums.spread(), sums.deviation()), (0.0, 0.0));
        sums.add(7.0, -3.0);
        assert_eq!((sums.spread(), sums.deviation()), (0.0, 0.0));
        sums.add(1.0, 5.0);
        assert!((sums.deviation() - 32.0_f64.sqrt()).abs() < 1e-12, "4 off the mean, twice, and one of two is free");
        sums.add(4.0, 7.0);
        assert!((sums.spread() - 6.0_f64.sqrt()).abs() < 1e-12, "3, 3 and 0 off the mean");
        assert!(
            (sums.deviation() - 28.0_f64.sqrt()).abs() < 1e-12,
            "6, 2 and 4 off the mean, and two of three are free"
        );
    }
}
