//! `visualization_msgs/MarkerArray`: objects as RViz and Foxglove draw them. Viewers have no cones, so a cone is a triangle mesh,
//! which includes the apex if that is visible.

use crate::transforms::write_pose;
use crate::{Stamped, Writer};
use conicflow_messages::{Object, ObjectKind, Track, TrackState};
use nalgebra::{Unit, UnitQuaternion, Vector3};
use std::f64::consts::TAU;

const SPHERE: i32 = 2;
const CYLINDER: i32 = 3;
const TEXT: i32 = 9;
const TRIANGLES: i32 = 11;
const ADD: i32 = 0;
const DELETE_ALL: i32 = 3;

/// Sides of a cone's mesh: with 48, the outline of a circle is within 0.2 % of the radius.
const SIDES: usize = 48;
/// Height of a label's letters in metres: readable beside objects of graspable size.
const LETTERS_M: f64 = 0.04;

/// An item that can be drawn.
pub trait Marked {
    /// Its shape.
    fn object(&self) -> &Object;
    /// The text beside it.
    fn label(&self) -> String;
    /// From 0, invisible, to 1: less certain items are paler.
    fn opacity(&self) -> f32;
    /// Its id across frames, if it has one.
    fn id(&self) -> Option<u64>;
    /// Its velocity in m/s, if known.
    fn velocity(&self) -> Option<[f64; 3]>;
}

impl Marked for Object {
    fn object(&self) -> &Object {
        self
    }

    fn label(&self) -> String {
        let [radius_mm, sigma_mm] = [self.radius, self.sigma.radius].map(|metres| 1000.0 * metres);
        format!("{} {radius_mm:.0} ± {sigma_mm:.1} mm", self.shape().name())
    }

    fn opacity(&self) -> f32 {
        0.8
    }

    fn id(&self) -> Option<u64> {
        None
    }

    fn velocity(&self) -> Option<[f64; 3]> {
        None
    }
}

impl Marked for Track {
    fn object(&self) -> &Object {
        &self.object
    }

    fn label(&self) -> String {
        format!("{} {}", self.id, Marked::label(&self.object))
    }

    fn opacity(&self) -> f32 {
        match self.track_state() {
            TrackState::Confirmed => 0.8,
            TrackState::Coasting => 0.5,
            TrackState::Tentative => 0.3,
        }
    }

    fn id(&self) -> Option<u64> {
        Some(self.id)
    }

    fn velocity(&self) -> Option<[f64; 3]> {
        Some(self.velocity)
    }
}

/// What happens to the markers of earlier messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Markers {
    /// The markers are removed at once: a viewer that joins at any time shows only the present markers.
    Replace,
    /// The markers stay until this age in nanoseconds; one with the same id moves without being removed first.
    Expire(u64),
}

/// Encodes a message that draws these items.
pub fn markers<T: Marked>(stamped: Stamped<'_>, items: &[T], others: Markers, memory: Vec<u8>) -> Vec<u8> {
    let mut writer = Writer::new(memory);
    let lifetime_ns = match others {
        Markers::Replace => {
            writer.length(1 + 2 * items.len());
            Marker { action: DELETE_ALL, ..Marker::default() }.write(stamped, &mut writer);
            0
        }
        Markers::Expire(lifetime_ns) => {
            writer.length(2 * items.len());
            lifetime_ns
        }
    };
    for (place, item) in (0..).zip(items) {
        let kept = item.id().filter(|_| others != Markers::Replace);
        // A marker's id has 31 bits: use the last ones.
        let id = kept.map_or(place, |id| (id & 0x7fff_ffff) as i32);
        let [red, green, blue] = color(item.object().shape());
        let color = [red, green, blue, item.opacity()];
        Marker { id, color, lifetime_ns, ..shape(item.object()) }.write(stamped, &mut writer);
        let label = label(item.object(), item.label());
        Marker { id, color: [1.0; 4], lifetime_ns, ..label }.write(stamped, &mut writer);
    }
    writer.finish()
}

/// Colours for the colour-blind (Okabe and Ito, 2008): orange, sky blue, bluish green.
pub(crate) fn color(shape: ObjectKind) -> [f32; 3] {
    match shape {
        ObjectKind::Sphere => [0.90, 0.62, 0.0],
        ObjectKind::Cylinder => [0.34, 0.71, 0.91],
        ObjectKind::Cone => [0.0, 0.62, 0.45],
    }
}

/// A `visualization_msgs/Marker`; other fields are empty.
struct Marker {
    namespace: &'static str,
    id: i32,
    kind: i32,
    action: i32,
    place: [f64; 3],
    rotation: UnitQuaternion<f64>,
    scale: [f64; 3],
    color: [f32; 4],
    /// 0: it stays until another message removes it.
    lifetime_ns: u64,
    points: Vec<Vector3<f64>>,
    text: String,
}

impl Default for Marker {
    fn default() -> Self {
        Self {
            namespace: "",
            id: 0,
            kind: SPHERE,
            action: ADD,
            place: [0.0; 3],
            rotation: UnitQuaternion::identity(),
            scale: [1.0; 3],
            color: [0.0; 4],
            lifetime_ns: 0,
            points: Vec::new(),
            text: String::new(),
        }
    }
}

fn shape(object: &Object) -> Marker {
    let (place, width) = (object.center, 2.0 * object.radius);
    let namespace = object.shape().name();
    match object.shape() {
        ObjectKind::Sphere => Marker { namespace, place, scale: [width; 3], ..Marker::default() },
        ObjectKind::Cylinder => {
            let (rotation, scale) = (turned_to(object), [width, width, object.length]);
            Marker { namespace, kind: CYLINDER, place, rotation, scale, ..Marker::default() }
        }
        ObjectKind::Cone => Marker { namespace, kind: TRIANGLES, points: cone(object), ..Marker::default() },
    }
}

fn label(object: &Object, text: String) -> Marker {
    // y points down, so this is above the object.
    let [x, y, z] = object.center;
    let place = [x, y - object.radius - LETTERS_M, z];
    Marker { namespace: "label", kind: TEXT, place, scale: [LETTERS_M; 3], text, ..Marker::default() }
}

/// Returns the rotation that turns z to the axis of an object.
pub(crate) fn turned_to(object: &Object) -> UnitQuaternion<f64> {
    let axis = Vector3::from(object.axis);
    // For an axis against z, any half turn about a perpendicular axis will do.
    UnitQuaternion::rotation_between(&Vector3::z(), &axis)
        .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), TAU / 2.0))
}

/// Returns the corners of a cone's triangles, three for each: the side from the base to the apex, or to the end of the visible
/// part before it, and the ends.
fn cone(object: &Object) -> Vec<Vector3<f64>> {
    let (center, axis) = (Vector3::from(object.center), Unit::new_normalize(Vector3::from(object.axis)));
    let (base, is_whole) = (center + 0.5 * object.length * axis.into_inner(), object.top_radius <= 0.0);
    let top = if is_whole { Vector3::from(object.apex) } else { center - 0.5 * object.length * axis.into_inner() };
    let turn = turned_to(object);
    let around = |side: usize, radius: f64| {
        let angle = TAU * (side % SIDES) as f64 / SIDES as f64;
        turn * Vector3::new(radius * angle.cos(), radius * angle.sin(), 0.0)
    };
    let mut points = Vec::with_capacity(12 * SIDES);
    for side in 0..SIDES {
        let [a, b] = [side, side + 1].map(|side| base + around(side, object.base_radius));
        points.extend([base, b, a]);
        if is_whole {
            points.extend([a, b, top]);
            continue;
        }
        let [c, d] = [side, side + 1].map(|side| top + around(side, object.top_radius));
        points.extend([a, b, c, c, b, d, top, c, d]);
    }
    points
}

impl Marker {
    fn write(&self, stamped: Stamped<'_>, writer: &mut Writer) {
        writer.stamped(stamped).text(self.namespace).i32(self.id).i32(self.kind).i32(self.action);
        write_pose(writer, self.place, &self.rotation);
        writer.f64s(&self.scale).f32s(&self.color).stamp_ns(self.lifetime_ns).u8(0);
        writer.length(self.points.len());
        for point in &self.points {
            writer.f64s(point.as_slice());
        }
        // No colours of points and no texture (resource, image with header, format and data, coordinates).
        writer.length(0).text("").stamped(Stamped::default()).text("").length(0).length(0);
        // The text, and no mesh (resource, file with name and data, materials).
        writer.text(&self.text).text("").text("").length(0).u8(0);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Reader;

    fn cone_of(top_radius: f64) -> Object {
        // Half-angle with a tangent of 0.5, apex at z = 1, axis down.
        let (from, to) = (2.0 * top_radius, 0.4);
        Object {
            kind: ObjectKind::Cone.code(),
            apex: [0.1, 0.0, 1.0],
            axis: [0.0, 1.0, 0.0],
            center: [0.1, 0.5 * (from + to), 1.0],
            length: to - from,
            half_angle: 0.5_f64.atan(),
            base_radius: 0.2,
            top_radius,
            ..Object::default()
        }
    }

    #[test]
    fn a_cone_ends_in_its_apex_and_all_of_its_corners_lie_on_it() {
        for top_radius in [0.0, 0.05] {
            let object = cone_of(top_radius);
            let points = cone(&object);
            let apex = Vector3::from(object.apex);
            let on_axis = |point: &Vector3<f64>| (point.xz() - apex.xz()).norm() < 1e-12;
            for point in &points {
                let (along, across) = (point.y - apex.y, (point.xz() - apex.xz()).norm());
                assert!(on_axis(point) || (across - 0.5 * along).abs() < 1e-12, "{point}");
                assert!((2.0 * top_radius - 1e-12..=0.4 + 1e-12).contains(&along), "{point}");
            }
            assert_eq!(points.contains(&apex), top_radius == 0.0);
            assert_eq!(points.len(), 3 * SIDES * if top_radius == 0.0 { 2 } else { 4 });
        }
    }

    #[test]
    fn cylinders_stand_along_their_axes() {
        for axis in [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [0.6, 0.0, -0.8], [0.0, -1.0, 0.0]] {
            let object = Object { kind: ObjectKind::Cylinder.code(), axis, ..Object::default() };
            assert!((turned_to(&object) * Vector3::z() - Vector3::from(axis)).norm() < 1e-12, "{axis:?}");
        }
    }

    #[test]
    fn a_message_replaces_all_before_it() {
        let sphere = Object { center: [0.1, 0.2, 1.5], radius: 0.1, ..Object::default() };
        let track = Track { id: 7, object: sphere, ..Track::default() };
        let stamped = Stamped { stamp_ns: 3, frame_id: "camera" };
        let message = markers(stamped, &[track], Markers::Replace, Vec::new());
        let mut reader = Reader::new(&message).unwrap();
        assert_eq!(reader.u32().unwrap(), 3);
        let mut marker = || {
            assert_eq!(reader.stamped().unwrap(), stamped);
            let (namespace, numbers) = (reader.text().unwrap(), [(); 3].map(|()| reader.i32().unwrap()));
            let (place, _, scale) =
                (reader.f64s::<3>().unwrap(), reader.f64s::<4>().unwrap(), reader.f64s::<3>().unwrap());
            (0..6).for_each(|_| assert!(reader.u32().is_ok()));
            assert_eq!((reader.u8().unwrap(), reader.u32().unwrap(), reader.u32().unwrap()), (0, 0, 0));
            assert_eq!((reader.text().unwrap(), reader.stamped().unwrap()), ("", Stamped::default()));
            assert_eq!((reader.text().unwrap(), reader.u32().unwrap(), reader.u32().unwrap()), ("", 0, 0));
            let text = reader.text().unwrap();
            assert_eq!((reader.text().unwrap(), reader.text().unwrap(), reader.u32().unwrap()), ("", "", 0));
            reader.u8().unwrap();
            (namespace, numbers, place, scale, text)
        };
        assert_eq!(marker().1, [0, SPHERE, DELETE_ALL]);
        assert_eq!(marker(), ("sphere", [0, SPHERE, ADD], [0.1, 0.2, 1.5], [0.2; 3], ""));
        let (namespace, numbers, _, _, text) = marker();
        assert_eq!((namespace, numbers, text), ("label", [0, TEXT, ADD], "7 sphere 100 ± 0.0 mm"));
        assert!(reader.u8().is_err(), "nothing follows");
    }

    #[test]
    fn markers_that_expire_keep_the_numbers_of_their_tracks() {
        let track = Track { id: (1 << 31) + 7, ..Track::default() };
        let stamped = Stamped { stamp_ns: 3, frame_id: "camera" };
        let message = markers(stamped, &[track], Markers::Expire(1_500_000_000), Vec::new());
        let mut reader = Reader::new(&message).unwrap();
        assert_eq!(reader.u32().unwrap(), 2, "none that takes others away");
        assert_eq!((reader.stamped().unwrap(), reader.text().unwrap()), (stamped, "sphere"));
        assert_eq!([(); 3].map(|()| reader.i32().unwrap()), [7, SPHERE, ADD]);
        assert!(reader.f64s::<10>().is_ok());
        (0..4).for_each(|_| assert!(reader.u32().is_ok()));
        assert_eq!((reader.i32().unwrap(), reader.u32().unwrap()), (1, 500_000_000));
        let of_object = markers(stamped, &[track.object; 2], Markers::Expire(1), Vec::new());
        let mut reader = Reader::new(&of_object).unwrap();
        assert_eq!(reader.u32().unwrap(), 4);
        assert_eq!((reader.stamped().unwrap(), reader.text().unwrap(), reader.i32().unwrap()), (stamped, "sphere", 0));
    }
}
