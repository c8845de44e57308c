//! Estimates the disparity step from the depths that occur: if a sensor's disparity has steps, the inverse depths of neighbouring
//! levels are one step apart.

use crate::quantile::median;
use conicflow_messages::is_measured;

/// Least number of gaps between levels for an estimate.
const FEWEST: usize = 8;
/// Widest gap in use, in steps: in wider ones levels are missing.
const WIDEST: f64 = 4.5;
/// Largest mean distance of gaps from whole steps, in steps; for random gaps it would be 0.25.
const LARGEST_FRACTION: f64 = 0.12;

/// The depths that occurred.
#[derive(Clone, Debug, Default)]
pub struct Levels {
    /// One for each scale of the images, as rounding to other units separates levels differently.
    scales: Vec<Scale>,
}

#[derive(Clone, Debug)]
struct Scale {
    /// Metres per unit.
    depth_scale: f64,
    /// Whether each number of units occurred.
    occurred: Vec<bool>,
}

/// The gap between two depths that occur.
#[derive(Clone, Copy)]
struct Gap {
    /// Difference of the inverse depths, in 1/metre.
    inverse: f64,
    /// Units of the depth image for a step of 1/metre at this depth.
    units_per_step: f64,
}

impl Levels {
    /// Notes the depths of an image of `depth_scale` metres per unit.
    pub fn add(&mut self, pixels: &[u16], depth_scale: f64) {
        let known = self.scales.iter().position(|scale| scale.depth_scale == depth_scale);
        let index = known.unwrap_or_else(|| {
            self.scales.push(Scale { depth_scale, occurred: vec![false; 1 << 16] });
            self.scales.len() - 1
        });
        let occurred = &mut self.scales[index].occurred;
        pixels.iter().filter(|pixel| is_measured(**pixel)).for_each(|&pixel| occurred[usize::from(pixel)] = true);
    }

    /// Returns the depth between two neighbouring levels divided by the squared depth, in 1/metre; 0 if there are no clear steps.
    pub fn step_per_m(&self) -> f64 {
        let gaps: Vec<(usize, Gap)> = self.scales.iter().flat_map(Scale::gaps).collect();
        let wide: Vec<f64> = gaps.iter().filter(|(units, _)| *units >= 3).map(|(_, gap)| gap.inverse).collect();
        let Some(first_guess) = Some(wide).filter(|wide| wide.len() >= FEWEST).and_then(median) else { return 0.0 };
        let gaps: Vec<Gap> = gaps.into_iter().map(|(_, gap)| gap).collect();
        refined(&gaps, refined(&gaps, first_guess).unwrap_or(first_guess)).unwrap_or(0.0)
    }
}

impl Scale {
    /// Returns the gaps between occurring depths, with their widths in units.
    fn gaps(&self) -> Vec<(usize, Gap)> {
        let occurring: Vec<usize> = (1..self.occurred.len()).filter(|&depth| self.occurred[depth]).collect();
        let gap = |pair: &[usize]| {
            let [near, far] = [pair[0], pair[1]].map(|units| units as f64 * self.depth_scale);
            let gap = Gap { inverse: 1.0 / near - 1.0 / far, units_per_step: near * far / self.depth_scale };
            (pair[1] - pair[0], gap)
        };
        occurring.windows(2).map(gap).collect()
    }
}

/// Returns the step of which the gaps are whole multiples, from gaps where the units of the image are fine enough; `None` if
/// there is none.
fn refined(gaps: &[Gap], step: f64) -> Option<f64> {
    let (mut sum, mut steps, mut fraction, mut count) = (0.0, 0.0, 0.0, 0_usize);
    for gap in gaps.iter().filter(|gap| gap.units_per_step * step >= 4.0 && gap.inverse < WIDEST * step) {
        let ratio = gap.inverse / step;
        let whole = ratio.round().max(1.0);
        (sum, steps) = (sum + gap.inverse, steps + whole);
        fraction += (ratio - whole).abs();
        count += 1;
    }
    let is_known = count >= FEWEST && fraction < LARGEST_FRACTION * count as f64;
    is_known.then(|| sum / steps)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All levels of a stepped disparity between two depths, in units of `scale` metres.
    fn stepped(step: f64, scale: f64, from: f64, to: f64) -> Vec<u16> {
        let numbers = (1.0 / (to * step)) as u32..(1.0 / (from * step)) as u32;
        numbers.map(|number| (1.0 / (f64::from(number) * step) / scale).round() as u16).collect()
    }

    #[test]
    fn the_step_is_found_in_millimetres_and_in_tenths() {
        for (scale, from, to) in [(0.001, 0.8, 4.0), (0.001, 1.8, 2.2), (0.0001, 0.8, 1.2)] {
            let mut levels = Levels::default();
            levels.add(&stepped(0.002874, scale, from, to), scale);
            let step = levels.step_per_m();
            assert!((step / 0.002874 - 1.0).abs() < 0.01, "{from} to {to} m: {step}");
        }
    }

    #[test]
    fn levels_that_are_missing_do_no_harm() {
        let mut levels = Levels::default();
        let all = stepped(0.002874, 0.001, 1.0, 3.0);
        let some: Vec<u16> =
            all.iter().enumerate().filter(|(index, _)| index % 5 != 0).map(|(_, &depth)| depth).collect();
        levels.add(&some, 0.001);
        assert!((levels.step_per_m() / 0.002874 - 1.0).abs() < 0.02);
    }

    #[test]
    fn scales_may_differ_from_image_to_image() {
        let mut levels = Levels::default();
        for scale in [0.0001, 0.00025, 0.0001] {
            levels.add(&stepped(0.002874, scale, 0.8, 4.0), scale);
        }
        assert_eq!(levels.scales.len(), 2);
        assert!((levels.step_per_m() / 0.002874 - 1.0).abs() < 0.01, "{}", levels.step_per_m());
    }

    #[test]
    fn a_sensor_without_steps_has_none() {
        let mut levels = Levels::default();
        assert_eq!(levels.step_per_m(), 0.0);
        levels.add(&(800..4000).collect::<Vec<u16>>(), 0.001);
        assert_eq!(levels.step_per_m(), 0.0);
        let mut sparse = Levels::default();
        sparse.add(&(0..60_u16).map(|i| 1000 + 7 * i + (i * i * 13) % 23).collect::<Vec<u16>>(), 0.001);
        assert_eq!(sparse.step_per_m(), 0.0, "gaps by chance are no steps");
    }
}
