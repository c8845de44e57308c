//! Depth images of known bodies in front of the camera, for the tests of the detector, from the simulated camera.

use crate::simulator::SyntheticCamera;
use crate::simulator::scene::{self, Scene};
use crate::simulator::shapes::{self, Shape};
use conicflow_detection::noise::{NoiseCoefficients, NoiseConfig};
use conicflow_geometry::Vector3;
use conicflow_messages::{Camera, Header, NoiseModel};

/// Half the resolution of a Kinect: 320 x 240.
pub const KINECT_HALF: Camera = Camera { width: 320, height: 240, fx: 290.0, fy: 290.0, cx: 159.5, cy: 119.5 };

/// A body of the scene, in the camera frame.
#[derive(Clone, Copy, Debug)]
pub enum Body {
    /// All points p with `normal . p = offset`.
    Plane {
        /// Unit normal.
        normal: Vector3,
        /// Distance from the camera along it, in metres.
        offset: f64,
    },
    /// A sphere.
    Sphere {
        /// Its centre, in metres.
        center: Vector3,
        /// Its radius, in metres.
        radius: f64,
    },
    /// A frustum: `center` in the middle, radius `radius + slope h` at the axial distance h from it; no lids.
    Frustum {
        /// The middle of the axis, in metres.
        center: Vector3,
        /// Unit vector.
        axis: Vector3,
        /// Radius in the middle, in metres.
        radius: f64,
        /// Growth of the radius along the axis; 0: a cylinder.
        slope: f64,
        /// Length along the axis, in metres.
        length: f64,
    },
    /// A box with its faces turned by `turn` (radians) about the vertical.
    Block {
        /// Its middle, in metres.
        center: Vector3,
        /// Its edges, in metres.
        size: Vector3,
        /// Turn about the vertical, in radians.
        turn: f64,
    },
}

impl Body {
    fn shape(&self) -> Shape {
        match *self {
            Self::Plane { normal, offset } => {
                let mut other = Vector3::zeros();
                other[normal.iamin()] = 1.0;
                let side = normal.cross(&other).normalize();
                let sides = [side, normal.cross(&side)];
                Shape::Plane(shapes::Plane { point: normal * offset, normal, sides, half: [f64::INFINITY; 2] })
            }
            Self::Sphere { center, radius } => Shape::Sphere(shapes::Sphere { center, radius }),
            Self::Frustum { center, axis, radius, slope, length } => Shape::Frustum(shapes::Frustum {
                base: center - axis * (length / 2.0),
                axis,
                length,
                base_radius: radius - slope * length / 2.0,
                top_radius: radius + slope * length / 2.0,
                open: true,
            }),
            Self::Block { center, size, turn } => Shape::Block(shapes::Block {
                center,
                axes: nalgebra::Rotation3::from_axis_angle(&Vector3::y_axis(), turn).into_inner(),
                half: size / 2.0,
            }),
        }
    }
}

/// `bodies` and nothing behind them.
pub fn scene_of(bodies: &[Body]) -> Scene {
    let bodies = bodies.iter().enumerate().map(|(i, body)| scene::Body::still(format!("body {i}"), body.shape()));
    Scene::still("test".into(), bodies.collect(), Vector3::zeros(), Vector3::z(), -Vector3::y())
}

/// A depth image of `bodies` with the noise of `noise`, in steps of 0.1 mm.
pub fn render(camera: Camera, noise: NoiseModel, bodies: &[Body], seed: u64) -> (Header, Vec<u16>) {
    let NoiseModel { floor_m, growth_per_m, knee_m, step_per_m } = noise;
    let noise = NoiseConfig::Coefficients(NoiseCoefficients { floor_m, growth_per_m, knee_m, step_per_m });
    let mut camera = SyntheticCamera::new(scene_of(bodies), camera, noise.into(), 1e-4, 30.0, seed);
    let size = camera.raster().camera;
    let mut pixels = vec![0; size.width as usize * size.height as usize];
    camera.shoot(0, &mut pixels);
    let mut header = Header::default();
    camera.describe(&mut header);
    (header, pixels)
}
