//! A robot with ROS 2, implemented with [hiroz](https://github.com/ZettaScaleLabs/hiroz): a node that publishes depth images of a
//! ball, and subscribes to the detections and markers that `ros2_sink` sends back. It communicates with hiroz alone,
//! independently of our code.
//!
//! ```console
//! $ cargo build --release
//! $ cargo run --manifest-path ros2/hiroz/Cargo.toml -- target/release/conicflow
//! ```
//!
//! starts a router and `examples/ros2.toml`, and exits with an error unless 60 images were received, tracks came back for most of
//! them, and the robot sees our nodes and topics.

use anyhow::{Context as _, Result, ensure};
use conicflow_messages::Camera;
use conicflow_ros::{CameraInfo, Stamped, write_units};
use hiroz::Builder;
use hiroz::context::ZContextBuilder;
use std::path::Path;
use std::process::{Child, Command};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};
use zenoh::Wait;

/// The number of images that the run takes.
const FRAMES: usize = 60;
const PERIOD: Duration = Duration::from_millis(33);
const PATIENCE: Duration = Duration::from_secs(60);
const CAMERA: Camera = Camera { width: 320, height: 240, fx: 262.5, fy: 262.5, cx: 159.5, cy: 119.5 };

/// Topic, type and type hash of what the robot sends.
const SENT: [[&str; 3]; 2] = [
    [
        "/camera/depth/image_rect_raw",
        "sensor_msgs::msg::dds_::Image_",
        "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
    ],
    [
        "/camera/depth/camera_info",
        "sensor_msgs::msg::dds_::CameraInfo_",
        "RIHS01_b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275",
    ],
];
/// Topic, type and type hash of what the robot subscribes to.
const HEARD: [[&str; 3]; 2] = [
    [
        "/conicflow/tracks",
        "vision_msgs::msg::dds_::Detection3DArray_",
        "RIHS01_793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018",
    ],
    [
        "/conicflow/tracks/markers",
        "visualization_msgs::msg::dds_::MarkerArray_",
        "RIHS01_86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf",
    ],
];

/// Depths in millimetres of a ball of radius 0.1 m at one metre, in front of a wall at two metres.
fn ball() -> Vec<u16> {
    let depth = |index: u32| {
        let (x, y) = (
            (f64::from(index % CAMERA.width) - CAMERA.cx) / CAMERA.fx,
            (f64::from(index / CAMERA.width) - CAMERA.cy) / CAMERA.fy,
        );
        // |z (x, y, 1) - (0, 0, 1)| = 0.1
        let (a, c) = (x * x + y * y + 1.0, 1.0 - 0.1 * 0.1);
        let root = 1.0 - a * c;
        let z = if root > 0.0 { (1.0 - root.sqrt()) / a } else { 2.0 };
        (z * 1000.0).round() as u16
    };
    (0..CAMERA.width * CAMERA.height).map(depth).collect()
}

fn router() -> Result<(zenoh::Session, String)> {
    let port = std::net::TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
    let endpoint = format!("tcp/127.0.0.1:{port}");
    let mut config = zenoh::Config::default();
    let listen = format!("[\"{endpoint}\"]");
    for (key, value) in [("mode", "\"router\""), ("listen/endpoints", &listen), ("scouting/multicast/enabled", "false")]
    {
        config.insert_json5(key, value).map_err(anyhow::Error::msg)?;
    }
    Ok((zenoh::open(config).wait().map_err(anyhow::Error::msg)?, endpoint))
}

/// Starts the pipeline; it ends after its number of images.
fn start(program: &str, endpoint: &str) -> Result<Child> {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("../../examples/ros2.toml");
    let connect = |stage: &str| format!("{stage}.connect=[\"{endpoint}\"]");
    let arguments = ["--frames", &FRAMES.to_string(), "--set", &connect("source"), "--set", &connect("ros")];
    let run = Command::new(program).arg("run").arg(file).args(arguments).spawn();
    run.with_context(|| program.to_owned())
}

fn main() -> Result<()> {
    let program = std::env::args().nth(1).context("which program? target/release/conicflow")?;
    let (_router, endpoint) = router()?;
    let context = ZContextBuilder::default().with_mode("client").disable_multicast_scouting();
    let context = context.with_connect_endpoints([endpoint.clone()]).build().map_err(anyhow::Error::msg)?;
    let node = context.create_node("robot").build().map_err(anyhow::Error::msg)?;
    let publisher =
        |[topic, kind, hash]: [&str; 3]| node.create_raw_publisher(topic, kind, hash).map_err(anyhow::Error::msg);
    let (images, infos) = (publisher(SENT[0])?, publisher(SENT[1])?);
    let counts = [(); 2].map(|()| Arc::new(AtomicUsize::new(0)));
    let mut subscribers = Vec::new();
    for ([topic, kind, hash], count) in HEARD.into_iter().zip(&counts) {
        let count = Arc::clone(count);
        // An empty list consists of little more than its header.
        let hear = move |message: &[u8]| {
            count.fetch_add(usize::from(message.len() > 100), Ordering::Relaxed);
        };
        subscribers.push(node.create_raw_subscriber(topic, kind, hash, hear).map_err(anyhow::Error::msg)?);
    }

    let mut run = start(&program, &endpoint)?;
    let (pixels, since) = (ball(), Instant::now());
    let (mut sent, mut nodes, mut topics) = (0_u64, Vec::new(), Vec::new());
    let status = loop {
        let stamp_ns = 1_700_000_000_000_000_000 + 33_000_000 * sent;
        let stamped = Stamped { stamp_ns, frame_id: "camera_depth_optical_frame" };
        infos.publish_bytes(&CameraInfo::write(stamped, &CAMERA, Vec::new())).map_err(anyhow::Error::msg)?;
        let image = write_units(stamped, (CAMERA.width, CAMERA.height), &pixels, Vec::new());
        images.publish_bytes(&image).map_err(anyhow::Error::msg)?;
        sent += 1;
        if counts[0].load(Ordering::Relaxed) >= FRAMES / 2 && nodes.is_empty() {
            nodes = node.graph().get_node_names();
            topics = node.graph().get_topic_names_and_types();
        }
        if let Some(status) = run.try_wait()? {
            break status;
        }
        if since.elapsed() > PATIENCE {
            run.kill()?;
        }
        sleep(PERIOD);
    };
    let received = counts.map(|count| count.load(Ordering::Relaxed));
    println!("sent {sent} images; heard {received:?} lists of detections and markers that are not empty");
    println!("nodes {nodes:?}\ntopics {topics:?}");
    ensure!(status.success(), "the run ended with {status}");
    ensure!(received.iter().all(|received| *received > FRAMES / 2), "fewer lists came back than half of the images");
    for name in ["conicflow_source", "conicflow_ros"] {
        ensure!(nodes.iter().any(|(node, _)| node == name), "the robot does not see `{name}`");
    }
    for [topic, ..] in HEARD {
        ensure!(topics.iter().any(|(name, _)| name == topic), "the robot does not see `{topic}`");
    }
    Ok(())
}
