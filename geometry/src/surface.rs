//! Spheres, cylinders and cones as the ten coefficients of a quadric `F(p) = q(theta)' m(p)`, with derivatives.
//!
//! F is scaled so that `|grad F| = 1` on the surface, so it is the distance to first order:
//! - sphere: `(|p - c|^2 - R^2) / (2 R)`
//! - cylinder and cone, with `x = p - c`, unit axis d, slope `tau = tan phi`, and the radius `R + tau d.x` along the axis:
//!   `cos phi ((|x|^2 - (d.x)^2 - (R + tau d.x)^2) / (2 R))`; a cylinder has tau = 0. Where the radius of a cone is
//!   g R, F is g times the distance, so pooled arcs have the weight `1 / g^2`.

use crate::{Coefficients, Conic, Scan, ScanPlane, Vector3};
use nalgebra::Matrix3;

/// A surface with N parameters.
pub trait Surface<const N: usize>: Copy {
    /// Coefficients of F.
    fn coefficients(&self) -> Coefficients;

    /// Derivatives of the coefficients of F by the parameters.
    fn derivatives(&self) -> [Coefficients; N];

    /// Returns the surface whose parameters differ by `step`; `None` where there is no such surface.
    fn moved(&self, step: &[f64; N]) -> Option<Self>;

    /// Returns for each parameter whether it is a length.
    fn lengths() -> [bool; N];

    /// Returns the surface in a frame with this origin, whose unit of length is `scale`.
    fn to_local(&self, origin: &Vector3, scale: f64) -> Self;

    /// Returns the surface, given in a frame with this origin and unit of length, in the camera frame.
    fn to_camera(&self, origin: &Vector3, scale: f64) -> Self;
}

/// A sphere.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sphere {
    /// Centre.
    pub center: Vector3,
    /// Radius.
    pub radius: f64,
}

/// A circular cylinder (slope 0) or cone without ends.
///
/// As a [`Surface`] it has 5 parameters if the slope is fixed: two tilts of the axis, two shifts across it, the radius. A free
/// slope is the sixth.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Conical {
    /// A point on the axis.
    pub point: Vector3,
    /// Unit vector along the axis.
    pub axis: Vector3,
    /// Radius at `point`.
    pub radius: f64,
    /// Change of the radius along the axis: the tangent of the half-angle.
    pub slope: f64,
}

impl Sphere {
    /// Returns the forms by which nearby quadrics differ from the sphere: the surface of F plus x times one of them is off the
    /// sphere by about `x R / 2`, outwards in some directions and inwards in others. Together they are the harmonics of second
    /// degree, all of the same norm.
    pub fn departures(&self) -> [Coefficients; 5] {
        let third = 1.0 / 3.0_f64.sqrt();
        let forms = [
            Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, 0.0)),
            Matrix3::from_diagonal(&Vector3::new(-third, -third, 2.0 * third)),
            symmetric(&Vector3::x(), &Vector3::y()),
            symmetric(&Vector3::x(), &Vector3::z()),
            symmetric(&Vector3::y(), &Vector3::z()),
        ];
        forms.map(|form| about(&form, &self.center, self.radius))
    }
}

impl Surface<4> for Sphere {
    fn coefficients(&self) -> Coefficients {
        let (c, a) = (&self.center, 0.5 / self.radius);
        let constant = a * c.norm_squared() - 0.5 * self.radius;
        [a, a, a, 0.0, 0.0, 0.0, -2.0 * a * c.x, -2.0 * a * c.y, -2.0 * a * c.z, constant]
    }

    fn derivatives(&self) -> [Coefficients; 4] {
        let (c, a) = (&self.center, 0.5 / self.radius);
        let along = |i: usize| {
            let mut d = [0.0; 10];
            (d[6 + i], d[9]) = (-2.0 * a, 2.0 * a * c[i]);
            d
        };
        // d/dR (x.x / 2R - R / 2) = -(F + R / 2) / R - 1 / 2
        let mut by_radius = self.coefficients().map(|q| -q / self.radius);
        by_radius[9] -= 1.0;
        [along(0), along(1), along(2), by_radius]
    }

    fn moved(&self, step: &[f64; 4]) -> Option<Self> {
        let [x, y, z, r] = *step;
        let radius = self.radius + r;
        (radius > 0.0).then(|| Self { center: self.center + Vector3::new(x, y, z), radius })
    }

    fn lengths() -> [bool; 4] {
        [true; 4]
    }

    fn to_local(&self, origin: &Vector3, scale: f64) -> Self {
        Self { center: (self.center - origin) / scale, radius: self.radius / scale }
    }

    fn to_camera(&self, origin: &Vector3, scale: f64) -> Self {
        Self { center: origin + self.center * scale, radius: self.radius * scale }
    }
}

impl Conical {
    /// Returns the radius where the axis passes `point`.
    pub fn radius_at(&self, point: &Vector3) -> f64 {
        self.radius + self.slope * self.axis.dot(&(point - self.point))
    }

    /// Returns the same surface with its point moved along the axis to the foot of `point`.
    #[must_use]
    pub fn anchored(&self, point: &Vector3) -> Self {
        self.moved_along(self.axis.dot(&(point - self.point)))
    }

    /// Returns the same surface with its point moved along the axis to the intersection with a scan plane; not finite if there is
    /// none.
    #[must_use]
    pub fn pierced_by(&self, plane: &ScanPlane) -> Self {
        let normal = plane.normal();
        self.moved_along(-normal.dot(&self.point) / normal.dot(&self.axis))
    }

    /// Returns the same surface with its point moved by this distance along the axis.
    fn moved_along(&self, along: f64) -> Self {
        Self { point: self.point + self.axis * along, radius: self.radius + self.slope * along, ..*self }
    }

    /// Angle between axis and surface.
    pub fn half_angle(&self) -> f64 {
        self.slope.atan()
    }

    /// Returns the point at which the radius is zero.
    pub fn apex(&self) -> Vector3 {
        self.point - self.axis * (self.radius / self.slope)
    }

    /// Coefficients of F.
    pub fn coefficients(&self) -> Coefficients {
        self.packed(&self.form())
    }

    /// Two unit vectors across the axis, perpendicular to each other.
    pub fn across(&self) -> [Vector3; 2] {
        across(&self.axis)
    }

    /// Returns the forms by which an oval section differs from a round one: the surface of F plus x times one of them is off by
    /// up to `x R / 2`, outwards along one direction across the axis and inwards along the other.
    pub fn departures(&self) -> [Coefficients; 2] {
        let [u, v] = self.across();
        let forms = [u * u.transpose() - v * v.transpose(), symmetric(&u, &v)];
        forms.map(|form| about(&form, &self.point, self.radius))
    }

    fn cosine(&self) -> f64 {
        1.0 / (1.0 + self.slope * self.slope).sqrt()
    }

    /// `(A, b, e)` of `p'A p + b.p + e`, without the factor `cos phi`.
    fn form(&self) -> (Matrix3<f64>, Vector3, f64) {
        let (c, d, tau) = (&self.point, &self.axis, self.slope);
        let a = (Matrix3::identity() - d * d.transpose() * (1.0 + tau * tau)) * (0.5 / self.radius);
        let ac = a * c;
        (a, ac * -2.0 - d * tau, c.dot(&ac) + tau * d.dot(c) - 0.5 * self.radius)
    }

    fn all_derivatives(&self) -> [Coefficients; 6] {
        let (c, d, tau, cosine) = (&self.point, &self.axis, self.slope, self.cosine());
        let form = self.form();
        let a = &form.0;
        let (ac, half) = (a * c, 0.5 / self.radius);
        let spread = -(1.0 + tau * tau) * half;
        // A change of A alone changes b by -2 dA c and e by c'dA c.
        let coefficients = |da: &Matrix3<f64>, db: Vector3, de: f64| {
            let dac = da * c;
            pack(da, &(db - dac * 2.0), de + c.dot(&dac)).map(|q| q * cosine)
        };
        let tilt = |u: &Vector3| {
            let outer = u * d.transpose();
            coefficients(&((outer + outer.transpose()) * spread), u * -tau, tau * u.dot(c))
        };
        let shift = |u: &Vector3| coefficients(&Matrix3::zeros(), a * u * -2.0, 2.0 * u.dot(&ac));
        let by_radius = coefficients(&(a * (-1.0 / self.radius)), Vector3::zeros(), -0.5);
        let mut by_slope = coefficients(&(d * d.transpose() * (-2.0 * tau * half)), -d, d.dot(c));
        let shrink = -tau * cosine * cosine;
        by_slope.iter_mut().zip(self.packed(&form)).for_each(|(sum, q)| *sum += shrink * q);
        let [u, v] = self.across();
        [tilt(&u), tilt(&v), shift(&u), shift(&v), by_radius, by_slope]
    }

    fn packed(&self, (a, b, e): &(Matrix3<f64>, Vector3, f64)) -> Coefficients {
        let cosine = self.cosine();
        pack(a, b, *e).map(|q| q * cosine)
    }

    /// Returns the surface after two tilts of the axis, two shifts across it, and changes of the radius and the slope.
    fn stepped(&self, &[tilt_u, tilt_v, shift_u, shift_v, radius, slope]: &[f64; 6]) -> Option<Self> {
        let [u, v] = self.across();
        let axis = (self.axis + u * tilt_u + v * tilt_v).normalize();
        let point = self.point + u * shift_u + v * shift_v;
        let moved = Self { point, axis, radius: self.radius + radius, slope: self.slope + slope };
        (moved.radius > 0.0 && axis.iter().all(|x| x.is_finite())).then_some(moved)
    }

    /// [`Surface::to_local`], whatever the number of free parameters.
    pub(crate) fn to_local(self, origin: &Vector3, scale: f64) -> Self {
        let near = self.anchored(origin);
        Self { point: (near.point - origin) / scale, radius: near.radius / scale, ..self }
    }

    /// [`Surface::to_camera`], whatever the number of free parameters.
    pub(crate) fn to_camera(self, origin: &Vector3, scale: f64) -> Self {
        Self { point: origin + self.point * scale, radius: self.radius * scale, ..self }
    }
}

/// Implements [`Surface`] for a [`Conical`] with its first parameters free.
macro_rules! free_parameters {
    ($count:literal) => {
        impl Surface<$count> for Conical {
            fn coefficients(&self) -> Coefficients {
                Conical::coefficients(self)
            }

            fn derivatives(&self) -> [Coefficients; $count] {
                let all = self.all_derivatives();
                std::array::from_fn(|i| all[i])
            }

            fn moved(&self, step: &[f64; $count]) -> Option<Self> {
                let mut all = [0.0; 6];
                all[..$count].copy_from_slice(step);
                self.stepped(&all)
            }

            fn lengths() -> [bool; $count] {
                std::array::from_fn(|i| (2..5).contains(&i))
            }

            fn to_local(&self, origin: &Vector3, scale: f64) -> Self {
                Conical::to_local(*self, origin, scale)
            }

            fn to_camera(&self, origin: &Vector3, scale: f64) -> Self {
                Conical::to_camera(*self, origin, scale)
            }
        }
    };
}

free_parameters!(5);
free_parameters!(6);

/// `u v' + v u'`.
fn symmetric(u: &Vector3, v: &Vector3) -> Matrix3<f64> {
    u * v.transpose() + v * u.transpose()
}

/// Returns the coefficients of `x'A x / (2 R)`, where x is relative to a point.
fn about(a: &Matrix3<f64>, point: &Vector3, radius: f64) -> Coefficients {
    let a = a * (0.5 / radius);
    let ac = a * point;
    pack(&a, &(ac * -2.0), point.dot(&ac))
}

fn pack(a: &Matrix3<f64>, b: &Vector3, e: f64) -> Coefficients {
    let twice = |i: usize, j: usize| a[(i, j)] + a[(j, i)];
    [a[(0, 0)], a[(1, 1)], a[(2, 2)], twice(0, 1), twice(0, 2), twice(1, 2), b.x, b.y, b.z, e]
}

/// Returns two unit vectors that are perpendicular to a third one and to each other.
pub fn across(axis: &Vector3) -> [Vector3; 2] {
    let mut other = Vector3::zeros();
    other[axis.iamin()] = 1.0;
    let u = axis.cross(&other).normalize();
    [u, axis.cross(&u)]
}

/// Returns the gradient of a quadric at a point.
pub fn gradient(q: &Coefficients, p: &Vector3) -> Vector3 {
    Vector3::new(
        2.0 * q[0] * p.x + q[3] * p.y + q[4] * p.z + q[6],
        2.0 * q[1] * p.y + q[3] * p.x + q[5] * p.z + q[7],
        2.0 * q[2] * p.z + q[4] * p.x + q[5] * p.y + q[8],
    )
}

/// Returns whether the line of a ray meets a quadric, in front of or behind the camera.
pub fn meets(q: &Coefficients, ray: &Vector3) -> bool {
    let [xx, yy, zz, xy, xz, yz, x, y, z, c] = *q;
    let a = ray.x * (xx * ray.x + xy * ray.y + xz * ray.z) + ray.y * (yy * ray.y + yz * ray.z) + zz * ray.z * ray.z;
    let b = x * ray.x + y * ray.y + z * ray.z;
    b * b - 4.0 * a * c > 0.0
}

/// Returns the conic `[s^2, s t, t^2, s, t, 1]` in which a scan plane cuts a quadric.
pub fn section_of(q: &Coefficients, plane: &ScanPlane) -> [f64; 6] {
    let [xx, yy, zz, xy, xz, yz, x, y, z, one] = *q;
    let (across, forward) = (plane.slope() / plane.stretch(), 1.0 / plane.stretch());
    // Coefficients along the line, across it, and forward.
    let (aa, bb, ab, az, bz, a, b) = match plane.scan() {
        Scan::Row => (xx, yy, xy, xz, yz, x, y),
        Scan::Column => (yy, xx, xy, yz, xz, y, x),
    };
    [
        aa,
        ab * across + az * forward,
        bb * across * across + bz * across * forward + zz * forward * forward,
        a,
        b * across + z * forward,
        one,
    ]
}

/// Returns the same conic about a point of the plane.
pub fn section_about(q: &Coefficients, plane: &ScanPlane, origin: [f64; 2]) -> Conic {
    Conic { origin: [0.0, 0.0], coefficients: section_of(q, plane) }.about(origin)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Pinhole;
    use crate::space::{dot, monomials};

    fn value(q: &Coefficients, p: &Vector3) -> f64 {
        dot(q, &monomials(p))
    }

    fn cone() -> Conical {
        Conical { point: Vector3::zeros(), axis: Vector3::new(0.2, 0.9, -0.3).normalize(), radius: 0.8, slope: 0.2 }
    }

    fn check_derivatives<const N: usize>(surface: impl Surface<N>) {
        let derivatives = surface.derivatives();
        for i in 0..N {
            let at = |h: f64| {
                let mut step = [0.0; N];
                step[i] = h;
                surface.moved(&step).unwrap().coefficients()
            };
            let (more, less) = (at(1e-6), at(-1e-6));
            for k in 0..10 {
                let difference = (more[k] - less[k]) / 2e-6;
                assert!((difference - derivatives[i][k]).abs() < 1e-6, "{i} {k}: {difference} {}", derivatives[i][k]);
            }
        }
    }

    #[test]
    fn rays_meet_a_surface_within_its_outline() {
        let center = Vector3::new(0.3, -0.2, 1.5);
        let ball = Sphere { center, radius: 0.4 }.coefficients();
        let leaning = Vector3::new(0.2, 0.9, -0.4).normalize();
        let can = Conical { point: center, axis: leaning, radius: 0.4, slope: 0.0 }.coefficients();
        for step in 0..400 {
            // The length of the ray does not matter.
            let ray = Vector3::new(f64::from(step % 20) - 8.0, f64::from(step / 20) - 11.0, 10.0) * 0.03;
            let to_ball = ray.cross(&center).norm() / ray.norm();
            assert_eq!(meets(&ball, &ray), to_ball < 0.4, "a ball, by {ray}");
            let beside = ray.cross(&leaning);
            let to_axis = beside.dot(&center).abs() / beside.norm();
            assert_eq!(meets(&can, &ray), to_axis < 0.4, "a can, by {ray}");
        }
    }

    #[test]
    fn derivatives_are_those_of_the_coefficients() {
        let shifted = Conical { point: cone().across()[0] * 0.3 + cone().across()[1], ..cone() };
        check_derivatives(Sphere { center: Vector3::new(0.3, -0.4, 1.2), radius: 0.7 });
        check_derivatives::<5>(Conical { slope: 0.0, ..shifted });
        check_derivatives::<6>(shifted);
    }

    #[test]
    fn values_are_distances_to_first_order() {
        let cone = cone();
        let [u, _] = cone.across();
        let normal = (u - cone.axis * cone.slope).normalize();
        let near = |offset: f64| cone.point + u * cone.radius + normal * offset;
        let q = cone.coefficients();
        assert!(value(&q, &near(0.0)).abs() < 1e-12);
        assert!((value(&q, &near(1e-4)) - 1e-4).abs() < 1e-7);
        let sphere = Sphere { center: Vector3::new(0.1, 0.2, 2.0), radius: 0.3 };
        let outside = sphere.center + u * 0.301;
        assert!((value(&sphere.coefficients(), &outside) - 0.001).abs() < 1e-5);
    }

    #[test]
    fn forms_of_departure_push_one_way_out_and_another_in_and_leave_the_size() {
        let cone = cone();
        let [u, v] = cone.across();
        let at = |form: &Coefficients, direction: Vector3| {
            value(form, &(cone.point + direction * cone.radius)) / cone.radius
        };
        let diagonal = (u + v).normalize();
        for (form, [by_u, by_v, between, along]) in
            cone.departures().iter().zip([[0.5, -0.5, 0.0, 0.0], [0.0, 0.0, 0.5, 0.0]])
        {
            for (direction, expected) in [(u, by_u), (v, by_v), (diagonal, between), (cone.axis, along)] {
                assert!((at(form, direction) - expected).abs() < 1e-12, "{form:?}");
            }
        }
        let ball = Sphere { center: Vector3::new(0.1, -0.2, 2.0), radius: 0.3 };
        let forms = ball.departures();
        for (i, a) in forms.iter().enumerate() {
            assert!((a[0] + a[1] + a[2]).abs() < 1e-12, "no part of it is of all directions alike");
            for (j, b) in forms.iter().enumerate() {
                // The coefficient of x y is split into halves for x y and y x.
                let product: f64 = (0..6).map(|k| a[k] * b[k] * if k < 3 { 1.0 } else { 0.5 }).sum();
                let expected = if i == j { 2.0 * (0.5_f64 / 0.3).powi(2) } else { 0.0 };
                assert!((product - expected).abs() < 1e-12, "{i} {j}: {product}");
            }
            assert!(value(a, &ball.center).abs() < 1e-12);
        }
    }

    #[test]
    fn where_a_scan_plane_pierces_the_axis_the_radius_is_that_of_its_section() {
        let camera = Pinhole { fx: 290.0, fy: 290.0, cx: 159.5, cy: 119.5 };
        let cone = Conical { point: Vector3::new(0.1, 0.2, 2.0), ..cone() };
        let plane = camera.plane(Scan::Row, 100.0);
        let pierced = cone.pierced_by(&plane);
        assert!(plane.normal().dot(&pierced.point).abs() < 1e-12);
        assert!((pierced.radius - cone.radius_at(&pierced.point)).abs() < 1e-12);
        assert!((pierced.apex() - cone.apex()).norm() < 1e-12);
        let along = Conical { axis: Vector3::x(), ..cone }.pierced_by(&plane);
        assert!(along.coefficients().iter().any(|q| q.is_nan()), "it runs along the plane");
    }

    #[test]
    fn a_frame_of_a_fit_and_back_is_the_same_surface() {
        let (origin, scale) = (Vector3::new(0.2, 0.1, 1.5), 0.13);
        let there = cone().to_local(&origin, scale);
        let back = there.to_camera(&origin, scale);
        let (point, local) = (Vector3::new(0.4, 0.7, 1.1), (Vector3::new(0.4, 0.7, 1.1) - origin) / scale);
        let ratio = value(&back.coefficients(), &point) / value(&there.coefficients(), &local);
        assert!((ratio - scale).abs() < 1e-12);
    }

    #[test]
    fn a_section_has_the_values_of_its_points() {
        let camera = Pinhole { fx: 290.0, fy: 290.0, cx: 159.5, cy: 119.5 };
        let q = cone().coefficients();
        for plane in [camera.plane(Scan::Row, 30.0), camera.plane(Scan::Column, 300.0)] {
            let (s, t) = (0.3, 1.4);
            let c = section_of(&q, &plane);
            let there = c[0] * s * s + c[1] * s * t + c[2] * t * t + c[3] * s + c[4] * t + c[5];
            assert!((there - value(&q, &plane.to_camera([s, t]))).abs() < 1e-12);
        }
    }

    #[test]
    fn the_half_angle_is_that_between_axis_and_side() {
        let cone = cone();
        let on_the_side = cone.point + cone.across()[0] * cone.radius;
        let side = on_the_side - cone.apex();
        let angle = side.cross(&cone.axis).norm().atan2(side.dot(&cone.axis));
        assert!((cone.half_angle() - angle).abs() < 1e-12, "{angle}");
    }

    #[test]
    fn a_step_to_no_radius_or_to_no_axis_leads_to_no_surface() {
        let cone = cone();
        for step in [
            [0.0, 0.0, 0.0, 0.0, -0.8, 0.0],
            [f64::NAN, 0.0, 0.0, 0.0, 0.0, 0.0],
            [0.0, f64::INFINITY, 0.0, 0.0, 0.0, 0.0],
        ] {
            assert_eq!(cone.moved(&step), None, "{step:?}");
        }
        assert_eq!(Sphere { center: Vector3::zeros(), radius: 0.3 }.moved(&[0.0, 0.0, 0.0, -0.3]), None);
    }
}
