//! Bias and noise of the contours of a sensor, learned from the objects that it sees.
//!
//! A sensor smears silhouettes, or loses pixels at grazing incidence. So its contours lie slightly beside the place where the ray
//! touches the surface: by different amounts in rows and in columns and on the two sides of a line, but by the same for all
//! objects. The amount is not known beforehand. But the points of an object determine its size without its contour. So each
//! object shows the bias of the contours and the scatter of their points, and later objects are measured more exactly.

use super::model::{Model, of_fit, pointing_from_apex, pool_within};
use super::region::Region;
use conicflow_geometry::{
    Contour, ContourBias, ContourNoise, GradientNoise, Information, Scan, Surface, SurfaceFit, fit_with_contour,
};
use conicflow_messages::{Camera, Object};
use nalgebra::{Matrix2, Matrix3, Matrix4, SMatrix, SVector, Vector2, Vector3, Vector4};
use std::ops::AddAssign;

/// Number of fits to the contour. Each fit uses the points within the outline of the previous model and the contour points near
/// that outline.
const PASSES: usize = 2; // [algorithmic]
/// Prior standard deviation of a contour point for an unknown sensor: the part that does not depend on the radius, in pixels. In
/// rendered frames of a Kinect and of a time-of-flight camera contour points scatter by half a pixel, by up to 1.2 pixels where a
/// sensor compares windows. The prior variance is given a standard deviation as large as itself.
const POINT_PX: f64 = 0.5; // [measured]
/// Prior standard deviation of a contour point for an unknown sensor: the part that is proportional to the radius, in radii. In
/// rendered frames of a Kinect and of a time-of-flight camera it is 1 to 2 %; 4 % leave a margin. The prior variance is given a
/// standard deviation as large as itself.
const POINT_SHARE: f64 = 0.04; // [tuned]
/// Least variance of a contour point, in square pixels: that of a uniform distribution within one pixel.
const LEAST_VARIANCE_PX: f64 = 1.0 / 12.0; // [derived]
/// Prior standard deviation of the offset of contours for an unknown sensor, in pixels.
const OFFSET_PX: f64 = 1.0; // [tuned]
/// Prior standard deviation of the bias of contours for an unknown sensor that is a share of the radius. In rendered frames a
/// whole contour lies up to 5 % of the radius too far in.
const SHARE: f64 = 0.05; // [tuned]
/// Prior standard deviation of the offset of contours, in pixels, that is added to [`OFFSET_PX`] (as squares) for each further
/// pixel that shares the noise of one: a sensor that compares windows of w pixels puts an edge anywhere within half a window,
/// which scatters it by (w - 1) / sqrt(12).
const WINDOW_OFFSET_PX: f64 = 0.288_675; // [derived]

/// Systematic error of the radius and centre of an object that the shared bias of contours does not explain: the part in radii.
/// It does not average out with more points. With this value, [`SYSTEMATIC_PX`] and [`FLATTENED_PX`] the errors over sigmas in
/// `experiments/detection.toml` and `experiments/simulated_sensors.toml` are near 1.
pub(super) const SYSTEMATIC: f64 = 0.0005; // [measured]
/// Systematic error of the radius and centre of an object that the shared bias of contours does not explain: the part in pixels,
/// where no neighbours share their noise.
pub(super) const SYSTEMATIC_PX: f64 = 0.04; // [measured]
/// Systematic error of the radius and centre of an object, in pixels, for each further pixel that shares the noise of one:
/// comparing windows flattens round surfaces at their silhouettes.
pub(super) const FLATTENED_PX: f64 = 0.06; // [measured]

/// Width of the strip inside the outline whose points the fit leaves out, in multiples of the expected outward bias of the
/// contour: a sensor that shows contours too far out also flattens the surface inside them. With 0 (no strip), 1, 2 and 3, 489,
/// 496, 503 and 503 of 520 objects are found in recordings (`experiments/README.md`, "The recorded ball").
const EDGE_WIDTH: f64 = 2.0; // [measured]

/// Gate on the displacement of an object, in standard deviations: an object that moved less counts as standing still.
const STILL_SIGMAS: f64 = 3.0; // [sigmas]
/// Weight of the prior that images of one object do not differ, in pairs of images (`NewShare`).
const UNCOMPARED: f64 = 10.0; // [tuned]
/// Number of images without an object after which it counts as another one when it is seen again, which bounds the work.
const RECENT_IMAGES: u32 = 30; // [tuned]

/// Fits models to contours, one object after another, with the bias and noise that earlier objects showed.
#[derive(Debug, Default)]
pub(crate) struct ContourCalibration {
    contour: Contour,
    camera: Camera,
    /// Evidence of each object of recent images.
    recent: Vec<ObjectEvidence>,
    /// Share of the evidence of an object that is new in each image.
    new_share: NewShare,
    /// Evidence of objects that are no longer in `recent`, in rows and in columns.
    before: [ContourEvidence; 2],
    /// Sum of all evidence, in rows and in columns.
    learned: [ContourEvidence; 2],
}

/// Evidence from the images of one object that stands still.
#[derive(Debug)]
struct ObjectEvidence {
    /// The object as it was last seen.
    object: Object,
    direction: usize,
    /// Mean evidence over the images of the object.
    learned: ContourEvidence,
    /// Number of images of the object, where old ones count less.
    images: f64,
    images_ago: u32,
    /// Weight that is left of the evidence, from 1 to 0.
    kept: f64,
}

/// Share of the variance of an object's evidence that is new in each image. The rest is the same in all images of the object: its
/// own part of the bias, and noise that stays.
#[derive(Debug, Default)]
struct NewShare {
    /// Sum of squared differences between an image and the mean over those before, in units of their variance if everything were
    /// new in each image.
    squares: f64,
    /// Number of differences in `squares`.
    pairs: f64,
}

impl NewShare {
    /// Adds the differences between an image of an object and the mean over its earlier images.
    fn add(&mut self, before: &ObjectEvidence, now: &ContourEvidence) {
        for side in [0, 1].into_iter().filter(|side| now.points[*side] > 0.0 && before.learned.points[*side] > 0.0) {
            let radius_px = now.radii_px[side] / now.points[side];
            let [(a, variance_a), (b, variance_b)] =
                [now, &before.learned].map(|learned| learned.outside(side, radius_px));
            let square = (a - b).powi(2) / (variance_a + variance_b / before.images);
            // Skips evidence without weight, such as that of another camera, and sides that no point determines.
            if before.kept > 0.0 && square.is_finite() {
                self.squares += square;
                self.pairs += 1.0;
            }
        }
    }

    fn times(&self, times: f64) -> Self {
        Self { squares: self.squares * times, pairs: self.pairs * times }
    }

    /// Returns how many independent images this number of images of one object is worth.
    fn count(&self, images: f64) -> f64 {
        let share = (self.squares / (self.pairs + UNCOMPARED)).min(1.0);
        1.0 / (1.0 - share + share / images)
    }
}

/// Evidence of objects on contours.
#[derive(Clone, Copy, Debug, Default)]
struct ContourEvidence {
    /// Evidence on the bias: offset and share of the first side, then of the last.
    bias: Information<4>,
    /// Evidence on the variance of contour points: in square pixels, and in squared radii.
    noise: Information<2>,
    /// Number of objects, where those of earlier images have less weight.
    objects: f64,
    /// Number of contour points on each side, and the sum of the radii of curvature there, in pixels.
    points: [f64; 2],
    radii_px: [f64; 2],
    /// Number of further pixels that share the noise of one, from the newest object.
    further_px: f64,
}

/// Errors of the contours of a sensor in rows or in columns, estimated from its objects.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ContourErrors {
    /// Rows or columns.
    pub scan: Scan,
    /// Number of objects behind the estimate. Those of earlier images have less weight (`contour_memory`), and an object that
    /// stands still counts for as many independent images as its images are worth.
    pub objects: f64,
    /// Bias where lines begin (left, or at the top), and where they end.
    pub sides: [SideErrors; 2],
    /// Standard deviation of a contour point along its line: the part in pixels.
    pub scatter_px: f64,
    /// Standard deviation of a contour point along its line: the part in radii of curvature.
    pub scatter_share: f64,
}

/// Bias of the contours on one side: how far they lie outside the place where the ray touches the surface. It is an offset plus a
/// share of the radius of curvature of the surface along the view. Each value comes with its standard deviation; without evidence
/// it is near 0, with the standard deviation of an unknown sensor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SideErrors {
    /// Number of contour points behind the estimate, weighted as objects are.
    pub points: f64,
    /// Mean radius of curvature at the contour points, in pixels; 0 without points.
    pub radius_px: f64,
    /// Offset and its standard deviation, in pixels.
    pub offset_px: [f64; 2],
    /// Share of the radius and its standard deviation.
    pub share: [f64; 2],
    /// Offset and share together at the mean radius, and the standard deviation, in pixels. Objects of one size determine this
    /// far better than its two parts.
    pub outside_px: [f64; 2],
}

impl ContourCalibration {
    /// Discounts the evidence of earlier images before a new image, so that they count for `memory` images together; clears it if
    /// the image is of another camera.
    pub fn next_image(&mut self, camera: &Camera, memory: f64) {
        let kept = if *camera == self.camera { memory / (memory + 1.0) } else { 0.0 };
        self.camera = *camera;
        self.before = self.before.map(|learned| learned.times(kept));
        self.new_share = self.new_share.times(kept);
        let Self { recent, before, new_share, .. } = self;
        recent.retain_mut(|shown| {
            shown.kept *= kept;
            shown.images_ago += 1;
            let is_recent = shown.images_ago <= RECENT_IMAGES;
            if !is_recent {
                before[shown.direction] += shown.counted(new_share);
            }
            is_recent
        });
        self.sum_up();
    }

    fn sum_up(&mut self) {
        self.learned = self.before;
        self.recent.iter().for_each(|shown| self.learned[shown.direction] += shown.counted(&self.new_share));
    }

    /// Returns the errors of contours in rows and in columns, for each of both that has evidence.
    pub fn errors(&self) -> impl Iterator<Item = ContourErrors> {
        let scans = [Scan::Row, Scan::Column].into_iter().zip(&self.learned);
        scans.filter(|(_, learned)| learned.objects > 0.0).map(|(scan, learned)| learned.errors(scan))
    }

    /// Collects the contour of a region and selects the points near the contour of its model.
    fn select_points(&mut self, region: &Region) -> &Contour {
        self.contour.clear(self.noise(region));
        region.arcs().flat_map(|arc| arc.contour).flatten().for_each(|point| self.contour.add(point));
        let [from, to] = region.span_of_means();
        self.contour.select(&region.model.coefficients(), |point| (from..=to).contains(&region.along(point)));
        &self.contour
    }

    /// Fits the model of a region again, to its arcs and their contour; returns the model and the contour.
    pub fn fit(&mut self, region: &Region) -> Option<(Model, &Contour)> {
        let mut region = *region;
        for _ in 0..PASSES {
            let contour = self.select_points(&region);
            let moments = pool_within(&region, edge_px(contour)).normalized()?;
            region.model = match &region.model {
                Model::Sphere(fit) => Model::Sphere(fit_with_contour(&moments, contour, &fit.surface)?),
                Model::Cylinder(fit) => Model::Cylinder(fit_with_contour(&moments, contour, &fit.surface)?),
                Model::Cone(fit) => Model::Cone(pointing_from_apex(fit_with_contour(&moments, contour, &fit.surface)?)),
            };
        }
        Some((region.model, &self.contour))
    }

    /// Learns the bias and the scatter of contours from an object. If the object may have stood still since it was last seen, its
    /// images count for less than as many objects: its own part of the bias, and noise that stays, are the same in each of them.
    pub fn learn(&mut self, region: &Region, object: &Object) {
        let own = covariance(own_sigma_px(further_px(region)), SYSTEMATIC);
        let contour = self.select_points(region);
        let shown = of_fit!(&region.model, fit => shown(contour, fit, &region.gradient_noise(fit), &own));
        if let Some((bias, noise)) = shown {
            let sides = [0, 1].map(|side| contour.used_on(side));
            if sides.iter().all(|(points, _)| *points == 0) {
                return;
            }
            let points = sides.map(|(points, _)| points as f64);
            let radii_px = sides.map(|(points, radius_px)| points as f64 * radius_px);
            let learned =
                ContourEvidence { bias, noise, objects: 1.0, points, radii_px, further_px: further_px(region) };
            let direction = direction(region.ends()[0].scan);
            let still = |shown: &ObjectEvidence| shown.direction == direction && has_not_moved(&shown.object, object);
            let mut now = ObjectEvidence { object: *object, direction, learned, images: 1.0, images_ago: 0, kept: 1.0 };
            if let Some(index) = self.recent.iter().position(still) {
                let before = self.recent.remove(index);
                self.new_share.add(&before, &learned);
                now.add(&before);
            }
            self.recent.retain(|shown| !still(shown));
            self.recent.push(now);
            self.sum_up();
        }
    }

    /// Returns the noise of a region's contour; its bias has a part common to the sensor and a part of the object's own.
    fn noise(&self, region: &Region) -> ContourNoise {
        let further_px = further_px(region);
        let learned = &self.learned[direction(region.ends()[0].scan)];
        let (mean, common) = learned.bias_of_all(further_px);
        let bias = ContourBias { mean, covariance: common + covariance(own_sigma_px(further_px), SYSTEMATIC) };
        let (shared_lines, surface_lines) = (region.contour_lines(), region.shared_lines());
        ContourNoise { point: learned.variance(), shared_lines, surface_lines, bias }
    }
}

impl ObjectEvidence {
    /// Adds the earlier images of the object.
    fn add(&mut self, before: &Self) {
        let images = self.images + before.kept * before.images;
        self.learned = self.learned.times(self.images / images);
        self.learned += before.learned.times(1.0 - self.images / images);
        self.images = images;
    }

    /// Returns the evidence of all images of the object together, with their weight.
    fn counted(&self, new_share: &NewShare) -> ContourEvidence {
        let Self { learned, images, kept, .. } = *self;
        learned.times(kept * new_share.count(images))
    }
}

impl AddAssign for ContourEvidence {
    fn add_assign(&mut self, other: Self) {
        self.bias += other.bias;
        self.noise += other.noise;
        self.objects += other.objects;
        for side in [0, 1] {
            self.points[side] += other.points[side];
            self.radii_px[side] += other.radii_px[side];
        }
        self.further_px = other.further_px;
    }
}

impl ContourEvidence {
    /// Scales the evidence, as if observations counted so many times.
    fn times(self, times: f64) -> Self {
        Self {
            bias: self.bias * times,
            noise: self.noise * times,
            objects: self.objects * times,
            points: self.points.map(|points| points * times),
            radii_px: self.radii_px.map(|radii| radii * times),
            further_px: self.further_px,
        }
    }

    /// Returns the expectation and covariance of the bias that all objects share, where `further_px` further pixels share the
    /// noise of one.
    fn bias_of_all(&self, further_px: f64) -> (Vector4<f64>, Matrix4<f64>) {
        combined(self.bias, Vector4::zeros(), prior_covariance(further_px))
    }

    /// Returns how far contours of a side are off at a radius of curvature, in pixels, and the variance that the evidence (not
    /// the prior) gives this estimate.
    fn outside(&self, side: usize, radius_px: f64) -> (f64, f64) {
        let (mean, covariance) = self.bias_of_all(self.further_px);
        let mut parts = Vector4::zeros();
        (parts[2 * side], parts[2 * side + 1]) = (1.0, radius_px);
        let weights = covariance * parts;
        (parts.dot(&mean), weights.dot(&(self.bias.matrix * weights)))
    }

    /// Returns the variance of a contour point: a part in square pixels and a part in squared radii.
    fn variance(&self) -> Vector2<f64> {
        let expected = Vector2::new(POINT_PX, POINT_SHARE).map(|sigma| sigma * sigma);
        let (point, _) =
            combined(self.noise, expected, Matrix2::from_diagonal(&expected.map(|variance| variance * variance)));
        Vector2::new(point[0].max(LEAST_VARIANCE_PX), point[1].max(0.0))
    }

    /// Returns the errors in one direction of scanning.
    fn errors(&self, scan: Scan) -> ContourErrors {
        let (mean, covariance) = self.bias_of_all(self.further_px);
        let side = |side: usize| {
            let points = self.points[side];
            let radius_px = if points > 0.0 { self.radii_px[side] / points } else { 0.0 };
            // The bias is positive along the line: at the first pixel, outwards is negative.
            let outwards = [-1.0, 1.0][side];
            let estimate = |offset: f64, share: f64| {
                let mut parts = Vector4::zeros();
                (parts[2 * side], parts[2 * side + 1]) = (outwards * offset, outwards * share);
                [parts.dot(&mean), parts.dot(&(covariance * parts)).sqrt()]
            };
            let [offset_px, share, outside_px] = [estimate(1.0, 0.0), estimate(0.0, 1.0), estimate(1.0, radius_px)];
            SideErrors { points, radius_px, offset_px, share, outside_px }
        };
        let [scatter_px, scatter_share] = self.variance().map(f64::sqrt).into();
        ContourErrors { scan, objects: self.objects, sides: [side(0), side(1)], scatter_px, scatter_share }
    }
}

/// Returns what an object shows of the bias and of the noise of its sensor's contours; `own` is the covariance of the object's
/// own part of the bias. `None` where its points do not determine it.
fn shown<S: Surface<N>, const N: usize>(
    contour: &Contour,
    fit: &SurfaceFit<S, N>,
    scatter: &GradientNoise<N>,
    own: &Matrix4<f64>,
) -> Option<(Information<4>, Information<2>)> {
    Some((contour.bias_evidence(fit, scatter, own)?, contour.noise_evidence(&fit.surface)?))
}

/// Returns the posterior expectation and covariance of numbers with this prior, given the evidence `learned`.
fn combined<const N: usize>(
    learned: Information<N>,
    mean: SVector<f64, N>,
    covariance: SMatrix<f64, N, N>,
) -> (SVector<f64, N>, SMatrix<f64, N, N>) {
    let known = || (learned + Information::of(&mean, &covariance)?).estimate();
    known().unwrap_or((mean, covariance))
}

/// Returns the covariance of the bias of an unknown sensor, where `further_px` further pixels share the noise of one.
fn prior_covariance(further_px: f64) -> Matrix4<f64> {
    covariance(OFFSET_PX.hypot(WINDOW_OFFSET_PX * further_px), SHARE)
}

/// Returns the standard deviation of an object's own contour error in pixels, where `further_px` further pixels share the noise
/// of one.
fn own_sigma_px(further_px: f64) -> f64 {
    SYSTEMATIC_PX + FLATTENED_PX * further_px
}

/// Returns the width of the flattened strip inside the outline of an object, in pixels; 0 where the contour is not expected
/// outside.
pub(super) fn edge_px(contour: &Contour) -> f64 {
    EDGE_WIDTH * contour.outside_px()
}

/// Returns the number of further pixels that share the noise of one.
fn further_px(region: &Region) -> f64 {
    region.ends()[0].correlation_px - 1.0
}

/// Returns whether the displacement of an object is within the noise.
fn has_not_moved(before: &Object, now: &Object) -> bool {
    let covariance = [before, now].map(|object| Matrix3::from(object.sigma.center)).iter().sum::<Matrix3<f64>>();
    let moved = Vector3::from(now.center) - Vector3::from(before.center);
    covariance.cholesky().is_some_and(|root| moved.dot(&root.solve(&moved)) <= STILL_SIGMAS * STILL_SIGMAS)
}

/// Returns 0 for rows, 1 for columns.
fn direction(scan: Scan) -> usize {
    usize::from(scan == Scan::Column)
}

/// Returns the covariance of a bias whose offset and share have these standard deviations on both sides.
fn covariance(offset_px: f64, share: f64) -> Matrix4<f64> {
    Matrix4::from_diagonal(&Vector4::new(offset_px, share, offset_px, share).map(|sigma| sigma * sigma))
}

#[cfg(test)]
mod tests {
    use super::super::arcs::Arcs;
    use super::super::model;
    use super::super::tests::{arcs_of, wall};
    use super::*;
    use conicflow_lab::random::CounterRng;
    use conicflow_lab::rendered::{KINECT_HALF, sphere};
    use conicflow_messages::{ObjectKind, ObjectSigma};

    const CAMERA: Camera = Camera { width: 320, height: 240, fx: 262.5, fy: 262.5, cx: 159.5, cy: 119.5 };

    /// Evidence that columns showed of this camera: on the first side contours lie half a pixel and 1 % of the radius outwards,
    /// on the last half a pixel inwards and 2 % outwards.
    fn learned() -> ContourCalibration {
        let bias = Information::of(&Vector4::new(-0.5, -0.01, -0.5, 0.02), &covariance(1e-5, 1e-6)).unwrap();
        let learned = ContourEvidence {
            bias,
            objects: 3.0,
            points: [10.0, 4.0],
            radii_px: [200.0, 40.0],
            ..ContourEvidence::default()
        };
        let learned = [ContourEvidence::default(), learned];
        ContourCalibration { camera: CAMERA, before: learned, learned, ..ContourCalibration::default() }
    }

    #[test]
    fn biases_are_told_outwards_on_both_sides_and_together_at_the_mean_radius() {
        let told: Vec<_> = learned().errors().collect();
        let [ContourErrors { scan: Scan::Column, objects: 3.0, sides, .. }] = &told[..] else { panic!("{told:?}") };
        for (side, points, radius_px, offset, share) in [(0, 10.0, 20.0, 0.5, 0.01), (1, 4.0, 10.0, -0.5, 0.02)] {
            let found = &sides[side];
            assert_eq!((found.points, found.radius_px), (points, radius_px), "{side}");
            for (found, expected) in [
                (found.offset_px, [offset, 1e-5]),
                (found.share, [share, 1e-6]),
                (found.outside_px, [offset + share * radius_px, 1e-5_f64.hypot(1e-6 * radius_px)]),
            ] {
                assert!((found[0] - expected[0]).abs() < 1e-6, "{side}: {found:?} {expected:?}");
                assert!((found[1] / expected[1] - 1.0).abs() < 1e-6, "{side}: {found:?} {expected:?}");
            }
        }
    }

    #[test]
    fn what_was_learned_counts_less_with_each_image_and_nothing_with_another_camera() {
        let mut contours = learned();
        let points = |contours: &ContourCalibration| contours.errors().map(|told| (told.objects, told.sides)).next();
        let (_, before) = points(&contours).unwrap();
        contours.next_image(&CAMERA, 4.0);
        let (objects, sides) = points(&contours).unwrap();
        assert!((objects - 0.8 * 3.0).abs() < 1e-12);
        for (now, before) in sides.iter().zip(&before) {
            assert!(
                (now.points - 0.8 * before.points).abs() < 1e-12 && (now.radius_px - before.radius_px).abs() < 1e-9
            );
            assert!((now.offset_px[1] / before.offset_px[1] - 0.8_f64.sqrt().recip()).abs() < 1e-6, "{now:?}");
        }
        contours.next_image(&Camera { fx: 263.0, ..CAMERA }, 4.0);
        assert_eq!(points(&contours), None);
    }

    /// Radius of the ball in `ball`, in metres.
    const RADIUS: f64 = 0.2;
    /// Distance of the ball in `ball`, in metres.
    const DISTANCE: f64 = 1.5;

    /// The arcs of a ball before a wall, and the indices of those in rows or columns that lie on the ball.
    fn ball(scan: Scan) -> (Arcs, Vec<usize>) {
        let arcs = arcs_of(&[sphere(Vector3::z() * DISTANCE, RADIUS), wall(4.0)]);
        let is_of_it = |&index: &usize| arcs.arcs[index].scan == scan && arcs.arcs[index].mean.z < 2.0;
        let members = (0..arcs.arcs.len()).filter(is_of_it).collect();
        (arcs, members)
    }

    fn fitted<'a>(arcs: &'a Arcs, members: &'a [usize], contours: &mut ContourCalibration) -> Region<'a> {
        let model = model::fit(ObjectKind::Sphere, &arcs.of(members), None, f64::INFINITY).unwrap();
        let region = Region { arcs, model, members };
        Region { model: contours.fit(&region).unwrap().0, ..region }
    }

    /// The report on a ball at this place along x, in metres.
    fn ball_at(x: f64) -> Object {
        let sigma = ObjectSigma { center: Matrix3::from_diagonal_element(1e-4).into(), ..ObjectSigma::default() };
        Object {
            kind: ObjectKind::Sphere.code(),
            center: [x, 0.0, DISTANCE],
            radius: RADIUS,
            sigma,
            ..Object::default()
        }
    }

    #[test]
    fn an_object_whose_images_do_not_differ_counts_once_however_often_it_is_seen_in_its_place() {
        let ((arcs, members), mut contours) = (ball(Scan::Row), ContourCalibration::default());
        let region = fitted(&arcs, &members, &mut contours);
        let mut told = |objects: &[f64]| {
            contours.next_image(&CAMERA, 4.0);
            objects.iter().for_each(|&x| contours.learn(&region, &ball_at(x)));
            contours.errors().next().unwrap()
        };
        // The expected scatter is learned from the first images, so they are not compared.
        let often: Vec<_> = (0..20).map(|image| told(&[0.01 * f64::from(image)])).collect();
        let [before, after] = [10, 19].map(|image| often[image].sides[0].outside_px[1]);
        assert!((often[19].objects - 1.0).abs() < 1e-3 && (after / before - 1.0).abs() < 0.02, "{often:?}");
        let both = told(&[0.2, 1.0]);
        assert!((both.objects - 2.0).abs() < 1e-3, "{both:?}");
        assert!((both.sides[0].points / often[19].sides[0].points - 2.0).abs() < 1e-3, "{both:?}");
        let gone = told(&[1.0]);
        assert!((gone.objects - 1.8).abs() < 1e-3, "what is not seen any more counts less: {gone:?}");
        for _ in 0..RECENT_IMAGES {
            told(&[1.0]);
        }
        let again = told(&[0.2, 1.0]);
        assert!((again.objects - 2.0).abs() < 3e-3, "after long it is another one: {again:?}");
    }

    /// Images of one object in each of which a share of the variance is new.
    #[test]
    fn an_object_that_stands_still_counts_for_as_many_as_its_images_differ() {
        for share in [0.0_f64, 0.5, 1.0] {
            let (random, mut drawn) = (CounterRng::new(5, 0), 0..);
            let mut normal = |variance: f64| variance.sqrt() * random.gaussian(drawn.next().unwrap());
            let (mut new_share, mut told) = (NewShare::default(), 0.0);
            for _ in 0..20 {
                let own = Vector4::from_fn(|_, _| normal(0.01 * (1.0 - share)));
                let mut before: Option<ObjectEvidence> = None;
                for _ in 0..40 {
                    let seen = own + Vector4::from_fn(|_, _| normal(0.01 * share));
                    let bias = Information::of(&seen, &Matrix4::from_diagonal_element(0.01)).unwrap();
                    let learned = ContourEvidence {
                        bias,
                        objects: 1.0,
                        points: [9.0; 2],
                        radii_px: [9.0; 2],
                        ..ContourEvidence::default()
                    };
                    let mut now = ObjectEvidence {
                        object: ball_at(0.0),
                        direction: 0,
                        learned,
                        images: 1.0,
                        images_ago: 0,
                        kept: 1.0,
                    };
                    if let Some(before) = before {
                        new_share.add(&before, &learned);
                        now.add(&before);
                    }
                    before = Some(now);
                }
                told = before.unwrap().counted(&new_share).objects;
            }
            let count = |share: f64| 1.0 / (1.0 - share + share / 40.0);
            // The share is known to a few hundredths.
            let expected = count((share - 0.1).max(0.0))..=count((share + 0.1).min(1.0));
            assert!(expected.contains(&told), "{share}: {told}, expected {expected:?}");
        }
    }

    #[test]
    fn each_object_shows_as_much_as_its_contour_has_points_at_the_radius_that_it_has_there() {
        // All rays that touch a ball touch it at the same depth.
        let depth = (DISTANCE.powi(2) - RADIUS.powi(2)) / DISTANCE;
        let expected_px = KINECT_HALF.fx * RADIUS / depth;
        for scan in [Scan::Row, Scan::Column] {
            let ((arcs, members), mut contours) = (ball(scan), ContourCalibration::default());
            let (region, mut points) = (fitted(&arcs, &members, &mut contours), [0.0; 2]);
            for count in [1.0, 2.0, 3.0] {
                contours.learn(&region, &ball_at(count));
                let told: Vec<_> = contours.errors().collect();
                let &[ContourErrors { scan: of, objects, sides, .. }] = &told[..] else { panic!("{told:?}") };
                assert_eq!((of, objects), (scan, count));
                for side in [0, 1] {
                    points[side] += contours.contour.used_on(side).0 as f64;
                    assert!(sides[side].points == points[side] && points[side] > 50.0 * count, "{sides:?}");
                    assert!((sides[side].radius_px / expected_px - 1.0).abs() < 0.03, "{sides:?}, not {expected_px}");
                }
            }
        }
    }

    #[test]
    fn of_what_shows_no_contour_none_is_learned_and_nothing_of_a_side_that_shows_none() {
        let told = |shows: [bool; 2]| {
            let ((mut arcs, members), mut contours) = (ball(Scan::Row), ContourCalibration::default());
            arcs.arcs
                .iter_mut()
                .for_each(|arc| arc.contour = [0, 1].map(|side| arc.contour[side].filter(|_| shows[side])));
            let region = fitted(&arcs, &members, &mut contours);
            contours.learn(&region, &ball_at(0.0));
            contours.errors().collect::<Vec<_>>()
        };
        assert_eq!(told([false; 2]), []);
        let told = told([false, true]);
        let [ContourErrors { objects: 1.0, sides: [hidden, seen], .. }] = &told[..] else { panic!("{told:?}") };
        assert!((hidden.points, hidden.radius_px) == (0.0, 0.0) && seen.points > 50.0, "{told:?}");
        assert_eq!(hidden.outside_px, hidden.offset_px);
        assert!(hidden.outside_px[1] > 0.9 && seen.outside_px[1] < 0.2, "{told:?}");
    }

    /// Windows of three pixels: two further pixels share the noise of one.
    #[test]
    fn a_contour_is_off_by_what_is_its_own_beside_what_is_not_known_of_all() {
        let prior_covariance = covariance(OFFSET_PX.hypot(2.0 * WINDOW_OFFSET_PX), SHARE);
        let known = (Vector4::new(-0.5, -0.01, -0.5, 0.02), Matrix4::zeros());
        for (scan, (mean, common)) in [(Scan::Row, (Vector4::zeros(), prior_covariance)), (Scan::Column, known)] {
            let (mut arcs, members) = ball(scan);
            arcs.arcs.iter_mut().for_each(|arc| arc.correlation_px = 3.0);
            let region = fitted(&arcs, &members, &mut ContourCalibration::default());
            let ContourBias { mean: found, covariance: of } = learned().noise(&region).bias;
            let expected = common + covariance(SYSTEMATIC_PX + 2.0 * FLATTENED_PX, SYSTEMATIC);
            assert!((found - mean).norm() < 1e-6, "{scan:?}: {found}");
            for i in 0..4 {
                assert!((of[(i, i)] / expected[(i, i)] - 1.0).abs() < 1e-3, "{scan:?}: {of}, not {expected}");
            }
        }
    }

    #[test]
    fn what_is_expected_of_the_scatter_may_be_wrong_by_as_much_as_it_is() {
        let before = ContourEvidence::default().variance();
        // The evidence is as uncertain as the prior, so the estimate is the mean of both.
        let shown = Information::of(&(before * 3.0), &Matrix2::from_diagonal(&before.map(|variance| variance.powi(2))));
        let told = ContourEvidence { noise: shown.unwrap(), ..ContourEvidence::default() }.variance();
        assert!((told - before * 2.0).component_div(&before).norm() < 1e-9, "{told} {before}");
    }
}
