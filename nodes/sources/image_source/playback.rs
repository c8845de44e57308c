//! Plays the frames of a recording one by one; skips, counts and logs unreadable ones.

use super::config::{Config, USUAL_RATE_HZ};
use super::poses::Poses;
use super::recording::{Frame, Recording};
use anyhow::Result;
use conicflow_dataflow::{EmptyFrames, TOO_FAR, report_frame};
use conicflow_messages::{Camera, HAS_POSE, Header, Hinted, NoiseModel, RECORDED, Text};
use std::collections::BTreeMap;
use std::path::Path;

/// Largest distance of the principal point from the middle, as a share of the image's size; beyond it, the intrinsics are
/// probably those of other images.
const MAX_OFF_CENTER: f64 = 0.25;

pub(super) const UNREADABLE: &str = "frames unreadable";
const WITHOUT_POSE: &str = "frames without pose";

/// Plays a recording back.
pub struct Playback {
    pub(super) recording: Recording,
    poses: Poses,
    clock: Clock,
    noise: NoiseModel,
    rate_hz: f64,
    repeat: bool,
    /// Frames sent or skipped, over all rounds.
    pub(super) position: u64,
    /// Frames that were read and sent, over all rounds.
    sent: u64,
    /// Frames skipped since the last readable one.
    misses: usize,
    /// Frames that were readable when the recording was opened, but not when their turn came: their number, and the first error.
    lost: Option<(u64, String)>,
    /// Counts since the last call of `take_counts`.
    counts: BTreeMap<&'static str, u64>,
    described: bool,
    empty: EmptyFrames,
    /// Whether the intrinsics are given; else they are fitted to the points.
    has_given_camera: bool,
}

impl Playback {
    /// Opens the recording that `config` names, relative to `base`, at frame `resume_at`; `counted` unreadable frames have been
    /// counted already.
    ///
    /// # Errors
    /// There is no recording, or its camera is not known.
    pub fn open(config: &Config, base: &Path, resume_at: u64, counted: u64) -> Result<Self> {
        Self::open_with_progress(config, base, (resume_at, counted), &mut |_, _| ())
    }

    /// Opens a recording as [`Playback::open`] does, and reports to `progress` the number of files seen and of all files.
    ///
    /// # Errors
    /// As for [`Playback::open`].
    pub fn open_with_progress(
        config: &Config,
        base: &Path,
        (resume_at, counted): (u64, u64),
        progress: &mut dyn FnMut(usize, usize),
    ) -> Result<Self> {
        let path =
            config.path.as_ref().ok_or_else(|| Hinted::new("`path` is missing", "write `path = \"folder/\"`"))?;
        let recording = Recording::open_with_progress(&base.join(path), config, progress)?;
        let poses = Poses::find(&config.poses, base, &recording, progress)?;
        for error in recording.unreadable() {
            tracing::warn!("passed over: {error:#}");
        }
        // Beyond those known as unreadable, the frames counted before a restart are ones that were skipped between those sent.
        let unreadable = recording.unreadable().len() as u64;
        Ok(Self {
            clock: Clock::new(&recording, config.rate_hz),
            noise: config.noise.into(),
            rate_hz: config.rate_hz,
            repeat: config.repeat,
            position: resume_at + counted.saturating_sub(unreadable),
            sent: resume_at,
            misses: 0,
            lost: None,
            counts: BTreeMap::from([(UNREADABLE, unreadable.saturating_sub(counted))]),
            described: false,
            empty: EmptyFrames::default(),
            has_given_camera: recording.has_given_camera(),
            poses,
            recording,
        })
    }

    /// Reads the file of the next readable frame; `None` at the end.
    ///
    /// # Errors
    /// None of the frames can be read.
    pub fn load(&mut self) -> Result<Option<Loaded>> {
        while let Some((round, index)) = self.advance() {
            match self.recording.load(index) {
                Ok(frame) => return Ok(Some(Loaded { frame, round })),
                Err(error) => self.pass_over(&error)?,
            }
        }
        Ok(None)
    }

    /// Writes the depths of the last loaded frame and returns the header of its message; `None` if the file is damaged.
    ///
    /// # Errors
    /// None of the frames can be read.
    pub fn decode(&mut self, loaded: &Loaded, pixels: &mut [u16]) -> Result<Option<Header>> {
        let Loaded { frame, round } = loaded;
        let too_far = match self.recording.decode(pixels) {
            Ok(too_far) => too_far,
            Err(error) => {
                self.pass_over(&error.context(format!("`{}`", frame.name)))?;
                return Ok(None);
            }
        };
        self.misses = 0;
        self.sent += 1;
        self.describe(frame, pixels);
        self.empty.look(&frame.name, pixels, too_far);
        *self.counts.entry(TOO_FAR).or_default() += too_far;
        let header = self.header(frame, *round);
        let lacks_pose = self.poses.are_known() && header.pose().is_none();
        *self.counts.entry(WITHOUT_POSE).or_default() += u64::from(lacks_pose);
        Ok(Some(header))
    }

    /// Ends the playback.
    ///
    /// # Errors
    /// Some frames were readable when the recording was opened, but not when their turn came: it was removed or changed.
    pub fn finish(&self) -> Result<()> {
        let Some((lost, why)) = &self.lost else { return Ok(()) };
        let (all, sent) = (self.recording.len(), self.sent);
        let what =
            format!("{lost} of {all} frames could not be read any more when their turn came, {sent} were: {why}");
        Err(Hinted::lasting(what, "leave a recording as it is while it is played, and its disk in its place").into())
    }

    /// Returns the counts since the last call.
    pub fn take_counts(&mut self) -> impl Iterator<Item = (&'static str, u64)> + use<> {
        std::mem::take(&mut self.counts).into_iter()
    }

    /// Frames per second to send; 0: as fast as the pipeline takes them.
    pub fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    /// Number of all frames; `None` for a loop.
    pub fn total(&self) -> Option<u64> {
        (!self.repeat).then_some(self.recording.len() as u64)
    }

    /// Returns round and index of the next frame, if there is one.
    pub(super) fn advance(&mut self) -> Option<(u64, usize)> {
        let count = self.recording.len() as u64;
        let (round, index) = (self.position / count, self.position % count);
        (self.repeat || round == 0).then(|| {
            self.position += 1;
            (round, index as usize)
        })
    }

    pub(super) fn pass_over(&mut self, error: &anyhow::Error) -> Result<()> {
        self.misses += 1;
        *self.counts.entry(UNREADABLE).or_default() += 1;
        let index = (self.position.saturating_sub(1) % self.recording.len() as u64) as usize;
        if self.recording.is_lost(index) {
            let (lost, _) = self.lost.get_or_insert_with(|| (0, Hinted::of(error.as_ref(), "").what));
            *lost += 1;
        }
        if self.misses >= self.recording.len() {
            let hint = "look at one with another program; record them anew, or copy them again";
            let Hinted { what, hint, .. } = Hinted::of(error.as_ref(), hint);
            let none = format!("none of the {} frames can be read; the last: {what}", self.misses);
            return Err(Hinted::lasting(none, hint).into());
        }
        // In a loop, a file is logged in the first round only.
        if self.position <= self.recording.len() as u64 {
            tracing::warn!("passed over: {error:#}");
        }
        Ok(())
    }

    /// Logs once the resolution and depths of the frames, so that a wrong scale is seen.
    fn describe(&mut self, frame: &Frame, pixels: &[u16]) {
        if self.described {
            return;
        }
        let (what, camera) = (format!("{} frames", self.recording.len()), frame.camera);
        self.described = report_frame(&what, &frame.name, &camera, frame.depth_scale, pixels);
        if self.described && self.has_given_camera && is_off_center(&camera) {
            tracing::warn!(
                "the camera's principal point is at ({}, {}), far from the middle of images of {}x{}\n  hint: are \
                 the intrinsics those of another resolution? they scale with the image",
                camera.cx,
                camera.cy,
                camera.width,
                camera.height
            );
        }
    }

    pub(super) fn header(&self, frame: &Frame, round: u64) -> Header {
        let world_from_camera = self.poses.of_frame(frame);
        Header {
            camera: frame.camera,
            depth_scale: frame.depth_scale,
            noise: self.noise,
            stamp_ns: self.clock.stamp_ns(frame, round),
            source: Text::new(&frame.name),
            world_from_camera: world_from_camera.unwrap_or_default(),
            flags: if world_from_camera.is_some() { RECORDED | HAS_POSE } else { RECORDED },
            ..Header::default()
        }
    }
}

/// A frame whose file was loaded.
pub struct Loaded {
    frame: Frame,
    round: u64,
}

impl Loaded {
    /// Number of pixels.
    pub fn pixels(&self) -> usize {
        self.frame.camera.width as usize * self.frame.camera.height as usize
    }
}

/// Computes the time of capture of each frame.
#[derive(Clone, Copy, Debug)]
pub(super) struct Clock {
    rate_hz: f64,
    /// Number of positions in one round.
    slots: u64,
    /// Duration of one round by its recorded time stamps.
    round_ns: u64,
}

impl Clock {
    pub(super) fn new(recording: &Recording, rate_hz: f64) -> Self {
        let rate_hz = if rate_hz > 0.0 { rate_hz } else { USUAL_RATE_HZ };
        let span_ns = recording.stamps_ns().map_or(0, |(first, last)| last.saturating_sub(first));
        let steps = recording.len().saturating_sub(1).max(1) as u64;
        let round_ns =
            if span_ns > 0 { span_ns.saturating_add(span_ns / steps) } else { (1e9 / rate_hz).round() as u64 };
        Self { rate_hz, slots: recording.slots(), round_ns }
    }

    pub(super) fn stamp_ns(&self, frame: &Frame, round: u64) -> u64 {
        match frame.stamp_ns {
            Some(stamp_ns) => stamp_ns.saturating_add(round.saturating_mul(self.round_ns)),
            None => ((round * self.slots + frame.slot) as f64 * 1e9 / self.rate_hz).round() as u64,
        }
    }
}

/// Whether the principal point is farther from the middle of the image than [`MAX_OFF_CENTER`] of its size.
pub(super) fn is_off_center(camera: &Camera) -> bool {
    let is_off = |center: f64, size: u32| {
        let size = f64::from(size);
        (center - 0.5 * (size - 1.0)).abs() > MAX_OFF_CENTER * size
    };
    is_off(camera.cx, camera.width) || is_off(camera.cy, camera.height)
}
