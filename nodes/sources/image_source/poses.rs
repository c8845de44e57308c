//! Finds the camera's pose in each frame of a recording: which file has the poses, and which pose belongs to which frame.
//!
//! A pose belongs to a frame by its name (7-Scenes: `frame-000012.pose.txt` to `frame-000012.depth.png`), by its time (TUM), or
//! by its position in the order of the files (Open3D). Between two times the position is interpolated linearly, and the rotation
//! about one axis (Shoemake, "Animating rotation with quaternion curves", 1985).

use super::config::PosesConfig;
use super::faulty::hinted;
use super::layout::{Progress, file_name, sorted_files};
use super::recording::{Frame, Recording};
use super::trajectory::{self, Known, Trajectory};
use super::tum;
use anyhow::{Context as _, Error, Result, bail, ensure};
use conicflow_messages::{Hinted, read_text};
use nalgebra::Isometry3;
use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read as _;
use std::path::{Path, PathBuf};

/// Largest difference in time between a frame and a single pose, as in the tools of the TUM benchmark.
const MAX_APART_NS: u64 = 20_000_000;
/// Largest difference in time between two poses that are interpolated: a hand moves a camera evenly over a tenth of a second.
const MAX_GAP_NS: u64 = 100_000_000;

/// Ending of the files of poses in recordings of 7-Scenes.
const OF_FRAME: &str = ".pose.txt";
/// Name of the file of poses in recordings of TUM.
const OF_TIMES: &str = "groundtruth.txt";

/// The poses of a recording.
#[derive(Debug, Default)]
pub(super) enum Poses {
    /// There are no poses.
    #[default]
    Unknown,
    /// By the stem of the frame's name; `None` where the camera was lost.
    Named(BTreeMap<String, Known>),
    /// By the frame's position in the recording.
    InOrder(Vec<Known>),
    /// By the frame's time, ascending.
    Timed(Vec<(u64, Isometry3<f64>)>),
}

impl Poses {
    /// Finds the poses that a pipeline file in `base` asks for; reports to `progress` the number of files seen. Files beside the
    /// frames that do not go with them are ignored.
    ///
    /// # Errors
    /// A file cannot be read, or one that was asked for does not go with the frames.
    pub(super) fn find(
        config: &PosesConfig,
        base: &Path,
        recording: &Recording,
        progress: &mut Progress<'_>,
    ) -> Result<Self> {
        let Some(path) = place(config, base, recording.folder(), progress)? else { return Ok(Self::Unknown) };
        let named =
            |error: Error| hinted(error, trajectory::HINT).context(format!("the poses of `{}`", path.display()));
        let poses =
            if path.is_dir() { Self::of_folder(&path, progress) } else { Self::of_file(&path) }.map_err(named)?;
        match poses.check(recording).map_err(named) {
            Ok(()) => {
                tracing::info!("the camera's poses come from `{}`", path.display());
                Ok(poses)
            }
            Err(error) if *config == PosesConfig::Auto => {
                tracing::warn!("left alone: {error:#}");
                Ok(Self::Unknown)
            }
            Err(error) => Err(error),
        }
    }

    fn of_file(path: &Path) -> Result<Self> {
        Ok(match trajectory::parse(&text_of(path)?)? {
            Trajectory::InOrder(poses) => Self::InOrder(poses),
            Trajectory::Timed(poses) => Self::Timed(poses),
            Trajectory::Single(pose) => Self::Named(BTreeMap::from([(stem(&file_name(path)).to_owned(), pose)])),
        })
    }

    /// Reads a folder with a file for each frame: `*.pose.txt`, or if there is none, any `*.txt`.
    fn of_folder(folder: &Path, progress: &mut Progress<'_>) -> Result<Self> {
        let paths = paths_in(folder, progress)?;
        ensure!(!paths.is_empty(), "it has no `*{OF_FRAME}`, nor any `*.txt`");
        let pose = |(number, path): (usize, &PathBuf)| {
            progress(number, paths.len());
            let name = file_name(path);
            let Trajectory::Single(pose) = trajectory::parse(&text_of(path)?).with_context(|| format!("`{name}`"))?
            else {
                bail!("`{name}` has several poses, expected one: the folder has a file for each frame");
            };
            Ok((stem(&name).to_owned(), pose))
        };
        Ok(Self::Named((1..).zip(&paths).map(pose).collect::<Result<_>>()?))
    }

    /// Refuses poses that do not go with the frames by number, name or time.
    fn check(&self, recording: &Recording) -> Result<()> {
        let first = recording.frames().next().map(|frame| file_name(&frame.path)).unwrap_or_default();
        match self {
            Self::InOrder(poses) if poses.len() as u64 != recording.places() => bail!(Hinted::new(
                format!("{} poses for {} frames", poses.len(), recording.places()),
                "a trajectory has one for each frame, in their order"
            )),
            Self::Timed(_) if recording.stamps_ns().is_none() => bail!(Hinted::new(
                "its poses have times, and the frames have none",
                "those of a TUM RGB-D folder stand in its `depth.txt`"
            )),
            _ => {
                let has_pose = recording.frames().any(|frame| {
                    let name = file_name(&frame.path);
                    self.of(&name, frame.slot, frame.stamp_ns).is_some()
                });
                ensure!(
                    matches!(self, Self::Unknown) || has_pose,
                    Hinted::new(
                        format!("none of its poses belongs to any of the frames, of which `{first}` is the first"),
                        format!(
                            "they go together by name (7-Scenes) or by time (TUM: not more than {} s between two poses)",
                            MAX_GAP_NS as f64 * 1e-9
                        )
                    )
                );
                Ok(())
            }
        }
    }

    /// Whether there are poses at all.
    pub(super) fn are_known(&self) -> bool {
        !matches!(self, Self::Unknown)
    }

    /// Returns `world_from_camera` of a frame as `[R | t]`, if it is known.
    pub(super) fn of_frame(&self, frame: &Frame) -> Option<[[f64; 4]; 3]> {
        let matrix = self.of(&frame.name, frame.place, frame.stamp_ns)?.to_homogeneous();
        Some(std::array::from_fn(|row| std::array::from_fn(|column| matrix[(row, column)])))
    }

    fn of(&self, name: &str, place: u64, stamp_ns: Option<u64>) -> Known {
        match self {
            Self::Unknown => None,
            Self::Named(poses) => *poses.get(stem(name))?,
            Self::InOrder(poses) => *poses.get(usize::try_from(place).ok()?)?,
            Self::Timed(poses) => at_time(poses, stamp_ns?),
        }
    }
}

/// Returns the pose at a time: interpolated between its neighbours, or else the nearest one within [`MAX_APART_NS`].
fn at_time(poses: &[(u64, Isometry3<f64>)], stamp_ns: u64) -> Known {
    let next = poses.partition_point(|(known, _)| *known < stamp_ns);
    let (before, after) = (next.checked_sub(1).and_then(|index| poses.get(index)), poses.get(next));
    if let (Some((from, first)), Some((to, second))) = (before, after)
        && to - from <= MAX_GAP_NS
    {
        let share = (stamp_ns - from) as f64 / (to - from) as f64;
        // between opposite rotations there is no shortest way
        return first.try_lerp_slerp(second, share, f64::EPSILON);
    }
    let near = [before, after].into_iter().flatten().map(|(known, pose)| (known.abs_diff(stamp_ns), *pose));
    let nearest = near.min_by_key(|(apart_ns, _)| *apart_ns);
    nearest.filter(|(apart_ns, _)| *apart_ns <= MAX_APART_NS).map(|(_, pose)| pose)
}

/// Returns what the names of a frame and its pose have in common: everything before the first dot, without the word for depth.
fn stem(name: &str) -> &str {
    let stem = name.split('.').next().unwrap_or(name);
    ["-depth", "_depth"].iter().find_map(|word| stem.strip_suffix(word)).unwrap_or(stem)
}

/// Returns the files of poses at a path: the file itself, or those of a folder.
pub(super) fn paths(place: &Path) -> Vec<PathBuf> {
    // A folder that cannot be listed is reported when it is read.
    if place.is_dir() { paths_in(place, &mut |_, _| ()).unwrap_or_default() } else { vec![place.to_owned()] }
}

fn paths_in(folder: &Path, progress: &mut Progress<'_>) -> Result<Vec<PathBuf>> {
    let of_frames = files(folder, OF_FRAME, progress)?;
    if of_frames.is_empty() { files(folder, ".txt", progress) } else { Ok(of_frames) }
}

/// Returns the file or folder of poses that a pipeline file in `base` asks for, if there is one.
pub(super) fn place(
    config: &PosesConfig,
    base: &Path,
    frames: &Path,
    progress: &mut Progress<'_>,
) -> Result<Option<PathBuf>> {
    match config {
        PosesConfig::None => Ok(None),
        PosesConfig::Path(path) => Ok(Some(base.join(path))),
        PosesConfig::Auto => beside(frames, progress),
    }
}

/// Returns the file or folder of poses beside the frames or in the folder above, if there is one.
fn beside(folder: &Path, progress: &mut Progress<'_>) -> Result<Option<PathBuf>> {
    for folder in [Some(folder), folder.parent()].into_iter().flatten() {
        // a folder that cannot be listed counts as empty
        let mut files = |ending| files(folder, ending, progress).unwrap_or_default();
        if !files(OF_FRAME).is_empty() {
            return Ok(Some(folder.to_owned()));
        }
        if folder.join(OF_TIMES).is_file() {
            return Ok(Some(folder.join(OF_TIMES)));
        }
        // other programs write `.log` files, too
        let mut logs = files(".log");
        logs.retain(|path| beginning(path).is_ok_and(|text| trajectory::begins_in_order(&text)));
        match &logs[..] {
            [] => {}
            [log] => return Ok(Some(log.clone())),
            [one, other, ..] => {
                let (one, other) = (file_name(one), file_name(other));
                return Err(Hinted::new(
                    format!("`{}` has several trajectories, such as `{one}` and `{other}`", folder.display()),
                    format!("choose by `poses`, of `conicflow detect` `--poses`: `{one}` with its folder, or `none`"),
                )
                .into());
            }
        }
    }
    Ok(None)
}

/// Returns the files of a folder with this ending, in natural order of their names.
fn files(folder: &Path, ending: &str, progress: &mut Progress<'_>) -> Result<Vec<PathBuf>> {
    sorted_files(folder, ending, progress).with_context(|| format!("`{}` cannot be listed", folder.display()))
}

fn text_of(path: &Path) -> Result<String> {
    Ok(read_text(path, tum::MAX_BYTES)?)
}

/// Reads the first bytes of a file, which are enough to recognise its format.
fn beginning(path: &Path) -> Result<String> {
    const BYTES: u64 = 512;
    let mut bytes = Vec::new();
    File::open(path)?.take(BYTES).read_to_end(&mut bytes)?;
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(&bytes);
    Ok(String::from_utf8_lossy(bytes).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Translation3, UnitQuaternion, Vector3};

    fn pose(x: f64, angle: f64) -> Isometry3<f64> {
        Isometry3::from_parts(Translation3::new(x, 0.0, 0.0), UnitQuaternion::from_scaled_axis(Vector3::y() * angle))
    }

    #[test]
    fn a_pose_between_two_times_is_interpolated_and_one_outside_is_the_nearest() {
        let poses = [(1_000_000_000, pose(0.0, 0.0)), (1_010_000_000, pose(0.1, 0.2)), (2_000_000_000, pose(5.0, 1.0))];
        let x = |stamp_ns| at_time(&poses, stamp_ns).map(|pose| (pose.translation.x, pose.rotation.angle()));
        let (place, angle) = x(1_002_500_000).unwrap();
        assert!((place - 0.025).abs() < 1e-12 && (angle - 0.05).abs() < 1e-12, "{place} {angle}");
        assert_eq!(x(1_010_000_000), Some((0.1, poses[1].1.rotation.angle())));
        assert_eq!(x(1_030_000_000).map(|it| it.0), Some(0.1), "20 ms after, and nothing until 2 s");
        assert_eq!(x(1_030_000_001), None);
        assert_eq!(x(1_979_999_999), None);
        assert_eq!(x(1_980_000_000).map(|it| it.0), Some(5.0));
        assert_eq!((x(980_000_000).map(|it| it.0), x(979_999_999), x(2_020_000_001)), (Some(0.0), None, None));
        assert_eq!(at_time(&[], 5), None);
    }

    #[test]
    fn names_are_matched_by_the_part_before_the_first_dot() {
        for name in
            ["frame-000012.depth.png", "frame-000012.pose.txt", "frame-000012-depth.png", "frame-000012_depth.png"]
        {
            assert_eq!(stem(name), "frame-000012");
        }
    }

    #[test]
    fn the_words_of_the_file_are_read_and_written() {
        for (text, config) in
            [("auto", PosesConfig::Auto), ("none", PosesConfig::None), ("a/b.log", PosesConfig::Path("a/b.log".into()))]
        {
            assert_eq!((PosesConfig::from(text.to_owned()), String::from(config.clone())), (config, text.to_owned()));
        }
    }
}
