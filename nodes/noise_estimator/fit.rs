//! The noise model that explains variances over depth.
//!
//! `variance(z) = (floor + growth (z - knee)^2)^2 + (step z^2)^2 / 12`. The step is known, so that what is left of the
//! standard deviation is linear in floor and growth for each knee; the knee is searched on a grid. Errors count relative
//! to the deviation, and no coefficient is negative.

use crate::random::Dice;
use anyhow::{Result, bail};
use conicflow_messages::NoiseModel;
use std::fmt;

/// Ratio of the depths at which a bin ends and begins.
const BIN_RATIO: f64 = 1.05;
const NEAREST_M: f64 = 0.05;
const BINS: usize = 120; // up to 17 m
/// Fewest variances of a bin.
const FEWEST: usize = 20;
/// Most that it keeps, far more than it takes for its full weight.
const MOST: usize = 1 << 14;
/// Variances above so many medians are edges, not noise.
const OUTLIER: f64 = 9.0;
/// Least ratio of the farthest to the nearest depth from which a growth can be told.
const LEAST_SPAN: f64 = 1.3;
const KNEE_STEP_M: f64 = 0.02;

/// Variances, by the depth at which they were seen.
#[derive(Clone, Debug, Default)]
pub struct Spreads {
    bins: Vec<Bin>,
}

/// A fair sample of the variances at about one depth, the same in each run: any that was added is kept with the same
/// probability, however long the recording is (algorithm R in J. S. Vitter, "Random sampling with a reservoir", ACM
/// Transactions on Mathematical Software 11, 1985).
#[derive(Clone, Debug, Default)]
struct Bin {
    /// How many were added.
    added: u64,
    /// Depth and variance.
    kept: Vec<(f64, f64)>,
}

impl Bin {
    fn add(&mut self, sample: (f64, f64)) {
        self.added += 1;
        if self.kept.len() < MOST {
            self.kept.push(sample);
            return;
        }
        let place = Dice::new(0, 0).uniform(self.added) * self.added as f64;
        if let Some(kept) = self.kept.get_mut(place as usize) {
            *kept = sample;
        }
    }
}

impl Spreads {
    /// Adds a variance (square metres) that was seen at a depth (metres).
    pub fn add(&mut self, depth: f64, variance: f64) {
        self.bins.resize(BINS, Bin::default());
        let number = (depth / NEAREST_M).ln() / BIN_RATIO.ln();
        if let Some(bin) = (number >= 0.0).then(|| self.bins.get_mut(number as usize)).flatten() {
            bin.add((depth, variance));
        }
    }

    fn summary(&self) -> Vec<Spread> {
        let samples = self.bins.iter().map(|bin| bin.kept.as_slice());
        samples.filter(|samples| samples.len() >= FEWEST).filter_map(Spread::of).collect()
    }
}

/// The noise at a depth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    /// Mean depth, in metres.
    pub depth: f64,
    /// Mean variance, in square metres.
    pub variance: f64,
    /// Number of variances that tell it.
    pub count: usize,
}

impl Spread {
    /// Edges, which vary far more than noise does, are left out. `None`: there is no noise at all.
    fn of(samples: &[(f64, f64)]) -> Option<Self> {
        let mut variances: Vec<f64> = samples.iter().map(|(_, variance)| *variance).collect();
        let middle = variances.len() / 2;
        let median = *variances.select_nth_unstable_by(middle, f64::total_cmp).1;
        let limit = if median > 0.0 { OUTLIER * median } else { f64::INFINITY };
        let noise: Vec<_> = samples.iter().filter(|(_, variance)| *variance <= limit).collect();
        let count = noise.len() as f64;
        let depth = noise.iter().map(|(depth, _)| depth).sum::<f64>() / count;
        let variance = noise.iter().map(|(_, variance)| variance).sum::<f64>() / count;
        (variance > 0.0).then_some(Self { depth, variance, count: noise.len() })
    }
}

/// A noise model and what it was fitted to.
#[derive(Clone, Debug, PartialEq)]
pub struct NoiseEstimate {
    /// The model.
    pub model: NoiseModel,
    /// The noise that was seen, from near to far.
    pub seen: Vec<Spread>,
    /// Whether the depths reach far enough to tell how the noise grows.
    pub grows: bool,
}

/// Fits a model with a known step of the disparity.
///
/// # Errors
/// There are too few variances.
pub fn fit(spreads: &Spreads, step_per_m: f64) -> Result<NoiseEstimate> {
    let seen = spreads.summary();
    let (Some(nearest), Some(farthest)) = (seen.first(), seen.last()) else {
        bail!(
            "too little was measured to tell the noise\n  hint: a static scene needs `min_frames` frames at least, a flat \
             wall has to fill a good part of the image"
        );
    };
    let grows = farthest.depth > LEAST_SPAN * nearest.depth;
    let farthest_knee = if grows { farthest.depth } else { 0.0 };
    let knees = (0..).map(|number| f64::from(number) * KNEE_STEP_M).take_while(|knee| *knee <= farthest_knee);
    let fits = knees.map(|knee| fit_with_knee(&seen, step_per_m, knee, grows));
    let best = fits.min_by(|a, b| a.1.total_cmp(&b.1));
    let model = best.map_or(NoiseModel::IDEAL, |(model, _)| model);
    Ok(NoiseEstimate { model, seen, grows })
}

/// The best model with a knee, and its cost.
fn fit_with_knee(seen: &[Spread], step_per_m: f64, knee_m: f64, grows: bool) -> (NoiseModel, f64) {
    let (mut ff, mut fg, mut gg, mut f1, mut g1) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for spread in seen {
        let weight = (spread.count as f64).min(1000.0);
        let axial = axial_sigma(spread, step_per_m);
        let (floor, growth) = (1.0 / axial, (spread.depth - knee_m).powi(2) / axial);
        ff += weight * floor * floor;
        fg += weight * floor * growth;
        gg += weight * growth * growth;
        f1 += weight * floor;
        g1 += weight * growth;
    }
    let determinant = ff * gg - fg * fg;
    let both = ((f1 * gg - g1 * fg) / determinant, (g1 * ff - f1 * fg) / determinant);
    let (floor_m, growth_per_m) = match both {
        (floor, growth) if grows && floor >= 0.0 && growth >= 0.0 => (floor, growth),
        (floor, _) if grows && floor < 0.0 => (0.0, g1 / gg),
        _ => (f1 / ff, 0.0),
    };
    let model = NoiseModel { floor_m, growth_per_m, knee_m, step_per_m };
    let cost = |spread: &Spread| {
        let relative = model.sigma(spread.depth) / spread.variance.sqrt() - 1.0;
        (spread.count as f64).min(1000.0) * relative * relative
    };
    (model, seen.iter().map(cost).sum())
}

/// What the steps leave of the standard deviation, at least a tenth of it.
fn axial_sigma(spread: &Spread, step_per_m: f64) -> f64 {
    let step = step_per_m * spread.depth * spread.depth;
    (spread.variance - step * step / 12.0).max(0.01 * spread.variance).sqrt()
}

/// A table as comments, and the line for the pipeline file.
impl fmt::Display for NoiseEstimate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "# depth m    seen mm   model mm    samples")?;
        for spread in &self.seen {
            let (seen, model) = (1e3 * spread.variance.sqrt(), 1e3 * self.model.sigma(spread.depth));
            writeln!(f, "# {:7.2} {seen:10.2} {model:10.2} {:10}", spread.depth, spread.count)?;
        }
        if !self.grows {
            writeln!(f, "# the depths are too much alike to tell how the noise grows: this holds for them only")?;
        }
        let NoiseModel { floor_m, growth_per_m, knee_m, step_per_m } = self.model;
        writeln!(
            f,
            "noise = {{ floor_m = {floor_m:.6}, growth_per_m = {growth_per_m:.6}, knee_m = {knee_m:.2}, step_per_m = \
             {step_per_m:.6} }}"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Noise that grows throughout a long recording: a sample of its beginning or its end alone would tell another mean.
    #[test]
    fn a_long_recording_takes_no_more_room_and_is_sampled_fairly() {
        let long = || {
            let mut spreads = Spreads::default();
            (0..20 * MOST).for_each(|number| spreads.add(2.0, 1e-6 * (1.0 + number as f64 / (20 * MOST) as f64)));
            spreads
        };
        let [first, again] = [long(), long()].map(|spreads| spreads.summary());
        assert_eq!((first.len(), first[0].count), (1, MOST));
        assert!((first[0].variance / 1.5e-6 - 1.0).abs() < 0.01, "{:.3e}", first[0].variance);
        assert_eq!(first, again);
    }
}
