//! Spheres, cylinders and cones as quadrics `F(p) = 0`, scaled so that `|grad F| = 1` on the surface: F is then the
//! distance from the surface to first order.
//!
//! - sphere: `(|p - c|^2 - R^2) / (2 R)`
//! - cylinder: `(|p - c|^2 - (d.(p - c))^2 - R^2) / (2 R)`
//! - cone: `(rho^2 cos^2 phi - h^2 sin^2 phi) / (2 h sin phi)`, h the axial distance from the apex, rho the distance from
//!   the axis; here h stands for a whole section: that of the point where the axis meets its plane.
//!
//! Restricted to a scan plane, F is a conic in `(s, t)`, so the squared distances of all points of an arc follow from
//! the arc's moments.

use crate::{Conic, PlaneMoments, ScanPlane, Vector3};
use nalgebra::Matrix3;

/// A surface of second degree.
pub trait Quadric {
    /// Coefficients of F on a scan plane, `[s^2, s t, t^2, s, t, 1]` about `(0, 0)`.
    fn section(&self, plane: &ScanPlane) -> [f64; 6];

    /// Sum of the squared distances of an arc's points from the surface, to first order; NaN for a
    /// cone on a plane along its axis.
    fn square_sum(&self, plane: &ScanPlane, moments: &PlaneMoments) -> f64 {
        let conic = Conic { origin: [0.0, 0.0], coefficients: self.section(plane) };
        let sum = conic.about(moments.origin()).square_sum(moments);
        if sum < 0.0 { 0.0 } else { sum }
    }
}

/// A sphere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sphere {
    /// Centre.
    pub center: Vector3,
    /// Radius.
    pub radius: f64,
}

/// A circular cylinder without ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cylinder {
    /// A point on the axis.
    pub point: Vector3,
    /// Unit vector along the axis.
    pub axis: Vector3,
    /// Radius.
    pub radius: f64,
}

/// A circular cone without ends.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Cone {
    /// Apex.
    pub apex: Vector3,
    /// Unit vector from the apex into the cone.
    pub axis: Vector3,
    /// Angle between axis and surface.
    pub half_angle: f64,
}

impl Quadric for Sphere {
    fn section(&self, plane: &ScanPlane) -> [f64; 6] {
        let constant = -self.radius * self.radius;
        restrict(&Matrix3::identity(), &self.center, constant, plane).map(|x| x / (2.0 * self.radius))
    }
}

impl Quadric for Cylinder {
    fn section(&self, plane: &ScanPlane) -> [f64; 6] {
        let form = Matrix3::identity() - self.axis * self.axis.transpose();
        let constant = -self.radius * self.radius;
        restrict(&form, &self.point, constant, plane).map(|x| x / (2.0 * self.radius))
    }
}

impl Quadric for Cone {
    fn section(&self, plane: &ScanPlane) -> [f64; 6] {
        let (sin, cos) = self.half_angle.sin_cos();
        let form = Matrix3::identity() * (cos * cos) - self.axis * self.axis.transpose();
        let normal = plane.normal();
        let height = (-normal.dot(&self.apex) / normal.dot(&self.axis)).abs();
        // On a plane along the axis there is no height that stands for the section.
        let height = if height.is_finite() { height } else { f64::NAN };
        restrict(&form, &self.apex, 0.0, plane).map(|x| x / (2.0 * height * sin))
    }
}

/// `(p - c)' Q (p - c) + constant` with `p = s e + t f`.
fn restrict(form: &Matrix3<f64>, center: &Vector3, constant: f64, plane: &ScanPlane) -> [f64; 6] {
    let (e, f) = (plane.s_axis(), plane.t_axis());
    let (qe, qf, qc) = (form * e, form * f, form * center);
    [
        e.dot(&qe),
        2.0 * e.dot(&qf),
        f.dot(&qf),
        -2.0 * center.dot(&qe),
        -2.0 * center.dot(&qf),
        center.dot(&qc) + constant,
    ]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Pinhole, Scan};

    #[test]
    fn what_is_no_surface_fits_nothing() {
        let plane = CAMERA.plane(Scan::Row, 100.0);
        let moments = points(&plane, 0.0, |p| (p - Vector3::new(0.0, 0.0, 2.0)).norm() - 0.25);
        let center = Vector3::new(0.0, 0.0, f64::NAN);
        assert!(Sphere { center, radius: 0.25 }.square_sum(&plane, &moments).is_nan());
        let cone = Cone { apex: Vector3::new(0.0, 0.0, 2.0), axis: Vector3::x(), half_angle: 0.3 };
        assert!(cone.square_sum(&plane, &moments).is_nan());
    }

    const CAMERA: Pinhole = Pinhole { fx: 290.0, fy: 290.0, cx: 159.5, cy: 119.5 };

    /// Points of a row that lie `offset` outside the surface given by a distance function, found by bisection.
    fn points(plane: &ScanPlane, offset: f64, distance: impl Fn(&Vector3) -> f64) -> PlaneMoments {
        let mut moments = PlaneMoments::new([0.0, 1.8]);
        for pixel in 150..170 {
            let slope = CAMERA.ray_slope(Scan::Row, f64::from(pixel));
            let at = |z: f64| [z * slope, z * plane.stretch()];
            let (mut near, mut far) = (1.0, 2.0);
            for _ in 0..60 {
                let middle = 0.5 * (near + far);
                let outside = distance(&plane.to_camera(at(middle))) > offset;
                (near, far) = if outside { (middle, far) } else { (near, middle) };
            }
            moments.add(at(near));
        }
        moments
    }

    fn rms(solid: &impl Quadric, plane: &ScanPlane, moments: &PlaneMoments) -> f64 {
        (solid.square_sum(plane, moments) / moments.count()).sqrt()
    }

    #[test]
    fn the_value_is_the_distance_to_first_order() {
        let center = Vector3::new(0.0, 0.05, 2.0);
        let axis = Vector3::new(0.1, 0.9, -0.4).normalize();
        let sphere = Sphere { center, radius: 0.25 };
        let cylinder = Cylinder { point: center, axis, radius: 0.2 };
        let cone = Cone { apex: center - axis * 0.8, axis, half_angle: 0.3 };
        let around = |p: &Vector3, from: &Vector3| (p - from).cross(&axis).norm();
        for line in [110.0, 125.0] {
            let plane = CAMERA.plane(Scan::Row, line);
            for offset in [0.0, 0.002, -0.003] {
                let found = [
                    rms(&sphere, &plane, &points(&plane, offset, |p| (p - center).norm() - 0.25)),
                    rms(&cylinder, &plane, &points(&plane, offset, |p| around(p, &center) - 0.2)),
                    rms(
                        &cone,
                        &plane,
                        &points(&plane, offset, |p| {
                            around(p, &cone.apex) * 0.3_f64.cos() - (p - cone.apex).dot(&axis) * 0.3_f64.sin()
                        }),
                    ),
                ];
                let exact = offset.abs();
                assert!((found[0] - exact).abs() < 1e-4 && (found[1] - exact).abs() < 1e-4, "{found:?} {offset}");
                assert!((found[2] - exact).abs() < 0.25 * exact + 1e-6, "{found:?} {offset}");
            }
        }
    }
}
