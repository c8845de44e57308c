//! Measures the correlation of the noise of neighbouring pixels, by distance, from residuals of windows that lie on one plane.
//!
//! In each frame, random samples find the one or two largest planes (in a pinhole camera the inverse depth of a plane is linear
//! in the pixel). For each window of 64 x 64 pixels that one of them explains, a plane of its own is fitted and subtracted. The
//! residuals in depth give sigma and the autocorrelation along rows and columns. The fit also removes waves longer than some 50
//! px, so that the autocorrelation at 16 px reads low. Windows overlap by half.
//!
//! For a still camera, the residuals of a window are averaged over the frames: the mean is the constant part, and the rest is new
//! in each frame. With n frames, C the covariance of single frames and M that of their mean,
//! `new = (C - M) n / (n - 1)` and `stays = C - new`.

use crate::quantile::{median, quantile};
use crate::random::CounterRng;
use conicflow_messages::{Header, is_measured};
use nalgebra::{Matrix3, Vector3};
use std::fmt;

/// Side of a window, in pixels.
const WINDOW_PX: usize = 64;
/// Distance of neighbouring windows, in pixels.
const STRIDE_PX: usize = WINDOW_PX / 2;
/// Lags of the autocorrelation, in pixels; the first is the variance.
const LAGS: [usize; 6] = [0, 1, 2, 4, 8, 16];
/// Limits of the depth bands, in metres.
const BANDS_M: [f64; 14] = [0.2, 0.4, 0.5, 0.6, 0.7, 0.8, 1.0, 1.3, 1.7, 2.2, 3.0, 4.0, 6.0, 10.0];
/// Number of planes that are searched in a frame.
const PLANES: usize = 2;
/// Distance of the pixels used in the search for planes, in pixels.
const GRID_PX: usize = 8;
/// Number of triples of pixels that are tried for a plane.
const TRIALS: u64 = 300;
/// Half the largest distance of the second and the third pixel of a trial from the first, in grid points.
const TRIAL_REACH: f64 = 20.0;
/// Largest residual of the inverse depth for a pixel to belong to any plane, in 1/metre: three sigmas of a stereo camera with a
/// noise of 4 mm at 1 m.
const TRIAL_RESIDUAL_PER_M: f64 = 0.012;
/// Largest residual of a pixel from a frame's plane, in robust standard deviations.
const LARGEST_RESIDUAL: f64 = 5.0;
/// Least share of a frame's points that a plane has to explain.
const LEAST_PLANE: f64 = 0.04;
/// Least share of a window's pixels that have to be measured.
const LEAST_MEASURED: f64 = 0.9;
/// Least share of a window's measured pixels that have to be on the plane.
const LEAST_ON_PLANE: f64 = 0.99;
/// Least number of frames to separate constant from new noise.
const FEWEST_FRAMES: u32 = 5;

/// Covariance at the lags, along rows and along columns; both begin with the variance.
type Covariances = [[f64; LAGS.len()]; 2];

/// The windows on planes of all frames so far.
#[derive(Clone, Debug, Default)]
pub struct Planes {
    frames: u64,
    /// Depth in metres and covariances in square metres of each window of each frame.
    windows: Vec<(f64, Covariances)>,
    /// The windows at the same position in all frames, for a still camera.
    places: Vec<WindowHistory>,
}

/// The residuals of a window over the frames.
#[derive(Clone, Debug, Default)]
struct WindowHistory {
    frames: u32,
    depth: f64,
    covariances: Covariances,
    sums: Vec<f64>,
    counts: Vec<u32>,
}

impl Planes {
    /// Adds a depth image of the same size as before; `still`: neither the camera nor the scene moves.
    pub fn add(&mut self, header: &Header, pixels: &[u16], still: bool) {
        let (width, height) = (header.camera.width as usize, header.camera.height as usize);
        let inverse = |&pixel: &u16| match is_measured(pixel) {
            true => 1.0 / (f64::from(pixel) * header.depth_scale),
            false => f64::NAN,
        };
        let inverse: Vec<f64> = pixels.iter().map(inverse).collect();
        let planes = largest_planes(&inverse, width, &CounterRng::new(0, self.frames));
        self.frames += 1;
        let starts = |size: usize| (0..(size + STRIDE_PX).saturating_sub(WINDOW_PX) / STRIDE_PX).map(|i| i * STRIDE_PX);
        for (place, (top, left)) in starts(height).flat_map(|v| starts(width).map(move |u| (v, u))).enumerate() {
            let Some((depth, residuals)) = flattened(&inverse, width, [left, top], &planes) else { continue };
            let covariances = covariances(&residuals);
            self.windows.push((depth, covariances));
            if still {
                self.places.resize_with(self.places.len().max(place + 1), WindowHistory::default);
                self.places[place].add(depth, &covariances, &residuals);
            }
        }
    }
}

/// Returns the depth of a window's plane in its middle, and the residuals of the window from it in metres, NaN where nothing is
/// measured. `None` if the window is not on one plane.
fn flattened(inverse: &[f64], width: usize, [left, top]: [usize; 2], planes: &[Plane]) -> Option<(f64, Vec<f64>)> {
    let pixels = || {
        let places = (0..WINDOW_PX).flat_map(|j| (0..WINDOW_PX).map(move |i| (left + i, top + j)));
        places.map(|(u, v)| (place_of(u, v), inverse[v * width + u]))
    };
    let on = |plane: &&Plane| {
        let (mut measured, mut near) = (0, 0);
        for (place, inverse) in pixels().filter(|(_, inverse)| !inverse.is_nan()) {
            measured += 1;
            near += usize::from(plane.explains(&place, inverse));
        }
        measured as f64 >= LEAST_MEASURED * (WINDOW_PX * WINDOW_PX) as f64
            && near as f64 >= LEAST_ON_PLANE * measured as f64
    };
    let plane = planes.iter().find(on)?;
    let own = fitted(pixels().filter(|(place, inverse)| plane.explains(place, *inverse)))?;
    let depth = |place: &Vector3<f64>| 1.0 / own.dot(place);
    let residuals = pixels().map(|(place, inverse)| match plane.explains(&place, inverse) {
        true => (own.dot(&place) - inverse) * depth(&place) * depth(&place),
        false => f64::NAN,
    });
    let middle = depth(&place_of(left + WINDOW_PX / 2, top + WINDOW_PX / 2));
    (middle > 0.0).then(|| (middle, residuals.collect()))
}

impl WindowHistory {
    fn add(&mut self, depth: f64, covariances: &Covariances, residuals: &[f64]) {
        self.sums.resize(residuals.len(), 0.0);
        self.counts.resize(residuals.len(), 0);
        self.frames += 1;
        self.depth += depth;
        for (sum, covariance) in self.covariances.as_flattened_mut().iter_mut().zip(covariances.as_flattened()) {
            *sum += covariance;
        }
        for ((sum, count), residual) in self.sums.iter_mut().zip(&mut self.counts).zip(residuals) {
            if !residual.is_nan() {
                *sum += residual;
                *count += 1;
            }
        }
    }

    /// Returns the mean depth, and the covariances of the constant and the new part.
    fn parts(&self) -> (f64, [Covariances; 2]) {
        let frames = f64::from(self.frames);
        let mean = |(sum, count): (&f64, &u32)| match 2 * count >= self.frames {
            true => sum / f64::from(*count),
            false => f64::NAN,
        };
        let of_mean = covariances(&self.sums.iter().zip(&self.counts).map(mean).collect::<Vec<_>>());
        let (mut stays, mut new) = (Covariances::default(), Covariances::default());
        for (direction, sums) in self.covariances.iter().enumerate() {
            for (lag, sum) in sums.iter().enumerate() {
                let all = sum / frames;
                new[direction][lag] = (all - of_mean[direction][lag]) * frames / (frames - 1.0);
                stays[direction][lag] = all - new[direction][lag];
            }
        }
        (self.depth / frames, [stays, new])
    }
}

/// A plane in a frame: its inverse depth is linear in the pixel.
#[derive(Clone, Copy, Debug)]
struct Plane {
    coefficients: Vector3<f64>,
    /// Largest residual of its pixels, in 1/metre.
    limit: f64,
}

impl Plane {
    fn residual(&self, place: &Vector3<f64>, inverse: f64) -> f64 {
        (self.coefficients.dot(place) - inverse).abs()
    }

    /// Whether a pixel belongs to the plane; false without a measurement.
    fn explains(&self, place: &Vector3<f64>, inverse: f64) -> bool {
        self.residual(place, inverse) <= self.limit
    }
}

fn place_of(u: usize, v: usize) -> Vector3<f64> {
    Vector3::new(1.0, u as f64, v as f64)
}

/// Fits a plane by least squares; `None` if there are too few points.
fn fitted(points: impl Iterator<Item = (Vector3<f64>, f64)>) -> Option<Vector3<f64>> {
    let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
    for (place, inverse) in points {
        normal += place * place.transpose();
        right += place * inverse;
    }
    Some(normal.cholesky()?.solve(&right))
}

/// Returns the largest planes of an image, in descending order.
fn largest_planes(inverse: &[f64], width: usize, dice: &CounterRng) -> Vec<Plane> {
    let mut points: Vec<_> = inverse
        .iter()
        .enumerate()
        .map(|(index, inverse)| ([index % width, index / width], *inverse))
        .filter(|([u, v], inverse)| u % GRID_PX == 0 && v % GRID_PX == 0 && !inverse.is_nan())
        .map(|([u, v], inverse)| (place_of(u, v), inverse))
        .collect();
    let least = (LEAST_PLANE * points.len() as f64) as usize;
    let mut planes = Vec::new();
    for number in 0..PLANES as u64 {
        let Some(plane) = largest_plane(&points, dice, number).and_then(|plane| settled(plane, &points)) else { break };
        let before = points.len();
        points.retain(|(place, inverse)| !plane.explains(place, *inverse));
        if before - points.len() < least.max(3) {
            break;
        }
        planes.push(plane);
    }
    planes
}

/// Returns the plane through three nearby points that explains the most pixels.
fn largest_plane(points: &[(Vector3<f64>, f64)], dice: &CounterRng, number: u64) -> Option<Plane> {
    let mut best: Option<(usize, Plane)> = None;
    for trial in 0..TRIALS {
        let draw = |i: u64| dice.uniform(((number * TRIALS + trial) * 16) + i);
        let first = points.get((draw(0) * points.len() as f64) as usize)?;
        let reach = TRIAL_REACH * GRID_PX as f64;
        let near = |from: u64| {
            let tries = (from..from + 5).map(|i| &points[(draw(i) * points.len() as f64) as usize]);
            tries.min_by(|a, b| (a.0 - first.0).norm().total_cmp(&(b.0 - first.0).norm()))
        };
        let (Some(second), Some(third)) = (near(1), near(6)) else { continue };
        if (second.0 - first.0).norm() > 2.0 * reach || (third.0 - first.0).norm() > 2.0 * reach {
            continue;
        }
        let Some(coefficients) = fitted([*first, *second, *third].into_iter()) else { continue };
        let plane = Plane { coefficients, limit: TRIAL_RESIDUAL_PER_M };
        let count = points.iter().filter(|(place, inverse)| plane.explains(place, *inverse)).count();
        if best.as_ref().is_none_or(|(most, _)| count > *most) {
            best = Some((count, plane));
        }
    }
    best.map(|(_, plane)| plane)
}

/// Refits a plane several times to the pixels that it explains, with a limit that follows from their noise.
fn settled(mut plane: Plane, points: &[(Vector3<f64>, f64)]) -> Option<Plane> {
    const ROUNDS: usize = 4;
    /// Median absolute deviation of a normal variable of variance one.
    const MEDIAN_DEVIATION: f64 = 0.6745;
    for _ in 0..ROUNDS {
        let own = || points.iter().copied().filter(|(place, inverse)| plane.explains(place, *inverse));
        let coefficients = fitted(own())?;
        let next = Plane { coefficients, limit: plane.limit };
        let deviation = median(own().map(|(place, inverse)| next.residual(&place, inverse)).collect())?;
        plane =
            Plane { coefficients, limit: (LARGEST_RESIDUAL * deviation / MEDIAN_DEVIATION).min(TRIAL_RESIDUAL_PER_M) };
    }
    Some(plane)
}

/// Returns the mean products of a window's residuals with those at each lag.
fn covariances(residuals: &[f64]) -> Covariances {
    let at = |lag: usize, along_row: bool| {
        let (mut sum, mut count) = (0.0, 0.0);
        let (columns, rows) = if along_row { (WINDOW_PX - lag, WINDOW_PX) } else { (WINDOW_PX, WINDOW_PX - lag) };
        let step = if along_row { lag } else { lag * WINDOW_PX };
        for v in 0..rows {
            let row = &residuals[v * WINDOW_PX..];
            for (one, other) in row[..columns].iter().zip(&row[step..]) {
                let product = one * other;
                if !product.is_nan() {
                    sum += product;
                    count += 1.0;
                }
            }
        }
        sum / count
    };
    [true, false].map(|along_row| LAGS.map(|lag| at(lag, along_row)))
}

/// Writes one line for each depth band: windows, quartiles of sigma, and the mean autocorrelations.
fn table(windows: &[(f64, Covariances)], f: &mut fmt::Formatter<'_>) -> fmt::Result {
    for band in BANDS_M.windows(2) {
        let inside: Vec<_> = windows.iter().filter(|(depth, _)| (band[0]..band[1]).contains(depth)).collect();
        let Some(depth) = median(inside.iter().map(|(depth, _)| *depth).collect()) else { continue };
        let mut sigmas: Vec<f64> = inside.iter().map(|(_, c)| 1e3 * c[0][0].max(0.0).sqrt()).collect();
        let [low, middle, high] = [0.25, 0.5, 0.75].map(|share| quantile(&mut sigmas, share));
        let sigma = |quartile: Option<f64>| quartile.unwrap_or(f64::NAN);
        write!(
            f,
            "# {:>4}-{:<4} {depth:6.2} {:8}  {:5.2} {:5.2} {:5.2}  ",
            band[0],
            band[1],
            inside.len(),
            sigma(low),
            sigma(middle),
            sigma(high)
        )?;
        for direction in 0..2 {
            for lag in 1..LAGS.len() {
                let correlations = inside.iter().map(|(_, c)| c[direction][lag] / c[direction][0]);
                let correlation = median(correlations.collect()).unwrap_or(f64::NAN);
                write!(f, " {correlation:5.2}")?;
            }
            write!(f, "{}", if direction == 0 { "  " } else { "\n" })?;
        }
    }
    Ok(())
}

/// Writes tables as comments of a pipeline file.
impl fmt::Display for Planes {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        const HEAD: &str =
            "#    between  median  windows  sigma quartiles     along rows at 1 2 4 8 16 px      along columns";
        writeln!(f, "# planes, {WINDOW_PX}x{WINDOW_PX} px each; m, mm, autocorrelation\n{HEAD}")?;
        table(&self.windows, f)?;
        let places: Vec<_> = self.places.iter().filter(|place| place.frames >= FEWEST_FRAMES).collect();
        if places.is_empty() {
            return Ok(());
        }
        let parts: Vec<_> = places.iter().map(|place| place.parts()).collect();
        for (index, name) in ["what stays from frame to frame", "what is new in each frame"].into_iter().enumerate() {
            writeln!(f, "# {name}\n{HEAD}")?;
            table(&parts.iter().map(|(depth, parts)| (*depth, parts[index])).collect::<Vec<_>>(), f)?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::scene::Scene;
    use crate::simulator::sensor::{SensorConfig, SensorTable};
    use crate::simulator::simulated_sensor::{SensorKind, SimulatedSensor};
    use crate::simulator::{SimulatorParameters, SyntheticCamera};
    use conicflow_messages::Camera;

    /// A table seen at an angle, with a box on it, in front of a wall.
    const TABLE: &str = "
name = 'table'
[camera]
position = [0, 0, 0.5]
direction = [0, 1, -0.8]
[[plane]]
name = 'table'
point = [0, 0, 0]
normal = [0, 0, 1]
[[box]]
name = 'box'
center = [0.1, 0.6, 0.1]
size = [0.1, 0.1, 0.2]
";

    const BOARD: &str = "
name = 'board'
[camera]
position = [0, 0, 0]
direction = [0, 1, 0]
[[plane]]
name = 'board'
point = [0, 0.8, 0]
normal = [0.2, -1, 0.5]
";

    /// Returns the median over the windows of a number computed from depth and covariances.
    fn typical(windows: &[(f64, Covariances)], number: impl Fn(f64, &Covariances) -> f64) -> f64 {
        median(windows.iter().map(|(depth, covariances)| number(*depth, covariances)).collect()).unwrap()
    }

    fn correlation(windows: &[(f64, Covariances)], direction: usize, lag: usize) -> f64 {
        typical(windows, |_, covariances| covariances[direction][lag] / covariances[direction][0])
    }

    fn planes(camera: &mut SyntheticCamera, frames: u64, still: bool) -> Planes {
        let mut planes = Planes::default();
        for number in 0..frames {
            let (header, pixels) = camera.frame(number);
            planes.add(&header, &pixels, still);
        }
        planes
    }

    fn before(scene: &str, noise: SensorConfig) -> SyntheticCamera {
        let camera = SimulatorParameters::default().camera();
        SyntheticCamera::new(Scene::parse(scene, "test").unwrap(), camera, noise, 1e-4, 30.0, 5)
    }

    /// Windows of five pixels overlap by 4, 3, 1 and none at lags of 1, 2, 4 and 8 pixels.
    #[test]
    fn noise_of_a_window_has_its_sigma_and_its_autocorrelation() {
        let (floor_m, noise_window_px) = (0.002, 5);
        let alone = SensorTable { growth_per_m: 0.0, step_per_m: 0.0, edge_jitter_px: 0.0, ..SensorTable::default() };
        let noise = SensorConfig::Table(SensorTable { floor_m, noise_window_px, ..alone });
        let planes = planes(&mut before(TABLE, noise), 2, false);
        assert!((150..=2 * 13 * 18).contains(&planes.windows.len()), "{}", planes.windows.len());
        let sigma = typical(&planes.windows, |_, covariances| covariances[0][0].sqrt());
        assert!((sigma / 0.002 - 1.0).abs() < 0.05, "{sigma}");
        for direction in 0..2 {
            for (lag, expected) in [(1, 0.8), (2, 0.6), (3, 0.2), (4, 0.0)] {
                let seen = correlation(&planes.windows, direction, lag);
                assert!((seen - expected).abs() < 0.05, "{direction}, {}: {seen}", LAGS[lag]);
            }
        }
    }

    #[test]
    fn a_window_with_a_box_in_it_is_on_no_plane() {
        let planes = planes(&mut before(TABLE, SensorConfig::default()), 1, false);
        let largest = planes.windows.iter().map(|(depth, c)| c[0][0].sqrt() / (depth * depth));
        assert!(largest.fold(0.0, f64::max) < 0.006, "noise only");
    }

    /// A constant wave with a sigma of 1 mm, and white noise of 2 mm that is new in each frame.
    #[test]
    fn what_stays_is_told_from_what_is_new() {
        let camera = Camera { width: 320, height: 240, ..Camera::default() };
        let header = Header { camera, depth_scale: 2e-5, ..Header::default() };
        let mut planes = Planes::default();
        for frame in 0..12 {
            let dice = CounterRng::new(9, frame);
            let depth = |index: usize| {
                let wave = 0.001 * 2.0_f64.sqrt() * (0.4 * (index % 320) as f64).sin();
                ((1.0 + wave + 0.002 * dice.gaussian(index as u64)) / 2e-5) as u16
            };
            planes.add(&header, &(0..320 * 240).map(depth).collect::<Vec<_>>(), true);
        }
        let parts: Vec<_> = planes.places.iter().map(WindowHistory::parts).collect();
        for (index, expected) in [(0, 0.001), (1, 0.002)] {
            let part: Vec<_> = parts.iter().map(|(depth, parts)| (*depth, parts[index])).collect();
            let sigma = typical(&part, |_, covariances| covariances[0][0].sqrt());
            assert!((sigma / expected - 1.0).abs() < 0.06, "{index}: {sigma}");
            let columns = correlation(&part, 1, 4);
            assert!((columns - [1.0, 0.0][index]).abs() < 0.05, "{index}: {columns}");
        }
        assert_eq!(planes.to_string().matches("what stays").count(), 1);
    }

    /// Ranges of recordings by real cameras, with a margin for their differences; see `experiments/README.md`.
    #[test]
    fn simulated_planes_are_as_alike_as_real_ones() {
        let stereo = [[0.94..0.99, 0.75..0.92, 0.5..0.75], [0.8..0.95, 0.3..0.6, -0.15..0.2]];
        let structured_light = [[0.7..0.9, 0.35..0.7, -0.05..0.4], [0.65..0.9, 0.2..0.55, -0.15..0.3]];
        for (kind, growth, ranges) in [
            (SensorKind::Stereo, 0.0019..0.0032, stereo),
            (SensorKind::StructuredLight, 0.0015..0.0024, structured_light),
        ] {
            let sensor = SimulatedSensor::Named(kind);
            let planes = planes(&mut before(BOARD, SensorConfig::default()).with_sensor(sensor), 1, false);
            let sigma = typical(&planes.windows, |depth, covariances| covariances[0][0].sqrt() / (depth * depth));
            assert!(growth.contains(&sigma), "{kind:?}: {sigma}");
            for (direction, ranges) in ranges.into_iter().enumerate() {
                for (lag, range) in [1, 3, 4].into_iter().zip(ranges) {
                    let seen = correlation(&planes.windows, direction, lag);
                    assert!(range.contains(&seen), "{kind:?}, {direction}, {}: {seen}", LAGS[lag]);
                }
            }
        }
    }
}
