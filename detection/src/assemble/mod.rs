//! Ellipses -> objects: no ellipse has to be right on its own.
//!
//! The files stand in the order of the steps: the arcs with the moments of their points ([`arcs`]); which of them are tried first
//! ([`seeds`]); how a model grows from one over the lines ([`growth`]), with the three models and their fits ([`model`]), what
//! they explain ([`region`]) and the contours that they show ([`contours`]); what an object has to fulfil as a whole
//! ([`verify`]), with whether it is round at all ([`round`]); which of the shapes it is ([`choice`]); what is told of it
//! ([`report`]); how probable it is that it is one ([`odds`]), and whether it is in the place of another ([`place`]); and why
//! candidates are turned down ([`rejection`]). The walk itself is `Assembler::assemble` in `method.rs`.

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
use contours::Contours;
use growth::Growing;
use odds::Evidence;
use seeds::Seeds;

/// Finds the objects in lists of ellipses, those of one image of a sensor after another: what objects show of where this sensor
/// puts contours is used for the next ones (`contour_memory`). Its buffers are used again for the next list.
#[derive(Debug)]
pub struct Assembler {
    pub(crate) parameters: AssemblerParameters,
    pub(crate) arcs: Arcs,
    pub(crate) seeds: Seeds,
    pub(crate) growing: Growing,
    pub(crate) contours: Contours,
    pub(crate) objects: Vec<Object>,
    pub(crate) candidates: Vec<(Object, Evidence)>,
    pub(crate) rejections: Rejections,
}

impl Assembler {
    /// An assembler with these parameters.
    pub fn new(parameters: AssemblerParameters) -> Self {
        Self {
            parameters,
            arcs: Arcs::default(),
            seeds: Seeds::default(),
            growing: Growing::default(),
            contours: Contours::default(),
            objects: Vec::new(),
            candidates: Vec::new(),
            rejections: Rejections::default(),
        }
    }

    /// All candidates of the last image, reported or not, with what spoke for each and against it.
    pub fn candidates(&self) -> &[(Object, Evidence)] {
        &self.candidates
    }

    /// By how much contours are off, as objects showed it so far: in rows, and in columns.
    pub fn contour_errors(&self) -> impl Iterator<Item = ContourErrors> {
        self.contours.errors()
    }

    /// Why candidates of the last image were turned down, and how many of them.
    pub fn rejections(&self) -> impl Iterator<Item = (&'static str, u64)> {
        self.rejections.iter()
    }
}
