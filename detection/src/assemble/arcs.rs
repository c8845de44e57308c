//! The arcs of a message, prepared for pooling, and the relation of neighbours among them.

use crate::camera::{pinhole, scan};
use crate::extract::LEAST_VARIANCE;
use conicflow_geometry::{
    Coefficients, ContourPoint, Pinhole, PlaneMoments, RaySums, Scan, ScanPlane, SpaceMoments, Vector3, bulge,
    gradient, meets, section_about,
};
use conicflow_messages::{END_POINTS, Ellipse, Header};
use std::array;
use std::f64::consts::FRAC_PI_8;
use std::iter;
use std::mem;
use std::ops::Range;
use std::sync::OnceLock;

/// Steepest slope of a surface from line to line, as depth per distance across the view.
const MAX_LINE_SLOPE: f64 = 5.0; // [tuned]
/// Standard deviations by which the mean depths of arcs of one surface may differ beyond what its slope explains.
const DEPTH_SIGMAS: f64 = 4.0; // [sigmas]
/// Difference by which the mean depths of two arcs of one surface may differ for each pixel by which one of them is longer, in
/// widths of a pixel: the points of half a circle lie on average `pi / 8` of its width before its centre.
const DEPTH_PER_PIXEL: f64 = FRAC_PI_8; // [derived]

/// An arc with the data that the assembler needs.
#[derive(Clone, Debug)]
pub(crate) struct Arc {
    pub scan: Scan,
    /// Number of the line among those that were searched.
    pub line: u32,
    /// First and last pixel along the line.
    pub pixels: [i64; 2],
    pub plane: ScanPlane,
    moments: PlaneMoments,
    /// Depths of the outermost points of either end, from the end inwards; 0 where there is none.
    ends: [[f64; END_POINTS]; 2],
    /// Variance of a depth for which the moments were corrected, in square metres; 0: they were not.
    corrected: f64,
    /// The moments in space, computed at their first use.
    space: OnceLock<SpaceMoments>,
    /// Number of points.
    pub count: u32,
    /// Number of independent points along the line, to which the moments are scaled.
    pub points: f64,
    /// Variance of a point along its ray, at the depth of the arc, in square metres.
    pub variance: f64,
    /// Mean of the points.
    pub mean: Vector3,
    /// Centre of the circle through the points.
    pub center: Vector3,
    /// Angle that the points span about the centre of the circle.
    pub angle: f64,
    /// Change of a ray of depth one from pixel to pixel of the line, and from line to line.
    steps: [Vector3; 2],
    /// Slopes of the rays through the first and the last pixel.
    pub rays: [f64; 2],
    /// Whether the pixel beyond the end has no measurement, for either end.
    pub unseen: [bool; 2],
    /// Point where the surface ends before something farther, for either end.
    pub contour: [Option<ContourPoint>; 2],
    /// Distance at the depth of the arc between neighbouring pixels of the line, in metres.
    pub pitch: f64,
    /// Distance at the depth of the arc between neighbouring lines that were searched, in metres.
    pub spacing: f64,
    /// Number of neighbouring pixels of the line that share their noise, at least 1.
    pub correlation_px: f64,
    /// Number of neighbouring lines that share their noise, at least 1.
    pub shared_lines: f64,
    /// Number of neighbouring lines that share the noise of their contour, which is not averaged over lines.
    pub contour_lines: f64,
    /// Gain of the circle over a line: the difference of their mean squares, in points times variances.
    pub bulge: f64,
}

/// Residuals of the points of an arc from a surface.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Residual {
    /// Mean square distance, without that of the noise.
    pub square: f64,
    /// Mean distance, positive outside.
    pub mean: f64,
}

impl Arc {
    /// Reads an arc of an image of which every `step`th line was searched; `None` without points.
    fn new(header: &Header, ellipse: &Ellipse, step: u32) -> Option<Self> {
        let (camera, scan) = (pinhole(&header.camera), scan(ellipse));
        let plane = camera.plane(scan, f64::from(ellipse.line));
        let shared = ellipse.points_per_sample();
        let moments = PlaneMoments::from_sums(ellipse.origin, ellipse.moments.map(|m| m / shared));
        let mean = plane.to_camera(moments.mean()?);
        let ray = |pixel: f64| camera.ray_slope(scan, pixel);
        let (first, last) = (f64::from(ellipse.first), f64::from(ellipse.last));
        let sigma = ellipse.sigma;
        let (corrected, variance) = match ellipse.unbiased {
            0 => (0.0, header.noise.variance(mean.z)),
            _ => (sigma * sigma, sigma * sigma),
        };
        let variance = (variance * plane.stretch().powi(2)).max(LEAST_VARIANCE);
        let steps = steps(&camera, &plane);
        let (pitch, spacing) = (camera.pixel_pitch(scan), camera.line_pitch(scan) * f64::from(step));
        let shared_lines = (ellipse.shared_lines / f64::from(step)).max(1.0);
        Some(Self {
            scan,
            line: ellipse.line / step,
            pixels: [i64::from(ellipse.first), i64::from(ellipse.last)],
            plane,
            moments,
            ends: ellipse.ends,
            corrected,
            space: OnceLock::new(),
            count: ellipse.points,
            points: moments.count(),
            variance,
            mean,
            center: Vector3::from(ellipse.center),
            angle: ellipse.arc,
            rays: [ray(first), ray(last)],
            unseen: ellipse.beyond.map(|depth| depth == 0.0),
            contour: contour(&camera, &plane, &steps, &ellipse.contour),
            steps,
            pitch: mean.z * pitch,
            spacing: mean.z * spacing,
            correlation_px: ellipse.correlation_px.max(1.0),
            shared_lines,
            contour_lines: (shared_lines / ellipse.averaged_lines.max(1.0)).max(1.0),
            bulge: bulge(&moments, variance),
        })
    }

    /// Returns the moments in space, about the camera centre. Most arcs never need them.
    pub fn space(&self) -> &SpaceMoments {
        self.space.get_or_init(|| SpaceMoments::of_arc(&self.plane, &self.moments))
    }

    /// Returns the residuals of the points from the quadric `q`.
    pub fn residual(&self, q: &Coefficients) -> Residual {
        let conic = section_about(q, &self.plane, self.moments.origin());
        let c = &conic.coefficients;
        let m = |p, q| self.moments.get(p, q);
        let sum = c[0] * m(2, 0) + c[1] * m(1, 1) + c[2] * m(0, 2) + c[3] * m(1, 0) + c[4] * m(0, 1) + c[5] * m(0, 0);
        Residual { square: conic.square_sum(&self.moments) / self.points, mean: sum / self.points }
    }

    /// Returns whether rays enter the surface `q` at the arc. An open object is also seen from inside, where its far wall has the
    /// same surface.
    pub fn faces(&self, q: &Coefficients) -> bool {
        gradient(q, &self.mean).dot(&self.mean) < 0.0
    }

    /// Returns the depth at which a ray of the scan line, of slope `x`, first meets a quadric; `section` is the conic in which
    /// the plane of the line cuts it.
    pub fn hit(&self, section: &[f64; 6], x: f64) -> Option<f64> {
        let [ss, st, tt, s, t, one] = *section;
        let k = self.plane.stretch();
        let (a, b) = (ss * x * x + st * x * k + tt * k * k, s * x + t * k);
        let discriminant = b * b - 4.0 * a * one;
        // No hit, or one at a great distance. [algorithmic]
        if discriminant <= 0.0 || a.abs() < 1e-12 {
            return None;
        }
        let near = (-b - discriminant.sqrt().copysign(a)) / (2.0 * a);
        (near > 0.0).then_some(near)
    }

    /// Returns the moments of the outermost points of each end that lie outside the outline of the surface `q`, or within
    /// `edge_px` pixels of it. A sensor that shifts the silhouette gives such points the depth of the object beside them, or of
    /// its parts farther in.
    pub fn outside(&self, q: &Coefficients, edge_px: f64) -> impl Iterator<Item = SpaceMoments> {
        let step = self.pitch / self.mean.z;
        [(0, step), (1, -step)].into_iter().filter_map(move |(end, inwards)| {
            let depths = &self.ends[end];
            let slopes: [f64; END_POINTS] = array::from_fn(|n| self.rays[end] + n as f64 * inwards);
            let is_outside = |(slope, depth): &(&f64, &f64)| **depth > 0.0 && self.is_edge(q, edge_px, **slope);
            let points = slopes.iter().zip(depths).take_while(is_outside).count();
            (points > 0).then(|| self.part(&slopes[..points], &depths[..points]))
        })
    }

    /// Returns whether its middle lies outside the outline of the surface `q`, or within `edge_px` pixels of it.
    pub fn grazes(&self, q: &Coefficients, edge_px: f64) -> bool {
        self.is_edge(q, edge_px, 0.5 * (self.rays[0] + self.rays[1]))
    }

    /// Returns whether the ray of slope `x` misses the surface `q`, or one of the rays that are `edge_px` pixels beside it, along
    /// the line or across.
    fn is_edge(&self, q: &Coefficients, edge_px: f64, x: f64) -> bool {
        let ray = self.plane.to_camera([x, self.plane.stretch()]);
        let [along, across] = self.steps.map(|step| step * edge_px);
        let beside = || [along, -along, across, -across].into_iter().any(|step| !meets(q, &(ray + step)));
        !meets(q, &ray) || (edge_px > 0.0 && beside())
    }

    /// Returns the part of some points in the moments, given the slopes of their rays.
    fn part(&self, slopes: &[f64], depths: &[f64]) -> SpaceMoments {
        let sums = RaySums::of(iter::once((slopes, depths, self.corrected)));
        let moments = sums.moments(self.plane.stretch());
        let weight = self.points / f64::from(self.count.max(1));
        let counted = moments.sums().map(|sum| sum * weight);
        SpaceMoments::of_arc(&self.plane, &PlaneMoments::from_sums(moments.origin(), counted))
    }

    /// Returns the point of depth `z` on the ray of slope `x`.
    pub fn point(&self, x: f64, z: f64) -> Vector3 {
        self.plane.to_camera([x * z, self.plane.stretch() * z])
    }

    /// Returns the number of pixels along the line that both have; negative for a gap between them.
    pub fn overlap(&self, pixels: [i64; 2]) -> i64 {
        self.pixels[1].min(pixels[1]) - self.pixels[0].max(pixels[0]) + 1
    }
}

/// Returns the change of a ray of depth one from pixel to pixel of a line, and from line to line.
fn steps(camera: &Pinhole, plane: &ScanPlane) -> [Vector3; 2] {
    let [along_rows, along_columns] = [Vector3::x() / camera.fx, Vector3::y() / camera.fy];
    match plane.scan() {
        Scan::Row => [along_rows, along_columns],
        Scan::Column => [along_columns, along_rows],
    }
}

fn contour(
    camera: &Pinhole,
    plane: &ScanPlane,
    &[pixel, across]: &[Vector3; 2],
    pixels: &[f64; 2],
) -> [Option<ContourPoint>; 2] {
    let ray = |pixel: f64| plane.to_camera([camera.ray_slope(plane.scan(), pixel), plane.stretch()]);
    let point = |end: usize| ContourPoint { ray: ray(pixels[end]), pixel, across, side: end };
    [0, 1].map(|end| (pixels[end] > 0.0).then(|| point(end)))
}

/// The arcs of one image in the order of scan, line and pixel; the buffers are used again for the next.
#[derive(Debug, Default)]
pub(crate) struct Arcs {
    pub arcs: Vec<Arc>,
    /// The pixels of each arc again, close together in memory: most lookups need nothing else.
    pixels: Vec<[i64; 2]>,
    /// For rows and columns: index of the first arc of each line, and the end.
    starts: [Vec<usize>; 2],
}

impl Arcs {
    pub fn read(&mut self, header: &Header, ellipses: &[Ellipse]) {
        self.arcs.clear();
        let step = ellipses.iter().map(Ellipse::step).min().unwrap_or(1);
        self.arcs.extend(ellipses.iter().filter_map(|ellipse| Arc::new(header, ellipse, step)));
        self.arcs.sort_unstable_by_key(|arc| (arc.scan == Scan::Column, arc.line, arc.pixels[0]));
        self.pixels.clear();
        self.pixels.extend(self.arcs.iter().map(|arc| arc.pixels));
        let lines = [header.camera.height, header.camera.width].map(|lines| lines.div_ceil(step) as usize);
        let mut next = 0;
        for (starts, (lines, scan)) in self.starts.iter_mut().zip(lines.into_iter().zip([Scan::Row, Scan::Column])) {
            starts.clear();
            for line in 0..=lines {
                while self.arcs.get(next).is_some_and(|arc| arc.scan == scan && (arc.line as usize) < line) {
                    next += 1;
                }
                starts.push(next);
            }
        }
    }

    /// Returns the arcs with these indices.
    pub fn of<'a>(&'a self, indices: &'a [usize]) -> impl Iterator<Item = &'a Arc> + Clone {
        indices.iter().map(|&index| &self.arcs[index])
    }

    /// Returns the number of neighbouring lines that share their noise, on average over some arcs, of which there is at least
    /// one.
    pub fn shared_lines(&self, indices: &[usize]) -> f64 {
        self.of(indices).map(|arc| arc.shared_lines).sum::<f64>() / indices.len() as f64
    }

    /// Returns the number of neighbouring lines that share the noise of their contour, on average over some arcs.
    pub fn contour_lines(&self, indices: &[usize]) -> f64 {
        self.of(indices).map(|arc| arc.contour_lines).sum::<f64>() / indices.len() as f64
    }

    /// Returns whether an arc has any of these pixels.
    pub fn reaches(&self, index: usize, [first, last]: [i64; 2]) -> bool {
        let [start, end] = self.pixels[index];
        start <= last && end >= first
    }

    /// Returns the first and the last pixel of some arcs.
    pub fn span(&self, indices: &[usize]) -> Option<[i64; 2]> {
        indices.iter().map(|&index| self.pixels[index]).reduce(|[a, b], [c, d]| [a.min(c), b.max(d)])
    }

    /// Returns the indices of the arcs of a line.
    pub fn on_line(&self, scan: Scan, line: i64) -> Range<usize> {
        let starts = &self.starts[usize::from(scan == Scan::Column)];
        match usize::try_from(line) {
            Ok(line) if line + 1 < starts.len() => starts[line]..starts[line + 1],
            _ => 0..0,
        }
    }

    /// Returns the arc beside `index` that is most likely of the same surface, at most `gap` lines on in the direction `side` (1
    /// or -1): in the nearest line that has arcs at the same depth, the one with the most columns in common.
    pub fn beside(&self, index: usize, side: i64, gap: i64, free: impl Fn(usize) -> bool + Copy) -> Option<usize> {
        let arc = &self.arcs[index];
        (1..=gap).find_map(|distance| {
            let near = self.adjoining(index, side * distance, free);
            near.max_by_key(|&other| arc.overlap(self.arcs[other].pixels))
        })
    }

    /// Adds to `surface` all free arcs that are connected with those in it, directly or through other free arcs, over at most
    /// `gap` lines each; none is added twice. `reached` is a buffer.
    pub fn connect(
        &self,
        surface: &mut Vec<usize>,
        reached: &mut Vec<bool>,
        gap: i64,
        free: impl Fn(usize) -> bool + Copy,
    ) {
        reached.clear();
        reached.resize(self.arcs.len(), false);
        surface.iter().for_each(|&arc| reached[arc] = true);
        let mut next = 0;
        while let Some(&arc) = surface.get(next) {
            for by in (1..=gap).flat_map(|distance| [-distance, distance]) {
                surface.extend(self.adjoining(arc, by, free).filter(|&other| !mem::replace(&mut reached[other], true)));
            }
            next += 1;
        }
    }

    /// Returns the free arcs in the line `by` lines from an arc that may belong to the same surface.
    fn adjoining(&self, index: usize, by: i64, free: impl Fn(usize) -> bool + Copy) -> impl Iterator<Item = usize> {
        let arc = &self.arcs[index];
        let line = self.on_line(arc.scan, i64::from(arc.line) + by);
        line.filter(move |&other| free(other) && self.touches(arc, &self.arcs[other]))
    }

    /// Returns whether two arcs of near lines may belong to one surface.
    fn touches(&self, a: &Arc, b: &Arc) -> bool {
        let lines = f64::from(a.line.abs_diff(b.line));
        let step = MAX_LINE_SLOPE * lines * a.spacing + DEPTH_SIGMAS * (a.variance / a.points.min(b.points)).sqrt();
        // The mean of a wider arc lies farther back, at most by that of half a circle.
        let wider = DEPTH_PER_PIXEL * (a.pixels[1] - a.pixels[0]).abs_diff(b.pixels[1] - b.pixels[0]) as f64 * a.pitch;
        a.overlap(b.pixels) > 0 && (a.mean.z - b.mean.z).abs() <= step + wider
    }
}

#[cfg(test)]
mod tests {
    use super::super::tests::{arcs_from, arcs_of, ellipses_of_a_can, rows_of, straight, wall};
    use super::*;
    use conicflow_geometry::{Conical, Sphere, Surface as _, section_of};
    use conicflow_lab::rendered::{KINECT_HALF, sphere};
    use conicflow_messages::NoiseModel;
    use std::f64::consts::PI;

    /// A can that leans in all directions, at a distance of a metre.
    fn leaning() -> Conical {
        let axis = Vector3::new(0.5, 0.6, 0.4).normalize();
        Conical { point: Vector3::new(0.02, -0.05, 1.0), axis, radius: 0.1, slope: 0.0 }
    }

    /// Distance of a point from the can, as its function F gives it.
    fn off(can: &Conical, point: &Vector3) -> f64 {
        let across = point - can.anchored(point).point;
        (across.norm_squared() - can.radius.powi(2)) / (2.0 * can.radius)
    }

    #[test]
    fn lines_are_counted_as_they_were_looked_at() {
        let of = |line_step: u32| {
            let told = |line: u32| Ellipse { line_step, shared_lines: 8.0, ..straight(line, 150, 1.0) };
            let arcs = arcs_from(&[told(100), told(104)]);
            let [first, next] = &arcs.arcs[..] else { panic!("{arcs:?}") };
            (next.line - first.line, first.spacing / first.pitch, first.shared_lines, arcs.beside(0, 1, 1, |_| true))
        };
        assert_eq!(of(1), (4, 1.0, 8.0, None));
        assert_eq!(of(4), (1, 4.0, 2.0, Some(1)), "there is none between them");
    }

    #[test]
    fn the_noise_of_an_arc_is_that_along_its_rays_as_it_was_measured_or_else_the_sensors() {
        let sigma = 0.004;
        for line in [0, 119, 239] {
            let measured = Ellipse { sigma, unbiased: 1, ..straight(line, 150, 1.0) };
            let arcs = arcs_from(&[measured, straight(line, 180, 1.0)]);
            let along = 1.0 + ((f64::from(line) - KINECT_HALF.cy) / KINECT_HALF.fy).powi(2);
            let expected = [sigma * sigma, NoiseModel::KINECT_V1.variance(arcs.arcs[1].mean.z)];
            for (arc, variance) in arcs.arcs.iter().zip(expected) {
                assert!((arc.variance / (variance * along) - 1.0).abs() < 1e-9, "{line}: {}", arc.variance);
            }
        }
    }

    #[test]
    fn an_end_is_unseen_where_no_depth_is_beyond_it_and_has_a_contour_where_one_is_told() {
        for side in [0, 1] {
            let mut ellipse = straight(120, 150, 1.0);
            (ellipse.beyond[side], ellipse.contour[side]) = (2.0, 170.5);
            let arc = &arcs_from(&[ellipse]).arcs[0];
            assert_eq!((arc.unseen[side], arc.unseen[1 - side], arc.contour[1 - side]), (false, true, None));
            let point = arc.contour[side].unwrap();
            assert!((point.ray.x / point.ray.z - 11.0 / KINECT_HALF.fx).abs() < 1e-12 && point.side == side);
        }
    }

    #[test]
    fn the_misfit_of_an_arc_is_that_of_its_points() {
        let can = leaning();
        for line in [0, 200] {
            let plane = pinhole(&KINECT_HALF).plane(Scan::Row, f64::from(line));
            let away = |i: u32| 0.9 + 0.01 * (f64::from(i) * 1.7).sin();
            let points: Vec<_> = (0..20).map(|i| [f64::from(i) / 290.0 * away(i), plane.stretch() * away(i)]).collect();
            let moments = PlaneMoments::of([0.05, 0.9], points.iter().copied());
            let ellipse = Ellipse { origin: moments.origin(), moments: *moments.sums(), ..straight(line, 160, 0.0) };
            let found = arcs_from(&[ellipse]).arcs[0].residual(&can.coefficients());
            let mean = |of: &dyn Fn(f64) -> f64| {
                points.iter().map(|point| of(off(&can, &plane.to_camera(*point)))).sum::<f64>() / 20.0
            };
            assert!((found.mean - mean(&|off| off)).abs() < 1e-12, "{found:?} in line {line}");
            assert!((found.square - mean(&|off| off * off)).abs() < 1e-12, "{found:?} in line {line}");
        }
    }

    #[test]
    fn a_ray_that_meets_what_leans_enters_it_from_outside_and_others_pass_by_its_side() {
        let can = leaning();
        let mut met = [0; 2];
        for arc in &arcs_from(&[0, 60, 120, 180, 239].map(|line| straight(line, 150, 1.0))).arcs {
            let section = section_of(&can.coefficients(), &arc.plane);
            for x in (-20..=20).map(|i| 0.02 * f64::from(i)) {
                let found = arc.hit(&section, x);
                if let Some(z) = found {
                    assert!(
                        off(&can, &arc.point(x, z)).abs() < 1e-9 && off(&can, &arc.point(x, z - 1e-3)) > 0.0,
                        "{x}"
                    );
                } else {
                    let both = arc.point(x, 1.0).cross(&can.axis);
                    assert!(both.dot(&can.point).abs() >= can.radius * both.norm(), "{x}");
                }
                met[usize::from(found.is_some())] += 1;
            }
        }
        assert!(met.iter().all(|count| *count > 20), "{met:?}");
    }

    #[test]
    fn no_more_points_lie_outside_than_are_told() {
        let (header, mut ellipses) = ellipses_of_a_can();
        ellipses.iter_mut().flat_map(|ellipse| &mut ellipse.ends).for_each(|end| end[2..].fill(0.0));
        let mut arcs = Arcs::default();
        arcs.read(&header, &ellipses);
        let far_off = Sphere { center: Vector3::new(3.0, 0.0, 2.0), radius: 0.1 }.coefficients();
        let arc = arcs.arcs.iter().find(|arc| arc.line == 120).unwrap();
        let counted = |end: SpaceMoments| end.weight() * f64::from(arc.count) / arc.points;
        let outside: Vec<_> = arc.outside(&far_off, 0.0).map(counted).collect();
        assert!(outside.len() == 2 && outside.iter().all(|count| (count - 2.0).abs() < 1e-9), "{outside:?}");
    }

    #[test]
    fn a_line_grazes_a_surface_if_its_middle_is_near_the_outline() {
        let ball = Sphere { center: Vector3::new(0.4, 0.0, 1.5), radius: 0.15 };
        let arcs = arcs_of(&[sphere(ball.center, ball.radius), wall(4.0)]);
        let rows = rows_of(&arcs, |arc| arc.mean.z < 2.0);
        let grazing = |edge_px: f64| {
            let lines = arcs.of(&rows).enumerate().filter(|(_, arc)| arc.grazes(&ball.coefficients(), edge_px));
            lines.map(|(line, _)| line).collect::<Vec<_>>()
        };
        let (near, last) = (grazing(3.0), rows.len() - 1);
        assert_eq!(grazing(0.0), [0; 0], "all of them show the ball");
        assert!(near.contains(&0) && near.contains(&last) && near.len() < 10 && last > 40, "{near:?} of {last}");
    }

    /// Over two lines the steepest surface falls by five times their distance; the mean of four points has half the standard
    /// deviation of one; and the points of a circle lie before its centre by an eighth of pi of its width.
    #[test]
    fn depths_of_one_surface_differ_by_its_slope_by_noise_and_by_how_much_longer_one_arc_is() {
        for (lines, spacing, sigma, longer, pitch) in
            [(2, 0.003, 0.0, 0, 0.001), (1, 0.0, 0.01, 0, 0.001), (1, 0.0, 0.0, 16, 0.002), (3, 0.004, 0.02, 30, 0.002)]
        {
            let mut ellipses = [straight(100, 150, 1.0), straight(100 + lines, 150, 1.0)];
            ellipses[1].last += longer;
            let touch = |apart: f64| {
                let mut arcs = arcs_from(&ellipses);
                for (arc, (points, z)) in arcs.arcs.iter_mut().zip([(100.0, 1.0), (4.0, 1.0 + apart)]) {
                    (arc.spacing, arc.variance, arc.pitch) = (spacing, sigma * sigma, pitch);
                    (arc.points, arc.mean.z) = (points, z);
                }
                let [one, other] = &arcs.arcs[..] else { panic!("{arcs:?}") };
                assert_eq!(arcs.touches(one, other), arcs.touches(other, one), "{apart}");
                arcs.touches(one, other)
            };
            let slope = 5.0 * f64::from(lines) * spacing;
            let most = slope + 4.0 * sigma / 2.0 + PI / 8.0 * f64::from(longer) * pitch;
            assert_eq!([0.99, 1.01, -0.99, -1.01].map(|part| touch(part * most)), [true, false, true, false], "{most}");
        }
    }

    #[test]
    fn a_ray_meets_a_surface_where_it_enters_it_and_one_that_passes_by_or_leaves_it_behind_meets_nothing() {
        let ball = Sphere { center: Vector3::new(0.05, -0.1, 1.5), radius: 0.2 };
        let arcs = arcs_of(&[sphere(ball.center, ball.radius), wall(2.5)]);
        let mut met = [0; 2];
        for arc in &arcs.arcs {
            let section = section_of(&ball.coefficients(), &arc.plane);
            let behind = Sphere { center: -ball.center, ..ball };
            let behind = section_of(&behind.coefficients(), &arc.plane);
            for x in (-20..=20).map(|i| 0.02 * f64::from(i)) {
                // On a ray of length 1: the distance to the foot of the centre, less half the chord.
                let ray = arc.plane.to_camera([x, arc.plane.stretch()]);
                let foot = ball.center.dot(&ray.normalize());
                let half_square = ball.radius.powi(2) - (ball.center.norm_squared() - foot * foot);
                let expected = (half_square > 0.0).then(|| (foot - half_square.sqrt()) / ray.norm());
                let found = arc.hit(&section, x);
                assert_eq!(found.is_some(), expected.is_some(), "{x}");
                assert!(found.zip(expected).is_none_or(|(found, expected)| (found - expected).abs() < 1e-9), "{x}");
                assert_eq!(arc.hit(&behind, x), None);
                met[usize::from(found.is_some())] += 1;
            }
        }
        assert!(met.iter().all(|count| *count > 100), "{met:?}");
    }
}
