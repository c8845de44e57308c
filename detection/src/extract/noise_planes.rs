//! Estimates how many neighbouring pixels share their noise, along rows and along columns, from the planes in the image.
//!
//! A camera that compares windows of two images, or a driver that smooths, gives neighbours the same errors, over blobs of up to
//! 20 pixels. Pixels that lie close together do not show these errors, but the residuals of a square of the image from a plane
//! do: the inverse depth of a plane is linear in the pixel. The number of pixels that count as one is the integrated
//! autocorrelation of the residuals along rows and columns, up to where the autocorrelation vanishes (after Geyer, "Practical
//! Markov chain Monte Carlo", 1992).

use super::view::View;
use conicflow_messages::is_measured;
use nalgebra::{Matrix3, Vector3};

/// Side of a square in pixels, in an image of [`USUAL_WIDTH`]: three of the longest blobs.
const SIDE: u32 = 64; // [algorithmic]
/// Width of the image, in pixels, for which [`SIDE`] is given: the length of blobs is proportional to the width of an image.
const USUAL_WIDTH: u32 = 640; // [algorithmic]
/// Fewest and most pixels along the side of a square.
const SIDES: [u32; 2] = [24, 128]; // [algorithmic] [algorithmic]
/// Number of samples along each side of a square for the fit of its plane, or a few more.
const SAMPLES: u32 = 16; // [algorithmic]
/// Least part of a square's samples, and of a line's pixels, that has to be measured. If too few squares reach the first value,
/// as in an image that is full of holes, the second one applies.
const MEASURED: [f64; 2] = [0.9, 0.5]; // [tuned] [tuned]
/// Part of all squares that counts as flat: the flattest of them, which show nothing but planes.
const FLAT: f64 = 0.15; // [tuned]
/// Limit on the mean square residual of a square, and of a line in a square, as a multiple of that of the flat squares: beyond it
/// the square is no plane, and the line meets more than the plane. The mean square of 20 blobs, as many as a square has, scatters
/// by a third, so the limit is three standard deviations.
const MAX_SQUARE_RATIO: f64 = 2.0; // [sigmas]
/// Fewest planes from which the noise is estimated.
const MIN_PLANES: usize = 4; // [algorithmic]
/// If parabolas leave less than this part of the residuals of lines from their planes, nothing in the image is flat, as where an
/// object was cut out of it, and the parabolas are subtracted. In recordings of rooms, tables and rocks they leave 0.37 or more,
/// of leaves close to a camera more than 0.2, of a ball without a background before a time-of-flight camera 0.06.
const UNBENT: f64 = 0.2; // [measured]
/// Number of rows and of columns of a square whose autocorrelation is computed.
const LINES_PER_SQUARE: u32 = 4; // [algorithmic]
/// Largest distance in pixels at which a correlation is computed: half of the largest square.
const FARTHEST: usize = SIDES[1] as usize / 2; // [derived]
/// Autocorrelations up to this count as zero: chance causes them, and so do surfaces that are not quite even.
const CHANCE: f64 = 0.1; // [tuned]
/// Largest number of squares whose autocorrelation is computed.
const MAX_SQUARES: usize = 16; // [algorithmic]
/// Upper bound of the part of the noise that the fit of a plane absorbs, which keeps the correction finite.
const MOST_TAKEN: f64 = 0.5; // [algorithmic]
/// Result where no plane is seen: that of a Kinect v1 at 1 m. In three recordings the autocorrelations that `noise_estimator`
/// prints add up to about 6.6 to 7.8 pixels along rows, and to 3.5 to 6.2 along columns (up to 3 m).
pub(super) const UNSEEN: [f64; 2] = [7.0, 4.0]; // [measured]

/// A square of the image with the plane through it.
#[derive(Clone, Copy, Debug)]
struct Square {
    corner: [u32; 2],
    /// Inverse depth at the corner, in 1/m, and its change per pixel along u and v.
    plane: Vector3<f64>,
    depth: f64,
    /// Mean square residual of the depth, in variances of the model.
    square: f64,
}

/// Sums over the samples of a cell, a quarter of a square, for the fit of a plane `1/z = a + b x + c y`; x and y count from the
/// cell's middle.
#[derive(Clone, Copy, Debug)]
struct CellSums {
    /// Number of samples, measured or not.
    samples: usize,
    /// Sums of `[1, x, y, x^2, x y, y^2]` over the samples that are measured: whole numbers, or quarters, and exact.
    places: [f64; 6],
    /// Sums of `[1, x, y]` over the depth, in units of the image.
    right: Vector3<f64>,
    /// Sum of the squared inverse depths.
    squares: f64,
}

/// Buffers, used again for the next image.
#[derive(Debug, Default)]
pub(crate) struct PlaneSquares {
    cells: Vec<CellSums>,
    squares: Vec<Square>,
    /// Residuals of lines along rows and along columns, each as long as the side of a square.
    residuals: [Vec<Residual>; 2],
}

/// Residual of a pixel from its plane, in standard deviations of the model, and 1; zeros where it is not measured.
type Residual = [f64; 2];

/// Sums of the products of two residuals that are 0, 1, ... pixels apart, and the number of these products.
type Covariances = [[f64; 2]; FARTHEST + 1];

/// Returns the number of neighbours along rows, and along columns, that count as one: the mean of many pixels has the variance of
/// one pixel, times this number, over theirs. `view` is set up for the rows of the image, with its noise. [`UNSEEN`] where
/// there are too few planes.
///
/// The level of the noise was estimated from neighbours, which do not show its longer waves. Planes do: where they are less even
/// than the level explains, more neighbours count as one.
pub(crate) fn correlation_px(view: &View, image: &[u16], buffers: &mut PlaneSquares) -> [f64; 2] {
    let half = (SIDE * view.length / USUAL_WIDTH).clamp(SIDES[0], SIDES[1]) / 2;
    buffers.sum_cells(view, image, half);
    MEASURED.into_iter().find_map(|measured| buffers.correlation_of(view, image, half, measured)).unwrap_or(UNSEEN)
}

impl PlaneSquares {
    /// Returns the number of neighbours that count as one, from the squares and lines of which the part `measured` is measured;
    /// `None` where these are too few.
    fn correlation_of(&mut self, view: &View, image: &[u16], half: u32, measured: f64) -> Option<[f64; 2]> {
        self.fit_squares(view, half, measured);
        let (planes, side) = (planes(&mut self.squares)?, 2 * half);
        let mut square = planes.iter().map(|square| square.square).sum::<f64>() / planes.len() as f64;
        let (lines, least) = (&mut self.residuals, measured * f64::from(side));
        for (direction, lines) in lines.iter_mut().enumerate() {
            lines.clear();
            for plane in planes.iter().step_by(planes.len().div_ceil(MAX_SQUARES)) {
                for line in 0..LINES_PER_SQUARE {
                    add_residuals(view, image, plane, (side, direction, line), least, lines);
                }
            }
        }
        let length = side as usize;
        let (mut all, mut left) = (0.0, 0.0);
        for line in lines.iter().flat_map(|lines| lines.chunks_exact(length)) {
            let energy = energy(line);
            all += energy;
            left += energy - parabola(line).map_or(0.0, |(_, explained)| explained);
        }
        if left < UNBENT * all {
            square *= left / all;
            lines.iter_mut().flat_map(|lines| lines.chunks_exact_mut(length)).for_each(unbend);
        }
        let mut px = [0.0; 2];
        for (lines, px) in lines.iter().zip(&mut px) {
            let mut covariances: Covariances = [[0.0; 2]; FARTHEST + 1];
            lines.chunks_exact(length).for_each(|line| add_line(line, square, &mut covariances));
            *px = shared(&covariances)?;
        }
        let level = square / kept(f64::from(side * side) / (px[0] * px[1]));
        Some(px.map(|px| px * level.max(1.0).sqrt()))
    }

    /// Sums up the cells of the image; `half` is their side in pixels.
    fn sum_cells(&mut self, view: &View, image: &[u16], half: u32) {
        let [columns, rows] = cells_of(view, half);
        self.cells.clear();
        for v in (0..view.lines).step_by(half as usize).take(rows) {
            let row = (0..view.length).step_by(half as usize).take(columns);
            self.cells.extend(row.map(|u| sums(view, image, [u, v], half)));
        }
    }

    /// Fits planes to the squares of the image of which the part `measured` is measured. Each square overlaps its neighbours by
    /// half, so cells of half their side are summed once and shared by four squares.
    fn fit_squares(&mut self, view: &View, half: u32, measured: f64) {
        let [columns, rows] = cells_of(view, half);
        self.squares.clear();
        for row in 1..rows {
            for column in 1..columns {
                let quarters =
                    [0, 1, columns, columns + 1].map(|cell| &self.cells[(row - 1) * columns + column - 1 + cell]);
                let corner = [(column - 1) as u32 * half, (row - 1) as u32 * half];
                self.squares.extend(fit(view, quarters, corner, half, measured));
            }
        }
    }
}

/// Returns the number of cells along a row of a view, and the number of their rows; `half` is their side in pixels.
fn cells_of(view: &View, half: u32) -> [usize; 2] {
    [view.length, view.lines].map(|pixels| (pixels / half) as usize)
}

/// Returns the part of the noise that the fit of a plane, with three parameters, leaves at this number of independent points.
fn kept(independent: f64) -> f64 {
    1.0 - (3.0 / independent).min(MOST_TAKEN)
}

/// Returns the sums of a cell with this side in pixels.
fn sums(view: &View, image: &[u16], corner: [u32; 2], side: u32) -> CellSums {
    let (step, middle) = ((2 * side / SAMPLES) as usize, 0.5 * f64::from(side));
    let samples = (step / 2..side as usize).step_by(step);
    let (mut places, mut right, mut squares) = ([0.0; 6], Vector3::zeros(), 0.0);
    for y in samples.clone() {
        let row = &view.line(image, corner[1] + y as u32)[corner[0] as usize..][..side as usize];
        let (mut x, mut x_sums, mut sums) = ((step / 2) as f64 - middle, [0.0; 3], [0.0; 3]);
        for &depth in row[step / 2..].iter().step_by(step) {
            // Unmeasured pixels add zeros, so that no branch depends on the image.
            let (seen, nearness) = if is_measured(depth) { (1.0, 1.0 / f64::from(depth)) } else { (0.0, 0.0) };
            x_sums = [x_sums[0] + seen, x_sums[1] + x * seen, x_sums[2] + x * x * seen];
            sums = [sums[0] + nearness, sums[1] + x * nearness, sums[2] + nearness * nearness];
            x += step as f64;
        }
        let y = y as f64 - middle;
        let [n, sx, sxx] = x_sums;
        let of_row = [n, sx, y * n, sxx, y * sx, y * y * n];
        places.iter_mut().zip(of_row).for_each(|(sum, term)| *sum += term);
        right += Vector3::new(sums[0], sums[1], y * sums[0]);
        squares += sums[2];
    }
    CellSums { samples: samples.len().pow(2), places, right, squares }
}

/// Fits a plane to a square of four cells with the side `half`; `None` where less than the part `measured` is measured.
fn fit(view: &View, quarters: [&CellSums; 4], corner: [u32; 2], half: u32, measured: f64) -> Option<Square> {
    let samples: usize = quarters.iter().map(|cell| cell.samples).sum();
    let count: f64 = quarters.iter().map(|cell| cell.places[0]).sum();
    if count < measured * samples as f64 {
        return None;
    }
    let (middle, off) = (f64::from(half), 0.5 * f64::from(half));
    let (mut places, mut right, mut squares) = ([0.0; 6], Vector3::zeros(), 0.0);
    for (cell, [x, y]) in quarters.into_iter().zip([[-off, -off], [off, -off], [-off, off], [off, off]]) {
        // Moves the origin from the middle of the cell to that of the square.
        let [n, sx, sy, sxx, sxy, syy] = cell.places;
        let (mx, my) = (sx + x * n, sy + y * n);
        let moved = [n, mx, my, sxx + x * (sx + mx), sxy + y * sx + x * my, syy + y * (sy + my)];
        places.iter_mut().zip(moved).for_each(|(sum, term)| *sum += term);
        right += cell.right + Vector3::new(0.0, x, y) * cell.right[0];
        squares += cell.squares;
    }
    let [n, sx, sy, sxx, sxy, syy] = places;
    let matrix = Matrix3::new(n, sx, sy, sx, sxx, sxy, sy, sxy, syy);
    let plane = matrix.cholesky()?.solve(&right);
    let residual = (squares - plane.dot(&right)).max(0.0) / count;
    let plane = plane / view.scale;
    let depth = 1.0 / plane[0];
    let square = residual / (view.scale * view.scale) * depth.powi(4) / view.variance(depth);
    let plane = Vector3::new(plane[0] - middle * (plane[1] + plane[2]), plane[1], plane[2]);
    (depth > 0.0).then_some(Square { corner, plane, depth, square })
}

/// Returns the squares that show nothing but a plane.
fn planes(squares: &mut [Square]) -> Option<&[Square]> {
    squares.sort_unstable_by(|a, b| a.square.total_cmp(&b.square));
    let flattest = squares.get(..MIN_PLANES.max((FLAT * squares.len() as f64) as usize))?;
    let mean = flattest.iter().map(|square| square.square).sum::<f64>() / flattest.len() as f64;
    Some(&squares[..squares.partition_point(|square| square.square <= MAX_SQUARE_RATIO * mean)])
}

/// Adds the residuals of one of the [`LINES_PER_SQUARE`] rows, or columns, of a square from its plane, if at least `least` of its
/// pixels are measured.
fn add_residuals(
    view: &View,
    image: &[u16],
    square: &Square,
    (side, direction, line): (u32, usize, u32),
    least: f64,
    residuals: &mut Vec<Residual>,
) {
    let scale = square.depth.powi(2) / view.variance(square.depth).sqrt();
    let (line, before) = ((2 * line + 1) * side / (2 * LINES_PER_SQUARE), residuals.len());
    residuals.extend((0..side).map(|along| {
        let [x, y] = if direction == 0 { [along, line] } else { [line, along] };
        let depth = view.line(image, square.corner[1] + y)[(square.corner[0] + x) as usize];
        let plane = square.plane.dot(&Vector3::new(1.0, f64::from(x), f64::from(y)));
        if is_measured(depth) { [(1.0 / (f64::from(depth) * view.scale) - plane) * scale, 1.0] } else { [0.0; 2] }
    }));
    let count: f64 = residuals[before..].iter().map(|[_, seen]| seen).sum();
    if count < least {
        residuals.truncate(before);
    }
}

/// Returns the sum of the squared residuals of a line.
fn energy(line: &[Residual]) -> f64 {
    line.iter().map(|[residual, _]| residual * residual).sum()
}

/// Returns the parabola `a + b x + c x^2` that fits a line best, where x goes from -1 to 1 along it, and by how much it reduces the
/// sum of the squared residuals; `None` where the measured pixels are too few.
fn parabola(line: &[Residual]) -> Option<(Vector3<f64>, f64)> {
    let (mut powers, mut right) = ([0.0; 5], [0.0; 3]);
    for ([residual, seen], x) in line.iter().zip(places(line.len())) {
        let square = x * x;
        let terms = [1.0, x, square, square * x, square * square];
        powers.iter_mut().zip(terms).for_each(|(sum, term)| *sum += seen * term);
        right.iter_mut().zip(terms).for_each(|(sum, term)| *sum += residual * term);
    }
    let (matrix, right) = (Matrix3::from_fn(|i, j| powers[i + j]), Vector3::from(right));
    let parabola = matrix.cholesky()?.solve(&right);
    Some((parabola, parabola.dot(&right)))
}

/// Subtracts from a line the parabola that fits it best.
fn unbend(line: &mut [Residual]) {
    let Some((parabola, _)) = parabola(line) else { return };
    let places = places(line.len());
    for ([residual, seen], x) in line.iter_mut().zip(places) {
        *residual -= *seen * parabola.dot(&Vector3::new(1.0, x, x * x));
    }
}

/// Returns the places of the pixels of a line, from -1 to 1.
fn places(length: usize) -> impl Iterator<Item = f64> {
    let middle = 0.5 * (length as f64 - 1.0);
    (0..length).map(move |place| place as f64 / middle - 1.0)
}

/// Adds the products of the residuals of a line; `usual` is the mean square of lines. A line of more than [`MAX_SQUARE_RATIO`]
/// times that is scaled down to it: it meets something that the samples of the plane have missed, such as a thin object, and
/// would outweigh all others.
fn add_line(residuals: &[Residual], usual: f64, covariances: &mut Covariances) {
    let pairs = |apart: usize| {
        let pairs = residuals.iter().zip(&residuals[apart..]);
        pairs.fold([0.0; 2], |[sum, count], (a, b)| [sum + a[0] * b[0], count + a[1] * b[1]])
    };
    let [square, count] = pairs(0);
    let share = (MAX_SQUARE_RATIO * usual * count / square).min(1.0);
    for (apart, [known, known_count]) in covariances.iter_mut().enumerate().take(residuals.len() / 2) {
        let [sum, count] = pairs(apart);
        *known += share * sum;
        *known_count += count;
    }
}

/// Returns the number of neighbours that count as one; `None` without any products.
fn shared(covariances: &Covariances) -> Option<f64> {
    let mean = |[sum, count]: [f64; 2]| if count > 0.0 { sum / count } else { 0.0 };
    let variance = mean(covariances[0]);
    let correlations = covariances[1..].iter().map(|sums| mean(*sums) / variance);
    // Without noise the correlations are NaN, and none is added.
    let sum = correlations.take_while(|correlation| *correlation > CHANCE).sum::<f64>();
    (covariances[0][1] > 0.0).then_some(1.0 + 2.0 * sum)
}

#[cfg(test)]
mod tests {
    use super::super::noise_estimate::NoiseEstimate;
    use super::super::parameters::ExtractorParameters;
    use super::*;
    use conicflow_geometry::Scan;
    use conicflow_lab::random::CounterRng;
    use conicflow_messages::{Camera, Header, NoiseModel};

    /// An image of 150 x 80 pixels and its view, of a sensor with a standard deviation of 1 mm; depths are in units of 0.1 mm.
    fn image(depth_m: impl Fn(u32, u32) -> f64) -> (View, Vec<u16>) {
        let camera = Camera { width: 150, height: 80, fx: 150.0, fy: 150.0, cx: 74.5, cy: 39.5 };
        let noise = NoiseModel { floor_m: 0.001, ..NoiseModel::IDEAL };
        let mut view = View::with(ExtractorParameters::default());
        let header = Header { camera, noise, depth_scale: 1e-4, ..Header::default() };
        view.set_up(&header, Scan::Row, &NoiseEstimate::nominal(noise));
        let pixels = (0..80).flat_map(|y| (0..150).map(move |x| [x, y]));
        (view, pixels.map(|[x, y]| (depth_m(x, y) * 1e4).round() as u16).collect())
    }

    /// The squares of an image with this side, of which the part `measured` is measured.
    fn squares((view, image): &(View, Vec<u16>), side: u32, measured: f64) -> Vec<Square> {
        let mut buffers = PlaneSquares::default();
        buffers.sum_cells(view, image, side / 2);
        buffers.fit_squares(view, side / 2, measured);
        buffers.squares
    }

    fn nearness(x: u32, y: u32) -> f64 {
        0.5 + 0.001 * f64::from(x) - 0.0005 * f64::from(y)
    }

    #[test]
    fn the_plane_of_a_square_is_that_of_the_image_though_pixels_are_missing() {
        // Some of the left columns and upper rows of each square lack pixels, so that nothing is symmetrical.
        let is_missing = |x: u32, y: u32| {
            (x * 7 + y * 3).is_multiple_of(41) || (x % 24 < 5 && y % 24 < 7 && (x + y).is_multiple_of(2))
        };
        let image = image(|x, y| if is_missing(x, y) { 0.0 } else { 1.0 / nearness(x, y) });
        for side in [24, 64] {
            let squares = squares(&image, side, 0.9);
            let places = [150, 80].map(|pixels| pixels / (side / 2) - 1);
            assert_eq!(squares.len() as u32, places[0] * places[1], "they overlap by half");
            for Square { corner, plane, depth, square } in squares {
                assert!(
                    corner
                        .iter()
                        .zip(places)
                        .all(|(at, places)| at.is_multiple_of(side / 2) && at / (side / 2) < places)
                );
                let expected = Vector3::new(nearness(corner[0], corner[1]), 0.001, -0.0005);
                let off = plane - expected;
                let across = f64::from(side) * off.yz().abs().max();
                assert!(off[0].abs() < 1e-5 && across < 2e-5, "{plane:?} at {corner:?}");
                let middle = 1.0 / nearness(corner[0] + side / 2, corner[1] + side / 2);
                assert!((depth / middle - 1.0).abs() < 1e-4, "{depth}");
                assert!((0.0..0.002).contains(&square), "rounding is a thousandth of the noise, {square} of {side}");
            }
        }
    }

    #[test]
    fn a_parabola_is_taken_off_a_line_whatever_is_not_measured() {
        let parabola = |place: f64| 3.0 - 0.4 * place + 0.02 * place * place;
        let is_seen = |place: u32| !place.is_multiple_of(5) && place < 40;
        let random = CounterRng::new(3, 0);
        let residual = |place: u32, noise: f64| {
            let seen = f64::from(is_seen(place));
            [seen * (parabola(f64::from(place)) + noise * random.gaussian(u64::from(place))), seen]
        };
        let left = |noise: f64| {
            let mut line: Vec<Residual> = (0..64).map(|place| residual(place, noise)).collect();
            unbend(&mut line);
            assert!(line.iter().all(|[residual, seen]| *seen > 0.0 || *residual == 0.0));
            energy(&line)
        };
        assert!(left(0.0) < 1e-18, "{}", left(0.0));
        // A parabola absorbs three of 32 points.
        assert!((15.0..45.0).contains(&left(1.0)), "{}", left(1.0));
    }

    /// An object without a background fills the image; the noise of its pixels is independent.
    #[test]
    fn what_is_bent_everywhere_shares_no_noise_for_that() {
        let random = CounterRng::new(9, 0);
        let depth = |bend: f64| {
            move |x: u32, y: u32| {
                let square = (f64::from(x) - 75.0).powi(2) + (f64::from(y) - 40.0).powi(2);
                1.0 + bend * square + 0.001 * random.gaussian(u64::from(150 * y + x))
            }
        };
        for bend in [0.0, 1e-4] {
            let (view, image) = image(depth(bend));
            let shared = correlation_px(&view, &image, &mut PlaneSquares::default());
            assert!(shared.iter().all(|px| *px < 1.5), "{shared:?} where {bend} bends it");
        }
    }

    #[test]
    fn the_residual_of_a_plane_is_the_noise() {
        let random = CounterRng::new(5, 0);
        let noise = |x: u32, y: u32| 0.002 * random.gaussian(u64::from(150 * y + x));
        let squares = squares(&image(|x, y| 1.0 / nearness(x, y) + noise(x, y)), 24, 0.9);
        let mean = squares.iter().map(|square| square.square).sum::<f64>() / squares.len() as f64;
        assert!((3.7..4.3).contains(&mean), "{mean} variances of the model");
    }

    #[test]
    fn a_square_that_lacks_more_of_its_pixels_than_it_may_is_not_looked_at() {
        let squares_with = |(missing, measured): (u32, f64)| {
            // `missing` pixels are missing in each block of 12 x 12, which is a quarter of a square.
            let is_missing = |x: u32, y: u32| y % 12 * 12 + x % 12 < missing;
            let image = image(|x, y| if is_missing(x, y) { 0.0 } else { 1.0 / nearness(x, y) });
            squares(&image, 24, measured).len()
        };
        assert_eq!([(14, 0.9), (15, 0.9), (72, 0.5), (73, 0.5)].map(squares_with), [55, 0, 55, 0]);
    }

    #[test]
    fn planes_are_the_squares_that_leave_little_more_than_the_flattest() {
        let (corner, plane) = ([0, 0], Vector3::zeros());
        let left = |squares: &[f64]| {
            let mut squares: Vec<_> =
                squares.iter().map(|&square| Square { corner, plane, depth: 1.0, square }).collect();
            planes(&mut squares).map(|planes| planes.iter().map(|plane| plane.square).collect::<Vec<_>>())
        };
        assert_eq!(left(&[1.0; 3]), None, "too few");
        assert_eq!(left(&[9.0, 1.0, 2.1, 0.5, 1.5, 1.0, 2.0]), Some(vec![0.5, 1.0, 1.0, 1.5, 2.0]));
        // The flattest of 40 squares are six; the level of four of them would be half as large.
        let many = [&[0.5; 4][..], &[1.9; 6], &[3.0; 30]].concat();
        assert_eq!(left(&many).map(|planes| planes.len()), Some(10));
    }

    const PLANE: Square = Square { corner: [12, 24], plane: Vector3::new(0.5, 0.0, 0.0), depth: 2.0, square: 1.0 };

    /// The covariances of four lines with a noise of one variance that changes its sign every `period` pixels.
    fn covariances_of(period: u32, direction: usize) -> Covariances {
        let sign = |at: u32| if (at / period).is_multiple_of(2) { 0.001 } else { -0.001 };
        let (view, image) = image(|x, y| 2.0 + sign(if direction == 0 { x } else { y }));
        let (mut covariances, mut residuals) = ([[0.0; 2]; FARTHEST + 1], Vec::new());
        for line in 0..LINES_PER_SQUARE {
            add_residuals(&view, &image, &PLANE, (24, direction, line), 24.0, &mut residuals);
        }
        residuals.chunks_exact(24).for_each(|line| add_line(line, 1.0, &mut covariances));
        covariances
    }

    #[test]
    fn covariances_are_those_of_the_rows_or_columns_of_a_square() {
        for direction in [0, 1] {
            let [alternating, pairs] = [1, 2].map(|period| covariances_of(period, direction));
            for (apart, [sum, counted]) in alternating[..12].iter().enumerate() {
                let (count, sign) = (4.0 * (24 - apart) as f64, if apart % 2 == 0 { 1.0 } else { -1.0 });
                assert!(*counted == count && (sum / count - sign).abs() < 0.01, "{sum} of {counted}, {apart} apart");
            }
            assert!((pairs[1][0] / pairs[1][1]).abs() < 0.06 && (pairs[2][0] / pairs[2][1] + 1.0).abs() < 0.01);
            assert!(alternating[12..].iter().all(|sums| *sums == [0.0; 2]), "half a line is the farthest");
        }
    }

    #[test]
    fn of_a_line_with_holes_the_pairs_count_that_are_measured() {
        let (view, mut image) = image(|_, _| 2.001);
        // The hole is in the first row that is read, three pixels below the corner, and in no column that is read.
        image[27 * 150 + 35] = 0;
        let read = |direction: usize, least: f64| {
            let mut residuals = vec![[7.0; 2]; 24];
            add_residuals(&view, &image, &PLANE, (24, direction, 0), least, &mut residuals);
            assert_eq!(residuals[..24], [[7.0; 2]; 24], "what was there stays");
            residuals.split_off(24)
        };
        assert_eq!([0, 1].map(|direction| read(direction, 24.0).len()), [0, 24], "all have to be measured");
        let pairs = [0, 1].map(|direction| {
            let residuals = read(direction, 23.0);
            let count: f64 = residuals.iter().map(|[_, seen]| seen).sum();
            let mut covariances = [[0.0; 2]; FARTHEST + 1];
            add_line(&residuals, 2.0, &mut covariances);
            let [alone, beside, apart] = [0, 1, 5].map(|apart| covariances[apart]);
            assert!([alone, beside, apart].iter().all(|[sum, count]| (sum / count - alone[0] / alone[1]).abs() < 1e-9));
            [count, alone[1], beside[1], apart[1]]
        });
        // The pixel is the last one.
        assert_eq!(pairs, [[23.0, 23.0, 22.0, 18.0], [24.0, 24.0, 23.0, 19.0]]);
    }

    #[test]
    fn a_line_that_meets_a_thin_thing_counts_no_more_than_one_without() {
        let plain = [[[1.0, 1.0]; 4], [[-1.0, 1.0]; 4]].as_flattened().repeat(3);
        let mut beside_a_wire = plain.clone();
        beside_a_wire[10][0] = 100.0;
        let of = |lines: &[&[Residual]]| {
            let mut covariances = [[0.0; 2]; FARTHEST + 1];
            lines.iter().for_each(|line| add_line(line, 1.0, &mut covariances));
            shared(&covariances).unwrap()
        };
        let [usual, wide] = [1.5, 2.0].map(|root| {
            let (line, mut covariances) =
                (plain.iter().map(|[x, one]| [root * x, *one]).collect::<Vec<_>>(), [[0.0; 2]; FARTHEST + 1]);
            add_line(&line, 1.2, &mut covariances);
            covariances.map(|[sum, count]| sum / count)
        });
        // The mean squares are 2.25 and 4, of which at most 2.4 counts.
        assert!((usual[0] - 2.25).abs() < 1e-12 && (wide[0] - 2.4).abs() < 1e-12, "{usual:?} {wide:?}");
        assert!((wide[1] / wide[0] - usual[1] / usual[0]).abs() < 1e-12, "as alike as they are");
        let alone = of(&[&plain]);
        assert!(alone > 2.0, "{alone} of blobs of four");
        // The wire is uncorrelated with its neighbours: as one of eight such lines it reduces their correlation by an eighth.
        let among_others = of(&[&[&plain[..]; 7][..], &[&beside_a_wire]].concat());
        assert!((0.8..1.0).contains(&(among_others / alone)), "{among_others} {alone}");
    }

    /// Some of each 12 columns are not measured: of nearly all rows and squares more than a tenth, or more than a half.
    #[test]
    fn an_image_that_is_full_of_holes_tells_as_well_who_shares_noise_but_not_one_that_is_mostly_holes() {
        let random = CounterRng::new(7, 0);
        // Two neighbours of a row share each noise.
        let noise = |x: u32, y: u32| 0.001 * random.gaussian(u64::from(150 * y + x / 2));
        let shared_with = |holes: u32| {
            let (view, image) = image(|x, y| if x % 12 < holes { 0.0 } else { 2.0 + noise(x, y) });
            correlation_px(&view, &image, &mut PlaneSquares::default())
        };
        for holes in [0, 1, 4] {
            let [rows, columns] = shared_with(holes);
            assert!((1.8..2.3).contains(&rows) && (0.97..1.15).contains(&columns), "{rows} {columns} with {holes}");
        }
        assert_eq!([8, 12].map(shared_with), [UNSEEN; 2]);
    }

    #[test]
    fn neighbours_count_as_one_as_far_as_they_are_surely_alike() {
        let of = |correlations: &[f64]| {
            let mut covariances = [[0.0; 2]; FARTHEST + 1];
            let sums = [&[1.0], correlations].concat();
            for (known, (sum, count)) in covariances.iter_mut().zip(sums.into_iter().zip((1..20).rev())) {
                *known = [4.0 * sum * f64::from(count), f64::from(count)];
            }
            shared(&covariances).unwrap()
        };
        assert_eq!(of(&[]), 1.0);
        assert!((of(&[0.5, 0.25, 0.05, 0.9]) - 2.5).abs() < 1e-12, "what comes back behind zero is chance");
        assert!((of(&[0.5, CHANCE]) - 2.0).abs() < 1e-12);
        assert_eq!(shared(&[[0.0; 2]; FARTHEST + 1]), None, "nothing is known");
        let mut of_an_ideal_sensor = [[0.0; 2]; FARTHEST + 1];
        add_line(&[[0.0, 1.0]; 24], 1.0, &mut of_an_ideal_sensor);
        assert_eq!(shared(&of_an_ideal_sensor), Some(1.0));
        assert_eq!(of(&[-0.5]), 1.0);
    }

    #[test]
    fn a_plane_takes_three_points_of_those_that_are_independent_and_at_most_half() {
        assert!((kept(30.0) - 0.9).abs() < 1e-12);
        assert_eq!([6.0, 2.0].map(kept), [0.5; 2]);
    }

    #[test]
    fn what_planes_take_with_them_and_what_bends_them_widens_what_counts_as_one() {
        let random = CounterRng::new(6, 0);
        let of = |factor: f64, blob: u32| {
            let noise = |x: u32, y: u32| 0.001 * factor * random.gaussian(u64::from(150 * (y / blob) + x / blob));
            let (view, image) = image(|x, y| 2.0 + noise(x, y));
            correlation_px(&view, &image, &mut PlaneSquares::default())
        };
        let ([alone, shared], louder) = ([1, 3].map(|blob| of(1.0, blob)), of(2.0, 1));
        for direction in [0, 1] {
            assert!((0.97..1.1).contains(&alone[direction]), "{alone:?}");
            assert!((2.5..3.6).contains(&shared[direction]), "{shared:?}");
            assert!((louder[direction] / alone[direction] - 2.0).abs() < 0.1, "{louder:?} {alone:?}");
        }
    }
}
