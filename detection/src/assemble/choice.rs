//! Chooses the shape of an object where several shapes explain it.

use super::contours::ContourCalibration;
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
/// Fewest standard deviations by which the half-angle of a cone has to exceed zero.
const SURE_SIGMAS: f64 = 3.0; // [sigmas]
/// Least gain of the shape with more parameters, as chi squared: two standard deviations of one parameter.
const MIN_GAIN: f64 = 4.0; // [sigmas]
/// Least gain per point, in variances: surfaces and sensors are not exact, and favour one of two shapes a little at each point.
const MIN_GAIN_PER_POINT: f64 = 0.01; // [tuned]
/// Standard deviation of a half-angle, in radians (4 degrees), beyond which it is unknown, so that the object is not surely a
/// cylinder.
const UNKNOWN_HALF_ANGLE: f64 = 0.07; // [tuned]
/// Standard deviation of a half-angle, in radians (1.5 degrees), beyond which a half-angle that exceeds zero by [`UNSURE_SIGMAS`]
/// speaks against a cylinder, although it does not show a cone.
const UNSURE_HALF_ANGLE: f64 = 0.026; // [tuned]
/// Standard deviations by which a half-angle with a sigma above [`UNSURE_HALF_ANGLE`] has to exceed zero to speak against a
/// cylinder.
const UNSURE_SIGMAS: f64 = 2.0; // [sigmas]

/// The chosen shape.
pub(crate) struct Chosen<'a> {
    pub candidate: Candidate<'a>,
    pub object: Object,
    pub evidence: Evidence,
}

/// Chooses the candidate that explains most points; of those that explain about as many, the one with fewer parameters, unless
/// the other explains them better.
pub(crate) fn choose<'a>(
    found: Verified<'a>,
    parameters: &AssemblerParameters,
    contours: &mut ContourCalibration,
) -> Result<Chosen<'a>, Rejection> {
    let reason = reason_without_shape(&found);
    let [sphere, cylinder, cone] = found;
    let cone = cone.map(|cone| (cone, report(&cone.region, &cone.measured)));
    let may_be_cone = speaks_against_cylinder(cone.as_ref());
    let [sphere, cylinder] = [sphere, cylinder].map(Result::ok);
    let taper = cone.as_ref().map_or(0.0, |(_, object)| sure_half_angle(object));
    // A cone with an uncertain half-angle may still rule out a cylinder, so the choice comes first.
    let cone = cone.ok().filter(|(_, object)| is_cone(object, parameters)).map(|(cone, _)| cone);
    let axial = match (cylinder, cone) {
        (Some(cylinder), Some(cone)) => Some(better(cylinder, cone, contours)),
        (cylinder, cone) => cylinder.or(cone),
    };
    let best = match (sphere, axial) {
        (Some(sphere), Some(axial)) => better(sphere, axial, contours),
        (sphere, axial) => sphere.or(axial).ok_or(reason)?,
    };
    let is_cylinder = best.region.model.kind() == ObjectKind::Cylinder;
    if is_cylinder && may_be_cone {
        return Err(Rejection::Taper);
    }
    let mut object = report(&best.region, &best.measured);
    let evidence = Evidence::of(&best, &object, parameters.max_gap());
    object.confidence = evidence.probability() as f32;
    if is_cylinder {
        object.sigma.axis = object.sigma.axis.hypot(taper);
    }
    // All shapes are flattened alike, so flattening is no evidence for or against one.
    add_flattening(&mut object, best.region.ends()[0]);
    Ok(Chosen { candidate: best, object, evidence })
}

/// Returns the reason if none of the shapes is chosen: that of the most general shape that grew.
fn reason_without_shape(found: &Verified) -> Rejection {
    let mut reasons = found.iter().filter_map(|found| found.as_ref().err()).copied();
    // A cone that is the only candidate was not chosen because its half-angle is uncertain.
    let alone = if found.iter().any(Result::is_ok) { Rejection::Taper } else { Rejection::NotGrown };
    reasons.rfind(|reason| *reason != Rejection::NotGrown).unwrap_or(alone)
}

/// Returns whether the cone that grew from the same arcs speaks against the cylinder: if its half-angle is unknown, if its
/// half-angle may well differ from zero, or if the cone fails as an object although it could be a cylinder.
fn speaks_against_cylinder(cone: Result<&(Candidate, Object), &Rejection>) -> bool {
    match cone {
        Ok((cone, object)) => {
            let (sigma, wider) = (object.sigma.half_angle, cone.region.shared_lines().sqrt());
            sigma > wider * UNKNOWN_HALF_ANGLE
                || sigma > wider * UNSURE_HALF_ANGLE && object.half_angle > UNSURE_SIGMAS * sigma
        }
        Err(Rejection::FewLines | Rejection::Small | Rejection::Tilted) => true,
        Err(_) => false,
    }
}

/// Returns whether the half-angle of a cone is surely not zero, and large enough.
fn is_cone(object: &Object, parameters: &AssemblerParameters) -> bool {
    sure_half_angle(object) > parameters.pooled.min_half_angle_deg.to_radians()
}

/// Returns the half-angle of a cone if it is surely not zero, else 0. An object that tapers too little for a cone is reported as
/// a cylinder: its side leans by this angle, and so may its axis.
fn sure_half_angle(object: &Object) -> f64 {
    if object.half_angle > SURE_SIGMAS * object.sigma.half_angle { object.half_angle } else { 0.0 }
}

/// Returns the shape that explains more points; if both explain about as many, the one with more parameters only if it is surely
/// better.
fn better<'a>(simple: Candidate<'a>, general: Candidate<'a>, contours: &mut ContourCalibration) -> Candidate<'a> {
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
    if gain > MIN_GAIN.max(MIN_GAIN_PER_POINT * a.max(b)) { general } else { simple }
}

/// Returns the residual cost of the points and the contour of some members for a model that is fitted to them. Contour points
/// that the model leaves out count, too, or it would gain by missing them.
fn cost(mut region: Region, contours: &mut ContourCalibration) -> Option<f64> {
    region.model = model::fit(region.model.kind(), &region.arcs(), Some(&region.model), f64::INFINITY)?;
    let (model, contour) = contours.fit(&region)?;
    Some(model.cost() + contour.least_left_out())
}

#[cfg(test)]
mod tests {
    use super::super::arcs::Arcs;
    use super::super::tests::{arcs_of, wall};
    use super::super::verify::{Measured, Outline};
    use super::*;
    use conicflow_geometry::{Scan, Vector3};
    use conicflow_lab::rendered::frustum;
    use conicflow_lab::simulator::shapes::Shape;
    use conicflow_messages::ObjectSigma;

    /// The arcs of a body that stands upright at a distance of two metres, and the indices of those in rows of its middle.
    fn upright(slope: f64) -> (Arcs, Vec<usize>) {
        upright_before(&[], slope)
    }

    /// The arcs of such an upright body together with other bodies, and the indices of those in rows of its middle.
    fn upright_before(others: &[Shape], slope: f64) -> (Arcs, Vec<usize>) {
        let center = Vector3::new(0.0, 0.0, 2.0);
        let body = frustum(center, Vector3::y(), 0.2, slope, 0.7);
        let arcs = arcs_of(&[&[body], others].concat());
        let is_near = |mean: &Vector3| mean.z < 2.5 && mean.y.abs() < 0.25;
        let is_of_it = |&index: &usize| arcs.arcs[index].scan == Scan::Row && is_near(&arcs.arcs[index].mean);
        let members = (0..arcs.arcs.len()).filter(is_of_it).collect();
        (arcs, members)
    }

    /// A candidate with this number of points.
    fn candidate<'a>(arcs: &'a Arcs, members: &'a [usize], kind: ObjectKind, points: f64) -> Candidate<'a> {
        let model = model::fit(kind, &arcs.of(members), None, f64::INFINITY).unwrap();
        let (count, lines, angle, extent) = (points as u32, members.len() as u32, 2.0, [-0.25, 0.25]);
        let measured =
            Measured { count, points, lines, variance: 1e-6, residual: 0.0, curvature: 100.0, angle, extent };
        let outline = Outline { square: 1.0, far_off: 0.0, free: 1.0 };
        Candidate { region: Region { arcs, model, members }, measured, outline, roundness: 0.0 }
    }

    #[test]
    fn the_shape_of_more_points_is_chosen_and_of_about_as_many_the_one_that_explains_them_better() {
        let chosen = |slope: f64, points: [f64; 2]| {
            let (arcs, members) = upright(slope);
            let [simple, general] = [(ObjectKind::Cylinder, points[0]), (ObjectKind::Cone, points[1])]
                .map(|(kind, points)| candidate(&arcs, &members, kind, points));
            better(simple, general, &mut ContourCalibration::default()).region.model.kind()
        };
        assert_eq!(chosen(0.0, [899.0, 1000.0]), ObjectKind::Cone);
        assert_eq!(chosen(0.2, [1000.0, 899.0]), ObjectKind::Cylinder);
        for points in [[901.0, 1000.0], [1000.0, 901.0], [1000.0, 1000.0]] {
            assert_eq!(chosen(0.2, points), ObjectKind::Cone);
            assert_eq!(chosen(0.0, points), ObjectKind::Cylinder, "it gains too little");
        }
    }

    #[test]
    fn a_shape_of_more_parameters_has_to_gain_four_and_of_many_points_a_hundredth_of_each() {
        let (mut arcs, members) = upright(0.06);
        let is_cone = |arcs: &Arcs, points: f64| {
            let [simple, general] =
                [ObjectKind::Cylinder, ObjectKind::Cone].map(|kind| candidate(arcs, &members, kind, points));
            better(simple, general, &mut ContourCalibration::default()).region.model.kind() == ObjectKind::Cone
        };
        let gain = |arcs: &Arcs| {
            let [simple, general] = [ObjectKind::Cylinder, ObjectKind::Cone].map(|kind| {
                let model = model::fit(kind, &arcs.of(&members), None, f64::INFINITY).unwrap();
                cost(Region { arcs, model, members: &members }, &mut ContourCalibration::default()).unwrap()
            });
            simple - general
        };
        let of_many = gain(&arcs);
        assert!(of_many > 2.0 * MIN_GAIN, "{of_many}");
        assert_eq!([99.0, 101.0].map(|times| is_cone(&arcs, times * of_many)), [true, false]);
        // The noise is scaled so that the cone gains slightly less than the limit, or slightly more.
        for (least, will_do) in [(3.8, false), (4.2, true)] {
            for _ in 0..8 {
                let louder = gain(&arcs) / least;
                arcs.arcs.iter_mut().for_each(|arc| arc.variance *= louder);
            }
            assert!((gain(&arcs) - least).abs() < 0.1, "{} {least}", gain(&arcs));
            assert_eq!(is_cone(&arcs, 100.0), will_do, "{least}");
        }
    }

    /// The gate is at 3.5 standard deviations. A cylinder is near a part of the contour of a cone, and would gain by the points
    /// that it misses.
    #[test]
    fn each_point_of_the_contour_that_a_shape_is_far_from_costs_as_much_as_one_at_the_gate() {
        let (arcs, members) = upright_before(&[wall(4.0)], 0.3);
        for (kind, least, most) in [(ObjectKind::Cylinder, 30, 60), (ObjectKind::Cone, 0, 0)] {
            let region = candidate(&arcs, &members, kind, 1000.0).region;
            let mut contours = ContourCalibration::default();
            let (model, contour) = contours.fit(&region).unwrap();
            let (near, far_off) = (model.cost(), contour.far_off());
            let times = region.shared_lines() / region.contour_lines();
            assert!((least..=most).contains(&far_off), "{kind:?}: {far_off}");
            let expected = near + 3.5_f64.powi(2) * far_off as f64 * times;
            let cost = cost(region, &mut ContourCalibration::default()).unwrap();
            assert!((cost - expected).abs() < 1e-3 * expected.abs(), "{kind:?}: {cost} {expected}");
        }
    }

    #[test]
    fn a_half_angle_that_is_unknown_or_may_well_differ_from_zero_speaks_against_a_cylinder() {
        let (mut arcs, members) = upright(0.0);
        let mut speaks = |half_angle: f64, sigma: f64, shared_lines: f64| {
            arcs.arcs.iter_mut().for_each(|arc| arc.shared_lines = shared_lines);
            let sigma = ObjectSigma { half_angle: sigma, ..ObjectSigma::default() };
            let object = Object { half_angle, sigma, ..Object::default() };
            speaks_against_cylinder(Ok(&(candidate(&arcs, &members, ObjectKind::Cone, 1000.0), object)))
        };
        // Where four lines share their noise, the standard deviation of a half-angle is twice as large.
        for (shared_lines, wider) in [(1.0, 1.0), (4.0, 2.0)] {
            let (unsure, unknown) = (0.027 * wider, 0.071 * wider);
            assert!(speaks(0.0, unknown, shared_lines) && !speaks(0.0, 0.069 * wider, shared_lines));
            assert!(speaks(2.1 * unsure, unsure, shared_lines) && !speaks(1.9 * unsure, unsure, shared_lines));
            let sure = 0.025 * wider;
            assert!(!speaks(2.1 * sure, sure, shared_lines));
        }
    }

    #[test]
    fn a_half_angle_is_sure_beyond_three_sigmas_and_a_cone_has_the_least_half_angle() {
        let of = |half_angle: f64, sigma: f64| {
            let sigma = ObjectSigma { half_angle: sigma, ..ObjectSigma::default() };
            let object = Object { half_angle, sigma, ..Object::default() };
            (sure_half_angle(&object), is_cone(&object, &AssemblerParameters::default()))
        };
        assert_eq!([of(0.76, 0.25), of(0.75, 0.25)], [(0.76, true), (0.0, false)]);
        let least = 2.5_f64.to_radians();
        assert_eq!([of(1.01 * least, 0.001).1, of(0.99 * least, 0.001).1], [true, false]);
        let mut parameters = AssemblerParameters::default();
        parameters.pooled.min_half_angle_deg = 0.0;
        let unsure = ObjectSigma { half_angle: 0.1, ..ObjectSigma::default() };
        let vague = Object { half_angle: 0.2, sigma: unsure, ..Object::default() };
        assert!(!is_cone(&vague, &parameters), "where any half-angle will do, it is a sure one nevertheless");
    }

    #[test]
    fn where_nothing_is_left_the_reason_is_that_of_the_most_general_shape_that_grew() {
        let reason = |reasons: [Rejection; 3]| {
            let found = reasons.map(Err);
            choose(found, &AssemblerParameters::default(), &mut ContourCalibration::default()).err()
        };
        use Rejection::{Gaps, NotGrown, Radius, Short};
        for (reasons, expected) in [
            ([Gaps, Radius, Short], Short),
            ([Gaps, Radius, NotGrown], Radius),
            ([Gaps, NotGrown, NotGrown], Gaps),
            ([NotGrown; 3], NotGrown),
        ] {
            assert_eq!(reason(reasons), Some(expected), "{reasons:?}");
        }
    }

    /// A slight taper shows in many lines, but not in a few.
    #[test]
    fn shapes_of_about_as_many_points_are_compared_by_the_members_of_the_one_of_more() {
        let (arcs, all) = upright(0.06);
        let few = &all[all.len() / 2 - 3..][..6];
        let chosen = |simple: (&[usize], f64), general: (&[usize], f64)| {
            let of = |kind: ObjectKind, (members, points)| Candidate {
                region: Region { members, ..candidate(&arcs, &all, kind, points).region },
                ..candidate(&arcs, &all, kind, points)
            };
            let [simple, general] = [of(ObjectKind::Cylinder, simple), of(ObjectKind::Cone, general)];
            better(simple, general, &mut ContourCalibration::default()).region.model.kind()
        };
        for (lesser, greater, expected) in [(few, &all[..], ObjectKind::Cone), (&all, few, ObjectKind::Cylinder)] {
            assert_eq!(chosen((greater, 100.0), (lesser, 95.0)), expected);
            assert_eq!(chosen((lesser, 95.0), (greater, 100.0)), expected);
        }
    }
}
