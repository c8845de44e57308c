//! Decides how probable it is that a candidate is an object of its shape, and not part of something else.
//!
//! Noise that neighbouring pixels share, creased cloth, edges of boxes and limbs give candidates that some sphere, cylinder or
//! cone explains. No single limit separates them from objects, but all of their [`Evidence`] together does: the logarithm of the
//! odds is a weighted sum of it (logistic regression; Hastie, Tibshirani and Friedman, "The Elements of Statistical Learning",
//! section 4.4). `cargo bench --bench odds` fits the weights to candidates in simulated scenes and prints how often candidates of
//! each confidence are right.

use super::arcs::Arc;
use super::growth::NOISE_ONLY;
use super::region::Region;
use super::verify::Candidate;
use conicflow_messages::{Object, ObjectKind};

/// Upper bound of the mean square error of the outline, in variances: larger errors count as this one.
const MOST_OUTLINE: f64 = 5.0; // [tuned]
/// Upper bound of the visible length, in radii: longer objects count as this long.
const MOST_LENGTH: f64 = 3.0; // [tuned]
/// Upper bound of the mean square residual, in variances: where there is almost no noise, any residual is many variances.
const MOST_RESIDUAL: f64 = 2.0; // [tuned]
/// Amount that is added to standard deviations in radii, so that their logarithms stay finite.
const LEAST_SIGMA: f64 = 0.003; // [tuned]
/// A surface beyond an end counts as the same surface while its arcs are within this mean distance of the object's surface, in
/// radii. With 0.1, 0.2, 0.3 and 0.4, and a weight fitted to each, 108, 90, 79 and 74 wrong candidates of `cargo bench --bench
/// odds` in furnished rooms are reported as objects, and of the right candidates that simulated stereo cameras see elsewhere 119,
/// 117, 115 and 112 (counted by a script that is not kept).
const NEAR: f64 = 0.2; // [tuned]
/// Largest distance over which a surface is followed beyond an end, in radii.
const MOST_BEYOND: f64 = 1.0; // [tuned]

/// Evidence for and against a candidate.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Evidence {
    /// Share of the ends of its arcs at which it stands free: before something farther, or before pixels without a measurement.
    pub free_ends: f64,
    /// Standard deviation of its radius, relative to the radius.
    pub radius_sigma: f64,
    /// Standard deviation of a point, in radii. The noisier it is, the less a wrong shape would show.
    pub noise_radii: f64,
    /// Mean square distance of its points from the surface, less that of the noise, in variances of a point.
    pub residual: f64,
    /// Mean square distance of its outline from that of the shape, in variances of an outline's point.
    pub outline_square: f64,
    /// Share of its outline that is far from that of the shape.
    pub outline_far_off: f64,
    /// Visible length in radii; of a sphere 0.
    pub length_radii: f64,
    /// Share of its two ends across the scan lines beyond which any surface continues.
    pub continued: f64,
    /// How far beyond its two ends a surface continues that departs from its own only slowly, in radii: the smaller of both, then
    /// the larger.
    pub beyond_radii: [f64; 2],
    /// Logarithm of the probability of its being round over that of its being some quadric near the shape (see `round.rs`).
    pub roundness: f64,
    /// Whether it is a sphere, which has fewer parameters to fit to anything.
    pub is_sphere: bool,
}

/// Number of terms of the sum, with the constant.
pub const TERMS: usize = 14; // [derived]

/// Weights of the terms in their order, which `cargo bench --bench odds` fits and prints. The candidates of that fit come from a
/// detector with nearly the same weights. The last weight is 1, because its term is itself a logarithm of odds (fitted 0.90).
#[expect(clippy::approx_constant, reason = "a weight that is near pi by chance")]
pub const WEIGHTS: [f64; TERMS] = [
    -8.68, 1.23, -0.96, -1.82, -3.14, -2.09, -3.26, 1.44, 4.69, -0.84, -1.10, -3.65, -2.20, // [fitted]
    1.0,   // [derived]
];

impl Evidence {
    /// Collects the evidence of a candidate with the report `object`; `gap` is the number of lines that growth bridges.
    pub(crate) fn of(candidate: &Candidate, object: &Object, gap: i64) -> Self {
        let Candidate { region, measured, outline, roundness } = candidate;
        let adjoining = [-1, 1].into_iter().filter_map(|side| region.beyond(side, gap).next()).count();
        let [before, behind] = [-1, 1].map(|side| continued_radii(region, side, gap, object.radius));
        Self {
            free_ends: outline.free,
            radius_sigma: object.sigma.radius / object.radius,
            noise_radii: measured.variance.sqrt() / object.radius,
            residual: measured.residual,
            outline_square: outline.square,
            outline_far_off: outline.far_off,
            length_radii: object.length / object.radius,
            continued: 0.5 * adjoining as f64,
            beyond_radii: [before.min(behind), before.max(behind)],
            roundness: *roundness,
            is_sphere: object.shape() == ObjectKind::Sphere,
        }
    }

    /// Returns the terms of the sum, the constant first. For a sphere a positive roundness counts as 0: heads and fruit are as
    /// round as can be measured, too.
    pub fn terms(&self) -> [f64; TERMS] {
        [
            1.0,
            self.free_ends,
            (self.radius_sigma + LEAST_SIGMA).ln(),
            (self.noise_radii + LEAST_SIGMA).ln(),
            self.residual.min(MOST_RESIDUAL),
            self.outline_square.min(MOST_OUTLINE),
            self.outline_far_off,
            self.length_radii.min(MOST_LENGTH),
            f64::from(self.is_sphere),
            self.continued,
            self.continued * f64::from(self.is_sphere),
            self.beyond_radii[0],
            self.beyond_radii[1],
            if self.is_sphere { self.roundness.min(0.0) } else { self.roundness },
        ]
    }

    /// Returns the probability that the candidate is an object of its shape.
    pub fn probability(&self) -> f64 {
        let log_odds: f64 = self.terms().iter().zip(WEIGHTS).map(|(term, weight)| term * weight).sum();
        1.0 / (1.0 + (-log_odds).exp())
    }
}

/// Returns how far beyond an end of a region a surface continues that stays near that of the region, up to the last line that
/// surely departs from it, in radii. The result is 0 where the surface ends or turns off at once. Where lines share their noise,
/// the camera compared a window for each pixel, and half of that window mixes in adjoining surfaces: these lines are subtracted.
fn continued_radii(region: &Region, side: i64, gap: i64, radius: f64) -> f64 {
    let (q, end) = (region.model.coefficients(), region.ends()[usize::from(side > 0)]);
    let lines_to = |arc: &Arc| f64::from(arc.line.abs_diff(end.line));
    let followed = region.beyond(side, gap).take_while(|arc| lines_to(arc) * end.spacing <= MOST_BEYOND * radius);
    let residuals = followed.map_while(|arc| Some((arc, region.model.residual(&q, arc)?)));
    let near = residuals.take_while(|(_, residual)| residual.mean.abs() < NEAR * radius);
    let last_off = near.filter(|(arc, residual)| !NOISE_ONLY.admits(arc, residual, 0.0)).last();
    let lines = last_off.map_or(0.0, |(arc, _)| lines_to(arc));
    (lines - 0.5 * (region.shared_lines() - 1.0)).max(0.0) * end.spacing / radius
}

#[cfg(test)]
mod tests {
    use super::super::arcs::Arcs;
    use super::super::model;
    use super::super::tests::arcs_of;
    use super::*;
    use conicflow_geometry::{Scan, Vector3};
    use conicflow_lab::rendered::{KINECT_HALF, cylinder, frustum};
    use conicflow_lab::simulator::shapes::Shape;

    /// Height of the can in `beyond`, in metres.
    const HEIGHT: f64 = 0.24;
    /// Radius of the can in `beyond`, in metres.
    const RADIUS: f64 = 0.2;

    /// Evidence of some object.
    const EVIDENCE: Evidence = Evidence {
        free_ends: 0.9,
        radius_sigma: 0.01,
        noise_radii: 0.02,
        residual: 0.0,
        outline_square: 1.0,
        outline_far_off: 0.05,
        length_radii: 1.0,
        continued: 0.5,
        beyond_radii: [0.0, 0.1],
        roundness: 0.0,
        is_sphere: false,
    };

    /// Returns how far a surface continues above and below a can at a distance of two metres. The region ends `inset` metres
    /// before the can's rims.
    fn beyond(bodies: &[Shape], shared_lines: f64, inset: f64) -> [f64; 2] {
        let can = cylinder(Vector3::new(0.0, 0.0, 2.0), Vector3::y(), RADIUS, HEIGHT);
        let mut arcs: Arcs = arcs_of(&[&[can], bodies].concat());
        arcs.arcs.iter_mut().for_each(|arc| arc.shared_lines = shared_lines);
        let is_of_it = |arc: &Arc| arc.scan == Scan::Row && arc.mean.y.abs() < 0.5 * HEIGHT - inset;
        let members: Vec<_> = (0..arcs.arcs.len()).filter(|&index| is_of_it(&arcs.arcs[index])).collect();
        let model = model::fit(ObjectKind::Cylinder, &arcs.of(&members), None, f64::INFINITY).unwrap();
        [-1, 1].map(|side| continued_radii(&Region { arcs: &arcs, model, members: &members }, side, 4, RADIUS))
    }

    /// A frustum that adjoins the can above (-1) or below (1), starts with its radius and narrows by `slope` metres per metre.
    fn tapering(side: f64, slope: f64, height: f64) -> Shape {
        let center = Vector3::new(0.0, side * 0.5 * (HEIGHT + height), 2.0);
        frustum(center, Vector3::y() * side, RADIUS - 0.5 * slope * height, -slope, height)
    }

    #[test]
    fn what_ends_or_turns_off_does_not_go_on_and_what_leaves_slowly_does_up_to_a_fifth_of_the_radius() {
        // Distances count from the last member of the region, 0.05 radii before the rim. The quadric is -0.2 radii where a
        // surface lies 0.225 radii inside.
        let near = |found: f64, height: f64| assert!((found - height - 0.05).abs() < 0.03, "{found} for {height}");
        assert_eq!(beyond(&[], 1.0, 0.01), [0.0, 0.0]);
        assert_eq!(beyond(&[], 1.0, 0.06), [0.0, 0.0], "its own lines, which growth may leave out");
        let [above, below] = beyond(&[tapering(-1.0, 0.3, 0.3)], 1.0, 0.01);
        near(above, 0.225 / 0.3);
        assert_eq!(below, 0.0);
        near(beyond(&[tapering(1.0, 0.3, 0.06)], 1.0, 0.01)[1], 0.3);
        near(beyond(&[tapering(1.0, 0.1, 0.3)], 1.0, 0.01)[1], 0.95);
        let wider = cylinder(Vector3::new(0.0, -0.27, 2.0), Vector3::y(), 1.5 * RADIUS, 0.3);
        assert_eq!(beyond(&[wider], 1.0, 0.01)[0], 0.0, "a step is an end");
    }

    #[test]
    fn each_part_of_the_evidence_speaks_for_an_object_or_against_it_and_a_misfit_beyond_two_variances_no_more() {
        let odds = |evidence: Evidence| {
            let told = evidence.probability();
            (told / (1.0 - told)).ln()
        };
        for (better, worse) in [
            (Evidence { free_ends: 1.0, ..EVIDENCE }, Evidence { free_ends: 0.5, ..EVIDENCE }),
            (Evidence { radius_sigma: 0.005, ..EVIDENCE }, Evidence { radius_sigma: 0.05, ..EVIDENCE }),
            (Evidence { noise_radii: 0.01, ..EVIDENCE }, Evidence { noise_radii: 0.1, ..EVIDENCE }),
            (Evidence { residual: -0.1, ..EVIDENCE }, Evidence { residual: 0.5, ..EVIDENCE }),
            (Evidence { outline_square: 0.8, ..EVIDENCE }, Evidence { outline_square: 2.0, ..EVIDENCE }),
            (Evidence { length_radii: 2.0, ..EVIDENCE }, Evidence { length_radii: 0.5, ..EVIDENCE }),
            (Evidence { continued: 0.0, ..EVIDENCE }, Evidence { continued: 1.0, ..EVIDENCE }),
            (Evidence { outline_far_off: 0.0, ..EVIDENCE }, Evidence { outline_far_off: 0.2, ..EVIDENCE }),
            (Evidence { beyond_radii: [0.0, 0.0], ..EVIDENCE }, Evidence { beyond_radii: [0.0, 0.2], ..EVIDENCE }),
            (Evidence { beyond_radii: [0.0, 0.0], ..EVIDENCE }, Evidence { beyond_radii: [0.05, 0.1], ..EVIDENCE }),
        ] {
            assert!(odds(better) > odds(EVIDENCE) && odds(EVIDENCE) > odds(worse) + 0.1, "{better:?} {worse:?}");
        }
        let [at_most, ideal] = [2.0, 1e6].map(|residual| odds(Evidence { residual, noise_radii: 0.0, ..EVIDENCE }));
        assert!(at_most == ideal && ideal.is_finite(), "{at_most} {ideal}");
    }

    #[test]
    fn that_it_is_round_speaks_for_a_cylinder_and_that_it_is_not_against_any_shape() {
        let odds = |is_sphere: bool, roundness: f64| {
            let evidence = Evidence { is_sphere, roundness, ..EVIDENCE };
            let (told, silent) = (evidence.probability(), Evidence { roundness: 0.0, ..evidence }.probability());
            (told / (1.0 - told) / silent * (1.0 - silent)).ln()
        };
        for (is_sphere, roundness, expected) in
            [(false, 2.0, 2.0), (false, -9.0, -9.0), (true, 2.0, 0.0), (true, -9.0, -9.0)]
        {
            assert!((odds(is_sphere, roundness) - expected).abs() < 1e-9, "{is_sphere} {roundness}");
        }
    }

    #[test]
    fn lines_that_windows_mix_with_what_adjoins_do_not_count() {
        let [own, shared] = [1.0, 9.0].map(|lines| beyond(&[tapering(-1.0, 0.3, 0.3)], lines, 0.01)[0]);
        let line = (2.0 - RADIUS) / KINECT_HALF.fy / RADIUS;
        assert!((own - shared - 4.0 * line).abs() < 0.01, "{own} {shared}");
    }

    #[test]
    fn a_surface_that_goes_on_speaks_more_against_a_sphere() {
        let against = |is_sphere: bool| {
            let odds = |continued: f64| {
                let told = Evidence { continued, is_sphere, ..EVIDENCE }.probability();
                (told / (1.0 - told)).ln()
            };
            odds(0.0) - odds(1.0)
        };
        assert!(against(true) > against(false) + 0.5 && against(false) > 0.5, "{} {}", against(true), against(false));
    }
}
