//! A detection: an object of one frame as input of the filters, in the tracking frame, each parameter with its variance.

use super::filter::{Axis, Size};
use super::parameters::TrackerParameters;
use conicflow_messages::{Object, ObjectKind};
use nalgebra::{Cholesky, IsometryMatrix3, Matrix3, Point3, Rotation3, UnitVector3, Vector3};

/// A measurement of one object.
#[derive(Clone, Debug)]
pub struct Detection {
    /// The object as it came, in the camera frame.
    pub object: Object,
    /// Kind of the object.
    pub kind: ObjectKind,
    /// Centre in the tracking frame, in metres.
    pub position: Vector3<f64>,
    /// Covariance of the centre.
    pub covariance: Matrix3<f64>,
    /// Size and axis of the object.
    pub shape: ShapeParameters,
    /// Time from this detection to the state with which it is compared, in seconds.
    pub late_s: f64,
}

/// The parameters of an object besides its place; each has its own filter.
#[derive(Clone, Copy, Debug)]
pub struct ShapeParameters {
    /// Radius at the centre, in metres.
    pub radius: Size,
    /// Length of the visible part, in metres.
    pub length: Size,
    /// Axis of a cylinder or cone in the tracking frame.
    pub axis: Option<Axis>,
    /// Half-angle of a cone, in radians.
    pub half_angle: Option<Size>,
}

impl ShapeParameters {
    /// Returns the parameters `dt` seconds later; their variances grow by the drifts of the configuration.
    pub fn predicted(&self, dt: f64, config: &TrackerParameters) -> Self {
        let [axis_drift, half_angle_drift] = [config.drift_axis_deg, config.drift_half_angle_deg].map(f64::to_radians);
        Self {
            radius: self.radius.predicted(dt, config.drift_radius_m),
            length: self.length.predicted(dt, config.drift_length_m),
            axis: self.axis.map(|axis| axis.predicted(dt, axis_drift)),
            half_angle: self.half_angle.map(|half_angle| half_angle.predicted(dt, half_angle_drift)),
        }
    }
}

impl Detection {
    /// Transforms an object into the tracking frame, and adds the floors of the configuration to its standard deviations.
    pub fn new(object: &Object, world_from_camera: &IsometryMatrix3<f64>, config: &TrackerParameters) -> Self {
        let kind = object.shape();
        let sigma = &object.sigma;
        let along = if kind.has_axis() { config.floor_along_axis * object.length } else { 0.0 };
        let direction = UnitVector3::try_new(world_from_camera.rotation * Vector3::from(object.axis), 1e-6)
            .filter(|_| kind.has_axis());
        let slope = if kind.has_half_angle() { object.half_angle.tan() } else { 0.0 };
        let radius_floor = config.floor_radius_m.hypot(along * slope);
        let half_angle =
            Size::new(object.half_angle, variance(sigma.half_angle, config.floor_half_angle_deg.to_radians()));
        Self {
            object: *object,
            kind,
            position: (world_from_camera * Point3::from(object.center)).coords,
            covariance: position_covariance(
                object,
                &world_from_camera.rotation,
                direction,
                along,
                config.floor_center_m,
            ),
            shape: ShapeParameters {
                radius: Size::new(object.radius, variance(sigma.radius, radius_floor)),
                length: Size::new(object.length, variance(sigma.length, config.floor_length_m)),
                // Each of the two directions across has half of the mean square angle.
                axis: direction
                    .map(|axis| Axis::new(axis, 0.5 * variance(sigma.axis, config.floor_axis_deg.to_radians()))),
                half_angle: kind.has_half_angle().then_some(half_angle),
            },
            late_s: 0.0,
        }
    }

    /// Returns this detection as a measurement of the object's state `late_s` seconds later, with the drift of the shape since.
    pub fn delayed(&self, late_s: f64, config: &TrackerParameters) -> Self {
        Self { late_s, shape: self.shape.predicted(late_s, config), ..self.clone() }
    }
}

fn variance(sigma: f64, floor: f64) -> f64 {
    sigma * sigma + floor * floor
}

/// Returns `R C R' + floor^2 I + along^2 a a'`; if `C` is no covariance, only its diagonal counts.
fn position_covariance(
    object: &Object,
    rotation: &Rotation3<f64>,
    axis: Option<UnitVector3<f64>>,
    along: f64,
    floor: f64,
) -> Matrix3<f64> {
    let given = Matrix3::from_fn(|row, column| object.sigma.center[row][column]);
    let added = Matrix3::from_diagonal_element(floor * floor)
        + axis.map_or_else(Matrix3::zeros, |axis| axis.into_inner() * axis.transpose() * (along * along));
    let whole = rotated(&given, rotation) + added;
    if Cholesky::new(whole).is_some() {
        return whole;
    }
    rotated(&Matrix3::from_diagonal(&given.diagonal().map(|variance| variance.max(0.0))), rotation) + added
}

/// Returns a covariance in a rotated frame, made symmetric.
pub fn rotated(covariance: &Matrix3<f64>, rotation: &Rotation3<f64>) -> Matrix3<f64> {
    let turned = rotation.matrix() * covariance * rotation.matrix().transpose();
    (turned + turned.transpose()) * 0.5
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::ObjectSigma;
    use nalgebra::Translation3;
    use std::f64::consts::FRAC_PI_2;

    fn config() -> TrackerParameters {
        TrackerParameters {
            floor_center_m: 0.001,
            floor_along_axis: 0.1,
            floor_radius_m: 0.003,
            ..TrackerParameters::default()
        }
    }

    fn cylinder() -> Object {
        let center = [[4e-6, 1e-6, 0.0], [1e-6, 9e-6, 0.0], [0.0, 0.0, 1e-6]];
        Object {
            kind: ObjectKind::Cylinder.code(),
            center: [1.0, 0.0, 0.0],
            axis: [0.0, 1.0, 0.0],
            radius: 0.05,
            length: 0.5,
            sigma: ObjectSigma { center, radius: 0.004, ..ObjectSigma::default() },
            ..Object::default()
        }
    }

    #[test]
    fn a_turned_camera_turns_place_axis_and_covariance() {
        let quarter = Rotation3::from_axis_angle(&Vector3::z_axis(), FRAC_PI_2);
        let pose = IsometryMatrix3::from_parts(Translation3::new(0.0, 0.0, 5.0), quarter);
        let detection = Detection::new(&cylinder(), &pose, &config());
        assert!((detection.position - Vector3::new(0.0, 1.0, 5.0)).norm() < 1e-15);
        assert!((detection.shape.axis.unwrap().direction.into_inner() + Vector3::x()).norm() < 1e-15);
        let expected = Matrix3::new(9e-6 + 1e-6 + 2.5e-3, -1e-6, 0.0, -1e-6, 4e-6 + 1e-6, 0.0, 0.0, 0.0, 1e-6 + 1e-6);
        assert!((detection.covariance - expected).norm() < 1e-15);
        assert!((detection.shape.radius.variance - 25e-6).abs() < 1e-18);
    }

    #[test]
    fn a_covariance_that_is_none_keeps_its_diagonal() {
        let mut object = cylinder();
        object.kind = ObjectKind::Sphere.code();
        object.sigma.center = [[4e-6, 1.0, 0.0], [1.0, -9e-6, 0.0], [0.0, 0.0, 1e-6]];
        let detection = Detection::new(&object, &IsometryMatrix3::identity(), &config());
        assert!((detection.covariance.diagonal() - Vector3::new(5e-6, 1e-6, 2e-6)).norm() < 1e-18);
        assert_eq!(detection.covariance[(0, 1)], 0.0);
        assert!(detection.shape.axis.is_none() && detection.shape.half_angle.is_none());
    }

    #[test]
    fn an_axis_of_zero_is_none() {
        let object = Object { axis: [0.0; 3], ..cylinder() };
        assert!(Detection::new(&object, &IsometryMatrix3::identity(), &config()).shape.axis.is_none());
    }
}
