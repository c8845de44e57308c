//! Ellipses -> objects: single ellipses may be wrong.
//!
//! The files in the order of the steps: the arcs with the moments of their points ([`arcs`]); the order in which they are tried
//! ([`seeds`]); the growth of a model from one arc over the lines ([`growth`]), with the three models and their fits ([`model`]),
//! the arcs that they explain ([`region`]) and their contours ([`contours`]); the requirements on an object ([`verify`]), and
//! whether it is round at all ([`round`]); the choice of its shape ([`choice`]); its report ([`report`]); the probability that it
//! is an object ([`odds`]), and whether another object is in its place ([`place`]); and the reasons for which candidates are
//! rejected ([`rejection`]). `Assembler::assemble` in `method.rs` puts the steps together.

pub(crate) mod arcs;
pub(crate) mod choice;
pub(crate) mod contours;
pub(crate) mod growth;
mod model;
pub mod odds;
mod parameters;
pub(crate) mod place;
mod region;
mod rejection;
mod report;
mod round;
pub(crate) mod seeds;
#[cfg(test)]
mod tests;
pub(crate) mod verify;

pub use contours::{ContourErrors, SideErrors};
pub use parameters::{AssemblerParameters, AxialLimits, PooledParameters, RadiusLimits};
pub(crate) use rejection::{Rejection, Rejections};
pub use report::end_sigma;

use arcs::Arcs;
use conicflow_messages::Object;
use contours::ContourCalibration;
use growth::RegionGrower;
use odds::Evidence;
use seeds::Seeds;

/// Finds the objects in lists of ellipses, those of one image of a sensor after another. Later images benefit from the errors of
/// contours that objects showed (`contour_memory`). Its buffers are used again for the next list.
#[derive(Debug)]
pub struct Assembler {
    pub(crate) parameters: AssemblerParameters,
    pub(crate) arcs: Arcs,
    pub(crate) seeds: Seeds,
    pub(crate) grower: RegionGrower,
    pub(crate) contours: ContourCalibration,
    pub(crate) objects: Vec<Object>,
    pub(crate) candidates: Vec<(Object, Evidence)>,
    pub(crate) rejections: Rejections,
}

impl Assembler {
    /// Creates an assembler with these parameters.
    pub fn new(parameters: AssemblerParameters) -> Self {
        Self {
            parameters,
            arcs: Arcs::default(),
            seeds: Seeds::default(),
            grower: RegionGrower::default(),
            contours: ContourCalibration::default(),
            objects: Vec::new(),
            candidates: Vec::new(),
            rejections: Rejections::default(),
        }
    }

    /// Returns all candidates of the last image, reported or not, with the evidence for and against each.
    pub fn candidates(&self) -> &[(Object, Evidence)] {
        &self.candidates
    }

    /// Returns the errors of contours that objects have shown so far, in rows and in columns.
    pub fn contour_errors(&self) -> impl Iterator<Item = ContourErrors> {
        self.contours.errors()
    }

    /// Returns the reasons for which candidates of the last image were rejected, with their numbers.
    pub fn rejections(&self) -> impl Iterator<Item = (&'static str, u64)> {
        self.rejections.iter()
    }
}
