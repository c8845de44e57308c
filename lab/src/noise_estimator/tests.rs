use super::*;
use crate::rendered::sensor_of;
use crate::simulator::scene::Scene;
use crate::simulator::sensor::SensorConfig;
use crate::simulator::{SimulatorParameters, SyntheticCamera};
use conicflow_detection::noise::{NoiseConfig, REALSENSE_D435, TIME_OF_FLIGHT};
use conicflow_messages::NoiseModel;

/// A floor seen from 0.8 to 6 m, with a box on it.
const FLOOR: &str = "
name = 'floor'
[camera]
position = [0, 0, 0.7]
direction = [0, 1, -0.5]
[[plane]]
name = 'floor'
point = [0, 0, 0]
normal = [0, 0.15, 1]
[[box]]
name = 'box'
center = [0.2, 1.2, 0.1]
size = [0.3, 0.3, 0.3]
";

/// A wall straight ahead.
const WALL: &str = "
name = 'wall'
[camera]
position = [0, 0, 0]
direction = [0, 1, 0]
[[plane]]
name = 'wall'
point = [0, 2, 0]
normal = [0.1, -1, 0.1]
";

/// Estimates the noise from frames that have these scales in turn.
fn estimate(scene: &str, sensor: SensorConfig, scales: &[f64], frames: u64, recorded: Recorded) -> NoiseEstimate {
    let config = SimulatorParameters { width: 160, height: 120, ..SimulatorParameters::default() };
    let scene = Scene::parse(scene, "test").unwrap();
    let camera = |scale: &f64| SyntheticCamera::new(scene.clone(), config.camera(), sensor, *scale, 30.0, 5);
    let mut cameras: Vec<_> = scales.iter().map(camera).collect();
    let mut estimator =
        NoiseEstimator::with(NoiseEstimatorParameters { recorded, ..NoiseEstimatorParameters::default() });
    for number in 0..frames {
        let (header, pixels) = cameras[number as usize % scales.len()].frame(number);
        estimator.add(&header, &pixels).unwrap();
    }
    estimator.estimate().unwrap()
}

/// Returns the largest relative error of the estimated deviation over the measured depths.
fn worst(estimate: &NoiseEstimate, truth: &NoiseModel) -> f64 {
    let errors =
        estimate.seen.iter().map(|spread| estimate.model.sigma(spread.depth) / truth.sigma(spread.depth) - 1.0);
    errors.fold(0.0, |worst, error| worst.max(error.abs()))
}

#[test]
fn a_static_scene_tells_the_noise_of_a_kinect() {
    let estimate = estimate(FLOOR, SensorConfig::default(), &[0.001], 40, Recorded::StaticScene);
    let truth = NoiseModel::KINECT_V1;
    assert!(estimate.grows && estimate.seen.last().unwrap().depth > 3.0, "{estimate}");
    assert!((estimate.model.step_per_m / truth.step_per_m - 1.0).abs() < 0.01, "{estimate}");
    assert!(worst(&estimate, &truth) < 0.06, "{:.3}\n{estimate}", worst(&estimate, &truth));
}

/// As in recorded point clouds, of which some extend beyond 6.55 m.
#[test]
fn frames_of_several_scales_tell_it_as_well() {
    for (recorded, frames, limit) in [(Recorded::StaticScene, 40, 0.06), (Recorded::FlatWall, 6, 0.1)] {
        let estimate = estimate(FLOOR, SensorConfig::default(), &[0.0001, 0.00025], frames, recorded);
        let truth = NoiseModel::KINECT_V1;
        assert!((estimate.model.step_per_m / truth.step_per_m - 1.0).abs() < 0.01, "{estimate}");
        assert!(worst(&estimate, &truth) < limit, "{estimate}");
    }
}

#[test]
fn flat_walls_tell_it_from_a_few_frames() {
    let estimate = estimate(FLOOR, SensorConfig::default(), &[0.001], 6, Recorded::FlatWall);
    assert!(worst(&estimate, &NoiseModel::KINECT_V1) < 0.1, "{estimate}");
}

#[test]
fn stereo_and_time_of_flight_have_no_steps() {
    for truth in [REALSENSE_D435, TIME_OF_FLIGHT] {
        let estimate = estimate(FLOOR, sensor_of(truth), &[0.0001], 40, Recorded::StaticScene);
        assert_eq!(estimate.model.step_per_m, 0.0);
        assert!(worst(&estimate, &truth) < 0.05, "{estimate}");
    }
}

#[derive(serde::Deserialize)]
struct Stage {
    noise: NoiseConfig,
}

#[test]
fn the_line_that_is_printed_is_understood_by_a_source() {
    let estimate = estimate(FLOOR, SensorConfig::default(), &[0.001], 25, Recorded::StaticScene);
    let model: NoiseModel = toml::from_str::<Stage>(&estimate.to_string()).unwrap().noise.into();
    assert!((model.sigma(2.0) / estimate.model.sigma(2.0) - 1.0).abs() < 1e-3);
}

#[test]
fn one_distance_tells_no_growth() {
    let estimate = estimate(WALL, SensorConfig::default(), &[0.001], 30, Recorded::StaticScene);
    assert!(!estimate.grows && estimate.model.growth_per_m == 0.0);
    assert!(estimate.to_string().contains("too much alike"));
    assert!((estimate.model.sigma(2.0) / NoiseModel::KINECT_V1.sigma(2.0) - 1.0).abs() < 0.05, "{estimate}");
}

#[test]
fn too_little_is_told() {
    let estimator = NoiseEstimator::with(NoiseEstimatorParameters::default());
    assert!(estimator.estimate().unwrap_err().to_string().contains("no frame"));
    let mut estimator = NoiseEstimator::with(NoiseEstimatorParameters::default());
    let camera = conicflow_messages::Camera { width: 4, height: 3, ..Default::default() };
    let header = Header { camera, depth_scale: 0.001, ..Header::default() };
    estimator.add(&header, &[1000; 12]).unwrap();
    let few = estimator.estimate().unwrap_err().to_string();
    assert!(
        few.starts_with("the recording has 1 frames, but a static scene needs `min_frames` = 20\n  hint: "),
        "{few}"
    );
    let other = Header { camera: conicflow_messages::Camera { width: 3, height: 4, ..camera }, ..header };
    assert!(estimator.add(&other, &[1000; 12]).unwrap_err().to_string().contains("another size"));
}
