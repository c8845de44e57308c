//! Plays back recorded depth frames: folders of 16-bit PNGs, TUM RGB-D folders, organised PCD files.
//!
//! A frame that cannot be read is reported, counted as `frames unreadable` and passed over; its place in time is kept.
//! It is an error when none can be read, and when frames are of different sizes.

mod depth_png;
mod intrinsics;
mod layout;
mod natural;
mod pcd;
mod pinhole;
mod recording;
mod tum;

#[cfg(test)]
mod fixtures;

pub use recording::{Frame, Options, Recording};

use anyhow::{Context as _, anyhow};
use conicflow_dataflow::{ConfigFault, Context, Next, Output, Sides, Source, StageError};
use conicflow_detection::camera::Intrinsics;
use conicflow_detection::noise::NoiseConfig;
use conicflow_lab::quantile::median_depth;
use conicflow_messages::{Camera, Header, MAX_PIXELS, NoiseModel, Text, is_measured};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

/// Frames per second by which frames without time stamps are stamped when `rate_hz` is 0.
const USUAL_RATE_HZ: f64 = 30.0;

/// Median depths outside of this, in metres, speak for a wrong `depth_scale`.
const PLAUSIBLE_DEPTH_M: std::ops::Range<f64> = 0.1..20.0;

/// A principal point farther from the middle, as a share of the image's size, speaks for intrinsics of other images.
const MAX_OFF_CENTER: f64 = 0.25;

const UNREADABLE: &str = "frames unreadable";
const TOO_FAR: &str = "points too far";

/// Parameters of [`ImageSource`].
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// The recording: a folder of 16-bit PNGs or organised PCD files, a TUM RGB-D folder, or a single such file. Points of PCD
    /// beyond 16.38 m are left out.
    pub path: Option<PathBuf>,
    /// Metres per unit of the file; default: as `camera.json` says, else 0.001, for TUM 0.0002, for PCD 1.
    #[schemars(range(min = 0.0))]
    pub depth_scale: Option<f64>,
    /// fx, fy, cx, cy in pixels; default: from a JSON file beside the frames, for PCD else fitted to the points.
    pub intrinsics: Option<Intrinsics>,
    /// Frames per second; 0: as fast as the pipeline takes them, stamped as at 30 Hz. Recorded time stamps are kept.
    #[schemars(range(min = 0.0))]
    pub rate_hz: f64,
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
}

impl Default for Config {
    fn default() -> Self {
        Self {
            path: None,
            depth_scale: None,
            intrinsics: None,
            rate_hz: USUAL_RATE_HZ,
            noise: NoiseConfig::default(),
            repeat: false,
            first: 0,
            frames: None,
        }
    }
}

impl Config {
    /// What types and ranges cannot tell: values that exclude each other, files that are missing.
    pub fn faults(&self, base: &Path) -> Vec<ConfigFault> {
        let fault = |key, what: String, hint: &str| ConfigFault { key, what, hint: hint.to_owned() };
        let mut faults = Vec::new();
        match self.path.as_ref().map(|path| base.join(path)) {
            None => faults.push(fault("path", "is missing".to_owned(), "write `path = \"folder/\"`")),
            Some(path) if !path.exists() => {
                let what = format!("`{}` does not exist", path.display());
                faults.push(fault("path", what, "relative paths start at the pipeline file's folder"));
            }
            Some(_) => {}
        }
        if self.depth_scale.is_some_and(|scale| !(scale.is_normal() && scale > 0.0)) {
            faults.push(fault("depth_scale", "is not above 0".to_owned(), "0.001 for millimetres"));
        }
        if self.intrinsics.is_some_and(|intrinsics| !intrinsics.are_usable()) {
            faults.push(fault(
                "intrinsics",
                "need fx and fy of at least one pixel, and finite cx and cy".to_owned(),
                "take them from the camera's calibration",
            ));
        }
        faults
    }
}

/// Sends the frames of a recording.
pub struct ImageSource {
    recording: Recording,
    clock: Clock,
    noise: NoiseModel,
    rate_hz: f64,
    repeat: bool,
    /// Frames sent or passed over, over all rounds.
    position: u64,
    /// Frames passed over since the last one that could be read.
    misses: usize,
    /// Files found unreadable at the start that have not been counted yet.
    uncounted: u64,
    described: bool,
    /// Whether it was said that a frame has no measurement.
    told_empty: bool,
    /// Whether the intrinsics are those of the pipeline file.
    given_intrinsics: bool,
}

impl ImageSource {
    fn open(config: &Config, context: &Context) -> anyhow::Result<Self> {
        let path = config.path.as_ref().context("`path` is missing\n  hint: write `path = \"folder/\"`")?;
        let Config { depth_scale, intrinsics, first, frames, .. } = *config;
        let options = Options { depth_scale, intrinsics, first, frames };
        let recording = Recording::open(&context.resolve(path), &options)?;
        for error in recording.unreadable() {
            tracing::warn!("passed over: {error:#}");
        }
        // Of what was counted before a restart, the rest are frames that were passed over between those sent.
        let unreadable = recording.unreadable().len() as u64;
        let counted = context.counted.get(UNREADABLE).copied().unwrap_or(0);
        Ok(Self {
            clock: Clock::new(&recording, config.rate_hz),
            noise: config.noise.into(),
            rate_hz: config.rate_hz,
            repeat: config.repeat,
            position: context.resume_at + counted.saturating_sub(unreadable),
            misses: 0,
            uncounted: unreadable.saturating_sub(counted),
            described: false,
            told_empty: false,
            given_intrinsics: intrinsics.is_some(),
            recording,
        })
    }

    /// Round and index of the next frame, if there is one.
    fn advance(&mut self) -> Option<(u64, usize)> {
        let count = self.recording.len() as u64;
        let (round, index) = (self.position / count, self.position % count);
        (self.repeat || round == 0).then(|| {
            self.position += 1;
            (round, index as usize)
        })
    }

    fn pass_over(&mut self, error: &anyhow::Error) -> anyhow::Result<()> {
        self.misses += 1;
        if self.misses >= self.recording.len() {
            let none = format!("none of the {} frames can be read; the last: {error:#}", self.misses);
            return Err(hinted(
                anyhow!(none),
                "look at one with another program; record them anew, or copy them again",
            ));
        }
        // Once is enough for a file that a loop meets in every round.
        if self.position <= self.recording.len() as u64 {
            tracing::warn!("passed over: {error:#}");
        }
        Ok(())
    }

    /// Says once what the frames are like, so that a wrong scale is seen.
    fn describe(&mut self, frame: &Frame, pixels: &[u16]) {
        let Some(median) = median_depth(pixels).filter(|_| !self.described) else { return };
        self.described = true;
        let median_m = f64::from(median) * frame.depth_scale;
        let (name, count, camera) = (&frame.name, self.recording.len(), frame.camera);
        tracing::info!(
            "{count} frames of {}x{}, fx {:.2} fy {:.2} cx {:.2} cy {:.2}; `{name}` has a median depth of {median_m:.3} m",
            camera.width,
            camera.height,
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy
        );
        if !PLAUSIBLE_DEPTH_M.contains(&median_m) {
            tracing::warn!(
                "a median depth of {median_m:.3} m is not plausible\n  hint: `depth_scale` is in metres per unit: 0.001 \
                 for millimetres, 0.0002 for TUM"
            );
        }
        if self.given_intrinsics && is_off_center(&camera) {
            tracing::warn!(
                "`intrinsics` have the principal point at ({}, {}), far from the middle of images of {}x{}\n  hint: are \
                 they those of another resolution? they scale with the image",
                camera.cx,
                camera.cy,
                camera.width,
                camera.height
            );
        }
    }
}

impl ImageSource {
    /// Says once that a frame is empty.
    fn look_for_emptiness(&mut self, frame: &Frame, pixels: &[u16], too_far: u64) {
        if let Some(why) = emptiness(pixels, too_far).filter(|_| !self.told_empty) {
            self.told_empty = true;
            tracing::warn!("`{}`: {why}", frame.name);
        }
    }
}

impl Source for ImageSource {
    const NAME: &'static str = "image_source";
    const SUMMARY: &'static str =
        "Plays back recorded depth frames: 16-bit PNGs, TUM RGB-D folders, organised PCD files";
    type Config = Config;
    type Output = u16;

    fn faults(config: &Self::Config, base: &Path) -> Vec<ConfigFault> {
        config.faults(base)
    }

    fn new(config: Config, context: &Context) -> Result<Self, StageError> {
        Ok(Self::open(&config, context)?)
    }

    fn message_length(config: &Config, base: &Path) -> Option<usize> {
        let Config { depth_scale, intrinsics, first, frames, .. } = *config;
        let options = Options { depth_scale, intrinsics, first, frames };
        // What cannot be opened is told when the stage starts.
        Recording::open(&base.join(config.path.as_ref()?), &options).ok().map(|recording| recording.pixels())
    }

    fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    fn total(&self) -> Option<u64> {
        (!self.repeat).then_some(self.recording.len() as u64)
    }

    fn next(&mut self, _: &Sides, output: &mut Output<u16>) -> Result<Next, StageError> {
        output.count(UNREADABLE, std::mem::take(&mut self.uncounted));
        while let Some((round, index)) = self.advance() {
            let frame = match self.recording.load(index) {
                Ok(frame) => frame,
                Err(error) => {
                    self.pass_over(&error)?;
                    output.count(UNREADABLE, 1);
                    continue;
                }
            };
            let pixels = output.image(frame.camera.width as usize * frame.camera.height as usize)?;
            let too_far = match self.recording.decode(pixels) {
                Ok(too_far) => too_far,
                Err(error) => {
                    self.pass_over(&error.context(format!("`{}`", frame.name)))?;
                    output.count(UNREADABLE, 1);
                    continue;
                }
            };
            self.misses = 0;
            self.describe(&frame, pixels);
            self.look_for_emptiness(&frame, pixels, too_far);
            output.count(TOO_FAR, too_far);
            output.header = self.header(&frame, round);
            return Ok(Next::Message);
        }
        Ok(Next::End)
    }
}

impl ImageSource {
    fn header(&self, frame: &Frame, round: u64) -> Header {
        Header {
            camera: frame.camera,
            depth_scale: frame.depth_scale,
            noise: self.noise,
            stamp_ns: self.clock.stamp_ns(frame, round),
            source: Text::new(&frame.name),
            ..Header::default()
        }
    }
}

/// Gives every frame its time of capture.
#[derive(Clone, Copy, Debug)]
struct Clock {
    rate_hz: f64,
    /// Places in one round.
    slots: u64,
    /// How long one round of recorded time stamps takes.
    round_ns: u64,
}

impl Clock {
    fn new(recording: &Recording, rate_hz: f64) -> Self {
        let rate_hz = if rate_hz > 0.0 { rate_hz } else { USUAL_RATE_HZ };
        let span_ns = recording.stamps_ns().map_or(0, |(first, last)| last.saturating_sub(first));
        let steps = recording.len().saturating_sub(1).max(1) as u64;
        let round_ns = if span_ns > 0 { span_ns + span_ns / steps } else { (1e9 / rate_hz).round() as u64 };
        Self { rate_hz, slots: recording.slots(), round_ns }
    }

    fn stamp_ns(&self, frame: &Frame, round: u64) -> u64 {
        match frame.stamp_ns {
            Some(stamp_ns) => stamp_ns + round * self.round_ns,
            None => ((round * self.slots + frame.slot) as f64 * 1e9 / self.rate_hz).round() as u64,
        }
    }
}

/// Why a frame has no measurement; `None`: it has some. Points in millimetres are too far away.
fn emptiness(pixels: &[u16], too_far: u64) -> Option<String> {
    if pixels.iter().any(|&pixel| is_measured(pixel)) {
        return None;
    }
    let why = match too_far {
        0 => "no pixel is measured, all are 0, 65535 or not a number\n  hint: nothing can be found there; was the camera \
              covered, or too near?"
            .to_owned(),
        _ => format!(
            "all {too_far} points are too far away and left out\n  hint: if they are in millimetres, write `depth_scale = \
             0.001`"
        ),
    };
    Some(why)
}

/// Whether the principal point is farther from the middle of the image than [`MAX_OFF_CENTER`] of its size.
fn is_off_center(camera: &Camera) -> bool {
    let is_off = |center: f64, size: u32| {
        let size = f64::from(size);
        (center - 0.5 * (size - 1.0)).abs() > MAX_OFF_CENTER * size
    };
    is_off(camera.cx, camera.width) || is_off(camera.cy, camera.height)
}

/// An error with what to do about it, where it does not say so itself.
fn hinted(error: anyhow::Error, hint: &str) -> anyhow::Error {
    let text = format!("{error:#}");
    if text.contains("\n  hint: ") { error } else { anyhow!("{text}\n  hint: {hint}") }
}

/// The beginning of a line, for an error.
fn excerpt(line: &str) -> String {
    line.trim_end().chars().take(60).collect()
}

#[cfg(test)]
mod tests;
