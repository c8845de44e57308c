//! Ellipses: what the extractor finds in one scan line, with the moments of the points that it fitted.

use crate::{Header, Item, Malformed, coded::coded, item::check_each, item::finite};
use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};

/// Number of moments `sum s^p t^q`, p + q <= 4.
pub const MOMENTS: usize = 15;

/// Number of points at either end of an arc that are listed individually. Few silhouettes add or spoil more: with 4, 6 and 12 of
/// them, 499, 503 and 502 of 520 things are found in recordings (`experiments/README.md`, "The recorded ball").
pub const END_POINTS: usize = 6;

/// The direction of a scan line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Scan {
    /// A row of the image: `line` is v, pixels are counted along u.
    Row,
    /// A column of the image: `line` is u, pixels are counted along v.
    Column,
}

coded!(Scan: Row = 0 "row", Column = 1 "column");

/// An ellipse in the plane through the camera centre and one scan line.
///
/// In-plane coordinates, for a row v with `y = (v - cy) / fy` and `k = sqrt(1 + y^2)`: `s = z (u - cx) / fx` along the line and
/// `t = z k` away from the camera; a point is `(s, t y / k, t / k)` in the camera frame. For a column, x and y are swapped.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable, PartialEq, Serialize, Deserialize)]
pub struct Ellipse {
    /// [`Scan::code`].
    pub scan: u32,
    /// Number of the row or column.
    pub line: u32,
    /// First pixel of the arc along the line.
    pub first: u32,
    /// Last pixel of the arc along the line.
    pub last: u32,
    /// Number of measurements in the arc, without holes.
    pub points: u32,
    /// How many pixels before `first` and after `last` the depths in `beyond` were measured.
    pub beyond_px: u32,
    /// 1: the moments are corrected for the bias that the sensor's noise causes; 0: they are plain sums.
    pub unbiased: u32,
    /// The extractor processed every `line_step`-th line; 0 stands for 1, all of them.
    pub line_step: u32,
    /// Centre in the camera frame, in metres.
    pub center: [f64; 3],
    /// Centre in the plane `(s, t)`, in metres.
    pub plane_center: [f64; 2],
    /// Semi-axes, the longer first, in metres.
    pub semi_axes: [f64; 2],
    /// Angle of the longer axis from the s axis, in (-pi/2, pi/2].
    pub angle: f64,
    /// Half the extent of the ellipse along s, across the view, in metres.
    pub half_width: f64,
    /// Half the extent along t, along the view, in metres: the paper's r2.
    pub half_depth: f64,
    /// Root mean square distance of the points from the ellipse, in metres; in excess of the noise if the moments are unbiased.
    pub rms: f64,
    /// Angle that the arc spans around the centre, in radians.
    pub arc: f64,
    /// Standard deviation of a depth, for which the moments were corrected, in metres.
    pub sigma: f64,
    /// How many neighbouring pixels share their noise: the variance of the mean of many depths is that of one, times this, over
    /// their number. 1 or 0: the noise of each pixel is independent.
    pub correlation_px: f64,
    /// How many neighbouring lines of the image share their noise; 0 stands for 1.
    pub shared_lines: f64,
    /// Over how many lines the depths of the points are averaged, as an effective number that gives the remaining variance; 0
    /// stands for 1, none. The number of lines that share their noise grows by the same factor. `contour` is that of the single
    /// line.
    pub averaged_lines: f64,
    /// Depths measured `beyond_px` pixels before the first and after the last pixel, in metres; 0: none.
    pub beyond: [f64; 2],
    /// Where along the line the surface ends on either side before a more distant background, in pixels: half a pixel beyond its
    /// last one, or the middle of a pixel that belongs to neither. 0: the surface is occluded, adjoins another, or its end is not
    /// seen.
    pub contour: [f64; 2],
    /// Depths of the outermost points at either end, on neighbouring pixels from `first` and `last` inwards, in metres; 0: none.
    /// They are included in the moments. Whether they belong to an object only shows when its outline is known.
    pub ends: [[f64; END_POINTS]; 2],
    /// Origin `(s, t)` of the moments, in metres.
    pub origin: [f64; 2],
    /// Moments `sum (s - s0)^p (t - t0)^q` of the points, by degree, then by falling p:
    /// 1, s, t, s2, st, t2, s3, s2t, st2, t3, s4, s3t, s2t2, st3, t4.
    pub moments: [f64; MOMENTS],
}

impl Ellipse {
    /// The direction of the scan line; [`Item::check`] has refused unknown codes.
    pub fn direction(&self) -> Scan {
        Scan::from_code(self.scan).unwrap_or(Scan::Column)
    }

    /// The step between the lines that the extractor processed, at least 1.
    pub fn step(&self) -> u32 {
        self.line_step.max(1)
    }

    /// Number of its points per independent noise value, at least 1: with few points, hardly any share their noise.
    pub fn points_per_sample(&self) -> f64 {
        let points = f64::from(self.points.max(1));
        points / ((points - 1.0) / self.correlation_px.max(1.0) + 1.0)
    }

    /// Whether the line and the pixels lie in the image, and the codes are valid.
    fn is_in(&self, header: &Header) -> bool {
        let (width, height) = (header.camera.width, header.camera.height);
        let (lines, pixels) = if self.direction() == Scan::Row { (height, width) } else { (width, height) };
        let inside = self.line < lines && self.first <= self.last && self.last < pixels;
        Scan::from_code(self.scan).is_some() && self.unbiased <= 1 && inside
    }

    /// Whether there are points, and no deviation or depth is negative.
    fn is_of_points(&self) -> bool {
        self.sigma >= 0.0
            && self.correlation_px >= 0.0
            && self.shared_lines >= 0.0
            && self.averaged_lines >= 0.0
            && self.rms >= 0.0
            && self.ends.as_flattened().iter().all(|depth| *depth >= 0.0)
            && self.moments[0] > 0.0
    }

    fn numbers_are_finite(&self) -> bool {
        finite(&self.center)
            && finite(&self.plane_center)
            && finite(&self.semi_axes)
            && finite(&[self.angle, self.half_width, self.half_depth, self.rms, self.arc])
            && finite(&self.beyond)
            && finite(&self.contour)
            && finite(self.ends.as_flattened())
            && finite(&[self.sigma, self.correlation_px, self.shared_lines, self.averaged_lines])
            && finite(&self.origin)
            && finite(&self.moments)
    }
}

impl Item for Ellipse {
    const NAME: &'static str = "ellipses";
    const TYPE_NAME: &'static str = "conicflow.Ellipse.v8";
    /// The number of arcs in an image of 640x480 pixels, which few exceed.
    const USUAL_LENGTH: usize = 1024;

    fn check(header: &Header, items: &[Self]) -> Result<(), Malformed> {
        check_each(items, |ellipse| {
            if !(ellipse.is_in(header) && ellipse.numbers_are_finite()) {
                Some("is out of range or not finite")
            } else if !ellipse.is_of_points() {
                Some("has no points, or a deviation or depth below zero")
            } else {
                None
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Camera;

    #[test]
    fn an_ellipse_that_no_extractor_could_find_is_refused() {
        let header = Header { camera: Camera { width: 8, height: 6, ..Camera::default() }, ..Header::default() };
        let mut good = Ellipse { line: 5, first: 2, last: 7, unbiased: 1, sigma: 0.001, ..Ellipse::default() };
        good.moments[0] = 6.0;
        assert_eq!(Ellipse::check(&header, &[good]), Ok(()));
        for spoil in [
            |e: &mut Ellipse| e.scan = 2,
            |e: &mut Ellipse| e.scan = 1,
            |e: &mut Ellipse| e.line = 6,
            |e: &mut Ellipse| e.last = 8,
            |e: &mut Ellipse| e.unbiased = 2,
            |e: &mut Ellipse| e.sigma = -1e-9,
            |e: &mut Ellipse| e.correlation_px = -1e-9,
            |e: &mut Ellipse| e.rms = -1e-9,
            |e: &mut Ellipse| e.ends[1][0] = -1e-9,
            |e: &mut Ellipse| e.ends[0][1] = f64::INFINITY,
            |e: &mut Ellipse| e.moments[0] = 0.0,
            |e: &mut Ellipse| e.moments[14] = f64::NAN,
        ] {
            let mut spoilt = good;
            spoil(&mut spoilt);
            let error = Ellipse::check(&header, &[good, spoilt]).unwrap_err();
            assert!(error.to_string().contains("item 1 "), "{error}");
        }
    }

    #[test]
    fn without_correlation_or_points_no_noise_is_shared() {
        assert_eq!(Ellipse::default().points_per_sample(), 1.0);
        let shared = |points| Ellipse { correlation_px: 2.5, points, ..Ellipse::default() }.points_per_sample();
        assert_eq!((shared(1), shared(0)), (1.0, 1.0), "there is none to share it with");
        assert!((shared(10_000) - 2.5).abs() < 1e-3 && shared(6) == 2.0, "{} and {}", shared(10_000), shared(6));
    }

    #[test]
    fn a_step_of_zero_means_each_line() {
        assert_eq!(Ellipse::default().step(), 1);
        assert_eq!(Ellipse { line_step: 4, ..Ellipse::default() }.step(), 4);
    }
}
