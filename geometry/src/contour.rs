//! The occluding contour as a measurement: where a scan line leaves a surface for something farther behind it, its ray touches
//! the surface.
//!
//! A ray `z r` meets `F = 0` where `a z^2 + b z + c = 0`; a, b and c are linear in the coefficients of F. It touches the surface
//! where the discriminant `D = b^2 - 4 a c` is zero. Along a scan line D is a polynomial of second degree. Its root is the place
//! of the contour, and the distance from there to the place where the contour was seen, in pixels, is the error.
//!
//! Sensors put contours systematically too far in (pixels at grazing incidence are lost) or too far out (silhouettes are
//! smeared). If the surface is lost at one angle of incidence, the lost band is a share p of the radius of curvature r that the
//! surface has there along the view. So the outline of one side is off by an offset o and by p r, both across the outline. Along
//! a line whose cosine to the normal of the outline is g, the error is `e_i = (o + p r_i) / g_i + noise`. With `U = [1, r_i] /
//! g_i` for each side, the weights w of the points, and the prior of o and p (its expectation is subtracted from e, its
//! covariance is V), o and p are eliminated by `e'we - (U'we)' (V^-1 + U'wU)^-1 (U'we)`.
//!
//! The points of the surface determine its size as well. So points and contour together give an estimate of o and p
//! ([`Contour::bias_evidence`]), and the scatter of the contour gives one of its noise ([`Contour::noise_evidence`]). Both serve
//! as prior for the next object.

use crate::space::dot;
use crate::{Coefficients, GradientNoise, Information, Surface, SurfaceFit, Vector3};
use nalgebra::{Matrix4, SMatrix, SVector, Vector2, Vector4};

/// Sides of an object that have a bias of their own: the first and the last pixel of its lines.
const SIDES: usize = 2; // [derived]
/// Gate on a contour point, in standard deviations: a point farther off belongs to something else.
const GATE: f64 = 3.5; // [sigmas]
/// Lower bound of the curvature along the view, in 1/m, which keeps the radius finite.
const LEAST_CURVATURE: f64 = 0.1; // [algorithmic]
/// Lower bound of the cosine between a scan line and the normal of an outline: a line that runs along the outline hardly shows
/// its place. Therefore the slope of the discriminant at the outline is also taken as at least this part of its slope at the ray.
const LEAST_ALONG: f64 = 0.3; // [algorithmic]

/// A point where a scan line leaves a surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContourPoint {
    /// A point on the ray, in the camera frame.
    pub ray: Vector3,
    /// Change of `ray` per pixel along the scan line.
    pub pixel: Vector3,
    /// Change of `ray` per pixel from scan line to scan line.
    pub across: Vector3,
    /// 0 for the first pixel of the line, 1 for the last.
    pub side: usize,
}

/// Noise and bias of contours.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ContourNoise {
    /// Variance of a point along its line: a part in square pixels and a part in squared radii.
    pub point: Vector2<f64>,
    /// Number of neighbouring lines that share the noise of the contour, at least 1.
    pub shared_lines: f64,
    /// Number of lines that share the noise of the surface's points, which may be means over several lines.
    pub surface_lines: f64,
    /// Bias of whole sides.
    pub bias: ContourBias,
}

/// Bias of the contour across the outline, positive along the line (inwards on the first side, outwards on the last): offset in
/// pixels and share of the radius of the first side, then of the last.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ContourBias {
    /// Expectation of the bias.
    pub mean: Vector4<f64>,
    /// Covariance of the bias.
    pub covariance: Matrix4<f64>,
}

/// The contour of an object; the buffer is used again for the next.
#[derive(Clone, Debug, Default)]
pub struct Contour {
    points: Vec<ModelledPoint>,
    noise: ContourNoise,
    /// Inverse of the covariance of the bias, scaled to weights of one over the variance of a point (see `clear`).
    prior: Matrix4<f64>,
    /// Number of points that are seen but too far off to be used.
    far_off: usize,
    /// Error of each point beyond the expected one, in pixels.
    errors: Vec<f64>,
    /// The errors of one side: a buffer.
    of_side: Vec<f64>,
}

/// A contour point and its relation to a surface.
#[derive(Clone, Copy, Debug)]
struct ModelledPoint {
    point: ContourPoint,
    /// Whether the point is near the contour of the surface.
    used: bool,
    /// Cosine between the scan line and the normal of the outline at the point.
    along: f64,
    /// Radius of curvature of the surface at the point, along the view, in pixels of the line.
    radius_px: f64,
    /// Expected error along the line, in pixels, and its variance.
    expected: f64,
    variance: f64,
}

/// Part of the contour in the normal equations of a fit.
#[derive(Clone, Copy, Debug)]
pub struct ContourTerm<const N: usize> {
    /// Weighted sum of squares.
    pub square_sum: f64,
    /// Half the gradient of `square_sum`.
    pub gradient: SVector<f64, N>,
    /// Gauss-Newton matrix.
    pub matrix: SMatrix<f64, N, N>,
}

/// Weighted sums over points with errors e, with J their derivatives by the surface's parameters and U those by the bias.
#[derive(Clone, Copy)]
struct Sums<const N: usize> {
    /// `e'we`, `J'we` and `J'wJ`.
    square: f64,
    slope_error: SVector<f64, N>,
    slopes: SMatrix<f64, N, N>,
    /// `U'wU`, `U'we` and `U'wJ`.
    shared: Matrix4<f64>,
    shared_error: Vector4<f64>,
    shared_slope: SMatrix<f64, 4, N>,
}

/// `F(z r) = a z^2 + b z + c` along a ray; a and b and their changes per pixel along the line.
#[derive(Clone, Copy)]
struct Along {
    a: f64,
    b: f64,
    c: f64,
    a_pixel: f64,
    b_pixel: f64,
    a_square: f64,
}

impl Along {
    #[inline]
    fn new(q: &Coefficients, r: &Vector3, pixel: &Vector3) -> Self {
        let [xx, yy, zz, xy, xz, yz, x, y, z, c] = *q;
        // half the gradient of a
        let half = |r: &Vector3| {
            Vector3::new(
                xx * r.x + 0.5 * (xy * r.y + xz * r.z),
                yy * r.y + 0.5 * (xy * r.x + yz * r.z),
                zz * r.z + 0.5 * (xz * r.x + yz * r.y),
            )
        };
        let (here, b) = (half(r), Vector3::new(x, y, z));
        Self {
            a: here.dot(r),
            b: b.dot(r),
            c,
            a_pixel: 2.0 * here.dot(pixel),
            b_pixel: b.dot(pixel),
            a_square: half(pixel).dot(pixel),
        }
    }

    /// Returns the coefficients of the discriminant as a polynomial of the pixels from the ray: constant, linear and quadratic.
    fn discriminant(&self) -> [f64; 3] {
        let Self { a, b, c, a_pixel, b_pixel, a_square } = *self;
        [b * b - 4.0 * a * c, 2.0 * b * b_pixel - 4.0 * a_pixel * c, b_pixel * b_pixel - 4.0 * a_square * c]
    }

    /// Returns the error of the ray in pixels along the line, and the slope of the discriminant per pixel at the contour. Where
    /// the line grazes or misses the contour, the lower bound [`LEAST_ALONG`] of the slope keeps both finite.
    fn error(&self) -> (f64, f64) {
        let [value, per_pixel, square] = self.discriminant();
        let there = (per_pixel * per_pixel - 4.0 * value * square).max(0.0).sqrt();
        let there = there.max(LEAST_ALONG * per_pixel.abs()).copysign(per_pixel);
        (2.0 * value / (per_pixel + there), there)
    }

    /// Returns the depth at which the ray touches the surface.
    fn depth(&self) -> f64 {
        -0.5 * self.b / self.a
    }

    /// Returns the radius of curvature of the surface along the ray where the ray touches it, in metres. Where the ray runs along
    /// the surface, which then looks flat, the radius is bounded.
    fn curvature_radius(&self, q: &Coefficients, ray: &Vector3) -> f64 {
        let steepness = crate::gradient(q, &(ray * self.depth())).norm();
        let curvature = 2.0 * self.a / (ray.norm_squared() * steepness);
        1.0 / curvature.max(LEAST_CURVATURE)
    }
}

impl ContourPoint {
    /// Returns the error of the point in pixels along the line, the ray to the contour, and the slope of the discriminant per
    /// pixel there.
    fn foot(&self, q: &Coefficients) -> (f64, Vector3, f64) {
        let (error, per_pixel) = Along::new(q, &self.ray, &self.pixel).error();
        (error, self.ray - self.pixel * error, per_pixel)
    }

    /// Returns the error of the point in pixels along the line, and its derivatives by the coefficients. These are taken at the
    /// contour, so they do not depend on the noise of the point.
    fn error_gradient(&self, q: &Coefficients) -> (f64, Coefficients) {
        let (error, r, per_pixel) = self.foot(q);
        let Along { a, b, c, .. } = Along::new(q, &r, &self.pixel);
        let [by_a, by_b, by_c] = [-4.0 * c, 2.0 * b, -4.0 * a].map(|by| by / per_pixel);
        let squares = [r.x * r.x, r.y * r.y, r.z * r.z, r.x * r.y, r.x * r.z, r.y * r.z].map(|square| square * by_a);
        let [xx, yy, zz, xy, xz, yz] = squares;
        (error, [xx, yy, zz, xy, xz, yz, by_b * r.x, by_b * r.y, by_b * r.z, by_c])
    }
}

impl Contour {
    /// Removes all points and sets the noise.
    pub fn clear(&mut self, noise: ContourNoise) {
        self.points.clear();
        // The weights treat the points of the surface as if each line had its own noise.
        self.prior = noise.bias.covariance.try_inverse().unwrap_or_default() * noise.surface_lines;
        self.noise = noise;
    }

    /// Adds a point.
    pub fn add(&mut self, point: ContourPoint) {
        let mut seen = ModelledPoint { point, used: true, along: 1.0, radius_px: 0.0, expected: 0.0, variance: 0.0 };
        seen.place(1.0, 0.0, &self.noise);
        self.points.push(seen);
    }

    /// Uses only the points that are near the contour of a surface `F = 0` with these coefficients, and for which `is_seen` holds
    /// at the point of the surface that the ray touches.
    pub fn select(&mut self, q: &Coefficients, is_seen: impl Fn(&Vector3) -> bool) {
        self.errors.clear();
        for seen in &mut self.points {
            let (error, ray, here) = seen.point.foot(q);
            let along = Along::new(q, &ray, &seen.point.pixel);
            let [_, beside, _] = Along::new(q, &ray, &seen.point.across).discriminant();
            let cosine = (here.abs() / (here * here + beside * beside).sqrt()).max(LEAST_ALONG);
            let radius_px = along.curvature_radius(q, &ray) / (along.depth() * seen.point.pixel.norm());
            seen.place(cosine, radius_px, &self.noise);
            seen.used = is_seen(&(ray * along.depth()));
            self.errors.push(error - seen.expected);
        }
        let middles = std::array::from_fn::<_, SIDES, _>(|side| self.median(side));
        self.far_off = 0;
        for (seen, error) in self.points.iter_mut().zip(&self.errors) {
            let is_near = (error - middles[seen.point.side]).abs() < GATE * seen.variance.sqrt();
            self.far_off += usize::from(seen.used && !is_near);
            seen.used &= is_near;
        }
    }

    /// Factor on the weight of a contour point relative to the points of the surface, whose noise more or fewer lines share.
    fn times(&self) -> f64 {
        self.noise.surface_lines / self.noise.shared_lines
    }

    /// Number of points.
    pub fn points(&self) -> usize {
        self.points.len()
    }

    /// Number of points that are used.
    pub fn used(&self) -> usize {
        self.points.iter().filter(|seen| seen.used).count()
    }

    /// Returns the number of used points on a side, and the mean radius of curvature that the surface has there along the view,
    /// in pixels; 0 without points.
    pub fn used_on(&self, side: usize) -> (usize, f64) {
        let radii = self.points.iter().filter(|seen| seen.used && seen.point.side == side).map(|seen| seen.radius_px);
        let (count, sum) = radii.fold((0, 0.0), |(count, sum), radius| (count + 1, sum + radius));
        (count, if count > 0 { sum / count as f64 } else { 0.0 })
    }

    /// Returns how far the used points are expected to lie outside the outline, in pixels across it, on average; 0 where they are
    /// expected inside it, and without points.
    pub fn outside_px(&self) -> f64 {
        let outwards = |seen: &ModelledPoint| [-1.0, 1.0][seen.point.side] * seen.expected * seen.along;
        let (count, sum) = self
            .points
            .iter()
            .filter(|seen| seen.used)
            .fold((0.0, 0.0), |(count, sum), seen| (count + 1.0, sum + outwards(seen)));
        if count > 0.0 { (sum / count).max(0.0) } else { 0.0 }
    }

    /// Number of points that are seen but too far off to be used.
    pub fn far_off(&self) -> usize {
        self.far_off
    }

    /// Returns the least that the points that are too far off add to the weighted sum of squares. With it each point counts up to
    /// the gate (MSAC: Torr and Zisserman, "MLESAC", 2000), so that surfaces can be compared although each of them is near other
    /// points.
    pub fn least_left_out(&self) -> f64 {
        self.far_off as f64 * GATE * GATE * self.times()
    }

    /// Returns the median error of the points of a side, limited to two standard deviations of the offset.
    fn median(&mut self, side: usize) -> f64 {
        let Self { points, noise, errors, of_side, .. } = self;
        of_side.clear();
        of_side.extend(points.iter().zip(errors).filter(|(seen, _)| seen.point.side == side).map(|(_, error)| *error));
        if of_side.is_empty() {
            return 0.0;
        }
        let (middle, limit) = (of_side.len() / 2, 2.0 * noise.bias.covariance[(2 * side, 2 * side)].sqrt()); // [sigmas]
        of_side.select_nth_unstable_by(middle, f64::total_cmp).1.clamp(-limit, limit)
    }

    /// Returns the term of a surface with these coefficients and derivatives of them, in a frame with this origin and unit of
    /// length.
    pub fn term<const N: usize>(
        &self,
        q: &Coefficients,
        derivatives: &[Coefficients; N],
        origin: &Vector3,
        scale: f64,
    ) -> ContourTerm<N> {
        let camera = |q: &Coefficients| in_camera_frame(q, origin, scale);
        self.sums(&camera(q), &derivatives.each_ref().map(camera)).term(&self.prior)
    }

    /// Returns the sums of a surface with these coefficients and derivatives of them, in the camera frame.
    fn sums<const N: usize>(&self, q: &Coefficients, derivatives: &[Coefficients; N]) -> Sums<N> {
        let mut sums = Sums::default();
        for seen in self.points.iter().filter(|seen| seen.used) {
            let (error, gradient) = seen.point.error_gradient(q);
            let slope = SVector::<f64, N>::from_fn(|i, _| dot(&gradient, &derivatives[i]));
            sums.add(error - seen.expected, &slope, seen, self.times() / seen.variance);
        }
        sums.slopes.fill_upper_triangle_with_lower_triangle();
        sums
    }

    /// Estimates the bias of all contours from the points and the contour of a fit; `own` is the covariance of the own bias of
    /// each side of each object. `None` where the points alone do not determine the surface.
    ///
    /// The contour is off by the common bias c, which has no prior here, and by the own bias a; the fit is off by x. The weighted
    /// sum of squares `(e + J x - U (c + a))' w (e + J x - U (c + a)) + a' own^-1 a + x' P x + 2 g' x` is minimised over a, then
    /// over x, which leaves a function of c alone. P and g reproduce the x of a fit to the points alone, with the covariance
    /// `P^-1 = A^-1 B A^-1` of [`GradientNoise`] that their noise gives it.
    pub fn bias_evidence<S: Surface<N>, const N: usize>(
        &self,
        fit: &SurfaceFit<S, N>,
        scatter: &GradientNoise<N>,
        own: &Matrix4<f64>,
    ) -> Option<Information<4>> {
        let sums = self.sums(&fit.surface.coefficients(), &fit.surface.derivatives());
        // At the minimum of the fit the gradients of points and contour cancel out.
        let points_information = fit.inverse.try_inverse()? - fit.contour;
        points_information.cholesky()?;
        let by_noise = points_information * (scatter.matrix * self.noise.surface_lines.recip()).cholesky()?.inverse();
        let (points, points_gradient) = (by_noise * points_information, by_noise * -sums.term(&self.prior).gradient);
        let Sums { shared, shared_error, shared_slope, .. } = sums;
        let mean = &self.noise.bias.mean;
        // The errors are relative to the expected bias: adds it again.
        let error = shared_error + shared * mean;
        let slope_error = sums.slope_error + shared_slope.transpose() * mean;
        // Eliminates a.
        let own = (shared + own.try_inverse()? * self.noise.surface_lines).try_inverse()?;
        let rest = Matrix4::identity() - shared * own;
        let slope = rest * shared_slope;
        let matrix = points + sums.slopes - shared_slope.transpose() * own * shared_slope;
        let gradient = points_gradient + slope_error - shared_slope.transpose() * (own * error);
        // Eliminates x.
        let inverse = matrix.cholesky()?.inverse();
        let matrix = rest * shared - slope * inverse * slope.transpose();
        let vector = rest * error - slope * (inverse * gradient);
        Some(Information { matrix, vector } * self.noise.surface_lines.recip())
    }

    /// Estimates the variance of contour points from their scatter about a surface, after the bias: the squared error of a point
    /// of variance v has the expectation v and the variance 2 v^2. `None` where the bias is not determined.
    pub fn noise_evidence<S: Surface<N>, const N: usize>(&self, surface: &S) -> Option<Information<2>> {
        let q = surface.coefficients();
        let sums = self.sums(&q, &surface.derivatives());
        let bias = (sums.shared + self.prior).try_inverse()? * sums.shared_error + self.noise.bias.mean;
        let mut evidence = Information::default();
        for seen in self.points.iter().filter(|seen| seen.used) {
            let square = (seen.point.foot(&q).0 - seen.moved_by(&bias)).powi(2);
            let (by_noise, variance) = (seen.by_noise(), seen.variance);
            let weight = 1.0 / (2.0 * variance * variance * self.noise.shared_lines);
            evidence.matrix += by_noise * by_noise.transpose() * weight;
            evidence.vector += by_noise * (square * weight);
        }
        Some(evidence)
    }
}

impl<const N: usize> Default for Sums<N> {
    fn default() -> Self {
        Self {
            square: 0.0,
            slope_error: SVector::zeros(),
            slopes: SMatrix::zeros(),
            shared: Matrix4::zeros(),
            shared_error: Vector4::zeros(),
            shared_slope: SMatrix::zeros(),
        }
    }
}

impl<const N: usize> Sums<N> {
    /// Adds a point; fills only the lower triangle of `J'wJ`.
    fn add(&mut self, error: f64, slope: &SVector<f64, N>, seen: &ModelledPoint, weight: f64) {
        self.square += error * error * weight;
        self.slope_error += slope * (error * weight);
        for j in 0..N {
            (j..N).for_each(|i| self.slopes[(i, j)] += slope[i] * slope[j] * weight);
        }
        // Only the bias of its own side moves a point.
        let (first, by_bias) = (2 * seen.point.side, seen.by_bias());
        for (row, moved) in (first..).zip(by_bias) {
            (first..).zip(by_bias).for_each(|(column, other)| self.shared[(row, column)] += moved * other * weight);
            self.shared_error[row] += moved * (error * weight);
            (0..N).for_each(|i| self.shared_slope[(row, i)] += moved * slope[i] * weight);
        }
    }

    /// Returns the term after the bias is eliminated; `prior` is the inverse of its covariance. The term is zero where the bias
    /// is not determined.
    fn term(&self, prior: &Matrix4<f64>) -> ContourTerm<N> {
        let Some(inverse) = (self.shared + prior).try_inverse() else {
            return ContourTerm { square_sum: 0.0, gradient: SVector::zeros(), matrix: SMatrix::zeros() };
        };
        let (error, slope) = (inverse * self.shared_error, inverse * self.shared_slope);
        ContourTerm {
            square_sum: self.square - self.shared_error.dot(&error),
            gradient: self.slope_error - self.shared_slope.transpose() * error,
            matrix: self.slopes - self.shared_slope.transpose() * slope,
        }
    }
}

impl ModelledPoint {
    /// Sets the direction and curvature of the outline at the point, and the expected error and variance that follow from them.
    fn place(&mut self, along: f64, radius_px: f64, noise: &ContourNoise) {
        (self.along, self.radius_px) = (along, radius_px);
        (self.expected, self.variance) = (self.moved_by(&noise.bias.mean), noise.point.dot(&self.by_noise()));
    }

    /// Returns the error of the point per unit of each part of its side's bias, in pixels along the line.
    fn by_bias(&self) -> [f64; 2] {
        [1.0 / self.along, self.radius_px / self.along]
    }

    /// Returns the error of the point by a bias, in pixels along the line.
    fn moved_by(&self, bias: &Vector4<f64>) -> f64 {
        let [by_offset, by_share] = self.by_bias();
        bias[2 * self.point.side] * by_offset + bias[2 * self.point.side + 1] * by_share
    }

    /// Returns the variance of the point per unit of each part of the noise, in square pixels along the line.
    fn by_noise(&self) -> Vector2<f64> {
        Vector2::new(1.0, (self.radius_px / self.along).powi(2))
    }
}

/// Returns the coefficients in the camera frame of a function given in a frame with this origin and unit of length.
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
#[path = "contour_tests.rs"]
mod tests;
