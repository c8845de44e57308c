//! A source for a camera: raw frames of 16-bit depths (Z16, little-endian, row by row) from a pipe or a file.
//!
//! Every depth camera with a Linux driver can deliver its frames like this:
//!
//! ```console
//! $ mkfifo depth.z16
//! $ v4l2-ctl -d /dev/video2 --set-fmt-video=width=640,height=480,pixelformat='Z16 ' --stream-mmap --stream-to=depth.z16
//! ```
//!
//! ```toml
//! [stage.camera]
//! program     = ["target/release/examples/raw_camera"]
//! output      = "depth"
//! path        = "depth.z16"
//! camera      = { width = 640, height = 480, fx = 385.0, fy = 385.0, cx = 319.5, cy = 239.5 }
//! depth_scale = 0.001
//! noise       = { floor_m = 0.0, growth_per_m = 0.002, knee_m = 0.0, step_per_m = 0.0 }
//! ```
//!
//! A source that uses the library of a camera works the same way. It opens the device when the first frame is requested, because
//! a stage that cannot be initialised ends the run, while one that fails later is restarted; and it checks [`Stop::requested`]
//! while it waits.

use anyhow::{Context as _, bail};
use conicflow_dataflow::{Context, Next, Output, SideInputs, Source, StageError, Stop, run_source};
use conicflow_messages::{Camera, Header, NoiseModel, Text};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::fs::{Mode, OFlags, open};
use rustix::io::Errno;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::fs::File;
use std::io::{ErrorKind, Read};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::UNIX_EPOCH;

/// Parameters of `raw_camera`.
#[derive(Clone, Debug, Default, Deserialize, Serialize, JsonSchema)]
#[serde(deny_unknown_fields)]
struct RawCameraConfig {
    /// The pipe or file that the frames come from.
    path: PathBuf,
    /// Size and pinhole intrinsics, in pixels.
    #[schemars(with = "serde_json::Value")]
    camera: Camera,
    /// Metres per unit of a pixel.
    depth_scale: f64,
    /// Coefficients of the depth noise, as determined with `experiments/noise.toml`.
    #[schemars(with = "serde_json::Value")]
    noise: NoiseModel,
}

/// Sends the frames of a camera.
struct RawCamera {
    config: RawCameraConfig,
    path: PathBuf,
    device: Option<File>,
    stop: Stop,
}

impl Source for RawCamera {
    const NAME: &'static str = "raw_camera";
    const SUMMARY: &'static str = "Sends raw 16-bit depth frames from a pipe or a file";
    type Config = RawCameraConfig;
    type Output = u16;

    fn new(config: RawCameraConfig, context: &Context) -> Result<Self, StageError> {
        let path = context.resolve(&config.path);
        Ok(Self { config, path, device: None, stop: context.stop.clone() })
    }

    fn message_length(config: &RawCameraConfig, _: &Path) -> Option<usize> {
        Some(pixels(&config.camera))
    }

    fn next(&mut self, _: &SideInputs, output: &mut Output<u16>) -> Result<Next, StageError> {
        let device = match &mut self.device {
            Some(device) => device,
            none => none.insert(open_device(&self.path)?),
        };
        let image = output.loan(pixels(&self.config.camera))?;
        if !read_frame(device, bytemuck::cast_slice_mut(image), &self.stop)? {
            return Ok(Next::End);
        }
        output.header = Header {
            camera: self.config.camera,
            depth_scale: self.config.depth_scale,
            noise: self.config.noise,
            stamp_ns: now_ns(),
            source: Text::new(Self::NAME),
            ..Header::default()
        };
        Ok(Next::Message)
    }
}

fn pixels(camera: &Camera) -> usize {
    camera.width as usize * camera.height as usize
}

/// Nanoseconds since the Unix epoch, as stamps are.
fn now_ns() -> u64 {
    UNIX_EPOCH.elapsed().map_or(0, |since| since.as_nanos() as u64)
}

/// Opens a pipe without waiting for its writer.
fn open_device(path: &Path) -> anyhow::Result<File> {
    let device = open(path, OFlags::RDONLY | OFlags::NONBLOCK | OFlags::CLOEXEC, Mode::empty());
    Ok(File::from(device.with_context(|| format!("cannot open `{}`", path.display()))?))
}

/// Reads a frame; returns false if the stream or the run has ended before.
fn read_frame(device: &mut File, frame: &mut [u8], stop: &Stop) -> anyhow::Result<bool> {
    let mut filled = 0;
    while filled < frame.len() {
        let patience = Timespec { tv_sec: 0, tv_nsec: 100_000_000 };
        // A signal that asks the stage to end interrupts the wait.
        let (Ok(0) | Err(Errno::INTR)) = poll(&mut [PollFd::new(device, PollFlags::IN)], Some(&patience)) else {
            filled += match device.read(&mut frame[filled..]) {
                Ok(0) if filled == 0 => return Ok(false),
                Ok(0) => bail!(
                    "the stream ends {} bytes before the end of a frame\n  hint: `camera` may have another size than it",
                    frame.len() - filled
                ),
                Ok(bytes) => bytes,
                Err(error) if matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::Interrupted) => 0,
                Err(error) => return Err(error.into()),
            };
            continue;
        };
        if stop.requested() {
            return Ok(false);
        }
    }
    Ok(true)
}

fn main() -> ExitCode {
    run_source::<RawCamera>()
}
