//! Turns segments into arcs: trims ends that may belong to something else; the curvature has to exceed the noise, and the centre
//! has to lie behind the surface.

use super::rays::Rays;
use super::rejection::ArcRejection;
use super::run::{MIN_ARC_POINTS, Run};
use super::segments::Segment;
use crate::camera::scan_code;
use conicflow_geometry::{ArcFit, ArcMoments, Circle, LineSums, PlaneMoments};
use conicflow_messages::{END_POINTS, Ellipse};
use std::ops::Range;

/// Least difference between the line error and the circle error of an arc, in standard deviations, if it is only a part of a run
/// and has no contour.
const PART_BEND_SIGMAS: f64 = 3.0; // [sigmas]
/// Least difference between the line error and the circle error, in standard deviations, of an arc of at least [`WEAK_POINTS`]
/// points that jumps or creases set off, or that has a contour. Most such runs are flat.
const WHOLE_BEND_SIGMAS: f64 = 0.5; // [sigmas]
/// Fewest points of an arc to which [`WHOLE_BEND_SIGMAS`] applies: shorter ones only have to be curved at all, because many weak
/// arcs together are strong evidence.
const WEAK_POINTS: usize = 16; // [tuned]
/// Fewest points of an arc that is kept although noise bends it the wrong way, because jumps separate it from its surroundings.
const MIN_SET_OFF_POINTS: usize = 6; // [tuned]
/// Number of points of an arc for each of which one point is trimmed from each end, besides `trim_px`: the larger an edge
/// appears, the wider it is smeared.
const POINTS_PER_SMEARED: usize = 32; // [tuned]
/// Radius of a circle that is indistinguishable from a line, in metres.
const STRAIGHT_M: f64 = 500.0; // [algorithmic]

/// Returns the arc of a run that a line explains, or why it is none; `None` where no line explains the run.
///
/// Most of an image shows walls and floors, so this computes only the sums that it needs.
pub(super) fn accept_line(rays: &Rays, image: &[u16]) -> Option<Result<Ellipse, ArcRejection>> {
    let inner = rays.inner.clone();
    let smeared = inner.len() / POINTS_PER_SMEARED;
    let points = inner.start + smeared..inner.end - smeared;
    let whole = rays.line_sums(inner.clone());
    let square = |sums: &LineSums, points: usize| sums.line_square(points as f64, rays.stretch);
    if square(&whole, inner.len()) > rays.limit(inner.start, inner.end) {
        return None;
    }
    let is_cut_off = rays.points.open != [false; 2];
    let is_straight = || {
        let ends = [inner.start..points.start, points.end..inner.end].map(|end| rays.line_sums(end));
        let middle = whole.without(&ends[0]).without(&ends[1]);
        square(&middle, points.len()) < PART_BEND_SIGMAS * scatter(rays, &points)
    };
    let Range { start: from, end: to } = inner;
    let segment = Segment { part: [from, to], from, to, is_curve: true };
    Some(if points.len() < MIN_ARC_POINTS {
        Err(ArcRejection::FewPoints)
    } else if rays.width() >= 2.0 * rays.view.parameters.max_radius_m || is_cut_off && is_straight() {
        Err(ArcRejection::Line)
    } else {
        arc(rays, image, &segment, points.clone(), &rays.moments(points))
    })
}

/// Returns the standard deviation of the mean square error of a line through some points.
fn scatter(rays: &Rays, points: &Range<usize>) -> f64 {
    rays.variance(points.start, points.end) * (2.0 / points.len() as f64).sqrt()
}

/// Returns the arc of a segment, or why it is none.
pub(super) fn accept(run: &Run, image: &[u16], segment: &Segment) -> Result<Ellipse, ArcRejection> {
    let points = trimmed(run, segment);
    if points.len() < MIN_ARC_POINTS {
        return Err(ArcRejection::FewPoints);
    }
    arc(run, image, segment, points.clone(), &run.moments(points.start, points.end))
}

/// Returns the arc of some points of a segment with these moments, or why it is none.
fn arc(
    rays: &Rays,
    image: &[u16],
    segment: &Segment,
    points: Range<usize>,
    moments: &ArcMoments,
) -> Result<Ellipse, ArcRejection> {
    let contour = contour(rays, segment);
    let is_set_off = contour != [0.0; 2] || is_whole(rays, segment);
    let fit = circle(rays, is_set_off, &points, moments, moments.fit()).or_else(|why| {
        if may_be_part(rays, segment, &points, contour) { Ok(nearly_flat(moments)) } else { Err(why) }
    })?;
    let (points, fit, moments) = with_ends(rays, segment, is_set_off, &points, &fit.circle).unwrap_or_else(|| {
        let moments = all_moments(rays, &points);
        (points, fit, moments)
    });
    Ok(Ellipse { contour, ..message(rays, image, points, &fit, &moments) })
}

/// Returns the moments of some points about their mean.
fn all_moments(rays: &Rays, points: &Range<usize>) -> PlaneMoments {
    let moments = rays.all_sums(points.clone()).moments(rays.plane().stretch());
    moments.mean().map_or(moments, |mean| moments.about(mean))
}

/// Returns the circle through the points of a segment, or why it is no arc; `is_set_off`: something separates it from its
/// surroundings.
fn circle(
    rays: &Rays,
    is_set_off: bool,
    points: &Range<usize>,
    moments: &ArcMoments,
    fit: ArcFit,
) -> Result<ArcFit, ArcRejection> {
    let parameters = &rays.view.parameters;
    let sigmas = if !is_set_off {
        PART_BEND_SIGMAS
    } else if points.len() >= WEAK_POINTS {
        WHOLE_BEND_SIGMAS
    } else {
        0.0
    };
    let bend = fit.line_square - fit.circle_square.max(0.0);
    if !fit.circle.radius.is_finite() || bend < sigmas * scatter(rays, points) {
        Err(ArcRejection::Line)
    } else if fit.circle.center[1] <= moments.mean()[1] {
        Err(ArcRejection::Concave)
    } else if !(parameters.min_radius_m..STRAIGHT_M).contains(&fit.circle.radius) {
        Err(ArcRejection::Radius)
    } else {
        Ok(fit)
    }
}

/// Returns whether a segment may be part of an object although noise bends it the wrong way, because jumps separate it from its
/// surroundings.
fn may_be_part(rays: &Rays, segment: &Segment, points: &Range<usize>, contour: [f64; 2]) -> bool {
    is_whole(rays, segment)
        && points.len() >= MIN_SET_OFF_POINTS
        && contour != [0.0; 2]
        && rays.width() < 2.0 * rays.view.parameters.max_radius_m
}

/// Returns a circle that touches the points and is as flat as a line.
fn nearly_flat(moments: &ArcMoments) -> ArcFit {
    let mean = moments.mean();
    let away = 1.0 / (mean[0] * mean[0] + mean[1] * mean[1]).sqrt();
    let circle = Circle { center: mean.map(|x| x * (1.0 + STRAIGHT_M * away)), radius: STRAIGHT_M };
    let line_square = moments.line_square();
    ArcFit { line_square, circle_square: line_square, circle }
}

/// Returns where a segment ends before something behind it, for the sides on which it ends its run; 0 elsewhere. The contour is
/// half a pixel beyond its last pixel; `contours.rs` estimates from all objects how much of its edge the sensor loses. Only a
/// jump counts, because the same surface may continue beyond a hole. A pixel between two jumps belongs to neither side, and the
/// contour is in its middle.
fn contour(rays: &Rays, segment: &Segment) -> [f64; 2] {
    let max_hole_px = rays.view.parameters.max_hole_px;
    let end = |is_end: bool, point: usize, [next, after]: [Option<(u32, u16)>; 2], half: f64| {
        let jumps = rays.view.jumps(rays.points.pairs.get(point).copied());
        let (pixel, depth) = (rays.points.pixels[point], rays.points.depths[point]);
        let (there, other) = next.filter(|_| is_end)?;
        let is_alone = |beyond: u32, farther: u16| beyond.abs_diff(pixel) == 2 && jumps.splits(other, farther, 1);
        let across = after.filter(|(beyond, farther)| is_alone(*beyond, *farther));
        let (there, other) = across.unwrap_or((there, other));
        let is_behind = other > depth && jumps.splits(depth, other, there.abs_diff(pixel).min(max_hole_px + 1));
        is_behind.then(|| f64::from(pixel) + if across.is_some() { 2.0 * half } else { half })
    };
    let ([starts_run, ends_run], [before, behind]) = (reaches_ends(rays, segment), rays.points.neighbors);
    [end(starts_run, 0, before, -0.5), end(ends_run, rays.length - 1, behind, 0.5)].map(Option::unwrap_or_default)
}

/// Returns whether a segment starts and ends its run.
fn reaches_ends(rays: &Rays, segment: &Segment) -> [bool; 2] {
    [segment.from == rays.inner.start, segment.to == rays.inner.end]
}

/// Returns whether a segment is everything between two jumps or creases.
fn is_whole(rays: &Rays, segment: &Segment) -> bool {
    let [starts_run, ends_run] = reaches_ends(rays, segment);
    let is_open = starts_run && rays.points.open[0] || ends_run && rays.points.open[1];
    [segment.from, segment.to] == segment.part && !is_open
}

/// Returns a segment without the ends that may belong to something else: pixels at a jump mix two depths, and a segment that ends
/// within its run may include a point of the next one.
fn trimmed(run: &Run, segment: &Segment) -> Range<usize> {
    let &Segment { from, to, .. } = segment;
    let [before, behind] = reaches_ends(run, segment)
        .map(|is_end| (to - from) / POINTS_PER_SMEARED + if is_end { 0 } else { run.view.parameters.trim_px as usize });
    from + before..to.saturating_sub(behind).max(from + before)
}

/// Extends the points by the next one on either side if it was trimmed only because pixels at a jump may mix two depths, and if
/// its ray meets the circle through the others: such a point shows the surface where it curves most. Returns the points with
/// their circle and moments; `None` where there is no such point, or no circle explains them all.
fn with_ends(
    rays: &Rays,
    segment: &Segment,
    is_set_off: bool,
    points: &Range<usize>,
    circle: &Circle,
) -> Option<(Range<usize>, ArcFit, PlaneMoments)> {
    let meets = |point: usize| {
        let ([s, t], [x, y]) = (rays.point(point), circle.center);
        (s * y - t * x).powi(2) < circle.radius * circle.radius * (s * s + t * t)
    };
    let [starts_run, ends_run] = reaches_ends(rays, segment);
    let first = if starts_run { 0 } else { segment.part[0] };
    let end = if ends_run { rays.length } else { segment.part[1] };
    let before = segment.from == segment.part[0] && first < points.start && meets(points.start - 1);
    let behind = segment.to == segment.part[1] && end > points.end && meets(points.end);
    let wider = points.start - usize::from(before)..points.end + usize::from(behind);
    if wider == *points {
        return None;
    }
    let moments = all_moments(rays, &wider);
    let sums = ArcMoments::of(&moments)?;
    let fit = sums.fit();
    if fit.circle_square > rays.limit(wider.start, wider.end) {
        return None;
    }
    let fit = match self::circle(rays, is_set_off, &wider, &sums, fit) {
        Err(_) if circle.radius >= STRAIGHT_M => nearly_flat(&sums),
        fit => fit.ok()?,
    };
    Some((wider, fit, moments))
}

fn message(rays: &Rays, image: &[u16], points: Range<usize>, fit: &ArcFit, moments: &PlaneMoments) -> Ellipse {
    let [first, last] = [points.start, points.end - 1];
    let radius = fit.circle.radius;
    let variance_ratio = rays.variance_ratio(points.clone());
    let beyond = rays.view.parameters.trim_px + 1;
    let from_front = |point: usize| {
        let [s, t] = rays.point(point);
        (s - fit.circle.center[0]).atan2(fit.circle.center[1] - t)
    };
    Ellipse {
        scan: scan_code(rays.view.scan),
        line: rays.line.number,
        first: rays.pixel(first),
        last: rays.pixel(last),
        points: points.len() as u32,
        sigma: (rays.averaged_variance((first + last) / 2) * variance_ratio).sqrt(),
        correlation_px: rays.view.correlation_px[0],
        shared_lines: rays.view.correlation_px[1] / variance_ratio,
        averaged_lines: rays.view.averaged_lines / variance_ratio,
        beyond_px: beyond,
        unbiased: 1,
        center: rays.plane().to_camera(fit.circle.center).into(),
        plane_center: fit.circle.center,
        semi_axes: [radius; 2],
        half_width: radius,
        half_depth: radius,
        rms: fit.circle_square.max(0.0).sqrt(),
        arc: (from_front(last) - from_front(first)).abs(),
        beyond: [
            depth_at(rays, image, i64::from(rays.pixel(first)) - i64::from(beyond)),
            depth_at(rays, image, i64::from(rays.pixel(last)) + i64::from(beyond)),
        ],
        ends: [false, true].map(|from_last| outermost(rays, &points, from_last)),
        origin: moments.origin(),
        moments: *moments.sums(),
        ..Ellipse::default()
    }
}

/// Returns the depths of the outermost points of an arc at one end, on neighbouring pixels; 0 beyond those.
fn outermost(rays: &Rays, points: &Range<usize>, from_last: bool) -> [f64; END_POINTS] {
    let point = |inwards: usize| if from_last { points.end - 1 - inwards } else { points.start + inwards };
    let end = i64::from(rays.pixel(point(0)));
    let is_next = |inwards: &usize| i64::from(rays.pixel(point(*inwards))).abs_diff(end) == *inwards as u64;
    let mut depths = [0.0; END_POINTS];
    // No point is reported at both ends.
    for inwards in (0..END_POINTS.min(points.len() / 2)).take_while(is_next) {
        depths[inwards] = rays.points.metres[point(inwards)];
    }
    depths
}

/// Returns the depth of a pixel of the line; 0 without a measurement.
fn depth_at(rays: &Rays, image: &[u16], pixel: i64) -> f64 {
    rays.view.depth(image, rays.line.number, pixel).unwrap_or(0.0)
}
