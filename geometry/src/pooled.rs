//! Levenberg-Marquardt fit of a surface to the pooled moments of its points: closed form, O(1) per iteration.
//!
//! With `M = sum m m'` the sum of squared distances is `q' M q`, its gradient is `2 J' M q`, and the Gauss-Newton matrix is `2 J'
//! M J`, `J = dq/dtheta`. Unbiased moments may leave M slightly indefinite and the least sum slightly negative: the damping keeps
//! the steps stable, and a sum below zero is as good as zero.

use crate::space::{dot, monomials};
use crate::{Coefficients, Contour, ContourTerm, QuadricMoments, Surface, Vector3, gradient};
use nalgebra::{SMatrix, SVector};

/// Most steps of a fit.
const MAX_STEPS: usize = 8; // [algorithmic]
/// Damping of the first step (Levenberg 1944, Marquardt 1963).
const DAMPING: f64 = 1e-3; // [algorithmic]
/// Factor by which the damping grows after a failed step and shrinks after a successful one.
const DAMPING_STEP: f64 = 10.0; // [algorithmic]
/// Least damping after a failed step.
const LEAST_DAMPING: f64 = 1e-6; // [algorithmic]
/// A step shorter than this ends the fit; in spreads of the points, and radians.
const SHORT: f64 = 1e-4; // [algorithmic]

/// A step that lowers the sum of squares by less than this ends the fit: noise makes that sum scatter by more than one.
const SLIGHT: f64 = 5e-2; // [algorithmic]
/// A fit is given up at a step that gains less than this part of the excess of the sum of squares over its limit: later steps
/// gain even less.
const HOPELESS: f64 = 0.1; // [algorithmic]
/// A fit is given up only at a step with less damping than this, because a damped step does not show the possible gain.
const FREE: f64 = 0.1; // [algorithmic]

/// A fitted surface.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SurfaceFit<S, const N: usize> {
    /// The surface, in the camera frame.
    pub surface: S,
    /// Sum of the squared distances, each times the weight of its point.
    pub square_sum: f64,
    /// Sum of the squared errors of the contour, each times the weight of its point, with the bias eliminated.
    pub contour_sum: f64,
    /// Inverse of the Gauss-Newton matrix. It is the covariance of the parameters if the distances of the points are independent
    /// and have a variance of one over their weights.
    pub inverse: SMatrix<f64, N, N>,
    /// The contour's part of the Gauss-Newton matrix.
    pub contour: SMatrix<f64, N, N>,
}

/// Fits a surface to points that are pooled with weights of one over their variance; `start` is a guess. `None` where the points
/// do not determine a surface near it, or as soon as the sum of squares will surely stay above `most`.
pub fn fit_surface<S: Surface<N>, const N: usize>(
    moments: &QuadricMoments,
    start: &S,
    most: f64,
) -> Option<SurfaceFit<S, N>> {
    fit(moments, None, start, most)
}

/// Fits a surface to points and to their contour; `square_sum` stays that of the points alone.
pub fn fit_with_contour<S: Surface<N>, const N: usize>(
    moments: &QuadricMoments,
    contour: &Contour,
    start: &S,
) -> Option<SurfaceFit<S, N>> {
    fit(moments, Some(contour), start, f64::INFINITY)
}

fn fit<S: Surface<N>, const N: usize>(
    moments: &QuadricMoments,
    contour: Option<&Contour>,
    start: &S,
    most: f64,
) -> Option<SurfaceFit<S, N>> {
    let mut surface = start.to_local(&moments.origin, moments.scale).moved(&[0.0; N])?;
    let below =
        |most, surface: &S| System::below(most, moments, contour, &surface.coefficients(), || surface.derivatives());
    let mut system = below(f64::INFINITY, &surface)?;
    let [slight, most] = [SLIGHT, most].map(|sum| sum / (moments.scale * moments.scale));
    let (mut damping, mut converged) = (DAMPING, false);
    for _ in 0..MAX_STEPS {
        let Some(step) = system.step(damping) else {
            damping = (damping * DAMPING_STEP).max(DAMPING);
            continue;
        };
        let length = step.iter().map(|x| x * x).sum::<f64>().sqrt();
        let next = surface.moved(&step);
        match next.and_then(|next| Some((next, below(system.sum(), &next)?))) {
            Some(next) => {
                let gain = system.sum() - next.1.sum();
                if damping < FREE && gain < HOPELESS * (next.1.sum() - most) {
                    return None;
                }
                converged = length < SHORT || gain < slight;
                (surface, system) = next;
                damping *= 1.0 / DAMPING_STEP;
            }
            None if length < SHORT => converged = true,
            None => damping = (damping * DAMPING_STEP).max(LEAST_DAMPING),
        }
        if converged {
            break;
        }
    }
    let square_sum = system.square_sum * moments.scale * moments.scale;
    let inverse = system.inverse(moments.scale, &S::lengths())?;
    let unit = |i: usize| if S::lengths()[i] { 1.0 } else { moments.scale };
    let contour = SMatrix::from_fn(|i, j| system.contour[(i, j)] * unit(i) * unit(j));
    let surface = surface.to_camera(&moments.origin, moments.scale);
    let contour_sum = system.contour_sum * moments.scale * moments.scale;
    square_sum.is_finite().then_some(SurfaceFit { surface, square_sum, contour_sum, inverse, contour })
}

/// Scatter of a fit's gradient, from sample points.
///
/// Noise along the ray moves a point less across the surface the more the ray grazes it: `variance (dF/dz)^2`. The
/// covariance of the parameters is then not the inverse `A^-1` of the Gauss-Newton matrix but `A^-1 B A^-1`, with
/// `B = sum w^2 variance (dF/dz)^2 j j'` and j the derivatives of F at the point.
#[derive(Clone, Copy, Debug)]
pub struct GradientNoise<const N: usize> {
    derivatives: [Coefficients; N],
    coefficients: Coefficients,
    pub(crate) matrix: SMatrix<f64, N, N>,
}

impl<const N: usize> GradientNoise<N> {
    /// Starts without points, on a surface in the camera frame.
    pub fn new<S: Surface<N>>(surface: &S) -> Self {
        Self { derivatives: surface.derivatives(), coefficients: surface.coefficients(), matrix: SMatrix::zeros() }
    }

    /// Adds a point; `weight` is the sum of `w^2 variance` over the points that it represents.
    pub fn add(&mut self, point: &Vector3, weight: f64) {
        let m = monomials(point);
        let j = SVector::<f64, N>::from_fn(|i, _| dot(&self.derivatives[i], &m));
        let slope = gradient(&self.coefficients, point).dot(point) / point.z;
        self.matrix += j * j.transpose() * (weight * slope * slope);
    }

    /// Returns the covariance of the parameters of a fit. The contour scatters as its weight says, times the number of
    /// neighbouring lines that share its noise.
    pub fn covariance<S>(&self, fit: &SurfaceFit<S, N>, shared_lines: f64) -> SMatrix<f64, N, N> {
        fit.inverse * (self.matrix + fit.contour * shared_lines) * fit.inverse
    }
}

/// Predicts the variance of a fitted surface away from the points of the fit.
#[derive(Clone, Copy, Debug)]
pub struct Prediction<const N: usize> {
    derivatives: [Coefficients; N],
    inverse: SMatrix<f64, N, N>,
}

impl<const N: usize> Prediction<N> {
    /// Creates the prediction of a fit whose points were pooled with weights of one over their variance.
    pub fn new<S: Surface<N>>(fit: &SurfaceFit<S, N>) -> Self {
        Self { derivatives: fit.surface.derivatives(), inverse: fit.inverse }
    }

    /// Returns the variance of the distance of `point` from the surface due to the uncertainty of the fit, in square metres.
    pub fn variance(&self, point: &Vector3) -> f64 {
        let m = monomials(point);
        let j = SVector::<f64, N>::from_fn(|i, _| dot(&self.derivatives[i], &m));
        j.dot(&(self.inverse * j)).max(0.0)
    }
}

/// The normal equations at one surface, in the frame of the fit.
pub(crate) struct System<const N: usize> {
    square_sum: f64,
    contour_sum: f64,
    pub(crate) gradient: SVector<f64, N>,
    pub(crate) matrix: SMatrix<f64, N, N>,
    contour: SMatrix<f64, N, N>,
}

impl<const N: usize> System<N> {
    /// Returns the system of the quadric `q`; `None` where its sum of squares exceeds `most`, after as little computation as
    /// possible.
    pub(crate) fn below(
        most: f64,
        moments: &QuadricMoments,
        contour: Option<&Contour>,
        q: &Coefficients,
        derivatives: impl FnOnce() -> [Coefficients; N],
    ) -> Option<Self> {
        let square_sum = dot(&moments.times(q), q);
        if contour.is_none() && square_sum > most {
            return None;
        }
        let derivatives = derivatives();
        let products: [Coefficients; N] = std::array::from_fn(|i| moments.times(&derivatives[i]));
        let mut matrix = SMatrix::<f64, N, N>::zeros();
        for i in 0..N {
            for j in 0..=i {
                let entry = dot(&products[i], &derivatives[j]);
                (matrix[(i, j)], matrix[(j, i)]) = (entry, entry);
            }
        }
        let gradient = SVector::from_fn(|i, _| dot(&products[i], q));
        let mut system = Self { square_sum, contour_sum: 0.0, gradient, matrix, contour: SMatrix::zeros() };
        if let Some(contour) = contour {
            let term = contour.term(q, &derivatives, &moments.origin, moments.scale);
            system.add(&term, 1.0 / (moments.scale * moments.scale));
        }
        (system.sum() <= most).then_some(system)
    }

    fn add(&mut self, term: &ContourTerm<N>, factor: f64) {
        self.contour_sum += factor * term.square_sum;
        self.gradient += term.gradient * factor;
        self.contour = term.matrix * factor;
        self.matrix += self.contour;
    }

    fn sum(&self) -> f64 {
        self.square_sum + self.contour_sum
    }

    /// Solves the damped equations for a step; `None` where they are not positive definite.
    fn step(&self, damping: f64) -> Option<[f64; N]> {
        let mut damped = self.matrix;
        let floor = 1e-12 * self.matrix.diagonal().amax(); // [algorithmic]
        (0..N).for_each(|i| damped[(i, i)] += damping * self.matrix[(i, i)].abs() + floor);
        let step = damped.cholesky()?.solve(&-self.gradient);
        Some(std::array::from_fn(|i| step[i]))
    }

    /// Returns the inverse of the matrix. A direction in which the noise correction leaves a curvature below zero gets a small
    /// share of the diagonal, which gives it a large variance.
    pub(crate) fn inverse(&self, scale: f64, lengths: &[bool; N]) -> Option<SMatrix<f64, N, N>> {
        let damped = |share: f64| {
            let mut matrix = self.matrix;
            (0..N).for_each(|i| matrix[(i, i)] += share * self.matrix[(i, i)].abs());
            matrix.cholesky()
        };
        let shares = [0.0, 1e-4, 1e-3, 1e-2, 0.1]; // [algorithmic]
        let inverse = shares.into_iter().find_map(damped)?.inverse();
        let unit = |i: usize| if lengths[i] { 1.0 } else { 1.0 / scale };
        Some(SMatrix::from_fn(|i, j| inverse[(i, j)] * unit(i) * unit(j)))
    }
}

#[cfg(test)]
#[path = "pooled_tests.rs"]
mod tests;
