//! Measures the age of ROS 2 depth images, from the time at which a node of a robot sends an image until a stage has it, and
//! until its objects are found. For comparison it measures the age of the same bytes at a bare Zenoh subscriber.
//!
//! `cargo bench --bench ros2` runs a router and the node of the robot in this process, with 30 images per second. The images have
//! 640x480 pixels and show one cluttered scene. The node, the subscriber and the pipeline are clients of the router. Ages are in
//! milliseconds.

mod ages;

use ages::{Ages, Outcome, frame, percentiles, run_pipeline, start, written_in};
use conicflow_dataflow::{Node, Registry, lock, monotonic_ns, run_in_run};
use conicflow_messages::{Camera, Object};
use conicflow_nodes::detection::{ObjectAssembler, RowEllipseExtractor};
use conicflow_ros::{CameraInfo, Image, Stamped, write_units};
use std::net::TcpListener;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::thread::sleep;
use std::time::Duration;
use tempfile::TempDir;
use zenoh::{Session, Wait};

const PERIOD: Duration = Duration::from_millis(33);
const IMAGES: usize = 300;
const NODES: &[Node] = &[
    conicflow_bridge::NODES[0],
    Node::stage::<RowEllipseExtractor>(),
    Node::stage::<ObjectAssembler>(),
    Node::stage::<Ages<u16>>(),
    Node::stage::<Ages<Object>>(),
];
const REGISTRY: Registry = Registry { nodes: NODES, network: None };
const IMAGE_KEY: &str = "0/camera/depth/image_rect_raw/sensor_msgs::msg::dds_::Image_/RIHS01_0";
const INFO_KEY: &str = "0/camera/depth/camera_info/sensor_msgs::msg::dds_::CameraInfo_/RIHS01_0";
/// A stage that reads the images.
const TO_A_STAGE: &str = "[stage.ages]\nnode = \"frame_ages\"\ninput = \"depth\"\n";
const TO_OBJECTS: &str = "[stage.extractor]\nnode = \"row_ellipse_extractor\"\ninput = \"depth\"\noutput = \"ellipses\"\n\
                          [stage.assembler]\nnode = \"object_assembler\"\ninput = \"ellipses\"\noutput = \"objects\"\n\
                          [stage.ages]\nnode = \"object_ages\"\ninput = \"objects\"\n";

fn main() -> Outcome<()> {
    let arguments: Vec<String> = std::env::args().collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        [_, "node", _] => Ok(run_in_run(&REGISTRY)?),
        [_, "run", folder] => run_pipeline(Path::new(folder), None, IMAGES, &REGISTRY),
        _ => compare(),
    }
}

fn compare() -> Outcome<()> {
    let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
    let endpoint = format!("tcp/127.0.0.1:{port}");
    let _router = session("router", "listen", &endpoint)?;
    let robot = Robot::new(&endpoint)?;
    println!("{} images of {} bytes at 30 Hz; p50 / p99", IMAGES, robot.image(0).len());
    let show = |name: &str, [p50, p99]: [f64; 2]| println!("{name:<36}{p50:>8.2} / {p99:.2}");
    show("bare Zenoh subscriber", bare(&robot, &endpoint)?);
    show("stage that reads depth", through(&robot, &endpoint, TO_A_STAGE)?);
    show("objects", through(&robot, &endpoint, TO_OBJECTS)?);
    Ok(())
}

fn session(mode: &str, mode_key: &str, endpoint: &str) -> Outcome<Session> {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", format!("\"{mode}\"")),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("listen/endpoints", "[]".to_owned()),
        (&format!("{mode_key}/endpoints"), format!("[\"{endpoint}\"]")),
    ] {
        config.insert_json5(key, &value).map_err(|error| error.to_string())?;
    }
    Ok(zenoh::open(config).wait().map_err(|error| error.to_string())?)
}

/// A robot with a camera.
struct Robot {
    session: Session,
    camera: Camera,
    pixels: Vec<u16>,
}

impl Robot {
    fn new(endpoint: &str) -> Outcome<Self> {
        let (header, pixels) = frame()?;
        Ok(Self { session: session("client", "connect", endpoint)?, camera: header.camera, pixels })
    }

    fn image(&self, stamp_ns: u64) -> Vec<u8> {
        let size = (self.camera.width, self.camera.height);
        write_units(Stamped { stamp_ns, frame_id: "camera" }, size, &self.pixels, Vec::new())
    }

    /// Sends images with their stamps, and their CameraInfo, while `goes_on` returns true. Its argument is the number of images
    /// that were sent so far.
    fn send(&self, mut goes_on: impl FnMut(usize) -> bool) -> Outcome<()> {
        let zenoh = |error: zenoh::Error| error.to_string();
        let mut sent = 0;
        while goes_on(sent) {
            sleep(PERIOD);
            sent += 1;
            let info = CameraInfo::write(Stamped::default(), &self.camera, Vec::new());
            self.session.put(INFO_KEY, info).wait().map_err(zenoh)?;
            self.session.put(IMAGE_KEY, self.image(monotonic_ns())).wait().map_err(zenoh)?;
        }
        Ok(())
    }
}

/// Measures the ages of the images at a bare Zenoh subscriber.
fn bare(robot: &Robot, endpoint: &str) -> Outcome<[f64; 2]> {
    let there = session("client", "connect", endpoint)?;
    let ages = Arc::new(Mutex::new(Vec::new()));
    let received = Arc::clone(&ages);
    let hear = move |sample: zenoh::sample::Sample| {
        let bytes = sample.payload().to_bytes();
        let sent = Image::read(&bytes).map_or(0, |image| image.stamped.stamp_ns);
        lock(&received).push(monotonic_ns().saturating_sub(sent));
    };
    let _ears = there.declare_subscriber(IMAGE_KEY).callback(hear).wait().map_err(|error| error.to_string())?;
    robot.send(|number| number < IMAGES)?;
    sleep(PERIOD);
    percentiles(std::mem::take(&mut *lock(&ages)))
}

/// Measures the ages of the images, or of their objects, at the last stage of a pipeline.
fn through(robot: &Robot, endpoint: &str, stages: &str) -> Outcome<[f64; 2]> {
    let folder = TempDir::new()?;
    let text = format!(
        "name = \"bench\"\n[stage.source]\nnode = \"ros2_source\"\noutput = \"depth\"\n\
         topic = \"/camera/depth/image_rect_raw\"\nconnect = [\"{endpoint}\"]\n{stages}"
    );
    std::fs::write(folder.path().join("pipeline.toml"), text)?;
    let mut child = start(&["run"], folder.path(), "run")?;
    robot.send(|_| matches!(child.try_wait(), Ok(None)))?;
    child.wait()?.success().then_some(()).ok_or("the run failed")?;
    written_in(folder.path())
}
