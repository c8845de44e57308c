//! `conicflow detect`: finds the objects of recorded frames, in one command without a pipeline file.

use super::invocation::write_to_stderr;
use crate::recording::files::looks_like_recording;
use crate::sinks::json_lines::{JsonLines, Wrote};
use crate::sinks::picture_sink::{self, Names, PictureSink};
use crate::sources::WrittenIn;
use crate::sources::image_source::{self, Playback, reading};
use crate::sources::mcap_source::{self, Replay};
use anyhow::{Context as _, Result, bail};
use clap::{ArgGroup, Args};
use conicflow_dataflow::{AnyMessage, FileUse, ItemType};
use conicflow_detection::camera::Intrinsics;
use conicflow_detection::noise::{NoiseConfig, NoiseName};
use conicflow_detection::{Detector, Object, ObjectKind};
use conicflow_messages::{Header, Hinted, Message, is_special};
use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::path::{Path, PathBuf};
use std::time::Instant;

/// Type of the items in the lines.
const OBJECTS: ItemType = ItemType::shown::<Object>();
/// Value of `--poses` that searches for poses beside the frames.
const AUTO: &str = "auto";
/// Number of reasons that are printed if nothing was found.
const REASONS: usize = 5;

/// The frames to read, and the destinations of the results.
#[derive(Args)]
#[command(group = ArgGroup::new("drawn").multiple(true))]
pub struct DetectArguments {
    /// A depth image (16-bit PNG, TIFF, NPY, organised PCD), a folder of them, TUM RGB-D folders included, or an MCAP recording
    path: PathBuf,
    /// Intrinsics in pixels [default: those of the file beside the frames or of the recording, or fitted to the points of PCD
    /// files]
    #[arg(long, value_name = "FX,FY,CX,CY", value_parser = intrinsics, allow_hyphen_values = true)]
    camera: Option<Intrinsics>,
    /// Metres per unit of depth [default: 0.001, of TUM folders 0.0002, of recordings as they say]
    #[arg(long, value_name = "M")]
    scale: Option<f64>,
    /// The camera's poses: `auto` (7-Scenes, TUM or Open3D poses beside the frames), `none`, or a path
    #[arg(long, value_name = "PATH", default_value = AUTO)]
    poses: String,
    /// The topic of a recording [default: the only one with depth images]
    #[arg(long, value_name = "TOPIC")]
    topic: Option<String>,
    /// The sensor's depth noise; its level in each image is estimated in addition [default: kinect_v1, of recordings by conicflow
    /// as recorded]
    #[arg(long, value_name = "NAME")]
    noise: Option<NoiseName>,
    /// Writes a picture of each frame into this folder: the depth in colours, the objects over it
    #[arg(long, value_name = "DIR", group = "drawn")]
    pictures: Option<PathBuf>,
    /// Writes one moving picture (APNG) of all frames into this file, up to 300 of them, for a README
    #[arg(long, value_name = "FILE", group = "drawn")]
    moving: Option<PathBuf>,
    /// Width of the moving picture in pixels; that of the frames where they are narrower
    #[arg(long, value_name = "PX", default_value_t = 480, requires = "moving", value_parser = clap::value_parser!(u32).range(16..=1920))]
    moving_width: u32,
    /// Draws every so many frames
    #[arg(long, value_name = "N", default_value_t = 1, requires = "drawn", value_parser = clap::value_parser!(u64).range(1..))]
    every: u64,
    /// Size of the pictures, as a multiple of the frames' size
    #[arg(long, value_name = "N", default_value_t = 1, requires = "pictures", value_parser = clap::value_parser!(u32).range(1..=8))]
    zoom: u32,
    /// Puts so many pictures, smaller, onto one contact sheet each, in the same folder
    #[arg(long, value_name = "N", requires = "pictures", value_parser = clap::value_parser!(u64).range(1..=100))]
    sheet: Option<u64>,
    /// Writes the lines of JSON into this file; - stands for standard output
    #[arg(long, value_name = "FILE", default_value = STANDARD_OUTPUT)]
    out: PathBuf,
}

/// Stands for standard output in place of a file.
const STANDARD_OUTPUT: &str = "-";

impl DetectArguments {
    /// Returns the file for the lines of JSON, unless they go to standard output.
    fn file(&self) -> Option<PathBuf> {
        (self.out != Path::new(STANDARD_OUTPUT)).then(|| self.out.clone())
    }
}

/// Parses four numbers separated by commas.
fn intrinsics(text: &str) -> Result<Intrinsics, String> {
    let numbers: Vec<f64> = text
        .split(',')
        .map(|number| number.trim().parse())
        .collect::<Result<_, _>>()
        .map_err(|_| "expected four numbers such as 525,525,319.5,239.5".to_owned())?;
    let &[fx, fy, cx, cy] = &numbers[..] else {
        return Err(format!("expected four numbers such as 525,525,319.5,239.5, not {}", numbers.len()));
    };
    let intrinsics = Intrinsics { fx, fy, cx, cy };
    if intrinsics.are_usable() {
        Ok(intrinsics)
    } else {
        Err("focal lengths are 1 to 1,000,000 pixels, and the principal point is no farther away".to_owned())
    }
}

/// Finds the objects of all frames, and writes them as lines of JSON and as pictures.
///
/// # Errors
/// There are no frames, their camera is not known, or an output cannot be written.
pub fn detect(arguments: &DetectArguments) -> Result<()> {
    refuse_unfit(arguments)?;
    arguments.moving.as_deref().map_or(Ok(()), picture_sink::check_moving)?;
    refuse_to_overwrite(arguments)?;
    let mut frames = Frames::open(arguments)?;
    let mut lines = match arguments.file() {
        Some(path) => JsonLines::open(&path, false)?,
        None => JsonLines::standard_output(),
    };
    let wants_pictures = arguments.pictures.is_some() || arguments.moving.is_some();
    let mut pictures = wants_pictures.then(|| pictures(arguments)).transpose()?;
    let mut detector = None;
    let (mut pixels, mut totals) = (Vec::new(), Totals::default());
    while let Some((start, header)) = frames.next(&mut pixels)? {
        let header = Header { sequence: totals.frames, ..header };
        let detector = detector_of(&mut detector, &header);
        let objects = detector.try_detect(&pixels)?;
        let message = Message { header: &header, items: &objects[..] };
        let latency_ms = Some((start.elapsed().as_micros() as f64) / 1000.0);
        let line = AnyMessage { header: &header, item: &OBJECTS, bytes: bytemuck::cast_slice(&objects) };
        if lines.write_with(|text| line.write_json(latency_ms, text))? == Wrote::ReaderGone {
            return Ok(());
        }
        if let Some(pictures) = &mut pictures {
            let depth = Message { header: &header, items: &pixels[..] };
            pictures.write_picture(&message, Some(&depth), &[]).context("pictures")?;
        }
        totals.add(&objects, detector);
    }
    pictures.as_mut().map_or(Ok(()), PictureSink::end).context("pictures")?;
    write_to_stderr(totals.text(&frames.take_counts()));
    frames.finish()
}

/// Refuses a path without frames, and options that have no effect on its frames.
fn refuse_unfit(arguments: &DetectArguments) -> Result<()> {
    let path = &arguments.path;
    if !path.exists() || is_special(path) {
        let fault = if path.exists() { "is neither a file nor a folder" } else { "does not exist" };
        bail!(Hinted::new(
            format!("`{}` {fault}", path.display()),
            "name a depth image, a folder of them, or a recording"
        ));
    }
    match looks_like_recording(path) {
        true if arguments.poses != AUTO => {
            bail!(Hinted::new("`--poses` is for images: a recording brings its own", "leave it out"))
        }
        false if arguments.topic.is_some() => {
            bail!(Hinted::new("`--topic` is for recordings: images have none", "leave it out"))
        }
        _ => Ok(()),
    }
}

/// Refuses outputs that are also inputs or written twice, before anything is created or opened.
fn refuse_to_overwrite(arguments: &DetectArguments) -> Result<()> {
    let base = Path::new("");
    let written: Vec<_> = FileUse::given(base, [("--out", &arguments.file())])
        .into_iter()
        .chain(picture_config(arguments).writes(base, "--pictures", "--moving"))
        .collect();
    let read = if written.is_empty() { Vec::new() } else { files_read(arguments) };
    let in_words = |files: &FileUse| format!("`{}`", files.key);
    for (index, files) in written.iter().enumerate() {
        let writer = in_words(files);
        let over_read = read.iter().find_map(|read| files.conflict_with_read(&writer, read, &in_words(read)));
        let mut earlier = written[..index].iter();
        let over_written = || earlier.find_map(|other| files.conflict_with_written(&writer, other, &in_words(other)));
        over_read.or_else(over_written).map_or(Ok(()), Err)?;
    }
    Ok(())
}

/// Returns the files that are read.
fn files_read(arguments: &DetectArguments) -> Vec<FileUse> {
    let base = Path::new("");
    match FramesConfig::of(arguments) {
        FramesConfig::Recording(config) => config.reads(base, "PATH"),
        FramesConfig::Images(config) => reading::files(&config, base, "PATH", "--poses"),
    }
}

/// Creates the sink for the pictures.
fn pictures(arguments: &DetectArguments) -> Result<PictureSink<Object>> {
    PictureSink::open(&picture_config(arguments), Path::new(""), 0)
}

fn picture_config(arguments: &DetectArguments) -> picture_sink::Config {
    picture_sink::Config {
        path: arguments.pictures.clone(),
        moving: arguments.moving.clone(),
        moving_width_px: arguments.moving_width,
        every: arguments.every,
        names: Names::Source,
        zoom: arguments.zoom,
        sheet: arguments.sheet.unwrap_or(0) as usize,
        ..picture_sink::Config::default()
    }
}

/// Returns the detector for a frame's camera; the camera of point clouds may differ from frame to frame.
fn detector_of<'a>(detector: &'a mut Option<(Header, Detector)>, header: &Header) -> &'a mut Detector {
    let is_other = |known: &Header| (known.camera, known.depth_scale) != (header.camera, header.depth_scale);
    detector.take_if(|(known, _)| is_other(known));
    let new = || (*header, Detector::new(header.camera).noise(header.noise).depth_scale(header.depth_scale));
    &mut detector.get_or_insert_with(new).1
}

/// The parameters of the source of frames.
enum FramesConfig {
    Images(image_source::Config),
    Recording(mcap_source::Config),
}

impl FramesConfig {
    fn of(arguments: &DetectArguments) -> Self {
        let (path, noise) = (Some(arguments.path.clone()), arguments.noise.map(NoiseConfig::Named));
        let (depth_scale, intrinsics, written_in) = (arguments.scale, arguments.camera, WrittenIn::CommandLine);
        if looks_like_recording(&arguments.path) {
            let topic = arguments.topic.clone();
            let config =
                mcap_source::Config { path, topic, depth_scale, intrinsics, noise, written_in, ..Default::default() };
            return Self::Recording(config);
        }
        let noise = noise.unwrap_or_default();
        let poses = arguments.poses.clone().into();
        let config =
            image_source::Config { path, depth_scale, intrinsics, poses, noise, written_in, ..Default::default() };
        Self::Images(config)
    }
}

/// The source of frames.
enum Frames {
    Images(Box<Playback>),
    Recording(Box<Replay>),
}

impl Frames {
    fn open(arguments: &DetectArguments) -> Result<Self> {
        let base = Path::new("");
        Ok(match FramesConfig::of(arguments) {
            FramesConfig::Images(config) => Self::Images(Box::new(Playback::open(&config, base, 0, 0)?)),
            FramesConfig::Recording(config) => {
                Self::Recording(Box::new(Replay::open(&config, base, &ItemType::of::<u16>())?))
            }
        })
    }

    /// Reads the next readable frame: writes its pixels, and returns its header and the instant before it was decoded.
    fn next(&mut self, pixels: &mut Vec<u16>) -> Result<Option<(Instant, Header)>> {
        match self {
            Self::Images(playback) => {
                while let Some(loaded) = playback.load()? {
                    let start = Instant::now();
                    pixels.resize(loaded.pixels(), 0);
                    if let Some(header) = playback.decode(&loaded, pixels)? {
                        return Ok(Some((start, header)));
                    }
                }
                Ok(None)
            }
            Self::Recording(replay) => {
                let start = Instant::now();
                let Some(replayed) = replay.next_message()? else { return Ok(None) };
                *pixels = replayed.items_as();
                Ok(Some((start, replayed.header)))
            }
        }
    }

    /// Returns an error if frames that were readable at the beginning could not be read later.
    fn finish(&self) -> Result<()> {
        match self {
            Self::Images(playback) => playback.finish(),
            // `next` has reported the error already.
            Self::Recording(_) => Ok(()),
        }
    }

    /// Returns the counts of the source.
    fn take_counts(&mut self) -> BTreeMap<&'static str, u64> {
        match self {
            Self::Images(playback) => playback.take_counts().collect(),
            Self::Recording(replay) => replay.take_counts().collect(),
        }
    }
}

/// The results of all frames.
#[derive(Default)]
struct Totals {
    frames: u64,
    found: BTreeMap<&'static str, u64>,
    rejections: BTreeMap<&'static str, u64>,
}

impl Totals {
    fn add(&mut self, objects: &[Object], detector: &Detector) {
        self.frames += 1;
        for object in objects {
            *self.found.entry(object.shape().name()).or_default() += 1;
        }
        for (reason, times) in detector.rejections() {
            *self.rejections.entry(reason).or_default() += times;
        }
    }

    /// Returns a line with the number of found objects and the counts of the source; if nothing was found, also the reasons.
    fn text(&self, of_source: &BTreeMap<&'static str, u64>) -> String {
        let mut text = format!("in {} frames: ", self.frames);
        let found: Vec<String> = ObjectKind::ALL
            .iter()
            .filter_map(|kind| Some(format!("{} {}", kind.name(), self.found.get(kind.name())?)))
            .collect();
        text += &if found.is_empty() { "nothing was found".to_owned() } else { found.join(", ") };
        for (what, times) in of_source.iter().filter(|(_, times)| **times > 0) {
            // Writing to a string cannot fail.
            write!(text, "; {what}: {times}").ok();
        }
        if found.is_empty() {
            let mut reasons: Vec<_> = self.rejections.iter().collect();
            reasons.sort_by_key(|(_, times)| std::cmp::Reverse(**times));
            for (reason, times) in reasons.into_iter().take(REASONS) {
                write!(text, "\n  {times} {reason}").ok();
            }
        }
        text
    }
}
