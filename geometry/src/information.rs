//! Information filter: knowledge of a vector as an information matrix and an information vector (Bar-Shalom, Li, Kirubarajan
//! 2001, section 7.2), which add up over independent observations.

use nalgebra::{SMatrix, SVector};
use std::ops::{Add, AddAssign, Mul};

/// Knowledge of N numbers; by default none.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Information<const N: usize> {
    /// Inverse of the covariance.
    pub matrix: SMatrix<f64, N, N>,
    /// Inverse of the covariance times the expectation.
    pub vector: SVector<f64, N>,
}

impl<const N: usize> Information<N> {
    /// Returns the information of this expectation and covariance; `None` where the covariance is singular.
    pub fn of(mean: &SVector<f64, N>, covariance: &SMatrix<f64, N, N>) -> Option<Self> {
        let matrix = covariance.try_inverse()?;
        Some(Self { matrix, vector: matrix * mean })
    }

    /// Returns the expectation and the covariance; `None` where the matrix is not positive definite.
    pub fn estimate(&self) -> Option<(SVector<f64, N>, SMatrix<f64, N, N>)> {
        let covariance = self.matrix.cholesky()?.inverse();
        Some((covariance * self.vector, covariance))
    }
}

impl<const N: usize> Default for Information<N> {
    fn default() -> Self {
        Self { matrix: SMatrix::zeros(), vector: SVector::zeros() }
    }
}

impl<const N: usize> Add for Information<N> {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self { matrix: self.matrix + other.matrix, vector: self.vector + other.vector }
    }
}

impl<const N: usize> AddAssign for Information<N> {
    fn add_assign(&mut self, other: Self) {
        *self = *self + other;
    }
}

/// Scales the information, as if the observations counted so many times.
impl<const N: usize> Mul<f64> for Information<N> {
    type Output = Self;

    fn mul(self, times: f64) -> Self {
        Self { matrix: self.matrix * times, vector: self.vector * times }
    }
}
