//! Fits the camera of an organised cloud to its points.
//!
//! In a cloud from a pinhole camera, the point of pixel (u, v) satisfies `u = fx x/z + cx`, `v = fy y/z + cy`: two straight
//! lines, fitted by least squares over all points, and once more without outliers. The signs give the directions of the axes: z
//! may point backward, x to the left, y upward. Only z goes into the depth image.

use anyhow::{Result, bail, ensure};
use conicflow_geometry::{Fit, Regression};
use conicflow_messages::{Camera, Hinted};

/// Largest root mean square residual of a cloud that is accepted as a pinhole image, in pixels.
pub(super) const MAX_RESIDUAL_PX: f64 = 0.5;
/// Residual above which a cloud is accepted with a warning, in pixels; exact clouds stay below 0.01.
pub(super) const FAIR_RESIDUAL_PX: f64 = 0.1;

const MIN_POINTS: f64 = 100.0;
const MIN_INLIER_SHARE: f64 = 0.9;

/// The camera of a cloud, and the directions of its axes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Pinhole {
    /// Size and intrinsics; focal lengths are positive.
    pub(super) camera: Camera,
    /// For x, y and z: whether the axis points left, up and backward, opposite to the optical frame.
    pub(super) flipped: [bool; 3],
    /// Root mean square distance of the pixels from the fit, in pixels.
    pub(super) residual_px: f64,
}

/// Fits the camera to the points of a cloud, row by row.
///
/// # Errors
/// There are too few points, or they do not fit a pinhole camera.
pub(super) fn fit(width: u32, height: u32, points: impl Iterator<Item = [f32; 3]> + Clone) -> Result<Pinhole> {
    let backward = looks_backward(points.clone().map(|[_, _, z]| z));
    let sign = if backward { -1.0 } else { 1.0 };
    let samples = points.enumerate().filter_map(move |(index, [x, y, z])| {
        let z = sign * f64::from(z);
        let (x, y) = (f64::from(x) / z, f64::from(y) / z);
        let pixel = (index % width as usize, index / width as usize);
        (z > 1e-6 && x.is_finite() && y.is_finite()).then_some((x, y, pixel.0 as f64, pixel.1 as f64))
    });
    let (u, v) = fit_lines(samples)?;
    let camera = Camera { width, height, fx: u.slope.abs(), fy: v.slope.abs(), cx: u.at(0.0), cy: v.at(0.0) };
    Ok(Pinhole { camera, flipped: [u.slope < 0.0, v.slope < 0.0, backward], residual_px: residual_of(&u, &v) })
}

/// Whether most of the depths are negative.
pub(super) fn looks_backward(depths: impl Iterator<Item = f32>) -> bool {
    let count = |(behind, before): (u64, u64), z: f32| (behind + u64::from(z < 0.0), before + u64::from(z > 0.0));
    let (behind, before) = depths.fold((0, 0), count);
    behind > before
}

/// Fits the line `pixel = slope ratio + offset`; `None` if the ratios or the pixels do not spread.
fn line(sums: &Regression) -> Option<Fit> {
    sums.fit().filter(|fit| fit.slope.is_normal() && sums.deviation() > 0.3 && sums.spread() > 1e-6)
}

fn residual_of(u: &Fit, v: &Fit) -> f64 {
    ((u.rms * u.rms + v.rms * v.rms) / 2.0).sqrt()
}

type Sample = (f64, f64, f64, f64);

fn fit_lines(samples: impl Iterator<Item = Sample> + Clone) -> Result<(Fit, Fit)> {
    let (u, v, all) = fit_where(samples.clone(), |_| true)?;
    let limit = |line: &Fit| (3.0 * line.rms).max(FAIR_RESIDUAL_PX);
    let (limit_u, limit_v) = (limit(&u), limit(&v));
    let near = |&(x, y, pu, pv): &Sample| (pu - u.at(x)).abs() < limit_u && (pv - v.at(y)).abs() < limit_v;
    let (u, v, kept) = fit_where(samples, near)?;
    let residual = residual_of(&u, &v);
    if residual > MAX_RESIDUAL_PX || kept < MIN_INLIER_SHARE * all {
        bail!(Hinted::new(
            format!(
                "the cloud is no image of a pinhole camera: its points lie {residual:.2} pixels (rms) beside the \
                 best fit, expected {MAX_RESIDUAL_PX} or less"
            ),
            "the points have to be in the camera's optical frame (x right, y down, z forward) and free of lens \
             distortion; transform them back before saving"
        ));
    }
    Ok((u, v))
}

fn fit_where(samples: impl Iterator<Item = Sample>, keep: impl Fn(&Sample) -> bool) -> Result<(Fit, Fit, f64)> {
    let (mut u, mut v) = (Regression::default(), Regression::default());
    for (x, y, pu, pv) in samples.filter(keep) {
        u.add(x, pu);
        v.add(y, pv);
    }
    ensure!(
        u.count() >= MIN_POINTS,
        Hinted::new(
            format!("{} points with a measurement, expected {MIN_POINTS} or more to fit the camera", u.count()),
            "give `intrinsics`, to `conicflow detect` `--camera`"
        )
    );
    let (Some(line_u), Some(line_v)) = (line(&u), line(&v)) else {
        bail!(Hinted::new(
            "the points lie in one row, one column or one ray, so that no camera can be fitted to them",
            "give `intrinsics`, to `conicflow detect` `--camera`"
        ));
    };
    Ok((line_u, line_v, u.count()))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sources::image_source::fixtures::{CAMERA, depth_m, points};

    fn close(got: &Camera, expected: &Camera, tolerance: f64) -> bool {
        let pairs = [(got.fx, expected.fx), (got.fy, expected.fy), (got.cx, expected.cx), (got.cy, expected.cy)];
        pairs.iter().all(|(a, b)| (a - b).abs() < tolerance)
    }

    fn fit_all(points: &[[f32; 3]]) -> Result<Pinhole> {
        fit(CAMERA.width, CAMERA.height, points.iter().copied())
    }

    #[test]
    fn the_camera_is_found_through_holes_and_outliers() {
        let mut points = points(&depth_m());
        let exact = fit_all(&points).unwrap();
        assert!(close(&exact.camera, &CAMERA, 1e-3), "{exact:?}");
        assert!(exact.residual_px < 1e-3);
        assert_eq!(exact.flipped, [false; 3]);
        for point in points.iter_mut().step_by(50) {
            point[0] += 0.5;
        }
        let robust = fit_all(&points).unwrap();
        assert!(close(&robust.camera, &CAMERA, 0.05), "{robust:?}");
    }

    #[test]
    fn reversed_axes_are_recognised() {
        let turned: Vec<_> = points(&depth_m()).iter().map(|[x, y, z]| [*x, -y, -z]).collect();
        let pinhole = fit_all(&turned).unwrap();
        assert!(close(&pinhole.camera, &CAMERA, 1e-3), "{pinhole:?}");
        assert_eq!(pinhole.flipped, [false, true, true]);
    }

    #[test]
    fn coordinates_in_millimetres_rounded_still_fit() {
        let round = |value: f32| (value * 1000.0).round();
        let rounded: Vec<_> = points(&depth_m()).iter().map(|point| point.map(round)).collect();
        let pinhole = fit_all(&rounded).unwrap();
        assert!(close(&pinhole.camera, &CAMERA, 0.1), "{pinhole:?}");
        assert!(pinhole.residual_px < FAIR_RESIDUAL_PX);
    }

    #[test]
    fn points_that_no_pinhole_camera_can_see_are_refused() {
        let world: Vec<_> = points(&depth_m()).iter().map(|[x, y, z]| [*z, -x, -y + 0.5 * z]).collect();
        let error = fit_all(&world).unwrap_err().to_string();
        assert!(error.starts_with("the cloud is no image of a pinhole camera: "), "{error}");
        let error = fit_all(&vec![[f32::NAN; 3]; 48 * 36]).unwrap_err().to_string();
        assert!(error.starts_with("0 points with a measurement, expected 100 or more to fit the camera\n  hint: "));
        let error = fit_all(&vec![[0.0, 0.0, 1.0]; 48 * 36]).unwrap_err().to_string();
        assert!(error.starts_with("the points lie in one row"), "{error}");
    }
}
