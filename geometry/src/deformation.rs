//! Whether points show that they lie on another quadric than the sphere, cylinder or cone that was fitted to them: on an
//! ellipsoid, or on one whose section is no circle, which is also what the edge of a box looks like.
//!
//! The score test (Rao, "Large sample tests of statistical hypotheses concerning several parameters", 1948): the surface
//! may change along some more directions, and to first order that lowers the weighted sum of squares by `b'C^-1 b`, with b
//! the part of its gradient along them and C their part of the Gauss-Newton matrix, both clear of what the parameters of
//! the surface can do themselves. For points on the surface, of a variance of one over their weights, that is a chi
//! squared of as many degrees of freedom. The sum of squares itself scatters by the noise of all points, this by that
//! of a few directions alone: it tells where the other cannot.

use crate::pooled::System;
use crate::space::dot;
use crate::{Coefficients, Conical, QuadricMoments, Sphere, Surface, Vector3};
use nalgebra::{SMatrix, SVector};

/// A deformation counts if its information is at least this part of that of the best determined one; noise alone decides
/// about the others.
const CLEAR: f64 = 0.02; // [tuned]

impl Sphere {
    /// The ways to make a sphere an ellipsoid.
    pub fn deformations() -> [Coefficients; 5] {
        let [x, y, z] = [Vector3::x(), Vector3::y(), Vector3::z()];
        [product(&x, &x), product(&y, &y), product(&x, &y), product(&x, &z), product(&y, &z)]
    }
}

impl Conical {
    /// The ways to make the section across the axis an ellipse, or a hyperbola.
    pub fn deformations(&self) -> [Coefficients; 2] {
        let [u, v] = self.across();
        let (mut squeezed, other) = (product(&u, &u), product(&v, &v));
        squeezed.iter_mut().zip(other).for_each(|(along, across)| *along -= across);
        [squeezed, product(&u, &v)]
    }
}

/// The quadric `(a.p) (b.p)`.
fn product(a: &Vector3, b: &Vector3) -> Coefficients {
    let mixed = |i: usize, j: usize| a[i] * b[j] + a[j] * b[i];
    [a.x * b.x, a.y * b.y, a.z * b.z, mixed(0, 1), mixed(0, 2), mixed(1, 2), 0.0, 0.0, 0.0, 0.0]
}

/// By how much less the weighted sum of squared distances would be, were a surface that was fitted to these points free to
/// be deformed as well; `None` where the points do not determine it.
pub fn gain_of_deformations<S: Surface<N>, const N: usize, const D: usize>(
    moments: &QuadricMoments,
    surface: &S,
    deformations: &[Coefficients; D],
) -> Option<f64> {
    let surface = surface.to_local(&moments.origin, moments.scale);
    let System { gradient, matrix, .. } = System::new(moments, None, &surface);
    let (q, derivatives) = (surface.coefficients(), surface.derivatives());
    let products = deformations.map(|deformation| moments.times(&deformation));
    let mixed = SMatrix::<f64, N, D>::from_fn(|i, j| dot(&derivatives[i], &products[j]));
    let undone = matrix.cholesky()?.solve(&mixed);
    let along = SVector::<f64, D>::from_fn(|i, _| dot(&q, &products[i])) - undone.tr_mul(&gradient);
    let square = SMatrix::<f64, D, D>::from_fn(|i, j| dot(&deformations[i], &products[j])) - undone.tr_mul(&mixed);
    Some(gain(square, along) * moments.scale * moments.scale)
}

/// `b'C^-1 b` by Cholesky's way, the clearest direction first, without those that are not.
fn gain<const D: usize>(mut square: SMatrix<f64, D, D>, mut along: SVector<f64, D>) -> f64 {
    let least = CLEAR * square.diagonal().max();
    let mut sum = 0.0;
    for _ in 0..D {
        let (pivot, size) = square.diagonal().argmax();
        if size <= least {
            break;
        }
        let (column, part) = (square.column(pivot).into_owned(), along[pivot]);
        sum += part * part / size;
        along -= column * (part / size);
        square -= column * column.transpose() / size;
        square[(pivot, pivot)] = 0.0;
    }
    sum
}

#[cfg(test)]
#[path = "deformation_tests.rs"]
mod tests;
