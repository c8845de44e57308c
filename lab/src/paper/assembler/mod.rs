//! The paper's way: ellipses of neighbouring scan lines with near centres form chains ([`chains`]); along a chain the centres
//! have to stay on a line or a circle and the radii on a straight or a circular profile, else the object ends and a new one
//! begins ([`sequence`]); what held together is fitted as a cylinder, a cone ([`axial`]) or a sphere ([`spherical`]) and
//! verified against the points, of which the ellipses carry the moments ([`verify`]). No point is seen again.

mod axial;
mod chains;
mod parameters;
mod rejection;
mod sections;
mod sequence;
mod spherical;
#[cfg(test)]
mod tests;
mod verify;

pub use parameters::{ProfileConfig, ProfileParameters, SectionFit};

use chains::Chains;
use conicflow_messages::{Ellipse, Header, NoiseModel, Object};
use rejection::{Rejection, Rejections};
use sections::Section;
use sequence::Sequences;
use std::ops::Range;
use verify::{Body, Candidate, Solid};

/// The paper's assembler; its buffers are used again for the next image.
#[derive(Debug)]
pub struct ProfileAssembler {
    config: ProfileConfig,
    sections: Vec<Section>,
    chains: Chains,
    sequences: Sequences,
    inliers: Vec<usize>,
    objects: Vec<Object>,
    rejections: Rejections,
}

impl ProfileAssembler {
    /// An assembler with these parameters.
    pub fn new(config: ProfileConfig) -> Self {
        Self {
            config,
            sections: Vec::new(),
            chains: Chains::default(),
            sequences: Sequences::default(),
            inliers: Vec::new(),
            objects: Vec::new(),
            rejections: Rejections::default(),
        }
    }

    /// The objects that the ellipses of one image form.
    pub fn assemble(&mut self, header: &Header, ellipses: &[Ellipse]) -> &[Object] {
        let Self { config, sections, chains, sequences, inliers, objects, rejections } = self;
        objects.clear();
        *rejections = Rejections::default();
        sections::read(header, ellipses, config.profile.section_fit, sections);
        chains.link(sections, config);
        for chain in chains.iter() {
            sequences.split(sections, chain, config);
            for members in sequences.iter() {
                let search = Search { sections, noise: &header.noise, config };
                search.run(members, inliers, objects, rejections);
            }
        }
        verify::drop_doubles(objects, rejections);
        objects
    }

    /// Why candidates of the last image were turned down, and how many of them.
    pub fn rejections(&self) -> impl Iterator<Item = (&'static str, u64)> {
        self.rejections.iter()
    }
}

/// What is the same for all sequences of an image.
struct Search<'a> {
    sections: &'a [Section],
    noise: &'a NoiseModel,
    config: &'a ProfileConfig,
}

impl Search<'_> {
    /// Adds the objects of a sequence: what lies before and after one is looked at again.
    fn run(&self, members: &[usize], inliers: &mut Vec<usize>, objects: &mut Vec<Object>, rejections: &mut Rejections) {
        let candidate = Candidate::new(self.sections, members, self.noise, self.config);
        match candidate.and_then(|candidate| object(&candidate, inliers)) {
            Ok((object, range)) => {
                objects.push(object);
                for rest in [&members[..range.start], &members[range.end..]] {
                    if rest.len() >= self.config.profile.min_rows as usize {
                        self.run(rest, inliers, objects, rejections);
                    }
                }
            }
            Err(reason) => rejections.count(reason),
        }
    }
}

/// Parts of a sequence that a fit starts from, where the whole is spoilt by its ends: a rim, a foot on the floor.
const SEEDS: [(f64, f64); 4] = [(0.0, 1.0), (0.25, 0.75), (0.0, 0.5), (0.5, 1.0)];

/// The first object that a sequence of sections forms, and where in the sequence, or why it forms none.
///
/// The first seed that forms one is fitted again with all sections around it that it explains; `inliers` is a buffer for
/// them.
fn object(candidate: &Candidate, inliers: &mut Vec<usize>) -> Result<(Object, Range<usize>), Rejection> {
    let mut whole = None;
    for (from, to) in SEEDS {
        let seed = candidate.part(from, to);
        match candidate.only(seed.clone()).and_then(|seed| best(&seed)) {
            Ok((object, solid)) => {
                let range = candidate.inliers(&solid, object.rms, seed, inliers);
                let refined = candidate.with(inliers).and_then(|all| best(&all));
                return Ok((refined.map_or(object, |(refined, _)| refined), range));
            }
            Err(reason) => whole = whole.or(Some(reason)),
        }
    }
    Err(whole.unwrap_or(Rejection::Degenerate))
}

/// The shape that explains the points best, among those that explain them at all.
///
/// A cone has one parameter more than a cylinder: it has to explain the points clearly better than the others.
fn best(candidate: &Candidate) -> Result<(Object, Solid), Rejection> {
    let verified = |body: Body| candidate.verify(&body).map(|object| (object, body.solid));
    let cylinder = axial::fit_cylinder(candidate).and_then(verified);
    let sphere = spherical::fit(candidate).and_then(verified);
    let cone = axial::fit_cone(candidate).and_then(verified);
    better(better(cylinder, sphere, 1.0), cone, candidate.config.profile.cone_gain)
}

/// The second of two where its residual is less than `gain` times that of the first, or the first is none.
fn better<T>(
    first: Result<(Object, T), Rejection>,
    second: Result<(Object, T), Rejection>,
    gain: f64,
) -> Result<(Object, T), Rejection> {
    match (first, second) {
        (Ok(first), Ok(second)) => Ok(if second.0.rms < gain * first.0.rms { second } else { first }),
        (first, second) => first.or_else(|reason| second.map_err(|_| reason)),
    }
}
