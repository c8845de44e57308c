//! Depth images of known bodies in front of the simulated camera, for tests of the detector.

use crate::simulator::SyntheticCamera;
use crate::simulator::scene::{Body, Scene};
use crate::simulator::sensor::SensorConfig;
use crate::simulator::shapes::{Block, Frustum, Plane, Shape, Sphere};
use conicflow_detection::noise::{NoiseCoefficients, NoiseConfig};
use conicflow_geometry::{Vector3, across};
use conicflow_messages::{Camera, Header, NoiseModel};

/// Half the resolution of a Kinect: 320 x 240.
pub const KINECT_HALF: Camera = Camera { width: 320, height: 240, fx: 290.0, fy: 290.0, cx: 159.5, cy: 119.5 };

/// Returns the plane of the points p with `normal . p = offset`, for a unit `normal` and an `offset` in metres.
pub fn plane(normal: Vector3, offset: f64) -> Shape {
    Shape::Plane(Plane { point: normal * offset, normal, sides: across(&normal), half: [f64::INFINITY; 2] })
}

/// A sphere, in metres.
pub fn sphere(center: Vector3, radius: f64) -> Shape {
    Shape::Sphere(Sphere { center, radius })
}

/// A cylinder with an open second end: `center` is the middle of its `axis`, a unit vector; in metres.
pub fn cylinder(center: Vector3, axis: Vector3, radius: f64, length: f64) -> Shape {
    frustum(center, axis, radius, 0.0, length)
}

/// Like a [`cylinder`], with the radius `radius + slope h` at the distance h from the center along the axis.
pub fn frustum(center: Vector3, axis: Vector3, radius: f64, slope: f64, length: f64) -> Shape {
    Shape::Frustum(Frustum {
        base: center - axis * (length / 2.0),
        axis,
        length,
        base_radius: radius - slope * length / 2.0,
        top_radius: radius + slope * length / 2.0,
        open: true,
    })
}

/// A box with edges of `size` metres, rotated about the vertical by `turn` radians.
pub fn block(center: Vector3, size: Vector3, turn: f64) -> Shape {
    let axes = nalgebra::Rotation3::from_axis_angle(&Vector3::y_axis(), turn).into_inner();
    Shape::Block(Block { center, axes, half: size / 2.0 })
}

/// A scene of these bodies, with nothing behind them.
pub fn scene_of(bodies: &[Shape]) -> Scene {
    let bodies = bodies.iter().enumerate().map(|(i, shape)| Body::still(format!("body {i}"), *shape));
    Scene::still("test".into(), bodies.collect(), Vector3::zeros(), Vector3::z(), -Vector3::y())
}

/// A sensor with this noise and no other error.
pub fn sensor_of(noise: NoiseModel) -> SensorConfig {
    let NoiseModel { floor_m, growth_per_m, knee_m, step_per_m } = noise;
    NoiseConfig::Coefficients(NoiseCoefficients { floor_m, growth_per_m, knee_m, step_per_m }).into()
}

/// A depth image of `bodies` with the noise of `noise`, in steps of 0.1 mm.
pub fn render(camera: Camera, noise: NoiseModel, bodies: &[Shape], seed: u64) -> (Header, Vec<u16>) {
    SyntheticCamera::new(scene_of(bodies), camera, sensor_of(noise), 1e-4, 30.0, seed).frame(0)
}
