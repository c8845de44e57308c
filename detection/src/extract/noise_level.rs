//! Estimates the noise of an image as a multiple of the variance of its noise model.
//!
//! All limits and the correction of the moments depend on the noise. A sensor may be noisier than its model says, or quieter
//! where a driver smooths. Limits that are too narrow are the worse mistake: from a tenth more noise on, fewer and fewer surfaces
//! would be found.
//!
//! Pixels that lie close together show the noise that they do not share, whatever the surface ([`scatter`]). That is all of the
//! noise, unless a driver smooths. If it is less than the model says, the residuals of lines and circles show the whole
//! ([`share`]): after the model's variance is taken off they are zero if the model is right, and negative by its excess. Where
//! the level is far too high, curves are also fitted across steps and folds, so they are fitted again with the level that they
//! showed.

use super::noise_estimate::NoiseEstimate;
use super::rays::Rays;
use super::run::Run;
use super::search::LineSearch;
use super::segments::{Segment, next_segment};
use super::view::View;
use conicflow_geometry::Scan;
use conicflow_messages::{Header, NoiseModel, is_measured};

/// Approximate number of lines that are sampled.
const SAMPLED_LINES: u32 = 12; // [algorithmic]
/// Fewest points of a line or circle whose residual counts as a sample of the noise.
const MIN_CURVE_POINTS: usize = 12; // [algorithmic]
/// Least spacing of the three pixels of a triple, in metres at a distance of one metre: those of a Kinect lie three pixels apart.
/// With a larger spacing triples span different surfaces too often, whatever the resolution; with a smaller one they often have
/// the same depth, where a sensor quantises it.
const TRIPLE_SPACING: f64 = 0.0048; // [tuned]
/// Fewest triples that give an estimate.
const MIN_TRIPLES: usize = 64; // [algorithmic]
/// A triple with a larger second difference, in standard deviations, does not lie on one smooth surface.
const SMOOTH_SIGMAS: f64 = 2.5; // [sigmas]
/// Mean square of a standard normal deviate that is truncated at [`SMOOTH_SIGMAS`].
const TRUNCATED_SQUARE: f64 = 0.911_26; // [derived]
/// An iteration ends when the noise level changes by less than this factor.
const SETTLED: f64 = 1.01; // [algorithmic]
/// If the scatter of neighbours exceeds this part of the model's variance, neighbours share no noise.
const UNSMOOTHED: f64 = 0.85; // [tuned]
/// Least share of all triples that lie on smooth surfaces, in any image. If fewer are within [`SMOOTH_SIGMAS`], the noise model
/// is far too small.
const SMOOTH: f64 = 0.25; // [tuned]
/// The quantile [`SMOOTH`] of chi squared with one degree of freedom.
const SQUARE_OF_SMOOTH: f64 = 0.101_53; // [derived]
/// Smallest ratio between the mean depths of the far and the near half at which the model's growth is replaced: two levels at
/// nearly one depth do not determine a growth.
const DISTANT: f64 = 1.15; // [tuned]
/// Fewest standard deviations by which the logarithm of the ratio of the noise levels of both halves has to differ from zero.
const SURE_SIGMAS: f64 = 3.5; // [sigmas]
/// [`NoiseSamples::range`] leaves out one sample in this many at either end.
const OUTER: usize = 20; // [algorithmic]
/// Most rounds of fitting a noise model to both halves, or of fitting curves with a new level: each round comes closer to the
/// noise.
const ROUNDS: usize = 4; // [algorithmic]

/// A sample of the noise: its depth in metres, and a squared residual in variances of the model.
#[derive(Clone, Copy, Debug)]
struct NoiseSample {
    depth: f64,
    square: f64,
}

/// Buffers, used again for the next image.
#[derive(Debug, Default)]
pub(crate) struct NoiseSamples {
    of_neighbors: Vec<NoiseSample>,
    of_curves: Vec<NoiseSample>,
}

impl NoiseSamples {
    /// Returns the range of depths in the last image: one in [`OUTER`] of its samples is nearer, and as many are farther. `None`
    /// where there are too few.
    pub fn range(&mut self) -> Option<[f64; 2]> {
        let count = self.of_neighbors.len();
        let outer = count / OUTER;
        let by_depth = |a: &NoiseSample, b: &NoiseSample| a.depth.total_cmp(&b.depth);
        let mut depth = |rank: usize| self.of_neighbors.select_nth_unstable_by(rank, by_depth).1.depth;
        (outer > 0).then(|| [outer, count - 1 - outer].map(&mut depth))
    }
}

/// The nearer or the farther half of an image.
#[derive(Clone, Copy, Debug)]
struct Half {
    /// Mean depth, in metres.
    depth: f64,
    count: f64,
    /// Variance that neighbours show, in variances of the model.
    scatter: f64,
}

/// Estimates the noise of an image with this header; sets up `view` for its rows.
pub(crate) fn estimate(
    view: &mut View,
    (header, image): (&Header, &[u16]),
    search: &mut LineSearch,
    samples: &mut NoiseSamples,
) -> NoiseEstimate {
    let NoiseSamples { of_neighbors, of_curves } = samples;
    view.set_up(header, Scan::Row, &NoiseEstimate::nominal(header.noise));
    sample_neighbors(view, image, of_neighbors);
    if of_neighbors.len() < MIN_TRIPLES {
        return NoiseEstimate::nominal(view.noise);
    }
    let halves = halves(of_neighbors);
    if differ(&halves) {
        sample_curves(view, image, search, of_curves);
        return of_another_growth(view, &halves, of_neighbors, of_curves);
    }
    let scatter = scatter(of_neighbors);
    if scatter > UNSMOOTHED {
        return NoiseEstimate::of_level(view.noise, scatter.max(1.0));
    }
    let mut noise = NoiseEstimate::nominal(header.noise);
    for _ in 0..ROUNDS {
        sample_curves(view, image, search, of_curves);
        let level = (noise.level * share(of_curves, |_| true)).max(scatter);
        let is_settled = noise.level <= level * SETTLED;
        noise = NoiseEstimate::of_level(header.noise, level);
        if is_settled {
            break;
        }
        view.set_up(header, Scan::Row, &noise);
    }
    noise
}

/// Estimates the noise of an image whose halves differ: fits a noise model through both, until the halves agree with it.
fn of_another_growth(
    view: &View,
    halves: &[Half; 2],
    of_neighbors: &mut [NoiseSample],
    of_curves: &mut [NoiseSample],
) -> NoiseEstimate {
    let depths = halves.map(|half| half.depth);
    let border = 0.5 * (depths[0] + depths[1]);
    let (mut model, mut halves) = (view.noise, *halves);
    for _ in 0..ROUNDS {
        let mut factor = |half: Half| {
            let is_of_it = |sample: &NoiseSample| (sample.depth < border) == (half.depth < border);
            if half.scatter > UNSMOOTHED { half.scatter } else { half.scatter.max(share(of_curves, is_of_it)) }
        };
        let variance_of = |model: &NoiseModel, depth: f64| model.variance(depth).max(view.least);
        let last = |depth: f64| variance_of(&model, depth);
        let next = through(depths, halves.map(|half| factor(half).sqrt()), last);
        for sample in of_neighbors.iter_mut().chain(&mut *of_curves) {
            sample.square *= last(sample.depth) / variance_of(&next, sample.depth);
        }
        model = next;
        halves = self::halves(of_neighbors);
    }
    let variance_ratios = depths.map(|depth| model.variance(depth) / view.variance(depth));
    let neighbour_model =
        through(depths, variance_ratios.map(|level| level.max(1.0).sqrt()), |depth| view.variance(depth));
    NoiseEstimate { neighbour_model, variance_ratios, ..NoiseEstimate::nominal(model) }
}

/// Returns whether the noise of the near and of the far half surely differs from the model by different factors.
fn differ([near, far]: &[Half; 2]) -> bool {
    let sigma = (2.0 / near.count + 2.0 / far.count).sqrt();
    let ratio = (near.scatter / far.scatter).ln().abs();
    let are_enough = near.count.min(far.count) >= MIN_TRIPLES as f64;
    // Noise below the model may be smoothed, and then neighbours show less than there is.
    let are_smoothed = near.scatter.min(far.scatter) <= UNSMOOTHED;
    are_enough && !are_smoothed && far.depth > DISTANT * near.depth && ratio > SURE_SIGMAS * sigma
}

/// Returns the model that has at two depths the standard deviations of `variance` times these factors, and that grows with the
/// square of the depth.
fn through(depths: [f64; 2], factors: [f64; 2], variance: impl Fn(f64) -> f64) -> NoiseModel {
    let [near, far] = [0, 1].map(|i| factors[i] * variance(depths[i]).sqrt());
    let [near_square, far_square] = depths.map(|depth| depth * depth);
    let growth = ((far - near) / (far_square - near_square)).max(0.0);
    let floor = near.max(far) - growth * if near < far { far_square } else { 0.0 };
    let (floor_m, growth_per_m) = if floor < 0.0 { (0.0, far / far_square) } else { (floor, growth) };
    NoiseModel { floor_m, growth_per_m, knee_m: 0.0, step_per_m: 0.0 }
}

/// Samples triples of pixels that lie close together.
///
/// On a plane the inverse depth is linear along a line of the image. So `b (b / a + b / c - 2)` of three depths in even steps is
/// noise alone, of six times the variance of one depth. The depth of a sample is the mean of the three, which is independent of
/// that difference. The depth of the middle pixel is not: halves divided by it would be divided by its noise.
fn sample_neighbors(view: &View, image: &[u16], samples: &mut Vec<NoiseSample>) {
    samples.clear();
    let apart = ((TRIPLE_SPACING / view.pitch()).ceil() as usize).min(view.length as usize).max(1);
    for line in lines(view) {
        let depths = view.line(image, line).windows(2 * apart + 1).step_by(apart);
        let threes = depths.map(|depths| [depths[0], depths[apart], depths[2 * apart]]);
        samples.extend(threes.filter(|depths| depths.iter().all(|&depth| is_measured(depth))).map(|depths| {
            let [a, b, c] = depths.map(|depth| f64::from(depth) * view.scale);
            let off = b * (b / a + b / c - 2.0);
            NoiseSample { depth: (a + b + c) / 3.0, square: off * off / (6.0 * view.variance(b)) }
        }));
    }
}

/// Divides the samples into those nearer than the mean depth and those farther, and puts them in this order.
fn halves(samples: &mut [NoiseSample]) -> [Half; 2] {
    let mean = samples.iter().map(|sample| sample.depth).sum::<f64>() / samples.len() as f64;
    let near = put_first(samples, |sample| sample.depth < mean);
    let (near, far) = samples.split_at_mut(near);
    [near, far].map(|samples| {
        let count = samples.len() as f64;
        Half { depth: samples.iter().map(|sample| sample.depth).sum::<f64>() / count, count, scatter: scatter(samples) }
    })
}

/// Puts the samples for which `is_of_them` holds first; returns their number.
fn put_first(samples: &mut [NoiseSample], is_of_them: impl Fn(&NoiseSample) -> bool) -> usize {
    let mut count = 0;
    for index in 0..samples.len() {
        if is_of_them(&samples[index]) {
            samples.swap(count, index);
            count += 1;
        }
    }
    count
}

/// Returns the variance that neighbours show, in variances of the model. It is less than the true one where they share noise.
///
/// Silhouettes and creases are kept out: the level starts from that of the model, or from that of the smoothest triples where the
/// model is far too small, and grows only as far as the mean square of the samples within [`SMOOTH_SIGMAS`] confirms it. The
/// order of `samples` may change.
fn scatter(samples: &mut [NoiseSample]) -> f64 {
    let within = |samples: &[NoiseSample], level: f64| {
        let limit = SMOOTH_SIGMAS * SMOOTH_SIGMAS * level;
        samples
            .iter()
            .map(|sample| sample.square)
            .filter(|square| *square <= limit)
            .fold((0.0, 0.0), |(sum, count), square| (sum + square, count + 1.0))
    };
    let mut level = 1.0;
    // Where a sensor quantises depth, triples of one depth are zero, which says nothing of a model that is far too small.
    let differing = put_first(samples, |sample| sample.square > 0.0);
    let (differing, smooth) = (&mut samples[..differing], SMOOTH * differing as f64);
    if within(differing, level).1 < smooth {
        let (_, sample, _) = differing.select_nth_unstable_by(smooth as usize, |a, b| a.square.total_cmp(&b.square));
        level = sample.square / SQUARE_OF_SMOOTH;
    }
    loop {
        let (sum, count) = within(samples, level);
        let last = std::mem::replace(&mut level, sum / (f64::max(count, 1.0) * TRUNCATED_SQUARE));
        if level < last * SETTLED {
            return level;
        }
    }
}

/// Samples the lines and circles of whole scan lines.
fn sample_curves(view: &View, image: &[u16], search: &mut LineSearch, samples: &mut Vec<NoiseSample>) {
    samples.clear();
    let LineSearch { line, curves } = search;
    for number in lines(view) {
        line.read(view, image, number, 0..view.length);
        for index in 0..line.runs() {
            if line.run_length(index) >= MIN_CURVE_POINTS {
                let rays = Rays::new(view, line, index, &mut curves.rays);
                add_curves(&Run::new(rays, &mut curves.sums), samples);
            }
        }
    }
}

/// Returns the part of the model's variance that the median of some lines and circles shows, from 0 to 1. The order of `samples`
/// may change.
fn share(samples: &mut [NoiseSample], is_of_them: impl Fn(&NoiseSample) -> bool) -> f64 {
    let count = put_first(samples, is_of_them);
    if count == 0 {
        return 1.0;
    }
    let (_, median, _) = samples[..count].select_nth_unstable_by(count / 2, |a, b| a.square.total_cmp(&b.square));
    median.square.clamp(0.0, 1.0)
}

fn lines(view: &View) -> impl Iterator<Item = u32> {
    (0..view.lines).step_by((view.lines / SAMPLED_LINES).max(1) as usize)
}

/// Adds the variances that the lines and circles of a run show.
fn add_curves(run: &Run, samples: &mut Vec<NoiseSample>) {
    let mut from = run.inner.start;
    while let Some(Segment { to, .. }) = next_segment(run, &run.inner, from) {
        if to - from >= MIN_CURVE_POINTS {
            let moments = run.moments(from, to);
            let fit = moments.fit();
            let excess = fit.line_square.min(fit.circle_square) / run.variance(from, to);
            samples.push(NoiseSample { depth: moments.mean()[1], square: 1.0 + excess });
        }
        from = to;
    }
}

#[cfg(test)]
mod tests {
    use super::super::parameters::ExtractorParameters;
    use super::*;
    use conicflow_lab::random::CounterRng;
    use conicflow_messages::Camera;

    /// Samples at these depths, with `variance` times the variance of the model.
    fn samples(count: u64, depth: impl Fn(u64) -> f64, variance: f64) -> Vec<NoiseSample> {
        let random = CounterRng::new(8, 0);
        let sample = |i: u64| NoiseSample { depth: depth(i), square: variance * random.gaussian(i).powi(2) };
        (0..count).map(sample).collect()
    }

    #[test]
    fn a_model_through_two_levels_has_these_and_grows_with_the_square_of_the_depth() {
        let kinect = NoiseModel { floor_m: 0.001, growth_per_m: 0.0005, knee_m: 0.0, step_per_m: 0.0 };
        let at = |depths: [f64; 2], factors: [f64; 2]| through(depths, factors, |depth| kinect.variance(depth));
        let wider = at([1.0, 3.0], [1.2, 2.0]);
        for (depth, factor) in [(1.0, 1.2), (3.0, 2.0)] {
            assert!((wider.sigma(depth) / kinect.sigma(depth) - factor).abs() < 1e-9, "{wider:?} at {depth} m");
        }
        assert!((wider.sigma(2.0) - (0.0018 + (0.011 - 0.0018) * 3.0 / 8.0)).abs() < 1e-12);
        // A sigma that falls with depth becomes constant at its near value; a negative sigma at zero depth becomes zero.
        let falling = at([1.0, 3.0], [4.0, 1.0]);
        assert_eq!((falling.growth_per_m, falling.floor_m), (0.0, kinect.sigma(1.0) * 4.0));
        let steep = at([1.0, 3.0], [0.1, 2.0]);
        assert!(steep.floor_m == 0.0 && (steep.sigma(3.0) - 0.011).abs() < 1e-12, "{steep:?}");
    }

    /// Waves of three pixels: triples with a spacing of three pixels do not see them, triples of neighbours do.
    #[test]
    fn threes_lie_as_far_apart_in_the_view_however_many_pixels_that_is() {
        let seen = |fx: f64| {
            let camera = Camera { width: 90, height: 12, fx, fy: fx, cx: 44.5, cy: 5.5 };
            let noise = NoiseModel { floor_m: 0.001, ..NoiseModel::IDEAL };
            let mut view = View::with(ExtractorParameters::default());
            let header = Header { camera, noise, depth_scale: 0.001, ..Header::default() };
            view.set_up(&header, Scan::Row, &NoiseEstimate::nominal(noise));
            let image: Vec<u16> = (0..90 * 12).map(|pixel| [1000, 1003, 1006][pixel % 3]).collect();
            let mut samples = Vec::new();
            sample_neighbors(&view, &image, &mut samples);
            (samples.len(), samples.iter().any(|sample| sample.square > 0.1))
        };
        assert_eq!([200.0, 525.0, 1e9].map(seen), [(12 * 88, true), (12 * 28, false), (0, false)]);
        assert_eq!([0.0, f64::NAN].map(|fx| seen(fx).0), [12 * 88; 2], "a camera that nobody set, too");
    }

    #[test]
    fn halves_differ_where_more_than_chance_does_at_two_depths_and_neither_is_smoothed() {
        let half = |depth: f64, count: f64, scatter: f64| Half { depth, count, scatter };
        let near = half(1.0, 200.0, 1.0);
        // For 200 samples each the standard deviation of the logarithm of the ratio is 0.1414.
        let ratio = |sigmas: f64| (sigmas * 0.02_f64.sqrt()).exp();
        for (far, expected) in [
            (half(2.0, 200.0, ratio(3.6)), true),
            (half(2.0, 200.0, ratio(3.4)), false),
            (half(1.16, 200.0, 4.0), true),
            (half(1.14, 200.0, 4.0), false),
            (half(2.0, 64.0, 4.0), true),
            (half(2.0, 63.0, 4.0), false),
            (half(2.0, 1e6, ratio(3.0)), true),
            (half(2.0, 200.0, 0.5), false),
        ] {
            assert_eq!(differ(&[near, far]), expected, "{far:?}");
        }
        assert!(differ(&[half(1.0, 200.0, 4.0), half(2.0, 200.0, 1.0)]), "it may fall as well");
        assert!(!differ(&[half(1.0, 200.0, UNSMOOTHED), half(2.0, 200.0, 4.0)]));
    }

    /// Neighbours of the near half share most of their noise; its curves show more, and those of the far half show nothing new.
    #[test]
    fn of_halves_that_differ_each_has_the_noise_that_its_own_neighbours_and_curves_show() {
        let model = NoiseModel { floor_m: 0.002, ..NoiseModel::IDEAL };
        let camera = Camera { width: 40, height: 30, fx: 40.0, fy: 40.0, cx: 19.5, cy: 14.5 };
        let mut view = View::with(ExtractorParameters::default());
        let header = Header { camera, noise: model, depth_scale: 1e-4, ..Header::default() };
        view.set_up(&header, Scan::Row, &NoiseEstimate::nominal(model));
        let mut neighbours = [samples(2000, |_| 1.0, 0.5), samples(2000, |_| 3.0, 4.0)].concat();
        let mut curves = [samples(9, |_| 1.0, 0.0), samples(30, |_| 3.0, 0.0)].concat();
        curves.iter_mut().for_each(|sample| sample.square = if sample.depth < 2.0 { 0.8 } else { 0.1 });
        let halves = halves(&mut neighbours);
        let seen = of_another_growth(&view, &halves, &mut neighbours, &mut curves);
        assert!(
            (0.79..0.81).contains(&seen.variance_ratios[0]) && (3.7..4.3).contains(&seen.variance_ratios[1]),
            "{seen:?}"
        );
        for (depth, ratio) in [(1.0, seen.variance_ratios[0]), (3.0, seen.variance_ratios[1])] {
            assert!((seen.level * seen.model.variance(depth) / model.variance(depth) - ratio).abs() < 1e-9);
            let of_neighbours = seen.neighbour_model.variance(depth) / model.variance(depth);
            assert!((of_neighbours - ratio.max(1.0)).abs() < 1e-9, "a driver smooths within surfaces: {of_neighbours}");
        }
    }

    #[test]
    fn halves_are_what_is_nearer_and_what_is_farther_than_the_mean() {
        let mut mixed = samples(4000, |i| if i % 4 == 0 { 3.0 } else { 1.0 + 0.1 * (i % 2) as f64 }, 1.0);
        mixed.iter_mut().filter(|sample| sample.depth > 2.0).for_each(|sample| sample.square *= 4.0);
        let [near, far] = halves(&mut mixed);
        assert_eq!((near.count, far.count, far.depth), (3000.0, 1000.0, 3.0));
        assert!((near.depth - (1.0 + 0.2 / 3.0)).abs() < 1e-9, "{near:?}");
        assert!((0.9..1.1).contains(&near.scatter) && (3.6..4.4).contains(&far.scatter), "{near:?} {far:?}");
    }

    #[test]
    fn the_scatter_is_that_of_smooth_surfaces_however_far_the_model_is_off() {
        for variance in [1.0, 2.0, 50.0, 1e6] {
            let mut smooth = samples(4000, |_| 1.0, variance);
            let alone = scatter(&mut smooth) / variance;
            assert!((0.9..1.1).contains(&alone), "{alone} at {variance}");
            // A third of the triples contain a silhouette or a crease.
            smooth.iter_mut().step_by(3).for_each(|sample| sample.square += 100.0 * variance);
            let among_others = scatter(&mut smooth) / variance;
            assert!((0.85..1.15).contains(&among_others), "{among_others} at {variance}");
        }
        let quiet = scatter(&mut samples(4000, |_| 1.0, 0.1)) / 0.1;
        assert!((1.0..1.2).contains(&quiet), "{quiet}: nothing of it is cut off, as is reckoned with");
    }

    #[test]
    fn lines_and_circles_show_the_median_of_their_variances_and_at_most_all() {
        let of = |squares: &[f64], depth: f64| {
            let mut samples: Vec<_> = squares.iter().map(|&square| NoiseSample { depth: square, square }).collect();
            share(&mut samples, |sample| sample.depth < depth)
        };
        assert_eq!(of(&[0.9, 0.2, 0.4, 0.3, 0.6], 9.0), 0.4);
        assert_eq!(of(&[0.9, 0.2, 0.4, 0.3, 0.6], 0.5), 0.3, "of those nearer");
        assert_eq!([of(&[-1.0; 3], 9.0), of(&[2.0; 3], 9.0), of(&[0.5], 0.0)], [0.0, 1.0, 1.0]);
    }

    /// Each row steps once, by up to 20 mm: eight times the true noise hides these steps.
    #[test]
    fn a_model_that_is_far_too_noisy_does_not_take_the_steps_between_surfaces_for_noise() {
        let camera = Camera { width: 320, height: 120, fx: 500.0, fy: 500.0, cx: 159.5, cy: 59.5 };
        let (sigma, random) = (0.0005, CounterRng::new(5, 0));
        let depth = |pixel: u64| {
            let [row, column] = [pixel / 320, pixel % 320];
            let step = if column < 160 { 0.0 } else { 0.020 * row as f64 / 120.0 };
            1.0 + step + sigma * random.gaussian(pixel)
        };
        let image: Vec<u16> = (0..320 * 120).map(|pixel| (depth(pixel) / 1e-4) as u16).collect();
        let level = |told: f64| {
            let noise = NoiseModel { floor_m: told * sigma, ..NoiseModel::IDEAL };
            let header = Header { camera, noise, depth_scale: 1e-4, ..Header::default() };
            let mut view = View::with(ExtractorParameters::default());
            let (search, samples) = (&mut LineSearch::default(), &mut NoiseSamples::default());
            estimate(&mut view, (&header, &image), search, samples).level * told * told
        };
        let levels = [1.5, 4.0, 8.0].map(level);
        let [slightly, surely, far] = levels;
        assert!((0.9..1.2).contains(&slightly) && (0.9..1.6).contains(&surely) && far < 6.0, "{levels:?}");
    }

    #[test]
    fn one_in_twenty_is_nearer_than_what_is_near_and_farther_than_what_is_far() {
        let range = |count: u64| {
            // In scrambled order: 37 has no factor in common with the counts.
            let of_neighbors = samples(count, |i| (i * 37 % count) as f64, 1.0);
            NoiseSamples { of_neighbors, of_curves: Vec::new() }.range()
        };
        assert_eq!([range(19), range(20), range(100)], [None, Some([1.0, 18.0]), Some([5.0, 94.0])]);
    }
}
