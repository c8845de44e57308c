//! A frame to show, and its encoding for a browser: a JSON text, and the depths of as many pixels as the browser wants.

use crate::outline::{Segment, trace};
use conicflow_messages::{Camera, Header, Object, ToJson, Track};
use serde_json::{Value as Json, json};
use std::sync::Arc;

/// Maximum number of pixels per row that a browser gets.
const MAX_WIDTH: u32 = 1280;
/// Outlines are rounded to 1 / this of a pixel.
const PLACES: f64 = 10.0;

/// A depth image.
#[derive(Clone, Debug)]
pub struct Depth {
    /// The header of the image.
    pub header: Header,
    /// The pixels, row by row.
    pub pixels: Vec<u16>,
}

/// The results of a frame.
#[derive(Clone, Debug, Default)]
pub enum List {
    /// No stage has processed the frame.
    #[default]
    None,
    /// Objects.
    Objects(Vec<Object>),
    /// Tracks.
    Tracks(Vec<Track>),
}

impl List {
    /// Returns the objects, also those of tracks.
    pub fn objects(&self) -> Vec<Object> {
        match self {
            Self::None => Vec::new(),
            Self::Objects(objects) => objects.clone(),
            Self::Tracks(tracks) => tracks.iter().map(|track| track.object).collect(),
        }
    }

    /// Returns the kind of the items, and the items in JSON.
    fn to_json(&self, camera: &Camera) -> (Option<&'static str>, Vec<Json>) {
        match self {
            Self::None => (None, Vec::new()),
            Self::Objects(objects) => (Some("objects"), objects.iter().map(|o| item(o.to_json(), o, camera)).collect()),
            Self::Tracks(tracks) => {
                (Some("tracks"), tracks.iter().map(|t| item(t.to_json(), &t.object, camera)).collect())
            }
        }
    }
}

/// The results of a second variant for the same frame.
#[derive(Clone, Debug, Default)]
pub struct Compared {
    /// All of its results.
    pub list: List,
    /// The objects that both variants have found.
    pub pairs: Vec<Pair>,
}

/// An object that both variants have found.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Pair {
    /// Its index in the list of the first variant.
    pub own: usize,
    /// Its index in the list of the second variant.
    pub other: usize,
    /// Distance between the two positions, in metres.
    pub position_m: f64,
    /// Radius of the second minus that of the first, in metres.
    pub radius_m: f64,
}

/// A frame to show; the depth image or the list may be missing.
#[derive(Clone, Debug, Default)]
pub struct Frame {
    /// The header of the list, or else that of the depth image.
    pub header: Header,
    /// The depth image.
    pub depth: Option<Arc<Depth>>,
    /// The results of the first or only variant.
    pub list: List,
    /// The results of a second variant, if two are compared.
    pub compared: Option<Compared>,
    /// Time from when the source had the frame until the list was there, in milliseconds, if known.
    pub latency_ms: Option<f64>,
}

impl Frame {
    /// Returns the frame in JSON; the description of its image assumes that every `step`-th pixel of every `step`-th row is sent.
    pub(crate) fn to_json(&self, step: u32) -> Json {
        let header = &self.header;
        let (kind, mut items) = self.list.to_json(&header.camera);
        if let Some(compared) = &self.compared {
            add_second_variant(&mut items, compared, &header.camera);
        }
        let image = self.depth.as_ref().map(|depth| {
            let Camera { width, height, .. } = depth.header.camera;
            let (columns, rows) = (width.div_ceil(step), height.div_ceil(step));
            json!({ "columns": columns, "rows": rows, "step": step, "scale": depth.header.depth_scale })
        });
        json!({
            "epoch": header.epoch.to_string(),
            "sequence": header.sequence,
            "stamp_s": header.stamp_ns as f64 * 1e-9,
            "source": header.source.as_str(),
            "origin": header.origin().as_str(),
            "latency_ms": self.latency_ms,
            "camera": header.camera,
            "pose": header.pose(),
            "image": image,
            "kind": kind,
            "compared": self.compared.is_some(),
            "items": items,
        })
    }

    /// Returns the step between the pixels for a browser that wants `columns` of them per row.
    pub(crate) fn step(&self, columns: u32) -> u32 {
        let width = self.depth.as_ref().map_or(1, |depth| depth.header.camera.width);
        width.div_ceil(columns.clamp(1, MAX_WIDTH)).max(1)
    }

    /// Appends every `step`-th pixel of every `step`-th row, in little-endian order.
    pub(crate) fn write_pixels(&self, step: u32, bytes: &mut Vec<u8>) {
        let Some(depth) = &self.depth else { return };
        let (width, step) = (depth.header.camera.width as usize, step as usize);
        bytes.reserve(2 * depth.pixels.len() / (step * step) + 2 * width);
        for row in depth.pixels.chunks_exact(width.max(1)).step_by(step) {
            bytes.extend(row.iter().step_by(step).flat_map(|pixel| pixel.to_le_bytes()));
        }
    }
}

/// Appends the items of a second variant to those of the first; the two items of a pair refer to each other by index.
fn add_second_variant(items: &mut Vec<Json>, compared: &Compared, camera: &Camera) {
    let first = items.len();
    items.extend(compared.list.to_json(camera).1);
    for (number, item) in items.iter_mut().enumerate() {
        item["variant"] = json!(if number < first { "a" } else { "b" });
    }
    for pair in &compared.pairs {
        let (own, other) = (pair.own, first + pair.other);
        let difference = json!({ "position_m": pair.position_m, "radius_m": pair.radius_m });
        for (number, with) in [(own, other), (other, own)] {
            if let Some(item) = items.get_mut(number) {
                (item["pair"], item["difference"]) = (json!(with), difference.clone());
            }
        }
    }
}

/// The JSON of an item, with its outline in the image and the covariance of its centre.
fn item(value: impl serde::Serialize, object: &Object, camera: &Camera) -> Json {
    let mut json = serde_json::to_value(value).unwrap_or_default();
    let mut segments = Vec::new();
    trace(object, camera, &mut segments);
    json["covariance"] = json!(object.sigma.center);
    json["seen"] = json!(lines(segments.iter().filter(|segment| !segment.hidden)));
    json["hidden"] = json!(lines(segments.iter().filter(|segment| segment.hidden)));
    json["radius_at_center"] = json!(object.radius);
    json
}

/// Joins consecutive segments to polylines: u0, v0, u1, v1, ..
fn lines<'a>(segments: impl Iterator<Item = &'a Segment>) -> Vec<Vec<f64>> {
    let place = |pixel: f64| (pixel * PLACES).round() / PLACES;
    let mut lines: Vec<Vec<f64>> = Vec::new();
    let mut end = None;
    for segment in segments {
        let [from, to] = [segment.from, segment.to].map(|pixel| pixel.map(place));
        match lines.last_mut() {
            Some(line) if end == Some(from) => line.extend(to),
            _ => lines.push([from, to].concat()),
        }
        end = Some(to);
    }
    lines
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::ObjectKind;

    fn frame() -> Frame {
        let camera = Camera { width: 5, height: 3, fx: 5.0, fy: 5.0, cx: 2.0, cy: 1.0 };
        let header = Header { sequence: 7, depth_scale: 0.001, camera, ..Header::default() };
        let depth = Some(Arc::new(Depth { header, pixels: (0..15).collect() }));
        Frame { header, depth, ..Frame::default() }
    }

    #[test]
    fn every_second_pixel_of_every_second_row_is_sent() {
        let frame = frame();
        let mut bytes = Vec::new();
        frame.write_pixels(2, &mut bytes);
        let pixels: Vec<_> = bytes.as_chunks().0.iter().map(|pixel| u16::from_le_bytes(*pixel)).collect();
        assert_eq!(pixels, [0, 2, 4, 10, 12, 14]);
        let json = frame.to_json(2);
        assert_eq!(json["image"], json!({ "columns": 3, "rows": 2, "step": 2, "scale": 0.001 }));
        assert_eq!((json["sequence"].as_u64(), &json["kind"]), (Some(7), &Json::Null));
    }

    #[test]
    fn the_number_of_pixels_sent_is_limited_to_the_request() {
        let frame = frame();
        assert_eq!([u32::MAX, 5, 4, 2, 1, 0].map(|columns| frame.step(columns)), [1, 1, 2, 3, 5, 5]);
    }

    #[test]
    fn an_item_has_an_outline_of_joined_lines() {
        let ball =
            Object { kind: ObjectKind::Sphere.code(), center: [0.0, 0.0, 2.0], radius: 0.1, ..Object::default() };
        let frame = Frame { list: List::Objects(vec![ball]), ..frame() };
        let json = frame.to_json(1);
        let item = &json["items"][0];
        assert_eq!(item["kind"], "sphere");
        let seen = item["seen"].as_array().unwrap();
        assert_eq!((seen.len(), seen[0].as_array().unwrap().len()), (1, 2 * 73), "a closed line of 72 steps: {seen:?}");
        assert_eq!(item["hidden"], json!([]));
    }

    #[test]
    fn items_of_a_second_variant_follow_and_pairs_refer_to_each_other() {
        let ball = |x: f64| Object { kind: ObjectKind::Sphere.code(), center: [x, 0.0, 2.0], ..Object::default() };
        let pair = Pair { own: 1, other: 0, position_m: 0.02, radius_m: -0.001 };
        let list = List::Objects(vec![ball(0.3), ball(0.0)]);
        let compared = Some(Compared { list: List::Objects(vec![ball(0.02), ball(0.9)]), pairs: vec![pair] });
        let json = Frame { list, compared, ..frame() }.to_json(1);
        let values =
            |key: &str| json["items"].as_array().unwrap().iter().map(|item| item[key].clone()).collect::<Vec<_>>();
        assert_eq!(values("variant"), ["a", "a", "b", "b"]);
        assert_eq!(values("pair"), [Json::Null, json!(2), json!(1), Json::Null]);
        assert_eq!(json["items"][1]["difference"], json!({ "position_m": 0.02, "radius_m": -0.001 }));
        assert_eq!(json["items"][2]["center"][0], 0.02);
    }
}
