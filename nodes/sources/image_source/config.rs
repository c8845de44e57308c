//! The parameters of `image_source`.

use crate::sources::WrittenIn;
use conicflow_dataflow::ConfigFault;
use conicflow_detection::camera::Intrinsics;
use conicflow_detection::noise::NoiseConfig;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Frame rate assumed for frames without time stamps when `rate_hz` is 0.
pub(crate) const USUAL_RATE_HZ: f64 = 30.0;

/// Parameters of `image_source`.
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// The recording: a folder of 16-bit PNGs, of TIFF or NPY files (16-bit whole numbers, floating point) or organised PCD
    /// files, a TUM RGB-D folder, or a single such file. Points of PCD and floating-point depths beyond 16.38 m are left out.
    pub path: Option<PathBuf>,
    /// Metres per unit of the file; default: as `camera.json` says, else 0.001, for TUM 0.0002, for PCD and
    /// floating point 1.
    #[schemars(range(min = 0.0))]
    pub depth_scale: Option<f64>,
    /// fx, fy, cx, cy in pixels; default: from a JSON file beside the frames, for PCD else fitted to the points.
    pub intrinsics: Option<Intrinsics>,
    /// Frames per second; 0: as fast as the pipeline takes them, stamped as at 30 Hz. Recorded time stamps are kept.
    #[schemars(range(min = 0.0))]
    pub rate_hz: f64,
    /// The camera's pose in each frame, for tracking in the world: `auto` (7-Scenes `*.pose.txt`, TUM `groundtruth.txt` or an
    /// Open3D trajectory `*.log` beside the frames or above them, else none), `none`, or the path of such a file or folder.
    pub poses: PosesConfig,
    /// Depth noise of the sensor: a name (`kinect_v1`, `realsense_d435`, `time_of_flight`, `ideal`) or a table.
    pub noise: NoiseConfig,
    /// Whether to start again at the end; stamps go on rising.
    #[serde(rename = "loop")]
    pub repeat: bool,
    /// Number of the first frame to send, counted from 0, unreadable ones included.
    pub first: u64,
    /// The most frames to send from there (in each round of a loop), unreadable ones included; default: all.
    #[schemars(range(min = 1))]
    pub frames: Option<u64>,
    /// Where these parameters were written, for the hints.
    #[serde(skip)]
    pub written_in: WrittenIn,
}

/// Choice of the poses in the pipeline file: `auto`, `none`, or a path.
#[derive(Clone, Debug, Default, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(from = "String", into = "String")]
#[schemars(with = "String")]
pub enum PosesConfig {
    /// The poses beside the frames, if there are any.
    #[default]
    Auto,
    /// No poses, even if there are some.
    None,
    /// The poses of a file, or of a folder with a file for each frame.
    Path(PathBuf),
}

impl From<String> for PosesConfig {
    fn from(text: String) -> Self {
        match text.as_str() {
            "auto" => Self::Auto,
            "none" => Self::None,
            _ => Self::Path(text.into()),
        }
    }
}

impl From<PosesConfig> for String {
    fn from(config: PosesConfig) -> Self {
        match config {
            PosesConfig::Auto => "auto".into(),
            PosesConfig::None => "none".into(),
            PosesConfig::Path(path) => path.to_string_lossy().into_owned(),
        }
    }
}

impl Default for Config {
    fn default() -> Self {
        Self {
            path: None,
            depth_scale: None,
            intrinsics: None,
            poses: PosesConfig::Auto,
            rate_hz: USUAL_RATE_HZ,
            noise: NoiseConfig::default(),
            repeat: false,
            first: 0,
            frames: None,
            written_in: WrittenIn::default(),
        }
    }
}

impl Config {
    /// Returns the faults that types and ranges do not exclude: values that contradict each other, missing files.
    pub fn faults(&self, base: &Path) -> Vec<ConfigFault> {
        let mut faults = Vec::new();
        match self.path.as_ref().map(|path| base.join(path)) {
            None => faults.push(ConfigFault::new("path", "is missing", "write `path = \"folder/\"`")),
            Some(path) => faults.extend(ConfigFault::of_missing("path", &path)),
        }
        if let PosesConfig::Path(path) = &self.poses {
            let hint = "`auto`, `none`, or a path that starts at the pipeline file's folder".to_owned();
            let missing = ConfigFault::of_missing("poses", &base.join(path));
            faults.extend(missing.map(|fault| ConfigFault { hint, ..fault }));
        }
        faults.extend(self.depth_scale.and_then(ConfigFault::of_depth_scale));
        faults.extend(self.intrinsics.and_then(|intrinsics| intrinsics.fault()));
        faults
    }
}
