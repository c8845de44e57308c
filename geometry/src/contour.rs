//! The occluding contour as a measurement: where a scan line leaves a surface for something farther behind it, its ray
//! touches the surface.
//!
//! A ray `z r` meets `F = 0` where `a z^2 + b z + c = 0`, a, b and c linear in the coefficients of F; it touches where the
//! discriminant `D = b^2 - 4 a c` is zero. `D` over its change per pixel along the line is the distance of the contour
//! from where it was seen, in pixels.
//!
//! Sensors put contours systematically too far in (grazing points get lost) or out (they are smeared), so those of one
//! side share an unknown offset and an unknown share of the radius r that is lost: `e_i = o + p r_i + noise`. With
//! `U = [1, r_i]`, V the variances of o and p, and the weights w of the points, these are eliminated by
//! `e'we - (U'we)' (V^-1 + U'wU)^-1 (U'we)`. What is left tells how the outline narrows and leans,
//! which the depths of a small object hardly do.

use crate::{Coefficients, Surface, Vector3};
use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

/// Sides of an object that have an offset of their own: the first and the last pixel of rows and of columns.
pub const SIDES: usize = 4;
/// Contours farther off than this many standard deviations belong to something else.
const GATE: f64 = 3.5;

/// A place where a scan line leaves a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContourPoint {
    /// A point on the ray, in the camera frame.
    pub ray: Vector3,
    /// Its change per pixel along the scan line.
    pub pixel: Vector3,
    /// Which side of the object it is on, less than [`SIDES`].
    pub side: usize,
    /// Radius of the object there, in pixels.
    pub radius_px: f64,
}

/// How exact contours are: standard deviations.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ContourNoise {
    /// Of a point, in pixels ...
    pub point_px: f64,
    /// ... and, on top of it, in radii.
    pub point_share: f64,
    /// Of the offset of a side, in pixels.
    pub offset_px: f64,
    /// Of the share of the radius that a side is off.
    pub share: f64,
}

/// The contour of an object; the buffer is used again for the next.
#[derive(Clone, Debug, Default)]
pub struct Contour {
    points: Vec<(ContourPoint, bool)>,
    /// Number of points that might be on the contour of the surface they were selected for.
    seen: usize,
    noise: ContourNoise,
}

/// Its part in the normal equations of a fit.
#[derive(Clone, Copy, Debug)]
pub struct ContourTerm<const N: usize> {
    /// Weighted sum of squares.
    pub square_sum: f64,
    /// Half its gradient.
    pub gradient: SVector<f64, N>,
    /// Gauss and Newton's matrix.
    pub matrix: SMatrix<f64, N, N>,
}

/// Sums over the points of one side.
#[derive(Clone, Copy)]
struct SideSums<const N: usize> {
    square: f64,
    slope_error: SVector<f64, N>,
    slopes: SMatrix<f64, N, N>,
    /// `U'wU`, `U'we` and `U'wJ`.
    shared: Matrix2<f64>,
    shared_error: Vector2<f64>,
    shared_slope: SMatrix<f64, 2, N>,
}

/// `(a, b, c)` of `F(z r) = a z^2 + b z + c`.
fn along(q: &Coefficients, r: &Vector3) -> [f64; 3] {
    let [xx, yy, zz, xy, xz, yz, x, y, z, one] = *q;
    let a = r.x * (xx * r.x + xy * r.y + xz * r.z) + r.y * (yy * r.y + yz * r.z) + zz * r.z * r.z;
    [a, x * r.x + y * r.y + z * r.z, one]
}

impl Contour {
    /// No points yet.
    pub fn clear(&mut self, noise: ContourNoise) {
        self.points.clear();
        self.noise = noise;
    }

    /// Adds a point.
    pub fn add(&mut self, point: ContourPoint) {
        self.points.push((point, true));
    }

    /// Number of points that are used.
    pub fn used(&self) -> usize {
        self.points.iter().filter(|(_, used)| *used).count()
    }

    /// Number of points of which the surface might be the contour, near or not.
    pub fn seen(&self) -> usize {
        self.seen
    }

    /// How far a point is off the contour of a surface, in pixels along the line.
    fn error(point: &ContourPoint, q: &Coefficients) -> f64 {
        let [a, b, c] = along(q, &point.ray);
        let per_pixel = Self::change(point, q, b, c);
        (b * b - 4.0 * a * c) / per_pixel
    }

    /// Change of the discriminant per pixel.
    fn change(point: &ContourPoint, q: &Coefficients, b: f64, c: f64) -> f64 {
        let r = &point.ray;
        let gradient = crate::gradient(&[q[0], q[1], q[2], q[3], q[4], q[5], 0.0, 0.0, 0.0, 0.0], r);
        let [_, db, _] = along(q, &point.pixel);
        2.0 * b * db - 4.0 * gradient.dot(&point.pixel) * c
    }

    /// Uses only the points that are near the contour of a surface, and only those for which `seen` holds at the point
    /// of the surface that the ray touches.
    pub fn select<S: Surface<N>, const N: usize>(&mut self, surface: &S, seen: impl Fn(&Vector3) -> bool) {
        self.seen = 0;
        let q = surface.coefficients();
        let mut middle = [0.0; SIDES];
        for (side, middle) in middle.iter_mut().enumerate() {
            *middle = self.median(side, &q);
        }
        for (point, used) in &mut self.points {
            let [a, b, _] = along(&q, &point.ray);
            let off = Self::error(point, &q) - middle[point.side];
            let is_seen = seen(&(point.ray * (-0.5 * b / a)));
            self.seen += usize::from(is_seen);
            *used = is_seen && off.abs() < GATE * self.noise.of(point).sqrt();
        }
    }

    fn median(&self, side: usize, q: &Coefficients) -> f64 {
        let errors = self.points.iter().filter(|(point, _)| point.side == side).map(|(point, _)| Self::error(point, q));
        let mut errors: Vec<f64> = errors.collect();
        if errors.is_empty() {
            return 0.0;
        }
        let middle = errors.len() / 2;
        let limit = 2.0 * self.noise.offset_px;
        errors.select_nth_unstable_by(middle, f64::total_cmp).1.clamp(-limit, limit)
    }

    /// The term of a surface, that is given in a frame with this origin and unit of length.
    pub fn term<S: Surface<N>, const N: usize>(&self, surface: &S, origin: &Vector3, scale: f64) -> ContourTerm<N> {
        let camera = |q: &Coefficients| in_camera_frame(q, origin, scale);
        let q = camera(&surface.coefficients());
        let derivatives = surface.derivatives().map(|derivative| camera(&derivative));
        let mut sides = [SideSums::default(); SIDES];
        for (point, _) in self.points.iter().filter(|(_, used)| *used) {
            let [a, b, c] = along(&q, &point.ray);
            let per_pixel = Self::change(point, &q, b, c);
            let error = (b * b - 4.0 * a * c) / per_pixel;
            let slope = SVector::<f64, N>::from_fn(|i, _| {
                let [da, db, dc] = along(&derivatives[i], &point.ray);
                (2.0 * b * db - 4.0 * (da * c + a * dc)) / per_pixel
            });
            sides[point.side].add(error, &slope, point.radius_px, self.noise.of(point));
        }
        let mut term = ContourTerm { square_sum: 0.0, gradient: SVector::zeros(), matrix: SMatrix::zeros() };
        for side in &sides {
            side.add_to(&mut term, &self.noise);
        }
        term
    }
}

impl<const N: usize> Default for SideSums<N> {
    fn default() -> Self {
        Self {
            square: 0.0,
            slope_error: SVector::zeros(),
            slopes: SMatrix::zeros(),
            shared: Matrix2::zeros(),
            shared_error: Vector2::zeros(),
            shared_slope: SMatrix::zeros(),
        }
    }
}

impl<const N: usize> SideSums<N> {
    fn add(&mut self, error: f64, slope: &SVector<f64, N>, radius_px: f64, variance: f64) {
        let (shared, weight) = (Vector2::new(1.0, radius_px), 1.0 / variance);
        self.square += error * error * weight;
        self.slope_error += slope * (error * weight);
        self.slopes += slope * slope.transpose() * weight;
        self.shared += shared * shared.transpose() * weight;
        self.shared_error += shared * (error * weight);
        self.shared_slope += shared * slope.transpose() * weight;
    }

    fn add_to(&self, term: &mut ContourTerm<N>, noise: &ContourNoise) {
        let prior = Vector2::new(noise.offset_px, noise.share).map(|sigma| sigma.powi(-2));
        let Some(inverse) = (self.shared + Matrix2::from_diagonal(&prior)).try_inverse() else { return };
        let (error, slope) = (inverse * self.shared_error, inverse * self.shared_slope);
        term.square_sum += self.square - self.shared_error.dot(&error);
        term.gradient += self.slope_error - self.shared_slope.transpose() * error;
        term.matrix += self.slopes - self.shared_slope.transpose() * slope;
    }
}

impl ContourNoise {
    /// Variance of a point, in square pixels.
    fn of(&self, point: &ContourPoint) -> f64 {
        self.point_px.powi(2) + (self.point_share * point.radius_px).powi(2)
    }
}

/// Coefficients of the same function of a point that is given in the camera frame.
fn in_camera_frame(q: &Coefficients, origin: &Vector3, scale: f64) -> Coefficients {
    let (one, square) = (1.0 / scale, 1.0 / (scale * scale));
    let o = origin / scale;
    let slope = crate::gradient(q, &-o) * one;
    let [xx, yy, zz, xy, xz, yz, x, y, z, constant] = *q;
    let value = o.x * (xx * o.x + xy * o.y + xz * o.z) + o.y * (yy * o.y + yz * o.z) + zz * o.z * o.z
        - (x * o.x + y * o.y + z * o.z)
        + constant;
    [xx * square, yy * square, zz * square, xy * square, xz * square, yz * square, slope.x, slope.y, slope.z, value]
}
