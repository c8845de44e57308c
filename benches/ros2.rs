//! Age of a depth image of ROS 2, from when a robot's node has written it to when a stage has it, and to when its objects are
//! there, beside that of the same bytes at a bare Zenoh subscriber.
//!
//! `cargo bench --bench ros2`: a router and the node in this process, at 30 images of 640x480 of one cluttered scene a second;
//! milliseconds. All are clients of the router.

use bytemuck::cast_slice;
use conicflow_dataflow::pipeline::{Pipeline, SourceText};
use conicflow_dataflow::testing::collect;
use conicflow_dataflow::{
    Context, NoConfig, Node, Output, Plan, RUNTIME_DIR, Registry, RunOptions, SideInputs, Stage, StageError,
    monotonic_ns, run, run_in_run,
};
use conicflow_lab::simulator::SimulatorParameters;
use conicflow_messages::{Camera, Item, Message, Nothing, Object};
use conicflow_nodes::detection::{ObjectAssembler, RowEllipseExtractor};
use conicflow_nodes::sources::SyntheticSource;
use conicflow_ros::{CameraInfo, Image, Stamped, write_units};
use std::error::Error;
use std::marker::PhantomData;
use std::net::TcpListener;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::Command;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread::sleep;
use std::time::Duration;
use tempfile::TempDir;
use zenoh::{Session, Wait};

type Outcome<T> = Result<T, Box<dyn Error>>;

const PERIOD: Duration = Duration::from_millis(33);
const IMAGES: usize = 300;
/// The first images find caches and connections cold.
const WARM_UP: usize = 60;
const FOLDER: &str = "ROS2_BENCH_FOLDER";
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
/// What reads the images.
const TO_A_STAGE: &str = "[stage.ages]\nnode = \"frame_ages\"\ninput = \"depth\"\n";
const TO_OBJECTS: &str = "[stage.extractor]\nnode = \"row_ellipse_extractor\"\ninput = \"depth\"\noutput = \"ellipses\"\n\
                          [stage.assembler]\nnode = \"object_assembler\"\ninput = \"ellipses\"\noutput = \"objects\"\n\
                          [stage.ages]\nnode = \"object_ages\"\ninput = \"objects\"\n";

fn main() -> Outcome<()> {
    let arguments: Vec<String> = std::env::args().collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        [_, "node", _] => Ok(run_in_run(&REGISTRY)?),
        [_, "run", folder] => run_pipeline(Path::new(folder)),
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

fn session(mode: &str, way: &str, endpoint: &str) -> Outcome<Session> {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("mode", format!("\"{mode}\"")),
        ("scouting/multicast/enabled", "false".to_owned()),
        ("listen/endpoints", "[]".to_owned()),
        (&format!("{way}/endpoints"), format!("[\"{endpoint}\"]")),
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
        let config = SimulatorParameters { width: 640, height: 480, rate_hz: 0.0, ..SimulatorParameters::default() };
        let context = Context { stage: "source".to_owned(), ..Context::default() };
        let made = collect::<SyntheticSource>(config, context, 1)?.pop();
        let (header, pixels) = made.ok_or("the source made nothing")?;
        Ok(Self { session: session("client", "connect", endpoint)?, camera: header.camera, pixels })
    }

    fn image(&self, stamp_ns: u64) -> Vec<u8> {
        let size = (self.camera.width, self.camera.height);
        write_units(Stamped { stamp_ns, frame_id: "camera" }, size, &self.pixels, Vec::new())
    }

    /// Sends images with their stamps, and what tells their camera, as long as `goes_on`, which is told how many there were.
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

/// The times in milliseconds at a half and at 99 of 100.
fn percentiles(mut ages_ns: Vec<u64>) -> Outcome<[f64; 2]> {
    let mut ages_ns = ages_ns.split_off(WARM_UP.min(ages_ns.len()));
    ages_ns.sort_unstable();
    let last = ages_ns.len().checked_sub(1).ok_or("nothing arrived")?;
    Ok([0.5, 0.99].map(|share| ages_ns[(share * last as f64) as usize] as f64 * 1e-6))
}

/// Ages of the images where they are subscribed, and nothing else.
fn bare(robot: &Robot, endpoint: &str) -> Outcome<[f64; 2]> {
    let there = session("client", "connect", endpoint)?;
    let ages = Arc::new(Mutex::new(Vec::new()));
    let heard = Arc::clone(&ages);
    let hear = move |sample: zenoh::sample::Sample| {
        let bytes = sample.payload().to_bytes();
        let sent = Image::read(&bytes).map_or(0, |image| image.stamped.stamp_ns);
        heard.lock().unwrap_or_else(PoisonError::into_inner).push(monotonic_ns().saturating_sub(sent));
    };
    let _ears = there.declare_subscriber(IMAGE_KEY).callback(hear).wait().map_err(|error| error.to_string())?;
    robot.send(|number| number < IMAGES)?;
    sleep(PERIOD);
    percentiles(std::mem::take(&mut *ages.lock().unwrap_or_else(PoisonError::into_inner)))
}

/// Ages of the images, or of what is found in them, at a stage of a pipeline.
fn through(robot: &Robot, endpoint: &str, stages: &str) -> Outcome<[f64; 2]> {
    let folder = TempDir::new()?;
    let text = format!(
        "name = \"bench\"\n[stage.source]\nnode = \"ros2_source\"\noutput = \"depth\"\n\
         topic = \"/camera/depth/image_rect_raw\"\nconnect = [\"{endpoint}\"]\n{stages}"
    );
    std::fs::write(folder.path().join("pipeline.toml"), text)?;
    // Unix sockets lie there, and have to have short paths.
    let runtime = folder.path().join("r");
    std::fs::create_dir(&runtime)?;
    std::fs::set_permissions(&runtime, std::fs::Permissions::from_mode(0o700))?;
    let mut command = Command::new(std::env::current_exe()?);
    command.arg("run").arg(folder.path()).env(RUNTIME_DIR, runtime).env(FOLDER, folder.path());
    let mut child = command.spawn()?;
    robot.send(|_| matches!(child.try_wait(), Ok(None)))?;
    child.wait()?.success().then_some(()).ok_or("the run failed")?;
    let bytes = std::fs::read(folder.path().join("ages"))?;
    let ages = bytes.chunks_exact(8).map(|age| u64::from_ne_bytes(age.try_into().unwrap_or_default()));
    percentiles(ages.collect())
}

fn run_pipeline(folder: &Path) -> Outcome<()> {
    let text = std::fs::read_to_string(folder.join("pipeline.toml"))?;
    let source = SourceText { name: "pipeline.toml".to_owned(), text };
    let (pipeline, _) = Pipeline::read(source, folder, &[], &REGISTRY).map_err(|report| report.to_string())?;
    let plan = Plan::of(&pipeline, None, Some(IMAGES as u64), monotonic_ns());
    let options = RunOptions { program: std::env::current_exe()?, quiet: true, nodes: NODES, ..RunOptions::default() };
    if run(&plan, &options)?.is_complete() { Ok(()) } else { Err("the run was not finished".into()) }
}

/// Writes down how old messages are when they come.
struct Ages<T>(Vec<u64>, PhantomData<T>);

/// A kind of message, and the name of the sink that takes it.
trait Aged: Item {
    const SINK: &'static str;
}

impl Aged for u16 {
    const SINK: &'static str = "frame_ages";
}

impl Aged for Object {
    const SINK: &'static str = "object_ages";
}

impl<T: Aged> Stage for Ages<T> {
    const NAME: &'static str = T::SINK;
    const SUMMARY: &'static str = "Writes down how old messages are when they come";
    type Config = NoConfig;
    type Input = T;
    type Output = Nothing;

    fn new(_: NoConfig, _: &Context) -> Result<Self, StageError> {
        Ok(Self(Vec::new(), PhantomData))
    }

    fn step(&mut self, input: &Message<T>, _: &SideInputs, _: &mut Output<Nothing>) -> Result<(), StageError> {
        self.0.push(monotonic_ns().saturating_sub(input.header.stamp_ns));
        Ok(())
    }

    fn finish(&mut self) -> Result<(), StageError> {
        let folder = std::env::var(FOLDER)?;
        Ok(std::fs::write(Path::new(&folder).join("ages"), cast_slice(&self.0))?)
    }
}
