//! `vision_msgs/Detection3DArray`: objects with pose, covariance and bounding box.

use crate::markers::turned_to;
use crate::transforms::write_pose;
use crate::{Marked, Stamped, Writer};
use conicflow_messages::{Object, ObjectKind};
use std::f64::consts::PI;

/// Variance of an unknown angle: uniform over a full turn.
const UNKNOWN_ANGLE: f64 = PI * PI / 3.0;

/// Encodes a message with these items. Each has its shape's name and confidence, the pose of its centre with z along the axis, a
/// covariance, the bounding box in the same orientation, and the item's id if it has one.
pub fn detections<T: Marked>(stamped: Stamped<'_>, items: &[T], memory: Vec<u8>) -> Vec<u8> {
    let mut writer = Writer::new(memory);
    writer.stamped(stamped).length(items.len());
    for item in items {
        let object = item.object();
        let (center, rotation) = (object.center, turned_to(object));
        writer.stamped(stamped).length(1).text(object.shape().name()).f64s(&[f64::from(object.confidence)]);
        write_pose(&mut writer, center, &rotation);
        writer.f64s(covariance(object).as_flattened());
        write_pose(&mut writer, center, &rotation);
        writer.f64s(&size(object)).text(&item.id().map_or_else(String::new, |id| id.to_string()));
    }
    writer.finish()
}

/// Covariance of x, y, z and of small rotations about these axes, row-major. The variance of an angle across the axis is half of
/// the mean squared angle between the estimated and the true axis. The rotation about the axis, and all rotations of a sphere,
/// are unknown.
fn covariance(object: &Object) -> [[f64; 6]; 6] {
    let mut covariance = [[0.0; 6]; 6];
    let across = 0.5 * object.sigma.axis * object.sigma.axis;
    for row in 0..3 {
        covariance[row][..3].copy_from_slice(&object.sigma.center[row]);
        for column in 0..3 {
            let unit = f64::from(row == column);
            covariance[3 + row][3 + column] = if object.shape().has_axis() {
                let along = object.axis[row] * object.axis[column];
                across * (unit - along) + UNKNOWN_ANGLE * along
            } else {
                unit * UNKNOWN_ANGLE
            };
        }
    }
    covariance
}

/// Size of the bounding box of an object, with z along its axis.
fn size(object: &Object) -> [f64; 3] {
    let width = 2.0 * object.radius;
    match object.shape() {
        ObjectKind::Sphere => [width; 3],
        ObjectKind::Cylinder => [width, width, object.length],
        ObjectKind::Cone => [2.0 * object.base_radius, 2.0 * object.base_radius, object.length],
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Reader;
    use conicflow_messages::{ObjectSigma, Track};

    const STAMPED: Stamped<'_> = Stamped { stamp_ns: 3_000_000_004, frame_id: "camera" };

    fn can() -> Object {
        let center = [[1e-6, 2e-7, 0.0], [2e-7, 2e-6, 0.0], [0.0, 0.0, 4e-6]];
        Object {
            kind: ObjectKind::Cylinder.code(),
            center: [0.1, 0.2, 1.5],
            axis: [0.6, 0.0, -0.8],
            radius: 0.05,
            length: 0.3,
            confidence: 0.75,
            sigma: ObjectSigma { center, axis: 0.02, ..ObjectSigma::default() },
            ..Object::default()
        }
    }

    #[test]
    fn a_detection_has_the_pose_the_box_and_the_number_of_its_track() {
        let track = Track { id: 7, object: can(), ..Track::default() };
        let message = detections(STAMPED, &[track], Vec::new());
        let mut reader = Reader::new(&message).unwrap();
        assert_eq!((reader.stamped().unwrap(), reader.u32().unwrap()), (STAMPED, 1));
        assert_eq!((reader.stamped().unwrap(), reader.u32().unwrap()), (STAMPED, 1));
        assert_eq!((reader.text().unwrap(), reader.f64().unwrap()), ("cylinder", 0.75));
        let pose = reader.f64s::<7>().unwrap();
        assert_eq!(pose[..3], [0.1, 0.2, 1.5]);
        let covariance = reader.f64s::<36>().unwrap();
        assert_eq!((covariance[0], covariance[1], covariance[14]), (1e-6, 2e-7, 4e-6));
        assert_eq!(reader.f64s::<7>().unwrap(), pose, "of the box");
        assert_eq!(reader.f64s::<3>().unwrap(), [0.1, 0.1, 0.3]);
        assert_eq!(reader.text().unwrap(), "7");
        assert!(reader.u8().is_err(), "nothing follows");
    }

    #[test]
    fn the_covariance_covers_tilts_of_an_axis_and_leaves_the_turn_about_it_unknown() {
        let covariance = covariance(&can());
        let variance = |turn: [f64; 3]| {
            let pairs = (0..3).flat_map(|row| (0..3).map(move |column| (row, column)));
            pairs.map(|(row, column)| turn[row] * covariance[3 + row][3 + column] * turn[column]).sum::<f64>()
        };
        for across in [[0.0, 1.0, 0.0], [0.8, 0.0, 0.6]] {
            assert!((variance(across) - 2e-4).abs() < 1e-12, "{across:?}");
        }
        assert!((variance([0.6, 0.0, -0.8]) - UNKNOWN_ANGLE).abs() < 1e-12);
    }

    #[test]
    fn boxes_contain_their_objects() {
        let ball = Object { radius: 0.1, ..Object::default() };
        assert_eq!(size(&ball), [0.2; 3]);
        let cone = Object { kind: ObjectKind::Cone.code(), base_radius: 0.2, length: 0.3, ..ball };
        assert_eq!(size(&cone), [0.4, 0.4, 0.3]);
        assert_eq!(covariance(&ball)[4][4], UNKNOWN_ANGLE);
    }
}
