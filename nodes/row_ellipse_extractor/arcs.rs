//! Arcs for the pooled fits of the assembler: a scan line is cut where neither a line nor a circle explains its points.
//!
//! Running sums of unbiased moments give the moments of any interval by one subtraction, so an interval grows by
//! galloping and bisection, with a handful of fits in place of one per point. On an arc of less than half a turn a
//! circle is a far better judge than a free ellipse; the true shape is left to the pooled fit. Unbiased moments put the
//! expected error of the right curve at zero, so the limit is what the noise of n points scatters:
//! `error^2 <= sigma^2 (a sqrt(2 / n) + b)`.

use super::RowEllipseConfig;
use super::filter::{Rejection, Rejections};
use super::pinhole;
use conicflow_geometry::{ArcFit, Circle, Pinhole, PlaneMoments, RaySums, Scan, ScanPlane, line_square};
use conicflow_messages::{Ellipse, Header, NoiseModel, is_measured};
use std::ops::Range;

/// The limit's `a`: how many standard deviations the error of a right curve may scatter.
const SCATTER: f64 = 2.5;
/// The limit's `b`: part of the variance that the noise model may be wrong by.
const SLACK: f64 = 0.3;
/// Significance that the error of a line has to exceed that of the circle by, in standard deviations, where the arc is
/// a part of a run.
const CURVED: f64 = 3.0;
/// Slope of a surface (depth per distance across the view) that neighbouring pixels may show ...
const JUMP_SLOPE: f64 = 3.0;
/// ... and those on the two sides of a hole;
const HOLE_SLOPE: f64 = 1.5;
/// how many standard deviations of the sensor a step may be on top of it.
const JUMP_SIGMAS: f64 = 4.0;
/// Points on each side of a crease that are compared with the three in it.
const WING: usize = 5;
/// Depth of a crease, in standard deviations of the sensor.
const CREASE: f64 = 7.0;
/// How many standard deviations the mean of a few points at an end may be off the circle through the others.
const STRAYING: f64 = 2.0;
/// Number of points whose mean depth tells the variance of each.
const SURROUNDINGS: usize = 16;
/// Fewest points of a curve that tells how noisy the sensor is.
const TELLING: usize = 12;
/// Most pixels between a contour and what is seen behind it that count: a wider gap is the shadow of the sensor.
const MAX_GAP: f64 = 3.0;
/// Besides `trim_px`, one point in so many is taken off each end: edges are smeared the wider, the larger they are seen.
const SMEARED: usize = 32;
/// Fewest points of an arc that goes on although it is not curved, because it is set off by jumps.
const SET_OFF: usize = 8;
/// Fewest points whose error means anything.
const FIRST_FIT: usize = 5;

/// One scan line; its buffers are used again for the next.
#[derive(Debug)]
pub(super) struct RayLine {
    scan: Scan,
    number: u32,
    plane: ScanPlane,
    pixels: Vec<u32>,
    slopes: Vec<f64>,
    depths: Vec<f64>,
    variances: Vec<f64>,
    runs: Vec<Range<usize>>,
    /// Running sums of one run, beginning with nothing.
    sums: Vec<RaySums>,
    /// Where a run is cut, its ends included.
    cuts: Vec<usize>,
    /// Depth of each pixel of the line, 0 where none was measured.
    all: Vec<f64>,
}

/// An interval of a part of a run.
#[derive(Clone, Copy, Debug)]
struct Interval {
    part: [usize; 2],
    from: usize,
    to: usize,
}

impl Default for RayLine {
    fn default() -> Self {
        let plane = Pinhole { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 }.plane(Scan::Row, 0.0);
        Self {
            scan: Scan::Row,
            number: 0,
            plane,
            pixels: Vec::new(),
            slopes: Vec::new(),
            depths: Vec::new(),
            variances: Vec::new(),
            runs: Vec::new(),
            sums: Vec::new(),
            cuts: Vec::new(),
            all: Vec::new(),
        }
    }
}

impl RayLine {
    /// Reads line `number` of a depth image and splits it at jumps and holes; the sensor's variance is `quiet` times that
    /// of its model.
    pub fn read(
        &mut self,
        header: &Header,
        quiet: f64,
        pixels: &[u16],
        (scan, number): (Scan, u32),
        config: &RowEllipseConfig,
    ) {
        let camera = pinhole(&header.camera);
        (self.scan, self.number, self.plane) = (scan, number, camera.plane(scan, f64::from(number)));
        let (width, line) = (header.camera.width as usize, number as usize);
        match scan {
            Scan::Row => self.gather(header, &camera, pixels[line * width..(line + 1) * width].iter()),
            Scan::Column => self.gather(header, &camera, pixels[line..].iter().step_by(width)),
        }
        self.split(&header.noise, camera.pixel_pitch(scan), config);
        self.weigh(&header.noise, quiet, (0.5 * header.depth_scale).powi(2));
    }

    /// Adds the errors of the lines and circles of this line, in variances of the sensor.
    pub fn errors(&mut self, config: &RowEllipseConfig, errors: &mut Vec<f64>) {
        for index in 0..self.runs.len() {
            let run = self.runs[index].clone();
            self.sum(run.clone());
            let (whole, mut from) = (0..run.len(), 0);
            while run.len() - from >= TELLING {
                let (length, _) = self.longest(&run, &whole, from, config);
                let fit = ArcFit::new(&self.moments(from, from + length)).filter(|_| length >= TELLING);
                let variance = self.variance(&run, from, from + length);
                errors.extend(fit.map(|fit| fit.line_square.min(fit.circle_square) / variance));
                from += length;
            }
        }
    }

    /// Adds the arcs of the line to `ellipses`.
    pub fn arcs(&mut self, config: &RowEllipseConfig, ellipses: &mut Vec<Ellipse>, rejections: &mut Rejections) {
        for index in 0..self.runs.len() {
            let run = self.runs[index].clone();
            if run.len() < FIRST_FIT {
                rejections.count(Rejection::FewPoints);
                continue;
            }
            self.sum(run.clone());
            self.cut(&run);
            for piece in 0..self.cuts.len() - 1 {
                self.arcs_of(&run, self.cuts[piece]..self.cuts[piece + 1], config, ellipses, rejections);
            }
        }
    }

    /// Adds the arcs of a part of a run.
    fn arcs_of(
        &self,
        run: &Range<usize>,
        part: Range<usize>,
        config: &RowEllipseConfig,
        ellipses: &mut Vec<Ellipse>,
        rejections: &mut Rejections,
    ) {
        let mut from = part.start;
        while part.end - from >= FIRST_FIT {
            let (length, is_curve) = self.longest(run, &part, from, config);
            let interval = Interval { part: [part.start, part.end], from, to: from + length };
            match if is_curve { self.accept(run, interval, config) } else { Err(Rejection::Line) } {
                Ok(ellipse) => ellipses.push(ellipse),
                Err(reason) => rejections.count(reason),
            }
            from += length;
        }
    }

    /// Cuts a run that no line and no circle explains at its creases that are open to the camera, as where an object
    /// stands on a floor.
    fn cut(&mut self, run: &Range<usize>) {
        self.cuts.clear();
        self.cuts.push(0);
        if !self.is_line(run, 0, run.len()) && !self.is_circle(run, 0, run.len()) {
            let mut deepest: Option<(usize, f64)> = None;
            for at in WING + 1..run.len().saturating_sub(WING + 1) {
                let depth = self.crease(at) / self.variances[run.start + at].sqrt();
                if depth > CREASE {
                    if deepest.is_none_or(|(_, most)| depth > most) {
                        deepest = Some((at, depth));
                    }
                } else if let Some((at, _)) = deepest.take() {
                    self.cuts.push(at);
                }
            }
            self.cuts.extend(deepest.map(|(at, _)| at));
        }
        self.cuts.push(run.len());
    }

    /// How much deeper the points about `at` are than those to both sides.
    fn crease(&self, at: usize) -> f64 {
        let mean = |from: usize, to: usize| (self.sums[to].0[2] - self.sums[from].0[2]) / (to - from) as f64;
        2.0 * mean(at - 1, at + 2) - mean(at - 1 - WING, at - 1) - mean(at + 2, at + 2 + WING)
    }

    fn gather<'a>(&mut self, header: &Header, camera: &Pinhole, depths: impl Iterator<Item = &'a u16>) {
        self.pixels.clear();
        self.slopes.clear();
        self.depths.clear();
        self.all.clear();
        for (pixel, &depth) in depths.enumerate() {
            if !is_measured(depth) {
                self.all.push(0.0);
                continue;
            }
            let z = f64::from(depth) * header.depth_scale;
            self.all.push(z);
            self.pixels.push(pixel as u32);
            self.slopes.push(camera.ray_slope(self.scan, pixel as f64));
            self.depths.push(z);
        }
    }

    /// The variance of each measurement, at the mean depth of its surroundings: were it taken at the measured depth, it
    /// would go with the noise and spoil the moments that it is to correct. It is no less than
    /// what the steps of the depth's unit make.
    fn weigh(&mut self, noise: &NoiseModel, quiet: f64, least: f64) {
        self.variances.resize(self.depths.len(), 0.0);
        for run in &self.runs {
            let (depths, variances) = (&self.depths[run.clone()], &mut self.variances[run.clone()]);
            for (depths, variances) in depths.chunks(SURROUNDINGS).zip(variances.chunks_mut(SURROUNDINGS)) {
                let mean = depths.iter().sum::<f64>() / depths.len() as f64;
                variances.fill((quiet * noise.variance(mean)).max(least));
            }
        }
    }

    fn split(&mut self, noise: &NoiseModel, pitch: f64, config: &RowEllipseConfig) {
        self.runs.clear();
        let mut start = 0;
        for end in 1..=self.depths.len() {
            if end == self.depths.len() || !self.connected(end, noise, pitch, config) {
                self.runs.push(start..end);
                start = end;
            }
        }
    }

    /// Whether the measurement `next` and the one before may lie on one surface.
    fn connected(&self, next: usize, noise: &NoiseModel, pitch: f64, config: &RowEllipseConfig) -> bool {
        let pixels = self.pixels[next] - self.pixels[next - 1];
        let (a, b) = (self.depths[next - 1], self.depths[next]);
        let (near, step) = (a.min(b), (b - a).abs());
        let reach = JUMP_SLOPE.max(HOLE_SLOPE * f64::from(pixels)) * pitch * near;
        pixels <= config.max_hole_px + 1 && (step <= reach || step <= reach + JUMP_SIGMAS * noise.sigma(near))
    }

    fn sum(&mut self, run: Range<usize>) {
        self.sums.clear();
        let mut sums = RaySums::default();
        self.sums.push(sums);
        for i in run {
            sums = sums.with(self.slopes[i], self.depths[i], self.variances[i]);
            self.sums.push(sums);
        }
    }

    /// Moments of an interval of the run.
    fn moments(&self, from: usize, to: usize) -> PlaneMoments {
        self.sums[to].since(&self.sums[from]).moments(self.plane.stretch())
    }

    /// Variance of the sensor in the middle of an interval, in the scan plane.
    fn variance(&self, run: &Range<usize>, from: usize, to: usize) -> f64 {
        self.variances[run.start + (from + to) / 2] * self.plane.stretch() * self.plane.stretch()
    }

    fn is_line(&self, run: &Range<usize>, from: usize, to: usize) -> bool {
        line_square(&self.moments(from, to)) <= limit(self.variance(run, from, to), to - from)
    }

    fn is_circle(&self, run: &Range<usize>, from: usize, to: usize) -> bool {
        let most = limit(self.variance(run, from, to), to - from);
        ArcFit::new(&self.moments(from, to)).is_some_and(|fit| fit.circle_square <= most)
    }

    /// Distance of the ends of a run.
    fn width(&self, run: &Range<usize>) -> f64 {
        let st = |i: usize| [self.slopes[i] * self.depths[i], self.plane.stretch() * self.depths[i]];
        let (a, b) = (st(run.start), st(run.end - 1));
        (a[0] - b[0]).hypot(a[1] - b[1])
    }

    /// Length of the longest interval from `from` on that one curve explains, and whether that has to be a circle.
    fn longest(
        &self,
        run: &Range<usize>,
        part: &Range<usize>,
        from: usize,
        config: &RowEllipseConfig,
    ) -> (usize, bool) {
        let most = part.end - from;
        if self.is_line(run, from, part.end) {
            return (most, from == part.start && self.width(run) < 2.0 * config.max_radius_m);
        }
        if self.is_circle(run, from, part.end) {
            return (most, true);
        }
        let line = gallop(FIRST_FIT, most, |length| self.is_line(run, from, from + length));
        let circle = gallop(line, most, |length| self.is_circle(run, from, from + length));
        (circle, circle > line + line / 8 + 1)
    }

    /// The arc of an interval, or why it is none.
    fn accept(&self, run: &Range<usize>, interval: Interval, config: &RowEllipseConfig) -> Result<Ellipse, Rejection> {
        let Interval { from, to, .. } = self.trimmed(run, interval, config);
        if to < from + FIRST_FIT - 1 {
            return Err(Rejection::FewPoints);
        }
        let moments = self.moments(from, to);
        let fit = ArcFit::new(&moments).ok_or(Rejection::NoEllipse)?;
        let mean = moments.mean().ok_or(Rejection::NoEllipse)?;
        let scatter = self.variance(run, from, to) * (2.0 / (to - from) as f64).sqrt();
        let is_whole = [interval.from, interval.to] == interval.part;
        let limits = config.min_radius_m..4.0 * config.max_radius_m;
        let is_line = fit.line_square - fit.circle_square.max(0.0) < if is_whole { 0.0 } else { CURVED * scatter };
        let fit = if is_line || !fit.circle.radius.is_finite() {
            Err(Rejection::Line)
        } else if fit.circle.center[1] <= mean[1] {
            Err(Rejection::Concave)
        } else if !limits.contains(&fit.circle.radius) {
            Err(Rejection::Radius)
        } else {
            Ok(fit)
        };
        let contour = self.contour(run, [interval.from == 0, interval.to == run.len()]);
        let may_be_part = is_whole && to - from >= SET_OFF && contour != [0.0; 2];
        let may_be_part = may_be_part && self.width(run) < 2.0 * config.max_radius_m;
        let fit =
            fit.or_else(|why| if may_be_part { Ok(nearly_flat(&moments, mean, limits.end)) } else { Err(why) })?;
        let mut ellipse = self.message(run.start + from..run.start + to, &fit, &moments.about(mean), config);
        ellipse.contour = contour;
        Ok(ellipse)
    }

    /// What is left of an interval when the ends that may belong to something else are taken off: pixels at a jump mix
    /// two depths, and where a curve breaks it has taken in some points of what follows.
    fn trimmed(&self, run: &Range<usize>, interval: Interval, config: &RowEllipseConfig) -> Interval {
        let Interval { part, mut from, mut to } = interval;
        let trim = config.trim_px as usize + (to - from) / SMEARED;
        let (starts_run, ends_run) = (from == part[0], to == part[1]);
        from += trim;
        to = to.saturating_sub(trim).max(from);
        for _ in 0..4 {
            let few = ((to - from) / 8).max(3);
            if to - from < 2 * FIRST_FIT + few {
                break;
            }
            let strays_behind = !ends_run && self.strays(run, from..to - few, to - few..to);
            let strays_before = !starts_run && self.strays(run, from + few..to, from..from + few);
            to -= if strays_behind { few } else { 0 };
            from += if strays_before { few } else { 0 };
            if !(strays_behind || strays_before) {
                break;
            }
        }
        Interval { from, to, ..interval }
    }

    /// Whether the points of `few` are off the circle through those of `others`.
    fn strays(&self, run: &Range<usize>, others: Range<usize>, few: Range<usize>) -> bool {
        let Some(fit) = ArcFit::new(&self.moments(others.start, others.end)) else { return false };
        let ([s, t], radius) = (fit.circle.center, fit.circle.radius);
        let block = self.moments(few.start, few.end);
        let m = |p, q| block.get(p, q) / block.count();
        let square = m(2, 0) + m(0, 2) - 2.0 * (s * m(1, 0) + t * m(0, 1)) + s * s + t * t;
        let off = (square - radius * radius) / (2.0 * radius);
        off.powi(2) > STRAYING.powi(2) * self.variance(run, few.start, few.end) / few.len() as f64
    }

    fn message(
        &self,
        points: Range<usize>,
        fit: &ArcFit,
        moments: &PlaneMoments,
        config: &RowEllipseConfig,
    ) -> Ellipse {
        let [first, last] = [points.start, points.end - 1];
        let radius = fit.circle.radius;
        let beyond = config.trim_px + 2 + points.len() as u32 / 8;
        let from_front = |i: usize| {
            let st = [self.slopes[i] * self.depths[i], self.plane.stretch() * self.depths[i]];
            (st[0] - fit.circle.center[0]).atan2(fit.circle.center[1] - st[1])
        };
        Ellipse {
            scan: if self.scan == Scan::Row { 0 } else { 1 },
            line: self.number,
            first: self.pixels[first],
            last: self.pixels[last],
            points: points.len() as u32,
            sigma: self.variances[(first + last) / 2].sqrt(),
            beyond_px: beyond,
            unbiased: 1,
            center: self.plane.to_camera(fit.circle.center).into(),
            plane_center: fit.circle.center,
            semi_axes: [radius; 2],
            half_width: radius,
            half_depth: radius,
            rms: fit.circle_square.max(0.0).sqrt(),
            arc: (from_front(last) - from_front(first)).abs(),
            beyond: [self.depth_near(self.pixels[first], beyond, -1), self.depth_near(self.pixels[last], beyond, 1)],
            origin: moments.origin(),
            moments: *moments.sums(),
            ..Ellipse::default()
        }
    }

    /// Where a run ends before something farther behind it, on the sides on which it `ends`.
    fn contour(&self, run: &Range<usize>, ends: [bool; 2]) -> [f64; 2] {
        let [first, last] = [run.start, run.end - 1].map(|i| (self.pixels[i], self.depths[i]));
        let next = |neighbor: Option<usize>, (pixel, z): (u32, f64), ends: bool| {
            let other = neighbor.filter(|_| ends)?;
            let (there, behind) = (self.pixels.get(other)?, self.depths.get(other)?);
            let away = f64::from(*there) - f64::from(pixel);
            (*behind > z).then(|| f64::from(pixel) + 0.5 * away.clamp(-MAX_GAP, MAX_GAP))
        };
        let before = next(run.start.checked_sub(1), first, ends[0]);
        let after = next(Some(run.end), last, ends[1]);
        [before.unwrap_or(0.0), after.unwrap_or(0.0)]
    }

    /// The depth `distance` pixels from `pixel`, or else a little farther; 0 where there is none.
    fn depth_near(&self, pixel: u32, distance: u32, side: i64) -> f64 {
        let at = |more: i64| usize::try_from(i64::from(pixel) + side * (i64::from(distance) + more)).ok();
        let depth = |more: i64| at(more).and_then(|index| self.all.get(index)).copied().filter(|z| *z > 0.0);
        depth(0).or_else(|| depth(1)).or_else(|| depth(2)).unwrap_or(0.0)
    }
}

/// A circle as flat as any may be that touches the points: an arc of noisy points that is set off by jumps may be part of
/// an object even where the noise bends it the wrong way.
fn nearly_flat(moments: &PlaneMoments, mean: [f64; 2], radius: f64) -> ArcFit {
    let away = 1.0 / mean[0].hypot(mean[1]);
    let circle = Circle { center: mean.map(|x| x * (1.0 + radius * away)), radius };
    let line_square = line_square(moments);
    ArcFit { line_square, circle_square: line_square, circle }
}

/// Largest mean square error that the noise accounts for.
fn limit(variance: f64, points: usize) -> f64 {
    variance * (SCATTER * (2.0 / points as f64).sqrt() + SLACK) + 1e-8
}

/// The greatest length up to `most` that is explained, from `least` on, if those explained are without gaps.
fn gallop(least: usize, most: usize, explained: impl Fn(usize) -> bool) -> usize {
    let (mut good, mut bad) = (least.min(most), most + 1);
    while good + 1 < bad {
        let trial = if bad > most { (good + good / 2 + 1).min(most) } else { (good + bad) / 2 };
        if explained(trial) {
            good = trial;
        } else {
            bad = trial;
        }
        if good == most {
            break;
        }
    }
    good
}
