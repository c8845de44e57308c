//! A region: a model and the arcs that it explains; and what is known of one that was verified.

use super::arcs::{Arc, Arcs};
use super::model::Model;

/// A model and the arcs that it explains, in the order of the lines.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Region<'a> {
    pub arcs: &'a Arcs,
    pub model: Model,
    pub members: &'a [usize],
}

impl<'a> Region<'a> {
    /// Its arcs.
    pub fn arcs(&self) -> impl Iterator<Item = &'a Arc> + Clone + use<'a> {
        self.arcs.of(self.members)
    }

    /// Number of points that share no noise.
    pub fn points(&self) -> f64 {
        self.arcs().map(|arc| arc.points).sum()
    }

    /// Mean variance of a point, in square metres.
    pub fn variance(&self) -> f64 {
        self.arcs().map(|arc| arc.variance * arc.points).sum::<f64>() / self.points()
    }

    /// How many neighbouring lines share their noise, at least 1.
    pub fn shared_lines(&self) -> f64 {
        self.arcs.shared_lines(self.members)
    }

    /// The arcs of the first and the last line.
    pub fn ends(&self) -> [&'a Arc; 2] {
        [self.members[0], self.members[self.members.len() - 1]].map(|index| &self.arcs.arcs[index])
    }

    /// From where to where the arcs reach along the axis, counted from the surface's point; 0 both for a sphere.
    pub fn extent(&self) -> [f64; 2] {
        let along = |arc: &Arc| self.model.conical().map_or(0.0, |s| s.axis.dot(&(arc.mean - s.point)));
        self.arcs().map(along).fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], x| [a.min(x), b.max(x)])
    }
}
