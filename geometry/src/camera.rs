//! The pinhole camera, and the planes through its centre and one row or column of the image.
//!
//! A pixel `(u, v)` of depth z is the point `z (x, y, 1)` with `x = (u - cx) / fx`, `y = (v - cy) / fy`. All points of
//! row v lie in the plane through the camera centre with in-plane coordinates `s = z x`, `t = z k`, `k = sqrt(1 + y^2)`,
//! and `p = (s, t y / k, t / k)`. Rows share the camera's x axis: they are a pencil of planes, not parallel ones.
//! Columns are the same with x and y exchanged.

use crate::Vector3;

/// A pinhole camera without distortion, in pixels; focal lengths are above zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pinhole {
    /// Focal length along x.
    pub fx: f64,
    /// Focal length along y.
    pub fy: f64,
    /// Principal point, x.
    pub cx: f64,
    /// Principal point, y.
    pub cy: f64,
}

/// The direction of a scan line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scan {
    /// A row of the image.
    Row,
    /// A column of the image.
    Column,
}

/// The plane through the camera centre and one scan line.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScanPlane {
    scan: Scan,
    slope: f64,
    stretch: f64,
}

impl Pinhole {
    /// The plane of row or column `line`.
    pub fn plane(&self, scan: Scan, line: f64) -> ScanPlane {
        match scan {
            Scan::Row => ScanPlane::new(scan, self.y(line)),
            Scan::Column => ScanPlane::new(scan, self.x(line)),
        }
    }

    /// The slope `s / z` of the rays through pixel `pixel` of a scan line.
    pub fn ray_slope(&self, scan: Scan, pixel: f64) -> f64 {
        match scan {
            Scan::Row => self.x(pixel),
            Scan::Column => self.y(pixel),
        }
    }

    /// Distance of neighbouring pixels along a scan line, per metre of depth.
    pub fn pixel_pitch(&self, scan: Scan) -> f64 {
        match scan {
            Scan::Row => 1.0 / self.fx,
            Scan::Column => 1.0 / self.fy,
        }
    }

    /// Distance of neighbouring scan lines, per metre of depth.
    pub fn line_pitch(&self, scan: Scan) -> f64 {
        match scan {
            Scan::Row => 1.0 / self.fy,
            Scan::Column => 1.0 / self.fx,
        }
    }

    fn x(&self, u: f64) -> f64 {
        (u - self.cx) / self.fx
    }

    fn y(&self, v: f64) -> f64 {
        (v - self.cy) / self.fy
    }
}

impl ScanPlane {
    /// The plane through the camera's x axis (rows) with `y = slope z`, or through its y axis (columns) with
    /// `x = slope z`.
    pub fn new(scan: Scan, slope: f64) -> Self {
        Self { scan, slope, stretch: (1.0 + slope * slope).sqrt() }
    }

    /// Direction of the scan line of the plane.
    pub fn scan(&self) -> Scan {
        self.scan
    }

    /// `y` of a row, `x` of a column.
    pub fn slope(&self) -> f64 {
        self.slope
    }

    /// Angle from the optical axis, the arc tangent of the slope.
    pub fn angle(&self) -> f64 {
        self.slope.atan()
    }

    /// `k = sqrt(1 + slope^2)`, which turns a depth z into `t = z k`.
    pub fn stretch(&self) -> f64 {
        self.stretch
    }

    /// Unit vector of the s axis, along the scan line.
    pub fn s_axis(&self) -> Vector3 {
        self.embed(1.0, 0.0, 0.0)
    }

    /// Unit vector of the t axis, away from the camera.
    pub fn t_axis(&self) -> Vector3 {
        self.embed(0.0, self.slope / self.stretch, 1.0 / self.stretch)
    }

    /// Unit normal, towards growing line numbers.
    pub fn normal(&self) -> Vector3 {
        self.embed(0.0, 1.0 / self.stretch, -self.slope / self.stretch)
    }

    /// The point of in-plane coordinates `(s, t)`.
    pub fn to_camera(&self, [s, t]: [f64; 2]) -> Vector3 {
        self.embed(s, t * self.slope / self.stretch, t / self.stretch)
    }

    /// In-plane coordinates `(s, t)` of the foot of a point on the plane.
    #[cfg(test)]
    pub(crate) fn to_plane(self, point: &Vector3) -> [f64; 2] {
        [self.s_axis().dot(point), self.t_axis().dot(point)]
    }

    /// Returns a vector with these components along the scan line, across it in the image, and along the view.
    fn embed(&self, along: f64, across: f64, forward: f64) -> Vector3 {
        match self.scan {
            Scan::Row => Vector3::new(along, across, forward),
            Scan::Column => Vector3::new(across, along, forward),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Pinhole = Pinhole { fx: 525.0, fy: 520.0, cx: 319.5, cy: 239.5 };

    #[test]
    fn a_pixel_has_the_same_place_in_its_row_its_column_and_the_camera_frame() {
        let (u, v, z) = (50.0, 400.0, 1.7);
        let point = Vector3::new((u - 319.5) / 525.0, (v - 239.5) / 520.0, 1.0) * z;
        for (scan, line, pixel) in [(Scan::Row, v, u), (Scan::Column, u, v)] {
            let plane = CAMERA.plane(scan, line);
            let coordinates = [z * CAMERA.ray_slope(scan, pixel), z * plane.stretch()];
            assert!((plane.to_camera(coordinates) - point).norm() < 1e-14);
            assert!(plane.normal().dot(&point).abs() < 1e-14);
            let back = plane.to_plane(&point);
            assert!((back[0] - coordinates[0]).hypot(back[1] - coordinates[1]) < 1e-14);
        }
    }

    #[test]
    fn the_axes_of_a_plane_are_orthonormal() {
        let plane = CAMERA.plane(Scan::Column, 600.0);
        let (s, t, n) = (plane.s_axis(), plane.t_axis(), plane.normal());
        for (a, b, expected) in [(s, s, 1.0), (t, t, 1.0), (n, n, 1.0), (s, t, 0.0), (s, n, 0.0), (t, n, 0.0)] {
            assert!((a.dot(&b) - expected).abs() < 1e-14);
        }
    }

    #[test]
    fn pixels_and_lines_are_as_far_apart_as_their_points_in_the_plane_a_metre_ahead() {
        let at = |scan, line, pixel| {
            let plane = CAMERA.plane(scan, line);
            plane.to_camera([CAMERA.ray_slope(scan, pixel), plane.stretch()])
        };
        for scan in [Scan::Row, Scan::Column] {
            let here = at(scan, 30.0, 70.0);
            let along = (at(scan, 30.0, 71.0) - here).norm();
            let across = (at(scan, 31.0, 70.0) - here).norm();
            assert!((CAMERA.pixel_pitch(scan) - along).abs() < 1e-14, "{scan:?}: {along}");
            assert!((CAMERA.line_pitch(scan) - across).abs() < 1e-14, "{scan:?}: {across}");
        }
    }

    #[test]
    fn the_angle_of_a_plane_is_that_of_its_view_to_the_optical_axis_towards_growing_lines() {
        for line in [-900.0, 100.0, 239.5, 700.0] {
            let plane = CAMERA.plane(Scan::Row, line);
            let (forward, view) = (Vector3::z(), plane.t_axis());
            let angle = forward.cross(&view).norm().atan2(forward.dot(&view));
            let signed = if line < CAMERA.cy { -angle } else { angle };
            assert!((plane.angle() - signed).abs() < 1e-14, "{line}");
        }
    }
}
