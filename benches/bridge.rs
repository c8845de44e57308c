//! Measures the age of messages that cross to another machine, from the time at which the writer sends a message until the reader
//! has it, and the age of the same bytes with Zenoh alone. Also measures the bytes on the wire and the CPU cost.
//!
//! `cargo bench --bench bridge` runs two launchers on this host, joined over loopback, at 30 messages per second, and then two
//! Zenoh sessions of one process. The messages are ellipses and frames of 640x480 of one cluttered scene. Ages are in
//! milliseconds, rates in megabytes per second, and the CPU cost is in per cent of a core for each of the two bridges.

mod ages;

use ages::{Ages, Outcome, frame, percentiles, run_pipeline, start, written_in};
use bytemuck::cast_slice;
use conicflow_bridge::{NETWORK, StreamPosition, encode_message};
use conicflow_dataflow::pipeline::Compression;
use conicflow_dataflow::{
    Context, ItemType, Next, NoConfig, Node, Output, Registry, SideInputs, Source, StageError, lock, monotonic_ns,
    observe, run_in_run,
};
use conicflow_detection::{Extractor, ExtractorParameters};
use conicflow_messages::{Ellipse, Header, Item};
use std::net::TcpListener;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::thread::sleep;
use std::time::Duration;
use tempfile::TempDir;
use zenoh::Wait;
use zenoh::qos::CongestionControl;

const RATE_HZ: f64 = 30.0;
const MESSAGES: usize = 450;
/// Time from the start of a machine until the measurement of the cost of its bridge, which then takes [`OBSERVED`].
const SETTLED: Duration = Duration::from_secs(4);
const OBSERVED: Duration = Duration::from_secs(8);
const NODES: &[Node] =
    &[Node::source::<Frames>(), Node::source::<Lists>(), Node::stage::<Ages<u16>>(), Node::stage::<Ages<Ellipse>>()];
const REGISTRY: Registry = Registry { nodes: NODES, network: Some(NETWORK) };
/// Name, source, sink and compression of each case.
const CASES: [(&str, &str, &str, Compression); 6] = [
    ("ellipses, none", "lists", "list_ages", Compression::None),
    ("ellipses, lz4", "lists", "list_ages", Compression::Lz4),
    ("ellipses, zstd", "lists", "list_ages", Compression::Zstd),
    ("frames, none", "frames", "frame_ages", Compression::None),
    ("frames, lz4", "frames", "frame_ages", Compression::Lz4),
    ("frames, zstd", "frames", "frame_ages", Compression::Zstd),
];

fn main() -> Outcome<()> {
    let arguments: Vec<String> = std::env::args().collect();
    match arguments.iter().map(String::as_str).collect::<Vec<_>>()[..] {
        [_, "node", _] => Ok(run_in_run(&REGISTRY)?),
        [_, "machine", name, folder] => machine(name, Path::new(folder)),
        _ => compare(),
    }
}

fn compare() -> Outcome<()> {
    let (header, pixels) = frame()?;
    let ellipses = found(&header, &pixels);
    println!("{} messages at {RATE_HZ} Hz; a list has {} ellipses", MESSAGES, ellipses.len());
    println!(
        "{:<16}{:>9}{:>9}{:>7}{:>18}{:>18}{:>16}",
        "", "bytes", "wire", "MB/s", "bridge p50/p99", "Zenoh p50/p99", "CPU out/in"
    );
    for (name, source, sink, how) in CASES {
        let (bytes, wire) = match source {
            "lists" => (size_of_val(&*ellipses), encoded(&header, &ellipses, how)?),
            _ => (size_of_val(&*pixels), encoded(&header, &pixels, how)?),
        };
        let (bridged, costs) = bridged(source, sink, how)?;
        let bare = bare(&wire)?;
        let rate = wire.len() as f64 * RATE_HZ / 1e6;
        let pair = |[p50, p99]: [f64; 2]| format!("{p50:.2} / {p99:.2}");
        let costs = format!("{:.1} / {:.1}", costs[0], costs[1]);
        println!("{name:<16}{bytes:>9}{:>9}{rate:>7.2}{:>18}{:>18}{costs:>16}", wire.len(), pair(bridged), pair(bare));
    }
    Ok(())
}

/// The ellipses of a frame.
fn found(header: &Header, pixels: &[u16]) -> Vec<Ellipse> {
    Extractor::new(ExtractorParameters::default()).extract(header, pixels).to_vec()
}

fn encoded<T: Item>(header: &Header, items: &[T], how: Compression) -> Outcome<Vec<u8>> {
    Ok(encode_message(StreamPosition::default(), &ItemType::of::<T>(), header, cast_slice(items), how)?)
}

/// Sends the same frame repeatedly, stamped when it is sent.
struct Frames(Header, Vec<u16>);

impl Source for Frames {
    const NAME: &'static str = "frames";
    const SUMMARY: &'static str = "The same frame again and again";
    type Config = NoConfig;
    type Output = u16;

    fn new(_: NoConfig, _: &Context) -> Result<Self, StageError> {
        let (header, pixels) = frame().map_err(|error| error.to_string())?;
        Ok(Self(header, pixels))
    }

    fn rate_hz(&self) -> f64 {
        RATE_HZ
    }

    fn next(&mut self, _: &SideInputs, output: &mut Output<u16>) -> Result<Next, StageError> {
        output.loan(self.1.len())?.copy_from_slice(&self.1);
        output.header = Header { stamp_ns: monotonic_ns(), ..with_own_sequence(&self.0, &output.header) };
        Ok(Next::Message)
    }
}

/// Sends the ellipses of the same frame repeatedly.
struct Lists(Header, Vec<Ellipse>);

impl Source for Lists {
    const NAME: &'static str = "lists";
    const SUMMARY: &'static str = "The same ellipses again and again";
    type Config = NoConfig;
    type Output = Ellipse;

    fn new(_: NoConfig, _: &Context) -> Result<Self, StageError> {
        let (header, pixels) = frame().map_err(|error| error.to_string())?;
        let ellipses = found(&header, &pixels);
        Ok(Self(header, ellipses))
    }

    fn rate_hz(&self) -> f64 {
        RATE_HZ
    }

    fn next(&mut self, _: &SideInputs, output: &mut Output<Ellipse>) -> Result<Next, StageError> {
        self.1.iter().for_each(|ellipse| output.push(*ellipse));
        output.header = Header { stamp_ns: monotonic_ns(), ..with_own_sequence(&self.0, &output.header) };
        Ok(Next::Message)
    }
}

/// A header with the camera, depth scale, noise and source of `made`, and the other fields of `own`.
fn with_own_sequence(made: &Header, own: &Header) -> Header {
    Header { camera: made.camera, depth_scale: made.depth_scale, noise: made.noise, source: made.source, ..*own }
}

/// Measures the ages of messages between two launchers, and the cost of their bridges.
fn bridged(source: &str, sink: &str, how: Compression) -> Outcome<([f64; 2], [f64; 2])> {
    let folder = TempDir::new()?;
    let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
    let compression = match how {
        Compression::None => "none",
        Compression::Lz4 => "lz4",
        Compression::Zstd => "zstd",
    };
    let text = format!(
        "name = \"bench\"\n[machine.robot]\nlisten = [\"tcp/127.0.0.1:{port}\"]\n[machine.base]\n\
         connect = [\"tcp/127.0.0.1:{port}\"]\n[stage.source]\nnode = \"{source}\"\nmachine = \"robot\"\n\
         output = \"topic\"\n[stage.sink]\nnode = \"{sink}\"\nmachine = \"base\"\n\
         input = {{ topic = \"topic\", compression = \"{compression}\" }}\n"
    );
    std::fs::write(folder.path().join("pipeline.toml"), text)?;
    let machines = ["robot", "base"].map(|name| start(&["machine", name], folder.path(), name));
    for machine in machines {
        let ended = machine?.wait()?;
        ended.success().then_some(()).ok_or("a machine failed")?;
    }
    let cost = |name: &str| -> Outcome<f64> { Ok(std::fs::read_to_string(folder.path().join(name))?.parse()?) };
    Ok((written_in(folder.path())?, [cost("robot.cpu")?, cost("base.cpu")?]))
}

/// Runs one machine of the pipeline, and measures the cost of its bridge.
fn machine(name: &str, folder: &Path) -> Outcome<()> {
    let cost_file = folder.join(format!("{name}.cpu"));
    let looking = std::thread::spawn(move || std::fs::write(cost_file, bridge_cpu().unwrap_or(f64::NAN).to_string()));
    run_pipeline(folder, Some(name), MESSAGES, &REGISTRY)?;
    Ok(looking.join().map_err(|_| "the observer panicked")??)
}

fn bridge_cpu() -> Option<f64> {
    sleep(SETTLED);
    let before = observe().ok()?;
    sleep(OBSERVED);
    let activity = observe().ok()?.since(&before);
    activity
        .iter()
        .flat_map(|pipeline| &pipeline.stages)
        .find(|stage| stage.stage == "bridge")
        .map(|stage| stage.cpu_percent)
}

fn session(listen: &str, connect: &str) -> Outcome<zenoh::Session> {
    let mut config = zenoh::Config::default();
    for (key, value) in [
        ("scouting/multicast/enabled", "false"),
        ("listen/endpoints", listen),
        ("connect/endpoints", connect),
        ("transport/link/tx/queue/congestion_control/drop/max_wait_before_drop_fragments", "1000000"),
    ] {
        config.insert_json5(key, value).map_err(|error| error.to_string())?;
    }
    Ok(zenoh::open(config).wait().map_err(|error| error.to_string())?)
}

/// Measures the ages of the same bytes with Zenoh alone, from a publisher to a subscriber.
fn bare(wire: &[u8]) -> Outcome<[f64; 2]> {
    let port = TcpListener::bind("127.0.0.1:0")?.local_addr()?.port();
    let endpoint = format!("[\"tcp/127.0.0.1:{port}\"]");
    let (here, there) = (session(&endpoint, "[]")?, session("[]", &endpoint)?);
    let ages = Arc::new(Mutex::new(Vec::new()));
    let received = Arc::clone(&ages);
    let hear = move |sample: zenoh::sample::Sample| {
        let bytes = sample.payload().to_bytes();
        let sent = bytes.get(..8).and_then(|sent| sent.try_into().ok()).map_or(0, u64::from_ne_bytes);
        lock(&received).push(monotonic_ns().saturating_sub(sent));
    };
    let zenoh = |error: zenoh::Error| error.to_string();
    let _ears = there.declare_subscriber("bench").callback(hear).wait().map_err(zenoh)?;
    let publisher = here.declare_publisher("bench").congestion_control(CongestionControl::Drop).express(true);
    let publisher = publisher.wait().map_err(zenoh)?;
    while !publisher.matching_status().wait().map_err(zenoh)?.matching() {
        sleep(Duration::from_millis(10));
    }
    for _ in 0..MESSAGES {
        sleep(Duration::from_secs_f64(1.0 / RATE_HZ));
        let sent = monotonic_ns();
        publisher.put([&sent.to_ne_bytes(), wire].concat()).wait().map_err(zenoh)?;
    }
    sleep(Duration::from_millis(200));
    percentiles(std::mem::take(&mut *lock(&ages)))
}
