//! Tables and rules that all scan lines of one direction of a depth image share.

use super::averaging::{self, Averaging};
use super::noise_estimate::NoiseEstimate;
use super::parameters::ExtractorParameters;
use crate::camera::pinhole;
use conicflow_geometry::{Pinhole, Scan, ScanPlane};
use conicflow_messages::{Header, NoiseModel, is_measured};
use std::ops::Range;

/// In the limit `error^2 <= v (a sqrt(2/n) + b)` on a right curve (`mod.rs`): a, in standard deviations.
const SCATTER: f64 = 2.5; // [sigmas]
/// In the limit `error^2 <= v (a sqrt(2/n) + b)` on a right curve (`mod.rs`): b, the part of its variance by which the noise
/// model may be wrong.
const SLACK: f64 = 0.6; // [tuned]
/// Mean square roughness of any surface, and so the least variance of its points, in square metres: a tenth of a millimetre,
/// squared. It matters only in images without noise.
pub(crate) const LEAST_VARIANCE: f64 = 1e-8; // [algorithmic]
/// Steepest slope of a surface between neighbouring pixels, as depth per distance across the view. A steeper step is a jump.
const JUMP_SLOPE: f64 = 3.0; // [tuned]
/// Steepest slope of a surface across a hole, as depth per distance across the view.
const HOLE_SLOPE: f64 = 1.5; // [tuned]
/// Standard deviations of the sensor by which a step on one surface may exceed what its slope explains.
const JUMP_SIGMAS: f64 = 4.0; // [sigmas]

/// Factor that keeps a lower bound below the exact value in spite of rounding.
const BELOW: f64 = 0.999; // [algorithmic]
/// The square root of one half in units of 2^-16, rounded down.
const ROOT_HALF: u16 = 46_340; // [derived]
/// Number of neighbours that are tested for jumps together.
pub(super) const JUMP_BATCH: usize = 64; // [algorithmic]
/// Number of neighbouring points that share one variance, that at their mean depth.
pub(super) const SURROUNDINGS: usize = 16; // [algorithmic]

/// The rows or the columns of an image; the tables are used again for the next image.
#[derive(Debug)]
pub(crate) struct View {
    pub parameters: ExtractorParameters,
    pub scan: Scan,
    /// Number of scan lines.
    pub lines: u32,
    /// Number of pixels of a scan line.
    pub length: u32,
    /// Step between the lines that are searched.
    pub step: u32,
    /// Metres per unit of a pixel.
    pub scale: f64,
    camera: Pinhole,
    /// Model of the sensor.
    pub noise: NoiseModel,
    /// Variance of a depth as a multiple of the model's, or of the rounding's where that is larger.
    level: f64,
    /// Number of neighbouring pixels of a line, and of lines, that share their noise.
    pub correlation_px: [f64; 2],
    /// Noise variance of one line over that of a mean of neighbouring ones.
    pub averaged_lines: f64,
    /// How neighbouring lines are averaged.
    averaging: Averaging,
    /// Variance of rounding to the unit of the image, in square metres, the lower bound of all variances.
    pub least: f64,
    /// The jump rules of lines that were averaged over 0, 1, ... lines on either side.
    jumps: Vec<JumpRule>,
    /// The tables of rows, and of columns.
    tables: [Tables; 2],
}

/// Tables for the pixels of a line, with the camera and the correlation that they were made for.
#[derive(Debug, Default)]
struct Tables {
    /// Slope of the ray through each pixel.
    slopes: Vec<f64>,
    camera: Option<Pinhole>,
    /// Limit on the mean square error of 0, 1, ... points, in variances.
    limits: Vec<f64>,
    correlation_px: f64,
}

impl Tables {
    /// Makes the tables for lines of `length` pixels; keeps those that were made for the same arguments.
    fn set(&mut self, camera: Pinhole, scan: Scan, length: u32, correlation_px: f64) {
        let is_as_long = self.slopes.len() == length as usize;
        if !is_as_long || self.camera != Some(camera) {
            self.camera = Some(camera);
            self.slopes.clear();
            self.slopes.extend((0..length).map(|pixel| camera.ray_slope(scan, f64::from(pixel))));
        }
        if !is_as_long || self.correlation_px != correlation_px {
            self.correlation_px = correlation_px;
            let independent = |points: usize| points.saturating_sub(1) as f64 / correlation_px + 1.0;
            self.limits.clear();
            self.limits.extend((0..=length as usize).map(|n| SCATTER * (2.0 / independent(n)).sqrt() + SLACK));
        }
    }
}

impl View {
    pub fn with(parameters: ExtractorParameters) -> Self {
        Self {
            parameters,
            scan: Scan::Row,
            lines: 0,
            length: 0,
            step: 1,
            scale: 0.0,
            camera: Pinhole { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 },
            noise: NoiseModel::IDEAL,
            level: 1.0,
            correlation_px: [1.0; 2],
            averaged_lines: 1.0,
            averaging: Averaging::default(),
            least: 0.0,
            jumps: Vec::new(),
            tables: Default::default(),
        }
    }

    /// Sets up the tables for the rows or the columns of an image of this noise.
    pub fn set_up(&mut self, header: &Header, scan: Scan, noise: &NoiseEstimate) {
        let size = [header.camera.height, header.camera.width];
        [self.lines, self.length] = if scan == Scan::Row { size } else { [size[1], size[0]] };
        self.step = self.parameters.line_step.max(1) * averaging::step(noise.averaged, size);
        (self.scan, self.camera) = (scan, pinhole(&header.camera));
        let ([along, across], averaged) = noise.along(scan);
        // Variance of a mean over lines relative to that of one line; more lines share the noise of means by its inverse.
        let left = averaging::variance(averaged, across);
        (self.noise, self.level, self.scale) = (noise.model, left * noise.level, header.depth_scale);
        (self.correlation_px, self.averaged_lines) = ([along, across / left], 1.0 / left);
        self.averaging.set(averaged, across);
        self.least = self.scale * self.scale / 12.0;
        let pitch = self.pitch();
        let rounding = self.least.sqrt() * noise.level.max(1.0).sqrt();
        let (scale, max_hole_px) = (self.scale, self.parameters.max_hole_px);
        self.jumps.clear();
        self.jumps.extend((0..=self.averaging.reach()).map(|pairs| {
            let model = noise.neighbour_model.times(averaging::variance(2 * pairs + 1, across).sqrt());
            let model = NoiseModel { floor_m: model.floor_m.max(rounding), ..model };
            JumpRule::new(&model, scale, pitch, max_hole_px)
        }));
        self.tables[usize::from(scan == Scan::Column)].set(self.camera, scan, self.length, along);
    }

    fn tables(&self) -> &Tables {
        &self.tables[usize::from(self.scan == Scan::Column)]
    }

    /// Returns the distance between neighbouring pixels of a line at a distance of one metre, in metres.
    pub fn pitch(&self) -> f64 {
        self.camera.pixel_pitch(self.scan)
    }

    /// Returns the plane of a scan line.
    pub fn plane(&self, line: u32) -> ScanPlane {
        self.camera.plane(self.scan, f64::from(line))
    }

    /// Returns the slopes of the rays through some pixels; `buffer` is for pixels with holes between them.
    #[inline]
    pub fn slopes<'a>(&'a self, pixels: &[u32], buffer: &'a mut Vec<f64>) -> &'a [f64] {
        let [first, last] = [pixels.first(), pixels.last()].map(|pixel| pixel.map_or(0, |&pixel| pixel as usize));
        let slopes = &self.tables().slopes;
        if last - first < pixels.len() {
            return &slopes[first..first + pixels.len()];
        }
        buffer.clear();
        buffer.extend(pixels.iter().map(|&pixel| slopes[pixel as usize]));
        buffer
    }

    /// Returns the pixels of a scan line of an image whose scan lines follow one another.
    pub fn line<'a>(&self, image: &'a [u16], line: u32) -> &'a [u16] {
        let length = self.length as usize;
        &image[line as usize * length..][..length]
    }

    /// Returns the pixels `window` of a scan line, of an image whose scan lines follow one another. Where noise requires it, they
    /// are averaged over neighbouring lines; then the second slice has the number of lines on either side for each pixel, else it
    /// is empty.
    pub fn depths<'a>(
        &self,
        image: &'a [u16],
        line: u32,
        window: &Range<u32>,
        buffer: &'a mut DepthBuffer,
    ) -> (&'a [u16], &'a [u16]) {
        let DepthBuffer { means, pairs } = buffer;
        let (first, length) = (window.start as usize, window.len());
        let beside = |by: i64| &self.line(image, (i64::from(line) + by) as u32)[first..][..length];
        if self.averaging.reach() == 0 {
            return (beside(0), &[]);
        }
        for buffer in [&mut *means, &mut *pairs] {
            buffer.resize(buffer.len().max(length), 0);
        }
        // The same number on either side.
        let reach = self.averaging.reach().min(line).min(self.lines - 1 - line);
        self.averaging.average(&self.jumps[0].least, reach, beside, &mut means[..length], &mut pairs[..length]);
        (&means[..length], &pairs[..length])
    }

    /// Returns the mean variance of pixels, relative to that of pixels averaged over all lines; `pairs` has the number of lines
    /// on either side over which each was averaged.
    pub fn variance_ratio(&self, pairs: &[u16]) -> f64 {
        self.averaging.variance(pairs)
    }

    /// Returns the jump rule of a line that was averaged over `pairs` lines on either side; `None`: over all.
    pub fn jumps(&self, pairs: Option<u16>) -> &JumpRule {
        let all = self.jumps.len() - 1;
        &self.jumps[pairs.map_or(all, usize::from)]
    }

    /// Returns the depth of a pixel in metres; `None` outside the image or without a measurement. The image's scan lines follow
    /// one another.
    pub fn depth(&self, image: &[u16], line: u32, pixel: i64) -> Option<f64> {
        let pixel = u32::try_from(pixel).ok().filter(|pixel| *pixel < self.length)?;
        let raw = self.line(image, line)[pixel as usize];
        is_measured(raw).then(|| f64::from(raw) * self.scale)
    }

    /// Returns the variance of a depth, in square metres.
    #[inline]
    pub fn variance(&self, depth: f64) -> f64 {
        (self.level * self.noise.variance(depth).max(self.least)).max(self.least)
    }

    /// Returns the noise of a depth in units of the step that the steepest surface makes between neighbouring pixels.
    pub fn noise_in_steps(&self, depth: f64) -> f64 {
        let step = JUMP_SLOPE * depth * self.pitch();
        JUMP_SIGMAS * self.variance(depth).sqrt() / step
    }

    /// Returns how many lines to average in an image with depths in this range; noise in steps is largest at one end of it.
    pub fn lines_to_average(&self, depths: Option<[f64; 2]>) -> u32 {
        let [_, across] = self.correlation_px;
        let lines = |depth: f64| averaging::lines(self.noise_in_steps(depth), across);
        depths.map_or(1, |depths| depths.map(lines).into_iter().max().unwrap_or(1))
    }

    /// Returns the largest mean square error of `points` points that noise of this variance explains, in square metres.
    #[inline]
    pub fn limit(&self, variance: f64, points: usize) -> f64 {
        variance * self.tables().limits[points] + LEAST_VARIANCE
    }
}

/// Buffers for the pixels of a line.
#[derive(Debug, Default)]
pub(crate) struct DepthBuffer {
    means: Vec<u16>,
    pairs: Vec<u16>,
}

/// Decides whether two measurements in a row may lie on one surface.
#[derive(Clone, Copy, Debug)]
pub(crate) struct JumpRule {
    scale: f32,
    per_metre: f32,
    slope: f32,
    hole_slope: f32,
    floor: f32,
    growth: f32,
    knee: f32,
    step: f32,
    max_pixels: u32,
    least: LeastStep,
}

/// A lower bound of the largest step between neighbours on one surface, in integers, of which processors compare eight at a time.
#[derive(Clone, Copy, Debug)]
pub(super) struct LeastStep {
    /// Part of the step due to constant noise, in units of the image.
    floor: u16,
    /// Depth beyond which the noise grows, in units of the image.
    knee: u16,
    /// Part of the step due to growing noise, per square unit of depth beyond `knee`, times 2^32.
    growth: u16,
    /// Part of the step due to rounding by the sensor, per square unit of depth, times 2^32.
    quantum: u16,
    /// Part of the step due to the slope of a surface, per unit of depth, times 2^16.
    slope: u16,
}

impl LeastStep {
    pub fn new(noise: &NoiseModel, scale: f64, pitch: f64) -> Self {
        let (sigmas, whole) = (BELOW * JUMP_SIGMAS, f64::from(1 << 16));
        let per_square = sigmas * whole * whole * scale;
        Self {
            floor: (sigmas * noise.floor_m / scale) as u16,
            knee: (noise.knee_m / scale).ceil() as u16,
            growth: (per_square * noise.growth_per_m) as u16,
            quantum: (per_square * noise.step_per_m / 12.0_f64.sqrt()) as u16,
            slope: (BELOW * whole * JUMP_SLOPE * pitch) as u16,
        }
    }

    #[inline]
    fn step(&self, near: u16) -> u16 {
        let [noise, slope] = self.noise_and_slope(near);
        noise.saturating_add(slope)
    }

    /// Returns the parts of the step due to noise and due to the slope of a surface.
    #[inline]
    pub fn noise_and_slope(&self, near: u16) -> [u16; 2] {
        let high = |a: u16, b: u16| ((u32::from(a) * u32::from(b)) >> 16) as u16;
        let beyond_knee = near.saturating_sub(self.knee);
        let axial = self.floor.saturating_add(high(high(beyond_knee, beyond_knee), self.growth));
        let quantum = high(high(near, near), self.quantum);
        // The root of a sum of two squares is at least the sum of both numbers over the root of two.
        let noise = axial.max(quantum).max(high(axial.saturating_add(quantum), ROOT_HALF));
        [noise, high(near, self.slope)]
    }
}

impl JumpRule {
    /// Creates the rule for depths in units of `scale` metres, and pixels with a distance of `pitch` per metre of depth.
    fn new(noise: &NoiseModel, scale: f64, pitch: f64, max_hole_px: u32) -> Self {
        let NoiseModel { floor_m, growth_per_m, knee_m, step_per_m } = *noise;
        Self {
            scale: scale as f32,
            per_metre: (1.0 / scale) as f32,
            slope: (JUMP_SLOPE * pitch) as f32,
            hole_slope: (HOLE_SLOPE * pitch) as f32,
            floor: (JUMP_SIGMAS * floor_m) as f32,
            growth: (JUMP_SIGMAS * growth_per_m) as f32,
            knee: knee_m as f32,
            step: (JUMP_SIGMAS * step_per_m / 12.0_f64.sqrt()) as f32,
            max_pixels: max_hole_px + 1,
            least: LeastStep::new(noise, scale, pitch),
        }
    }

    /// Returns whether there is a jump or too large a hole between the raw depths a and b, which are `pixels` apart.
    #[inline]
    pub fn splits(&self, a: u16, b: u16, pixels: u32) -> bool {
        (f32::from(a.abs_diff(b)) > self.largest_step(a.min(b), pixels)) | (pixels > self.max_pixels)
    }

    /// Returns ones where there may be a jump or a hole between a measurement and the next; the others need no exact test.
    #[inline]
    pub fn doubtful(&self, pixels: &[u32], depths: &[u16]) -> [u8; JUMP_BATCH] {
        let mut doubtful = [0; JUMP_BATCH];
        let next = |count: usize| (JUMP_BATCH + 1).min(count);
        let (pixels, depths) = (&pixels[..next(pixels.len())], &depths[..next(depths.len())]);
        for (doubtful, (&a, &b)) in doubtful.iter_mut().zip(depths.iter().zip(&depths[1..])) {
            *doubtful = u8::from(a.abs_diff(b) > self.least.step(a.min(b)));
        }
        if (pixels[pixels.len() - 1] - pixels[0]) as usize >= pixels.len() {
            for (doubtful, (&here, &there)) in doubtful.iter_mut().zip(pixels.iter().zip(&pixels[1..])) {
                *doubtful |= u8::from(there - here > 1);
            }
        }
        doubtful
    }

    /// Returns the largest raw step on one surface from the raw depth `near`; it grows with the depth.
    #[inline]
    fn largest_step(&self, near: u16, pixels: u32) -> f32 {
        let near = f32::from(near) * self.scale;
        let slope = self.slope.max(self.hole_slope * pixels.cast_signed() as f32);
        let beyond_knee = near - self.knee;
        let (axial, quantum) = (self.floor + self.growth * beyond_knee * beyond_knee, self.step * near * near);
        (slope * near + (axial * axial + quantum * quantum).sqrt()) * self.per_metre
    }
}

#[cfg(test)]
mod tests {
    use super::super::transposed::transposed;
    use super::*;
    use conicflow_messages::Camera;

    fn rule() -> JumpRule {
        let camera = Camera { width: 320, height: 240, fx: 290.0, fy: 290.0, cx: 159.5, cy: 119.5 };
        let noise = NoiseModel::KINECT_V1;
        let mut view = View::with(ExtractorParameters::default());
        view.set_up(
            &Header { camera, noise, depth_scale: 1e-3, ..Header::default() },
            Scan::Row,
            &NoiseEstimate::nominal(noise),
        );
        *view.jumps(None)
    }

    #[test]
    fn a_jump_is_more_than_slope_and_noise() {
        let (rule, noise) = (rule(), NoiseModel::KINECT_V1);
        for near in [500_u16, 1000, 2000, 4000] {
            let z = f64::from(near) * 1e-3;
            let largest = 1e3 * (JUMP_SLOPE * z / 290.0 + JUMP_SIGMAS * noise.sigma(z));
            let (within, beyond) = ((largest - 1.0) as u16, (largest + 1.0) as u16);
            assert!(!rule.splits(near, near + within, 1) && !rule.splits(near + within, near, 1));
            assert!(rule.splits(near, near + beyond, 1) && rule.splits(near + beyond, near, 1));
        }
    }

    #[test]
    fn a_hole_allows_more_and_ends_a_run_where_it_is_large() {
        let rule = rule();
        assert!(rule.splits(1000, 1025, 1) && !rule.splits(1000, 1025, 4));
        assert!(!rule.splits(1000, 1000, 4) && rule.splits(1000, 1000, 5));
    }

    #[test]
    fn rounding_is_noise_that_no_model_tells() {
        let camera = Camera { width: 1280, height: 720, fx: 1400.0, fy: 1400.0, cx: 639.5, cy: 359.5 };
        let mut view = View::with(ExtractorParameters::default());
        let header = Header { camera, noise: NoiseModel::IDEAL, depth_scale: 1e-3, ..Header::default() };
        view.set_up(&header, Scan::Row, &NoiseEstimate::nominal(header.noise));
        assert!(!view.jumps(None).splits(300, 301, 1), "one unit on a smooth surface");
        assert!((view.variance(0.3) - 1e-6 / 12.0).abs() < 1e-20);
        view.set_up(&header, Scan::Row, &NoiseEstimate { level: 12.0, ..NoiseEstimate::nominal(header.noise) });
        assert!((view.variance(0.3) - 1e-6).abs() < 1e-18, "as noisy as the image is");
    }

    /// A view of an image of 40 x 30 pixels; along and across the lines 3 and 2 pixels share their noise.
    fn view_of_shared_noise(scan: Scan) -> View {
        let camera = Camera { width: 40, height: 30, fx: 50.0, fy: 40.0, cx: 19.5, cy: 14.5 };
        let mut view = View::with(ExtractorParameters::default());
        let noise = NoiseModel { floor_m: 0.002, ..NoiseModel::IDEAL };
        let header = Header { camera, noise, depth_scale: 1e-3, ..Header::default() };
        view.set_up(&header, scan, &NoiseEstimate { correlation_px: [3.0, 2.0], ..NoiseEstimate::nominal(noise) });
        view
    }

    #[test]
    fn the_limit_of_a_mean_square_is_that_of_as_many_points_as_share_no_noise() {
        let view = view_of_shared_noise(Scan::Row);
        // 13 points, of which three share their noise, count as five: the limit is 2.5 sqrt(2 / 5) + 0.6 variances, plus the
        // roughness.
        let expected = 4e-6 * (2.5 * 0.4_f64.sqrt() + 0.6) + 1e-8;
        assert!((view.limit(4e-6, 13) / expected - 1.0).abs() < 1e-12, "{}", view.limit(4e-6, 13));
        let alone = 4e-6 * (2.5 * 2.0_f64.sqrt() + 0.6) + 1e-8;
        assert!((view.limit(4e-6, 1) / alone - 1.0).abs() < 1e-12);
        assert!(view.limit(4e-6, 40) < expected);
    }

    #[test]
    fn noise_is_told_in_steps_of_the_steepest_surface_along_the_line() {
        for (scan, focal) in [(Scan::Row, 50.0), (Scan::Column, 40.0)] {
            let steps = 4.0 * 0.002 / (3.0 * 2.5 / focal);
            assert!((view_of_shared_noise(scan).noise_in_steps(2.5) / steps - 1.0).abs() < 1e-12, "{scan:?}");
        }
    }

    #[test]
    fn a_depth_is_that_of_its_pixel_if_there_is_one_and_it_is_measured() {
        let mut image = vec![0; 40 * 30];
        (image[7 * 40 + 3], image[7 * 40 + 39]) = (1500, 1600);
        let columns = transposed(&image, 40, &mut Vec::new()).to_vec();
        let depth = |scan, line, pixel| {
            let lines = if scan == Scan::Row { &image } else { &columns };
            view_of_shared_noise(scan).depth(lines, line, pixel)
        };
        assert_eq!([depth(Scan::Row, 7, 3), depth(Scan::Column, 3, 7)], [Some(1.5); 2]);
        assert_eq!((depth(Scan::Row, 7, 39), depth(Scan::Row, 7, 40)), (Some(1.6), None));
        assert_eq!([depth(Scan::Row, 7, -1), depth(Scan::Row, 8, 3), depth(Scan::Column, 39, 30)], [None; 3]);
    }

    #[test]
    fn slopes_are_those_of_the_pixels_with_holes_between_them_or_without() {
        let view = view_of_shared_noise(Scan::Column);
        for pixels in [vec![4, 5, 6], vec![4, 6, 7], vec![29], vec![]] {
            let mut buffer = vec![9.0];
            let slopes = view.slopes(&pixels, &mut buffer);
            assert_eq!(slopes.len(), pixels.len());
            for (slope, pixel) in slopes.iter().zip(&pixels) {
                assert!((slope - (f64::from(*pixel) - 14.5) / 40.0).abs() < 1e-12, "{pixels:?}");
            }
        }
    }

    #[test]
    fn nothing_splits_but_what_is_doubtful() {
        let (rule, pixels) = (rule(), [10, 11, 12, 13, 14, 15]);
        let mut none = 0;
        for seed in 0..2000_u32 {
            let random = |i: u32| (seed * 6 + i).wrapping_mul(2_654_435_761) >> 8;
            let depths: [u16; 6] = std::array::from_fn(|i| 1500 + (random(i as u32) % (seed / 20 + 1)) as u16);
            let doubtful = rule.doubtful(&pixels, &depths);
            none += usize::from(doubtful == [0; JUMP_BATCH]);
            for (pair, doubtful) in depths.windows(2).zip(doubtful) {
                assert!(doubtful == 1 || !rule.splits(pair[0], pair[1], 1), "{depths:?}");
            }
        }
        assert!((200..1800).contains(&none), "{none} without");
        assert_eq!(rule.doubtful(&[10, 11, 13], &[1500, 1500, 1500])[..3], [0, 1, 0]);
    }
}
