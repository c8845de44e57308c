//! The best possible accuracy of an object: the Cramer-Rao bound, from a rendered image and the sensor's noise.
//!
//! Depths are independent and normal about `z_i(theta)`, so that the information about the parameters theta is
//! `I = sum_i w_i J_i' J_i / sigma(z_i)^2` with `J_i = dz_i / dtheta`, and no unbiased estimate scatters less than `I^-1`
//! (Rao 1945, Cramer 1946; for example Kay, "Fundamentals of Statistical Signal Processing: Estimation Theory", 1993, chapter
//! 3). On the surface `F(z r, theta) = 0` of a ray r that is `J = -(dF / dtheta) / (grad F . r)`. The weight w is the
//! probability that a pixel is measured: 1 up to an angle between ray and normal, then falling linearly in its cosine to 0, as
//! in [`super::simulator::sensor`]. Bound A uses the depths of the visible side only: not the flat ends, and not the pixels next
//! to another surface, whose depth may be that of either one and depends on the silhouette.
//!
//! Bound B uses the silhouettes, too: where a scan line leaves the side of the object for something farther away, the
//! discriminant `D(u, theta) = b^2 - 4 a c` of `F(z r) = a z^2 + b z + c` is zero, so `du / dtheta = -(dD / dtheta) / (dD / du)`,
//! and u is known with a variance of `1/12 + jitter^2` square pixels. Each piece of the contour counts once: in rows where it is
//! steeper than 45 degrees, in columns where it is flatter.

use crate::bisection::end_of;
use crate::simulator::raster::{NO_OWNER, Raster, ray};
use conicflow_geometry::{Coefficients, Conical, Sphere, Surface, gradient};
use conicflow_messages::{NoiseModel, Object, ObjectKind};
use nalgebra::{SMatrix, SVector, Vector3};

/// Least standard deviations of an unbiased estimate; `None` for parameters that the shape does not have.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bound {
    /// Of the radius at the object's middle, in metres.
    pub radius_m: f64,
    /// Of the middle's position, as root mean square distance in metres: in space for spheres, else across the axis.
    pub position_m: f64,
    /// Of the axis, as root mean square angle in radians.
    pub axis: Option<f64>,
    /// Of the half-angle, in radians.
    pub half_angle: Option<f64>,
}

/// The lower bounds of the errors from depths alone, and from depths and silhouettes.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// A: from depths alone.
    pub depths: Bound,
    /// B: from depths and silhouettes.
    pub contour: Bound,
}

/// The properties of the sensor that limit the accuracy.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measuring {
    /// Noise of each depth, independent of all others.
    pub noise: NoiseModel,
    /// Angle between ray and normal beyond which points may be missing, in radians.
    pub dropout_angle: f64,
    /// Standard deviation of a silhouette's position beside that of a pixel's size, in pixels.
    pub edge_jitter_px: f64,
}

/// Returns the bounds for the object that is shape number `owner` in an image. `body` is the whole object in the camera's frame,
/// with its middle as `center`. `None` if too little of it is visible to determine all of its parameters.
pub fn bounds(raster: &Raster, owner: u16, body: &Object, measuring: &Measuring) -> Option<Bounds> {
    let (point, axis) = (Vector3::from(body.center), Vector3::from(body.axis));
    let conical = Conical { point, axis, radius: body.radius, slope: body.half_angle.tan() };
    let view = View { raster, owner, measuring };
    match body.shape() {
        ObjectKind::Sphere => view.bounds(&Sphere { center: point, radius: body.radius }, |covariance| Bound {
            radius_m: covariance[(3, 3)].sqrt(),
            position_m: root_of_sum(covariance, [0, 1, 2]),
            axis: None,
            half_angle: None,
        }),
        ObjectKind::Cylinder => view.bounds::<_, 5>(&conical, conical_bound),
        ObjectKind::Cone => view.bounds::<_, 6>(&conical, |covariance| {
            // d atan(slope) = cos^2 d slope
            let half_angle = covariance[(5, 5)].sqrt() * body.half_angle.cos().powi(2);
            Bound { half_angle: Some(half_angle), ..conical_bound(covariance) }
        }),
    }
}

/// The bound of the parameters that cylinders and cones share.
fn conical_bound<const N: usize>(covariance: &SMatrix<f64, N, N>) -> Bound {
    Bound {
        radius_m: covariance[(4, 4)].sqrt(),
        position_m: root_of_sum(covariance, [2, 3]),
        axis: Some(root_of_sum(covariance, [0, 1])),
        half_angle: None,
    }
}

fn root_of_sum<const N: usize, const M: usize>(covariance: &SMatrix<f64, N, N>, indices: [usize; M]) -> f64 {
    indices.iter().map(|&index| covariance[(index, index)]).sum::<f64>().sqrt()
}

/// Steps to the four neighbours of a pixel.
const BESIDE: [[i64; 2]; 4] = [[1, 0], [-1, 0], [0, 1], [0, -1]];

/// An object in an image.
struct View<'a> {
    raster: &'a Raster,
    owner: u16,
    measuring: &'a Measuring,
}

impl View<'_> {
    fn bounds<S: Surface<N>, const N: usize>(
        &self,
        surface: &S,
        of: impl Fn(&SMatrix<f64, N, N>) -> Bound,
    ) -> Option<Bounds> {
        let depths = self.of_depths(surface);
        let both = depths + self.of_silhouettes(surface);
        Some(Bounds { depths: of(&inverse(&depths)?), contour: of(&inverse(&both)?) })
    }

    fn pixels(&self) -> impl Iterator<Item = [i64; 2]> {
        let (width, height) = (i64::from(self.raster.camera.width), i64::from(self.raster.camera.height));
        (0..height).flat_map(move |v| (0..width).map(move |u| [u, v]))
    }

    /// Returns the information of the depths of the side.
    fn of_depths<S: Surface<N>, const N: usize>(&self, surface: &S) -> SMatrix<f64, N, N> {
        let (q, derivatives) = (surface.coefficients(), surface.derivatives());
        let dropout_cosine = self.measuring.dropout_angle.cos();
        let mut information = SMatrix::zeros();
        for [u, v] in self.pixels().filter(|pixel| self.is_within(&q, *pixel)) {
            let (point, direction) = (self.raster.point(u, v), ray(&self.raster.camera, u, v));
            let normal = gradient(&q, &point);
            let along = normal.dot(&direction);
            let cosine = along.abs() / (normal.norm() * direction.norm());
            let weight = (cosine / dropout_cosine).min(1.0) / self.measuring.noise.variance(point.z);
            let slopes = SVector::<f64, N>::from_fn(|i, _| -value(&derivatives[i], &point) / along);
            information += slopes * slopes.transpose() * weight;
        }
        information
    }

    /// Whether a pixel shows the outer side of the object, and not another object, its inside or one of its ends.
    fn is_side(&self, q: &Coefficients, [u, v]: [i64; 2]) -> bool {
        /// Tolerance as a share of the depth: a point farther off the side lies on an end.
        const OFF: f64 = 1e-6;
        if self.raster.owner[self.raster.index(u, v)] != self.owner {
            return false;
        }
        let point = self.raster.point(u, v);
        gradient(q, &point).dot(&point) < 0.0 && value(q, &point).abs() < OFF * point.z
    }

    /// Whether a pixel shows the outer side, and its neighbours the same object.
    fn is_within(&self, q: &Coefficients, [u, v]: [i64; 2]) -> bool {
        let is_own = |[u, v]: [i64; 2]| self.raster.owner[self.raster.index(u, v)] == self.owner;
        let beside = BESIDE.map(|[step_u, step_v]| [u + step_u, v + step_v]);
        self.is_side(q, [u, v]) && beside.into_iter().all(|pixel| !self.is_in_image(pixel) || is_own(pixel))
    }

    fn is_in_image(&self, [u, v]: [i64; 2]) -> bool {
        let camera = &self.raster.camera;
        (0..i64::from(camera.width)).contains(&u) && (0..i64::from(camera.height)).contains(&v)
    }

    /// Returns the information of the positions where scan lines leave the side for something farther away.
    fn of_silhouettes<S: Surface<N>, const N: usize>(&self, surface: &S) -> SMatrix<f64, N, N> {
        let (q, derivatives) = (surface.coefficients(), surface.derivatives());
        let variance = 1.0 / 12.0 + self.measuring.edge_jitter_px.powi(2);
        let mut information = SMatrix::zeros();
        for [u, v] in self.pixels().filter(|pixel| self.is_side(&q, *pixel)) {
            for [step_u, step_v] in BESIDE {
                if !self.is_farther([u, v], [u + step_u, v + step_v]) {
                    continue;
                }
                if let Some(tangent) = self.tangent(&q, [u, v], [step_u, step_v]) {
                    let slopes = SVector::<f64, N>::from_fn(|i, _| tangent.shift(&q, &derivatives[i]));
                    information += slopes * slopes.transpose() / variance;
                }
            }
        }
        information
    }

    /// Whether a pixel is in the image and shows either nothing or something farther away than another pixel does.
    fn is_farther(&self, here: [i64; 2], there: [i64; 2]) -> bool {
        if !self.is_in_image(there) {
            return false;
        }
        let [here, there] = [here, there].map(|[u, v]| self.raster.index(u, v));
        let owner = self.raster.owner[there];
        owner != self.owner && (owner == NO_OWNER || self.raster.depth[there] > self.raster.depth[here])
    }

    /// Returns the ray between a pixel and its neighbour that touches the surface; `None` if the scan line leaves the object at
    /// an end, or if the contour is so flat to it that the other scan lines count.
    fn tangent(&self, q: &Coefficients, [u, v]: [i64; 2], [step_u, step_v]: [i64; 2]) -> Option<Tangent> {
        let camera = &self.raster.camera;
        let start = ray(camera, u, v);
        let [across_u, across_v] = [Vector3::new(1.0 / camera.fx, 0.0, 0.0), Vector3::new(0.0, 1.0 / camera.fy, 0.0)];
        let [pixel, other] = if step_u != 0 { [across_u, across_v] } else { [across_v, across_u] };
        let pixel = pixel * (step_u + step_v) as f64;
        let discriminant = |share: f64| Along::new(q, &(start + pixel * share)).discriminant();
        // more than half a pixel beyond the neighbour, the contour is not the visible edge
        let [seen, unseen] = [0.0, 1.5];
        if discriminant(seen) < 0.0 || discriminant(unseen) >= 0.0 {
            return None;
        }
        let ray = start + pixel * end_of(|share| discriminant(share) >= 0.0, [seen, unseen]);
        let along = Along::new(q, &ray);
        let per_pixel = along.change(&Along::change_of_ray(q, &ray, &pixel));
        let per_other = along.change(&Along::change_of_ray(q, &ray, &other));
        // at exactly 45 degrees, rows count one of two pieces and columns the other
        let is_steep = if step_u != 0 { per_pixel.abs() >= per_other.abs() } else { per_pixel.abs() > per_other.abs() };
        is_steep.then_some(Tangent { ray, per_pixel })
    }
}

fn inverse<const N: usize>(information: &SMatrix<f64, N, N>) -> Option<SMatrix<f64, N, N>> {
    // scaled, as the parameters have different units: radians and metres
    let scale = SVector::<f64, N>::from_fn(|i, _| information[(i, i)].sqrt().recip());
    if !scale.iter().all(|number| number.is_finite()) {
        return None;
    }
    let scaling = SMatrix::from_diagonal(&scale);
    Some(scaling * (scaling * information * scaling).cholesky()?.inverse() * scaling)
}

/// `F` at a point, or its derivative by a parameter.
fn value(q: &Coefficients, p: &Vector3<f64>) -> f64 {
    let Along { a, b, c } = Along::new(q, p);
    a + b + c
}

/// `F(z r) = a z^2 + b z + c` along a ray.
#[derive(Clone, Copy)]
struct Along {
    a: f64,
    b: f64,
    c: f64,
}

impl Along {
    fn new([xx, yy, zz, xy, xz, yz, x, y, z, c]: &Coefficients, r: &Vector3<f64>) -> Self {
        let a = xx * r.x * r.x + yy * r.y * r.y + zz * r.z * r.z + xy * r.x * r.y + xz * r.x * r.z + yz * r.y * r.z;
        Self { a, b: x * r.x + y * r.y + z * r.z, c: *c }
    }

    /// Returns its change for a step of the ray; `F` is quadratic, so that the central difference is exact.
    fn change_of_ray(q: &Coefficients, ray: &Vector3<f64>, step: &Vector3<f64>) -> Self {
        let [forth, back] = [Self::new(q, &(ray + step)), Self::new(q, &(ray - step))];
        Self { a: 0.5 * (forth.a - back.a), b: 0.5 * (forth.b - back.b), c: 0.0 }
    }

    fn discriminant(&self) -> f64 {
        self.b * self.b - 4.0 * self.a * self.c
    }

    /// Returns the change of the discriminant.
    fn change(&self, by: &Self) -> f64 {
        2.0 * self.b * by.b - 4.0 * (by.a * self.c + self.a * by.c)
    }
}

/// A ray that touches a surface.
struct Tangent {
    ray: Vector3<f64>,
    /// Change of the discriminant per pixel along the scan line.
    per_pixel: f64,
}

impl Tangent {
    /// Returns how far the tangent moves along the scan line for a change of the surface, in pixels.
    fn shift(&self, q: &Coefficients, change: &Coefficients) -> f64 {
        -Along::new(q, &self.ray).change(&Along::new(change, &self.ray)) / self.per_pixel
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::shapes::{self, Frustum, Plane, Shape};
    use conicflow_messages::Camera;
    use nalgebra::DMatrix;
    use std::f64::consts::PI;

    const SIGMA_M: f64 = 0.002;
    /// Noise so large that most information is in the silhouettes.
    const VAGUE_M: f64 = 0.5;
    const JITTER_PX: f64 = 0.5;

    fn measuring(dropout_deg: f64) -> Measuring {
        measuring_with(SIGMA_M, dropout_deg)
    }

    fn measuring_with(sigma_m: f64, dropout_deg: f64) -> Measuring {
        let noise = NoiseModel { floor_m: sigma_m, ..NoiseModel::IDEAL };
        Measuring { noise, dropout_angle: f64::to_radians(dropout_deg), edge_jitter_px: JITTER_PX }
    }

    fn wall(z: f64, half: f64, [x, y]: [f64; 2]) -> Shape {
        let (point, sides) = (Vector3::new(x, y, z), [Vector3::x(), Vector3::y()]);
        Shape::Plane(Plane { point, normal: -Vector3::z(), sides, half: [half; 2] })
    }

    fn sphere(z: f64, radius: f64) -> (Shape, Object) {
        let center = Vector3::new(0.0, 0.0, z);
        let body = Object { kind: ObjectKind::Sphere.code(), center: center.into(), radius, ..Object::default() };
        (Shape::Sphere(shapes::Sphere { center, radius }), body)
    }

    fn frustum(middle: Vector3<f64>, axis: Vector3<f64>, radius: f64, slope: f64, length: f64) -> (Shape, Object) {
        let axis = axis.normalize();
        let radius_at = |share: f64| radius + slope * share * length;
        let shape = Shape::Frustum(Frustum {
            base: middle - axis * (0.5 * length),
            axis,
            length,
            base_radius: radius_at(-0.5),
            top_radius: radius_at(0.5),
            open: false,
        });
        let kind = if slope == 0.0 { ObjectKind::Cylinder } else { ObjectKind::Cone };
        let (center, axis) = (middle.into(), axis.into());
        let body =
            Object { kind: kind.code(), center, axis, radius, length, half_angle: slope.atan(), ..Object::default() };
        (shape, body)
    }

    /// A camera so far away that all rays are nearly parallel; the radius is 120 pixels.
    const FAR: Camera = Camera { width: 400, height: 400, fx: 40_000.0, fy: 40_000.0, cx: 199.7, cy: 199.6 };

    fn assert_near(what: &str, number: f64, expected: f64, share: f64) {
        assert!((number / expected - 1.0).abs() < share, "{what}: {number}, expected {expected}");
    }

    /// Under parallel rays with white noise, over the disc of the sphere with c the cosine between ray and normal, and w the
    /// weight: `dz/dR = -1/c`, `dz/dcz = 1`, `dz/dcx = tan cos(phi)`, and pixels are `2 pi R^2 c dc`. With
    /// `W0, W1, W2 = integral of w c, w, w / c` the variances follow in closed form. The pixels at the rim, `max(|cos phi|,
    /// |sin phi|)` wide, end the integrals at `c1 = sqrt(2 width / R)`.
    #[test]
    fn the_bounds_of_a_sphere_are_those_of_the_formula() {
        const RADIUS_PX: f64 = 120.0;
        let (shape, body) = sphere(100.0, 0.3);
        let raster = Raster::of(FAR, &[shape]);
        let c0 = 70_f64.to_radians().cos();
        let mean_of_rim = |power: f64| {
            let widths = (0..1000).map(|step| (f64::from(step) / 1000.0 * PI / 4.0).cos());
            widths.map(|width| (2.0 * width / RADIUS_PX).powf(0.5 * power)).sum::<f64>() / 1000.0
        };
        let w0 = (1.0 - c0 * c0) / 2.0 + c0 * c0 / 3.0 - mean_of_rim(3.0) / (3.0 * c0);
        let w1 = 1.0 - c0 + c0 / 2.0 - mean_of_rim(2.0) / (2.0 * c0);
        let w2 = 1.0 - c0.ln() - mean_of_rim(1.0) / c0;
        let (pixels, per_metre) = (2.0 * PI * RADIUS_PX * RADIUS_PX, FAR.fx / 100.0);
        let variance = |information: f64| SIGMA_M * SIGMA_M / (pixels * information);
        let bounds = bounds(&raster, 0, &body, &measuring(70.0)).unwrap();
        assert_near("radius by depths", bounds.depths.radius_m, variance(w2 - w1 * w1 / w0).sqrt(), 0.02);
        let across = variance(0.5 * (w2 - w0));
        let along = variance(w0 - w1 * w1 / w2);
        assert_near("position by depths", bounds.depths.position_m, (2.0 * across + along).sqrt(), 0.02);
        // each quarter of the circle has scan lines R cos phi d phi, along which it moves by 1 / cos phi
        let edges = 8.0 * RADIUS_PX * (1.0 + 2_f64.sqrt()).ln() / (1.0 / 12.0 + JITTER_PX * JITTER_PX);
        for sigma_m in [SIGMA_M, VAGUE_M] {
            let bounds = super::bounds(&raster, 0, &body, &measuring_with(sigma_m, 70.0)).unwrap();
            let by_depths = pixels / (sigma_m * sigma_m);
            let information = by_depths * (w2 - w1 * w1 / w0) + edges * per_metre * per_metre;
            assert_near("radius by both", bounds.contour.radius_m, information.sqrt().recip(), 0.02);
        }
        assert_eq!((bounds.depths.axis, bounds.depths.half_angle), (None, None));
    }

    /// A board in front of the left half hides its depths and silhouette: half of the contour's information about the radius is
    /// lost, and the contour of the board has none.
    #[test]
    fn what_is_hidden_tells_nothing() {
        let (shape, body) = sphere(100.0, 0.3);
        let of = |shapes: &[Shape]| bounds(&Raster::of(FAR, shapes), 0, &body, &measuring(70.0)).unwrap();
        let (free, hidden) = (of(&[shape, wall(101.0, 5.0, [0.0; 2])]), of(&[shape, wall(99.0, 0.6, [-0.6, 0.0])]));
        assert_eq!(free, of(&[shape]), "before a wall or before nothing");
        // half of the information, part of which goes into distinguishing depth from lateral position
        for (hidden, free) in [(hidden.depths, free.depths), (hidden.contour, free.contour)] {
            assert!(hidden.radius_m > 1.4 * free.radius_m, "{hidden:?} {free:?}");
            assert!(hidden.position_m > 1.4 * free.position_m, "{hidden:?} {free:?}");
        }
        assert_eq!(bounds(&Raster::of(FAR, &[shape, wall(99.0, 5.0, [0.0; 2])]), 0, &body, &measuring(70.0)), None);
    }

    /// A board in front of the right or lower half of a sphere hides half of the contour; its own contour, in the middle of the
    /// sphere, has no information.
    #[test]
    fn the_contour_of_what_hides_an_object_tells_nothing_of_it() {
        let (shape, body) = sphere(100.0, 0.3);
        let information = |shapes: &[Shape]| {
            let raster = Raster::of(FAR, shapes);
            let measuring = measuring(70.0);
            let view = View { raster: &raster, owner: 0, measuring: &measuring };
            let surface = Sphere { center: Vector3::from(body.center), radius: body.radius };
            view.of_silhouettes(&surface)
        };
        let free = information(&[shape]);
        assert_eq!(free, information(&[shape, wall(101.0, 5.0, [0.0; 2])]), "before a wall or before nothing");
        for (x, y) in [(0.6, 0.0), (-0.6, 0.0), (0.0, 0.6), (0.0, -0.6)] {
            let half = information(&[shape, wall(99.0, 0.6, [x, y])]);
            assert_near(&format!("the radius beside a board at {x}, {y}"), half[(3, 3)], 0.5 * free[(3, 3)], 0.03);
            // The visible side determines both; the mean of its cosine outwards is 2 / pi.
            let side = if x == 0.0 { 1 } else { 0 };
            let outwards = half[(3, side)] * -(x + y).signum();
            assert!(outwards > 0.5 * half[(3, 3)] && half[(3, 1 - side)].abs() < 0.05 * half[(3, 3)], "{half}");
        }
    }

    /// An image that ends in the middle of a sphere shows half of its contour and of its depths.
    #[test]
    fn where_the_image_ends_is_no_contour() {
        let (shape, body) = sphere(100.0, 0.3);
        let of = |camera: Camera| {
            let (raster, measuring) = (Raster::of(camera, &[shape]), measuring(70.0));
            let view = View { raster: &raster, owner: 0, measuring: &measuring };
            let surface = Sphere { center: Vector3::from(body.center), radius: body.radius };
            [view.of_depths(&surface)[(3, 3)], view.of_silhouettes(&surface)[(3, 3)]]
        };
        let whole = of(FAR);
        for half in [
            Camera { width: 200, ..FAR },
            Camera { height: 200, ..FAR },
            Camera { width: 200, cx: -0.3, ..FAR },
            Camera { height: 200, cy: -0.4, ..FAR },
        ] {
            for (half, whole) in of(half).into_iter().zip(whole) {
                assert_near("half of the information", half, 0.5 * whole, 0.03);
            }
        }
    }

    /// The position is that of the tangent ray, not that of the pixel.
    #[test]
    fn a_tangent_touches_the_surface_less_than_a_pixel_and_a_half_away() {
        let (shape, body) = sphere(100.0, 0.3);
        let (raster, measuring) = (Raster::of(FAR, &[shape]), measuring(70.0));
        let view = View { raster: &raster, owner: 0, measuring: &measuring };
        let q = Sphere { center: Vector3::from(body.center), radius: body.radius }.coefficients();
        let mut count = 0;
        for [u, v] in view.pixels().filter(|pixel| view.is_side(&q, *pixel)) {
            for [step_u, step_v] in BESIDE {
                let is_edge = view.is_farther([u, v], [u + step_u, v + step_v]);
                let tangent = view.tangent(&q, [u, v], [step_u, step_v]).filter(|_| is_edge);
                let Some(tangent) = tangent else { continue };
                // Under nearly parallel rays the silhouette is a circle of this radius around the middle of the image.
                let place = FAR.fx * tangent.ray.xy().norm();
                let radius_px = FAR.fx * (0.3_f64 / 100.0).asin().tan();
                assert!((place - radius_px).abs() < 1e-3, "{place} {radius_px}");
                let moved = tangent.ray - ray(&FAR, u, v);
                let along = FAR.fx * (moved.x * step_u as f64 + moved.y * step_v as f64);
                assert!((0.0..=1.5).contains(&along) && FAR.fx * moved.norm() - along < 1e-6, "{along}");
                count += 1;
            }
        }
        // The number is that of columns and rows between 45 degrees on each side: 4 * 2 * 120 * cos 45.
        assert!((count as f64 - 8.0 * 120.0 * 0.5_f64.sqrt()).abs() < 12.0, "{count}");
    }

    const NEAR: Camera = Camera { width: 160, height: 120, fx: 131.0, fy: 133.0, cx: 80.3, cy: 58.7 };

    /// Returns the depths of the side, and the silhouette's positions in rows and columns, as traced by the simulator.
    fn traced(shape: &Shape, pixels: &[[i64; 2]], edges: &[([i64; 2], [i64; 2])]) -> Vec<f64> {
        use crate::simulator::shapes::Surface as _;
        let depth = |[u, v]: &[i64; 2]| shape.hit(&Vector3::zeros(), &ray(&NEAR, *u, *v));
        let edge = |([u, v], [step_u, step_v]): &([i64; 2], [i64; 2])| {
            let (start, pixel) =
                (ray(&NEAR, *u, *v), Vector3::new(*step_u as f64 / NEAR.fx, *step_v as f64 / NEAR.fy, 0.0));
            let (mut seen, mut unseen) = (0.0, 1.5);
            for _ in 0..45 {
                let middle = 0.5 * (seen + unseen);
                let hits = shape.hit(&Vector3::zeros(), &(start + pixel * middle)).is_finite();
                *(if hits { &mut seen } else { &mut unseen }) = middle;
            }
            seen
        };
        pixels.iter().map(depth).chain(edges.iter().map(edge)).collect()
    }

    /// Computes the information by brute force: moves each parameter a little forth and back, and traces all rays anew.
    fn by_differences(view: &View, conical: &Conical, length: f64) -> [DMatrix<f64>; 2] {
        const STEP: f64 = 1e-6;
        let q = conical.coefficients();
        let pixels: Vec<_> = view.pixels().filter(|pixel| view.is_within(&q, *pixel)).collect();
        let sides = view.pixels().filter(|pixel| view.is_side(&q, *pixel));
        let edges: Vec<_> = sides
            .flat_map(|[u, v]| BESIDE.map(|step| ([u, v], step)))
            .filter(|([u, v], step)| view.is_farther([*u, *v], [u + step[0], v + step[1]]))
            .filter(|(pixel, step)| view.tangent(&q, *pixel, *step).is_some())
            .collect();
        assert!(pixels.len() > 800 && edges.len() > 60, "{} pixels, {} edges", pixels.len(), edges.len());
        let moved = |parameter: usize, step: f64| {
            let Conical { point: mut middle, mut axis, mut radius, mut slope } = *conical;
            let [across, other] = conical.across();
            match parameter {
                0 => axis += across * step,
                1 => axis += other * step,
                2 => middle += across * step,
                3 => middle += other * step,
                4 => radius += step,
                _ => slope += step,
            }
            // longer than the object, so that rays to its ends always meet the side
            traced(&frustum(middle, axis, radius, slope, 1.2 * length).0, &pixels, &edges)
        };
        let count = if conical.slope == 0.0 { 5 } else { 6 };
        let slopes = |parameter| {
            let (forth, back) = (moved(parameter, STEP), moved(parameter, -STEP));
            forth.iter().zip(back).map(|(a, b)| (a - b) / (2.0 * STEP)).collect()
        };
        let slopes: Vec<Vec<f64>> = (0..count).map(slopes).collect();
        let weight = |&[u, v]: &[i64; 2]| {
            let (point, normal) = (view.raster.point(u, v), gradient(&q, &view.raster.point(u, v)));
            let cosine = -normal.dot(&point) / (normal.norm() * point.norm());
            (cosine / view.measuring.dropout_angle.cos()).min(1.0) / view.measuring.noise.variance(point.z)
        };
        let of_edges = edges.iter().map(|_| 1.0 / (1.0 / 12.0 + JITTER_PX * JITTER_PX));
        let weights: Vec<f64> = pixels.iter().map(weight).chain(of_edges).collect();
        let information = |to: usize| {
            let sum = |i: usize, j: usize| (0..to).map(|n| weights[n] * slopes[i][n] * slopes[j][n]).sum();
            DMatrix::from_fn(count, count, sum)
        };
        [information(pixels.len()), information(weights.len())]
    }

    #[test]
    fn cylinder_and_cone_agree_with_differences_of_traced_rays() {
        // At 20 degrees most pixels have a reduced probability; rays towards the border of the image are longer.
        for (slope, sigma_m, dropout_deg) in [
            (0.0, SIGMA_M, 70.0),
            (0.15, SIGMA_M, 70.0),
            (0.0, VAGUE_M, 70.0),
            (0.15, VAGUE_M, 70.0),
            (0.0, SIGMA_M, 20.0),
        ] {
            let aside = if dropout_deg < 70.0 { 0.6 } else { 0.1 };
            let (point, axis) = (Vector3::new(aside, -0.05, 1.5), Vector3::new(0.35, 0.9, 0.4).normalize());
            let (radius, length) = (0.15, 0.5);
            let (shape, body) = frustum(point, axis, radius, slope, length);
            let raster = Raster::of(NEAR, &[shape, wall(3.0, 9.0, [0.0; 2])]);
            let measuring = measuring_with(sigma_m, dropout_deg);
            let view = View { raster: &raster, owner: 0, measuring: &measuring };
            let [depths, both] = by_differences(&view, &Conical { point, axis, radius, slope }, length);
            let bounds = bounds(&raster, 0, &body, &measuring).unwrap();
            for (name, information, bound) in [("A", depths, bounds.depths), ("B", both, bounds.contour)] {
                let covariance = information.try_inverse().unwrap();
                let root = |indices: &[usize]| indices.iter().map(|&i| covariance[(i, i)]).sum::<f64>().sqrt();
                assert_near(&format!("{name} radius"), bound.radius_m, root(&[4]), 0.02);
                assert_near(&format!("{name} position"), bound.position_m, root(&[2, 3]), 0.02);
                assert_near(&format!("{name} axis"), bound.axis.unwrap(), root(&[0, 1]), 0.02);
                assert_eq!(bound.half_angle.is_some(), slope != 0.0);
                if let Some(half_angle) = bound.half_angle {
                    let cosine_squared = 1.0 / (1.0 + slope * slope);
                    assert_near(&format!("{name} half-angle"), half_angle, root(&[5]) * cosine_squared, 0.02);
                }
            }
        }
    }
}
