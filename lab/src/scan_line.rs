//! The scan lines of a depth image for the baselines, and the messages of ellipses fitted to their points.

use conicflow_detection::ScanLines;
use conicflow_detection::camera::{pinhole, scan_code};
use conicflow_geometry::{self as geometry, PlaneMoments, Scan, ScanPlane};
use conicflow_messages::{Ellipse, Header, is_measured};

/// A measurement in the plane of its scan line.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Point {
    /// Its pixel along the line.
    pub pixel: u32,
    /// Depth, in metres.
    pub depth: f64,
    /// In-plane coordinates, in metres.
    pub st: [f64; 2],
}

/// One scan line.
#[derive(Debug)]
pub(crate) struct ScanLine {
    number: u32,
    /// Distance between the scan lines in use, in lines of the image.
    step: u32,
    pub plane: ScanPlane,
    pub points: Vec<Point>,
}

impl ScanLine {
    /// Every `step`th row or column of a depth image, or of both.
    pub fn all(header: &Header, pixels: &[u16], scan: ScanLines, step: u32) -> impl Iterator<Item = Self> {
        scan.directions().iter().flat_map(move |&scan| {
            let lines = if scan == Scan::Row { header.camera.height } else { header.camera.width };
            (0..lines).step_by(step.max(1) as usize).map(move |number| Self::read(header, pixels, scan, number, step))
        })
    }

    fn read(header: &Header, pixels: &[u16], scan: Scan, number: u32, step: u32) -> Self {
        let camera = pinhole(&header.camera);
        let plane = camera.plane(scan, f64::from(number));
        let (width, line) = (header.camera.width as usize, number as usize);
        let (first, stride, length) = match scan {
            Scan::Row => (line * width, 1, width),
            Scan::Column => (line, width, header.camera.height as usize),
        };
        let depths = (0..).zip(pixels[first..].iter().step_by(stride).take(length));
        let points = depths.filter(|(_, depth)| is_measured(**depth)).map(|(pixel, depth)| {
            let depth = f64::from(*depth) * header.depth_scale;
            Point { pixel, depth, st: [depth * camera.ray_slope(scan, f64::from(pixel)), depth * plane.stretch()] }
        });
        Self { number, step, plane, points: points.collect() }
    }

    /// Returns the message of an ellipse fitted to points with these moments; the first and the last point are at these pixels.
    pub fn message(
        &self,
        ellipse: &geometry::Ellipse,
        [first, last]: [u32; 2],
        moments: &PlaneMoments,
        rms: f64,
        arc: f64,
    ) -> Ellipse {
        Ellipse {
            scan: scan_code(self.plane.scan()),
            line: self.number,
            line_step: self.step,
            first,
            last,
            points: moments.count() as u32,
            center: self.plane.to_camera(ellipse.center).into(),
            plane_center: ellipse.center,
            semi_axes: ellipse.semi_axes,
            angle: ellipse.angle,
            half_width: ellipse.half_extents[0],
            half_depth: ellipse.half_extents[1],
            rms,
            arc,
            origin: moments.origin(),
            moments: *moments.sums(),
            ..Ellipse::default()
        }
    }
}

/// Returns the angle between two points of an ellipse, seen from its centre, over the side that faces the camera.
pub(crate) fn span(ellipse: &geometry::Ellipse, [first, last]: [[f64; 2]; 2]) -> f64 {
    let from_front = |[s, t]: [f64; 2]| (s - ellipse.center[0]).atan2(ellipse.center[1] - t);
    (from_front(last) - from_front(first)).abs()
}
