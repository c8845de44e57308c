//! Screens: boards in front of a body that hide a given share of its width from the camera.

use super::pose::Pose;
use super::shapes::{Plane, Shape, Surface};
use crate::bisection::end_of;
use nalgebra::Vector3;

/// Half of a screen's width and height, in metres.
const HALF_M: [f64; 2] = [0.4, 2.0];

/// Returns a board at `distance_m` from the camera that hides the share `hides` of a body's width from the left, in the row of
/// its middle; in the world frame. `None` if the body is not visible there.
pub fn screen(body: &Shape, world_from_camera: &Pose, distance_m: f64, hides: f64) -> Option<Shape> {
    let seen = body.transformed(&world_from_camera.inverse());
    let [least, most] = seen.bounds()?;
    let middle = (least + most) * 0.5;
    let (column, row) = (middle.x / middle.z, middle.y / middle.z);
    let is_hit = |x: f64| seen.hit(&Vector3::zeros(), &Vector3::new(x, row, 1.0)).is_finite();
    if middle.z <= distance_m || !is_hit(column) {
        return None;
    }
    let reach = (most - least).norm() / least.z.max(distance_m);
    let [left, right] = [-reach, reach].map(|reach| end_of(is_hit, [column, column + reach]));
    let end = (left + hides * (right - left)) * distance_m;
    let plane = Plane {
        point: Vector3::new(end - HALF_M[0], row * distance_m, distance_m),
        normal: -Vector3::z(),
        sides: [Vector3::x(), Vector3::y()],
        half: HALF_M,
    };
    Some(Shape::Plane(plane).transformed(world_from_camera))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::simulator::shapes::Sphere;

    #[test]
    fn it_hides_the_share_that_is_asked_for() {
        let pose = Pose::shift(Vector3::new(1.0, 2.0, 3.0));
        let ball = Shape::Sphere(Sphere { center: Vector3::new(1.0, 2.0, 5.0), radius: 0.2 });
        let Some(Shape::Plane(plane)) = screen(&ball, &pose, 1.0, 0.25) else { panic!("no screen") };
        let tangent = 0.1_f64.asin().tan();
        assert!((plane.point.x + plane.half[0] - 1.0 + 0.5 * tangent).abs() < 1e-9);
        assert_eq!((plane.point.y, plane.point.z), (2.0, 4.0));
        assert!(screen(&ball, &pose, 2.5, 0.25).is_none(), "behind the body");
    }
}
