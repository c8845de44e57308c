//! Verifies that enough is seen of a grown model for it to be a candidate; `odds.rs` decides whether the candidate is an object.

use super::arcs::{Arc, Arcs};
use super::contours::ContourCalibration;
use super::model::Model;
use super::parameters::AssemblerParameters;
use super::region::Region;
use super::rejection::Rejection;
use super::report::spacing_along;
use super::round::roundness;
use conicflow_geometry::{Contour, Scan, SpaceMoments, Vector3, section_of};

/// Width of the margin at each end of an arc, in pixels, that does not count for the extent: it may belong to a lid or to the
/// floor.
const UNSURE_PX: f64 = 2.0; // [tuned]
/// Largest cosine between the axis of an object and its scan lines: that of 40 degrees.
const ALONG_LINES: f64 = 0.766; // [tuned]
/// Largest cosine between the axis of an object and the view: that of 25 degrees.
const ALONG_VIEW: f64 = 0.906; // [tuned]
/// Fewest standard deviations by which the curvature of an object has to exceed that of a plane.
const PLANE_SIGMAS: f64 = 4.0; // [sigmas]

/// Weight of the prior that the points of an outline are off by one standard deviation, in independent points.
const EXPECTED_POINTS: f64 = 4.0; // [tuned]

/// Measurements of a grown model, for its report.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Measured {
    /// Number of points.
    pub count: u32,
    /// Number of independent points.
    pub points: f64,
    pub lines: u32,
    /// Mean variance of a point, in square metres.
    pub variance: f64,
    /// Mean square distance of the points, less that of the noise, in variances of a point.
    pub residual: f64,
    /// Excess of the residuals from a plane over those from the model, as chi squared of independent points.
    pub curvature: f64,
    /// Mean visible circumference, in radians.
    pub angle: f64,
    /// Extent of the arcs of the near wall, and of half a line beyond them, along the axis from the surface's point, in metres.
    /// For a sphere it is that of all arcs across the scan lines: along y of the camera frame for rows and x for columns.
    pub extent: [f64; 2],
}

/// Fit of the outline that is seen.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Outline {
    /// Mean square distance of the contour points that fit, in variances of one. It is the mean under a conjugate prior: a few
    /// points which fit by chance, or share their noise with their neighbours, change it little.
    pub square: f64,
    /// Share of the contour points that are far off, which belong to something else.
    pub far_off: f64,
    /// Share of the ends of all arcs beyond which the camera sees something farther, or measures nothing.
    pub free: f64,
}

impl Outline {
    /// Returns the outline of a region that was fitted together with its contour.
    fn of(region: &Region, contour: &Contour) -> Self {
        let ends = 2.0 * region.members.len() as f64;
        let is_free = |arc: &Arc, end: usize| arc.unseen[end] || arc.contour[end].is_some();
        let free: usize = region.arcs().map(|arc| (0..2).filter(|&end| is_free(arc, end)).count()).sum();
        let free = free as f64 / ends;
        let share = |part: usize, all: usize| part as f64 / all.max(1) as f64;
        let lines = region.contour_lines();
        let (sum, expected) = (region.model.contour_sum() * lines / region.shared_lines(), EXPECTED_POINTS * lines);
        let square = (sum + expected) / (contour.used() as f64 + expected);
        Self { square, far_off: share(contour.far_off(), contour.points()), free }
    }
}

/// A verified region.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Candidate<'a> {
    pub region: Region<'a>,
    pub measured: Measured,
    pub outline: Outline,
    /// Logarithm of the probability of its being round over that of its being some quadric near the shape.
    pub roundness: f64,
}

/// Results for sphere, cylinder and cone.
pub(crate) type Verified<'a> = [Result<Candidate<'a>, Rejection>; 3];

/// Verifies the grown model of each shape.
pub(crate) fn verify_all<'a>(
    arcs: &'a Arcs,
    grown: [Result<Model, Rejection>; 3],
    members: &'a [Vec<usize>; 3],
    parameters: &AssemblerParameters,
    contours: &mut ContourCalibration,
) -> Verified<'a> {
    std::array::from_fn(|kind| {
        let region = |model| Region { arcs, model, members: &members[kind] };
        grown[kind].and_then(|model| verify(region(model), parameters, contours))
    })
}

/// Fits a region together with its contour, and checks that enough of it is seen for an object.
fn verify<'a>(
    mut region: Region<'a>,
    parameters: &AssemblerParameters,
    contours: &mut ContourCalibration,
) -> Result<Candidate<'a>, Rejection> {
    check(&region, parameters)?;
    let no_contour = Contour::default();
    let (model, contour) = contours.fit(&region).unwrap_or((region.model, &no_contour));
    region.model = model;
    let measured = check(&region, parameters)?;
    let outline = Outline::of(&region, contour);
    let roundness = roundness(&region, contour);
    Ok(Candidate { region, measured, outline, roundness })
}

fn check(region: &Region, parameters: &AssemblerParameters) -> Result<Measured, Rejection> {
    let measured = measure(region);
    let [first, last] = region.ends();
    let radius = region.model.radius_at(&middle(region, &measured));
    let reach = measured.extent[1] - measured.extent[0];
    if reach < 0.0 {
        // Only the far wall is seen, so it has no middle.
        Err(Rejection::Short)
    } else if measured.lines < parameters.pooled.min_lines {
        Err(Rejection::FewLines)
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
    } else if measured.curvature < PLANE_SIGMAS * PLANE_SIGMAS {
        Err(Rejection::Flat)
    } else {
        Ok(measured)
    }
}

/// Returns the visual angle across the scan lines, in radians.
fn height_in_view(region: &Region) -> f64 {
    let [first, last] = region.ends();
    f64::from(last.line - first.line + 1) * first.spacing / first.mean.z
}

/// Returns whether the axis lies so nearly along the scan lines that they hardly show the curvature, or so nearly along the view
/// that the side is hardly seen.
fn runs_along(region: &Region, measured: &Measured) -> bool {
    let [arc, _] = region.ends();
    let (along, view) = (arc.plane.s_axis(), middle(region, measured).normalize());
    region.model.conical().is_some_and(|surface| {
        surface.axis.dot(&along).abs() > ALONG_LINES || surface.axis.dot(&view).abs() > ALONG_VIEW
    })
}

/// Returns the least visible extent, in radii.
fn least_reach(region: &Region, parameters: &AssemblerParameters) -> f64 {
    match region.model {
        Model::Sphere(_) => parameters.pooled.min_cap_radii,
        _ => parameters.pooled.min_length_radii,
    }
}

fn is_sharp(region: &Region, parameters: &AssemblerParameters) -> bool {
    match &region.model {
        Model::Cone(fit) => fit.surface.slope <= parameters.max_half_angle_deg.to_radians().tan(),
        _ => true,
    }
}

/// Returns the point of the axis in the middle of the visible part; the centre of a sphere.
pub(super) fn middle(region: &Region, measured: &Measured) -> Vector3 {
    let (point, axis) = region.model.axis();
    point + axis * (0.5 * (measured.extent[0] + measured.extent[1]))
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
        // Lines that cross the mouth of a cup show its far wall and no longer the near one.
        if region.model.conical().is_some() && !arc.faces(&q) {
            continue;
        }
        let inset = UNSURE_PX * arc.pitch / arc.mean.z;
        let sure = [arc.rays[0] + inset, arc.rays[1] - inset].map(hit);
        for point in sure.into_iter().flatten().chain([arc.mean]) {
            let along = match (&region.model, arc.scan) {
                (Model::Sphere(_), Scan::Row) => point.y,
                (Model::Sphere(_), Scan::Column) => point.x,
                _ => region.along(&point),
            };
            extent = [extent[0].min(along), extent[1].max(along)];
        }
    }
    let half_line = region.model.conical().map_or(0.0, |surface| {
        let first = region.ends()[0];
        0.5 * spacing_along(first.spacing, &first.plane, &surface.axis)
    });
    let extent = [(extent[0] - half_line).max(apex(&region.model)), extent[1] + half_line];
    let (residual, angle) = (region.model.square_sum() / points, angle / points);
    let variance = region.variance();
    let curvature = curvature(region, variance, residual);
    Measured { count, points, lines, variance, residual, curvature, angle, extent }
}

/// Returns the position of a cone's apex along its axis, beyond which there is no surface; minus infinity for other shapes.
fn apex(model: &Model) -> f64 {
    match model {
        Model::Cone(fit) if fit.surface.slope > 0.0 => -fit.surface.radius / fit.surface.slope,
        _ => f64::NEG_INFINITY,
    }
}

/// Returns the angle between the ends of an arc about the axis or centre, given the points where the rays through them meet the
/// surface.
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

/// Returns by how much worse than the model a plane explains the points: chi squared of independent points, in units of their
/// actual scatter about the model.
fn curvature(region: &Region, variance: f64, residual: f64) -> f64 {
    let mut pool = SpaceMoments::default();
    region.arcs().for_each(|arc| pool.add(arc.space(), 1.0));
    let independent = region.points() / region.shared_lines();
    independent * (pool.least_variance() / variance - residual) / (1.0 + residual.max(0.0))
}

#[cfg(test)]
mod tests {
    use super::super::growth::{RegionGrower, chain};
    use super::super::model;
    use super::super::parameters::PooledParameters;
    use super::super::tests::{arcs_of, rows_of, wall};
    use super::*;
    use conicflow_lab::rendered::{KINECT_HALF, cylinder, frustum, sphere};
    use conicflow_messages::ObjectKind;

    #[test]
    fn an_object_has_at_least_as_many_lines_as_it_has_to_and_is_seen_in_as_many_of_those_that_it_spans() {
        let (center, axis) = (Vector3::new(0.0, 0.0, 2.0), Vector3::y());
        let arcs = arcs_of(&[cylinder(center, axis, 0.2, 0.7)]);
        let seed = arcs.arcs.iter().position(|arc| arc.scan == Scan::Row && arc.line == 120).unwrap();
        let (mut grower, mut parameters) = (RegionGrower::default(), AssemblerParameters::default());
        chain(&arcs, seed, parameters.max_gap(), |_| true, &mut grower.chain);
        let Ok(model) = grower.models(&arcs, &parameters, |_| true)[1] else { panic!("no cylinder") };
        let region = Region { arcs: &arcs, model, members: &grower.members[1] };
        let lines = measure(&region).lines;
        let mut is_too_low = |min_lines: u32| {
            parameters.pooled.min_lines = min_lines;
            check(&region, &parameters).err()
        };
        assert_eq!([lines - 1, lines, lines + 1].map(&mut is_too_low), [None, None, Some(Rejection::FewLines)]);
        let every_other: Vec<_> =
            region.members.iter().copied().filter(|arc| arcs.arcs[*arc].line.is_multiple_of(2)).collect();
        parameters.pooled.min_lines = 1;
        let mut has_gaps = |min_coverage: f64| {
            parameters.pooled.min_coverage = min_coverage;
            check(&Region { members: &every_other, ..region }, &parameters).err()
        };
        // The coverage counts all lines from the first to the last.
        let shown = every_other.len() as f64;
        let [fewer, all, more] = [2.0, 1.0, 0.0].map(|less| shown / (2.0 * shown - less));
        assert_eq!([0.5 * (more + all), 0.5 * (all + fewer)].map(&mut has_gaps), [None, Some(Rejection::Gaps)]);
        parameters.pooled.min_coverage = 1.0;
        assert_eq!(check(&region, &parameters).err(), None, "all of them");
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
            fit.surface.point.z -= 0.5;
            checked
        };
        assert_eq!([checked(), checked()], [None, Some(Rejection::Short)]);
    }

    fn fitted<'a>(arcs: &'a Arcs, members: &'a [usize], kind: ObjectKind) -> Region<'a> {
        let model = model::fit(kind, &arcs.of(members), None, f64::INFINITY).unwrap();
        Region { arcs, model, members }
    }

    /// The result of a check with a limit slightly below the object, and slightly above.
    fn limited(region: &Region, limit: impl Fn(&mut AssemblerParameters, f64)) -> [Option<Rejection>; 2] {
        [0.97, 1.03].map(|times| {
            let mut parameters = AssemblerParameters::default();
            parameters.pooled = PooledParameters { min_length_radii: 0.1, min_cap_radii: 0.1, ..parameters.pooled };
            limit(&mut parameters, times);
            check(region, &parameters).err()
        })
    }

    #[test]
    fn what_is_seen_of_an_object_is_as_large_as_its_limits_ask() {
        let can = arcs_of(&[cylinder(Vector3::z() * 2.0, Vector3::y(), 0.2, 0.5)]);
        let rows = rows_of(&can, |_| true);
        let region = fitted(&can, &rows, ObjectKind::Cylinder);
        let angle = measure(&region).angle;
        // Twelve lines: a tolerance of 3 % does not reach one line more or less.
        let band = Region { members: &rows[rows.len() / 2 - 6..][..12], ..region };
        let view = 12.0 / KINECT_HALF.fy;
        let limit =
            |limits: &mut AssemblerParameters, times: f64| limits.pooled.min_view_deg = times * view.to_degrees();
        assert_eq!(limited(&band, limit), [None, Some(Rejection::Small)]);
        let limit = |limits: &mut AssemblerParameters, times: f64| limits.pooled.min_length_radii = times * 0.5 / 0.2;
        assert_eq!(limited(&region, limit), [None, Some(Rejection::Short)]);
        let limit =
            |limits: &mut AssemblerParameters, times: f64| limits.pooled.min_arc_deg = times * angle.to_degrees();
        assert_eq!(limited(&region, limit), [None, Some(Rejection::ShortArc)]);
        let ball = arcs_of(&[sphere(Vector3::z() * 2.0, 0.2)]);
        let upper = rows_of(&ball, |arc| arc.mean.y < -0.05);
        let cap = fitted(&ball, &upper, ObjectKind::Sphere);
        let [from, to] = measure(&cap).extent;
        assert!((0.12..0.15).contains(&(to - from)), "{from} to {to} m, of the upper 15 cm");
        let limit = |limits: &mut AssemblerParameters, times: f64| {
            limits.pooled.min_cap_radii = times * (to - from) / cap.model.radius().0;
        };
        assert_eq!(limited(&cap, limit), [None, Some(Rejection::Short)]);
    }

    #[test]
    fn a_cone_is_no_blunter_than_it_may_be() {
        let arcs = arcs_of(&[frustum(Vector3::z() * 2.0, Vector3::y(), 0.2, 0.4, 0.5)]);
        let rows = rows_of(&arcs, |_| true);
        let region = fitted(&arcs, &rows, ObjectKind::Cone);
        let half_angle = region.model.conical().unwrap().half_angle().to_degrees();
        let limit = |limits: &mut AssemblerParameters, times: f64| limits.max_half_angle_deg = half_angle / times;
        assert_eq!(limited(&region, limit), [None, Some(Rejection::HalfAngle)]);
    }

    /// At this distance the visible side lies between the rays that touch it, except for the pixels at its edges.
    #[test]
    fn the_visible_angle_is_that_about_the_axis_or_about_the_middle_of_each_line_of_a_ball() {
        let touched = 2.0 * (0.2_f64 / 2.0).acos();
        let can = arcs_of(&[cylinder(Vector3::z() * 2.0, Vector3::y(), 0.2, 0.5)]);
        let ball = arcs_of(&[sphere(Vector3::z() * 2.0, 0.2)]);
        let (rows, beside) = (rows_of(&can, |_| true), rows_of(&ball, |arc| (0.08..0.12).contains(&arc.mean.y)));
        let all = rows_of(&ball, |_| true);
        let round = Region { members: &beside, ..fitted(&ball, &all, ObjectKind::Sphere) };
        for region in [fitted(&can, &rows, ObjectKind::Cylinder), round] {
            let angle = measure(&region).angle;
            assert!((0.7 * touched..touched).contains(&angle), "{angle} of {touched}");
        }
    }

    #[test]
    fn pixels_at_the_ends_of_a_line_do_not_make_an_object_longer() {
        let axis = Vector3::new(0.5, 0.8, 0.0).normalize();
        let arcs = arcs_of(&[cylinder(Vector3::z() * 2.0, axis, 0.2, 1.0)]);
        let rows = rows_of(&arcs, |arc| arc.mean.y.abs() < 0.1);
        let whole = fitted(&arcs, &rows, ObjectKind::Cylinder);
        let member = [rows[rows.len() / 2]];
        let (region, arc) = (Region { members: &member, ..whole }, &arcs.arcs[member[0]]);
        let section = section_of(&region.model.coefficients(), &arc.plane);
        let ends = [arc.pixels[0] + 2, arc.pixels[1] - 2].map(|pixel| {
            let x = (pixel as f64 - KINECT_HALF.cx) / KINECT_HALF.fx;
            region.along(&arc.point(x, arc.hit(&section, x).unwrap()))
        });
        let [from, to] = measure(&region).extent;
        let line = spacing_along(arc.spacing, &arc.plane, &region.model.conical().unwrap().axis);
        let expected = (ends[1] - ends[0]).abs() + line;
        assert!((to - from - expected).abs() < 1e-9, "{} {expected}", to - from);
    }

    #[test]
    fn nothing_of_a_cone_lies_beyond_its_apex() {
        let arcs = arcs_of(&[frustum(Vector3::z() * 2.0, Vector3::y(), 0.2, 0.2, 0.5)]);
        let rows = rows_of(&arcs, |_| true);
        let Model::Cone(mut fit) = fitted(&arcs, &rows, ObjectKind::Cone).model else { panic!("no cone") };
        let extent = |fit| measure(&Region { arcs: &arcs, model: Model::Cone(fit), members: &rows }).extent;
        let ([from, _], cone) = (extent(fit), fit.surface);
        // The cone now has the radius zero within the visible part.
        fit.surface.slope = cone.radius / (0.5 * -from);
        let apex = fit.surface.axis.dot(&(fit.surface.apex() - cone.point));
        assert!((extent(fit)[0] - apex).abs() < 1e-12 && apex > from, "{} {apex}", extent(fit)[0]);
        fit.surface.slope = 0.0;
        assert!(extent(fit)[0] < apex, "a cone that does not taper has none");
    }

    #[test]
    fn an_axis_leans_by_forty_degrees_from_the_lines_and_by_25_from_the_view() {
        let arcs = arcs_of(&[cylinder(Vector3::z() * 2.0, Vector3::y(), 0.2, 0.5)]);
        let rows = rows_of(&arcs, |_| true);
        let region = fitted(&arcs, &rows, ObjectKind::Cylinder);
        let measured = Measured { extent: [-0.1, 0.1], ..measure(&region) };
        let Model::Cylinder(mut fit) = region.model else { panic!("{region:?}") };
        let mut along = |x: f64, y: f64, z: f64| {
            (fit.surface.point, fit.surface.axis) = (Vector3::z() * 2.0, Vector3::new(x, y, z));
            runs_along(&Region { model: Model::Cylinder(fit), ..region }, &measured)
        };
        for side in [-1.0, 1.0] {
            let mut from = |degrees: f64, is_view: bool| {
                let (sine, cosine) = degrees.to_radians().sin_cos();
                if is_view { along(0.0, sine, side * cosine) } else { along(side * cosine, sine, 0.0) }
            };
            assert_eq!([from(39.0, false), from(41.0, false), from(90.0, false)], [true, false, false]);
            assert_eq!([from(24.0, true), from(26.0, true)], [true, false]);
        }
        assert!(!runs_along(&fitted(&arcs, &rows, ObjectKind::Sphere), &measured), "a ball has no axis");
    }

    #[test]
    fn an_object_is_curved_by_four_deviations_of_what_noise_makes_of_a_plane() {
        let mut arcs = arcs_of(&[cylinder(Vector3::z() * 2.0, Vector3::y(), 0.2, 0.5)]);
        let rows = rows_of(&arcs, |_| true);
        let model = fitted(&arcs, &rows, ObjectKind::Cylinder).model;
        for (sigmas, expected) in [(3.9_f64, Some(Rejection::Flat)), (4.1, None)] {
            for _ in 0..8 {
                let louder = measure(&Region { arcs: &arcs, model, members: &rows }).curvature / sigmas.powi(2);
                arcs.arcs.iter_mut().for_each(|arc| arc.variance *= louder);
            }
            let region = Region { arcs: &arcs, model, members: &rows };
            assert!((measure(&region).curvature / sigmas.powi(2) - 1.0).abs() < 0.01);
            assert_eq!(check(&region, &AssemblerParameters::default()).err(), expected);
        }
    }

    /// The chi squared of a plane is that beyond the surface's, in units of the scatter about the surface.
    #[test]
    fn points_that_share_their_noise_or_miss_the_surface_show_less_of_how_it_is_curved() {
        let mut arcs = arcs_of(&[cylinder(Vector3::z() * 2.0, Vector3::y(), 0.2, 0.5)]);
        let rows = rows_of(&arcs, |_| true);
        let mut of = |variance: f64, residual: f64, shared_lines: f64| {
            arcs.arcs.iter_mut().for_each(|arc| arc.shared_lines = shared_lines);
            let region = fitted(&arcs, &rows, ObjectKind::Cylinder);
            (curvature(&region, variance, residual), region.points())
        };
        let (whole, points) = of(1e-5, 0.0, 1.0);
        for (variance, residual, shared_lines, expected) in [
            (2e-5, 0.0, 1.0, whole / 2.0),
            (1e-5, 0.0, 4.0, whole / 4.0),
            (1e-5, 1.0, 1.0, (whole - points) / 2.0),
            (1e-5, 2.0, 1.0, (whole - 2.0 * points) / 3.0),
            (1e-5, -0.5, 1.0, whole + 0.5 * points),
        ] {
            let (found, _) = of(variance, residual, shared_lines);
            assert!((found / expected - 1.0).abs() < 1e-9, "{found} {expected}");
        }
    }

    #[test]
    fn ends_are_free_before_what_is_not_measured_or_farther() {
        let mut arcs = arcs_of(&[sphere(Vector3::z() * 1.5, 0.2), wall(4.0)]);
        let rows = rows_of(&arcs, |arc| arc.mean.z < 2.0);
        let seen = rows.iter().find_map(|&row| arcs.arcs[row].contour[1]).unwrap();
        arcs.arcs.iter_mut().for_each(|arc| (arc.unseen, arc.contour) = ([false; 2], [None; 2]));
        for (at, &row) in rows[..10].iter().enumerate() {
            // Five ends are free on one side, and seven on the other.
            (arcs.arcs[row].unseen[0], arcs.arcs[row].contour[1]) = (at < 5, (at < 7).then_some(seen));
        }
        let region = Region { members: &rows[..10], ..fitted(&arcs, &rows, ObjectKind::Sphere) };
        assert_eq!(Outline::of(&region, &Contour::default()).free, 12.0 / 20.0);
    }

    /// The expected square is a mean with four points that are off by one standard deviation, for each line that shares their
    /// noise.
    #[test]
    fn few_points_of_an_outline_say_little_of_how_well_it_fits() {
        let mut arcs = arcs_of(&[sphere(Vector3::z() * 1.5, 0.2), wall(4.0)]);
        let rows = rows_of(&arcs, |arc| arc.mean.z < 2.0);
        for (lines, shared_lines, contour_lines) in [(20, 1.0, 1.0), (60, 1.0, 1.0), (60, 5.0, 5.0), (60, 5.0, 1.0)] {
            let share = |arc: &mut Arc| (arc.shared_lines, arc.contour_lines) = (shared_lines, contour_lines);
            arcs.arcs.iter_mut().for_each(share);
            let (mut region, mut contours) =
                (fitted(&arcs, &rows[..lines], ObjectKind::Sphere), ContourCalibration::default());
            let (model, contour) = contours.fit(&region).unwrap();
            region.model = model;
            let (sum, used) = (model.contour_sum(), contour.used() as f64);
            let told = Outline::of(&region, contour).square;
            let (lines_as_one, sum) = (4.0 * contour_lines, sum * contour_lines / shared_lines);
            let expected = (sum + lines_as_one) / (used + lines_as_one);
            assert!(used > lines as f64 && (told - expected).abs() < 1e-12 && told != 1.0, "{told} {expected}");
        }
        let region = fitted(&arcs, &rows, ObjectKind::Sphere);
        assert_eq!(Outline::of(&region, &Contour::default()).square, 1.0, "nothing is seen of it");
    }
}
