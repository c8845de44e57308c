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

use crate::pooled::add_square;
use crate::space::dot;
use crate::{Coefficients, Surface, Vector3};
use nalgebra::{Matrix2, SMatrix, SVector, Vector2};

/// SideInputs of an object that have an offset of their own: the first and the last pixel of rows and of columns.
pub const SIDES: usize = 4; // [derived]
/// A contour point farther off than so many standard deviations belongs to something else.
const GATE: f64 = 3.5; // [sigmas]

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
    /// Scatter of a point, in pixels.
    pub point_px: f64,
    /// Further scatter of a point, in radii.
    pub point_share: f64,
    /// Scatter of the offset of a side, in pixels.
    pub offset_px: f64,
    /// Scatter of the share of the radius by which a side is off.
    pub share: f64,
}

/// The contour of an object; the buffer is used again for the next.
#[derive(Clone, Debug, Default)]
pub struct Contour {
    points: Vec<(ContourPoint, bool)>,
    noise: ContourNoise,
    /// How many of the points that are seen are too far off.
    far_off: usize,
    /// How far each point is off, in pixels.
    errors: Vec<f64>,
    /// How far the points of one side are off: a buffer.
    of_side: Vec<f64>,
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

/// `F(z r) = a z^2 + b z + c` along a ray, and the changes of a and b per pixel.
#[derive(Clone, Copy)]
struct Along {
    a: f64,
    b: f64,
    c: f64,
    a_pixel: f64,
    b_pixel: f64,
}

impl Along {
    #[inline]
    fn new(q: &Coefficients, point: &ContourPoint) -> Self {
        let (r, pixel) = (&point.ray, &point.pixel);
        let [xx, yy, zz, xy, xz, yz, x, y, z, c] = *q;
        // half the gradient of a
        let half = Vector3::new(
            xx * r.x + 0.5 * (xy * r.y + xz * r.z),
            yy * r.y + 0.5 * (xy * r.x + yz * r.z),
            zz * r.z + 0.5 * (xz * r.x + yz * r.y),
        );
        let b = Vector3::new(x, y, z);
        Self { a: half.dot(r), b: b.dot(r), c, a_pixel: 2.0 * half.dot(pixel), b_pixel: b.dot(pixel) }
    }

    /// The discriminant, and its change per pixel.
    fn discriminant(&self) -> [f64; 2] {
        [self.b * self.b - 4.0 * self.a * self.c, 2.0 * self.b * self.b_pixel - 4.0 * self.a_pixel * self.c]
    }

    /// Error, and its derivatives by the coefficients: `(dD - e dD') / D'`, D' being the change of D per pixel.
    fn error_gradient(&self, point: &ContourPoint) -> (f64, Coefficients) {
        let [value, per_pixel] = self.discriminant();
        let error = value / per_pixel;
        let (r, pixel) = (&point.ray, &point.pixel);
        // What a, a', b, b' and c add to it.
        let by_a = -4.0 * self.c / per_pixel;
        let by_a_pixel = -error * by_a;
        let by_b = 2.0 * (self.b - error * self.b_pixel) / per_pixel;
        let by_b_pixel = -2.0 * error * self.b / per_pixel;
        let by_c = -4.0 * (self.a - error * self.a_pixel) / per_pixel;
        // a = r'Ar and a' = 2 r'A pixel: both are linear in A, as `r'A (by_a r + 2 by_a' pixel)`.
        let w = r * by_a + pixel * (2.0 * by_a_pixel);
        let b = r * by_b + pixel * by_b_pixel;
        let mixed = |i: usize, j: usize| 0.5 * (r[i] * w[j] + r[j] * w[i]);
        let [xy, xz, yz] = [mixed(0, 1), mixed(0, 2), mixed(1, 2)];
        (error, [r.x * w.x, r.y * w.y, r.z * w.z, xy, xz, yz, b.x, b.y, b.z, by_c])
    }

    /// How far the ray is off the contour, in pixels along the line.
    fn error(&self) -> f64 {
        let [value, per_pixel] = self.discriminant();
        value / per_pixel
    }

    /// Depth at which the ray touches the surface.
    fn depth(&self) -> f64 {
        -0.5 * self.b / self.a
    }
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

    /// Uses only the points that are near the contour of a surface, and only those for which `seen` holds at the point
    /// of the surface that the ray touches.
    pub fn select<S: Surface<N>, const N: usize>(&mut self, surface: &S, seen: impl Fn(&Vector3) -> bool) {
        let q = surface.coefficients();
        self.errors.clear();
        for (point, used) in &mut self.points {
            let along = Along::new(&q, point);
            *used = seen(&(point.ray * along.depth()));
            self.errors.push(along.error());
        }
        let middles = std::array::from_fn::<_, SIDES, _>(|side| self.median(side));
        self.far_off = 0;
        for ((point, used), error) in self.points.iter_mut().zip(&self.errors) {
            let is_near = (error - middles[point.side]).abs() < GATE * self.noise.of(point).sqrt();
            self.far_off += usize::from(*used && !is_near);
            *used &= is_near;
        }
    }

    /// Number of points.
    pub fn points(&self) -> usize {
        self.points.len()
    }

    /// How many of them are used.
    pub fn used(&self) -> usize {
        self.points.iter().filter(|(_, used)| *used).count()
    }

    /// How many of them are seen, and too far off to be used.
    pub fn far_off(&self) -> usize {
        self.far_off
    }

    /// What the points that were selected against for being too far off would at least add to the weighted sum of squares.
    /// They come in stretches, such as the rim of a bucket, that are off for one reason: all of them count as one.
    pub fn least_left_out(&self) -> f64 {
        if self.far_off > 0 { GATE * GATE } else { 0.0 }
    }

    /// The median of how far the points of a side are off, within what its offset may be.
    fn median(&mut self, side: usize) -> f64 {
        let Self { points, noise, errors, of_side, .. } = self;
        of_side.clear();
        of_side.extend(points.iter().zip(errors).filter(|((point, _), _)| point.side == side).map(|(_, error)| *error));
        if of_side.is_empty() {
            return 0.0;
        }
        let (middle, limit) = (of_side.len() / 2, 2.0 * noise.offset_px);
        of_side.select_nth_unstable_by(middle, f64::total_cmp).1.clamp(-limit, limit)
    }

    /// The term of a surface, that is given in a frame with this origin and unit of length.
    pub fn term<S: Surface<N>, const N: usize>(&self, surface: &S, origin: &Vector3, scale: f64) -> ContourTerm<N> {
        let camera = |q: &Coefficients| in_camera_frame(q, origin, scale);
        let q = camera(&surface.coefficients());
        let derivatives = surface.derivatives().map(|derivative| camera(&derivative));
        let mut sides = [SideSums::default(); SIDES];
        for (point, _) in self.points.iter().filter(|(_, used)| *used) {
            let (error, gradient) = Along::new(&q, point).error_gradient(point);
            let slope = SVector::<f64, N>::from_fn(|i, _| dot(&gradient, &derivatives[i]));
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
        add_square(&mut self.slopes, slope, weight);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Conical, FreeSlope, Pinhole, Scan, section_of};

    const CAMERA: Pinhole = Pinhole { fx: 290.0, fy: 290.0, cx: 159.5, cy: 119.5 };
    const NOISE: ContourNoise = ContourNoise { point_px: 0.5, point_share: 0.03, offset_px: 1.0, share: 0.05 };

    fn cup() -> Conical {
        let axis = Vector3::new(0.1, 0.9, -0.3).normalize();
        Conical { point: Vector3::new(0.05, 0.02, 1.2), axis, radius: 0.05, slope: 0.12 }
    }

    /// The contour of a surface on rows 105 to 140, moved outwards by so many pixels.
    fn contour(surface: &Conical, outwards: f64) -> Contour {
        let mut contour = Contour::default();
        contour.clear(NOISE);
        for row in 105..140 {
            let plane = CAMERA.plane(Scan::Row, f64::from(row));
            let [ss, st, tt, s, t, one] = section_of(&FreeSlope(*surface).coefficients(), &plane);
            let k = plane.stretch();
            // the discriminant along the ray of slope x, as a polynomial of x
            let (a, b) = (s * s - 4.0 * ss * one, 2.0 * s * t * k - 4.0 * st * k * one);
            let c = t * t * k * k - 4.0 * tt * k * k * one;
            let root = (b * b - 4.0 * a * c).sqrt();
            let mut slopes = [(-b - root) / (2.0 * a), (-b + root) / (2.0 * a)];
            slopes.sort_by(f64::total_cmp);
            for (side, slope) in slopes.into_iter().enumerate() {
                let slope = slope + outwards * if side == 0 { -1.0 } else { 1.0 } / CAMERA.fx;
                let ray = plane.to_camera([slope, k]);
                let pixel = plane.s_axis() / CAMERA.fx;
                contour.add(ContourPoint { ray, pixel, side, radius_px: 12.0 });
            }
        }
        contour
    }

    fn cost(contour: &Contour, surface: &Conical) -> f64 {
        contour.term(&FreeSlope(*surface), &Vector3::zeros(), 1.0).square_sum
    }

    #[test]
    fn the_true_surface_touches_its_contour() {
        let contour = contour(&cup(), 0.0);
        assert!(cost(&contour, &cup()) < 1e-12);
        let (origin, scale) = (Vector3::new(0.0, 0.1, 1.1), 0.04);
        let local = FreeSlope(cup()).to_local(&origin, scale);
        assert!(contour.term(&local, &origin, scale).square_sum < 1e-12, "in any frame");
    }

    #[test]
    fn a_taper_costs_and_an_offset_hardly_does() {
        let tapered = cost(&contour(&cup(), 0.0), &Conical { slope: 0.0, ..cup() });
        let shifted = cost(&contour(&cup(), 1.0), &cup());
        assert!(tapered > 20.0 && shifted < 3.0, "{tapered} {shifted}");
    }

    #[test]
    fn the_gradient_is_that_of_the_cost() {
        let contour = contour(&Conical { slope: 0.1, radius: 0.049, ..cup() }, 0.4);
        let surface = FreeSlope(cup());
        let term = contour.term(&surface, &Vector3::zeros(), 1.0);
        for i in 0..6 {
            let at = |h: f64| {
                let mut step = [0.0; 6];
                step[i] = h;
                cost(&contour, &surface.moved(&step).unwrap().0)
            };
            let slope = (at(1e-6) - at(-1e-6)) / 4e-6;
            let scale = 1.0 + term.gradient.amax();
            assert!((slope - term.gradient[i]).abs() < 1e-4 * scale, "{i}: {slope} {}", term.gradient[i]);
        }
    }

    #[test]
    fn what_is_far_off_is_not_used() {
        let mut contour = contour(&cup(), 0.0);
        let [first, ..] = contour.points[..] else { panic!() };
        for far_off in 1..=3 {
            contour.add(ContourPoint { ray: first.0.ray + first.0.pixel * 8.0, ..first.0 });
            contour.select(&FreeSlope(cup()), |_| true);
            assert_eq!((contour.used() + far_off, contour.far_off()), (contour.points(), far_off));
            assert_eq!(contour.least_left_out(), GATE * GATE, "all for one reason");
        }
        contour.select(&FreeSlope(cup()), |_| false);
        assert_eq!((contour.used(), contour.far_off(), contour.least_left_out()), (0, 0, 0.0));
    }
}
