//! The shadow of a projector: a structured-light camera measures no depth at points that its projector, at a base line along x,
//! does not see.

use super::raster::{Raster, Window};
use super::shapes::{Shape, Surface};
use nalgebra::Vector3;

/// Marks the pixels whose points are not visible from the projector at `(baseline_m, 0, 0)`.
///
/// A shape only shadows points behind it that lie in its image as seen by the projector. In that image, a point of depth z is
/// shifted by `fx baseline / z` pixels from its position in the camera's image. So only the pixels of the shape's window,
/// stretched by that shift, have to be checked.
pub fn cast(raster: &Raster, shapes: &[Shape], baseline_m: f64) -> Vec<bool> {
    let mut shadow = vec![false; raster.depth.len()];
    if baseline_m == 0.0 {
        return shadow;
    }
    let projector = Vector3::new(baseline_m, 0.0, 0.0);
    for (owner, shape) in shapes.iter().enumerate() {
        if shape.bounds().is_some() {
            darken(raster, shape, owner as u16, &projector, &mut shadow);
        }
    }
    shadow
}

fn darken(raster: &Raster, shape: &Shape, owner: u16, projector: &Vector3<f64>, shadow: &mut [bool]) {
    let image = Window::image(&raster.camera, 0);
    let seen_by_projector = shape.bounds().map(|bounds| bounds.map(|corner| corner - projector));
    let Some(window) = Window::of_bounds(&raster.camera, seen_by_projector) else { return };
    let nearest = seen_by_projector.map_or(0.0, |[least, _]| least.z);
    let Some(window) = stretched(window, raster.camera.fx * projector.x / nearest).and(image) else { return };
    for v in window.v[0]..window.v[1] {
        for u in window.u[0]..window.u[1] {
            let index = raster.index(u, v);
            if shadow[index] || raster.depth[index] < nearest || !raster.depth[index].is_finite() {
                continue;
            }
            let point = raster.point(u, v);
            shadow[index] = if raster.owner[index] == owner && !shape.hides_itself() {
                turned_away(shape, &point, projector)
            } else {
                shape.hit(&point, &(projector - point)) < 1.0
            };
        }
    }
}

/// Returns the area that a window sweeps when it is shifted along the rows.
fn stretched(window: Window, shift: f64) -> Window {
    if !shift.is_finite() {
        return Window { u: [i64::MIN, i64::MAX], ..window };
    }
    let (left, right) = (shift.min(0.0).floor() as i64, shift.max(0.0).ceil() as i64);
    Window { u: [window.u[0].saturating_add(left), window.u[1].saturating_add(right)], ..window }
}

/// Whether camera and projector are on opposite sides of a convex surface.
fn turned_away(shape: &Shape, point: &Vector3<f64>, projector: &Vector3<f64>) -> bool {
    let normal = shape.normal(point);
    normal.dot(&-point) * normal.dot(&(projector - point)) < 0.0
}

#[cfg(test)]
mod tests {
    use super::super::shapes::Plane;
    use super::*;
    use crate::rendered::{plane, sphere};
    use conicflow_messages::Camera;

    const CAMERA: Camera = Camera { width: 320, height: 240, fx: 262.5, fy: 262.5, cx: 159.5, cy: 119.5 };

    fn wall(z: f64) -> Shape {
        plane(Vector3::z(), z)
    }

    fn screen(z: f64, half_width: f64) -> Shape {
        let sides = [Vector3::x(), Vector3::y()];
        Shape::Plane(Plane { point: Vector3::new(0.0, 0.0, z), normal: -Vector3::z(), sides, half: [half_width, 5.0] })
    }

    /// Returns the first and last dark pixel of the middle row.
    fn dark_span(shapes: &[Shape], baseline_m: f64) -> Option<(usize, usize)> {
        let raster = Raster::of(CAMERA, shapes);
        let shadow = cast(&raster, shapes, baseline_m);
        let row = &shadow[120 * 320..121 * 320];
        Some((row.iter().position(|&dark| dark)?, row.iter().rposition(|&dark| dark)?))
    }

    /// A screen at 1 m in front of a wall at 2 m: the shadow's width is the difference of the disparities, 262.5 * 0.075 * (1 -
    /// 1/2) = 9.84 pixels, and it is on the side away from the projector.
    #[test]
    fn the_shadow_is_as_wide_as_the_disparity_says_and_on_the_left() {
        let shapes = [screen(1.0, 0.2), wall(2.0)];
        let left_edge = 159.5 - 262.5 * 0.2;
        let (first, last) = dark_span(&shapes, 0.075).unwrap();
        assert_eq!(first, (left_edge - 262.5_f64 * 0.075 * 0.5).ceil() as usize);
        assert_eq!(last, left_edge.floor() as usize - usize::from(left_edge.fract() == 0.0));
    }

    #[test]
    fn a_projector_on_the_left_darkens_the_right() {
        let shapes = [screen(1.0, 0.2), wall(2.0)];
        let (left, right) = (dark_span(&shapes, 0.075).unwrap(), dark_span(&shapes, -0.075).unwrap());
        assert_eq!((right.0, right.1), (319 - left.1, 319 - left.0));
        assert_eq!(dark_span(&shapes, 0.0), None);
    }

    /// A strip narrower than the base line shadows a part of the wall that is separate from it in the image.
    #[test]
    fn a_thin_thing_casts_a_shadow_apart_from_itself() {
        let (first, last) = dark_span(&[screen(1.0, 0.01), wall(4.0)], 0.075).unwrap();
        let shift: f64 = 262.5 * 0.075 * 0.75;
        assert_eq!(first, (159.5 - 2.625 - shift).ceil() as usize);
        assert_eq!(last, (159.5 + 2.625 - shift).floor() as usize);
    }

    #[test]
    fn the_side_of_a_ball_that_the_projector_does_not_see_is_dark() {
        let shapes = [sphere(Vector3::new(0.0, 0.0, 1.0), 0.2)];
        let (first, last) = dark_span(&shapes, 0.075).unwrap();
        assert!(last < 160 - 45, "only at the left rim: {first} to {last}");
    }
}
