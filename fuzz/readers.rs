//! Bytes that others wrote, read as a pipeline reads them: messages from other machines and files. None may do harm, whatever
//! is in them. The fuzz targets call this, and so does the test that replays their corpora.

use anyhow::Result;
use conicflow_bridge::{NETWORK, decode_message, encode_message};
use conicflow_dataflow::pipeline::{Compression, Pipeline, SourceText};
use conicflow_dataflow::{AnyMessage, BUILT_IN, ItemType, Registry};
use conicflow_detection::camera::Intrinsics;
use conicflow_lab::simulator::scene::Scene;
use conicflow_lab::simulator::scene_values::{SceneTemplate, Values};
use conicflow_lab::simulator::{SimulatorParameters, SyntheticCamera};
use conicflow_messages::{Header, Layout, Object};
use conicflow_nodes::NODES;
use conicflow_nodes::sources::image_source::{self, Recording};
use conicflow_nodes::sources::mcap_source::{Config, Replay};
use std::fs;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// One kind of bytes: its name, and what reads it; whether it was accepted.
pub type Reader = (&'static str, fn(&[u8]) -> bool);

/// All kinds of bytes, named as their corpora.
pub const READERS: [Reader; 8] = [
    ("wire", wire),
    ("pcd", pcd),
    ("png", png),
    ("tiff", tiff),
    ("npy", npy),
    ("mcap", mcap),
    ("scene", scene),
    ("pipeline", pipeline),
];

/// A type of one's own, as a pipeline file describes it.
pub fn grasps() -> ItemType {
    let fields = [("position", "f64[3]"), ("label", "text[12]"), ("width_m", "f32"), ("id", "u16"), ("tries", "i8[6]")];
    let fields = fields.map(|(name, kind)| (name.to_owned(), kind.to_owned()));
    ItemType::described("grasps", "acme.Grasp.v1", Layout::new(&fields).unwrap(), 16)
}

/// A message from another machine, as items of each type: what is accepted can be shown, and survives being sent on.
pub fn wire(bytes: &[u8]) -> bool {
    let accepts = |item: &ItemType| {
        let Ok((place, header, items)) = decode_message(bytes, item) else { return false };
        let message = AnyMessage { header: &header, item, bytes: &items };
        message.write_json(None, &mut Vec::new()).unwrap();
        let again = encode_message(place, item, &header, &items, Compression::Lz4).unwrap();
        assert_eq!(decode_message(&again, item), Ok((place, header, items)));
        true
    };
    BUILT_IN.iter().chain([&grasps()]).any(accepts)
}

/// A point cloud, as the only frame of a recording.
pub fn pcd(bytes: &[u8]) -> bool {
    is_fine(first_frame("cloud.pcd", bytes))
}

/// A depth image, as the only frame of a recording.
pub fn png(bytes: &[u8]) -> bool {
    is_fine(first_frame("depth.png", bytes))
}

/// The same as TIFF.
pub fn tiff(bytes: &[u8]) -> bool {
    is_fine(first_frame("depth.tiff", bytes))
}

/// The same as an array of NumPy.
pub fn npy(bytes: &[u8]) -> bool {
    is_fine(first_frame("depth.npy", bytes))
}

/// A recording, of which each depth image is read, and each list of objects that conicflow wrote.
pub fn mcap(bytes: &[u8]) -> bool {
    let objects = is_fine(replayed(bytes, &ItemType::of::<Object>()));
    is_fine(replayed(bytes, &ItemType::of::<u16>())) || objects
}

/// A scene, of which two small frames are rendered.
pub fn scene(bytes: &[u8]) -> bool {
    let template = SceneTemplate::new(String::from_utf8_lossy(bytes).into_owned(), "scene.toml".to_owned());
    is_fine(template.scene(&Values::new()).map(render))
}

/// A pipeline file.
pub fn pipeline(bytes: &[u8]) -> bool {
    let source = SourceText { name: "pipeline.toml".to_owned(), text: String::from_utf8_lossy(bytes).into_owned() };
    // What is told of it has to be printable as well.
    Pipeline::read(source, Path::new("/nowhere"), &[], &Registry { nodes: NODES, network: Some(NETWORK) })
        .map_err(|report| report.to_string())
        .is_ok()
}

/// Whether something went well. What is told of it otherwise has to be printable.
fn is_fine(outcome: Result<()>) -> bool {
    outcome.map_err(|error| format!("{error:#}")).is_ok()
}

fn render(scene: Scene) {
    let intrinsics = Some(Intrinsics { fx: 12.0, fy: 12.0, cx: 7.5, cy: 5.5 });
    let config = SimulatorParameters { width: 16, height: 12, intrinsics, ..SimulatorParameters::default() };
    let camera = config.camera();
    let mut camera = SyntheticCamera::new(scene, camera, config.noise, config.depth_scale, config.rate_hz, config.seed);
    for number in 0..2 {
        camera.shoot(number, &mut [0; 16 * 12]);
        camera.describe(&mut Header::default());
        camera.truth();
    }
}

/// Reads a recording of one frame.
fn first_frame(name: &str, bytes: &[u8]) -> Result<()> {
    let path = written(name, bytes)?;
    let intrinsics = Some(Intrinsics { fx: 50.0, fy: 50.0, cx: 3.0, cy: 2.0 });
    let mut recording =
        Recording::open(&path, &image_source::Config { intrinsics, ..image_source::Config::default() })?;
    recording.load(0)?;
    recording.decode(&mut vec![0; recording.pixels()])?;
    Ok(())
}

/// Replays all messages with such items.
fn replayed(bytes: &[u8], item: &ItemType) -> Result<()> {
    let config = Config { path: Some(written("run.mcap", bytes)?), ..Config::default() };
    let mut replay = Replay::open(&config, Path::new(""), item)?;
    while let Some(message) = replay.next_message()? {
        item.check(&message.header, &message.items)?;
    }
    Ok(())
}

/// Writes a file. Fuzzers do it so often that the folder stays, and lies in memory where there is such.
fn written(name: &str, bytes: &[u8]) -> Result<PathBuf> {
    thread_local! {
        static FOLDER: TempDir = TempDir::new_in("/dev/shm").or_else(|_| TempDir::new()).unwrap();
    }
    let path = FOLDER.with(|folder| folder.path().join(name));
    fs::write(&path, bytes)?;
    Ok(path)
}
