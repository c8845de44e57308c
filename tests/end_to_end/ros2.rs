//! The nodes that take part in ROS 2, with a Zenoh router and a bare Zenoh session in place of a robot. The keys, attachments and
//! tokens of `rmw_zenoh_cpp` are written here independently of the nodes.

use crate::bridge::loopback;
use crate::routers::{router, session};
use crate::support::{Playground, RECORDING, Started, TRACKING, depth_png, python_with, read_png, wait_until};
use conicflow_lab::simulator::scene::Scene;
use conicflow_messages::Camera;
use conicflow_ros::{CameraInfo, Image, Reader, Stamped, Writer, write_transform, write_units};
use serde_json::Value as Json;
use std::fs;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::{RecvTimeoutError, channel};
use std::sync::{Arc, Mutex};
use std::thread;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use zenoh::Wait;
use zenoh::qos::CongestionControl;
use zenoh::sample::SampleKind;

const IMAGE_HASH: &str = "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47";
const INFO_HASH: &str = "RIHS01_b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275";
const COMPRESSED_HASH: &str = "RIHS01_15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a";
const CLOUD_HASH: &str = "RIHS01_9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5";
const TF_HASH: &str = "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087";
const DETECTIONS_HASH: &str = "RIHS01_793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018";
const MARKERS_HASH: &str = "RIHS01_86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf";
const FRAME: &str = "camera_depth_optical_frame";
const SMALL: Camera = Camera { width: 64, height: 48, fx: 50.0, fy: 50.0, cx: 31.5, cy: 23.5 };

/// Opens a Zenoh session in place of a robot, connected to the router at this endpoint.
fn robot(endpoint: &str) -> zenoh::Session {
    session("client", &[("connect/endpoints", &format!("[\"{endpoint}\"]"))])
}

/// Returns an endpoint, the router that listens at it, and the session of a robot.
fn behind_router() -> (String, zenoh::Session, zenoh::Session) {
    let endpoint = loopback();
    let (router, robot) = (router(&endpoint), robot(&endpoint));
    (endpoint, router, robot)
}

/// A message with its key and its attachment.
type ReceivedMessage = (String, Vec<u8>, Vec<u8>);

/// A topic as a node of the robot publishes it.
struct RobotsTopic {
    session: zenoh::Session,
    key: String,
    sequence: i64,
}

impl RobotsTopic {
    fn new(session: &zenoh::Session, key: &str) -> Self {
        Self { session: session.clone(), key: key.to_owned(), sequence: 0 }
    }

    fn publish(&mut self, message: Vec<u8>) {
        self.sequence += 1;
        // The session waits where a busy machine is slow, because the test must not lose messages.
        let put = self.session.put(&self.key, message).congestion_control(CongestionControl::Block);
        put.attachment(attachment(self.sequence)).wait().unwrap();
    }

    /// Keeps a message for late subscribers, as a publisher of `TRANSIENT_LOCAL` does: a cache under a key below that of the
    /// topic answers with the key of the topic itself.
    fn latch(&self, message: Vec<u8>) -> impl Sized + use<> {
        let (key, below) = (self.key.clone(), format!("{}/@adv/pub/{}/1/_", self.key, self.session.zid()));
        let answer = move |query: zenoh::query::Query| {
            query.reply(&key, message.clone()).attachment(attachment(1)).wait().unwrap();
        };
        self.session.declare_queryable(below).callback(answer).wait().unwrap()
    }
}

/// The attachment of a message: its number, the time, and the id of the publisher.
fn attachment(sequence: i64) -> Vec<u8> {
    let now = SystemTime::now().duration_since(UNIX_EPOCH).unwrap().as_nanos() as i64;
    [&sequence.to_le_bytes()[..], &now.to_le_bytes(), &[16], &[3; 16]].concat()
}

/// The depth topic of a camera, and its camera info.
fn camera_topics(session: &zenoh::Session) -> [RobotsTopic; 2] {
    topics(session, "image_rect_raw", "Image", IMAGE_HASH)
}

/// A topic of a camera with messages of this type, and its camera info.
fn topics(session: &zenoh::Session, name: &str, kind: &str, hash: &str) -> [RobotsTopic; 2] {
    let messages = format!("0/camera/depth/{name}/sensor_msgs::msg::dds_::{kind}_/{hash}");
    let info = format!("0/camera/depth/camera_info/sensor_msgs::msg::dds_::CameraInfo_/{INFO_HASH}");
    [messages, info].map(|key| RobotsTopic::new(session, &key))
}

/// The camera info of a camera.
fn info_of(camera: &Camera, stamped: Stamped<'_>) -> Vec<u8> {
    CameraInfo::write(stamped, camera, Vec::new())
}

/// A depth image in millimetres.
fn plain(stamped: Stamped<'_>, camera: &Camera, pixels: &[u16]) -> Vec<u8> {
    write_units(stamped, (camera.width, camera.height), pixels, Vec::new())
}

/// An image of the small camera, which shows a wall at a distance of one metre.
fn wall(stamped: Stamped<'_>) -> Vec<u8> {
    plain(stamped, &SMALL, &[1000; 64 * 48])
}

/// A depth image as `compressed_depth_image_transport` sends it.
fn compressed(stamped: Stamped<'_>, camera: &Camera, pixels: &[u16]) -> Vec<u8> {
    let mut file = vec![0; 12]; // parameters to convert integers to metres, unused for millimetres
    depth_png(&mut file, camera.width, pixels);
    let mut writer = Writer::new(Vec::new());
    writer.stamped(stamped).text("16UC1; compressedDepth png").bytes(file.len(), file.into_iter());
    writer.finish()
}

/// The points of a depth image in millimetres, as `depth_image_proc` sends them; NaN without a measurement.
fn cloud(stamped: Stamped<'_>, camera: &Camera, pixels: &[u16]) -> Vec<u8> {
    let point = |(place, &millimetres): (usize, &u16)| {
        let z = if matches!(millimetres, 0 | u16::MAX) { f64::NAN } else { f64::from(millimetres) * 1e-3 };
        let [u, v] = [place as u32 % camera.width, place as u32 / camera.width].map(f64::from);
        [z * (u - camera.cx) / camera.fx, z * (v - camera.cy) / camera.fy, z, 0.0].map(|number| number as f32)
    };
    let data: Vec<u8> = pixels.iter().enumerate().flat_map(point).flat_map(f32::to_le_bytes).collect();
    let mut writer = Writer::new(Vec::new());
    writer.stamped(stamped).u32(camera.height).u32(camera.width).length(3);
    for (name, offset) in [("x", 0), ("y", 4), ("z", 8)] {
        writer.text(name).u32(offset).u8(7).u32(1);
    }
    writer.u8(0).u32(16).u32(16 * camera.width).bytes(data.len(), data.into_iter()).u8(0);
    writer.finish()
}

/// The liveliness tokens of all nodes, publishers and subscribers.
fn tokens(session: &zenoh::Session) -> Vec<String> {
    let answers = session.liveliness().get("@ros2_lv/0/**").wait().unwrap();
    answers.iter().filter_map(|answer| Some(answer.into_result().ok()?.key_expr().to_string())).collect()
}

fn wait_for_token(session: &zenoh::Session, part: &str) -> String {
    let mut found = None;
    wait_until(part, || {
        found = tokens(session).into_iter().find(|token| token.contains(part));
        found.is_some()
    });
    found.unwrap()
}

/// The stages of `text` with the depth images of a ROS 2 camera as their source.
fn by_ros(text: &str, endpoint: &str) -> String {
    by_topic(text, "image_rect_raw", endpoint)
}

/// The stages of `text` with messages of this topic of a camera as their source.
fn by_topic(text: &str, topic: &str, endpoint: &str) -> String {
    let (before, after) = text.split_once("[stage.source]").unwrap();
    let rest = after.split_once("[stage.extractor]").unwrap().1;
    format!(
        "{before}[stage.source]\nnode = \"ros2_source\"\noutput = \"depth\"\nnoise = \"ideal\"\n\
         topic = \"/camera/depth/{topic}\"\nconnect = [\"{endpoint}\"]\n\n[stage.extractor]{rest}"
    )
}

/// A pipeline that publishes its tracks in ROS 2.
fn to_ros(endpoint: &str) -> String {
    let text = TRACKING.replace("rate_hz    = 0", "rate_hz    = 50");
    with_sink(&text, "input = \"tracks\"", endpoint)
}

/// The stages of `text` and a ROS 2 sink with these settings.
fn with_sink(text: &str, settings: &str, endpoint: &str) -> String {
    format!("{text}\n[stage.ros]\nnode = \"ros2_sink\"\n{settings}\nconnect = [\"{endpoint}\"]\n")
}

/// Depth images of a scene as files in a playground, their camera, and their pixels.
fn recorded(text: &str, frames: u64) -> (Playground, Camera, Vec<Vec<u16>>) {
    let playground = Playground::with_pipeline(text);
    let camera = playground.record_with_camera(Scene::built_in("tabletop").unwrap().unwrap(), 5, frames);
    let pixels = |number: u64| {
        let (_, bytes) = read_png(&playground.path(&format!("frames/{number}.png")));
        bytes.as_chunks().0.iter().map(|pixel| u16::from_be_bytes(*pixel)).collect()
    };
    let images = (0..frames).map(pixels).collect();
    (playground, camera, images)
}

/// Encodes a depth image in millimetres as a ROS message.
type Encode = fn(Stamped<'_>, &Camera, &[u16]) -> Vec<u8>;

/// Returns the results for frames in files, and for the same frames as messages of a ROS topic.
fn of_files_and_of_ros(name: &str, kind: &str, hash: &str, encode: Encode) -> [Vec<Json>; 2] {
    const FRAMES: u64 = 10;
    // The unit of the depths contributes to the noise, and the unit of clouds is smaller. With a noise model other than the ideal
    // one, frames from files and from clouds have the same noise.
    let with_noise = |text: String| text.replace("\"ideal\"", "\"kinect_v1\"");
    let (files, camera, images) = recorded(&with_noise(RECORDING.to_owned()), FRAMES);
    files.conicflow(&["run"]).expect_code(0);
    let (endpoint, _router, session) = behind_router();
    let of_ros = Playground::with_pipeline(&with_noise(by_topic(RECORDING, name, &endpoint)));
    let mut run = of_ros.start(&["run", "--frames", &FRAMES.to_string()]);
    wait_for_token(&session, &format!("/MS/%/%/conicflow_source/%camera%depth%{}/", name.replace('/', "%")));
    let [mut topic, mut info] = topics(&session, name, kind, hash);
    for (number, image) in images.iter().enumerate() {
        let stamped = Stamped { stamp_ns: 1_700_000_000_000_000_000 + number as u64, frame_id: FRAME };
        info.publish(info_of(&camera, stamped));
        topic.publish(encode(stamped, &camera, image));
        // The test sends the next message after the objects of an earlier message are written, because a ROS topic does not wait
        // for its subscribers.
        run.wait_until("its objects are written", || of_ros.lines("objects.jsonl").len() + 2 > number);
    }
    run.wait().expect_code(0);
    let last = of_ros.json_lines("objects.jsonl").pop().unwrap();
    let stamp_ns = 1_700_000_000_000_000_000 + FRAMES - 1;
    assert_eq!((last["stamp_ns"].as_u64(), last["source"].as_str()), (Some(stamp_ns), Some(FRAME)));
    let lines = [files, of_ros].map(|playground| playground.json_lines("objects.jsonl"));
    assert!(lines[0].iter().any(|line| !line["objects"].as_array().unwrap().is_empty()), "something is found");
    assert_eq!(lines[1].len() as u64, FRAMES);
    lines
}

/// The frame number and the objects of each line.
fn objects(lines: &[Json]) -> Vec<(Json, Json)> {
    lines.iter().map(|line| (line["sequence"].clone(), line["objects"].clone())).collect()
}

#[test]
fn images_of_ros_give_the_objects_that_the_same_files_give() {
    let [of_files, of_ros] = of_files_and_of_ros("image_rect_raw", "Image", IMAGE_HASH, plain);
    assert!(objects(&of_ros) == objects(&of_files));
}

#[test]
fn compressed_images_of_ros_give_the_objects_that_the_same_files_give() {
    let [of_files, of_ros] =
        of_files_and_of_ros("image_rect_raw/compressedDepth", "CompressedImage", COMPRESSED_HASH, compressed);
    assert!(objects(&of_ros) == objects(&of_files));
}

#[test]
fn clouds_of_ros_give_the_objects_that_the_same_files_give() {
    let [of_files, of_ros] = of_files_and_of_ros("points", "PointCloud2", CLOUD_HASH, cloud);
    // The depths of clouds are in single precision, and have a smaller unit. So the positions of objects differ a little, and an
    // object at the limit of a criterion may be found in only one of the two.
    let (mut all, mut alike) = (0, 0);
    for (of_file, of_cloud) in of_files.iter().zip(&of_ros) {
        let [of_file, of_cloud] = [of_file, of_cloud].map(|line| line["objects"].as_array().unwrap());
        let is_alike = |one: &Json, other: &Json| {
            let far = |axis: usize| one["center"][axis].as_f64().unwrap() - other["center"][axis].as_f64().unwrap();
            one["kind"] == other["kind"] && (0..3).all(|axis| far(axis).abs() < 1e-3)
        };
        all += of_file.len().max(of_cloud.len());
        alike += of_file.iter().filter(|one| of_cloud.iter().any(|other| is_alike(one, other))).count();
    }
    assert!(all > 24 && 10 * alike > 9 * all, "{alike} of {all}");
}

/// From ROS 2 Lyrical on, a publisher of images uses a key below that of the topic for subscribers that announce in their
/// liveliness token that they accept such keys.
#[test]
fn images_below_the_key_of_the_topic_are_taken() {
    let (endpoint, _router, session) = behind_router();
    let playground = Playground::with_pipeline(&by_ros(RECORDING, &endpoint));
    let mut run = playground.start(&["run", "--frames", "3"]);
    let token = wait_for_token(&session, "/MS/%/%/conicflow_source/%camera%depth%image_rect_raw/");
    assert!(token.ends_with("/backends:cpu:"), "{token}");
    let [topic, mut info] = camera_topics(&session);
    let mut below = RobotsTopic::new(&session, &format!("{}/_buf_cpu", topic.key));
    let stamped = Stamped { stamp_ns: 1, frame_id: FRAME };
    info.publish(info_of(&SMALL, stamped));
    for taken in 1..=3 {
        below.publish(wall(stamped));
        // The publisher has sent messages to two other subscribers under other keys. These messages have used up two numbers.
        below.sequence += 2;
        run.wait_until("it is taken", || playground.lines("objects.jsonl").len() == taken);
    }
    let ended = run.wait().expect_code(0);
    assert!(!ended.stderr.contains("frames lost"), "{}", ended.stderr);
}

/// If the nodes use DDS, `zenoh-bridge-ros2dds` forwards their topics under their names, with its own tokens and without
/// attachments.
#[test]
fn topics_are_exchanged_with_a_bridge_to_dds() {
    const FRAMES: usize = 10;
    let (files, camera, images) = recorded(RECORDING, FRAMES as u64);
    files.conicflow(&["run"]).expect_code(0);
    let (endpoint, _router, session) = behind_router();
    let subscriber = session.declare_subscriber("conicflow/**").wait().unwrap();
    let text = by_ros(RECORDING, &endpoint).replace("[stage.extractor]", "via = \"ros2dds\"\n\n[stage.extractor]");
    let sink = "input = { topic = \"objects\", delivery = \"lossless\" }\nvia = \"ros2dds\"";
    let playground = Playground::with_pipeline(&with_sink(&text, sink, &endpoint));
    let mut run = playground.start(&["run", "--frames", &FRAMES.to_string()]);
    wait_until("our end is told", || {
        let answers = session.liveliness().get("@/*/@ros2_lv/MS/**").wait().unwrap();
        let tokens = answers.iter().filter_map(|answer| Some(answer.into_result().ok()?.key_expr().to_string()));
        tokens.into_iter().any(|token| token.contains("/camera§depth§image_rect_raw/sensor_msgs§msg§Image/"))
    });
    let put = |key: &str, message: Vec<u8>| {
        session.put(key, message).congestion_control(CongestionControl::Block).wait().unwrap();
    };
    for (number, image) in images.iter().enumerate() {
        let stamped = Stamped { stamp_ns: 1_700_000_000_000_000_000 + number as u64, frame_id: FRAME };
        put("camera/depth/camera_info", info_of(&camera, stamped));
        put("camera/depth/image_rect_raw", plain(stamped, &camera, image));
        run.wait_until("its objects are written", || playground.lines("objects.jsonl").len() + 2 > number);
    }
    run.wait().expect_code(0);
    assert!(objects(&playground.json_lines("objects.jsonl")) == objects(&files.json_lines("objects.jsonl")));
    // The last messages may still pass through the router when the run has ended.
    let mut keys = Vec::new();
    wait_until("both messages of each frame are heard", || {
        keys.extend(subscriber.drain().map(|sample| sample.key_expr().to_string()));
        keys.len() >= 2 * FRAMES
    });
    for key in ["conicflow/objects", "conicflow/objects/markers"] {
        assert_eq!(keys.iter().filter(|received| *received == key).count(), FRAMES, "{key} in {keys:?}");
    }
}

/// A static transform that was sent before the run began and a moving one give the pose of each image. The sink publishes the
/// pose.
#[test]
fn the_pose_of_the_camera_is_read_from_transforms_and_published_as_one() {
    let (endpoint, _router, session) = behind_router();
    let tf = |name: &str| RobotsTopic::new(&session, &format!("0/{name}/tf2_msgs::msg::dds_::TFMessage_/{TF_HASH}"));
    let pose = |x| [[1.0, 0.0, 0.0, x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
    let in_base = Stamped { stamp_ns: 0, frame_id: "base" };
    let _latched = tf("tf_static").latch(write_transform(in_base, FRAME, &pose(0.5), Vec::new()));
    let subscriber =
        session.declare_subscriber(format!("0/tf/tf2_msgs::msg::dds_::TFMessage_/{TF_HASH}")).wait().unwrap();
    let text = by_ros(RECORDING, &endpoint).replace("[stage.extractor]", "world = \"map\"\n\n[stage.extractor]");
    // The frame of the camera already has the parent `base`, so the sink publishes the pose with the name of another frame.
    let sink = "input = \"objects\"\nworld = \"map\"\nframe_id = \"seen_from\"";
    let playground = Playground::with_pipeline(&with_sink(&text, sink, &endpoint));
    let mut run = playground.start(&["run"]);
    wait_for_token(&session, "/MS/%/%/conicflow_source/%camera%depth%image_rect_raw/");
    wait_for_token(&session, "/MP/%/%/conicflow_ros/%tf/");
    let ([mut topic, mut info], mut moving) = (camera_topics(&session), tf("tf"));
    // The base moves a metre in five milliseconds. Its place at the time of the image is interpolated between two transforms.
    const STEP_NS: u64 = 5_000_000;
    const BEGIN_NS: u64 = 1_700_000_000_000_000_000;
    let (mut step, mut last) = (0, None);
    run.wait_until("poses come back", || {
        let at = Stamped { stamp_ns: BEGIN_NS + step * STEP_NS, frame_id: FRAME };
        info.publish(info_of(&SMALL, at));
        topic.publish(wall(at));
        let after = Stamped { stamp_ns: at.stamp_ns + STEP_NS, frame_id: "map" };
        moving.publish(write_transform(after, "base", &pose((step + 1) as f64), Vec::new()));
        step += 2;
        thread::sleep(Duration::from_millis(20));
        let messages = subscriber.drain().map(|sample| sample.payload().to_bytes().into_owned());
        let of_sink = messages.filter(|message| message.windows(9).any(|bytes| bytes == b"seen_from"));
        last = of_sink.last().or(last.take());
        last.is_some() && step > 40
    });
    let message = last.unwrap();
    let mut reader = Reader::new(&message).unwrap();
    assert_eq!(reader.u32().unwrap(), 1);
    let stamped = reader.stamped().unwrap();
    assert_eq!((stamped.frame_id, reader.text().unwrap()), ("map", "seen_from"));
    let expected = ((stamped.stamp_ns - BEGIN_NS) / STEP_NS) as f64 + 0.5;
    let [x, y, z] = reader.f64s().unwrap();
    assert!((x - expected).abs() < 1e-9 && y == 0.0 && z == 0.0, "{x} {y} {z}, expected {expected}");
    run.end();
}

#[test]
fn tracks_reach_ros_and_the_node_is_listed_there() {
    let (endpoint, _router, session) = behind_router();
    let received = Arc::<Mutex<Vec<ReceivedMessage>>>::default();
    let take = Arc::clone(&received);
    let _subscriber = session
        .declare_subscriber("0/conicflow/**")
        .callback(move |sample| {
            let attachment = sample.attachment().map(|bytes| bytes.to_bytes().into_owned()).unwrap_or_default();
            let message = sample.payload().to_bytes().into_owned();
            take.lock().unwrap().push((sample.key_expr().to_string(), message, attachment));
        })
        .wait()
        .unwrap();
    let gone = Arc::<Mutex<Vec<String>>>::default();
    let take = Arc::clone(&gone);
    let _graph = session
        .liveliness()
        .declare_subscriber("@ros2_lv/0/**")
        .callback(move |sample| {
            if sample.kind() == SampleKind::Delete {
                take.lock().unwrap().push(sample.key_expr().to_string());
            }
        })
        .wait()
        .unwrap();
    let playground = Playground::with_pipeline(&to_ros(&endpoint));
    let mut run = playground.start(&["run"]);
    run.wait_until("tracks are heard", || received.lock().unwrap().len() > 40);
    let node = wait_for_token(&session, "/NN/%/%/conicflow_ros");
    let zid = node.split('/').nth(2).unwrap().to_owned();
    assert_eq!(node, format!("@ros2_lv/0/{zid}/0/0/NN/%/%/conicflow_ros"));
    let ends = [
        format!("1/MP/%/%/conicflow_ros/%conicflow%tracks/vision_msgs::msg::dds_::Detection3DArray_/{DETECTIONS_HASH}"),
        format!(
            "2/MP/%/%/conicflow_ros/%conicflow%tracks%markers/visualization_msgs::msg::dds_::MarkerArray_/{MARKERS_HASH}"
        ),
    ];
    // On a busy machine an answer may lack what the one before had.
    for end in ends {
        let token = format!("@ros2_lv/0/{zid}/0/{end}/::,10:,:,:,,");
        assert_eq!(wait_for_token(&session, &token), token);
    }
    swap_and_go_on(&playground, &mut run, &received);
    run.end();
    wait_until("the node is gone", || gone.lock().unwrap().len() >= 6);
    check_received(&received.lock().unwrap());
}

/// Replaces the sink during the run, and waits for messages of the new sink.
fn swap_and_go_on(playground: &Playground, run: &mut Started, received: &Mutex<Vec<ReceivedMessage>>) {
    playground.conicflow(&["swap", "ros", "--set", "frame_id=optical"]).expect_code(0);
    let is_new = |message: &[u8]| message.windows(7).any(|bytes| bytes == b"optical");
    run.wait_until("the successor is heard", || {
        received.lock().unwrap().iter().filter(|(_, message, _)| is_new(message)).count() > 20
    });
    let ros = playground.top_stage("ros");
    assert!(ros["counters"]["messages sent"].as_u64().unwrap() > 20, "{ros}");
}

/// Asserts that each message has its key, and an attachment whose numbers rise by one.
fn check_received(received: &[ReceivedMessage]) {
    let detections = format!("0/conicflow/tracks/vision_msgs::msg::dds_::Detection3DArray_/{DETECTIONS_HASH}");
    let markers = format!("0/conicflow/tracks/markers/visualization_msgs::msg::dds_::MarkerArray_/{MARKERS_HASH}");
    assert!(received.iter().all(|(key, ..)| [&detections, &markers].contains(&key)), "nothing else");
    for key in [detections, markers] {
        let of_key: Vec<_> = received.iter().filter(|(other_key, ..)| *other_key == key).collect();
        assert!(of_key.len() > 20, "{} on {key}", of_key.len());
        let (mut last, mut ends) = (None, 0);
        for (_, message, attachment) in of_key {
            assert_eq!((message[..4].to_vec(), attachment.len(), attachment[16]), (vec![0, 1, 0, 0], 33, 16));
            let number = i64::from_le_bytes(attachment[..8].try_into().unwrap());
            let end = attachment[17..].to_vec();
            match last.replace((end.clone(), number)) {
                Some((same, before)) if same == end => assert_eq!(number, before + 1),
                _ => ends += 1,
            }
        }
        assert_eq!(ends, 2, "one for each process of the stage");
    }
}

#[test]
fn malformed_messages_are_skipped_and_reported_once() {
    let (endpoint, _router, session) = behind_router();
    let playground = Playground::with_pipeline(&by_ros(RECORDING, &endpoint));
    let mut run = playground.start(&["run", "--frames", "3"]);
    wait_for_token(&session, "/MS/%/%/conicflow_source/%camera%depth%image_rect_raw/");
    let [mut topic, mut info] = camera_topics(&session);
    let stamped = Stamped { stamp_ns: 1, frame_id: FRAME };
    info.publish(info_of(&SMALL, stamped));
    let mut damaged: Vec<Vec<u8>> = vec![Vec::new(), vec![0; 5], vec![0xff; 70_000], b"\0\x01\0\0".to_vec()];
    let mut random = fastrand::Rng::with_seed(7);
    damaged.extend((0..200).map(|_| {
        let mut message = wall(stamped);
        // The first hundred bytes contain the lengths and sizes.
        (0..4).for_each(|_| message[random.usize(..100)] = random.u8(..));
        message.truncate(random.usize(..message.len()));
        message
    }));
    for message in damaged {
        topic.publish(message.clone());
        info.publish(message);
        // A malformed attachment, and no attachment.
        session.put(&topic.key, vec![1; 9]).attachment(vec![7; 20]).wait().unwrap();
        session.put(&info.key, vec![1; 9]).wait().unwrap();
    }
    run.wait_for_text("is counted as `frames unreadable`");
    let mut sent = 0;
    run.wait_until("good ones are taken", || {
        info.publish(info_of(&SMALL, stamped));
        topic.publish(wall(stamped));
        sent += 1;
        playground.lines("objects.jsonl").len() == 3 || sent > 1000
    });
    let ended = run.wait().expect_code(0);
    assert_eq!(ended.stderr.matches("is counted as `frames unreadable`").count(), 1, "{}", ended.stderr);
    assert_eq!(ended.stage("source").starts, 1);
    ended.expect_texts(&["frames unreadable"]);
}

#[test]
fn a_router_of_ros_may_start_late_and_restart() {
    let endpoint = loopback();
    let playground = Playground::with_pipeline(&to_ros(&endpoint));
    let mut run = playground.start(&["run"]);
    run.wait_for_text(&format!("no router of ROS 2 is reached at `{endpoint}`"));
    for round in 1..=2 {
        let router = router(&endpoint);
        let session = robot(&endpoint);
        let subscriber = session.declare_subscriber("0/conicflow/**").wait().unwrap();
        wait_for_token(&session, "/MP/%/%/conicflow_ros/%conicflow%tracks/");
        assert!(subscriber.recv_timeout(Duration::from_secs(60)).unwrap().is_some());
        session.close().wait().unwrap();
        router.close().wait().unwrap();
        run.wait_until("the loss is counted", || is_without_router(&playground, round));
    }
    let ended = run.end();
    assert!(ended.stderr.matches("no router of ROS 2 is reached").count() >= 2, "{}", ended.stderr);
    ended.expect_texts(&["is reached\n"]);
    assert_eq!(ended.stage("ros").starts, 1);
}

/// Whether the sink has counted more than twenty messages without a router for each round.
fn is_without_router(playground: &Playground, round: u64) -> bool {
    playground.top_stage("ros")["counters"]["messages without a router"].as_u64().unwrap_or(0) > 20 * round
}

#[test]
fn silence_is_reported_with_the_topics_that_exist() {
    let (endpoint, _router, session) = behind_router();
    let token = format!(
        "@ros2_lv/0/{}/0/1/MP/%/%/driver/%camera%depth%points/sensor_msgs::msg::dds_::PointCloud2_/RIHS01_0/::,10:,:,:,,",
        session.zid()
    );
    let _token = session.liveliness().declare_token(token).wait().unwrap();
    let playground = Playground::with_pipeline(&by_ros(RECORDING, &endpoint));
    let mut run = playground.start(&["run"]);
    run.wait_for_text("nobody publishes `/camera/depth/image_rect_raw`");
    run.wait_for_text("hint: topics with images or clouds: `/camera/depth/points`");
    run.end();
}

/// Images arrive at 50 Hz: each one arrives while the source still waits for the camera info of the one before.
#[test]
fn images_without_a_camera_info_are_reported_and_counted_and_nothing_is_sent() {
    let (endpoint, _router, session) = behind_router();
    let playground = Playground::with_pipeline(&by_ros(RECORDING, &endpoint));
    let mut run = playground.start(&["run"]);
    wait_for_token(&session, "/MS/%/%/conicflow_source/%camera%depth%image_rect_raw/");
    let [mut topic, mut info] = camera_topics(&session);
    let stamped = Stamped { stamp_ns: 1, frame_id: FRAME };
    let has_camera = AtomicBool::new(false);
    let counted = || playground.top_stage("source")["counters"]["frames without camera"].as_u64().unwrap_or(0);
    // The thread publishes until the other end of the channel is dropped, which also happens if the test fails.
    let (goes_on, over) = channel::<()>();
    thread::scope(|scope| {
        let _goes_on = goes_on;
        let has_camera = &has_camera;
        scope.spawn(move || {
            while over.recv_timeout(Duration::from_millis(20)) == Err(RecvTimeoutError::Timeout) {
                if has_camera.load(Ordering::Relaxed) {
                    info.publish(info_of(&SMALL, stamped));
                }
                topic.publish(wall(stamped));
            }
        });
        run.wait_until("they are counted", || counted() > 60);
        run.wait_for_text("nothing tells the camera of `/camera/depth/image_rect_raw`");
        assert!(playground.lines("objects.jsonl").is_empty());
        has_camera.store(true, Ordering::Relaxed);
        run.wait_until("the camera is told", || playground.lines("objects.jsonl").len() > 3);
    });
    run.end().expect_texts(&["frames without camera"]);
}

#[test]
fn messages_are_read_by_an_independent_reader() {
    let Some(python) = python_with("rosbags", "has no rosbags; nothing was shown") else { return };
    let (endpoint, _router, session) = behind_router();
    let subscriber = session.declare_subscriber("0/conicflow/**").wait().unwrap();
    let playground = Playground::with_pipeline(&to_ros(&endpoint));
    let run = playground.start(&["run"]);
    for number in 0..20 {
        let sample = subscriber.recv_timeout(Duration::from_secs(60)).unwrap().unwrap();
        let kind = sample.key_expr().as_str().split('/').rev().nth(1).unwrap().to_owned();
        let (package, name) = kind.split_once("::msg::dds_::").unwrap();
        let file = format!("{number}.{package}.{}", name.trim_end_matches('_'));
        fs::write(playground.path(&file), sample.payload().to_bytes()).unwrap();
    }
    drop(run);
    let stamped = Stamped { stamp_ns: 5_000_000_006, frame_id: FRAME };
    let camera = Camera { width: 3, height: 2, fx: 52.5, fy: 52.0, cx: 1.0, cy: 0.5 };
    let pose = [[0.0, 0.0, 1.0, 4.0], [-1.0, 0.0, 0.0, 5.0], [0.0, -1.0, 0.0, 6.0]];
    let pixels = [0, 1, 65535, 4, 5, 6];
    let image = plain(stamped, &camera, &pixels);
    assert!(Image::read(&image).is_ok());
    for (file, message) in [
        ("image.sensor_msgs.Image", image),
        ("info.sensor_msgs.CameraInfo", info_of(&camera, stamped)),
        ("compressed.sensor_msgs.CompressedImage", compressed(stamped, &camera, &pixels)),
        ("cloud.sensor_msgs.PointCloud2", cloud(stamped, &camera, &pixels)),
        ("tf.tf2_msgs.TFMessage", write_transform(stamped, "camera", &pose, Vec::new())),
    ] {
        fs::write(playground.path(file), message).unwrap();
    }
    let mut script = Command::new(python);
    script.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/end_to_end/ros2_messages.py"));
    script.arg(concat!(env!("CARGO_MANIFEST_DIR"), "/ros")).arg(playground.path("."));
    let printed = Started::new(script).wait().expect_code(0).stdout;
    assert!(printed.contains("7 types, 25 messages"), "{printed}");
}

#[test]
fn the_example_is_valid_and_can_be_pointed_at_a_robot() {
    let playground = Playground::new();
    let example = concat!(env!("CARGO_MANIFEST_DIR"), "/examples/ros2.toml");
    let robot = r#"connect=["tcp/192.168.0.2:7447"]"#;
    let set = ["source", "ros"].map(|stage| format!("{stage}.{robot}"));
    playground.conicflow(&["validate", example, "--set", &set[0], "--set", &set[1]]).expect_code(0);
    let wrong =
        playground.conicflow(&["validate", example, "--set", "ros.connect=[]", "--set", "source.topic=\"a b\""]);
    let output = wrong.expect_code(2);
    let output = output.stdout + &output.stderr;
    assert!(output.contains("`connect`: is missing") && output.contains("`a b` is no name of a topic"), "{output}");
    let mut command = playground.command(&["validate", example]);
    let away = Started::new({
        command.env("CONICFLOW_BRIDGE", playground.path("no-such-program"));
        command
    });
    let output = away.wait().expect_code(2);
    assert!((output.stdout + &output.stderr).contains("no-such-program"));
}
