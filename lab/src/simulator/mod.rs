//! A depth camera that is simulated exactly: rays are intersected with the shapes of a scene file in closed form, a model of the
//! sensor adds its errors, and the true objects are known.
//!
//! The steps of a frame: [`scene`] (poses at this time, by [`motion`]) -> [`raster`] (exact depth, by [`shapes`]) -> [`sensor`]
//! (noise, silhouettes, shadow, lost points) or [`simulated_sensor`] (the sensor's own images, and depths from these) -> pixels;
//! and from the raster to [`truth`].

mod block;
mod block_matching;
mod dot_pattern;
mod fields;
mod lump;
mod matching_camera;
pub mod motion;
mod noise_field;
pub mod pose;
pub mod random_scene;
pub mod random_scenes;
pub mod raster;
pub mod scene;
mod scene_file;
pub mod scene_values;
mod screen;
pub mod sensor;
mod shadow;
pub mod shapes;
pub mod simulated_sensor;
mod surface;
mod time_of_flight;
pub mod truth;
mod waves;

use crate::random::CounterRng;
use anyhow::{Result, bail};
use conicflow_detection::camera::Intrinsics;
use conicflow_detection::noise::NoiseConfig;
use conicflow_messages::{Camera, ConfigFault, Frame, Header, Hinted, INVALID_NEAR, NoiseModel, Text, Velocity};
use nalgebra::Vector3;
use random_scenes::RandomScenes;
use raster::Raster;
use scene::{Role, Scene};
use scene_file::BUILT_IN;
use scene_values::{SceneTemplate, Values};
use schemars::JsonSchema;
use sensor::{Sensor, SensorConfig};
use serde::{Deserialize, Serialize};
use shapes::Shape;
use simulated_sensor::{SensorSimulation, SimulatedSensor};
use std::path::{Path, PathBuf};
use truth::{Truth, truth_of};

/// Frame rate of simulated time if frames are produced as fast as possible.
pub const UNPACED_RATE_HZ: f64 = 30.0;
/// A depth camera in a scene. Each frame depends only on its number, the seed and the position to which the camera was driven.
#[derive(Clone, Debug)]
pub struct SyntheticCamera {
    scene: Scene,
    scenes: Option<RandomScenes>,
    sensor: Sensor,
    simulation: Option<SensorSimulation>,
    told_noise: NoiseModel,
    seed: u64,
    rate_hz: f64,
    depth_scale: f64,
    raster: Raster,
    shapes: Vec<Shape>,
    time_s: f64,
}

impl SyntheticCamera {
    /// Creates a camera with `rate_hz` frames per second (above 0) and `depth_scale` metres per unit of its pixels.
    pub fn new(scene: Scene, camera: Camera, noise: SensorConfig, depth_scale: f64, rate_hz: f64, seed: u64) -> Self {
        let sensor = Sensor::new(noise, depth_scale);
        let (raster, shapes, told_noise) = (Raster::new(camera), Vec::new(), sensor.noise_model());
        Self {
            scene,
            scenes: None,
            sensor,
            simulation: None,
            told_noise,
            seed,
            rate_hz,
            depth_scale,
            raster,
            shapes,
            time_s: 0.0,
        }
    }

    /// Returns the camera with another random scene in each frame.
    pub fn before(self, scenes: RandomScenes) -> Self {
        Self { scenes: Some(scenes), ..self }
    }

    /// Returns the camera with a simulated sensor instead of a noise model.
    pub fn with_sensor(self, sensor: SimulatedSensor) -> Self {
        let camera = self.raster.camera;
        let simulation = SensorSimulation::new(sensor, &camera, self.depth_scale, self.seed);
        Self { told_noise: simulation.noise_model(&camera), simulation: Some(simulation), ..self }
    }

    /// Returns the camera with another noise model in its headers than that of the sensor.
    pub fn with_noise_in_headers(self, noise: NoiseModel) -> Self {
        Self { told_noise: noise, ..self }
    }

    /// Moves the camera by a velocity for one frame, in addition to the scene's motion; it does not rotate.
    pub fn drive(&mut self, velocity: &Velocity) {
        let linear = Vector3::from(velocity.linear);
        let in_world = match velocity.frame() {
            Frame::Camera => self.scene.world_from_camera(self.time_s).rotation * linear,
            Frame::World => linear,
        };
        self.scene.camera_shift += in_world / self.rate_hz;
    }

    /// Takes frame `number`: writes the camera's pixels, row by row.
    pub fn shoot(&mut self, number: u64, pixels: &mut [u16]) {
        self.time_s = number as f64 / self.rate_hz;
        let mut noise = number;
        if let Some(scenes) = &self.scenes {
            (self.scene, noise) = scenes.scene(number);
        }
        self.shapes.clear();
        self.shapes.extend(self.scene.shapes_in_camera(self.time_s));
        self.raster.render(&self.shapes);
        let dice = CounterRng::new(self.seed, noise);
        match &mut self.simulation {
            Some(sensor) => sensor.measure(&self.raster, &self.shapes, &dice, pixels),
            None => self.sensor.measure(&self.raster, &self.shapes, &dice, pixels),
        }
        self.see_through_glass(pixels);
    }

    /// Takes frame `number`, and returns its header and pixels.
    pub fn frame(&mut self, number: u64) -> (Header, Vec<u16>) {
        let Camera { width, height, .. } = self.raster.camera;
        let (mut header, mut pixels) = (Header::default(), vec![0; width as usize * height as usize]);
        self.shoot(number, &mut pixels);
        self.describe(&mut header);
        (header, pixels)
    }

    /// Removes the depths of glass.
    fn see_through_glass(&self, pixels: &mut [u16]) {
        if self.scene.bodies.iter().all(|body| body.role != Role::Glass) {
            return;
        }
        for (pixel, owner) in pixels.iter_mut().zip(&self.raster.owner) {
            if self.scene.bodies.get(usize::from(*owner)).is_some_and(|body| body.role == Role::Glass) {
                *pixel = INVALID_NEAR;
            }
        }
    }

    /// Returns the true objects of the last frame.
    pub fn truth(&self) -> Vec<Truth> {
        truth_of(&self.scene, self.time_s, &self.raster, &self.shapes)
    }

    /// Returns the name of the last frame's scene.
    pub fn scene_name(&self) -> &str {
        &self.scene.name
    }

    /// Returns the simulated time of frame `number`, in seconds.
    pub fn time_of(&self, number: u64) -> f64 {
        number as f64 / self.rate_hz
    }

    /// Returns the exact depth of the last frame.
    pub fn raster(&self) -> &Raster {
        &self.raster
    }

    /// Fills in the header of the last frame.
    pub fn describe(&self, header: &mut Header) {
        header.camera = self.raster.camera;
        header.depth_scale = self.depth_scale;
        header.noise = self.told_noise;
        header.set_pose(self.scene.world_from_camera(self.time_s).rows());
        header.source = Text::new(&self.scene.name);
        header.stamp_ns = (self.time_s * 1e9).round() as u64;
    }
}

/// Parameters of the simulated camera.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct SimulatorParameters {
    /// Scene file, or the name of a built-in scene; none: `bouncing_ball`.
    pub scene: Option<PathBuf>,
    /// Values of the scene file, instead of the defaults under its `[values]`.
    pub values: Values,
    /// Another random scene in each frame, instead of `scene`: `{ groups = ["standing", ...], seeds = [first, last] }`.
    pub scenes: Option<RandomScenes>,
    /// Width of the image in pixels.
    #[schemars(range(min = 1, max = 4096))]
    pub width: u32,
    /// Height of the image in pixels.
    #[schemars(range(min = 1, max = 4096))]
    pub height: u32,
    /// Intrinsics in pixels; none: those of a Kinect v1, scaled to the width.
    pub intrinsics: Option<Intrinsics>,
    /// Frames per second; 0: as fast as they are taken, with 30 per second in simulated time.
    #[schemars(range(min = 0.0, max = 1000.0))]
    pub rate_hz: f64,
    /// Number of frames; 0: without end, of random scenes one for each.
    pub frames: u64,
    /// Seed of the noise.
    pub seed: u64,
    /// Errors of the sensor: "kinect_v1", "realsense_d435", "time_of_flight", "ideal" or a table.
    pub noise: SensorConfig,
    /// A simulation of the sensor itself, instead of `noise`: "stereo" (as a RealSense D400), "structured_light" (as a Kinect
    /// v1), both by matching blocks of rendered images, "time_of_flight", or a table such as `{ stereo = { baseline_m = 0.05 }
    /// }`.
    pub sensor: Option<SimulatedSensor>,
    /// Depth noise in the frames' headers, if not that of the sensor, to see the effect of a wrong model.
    pub told_noise: Option<NoiseConfig>,
    /// Metres per unit of a depth pixel.
    #[schemars(range(min = 1e-6, max = 1.0))]
    pub depth_scale: f64,
    /// File for the true objects, one line of JSON per frame; none: not written.
    pub truth_path: Option<PathBuf>,
}

impl Default for SimulatorParameters {
    fn default() -> Self {
        Self {
            scene: None,
            values: Values::new(),
            scenes: None,
            width: 640,
            height: 480,
            intrinsics: None,
            rate_hz: 30.0,
            frames: 0,
            seed: 0,
            noise: SensorConfig::default(),
            sensor: None,
            told_noise: None,
            depth_scale: 0.001,
            truth_path: None,
        }
    }
}

impl SimulatorParameters {
    /// Returns the number of all frames; `None` if there is no end.
    pub fn total(&self) -> Option<u64> {
        let wanted = (self.frames > 0).then_some(self.frames);
        let there = self.scenes.as_ref().map(RandomScenes::frames);
        wanted.into_iter().chain(there).min()
    }

    /// Returns the configured camera; by default a Kinect v1, with a focal length of 525 pixels at 640x480.
    pub fn camera(&self) -> Camera {
        let (width, height) = (self.width, self.height);
        let focal = 525.0 * f64::from(width) / 640.0;
        let middle = |size: u32| 0.5 * (f64::from(size) - 1.0);
        let kinect = Intrinsics { fx: focal, fy: focal, cx: middle(width), cy: middle(height) };
        self.intrinsics.unwrap_or(kinect).camera((width, height))
    }

    /// Reads the scene; a single word is the name of a built-in one.
    ///
    /// # Errors
    /// There is no such scene, or its file cannot be used.
    pub fn load_scene(&self, base: &Path) -> Result<Scene> {
        let default = Path::new(BUILT_IN[0].0);
        let path = self.scene.as_deref().unwrap_or(default);
        match path.to_str().and_then(Scene::built_in) {
            Some(scene) if self.values.is_empty() => scene,
            Some(_) => bail!(Hinted::new("a built-in scene has no values", "leave `values` out, or name a scene file")),
            None => SceneTemplate::load(&base.join(path))?.scene(&self.values),
        }
    }

    /// Creates the camera in its scene.
    ///
    /// # Errors
    /// The scene is not valid.
    pub fn open(self, base: &Path) -> Result<SyntheticCamera> {
        let scene = self.load_scene(base)?;
        let rate_hz = if self.rate_hz > 0.0 { self.rate_hz } else { UNPACED_RATE_HZ };
        let mut camera = SyntheticCamera::new(scene, self.camera(), self.noise, self.depth_scale, rate_hz, self.seed);
        if let Some(scenes) = self.scenes {
            camera = camera.before(scenes);
        }
        if let Some(sensor) = self.sensor {
            camera = camera.with_sensor(sensor);
        }
        if let Some(noise) = self.told_noise {
            camera = camera.with_noise_in_headers(noise.into());
        }
        Ok(camera)
    }

    /// Returns the faults that types and ranges do not exclude: values that contradict each other, missing files.
    pub fn faults(&self, base: &Path) -> Vec<ConfigFault> {
        let mut faults = Vec::new();
        if let Err(error) = self.load_scene(base) {
            faults.push(ConfigFault::of_file("scene", error.as_ref()));
        }
        faults.extend(self.sensor.and_then(SimulatedSensor::fault));
        faults.extend(self.scenes.as_ref().and_then(RandomScenes::fault));
        if self.scene.is_some() && self.scenes.is_some() {
            let what = "cannot be shown together with `scene`";
            faults.push(ConfigFault::new("scenes", what, "leave one of them out"));
        }
        let truth_path = self.truth_path.as_ref().map(|path| base.join(path));
        if let Some(folder) = truth_path.filter(|path| path.is_dir()) {
            let what = format!("`{}` is a folder, expected a file", folder.display());
            faults.push(ConfigFault::new("truth_path", what, "add the name of a file"));
        }
        faults
    }
}

#[cfg(test)]
mod tests;
