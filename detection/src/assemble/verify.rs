//! What has to be seen of a grown model for it to be a candidate; whether the candidate is an object is asked in `odds.rs`.

use super::arcs::{Arc, Arcs};
use super::contours::Contours;
use super::model::Model;
use super::parameters::AssemblerParameters;
use super::region::Region;
use super::rejection::Rejection;
use super::report::spacing_along;
use super::round::roundness;
use conicflow_geometry::{Contour, Scan, SpaceMoments, Vector3, section_of};

/// Pixels at each end of an arc that do not count for the extent: they may belong to a lid or to the floor.
const UNSURE_PX: f64 = 2.0; // [tuned]
/// Largest cosine between the axis and the scan lines: that of 40 degrees.
const ALONG_LINES: f64 = 0.766; // [tuned]
/// Largest cosine between the axis and the view: that of 25 degrees.
const ALONG_VIEW: f64 = 0.906; // [tuned]
/// The curvature of an object has to exceed that of a plane by so many standard deviations.
const CURVED: f64 = 4.0; // [sigmas]

/// As how many independent points it counts that the points of an outline are expected to be off by one standard deviation.
const EXPECTED_POINTS: f64 = 4.0; // [tuned]

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
    /// How much worse a plane explains the points, as chi squared of independent points.
    pub curvature: f64,
    /// Mean visible circumference.
    pub angle: f64,
    /// From where to where the arcs of the near wall and half a line beyond them reach along the axis, counted from the surface's
    /// point; of a sphere all arcs across the scan lines, along y of the camera frame for rows and x for columns.
    pub extent: [f64; 2],
}

/// How well the outline that is seen fits.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Outline {
    /// Mean square distance of the contour points that fit, in variances of one: its mean under a conjugate prior, so that a few
    /// points which fit by chance, or share their noise with their neighbours, say little.
    pub square: f64,
    /// Share of the contour points that are far off, and so belong to something else.
    pub far_off: f64,
    /// Share of the ends of all arcs beyond which something farther is seen, or nothing is measured.
    pub free: f64,
}

impl Outline {
    /// That of a region that was fitted together with its contour.
    fn of(region: &Region, contour: &Contour) -> Self {
        let ends = 2.0 * region.members.len() as f64;
        let is_free = |arc: &Arc, end: usize| arc.unseen[end] || arc.contour[end].is_some();
        let free: usize = region.arcs().map(|arc| (0..2).filter(|&end| is_free(arc, end)).count()).sum();
        let free = free as f64 / ends;
        let share = |part: usize, all: usize| part as f64 / all.max(1) as f64;
        let expected = EXPECTED_POINTS * region.shared_lines();
        let square = (region.model.contour_sum() + expected) / (contour.used() as f64 + expected);
        Self { square, far_off: share(contour.far_off(), contour.points()), free }
    }
}

/// A region that was verified.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Candidate<'a> {
    pub region: Region<'a>,
    pub measured: Measured,
    pub outline: Outline,
    /// How much more probable it is that it is round than that it is any quadric near it, as a logarithm.
    pub roundness: f64,
}

/// What became of the shapes: sphere, cylinder and cone.
pub(crate) type Verified<'a> = [Result<Candidate<'a>, Rejection>; 3];

/// Verifies what grew of each shape.
pub(crate) fn verify_all<'a>(
    arcs: &'a Arcs,
    grown: [Result<Model, Rejection>; 3],
    members: &'a [Vec<usize>; 3],
    parameters: &AssemblerParameters,
    contours: &mut Contours,
) -> Verified<'a> {
    std::array::from_fn(|kind| {
        let region = |model| Region { arcs, model, members: &members[kind] };
        grown[kind].and_then(|model| verify(region(model), parameters, contours))
    })
}

/// A region fitted together with the contour that it shows, if what is seen of it is enough for an object.
fn verify<'a>(
    mut region: Region<'a>,
    parameters: &AssemblerParameters,
    contours: &mut Contours,
) -> Result<Candidate<'a>, Rejection> {
    check(&region, parameters)?;
    if let Some(model) = contours.fit(&region) {
        region.model = model;
    } else {
        contours.clear();
    }
    let measured = check(&region, parameters)?;
    let outline = Outline::of(&region, contours.last());
    let roundness = roundness(&region, contours.last());
    Ok(Candidate { region, measured, outline, roundness })
}

fn check(region: &Region, parameters: &AssemblerParameters) -> Result<Measured, Rejection> {
    let measured = measure(region);
    let [first, last] = region.ends();
    let radius = region.model.radius_at(&middle(region, &measured));
    let reach = measured.extent[1] - measured.extent[0];
    if reach < 0.0 {
        // All that is seen of it is the far wall, so that it has no middle either.
        Err(Rejection::Short)
    } else if measured.lines < parameters.pooled.min_lines {
        Err(Rejection::FewRows)
    } else if height_in_view(region) < parameters.pooled.min_view_deg.to_radians() {
        Err(Rejection::Small)
    } else if f64::from(measured.lines) < parameters.pooled.min_coverage * f64::from(last.line - first.line + 1) {
        Err(Rejection::Gaps)
    } else if !parameters.radii_m(region.model.kind()).contains(&radius) {
        Err(Rejection::Radius)
    } else if !parameters.lengths_m(region.model.kind()).contains(&reach) {
        Err(Rejection::Length)
    } else if !is_sharp(region, parameters) {
        Err(Rejection::HalfAngle)
    } else if reach < least_reach(region, parameters) * radius {
        Err(Rejection::Short)
    } else if runs_along(region, &measured) {
        Err(Rejection::Tilted)
    } else if measured.angle < parameters.pooled.min_arc_deg.to_radians() {
        Err(Rejection::ShortArc)
    } else if measured.curvature < CURVED * CURVED {
        Err(Rejection::Flat)
    } else {
        Ok(measured)
    }
}

/// Visual angle across the scan lines, in radians.
fn height_in_view(region: &Region) -> f64 {
    let [first, last] = region.ends();
    f64::from(last.line - first.line + 1) * first.spacing / first.mean.z
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
        // Where lines cross the mouth of a cup, they show its far wall, and its near one is no longer there.
        if region.model.conical().is_some() && !arc.faces(&q) {
            continue;
        }
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
    let extent = [(extent[0] - half_line).max(apex(&region.model)), extent[1] + half_line];
    let (misfit, angle) = (region.model.square_sum() / points, angle / points);
    let variance = region.variance();
    let curvature = curvature(region, variance, misfit);
    Measured { count, points, lines, variance, misfit, curvature, angle, extent }
}

/// Place of the apex of a cone along its axis, beyond which there is nothing of it; other shapes have none.
fn apex(model: &Model) -> f64 {
    match model {
        Model::Cone(fit) if fit.surface.0.slope > 0.0 => -fit.surface.0.radius / fit.surface.0.slope,
        _ => f64::NEG_INFINITY,
    }
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

/// How much worse than the model a plane explains the points: chi squared of independent points, in units of what the points
/// really scatter about the model.
fn curvature(region: &Region, variance: f64, misfit: f64) -> f64 {
    let mut pool = SpaceMoments::default();
    region.arcs().for_each(|arc| pool.add(arc.space(), 1.0));
    let independent = region.points() / region.shared_lines();
    independent * (pool.least_variance() / variance - misfit) / (1.0 + misfit.max(0.0))
}

#[cfg(test)]
mod tests {
    use super::super::growth::{Growing, chain};
    use super::super::model;
    use super::super::tests::arcs_of;
    use super::*;
    use conicflow_lab::rendered::{cylinder, frustum};
    use conicflow_messages::ObjectKind;

    #[test]
    fn an_object_has_at_least_as_many_lines_as_it_has_to_and_is_seen_in_as_many_of_those_that_it_spans() {
        let (center, axis) = (Vector3::new(0.0, 0.0, 2.0), Vector3::y());
        let arcs = arcs_of(&[cylinder(center, axis, 0.2, 0.7)]);
        let seed = arcs.arcs.iter().position(|arc| arc.scan == Scan::Row && arc.line == 120).unwrap();
        let (mut growing, mut parameters) = (Growing::default(), AssemblerParameters::default());
        chain(&arcs, seed, parameters.max_gap(), |_| true, &mut growing.chain);
        let Ok(model) = growing.models(&arcs, &parameters, |_| true)[1] else { panic!("no cylinder") };
        let region = Region { arcs: &arcs, model, members: &growing.members[1] };
        let lines = measure(&region).lines;
        let mut is_too_low = |min_lines: u32| {
            parameters.pooled.min_lines = min_lines;
            check(&region, &parameters).err()
        };
        assert_eq!([lines - 1, lines, lines + 1].map(&mut is_too_low), [None, None, Some(Rejection::FewRows)]);
        let every_other: Vec<_> =
            region.members.iter().copied().filter(|arc| arcs.arcs[*arc].line.is_multiple_of(2)).collect();
        parameters.pooled.min_lines = 1;
        let mut has_gaps = |min_coverage: f64| {
            parameters.pooled.min_coverage = min_coverage;
            check(&Region { members: &every_other, ..region }, &parameters).err()
        };
        assert_eq!([0.45, 0.55].map(&mut has_gaps), [None, Some(Rejection::Gaps)]);
    }

    #[test]
    fn what_shows_nothing_but_its_far_wall_is_turned_down() {
        let arcs = arcs_of(&[frustum(Vector3::new(0.0, 0.0, 2.0), Vector3::y(), 0.2, 0.2, 0.7)]);
        let members: Vec<_> = (0..arcs.arcs.len()).filter(|&arc| arcs.arcs[arc].scan == Scan::Row).collect();
        let model = model::fit(ObjectKind::Cone, &arcs.of(&members), None, f64::INFINITY).unwrap();
        let Model::Cone(mut fit) = model else { panic!("{model:?}") };
        let mut checked = || {
            let region = Region { arcs: &arcs, model: Model::Cone(fit), members: &members };
            let checked = check(&region, &AssemblerParameters::default()).err();
            fit.surface.0.point.z -= 0.5;
            checked
        };
        assert_eq!([checked(), checked()], [None, Some(Rejection::Short)]);
    }
}
