//! A recording: the depth frames of a path with their camera, read one by one into the caller's memory.

use super::config::Config;
use super::depth_png;
use super::faulty::hinted;
use super::intrinsics::{self, CameraFile};
use super::layout::{self, Format, FrameFile, Layout, file_name};
use super::pcd::Cloud;
use super::pinhole::{self, FAIR_RESIDUAL_PX, Pinhole};
use super::raster::{self, Depths};
use anyhow::{Context as _, Error, Result, bail, ensure};
use conicflow_messages::{Camera, DEPTH_SCALES_M, Hinted, MAX_SIDE_PX, finest_scale, is_too_far, quantise};
use std::fs::{self, File};
use std::io::Read as _;
use std::path::Path;
use std::time::SystemTime;

/// The depth frames of a file or a folder.
pub struct Recording {
    layout: Layout,
    size: (u32, u32),
    /// Number of all frames of the recording, including unreadable ones and those that `first` and `frames` leave out.
    places: u64,
    camera: Option<Camera>,
    depth_scale: f64,
    /// When the files' headers were read; a file written later has changed.
    opened: SystemTime,
    /// The file of the last frame that was loaded, and whether it was read in full.
    file: Vec<u8>,
    is_read: bool,
    cloud: Cloud,
    raster: Depths,
    /// Metres per unit of depths in floating point.
    metres_per_number: f64,
    /// Depth units per unit of the cloud's z, with its sign, or of depths in floating point.
    units_per_z: f64,
    /// Whether it was already logged that the clouds' axes are flipped, and that their residual from a pinhole camera is large.
    reported_flipped: bool,
    reported_residual: bool,
}

/// A frame whose file is loaded, and whose pixels can be decoded.
#[derive(Clone, Debug, PartialEq)]
pub struct Frame {
    /// Size and intrinsics.
    pub camera: Camera,
    /// Metres per unit of a pixel.
    pub depth_scale: f64,
    /// Name of the file.
    pub name: String,
    /// Position from the first frame in use, counting unreadable ones.
    pub slot: u64,
    /// Position in the whole recording, counting unreadable frames and those that are not used.
    pub place: u64,
    /// Time of capture, if the recording has it.
    pub stamp_ns: Option<u64>,
}

impl Recording {
    /// Finds the frames of `path`, reads the header of each, and finds their camera; `config` completes or overrides what the
    /// files say.
    ///
    /// # Errors
    /// No frame can be read, frames are of different sizes, or their camera is not known.
    pub fn open(path: &Path, config: &Config) -> Result<Self> {
        Self::open_with_progress(path, config, &mut |_, _| ())
    }

    /// Opens a recording as [`Recording::open`] does, and reports to `progress` the number of files seen and of all files.
    ///
    /// # Errors
    /// As for [`Recording::open`].
    pub fn open_with_progress(path: &Path, config: &Config, progress: &mut dyn FnMut(usize, usize)) -> Result<Self> {
        let opened = SystemTime::now();
        let mut layout = Layout::discover(path, progress)?;
        let places = (layout.frames.len() + layout.unreadable.len()) as u64;
        select(&mut layout, config)?;
        let size = common_size(&layout.frames)?;
        let beside = CameraFile::find(&layout.folder)?;
        let camera = camera(&layout, size, config, beside.as_ref())?;
        let by_file = beside.and_then(|file| file.depth_scale).filter(|_| layout.format != Format::Pcd);
        let given_scale = config.depth_scale.or(by_file);
        let depth_scale = given_scale.unwrap_or(layout.depth_scale);
        ensure!(
            DEPTH_SCALES_M.contains(&depth_scale),
            Hinted::new(
                format!("`depth_scale` is {depth_scale:?}, expected 1e-9 to 1"),
                "metres per unit: 0.001 for millimetres"
            )
        );
        Ok(Self {
            layout,
            size,
            places,
            camera,
            depth_scale,
            opened,
            file: Vec::new(),
            is_read: false,
            cloud: Cloud::default(),
            raster: Depths::Units(Vec::new()),
            metres_per_number: given_scale.unwrap_or(1.0),
            units_per_z: 1.0,
            reported_flipped: false,
            reported_residual: false,
        })
    }

    /// Whether the camera is given by parameters or a file; else it is fitted to the points.
    pub(super) fn has_given_camera(&self) -> bool {
        self.camera.is_some()
    }

    /// Number of frames.
    pub fn len(&self) -> usize {
        self.layout.frames.len()
    }

    /// The files of the frames.
    pub(super) fn frames(&self) -> impl Iterator<Item = &FrameFile> {
        self.layout.frames.iter()
    }

    /// The folder of the frames.
    pub(super) fn folder(&self) -> &Path {
        &self.layout.folder
    }

    /// Number of all frames of the recording, including unreadable ones and those that are not used.
    pub(super) fn places(&self) -> u64 {
        self.places
    }

    /// Number of pixels of each frame of `path`, if there is one; reads no more files than needed.
    pub fn pixels_of(path: &Path) -> Option<usize> {
        let (width, height) = layout::first_size(path)?;
        (width.max(height) <= MAX_SIDE_PX).then_some(width as usize * height as usize)
    }

    /// Number of pixels of each frame.
    pub fn pixels(&self) -> usize {
        self.size.0 as usize * self.size.1 as usize
    }

    /// Whether there are no frames; never true, as [`Recording::open`] refuses that.
    pub fn is_empty(&self) -> bool {
        self.layout.frames.is_empty()
    }

    /// Errors of the frames that cannot be read.
    pub fn unreadable(&self) -> impl ExactSizeIterator<Item = &Error> {
        self.layout.unreadable.iter().map(|(_, error)| error)
    }

    /// Times of capture of the first and the last frame, if the recording has them.
    pub fn stamps_ns(&self) -> Option<(u64, u64)> {
        let frames = &self.layout.frames;
        frames.first()?.stamp_ns.zip(frames.last()?.stamp_ns)
    }

    /// Number of positions between the first and the last frame, counting unreadable ones.
    pub fn slots(&self) -> u64 {
        let slot = |frame: Option<&FrameFile>| frame.map_or(0, |frame| frame.slot);
        slot(self.layout.frames.last()) - slot(self.layout.frames.first()) + 1
    }

    /// Reads the file of a frame.
    ///
    /// # Errors
    /// The file cannot be read, is damaged, or is a cloud that does not fit a pinhole camera.
    pub fn load(&mut self, index: usize) -> Result<Frame> {
        let file = self.layout.frames.get(index).context("no such frame")?.clone();
        let loaded = self.load_file(&file).map_err(|error| hinted(error, self.layout.format.hint()));
        loaded.with_context(|| format!("`{}`", file.path.display()))
    }

    /// Whether a frame that cannot be used was lost since the recording was opened: its file cannot be read any more, or was
    /// written since.
    pub(super) fn is_lost(&self, index: usize) -> bool {
        let written =
            self.layout.frames.get(index).map(|file| fs::metadata(&file.path).and_then(|about| about.modified()));
        !self.is_read || matches!(written, Some(Ok(written)) if written > self.opened)
    }

    fn load_file(&mut self, file: &FrameFile) -> Result<Frame> {
        self.file.clear();
        self.is_read = false;
        File::open(&file.path)?.read_to_end(&mut self.file)?;
        self.is_read = true;
        let (name, first) = (file_name(&file.path), self.layout.frames[0].slot);
        let (camera, depth_scale) = match (self.layout.format, self.camera) {
            (Format::Png, Some(camera)) => (camera, self.depth_scale),
            (Format::Tiff | Format::Npy, Some(camera)) => (camera, self.load_raster()?),
            _ => self.load_cloud(&name)?,
        };
        Ok(Frame { camera, depth_scale, name, slot: file.slot - first, place: file.slot, stamp_ns: file.stamp_ns })
    }

    /// Decodes a TIFF or NPY file, and returns the metres per unit.
    fn load_raster(&mut self) -> Result<f64> {
        let decode = if self.layout.format == Format::Tiff { raster::decode_tiff } else { raster::decode_npy };
        self.raster = decode(&self.file, self.size)?;
        let Depths::Metres(depths) = &self.raster else { return Ok(self.depth_scale) };
        let scale = finest_scale(depths, self.metres_per_number);
        self.units_per_z = self.metres_per_number / scale;
        Ok(scale)
    }

    fn load_cloud(&mut self, name: &str) -> Result<(Camera, f64)> {
        self.cloud.read(&self.file)?;
        let (width, height) = (self.cloud.width, self.cloud.height);
        ensure!((width, height) == self.size, "{width}x{height} points, expected {}x{}", self.size.0, self.size.1);
        let (camera, backward) = match self.camera {
            Some(camera) => (camera, pinhole::looks_backward(self.cloud.depths().iter().copied())),
            None => {
                let pinhole = pinhole::fit(width, height, self.cloud.points())?;
                self.report_fit(name, &pinhole);
                (pinhole.camera, pinhole.flipped[2])
            }
        };
        let metres_per_z = if backward { -self.depth_scale } else { self.depth_scale };
        let scale = finest_scale(self.cloud.depths(), metres_per_z);
        self.units_per_z = metres_per_z / scale;
        Ok((camera, scale))
    }

    /// Logs once that a cloud has flipped axes, or a large residual.
    fn report_fit(&mut self, name: &str, pinhole: &Pinhole) {
        let axes = ["x points left", "y points up", "z points backward"];
        let flipped: Vec<_> =
            axes.into_iter().zip(pinhole.flipped).filter_map(|(axis, is)| is.then_some(axis)).collect();
        if !flipped.is_empty() && !std::mem::replace(&mut self.reported_flipped, true) {
            let axes = flipped.join(", ");
            tracing::warn!("`{name}`: {axes}; turned into the optical frame: x right, y down, z forward");
        }
        if pinhole.residual_px > FAIR_RESIDUAL_PX && !std::mem::replace(&mut self.reported_residual, true) {
            let residual = pinhole.residual_px;
            tracing::warn!(
                "`{name}`: points lie {residual:.2} pixels (rms) beside a pinhole camera's: rounded or distorted"
            );
        }
    }

    /// Writes the depths of the last loaded frame, row by row; 0 or 65535 means no measurement. Returns the number of points that
    /// were left out as too far.
    ///
    /// # Errors
    /// The file is damaged.
    pub fn decode(&self, pixels: &mut [u16]) -> Result<u64> {
        match (self.layout.format, &self.raster) {
            (Format::Png, _) => {
                depth_png::decode(&self.file, self.size, pixels).map_err(|error| hinted(error, depth_png::HINT))?;
                Ok(0)
            }
            (Format::Tiff | Format::Npy, Depths::Units(depths)) => {
                pixels.copy_from_slice(depths);
                Ok(0)
            }
            (Format::Tiff | Format::Npy, Depths::Metres(depths)) => Ok(self.quantise(depths, pixels)),
            (Format::Pcd, _) => Ok(self.quantise(self.cloud.depths(), pixels)),
        }
    }

    /// Writes depths in units, and returns the number of those left out as too far.
    fn quantise(&self, depths: &[f32], pixels: &mut [u16]) -> u64 {
        for (pixel, &z) in pixels.iter_mut().zip(depths) {
            *pixel = quantise(z, self.units_per_z);
        }
        depths.iter().filter(|&&z| is_too_far(z, self.units_per_z)).count() as u64
    }
}

/// Drops the frames outside of `first` and `frames`, readable or not.
fn select(layout: &mut Layout, config: &Config) -> Result<()> {
    let Config { first, frames, .. } = *config;
    let count = (layout.frames.len() + layout.unreadable.len()) as u64;
    ensure!(
        first < count,
        Hinted::new(
            format!("`first` is {first}, but there are {count} frames, counted from 0"),
            format!("the last is {}", count - 1)
        )
    );
    ensure!(frames != Some(0), Hinted::new("`frames` is 0, expected 1 or more", "leave it out for all"));
    let wanted = first..first.saturating_add(frames.unwrap_or(u64::MAX));
    layout.frames.retain(|frame| wanted.contains(&frame.slot));
    layout.unreadable.retain(|(slot, _)| wanted.contains(slot));
    ensure!(
        !layout.frames.is_empty(),
        Hinted::new(
            format!("none of the frames from number {first} can be read"),
            "`first` and `frames` choose others"
        )
    );
    Ok(())
}

fn common_size(frames: &[FrameFile]) -> Result<(u32, u32)> {
    let size = frames.first().context("no frames")?.size;
    let (width, height) = size;
    ensure!(
        width.max(height) <= MAX_SIDE_PX,
        Hinted::new(
            format!("frames of {width}x{height}, expected {MAX_SIDE_PX} pixels a side or less"),
            "cut or scale them first"
        )
    );
    if let Some(other) = frames.iter().find(|frame| frame.size != size) {
        bail!(Hinted::new(
            format!(
                "`{}` is {}x{}, but the frames before it are {}x{}",
                other.path.display(),
                other.size.0,
                other.size.1,
                size.0,
                size.1
            ),
            "keep the frames of each camera in a folder of their own"
        ));
    }
    Ok(size)
}

/// Returns the camera from the parameters or the file; `None` for clouds without either, whose camera is fitted.
fn camera(layout: &Layout, size: (u32, u32), config: &Config, beside: Option<&CameraFile>) -> Result<Option<Camera>> {
    if let Some(intrinsics) = config.intrinsics {
        ensure!(
            intrinsics.are_usable(),
            Hinted::new(
                format!(
                    "`intrinsics` need focal lengths of 1 to 1,000,000 pixels and a principal point no farther away, \
                     not {intrinsics:?}"
                ),
                "take them from the camera's calibration, in pixels"
            )
        );
        return Ok(Some(intrinsics.camera(size)));
    }
    if let Some(file) = beside {
        file.check_size(size)?;
        return Ok(Some(file.intrinsics.camera(size)));
    }
    if layout.format == Format::Pcd {
        return Ok(None);
    }
    Err(intrinsics::missing(&layout.folder, size, config.written_in))
}
