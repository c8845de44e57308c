use super::super::random_scene::{SceneGroup, random_scene};
use super::super::scene::Scene;
use super::*;
use crate::rendered::{plane, sphere};

const CAMERA: Camera = Camera { width: 320, height: 240, fx: 262.5, fy: 262.5, cx: 159.5, cy: 119.5 };
/// Depth unit of a tenth of a millimetre, in metres, so that the pixels' rounding is far below the noise.
const FINE: f64 = 1e-4;

/// A plane through (0, 0, z), rotated about the camera's x axis.
fn wall(z: f64, tilt: f64) -> Shape {
    plane(Vector3::new(0.0, tilt.sin(), -tilt.cos()), -tilt.cos() * z)
}

fn ball() -> Shape {
    sphere(Vector3::new(0.0, 0.0, 1.2), 0.3)
}

fn measure(config: SensorConfig, shapes: &[Shape], dice: CounterRng) -> (Raster, Vec<u16>) {
    let raster = Raster::of(CAMERA, shapes);
    let mut pixels = vec![7; raster.depth.len()];
    Sensor::new(config, FINE).measure(&raster, shapes, &dice, &mut pixels);
    (raster, pixels)
}

fn only(spoil: impl FnOnce(&mut SensorTable)) -> SensorConfig {
    let mut table = SensorTable::IDEAL;
    spoil(&mut table);
    SensorConfig::Table(table)
}

const IDEAL: SensorConfig = SensorConfig::Named(NoiseName::Ideal);
const KINECT: SensorConfig = SensorConfig::Named(NoiseName::KinectV1);

#[test]
fn an_ideal_sensor_rounds_and_does_nothing_else() {
    let (raster, pixels) = measure(IDEAL, &[ball(), wall(2.0, 0.3)], CounterRng::new(1, 1));
    for (&pixel, &z) in pixels.iter().zip(&raster.depth) {
        assert_eq!(f64::from(pixel), (z / FINE).round());
    }
}

#[test]
fn noise_has_the_mean_and_the_sigma_of_the_model() {
    for z in [0.8, 1.5, 2.0, 3.0, 4.0, 6.0] {
        let (_, pixels) = measure(KINECT, &[wall(z, 0.0)], CounterRng::new(5, 0));
        let depths: Vec<f64> =
            pixels.iter().filter(|&&pixel| pixel != 0).map(|&pixel| f64::from(pixel) * FINE).collect();
        assert!(depths.len() == pixels.len(), "a wall seen from the front loses no point");
        let count = depths.len() as f64;
        let mean = depths.iter().sum::<f64>() / count;
        let sigma = (depths.iter().map(|depth| (depth - mean).powi(2)).sum::<f64>() / count).sqrt();
        let model = NoiseModel::KINECT_V1.sigma(z);
        // depth is 1 / disparity: the mean moves by sigma^2 / z
        assert!((mean - z).abs() < 0.05 * model + 1.5 * model * model / z, "mean {mean} at {z}");
        assert!((sigma / model - 1.0).abs() < 0.03, "sigma {sigma} at {z}, expected {model}");
    }
}

#[test]
fn neighbors_share_their_noise_as_far_as_their_windows_overlap() {
    let sigma = 0.01;
    for window in [1, 3, 4_u32] {
        let sensor = only(|table| (table.floor_m, table.noise_window_px) = (sigma, window));
        let (raster, pixels) = measure(sensor, &[wall(2.0, 0.0)], CounterRng::new(7, 0));
        let error = |u: u32, v: u32| {
            let index = raster.index(i64::from(u), i64::from(v));
            (f64::from(pixels[index]) * FINE - raster.depth[index]) / sigma
        };
        let correlation = |right: u32, down: u32| {
            let pairs = (0..230 * 310).map(|i| (i % 310, i / 310));
            pairs.map(|(u, v)| error(u, v) * error(u + right, v + down)).sum::<f64>() / f64::from(230 * 310)
        };
        for (right, down) in [(0, 0), (1, 0), (0, 1), (2, 1), (3, 0), (5, 5)] {
            let overlap =
                f64::from(window.saturating_sub(right) * window.saturating_sub(down)) / f64::from(window * window);
            let shared = correlation(right, down);
            assert!(
                (shared - overlap).abs() < 0.03,
                "{shared} at {right}, {down} of a window of {window}, not {overlap}"
            );
        }
    }
}

#[test]
fn noise_grows_at_grazing_angles() {
    let sensor = only(|table| table.grazing_noise = 1e-4);
    for degrees in [0.0_f64, 60.0, 75.0, 82.0] {
        let (raster, pixels) = measure(sensor, &[wall(2.0, degrees.to_radians())], CounterRng::new(3, 0));
        // A few pixels around the middle, where the angle is that of the wall.
        let middle = (117..123).flat_map(|row| row * 320 + 130..row * 320 + 190);
        let squares = middle.map(|i| (f64::from(pixels[i]) * FINE - raster.depth[i]).powi(2));
        let sigma = (squares.sum::<f64>() / 360.0).sqrt();
        let expected = 1e-4 / 2.0_f64.sqrt() * (degrees / (90.0 - degrees)).powi(2);
        assert!((sigma - expected).abs() < 0.15 * expected + 1e-4, "{sigma} at {degrees} degrees, expected {expected}");
    }
}

#[test]
fn depth_comes_in_steps_of_disparity() {
    let (_, pixels) = measure(KINECT, &[wall(3.0, 0.0)], CounterRng::new(5, 0));
    let mut levels: Vec<u16> = pixels;
    levels.sort_unstable();
    levels.dedup();
    assert!(levels.len() < 20, "{} levels", levels.len());
    let step = NoiseModel::KINECT_V1.step_per_m;
    for level in levels {
        let disparity = 1.0 / (f64::from(level) * FINE * step);
        assert!((disparity - disparity.round()).abs() < 0.005, "{level}: {disparity} eighths of a pixel");
    }
}

#[test]
fn bits_depend_on_seed_and_frame_alone() {
    let shapes = [ball(), wall(2.0, 0.3)];
    let frame = |seed, number| measure(KINECT, &shapes, CounterRng::new(seed, number)).1;
    assert_eq!(frame(1, 4), frame(1, 4));
    let differing = |a: &[u16], b: &[u16]| a.iter().zip(b).filter(|(a, b)| a != b).count();
    assert!(differing(&frame(1, 4), &frame(1, 5)) > 30_000);
    assert!(differing(&frame(1, 4), &frame(2, 4)) > 30_000);
}

#[test]
fn points_get_lost_at_grazing_angles_only() {
    let sensor = only(|table| table.dropout_angle_deg = 70.0);
    let lost = |tilt_deg: f64| {
        let (raster, pixels) = measure(sensor, &[wall(2.0, tilt_deg.to_radians())], CounterRng::new(3, 0));
        // the middle row, where the ray is nearly the optical axis
        let row = &pixels[raster.index(100, 120)..raster.index(220, 120)];
        row.iter().filter(|&&pixel| pixel == 0).count()
    };
    assert_eq!(lost(0.0), 0);
    assert_eq!(lost(65.0), 0);
    let expected = 120.0 * (1.0 - 80.0_f64.to_radians().cos() / 70.0_f64.to_radians().cos());
    assert!((lost(80.0) as f64 - expected).abs() < 18.0, "{} lost, expected {expected:.0}", lost(80.0));
}

#[test]
fn only_silhouettes_are_restless() {
    let shapes = [ball(), wall(2.0, 0.0)];
    let (raster, pixels) = measure(only(|table| table.edge_jitter_px = 0.5), &shapes, CounterRng::new(3, 0));
    let (_, exact) = measure(IDEAL, &shapes, CounterRng::new(3, 0));
    let (mut changed, mut at_silhouette) = (0, 0);
    let radius = 262.5 * 0.3 / (1.2_f64 * 1.2 - 0.09).sqrt();
    for (u, v) in (0..240).flat_map(|v| (0..320).map(move |u| (u, v))) {
        let index = raster.index(u, v);
        let from_silhouette = ((u as f64 - 159.5).hypot(v as f64 - 119.5) - radius).abs();
        at_silhouette += usize::from(from_silhouette < 0.5);
        if pixels[index] != exact[index] {
            changed += 1;
            assert!(from_silhouette < 2.5, "({u}, {v}) is {from_silhouette} pixels away");
        }
    }
    assert!(changed > at_silhouette / 4 && changed < at_silhouette, "{changed} of {at_silhouette} changed");
}

#[test]
fn the_shadow_lies_on_the_left_and_range_has_limits() {
    let shapes = [ball(), wall(2.0, 0.0)];
    let (raster, pixels) = measure(only(|table| table.shadow_baseline_m = 0.075), &shapes, CounterRng::new(3, 0));
    let dark: Vec<i64> = (0..320).filter(|&u| pixels[raster.index(u, 120)] == 0).collect();
    let radius = 262.5 * 0.3 / (1.2_f64 * 1.2 - 0.09).sqrt();
    let left_edge = 159.5 - radius;
    assert!(dark.len() >= 5 && dark.iter().all(|&u| (u as f64 - left_edge).abs() < 12.0), "{dark:?}");
    let (_, pixels) =
        measure(only(|table| (table.min_range_m, table.max_range_m) = (1.0, 1.9)), &shapes, CounterRng::new(3, 0));
    assert_eq!(pixels[raster.index(159, 120)], 0, "the ball's front is at 0.9 m");
    assert_eq!(pixels[raster.index(10, 10)], 0, "the wall is at 2 m");
    assert_ne!(pixels[raster.index(159 + 62, 120)], 0, "the ball's rim is at 1.02 m");
}

/// Depths that do not fit into 16 bits are not measured.
#[test]
fn depths_beyond_the_pixels_range_are_no_measurement() {
    let (_, pixels) = measure(IDEAL, &[wall(7.0, 0.0)], CounterRng::new(0, 0));
    assert!(pixels.iter().all(|&pixel| pixel == 0), "70000 units");
}

#[test]
fn words_and_tables_are_understood() {
    #[derive(Debug, Deserialize)]
    struct Stage {
        noise: SensorConfig,
    }
    let parse = |text: &str| toml::from_str::<Stage>(text).map(|stage| stage.noise);
    assert_eq!(parse("noise = 'ideal'").unwrap(), IDEAL);
    let table = SensorTable { edge_jitter_px: 0.0, ..SensorTable::KINECT_V1 };
    assert_eq!(parse("noise = { edge_jitter_px = 0.0 }").unwrap(), SensorConfig::Table(table));
    let error = parse("noise = { jitter = 1.0 }").unwrap_err().to_string();
    assert!(error.contains("`edge_jitter_px`"), "{error}");
    assert_eq!(SensorConfig::from(NoiseConfig::default()), KINECT);
}

/// The bits of one frame, which are the same on every machine; a change of the model changes them, and has to be announced to
/// users.
#[test]
fn bits_are_the_same_on_every_machine() {
    let fnv = |bytes: &[u8]| {
        let step = |hash: u64, byte: &u8| (hash ^ u64::from(*byte)).wrapping_mul(0x0100_0000_01b3);
        bytes.iter().fold(0xcbf2_9ce4_8422_2325_u64, step)
    };
    // A lying cone, seen by a camera whose roll has a tangent that the platform's function may round differently; the last bit
    // shows only in the exact depth.
    let (ball, cone) = (Scene::built_in("bouncing_ball").unwrap().unwrap(), random_scene(SceneGroup::Lying, 1812));
    for (scene, expected) in
        [(ball, [0x110a_e80b_122a_ed45, 0xc07e_090c_6ca9_adb4]), (cone, [0x1905_41eb_df24_c359, 0x3ea6_f8a8_138a_3fa2])]
    {
        let shapes: Vec<Shape> = scene.shapes_in_camera(0.5).collect();
        let (raster, pixels) = measure(KINECT, &shapes, CounterRng::new(11, 15));
        let exact: Vec<u8> = raster.depth.iter().flat_map(|depth| depth.to_le_bytes()).collect();
        let noisy: Vec<u8> = pixels.iter().flat_map(|pixel| pixel.to_le_bytes()).collect();
        let hashes = [exact, noisy].map(|bytes| fnv(&bytes));
        assert_eq!(hashes, expected, "{hashes:#x?} of {}", scene.name);
    }
}
