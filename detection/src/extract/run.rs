//! A run with running sums, from which lines and circles through any interval follow by one subtraction.

use super::rays::Rays;
use super::view::SURROUNDINGS;
use conicflow_geometry::{ArcMoments, ArcSums};
use std::ops::Deref;

/// Fewest points of the first fit of a curve: two more than a circle has parameters.
pub(super) const FIRST_FIT: usize = 5; // [algorithmic]
/// Fewest points of an arc: one more than a circle has parameters.
pub(super) const MIN_ARC_POINTS: usize = 4; // [algorithmic]

/// A run with the sums for fits.
#[derive(Debug)]
pub(super) struct Run<'a> {
    rays: Rays<'a>,
    /// Running sums, starting with 0.
    sums: &'a [ArcSums],
}

impl<'a> Deref for Run<'a> {
    type Target = Rays<'a>;

    fn deref(&self) -> &Rays<'a> {
        &self.rays
    }
}

impl<'a> Run<'a> {
    /// Sums the rays of a run; `sums` is a buffer.
    pub fn new(rays: Rays<'a>, sums: &'a mut Vec<ArcSums>) -> Self {
        if sums.len() <= rays.length {
            sums.resize(rays.length + 1, ArcSums::default());
        }
        let square_stretch = rays.stretch * rays.stretch;
        let mut last = ArcSums::default();
        for (part, known) in rays.parts(0..rays.length).zip(sums[1..].chunks_mut(SURROUNDINGS)) {
            last = add_part(&last, part, square_stretch, known);
        }
        Self { rays, sums }
    }

    /// Returns the moments of an interval for fits of lines and circles.
    #[inline]
    pub fn moments(&self, from: usize, to: usize) -> ArcMoments {
        self.sums_between(from, to).moments((to - from) as f64, self.stretch)
    }

    #[inline]
    fn sums_between(&self, from: usize, to: usize) -> ArcSums {
        self.sums[to].since(&self.sums[from])
    }

    /// Returns the mean square distance of an interval from its line of least squares.
    #[inline]
    pub fn line_square(&self, from: usize, to: usize) -> f64 {
        self.sums_between(from, to).line_square((to - from) as f64, self.stretch)
    }

    /// Returns whether a line explains the points of an interval.
    #[inline]
    pub fn is_line(&self, from: usize, to: usize) -> bool {
        self.line_square(from, to) <= self.limit(from, to)
    }

    /// Returns whether a circle explains the points of an interval.
    #[inline]
    pub fn is_circle(&self, from: usize, to: usize) -> bool {
        let limit = self.limit(from, to);
        self.moments(from, to).is_circle_within(limit)
    }
}

/// Adds points of one variance to the running sums, and stores each state.
#[inline]
fn add_part(
    sums: &ArcSums,
    (slopes, depths, variance): (&[f64], &[f64], f64),
    square_stretch: f64,
    known: &mut [ArcSums],
) -> ArcSums {
    let mut sums = *sums;
    let ((x_pairs, x_rest), (z_pairs, z_rest)) = (slopes.as_chunks(), depths.as_chunks());
    let (pairs, rest) = known[..depths.len()].as_chunks_mut();
    for ((&x, &z), known) in x_pairs.iter().zip(z_pairs).zip(pairs) {
        *known = sums.with_two(x, z, variance, square_stretch);
        sums = known[1];
    }
    if let (&[x], &[z], [known]) = (x_rest, z_rest, rest) {
        [*known, _] = sums.with_two([x; 2], [z; 2], variance, square_stretch);
        sums = *known;
    }
    sums
}
