//! Objects: spheres, cylinders and cones found in one frame, with their uncertainty.

use crate::{Header, Item, Malformed, coded::coded, item::check_each, item::finite};
use bytemuck::{Pod, Zeroable};
use serde::{Deserialize, Serialize};
use std::f64::consts::FRAC_PI_2;

/// How far the squared length of an axis may be from 1, because hand-written numbers are rounded.
const UNIT_TOLERANCE: f64 = 1e-3;

/// The shapes.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, PartialOrd, Ord)]
pub enum ObjectKind {
    /// A sphere.
    Sphere,
    /// A circular cylinder.
    Cylinder,
    /// A circular cone or a frustum of one.
    Cone,
}

coded!(ObjectKind: Sphere = 0 "sphere", Cylinder = 1 "cylinder", Cone = 2 "cone");

impl ObjectKind {
    /// Whether it has an axis, and a length along it.
    pub const fn has_axis(self) -> bool {
        match self {
            Self::Sphere => false,
            Self::Cylinder | Self::Cone => true,
        }
    }

    /// Whether it has a half-angle, an apex and a radius at either end; the sign of its axis then has a meaning.
    pub const fn has_half_angle(self) -> bool {
        match self {
            Self::Sphere | Self::Cylinder => false,
            Self::Cone => true,
        }
    }
}

/// A sphere, cylinder or cone in the camera frame; parameters that a shape lacks are zero.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable, PartialEq, Serialize, Deserialize)]
pub struct Object {
    /// [`ObjectKind::code`].
    pub kind: u32,
    /// Number of measurements that support it.
    pub points: u32,
    /// Number of scan lines that support it.
    pub rows: u32,
    /// Probability that it is an object of this shape; 0 if the method does not estimate it.
    pub confidence: f32,
    /// Centre of a sphere, or the middle of the visible part of a cylinder or cone, on the axis, in metres.
    pub center: [f64; 3],
    /// Unit vector along the axis; for a cone from the apex to the base.
    pub axis: [f64; 3],
    /// Radius in metres; for a cone at `center`.
    pub radius: f64,
    /// Length of the visible part along the axis, in metres. For a cone it excludes the part that is too narrow to be seen in
    /// lines: a radius below about six pixels.
    pub length: f64,
    /// Half-angle of a cone in radians.
    pub half_angle: f64,
    /// Radius of a cone at the wide end of its visible part, in metres.
    pub base_radius: f64,
    /// Radius of a cone at the narrow end of its visible part, in metres.
    pub top_radius: f64,
    /// Apex of a cone, in metres; may lie outside the visible part.
    pub apex: [f64; 3],
    /// Standard deviations.
    pub sigma: ObjectSigma,
    /// Root mean square distance of the points from the surface in excess of the noise, in metres; 0 if noise explains it.
    pub rms: f64,
    /// Visible part of the circumference, in radians.
    pub arc: f64,
}

/// Standard deviations of an [`Object`]; zero for parameters that a shape lacks.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable, PartialEq, Serialize, Deserialize)]
pub struct ObjectSigma {
    /// Covariance of the centre, row-major, in square metres.
    pub center: [[f64; 3]; 3],
    /// Root mean square of the angle between the estimated and the true axis, in radians.
    pub axis: f64,
    /// Of the radius, in metres.
    pub radius: f64,
    /// Of the length, in metres.
    pub length: f64,
    /// Of the half-angle, in radians.
    pub half_angle: f64,
}

impl Object {
    /// The shape; [`Item::check`] has refused unknown codes.
    pub fn shape(&self) -> ObjectKind {
        ObjectKind::from_code(self.kind).unwrap_or(ObjectKind::Sphere)
    }

    /// Returns the fault of an object from another process, if there is one.
    pub(crate) fn fault(&self) -> Option<&'static str> {
        let sigma = &self.sigma;
        let numbers = finite(&self.center)
            && finite(&self.axis)
            && finite(&self.apex)
            && finite(&[self.radius, self.length, self.half_angle, self.base_radius, self.top_radius])
            && finite(&[sigma.axis, sigma.radius, sigma.length, sigma.half_angle, self.rms, self.arc])
            && sigma.center.iter().all(|row| finite(row));
        if ObjectKind::from_code(self.kind).is_none() {
            Some("is of no known shape")
        } else if !numbers {
            Some("has a number that is not finite")
        } else if self.radius < 0.0 || self.length < 0.0 {
            Some("has a negative size")
        } else if !(0.0..=1.0).contains(&self.confidence) {
            Some("has a confidence that is no probability")
        } else if !self.has_fitting_axis() {
            Some("has an axis that is no unit vector, or a sphere has one")
        } else if !(0.0..FRAC_PI_2).contains(&self.half_angle) {
            Some("has a half-angle outside of 0 to 90 degrees")
        } else {
            None
        }
    }

    /// Whether the axis is a unit vector, or zero for a sphere.
    fn has_fitting_axis(&self) -> bool {
        let square: f64 = self.axis.iter().map(|number| number * number).sum();
        if self.shape().has_axis() { (square - 1.0).abs() <= UNIT_TOLERANCE } else { square == 0.0 }
    }
}

impl Item for Object {
    const NAME: &'static str = "objects";
    const TYPE_NAME: &'static str = "conicflow.Object.v2";
    const IS_COUNTED: bool = true;

    fn check(_: &Header, items: &[Self]) -> Result<(), Malformed> {
        check_each(items, Self::fault)
    }

    fn label(&self) -> Option<&'static str> {
        Some(self.shape().name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_codes_of_shapes_are_decoded_to_the_same_shapes() {
        for shape in ObjectKind::ALL {
            assert_eq!(ObjectKind::from_code(shape.code()), Some(shape));
            let object = Object { kind: shape.code(), ..Object::default() };
            assert_eq!(object.label(), Some(shape.name()));
        }
        assert_eq!(ObjectKind::from_code(3), None);
    }

    #[test]
    fn an_unknown_shape_and_a_nan_are_refused() {
        let good = Object { radius: 0.1, ..Object::default() };
        let unknown = Object { kind: 7, ..good };
        let nan = Object { axis: [0.0, f64::NAN, 0.0], ..good };
        assert!(Object::check(&Header::default(), &[good]).is_ok());
        let error = Object::check(&Header::default(), &[good, unknown]).unwrap_err();
        assert_eq!(error.to_string(), "malformed objects: item 1 is of no known shape");
        assert!(Object::check(&Header::default(), &[nan]).is_err());
        for (negative, fault) in [
            (Object { radius: -0.1, ..good }, "has a negative size"),
            (Object { length: -0.1, ..good }, "has a negative size"),
            (Object { confidence: -0.1, ..good }, "has a confidence that is no probability"),
            (Object { confidence: 1.1, ..good }, "has a confidence that is no probability"),
        ] {
            assert_eq!(negative.fault(), Some(fault));
        }
    }

    #[test]
    fn an_axis_is_a_unit_vector_and_a_half_angle_is_acute() {
        let check = |object: Object| Object::check(&Header::default(), &[object]).map_err(|error| error.to_string());
        let sphere = Object { radius: 0.1, ..Object::default() };
        let can = Object { kind: ObjectKind::Cylinder.code(), axis: [0.0, -1.0, 0.0], ..sphere };
        let cone = Object { kind: ObjectKind::Cone.code(), axis: [0.0, 0.866, 0.5], half_angle: 0.2, ..sphere };
        for good in [sphere, can, cone] {
            assert_eq!(check(good), Ok(()));
        }
        let axes = [
            Object { axis: [0.0; 3], ..can },
            Object { axis: [0.0, 2.0, 0.0], ..can },
            Object { axis: [0.0, 0.0, 1.0], ..sphere },
        ];
        for bad in axes {
            let expected = "malformed objects: item 0 has an axis that is no unit vector, or a sphere has one";
            assert_eq!(check(bad), Err(expected.into()));
        }
        for half_angle in [-0.1, FRAC_PI_2, 3.0] {
            let expected = "malformed objects: item 0 has a half-angle outside of 0 to 90 degrees";
            assert_eq!(check(Object { half_angle, ..cone }), Err(expected.into()));
        }
    }
}
