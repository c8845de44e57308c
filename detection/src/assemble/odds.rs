//! The one decision: how probable it is that a candidate is an object of its shape, and not a part of anything else.
//!
//! Noise that neighbours share, creased cloth, edges of boxes and limbs give candidates that some sphere, cylinder or cone
//! explains. What tells them from objects is not one limit that they miss but all of their [`Evidence`] together: the
//! logarithm of the odds is a weighted sum of it (logistic regression; Hastie, Tibshirani and Friedman, "The Elements of
//! Statistical Learning", section 4.4). `cargo bench --bench odds` fits the weights to candidates in simulated scenes and
//! prints how often candidates of each confidence are right.

use super::verify::Candidate;
use conicflow_messages::{Object, ObjectKind};

/// Upper bound of the mean square error of the outline that counts, in variances: what is farther off is no worse.
const MOST_OUTLINE: f64 = 5.0; // [algorithmic]
/// Upper bound of the visible length that counts, in radii.
const MOST_LENGTH: f64 = 3.0; // [algorithmic]
/// Added to the relative standard deviation of the radius, so that its logarithm stays finite.
const LEAST_SIGMA: f64 = 0.003; // [algorithmic]

/// What speaks for a candidate and against it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Evidence {
    /// Share of the ends of its arcs at which it stands free: before something farther, or before what is not measured.
    pub free_ends: f64,
    /// Standard deviation of its radius, as a part of it.
    pub radius_sigma: f64,
    /// Root mean square distance of its points from the surface, without the noise, in radii.
    pub residual_radii: f64,
    /// Mean square distance of its outline from where the shape has one, in variances of an outline's point.
    pub outline_square: f64,
    /// Share of its outline that is far from where the shape has one.
    pub outline_far_off: f64,
    /// Visible length in radii; of a sphere 0.
    pub length_radii: f64,
    /// Part of the scan lines between the first and the last that show it.
    pub coverage: f64,
    /// Share of its two ends across the scan lines beyond which its surface goes on.
    pub continued: f64,
    /// Whether it is a sphere, which has fewer parameters to bend to anything.
    pub is_sphere: bool,
}

/// Number of terms of the sum, the constant included.
pub const TERMS: usize = 11; // [derived]

/// Weights of the terms, in their order, as `cargo bench --bench odds` printed them before noisy lines were averaged. It prints
/// others since the bias of contours is learned, with which recordings showed 99 in place of 98 of 104 objects, and 16 in place
/// of 9 wrong answers. The constant is larger by 0.475 than it was: since the noise of contours is learned, the mean square of an
/// outline is expected to be 1, where 0.5 had been measured, and 0.95 times the difference leaves the odds as they were.
const WEIGHTS: [f64; TERMS] = [-6.775, 2.20, -0.95, -22.97, -0.95, -4.62, 0.56, 3.72, 2.78, -1.13, -1.50]; // [fitted]

impl Evidence {
    /// That of a candidate of which `object` is the report.
    pub(crate) fn of(candidate: &Candidate, object: &Object) -> Self {
        let Candidate { region, measured, outline } = candidate;
        let [first, last] = region.ends();
        Self {
            free_ends: outline.free,
            radius_sigma: object.sigma.radius / object.radius,
            residual_radii: object.rms / object.radius,
            outline_square: outline.square,
            outline_far_off: outline.far_off,
            length_radii: object.length / object.radius,
            coverage: f64::from(measured.lines) / f64::from(last.line - first.line + 1),
            continued: outline.continued,
            is_sphere: object.shape() == ObjectKind::Sphere,
        }
    }

    /// The terms of the sum: a constant and what the evidence makes of each of its parts.
    pub fn terms(&self) -> [f64; TERMS] {
        [
            1.0,
            self.free_ends,
            (self.radius_sigma + LEAST_SIGMA).ln(),
            self.residual_radii,
            self.outline_square.min(MOST_OUTLINE),
            self.outline_far_off,
            self.length_radii.min(MOST_LENGTH),
            self.coverage,
            f64::from(u8::from(self.is_sphere)),
            self.continued,
            self.continued * f64::from(u8::from(self.is_sphere)),
        ]
    }

    /// The probability that the candidate is an object of its shape.
    pub fn probability(&self) -> f64 {
        let log_odds: f64 = self.terms().iter().zip(WEIGHTS).map(|(term, weight)| term * weight).sum();
        1.0 / (1.0 + (-log_odds).exp())
    }
}
