//! Depth images of known bodies in front of the camera, for the tests of the detector, from the simulated camera.

use crate::noise_config::{NoiseCoefficients, NoiseConfig};
use crate::synthetic_source::SyntheticCamera;
use crate::synthetic_source::scene::{self, Scene};
use crate::synthetic_source::shapes::{self, Shape};
use conicflow_geometry::Vector3;
use conicflow_messages::{Camera, Header, NoiseModel};

/// Half the resolution of a Kinect: 320 x 240.
pub(crate) const KINECT_HALF: Camera = Camera { width: 320, height: 240, fx: 290.0, fy: 290.0, cx: 159.5, cy: 119.5 };

/// A body of the scene, in the camera frame.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Body {
    /// All points p with `normal . p = offset`.
    Plane { normal: Vector3, offset: f64 },
    /// A sphere.
    Sphere { center: Vector3, radius: f64 },
    /// A frustum: `center` in the middle, radius `radius + slope h` at the axial distance h from it; no lids.
    Frustum { center: Vector3, axis: Vector3, radius: f64, slope: f64, length: f64 },
    /// A box with its faces turned by `turn` (radians) about the vertical.
    Block { center: Vector3, size: Vector3, turn: f64 },
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

/// A depth image of `bodies` with the noise of `noise`, in steps of 0.1 mm; behind them there is nothing.
pub(crate) fn render(camera: Camera, noise: NoiseModel, bodies: &[Body], seed: u64) -> (Header, Vec<u16>) {
    let bodies = bodies.iter().enumerate().map(|(i, body)| scene::Body::still(format!("body {i}"), body.shape()));
    let scene = Scene::still("test".into(), bodies.collect(), Vector3::zeros(), Vector3::z(), -Vector3::y());
    let NoiseModel { floor_m, growth_per_m, knee_m, step_per_m } = noise;
    let noise = NoiseConfig::Coefficients(NoiseCoefficients { floor_m, growth_per_m, knee_m, step_per_m });
    let mut camera = SyntheticCamera::new(scene, camera, noise.into(), 1e-4, 30.0, seed);
    let size = camera.raster().camera;
    let mut pixels = vec![0; size.width as usize * size.height as usize];
    camera.shoot(0, &mut pixels);
    let mut header = Header::default();
    camera.describe(&mut header);
    (header, pixels)
}
