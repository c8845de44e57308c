//! The exact depth image of a scene: for each pixel the depth of the nearest surface and whose surface it is.

use super::shapes::{Shape, Surface};
use conicflow_messages::Camera;
use nalgebra::Vector3;

/// Owner of a pixel in which nothing is seen.
pub const NOBODY: u16 = u16::MAX;

/// Surfaces nearer to the camera's plane than this are not cut to their bounds, in metres.
const NEAR_M: f64 = 1e-3;

/// Depth and owner of each pixel, row by row.
#[derive(Clone, Debug)]
pub struct Raster {
    /// The camera.
    pub camera: Camera,
    /// Depth along the optical axis in metres; infinite where nothing is seen.
    pub depth: Vec<f64>,
    /// Index of the shape that is seen; [`NOBODY`] where none is.
    pub owner: Vec<u16>,
    /// For each shape, how many pixels of the image it would cover if it were alone.
    pub alone: Vec<u32>,
    columns: Vec<f64>,
    rows: Vec<f64>,
}

/// Pixels from `first` up to but without `end`, in columns and in rows; may reach beyond the image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Window {
    /// Columns.
    pub u: [i64; 2],
    /// Rows.
    pub v: [i64; 2],
}

impl Window {
    /// What both windows cover, if anything.
    pub fn and(self, other: Self) -> Option<Self> {
        let common = |a: [i64; 2], b: [i64; 2]| {
            let both = [a[0].max(b[0]), a[1].min(b[1])];
            (both[0] < both[1]).then_some(both)
        };
        Some(Self { u: common(self.u, other.u)?, v: common(self.v, other.v)? })
    }

    /// The whole image of a camera, and `margin` times its size on each side.
    pub fn image(camera: &Camera, margin: i64) -> Self {
        let reach = |size: u32| [-margin * i64::from(size), (1 + margin) * i64::from(size)];
        Self { u: reach(camera.width), v: reach(camera.height) }
    }

    /// The pixels in which what lies within the bounds can be seen; `None`: it lies behind the camera.
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

/// Whether the depths of two pixels beside each other are of two surfaces.
pub fn is_jump(here: f64, there: f64) -> bool {
    const JUMP: f64 = 0.02; // of the depth
    here.is_finite() != there.is_finite() || (here - there).abs() > JUMP * here.min(there)
}

impl Raster {
    /// An empty image.
    pub fn new(camera: Camera) -> Self {
        let pixels = camera.width as usize * camera.height as usize;
        let columns = (0..camera.width).map(|u| (f64::from(u) - camera.cx) / camera.fx).collect();
        let rows = (0..camera.height).map(|v| (f64::from(v) - camera.cy) / camera.fy).collect();
        let (depth, owner) = (vec![f64::INFINITY; pixels], vec![NOBODY; pixels]);
        Self { camera, depth, owner, alone: Vec::new(), columns, rows }
    }

    /// The image of these shapes, in the camera's frame.
    pub fn of(camera: Camera, shapes: &[Shape]) -> Self {
        let mut raster = Self::new(camera);
        raster.render(shapes);
        raster
    }

    /// Renders shapes that are given in the camera's frame.
    pub fn render(&mut self, shapes: &[Shape]) {
        self.depth.fill(f64::INFINITY);
        self.owner.fill(NOBODY);
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

    /// Paints what of a surface lies before everything painted so far; the number of pixels that it covers alone.
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

    /// Place of a pixel of the image in the vectors.
    #[inline]
    pub fn index(&self, u: i64, v: i64) -> usize {
        v as usize * self.camera.width as usize + u as usize
    }

    /// The point that is seen in a pixel, in the camera's frame.
    #[inline]
    pub fn point(&self, u: i64, v: i64) -> Vector3<f64> {
        Vector3::new(self.columns[u as usize], self.rows[v as usize], 1.0) * self.depth[self.index(u, v)]
    }
}

/// Direction of the ray through a pixel, with z = 1.
#[inline]
pub fn ray(camera: &Camera, u: i64, v: i64) -> Vector3<f64> {
    Vector3::new((u as f64 - camera.cx) / camera.fx, (v as f64 - camera.cy) / camera.fy, 1.0)
}

#[cfg(test)]
#[path = "raster_tests.rs"]
mod tests;
