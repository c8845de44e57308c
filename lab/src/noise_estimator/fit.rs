//! Fits the noise model to variances over depth.
//!
//! `variance(z) = (floor + growth (z - knee)^2)^2 + (step z^2)^2 / 12`. The step is known, so that the rest of the standard
//! deviation is linear in floor and growth for each knee; the knee is searched on a grid. Errors are relative to the deviation,
//! and no coefficient is negative.

use crate::quantile::median;
use crate::random::CounterRng;
use anyhow::{Result, bail};
use conicflow_messages::{Hinted, NoiseModel};
use std::fmt;

/// Ratio of the depths at which a bin ends and begins.
const BIN_RATIO: f64 = 1.05;
/// Depth at which the first bin begins, in metres; smaller depths are left out.
const NEAREST_M: f64 = 0.05;
/// Number of bins.
const BINS: usize = 120; // up to 17 m
/// Least number of variances in a bin.
const FEWEST: usize = 20;
/// Largest number of variances kept in a bin, far more than its full weight needs.
const MOST: usize = 1 << 14;
/// Variances above this multiple of the median are edges, not noise.
const OUTLIER: f64 = 9.0;
/// Ratio of standard deviations from which a bin does not fit a bin with more samples, or the model.
const MISFIT: f64 = 2.5;
/// Largest power of the depth with which noise grows; it never shrinks.
const STEEPEST: i32 = 3;
/// Largest weight of a bin in the fit.
const LARGEST_WEIGHT: f64 = 1000.0;
/// Least ratio of the farthest to the nearest depth for which a growth is estimated.
const LEAST_SPAN: f64 = 1.3;
/// Distance of the knees that are tried in the fit, in metres.
const KNEE_STEP_M: f64 = 0.02;

/// Variances, binned by depth.
#[derive(Clone, Debug, Default)]
pub struct Spreads {
    bins: Vec<Bin>,
}

/// A uniform sample of the variances at about one depth, the same in each run: each variance is kept with the same probability,
/// however long the recording is (algorithm R in J. S. Vitter, "Random sampling with a reservoir", ACM Transactions on
/// Mathematical Software 11, 1985).
#[derive(Clone, Debug, Default)]
struct Bin {
    /// Number of variances added.
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
        let place = CounterRng::new(0, 0).uniform(self.added) * self.added as f64;
        if let Some(kept) = self.kept.get_mut(place as usize) {
            *kept = sample;
        }
    }
}

impl Spreads {
    /// Adds a variance (square metres) at a depth (metres).
    pub fn add(&mut self, depth: f64, variance: f64) {
        self.bins.resize(BINS, Bin::default());
        let number = (depth / NEAREST_M).ln() / BIN_RATIO.ln();
        if let Some(bin) = (number >= 0.0).then(|| self.bins.get_mut(number as usize)).flatten() {
            bin.add((depth, variance));
        }
    }

    /// Returns the noise of the bins with enough samples; `None` if no bin has enough.
    fn summary(&self) -> Option<Vec<Spread>> {
        let samples = self.bins.iter().map(|bin| bin.kept.as_slice());
        let mut enough = samples.filter(|samples| samples.len() >= FEWEST).peekable();
        enough.peek()?;
        Some(enough.filter_map(Spread::of).collect())
    }
}

/// The noise at a depth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spread {
    /// Mean depth, in metres.
    pub depth: f64,
    /// Mean variance, in square metres.
    pub variance: f64,
    /// Number of its variances.
    pub count: usize,
    /// Whether the model explains it.
    pub fits: bool,
}

impl Spread {
    /// Computes the noise of a bin without edges, which vary far more. `None` if all samples are above the limit.
    fn of(samples: &[(f64, f64)]) -> Option<Self> {
        let median = median(samples.iter().map(|(_, variance)| *variance).collect())?;
        let limit = if median > 0.0 { OUTLIER * median } else { f64::INFINITY };
        let noise: Vec<_> = samples.iter().filter(|(_, variance)| *variance <= limit).collect();
        let count = noise.len() as f64;
        let depth = noise.iter().map(|(depth, _)| depth).sum::<f64>() / count;
        let variance = noise.iter().map(|(_, variance)| variance).sum::<f64>() / count;
        (variance > 0.0).then_some(Self { depth, variance, count: noise.len(), fits: true })
    }

    fn weight(&self) -> f64 {
        (self.count as f64).min(LARGEST_WEIGHT)
    }

    /// Whether this is far noisier than a spread with more samples allows at this depth: edges, or something that moved.
    fn exceeds(&self, known: &Self) -> bool {
        let growth = (self.depth / known.depth).powi(STEEPEST).max(1.0);
        known.count >= self.count && self.variance.sqrt() > MISFIT * growth * known.variance.sqrt()
    }

    fn is_explained_by(&self, model: &NoiseModel) -> bool {
        let ratio = self.variance.sqrt() / model.sigma(self.depth);
        (1.0 / MISFIT..=MISFIT).contains(&ratio)
    }
}

/// A noise model and the noise to which it was fitted.
#[derive(Clone, Debug, PartialEq)]
pub struct NoiseEstimate {
    /// The model.
    pub model: NoiseModel,
    /// The measured noise, from near to far.
    pub seen: Vec<Spread>,
    /// Whether the range of depths is large enough for the growth of the noise.
    pub grows: bool,
}

/// Fits a model with a known disparity step. Leaves out depths that are far noisier than depths with more samples allow.
///
/// # Errors
/// There are too few variances, or most of them do not fit.
pub fn fit(spreads: &Spreads, step_per_m: f64) -> Result<NoiseEstimate> {
    let Some(all) = spreads.summary() else {
        bail!(Hinted::new(
            "too little was measured to tell the noise",
            "a static scene has to be measured in most of the frames, a flat wall has to fill a good part of the image"
        ));
    };
    let (mut seen, kept) = without_outliers(all);
    let (Some(nearest), Some(farthest)) = (kept.first(), kept.last()) else {
        return Ok(NoiseEstimate { model: NoiseModel::IDEAL, seen, grows: false });
    };
    let grows = farthest.depth > LEAST_SPAN * nearest.depth;
    let farthest_knee = if grows { farthest.depth } else { 0.0 };
    let knees = (0..).map(|number| f64::from(number) * KNEE_STEP_M).take_while(|knee| *knee <= farthest_knee);
    let fits = knees.map(|knee| fit_with_knee(&kept, step_per_m, knee, grows));
    let best = fits.min_by(|a, b| a.1.total_cmp(&b.1));
    let model = best.map_or(NoiseModel::IDEAL, |(model, _)| model);
    seen.iter_mut().for_each(|spread| spread.fits &= spread.is_explained_by(&model));
    let estimate = NoiseEstimate { model, seen, grows };
    estimate.check()?;
    Ok(estimate)
}

/// Returns all spreads, marked whether others rule them out, and those that are left.
fn without_outliers(all: Vec<Spread>) -> (Vec<Spread>, Vec<Spread>) {
    let judged = |spread: &Spread| Spread { fits: !all.iter().any(|known| spread.exceeds(known)), ..*spread };
    let seen: Vec<Spread> = all.iter().map(judged).collect();
    let kept = seen.iter().filter(|spread| spread.fits).copied().collect();
    (seen, kept)
}

impl NoiseEstimate {
    /// Returns a fault, with a hint, if the model does not explain some depths.
    pub fn misfit(&self) -> Option<Hinted> {
        let misfits = self.seen.iter().filter(|spread| !spread.fits).count();
        (misfits > 0).then(|| {
            let depths = self.seen.len();
            Hinted::new(
                format!("{misfits} of {depths} depths do not fit the coefficients: did something move?"),
                "pixels at edges do so as well and do no harm while few; else record a scene in which nothing moves, the \
                 camera neither",
            )
        })
    }

    /// Refuses coefficients that most of the samples do not fit. Samples count, not depths: edges occur at many depths, with few
    /// samples each.
    fn check(&self) -> Result<()> {
        let count = |fits: bool| self.seen.iter().filter(|spread| spread.fits == fits).map(|spread| spread.count).sum();
        let (good, bad): (usize, usize) = (count(true), count(false));
        match self.misfit().filter(|_| bad > good) {
            Some(Hinted { what, hint, .. }) => {
                bail!(Hinted::new(format!("no coefficients explain most of what was measured: {what}"), hint))
            }
            None => Ok(()),
        }
    }

    /// Returns the model of a stereo camera, whose noise grows with the squared depth, from noise at about one depth.
    fn of_stereo(&self) -> NoiseModel {
        let fitting = || self.seen.iter().filter(|spread| spread.fits);
        let weights: f64 = fitting().map(Spread::weight).sum();
        let depth = fitting().map(|spread| spread.weight() * spread.depth).sum::<f64>() / weights;
        let NoiseModel { floor_m, step_per_m, .. } = self.model;
        NoiseModel { floor_m: 0.0, growth_per_m: floor_m / (depth * depth), knee_m: 0.0, step_per_m }
    }
}

/// Returns the best model with this knee, and its cost.
fn fit_with_knee(seen: &[Spread], step_per_m: f64, knee_m: f64, grows: bool) -> (NoiseModel, f64) {
    let (mut ff, mut fg, mut gg, mut f1, mut g1) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for spread in seen {
        let weight = spread.weight();
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
        spread.weight() * relative * relative
    };
    (model, seen.iter().map(cost).sum())
}

/// Returns the standard deviation without the steps, at least a tenth of the whole.
fn axial_sigma(spread: &Spread, step_per_m: f64) -> f64 {
    let step = step_per_m * spread.depth * spread.depth;
    (spread.variance - step * step / 12.0).max(0.01 * spread.variance).sqrt()
}

/// Writes a table as comments, and the line for the pipeline file.
impl fmt::Display for NoiseEstimate {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.seen.is_empty() {
            return writeln!(f, "# there is no noise to be seen\nnoise = \"ideal\"");
        }
        writeln!(f, "# depth m    seen mm   model mm    samples")?;
        for spread in &self.seen {
            let (seen, model) = (1e3 * spread.variance.sqrt(), 1e3 * self.model.sigma(spread.depth));
            let note = if spread.fits { "" } else { "  does not fit" };
            writeln!(f, "# {:7.2} {seen:10.2} {model:10.2} {:10}{note}", spread.depth, spread.count)?;
        }
        if !self.grows {
            writeln!(
                f,
                "# the depths are too much alike to tell how the noise grows: this holds for them only\n\
                 # hint: record a second distance, 1.5 times as far; or, for a stereo camera or a Kinect, whose noise \
                 grows with the squared depth, write\n# {}",
                line(&self.of_stereo())
            )?;
        }
        writeln!(f, "{}", line(&self.model))
    }
}

/// Formats a model as in a pipeline file.
fn line(model: &NoiseModel) -> String {
    let NoiseModel { floor_m, growth_per_m, knee_m, step_per_m } = model;
    format!(
        "noise = {{ floor_m = {floor_m:.6}, growth_per_m = {growth_per_m:.6}, knee_m = {knee_m:.2}, step_per_m = \
         {step_per_m:.6} }}"
    )
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The noise grows throughout a long recording, so that a sample of its beginning or end would have another mean.
    #[test]
    fn a_long_recording_takes_no_more_room_and_is_sampled_fairly() {
        let long = || {
            let mut spreads = Spreads::default();
            (0..20 * MOST).for_each(|number| spreads.add(2.0, 1e-6 * (1.0 + number as f64 / (20 * MOST) as f64)));
            spreads
        };
        let [first, again] = [long(), long()].map(|spreads| spreads.summary().unwrap());
        assert_eq!((first.len(), first[0].count), (1, MOST));
        assert!((first[0].variance / 1.5e-6 - 1.0).abs() < 0.01, "{:.3e}", first[0].variance);
        assert_eq!(first, again);
    }

    /// Adds `count` variances of a deviation in millimetres.
    fn add(spreads: &mut Spreads, depth: f64, sigma_mm: f64, count: usize) {
        (0..count).for_each(|_| spreads.add(depth, (1e-3 * sigma_mm).powi(2)));
    }

    /// Surfaces seen by a time-of-flight camera at 1, 1.5 and 3 m.
    fn surfaces() -> Spreads {
        let mut spreads = Spreads::default();
        [(1.0, 1.0), (1.5, 1.3), (3.0, 3.0)].iter().for_each(|&(depth, sigma)| add(&mut spreads, depth, sigma, 3000));
        spreads
    }

    #[test]
    fn pixels_between_two_surfaces_do_not_pull_the_model() {
        let clean = fit(&surfaces(), 0.0).unwrap();
        assert_eq!(clean.misfit(), None);
        let mut spreads = surfaces();
        (0..10).for_each(|number| add(&mut spreads, 1.7 + 0.12 * f64::from(number), 36.0, 150));
        add(&mut spreads, 3.6, 60.0, 100);
        let flying = fit(&spreads, 0.0).unwrap();
        assert_eq!(flying.model, clean.model, "{flying}");
        assert!(flying.misfit().unwrap().what.starts_with("11 of 14 depths do not fit the coefficients"), "{flying}");
        assert_eq!(flying.to_string().matches("does not fit").count(), 11);
    }

    #[test]
    fn a_recording_of_much_that_moved_is_refused() {
        let mut spreads = surfaces();
        (0..10).for_each(|number| add(&mut spreads, 1.7 + 0.12 * f64::from(number), 400.0, 2000));
        let error = fit(&spreads, 0.0).unwrap_err().to_string();
        assert!(error.contains("10 of 13 depths do not fit") && error.contains("\n  hint: "), "{error}");
    }

    #[test]
    fn no_noise_is_no_lack_of_measurements() {
        let mut spreads = Spreads::default();
        add(&mut spreads, 2.0, 0.0, 500);
        let estimate = fit(&spreads, 0.0).unwrap();
        assert_eq!(estimate.model, NoiseModel::IDEAL);
        assert_eq!(estimate.to_string(), "# there is no noise to be seen\nnoise = \"ideal\"\n");
        assert!(fit(&Spreads::default(), 0.0).unwrap_err().to_string().starts_with("too little was measured"));
    }

    #[test]
    fn one_distance_gives_the_line_of_a_stereo_camera_too() {
        let mut spreads = Spreads::default();
        add(&mut spreads, 2.0, 8.0, 500);
        let text = fit(&spreads, 0.0).unwrap().to_string();
        assert!(text.contains("\n# noise = { floor_m = 0.000000, growth_per_m = 0.002000, knee_m = 0.00,"), "{text}");
        assert!(text.contains("record a second distance"), "{text}");
    }
}
