//! Files that others wrote, read as the stages of a pipeline read them: none may do harm, whatever is in it. The fuzz targets
//! call this, and so does the test that replays their corpora.

use anyhow::Result;
use conicflow_dataflow::pipeline::{Pipeline, SourceText};
use conicflow_messages::Header;
use conicflow_nodes::REGISTRY;
use conicflow_nodes::camera::Intrinsics;
use conicflow_nodes::image_source::{Options, Recording};
use conicflow_nodes::synthetic_source::scene::Scene;
use conicflow_nodes::synthetic_source::scene_values::{SceneTemplate, Values};
use conicflow_nodes::synthetic_source::{SyntheticCamera, SyntheticSourceConfig};
use std::fs;
use std::path::Path;
use tempfile::TempDir;

/// One kind of file: its name, and what reads it; whether it was accepted.
pub type Reader = (&'static str, fn(&[u8]) -> bool);

/// All kinds of files, named as their corpora.
pub const READERS: [Reader; 4] = [("pcd", pcd), ("png", png), ("scene", scene), ("pipeline", pipeline)];

/// A point cloud, as the only frame of a recording.
pub fn pcd(bytes: &[u8]) -> bool {
    is_fine(first_frame("cloud.pcd", bytes))
}

/// A depth image, as the only frame of a recording.
pub fn png(bytes: &[u8]) -> bool {
    is_fine(first_frame("depth.png", bytes))
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
    Pipeline::read(source, Path::new("/nowhere"), &[], &REGISTRY).map_err(|report| report.to_string()).is_ok()
}

/// Whether something went well. What is told of it otherwise has to be printable.
fn is_fine(outcome: Result<()>) -> bool {
    outcome.map_err(|error| format!("{error:#}")).is_ok()
}

fn render(scene: Scene) {
    let intrinsics = Some(Intrinsics { fx: 12.0, fy: 12.0, cx: 7.5, cy: 5.5 });
    let config = SyntheticSourceConfig { width: 16, height: 12, intrinsics, ..SyntheticSourceConfig::default() };
    let camera = config.camera();
    let mut camera = SyntheticCamera::new(scene, camera, config.noise, config.depth_scale, config.rate_hz, config.seed);
    for number in 0..2 {
        camera.shoot(number, &mut [0; 16 * 12]);
        camera.describe(&mut Header::default());
        camera.truth();
    }
}

/// Reads a recording of one frame. Fuzzers do it so often that the folder stays, and lies in memory where there is such.
fn first_frame(name: &str, bytes: &[u8]) -> Result<()> {
    thread_local! {
        static FOLDER: TempDir = TempDir::new_in("/dev/shm").or_else(|_| TempDir::new()).unwrap();
    }
    let path = FOLDER.with(|folder| folder.path().join(name));
    fs::write(&path, bytes)?;
    let intrinsics = Some(Intrinsics { fx: 50.0, fy: 50.0, cx: 3.0, cy: 2.0 });
    let mut recording = Recording::open(&path, &Options { intrinsics, ..Options::default() })?;
    recording.load(0)?;
    recording.decode(&mut vec![0; recording.pixels()])?;
    Ok(())
}
