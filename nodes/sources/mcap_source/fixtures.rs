//! Recordings for tests: as other programs write them, and as conicflow does.

use super::replay::Replayed;
use super::*;
use crate::recording::recorder::{Limits, Recorded, Recorder};
use conicflow_dataflow::{AnyMessage, BUILT_IN};
use conicflow_messages::{Camera, HAS_POSE, Header, Hop, NoiseModel, Object, RECORDED, Text};
use conicflow_ros::{CAMERA_INFO, CameraInfo, Definition, IMAGE, Stamped, write_units};
use mcap::records::MessageHeader;
use mcap::{Compression, WriteOptions};
use std::collections::BTreeMap;
use std::fs;
use std::io::Cursor;

pub(super) const CAMERA: Camera = Camera { width: 4, height: 3, fx: 50.0, fy: 51.0, cx: 1.5, cy: 1.0 };
pub(super) const SIZE: (u32, u32) = (4, 3);
pub(super) const IMAGES: &str = "/camera/depth/image_rect_raw";
pub(super) const INFO: &str = "/camera/depth/camera_info";
/// Log time of the first message; the frames are a tenth of a second apart.
pub(super) const BEGIN_NS: u64 = 1_700_000_000_000_000_000;

pub(super) fn stamp_ns(frame: u64) -> u64 {
    BEGIN_NS + frame * 100_000_000
}

pub(super) fn stamped(frame: u64) -> Stamped<'static> {
    Stamped { stamp_ns: stamp_ns(frame), frame_id: "optical" }
}

pub(super) fn pixels(frame: u64) -> Vec<u16> {
    (0..12).map(|pixel| if pixel == 3 { 0 } else { 1000 + 10 * frame as u16 + pixel }).collect()
}

/// A recording as another program makes it.
pub(super) struct Foreign(pub(super) mcap::Writer<Cursor<Vec<u8>>>);

impl Foreign {
    pub(super) fn new(compression: Option<Compression>) -> Self {
        let options = WriteOptions::new().compression(compression).chunk_size(Some(300)).profile("ros2");
        Self(mcap::Writer::with_options(Cursor::new(Vec::new()), options).unwrap())
    }

    pub(super) fn put_as(&mut self, topic: &str, (name, encoding): (&str, &str), frame: u64, data: &[u8]) -> &mut Self {
        let schema = self.0.add_schema(name, "ros2msg", b"").unwrap();
        let channel_id = self.0.add_channel(schema, topic, encoding, &BTreeMap::new()).unwrap();
        let (log_time, publish_time) = (stamp_ns(frame), stamp_ns(frame));
        let header = MessageHeader { channel_id, sequence: frame as u32, log_time, publish_time };
        self.0.write_to_known_channel(&header, data).unwrap();
        self
    }

    pub(super) fn put(&mut self, topic: &str, definition: Definition, frame: u64, data: &[u8]) -> &mut Self {
        self.put_as(topic, (definition.name, "cdr"), frame, data)
    }

    pub(super) fn info(&mut self, topic: &str) -> &mut Self {
        self.put(topic, CAMERA_INFO, 0, &CameraInfo::write(stamped(0), &CAMERA, Vec::new()))
    }

    /// Adds images for this range of frames.
    pub(super) fn images(&mut self, topic: &str, frames: std::ops::Range<u64>) -> &mut Self {
        for frame in frames {
            self.put(topic, IMAGE, frame, &write_units(stamped(frame), SIZE, &pixels(frame), Vec::new()));
        }
        self
    }

    pub(super) fn bytes(&mut self) -> Vec<u8> {
        self.0.finish().unwrap();
        let writer = std::mem::replace(&mut self.0, mcap::Writer::new(Cursor::new(Vec::new())).unwrap());
        writer.into_inner().into_inner()
    }
}

/// Five frames with their camera.
pub(super) fn usual(compression: Option<Compression>) -> Vec<u8> {
    Foreign::new(compression).info(INFO).images(IMAGES, 0..5).bytes()
}

pub(super) struct RecordingFolder(pub(super) tempfile::TempDir);

impl RecordingFolder {
    pub(super) fn of(bytes: &[u8]) -> Self {
        let place = Self(tempfile::tempdir().unwrap());
        fs::write(place.0.path().join("run.mcap"), bytes).unwrap();
        place
    }

    pub(super) fn open(&self, config: Config) -> anyhow::Result<Replay> {
        let path = config.path.clone().unwrap_or_else(|| "run.mcap".into());
        Replay::open(&Config { path: Some(path), ..config }, self.0.path(), &DEPTH)
    }

    pub(super) fn play(&self, config: Config) -> anyhow::Result<Vec<(Header, Vec<u16>)>> {
        all(&mut self.open(config)?)
    }
}

pub(super) fn all(replay: &mut Replay) -> anyhow::Result<Vec<(Header, Vec<u16>)>> {
    let mut messages = Vec::new();
    while let Some(Replayed { header, items, .. }) = replay.next_message()? {
        messages.push((header, items.as_chunks().0.iter().map(|pixel| u16::from_ne_bytes(*pixel)).collect()));
    }
    Ok(messages)
}

pub(super) fn play(bytes: &[u8], config: Config) -> anyhow::Result<Vec<(Header, Vec<u16>)>> {
    RecordingFolder::of(bytes).play(config)
}

pub(super) fn error_of(bytes: &[u8], config: Config) -> String {
    format!("{:#}", play(bytes, config).unwrap_err())
}

pub(super) fn topic(topic: &str) -> Config {
    Config { topic: Some(topic.to_owned()), ..Config::default() }
}

/// The header of a frame after two stages of a pipeline.
pub(super) fn header(number: u64, depth_scale: f64) -> Header {
    let mut header = Header {
        epoch: 9,
        sequence: 3 + 2 * number,
        number,
        stamp_ns: 33_333_333 * number,
        camera: CAMERA,
        depth_scale,
        noise: NoiseModel { floor_m: 0.1, growth_per_m: 0.2, knee_m: 0.3, step_per_m: 0.4 },
        world_from_camera: [[0.0, 0.0, 1.0, 0.1], [-1.0, 0.0, 0.0, 0.2], [0.0, -1.0, 0.0, 0.3]],
        source: Text::new("frame-7.png"),
        flags: HAS_POSE | RECORDED,
        ..Header::default()
    };
    header.add_hop(Hop { stage: Text::new("left"), received_ns: 1, sent_ns: 2 });
    header
}

/// The header as a replay returns it: without the trace of hops.
pub(super) fn replayed(header: Header) -> Header {
    Header { hop_count: 0, hops: Default::default(), ..header }
}

/// The run that records.
pub(super) const RUN: u64 = 7;
pub(super) const ANY: [u16; 12] = [0, 1, 2, 65534, 65535, 1000, 0x1234, 30_000, 7, 65535, 0, 9];

pub(super) fn record(path: &Path, limits: Limits, depth_scale: f64, frames: std::ops::Range<u64>) -> Recorded {
    let recorder = Recorder::create(path, limits, RUN, false).unwrap();
    let objects = [Object { radius: 0.1, ..Object::default() }; 2];
    let mut last = Recorded::Written;
    for number in frames {
        let header = header(number, depth_scale);
        let depth = AnyMessage { header: &header, item: &BUILT_IN[0], bytes: bytemuck::cast_slice(&ANY) };
        recorder.write("depth", &depth, None).unwrap();
        let items = bytemuck::cast_slice(&objects[..number as usize % 3]);
        let list = AnyMessage { header: &header, item: &BUILT_IN[2], bytes: items };
        last = recorder.write("objects", &list, Some(1.5)).unwrap();
    }
    recorder.finish().unwrap();
    last
}
