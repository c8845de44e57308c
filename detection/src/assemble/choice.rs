//! Which shape an object has, where more than one explains it.

use super::contours::Contours;
use super::model;
use super::odds::Evidence;
use super::parameters::AssemblerParameters;
use super::region::Region;
use super::rejection::Rejection;
use super::report::{add_flattening, report};
use super::verify::{Candidate, Verified};
use conicflow_messages::{Object, ObjectKind};

/// Two models explain about as many points if the smaller number is at least this part of the larger.
const AS_MANY: f64 = 0.9; // [tuned]
/// Standard deviations by which the half-angle of a cone has to exceed zero.
const SLOPE_SIGMAS: f64 = 3.0; // [sigmas]
/// Least gain of the shape of more parameters, as chi squared: two standard deviations of one parameter.
const GAIN: f64 = 4.0; // [sigmas]
/// Half-angles (5 and 7 degrees) between which the gain that faults of a sensor give a cone over a cylinder falls to nothing.
const SLENDER: [f64; 2] = [0.0873, 0.122]; // [tuned] [tuned]
/// Gain that faults of a sensor give a slender cone over a cylinder, per point.
const GAIN_PER_POINT: f64 = 0.03; // [tuned]
/// Largest gain that faults of a sensor give a slender cone over a cylinder.
const MOST_GAIN: f64 = 20.0; // [tuned]
/// A half-angle with a larger standard deviation (4 degrees) is unknown, so that the object is not surely a cylinder.
const ANY_SLOPE: f64 = 0.07; // [tuned]
/// A half-angle with a larger standard deviation (1.5 degrees) that exceeds zero by [`UNSURE_SIGMAS`] speaks against a
/// cylinder, although it does not show a cone.
const UNSURE_SLOPE: f64 = 0.026; // [tuned]
/// Standard deviations by which such an uncertain half-angle exceeds zero.
const UNSURE_SIGMAS: f64 = 2.0; // [sigmas]

/// The shape that was chosen.
pub(crate) struct Chosen<'a> {
    pub candidate: Candidate<'a>,
    pub object: Object,
    pub evidence: Evidence,
}

/// The candidate that explains most points; of those that explain about as many, the one of fewer parameters, unless
/// the other explains them better. Of the three shapes those are `None` that did not even grow. Where none is left, the
/// reason is that of the most general one that grew.
pub(crate) fn choose<'a>(
    found: Verified<'a>,
    parameters: &AssemblerParameters,
    contours: &mut Contours,
) -> Result<Chosen<'a>, Rejection> {
    let grown = || found.iter().flatten();
    let reason = grown().filter_map(|found| found.as_ref().err()).next_back().copied();
    // Where a cone alone is a candidate, its slope is not sure.
    let reason = reason.unwrap_or(if grown().next().is_some() { Rejection::Taper } else { Rejection::NotGrown });
    let [sphere, cylinder, cone] = found;
    let cone = cone.map(|cone| cone.map(|cone| (cone, report(&cone.region, &cone.measured))));
    let may_be_cone = cone.as_ref().is_some_and(|cone| speaks_against_cylinder(cone.as_ref()));
    let [sphere, cylinder] = [sphere, cylinder].map(|found| found?.ok());
    let taper = cone.as_ref().and_then(|cone| cone.as_ref().ok()).map_or(0.0, |(_, object)| sure_slope(object));
    // A vague cone may still show that a cylinder is none: the choice comes first.
    let cone = cone.and_then(Result::ok).filter(|(_, object)| is_cone(object, parameters)).map(|(cone, _)| cone);
    let axial = match (cylinder, cone) {
        (Some(cylinder), Some(cone)) => Some(better(cylinder, cone, least_gain_of_cone, contours)),
        (cylinder, cone) => cylinder.or(cone),
    };
    let best = match (sphere, axial) {
        (Some(sphere), Some(axial)) => better(sphere, axial, |_, _| GAIN, contours),
        (sphere, axial) => sphere.or(axial).ok_or(reason)?,
    };
    let is_cylinder = best.region.model.kind() == ObjectKind::Cylinder;
    if is_cylinder && may_be_cone {
        return Err(Rejection::Taper);
    }
    let mut object = report(&best.region, &best.measured);
    let evidence = Evidence::of(&best, &object);
    object.confidence = evidence.probability() as f32;
    if is_cylinder {
        object.sigma.axis = object.sigma.axis.hypot(taper);
    }
    // All shapes are flattened alike: that speaks neither for nor against one.
    add_flattening(&mut object, best.region.ends()[0]);
    Ok(Chosen { candidate: best, object, evidence })
}

/// Whether the cone that grew from the same arcs speaks against the cylinder. It does if its half-angle is unknown, if its
/// half-angle may well differ from zero, or if the cone fails as an object although it is free to be a cylinder.
fn speaks_against_cylinder(cone: Result<&(Candidate, Object), &Rejection>) -> bool {
    match cone {
        Ok((cone, object)) => {
            let (sigma, wider) = (object.sigma.half_angle, cone.region.shared_lines().sqrt());
            sigma > wider * ANY_SLOPE || sigma > wider * UNSURE_SLOPE && object.half_angle > UNSURE_SIGMAS * sigma
        }
        Err(Rejection::FewRows | Rejection::Small | Rejection::Tilted) => true,
        Err(_) => false,
    }
}

/// Whether the half-angle of a cone is surely not zero, and large enough for one.
fn is_cone(object: &Object, parameters: &AssemblerParameters) -> bool {
    sure_slope(object) > parameters.pooled.min_half_angle_deg.to_radians()
}

/// The half-angle of a cone if it is surely not zero. The side of what tapers by less than a cone has to leans by it, and the
/// axis of the cylinder that it is called with it.
fn sure_slope(object: &Object) -> f64 {
    if object.half_angle > SLOPE_SIGMAS * object.sigma.half_angle { object.half_angle } else { 0.0 }
}

/// Of two shapes the one that explains more points; where both explain about as many, the one of more parameters only if it
/// explains them better by more than `least_gain` of it and the number of points.
fn better<'a>(
    simple: Candidate<'a>,
    general: Candidate<'a>,
    least_gain: impl Fn(&Candidate, f64) -> f64,
    contours: &mut Contours,
) -> Candidate<'a> {
    let (a, b) = (simple.measured.points, general.measured.points);
    if a < AS_MANY * b {
        return general;
    }
    if b < AS_MANY * a {
        return simple;
    }
    let members = if a > b { simple.region.members } else { general.region.members };
    let mut cost = |candidate: &Candidate| cost(Region { members, ..candidate.region }, contours);
    let gain = cost(&simple).zip(cost(&general)).map_or(0.0, |(simple, general)| simple - general);
    if gain > least_gain(&general, a.max(b)) { general } else { simple }
}

/// Least gain of a cone of so many points over a cylinder.
fn least_gain_of_cone(cone: &Candidate, points: f64) -> f64 {
    let half_angle = cone.region.model.conical().map_or(0.0, |surface| surface.half_angle());
    let slender = 1.0 - ((half_angle - SLENDER[0]) / (SLENDER[1] - SLENDER[0])).clamp(0.0, 1.0);
    GAIN.max(slender * (GAIN_PER_POINT * points).min(MOST_GAIN))
}

/// What is left of the points and the contour of some members by a model that is fitted to these. What it leaves out of
/// the contour counts, too, or it would gain by what it misses.
fn cost(mut region: Region, contours: &mut Contours) -> Option<f64> {
    region.model = model::fit(region.model.kind(), &region.arcs(), Some(&region.model), f64::INFINITY)?;
    let cost = contours.fit(&region, 1)?.cost();
    Some(cost + contours.last().least_left_out())
}
