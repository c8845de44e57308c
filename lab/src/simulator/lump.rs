//! Nearly round, rounded or creased things: cushions, bags, clothes, limbs, heads, fruit. They are no objects.

use super::block::Block;
use super::fields::{finite, not_negative, vector};
use super::pose::Pose;
use super::surface::{NEAREST, Surface};
use crate::bisection::end_of;
use nalgebra::{Matrix3, Vector3};
use serde::Deserialize;

/// Largest number of waves on the surface of a lump.
pub const CREASES: usize = 4; // [algorithmic]
/// Shortest step along a ray, in half-sizes: 0.1 mm for something as large as a head.
const LEAST_STEP: f64 = 1e-3; // [algorithmic]

/// A superellipsoid (Barr, "Superquadrics and angle-preserving transformations", 1981) with waves on its surface.
///
/// With `q` a point in its own axes, in half-sizes, it is the set of points at which
/// `|(|(q.x, q.y)|_m, q.z)|_n = 1 + sum of height sin(wave . q + phase)`, where `|.|_m` is the norm of the exponent `m`.
/// `m = n = 2` is an ellipsoid, `m = 2` with a large `n` a cylinder of oval section with rounded ends, both large a box with
/// rounded edges.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lump {
    /// Its centre.
    pub center: Vector3<f64>,
    /// Directions of its own axes, as columns.
    pub axes: Matrix3<f64>,
    /// Half of its size along each axis.
    pub half: Vector3<f64>,
    /// Base-2 logarithms of the exponents across its third axis and along it; 1 is round.
    pub squareness: [u32; 2],
    /// Its waves.
    pub creases: [Crease; CREASES],
}

/// One wave on the surface of a lump.
#[derive(Clone, Copy, Debug, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Crease {
    /// Radians per half-size along each axis.
    #[serde(deserialize_with = "vector")]
    pub wave: Vector3<f64>,
    /// Radians in the centre.
    #[serde(default, deserialize_with = "finite")]
    pub phase: f64,
    /// Height in half-sizes.
    #[serde(deserialize_with = "not_negative")]
    pub height: f64,
}

/// Returns the norm of two numbers for the exponent `2^log2`, and its derivatives by them.
fn norm(a: f64, b: f64, log2: u32) -> (f64, [f64; 2]) {
    let largest = a.abs().max(b.abs());
    if largest == 0.0 {
        return (0.0, [0.0; 2]);
    }
    let (mut powers, mut lower) = ([a / largest, b / largest], [1.0; 2]);
    for _ in 0..log2 {
        lower = [lower[0] * powers[0], lower[1] * powers[1]];
        powers = powers.map(|power| power * power);
    }
    // `lower` is now the power with the exponent minus one.
    let mut root = powers[0] + powers[1];
    let sum = root;
    (0..log2).for_each(|_| root = root.sqrt());
    (largest * root, lower.map(|lower| lower * root / sum))
}

impl Lump {
    /// Converts a direction or difference to the lump's own axes, in half-sizes.
    fn inwards(&self, vector: &Vector3<f64>) -> Vector3<f64> {
        self.axes.tr_mul(vector).component_div(&self.half)
    }

    /// Returns how far outside a point (in half-sizes) is, and the gradient of that.
    fn outside(&self, q: &Vector3<f64>) -> (f64, Vector3<f64>) {
        let (across, [by_x, by_y]) = norm(q.x, q.y, self.squareness[0]);
        let (size, [by_across, by_z]) = norm(across, q.z, self.squareness[1]);
        let (mut value, mut gradient) = (size - 1.0, Vector3::new(by_across * by_x, by_across * by_y, by_z));
        for Crease { wave, phase, height } in self.creases.iter().filter(|crease| crease.height != 0.0) {
            let (sine, cosine) = libm::sincos(wave.dot(q) + phase);
            value -= height * sine;
            gradient -= wave * (height * cosine);
        }
        (value, gradient)
    }

    /// Returns the sum of the heights of all waves.
    fn swell(&self) -> f64 {
        self.creases.iter().map(|crease| crease.height.abs()).sum()
    }

    /// Returns the bounding box.
    pub(super) fn hull(&self) -> Block {
        Block { center: self.center, axes: self.axes, half: self.half * (1.0 + self.swell()) }
    }
}

impl Surface for Lump {
    /// [`Lump::outside`] changes per half-size by no more than its steepest gradient, so that a step of its value divided by that
    /// cannot jump across the surface (sphere tracing: Hart 1996).
    fn hit(&self, origin: &Vector3<f64>, direction: &Vector3<f64>) -> f64 {
        let Some([enter, leave]) = self.hull().crossings(origin, direction) else { return f64::INFINITY };
        let (from, along) = (self.inwards(&(origin - self.center)), self.inwards(direction));
        let value = |t: f64| self.outside(&(from + along * t)).0;
        let steepest = 1.0 + self.creases.iter().map(|crease| crease.height.abs() * crease.wave.norm()).sum::<f64>();
        let speed = along.norm();
        let mut t = enter.max(NEAREST);
        let mut before = value(t);
        let starts_outside = before > 0.0;
        while t < leave {
            let next = t + (before.abs() / steepest).max(LEAST_STEP) / speed;
            let there = value(next);
            if (there > 0.0) != starts_outside {
                return end_of(|t| (value(t) > 0.0) == starts_outside, [t, next]);
            }
            (t, before) = (next, there);
        }
        f64::INFINITY
    }

    fn normal(&self, point: &Vector3<f64>) -> Vector3<f64> {
        let (_, gradient) = self.outside(&self.inwards(&(point - self.center)));
        (self.axes * gradient.component_div(&self.half)).normalize()
    }

    fn bounds(&self) -> Option<[Vector3<f64>; 2]> {
        self.hull().bounds()
    }

    fn transformed(&self, target_from_source: &Pose) -> Self {
        let axes = target_from_source.rotation * self.axes;
        Self { center: target_from_source.point(&self.center), axes, ..*self }
    }
}

#[cfg(test)]
mod tests {
    use super::super::shapes::{Frustum, Sphere};
    use super::*;
    use nalgebra::{Rotation3, Unit};

    fn lump(half: [f64; 3], squareness: [u32; 2]) -> Lump {
        let axis = Unit::new_normalize(Vector3::new(0.3, -1.0, 0.5));
        let axes = Rotation3::from_axis_angle(&axis, 0.7).into_inner();
        Lump { center: Vector3::new(0.1, -0.05, 1.5), axes, half: half.into(), squareness, creases: Default::default() }
    }

    /// Rays through the whole image.
    fn rays() -> impl Iterator<Item = Vector3<f64>> {
        (-20..=20).flat_map(|v| (-20..=20).map(move |u| Vector3::new(f64::from(u) * 0.01, f64::from(v) * 0.01, 1.0)))
    }

    #[test]
    fn one_that_is_round_everywhere_is_a_sphere() {
        let lump = lump([0.2; 3], [1, 1]);
        let sphere = Sphere { center: lump.center, radius: 0.2 };
        for ray in rays() {
            let [of_lump, of_sphere] = [lump.hit(&Vector3::zeros(), &ray), sphere.hit(&Vector3::zeros(), &ray)];
            if of_sphere.is_finite() && sphere.normal(&(ray * of_sphere)).dot(&ray).abs() > 0.05 {
                assert!((of_lump - of_sphere).abs() < 1e-9, "{of_lump} {of_sphere}");
                assert!((lump.normal(&(ray * of_lump)) - sphere.normal(&(ray * of_sphere))).norm() < 1e-6);
            } else if of_sphere.is_infinite() {
                assert!(of_lump.is_infinite());
            }
        }
    }

    #[test]
    fn one_that_is_round_across_and_square_along_is_a_cylinder_in_its_middle() {
        let lump = lump([0.1, 0.1, 0.3], [1, 4]);
        let axis = lump.axes.column(2).into_owned();
        let base = lump.center - axis * 0.1;
        let cylinder = Frustum { base, axis, length: 0.2, base_radius: 0.1, top_radius: 0.1, open: false };
        let mut compared = 0;
        for ray in rays() {
            let [of_lump, of_cylinder] = [lump.hit(&Vector3::zeros(), &ray), cylinder.hit(&Vector3::zeros(), &ray)];
            let point = ray * of_cylinder;
            if of_cylinder.is_finite() && !cylinder.is_cap(&point) && cylinder.normal(&point).dot(&ray) < -0.2 {
                assert!((of_lump - of_cylinder).abs() < 1e-3, "{of_lump} {of_cylinder}");
                compared += 1;
            }
        }
        assert!(compared > 50, "{compared}");
    }

    #[test]
    fn a_ray_meets_a_creased_one_where_it_enters_it_and_the_normal_is_that_of_the_surface() {
        let mut lump = lump([0.15, 0.1, 0.2], [1, 2]);
        for (index, crease) in lump.creases.iter_mut().enumerate() {
            let turn = index as f64;
            *crease = Crease { wave: Vector3::new(5.0 - turn, 2.0 * turn, 4.0 + turn), phase: turn, height: 0.03 };
        }
        let (mut met, mut farthest) = (0, 0.0_f64);
        for ray in rays() {
            let z = lump.hit(&Vector3::zeros(), &ray);
            // Small steps along the ray find no surface before, except perhaps one that is grazed.
            let outside = |z: f64| lump.outside(&lump.inwards(&(ray * z - lump.center))).0;
            let first = (0..4000).map(|step| 1.0 + f64::from(step) * 2.5e-4).find(|&z| outside(z) < -1e-4);
            let Some(first) = first else { continue };
            assert!(z < first + 1e-3 && outside(z).abs() < 1e-9, "{z} {first}");
            met += 1;
            let normal = lump.normal(&(ray * z));
            let aside = normal.cross(&Vector3::new(0.3, 1.0, -0.2)).normalize();
            for step in [aside, aside.cross(&normal)] {
                let by = |step: &Vector3<f64>| {
                    let value =
                        |sign: f64| lump.outside(&lump.inwards(&(ray * z + step * (sign * 1e-6) - lump.center))).0;
                    value(1.0) - value(-1.0)
                };
                farthest = farthest.max((by(&step) / by(&normal)).abs());
            }
        }
        assert!(met > 200 && farthest < 1e-4, "{met} {farthest}");
    }

    #[test]
    fn it_hides_a_part_of_itself_where_a_crease_is_before_it() {
        let mut lump = lump([0.2; 3], [1, 1]);
        let apart = |lump: &Lump| {
            rays()
                .filter(|ray| {
                    let z = lump.hit(&Vector3::zeros(), ray);
                    let point = ray * z;
                    let light = Vector3::new(1.5, 0.0, 0.8) - point;
                    z.is_finite() && lump.normal(&point).dot(&light) > 0.0 && lump.hit(&point, &light) < 1.0
                })
                .count()
        };
        assert_eq!(apart(&lump), 0);
        lump.creases[0] = Crease { wave: Vector3::new(20.0, 0.0, 0.0), phase: 0.0, height: 0.1 };
        assert!(apart(&lump) > 10, "{}", apart(&lump));
    }
}
