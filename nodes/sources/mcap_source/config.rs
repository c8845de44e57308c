//! The parameters of `mcap_source`.

use super::channels::{Chosen, has_other_own};
use crate::recording::files::Files;
use crate::sources::WrittenIn;
use conicflow_dataflow::{ConfigFault, FileUse, ItemType};
use conicflow_detection::camera::Intrinsics;
use conicflow_detection::noise::NoiseConfig;
use conicflow_messages::Hinted;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// The item type of a source unless another one is asked for.
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
    /// The coordinate frame for the camera's pose, such as `map`, which is searched for in /tf and /tf_static; default: as
    /// recorded by conicflow, else none.
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
    /// End of the playback, in seconds from the beginning of the recording; default: its end.
    #[schemars(range(min = 0.0))]
    pub to_s: Option<f64>,
    /// Where these parameters were written, for the hints.
    #[serde(skip)]
    pub written_in: WrittenIn,
}

impl Config {
    /// Returns the faults that types and ranges do not exclude: values that contradict each other, missing files.
    pub fn faults(&self, base: &Path) -> Vec<ConfigFault> {
        let mut faults = Vec::new();
        match self.path.as_ref().map(|path| base.join(path)) {
            None => faults.push(ConfigFault::new("path", "is missing", "write `path = \"run.mcap\"`")),
            Some(path) => faults.extend(ConfigFault::of_missing("path", &path).or_else(|| self.unplayable(&path))),
        }
        faults.extend(self.depth_scale.and_then(ConfigFault::of_depth_scale));
        faults.extend(self.intrinsics.and_then(|intrinsics| intrinsics.fault()));
        if self.to_s.is_some_and(|to_s| to_s <= self.from_s) {
            let hint = "both count from the beginning of the recording";
            faults.push(ConfigFault::new("to_s", "is not after `from_s`", hint));
        }
        faults
    }

    /// Returns the files that are read, for the parameter `key`: those that exist, and in a folder also those that are added
    /// later.
    pub fn reads(&self, base: &Path, key: &'static str) -> Vec<FileUse> {
        let Some(path) = self.path.as_ref().map(|path| base.join(path)) else { return Vec::new() };
        let files = Files::find(&path).map(|files| files.paths().cloned().collect::<Vec<_>>()).unwrap_or_default();
        let those_that_come = path.is_dir().then(|| FileUse::ending(key, path, ".mcap"));
        files.into_iter().map(|file| FileUse::one(key, file)).chain(those_that_come).collect()
    }

    /// Whether only a part of the recording is played.
    pub(super) fn is_part(&self) -> bool {
        self.from_s > 0.0 || self.to_s.is_some()
    }

    /// Returns why the images of a recording cannot be played, if that is known without reading its files in full, and if it has
    /// nothing else that may be meant.
    fn unplayable(&self, path: &Path) -> Option<ConfigFault> {
        let files = Files::find(path).ok()?;
        let channels = files.survey_of_complete()?;
        if has_other_own(&channels, &DEPTH) {
            return None;
        }
        let error = Chosen::of(&files, &channels, self, &DEPTH).err()?;
        let hint = error.chain().find_map(|cause| cause.downcast_ref::<Hinted>())?;
        Some(ConfigFault::new("topic", &hint.what, &hint.hint))
    }
}
