//! The paper's method: ellipses of neighbouring scan lines with near centres form chains ([`chains`]). Along a chain the centres
//! have to stay on a line or a circle, and the radii on a straight or circular profile; else the object ends and a new one begins
//! ([`sequence`]). Each sequence is fitted as a cylinder, a cone ([`axial`]) or a sphere ([`spherical`]), and verified against
//! the points, whose moments the ellipses carry ([`verify`]). The points themselves are not needed again.

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

use conicflow_messages::{Ellipse, Header, NoiseModel, Object};
use rejection::{Rejection, Rejections};
use sections::Section;
use std::ops::Range;
use verify::{Body, Candidate, Solid};

/// The paper's assembler.
#[derive(Debug)]
pub struct ProfileAssembler {
    config: ProfileConfig,
    objects: Vec<Object>,
    rejections: Rejections,
}

impl ProfileAssembler {
    /// Creates an assembler with these parameters.
    pub fn new(config: ProfileConfig) -> Self {
        Self { config, objects: Vec::new(), rejections: Rejections::default() }
    }

    /// Returns the objects that the ellipses of one image form.
    pub fn assemble(&mut self, header: &Header, ellipses: &[Ellipse]) -> &[Object] {
        self.objects.clear();
        self.rejections = Rejections::default();
        let sections = sections::read(header, ellipses, self.config.profile.section_fit);
        for chain in chains::link(&sections, &self.config) {
            for members in sequence::split(&sections, &chain, &self.config) {
                self.search(&sections, &members, &header.noise);
            }
        }
        verify::drop_doubles(&mut self.objects, &mut self.rejections);
        &self.objects
    }

    /// Adds the objects of a sequence; searches the sections before and after each object again.
    fn search(&mut self, sections: &[Section], members: &[usize], noise: &NoiseModel) {
        match Candidate::new(sections, members, noise, &self.config).and_then(|candidate| object(&candidate)) {
            Ok((object, range)) => {
                self.objects.push(object);
                for rest in [&members[..range.start], &members[range.end..]] {
                    if rest.len() >= self.config.profile.min_rows as usize {
                        self.search(sections, rest, noise);
                    }
                }
            }
            Err(reason) => self.rejections.count(reason),
        }
    }

    /// Returns the reasons for rejected candidates of the last image, and their counts.
    pub fn rejections(&self) -> impl Iterator<Item = (&'static str, u64)> {
        self.rejections.iter()
    }
}

/// Parts of a sequence with which a fit starts, in case its ends spoil the whole: a rim, or a foot on the floor.
const SEEDS: [(f64, f64); 4] = [(0.0, 1.0), (0.25, 0.75), (0.0, 0.5), (0.5, 1.0)];

/// Returns the first object that a sequence of sections forms and its range, or the reason why it forms none.
///
/// The first seed that forms an object is fitted again with all surrounding sections that it explains.
fn object(candidate: &Candidate) -> Result<(Object, Range<usize>), Rejection> {
    let mut whole = None;
    for (from, to) in SEEDS {
        let seed = candidate.part(from, to);
        match candidate.only(seed.clone()).and_then(|seed| best(&seed)) {
            Ok((object, solid)) => {
                let (range, inliers) = candidate.inliers(&solid, object.rms, seed);
                let refined = candidate.with(&inliers).and_then(|all| best(&all));
                return Ok((refined.map_or(object, |(refined, _)| refined), range));
            }
            Err(reason) => whole = whole.or(Some(reason)),
        }
    }
    Err(whole.unwrap_or(Rejection::Degenerate))
}

/// Returns the shape that explains the points best, if any does.
///
/// A cone has one parameter more than a cylinder, so that it has to explain the points clearly better than the others.
fn best(candidate: &Candidate) -> Result<(Object, Solid), Rejection> {
    let verified = |body: Body| candidate.verify(&body).map(|object| (object, body.solid));
    let cylinder = axial::fit_cylinder(candidate).and_then(verified);
    let sphere = spherical::fit(candidate).and_then(verified);
    let cone = axial::fit_cone(candidate).and_then(verified);
    better(better(cylinder, sphere, 1.0), cone, candidate.config.profile.cone_gain)
}

/// Returns the second of two if its residual is less than `gain` times that of the first, or if the first is an error.
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
