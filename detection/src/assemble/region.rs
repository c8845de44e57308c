//! A region: a model and the arcs that it explains.

use super::arcs::{Arc, Arcs};
use super::model::Model;
use conicflow_geometry::{GradientNoise, Surface, SurfaceFit, Vector3, section_of};
use std::iter;

/// Number of points along an arc at which its noise is evaluated.
const SAMPLES: usize = 5; // [algorithmic]
/// Approximate number of arcs of an object at which its noise is evaluated.
const ARCS: usize = 16; // [algorithmic]

/// A model and the arcs that it explains, in the order of the lines.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Region<'a> {
    pub arcs: &'a Arcs,
    pub model: Model,
    pub members: &'a [usize],
}

impl<'a> Region<'a> {
    /// Returns its arcs.
    pub fn arcs(&self) -> impl Iterator<Item = &'a Arc> + Clone + use<'a> {
        self.arcs.of(self.members)
    }

    /// Returns the number of independent points along its lines.
    pub fn points(&self) -> f64 {
        self.arcs().map(|arc| arc.points).sum()
    }

    /// Returns the mean variance of a point, in square metres.
    pub fn variance(&self) -> f64 {
        self.arcs().map(|arc| arc.variance * arc.points).sum::<f64>() / self.points()
    }

    /// Returns the number of neighbouring lines that share their noise, at least 1.
    pub fn shared_lines(&self) -> f64 {
        self.arcs.shared_lines(self.members)
    }

    /// Returns the number of neighbouring lines that share the noise of their contour, at least 1.
    pub fn contour_lines(&self) -> f64 {
        self.arcs.contour_lines(self.members)
    }

    /// Returns the scatter of the gradient of a fit due to the noise of its points, from a sample of them.
    pub fn gradient_noise<S: Surface<N>, const N: usize>(&self, fit: &SurfaceFit<S, N>) -> GradientNoise<N> {
        let q = self.model.coefficients();
        let stride = self.members.len().div_ceil(ARCS);
        // Each sampled arc represents this many arcs.
        let times = self.members.len() as f64 / self.members.len().div_ceil(stride) as f64;
        let mut noise = GradientNoise::new(&fit.surface);
        for arc in self.arcs().step_by(stride) {
            let weight = self.model.weight(arc);
            let along_z = arc.variance / arc.plane.stretch().powi(2);
            let section = section_of(&q, &arc.plane);
            let share = times * self.shared_lines() * arc.points / SAMPLES as f64;
            for sample in 0..SAMPLES {
                let part = (sample as f64 + 0.5) / SAMPLES as f64;
                let x = arc.rays[0] + part * (arc.rays[1] - arc.rays[0]);
                if let Some(z) = arc.hit(&section, x) {
                    noise.add(&arc.point(x, z), share * weight * weight * along_z);
                }
            }
        }
        noise
    }

    /// Returns the arcs of the first and the last line.
    pub fn ends(&self) -> [&'a Arc; 2] {
        [self.members[0], self.members[self.members.len() - 1]].map(|index| &self.arcs.arcs[index])
    }

    /// Returns the arcs beyond its first line (`side` -1) or its last (1), line by line: none is a member, and each touches the
    /// one before it, over at most `gap` lines.
    pub fn beyond(&self, side: i64, gap: i64) -> impl Iterator<Item = &'a Arc> + use<'a> {
        let Self { arcs, members, .. } = *self;
        let end = members[if side < 0 { 0 } else { members.len() - 1 }];
        let is_other = |arc: usize| members.binary_search(&arc).is_err();
        let chain = iter::successors(Some(end), move |&at| arcs.beside(at, side, gap, is_other));
        chain.skip(1).map(|index| &arcs.arcs[index])
    }

    /// Returns the position of a point along the axis, from the surface's point; 0 for a sphere.
    pub fn along(&self, point: &Vector3) -> f64 {
        let (origin, axis) = self.model.axis();
        axis.dot(&(point - origin))
    }

    /// Returns the interval along the axis in which the means of its arcs lie.
    pub fn span_of_means(&self) -> [f64; 2] {
        self.arcs()
            .map(|arc| self.along(&arc.mean))
            .fold([f64::INFINITY, f64::NEG_INFINITY], |[a, b], x| [a.min(x), b.max(x)])
    }
}

#[cfg(test)]
mod tests {
    use super::super::model;
    use super::super::tests::{arcs_of, rows_of};
    use super::*;
    use conicflow_lab::rendered::cylinder;
    use conicflow_messages::ObjectKind;

    #[test]
    fn places_along_an_axis_are_counted_from_the_point_of_the_surface_and_a_sphere_has_none() {
        let arcs = arcs_of(&[cylinder(Vector3::z() * 2.0, Vector3::y(), 0.2, 0.7)]);
        let members = rows_of(&arcs, |_| true);
        let of = |kind: ObjectKind, along: f64| {
            let model = model::fit(kind, &arcs.of(&members), None, f64::INFINITY).unwrap();
            let region = Region { arcs: &arcs, model, members: &members };
            let point = model.conical().map_or(Vector3::zeros(), |can| can.point + can.axis * along);
            region.along(&point)
        };
        assert!((of(ObjectKind::Cylinder, 0.3) - 0.3).abs() < 1e-12 && of(ObjectKind::Sphere, 0.3) == 0.0);
    }
}
