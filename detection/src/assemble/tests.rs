//! Tests of the pooled method, on rendered frames.

use super::arcs::{Arc, Arcs};
use super::growth::{RegionGrower, chain};
use super::model::{self, Model, pool_within};
use super::odds::Evidence;
use super::region::Region;
use super::seeds::{MAX_FAILED, Seeds};
use super::{Assembler, AssemblerParameters, Rejection, Rejections};
use crate::extract::{Extractor, ExtractorParameters};
use conicflow_geometry::{Conical, PlaneMoments, Scan, SpaceMoments, Vector3};
use conicflow_lab::rendered::{KINECT_HALF, block, cylinder, frustum, plane, render, sphere};
use conicflow_lab::simulator::random_scene::{SceneGroup, random_scene};
use conicflow_lab::simulator::random_scenes::RandomScenes;
use conicflow_lab::simulator::scene::Scene;
use conicflow_lab::simulator::sensor::{SensorConfig, SensorTable};
use conicflow_lab::simulator::shapes::Shape;
use conicflow_lab::simulator::{SimulatorParameters, SyntheticCamera};
use conicflow_messages::{Camera, END_POINTS, Ellipse, Header, Item, NoiseModel, Object, ObjectKind};

fn detect(camera: Camera, noise: NoiseModel, bodies: &[Shape], seed: u64) -> Vec<Object> {
    let (header, pixels) = render(camera, noise, bodies, seed);
    find(&header, &pixels)
}

fn find(header: &Header, pixels: &[u16]) -> Vec<Object> {
    let arcs = ExtractorParameters::default();
    let mut extractor = Extractor::new(arcs);
    let mut assembler = Assembler::new(AssemblerParameters::default());
    let objects = assembler.assemble(header, extractor.extract(header, pixels)).to_vec();
    assert_eq!(Object::check(header, &objects), Ok(()));
    objects
}

fn kinect(bodies: &[Shape], seed: u64) -> Vec<Object> {
    detect(KINECT_HALF, NoiseModel::KINECT_V1, bodies, seed)
}

fn can(distance: f64) -> Shape {
    cylinder(Vector3::new(0.0, 0.0, distance), Vector3::y(), 0.2, 0.7)
}

pub(super) fn wall(z: f64) -> Shape {
    plane(Vector3::z(), z)
}

fn floor(y: f64) -> Shape {
    plane(Vector3::y(), y)
}

fn single(objects: &[Object], shape: ObjectKind) -> Object {
    assert_eq!(objects.len(), 1, "{objects:?}");
    assert_eq!(objects[0].shape(), shape, "{objects:?}");
    objects[0]
}

fn off(object: &Object, point: &Vector3) -> f64 {
    (Vector3::from(object.center) - point).norm()
}

#[test]
fn a_can_keeps_its_radius_at_a_distance() {
    for (distance, tolerance) in [(1.0, 0.001), (2.0, 0.002), (3.0, 0.006)] {
        let found = single(&kinect(&[can(distance), wall(4.0)], 1), ObjectKind::Cylinder);
        assert!((found.radius - 0.2).abs() < tolerance, "{} at {distance} m", found.radius);
        assert!(Vector3::from(found.axis).y.abs() > 0.999 && off(&found, &Vector3::new(0.0, 0.0, distance)) < 0.02);
        assert!((found.radius - 0.2).abs() < 5.0 * found.sigma.radius, "{found:?}");
    }
}

#[test]
fn half_a_can_is_enough() {
    let board = block(Vector3::new(0.2, 0.0, 1.2), Vector3::new(0.4, 1.2, 0.02), 0.0);
    let found = single(&kinect(&[can(1.6), board, wall(3.0)], 2), ObjectKind::Cylinder);
    assert!((found.radius - 0.2).abs() < 0.006 && found.arc < 1.6, "{found:?}");
}

#[test]
fn boxes_floor_and_wall_are_nothing() {
    for seed in 0..6 {
        let turn = 0.3 + 0.2 * seed as f64;
        let near = block(Vector3::new(-0.3, 0.3, 1.6), Vector3::new(0.3, 0.6, 0.3), turn);
        let far = block(Vector3::new(0.6, 0.2, 2.6), Vector3::new(0.4, 0.8, 0.5), -turn);
        assert_eq!(kinect(&[near, far, floor(0.6), wall(3.5)], seed), []);
    }
}

#[test]
fn rooms_of_boxes_alone_hold_no_object() {
    // Of boxes far away noise leaves so little that arcs of cylinders, cones and spheres miss their edges by no more than chance.
    let (config, rooms) = (SimulatorParameters::default(), 40);
    let scenes = RandomScenes { groups: vec![SceneGroup::Empty], seeds: [1, rooms], ..RandomScenes::default() };
    let first = random_scene(SceneGroup::Empty, 1);
    let mut camera =
        SyntheticCamera::new(first, config.camera(), config.noise, config.depth_scale, 30.0, 0).before(scenes);
    let (mut header, mut pixels) = (Header::default(), vec![0; 640 * 480]);
    for room in 1..=rooms {
        camera.shoot(room - 1, &mut pixels);
        camera.describe(&mut header);
        assert_eq!(find(&header, &pixels), [], "room {room}");
    }
}

#[test]
fn posts_in_much_noise_are_no_cans() {
    let camera = Camera { width: 848, height: 480, fx: 696.0, fy: 696.0, cx: 423.5, cy: 239.5 };
    // As cameras of the RealSense D400 class show it on tables.
    let stereo = NoiseModel { growth_per_m: 0.0022, ..NoiseModel::IDEAL };
    for (seed, turn) in [(1, 0.6), (2, 0.7), (3, 0.8), (4, 0.7)] {
        let post = block(Vector3::new(0.1, 0.2, 2.0), Vector3::new(0.1, 0.5, 0.1), turn);
        let found = detect(camera, stereo, &[post, wall(3.5)], seed);
        assert_eq!(found, [], "turned by {turn}");
    }
}

#[test]
fn a_sphere_and_cones_of_either_sense_are_told_apart() {
    let center = Vector3::new(0.1, 0.0, 1.5);
    let ball = single(&kinect(&[sphere(center, 0.15)], 3), ObjectKind::Sphere);
    assert!((ball.radius - 0.15).abs() < 0.0015 && off(&ball, &center) < 0.003, "{ball:?}");
    for slope in [0.25_f64, -0.2, 0.55] {
        let cone = frustum(center, Vector3::y(), 0.12, slope, 0.4);
        let found = single(&kinect(&[cone], 4), ObjectKind::Cone);
        assert!((found.half_angle - slope.abs().atan()).to_degrees().abs() < 1.0, "{found:?}");
        assert!(found.axis[1] * slope > 0.0 && found.base_radius > found.top_radius, "{found:?}");
        let apex = center - Vector3::y() * (0.12 / slope);
        assert!((Vector3::from(found.apex) - apex).norm() < 0.03, "{found:?}");
    }
}

#[test]
fn a_cone_ends_at_its_apex() {
    let center = Vector3::new(0.0, 0.0, 1.2);
    let whole = frustum(center, Vector3::y(), 0.05, 0.45, 2.0 * 0.05 / 0.45);
    for seed in 0..8 {
        for found in kinect(&[whole, wall(3.0)], seed) {
            let (axis, middle) = (Vector3::from(found.axis), Vector3::from(found.center));
            let top = middle - axis * (0.5 * found.length);
            let beyond = (Vector3::from(found.apex) - top).dot(&axis);
            assert!(beyond < 1e-9, "{found:?} begins {beyond} m before its apex");
            assert!((found.top_radius + found.length * found.half_angle.tan() - found.base_radius).abs() < 1e-9);
        }
    }
}

#[test]
fn a_ball_on_a_can_is_cut_off_from_it() {
    let axis = Vector3::y();
    let can = cylinder(Vector3::new(0.0, 0.25, 1.4), axis, 0.1, 0.3);
    let ball = sphere(Vector3::new(0.0, -0.02, 1.4), 0.12);
    let mut objects = kinect(&[can, ball, floor(0.4), wall(3.0)], 7);
    objects.sort_by_key(|object| object.kind);
    let shapes: Vec<_> = objects.iter().map(Object::shape).collect();
    assert_eq!(shapes, [ObjectKind::Sphere, ObjectKind::Cylinder], "{objects:?}");
    assert!((objects[0].radius - 0.12).abs() < 0.001 && (objects[1].radius - 0.1).abs() < 0.001, "{objects:?}");
}

#[test]
fn of_two_whose_middles_lie_in_each_other_one_is_reported() {
    for seed in 0..4 {
        let found = |apart: f64| {
            let balls = [-0.5, 0.5].map(|side| sphere(Vector3::new(side * apart, 0.0, 1.4), 0.12));
            kinect(&[&balls[..], &[wall(3.0)]].concat(), seed)
        };
        let (merged, touching) = (found(0.09), found(0.15));
        assert_eq!([merged.len(), touching.len()], [1, 2], "{merged:?} {touching:?}");
    }
}

#[test]
fn where_a_surface_goes_on_it_is_told_and_speaks_against_a_sphere() {
    let ball = sphere(Vector3::new(0.0, -0.02, 1.4), 0.12);
    let axis = Vector3::y();
    let post = cylinder(Vector3::new(0.0, 0.22, 1.4), axis, 0.11, 0.4);
    let evidence = |bodies: &[Shape]| {
        let (header, pixels) = render(KINECT_HALF, NoiseModel::KINECT_V1, bodies, 7);
        let mut extractor = Extractor::new(ExtractorParameters::default());
        let mut assembler = Assembler::new(AssemblerParameters::default());
        assembler.assemble(&header, extractor.extract(&header, &pixels));
        let spheres = assembler.candidates().iter().filter(|(object, _)| object.shape() == ObjectKind::Sphere);
        *spheres.map(|(_, evidence)| evidence).next().unwrap()
    };
    let (free, on_a_post) = (evidence(&[ball, wall(3.0)]), evidence(&[ball, post, wall(3.0)]));
    assert_eq!((free.continued, on_a_post.continued), (0.0, 0.5));
    assert_eq!((free.beyond_radii, on_a_post.beyond_radii[0]), ([0.0; 2], 0.0));
    assert!((0.3..0.4).contains(&on_a_post.beyond_radii[1]), "until the post is a fifth of the radius off the ball");
    assert!(Evidence { continued: 1.0, ..free }.probability() < free.probability());
    let [one, both] = [[0.0, 0.2], [0.2, 0.2]].map(|beyond_radii| Evidence { beyond_radii, ..free }.probability());
    assert!(both < one && one < free.probability());
}

#[test]
fn what_lies_across_is_found_in_columns_and_reported_once() {
    let center = Vector3::new(0.0, 0.1, 1.5);
    for axis in [Vector3::x(), Vector3::new(0.8, 0.6, 0.0), Vector3::new(0.6, 0.7, -0.4).normalize()] {
        let pipe = cylinder(center, axis, 0.08, 0.6);
        let found = single(&kinect(&[pipe, wall(3.0)], 8), ObjectKind::Cylinder);
        assert!((found.radius - 0.08).abs() < 0.001, "{found:?}");
        assert!(Vector3::from(found.axis).cross(&axis).norm() < 0.02, "{found:?}");
    }
}

#[test]
fn what_is_seen_through_a_gap_may_be_anything_but_a_dome_on_a_wall_is_a_sphere() {
    let door = |x: f64| block(Vector3::new(x, 0.0, 1.0), Vector3::new(0.4, 1.5, 0.02), 0.0);
    let ajar = [can(1.5), door(-0.24), door(0.24), wall(3.0)];
    assert_eq!(kinect(&ajar, 7), []);
    assert_eq!(single(&kinect(&[can(1.5), door(-0.24), wall(3.0)], 7), ObjectKind::Cylinder).kind, 1);
    let dome = sphere(Vector3::new(0.1, 0.05, 1.5), 0.15);
    let found = single(&kinect(&[dome, wall(1.5)], 7), ObjectKind::Sphere);
    assert!((found.radius - 0.15).abs() < 0.005, "{found:?}");
}

#[test]
fn the_inside_of_a_bowl_is_nothing() {
    let bowl = sphere(Vector3::new(0.0, 0.0, 0.2), 0.5);
    assert_eq!(kinect(&[bowl], 9), []);
}

#[test]
fn a_sensor_quieter_than_its_model_is_no_worse() {
    let center = Vector3::new(0.02, 0.01, 0.8);
    let camera = Camera { width: 160, height: 120, fx: 150.0, fy: 150.0, cx: 79.5, cy: 59.5 };
    let ball = sphere(center, 0.1);
    let (mut header, pixels) = render(camera, NoiseModel::IDEAL, &[ball], 12);
    header.noise = NoiseModel::KINECT_V1;
    let found = single(&find(&header, &pixels), ObjectKind::Sphere);
    assert!((found.radius - 0.1).abs() < 1e-3 && off(&found, &center) < 2e-3, "{found:?}");
}

/// Returns the objects that are found in a scene as a Kinect sees it: with silhouettes whose place is uncertain.
fn by_a_kinect(scene: &str, width: u32, seed: u64) -> Vec<Object> {
    by_a_sensor(SensorTable::default(), scene, width, seed)
}

fn by_a_sensor(sensor: SensorTable, scene: &str, width: u32, seed: u64) -> Vec<Object> {
    let noise = SensorConfig::Table(sensor);
    let config = SimulatorParameters { width, height: width / 4 * 3, noise, ..SimulatorParameters::default() };
    let scene = Scene::parse(scene, "test").unwrap();
    let mut camera = SyntheticCamera::new(scene, config.camera(), config.noise, config.depth_scale, 30.0, seed);
    let (mut header, mut pixels) = (Header::default(), vec![0; (config.width * config.height) as usize]);
    camera.shoot(0, &mut pixels);
    camera.describe(&mut header);
    find(&header, &pixels)
}

#[test]
fn a_ball_in_a_bowl_and_the_bowl_are_two_things() {
    let scene = "
        name = 'bowl'
        camera = { position = [0, 0, 0.4], look_at = [0, 0.8, 0.1] }
        bowl   = [{ name = 'bowl', center = [0, 0.8, 0.13], radius = 0.13 }]
        sphere = [{ name = 'ball', center = [0, 0.82, 0.09], radius = 0.06 }]
        plane  = [{ name = 'table', point = [0, 0, 0], normal = [0, 0, 1] }]
    ";
    for seed in 0..4 {
        let found = by_a_kinect(scene, 640, seed);
        let radii: Vec<_> = found.iter().map(|object| (object.shape(), (object.radius * 100.0).round())).collect();
        assert_eq!(radii, [(ObjectKind::Sphere, 13.0), (ObjectKind::Sphere, 6.0)], "{found:?}");
    }
}

/// A can of radius 0.1 m, 2.6 m before the camera.
fn can_by_a_kinect(noise_window_px: u32, seed: u64) -> Object {
    const CAN: &str = "name = 'can'\n[camera]\nposition = [0.0, 0.0, 0.0]\nlook_at = [0.0, 1.0, 0.0]\n\
        [[cylinder]]\nname = 'can'\nbase = [0.0, 2.6, -0.35]\nradius = 0.1\nlength = 0.7\n\
        [[plane]]\nname = 'wall'\npoint = [0.0, 4.0, 0.0]\nnormal = [0.0, -1.0, 0.0]\n";
    let kinect = SensorTable { noise_window_px, ..SensorTable::default() };
    single(&by_a_sensor(kinect, CAN, 320, seed), ObjectKind::Cylinder)
}

/// Something on a table that a camera looks down at by 35 degrees, from 0.9 m; upwards is `(0, -0.82, -0.57)` to it.
fn on_a_table(thing: &str, seed: u64) -> Vec<Object> {
    let table = "[[plane]]\nname = 'table'\npoint = [0.0, 0.0, 0.0]\nnormal = [0.0, 0.0, 1.0]\n";
    let camera = "[camera]\nposition = [0.0, -0.737, 0.516]\nlook_at = [0.0, 0.0, 0.0]\n";
    by_a_kinect(&format!("name = 'table'\n{camera}{table}{thing}"), 640, seed)
}

#[test]
fn a_flat_tin_is_found_by_the_part_of_its_side_that_shows() {
    // The lines run obliquely over its side, and their means cover no more than a third of the radius along the axis.
    let tin = "[[cylinder]]\nname = 'tin'\nbase = [0.0, 0.0, 0.0]\nradius = 0.098\nlength = 0.064\n";
    for seed in 0..8 {
        let found = single(&on_a_table(tin, seed), ObjectKind::Cylinder);
        assert!((found.radius - 0.098).abs() < 0.002 && (found.length - 0.064).abs() < 0.01, "{found:?}");
        let upwards = Vector3::new(0.0, -0.819, -0.574);
        assert!(Vector3::from(found.axis).cross(&upwards).norm() < 0.05, "{found:?}");
    }
}

#[test]
fn a_band_of_a_ball_is_no_cylinder() {
    // The part of the ball above the table is smaller than the part that has to be visible.
    for (seed, depth) in [(1, 0.04), (2, 0.05), (3, 0.06), (4, 0.07)] {
        let ball = format!("[[sphere]]\nname = 'ball'\ncenter = [0.0, 0.0, {depth}]\nradius = 0.1\n");
        let found = on_a_table(&ball, seed);
        assert!(found.iter().all(|object| object.shape() == ObjectKind::Sphere), "{found:?}");
    }
}

#[test]
fn the_axis_of_what_tapers_slightly_is_not_sure() {
    for seed in 0..4 {
        let pot =
            "[[cone]]\nname = 'pot'\nbase = [0.0, 0.0, 0.0]\nbase_radius = 0.07\ntop_radius = 0.0745\nlength = 0.15\n";
        let found = single(&on_a_table(pot, seed), ObjectKind::Cylinder);
        let off = Vector3::from(found.axis).cross(&Vector3::new(0.0, -0.819, -0.574)).norm();
        assert!(off > 0.01 && off < 2.0 * found.sigma.axis, "{off} {found:?}");
    }
}

#[test]
fn lengths_are_neither_too_long_nor_too_short() {
    // Of both ends, the last line lies half a line within the end on average.
    let found: Vec<_> = (0..24_u64)
        .map(|i| {
            let center = Vector3::new(0.0, 2e-4 * i as f64, 1.5);
            let pipe = cylinder(center, Vector3::y(), 0.1, 0.5);
            single(&kinect(&[pipe, wall(3.0)], i), ObjectKind::Cylinder)
        })
        .collect();
    let mean = found.iter().map(|object| object.length - 0.5).sum::<f64>() / 24.0;
    let most = found.iter().map(|object| (object.length - 0.5).abs() / object.sigma.length).fold(0.0, f64::max);
    assert!(mean.abs() < 0.002 && most < 2.0, "mean {mean} m, at most {most} sigmas off");
}

/// The cup is so small that its inside looks flat. Lines beyond its near rim show the far wall through its mouth, which belongs
/// to the same surface, 2 cm farther along the axis.
#[test]
fn a_cup_ends_at_its_near_rim() {
    let axis = Vector3::new(0.0, -0.87, -0.5).normalize();
    for seed in 0..8 {
        let center = Vector3::new(0.0, 0.001 * seed as f64, 0.8);
        let cup = single(&kinect(&[frustum(center, axis, 0.035, 0.14, 0.1), wall(1.5)], seed), ObjectKind::Cone);
        let along = (center - Vector3::from(cup.center)).dot(&axis);
        assert!((cup.length - 0.1).abs() < 0.02 && along.abs() < 0.01, "{cup:?}");
    }
}

#[test]
fn sigmas_are_about_as_large_as_the_errors() {
    let found: Vec<_> = (0..96).map(|seed| can_by_a_kinect(1, 100 + seed)).collect();
    let scatter = |error: &dyn Fn(&Object) -> f64| {
        (found.iter().map(|object| error(object).powi(2)).sum::<f64>() / found.len() as f64).sqrt()
    };
    let radius = scatter(&|object| (object.radius - 0.1) / object.sigma.radius);
    let axis = scatter(&|object| Vector3::from(object.axis).cross(&Vector3::y()).norm() / object.sigma.axis);
    let side = scatter(&|object| object.center[0] / object.sigma.center[0][0].sqrt());
    // The faults of a sensor are taken to move a centre alike in all directions; those of both sides cancel.
    for (ratio, range) in [(radius, 0.6..1.3), (axis, 0.6..1.3), (side, 0.4..0.9)] {
        assert!(range.contains(&ratio), "errors over sigmas: {radius}, {axis}, {side}");
    }
}

#[test]
fn sigmas_are_those_of_the_same_can_beside_the_middle() {
    let at = |x: f64| {
        let beside = cylinder(Vector3::new(x, 0.0, 2.0), Vector3::y(), 0.2, 0.7);
        single(&kinect(&[beside, wall(4.0)], 4), ObjectKind::Cylinder).sigma
    };
    let [middle, left, right] = [0.0, -0.5, 0.5].map(at);
    for beside in [left, right] {
        for ratio in [beside.radius / middle.radius, beside.axis / middle.axis] {
            assert!((0.8..1.25).contains(&ratio), "{beside:?} {middle:?}");
        }
    }
}

#[test]
fn arcs_of_one_surface_have_a_column_in_common_and_are_at_the_same_depth() {
    let goes_on = |first: u32, depth: f64| {
        let arcs = arcs_from(&[straight(100, 150, 1.0), straight(101, first, depth)]);
        arcs.beside(0, 1, 1, |_| true).is_some()
    };
    assert_eq!([1.0, 1.01, 1.1, 0.9].map(|depth| goes_on(150, depth)), [true, true, false, false]);
    assert_eq!([130, 131, 169, 170].map(|first| goes_on(first, 1.0)), [false, true, true, false]);
}

#[test]
fn noise_that_neighbors_share_widens_the_sigmas() {
    let found = |window| (0..48).map(|seed| can_by_a_kinect(window, 200 + seed)).collect::<Vec<_>>();
    let (alone, shared) = (found(1), found(3));
    let mean_sigma = |found: &[Object]| found.iter().map(|object| object.sigma.axis).sum::<f64>() / found.len() as f64;
    let wider = mean_sigma(&shared) / mean_sigma(&alone);
    assert!((1.8..3.2).contains(&wider), "an axis is {wider} times as unsure");
    let axis = |object: &Object| Vector3::from(object.axis).cross(&Vector3::y()).norm() / object.sigma.axis;
    let ratio = (shared.iter().map(|object| axis(object).powi(2)).sum::<f64>() / 48.0).sqrt();
    assert!((0.6..1.4).contains(&ratio), "errors over sigmas: {ratio}");
    assert!(shared.iter().all(|object| object.points > 1000), "points are those that were measured");
}

#[test]
fn after_two_rounds_nothing_is_allocated() {
    let bodies = |distance| [can(distance), floor(0.6), wall(3.5)];
    let mut extractor = Extractor::new(ExtractorParameters::default());
    let scenes: Vec<_> = [1.0, 1.5, 2.0]
        .map(|distance| render(KINECT_HALF, NoiseModel::KINECT_V1, &bodies(distance), 1))
        .map(|(header, pixels)| (header, extractor.extract(&header, &pixels).to_vec()))
        .into();
    let mut assembler = Assembler::new(AssemblerParameters::default());
    let mut round = || scenes.iter().map(|(header, arcs)| assembler.assemble(header, arcs).len()).sum::<usize>();
    let first = allocation_counter::measure(|| assert!(round() >= 3));
    round();
    let third = allocation_counter::measure(|| assert!(round() >= 3));
    assert!(first.count_total > 0, "the counter counts nothing");
    assert_eq!(third.count_total, 0, "{third:?}");
}

/// The arcs of a scene as a Kinect sees it.
pub(super) fn arcs_of(bodies: &[Shape]) -> Arcs {
    arcs_by(KINECT_HALF, NoiseModel::KINECT_V1, bodies)
}

/// The arcs of a scene as a camera with this noise sees it.
pub(super) fn arcs_by(camera: Camera, noise: NoiseModel, bodies: &[Shape]) -> Arcs {
    let (header, pixels) = render(camera, noise, bodies, 1);
    let mut arcs = Arcs::default();
    arcs.read(&header, Extractor::new(ExtractorParameters::default()).extract(&header, &pixels));
    arcs
}

/// Those of the arcs in rows that are of something.
pub(super) fn rows_of(arcs: &Arcs, is_of_it: impl Fn(&Arc) -> bool) -> Vec<usize> {
    let is_row = |&index: &usize| arcs.arcs[index].scan == Scan::Row && is_of_it(&arcs.arcs[index]);
    (0..arcs.arcs.len()).filter(is_row).collect()
}

/// 20 points, all as far along the view, in a row from a pixel on.
pub(super) fn straight(line: u32, first: u32, away: f64) -> Ellipse {
    let mut ellipse = Ellipse { line, first, last: first + 19, points: 20, origin: [0.0, away], ..Ellipse::default() };
    ellipse.moments[0] = 20.0;
    ellipse
}

/// The arcs of some ellipses, as if a Kinect had shown them.
pub(super) fn arcs_from(ellipses: &[Ellipse]) -> Arcs {
    let mut arcs = Arcs::default();
    arcs.read(&Header { camera: KINECT_HALF, noise: NoiseModel::KINECT_V1, ..Header::default() }, ellipses);
    arcs
}

/// The ellipses of a can before a wall.
pub(super) fn ellipses_of_a_can() -> (Header, Vec<Ellipse>) {
    let (header, pixels) = render(KINECT_HALF, NoiseModel::KINECT_V1, &[can(2.0), wall(4.0)], 1);
    let ellipses = Extractor::new(ExtractorParameters::default()).extract(&header, &pixels).to_vec();
    (header, ellipses)
}

#[test]
fn what_is_surely_larger_than_its_limit_does_not_grow_on_and_what_may_be_smaller_does() {
    let (header, ellipses) = ellipses_of_a_can();
    let mut parameters = AssemblerParameters::default();
    let mut grown = |max_m: f64, shared_lines: f64| {
        (parameters.sphere.max_m, parameters.cylinder.max_m, parameters.cone.max_m) = (max_m, max_m, max_m);
        let (mut arcs, mut grower) = (Arcs::default(), RegionGrower::default());
        arcs.read(&header, &ellipses);
        arcs.arcs.iter_mut().for_each(|arc| arc.shared_lines = shared_lines);
        let seed = arcs.arcs.iter().position(|arc| arc.scan == Scan::Row && arc.line == 120).unwrap();
        chain(&arcs, seed, parameters.max_gap(), |_| true, &mut grower.chain);
        grower.models(&arcs, &parameters, |_| true)[1]
    };
    assert!(grown(0.5, 1.0).is_ok());
    assert!(matches!(grown(0.1, 1.0), Err(Rejection::Radius)), "its radius is 0.2 m");
    assert!(grown(0.1, 1e6).is_ok(), "all lines share their noise, so that its radius is known to no millimetre");
}

#[test]
fn after_the_budget_nothing_further_is_looked_for_and_that_is_counted() {
    let (header, ellipses) = ellipses_of_a_can();
    let found = |budget_ms: Option<f64>| {
        let mut parameters = AssemblerParameters::default();
        parameters.pooled.budget_ms = budget_ms;
        let mut assembler = Assembler::new(parameters);
        let objects = assembler.assemble(&header, &ellipses).len();
        (objects, assembler.rejections().filter(|(words, _)| words.contains("budget_ms")).map(|(_, times)| times).sum())
    };
    assert_eq!([None, Some(0.0), Some(1e4), Some(1e-6)].map(found), [(1, 0), (1, 0), (1, 0), (0, 1)]);
}

/// Lines over which arcs hang together.
const GAP: i64 = 2;

#[test]
fn what_grows_in_vain_on_one_surface_lets_another_one_come_first() {
    let [near, far] = [(-0.2, 1.0), (0.3, 1.5)].map(|(x, z)| cylinder(Vector3::new(x, 0.0, z), Vector3::y(), 0.1, 0.4));
    let arcs = arcs_of(&[near, far, wall(3.0)]);
    let is_near = |arc: usize| arcs.arcs[arc].mean.x < 0.05;
    let (mut seeds, mut rejections) = (Seeds::default(), Rejections::default());
    seeds.order(&arcs, None);
    let mut tried = Vec::new();
    while let Some(seed) = seeds.next(&arcs, &mut rejections) {
        seeds.give_up(&arcs, &[seed], GAP);
        tried.push(seed);
    }
    let of_near = tried.iter().filter(|&&arc| is_near(arc)).count();
    let bulges = |near: bool| {
        let bulges = (0..arcs.arcs.len()).filter(move |&arc| is_near(arc) == near).map(|arc| arcs.arcs[arc].bulge);
        let mut bulges: Vec<_> = bulges.collect();
        bulges.sort_by(|a, b| b.total_cmp(a));
        bulges
    };
    assert!(
        bulges(true)[MAX_FAILED] > bulges(false)[0],
        "each of the near can's is more curved than any of the far one's"
    );
    assert!(is_near(tried[0]) && (4..=8).contains(&of_near), "{of_near} of {}", tried.len());
}

#[test]
fn a_surface_is_what_hangs_together_over_gaps_and_ends_at_what_is_taken() {
    // Two arms that meet in the arc of line 103, and one beside them.
    let places = [(100, 40), (100, 80), (102, 50), (102, 70), (103, 60), (106, 60), (100, 150)];
    let arcs = arcs_from(&places.map(|(line, first)| straight(line, first, 1.0)));
    let named = |arc: usize| (arcs.arcs[arc].line, arcs.arcs[arc].pixels[0]);
    let surface = |gap: i64, taken: Option<(u32, i64)>| {
        let first = (0..7).find(|&arc| named(arc) == (100, 40)).unwrap();
        let (mut surface, mut reached) = (vec![first], Vec::new());
        arcs.connect(&mut surface, &mut reached, gap, |arc| Some(named(arc)) != taken);
        let mut surface: Vec<_> = surface.into_iter().map(named).collect();
        surface.sort_unstable();
        surface
    };
    let arms = [(100, 40), (100, 80), (102, 50), (102, 70), (103, 60)];
    assert_eq!(surface(1, None), [(100, 40)], "there is no arc in line 101");
    assert_eq!(surface(2, None), arms);
    assert_eq!(surface(3, None), [&arms[..], &[(106, 60)]].concat());
    assert_eq!(surface(2, Some((103, 60))), [(100, 40), (102, 50)], "what is taken joins nothing");
}

#[test]
fn seeds_that_were_tried_in_vain_come_to_an_end_and_objects_do_not_count() {
    let (header, ellipses) = ellipses_of_a_can();
    let mut arcs = Arcs::default();
    arcs.read(&header, &ellipses);
    let (mut seeds, mut rejections) = (Seeds::default(), Rejections::default());
    seeds.order(&arcs, None);
    // Chains of too few lines are passed over.
    for _ in 0..5 {
        let short = seeds.next(&arcs, &mut rejections).unwrap();
        seeds.exclude(&[short]);
    }
    let (mut tries, mut untried) = (0, 0);
    while let Some(seed) = seeds.next(&arcs, &mut rejections) {
        seeds.give_up(&arcs, &[seed], GAP);
        tries += 1;
    }
    rejections.iter().for_each(|(_, times)| untried += times);
    assert_eq!(tries, MAX_FAILED);
    assert_eq!(5 + tries + untried as usize, arcs.arcs.len());
}

#[test]
fn what_is_too_improbable_is_not_tried_from_its_other_arcs() {
    let (header, ellipses) = ellipses_of_a_can();
    let mut assembler = Assembler::new(AssemblerParameters { min_confidence: 1.0, ..AssemblerParameters::default() });
    assert!(assembler.assemble(&header, &ellipses).is_empty());
    // An arc that it does not explain may lead to it once more.
    let tried = assembler.candidates().len();
    assert!((1..=2).contains(&tried), "{tried} times");
}

#[test]
fn a_window_of_the_sensor_may_move_the_outline() {
    let (header, ellipses) = ellipses_of_a_can();
    // The contours of a sensor that loses surfaces at grazing incidence: eight pixels too far in, on both sides.
    let far_off = |correlation_px: f64| {
        let inwards = |ellipse: &Ellipse| {
            let [before, behind] = ellipse.contour;
            let contour =
                [if before > 0.0 { before + 8.0 } else { 0.0 }, if behind > 0.0 { behind - 8.0 } else { 0.0 }];
            Ellipse { contour, correlation_px, ..*ellipse }
        };
        let moved: Vec<Ellipse> = ellipses.iter().filter(|ellipse| ellipse.scan == 0).map(inwards).collect();
        let mut assembler = Assembler::new(AssemblerParameters::default());
        assembler.assemble(&header, &moved);
        assembler.candidates()[0].1.outline_far_off
    };
    assert!(far_off(1.0) > 0.9 && far_off(20.0) < 0.1, "{} and {}", far_off(1.0), far_off(20.0));
}

/// An arc of a row with one point more at either end, beside its object, at the depth of the last one on it.
fn with_strays(header: &Header, arc: &Ellipse, are_told: bool) -> Ellipse {
    let Camera { fx, fy, cx, cy, .. } = header.camera;
    let stretch = ((f64::from(arc.line) - cy) / fy).hypot(1.0);
    let (first, last) = (arc.first - 1, arc.last + 1);
    let depths = arc.ends.map(|end| end[0]);
    let mut moments = PlaneMoments::from_sums(arc.origin, arc.moments);
    for (pixel, depth) in [first, last].into_iter().zip(depths) {
        moments.add([(f64::from(pixel) - cx) / fx * depth, stretch * depth]);
    }
    let with_stray = |mut end: [f64; END_POINTS]| {
        end.copy_within(..END_POINTS - 1, 1);
        end
    };
    let ends = if are_told { arc.ends.map(with_stray) } else { [[0.0; END_POINTS]; 2] };
    Ellipse { first, last, points: arc.points + 2, ends, moments: *moments.sums(), ..*arc }
}

#[test]
fn what_lies_outside_the_outline_does_not_widen_an_object() {
    let thin = cylinder(Vector3::z() * 2.0, Vector3::y(), 0.06, 0.7);
    let (header, pixels) = render(KINECT_HALF, NoiseModel::KINECT_V1, &[thin, wall(4.0)], 1);
    let mut extractor = Extractor::new(ExtractorParameters::default());
    let arcs: Vec<Ellipse> = extractor.extract(&header, &pixels).iter().filter(|arc| arc.scan == 0).copied().collect();
    let radius = |arcs: &[Ellipse]| {
        let objects = Assembler::new(AssemblerParameters::default()).assemble(&header, arcs).to_vec();
        assert_eq!(objects.len(), 1);
        objects[0].radius
    };
    let [told, untold] = [true, false].map(|are_told| {
        let widened: Vec<Ellipse> = arcs.iter().map(|arc| with_strays(&header, arc, are_told)).collect();
        radius(&widened) - radius(&arcs)
    });
    assert!(told.abs() < 0.3 * untold && untold > 3e-3, "{told} and {untold} m");
}

#[test]
fn outside_is_each_end_up_to_the_first_ray_that_is_farther_within_the_outline() {
    let (header, ellipses) = ellipses_of_a_can();
    let mut arcs = Arcs::default();
    arcs.read(&header, &ellipses);
    let arc = arcs.arcs.iter().find(|arc| arc.scan == Scan::Row && arc.line == 120).unwrap();
    let can = |x: f64, radius: f64| {
        Conical { point: Vector3::new(x, 0.0, 2.0), axis: Vector3::y(), radius, slope: 0.0 }.coefficients()
    };
    let near = |x: f64, radius: f64, edge_px: f64| {
        let ends: Vec<_> = arc.outside(&can(x, radius), edge_px).collect();
        ends.iter()
            .map(|end| end.mean())
            .for_each(|at| assert!(at.x.abs() > 0.15 && (1.8..2.1).contains(&at.z), "{at}"));
        let points = |end: &SpaceMoments| (end.weight() * f64::from(arc.count) / arc.points).round() as usize;
        [-1.0, 1.0].map(|side| ends.iter().filter(|end| end.mean().x * side > 0.0).map(points).sum::<usize>())
    };
    // The outermost rays touch a can of 0.189 m, each farther in one that is smaller by 7 mm.
    let outside = |x: f64, radius: f64| near(x, radius, 0.0);
    assert_eq!([outside(0.0, 0.193), outside(0.0, 0.186), outside(0.0, 0.15)], [[0, 0], [1, 1], [6, 6]]);
    assert_eq!([outside(0.03, 0.2), outside(-0.03, 0.2)], [[3, 0], [0, 3]]);
    let within = [0.5, 1.0, 2.0, 4.0, 99.0].map(|edge_px| near(0.0, 0.193, edge_px));
    assert_eq!(within, [[0, 0], [1, 1], [2, 2], [4, 4], [END_POINTS; 2]]);
}

#[test]
fn lines_near_the_outline_do_not_count_unless_most_are_such() {
    let mut arcs = arcs_of(&[sphere(Vector3::z() * 1.5, 0.2), wall(4.0)]);
    arcs.arcs.retain(|arc| arc.scan == Scan::Row && arc.mean.z < 2.0);
    let all: Vec<_> = (0..arcs.arcs.len()).collect();
    let model = model::fit(ObjectKind::Sphere, &arcs.of(&all), None, f64::INFINITY).unwrap();
    let weight =
        |members: &[usize], edge_px: f64| pool_within(&Region { arcs: &arcs, model, members }, edge_px).weight();
    // The outline has a radius of 39.3 pixels, its rows are 81 to 158: three at either end are within three pixels of it.
    let rest = &all[3..all.len() - 3];
    assert_eq!((all.len(), weight(&all, 3.0)), (78, weight(rest, 3.0)));
    assert!(weight(&all, 0.0) > 1.02 * weight(&all, 3.0));
    assert_eq!(weight(&all[..5], 3.0), weight(&all[..5], 0.0), "nothing else tells of what is seen at its edge alone");
    assert!(weight(&all[..6], 3.0) < 0.7 * weight(&all[..6], 0.0));
}

#[test]
fn no_line_is_left_out_as_a_whole_where_nothing_is_flattened() {
    let arcs = arcs_of(&[sphere(Vector3::z() * 1.5, 0.2), wall(4.0)]);
    let rows = rows_of(&arcs, |arc| arc.mean.z < 2.0);
    let Some(Model::Sphere(mut fit)) = model::fit(ObjectKind::Sphere, &arcs.of(&rows), None, f64::INFINITY) else {
        panic!("no ball")
    };
    // The outermost lines pass by such a ball.
    fit.surface.radius = 0.18;
    let model = Model::Sphere(fit);
    let q = model.coefficients();
    let beside = arcs.of(&rows).filter(|arc| arc.grazes(&q, 0.0)).count();
    let weight = |arc: &Arc| arc.space().weight() - arc.outside(&q, 0.0).map(|end| end.weight()).sum::<f64>();
    let expected: f64 = arcs.of(&rows).map(|arc| weight(arc) / arc.variance).sum();
    let found = pool_within(&Region { arcs: &arcs, model, members: &rows }, 0.0).weight();
    assert!((4..20).contains(&beside) && (found / expected - 1.0).abs() < 1e-9, "{beside}: {found} {expected}");
}

/// Returns the image of a sensor that smears the silhouette of a ball outwards by `outwards` pixels: the ring from twice as far
/// within the outline to the outline is stretched outwards to there. `middle` and `radius_px` are those of the outline.
fn smeared(camera: Camera, pixels: &[u16], middle: [f64; 2], radius_px: f64, outwards: f64) -> Vec<u16> {
    let (width, inner) = (camera.width as usize, radius_px - 2.0 * outwards);
    let shown = |at: usize| {
        let [x, y] = [(at % width) as f64 - middle[0], (at / width) as f64 - middle[1]];
        let from_middle = x.hypot(y);
        let within = (inner..radius_px + outwards).contains(&from_middle);
        let factor = if within { (inner + 2.0 / 3.0 * (from_middle - inner)) / from_middle } else { 1.0 };
        let [x, y] = [middle[0] + factor * x, middle[1] + factor * y].map(|place| place.round() as usize);
        pixels[y * width + x]
    };
    (0..pixels.len()).map(shown).collect()
}

#[test]
fn what_lies_near_a_smeared_silhouette_does_not_make_a_ball_larger() {
    let (camera, radius, distance) = (KINECT_HALF, 0.15, 1.2_f64);
    let outline_px = camera.fx * radius / (distance * distance - radius * radius).sqrt();
    let error = |outwards: f64| {
        let mut extractor = Extractor::new(ExtractorParameters::default());
        let mut assembler = Assembler::new(AssemblerParameters::default());
        let errors = (0..20).map(|seed| {
            let ball = sphere(Vector3::z() * distance, radius);
            let (header, pixels) = render(camera, NoiseModel::KINECT_V1, &[ball, wall(3.0)], seed);
            let pixels = smeared(camera, &pixels, [camera.cx, camera.cy], outline_px, outwards);
            let found = assembler.assemble(&header, extractor.extract(&header, &pixels));
            single(found, ObjectKind::Sphere).radius - radius
        });
        errors.skip(10).sum::<f64>() / 10.0
    };
    // With all points it would be larger by 3 mm where two pixels are added.
    for outwards in [0.0, 1.0, 2.0] {
        let error = error(outwards);
        assert!(error.abs() < 5e-4, "{error} m, smeared by {outwards} pixels");
    }
}
