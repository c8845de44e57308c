//! Writes pictures: the depth image in colours, with the ellipses and the outlines of objects or tracks over it.
//!
//! The driving input can be a list of objects, tracks or ellipses; the depth image and the ellipses of the same frame are side
//! inputs and may be missing.

mod canvas;
mod depth_view;
mod labels;
mod moving;
mod painter;
mod sheet;
mod whole_file;

use crate::faults::stage_error;
use crate::sinks::decimator::Decimator;
use anyhow::{Context as _, Result, ensure};
use canvas::{Box2, Canvas};
use conicflow_dataflow::{ConfigFault, Context, FileUse, Output, SideInput, SideInputs, Stage, StageError};
use conicflow_messages::{Ellipse, Header, Hinted, MAX_PIXELS, Message, Nothing, Text};
use moving::Moving;
pub use painter::{Drawn, Painter};
use png::{BitDepth, ColorType, Compression, Encoder};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use sheet::Sheet;
use std::fs;
use std::marker::PhantomData;
use std::path::{Path, PathBuf};
use whole_file::write_whole;

/// Longest stem of a picture's name, in bytes: file systems allow 255 with the ending.
const LONGEST_NAME: usize = 200;

/// Parameters of [`PictureSink`].
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Folder for the pictures, which is created if need be; may be left out if `moving` is given.
    pub path: Option<PathBuf>,
    /// File for one moving picture (APNG) of everything that is drawn, up to 300 pictures, which browsers and README pages play;
    /// it is written at the end.
    pub moving: Option<PathBuf>,
    /// Width of the moving picture, in pixels; that of the pictures where they are narrower.
    #[schemars(range(min = 16, max = 1920))]
    pub moving_width_px: u32,
    /// Draw every so many frames, of each camera.
    #[schemars(range(min = 1))]
    pub every: u64,
    /// Names of the pictures: by `sequence` (frame_000012.png), `stage` (camera_000012.png, after the stage that had the frame
    /// first: for several cameras) or `source` (the frame's file, where it has one).
    pub names: Names,
    /// Width of the outlines, in pixels.
    #[schemars(range(min = 1, max = 15))]
    pub line_width_px: u32,
    /// Whether objects are labelled with their kind, confidence and radius with its standard deviation, and tracks with their
    /// number.
    pub labels: bool,
    /// Whether the lowest lines of the picture show the frame, its time, and the scale of the depth.
    pub legend: bool,
    /// Number of pixels of the picture, along either side, for one pixel of the frame.
    #[schemars(range(min = 1, max = 8))]
    pub zoom: u32,
    /// Put so many pictures, smaller, onto one contact sheet each (sheet_0001.png); 0: no sheets.
    #[schemars(range(min = 0, max = 100))]
    pub sheet: usize,
    /// Depth of the warmest colour, in metres; default: by the frame.
    #[schemars(range(min = 0.0))]
    pub near_m: Option<f64>,
    /// Depth of the coldest colour, in metres; default: by the frame.
    #[schemars(range(min = 0.0))]
    pub far_m: Option<f64>,
}

/// The naming of pictures.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Names {
    /// The frame's sequence number.
    Sequence,
    /// The stage that had the frame first, and its sequence number.
    Stage,
    /// The frame's file.
    Source,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            path: None,
            moving: None,
            moving_width_px: 480,
            every: 1,
            names: Names::Sequence,
            line_width_px: 2,
            labels: true,
            legend: true,
            zoom: 1,
            sheet: 0,
            near_m: None,
            far_m: None,
        }
    }
}

impl Config {
    /// Returns the files that are written, for the parameters with the keys `path` and `moving`. If names depend on the frames,
    /// any PNG of the folder may be one of them.
    pub fn writes(&self, base: &Path, path: &'static str, moving: &'static str) -> Vec<FileUse> {
        let mut files = Vec::new();
        if let Some(folder) = self.path.as_ref().map(|path| base.join(path)) {
            files.push(match self.names {
                Names::Sequence => FileUse::numbered(path, folder.clone(), "frame_", ".png"),
                Names::Stage | Names::Source => FileUse::ending(path, folder.clone(), ".png"),
            });
            if self.sheet > 0 {
                files.push(FileUse::numbered(path, folder, "sheet_", ".png"));
            }
        }
        files.extend(self.moving.as_ref().map(|path| FileUse::one(moving, base.join(path))));
        files
    }
}

/// Refuses names of moving pictures with an ending of another format.
///
/// # Errors
/// The ending is not one of a PNG; the hint proposes one that is.
pub fn check_moving(path: &Path) -> Result<(), Hinted> {
    match path.extension().map(|ending| ending.to_ascii_lowercase()) {
        Some(ending) if ending != "png" && ending != "apng" => Err(Hinted::new(
            format!("`{}` will be a PNG that moves (APNG)", path.display()),
            format!("name it `{}`", path.with_extension("png").display()),
        )),
        _ => Ok(()),
    }
}

/// Writes a PNG for every message, or for one in so many.
pub struct PictureSink<T> {
    folder: Option<PathBuf>,
    moving: Option<Moving>,
    decimator: Decimator,
    names: Names,
    painter: Painter,
    zoom: u32,
    sheet: Option<Sheet>,
    file: Vec<u8>,
    /// Camera of the last picture.
    camera: Option<Text<32>>,
    /// Whether the warning about several cameras was already logged.
    is_reported: bool,
    item: PhantomData<T>,
}

impl<T: Drawn> PictureSink<T> {
    /// Creates the folder of the pictures, relative to `base`; `resume_at` messages were taken before a restart.
    ///
    /// # Errors
    /// The parameters name no folder, or it cannot be created.
    pub fn open(config: &Config, base: &Path, resume_at: u64) -> Result<Self> {
        ensure!(
            config.path.is_some() || config.moving.is_some(),
            Hinted::new("`path` is missing", "write `path = \"pictures/\"`")
        );
        let folder = config.path.as_ref().map(|path| base.join(path));
        if let Some(folder) = &folder {
            fs::create_dir_all(folder).with_context(|| format!("the folder `{}` cannot be made", folder.display()))?;
        }
        Ok(Self {
            folder,
            moving: config.moving.as_ref().map(|path| Moving::new(base.join(path), config.moving_width_px)),
            decimator: Decimator::new(config.every, resume_at),
            names: config.names,
            painter: Painter::new(config),
            zoom: config.zoom,
            sheet: (config.sheet > 0).then(|| Sheet::new(config.sheet, resume_at / config.every / config.sheet as u64)),
            file: Vec::new(),
            camera: None,
            is_reported: false,
            item: PhantomData,
        })
    }

    fn take(&mut self, input: &Message<T>, side_inputs: &SideInputs) -> Result<Option<PathBuf>> {
        let (depth, ellipses) = (side_inputs.get::<u16>("depth"), side_inputs.get::<Ellipse>("ellipses"));
        self.write_picture(input, depth.as_ref(), ellipses.map_or(&[], |message| message.items))
    }

    /// Draws a message and writes the picture if it is due; returns the file, if pictures have one each.
    ///
    /// # Errors
    /// The camera cannot be that of an image, or the file cannot be written.
    pub fn write_picture(
        &mut self,
        input: &Message<T>,
        depth: Option<&Message<u16>>,
        ellipses: &[Ellipse],
    ) -> Result<Option<PathBuf>> {
        if !self.decimator.is_due(input.header) {
            return Ok(None);
        }
        self.draw(input, depth, ellipses)?;
        self.warn_of_another_camera(input.header);
        if let Some(moving) = &mut self.moving {
            moving.add(self.painter.canvas(), input.header.stamp_ns);
        }
        let Some(folder) = &self.folder else { return Ok(None) };
        let path = folder.join(picture_name(input.header, self.names));
        write_png(self.painter.canvas(), &mut self.file, &path)?;
        if let Some(sheet) = &mut self.sheet {
            sheet.add(self.painter.canvas());
            if sheet.is_full() {
                self.write_sheet()?;
            }
        }
        Ok(Some(path))
    }

    /// Writes the last contact sheet and the moving picture.
    ///
    /// # Errors
    /// A file cannot be written.
    pub fn end(&mut self) -> Result<()> {
        self.write_sheet()?;
        self.moving.as_ref().map_or(Ok(()), Moving::write)
    }

    /// Writes the contact sheet if it has pictures.
    fn write_sheet(&mut self) -> Result<()> {
        let Some(sheet) = self.sheet.as_mut().filter(|sheet| !sheet.is_empty()) else { return Ok(()) };
        let Some(folder) = &self.folder else { return Ok(()) };
        let path = folder.join(format!("sheet_{:04}.png", sheet.number()));
        write_png(&sheet.take(), &mut self.file, &path)
    }

    fn draw(&mut self, input: &Message<T>, depth: Option<&Message<u16>>, ellipses: &[Ellipse]) -> Result<()> {
        let camera = &input.header.camera;
        let pixels = u64::from(camera.width) * u64::from(camera.height);
        ensure!(
            (1..=MAX_PIXELS).contains(&pixels),
            Hinted::new(
                format!(
                    "frame {} has {}x{} pixels, expected 1 to {MAX_PIXELS}",
                    input.header.sequence, camera.width, camera.height
                ),
                "the stage that made the message gave a wrong camera"
            )
        );
        ensure!(
            pixels * u64::from(self.zoom * self.zoom) <= MAX_PIXELS,
            Hinted::new(
                format!("a picture {} times as wide as {}x{} is too large", self.zoom, camera.width, camera.height),
                "write a smaller `zoom`"
            )
        );
        self.painter.begin(camera);
        if let Some(depth) = depth {
            self.painter.depth(depth);
        }
        self.painter.ellipses(ellipses);
        T::draw(input.items, &mut self.painter);
        self.painter.finish(input.header);
        Ok(())
    }

    /// Warns once if pictures of several cameras may overwrite each other.
    fn warn_of_another_camera(&mut self, header: &Header) {
        let camera = header.origin();
        if self.names != Names::Stage && self.camera.is_some_and(|other| other != camera) && !self.is_reported {
            self.is_reported = true;
            tracing::warn!(
                "pictures of several cameras may overwrite each other\n  hint: `names = \"stage\"` calls them after their cameras"
            );
        }
        self.camera = Some(camera);
    }
}

/// Writes a PNG under a temporary name first, so that no reader sees half of it; `file` is the buffer for its bytes.
///
/// # Errors
/// The file cannot be written.
fn write_png(canvas: &Canvas, file: &mut Vec<u8>, path: &Path) -> Result<()> {
    file.clear();
    let (width, height) = canvas.size();
    let mut encoder = Encoder::new(&mut *file, width, height);
    encoder.set_color(ColorType::Rgb);
    encoder.set_depth(BitDepth::Eight);
    encoder.set_compression(Compression::Fast);
    encoder.write_header()?.write_image_data(canvas.bytes())?;
    write_whole(path, file)
}

/// Writes the pictures of two painters side by side into one PNG; `file` is the buffer for its bytes.
///
/// # Errors
/// The file cannot be written.
pub fn write_beside(painters: [&Painter; 2], file: &mut Vec<u8>, path: &Path) -> Result<()> {
    const GAP: u32 = 4;
    let [left, right] = painters.map(Painter::canvas);
    let ((width, height), (other_width, other_height)) = (left.size(), right.size());
    let mut both = Canvas::default();
    both.begin(width + GAP + other_width, height.max(other_height));
    left.shrink_into(&mut both, Box2 { left: 0, top: 0, width: width.into(), height: height.into() });
    let begin = i64::from(width + GAP);
    right.shrink_into(&mut both, Box2 { left: begin, top: 0, width: other_width.into(), height: other_height.into() });
    write_png(&both, file, path)
}

/// Returns `frame_000012.png`, `camera_000012.png`, or the stem of the frame's file if the source names one.
fn picture_name(header: &Header, names: Names) -> String {
    let source = Path::new(header.source.as_str().unwrap_or_default());
    match (names, source.extension(), source.file_stem()) {
        (Names::Source, Some(_), Some(stem)) => format!("{}.png", harmless(&stem.to_string_lossy())),
        (Names::Stage, ..) => format!("{}_{:06}.png", harmless(&header.origin().to_string()), header.sequence),
        _ => format!("frame_{:06}.png", header.sequence),
    }
}

/// Replaces the letters of a name from another process that could lead out of the folder, and shortens it to a valid file name.
fn harmless(name: &str) -> String {
    let allowed = |letter: char| letter.is_alphanumeric() || "._- ".contains(letter);
    let mut harmless: String = name.chars().map(|letter| if allowed(letter) { letter } else { '_' }).collect();
    harmless.truncate(harmless.floor_char_boundary(LONGEST_NAME));
    harmless
}

impl<T: Drawn> Stage for PictureSink<T> {
    const NAME: &'static str = "picture_sink";
    const SUMMARY: &'static str = "Writes PNGs of the depth image with ellipses, objects or tracks drawn over it";
    type Config = Config;
    type Input = T;
    type Output = Nothing;

    fn faults(config: &Self::Config, _: &Path) -> Vec<ConfigFault> {
        let mut faults = Vec::new();
        if config.path.is_none() && config.moving.is_none() {
            faults.push(ConfigFault::new("path", "is missing", "write `path = \"pictures/\"`"));
        }
        if let Some(Err(Hinted { what, hint, .. })) = config.moving.as_deref().map(check_moving) {
            faults.push(ConfigFault::new("moving", what, hint));
        }
        if config.near_m.zip(config.far_m).is_some_and(|(near, far)| near >= far) {
            let hint = "near is warm, far is cold: write the smaller depth here";
            faults.push(ConfigFault::new("near_m", "is not below `far_m`", hint));
        }
        faults
    }

    fn writes(config: &Self::Config, base: &Path) -> Vec<FileUse> {
        config.writes(base, "path", "moving")
    }

    fn new(config: Config, context: &Context) -> Result<Self, StageError> {
        Ok(Self::open(&config, &context.base, context.resume_at)?)
    }

    fn side_inputs() -> &'static [SideInput] {
        const { &[SideInput::same_frame::<u16>("depth"), SideInput::same_frame::<Ellipse>("ellipses")] }
    }

    fn step(
        &mut self,
        input: &Message<T>,
        side_inputs: &SideInputs,
        output: &mut Output<Nothing>,
    ) -> Result<(), StageError> {
        if self.take(input, side_inputs).map_err(stage_error)?.is_some() {
            output.count("pictures written", 1);
        }
        Ok(())
    }

    fn finish(&mut self) -> Result<(), StageError> {
        self.end().map_err(stage_error)
    }
}

#[cfg(test)]
mod tests;
