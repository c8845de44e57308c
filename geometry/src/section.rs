//! What a plane cuts out of a cylinder or a cone: how the cut's extents tell the radius, and where its centre lies.
//!
//! Take a cone with apex a, half-angle phi and unit axis d, cut by a plane with unit normal n, `d.n = cos e`. The cut is
//! an ellipse while `cos e > sin phi`. With the plane at the distance h from the apex, its semi-axes are
//! `h sin phi cos phi / (cos^2 e - sin^2 phi)` and `b = h sin phi / sqrt(cos^2 e - sin^2 phi)`; its half extent along a
//! unit vector w of the plane is `sqrt(b^2 (1 + (d.w)^2 / (cos^2 e - sin^2 phi)))`; its centre is the plane's conjugate
//! point, at the axial distance `z = h cos e cos^2 phi / (cos^2 e - sin^2 phi)` from the apex and beside the axis, towards
//! -m, by `z tan e tan^2 phi`, m the direction of n across the axis. So `b = z tan phi sqrt(1 - tan^2 phi tan^2 e)`: for
//! parallel planes linear in z. A cylinder is the limit phi = 0, where b = R and the centre lies on the axis.

use crate::{Circle, PlaneMoments, ScanPlane, Vector3, fit_circle};

/// How a section of a cylinder or cone of known axis is stretched.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SectionShape {
    /// Half extent along s, divided by b.
    pub width: f64,
    /// Half extent along t, divided by b.
    pub depth: f64,
    /// Unit vector `(s, t)` of the longer semi-axis.
    pub long_axis: [f64; 2],
    /// The longer semi-axis, divided by b.
    pub ratio: f64,
}

impl SectionShape {
    /// The section of a body with unit axis `axis` and half-angle `half_angle` (0: a cylinder) by `plane`; `None` where
    /// the plane cuts no ellipse.
    pub fn new(plane: &ScanPlane, axis: &Vector3, half_angle: f64) -> Option<Self> {
        let steepness = axis.dot(&plane.normal()).powi(2) - half_angle.sin().powi(2);
        if steepness < 1e-3 {
            return None;
        }
        let stretch = |part: f64| (1.0 + part * part / steepness).sqrt();
        let (s, t) = (axis.dot(&plane.s_axis()), axis.dot(&plane.t_axis()));
        let length = s.hypot(t);
        let long_axis = if length > 0.0 { [s / length, t / length] } else { [1.0, 0.0] };
        Some(Self { width: stretch(s), depth: stretch(t), long_axis, ratio: stretch(length) })
    }

    /// The ellipse of this shape through an arc's points: its centre and b.
    ///
    /// Pressed along its longer axis the ellipse is a circle, which a short noisy arc determines far better than a free
    /// ellipse.
    pub fn fit(&self, moments: &PlaneMoments) -> Option<Circle> {
        let circle = fit_circle(&moments.mapped(self.along_long_axis(1.0 / self.ratio)))?;
        let [[a, b], [c, d]] = self.along_long_axis(self.ratio);
        let [s, t] = circle.center;
        Some(Circle { center: [a * s + b * t, c * s + d * t], radius: circle.radius })
    }

    /// The map that multiplies lengths along the longer axis by `factor`.
    fn along_long_axis(&self, factor: f64) -> [[f64; 2]; 2] {
        let [s, t] = self.long_axis;
        let more = factor - 1.0;
        [[1.0 + more * s * s, more * s * t], [more * s * t, 1.0 + more * t * t]]
    }
}

/// The half-angle of a cone whose semi-minor axis b grows by `slope` per metre along the axis, cut by planes with
/// `tan e = tilt`: the smaller solution of `slope^2 = x (1 - x tilt^2)`, `x = tan^2 phi`.
pub fn cone_half_angle(slope: f64, tilt: f64) -> f64 {
    let (square, tilt2) = (slope * slope, tilt * tilt);
    let root = (1.0 - 4.0 * square * tilt2).max(0.0).sqrt();
    (2.0 * square / (1.0 + root)).sqrt().atan()
}

/// Unit axis of a cone from the direction of the line through the centres of its sections by planes with normal
/// `normal`; `direction` points away from the apex.
pub fn cone_lean(direction: &Vector3, normal: &Vector3, half_angle: f64) -> Vector3 {
    let mut axis = *direction;
    let square = half_angle.tan().powi(2);
    for _ in 0..4 {
        let cosine = axis.dot(normal);
        let across = (normal - axis * cosine) / cosine;
        axis = (direction + across * square).normalize();
    }
    axis
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Cone, Conic, Cylinder, Pinhole, Quadric, Scan};

    const CAMERA: Pinhole = Pinhole { fx: 290.0, fy: 290.0, cx: 159.5, cy: 119.5 };

    fn cut(solid: &impl Quadric, plane: &ScanPlane) -> crate::Ellipse {
        Conic { origin: [0.0, 0.0], coefficients: solid.section(plane) }.to_ellipse().unwrap()
    }

    #[test]
    fn the_extents_of_a_cut_cylinder_give_its_radius() {
        let axis = Vector3::new(0.3, 0.9, -0.5).normalize();
        let cylinder = Cylinder { point: Vector3::new(0.1, 0.2, 2.0), axis, radius: 0.15 };
        for plane in [CAMERA.plane(Scan::Row, 20.0), CAMERA.plane(Scan::Row, 200.0), CAMERA.plane(Scan::Column, 90.0)] {
            let ellipse = cut(&cylinder, &plane);
            let shape = SectionShape::new(&plane, &axis, 0.0).unwrap();
            assert!((ellipse.half_extents[0] / shape.width - 0.15).abs() < 1e-9);
            assert!((ellipse.half_extents[1] / shape.depth - 0.15).abs() < 1e-9);
        }
    }

    #[test]
    fn the_cut_of_a_tilted_cone_is_as_stated() {
        let axis = Vector3::new(0.1, 0.85, -0.5).normalize();
        let cone = Cone { apex: Vector3::new(0.05, -0.3, 1.8), axis, half_angle: 0.22 };
        for line in [90.0, 120.0, 160.0] {
            let plane = CAMERA.plane(Scan::Row, line);
            let ellipse = cut(&cone, &plane);
            let shape = SectionShape::new(&plane, &axis, cone.half_angle).unwrap();
            let minor = ellipse.half_extents[0] / shape.width;
            assert!((ellipse.half_extents[1] / shape.depth - minor).abs() < 1e-9);
            assert!((ellipse.semi_axes[1] - minor).abs() < 1e-9);
            let center = plane.to_camera(ellipse.center) - cone.apex;
            let z = center.dot(&axis);
            let cosine = plane.normal().dot(&axis);
            let tilt = (1.0 - cosine * cosine).sqrt() / cosine;
            assert!((cone_half_angle(minor / z, tilt) - cone.half_angle).abs() < 1e-9);
            assert!((cone_lean(&center.normalize(), &plane.normal(), cone.half_angle) - axis).norm() < 1e-4);
        }
    }

    #[test]
    fn an_arc_of_known_shape_gives_centre_and_radius() {
        let axis = Vector3::new(0.3, 0.8, -0.5).normalize();
        let cylinder = Cylinder { point: Vector3::new(0.1, 0.2, 2.0), axis, radius: 0.15 };
        let plane = CAMERA.plane(Scan::Row, 200.0);
        let ellipse = cut(&cylinder, &plane);
        let (sin, cos) = ellipse.angle.sin_cos();
        let [long, short] = ellipse.semi_axes;
        let points = (0..20).map(|i| 4.0 + 0.05 * f64::from(i)).map(|a: f64| (long * a.cos(), short * a.sin()));
        let points =
            points.map(|(x, y)| [ellipse.center[0] + cos * x - sin * y, ellipse.center[1] + sin * x + cos * y]);
        let shape = SectionShape::new(&plane, &axis, 0.0).unwrap();
        let found = shape.fit(&PlaneMoments::of([0.0, 1.8], points)).unwrap();
        assert!((found.radius - 0.15).abs() < 1e-6, "{found:?}");
        assert!((found.center[0] - ellipse.center[0]).hypot(found.center[1] - ellipse.center[1]) < 1e-6);
    }

    #[test]
    fn a_plane_along_the_axis_cuts_no_ellipse() {
        let plane = CAMERA.plane(Scan::Row, 119.5);
        assert_eq!(SectionShape::new(&plane, &Vector3::x(), 0.0), None);
        assert_eq!(SectionShape::new(&plane, &Vector3::new(0.0, 0.3, 0.95).normalize(), 0.4), None);
    }
}
