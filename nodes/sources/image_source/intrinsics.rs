//! The camera's intrinsics, from the pipeline file or from a JSON file beside the frames.

use super::faulty::hinted;
use crate::sources::WrittenIn;
use anyhow::{Context as _, Result, anyhow, bail, ensure};
use conicflow_detection::camera::Intrinsics;
use conicflow_messages::{DEPTH_SCALES_M, Hinted, read_text};
use serde::Deserialize;
use serde_json::Value as Json;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

/// Names of the files that are searched for, in the folder of the frames and then in its parent.
const NAMES: [&str; 3] = ["camera.json", "camera_intrinsics.json", "camera_intrinsic.json"];

const MAX_JSON_BYTES: u64 = 1 << 20;

/// Hint of the errors: the expected format of a JSON file.
const HINT: &str = "write `{\"width\": 640, \"height\": 480, \"fx\": .., \"fy\": .., \"cx\": .., \"cy\": ..}` with your camera's \
                    numbers, or give `intrinsics` in the pipeline file, to `conicflow detect` `--camera`";

/// The content of a JSON file beside the frames.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct CameraFile {
    pub(super) path: PathBuf,
    pub(super) intrinsics: Intrinsics,
    /// Width and height of the images for which the intrinsics hold.
    pub(super) size: Option<(u32, u32)>,
    pub(super) depth_scale: Option<f64>,
}

impl CameraFile {
    /// Searches for a file beside the frames.
    ///
    /// # Errors
    /// The file cannot be used.
    pub(super) fn find(folder: &Path) -> Result<Option<Self>> {
        let Some(path) = Self::path_beside(folder) else { return Ok(None) };
        let read = Self::read(&path).map_err(|error| hinted(error, HINT));
        let found = read.with_context(|| format!("`{}`", path.display()))?;
        if let Some(other) = found.another_beside() {
            tracing::warn!("`{}` is read; `{}` beside it tells of another camera, and is not", path.display(), other);
        }
        Ok(Some(found))
    }

    /// The name of a file in the same folder that describes another camera, or cannot be read.
    fn another_beside(&self) -> Option<&'static str> {
        let is_another = |name: &&str| {
            let other = self.path.with_file_name(name);
            let is_as_large = |other: &Self| other.size.zip(self.size).is_none_or(|(other, own)| other == own);
            let agrees = |other: Self| other.intrinsics == self.intrinsics && is_as_large(&other);
            other.symlink_metadata().is_ok() && !Self::read(&other).is_ok_and(agrees)
        };
        NAMES.into_iter().find(is_another)
    }

    /// Returns the path of the first file that exists.
    pub(super) fn path_beside(folder: &Path) -> Option<PathBuf> {
        let folders = [Some(folder), folder.parent()];
        let mut candidates = folders.into_iter().flatten().flat_map(|folder| NAMES.map(|name| folder.join(name)));
        // A file that cannot be read counts, too: the next one may be of another camera.
        candidates.find(|path| path.symlink_metadata().is_ok())
    }

    fn read(path: &Path) -> Result<Self> {
        ensure!(path.is_file(), "it is no file, or a link to nothing");
        let json: CameraJson = serde_json::from_str(&read_text(path, MAX_JSON_BYTES)?)?;
        json.check_others()?;
        let intrinsics = json.intrinsics()?;
        ensure!(
            intrinsics.are_usable(),
            "focal lengths are 1 to 1,000,000 pixels, and a principal point is no farther away, not {intrinsics:?}"
        );
        if let Some(scale) = json.depth_scale {
            ensure!(DEPTH_SCALES_M.contains(&scale), "`depth_scale` is {scale:?}, expected 1e-9 to 1");
        }
        Ok(Self { path: path.to_owned(), intrinsics, size: json.width.zip(json.height), depth_scale: json.depth_scale })
    }

    /// Refuses intrinsics of images of another size.
    ///
    /// # Errors
    /// The file gives a size, and it is not `frames`.
    pub(super) fn check_size(&self, frames: (u32, u32)) -> Result<()> {
        match self.size {
            Some(size) if size != frames => bail!(Hinted::new(
                format!(
                    "`{}` is for images of {}x{}, but the frames are {}x{}",
                    self.path.display(),
                    size.0,
                    size.1,
                    frames.0,
                    frames.1
                ),
                "intrinsics scale with the image; write those of the frames"
            )),
            _ => Ok(()),
        }
    }
}

/// The keys of both formats; unknown keys are ignored, since other programs write these files, too.
#[derive(Deserialize)]
struct CameraJson {
    width: Option<u32>,
    height: Option<u32>,
    fx: Option<f64>,
    fy: Option<f64>,
    cx: Option<f64>,
    cy: Option<f64>,
    /// Metres per unit.
    depth_scale: Option<f64>,
    /// Open3D's: 3x3, column-major.
    intrinsic_matrix: Option<Vec<f64>>,
    #[serde(flatten)]
    others: BTreeMap<String, Json>,
}

/// The keys that are read, for comparison with similar ones.
const KEYS: [&str; 8] = ["width", "height", "fx", "fy", "cx", "cy", "depth_scale", "intrinsic_matrix"];
/// Keys with which other programs describe lens distortion, beside those that contain the word.
const DISTORTION: [&str; 12] = ["d", "coeffs", "dist", "distcoeffs", "k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2"];

impl CameraJson {
    /// Refuses keys that would change the camera if they were read: other spellings of known keys, and lens distortion.
    fn check_others(&self) -> Result<()> {
        let plain = |key: &str| key.chars().filter(char::is_ascii_alphanumeric).collect::<String>().to_lowercase();
        for (key, value) in &self.others {
            let key_read = KEYS.iter().find(|known| plain(known) == plain(key));
            ensure!(key_read.is_none(), "the key `{key}` is not read, expected `{}`", key_read.unwrap_or(&""));
            let is_distortion = DISTORTION.contains(&plain(key).as_str()) || plain(key).contains("distortion");
            ensure!(
                !is_distortion || !is_any_number(value),
                Hinted::new(
                    format!("the images are distorted (`{key}`: {value}), expected those of a pinhole camera"),
                    "rectify the frames; if they are, take the key out of the file"
                )
            );
        }
        Ok(())
    }

    fn intrinsics(&self) -> Result<Intrinsics> {
        if let Some(matrix) = &self.intrinsic_matrix {
            return from_matrix(matrix);
        }
        let number = |key: &str, value: Option<f64>| value.ok_or_else(|| anyhow!("the key `{key}` is missing"));
        Ok(Intrinsics {
            fx: number("fx", self.fx)?,
            fy: number("fy", self.fy)?,
            cx: number("cx", self.cx)?,
            cy: number("cy", self.cy)?,
        })
    }
}

/// Whether a value is, or contains, a number other than 0.
fn is_any_number(value: &Json) -> bool {
    match value {
        Json::Number(number) => number.as_f64() != Some(0.0),
        Json::Array(values) => values.iter().any(is_any_number),
        Json::Object(values) => values.values().any(is_any_number),
        _ => false,
    }
}

fn from_matrix(matrix: &[f64]) -> Result<Intrinsics> {
    let &[fx, _, row_cx, _, fy, row_cy, cx, cy, _] = matrix else {
        bail!("`intrinsic_matrix` has {} numbers, expected 9", matrix.len());
    };
    if (cx, cy) == (0.0, 0.0) && (row_cx, row_cy) != (0.0, 0.0) {
        bail!(Hinted::new(
            "`intrinsic_matrix` is row-major, expected column-major",
            format!("write [{fx}, 0, 0, 0, {fy}, 0, {row_cx}, {row_cy}, 1]")
        ));
    }
    Ok(Intrinsics { fx, fy, cx, cy })
}

/// Returns the error for frames without intrinsics, with the line to write.
pub(super) fn missing(folder: &Path, (width, height): (u32, u32), written_in: WrittenIn) -> anyhow::Error {
    let (cx, cy) = (f64::from(width.saturating_sub(1)) / 2.0, f64::from(height.saturating_sub(1)) / 2.0);
    let focal = 525.0 * f64::from(width) / 640.0;
    let [focal, cx, cy] = [focal, cx, cy].map(|pixels| format!("{pixels:.1}"));
    let example = written_in.intrinsics([&focal, &focal, &cx, &cy]);
    let name = if written_in == WrittenIn::CommandLine { "`--camera`" } else { "the key `intrinsics`" };
    anyhow!(Hinted::new(
        format!(
            "no intrinsics for the frames in `{}`: neither {name} nor a `camera.json` or \
             `camera_intrinsics.json` beside them",
            folder.display()
        ),
        format!("write `{example}` with the numbers of your camera (these are a Kinect's at {width}x{height})")
    ))
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    const MINE: &str =
        r#"{"width": 64, "height": 48, "fx": 52.5, "fy": 52.0, "cx": 31.5, "cy": 23.5, "depth_scale": 0.0002}"#;
    const OPEN3D: &str = r#"{"width": 64, "height": 48, "intrinsic_matrix": [52.5, 0, 0, 0, 52.0, 0, 31.5, 23.5, 1]}"#;
    const EXPECTED: Intrinsics = Intrinsics { fx: 52.5, fy: 52.0, cx: 31.5, cy: 23.5 };

    fn found(name: &str, text: &str) -> Result<Option<CameraFile>> {
        let parent = tempfile::tempdir().unwrap();
        let folder = parent.path().join("frames");
        fs::create_dir(&folder).unwrap();
        fs::write(folder.join(name), text).unwrap();
        CameraFile::find(&folder)
    }

    fn error_of(text: &str) -> String {
        let error = format!("{:#}", found("camera.json", text).unwrap_err());
        error.split_once("camera.json`: ").unwrap().1.to_owned()
    }

    #[test]
    fn keys_that_would_change_the_camera_are_refused_and_notes_are_ignored() {
        let with = |entry: &str| MINE.replace('}', &format!(", {entry}}}"));
        for (entry, expected) in [
            (r#""depthScale": 0.001"#, "the key `depthScale` is not read, expected `depth_scale`"),
            (r#""FX": 5.0"#, "the key `FX` is not read, expected `fx`"),
            (r#""distortion": [0.0, 0.2]"#, "the images are distorted (`distortion`: [0.0,0.2]), expected those of"),
            (r#""coeffs": [0.1]"#, "the images are distorted (`coeffs`: [0.1])"),
            (r#""distortion_coefficients": { "data": [1e-3] }"#, "the images are distorted"),
            (r#""dist_coeffs": [0.1, 0.2]"#, "the images are distorted"),
            (r#""radial_distortion": [0.1]"#, "the images are distorted"),
            (r#""k1": -0.1, "k2": 0.0"#, "the images are distorted (`k1`: -0.1)"),
        ] {
            let error = error_of(&with(entry));
            assert!(error.starts_with(expected), "{entry}: {error}");
        }
        for entry in [r#""note": "by hand", "serial": 7"#, r#""distortion": [0, 0.0], "distortion_model": "none""#] {
            assert_eq!(found("camera.json", &with(entry)).unwrap().unwrap().intrinsics, EXPECTED, "{entry}");
        }
    }

    #[test]
    fn both_layouts_are_read_under_each_file_name() {
        for name in NAMES {
            let mine = found(name, MINE).unwrap().unwrap();
            assert_eq!((mine.intrinsics, mine.size, mine.depth_scale), (EXPECTED, Some((64, 48)), Some(0.0002)));
            let open3d = found(name, OPEN3D).unwrap().unwrap();
            assert_eq!((open3d.intrinsics, open3d.size, open3d.depth_scale), (EXPECTED, Some((64, 48)), None));
        }
        assert_eq!(found("notes.json", MINE).unwrap(), None);
    }

    #[test]
    fn an_unreadable_file_is_reported_and_no_other_is_read_in_its_place() {
        let frames = tempfile::tempdir().unwrap();
        fs::write(frames.path().join("camera_intrinsics.json"), OPEN3D).unwrap();
        std::os::unix::fs::symlink("nowhere", frames.path().join("camera.json")).unwrap();
        let error = format!("{:#}", CameraFile::find(frames.path()).unwrap_err());
        assert!(error.contains("camera.json`: it is no file, or a link to nothing\n  hint: "), "{error}");
    }

    #[test]
    fn the_parent_folder_is_searched_last() {
        let parent = tempfile::tempdir().unwrap();
        let frames = parent.path().join("depth");
        fs::create_dir(&frames).unwrap();
        fs::write(parent.path().join("camera_intrinsics.json"), OPEN3D).unwrap();
        assert_eq!(CameraFile::find(&frames).unwrap().unwrap().depth_scale, None);
        fs::write(frames.join("camera.json"), MINE).unwrap();
        assert_eq!(CameraFile::find(&frames).unwrap().unwrap().depth_scale, Some(0.0002));
    }

    #[test]
    fn a_second_file_in_the_folder_is_reported_if_it_describes_another_camera() {
        let folder = tempfile::tempdir().unwrap();
        let another = |open3d: &str| {
            fs::write(folder.path().join("camera_intrinsics.json"), open3d).unwrap();
            CameraFile::find(folder.path()).unwrap().unwrap().another_beside()
        };
        assert_eq!(another(OPEN3D), None, "it is alone");
        fs::write(folder.path().join("camera.json"), MINE).unwrap();
        assert_eq!(another(OPEN3D), None, "they agree");
        assert_eq!(another(&OPEN3D.replace("\"width\": 64, \"height\": 48, ", "")), None, "it tells no size");
        assert_eq!(another(&OPEN3D.replace("52.5", "60")), Some("camera_intrinsics.json"));
    }

    #[test]
    fn faults_are_reported() {
        assert!(error_of("{\n oops").contains("line 2"));
        assert!(error_of(&MINE.replace("\"fy\": 52.0, ", "")).starts_with("the key `fy` is missing\n  hint: write `{"));
        assert!(error_of(&MINE.replace("52.0", "0")).starts_with("focal lengths are 1 to 1,000,000 pixels"));
        assert!(error_of(&MINE.replace("0.0002", "-1")).starts_with("`depth_scale` is -1.0, expected 1e-9 to 1\n"));
        assert!(
            error_of(r#"{"intrinsic_matrix": [1, 2]}"#).starts_with("`intrinsic_matrix` has 2 numbers, expected 9\n")
        );
        let long = format!("{MINE}{}", " ".repeat(MAX_JSON_BYTES as usize));
        assert!(error_of(&long).starts_with("it is longer than 1048576 bytes\n  hint: "));
        let rows = error_of(r#"{"intrinsic_matrix": [52.5, 0, 31.5, 0, 52, 23.5, 0, 0, 1]}"#);
        assert_eq!(
            rows,
            "`intrinsic_matrix` is row-major, expected column-major\n  hint: write [52.5, 0, 0, 0, 52, 0, 31.5, 23.5, 1]"
        );
    }

    #[test]
    fn another_size_is_refused() {
        let file = found("camera.json", MINE).unwrap().unwrap();
        assert!(file.check_size((64, 48)).is_ok());
        let error = file.check_size((32, 24)).unwrap_err().to_string();
        assert!(error.contains("is for images of 64x48, but the frames are 32x24\n  hint: "), "{error}");
    }

    #[test]
    fn the_hint_shows_the_line_to_write() {
        let error = missing(Path::new("frames"), (640, 480), WrittenIn::PipelineFile).to_string();
        assert!(error.contains("`intrinsics = { fx = 525.0, fy = 525.0, cx = 319.5, cy = 239.5 }`"), "{error}");
        let error = missing(Path::new("frames"), (640, 480), WrittenIn::CommandLine).to_string();
        assert!(error.contains("hint: write `--camera 525.0,525.0,319.5,239.5` with"), "{error}");
        assert!(!error.contains("the key"), "{error}");
    }
}
