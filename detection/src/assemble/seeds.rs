//! Seeds: the arcs of an image that nothing explains yet, the most curved first.

use super::arcs::Arcs;
use super::rejection::{Rejection, Rejections};
use super::verify::{self, Candidate};
use conicflow_messages::Object;
use std::cmp::Ordering;
use std::collections::BinaryHeap;
use std::time::Instant;

/// Most seeds from which something grows in vain in one image, the most curved first. It bounds the time, and what is found later
/// is seldom right: in recorded frames 8 and 10 of them give 7 wrong answers, 12 give 8 and 16 give 10, and of 104 things 98 are
/// found in all cases; in simulated stereo 208, 210, 211 and 213 of 320, with 25, 27, 28 and 28 wrong answers (before arcs behind
/// a model were let into its growth).
pub(super) const MAX_VAIN: usize = 10; // [measured]
/// Arcs up to so many radii beyond the visible ends of an object are tested for belonging to it; those farther off hardly ever do.
const SPARE_REACH: f64 = 1.5; // [algorithmic]
/// Such an arc belongs to the object if its mean square residual is less than so many variances.
const SPARE_SQUARE: f64 = 4.0; // [sigmas]

/// The order in which arcs are tried; its buffers are used again for the next image.
#[derive(Debug, Default)]
pub(crate) struct Seeds {
    /// The arcs that were not looked at yet.
    order: BinaryHeap<Seed>,
    /// How many were tried in vain.
    vain: usize,
    /// When to stop, if ever.
    deadline: Option<Instant>,
    taken: Vec<bool>,
    tried: Vec<bool>,
}

/// How curved an arc is, and its index: the more curved one comes first, of two alike the one of the lower index.
#[derive(Clone, Copy, Debug)]
struct Seed(f64, usize);

impl Ord for Seed {
    fn cmp(&self, other: &Self) -> Ordering {
        self.0.total_cmp(&other.0).then(other.1.cmp(&self.1))
    }
}

impl PartialOrd for Seed {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl PartialEq for Seed {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Seed {}

impl Seeds {
    /// Begins with the arcs of another image.
    pub fn order(&mut self, arcs: &Arcs, deadline: Option<Instant>) {
        let arcs = &arcs.arcs;
        (self.vain, self.deadline) = (0, deadline);
        self.order.clear();
        self.order.extend(arcs.iter().zip(0..).map(|(arc, index)| Seed(arc.bulge, index)));
        for flags in [&mut self.taken, &mut self.tried] {
            flags.clear();
            flags.resize(arcs.len(), false);
        }
    }

    /// The next arc that is neither part of an object nor was tried with another.
    pub fn next(&mut self, rejections: &mut Rejections) -> Option<usize> {
        let is_late = self.deadline.is_some_and(|deadline| Instant::now() >= deadline);
        if is_late {
            rejections.count(Rejection::Late);
        }
        let Self { order, taken, tried, .. } = self;
        let is_left = |Seed(_, arc): &Seed| !taken[*arc] && !tried[*arc];
        if is_late || self.vain >= MAX_VAIN {
            order.drain().filter(is_left).for_each(|_| rejections.count(Rejection::Untried));
        }
        std::iter::from_fn(|| order.pop()).find(is_left).map(|Seed(_, arc)| arc)
    }

    /// Whether an arc is part of no object yet.
    pub fn is_free(&self, arc: usize) -> bool {
        !self.taken[arc]
    }

    /// A seed was tried in vain: none of these arcs is tried again as one.
    pub fn give_up(&mut self, arcs: &[usize]) {
        self.vain += 1;
        self.pass_over(arcs);
    }

    /// None of these arcs is tried as a seed.
    pub fn pass_over(&mut self, arcs: &[usize]) {
        for &arc in arcs {
            self.tried[arc] = true;
        }
    }

    /// Takes the arcs of an object, and all others that its surface explains, from what is left.
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
                let misfit = region.model.misfit(&q, arc);
                *taken =
                    misfit.is_some_and(|misfit| misfit.square.max(misfit.mean.powi(2)) < SPARE_SQUARE * arc.variance);
            }
        }
    }
}
