//! The section of a cylinder or a cone by a plane: its extents give the radius, and its centre the axis.
//!
//! Take a cone with apex a, half-angle phi and unit axis d away from the apex, cut by a plane with unit normal n, and
//! `d = n cos e + g sin e` with g a unit vector of the plane. The cut is an ellipse while `cos e > sin phi`. Let the
//! axis pierce the plane at the distance zeta from the apex, where the cone has the radius `rho = zeta tan phi`, and
//! `q = 1 - tan^2 phi tan^2 e`. Then the semi-minor axis is `b = rho / sqrt(q)`; the half extent along a unit vector w
//! of the plane is `b sqrt(1 + (d.w)^2 / (cos^2 e - sin^2 phi))`; the centre, which is the plane's conjugate point, lies
//! `rho tan phi sin e / (q cos^2 e)` from the piercing point, towards g. A cylinder is the limit phi = 0: b = rho = R,
//! and the centre lies on the axis.

use crate::{Circle, PlaneMoments, ScanPlane, Vector3, fit_circle};

/// The section of a cylinder or cone of known axis, in units of the radius rho where the axis pierces the plane.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SectionShape {
    /// Half extent along s.
    pub width: f64,
    /// Half extent along t.
    pub depth: f64,
    /// Centre of the section, `(s, t)` from the piercing point.
    pub center: [f64; 2],
    /// The semi-minor axis b.
    minor: f64,
    /// Unit vector `(s, t)` of the longer semi-axis.
    long_axis: [f64; 2],
    /// The longer semi-axis, divided by b.
    ratio: f64,
}

impl SectionShape {
    /// Returns the section by `plane` of a body with unit axis `axis` and half-angle `half_angle` (0: a cylinder); the axis of a
    /// cone points away from its apex. `None` where the plane cuts no ellipse, or one that is too long.
    pub fn new(plane: &ScanPlane, axis: &Vector3, half_angle: f64) -> Option<Self> {
        let cosine2 = axis.dot(&plane.normal()).powi(2);
        let steepness = cosine2 - half_angle.sin().powi(2);
        // The section is more than 30 times as long as it is wide. [algorithmic]
        if steepness < 1e-3 {
            return None;
        }
        let tangent = half_angle.tan();
        let (s, t) = (axis.dot(&plane.s_axis()), axis.dot(&plane.t_axis()));
        let sine = s.hypot(t);
        let q = 1.0 - (tangent * sine).powi(2) / cosine2;
        let minor = 1.0 / q.sqrt();
        let stretch = |part: f64| (1.0 + part * part / steepness).sqrt();
        let long_axis = if sine > 0.0 { [s / sine, t / sine] } else { [1.0, 0.0] };
        let shift = tangent / (q * cosine2);
        let (width, depth) = (minor * stretch(s), minor * stretch(t));
        Some(Self { width, depth, center: [shift * s, shift * t], minor, long_axis, ratio: stretch(sine) })
    }

    /// Fits a section of this shape to the points of an arc; returns its centre and rho.
    ///
    /// Compressed along its longer axis the ellipse is a circle, which a short noisy arc determines far better than a free
    /// ellipse.
    pub fn fit(&self, moments: &PlaneMoments) -> Option<Circle> {
        let circle = fit_circle(&moments.mapped(self.along_long_axis(1.0 / self.ratio)))?;
        let [[a, b], [c, d]] = self.along_long_axis(self.ratio);
        let [s, t] = circle.center;
        Some(Circle { center: [a * s + b * t, c * s + d * t], radius: circle.radius / self.minor })
    }

    /// Returns the map that multiplies lengths along the longer axis by `factor`.
    fn along_long_axis(&self, factor: f64) -> [[f64; 2]; 2] {
        let [s, t] = self.long_axis;
        let more = factor - 1.0;
        [[1.0 + more * s * s, more * s * t], [more * s * t, 1.0 + more * t * t]]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{Conical, Pinhole, Scan, section_about};

    const CAMERA: Pinhole = Pinhole { fx: 290.0, fy: 290.0, cx: 159.5, cy: 119.5 };

    fn cut(surface: &Conical, plane: &ScanPlane) -> crate::Ellipse {
        section_about(&surface.coefficients(), plane, [0.0, 0.0]).to_ellipse().unwrap()
    }

    /// Points on a part of an ellipse.
    fn arc(ellipse: &crate::Ellipse) -> impl Iterator<Item = [f64; 2]> {
        let ((sin, cos), [long, short], center) = (ellipse.angle.sin_cos(), ellipse.semi_axes, ellipse.center);
        (0..20)
            .map(|i| 4.0 + 0.05 * f64::from(i))
            .map(move |a: f64| (long * a.cos(), short * a.sin()))
            .map(move |(x, y)| [center[0] + cos * x - sin * y, center[1] + sin * x + cos * y])
    }

    #[test]
    fn the_extents_of_a_cut_cylinder_give_its_radius() {
        let axis = Vector3::new(0.3, 0.9, -0.5).normalize();
        let cylinder = Conical { point: Vector3::new(0.1, 0.2, 2.0), axis, radius: 0.15, slope: 0.0 };
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
        let (apex, slope) = (Vector3::new(0.05, -0.3, 1.8), 0.22_f64.tan());
        let cone = Conical { point: apex + axis * 0.3, axis, radius: 0.3 * slope, slope };
        for plane in [90.0, 120.0, 160.0].map(|line| CAMERA.plane(Scan::Row, line)) {
            let ellipse = cut(&cone, &plane);
            let shape = SectionShape::new(&plane, &axis, 0.22).unwrap();
            let zeta = -plane.normal().dot(&apex) / plane.normal().dot(&axis);
            let pierced = plane.to_plane(&(apex + axis * zeta));
            let rho = zeta * slope;
            assert!((ellipse.half_extents[0] - rho * shape.width).abs() < 1e-9);
            assert!((ellipse.half_extents[1] - rho * shape.depth).abs() < 1e-9);
            for k in [0, 1] {
                assert!((ellipse.center[k] - pierced[k] - rho * shape.center[k]).abs() < 1e-9);
            }
        }
    }

    #[test]
    fn an_arc_of_known_shape_gives_centre_and_radius() {
        let axis = Vector3::new(0.3, 0.8, -0.5).normalize();
        let cylinder = Conical { point: Vector3::new(0.1, 0.2, 2.0), axis, radius: 0.15, slope: 0.0 };
        let plane = CAMERA.plane(Scan::Row, 200.0);
        let ellipse = cut(&cylinder, &plane);
        let shape = SectionShape::new(&plane, &axis, 0.0).unwrap();
        let found = shape.fit(&PlaneMoments::of([0.0, 1.8], arc(&ellipse))).unwrap();
        assert!((found.radius - 0.15).abs() < 1e-6, "{found:?}");
        assert!((found.center[0] - ellipse.center[0]).hypot(found.center[1] - ellipse.center[1]) < 1e-6);
    }

    #[test]
    fn a_plane_along_the_axis_cuts_no_ellipse() {
        let plane = CAMERA.plane(Scan::Row, 119.5);
        assert_eq!(SectionShape::new(&plane, &Vector3::x(), 0.0), None);
        assert_eq!(SectionShape::new(&plane, &Vector3::new(0.0, 0.3, 0.95).normalize(), 0.4), None);
    }

    #[test]
    fn an_arc_of_a_tilted_cone_gives_the_radius_where_the_axis_pierces_the_plane() {
        let axis = Vector3::new(0.1, 0.85, -0.5).normalize();
        let cone = Conical { point: Vector3::new(0.05, 0.1, 1.7), axis, radius: 0.15, slope: 0.4_f64.tan() };
        let plane = CAMERA.plane(Scan::Row, 120.0);
        let ellipse = cut(&cone, &plane);
        let found =
            SectionShape::new(&plane, &axis, 0.4).unwrap().fit(&PlaneMoments::of([0.0, 1.6], arc(&ellipse))).unwrap();
        assert!((found.radius - cone.pierced_by(&plane).radius).abs() < 1e-6, "{found:?}");
        assert!((found.center[0] - ellipse.center[0]).hypot(found.center[1] - ellipse.center[1]) < 1e-6);
    }
}
