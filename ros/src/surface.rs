//! `sensor_msgs/PointCloud2`: points on the surfaces of objects, for viewers without markers, such as Rerun.

use crate::markers::{color, turned_to};
use crate::point_cloud::FLOAT32;
use crate::{Marked, Stamped, Writer};
use conicflow_messages::{Object, ObjectKind};
use nalgebra::Vector3;
use std::f64::consts::{PI, TAU};

/// Fields of a point: x, y and z in metres, and the colour, which PCL and RViz expect as three bytes in a number named `rgb`.
const FIELDS: [&str; 4] = ["x", "y", "z", "rgb"];
/// Size of a point in bytes.
const POINT_BYTES: usize = 4 * FIELDS.len();
/// Number of rings around an object: enough to show the shape, few enough to see through.
const RINGS: usize = 12;
/// Number of points per ring: enough to show the shape, few enough to see through.
const SIDES: usize = 24;
/// Number of steps from a moving object to its position after [`AHEAD_S`] seconds, each with a point.
const STEPS: usize = 12;
/// How far the motion of an object is shown ahead, in seconds.
const AHEAD_S: f64 = 0.5;

/// Encodes a message that shows these items in place of those of the message before.
pub fn surface_points<T: Marked>(stamped: Stamped<'_>, items: &[T], memory: Vec<u8>) -> Vec<u8> {
    let points: Vec<[f32; 4]> = items.iter().flat_map(colored_points).collect();
    let mut writer = Writer::new(memory);
    writer.stamped(stamped).u32(1).u32(points.len() as u32).length(FIELDS.len());
    for (place, name) in (0..).zip(FIELDS) {
        writer.text(name).u32(4 * place).u8(FLOAT32).u32(1);
    }
    let bytes = POINT_BYTES * points.len();
    writer.u8(0).u32(POINT_BYTES as u32).u32(bytes as u32);
    writer.bytes(bytes, points.iter().flatten().flat_map(|number| number.to_le_bytes())).u8(1);
    writer.finish()
}

fn colored_points<T: Marked>(item: &T) -> Vec<[f32; 4]> {
    let object = item.object();
    let mut points = surface(object);
    if let Some(velocity) = item.velocity() {
        let (center, path) = (Vector3::from(object.center), AHEAD_S * Vector3::from(velocity));
        points.extend((0..=STEPS).map(|step| center + step as f64 / STEPS as f64 * path));
    }
    let bytes = color(object.shape()).map(|part| u32::from((255.0 * part) as u8));
    let rgb = f32::from_bits(bytes.into_iter().fold(0, |color, byte| color << 8 | byte));
    points.iter().map(|point| [point.x as f32, point.y as f32, point.z as f32, rgb]).collect()
}

/// Returns points on an object: rings across its axis; for a sphere, across z.
fn surface(object: &Object) -> Vec<Vector3<f64>> {
    let (turn, center) = (turned_to(object), Vector3::from(object.center));
    let ring = |number: usize| {
        let (along, radius) = ring(object, number as f64 / (RINGS - 1) as f64);
        (0..SIDES).map(move |side| {
            let angle = TAU * side as f64 / SIDES as f64;
            center + turn * Vector3::new(radius * angle.cos(), radius * angle.sin(), along)
        })
    };
    (0..RINGS).flat_map(ring).collect()
}

/// Returns the position of a ring along the axis, from the centre, and its radius. `part` is 0 at one end (the narrow one of a
/// cone) and 1 at the other.
fn ring(object: &Object, part: f64) -> (f64, f64) {
    let along = (part - 0.5) * object.length;
    match object.shape() {
        ObjectKind::Sphere => (-object.radius * (PI * part).cos(), object.radius * (PI * part).sin()),
        ObjectKind::Cylinder => (along, object.radius),
        ObjectKind::Cone => (along, object.top_radius + part * (object.base_radius - object.top_radius)),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Reader;
    use conicflow_messages::Track;

    const STAMPED: Stamped<'_> = Stamped { stamp_ns: 3, frame_id: "camera" };

    /// Decodes the points of a message and the bytes of their colours.
    fn read(message: &[u8]) -> Vec<(Vector3<f64>, u32)> {
        let mut reader = Reader::new(message).unwrap();
        assert_eq!((reader.stamped().unwrap(), reader.u32().unwrap()), (STAMPED, 1));
        let count = reader.u32().unwrap();
        assert_eq!(reader.u32().unwrap(), 4);
        for (name, offset) in [("x", 0), ("y", 4), ("z", 8), ("rgb", 12)] {
            assert_eq!((reader.text().unwrap(), reader.u32().unwrap()), (name, offset));
            assert_eq!((reader.u8().unwrap(), reader.u32().unwrap()), (FLOAT32, 1));
        }
        assert_eq!((reader.u8().unwrap(), reader.u32().unwrap(), reader.u32().unwrap()), (0, 16, 16 * count));
        let numbers: Vec<_> =
            reader.bytes().unwrap().as_chunks().0.iter().map(|bytes| u32::from_le_bytes(*bytes)).collect();
        assert!(reader.u8().is_ok() && reader.u8().is_err(), "nothing follows");
        let points = numbers.as_chunks::<4>().0;
        assert_eq!(points.len(), count as usize);
        let metres = |bits: u32| f64::from(f32::from_bits(bits));
        points.iter().map(|[x, y, z, rgb]| (Vector3::new(metres(*x), metres(*y), metres(*z)), *rgb)).collect()
    }

    fn object(kind: ObjectKind) -> Object {
        Object {
            kind: kind.code(),
            center: [0.1, 0.2, 1.5],
            axis: [0.6, 0.0, -0.8],
            radius: 0.1,
            length: 0.4,
            top_radius: 0.0,
            base_radius: 0.2,
            ..Object::default()
        }
    }

    #[test]
    fn all_points_lie_on_their_object_up_to_its_ends() {
        for kind in ObjectKind::ALL {
            let object = object(kind);
            let (center, axis) = (Vector3::from(object.center), Vector3::from(object.axis));
            let points = read(&surface_points(STAMPED, &[object], Vec::new()));
            assert_eq!(points.len(), RINGS * SIDES);
            let (mut least, mut most) = (f64::INFINITY, f64::NEG_INFINITY);
            for (point, _) in &points {
                let along = (point - center).dot(&axis);
                let across = (point - center - along * axis).norm();
                (least, most) = (least.min(along), most.max(along));
                let off = match kind {
                    ObjectKind::Sphere => (point - center).norm() - 0.1,
                    ObjectKind::Cylinder => across - 0.1,
                    ObjectKind::Cone => across - 0.5 * (along + 0.2),
                };
                assert!(off.abs() < 1e-6, "{kind:?}: {off} m off at {point}");
            }
            let end = if kind == ObjectKind::Sphere { 0.1 } else { 0.2 };
            assert!((least + end).abs() < 1e-6 && (most - end).abs() < 1e-6, "{kind:?}: {least} to {most}");
        }
    }

    #[test]
    fn points_of_a_moving_object_lead_ahead_and_kinds_differ_in_colour() {
        let objects = ObjectKind::ALL.map(object);
        let still = read(&surface_points(STAMPED, &objects, Vec::new()));
        let colors: Vec<_> = still.chunks(RINGS * SIDES).map(|points| points[0].1).collect();
        assert_eq!(colors, [0x00e5_9e00, 0x0056_b5e8, 0x0000_9e72]);
        let track = Track { object: objects[0], velocity: [2.0, 0.0, -1.0], ..Track::default() };
        let points = read(&surface_points(STAMPED, &[track], Vec::new()));
        let (last, _) = points.last().unwrap();
        assert!((last - Vector3::new(1.1, 0.2, 1.0)).norm() < 1e-6, "{last}");
        assert_eq!(points.len(), RINGS * SIDES + STEPS + 1);
        assert!(read(&surface_points::<Track>(STAMPED, &[], Vec::new())).is_empty());
    }
}
