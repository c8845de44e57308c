//! The axes of a plot: round numbers as labels, and positions of numbers on the paper.

/// One axis: numbers from `least` to `most`, drawn from `start` to `end` on the paper.
#[derive(Clone, Debug)]
pub struct Axis {
    least: f64,
    most: f64,
    start: f64,
    end: f64,
    logarithmic: bool,
}

impl Axis {
    /// Creates an axis for all `numbers`, from `start` to `end` on the paper; `None` if there are none.
    pub fn holding(numbers: impl Iterator<Item = f64>, [start, end]: [f64; 2], logarithmic: bool) -> Option<Self> {
        let scale = |number: f64| if logarithmic { number.log10() } else { number };
        let numbers = numbers.map(scale).filter(|number| number.is_finite());
        let (least, most) = numbers.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), n| (a.min(n), b.max(n)));
        let margin = if most > least { 0.05 * (most - least) } else { 0.1 * most.abs().max(0.1) };
        (least <= most).then_some(Self { least: least - margin, most: most + margin, start, end, logarithmic })
    }

    /// Returns the position of a number on the paper; `None` if it has no logarithm on a logarithmic axis.
    pub fn place(&self, number: f64) -> Option<f64> {
        let number = if self.logarithmic { number.log10() } else { number };
        let share = (number - self.least) / (self.most - self.least);
        share.is_finite().then_some(self.start + share * (self.end - self.start))
    }

    /// Returns about six round numbers along the axis, with their labels.
    pub fn ticks(&self) -> Vec<(f64, String)> {
        let raw = (self.most - self.least) / 6.0;
        let power = 10_f64.powf(raw.log10().floor());
        let factors = [1.0, 2.0, 5.0, 10.0];
        let step = power * factors.into_iter().find(|factor| raw <= factor * power).unwrap_or(10.0);
        let step = if self.logarithmic { step.max(1.0) } else { step };
        let decimals = (-step.log10().floor()).max(0.0) as usize;
        let (first, last) = ((self.least / step).ceil() as i64, (self.most / step).floor() as i64);
        let label = |number: f64| match self.logarithmic {
            true => format!("{}", 10_f64.powf(number)),
            false => format!("{number:.decimals$}"),
        };
        let ticks = (first..=last).map(|index| index as f64 * step);
        ticks.map(|number| (if self.logarithmic { 10_f64.powf(number) } else { number }, label(number))).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ticks_are_round_and_within() {
        let axis = Axis::holding([0.11, 0.2].into_iter(), [0.0, 100.0], false).unwrap();
        let labels: Vec<_> = axis.ticks().into_iter().map(|(_, label)| label).collect();
        assert_eq!(labels, ["0.12", "0.14", "0.16", "0.18", "0.20"]);
        assert!((axis.place(0.155).unwrap() - 50.0).abs() < 1e-9);
    }

    #[test]
    fn a_logarithmic_axis_is_labelled_at_powers_of_ten() {
        let axis = Axis::holding([0.5, 2000.0].into_iter(), [0.0, 1.0], true).unwrap();
        assert_eq!(
            axis.ticks().iter().map(|(_, label)| label.as_str()).collect::<Vec<_>>(),
            ["1", "10", "100", "1000"]
        );
        assert_eq!(axis.place(0.0), None);
    }

    #[test]
    fn one_number_has_room_around_it_and_none_no_axis() {
        assert!(Axis::holding([3.0].into_iter(), [0.0, 1.0], false).unwrap().ticks().len() > 2);
        assert!(Axis::holding(std::iter::empty(), [0.0, 1.0], false).is_none());
    }
}
