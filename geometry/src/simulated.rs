//! Surfaces as a camera sees them in some rows, for tests of the fits.

use crate::{Coefficients, Pinhole, QuadricMoments, RaySums, Scan, ScanPlane, SpaceMoments, section_of};

/// A Kinect v1 at half its resolution.
pub const CAMERA: Pinhole = Pinhole { fx: 290.0, fy: 290.0, cx: 159.5, cy: 119.5 };

/// Random numbers that are the same in each run (SplitMix64).
pub struct Random(pub u64);

impl Random {
    pub fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut x = self.0;
        x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((x ^ (x >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Returns a number with mean 0 and standard deviation 1 (Box-Muller transform).
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// Returns the nearer root of `F = 0` along a ray, if the ray meets the surface.
pub fn hit(conic: &[f64; 6], x: f64, k: f64) -> Option<f64> {
    let a = conic[0] * x * x + conic[1] * x * k + conic[2] * k * k;
    let b = conic[3] * x + conic[4] * k;
    let discriminant = b * b - 4.0 * a * conic[5];
    (discriminant > 0.0).then(|| (-b - discriminant.sqrt()) / (2.0 * a))
}

/// Returns the moments of a surface that is seen in some rows, with the share `hidden` of each arc removed on one side; `measure`
/// returns the measured depth and its variance.
pub fn seen(
    q: &Coefficients,
    rows: std::ops::Range<u32>,
    hidden: f64,
    mut measure: impl FnMut(f64) -> (f64, f64),
) -> SpaceMoments {
    let mut pool = SpaceMoments::default();
    for row in rows {
        let plane: ScanPlane = CAMERA.plane(Scan::Row, f64::from(row));
        let conic = section_of(q, &plane);
        let ray = |u: u32| CAMERA.ray_slope(Scan::Row, f64::from(u));
        let hits: Vec<_> = (0..320).map(ray).filter_map(|x| Some((x, hit(&conic, x, plane.stretch())?))).collect();
        let visible = &hits[(hidden * hits.len() as f64) as usize..];
        let measured: Vec<_> = visible.iter().map(|(x, z)| ([*x], measure(*z))).collect();
        let sums = RaySums::of(measured.iter().map(|(x, (z, variance))| (&x[..], std::slice::from_ref(z), *variance)));
        pool.add(&SpaceMoments::of_arc(&plane, &sums.moments(plane.stretch())), 1.0);
    }
    pool
}

/// Returns a depth without noise, and its variance.
pub fn exact(z: f64) -> (f64, f64) {
    (z, 0.0)
}

/// Returns the moments of points with the weight of an accuracy of a hundredth of a micrometre.
pub fn of_exact(points: &SpaceMoments) -> QuadricMoments {
    let mut pool = SpaceMoments::default();
    pool.add(points, 1e16);
    pool.normalized().unwrap()
}
