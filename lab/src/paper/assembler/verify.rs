//! Verifies fitted bodies, and turns them into objects.

use super::parameters::{ProfileConfig, SectionFit};
use super::rejection::{Rejection, Rejections};
use super::sections::Section;
use conicflow_detection::assemble::end_sigma;
use conicflow_geometry::{Conical, Sphere, Surface, Vector3, line_rms, section_about};
use conicflow_messages::{NoiseModel, Object, ObjectKind, ObjectSigma};
use std::ops::Range;

/// Least standard deviation that is reported, in metres and radians.
const LEAST_SIGMA: f64 = 1e-6;

/// Allowed error of the paper's model at the points, in radii: on short arcs its centres are too near by a quarter.
const ELLIPSE_RMS_RADII: f64 = 0.35;

/// Sections worse than the whole by this factor are left out.
const OUTLIER_RMS: f64 = 1.6;

/// The surface of a body: its point is the centre; a sphere has neither axis nor slope.
#[derive(Clone, Copy, Debug)]
pub(super) struct Solid {
    pub shape: ObjectKind,
    pub surface: Conical,
}

impl Solid {
    /// Returns the sum of the squared distances of a section's points, to first order; NaN for a cone on a plane along its axis.
    fn square_sum(&self, section: &Section) -> f64 {
        let Conical { point: center, radius, .. } = self.surface;
        let coefficients = match self.shape {
            ObjectKind::Sphere => Sphere { center, radius }.coefficients(),
            ObjectKind::Cylinder => self.surface.coefficients(),
            ObjectKind::Cone => self.surface.pierced_by(&section.plane).coefficients(),
        };
        let conic = section_about(&coefficients, &section.plane, section.moments.origin());
        let sum = conic.square_sum(&section.moments);
        if sum < 0.0 { 0.0 } else { sum }
    }
}

/// A fitted body.
#[derive(Clone, Copy, Debug)]
pub(super) struct Body {
    pub solid: Solid,
    pub length: f64,
    pub radius_sigma: f64,
    pub half_angle_sigma: f64,
    pub axis_sigma: f64,
    /// Standard error of the centre, across the axis.
    pub across_sigma: f64,
}

/// The sections of one body that passed the tests without a fit.
#[derive(Clone, Copy, Debug)]
pub(super) struct Candidate<'a> {
    sections: &'a [Section],
    members: &'a [usize],
    noise: &'a NoiseModel,
    pub config: &'a ProfileConfig,
}

impl<'a> Candidate<'a> {
    pub fn new(
        sections: &'a [Section],
        members: &'a [usize],
        noise: &'a NoiseModel,
        config: &'a ProfileConfig,
    ) -> Result<Self, Rejection> {
        if members.len() < config.profile.min_rows.max(3) as usize {
            return Err(Rejection::FewRows);
        }
        let candidate = Self { sections, members, noise, config };
        let [first, last] = candidate.ends();
        if candidate.count() < config.profile.min_coverage * f64::from(last.line - first.line + 1) {
            return Err(Rejection::Gaps);
        }
        if candidate.mean(|section| section.arc) < config.profile.min_arc_deg.to_radians() {
            return Err(Rejection::ShortArc);
        }
        if candidate.bulge() < config.profile.min_bulge_sigmas * candidate.noise_sigma() {
            return Err(Rejection::Flat);
        }
        Ok(candidate)
    }

    /// Returns the members between two fractions of the sequence.
    pub fn part(&self, from: f64, to: f64) -> Range<usize> {
        let index = |fraction: f64| (fraction * self.count()).round() as usize;
        index(from)..index(to)
    }

    /// Returns the candidate with a part of its members.
    pub fn only(&self, part: Range<usize>) -> Result<Self, Rejection> {
        self.with(&self.members[part])
    }

    /// Returns the candidate with other members.
    pub fn with(&self, members: &'a [usize]) -> Result<Self, Rejection> {
        Self::new(self.sections, members, self.noise, self.config)
    }

    pub fn sections(&self) -> impl Iterator<Item = &'a Section> {
        self.members.iter().map(|&member| &self.sections[member])
    }

    /// Number of sections.
    pub fn count(&self) -> f64 {
        self.members.len() as f64
    }

    pub fn middle(&self) -> &'a Section {
        &self.sections[self.members[self.members.len() / 2]]
    }

    /// Returns the first and the last section.
    pub fn ends(&self) -> [&'a Section; 2] {
        [self.members[0], self.members[self.members.len() - 1]].map(|member| &self.sections[member])
    }

    /// Returns the mean of a property of the sections.
    pub fn mean(&self, property: impl Fn(&Section) -> f64) -> f64 {
        self.sections().map(property).sum::<f64>() / self.count()
    }

    /// Returns the range of the sections' points along an axis, from `point`.
    pub fn extent(&self, point: &Vector3, axis: &Vector3) -> (f64, f64) {
        let positions = self.ends().map(|section| (section.mean() - point).dot(axis));
        (positions[0].min(positions[1]), positions[0].max(positions[1]))
    }

    /// Returns the object for a body, or the reason to reject it.
    pub fn verify(&self, body: &Body) -> Result<Object, Rejection> {
        let (shape, radius) = (body.solid.shape, body.solid.surface.radius);
        let rms = self.rms(&body.solid);
        if !self.config.common.radii_m(shape).contains(&radius) {
            Err(Rejection::Radius)
        } else if !self.config.common.lengths_m(shape).contains(&body.length) {
            Err(Rejection::Length)
        } else if shape.has_axis() && body.length < self.config.profile.min_length_radii * radius {
            Err(Rejection::Short)
        } else if rms.is_nan() || rms > self.max_rms(radius) {
            Err(Rejection::Rms)
        } else {
            Ok(self.report(body, rms))
        }
    }

    fn max_rms(&self, radius: f64) -> f64 {
        let radii = match self.config.profile.section_fit {
            SectionFit::Ellipse => ELLIPSE_RMS_RADII,
            SectionFit::Circle => self.config.profile.max_rms_radii,
        };
        self.config.profile.max_rms_sigmas * self.noise_sigma() + radii * radius
    }

    /// Returns the root mean square distance of all points from the surface.
    fn rms(&self, solid: &Solid) -> f64 {
        (self.sections().map(|section| solid.square_sum(section)).sum::<f64>() / self.points()).sqrt()
    }

    /// Extends `seed` to both sides by members whose points lie on a surface, given the rms distance of the points to which it
    /// was fitted. Returns the range, and the members in it. Sections that include points of a floor or a neighbour are left out,
    /// and k consecutive ones end the body.
    pub fn inliers(&self, solid: &Solid, rms: f64, seed: Range<usize>) -> (Range<usize>, Vec<usize>) {
        let limit = OUTLIER_RMS * rms;
        let fits = |position: &usize| {
            let section = &self.sections[self.members[*position]];
            solid.square_sum(section) <= limit * limit * section.moments.count()
        };
        let last = reach(seed.start..self.members.len(), self.config.profile.neighbors, fits);
        let first = reach((0..seed.end).rev(), self.config.profile.neighbors, fits);
        let start = first.map_or(seed.start, |first| first.min(seed.start));
        let end = last.map_or(seed.end, |last| seed.end.max(last + 1));
        (start..end, (start..end).filter(fits).map(|position| self.members[position]).collect())
    }

    /// Returns the root mean square distance of the points of each section from a straight line.
    fn bulge(&self) -> f64 {
        let square_sum =
            |section: &Section| line_rms(&section.moments).map_or(0.0, |rms| rms * rms * section.moments.count());
        (self.sections().map(square_sum).sum::<f64>() / self.points()).sqrt()
    }

    /// Returns the standard deviation of the sensor at the depth of the points.
    fn noise_sigma(&self) -> f64 {
        self.noise.sigma(self.mean(|section| section.mean().z))
    }

    fn points(&self) -> f64 {
        self.sections().map(|section| section.moments.count()).sum()
    }

    fn report(&self, body: &Body, rms: f64) -> Object {
        let Solid { shape, surface } = body.solid;
        let object = Object {
            kind: shape.code(),
            points: self.points().round() as u32,
            rows: self.members.len() as u32,
            center: surface.point.into(),
            axis: surface.axis.into(),
            radius: surface.radius,
            length: body.length,
            sigma: self.sigma(body, rms),
            rms,
            arc: self.mean(|section| section.arc),
            ..Object::default()
        };
        if !shape.has_half_angle() {
            return object;
        }
        let end = |along: f64| (surface.radius + surface.slope * along).max(0.0);
        Object {
            half_angle: surface.half_angle(),
            apex: surface.apex().into(),
            top_radius: end(-body.length / 2.0),
            base_radius: end(body.length / 2.0),
            ..object
        }
    }

    /// Returns standard errors from the scatter of centres and radii, at least those that the points allow.
    fn sigma(&self, body: &Body, rms: f64) -> ObjectSigma {
        let floor = (rms / self.points().sqrt()).max(LEAST_SIGMA);
        let middle = self.middle();
        let Solid { shape, surface: Conical { axis, .. } } = body.solid;
        let end = end_sigma(middle.spacing, &middle.plane, &axis);
        let across = body.across_sigma.max(floor).powi(2);
        let along = (end * end / 2.0 + floor * floor - across) * axis.norm();
        let at = |i: usize, j: usize| {
            let diagonal = if i == j { across } else { 0.0 };
            diagonal + along * axis[i] * axis[j]
        };
        let (has_axis, has_half_angle) = (shape.has_axis(), shape.has_half_angle());
        let present = |present: bool, sigma: f64| if present { sigma } else { 0.0 };
        ObjectSigma {
            center: [0, 1, 2].map(|i| [0, 1, 2].map(|j| at(i, j))),
            axis: present(has_axis, body.axis_sigma.max(LEAST_SIGMA)),
            radius: body.radius_sigma.max(floor),
            length: present(has_axis, (2.0 * end * end).sqrt().max(floor)),
            half_angle: present(has_half_angle, body.half_angle_sigma.max(LEAST_SIGMA)),
        }
    }
}

/// Returns the last position that fits before `patience` consecutive ones that do not.
fn reach(positions: impl Iterator<Item = usize>, patience: u32, fits: impl Fn(&usize) -> bool) -> Option<usize> {
    let (mut last, mut misses) = (None, 0);
    for position in positions {
        if fits(&position) {
            (last, misses) = (Some(position), 0);
        } else {
            misses += 1;
            if misses >= patience {
                break;
            }
        }
    }
    last
}

/// Drops objects with their centre inside one with more points: the same object, seen along rows and along columns.
pub(super) fn drop_doubles(objects: &mut Vec<Object>, rejections: &mut Rejections) {
    objects.sort_by_key(|object| std::cmp::Reverse(object.points));
    let mut kept = 0;
    for index in 0..objects.len() {
        let object = objects[index];
        let inside = |other: &Object| distance(&object, other) < 0.5 * other.radius.max(object.radius);
        if objects[..kept].iter().any(inside) {
            rejections.count(Rejection::Double);
        } else {
            objects[kept] = object;
            kept += 1;
        }
    }
    objects.truncate(kept);
}

fn distance(a: &Object, b: &Object) -> f64 {
    (Vector3::from(a.center) - Vector3::from(b.center)).norm()
}
