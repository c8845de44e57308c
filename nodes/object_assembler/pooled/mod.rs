//! Objects by pooled moments (`method = "pooled"`): no ellipse has to be right on its own.
//!
//! The arcs of an image ([`arcs`]) carry the moments of their points. From the most curved arc on, models of each shape
//! grow over the lines as long as they explain the moments ([`growth`], [`model`]); what has grown is fitted together
//! with the contour that it shows, verified as a whole ([`verify`]), and of the shapes that pass the one is reported
//! ([`report`]) that explains most with the fewest parameters ([`choice`]). Its arcs are taken out before the next seed
//! is tried.

mod arcs;
mod choice;
mod config;
mod growth;
mod model;
mod report;
#[cfg(test)]
mod tests;
mod verify;

pub use config::PooledConfig;

use super::AssemblerConfig;
use super::rejection::{Rejection, Rejections};
use arcs::{Arc, Arcs};
use conicflow_geometry::Contour;
use conicflow_messages::{Ellipse, Header, Object, ObjectKind};
use growth::{Growth, Start};
use model::Model;
use verify::Measured;

/// Most seeds that are tried in one image, the most curved first. It bounds the time; three times as many find no more.
const MAX_TRIES: usize = 96; // [algorithmic]
/// Number of fits to the contour. Each uses the contour points that are near the contour of the last fit.
const CONTOUR_PASSES: usize = 2; // [algorithmic]

/// Finds objects in the arcs of an image; its buffers are used again for the next.
#[derive(Debug, Default)]
pub(super) struct Pooled {
    arcs: Arcs,
    /// How curved each arc is, and its index.
    order: Vec<(f64, usize)>,
    taken: Vec<bool>,
    tried: Vec<bool>,
    growing: Growing,
}

/// Buffers of a growth.
#[derive(Debug, Default)]
struct Growing {
    chain: Vec<usize>,
    spare: Vec<usize>,
    /// The members of each shape.
    members: [Vec<usize>; ObjectKind::ALL.len()],
    contour: Contour,
}

/// A model and the arcs that it explains, in the order of the lines.
#[derive(Clone, Copy, Debug)]
struct Grown<'a> {
    arcs: &'a Arcs,
    model: Model,
    members: &'a [usize],
}

/// A verified candidate.
#[derive(Clone, Copy, Debug)]
struct Candidate<'a> {
    grown: Grown<'a>,
    measured: Measured,
}

impl Pooled {
    pub fn assemble(
        &mut self,
        header: &Header,
        ellipses: &[Ellipse],
        config: &AssemblerConfig,
        objects: &mut Vec<Object>,
        rejections: &mut Rejections,
    ) {
        self.arcs.read(header, ellipses);
        let arcs = &self.arcs.arcs;
        self.order.clear();
        self.order.extend(arcs.iter().map(|arc| arc.bulge).zip(0..));
        self.order.sort_unstable_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
        for flags in [&mut self.taken, &mut self.tried] {
            flags.clear();
            flags.resize(arcs.len(), false);
        }
        let mut tries = 0;
        for &(_, seed) in &self.order {
            if self.taken[seed] || self.tried[seed] {
                continue;
            }
            if tries == MAX_TRIES {
                rejections.count(Rejection::Untried);
                continue;
            }
            tries += 1;
            match self.growing.candidate(&self.arcs, &self.taken, seed, config, rejections) {
                Some((candidate, object)) => {
                    take(&candidate, &object, &mut self.taken);
                    objects.push(object);
                }
                None => self.growing.chain.iter().for_each(|&arc| self.tried[arc] = true),
            }
        }
    }
}

impl Growing {
    /// The object around a seed, if there is one.
    fn candidate<'a>(
        &'a mut self,
        arcs: &'a Arcs,
        taken: &[bool],
        seed: usize,
        config: &AssemblerConfig,
        rejections: &mut Rejections,
    ) -> Option<(Candidate<'a>, Object)> {
        let free = |index: usize| !taken[index];
        let gap = i64::from(config.pooled.max_gap_lines);
        growth::chain(arcs, seed, gap, free, &mut self.chain);
        if self.chain.len() < config.pooled.min_lines as usize {
            rejections.count(Rejection::FewRows);
            return None;
        }
        if !growth::is_curved(arcs, &self.chain) {
            rejections.count(Rejection::Flat);
            return None;
        }
        let models = self.models(arcs, gap, free);
        let Self { members, contour, .. } = self;
        let found = std::array::from_fn(|kind| {
            let grown = Grown { arcs, model: models[kind]?, members: &members[kind] };
            Some(candidate(grown, config, contour))
        });
        choice::choose(found, config, contour).map_err(|reason| rejections.count(reason)).ok()
    }

    /// The model of each shape that grows from the chain. Where a cylinder explains all of that, a sphere has to as well;
    /// and a slope needs many lines: a cone starts from what a cylinder took for one.
    fn models(&mut self, arcs: &Arcs, gap: i64, free: impl Fn(usize) -> bool + Copy) -> [Option<Model>; 3] {
        let Self { chain, spare, members: [balls, cans, cones], .. } = self;
        let mut grow = |start: &Start, members: &mut Vec<usize>| growth::grow(arcs, start, gap, free, members, spare);
        let start = Start { kind: ObjectKind::Cylinder, chain, guess: None, middle_will_do: true };
        let Growth { model: cylinder, from_whole } = grow(&start, cans);
        let sphere = grow(&Start { kind: ObjectKind::Sphere, middle_will_do: !from_whole, ..start }, balls).model;
        let longer = if cylinder.is_some() && cans.len() > chain.len() { &*cans } else { &*chain };
        let cone = Start { kind: ObjectKind::Cone, chain: longer, guess: cylinder.as_ref(), ..start };
        [sphere, cylinder, grow(&cone, cones).model]
    }
}

impl<'a> Grown<'a> {
    fn arcs(&self) -> impl Iterator<Item = &'a Arc> + Clone + use<'a> {
        self.arcs.of(self.members)
    }

    fn points(&self) -> f64 {
        self.arcs().map(|arc| arc.points).sum()
    }

    /// Mean variance of a point, in square metres.
    fn variance(&self) -> f64 {
        self.arcs().map(|arc| arc.variance * arc.points).sum::<f64>() / self.points()
    }

    /// How many neighbouring lines share their noise, at least 1.
    fn shared_lines(&self) -> f64 {
        self.ends()[0].shared_lines
    }

    /// The arcs of the first and the last line.
    fn ends(&self) -> [&'a Arc; 2] {
        [self.members[0], self.members[self.members.len() - 1]].map(|index| &self.arcs.arcs[index])
    }

    /// From where to where the arcs reach along the axis, counted from the surface's point; 0 both for a sphere.
    fn extent(&self) -> [f64; 2] {
        let along = |arc: &Arc| self.model.conical().map_or(0.0, |s| s.axis.dot(&(arc.mean - s.point)));
        self.arcs().map(along).fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], x| [a.min(x), b.max(x)])
    }
}

/// What has grown, fitted together with its contour, if it is an object.
fn candidate<'a>(
    mut grown: Grown<'a>,
    config: &AssemblerConfig,
    contour: &mut Contour,
) -> Result<Candidate<'a>, Rejection> {
    let measured = verify::check(&grown, config)?;
    if verify::is_plane(&grown, &measured) {
        return Err(Rejection::Flat);
    }
    if verify::goes_on(&grown, i64::from(config.pooled.max_gap_lines)) {
        return Err(Rejection::Part);
    }
    if let Some(model) = model::with_contour(&grown, CONTOUR_PASSES, contour) {
        if verify::has_other_outline(&model, contour) {
            return Err(Rejection::Outline);
        }
        grown.model = model;
    }
    Ok(Candidate { grown, measured: verify::check(&grown, config)? })
}

impl Candidate<'_> {
    fn report(&self) -> Object {
        report::report(&self.grown, &self.measured)
    }
}

/// Arcs up to so many radii beyond the visible ends of an object are tested for belonging to it.
const SPARE_REACH: f64 = 1.5; // [tuned]
/// Such an arc belongs to the object if its mean square residual is less than so many variances.
const SPARE_SQUARE: f64 = 4.0; // [sigmas]

/// Takes the arcs of an object, and all others that its surface explains, from what is left.
fn take(candidate: &Candidate, object: &Object, taken: &mut [bool]) {
    let Candidate { grown, measured } = candidate;
    grown.members.iter().for_each(|&member| taken[member] = true);
    let q = grown.model.coefficients();
    let center = verify::middle(grown, measured);
    let reach = 0.5 * (measured.extent[1] - measured.extent[0]) + SPARE_REACH * object.radius;
    for (taken, arc) in taken.iter_mut().zip(&grown.arcs.arcs) {
        if !*taken && (arc.mean - center).norm() < reach {
            let misfit = grown.model.misfit(&q, arc);
            *taken = misfit.is_some_and(|misfit| misfit.square.max(misfit.mean.powi(2)) < SPARE_SQUARE * arc.variance);
        }
    }
}
