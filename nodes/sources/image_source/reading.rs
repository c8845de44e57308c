//! Lists the files that are read: the frames, and those with their camera and its poses.

use super::config::Config;
use super::intrinsics::CameraFile;
use super::layout::{Format, Layout};
use super::{poses, tum};
use conicflow_dataflow::FileUse;
use std::path::Path;

/// Returns the files that are read according to `config`, for the parameters with the keys `path` and `poses`. Missing frames are
/// reported when the recording is opened.
pub(crate) fn files(config: &Config, base: &Path, path: &'static str, poses: &'static str) -> Vec<FileUse> {
    let layout = config.path.as_ref().and_then(|path| Layout::discover(&base.join(path), &mut |_, _| ()).ok());
    let Some(Layout { frames, folder, format, .. }) = layout else { return Vec::new() };
    let list = (format == Format::Png).then(|| folder.join(tum::LIST));
    let beside = list.into_iter().chain(CameraFile::path_beside(&folder));
    let of_path = frames.into_iter().map(|frame| frame.path).chain(beside).map(|file| FileUse::one(path, file));
    let place = poses::place(&config.poses, base, &folder, &mut |_, _| ()).ok().flatten();
    let of_poses = place.map(|place| poses::paths(&place)).unwrap_or_default();
    of_path.chain(of_poses.into_iter().map(|file| FileUse::one(poses, file))).collect()
}
