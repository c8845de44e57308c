//! Growth of an object: from a few arcs that lie beside each other, a model takes in line after line what it explains.

use super::arcs::{Arc, Arcs, Misfit};
use super::model::{self, Model};
use conicflow_messages::ObjectKind;

/// Arcs that a growth starts from, on each side of its seed.
const CHAIN: usize = 8;
/// Slope of a cone beyond which its fit has gone astray.
const STEEPEST: f64 = 1.2;
/// Fewest arcs that a model is fitted to.
const FEWEST: usize = 5;
/// Most rounds of taking in and fitting again; each at most doubles the extent.
const ROUNDS: usize = 7;
/// How many standard deviations the error of an arc may scatter.
const SCATTER: f64 = 3.0;
/// How many standard deviations the curvature of a chain has to be above zero.
const CURVED: f64 = 4.0;
/// Part of the variance that the misfit of one arc may be on top of it.
const SLACK: f64 = 0.5;
/// The same when all that belongs to the object has been found ...
const STRICT_SCATTER: f64 = 2.5;
/// ... and there,
const STRICT_SLACK: f64 = 0.15;
/// and at the ends.
const END_SCATTER: f64 = 1.2;

/// A model and the arcs that it explains, in the order of the lines.
#[derive(Clone, Debug)]
pub(super) struct Grown {
    pub model: Model,
    pub members: Vec<usize>,
}

impl Grown {
    pub fn arcs<'a>(&'a self, arcs: &'a Arcs) -> impl Iterator<Item = &'a Arc> + Clone {
        self.members.iter().map(|&member| &arcs.arcs[member])
    }

    pub fn points(&self, arcs: &Arcs) -> f64 {
        self.arcs(arcs).map(|arc| arc.points).sum()
    }
}

/// Whether an arc's misfit is what its noise accounts for, and `slack` variances more.
fn explains(arc: &Arc, misfit: &Misfit, scatter: f64, slack: f64) -> bool {
    let sigma = arc.variance.sqrt();
    misfit.square <= arc.variance * (scatter * (2.0 / arc.points).sqrt() + slack)
        && misfit.mean.abs() <= sigma * (slack + scatter / arc.points.sqrt())
}

/// Leaves out the arcs that the model explains badly, at the ends with less patience: there an object meets the floor, a
/// rim or another object.
fn cleaned(arcs: &Arcs, grown: &Grown) -> Vec<usize> {
    let q = grown.model.coefficients();
    let fits = |index: usize, scatter: f64, slack: f64| {
        let arc = &arcs.arcs[index];
        grown.model.misfit(&q, arc).is_some_and(|misfit| explains(arc, &misfit, scatter, slack))
    };
    let mut members = grown.members.clone();
    members.retain(|&index| fits(index, STRICT_SCATTER, STRICT_SLACK));
    let at_end = |index: usize| !fits(index, END_SCATTER, 0.0);
    let last = members.iter().rposition(|&index| !at_end(index)).map_or(0, |last| last + 1);
    members.truncate(last);
    let first = members.iter().position(|&index| !at_end(index)).unwrap_or(0);
    members.split_off(first)
}

/// The seed with its neighbours on both sides, in the order of the lines.
pub(super) fn chain(arcs: &Arcs, seed: usize, gap: i64, free: impl Fn(usize) -> bool + Copy, chain: &mut Vec<usize>) {
    chain.clear();
    for side in [-1, 1] {
        let mut at = seed;
        for _ in 0..CHAIN {
            let Some(next) = arcs.beside(at, side, gap, free) else { break };
            chain.push(next);
            at = next;
        }
        if side < 0 {
            chain.reverse();
            chain.push(seed);
        }
    }
}

/// Whether the arcs of a chain are surely curved, all together.
pub(super) fn is_curved(arcs: &Arcs, chain: &[usize]) -> bool {
    let (mut bulge, mut points) = (0.0, 0.0);
    for arc in chain.iter().map(|&index| &arcs.arcs[index]) {
        bulge += arc.bulge;
        points += arc.points;
    }
    chain.len() >= FEWEST && bulge > CURVED * (2.0 * points).sqrt()
}

/// Grows a model of one kind from `chain` on; `None` where it does not explain even that.
pub(super) fn grow(
    arcs: &Arcs,
    kind: ObjectKind,
    chain: &[usize],
    gap: i64,
    free: impl Fn(usize) -> bool + Copy,
) -> Option<Grown> {
    if chain.len() < FEWEST {
        return None;
    }
    let mut grown = first(arcs, kind, chain)?;
    for round in 0..ROUNDS {
        let members = reach(arcs, &grown, gap, free);
        if members.len() < FEWEST {
            return None;
        }
        let settled = members == grown.members;
        if settled && round > 0 {
            break;
        }
        grown.members = members;
        let members = grown.members.iter().map(|&member| &arcs.arcs[member]);
        grown.model = model::fit(kind, &members, Some(&grown.model))?;
    }
    for _ in 0..2 {
        grown.members = cleaned(arcs, &grown);
        if grown.members.len() < FEWEST {
            return None;
        }
        let members = grown.members.iter().map(|&member| &arcs.arcs[member]);
        grown.model = model::fit(kind, &members, Some(&grown.model))?;
    }
    Some(grown)
}

/// The model of the chain, if it explains it, or else of its middle.
fn first(arcs: &Arcs, kind: ObjectKind, chain: &[usize]) -> Option<Grown> {
    for length in [chain.len(), 9, FEWEST] {
        let start = chain.len().saturating_sub(length) / 2;
        let part = &chain[start..(start + length).min(chain.len())];
        let members = part.iter().map(|&member| &arcs.arcs[member]);
        let Some(model) = model::fit(kind, &members, None) else { continue };
        let points: f64 = members.clone().map(|arc| arc.points).sum();
        if !is_wild(&model) && model.square_sum() / points <= SLACK + SCATTER * (2.0 / points).sqrt() {
            return Some(Grown { model, members: part.to_vec() });
        }
    }
    None
}

/// Whether a few arcs gave a cone that none is.
fn is_wild(model: &Model) -> bool {
    model.conical().is_some_and(|surface| surface.slope.abs() > STEEPEST)
}

/// The arcs around the members that the model explains, without gaps of more than `gap` lines, and not farther off than
/// the members reach.
fn reach(arcs: &Arcs, grown: &Grown, gap: i64, free: impl Fn(usize) -> bool) -> Vec<usize> {
    let q = grown.model.coefficients();
    let [first, last] = [grown.members[0], grown.members[grown.members.len() - 1]].map(|index| &arcs.arcs[index]);
    let middle = &arcs.arcs[grown.members[grown.members.len() / 2]];
    let (from, to) = (i64::from(first.line), i64::from(last.line));
    let more = (to - from + 1).max(4);
    let mut members = Vec::new();
    let accept = |index: usize, span: [i64; 2]| {
        let arc = &arcs.arcs[index];
        let margin = (span[1] - span[0]) / 8 + 2;
        free(index)
            && arc.overlap([span[0] - margin, span[1] + margin]) > 0
            && grown.model.misfit(&q, arc).is_some_and(|misfit| explains(arc, &misfit, SCATTER, SLACK))
            && faces(arc, &grown.model)
    };
    for side in [-1, 1] {
        let (mut line, mut span, mut misses) = (i64::from(middle.line), middle.pixels, 0);
        if side > 0 {
            line += 1;
        }
        while misses <= gap && line >= from - more && line <= to + more {
            let before = members.len();
            let mut wide: Option<[i64; 2]> = None;
            for index in arcs.on_line(middle.scan, line).filter(|&index| accept(index, span)) {
                members.push(index);
                let [a, b] = arcs.arcs[index].pixels;
                wide = Some(wide.map_or([a, b], |[c, d]| [a.min(c), b.max(d)]));
            }
            misses = if members.len() > before { 0 } else { misses + 1 };
            span = wide.unwrap_or(span);
            line += side;
        }
    }
    members.sort_unstable();
    members
}

/// Whether an arc lies on the side of the surface that can be seen.
fn faces(arc: &Arc, model: &Model) -> bool {
    let outwards = match model {
        Model::Sphere(fit) => arc.mean - fit.surface.center,
        _ => model.conical().map_or(arc.mean, |surface| arc.mean - surface.anchored(&arc.mean).point),
    };
    outwards.dot(&arc.mean) < 0.0
}
