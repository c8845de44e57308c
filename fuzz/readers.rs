//! Bytes that others wrote, read as a pipeline reads them: messages from other machines and files. None may do harm, whatever
//! is in them. The fuzz targets call this, and so does the test that replays their corpora.

use anyhow::Result;
use conicflow_bridge::{NETWORK, decode_message, encode_message};
use conicflow_dataflow::pipeline::{Compression, Pipeline, SourceText};
use conicflow_dataflow::{AnyMessage, BUILT_IN, ItemType, Registry};
use conicflow_detection::camera::Intrinsics;
use conicflow_lab::score::{RecordedTolerances, RecordedTruth};
use conicflow_lab::simulator::scene::Scene;
use conicflow_lab::simulator::scene_values::{SceneTemplate, Values};
use conicflow_lab::simulator::{SimulatorParameters, SyntheticCamera};
use conicflow_messages::{Header, Layout, Object};
use conicflow_nodes::NODES;
use conicflow_nodes::sources::image_source::{self, Playback, PosesConfig, Recording};
use conicflow_nodes::sources::mcap_source::{Config, Replay};
use conicflow_ros::{CameraInfo, CompressedImage, Image, PointCloud, Transforms, Undecodable};
use std::fs;
use std::path::{Path, PathBuf};
use tempfile::TempDir;

/// One kind of bytes: its name, and what reads it; whether it was accepted.
pub type Reader = (&'static str, fn(&[u8]) -> bool);

/// All kinds of bytes, named as their corpora.
pub const READERS: [Reader; 13] = [
    ("wire", wire),
    ("pcd", pcd),
    ("png", png),
    ("tiff", tiff),
    ("npy", npy),
    ("camera", camera),
    ("list", list),
    ("poses", poses),
    ("mcap", mcap),
    ("ros", ros),
    ("truth", truth),
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
        // As text, in which what is not a number equals itself: a pose that the header does not say to be one may be anything.
        assert_eq!(format!("{:?}", decode_message(&again, item).unwrap()), format!("{:?}", (place, header, items)));
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

/// A file that tells the camera, beside a frame.
pub fn camera(bytes: &[u8]) -> bool {
    is_fine(played(&[("camera.json", bytes)], PosesConfig::None))
}

/// A list of frames, as in folders of TUM RGB-D.
pub fn list(bytes: &[u8]) -> bool {
    is_fine(played(&[("depth.txt", bytes)], PosesConfig::None))
}

/// Where the camera was in two frames.
pub fn poses(bytes: &[u8]) -> bool {
    let list = b"1.00 frame.png\n1.03 frame.png\n";
    is_fine(played(&[("depth.txt", list), ("frame.pose.txt", bytes)], PosesConfig::Path("frame.pose.txt".into())))
}

/// A recording, of which each depth image is read, and each list of objects that conicflow wrote.
pub fn mcap(bytes: &[u8]) -> bool {
    let objects = is_fine(replayed(bytes, &ItemType::of::<Object>()));
    is_fine(replayed(bytes, &ItemType::of::<u16>())) || objects
}

/// A message of ROS, as one of each kind that is read.
pub fn ros(bytes: &[u8]) -> bool {
    let transforms = || {
        let mut transforms = Transforms::default();
        transforms.add(bytes, false)?;
        let names = transforms.names();
        for (target, source) in names.iter().zip(names.iter().rev()) {
            _ = transforms.pose(target, source, 1);
        }
        Ok(())
    };
    let camera = || {
        let info = CameraInfo::read(bytes)?;
        _ = (info.is_calibrated(), info.fits((8, 6)), info.camera((8, 6), false), info.camera((8, 6), true));
        Ok(())
    };
    let cloud = || {
        let (cloud, camera) = (PointCloud::read(bytes)?, SimulatorParameters::default().camera());
        _ = (cloud.depths(), cloud.is_of(&camera));
        Ok(())
    };
    let outcomes: [Result<(), Undecodable>; 5] = [
        Image::read(bytes).and_then(|image| image.depths()).map(drop),
        CompressedImage::read(bytes).and_then(|image| image.depths()).map(drop),
        camera(),
        cloud(),
        transforms(),
    ];
    // What is told of those that are none has to be printable.
    outcomes.map(|outcome| outcome.map_err(|error| error.to_string()).is_ok()).contains(&true)
}

/// What is truly in recorded frames.
pub fn truth(bytes: &[u8]) -> bool {
    let load = |path: PathBuf| RecordedTruth::load(&path, &RecordedTolerances::default());
    is_fine(written("truth.json", bytes).and_then(load).map(drop))
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

/// Plays a folder that holds a frame and these files.
fn played(files: &[(&str, &[u8])], poses: PosesConfig) -> Result<()> {
    let folder = folder()?;
    for (name, bytes) in files.iter().chain([&("frame.png", include_bytes!("corpus/png/good").as_slice())]) {
        fs::write(folder.path().join(name), bytes)?;
    }
    let tells_camera = files.iter().any(|(name, _)| *name == "camera.json");
    let intrinsics = (!tells_camera).then_some(Intrinsics { fx: 50.0, fy: 50.0, cx: 3.0, cy: 2.0 });
    let path = Some(folder.path().to_owned());
    let config = image_source::Config { path, intrinsics, poses, ..image_source::Config::default() };
    let mut playback = Playback::open(&config, folder.path(), 0, 0)?;
    while let Some(loaded) = playback.load()? {
        playback.decode(&loaded, &mut vec![0; loaded.pixels()])?;
    }
    playback.finish()
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
        static FOLDER: TempDir = folder().unwrap();
    }
    let path = FOLDER.with(|folder| folder.path().join(name));
    fs::write(&path, bytes)?;
    Ok(path)
}

fn folder() -> Result<TempDir> {
    Ok(TempDir::new_in("/dev/shm").or_else(|_| TempDir::new())?)
}
