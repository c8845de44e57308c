//! How many neighbouring pixels share their noise.
//!
//! A camera that compares windows of two images, or a driver that smooths, gives neighbours the same errors: the mean of n
//! pixels is then no better than that of n over so many. What parabolas leave of short stretches of smooth surfaces tells it
//! by its autocorrelation, of which all counts before it vanishes (Geyer, "Practical Markov chain Monte Carlo", 1992).

use super::view::View;
use conicflow_messages::is_measured;

/// Approximate number of lines that are sampled.
const LINES: u32 = 8; // [algorithmic]
/// Number of pixels of a stretch.
const STRETCH: usize = 32; // [algorithmic]
/// Largest distance in pixels at which a correlation is computed.
const FARTHEST: usize = 10; // [algorithmic]
/// Correlations up to this count as zero: chance makes them, and so do surfaces that are not quite smooth.
const CHANCE: f64 = 0.05; // [tuned]
/// A stretch with a larger mean square residual, in variances of a pixel, is not one smooth surface.
const SMOOTH: f64 = 2.0; // [sigmas]
/// Fewest stretches that give an estimate.
const FEWEST: usize = 24; // [algorithmic]
/// Upper bound of the part of the noise that the fitted parabola takes with it; it keeps the correction finite.
const MOST_TAKEN: f64 = 0.8; // [algorithmic]

/// A number for each pixel of a stretch.
type Stretch = [f64; STRETCH];

/// How many neighbouring pixels share their noise, at least 1, in an image that `view` shows by its rows.
pub(super) fn length_px(view: &View, image: &[u16]) -> f64 {
    let parabola = parabola();
    let [variance, next] = covariances(view, image, &parabola);
    if next <= CHANCE * variance {
        return 1.0;
    }
    let [variance, covariances @ ..]: [f64; FARTHEST + 1] = covariances(view, image, &parabola);
    let (sum, count) = covariances
        .iter()
        .map(|covariance| covariance / variance)
        .take_while(|correlation| *correlation > CHANCE)
        .fold((0.0, 0.0), |(sum, count), correlation| (sum + correlation, count + 1.0));
    // What is sought is s = 1 + 2 sum c, of the true correlations c. A parabola has three parameters and takes 3 s / n of each
    // covariance: those that are left are (c - 3 s / n) / (1 - 3 s / n). That solved for s:
    let taken = 6.0 * (count - sum) / STRETCH as f64;
    (1.0 + 2.0 * sum) / (1.0 - taken.min(MOST_TAKEN))
}

/// Sums over the stretches of the mean products of errors that are 0, 1, ... pixels apart; 0 all of too few stretches.
fn covariances<const N: usize>(view: &View, image: &[u16], parabola: &[Stretch; 3]) -> [f64; N] {
    let mut covariances = [0.0; N];
    let mut stretches = 0;
    for line in (0..view.lines).step_by((view.lines / LINES).max(1) as usize) {
        let depths = view.row(image, line).as_chunks().0.iter();
        for errors in depths.filter_map(|depths| errors(view, depths, parabola)) {
            stretches += 1;
            for (apart, covariance) in covariances.iter_mut().enumerate() {
                *covariance += product(&errors, &errors[apart..]) / (STRETCH - apart) as f64;
            }
        }
    }
    if stretches < FEWEST { [0.0; N] } else { covariances }
}

/// What a parabola leaves of a stretch, in standard deviations of a pixel, if that is one smooth surface: along a line of the
/// image a plane's inverse depth is linear.
fn errors(view: &View, depths: &[u16; STRETCH], parabola: &[Stretch; 3]) -> Option<Stretch> {
    if !depths.iter().all(|&depth| is_measured(depth)) {
        return None;
    }
    let nearness = depths.map(|depth| 1.0 / (f64::from(depth) * view.scale));
    let mean = nearness.iter().sum::<f64>() / STRETCH as f64;
    let sigma = view.variance(1.0 / mean).sqrt();
    let mut errors = nearness.map(|nearness| nearness / (mean * mean * sigma));
    parabola.iter().for_each(|part| take_out(part, &mut errors));
    (product(&errors, &errors) < SMOOTH * STRETCH as f64).then_some(errors)
}

/// The constant, the line and the parabola, of square sum one and none a part of another.
fn parabola() -> [Stretch; 3] {
    let place = |i: usize| 2.0 * i as f64 / (STRETCH - 1) as f64 - 1.0;
    let mut parts = [0, 1, 2].map(|power| std::array::from_fn(|i| place(i).powi(power)));
    for k in 0..parts.len() {
        let (lower, [part, ..]) = parts.split_at_mut(k) else { break };
        lower.iter().for_each(|other| take_out(other, part));
        let length = product(part, part).sqrt();
        part.iter_mut().for_each(|x| *x /= length);
    }
    parts
}

/// Takes what is of `part` out of a stretch.
fn take_out(part: &Stretch, stretch: &mut Stretch) {
    let share = product(part, stretch);
    stretch.iter_mut().zip(part).for_each(|(x, part)| *x -= share * part);
}

fn product(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
