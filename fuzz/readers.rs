//! Functions that read bytes of other programs (messages from other machines, and files) as a pipeline reads them. No bytes may
//! cause a panic or other harm. The fuzz targets call these functions, and so does the test that replays their corpora.

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

/// The name of a kind of bytes, and the function that reads such bytes and returns whether it accepts them.
pub type Reader = (&'static str, fn(&[u8]) -> bool);

/// The readers of all kinds of bytes. A kind has the name of its corpus.
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

/// An item type of a user, as a pipeline file describes it.
pub fn grasps() -> ItemType {
    let fields = [("position", "f64[3]"), ("label", "text[12]"), ("width_m", "f32"), ("id", "u16"), ("tries", "i8[6]")];
    let fields = fields.map(|(name, kind)| (name.to_owned(), kind.to_owned()));
    ItemType::described("grasps", "acme.Grasp.v1", Layout::new(&fields).unwrap(), 16)
}

/// Reads a message from another machine as items of each type. An accepted message can be written as JSON, and does not change
/// when it is encoded and decoded again.
pub fn wire(bytes: &[u8]) -> bool {
    let accepts = |item: &ItemType| {
        let Ok((place, header, items)) = decode_message(bytes, item) else { return false };
        let message = AnyMessage { header: &header, item, bytes: &items };
        message.write_json(None, &mut Vec::new()).unwrap();
        let again = encode_message(place, item, &header, &items, Compression::Lz4).unwrap();
        // The messages are compared as text, in which NaN equals NaN: if the header does not have a pose, the bytes of the pose
        // may have any values.
        assert_eq!(format!("{:?}", decode_message(&again, item).unwrap()), format!("{:?}", (place, header, items)));
        true
    };
    BUILT_IN.iter().chain([&grasps()]).any(accepts)
}

/// Reads a point cloud as the only frame of a recording.
pub fn pcd(bytes: &[u8]) -> bool {
    is_fine(first_frame("cloud.pcd", bytes))
}

/// Reads a PNG as the only frame of a recording.
pub fn png(bytes: &[u8]) -> bool {
    is_fine(first_frame("depth.png", bytes))
}

/// Reads a TIFF file as the only frame of a recording.
pub fn tiff(bytes: &[u8]) -> bool {
    is_fine(first_frame("depth.tiff", bytes))
}

/// Reads an array of NumPy as the only frame of a recording.
pub fn npy(bytes: &[u8]) -> bool {
    is_fine(first_frame("depth.npy", bytes))
}

/// Reads a file with the camera parameters, which lies beside a frame.
pub fn camera(bytes: &[u8]) -> bool {
    is_fine(played(&[("camera.json", bytes)], PosesConfig::None))
}

/// Reads a list of frames, as in folders of TUM RGB-D.
pub fn list(bytes: &[u8]) -> bool {
    is_fine(played(&[("depth.txt", bytes)], PosesConfig::None))
}

/// Reads the poses of the camera in two frames.
pub fn poses(bytes: &[u8]) -> bool {
    let list = b"1.00 frame.png\n1.03 frame.png\n";
    is_fine(played(&[("depth.txt", list), ("frame.pose.txt", bytes)], PosesConfig::Path("frame.pose.txt".into())))
}

/// Reads the depth images of a recording, and the lists of objects that conicflow wrote.
pub fn mcap(bytes: &[u8]) -> bool {
    let objects = is_fine(replayed(bytes, &ItemType::of::<Object>()));
    is_fine(replayed(bytes, &ItemType::of::<u16>())) || objects
}

/// Reads a message of ROS as each of the kinds of messages that conicflow reads.
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
    // All errors are converted to text, because this must not fail either.
    outcomes.map(|outcome| outcome.map_err(|error| error.to_string()).is_ok()).contains(&true)
}

/// Reads the true objects of recorded frames.
pub fn truth(bytes: &[u8]) -> bool {
    let load = |path: PathBuf| RecordedTruth::load(&path, &RecordedTolerances::default());
    is_fine(written("truth.json", bytes).and_then(load).map(drop))
}

/// Reads a scene, and renders two small frames of it.
pub fn scene(bytes: &[u8]) -> bool {
    let template = SceneTemplate::new(String::from_utf8_lossy(bytes).into_owned(), "scene.toml".to_owned());
    is_fine(template.scene(&Values::new()).map(render))
}

/// Reads a pipeline file.
pub fn pipeline(bytes: &[u8]) -> bool {
    let source = SourceText { name: "pipeline.toml".to_owned(), text: String::from_utf8_lossy(bytes).into_owned() };
    // The report is converted to text, because this must not fail either.
    Pipeline::read(source, Path::new("/nowhere"), &[], &Registry { nodes: NODES, network: Some(NETWORK) })
        .map_err(|report| report.to_string())
        .is_ok()
}

/// Whether an outcome is no error. An error is converted to text, because this must not fail either.
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

/// Plays a folder that contains a frame and these files.
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

/// Replays all messages of a recording that have items of this type.
fn replayed(bytes: &[u8], item: &ItemType) -> Result<()> {
    let config = Config { path: Some(written("run.mcap", bytes)?), ..Config::default() };
    let mut replay = Replay::open(&config, Path::new(""), item)?;
    while let Some(message) = replay.next_message()? {
        item.check(&message.header, &message.items)?;
    }
    Ok(())
}

/// Writes a file, and returns its path. Fuzzers call this so often that all files go to the same folder, which lies in memory
/// where possible.
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
