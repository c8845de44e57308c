//! What a grown model has to fulfil as a whole to be an object.

use super::arcs::{Arc, Arcs};
use super::model::{self, Model};
use super::parameters::AssemblerParameters;
use super::region::Region;
use super::rejection::Rejection;
use super::report::spacing_along;
use conicflow_geometry::{Contour, Scan, Sphere, Vector3, section_of};
use conicflow_messages::{Object, ObjectKind};

/// Number of fits to the contour. Each uses the contour points that are near the contour of the last fit.
const CONTOUR_PASSES: usize = 2; // [algorithmic]
/// The mean square residual of an object may exceed zero by so many of its standard deviations.
const SCATTER: f64 = 1.0; // [sigmas]
/// Pixels at each end of an arc that do not count for the extent: they may belong to a lid or to the floor.
const UNSURE_PX: f64 = 2.0; // [tuned]
/// Slack of the mean square residual of an object on top of its scatter, in variances.
const SLACK: f64 = 0.07; // [tuned]
/// Further slack of the mean square residual of an object of [`MANY_POINTS`], which shows the faults of sensor and surface.
const MORE_SLACK: f64 = 0.1; // [tuned]
/// Number of points from which on an object gets all of [`MORE_SLACK`] and [`MORE_DEFORMED_SLACK`]; fewer get a part.
const MANY_POINTS: f64 = 3000.0; // [tuned]
/// The slack is at most that of a surface that is off by this part of its radius. In much noise this tells a square post from
/// a can.
const UNEVEN: f64 = 0.04; // [tuned]
/// Largest gain of another quadric over the model that noise alone explains, as chi squared.
const DEFORMED: f64 = 10.0; // [sigmas]
/// Slack of that gain, in variances per point.
const DEFORMED_SLACK: f64 = 0.03; // [tuned]
/// Further slack of that gain for an object of [`MANY_POINTS`], in variances per point: real sensors bend what is far.
const MORE_DEFORMED_SLACK: f64 = 0.5; // [tuned]
/// Least mean square residual of a plane through the points of an object, in variances.
const PLANE: f64 = 0.05; // [tuned]
/// Largest part of the arc ends beyond which something is seen where the model would hide it.
const SEEN_THROUGH: f64 = 0.2; // [tuned]
/// Largest mean square residual of the contour, in variances of a contour point.
const OUTLINE: f64 = 1.7; // [tuned]
/// The mean square residual of the contour may exceed [`OUTLINE`] by so many standard deviations.
const OUTLINE_SCATTER: f64 = 2.0; // [sigmas]
/// Largest part of the contour points that may be far off the contour, and so belong to something else.
const OTHERS: f64 = 0.35; // [tuned]
/// Fewest contour points of which that part is asked.
const FEWEST_TELLING: usize = 8; // [algorithmic]
/// If at least this part of the arc ends is followed by something farther or by nothing, enough of the outline is seen.
const LEAST_OUTLINE: f64 = 0.2; // [tuned]
/// If less of the outline is seen: largest part of the arc ends that may be hidden by something nearer.
const MOST_HIDDEN: f64 = 0.2; // [tuned]
/// A neighbour is nearer if it is so by more than so many standard deviations and a slope of one.
const NEARER: f64 = 4.0; // [sigmas]
/// Largest cosine between the axis and the scan lines: that of 40 degrees.
const ALONG_LINES: f64 = 0.766; // [tuned]
/// Largest cosine between the axis and the view: that of 25 degrees.
const ALONG_VIEW: f64 = 0.906; // [tuned]
/// Largest standard deviations of the radius of a sphere, as a part of it, and of its axis, which it has not.
const VAGUE_SPHERE: [f64; 2] = [0.03, f64::INFINITY]; // [tuned]
/// Largest standard deviations of the radius of a cylinder, as a part of it, and of its axis (1.5 degrees).
const VAGUE_CYLINDER: [f64; 2] = [0.05, 0.0262]; // [tuned] [tuned]
/// Largest standard deviations of the radius of a cone, as a part of it, and of its axis (3 degrees).
const VAGUE_CONE: [f64; 2] = [0.12, 0.0524]; // [tuned] [tuned]
/// Largest standard deviation of an axis of which less than one radius of length is seen: 1.2 degrees.
const VAGUE_SHORT_AXIS: f64 = 0.0209; // [tuned]

/// What was measured of a grown model, for its report.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Measured {
    /// Number of points.
    pub count: u32,
    /// Effective number of points, whose noise is independent.
    pub points: f64,
    pub lines: u32,
    /// Mean variance of a point, in square metres.
    pub variance: f64,
    /// Mean square distance over variance, free of noise.
    pub misfit: f64,
    /// Mean visible circumference.
    pub angle: f64,
    /// From where to where the arcs and half a line beyond them reach along the axis, counted from the surface's point; of a
    /// sphere across the scan lines, along y of the camera frame for rows and x for columns.
    pub extent: [f64; 2],
}

/// A region that was verified.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Candidate<'a> {
    pub region: Region<'a>,
    pub measured: Measured,
}

/// What became of the shapes that grew: sphere, cylinder and cone; none where the shape did not even grow.
pub(crate) type Verified<'a> = [Option<Result<Candidate<'a>, Rejection>>; 3];

/// Verifies what grew of each shape.
pub(crate) fn verify_all<'a>(
    arcs: &'a Arcs,
    models: [Option<Model>; 3],
    members: &'a [Vec<usize>; 3],
    parameters: &AssemblerParameters,
    contour: &mut Contour,
) -> Verified<'a> {
    std::array::from_fn(|kind| {
        let region = Region { arcs, model: models[kind]?, members: &members[kind] };
        Some(verify(region, parameters, contour))
    })
}

/// What has region, fitted together with its contour, if it is an object.
fn verify<'a>(
    mut region: Region<'a>,
    parameters: &AssemblerParameters,
    contour: &mut Contour,
) -> Result<Candidate<'a>, Rejection> {
    let measured = check(&region, parameters)?;
    if is_plane(&region, &measured) {
        return Err(Rejection::Flat);
    }
    if goes_on(&region, parameters.max_gap()) {
        return Err(Rejection::Part);
    }
    if let Some(model) = model::with_contour(&region, CONTOUR_PASSES, contour) {
        if has_other_outline(&model, contour) {
            return Err(Rejection::Outline);
        }
        region.model = model;
    }
    Ok(Candidate { region, measured: check(&region, parameters)? })
}

fn check(region: &Region, parameters: &AssemblerParameters) -> Result<Measured, Rejection> {
    let measured = measure(region);
    let [first, last] = region.ends();
    let radius = region.model.radius_at(&middle(region, &measured));
    let reach = measured.extent[1] - measured.extent[0];
    if measured.lines < parameters.pooled.min_lines {
        Err(Rejection::FewRows)
    } else if height_in_view(region) < parameters.pooled.min_view_deg.to_radians() {
        Err(Rejection::Small)
    } else if f64::from(measured.lines) < parameters.pooled.min_coverage * f64::from(last.line - first.line + 1) {
        Err(Rejection::Gaps)
    } else if measured.misfit > most_misfit(&measured, radius) {
        Err(Rejection::Rms)
    } else if let Some(reason) = parameters.wrong_size(region.model.kind(), radius, reach) {
        Err(reason)
    } else if !is_sharp(region, parameters) {
        Err(Rejection::HalfAngle)
    } else if reach < least_reach(region, parameters) * radius {
        Err(Rejection::Short)
    } else if runs_along(region, &measured) {
        Err(Rejection::Tilted)
    } else if measured.angle < parameters.pooled.min_arc_deg.to_radians() {
        Err(Rejection::ShortArc)
    } else if is_between_others(region) {
        Err(Rejection::Between)
    } else if seen_through(region, &measured) > SEEN_THROUGH {
        Err(Rejection::SeenThrough)
    } else {
        Ok(measured)
    }
}

/// Visual angle across the scan lines, in radians.
fn height_in_view(region: &Region) -> f64 {
    let [first, last] = region.ends();
    f64::from(last.line - first.line + 1) * first.spacing / first.mean.z
}

/// Greatest misfit of an object, in variances.
fn most_misfit(measured: &Measured, radius: f64) -> f64 {
    let &Measured { count, points, variance, .. } = measured;
    let slack = SLACK + MORE_SLACK * share_of_many(count);
    slack.min((UNEVEN * radius).powi(2) / variance) + SCATTER * (2.0 / points).sqrt()
}

fn share_of_many(count: u32) -> f64 {
    (f64::from(count) / MANY_POINTS).min(1.0)
}

/// Whether another quadric explains the points surely better: an ellipsoid, an oval pillar, or the edge of a box.
pub(super) fn is_deformed(region: &Region, measured: &Measured) -> bool {
    let slack = DEFORMED_SLACK + MORE_DEFORMED_SLACK * share_of_many(measured.count);
    let most = DEFORMED * region.shared_lines() + measured.points * slack;
    model::deformation_gain(region).is_some_and(|gain| gain > most)
}

/// Whether the axis lies so nearly along the scan lines that these hardly show the curvature, or so nearly along the view
/// that this hardly shows the side.
fn runs_along(region: &Region, measured: &Measured) -> bool {
    let [arc, _] = region.ends();
    let (along, view) = (arc.plane.s_axis(), middle(region, measured).normalize());
    region.model.conical().is_some_and(|surface| {
        surface.axis.dot(&along).abs() > ALONG_LINES || surface.axis.dot(&view).abs() > ALONG_VIEW
    })
}

/// Least extent of what is seen, in radii.
fn least_reach(region: &Region, parameters: &AssemblerParameters) -> f64 {
    match region.model {
        Model::Sphere(_) => parameters.pooled.min_cap_radii,
        _ => parameters.pooled.min_length_radii,
    }
}

fn is_sharp(region: &Region, parameters: &AssemblerParameters) -> bool {
    match &region.model {
        Model::Cone(fit) => fit.surface.0.slope <= parameters.max_half_angle_deg.to_radians().tan(),
        _ => true,
    }
}

/// The point of the axis in the middle of what is seen, or the centre.
pub(super) fn middle(region: &Region, measured: &Measured) -> Vector3 {
    match &region.model {
        Model::Sphere(fit) => fit.surface.center,
        other => other.conical().map_or(Vector3::zeros(), |surface| {
            surface.point + surface.axis * (0.5 * (measured.extent[0] + measured.extent[1]))
        }),
    }
}

fn measure(region: &Region) -> Measured {
    let points = region.points();
    let (mut lines, mut count) = (0, 0);
    let mut last = None;
    let (mut angle, mut extent) = (0.0, [f64::INFINITY, f64::NEG_INFINITY]);
    let q = region.model.coefficients();
    for arc in region.arcs() {
        lines += u32::from(last != Some(arc.line));
        last = Some(arc.line);
        count += arc.count;
        let section = section_of(&q, &arc.plane);
        let hit = |x: f64| arc.hit(&section, x).map(|z| arc.point(x, z));
        angle += arc.points * span(arc, region, arc.rays.map(hit));
        let inset = UNSURE_PX * arc.pitch / arc.mean.z;
        let sure = [arc.rays[0] + inset, arc.rays[1] - inset].map(hit);
        for point in sure.into_iter().flatten().chain([arc.mean]) {
            let along = match (&region.model, arc.scan) {
                (Model::Sphere(_), Scan::Column) => point.x,
                (model, _) => position(model, &point),
            };
            extent = [extent[0].min(along), extent[1].max(along)];
        }
    }
    let half_line = region.model.conical().map_or(0.0, |surface| {
        let first = region.ends()[0];
        0.5 * spacing_along(first.spacing, &first.plane, &surface.axis)
    });
    let extent = [extent[0] - half_line, extent[1] + half_line];
    let (misfit, angle) = (region.model.square_sum() / points, angle / points);
    Measured { count, points, lines, variance: region.variance(), misfit, angle, extent }
}

/// Place of a point along the axis; of a sphere, across its arcs.
fn position(model: &Model, point: &Vector3) -> f64 {
    match model.conical() {
        Some(surface) => surface.axis.dot(&(point - surface.point)),
        None => point.y,
    }
}

/// Angle between the ends of an arc as seen from the axis or centre, given where the rays through them meet the surface.
fn span(arc: &Arc, region: &Region, ends: [Option<Vector3>; 2]) -> f64 {
    let [Some(a), Some(b)] = ends else { return arc.angle };
    let outwards = |point: Vector3| match &region.model {
        Model::Sphere(fit) => {
            let normal = arc.plane.normal();
            let from = point - fit.surface.center;
            from - normal * normal.dot(&from)
        }
        other => other.conical().map_or(point, |surface| point - surface.anchored(&point).point),
    };
    outwards(a).angle(&outwards(b))
}

/// Whether a plane explains the points nearly as well.
fn is_plane(region: &Region, measured: &Measured) -> bool {
    let mut pool = conicflow_geometry::SpaceMoments::default();
    region.arcs().for_each(|arc| pool.add(&arc.space, 1.0));
    pool.least_variance() < measured.variance * (PLANE + SCATTER * (2.0 / measured.points).sqrt())
}

/// Whether the contour that is seen is not that of a model which was fitted to it: on real frames, of most things that
/// are neither sphere, cylinder nor cone.
pub(super) fn has_other_outline(model: &Model, contour: &Contour) -> bool {
    let (used, others) = (contour.used() as f64, contour.far_off() as f64);
    let differs = model.contour_sum() > used * OUTLINE + OUTLINE_SCATTER * (2.0 * used).sqrt();
    differs || contour.points() >= FEWEST_TELLING && others > OTHERS * contour.points() as f64
}

/// Whether hardly any of an object's own outline is seen, and something nearer hides it: what is seen between other things
/// may be a part of anything.
fn is_between_others(region: &Region) -> bool {
    let part = |ends: usize| 0.5 * ends as f64 / region.members.len() as f64;
    let may_end = |arc: &Arc| (0..2).filter(|&end| arc.contour[end].is_some() || arc.beyond[end] == 0.0).count();
    if part(region.arcs().map(may_end).sum()) >= LEAST_OUTLINE {
        return false;
    }
    let q = region.model.coefficients();
    let hidden = |arc: &Arc| {
        let section = section_of(&q, &arc.plane);
        let is_nearer = |end: usize| {
            let (x, there, z) = (arc.rays[end], arc.beyond_rays[end], arc.beyond[end]);
            let nearer = |here: f64| z < here - NEARER * arc.variance.sqrt() - (there - x).abs() * here;
            z > 0.0 && arc.hit(&section, x).is_some_and(nearer)
        };
        (0..2).filter(|&end| is_nearer(end)).count()
    };
    part(region.arcs().map(hidden).sum()) > MOST_HIDDEN
}

/// An arc that adjoins a sphere and lies farther than so many radii from its centre does not belong to it.
const BEYOND: f64 = 1.3; // [tuned]

/// Whether a sphere is part of something longer: its first and its last line are wider than its radius, and what adjoins
/// them goes on beyond it on both sides.
pub(super) fn goes_on(region: &Region, gap: i64) -> bool {
    let Model::Sphere(fit) = &region.model else { return false };
    let Sphere { center, radius } = fit.surface;
    let ends = [(region.members[0], -1), (region.members[region.members.len() - 1], 1)];
    ends.into_iter().all(|(end, side)| {
        let next = |&at: &usize| region.arcs.beside(at, side, gap, |_| true);
        let leaves_it = |at: usize| (region.arcs.arcs[at].mean - center).norm() > BEYOND * radius;
        region.arcs.arcs[end].width() > radius && std::iter::successors(Some(end), next).any(leaves_it)
    })
}

/// A measurement lies behind a surface if it does so by more than so many standard deviations of a point.
const BEHIND: f64 = 3.0; // [sigmas]
/// Part of an object's length at each of its ends in which it need not hide anything.
const END_MARGIN: f64 = 0.05; // [tuned]

/// Part of the arc ends at which something is seen behind the surface; of few ends that tell, some may be noise.
fn seen_through(region: &Region, measured: &Measured) -> f64 {
    let q = region.model.coefficients();
    let (mut seen, mut all) = (0.0, 0.0_f64);
    for arc in region.arcs() {
        let section = section_of(&q, &arc.plane);
        for (x, z) in arc.beyond_rays.into_iter().zip(arc.beyond).filter(|(_, z)| *z > 0.0) {
            all += 1.0;
            let margin = BEHIND * arc.variance.sqrt();
            let through = |surface: f64| z > surface + margin && is_between(region, measured, &arc.point(x, surface));
            seen += f64::from(u8::from(arc.hit(&section, x).is_some_and(through)));
        }
    }
    seen / all.max(1.0).max(0.5 * region.members.len() as f64)
}

/// Whether a point is surely between the ends of what is seen; of a sphere any is.
fn is_between(region: &Region, measured: &Measured, point: &Vector3) -> bool {
    let along = position(&region.model, point);
    let margin = END_MARGIN * (measured.extent[1] - measured.extent[0]);
    let between = (measured.extent[0] + margin..measured.extent[1] - margin).contains(&along);
    region.model.kind() == ObjectKind::Sphere || between
}

/// Whether too little is known about the radius or the axis of an object, given their standard deviations. The
/// limits are those of noise that no lines share; what `shared_lines` of them share makes an axis the less certain.
pub(super) fn is_vague(object: &Object, shared_lines: f64) -> bool {
    let sigma = &object.sigma;
    // Nothing but the radius tells a sphere from other things that are bent.
    let wider = if object.shape() == ObjectKind::Sphere { 1.0 } else { shared_lines.sqrt() };
    let [radius, axis] = match object.shape() {
        ObjectKind::Sphere => VAGUE_SPHERE,
        ObjectKind::Cylinder => VAGUE_CYLINDER,
        ObjectKind::Cone => VAGUE_CONE,
    };
    let axis = if object.length < object.radius { axis.min(VAGUE_SHORT_AXIS) } else { axis };
    sigma.radius > wider * radius * object.radius || sigma.axis > wider * axis
}
