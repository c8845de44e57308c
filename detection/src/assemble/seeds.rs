//! Seeds: the arcs of an image from which growth starts, until an object explains them. The most surely curved arcs come first,
//! and seeds spread over the image: the more often growth failed on a surface, the later its other arcs come. A person beside a
//! ball has more arcs than the ball, and more strongly curved ones.

use super::arcs::{Arc, Arcs};
use super::rejection::{Rejection, Rejections};
use super::verify::{self, Candidate};
use conicflow_messages::Object;
use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::time::Instant;

/// Largest number of seeds in an image from which growth may fail. It bounds the time, and later finds are seldom right: with 8,
/// 10 and 14, recordings that are turned and mirrored in five ways show 486, 489 and 491 of 520 objects, and 37, 38 and 40 wrong
/// ones; furnished rooms, seen by a Kinect, 106, 106 and 108 of 114, with 8, 10 and 13 wrong ones.
pub(super) const MAX_FAILED: usize = 10; // [measured]
/// Distance beyond the visible ends of an object within which arcs are tested for belonging to it, in radii; arcs farther off
/// hardly ever belong to it.
const SPARE_REACH: f64 = 1.5; // [algorithmic]
/// Limit on the mean square residual from an object of an arc that still belongs to it, in variances of a point. It holds for
/// arcs within [`SPARE_REACH`] that the object did not take in.
const SPARE_SQUARE: f64 = 4.0; // [sigmas]

/// The order in which arcs are tried; its buffers are used again for the next image.
#[derive(Debug, Default)]
pub(crate) struct Seeds {
    /// The arcs that were not tried yet: the worth of each as a seed when it was put here, and its index. Of two equal ones that
    /// with the lower index comes first.
    order: BinaryHeap<(u64, Reverse<usize>)>,
    /// Number of seeds from which growth failed.
    failed: usize,
    /// For each arc: how many seeds have failed on the surface that it is connected with.
    failed_beside: Vec<u32>,
    /// Time to stop; `None`: never.
    deadline: Option<Instant>,
    taken: Vec<bool>,
    tried: Vec<bool>,
    /// Buffers: the arcs connected with a seed from which growth failed, and a flag for each arc that is among them.
    surface: Vec<usize>,
    reached: Vec<bool>,
}

/// Returns the worth of an arc as a seed: by how many standard deviations it is curved, times the chance of growth on a surface
/// where it failed `failed` times (Laplace's rule of succession). The bits of non-negative numbers have the order of the numbers.
fn worth(arc: &Arc, failed: u32) -> u64 {
    (arc.bulge.sqrt() / f64::from(2 + failed)).to_bits()
}

impl Seeds {
    /// Starts with the arcs of another image.
    pub fn order(&mut self, arcs: &Arcs, deadline: Option<Instant>) {
        let arcs = &arcs.arcs;
        (self.failed, self.deadline) = (0, deadline);
        self.order.clear();
        self.order.extend(arcs.iter().zip(0..).map(|(arc, index)| (worth(arc, 0), Reverse(index))));
        self.failed_beside.clear();
        self.failed_beside.resize(arcs.len(), 0);
        for flags in [&mut self.taken, &mut self.tried] {
            flags.clear();
            flags.resize(arcs.len(), false);
        }
    }

    /// Returns the best arc that is not part of an object and was not tried as part of a chain.
    pub fn next(&mut self, arcs: &Arcs, rejections: &mut Rejections) -> Option<usize> {
        let is_late = self.deadline.is_some_and(|deadline| Instant::now() >= deadline);
        if is_late {
            rejections.count(Rejection::Late);
        }
        let Self { order, failed_beside, taken, tried, .. } = self;
        let is_left = |(_, Reverse(arc)): &(u64, Reverse<usize>)| !taken[*arc] && !tried[*arc];
        if is_late || self.failed >= MAX_FAILED {
            order.drain().filter(is_left).for_each(|_| rejections.count(Rejection::Untried));
        }
        while let Some((known, Reverse(arc))) = std::iter::from_fn(|| order.pop()).find(is_left) {
            let now = worth(&arcs.arcs[arc], failed_beside[arc]);
            if now < known {
                order.push((now, Reverse(arc)));
            } else {
                return Some(arc);
            }
        }
        None
    }

    /// Returns whether an arc is not part of an object yet.
    pub fn is_free(&self, arc: usize) -> bool {
        !self.taken[arc]
    }

    /// Records that growth from a seed failed: no arc of its chain is tried as a seed again, and those connected with them, over
    /// gaps of `gap` lines, come later.
    pub fn give_up(&mut self, arcs: &Arcs, chain: &[usize], gap: i64) {
        self.failed += 1;
        self.exclude(chain);
        let Self { failed_beside, taken, surface, reached, .. } = self;
        surface.clear();
        surface.extend_from_slice(chain);
        arcs.connect(surface, reached, gap, |arc| !taken[arc]);
        surface.iter().for_each(|&arc| failed_beside[arc] += 1);
    }

    /// Excludes these arcs as seeds.
    pub fn exclude(&mut self, arcs: &[usize]) {
        for &arc in arcs {
            self.tried[arc] = true;
        }
    }

    /// Removes the arcs of an object, and all others that its surface explains.
    pub fn take(&mut self, best: &Candidate, object: &Object) {
        let Candidate { region, measured, .. } = best;
        for &member in region.members {
            self.taken[member] = true;
        }
        let q = region.model.coefficients();
        let center = verify::middle(region, measured);
        let reach = 0.5 * (measured.extent[1] - measured.extent[0]) + SPARE_REACH * object.radius;
        for (taken, arc) in self.taken.iter_mut().zip(&region.arcs.arcs) {
            if !*taken && (arc.mean - center).norm() < reach {
                let residual = region.model.residual(&q, arc);
                *taken = residual
                    .is_some_and(|residual| residual.square.max(residual.mean.powi(2)) < SPARE_SQUARE * arc.variance);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::model;
    use super::super::region::Region;
    use super::super::tests::{arcs_of, rows_of};
    use super::super::verify::{Measured, Outline};
    use super::*;
    use conicflow_geometry::Vector3;
    use conicflow_lab::rendered::cylinder;
    use conicflow_messages::ObjectKind;

    /// The reach from the middle is half of the length plus one and a half radii.
    #[test]
    fn an_object_takes_what_its_surface_explains_as_far_as_it_reaches_and_a_little_beyond() {
        let (radius, low, high) = (0.05, 0.05, 0.15);
        let arcs = arcs_of(&[cylinder(Vector3::z(), Vector3::y(), radius, 0.7)]);
        let rows = rows_of(&arcs, |_| true);
        let members = rows_of(&arcs, |arc| (low..high).contains(&arc.mean.y));
        let model = model::fit(ObjectKind::Cylinder, &arcs.of(&rows), None, f64::INFINITY).unwrap();
        let region = Region { arcs: &arcs, model, members: &members };
        let along = |y: f64| region.along(&Vector3::new(0.0, y, 1.0));
        let extent = [along(low).min(along(high)), along(low).max(along(high))];
        let (lines, count, points) = (members.len() as u32, 1000, 1000.0);
        let measured =
            Measured { count, points, lines, variance: 1e-6, residual: 0.0, curvature: 100.0, angle: 2.0, extent };
        let outline = Outline { square: 1.0, far_off: 0.0, free: 1.0 };
        let mut seeds = Seeds::default();
        seeds.order(&arcs, None);
        seeds.take(&Candidate { region, measured, outline, roundness: 0.0 }, &Object { radius, ..Object::default() });
        let reach = 0.5 * (high - low) + 1.5 * radius;
        let (mut taken, mut left) = (0, 0);
        for &row in &rows {
            let away = (arcs.arcs[row].mean - Vector3::new(0.0, 0.5 * (low + high), 1.0)).norm();
            match seeds.is_free(row) {
                false if away < reach + 0.005 => taken += 1,
                true if away > reach - 0.005 => left += 1,
                is_free => panic!("{is_free} {away} m from its middle, of {reach} m"),
            }
        }
        assert!(taken > 60 && left > 60, "{taken} {left}");
    }
}
