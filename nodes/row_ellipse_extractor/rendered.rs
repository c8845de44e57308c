//! Rendered depth images of known bodies, for the tests of the detector: exact ray casting and the noise of a sensor.

use conicflow_geometry::Vector3;
use conicflow_messages::{Camera, Header, NoiseModel};

/// Half the resolution of a Kinect: 320 x 240.
pub(crate) const KINECT_HALF: Camera = Camera { width: 320, height: 240, fx: 290.0, fy: 290.0, cx: 159.5, cy: 119.5 };

/// A body of the scene.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Body {
    /// All points p with `normal . p = offset`.
    Plane { normal: Vector3, offset: f64 },
    /// A sphere.
    Sphere { center: Vector3, radius: f64 },
    /// A frustum: `center` in the middle, radius `radius + slope h` at the axial distance h from it; no lids.
    Frustum { center: Vector3, axis: Vector3, radius: f64, slope: f64, length: f64 },
}

impl Body {
    /// Depths at which the ray `z direction` (z component 1) meets the body.
    fn depths(&self, ray: &Vector3) -> Vec<f64> {
        match *self {
            Self::Plane { normal, offset } => vec![offset / normal.dot(ray)],
            Self::Sphere { center, radius } => {
                roots(ray.dot(ray), -2.0 * ray.dot(&center), center.dot(&center) - radius * radius)
            }
            Self::Frustum { center, axis, radius, slope, length } => {
                let (da, dc) = (ray.dot(&axis), center.dot(&axis));
                let (ra, rc) = (ray - axis * da, center - axis * dc);
                // Radius along the ray: base + slope da z.
                let base = radius - slope * dc;
                let grow = slope * da;
                let found =
                    roots(ra.dot(&ra) - grow * grow, -2.0 * (ra.dot(&rc) + base * grow), rc.dot(&rc) - base * base);
                let inside = |z: &f64| (da * z - dc).abs() <= length / 2.0 && base + grow * z > 0.0;
                found.into_iter().filter(inside).collect()
            }
        }
    }
}

fn roots(a: f64, b: f64, c: f64) -> Vec<f64> {
    let discriminant = b * b - 4.0 * a * c;
    if discriminant < 0.0 || a == 0.0 {
        return Vec::new();
    }
    let root = discriminant.sqrt();
    vec![(-b - root) / (2.0 * a), (-b + root) / (2.0 * a)]
}

/// Random numbers that are the same in each run (splitmix64).
#[derive(Clone, Debug)]
pub(crate) struct Random(pub u64);

impl Random {
    fn uniform(&mut self) -> f64 {
        self.0 = self.0.wrapping_add(0x9E37_79B9_7F4A_7C15);
        let mut x = self.0;
        x = (x ^ (x >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
        x = (x ^ (x >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
        ((x ^ (x >> 31)) >> 11) as f64 / (1u64 << 53) as f64
    }

    /// Mean 0, standard deviation 1 (Box and Muller).
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }
}

/// A depth image of `bodies` with the noise of `noise`, in steps of 0.1 mm; behind them there is nothing.
pub(crate) fn render(camera: Camera, noise: NoiseModel, bodies: &[Body], seed: u64) -> (Header, Vec<u16>) {
    let header = Header { camera, noise, depth_scale: 1e-4, ..Header::default() };
    let mut random = Random(seed);
    let mut pixels = Vec::new();
    for v in 0..camera.height {
        for u in 0..camera.width {
            let ray = Vector3::new((f64::from(u) - camera.cx) / camera.fx, (f64::from(v) - camera.cy) / camera.fy, 1.0);
            let depths = bodies.iter().flat_map(|body| body.depths(&ray)).filter(|z| *z > 0.1);
            let nearest = depths.min_by(f64::total_cmp);
            let measured = nearest.map_or(0.0, |z| measure(z, &noise, &mut random));
            pixels.push((measured / header.depth_scale).round().clamp(0.0, 65534.0) as u16);
        }
    }
    (header, pixels)
}

/// What a sensor measures: axial noise, then the step of the disparity.
fn measure(z: f64, noise: &NoiseModel, random: &mut Random) -> f64 {
    let axial = noise.floor_m + noise.growth_per_m * (z - noise.knee_m).powi(2);
    let noisy = z + axial * random.normal();
    if noise.step_per_m == 0.0 { noisy } else { 1.0 / (noise.step_per_m * (1.0 / (noise.step_per_m * noisy)).round()) }
}
