//! The points of one scan line, split into runs without holes and depth jumps.

use super::parameters::ConicConfig;
use conicflow_detection::camera::pinhole;
use conicflow_geometry::{Pinhole, Scan, ScanPlane};
use conicflow_messages::{Header, is_measured};
use std::ops::Range;

/// A measurement in the plane of its scan line.
#[derive(Clone, Copy, Debug)]
pub(super) struct Point {
    /// Its pixel along the line.
    pub pixel: u32,
    /// Depth, in metres.
    pub depth: f64,
    /// In-plane coordinates, in metres.
    pub st: [f64; 2],
}

/// One scan line; its buffers are used again for the next.
#[derive(Debug)]
pub(super) struct ScanLine {
    pub number: u32,
    pub plane: ScanPlane,
    points: Vec<Point>,
    runs: Vec<Range<usize>>,
}

impl Default for ScanLine {
    fn default() -> Self {
        let plane = Pinhole { fx: 1.0, fy: 1.0, cx: 0.0, cy: 0.0 }.plane(Scan::Row, 0.0);
        Self { number: 0, plane, points: Vec::new(), runs: Vec::new() }
    }
}

impl ScanLine {
    /// Reads line `number` of a depth image and splits it.
    pub fn read(&mut self, header: &Header, pixels: &[u16], scan: Scan, number: u32, config: &ConicConfig) {
        let camera = pinhole(&header.camera);
        (self.number, self.plane) = (number, camera.plane(scan, f64::from(number)));
        let width = header.camera.width as usize;
        let line = number as usize;
        self.points.clear();
        match scan {
            Scan::Row => self.gather(header, &camera, pixels[line * width..(line + 1) * width].iter()),
            Scan::Column => self.gather(header, &camera, pixels[line..].iter().step_by(width)),
        }
        self.split(header, camera.pixel_pitch(scan), config);
    }

    /// The points between two holes or jumps, run by run.
    pub fn runs(&self) -> impl Iterator<Item = &[Point]> {
        self.runs.iter().map(|run| &self.points[run.clone()])
    }

    fn gather<'a>(&mut self, header: &Header, camera: &Pinhole, depths: impl Iterator<Item = &'a u16>) {
        let (scan, stretch) = (self.plane.scan(), self.plane.stretch());
        for (pixel, &depth) in depths.enumerate().filter(|(_, depth)| is_measured(**depth)) {
            let z = f64::from(depth) * header.depth_scale;
            let st = [z * camera.ray_slope(scan, pixel as f64), z * stretch];
            self.points.push(Point { pixel: pixel as u32, depth: z, st });
        }
    }

    fn split(&mut self, header: &Header, pitch: f64, config: &ConicConfig) {
        self.runs.clear();
        let mut start = 0;
        for end in 1..=self.points.len() {
            let broken = match self.points.get(end) {
                Some(next) => !connected(&self.points[end - 1], next, header, pitch, config),
                None => true,
            };
            if broken {
                let trim = config.common.trim_px as usize;
                self.runs.extend((end - start > 2 * trim).then(|| start + trim..end - trim));
                start = end;
            }
        }
    }
}

/// Whether two neighbouring measurements may lie on one surface.
fn connected(a: &Point, b: &Point, header: &Header, pitch: f64, config: &ConicConfig) -> bool {
    let pixels = b.pixel - a.pixel;
    let near = a.depth.min(b.depth);
    let slope = config.conic.jump_slope * pitch * near * f64::from(pixels);
    let step = (b.depth - a.depth).abs();
    // The noise is looked up only where the slope alone does not explain the step.
    let sigma = || header.noise.sigma(near).max(header.depth_scale / 12.0_f64.sqrt());
    let explained = || step <= slope + config.conic.jump_sigmas * sigma();
    pixels <= config.common.max_hole_px + 1 && (step <= slope || explained())
}
