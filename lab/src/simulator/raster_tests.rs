use super::super::scene::Scene;
use super::super::scene_file::BUILT_IN;
use super::*;
use crate::rendered::{plane, sphere};
use crate::simulator::SimulatorParameters;

fn camera(width: u32, height: u32) -> Camera {
    SimulatorParameters { width, height, ..SimulatorParameters::default() }.camera()
}

fn wall(z: f64) -> Shape {
    plane(Vector3::z(), z)
}

#[test]
fn depth_is_along_the_optical_axis() {
    let raster = Raster::of(camera(64, 48), &[wall(2.0)]);
    assert!(raster.depth.iter().all(|&z| (z - 2.0).abs() < 1e-12), "a wall has the same depth everywhere");
    assert_eq!(raster.alone, [64 * 48]);
}

#[test]
fn the_nearest_surface_is_seen_whatever_the_order() {
    let ball = sphere(Vector3::new(0.0, 0.0, 1.5), 0.2);
    let [one, other] = [[ball, wall(2.0)], [wall(2.0), ball]].map(|shapes| Raster::of(camera(64, 48), &shapes));
    assert_eq!(one.depth, other.depth);
    let (seen, hidden) = (one.owner.iter().filter(|&&owner| owner == 0).count(), one.alone[1] as usize);
    assert_eq!(seen, one.alone[0] as usize);
    assert_eq!(hidden, 64 * 48);
    // the outline of a ball: a circle of tan(asin(R / d)) around the middle
    let radius = 52.5 * 0.2 / (1.5_f64 * 1.5 - 0.04).sqrt();
    let area = std::f64::consts::PI * radius * radius;
    assert!((seen as f64 - area).abs() < 0.05 * area, "{seen} pixels, expected {area:.0}");
}

/// Intersects every ray with every shape, without windows.
fn every_ray(raster: &Raster, shapes: &[Shape]) -> Vec<f64> {
    let camera = &raster.camera;
    let depth = |u: i64, v: i64| {
        let hits = shapes.iter().map(|shape| shape.hit(&Vector3::zeros(), &ray(camera, u, v)));
        hits.fold(f64::INFINITY, f64::min)
    };
    let pixels = (0..i64::from(camera.height)).flat_map(|v| (0..i64::from(camera.width)).map(move |u| (u, v)));
    pixels.map(|(u, v)| depth(u, v)).collect()
}

#[test]
fn windows_cut_nothing_off() {
    for (name, time_s) in BUILT_IN.iter().flat_map(|(name, _)| [0.0, 1.7, 8.0].map(|time_s| (name, time_s))) {
        let scene = Scene::built_in(name).unwrap().unwrap();
        let shapes: Vec<Shape> = scene.shapes_in_camera(time_s).collect();
        let raster = Raster::of(camera(80, 60), &shapes);
        assert_eq!(raster.depth, every_ray(&raster, &shapes), "{name} at {time_s} s");
    }
}

#[test]
fn what_surrounds_the_camera_or_lies_behind_it_is_rendered_rightly() {
    let around = sphere(Vector3::new(0.1, 0.0, 0.0), 1.0);
    let behind = sphere(Vector3::new(0.0, 0.0, -2.0), 1.0);
    let raster = Raster::of(camera(64, 48), &[around, behind]);
    assert!(raster.owner.iter().all(|&owner| owner == 0));
    let distance = |u, v| (raster.point(u, v) - Vector3::new(0.1, 0.0, 0.0)).norm();
    assert!((distance(3, 40) - 1.0).abs() < 1e-12);
    assert_eq!(raster.alone[1], 0);
}

/// At three times the resolution, every third pixel has the same ray.
#[test]
fn resolutions_show_the_same_scene() {
    let scene = Scene::built_in("tabletop").unwrap().unwrap();
    let shapes: Vec<Shape> = scene.shapes_in_camera(0.5).collect();
    let [small, large] = [camera(64, 48), camera(192, 144)].map(|camera| Raster::of(camera, &shapes));
    for (u, v) in (0..48).flat_map(|v| (0..64).map(move |u| (u, v))) {
        let (z, same) = (small.depth[small.index(u, v)], large.depth[large.index(3 * u + 1, 3 * v + 1)]);
        assert!((z - same).abs() < 1e-9, "({u}, {v}): {z} and {same}");
    }
}
