//! The exact depth image of a scene: for each pixel, the depth of the nearest surface and its owner.

use super::shapes::{Shape, Surface};
use conicflow_messages::Camera;
use nalgebra::Vector3;

/// Owner of a pixel without a surface.
pub const NO_OWNER: u16 = u16::MAX;

/// Distance to the camera's plane below which surfaces have no bounds in the image, in metres.
const NEAR_M: f64 = 1e-3;

/// Depth and owner of each pixel, row by row.
#[derive(Clone, Debug)]
pub struct Raster {
    /// The camera.
    pub camera: Camera,
    /// Depth along the optical axis in metres; infinite without a surface.
    pub depth: Vec<f64>,
    /// Index of the visible shape; [`NO_OWNER`] if there is none.
    pub owner: Vec<u16>,
    /// Number of pixels that each shape would cover alone.
    pub alone: Vec<u32>,
    columns: Vec<f64>,
    rows: Vec<f64>,
}

/// Pixels from `first` up to but without `end`, in columns and rows; may extend beyond the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// Columns.
    pub u: [i64; 2],
    /// Rows.
    pub v: [i64; 2],
}

impl Window {
    /// Returns the intersection of two windows, if they overlap.
    pub fn and(self, other: Self) -> Option<Self> {
        let common = |a: [i64; 2], b: [i64; 2]| {
            let both = [a[0].max(b[0]), a[1].min(b[1])];
            (both[0] < both[1]).then_some(both)
        };
        Some(Self { u: common(self.u, other.u)?, v: common(self.v, other.v)? })
    }

    /// Returns the whole image of a camera, enlarged by `margin` times its size on each side.
    pub fn image(camera: &Camera, margin: i64) -> Self {
        let reach = |size: u32| [-margin * i64::from(size), (1 + margin) * i64::from(size)];
        Self { u: reach(camera.width), v: reach(camera.height) }
    }

    /// Returns the pixels in which something within the bounds can be visible; `None` if it is behind the camera.
    pub fn of_bounds(camera: &Camera, bounds: Option<[Vector3<f64>; 2]>) -> Option<Self> {
        let Some([least, most]) = bounds else {
            return Some(Self { u: [i64::MIN, i64::MAX], v: [i64::MIN, i64::MAX] });
        };
        if most.z <= 0.0 {
            return None;
        }
        if least.z <= NEAR_M {
            return Self::of_bounds(camera, None);
        }
        let span = |least_x: f64, most_x: f64, f: f64, c: f64| {
            let first = least_x / if least_x < 0.0 { least.z } else { most.z };
            let last = most_x / if most_x < 0.0 { most.z } else { least.z };
            [(c + f * first).floor() as i64, (c + f * last).ceil() as i64 + 1]
        };
        Some(Self { u: span(least.x, most.x, camera.fx, camera.cx), v: span(least.y, most.y, camera.fy, camera.cy) })
    }
}

/// Whether the depths of two neighbouring pixels belong to different surfaces.
pub fn is_jump(here: f64, there: f64) -> bool {
    const JUMP: f64 = 0.02; // of the depth
    here.is_finite() != there.is_finite() || (here - there).abs() > JUMP * here.min(there)
}

impl Raster {
    /// Creates an empty image.
    pub fn new(camera: Camera) -> Self {
        let pixels = camera.width as usize * camera.height as usize;
        let columns = (0..camera.width).map(|u| (f64::from(u) - camera.cx) / camera.fx).collect();
        let rows = (0..camera.height).map(|v| (f64::from(v) - camera.cy) / camera.fy).collect();
        let (depth, owner) = (vec![f64::INFINITY; pixels], vec![NO_OWNER; pixels]);
        Self { camera, depth, owner, alone: Vec::new(), columns, rows }
    }

    /// Renders shapes in the camera's frame into a new image.
    pub fn of(camera: Camera, shapes: &[Shape]) -> Self {
        let mut raster = Self::new(camera);
        raster.render(shapes);
        raster
    }

    /// Renders shapes in the camera's frame.
    pub fn render(&mut self, shapes: &[Shape]) {
        self.depth.fill(f64::INFINITY);
        self.owner.fill(NO_OWNER);
        self.alone.clear();
        for (index, shape) in shapes.iter().enumerate() {
            let hits = match shape {
                Shape::Sphere(sphere) => self.paint(sphere, index as u16),
                Shape::Frustum(frustum) => self.paint(frustum, index as u16),
                Shape::Bowl(bowl) => self.paint(bowl, index as u16),
                Shape::Block(block) => self.paint(block, index as u16),
                Shape::Plane(plane) => self.paint(plane, index as u16),
                Shape::Lump(lump) => self.paint(lump, index as u16),
            };
            self.alone.push(hits);
        }
    }

    /// Paints the parts of a surface in front of everything painted so far; returns the number of pixels that it covers alone.
    fn paint(&mut self, surface: &impl Surface, owner: u16) -> u32 {
        let window = Window::of_bounds(&self.camera, surface.bounds());
        let Some(window) = window.and_then(|window| window.and(Window::image(&self.camera, 0))) else { return 0 };
        let [first, end] = window.u.map(|u| u as usize);
        let mut hits = 0;
        for v in window.v[0]..window.v[1] {
            let row = self.index(window.u[0], v)..self.index(window.u[1], v);
            let y = self.rows[v as usize];
            let pixels = self.depth[row.clone()].iter_mut().zip(&mut self.owner[row]);
            for ((depth, seen), x) in pixels.zip(&self.columns[first..end]) {
                let z = surface.hit(&Vector3::zeros(), &Vector3::new(*x, y, 1.0));
                hits += u32::from(z < f64::INFINITY);
                if z < *depth {
                    (*depth, *seen) = (z, owner);
                }
            }
        }
        hits
    }

    /// Returns the index of a pixel in the vectors.
    #[inline]
    pub fn index(&self, u: i64, v: i64) -> usize {
        v as usize * self.camera.width as usize + u as usize
    }

    /// Returns the visible point of a pixel, in the camera's frame.
    #[inline]
    pub fn point(&self, u: i64, v: i64) -> Vector3<f64> {
        Vector3::new(self.columns[u as usize], self.rows[v as usize], 1.0) * self.depth[self.index(u, v)]
    }
}

/// Returns the direction of the ray through a pixel, with z = 1.
#[inline]
pub fn ray(camera: &Camera, u: i64, v: i64) -> Vector3<f64> {
    Vector3::new((u as f64 - camera.cx) / camera.fx, (v as f64 - camera.cy) / camera.fy, 1.0)
}

#[cfg(test)]
#[path = "raster_tests.rs"]
mod tests;
