use super::*;
use crate::rendered::{KINECT_HALF, cylinder, plane, render, sphere};
use crate::simulator::shapes::Shape;
use conicflow_detection::{ExtractorParameters, ScanLines};
use conicflow_geometry::Vector3;
use conicflow_messages::{Item, NoiseModel};

fn upright(x: f64, z: f64, radius: f64) -> Shape {
    cylinder(Vector3::new(x, 0.0, z), Vector3::y(), radius, 0.5)
}

fn wall(z: f64) -> Shape {
    plane(Vector3::z(), z)
}

fn extract(config: ConicConfig, scene: &(Header, Vec<u16>)) -> (Vec<Ellipse>, Vec<(&'static str, u64)>) {
    let mut extractor = ConicExtractor::new(config);
    let ellipses = extractor.extract(&scene.0, &scene.1).to_vec();
    assert_eq!(Ellipse::check(&scene.0, &ellipses), Ok(()));
    (ellipses, extractor.rejections().collect())
}

fn with_scan(scan: ScanLines) -> ConicConfig {
    let common = ExtractorParameters { scan, ..ExtractorParameters::default() };
    ConicConfig { common, ..ConicConfig::default() }
}

fn rejected(rejections: &[(&'static str, u64)], name: &str) -> u64 {
    rejections.iter().find(|(reason, _)| *reason == name).map_or(0, |(_, times)| *times)
}

#[test]
fn each_row_of_a_cylinder_gives_its_section() {
    let scene = render(KINECT_HALF, NoiseModel::IDEAL, &[upright(0.1, 1.5, 0.2)], 1);
    let (ellipses, _) = extract(ConicConfig::of_the_paper(), &scene);
    // At the ends of the frustum, a row shows only a part of its section.
    let whole: Vec<_> = ellipses.iter().filter(|ellipse| ellipse.points > 60).collect();
    assert!(whole.len() > 80, "{} whole ones", whole.len());
    for ellipse in whole {
        let stretch = ((f64::from(ellipse.line) - KINECT_HALF.cy) / KINECT_HALF.fy).hypot(1.0);
        assert!((ellipse.half_width - 0.2).abs() < 2e-3, "{ellipse:?}");
        assert!((ellipse.half_depth - 0.2 * stretch).abs() < 3e-3, "{ellipse:?}");
        assert!((ellipse.center[0] - 0.1).abs() < 1e-3 && (ellipse.center[2] - 1.5).abs() < 3e-3, "{ellipse:?}");
        assert!(ellipse.rms < 2e-4 && ellipse.arc > 1.5, "{ellipse:?}");
        assert_eq!(f64::from(ellipse.points), ellipse.moments[0]);
    }
}

#[test]
fn one_pass_finds_all_ellipses_of_a_row_and_no_wall() {
    let bodies = [upright(-0.5, 1.8, 0.15), upright(0.0, 1.6, 0.1), upright(0.5, 2.0, 0.2), wall(3.0)];
    let scene = render(KINECT_HALF, NoiseModel::KINECT_V1, &bodies, 2);
    let (ellipses, rejections) = extract(ConicConfig::of_the_paper(), &scene);
    for (from, to, radius) in [(-0.65, -0.35, 0.15), (-0.1, 0.1, 0.1), (0.3, 0.7, 0.2)] {
        let of_body: Vec<_> = ellipses.iter().filter(|ellipse| (from..to).contains(&ellipse.center[0])).collect();
        let mean = of_body.iter().map(|ellipse| ellipse.half_width).sum::<f64>() / of_body.len() as f64;
        assert!(of_body.len() > 60, "{} ellipses of radius {radius}", of_body.len());
        assert!((0.75..1.01).contains(&(mean / radius)), "{mean} in place of {radius}");
    }
    let strays = ellipses.iter().filter(|ellipse| ellipse.center[2] > 2.4).count();
    assert!(strays < 5, "{strays} ellipses in the wall");
    assert!(rejected(&rejections, "arcs that a line explains") > 300);
}

#[test]
fn a_floor_and_a_wall_give_next_to_nothing() {
    let floor = plane(Vector3::new(0.0, 0.9, 0.3).normalize(), 0.9);
    let scene = render(KINECT_HALF, NoiseModel::KINECT_V1, &[floor, wall(2.5)], 3);
    let (ellipses, rejections) = extract(ConicConfig::of_the_paper(), &scene);
    assert!(ellipses.len() < 10, "{} ellipses", ellipses.len());
    assert!(rejected(&rejections, "arcs that a line explains") > 200, "{rejections:?}");
}

#[test]
fn the_inside_of_a_bowl_is_concave() {
    // The camera is inside the sphere, so that only the far half is visible.
    let bowl = sphere(Vector3::new(0.0, 0.0, 0.2), 0.5);
    let scene = render(KINECT_HALF, NoiseModel::IDEAL, &[bowl], 4);
    let (ellipses, rejections) = extract(ConicConfig::of_the_paper(), &scene);
    assert_eq!(ellipses.len(), 0);
    assert!(rejected(&rejections, "concave arcs") > 200, "{rejections:?}");
}

#[test]
fn small_holes_are_bridged_and_large_ones_split() {
    let scene = render(KINECT_HALF, NoiseModel::IDEAL, &[upright(0.0, 1.0, 0.2)], 5);
    let points_without = |hole: usize| {
        let mut holed = scene.clone();
        let row = 120 * KINECT_HALF.width as usize;
        holed.1[row + 150..row + 150 + hole].fill(0);
        let (ellipses, _) = extract(ConicConfig::of_the_paper(), &holed);
        ellipses.iter().filter(|ellipse| ellipse.line == 120).map(|ellipse| ellipse.points).collect::<Vec<_>>()
    };
    let whole = points_without(0)[0];
    assert_eq!(points_without(3), [whole - 3]);
    assert!(points_without(20).iter().all(|points| *points < whole - 20));
}

#[test]
fn columns_find_what_lies_across() {
    let lying = cylinder(Vector3::new(0.0, 0.0, 1.5), Vector3::x(), 0.1, 0.6);
    let scene = render(KINECT_HALF, NoiseModel::KINECT_V1, &[lying], 6);
    let count = |scan| extract(with_scan(scan), &scene).0.len();
    let (rows, columns) = (count(ScanLines::Rows), count(ScanLines::Columns));
    assert!(rows < 5 && columns > 90, "{rows} in rows, {columns} in columns");
    assert_eq!(count(ScanLines::Both), rows + columns);
}

#[test]
fn the_moments_are_those_of_the_points() {
    let scene = render(KINECT_HALF, NoiseModel::KINECT_V1, &[upright(0.0, 1.2, 0.15)], 7);
    let (ellipses, _) = extract(ConicConfig::of_the_paper(), &scene);
    let ellipse = ellipses.iter().find(|ellipse| ellipse.line == 130).unwrap();
    let stretch = ((130.0 - KINECT_HALF.cy) / KINECT_HALF.fy).hypot(1.0);
    let mut sums = [0.0; 4];
    for u in ellipse.first..=ellipse.last {
        let z = f64::from(scene.1[(130 * KINECT_HALF.width + u) as usize]) * 1e-4;
        let s = z * (f64::from(u) - KINECT_HALF.cx) / KINECT_HALF.fx - ellipse.origin[0];
        let t = z * stretch - ellipse.origin[1];
        [s, t, s * s * t, t.powi(4)].iter().zip(&mut sums).for_each(|(term, sum)| *sum += term);
    }
    for (sum, index) in sums.into_iter().zip([1, 2, 7, 14]) {
        assert!((sum - ellipse.moments[index]).abs() < 1e-12);
    }
}

#[test]
fn an_image_without_measurements_is_an_empty_list() {
    let (header, pixels) = render(KINECT_HALF, NoiseModel::IDEAL, &[], 8);
    assert_eq!(extract(ConicConfig::of_the_paper(), &(header, pixels.clone())).0.len(), 0);
    let far = vec![u16::MAX; pixels.len()];
    assert_eq!(extract(ConicConfig::of_the_paper(), &(header, far)).0.len(), 0);
}
