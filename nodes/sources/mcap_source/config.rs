//! The parameters of `mcap_source`.

use super::channels::{Chosen, has_other_own};
use crate::recording::files::Files;
use crate::sources::WrittenIn;
use conicflow_dataflow::{ConfigFault, ItemType};
use conicflow_detection::camera::Intrinsics;
use conicflow_detection::noise::NoiseConfig;
use conicflow_messages::{DEPTH_SCALES_M, Hinted};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// What a source sends where nothing else is asked for.
pub(super) const DEPTH: ItemType = ItemType::of::<u16>();

/// Parameters of `mcap_source`.
#[derive(Clone, Debug, Default, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// The recording: an MCAP file, or a folder of them.
    pub path: Option<PathBuf>,
    /// The topic to play back, in the recording; default: the only one that fits.
    pub topic: Option<String>,
    /// Metres per unit of depth; default: as recorded by conicflow, else 0.001, for depths in single precision 1.
    #[schemars(range(min = 0.0))]
    pub depth_scale: Option<f64>,
    /// fx, fy, cx, cy in pixels; default: those of the CameraInfo beside the images.
    pub intrinsics: Option<Intrinsics>,
    /// Depth noise of the sensor: a name (`kinect_v1`, `realsense_d435`, `time_of_flight`, `ideal`) or a table; default: as
    /// recorded by conicflow, else `kinect_v1`.
    pub noise: Option<NoiseConfig>,
    /// The frame of coordinates in which the camera's pose is wanted, such as `map`: looked for in /tf and /tf_static; default:
    /// as recorded by conicflow, else none.
    pub world: Option<String>,
    /// Messages per second; 0: as fast as the pipeline takes them; default: as recorded.
    #[schemars(range(min = 0.0))]
    pub rate_hz: Option<f64>,
    /// Whether to start again at the end; stamps and numbers go on rising.
    #[serde(rename = "loop")]
    pub repeat: bool,
    /// Seconds of the recording to leave out at its beginning.
    #[schemars(range(min = 0.0))]
    pub from_s: f64,
    /// Where to end, in seconds from the beginning of the recording; default: at its end.
    #[schemars(range(min = 0.0))]
    pub to_s: Option<f64>,
    /// Where these parameters are written.
    #[serde(skip)]
    pub written_in: WrittenIn,
}

impl Config {
    /// What types and ranges cannot tell: values that exclude each other, files that are missing.
    pub fn faults(&self, base: &Path) -> Vec<ConfigFault> {
        let fault = |key, what: &str, hint: &str| ConfigFault { key, what: what.to_owned(), hint: hint.to_owned() };
        let mut faults = Vec::new();
        match self.path.as_ref().map(|path| base.join(path)) {
            None => faults.push(fault("path", "is missing", "write `path = \"run.mcap\"`")),
            Some(path) if !path.exists() => {
                let what = format!("`{}` does not exist", path.display());
                faults.push(fault("path", &what, "relative paths start at the pipeline file's folder"));
            }
            Some(path) => faults.extend(self.unplayable(&path)),
        }
        if self.depth_scale.is_some_and(|scale| !DEPTH_SCALES_M.contains(&scale)) {
            faults.push(fault("depth_scale", "is not above 0 and at most 1", "0.001 for millimetres"));
        }
        if self.intrinsics.is_some_and(|intrinsics| !intrinsics.are_usable()) {
            let what = "need fx and fy of 1 to 1,000,000 pixels, and no larger cx and cy";
            faults.push(fault("intrinsics", what, "take them from the camera's calibration"));
        }
        if self.to_s.is_some_and(|to_s| to_s <= self.from_s) {
            faults.push(fault("to_s", "is not after `from_s`", "both count from the beginning of the recording"));
        }
        faults
    }

    /// Why the images of a recording cannot be played, as far as that is known at once: where its files tell what they have, and
    /// nothing but images can be meant.
    fn unplayable(&self, path: &Path) -> Option<ConfigFault> {
        let channels = Files::find(path).ok()?.survey_of_complete()?;
        if has_other_own(&channels, &DEPTH) {
            return None;
        }
        let error = Chosen::of(&channels, self, &DEPTH).err()?;
        let hint = error.chain().find_map(|cause| cause.downcast_ref::<Hinted>())?;
        Some(ConfigFault { key: "topic", what: hint.what.clone(), hint: hint.hint.clone() })
    }
}
