//! Files that others wrote, read as a pipeline reads them: none may do harm, whatever is in it. The fuzz targets call this,
//! and so does the test that replays their corpora.

use conicflow_dataflow::pipeline::{Pipeline, SourceText};
use conicflow_dataflow::testing::collect;
use conicflow_dataflow::{Context, Source};
use conicflow_nodes::NODES;
use conicflow_nodes::image_source::ImageSource;
use conicflow_nodes::synthetic_source::SyntheticSource;
use serde_json::{Value, json};
use std::fs;
use std::path::Path;
use tempfile::TempDir;

/// One kind of file: its name, and what reads it; whether it was accepted.
pub type Reader = (&'static str, fn(&[u8]) -> bool);

/// All kinds of files, named as their corpora.
pub const READERS: [Reader; 4] = [("pcd", pcd), ("png", png), ("scene", scene), ("pipeline", pipeline)];

/// A point cloud, as the only frame of a recording.
pub fn pcd(bytes: &[u8]) -> bool {
    image("cloud.pcd", bytes)
}

/// A depth image, as the only frame of a recording.
pub fn png(bytes: &[u8]) -> bool {
    image("depth.png", bytes)
}

/// A scene, of which two small frames are rendered.
pub fn scene(bytes: &[u8]) -> bool {
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join("scene.toml"), bytes).unwrap();
    let intrinsics = json!({ "fx": 12, "fy": 12, "cx": 7.5, "cy": 5.5 });
    let config = json!({ "scene": "scene.toml", "width": 16, "height": 12, "intrinsics": intrinsics, "rate_hz": 0 });
    first_frames::<SyntheticSource>(config, folder.path(), 2)
}

/// A pipeline file.
pub fn pipeline(bytes: &[u8]) -> bool {
    let source = SourceText { name: "pipeline.toml".to_owned(), text: String::from_utf8_lossy(bytes).into_owned() };
    // What is told of it has to be printable as well.
    Pipeline::read(source, Path::new("/nowhere"), &[], NODES).map_err(|report| report.to_string()).is_ok()
}

fn image(name: &str, bytes: &[u8]) -> bool {
    let folder = TempDir::new().unwrap();
    fs::write(folder.path().join(name), bytes).unwrap();
    let intrinsics = json!({ "fx": 50, "fy": 50, "cx": 3, "cy": 2 });
    first_frames::<ImageSource>(json!({ "path": name, "intrinsics": intrinsics, "rate_hz": 0 }), folder.path(), 1)
}

/// Whether a source with this configuration makes its first frames.
fn first_frames<S: Source>(config: Value, folder: &Path, frames: u64) -> bool
where
    S::Config: Send,
{
    let config = serde_json::from_value(config).unwrap();
    let context = Context { stage: "source".to_owned(), base: folder.to_owned(), ..Context::default() };
    collect::<S>(config, context, frames).map_err(|error| error.to_string()).is_ok()
}
