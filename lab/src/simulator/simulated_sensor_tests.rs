use super::super::shapes::{Frustum, Plane};
use super::*;
use crate::quantile::median;
use crate::rendered::plane;
use nalgebra::Vector3;

const CAMERA: Camera = Camera { width: 320, height: 160, fx: 525.0, fy: 525.0, cx: 159.5, cy: 79.5 };
/// Depth unit of a tenth of a millimetre, in metres, so that the pixels' rounding is far below the noise.
const FINE: f64 = 1e-4;
const STEREO: SimulatedSensor = SimulatedSensor::Named(SensorKind::Stereo);
const STRUCTURED_LIGHT: SimulatedSensor = SimulatedSensor::Named(SensorKind::StructuredLight);
const TIME_OF_FLIGHT: SimulatedSensor = SimulatedSensor::Named(SensorKind::TimeOfFlight);

fn board(z: f64, half: f64) -> Shape {
    let sides = [Vector3::x(), Vector3::y()];
    let (point, normal) = (Vector3::new(0.0, 0.0, z), -Vector3::z());
    Shape::Plane(Plane { point, normal, sides, half: [half, f64::INFINITY].map(|half| half.min(10.0)) })
}

/// Returns the depths of a frame in metres, row by row; 0 without a measurement.
fn shot(sensor: SimulatedSensor, shapes: &[Shape], seed: u64, frame: u64) -> Vec<f64> {
    let raster = Raster::of(CAMERA, shapes);
    let mut pixels = vec![7; raster.depth.len()];
    let mut simulation = SensorSimulation::new(sensor, &CAMERA, FINE, seed);
    simulation.measure(&raster, shapes, &CounterRng::new(seed, frame), &mut pixels);
    pixels.into_iter().map(|pixel| f64::from(pixel) * FINE).collect()
}

/// Returns the share of a column's pixels that fulfil a condition.
fn share(depths: &[f64], column: usize, holds: impl Fn(f64) -> bool) -> f64 {
    let width = CAMERA.width as usize;
    let column = depths.chunks_exact(width).map(|row| row[column]);
    column.filter(|depth| holds(*depth)).count() as f64 / f64::from(CAMERA.height)
}

fn is_near(depth: f64) -> bool {
    (0.9..1.1).contains(&depth)
}

fn is_far(depth: f64) -> bool {
    (1.8..2.2).contains(&depth)
}

#[test]
fn a_frame_is_a_function_of_seed_and_number() {
    let shapes = [board(1.0, 0.1), board(2.0, 10.0)];
    for sensor in [STEREO, STRUCTURED_LIGHT, TIME_OF_FLIGHT] {
        let one = shot(sensor, &shapes, 3, 5);
        assert_eq!(one, shot(sensor, &shapes, 3, 5));
        assert_ne!(one, shot(sensor, &shapes, 3, 6), "other noise");
        assert_ne!(one, shot(sensor, &shapes, 4, 5), "another camera");
    }
}

/// A board at 1 m in front of a wall at 2 m: the band of the wall that the second eye or the projector does not see is a hole on
/// the left of the board, as wide as the difference of the disparities.
#[test]
fn what_the_second_eye_or_the_projector_does_not_see_is_a_hole() {
    let shapes = [board(1.0, 0.1), board(2.0, 10.0)];
    let left_edge = 159.5 - 525.0 * 0.1;
    for (sensor, baseline_m) in [(STEREO, 0.055), (STRUCTURED_LIGHT, 0.075)] {
        let depths = shot(sensor, &shapes, 1, 1);
        let band = 525.0 * baseline_m * 0.5;
        let hole = (0..160).filter(|&u| share(&depths, u, |depth| depth == 0.0) > 0.5).collect::<Vec<_>>();
        assert!(!hole.is_empty() && (hole.len() as f64 - band).abs() < 4.0, "{sensor:?}: {hole:?}, expected {band}");
        assert!(hole.iter().all(|&u| (u as f64) < left_edge + 2.0), "{sensor:?}: {hole:?}");
        let beyond = left_edge - band - 8.0;
        assert!(share(&depths, beyond as usize, is_far) > 0.9, "{sensor:?}: the wall beside the hole");
        assert!(share(&depths, 159, is_near) > 0.95 && share(&depths, 300, is_far) > 0.95, "{sensor:?}");
    }
}

/// As in recordings, a silhouette ends at its true position or slightly inside, although windows see both surfaces.
#[test]
fn a_silhouette_does_not_grow() {
    let shapes = [board(1.0, 0.1), board(2.0, 10.0)];
    let (left, right) = (107, 212); // the first and the last column of the board
    for sensor in [STEREO, STRUCTURED_LIGHT] {
        let depths = shot(sensor, &shapes, 1, 1);
        let near = |u: usize| share(&depths, u, is_near);
        let grown_left = (80..left).map(near).sum::<f64>() - (left..160).map(|u| 1.0 - near(u)).sum::<f64>();
        let grown_right = (right + 1..240).map(near).sum::<f64>() - (160..=right).map(|u| 1.0 - near(u)).sum::<f64>();
        for (side, grown) in [("left", grown_left), ("right", grown_right)] {
            assert!((-2.0..0.8).contains(&grown), "{sensor:?}: {grown} px to the {side}");
        }
    }
}

/// In a recording of a tin of this size and distance, the excess is 0.4 and 0.5 pixels in the first three pixels from its
/// silhouettes, and 0.0 and 0.1 from the fifth to the eighth (`experiments/README.md`).
#[test]
fn what_is_round_is_flattened_at_its_silhouettes_as_in_recordings() {
    let (radius, z) = (0.034, 0.6);
    let (base, axis) = (Vector3::new(0.0, 1.0, z), -Vector3::y());
    let tin = Frustum { base, axis, length: 2.0, base_radius: radius, top_radius: radius, open: false };
    let shapes = [Shape::Frustum(tin), board(0.9, 10.0)];
    let raster = Raster::of(CAMERA, &shapes);
    let depths: Vec<_> = (0..4).map(|seed| shot(STEREO, &shapes, seed, 1)).collect();
    let on_tin = |u: usize| raster.depth[u] < z;
    let (first, last) = ((0..320).find(|&u| on_tin(u)).unwrap(), (0..320).rfind(|&u| on_tin(u)).unwrap());
    // Returns the excess of the disparity over that of the tin in pixels, as the median of all rows that measure it.
    let excess = |u: usize| {
        let of_row = |v: usize| (v * 320 + u, raster.depth[v * 320 + u]);
        let measured = depths.iter().flat_map(|depths| (0..160).map(move |v| (depths, of_row(v))));
        let near = measured.filter(|(depths, (index, truth))| (depths[*index] - truth).abs() < 0.05);
        median(near.map(|(depths, (index, truth))| 525.0 * 0.055 * (1.0 / depths[index] - 1.0 / truth)).collect())
    };
    for at in [|first: usize, _: usize, k: usize| first + k, |_, last: usize, k: usize| last - k] {
        let [edge, inside] = [0..3, 4..8].map(|pixels| {
            let all: Vec<f64> = pixels.filter_map(|k| excess(at(first, last, k))).collect();
            all.iter().sum::<f64>() / all.len() as f64
        });
        assert!((0.2..0.7).contains(&edge) && inside.abs() < 0.12, "{edge} at the silhouette, {inside} inside");
    }
}

#[test]
fn pixels_of_time_of_flight_fly_between_two_surfaces() {
    let half = 0.1 + 0.25 / 525.0; // the edge crosses a pixel
    let shapes = [board(1.0, half), board(2.0, 10.0)];
    let depths = shot(TIME_OF_FLIGHT, &shapes, 1, 1);
    let flying = |u: usize| share(&depths, u, |depth| (1.1..1.9).contains(&depth));
    let columns: Vec<usize> = (0..320).filter(|&u| flying(u) > 0.5).collect();
    assert!((2..=6).contains(&columns.len()), "{columns:?}");
    assert!(columns.iter().all(|&u| ((u as f64 - 159.5).abs() - 525.0 * half).abs() < 2.0), "{columns:?}");
    assert!(depths.iter().all(|depth| *depth > 0.0), "it sees from where it lights");
}

#[test]
fn too_little_light_comes_back_from_what_is_seen_at_a_flat_angle() {
    let steep = |tilt: f64| plane(Vector3::new(0.0, libm::sin(tilt), -libm::cos(tilt)), -libm::cos(tilt));
    let middle = |tilt: f64| shot(TIME_OF_FLIGHT, &[steep(tilt)], 1, 1)[80 * 320 + 160];
    assert!((middle(1.2) - 1.0).abs() < 0.02 && middle(1.5) == 0.0);
}

#[derive(Deserialize)]
struct Stage {
    sensor: SimulatedSensor,
}

#[test]
fn words_and_tables_are_understood_and_windows_checked() {
    let sensor = |text: &str| toml::from_str::<Stage>(text).map(|stage| stage.sensor);
    assert_eq!(sensor("sensor = 'structured_light'").unwrap(), STRUCTURED_LIGHT);
    let table = sensor("sensor = { stereo = { baseline_m = 0.1 } }").unwrap();
    assert_eq!(
        table.numbers(),
        SensorNumbers::Stereo(MatchingNumbers { baseline_m: Some(0.1), ..MatchingNumbers::default() })
    );
    assert_eq!(table.fault(), None);
    let wide = sensor("sensor = { structured_light = { window_px = [100, 9] } }").unwrap();
    assert!(wide.fault().unwrap().what.contains("100 times 9"));
    for text in ["sensor = 'lidar'", "sensor = { stereo = { base = 1 } }", "sensor = 3"] {
        let error = sensor(text).err().unwrap().to_string();
        assert!(error.contains("\"structured_light\""), "{error}");
    }
}
