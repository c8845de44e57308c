//! Objects by pooled moments (`method = "pooled"`): no ellipse has to be right on its own.
//!
//! The arcs of an image ([`arcs`]) carry the moments of their points. From the most curved arc on, models of each shape
//! grow over the lines as long as they explain the moments ([`growth`], [`model`]); each is verified as a whole
//! ([`verify`]), the one that explains most with the fewest parameters is reported ([`report`]), and its arcs are taken
//! out before the next seed is tried.

mod arcs;
mod growth;
mod model;
mod report;
#[cfg(test)]
mod tests;
mod verify;

use super::AssemblerConfig;
use super::verify::{Rejection, Rejections};
use arcs::Arcs;
use conicflow_messages::{Ellipse, Header, Object, ObjectKind};
use growth::Grown;
use verify::Measured;

/// Two models that explain about as many points: the smaller explains at least this part of the larger's.
const AS_MANY: f64 = 0.9;
/// Standard deviations by which the slope of a cone has to differ from zero.
const SLOPE_SIGMAS: f64 = 3.0;
/// Half-angle below which a cone is slender, in radians (7 degrees) ...
const SLENDER: f64 = 0.122;
/// ... and has to take this part of the variance off the residual that a cylinder leaves.
const NOTABLE: f64 = 0.03;
/// Most seeds that are tried in one image.
const MAX_TRIES: usize = 96;

/// Finds objects in the arcs of an image; its buffers are used again for the next.
#[derive(Debug, Default)]
pub(super) struct Pooled {
    arcs: Arcs,
    order: Vec<usize>,
    taken: Vec<bool>,
    tried: Vec<bool>,
    chain: Vec<usize>,
}

/// A verified candidate.
struct Candidate {
    grown: Grown,
    measured: Measured,
    object: Object,
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
        self.order.extend(0..arcs.len());
        self.order.sort_by(|&a, &b| arcs[b].bulge.total_cmp(&arcs[a].bulge).then(a.cmp(&b)));
        for flags in [&mut self.taken, &mut self.tried] {
            flags.clear();
            flags.resize(arcs.len(), false);
        }
        let mut tries = 0;
        for place in 0..self.order.len() {
            let seed = self.order[place];
            if self.taken[seed] || self.tried[seed] {
                continue;
            }
            if tries == MAX_TRIES {
                break;
            }
            tries += 1;
            match self.candidate(seed, config, rejections) {
                Some(candidate) => {
                    self.take(&candidate);
                    objects.push(candidate.object);
                }
                None => self.chain.iter().for_each(|&arc| self.tried[arc] = true),
            }
        }
    }

    /// The object around a seed, if there is one.
    fn candidate(&mut self, seed: usize, config: &AssemblerConfig, rejections: &mut Rejections) -> Option<Candidate> {
        let taken = &self.taken;
        let free = |index: usize| !taken[index];
        let gap = i64::from(config.max_gap_lines);
        growth::chain(&self.arcs, seed, gap, free, &mut self.chain);
        if !growth::is_curved(&self.arcs, &self.chain) {
            rejections.count(Rejection::Flat);
            return None;
        }
        let mut found = ObjectKind::ALL.map(|_| None);
        let mut reason = None;
        let mut start = self.chain.clone();
        for (slot, kind) in found.iter_mut().zip(ObjectKind::ALL) {
            let Some(grown) = growth::grow(&self.arcs, kind, &start, gap, free) else { continue };
            // A slope needs many lines: a cone starts from what a cylinder took for one.
            if kind == ObjectKind::Cylinder && grown.members.len() > start.len() {
                start.clone_from(&grown.members);
            }
            match candidate(&self.arcs, grown, config) {
                Ok(candidate) => *slot = Some(candidate),
                Err(why) => reason = Some(why),
            }
        }
        let best = choose(found, config);
        if best.is_none() {
            rejections.count(reason.unwrap_or(Rejection::Degenerate));
        }
        best
    }

    /// Takes the arcs of an object, and all others that its surface explains, from what is left.
    fn take(&mut self, candidate: &Candidate) {
        let (model, measured) = (&candidate.grown.model, &candidate.measured);
        candidate.grown.members.iter().for_each(|&member| self.taken[member] = true);
        let q = model.coefficients();
        let center = verify::middle(&candidate.grown, measured);
        let reach = 0.5 * (measured.extent[1] - measured.extent[0]) + 1.5 * candidate.object.radius;
        for (taken, arc) in self.taken.iter_mut().zip(&self.arcs.arcs) {
            if !*taken && (arc.mean - center).norm() < reach {
                let misfit = model.misfit(&q, arc);
                *taken = misfit.is_some_and(|misfit| misfit.square.max(misfit.mean.powi(2)) < 4.0 * arc.variance);
            }
        }
    }
}

fn candidate(arcs: &Arcs, grown: Grown, config: &AssemblerConfig) -> Result<Candidate, Rejection> {
    let measured = verify::check(arcs, &grown, config)?;
    let object = report::report(arcs, &grown, &measured);
    if verify::is_vague(object.radius, object.sigma.radius) {
        return Err(Rejection::Vague);
    }
    Ok(Candidate { grown, measured, object })
}

/// The candidate that explains most points; of those that explain about as many, the one of fewer parameters, unless
/// the other explains them better.
fn choose([sphere, cylinder, cone]: [Option<Candidate>; 3], config: &AssemblerConfig) -> Option<Candidate> {
    let cone = cone.filter(|cone| is_cone(&cone.object, config));
    let axial = match (cylinder, cone) {
        (Some(cylinder), Some(cone)) => {
            Some(if cylinder.measured.points < AS_MANY * cone.measured.points { cone } else { sharper(cylinder, cone) })
        }
        (cylinder, cone) => cylinder.or(cone),
    };
    match (sphere, axial) {
        (Some(sphere), Some(axial)) => Some(rounder(sphere, axial)),
        (sphere, axial) => sphere.or(axial),
    }
}

/// Whether the half-angle of a cone is surely not zero.
fn is_cone(object: &Object, config: &AssemblerConfig) -> bool {
    object.half_angle > config.min_cone_deg.to_radians() && object.half_angle > SLOPE_SIGMAS * object.sigma.half_angle
}

/// Of a cylinder and a cone that explain about the same points the cone where it is surely one: a blunt one by its
/// half-angle; a slender one, which a tilted cylinder resembles, only where it also explains the points notably better.
fn sharper(cylinder: Candidate, cone: Candidate) -> Candidate {
    let gain = cylinder.measured.misfit - cone.measured.misfit;
    let is_slender = cone.object.half_angle < SLENDER;
    if cone.measured.points < AS_MANY * cylinder.measured.points || (is_slender && gain < NOTABLE) {
        cylinder
    } else {
        cone
    }
}

fn rounder(sphere: Candidate, axial: Candidate) -> Candidate {
    let (a, b) = (sphere.measured.points, axial.measured.points);
    let sphere_wins = if a < AS_MANY * b {
        false
    } else if b < AS_MANY * a {
        true
    } else {
        sphere.measured.misfit <= axial.measured.misfit + 2.0 * (2.0 / a).sqrt()
    };
    if sphere_wins { sphere } else { axial }
}
