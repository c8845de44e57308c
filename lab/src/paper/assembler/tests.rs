use super::*;
use crate::paper::extractor::{ConicConfig, ConicExtractor};
use crate::rendered::{KINECT_HALF, cylinder, frustum, plane, render, sphere};
use crate::simulator::shapes::Shape;
use conicflow_detection::assemble::AxialLimits;
use conicflow_detection::{Assembler, AssemblerParameters, Extractor, ExtractorParameters};
use conicflow_geometry::Vector3;
use conicflow_messages::{Camera, Item, NoiseModel, ObjectKind};

const KINECT: Camera = Camera { width: 640, height: 480, fx: 580.0, fy: 580.0, cx: 319.5, cy: 239.5 };

/// The paper's method, with sections of the shape that follows from the axis.
fn profile() -> ProfileConfig {
    ProfileConfig::default()
}

fn detect(camera: Camera, noise: NoiseModel, bodies: &[Shape], seed: u64, config: &ProfileConfig) -> Vec<Object> {
    let (header, pixels) = render(camera, noise, bodies, seed);
    let mut extractor = ConicExtractor::new(ConicConfig::of_the_paper());
    let mut assembler = ProfileAssembler::new(config.clone());
    let objects = assembler.assemble(&header, extractor.extract(&header, &pixels)).to_vec();
    assert_eq!(Object::check(&header, &objects), Ok(()));
    objects
}

fn kinect(bodies: &[Shape], seed: u64) -> Vec<Object> {
    detect(KINECT_HALF, NoiseModel::KINECT_V1, bodies, seed, &profile())
}

fn can(distance: f64) -> Shape {
    cylinder(Vector3::new(0.0, 0.0, distance), Vector3::y(), 0.2, 0.7)
}

fn single(objects: &[Object], shape: ObjectKind) -> Object {
    assert_eq!(objects.len(), 1, "{objects:?}");
    assert_eq!(objects[0].shape(), shape, "{objects:?}");
    objects[0]
}

fn angle(object: &Object, axis: &Vector3) -> f64 {
    Vector3::from(object.axis).cross(axis).norm().asin()
}

fn distance(object: &Object, point: &Vector3) -> f64 {
    (Vector3::from(object.center) - point).norm()
}

#[test]
fn a_cylinder_without_noise_is_exact() {
    let objects = detect(KINECT, NoiseModel::IDEAL, &[can(1.5)], 1, &profile());
    let found = single(&objects, ObjectKind::Cylinder);
    assert!((found.radius - 0.2).abs() < 1e-4 && found.rms < 1e-4, "{found:?}");
    assert!(angle(&found, &Vector3::y()) < 1e-3 && distance(&found, &Vector3::new(0.0, 0.0, 1.5)) < 1e-3);
    assert!((found.length - 0.7).abs() < 0.01);
}

#[test]
fn sections_of_known_shape_keep_the_radius_at_a_distance() {
    for (range, tolerance) in [(1.0, 0.002), (2.0, 0.004), (3.0, 0.010)] {
        let found = single(&kinect(&[can(range)], 2), ObjectKind::Cylinder);
        assert!((found.radius - 0.2).abs() < tolerance, "{} at {range} m", found.radius);
        assert!(distance(&found, &Vector3::new(0.0, 0.0, range)) < 0.01, "{found:?}");
    }
}

#[test]
fn the_papers_radius_shrinks_as_in_the_paper() {
    let config = ProfileConfig::of_the_paper();
    // Table 1 of the paper, without its Kalman filter.
    for (range, paper) in [(1.0, 0.20), (1.5, 0.17), (2.0, 0.16), (2.5, 0.16), (3.0, 0.15)] {
        let objects = detect(KINECT_HALF, NoiseModel::KINECT_V1, &[can(range)], 3, &config);
        let found = single(&objects, ObjectKind::Cylinder);
        assert!((found.radius - paper).abs() < 0.02, "{} at {range} m, the paper has {paper}", found.radius);
        assert!((found.center[2] / range - 1.0).abs() < 0.05, "{found:?}");
    }
}

#[test]
fn a_sphere_is_found_off_the_optical_axis() {
    let center = Vector3::new(0.2, 0.25, 1.5);
    let ball = sphere(center, 0.15);
    let exact = detect(KINECT, NoiseModel::IDEAL, &[ball], 4, &profile());
    let found = single(&exact, ObjectKind::Sphere);
    assert!((found.radius - 0.15).abs() < 1e-4 && distance(&found, &center) < 2e-4, "{found:?}");
    let found = single(&kinect(&[ball], 4), ObjectKind::Sphere);
    assert!((found.radius - 0.15).abs() < 0.004 && distance(&found, &center) < 0.006, "{found:?}");
}

#[test]
fn tilted_cones_are_found_as_in_the_paper() {
    for tilt_deg in [5.0_f64, 20.0, 40.0] {
        for half_angle_deg in [10.0_f64, 15.0] {
            let (sin, cos) = tilt_deg.to_radians().sin_cos();
            // Leaning towards the camera: the apex, at the top, is the nearer end.
            let axis = Vector3::new(0.0, cos, sin);
            let center = Vector3::new(0.1, 0.0, 1.3);
            let slope = half_angle_deg.to_radians().tan();
            let cone = frustum(center, axis, 0.15, slope, 0.5);
            let found = single(&kinect(&[cone], 5), ObjectKind::Cone);
            assert!((found.half_angle.to_degrees() - half_angle_deg).abs() < 0.5, "{found:?}");
            assert!(Vector3::from(found.axis).dot(&axis) > 0.99985, "{found:?}");
            assert!((Vector3::from(found.apex) - (center - axis * (0.15 / slope))).norm() < 0.03, "{found:?}");
            assert!(distance(&found, &center) < 0.03 && (found.length - 0.45).abs() < 0.06, "{found:?}");
            let rise = (found.base_radius - found.top_radius) / found.length;
            assert!((rise - found.half_angle.tan()).abs() < 1e-9, "{found:?}");
        }
    }
}

#[test]
fn blunt_cones_are_found_where_they_are_asked_for() {
    let slope = 38.0_f64.to_radians().tan();
    let cone = frustum(Vector3::new(0.0, 0.05, 1.3), Vector3::y(), 0.16, slope, 0.2);
    let found = |max_half_angle_deg| {
        let common = AssemblerParameters { max_half_angle_deg, ..AssemblerParameters::default() };
        let config = ProfileConfig { common, ..profile() };
        detect(KINECT, NoiseModel::KINECT_V1, &[cone], 5, &config)
    };
    let asked_for = single(&found(45.0), ObjectKind::Cone);
    assert!((asked_for.half_angle.to_degrees() - 38.0).abs() < 1.0, "{asked_for:?}");
    assert!(found(30.0).iter().all(|object| object.shape() != ObjectKind::Cone));
}

#[test]
fn the_radius_of_a_tilted_cylinder_is_not_that_of_its_sections() {
    for tilt_deg in [5.0_f64, 20.0, 40.0, -40.0] {
        let (sin, cos) = tilt_deg.to_radians().sin_cos();
        let axis = Vector3::new(0.2 * cos, cos, sin).normalize();
        let body = cylinder(Vector3::new(0.1, 0.0, 1.5), axis, 0.1, 0.4);
        let found = single(&kinect(&[body], 6), ObjectKind::Cylinder);
        assert!((found.radius - 0.1).abs() < 0.002, "{} at a tilt of {tilt_deg} degrees", found.radius);
        assert!(angle(&found, &axis) < 0.01, "{found:?}");
    }
}

#[test]
fn a_ball_on_a_cylinder_on_a_floor_are_two_objects() {
    let can = cylinder(Vector3::new(0.0, 0.25, 1.4), Vector3::y(), 0.1, 0.3);
    let ball = sphere(Vector3::new(0.0, -0.02, 1.4), 0.12);
    let floor = plane(Vector3::y(), 0.4);
    let wall = plane(Vector3::z(), 3.0);
    let mut objects = kinect(&[can, ball, floor, wall], 7);
    objects.sort_by_key(|object| object.kind);
    let shapes: Vec<_> = objects.iter().map(Object::shape).collect();
    assert_eq!(shapes, [ObjectKind::Sphere, ObjectKind::Cylinder], "{objects:?}");
    assert!((objects[0].radius - 0.12).abs() < 0.003 && (objects[1].radius - 0.1).abs() < 0.003, "{objects:?}");
    assert!(distance(&objects[0], &Vector3::new(0.0, -0.02, 1.4)) < 0.005);
    assert!((objects[1].length - 0.3).abs() < 0.03, "{objects:?}");
}

#[test]
fn planes_alone_are_no_object() {
    let floor = plane(Vector3::new(0.0, 0.9, 0.3).normalize(), 0.9);
    let wall = plane(Vector3::new(-0.3, 0.0, 1.0).normalize(), 2.5);
    assert_eq!(kinect(&[floor, wall], 8), []);
}

#[test]
fn noisy_rows_are_skipped() {
    let (header, mut pixels) = render(KINECT_HALF, NoiseModel::KINECT_V1, &[can(1.5)], 9);
    for row in [100, 110, 111, 130] {
        let width = KINECT_HALF.width as usize;
        pixels[row * width..(row + 1) * width].iter_mut().step_by(3).for_each(|pixel| *pixel = *pixel / 10 * 9);
    }
    let mut extractor = ConicExtractor::new(ConicConfig::of_the_paper());
    let mut assembler = ProfileAssembler::new(profile());
    let objects = assembler.assemble(&header, extractor.extract(&header, &pixels)).to_vec();
    let found = single(&objects, ObjectKind::Cylinder);
    assert!(found.rows > 120 && (found.radius - 0.2).abs() < 0.003, "{found:?}");
}

#[test]
fn sigmas_tell_the_scatter_over_frames() {
    let found: Vec<_> = (0..96).map(|seed| single(&kinect(&[can(1.5)], 100 + seed), ObjectKind::Cylinder)).collect();
    let count = found.len() as f64;
    let ratio = |value: fn(&Object) -> f64, sigma: fn(&Object) -> f64| {
        let mean = found.iter().map(value).sum::<f64>() / count;
        let variance = found.iter().map(|object| (value(object) - mean).powi(2)).sum::<f64>() / (count - 1.0);
        variance.sqrt() / (found.iter().map(sigma).sum::<f64>() / count)
    };
    let radius = ratio(|object| object.radius, |object| object.sigma.radius);
    let side = ratio(|object| object.center[0], |object| object.sigma.center[0][0].sqrt());
    let axis = ratio(|object| object.axis[0], |object| object.sigma.axis / std::f64::consts::SQRT_2);
    for ratio in [radius, side, axis] {
        assert!((0.7..1.4).contains(&ratio), "scatter over sigma: {radius}, {side}, {axis}");
    }
}

#[test]
fn sigmas_are_present_exactly_where_the_shape_has_the_parameter() {
    let ball = sphere(Vector3::new(0.0, 0.0, 1.2), 0.15);
    for noise in [NoiseModel::IDEAL, NoiseModel::KINECT_V1] {
        for body in [ball, can(1.5)] {
            let objects = detect(KINECT_HALF, noise, &[body], 10, &profile());
            let sigma = objects[0].sigma;
            let is_sphere = objects[0].shape() == ObjectKind::Sphere;
            assert!(sigma.radius > 0.0 && (0..3).all(|i| sigma.center[i][i] > 0.0), "{sigma:?}");
            assert_eq!((sigma.axis > 0.0, sigma.length > 0.0), (!is_sphere, !is_sphere));
            assert_eq!(sigma.half_angle, 0.0);
        }
    }
}

#[test]
fn of_every_second_to_eighth_line_objects_are_the_same() {
    let tall = cylinder(Vector3::new(0.0, 0.0, 1.5), Vector3::y(), 0.2, 1.0);
    let (header, pixels) = render(KINECT, NoiseModel::KINECT_V1, &[tall], 12);
    for find in [by_default, by_the_paper] {
        let mut end_sigma = 0.0;
        for line_step in [1, 2, 4, 8] {
            let common = ExtractorParameters { line_step, ..ExtractorParameters::default() };
            let (objects, _) = find(&header, &pixels, common, AssemblerParameters::default());
            let found = single(&objects, ObjectKind::Cylinder);
            assert!((found.radius - 0.2).abs() < 0.004, "{found:?}");
            assert!((found.length - 1.0).abs() < 0.04, "{found:?}");
            end_sigma = if line_step == 1 { found.sigma.length } else { end_sigma };
            let coarser = found.sigma.length / end_sigma / f64::from(line_step);
            assert!((coarser - 1.0).abs() < 0.1, "step {line_step}: {found:?}");
        }
    }
}

type Found = (Vec<Object>, Vec<&'static str>);

fn by_default(header: &Header, pixels: &[u16], arcs: ExtractorParameters, common: AssemblerParameters) -> Found {
    let (mut extractor, mut assembler) = (Extractor::new(arcs), Assembler::new(common));
    let objects = assembler.assemble(header, extractor.extract(header, pixels)).to_vec();
    (objects, assembler.rejections().map(|(why, _)| why).collect())
}

fn by_the_paper(header: &Header, pixels: &[u16], arcs: ExtractorParameters, common: AssemblerParameters) -> Found {
    let scan = ConicConfig::of_the_paper().common.scan;
    let arcs = ConicConfig { common: ExtractorParameters { scan, ..arcs }, ..ConicConfig::of_the_paper() };
    let mut extractor = ConicExtractor::new(arcs);
    let mut assembler = ProfileAssembler::new(ProfileConfig { common, ..profile() });
    let objects = assembler.assemble(header, extractor.extract(header, pixels)).to_vec();
    (objects, assembler.rejections().map(|(why, _)| why).collect())
}

#[test]
fn a_candidate_beyond_the_limits_is_counted() {
    let (header, pixels) = render(KINECT_HALF, NoiseModel::KINECT_V1, &[can(1.5)], 11);
    let limits = AssemblerParameters::default().cylinder;
    for find in [by_default, by_the_paper] {
        for (cylinder, reason) in [
            (AxialLimits { max_m: 0.15, ..limits }, "candidates beyond the radius limits"),
            (AxialLimits { max_length_m: 0.2, ..limits }, "candidates beyond the length limits"),
        ] {
            let common = AssemblerParameters { cylinder, ..AssemblerParameters::default() };
            let (objects, reasons) = find(&header, &pixels, ExtractorParameters::default(), common);
            assert!(objects.is_empty() && reasons.contains(&reason), "{reason}: {objects:?}");
        }
    }
}
