//! Tests of the two nodes with a scripted middleware.

use crate::{Middleware, Participant, Published, Ros2Sink, Ros2Source, SinkConfig, SourceConfig};
use conicflow_dataflow::testing::{Owned, collect, pass};
use conicflow_dataflow::{ConfigFault, Context, Next, Output, RunError, SideInputs, Source, Stage, StageError};
use conicflow_messages::{Camera, HAS_POSE, Header, Hop, Object, RECORDED, Text, Track};
use conicflow_ros::{CameraInfo, Reader, Stamped, Writer, write_metres, write_transform, write_units};
use serde_json::json;
use std::collections::{BTreeMap, VecDeque};
use std::path::Path;
use std::sync::Mutex;
use std::thread;
use std::time::{Duration, Instant};

const CAMERA: Camera = Camera { width: 3, height: 2, fx: 52.5, fy: 52.0, cx: 1.0, cy: 0.5 };
const STAMPED: Stamped<'_> = Stamped { stamp_ns: 7_000_000_001, frame_id: "camera_depth_optical_frame" };
const PIXELS: [u16; 6] = [0, 1000, 65535, 4, 5, 6];

/// The messages that come at each endpoint, each with the number of empty looks before it.
type Incoming = Vec<VecDeque<(u32, Vec<u8>)>>;
/// The messages that were sent, with their endpoints.
type Sent = Vec<(usize, Vec<u8>)>;

/// The scripts of the participants by name: incoming and sent messages.
static SCRIPTS: Mutex<BTreeMap<String, (Incoming, Sent)>> = Mutex::new(BTreeMap::new());

struct Scripted {
    name: String,
    topics: Vec<String>,
}

impl Middleware for Scripted {
    fn join(participant: Participant) -> Result<Self, StageError> {
        let topics = participant.ends.iter().map(|end| end.topic.clone()).collect();
        Ok(Self { name: participant.name, topics })
    }

    fn is_joined(&self) -> bool {
        true
    }

    fn receive(&self, end: usize, look: Duration) -> Option<Vec<u8>> {
        let came = self.look(end);
        if came.is_none() {
            thread::sleep(look);
        }
        came
    }

    fn take_lost(&self, _: usize) -> u64 {
        0
    }

    fn publish(&self, end: usize, message: Vec<u8>) {
        SCRIPTS.lock().unwrap().entry(self.name.clone()).or_default().1.push((end, message));
    }

    fn published(&self) -> Vec<Published> {
        self.topics.iter().map(|topic| (topic.clone(), "other/msg/Type".to_owned())).collect()
    }
}

impl Scripted {
    fn look(&self, end: usize) -> Option<Vec<u8>> {
        let mut scripts = SCRIPTS.lock().unwrap();
        let incoming = scripts.get_mut(&self.name)?.0.get_mut(end)?;
        let looks = &mut incoming.front_mut()?.0;
        if *looks > 0 {
            *looks -= 1;
            return None;
        }
        Some(incoming.pop_front()?.1)
    }
}

/// The source without timeouts for cameras and poses. It fails with a message if nothing comes.
struct Patient {
    source: Ros2Source<Scripted>,
    begin: Instant,
}

impl Source for Patient {
    const NAME: &'static str = Ros2Source::<Scripted>::NAME;
    const SUMMARY: &'static str = Ros2Source::<Scripted>::SUMMARY;
    type Config = SourceConfig;
    type Output = u16;

    fn faults(config: &SourceConfig, base: &Path) -> Vec<ConfigFault> {
        Ros2Source::<Scripted>::faults(config, base)
    }

    fn new(config: SourceConfig, context: &Context) -> Result<Self, StageError> {
        let mut source = Ros2Source::new(config, context)?;
        (source.camera_timeout, source.patience_with_pose) = (Duration::MAX, Duration::MAX);
        Ok(Self { source, begin: Instant::now() })
    }

    fn next(&mut self, sides: &SideInputs, output: &mut Output<u16>) -> Result<Next, StageError> {
        assert!(self.begin.elapsed() < Duration::from_secs(60), "the frames do not come");
        self.source.next(sides, output)
    }
}

/// Runs the source, without timeouts, on these messages; returns the frames that it sends.
fn frames(stage: &str, more: serde_json::Value, incoming: Incoming, count: u64) -> Result<Vec<Owned<u16>>, RunError> {
    frames_of::<Patient>(stage, more, incoming, count)
}

fn frames_of<S: Source<Config = SourceConfig, Output = u16>>(
    stage: &str,
    more: serde_json::Value,
    incoming: Incoming,
    count: u64,
) -> Result<Vec<Owned<u16>>, RunError> {
    let context = Context { stage: stage.to_owned(), ..Context::default() };
    SCRIPTS.lock().unwrap().insert(format!("conicflow_{stage}"), (incoming, Vec::new()));
    let mut config = json!({ "topic": "/camera/depth/image_rect_raw", "connect": ["tcp/127.0.0.1:7447"] });
    config.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
    let config: SourceConfig = serde_json::from_value(config).unwrap();
    assert_eq!(S::faults(&config, Path::new("")), []);
    collect::<S>(config, context, count)
}

fn info() -> Vec<u8> {
    CameraInfo::write(STAMPED, &CAMERA, Vec::new())
}

fn image() -> Vec<u8> {
    write_units(STAMPED, (3, 2), &PIXELS, Vec::new())
}

fn queue(messages: impl IntoIterator<Item = Vec<u8>>) -> VecDeque<(u32, Vec<u8>)> {
    messages.into_iter().map(|message| (0, message)).collect()
}

#[test]
fn images_become_frames_with_their_camera_stamp_and_frame() {
    let metres = [f32::NAN, 1.0, 2.0, 3.0, 4.0, 5.0];
    let incoming =
        vec![queue([image(), write_metres(STAMPED, (3, 2), metres.into_iter(), Vec::new())]), queue([info()])];
    let frames = frames("kinds", json!({}), incoming, 2).unwrap();
    let (header, pixels) = &frames[0];
    assert_eq!((header.camera, header.stamp_ns, header.depth_scale), (CAMERA, STAMPED.stamp_ns, 0.001));
    assert_eq!((header.source.as_str(), header.flags), (Some(STAMPED.frame_id), 0));
    assert_eq!(pixels[..], PIXELS);
    let (header, pixels) = &frames[1];
    assert_eq!((header.depth_scale, header.sequence), (0.0001, 1));
    assert_eq!(pixels[..], [0, 10_000, 20_000, 30_000, 40_000, 50_000]);
}

#[test]
fn an_image_waits_for_what_tells_its_camera() {
    let incoming = vec![queue([image()]), VecDeque::from([(20, info())])];
    let frames = frames("waits", json!({}), incoming, 1).unwrap();
    assert_eq!((frames[0].0.camera, &frames[0].1[..]), (CAMERA, &PIXELS[..]));
}

#[test]
fn what_cannot_be_used_is_passed_over() {
    let distorted = {
        let mut info = info();
        // The five coefficients follow the name of their model; they are the first numbers of eight bytes.
        let at = info.windows(10).position(|bytes| bytes == b"plumb_bob\0").unwrap() + 10;
        let at = (at - 4 + 4).next_multiple_of(8) + 4;
        info[at..at + 8].copy_from_slice(&0.5_f64.to_le_bytes());
        info
    };
    assert_eq!(CameraInfo::read(&distorted).unwrap().distortion[0], 0.5, "the test spoils what it means to");
    let color = {
        let mut writer = Writer::new(Vec::new());
        writer.stamped(STAMPED).u32(2).u32(3).text("rgb8").u8(0).u32(9).bytes(18, [0; 18].into_iter());
        writer.finish()
    };
    let huge = write_units(Stamped { stamp_ns: 1, ..STAMPED }, (3, u32::MAX), &PIXELS, Vec::new());
    let larger = write_units(STAMPED, (6, 1), &PIXELS, Vec::new());
    let bad = [Vec::new(), vec![0; 3], vec![0xff; 4096], image()[..40].to_vec(), color, huge, larger];
    let images = queue(bad.into_iter().chain([image(), image()]));
    // The camera is distorted at first; then invalid bytes come on its topic.
    let infos = VecDeque::from([(0, distorted), (0, vec![0xff; 64]), (7, info())]);
    let more = json!({ "topic": "/camera/depth/image_raw" });
    let frames = frames("hostile", more, vec![images, infos], 1).unwrap();
    assert_eq!((frames[0].0.camera, &frames[0].1[..]), (CAMERA, &PIXELS[..]));
}

#[test]
fn the_camera_has_its_pose_where_transforms_tell_it() {
    let pose = |x| [[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let in_map = |stamp_ns| Stamped { stamp_ns, frame_id: "map" };
    let fixed = write_transform(Stamped { stamp_ns: 0, frame_id: "base" }, STAMPED.frame_id, &pose(0.5), Vec::new());
    let moving = [-1_i64, 1].map(|sign| {
        let at = STAMPED.stamp_ns.checked_add_signed(sign * 1000).unwrap();
        write_transform(in_map(at), "base", &pose(sign as f64), Vec::new())
    });
    // The second transform comes after the image.
    let mut dynamic = queue(moving);
    dynamic[1].0 = 3;
    let incoming = vec![queue([image()]), queue([info()]), queue([fixed]), dynamic];
    let frames = frames("poses", json!({ "world": "map" }), incoming, 1).unwrap();
    let told = frames[0].0.pose().expect("a pose")[0][3];
    assert!((told - 0.5).abs() < 1e-12, "{told}");
}

/// Transforms arrive several images late, as those of a map do.
#[test]
fn as_many_images_wait_for_their_poses_as_come_meanwhile() {
    let pose = |x| [[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let at = |number: u64| STAMPED.stamp_ns + number * 1_000_000;
    let images =
        (0..8).map(|number| write_units(Stamped { stamp_ns: at(number), ..STAMPED }, (3, 2), &PIXELS, Vec::new()));
    let transform = |number: u64| {
        let stamped = Stamped { stamp_ns: at(number), frame_id: "map" };
        write_transform(stamped, STAMPED.frame_id, &pose(number as f64), Vec::new())
    };
    // An image comes at each look; the second transform comes after the last image.
    let dynamic = VecDeque::from([(0, transform(0)), (9, transform(7))]);
    let incoming = vec![queue(images), queue([info()]), VecDeque::new(), dynamic];
    let frames = frames("late", json!({ "world": "map" }), incoming, 8).unwrap();
    let told = frames.iter().map(|(header, _)| (header.stamp_ns, header.pose().map(|pose| pose[0][3].round())));
    assert!(told.eq((0..8).map(|number| (at(number), Some(number as f64)))), "{frames:?}");
}

#[test]
fn frames_go_on_without_a_pose_that_nothing_tells() {
    let incoming = vec![queue(vec![image(); 40]), queue([info()])];
    let frames = frames_of::<Ros2Source<Scripted>>("lost", json!({ "world": "map" }), incoming, 40).unwrap();
    assert!(frames.iter().all(|(header, _)| header.flags & HAS_POSE == 0));
}

#[test]
fn an_organised_cloud_is_a_depth_image() {
    let cloud = |fx: f64| {
        let mut data = Vec::new();
        for (v, u) in [(0.0, 0.0), (0.0, 1.0), (0.0, 2.0), (1.0, 0.0), (1.0, 1.0), (1.0, 2.0)] {
            let point =
                [2.0 * (u - CAMERA.cx) / fx, 2.0 * (v - CAMERA.cy) / CAMERA.fy, 2.0].map(|number| number as f32);
            data.extend(point.into_iter().flat_map(f32::to_le_bytes));
        }
        let mut writer = Writer::new(Vec::new());
        writer.stamped(STAMPED).u32(2).u32(3).length(3);
        for (name, offset) in [("x", 0), ("y", 4), ("z", 8)] {
            writer.text(name).u32(offset).u8(7).u32(1);
        }
        writer.u8(0).u32(12).u32(36).bytes(data.len(), data.into_iter()).u8(1);
        writer.finish()
    };
    // The first cloud is that of another camera.
    let incoming = vec![queue([cloud(1.0), cloud(CAMERA.fx)]), queue([info()])];
    let frames = frames("cloud", json!({ "topic": "/camera/depth/points" }), incoming, 1).unwrap();
    assert_eq!((frames[0].0.depth_scale, &frames[0].1[..]), (0.0001, &[20_000; 6][..]));
}

#[test]
fn parameters_that_cannot_be_are_told() {
    let told = |config: serde_json::Value| {
        let config: SourceConfig = serde_json::from_value(config).unwrap();
        Ros2Source::<Scripted>::faults(&config, Path::new("")).iter().map(|fault| fault.key).collect::<Vec<_>>()
    };
    assert_eq!(told(json!({})), ["connect", "topic"]);
    let wrong = json!({ "connect": ["robot"], "topic": "/a/*", "camera_info": "b", "depth_scale": 0.0 });
    assert_eq!(told(wrong), ["connect", "topic", "camera_info", "depth_scale"]);
    let sink = SinkConfig { frame_id: Some(String::new()), topic: Some("a".to_owned()), ..SinkConfig::default() };
    let faults = Ros2Sink::<Track, Scripted>::faults(&sink, Path::new(""));
    assert_eq!(faults.iter().map(|fault| fault.key).collect::<Vec<_>>(), ["connect", "topic", "frame_id"]);
}

/// Returns what the sink sends for a message with this header.
fn sent(stage: &str, more: serde_json::Value, header: Header) -> Sent {
    let name = format!("conicflow_{stage}");
    SCRIPTS.lock().unwrap().remove(&name);
    let mut config = json!({ "connect": ["tcp/127.0.0.1:7447"] });
    config.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
    let config = serde_json::from_value(config).unwrap();
    let context = Context { stage: stage.to_owned(), ..Context::default() };
    let header = Header { camera: CAMERA, depth_scale: 0.001, stamp_ns: STAMPED.stamp_ns, ..header };
    let ball = Object { radius: 0.1, center: [0.0, 0.0, 1.0], ..Object::default() };
    let track = Track { id: 5, state: 1, object: ball, ..Track::default() };
    assert!(pass::<Ros2Sink<Track, Scripted>>(config, context, &[(header, vec![track])]).unwrap().is_empty());
    SCRIPTS.lock().unwrap().remove(&name).unwrap().1
}

#[test]
fn tracks_are_detections_and_markers_in_the_frame_of_the_images() {
    let header = Header { source: Text::new(STAMPED.frame_id), ..Header::default() };
    let sent = sent("sink", json!({ "world": "map" }), header);
    assert_eq!(sent.iter().map(|(end, _)| *end).collect::<Vec<_>>(), [0, 1], "no pose, no transform");
    let mut detections = Reader::new(&sent[0].1).unwrap();
    assert_eq!((detections.stamped().unwrap(), detections.u32().unwrap()), (STAMPED, 1));
    let mut markers = Reader::new(&sent[1].1).unwrap();
    assert_eq!((markers.u32().unwrap(), markers.stamped().unwrap()), (2, STAMPED));
    assert_eq!((markers.text().unwrap(), markers.i32().unwrap()), ("sphere", 5));
}

#[test]
fn the_frame_is_the_one_that_is_told() {
    let frame_of = |more, header| {
        let sent = sent("frame", more, header);
        Reader::new(&sent[0].1).unwrap().stamped().unwrap().frame_id.to_owned()
    };
    let of_file = Header { source: Text::new("frame-7.png"), flags: RECORDED, ..Header::default() };
    // The test runs the sink behind a stage called `upstream`.
    assert_eq!(frame_of(json!({}), of_file), "upstream");
    assert_eq!(frame_of(json!({ "frame_id": "optical" }), of_file), "optical");
}

#[test]
fn the_pose_of_the_camera_is_a_transform() {
    let world_from_camera = [[1.0, 0.0, 0.0, 4.0], [0.0, 1.0, 0.0, 5.0], [0.0, 0.0, 1.0, 6.0]];
    let hops = [Hop::default(); 8];
    let source = Text::new("optical");
    let header = Header { world_from_camera, flags: HAS_POSE, hops, source, ..Header::default() };
    let sent = sent("tf", json!({ "world": "map" }), header);
    let expected = write_transform(Stamped { frame_id: "map", ..STAMPED }, "optical", &world_from_camera, Vec::new());
    assert_eq!(sent[2], (2, expected));
}
