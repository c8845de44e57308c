//! Access to Linux video devices: the trait that the source needs, and its implementation by the kernel.
//!
//! Calls to the kernel go through `linuxvideo`, which is pure Rust with a safe interface; `v4l` and `v4l2r` generate their
//! bindings with libclang, which would be needed for each build. It gives neither the kernel's time stamp nor the sequence number
//! of a buffer. The code from [`LinuxVideo`] on needs a device and was not tested with one.

use super::format::{DepthFormat, Layout};
use linuxvideo::format::{FrameIntervals, FrameSizes, PixFormat, PixelFormat};
use linuxvideo::stream::ReadStream;
use linuxvideo::{BufType, CapabilityFlags, Device, Fract};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::io::Errno;
use std::fmt;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Access to video devices.
pub trait Driver {
    /// A stream of images.
    type Stream: Stream;

    /// Lists the devices with depth formats.
    fn devices(&self) -> Vec<Found>;

    /// Starts a stream of this format and size, or of the nearest that the device has.
    ///
    /// # Errors
    /// The device is gone, or another program uses it.
    fn open(&self, path: &Path, mode: &Mode) -> io::Result<(Layout, Self::Stream)>;
}

/// A stream of images from a device.
pub trait Stream {
    /// Waits for a buffer and passes it to `show`; returns whether one came. `is_damaged`: the driver reports the buffer as
    /// incomplete.
    ///
    /// # Errors
    /// The device is gone.
    fn next(&mut self, patience: Duration, show: &mut dyn FnMut(&[u8], bool)) -> io::Result<bool>;
}

/// A device that was found.
#[derive(Clone, Debug, PartialEq)]
pub struct Found {
    /// Path of the device file.
    pub path: PathBuf,
    /// Name of the device.
    pub name: String,
    /// Modes that it offers.
    pub modes: Vec<Mode>,
}

/// A mode that a device offers, or that is requested.
#[derive(Clone, Debug, PartialEq)]
pub struct Mode {
    /// Pixel format.
    pub format: DepthFormat,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// Images per second. A request has one rate at most, or none if the device may choose.
    pub rates_hz: Vec<f64>,
}

impl fmt::Display for Mode {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}x{}", self.format.word(), self.width, self.height)?;
        let rates: Vec<_> = self.rates_hz.iter().map(|rate| format!("{rate:.0}")).collect();
        if rates.is_empty() { Ok(()) } else { write!(f, " at {} Hz", rates.join(", ")) }
    }
}

impl fmt::Display for Found {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let modes: Vec<_> = self.modes.iter().map(Mode::to_string).collect();
        write!(f, "`{}` ({}): {}", self.path.display(), self.name, modes.join("; "))
    }
}

/// The drivers of the Linux kernel.
#[derive(Clone, Copy, Debug, Default)]
pub struct LinuxVideo;

impl Driver for LinuxVideo {
    type Stream = ReadStream;

    fn devices(&self) -> Vec<Found> {
        // Devices that this user may not open are left out.
        let opened = linuxvideo::list().into_iter().flatten().flatten();
        let mut devices: Vec<Found> = opened.filter_map(|device| found(&device).ok()).collect();
        devices.retain(|device| !device.modes.is_empty());
        devices.sort_by(|a, b| a.path.cmp(&b.path));
        devices
    }

    fn open(&self, path: &Path, mode: &Mode) -> io::Result<(Layout, ReadStream)> {
        let wanted = PixFormat::new(mode.width, mode.height, PixelFormat::from_fourcc(mode.format.fourcc()));
        let capture = Device::open(path)?.video_capture(wanted)?;
        if let Some(rate_hz) = mode.rates_hz.first() {
            // In thousandths, as 29.97 Hz is a rate, too.
            capture.set_frame_interval(Fract::new(1000, (rate_hz * 1000.0).round().max(1.0) as u32))?;
        }
        let actual = capture.format();
        let letters = actual.pixel_format();
        let format = DepthFormat::of(letters.as_fourcc())
            .ok_or_else(|| io::Error::other(format!("it sends {letters} in place of {}", mode.format.word())))?;
        let (width, height) = (actual.width(), actual.height());
        let layout = Layout { format, width, height, bytes_per_line: actual.bytes_per_line() };
        Ok((layout, capture.into_stream()?))
    }
}

impl Stream for ReadStream {
    fn next(&mut self, patience: Duration, show: &mut dyn FnMut(&[u8], bool)) -> io::Result<bool> {
        let patience = Timespec { tv_sec: patience.as_secs().cast_signed(), tv_nsec: patience.subsec_nanos().into() };
        match poll(&mut [PollFd::new(&*self, PollFlags::IN)], Some(&patience)) {
            // The wait is interrupted by the signal that ends the stage.
            Ok(0) | Err(Errno::INTR) => Ok(false),
            Ok(_) => self.dequeue(|buffer| {
                show(&buffer, buffer.is_error());
                Ok(true)
            }),
            Err(error) => Err(error.into()),
        }
    }
}

fn found(device: &Device) -> io::Result<Found> {
    let capabilities = device.capabilities()?;
    let mut modes = Vec::new();
    if capabilities.device_capabilities().contains(CapabilityFlags::VIDEO_CAPTURE) {
        for description in device.formats(BufType::VIDEO_CAPTURE) {
            let letters = description?.pixel_format();
            let Some(format) = DepthFormat::of(letters.as_fourcc()) else { continue };
            for (width, height) in sizes(&device.frame_sizes(letters)?) {
                let rates_hz = device.frame_intervals(letters, width, height).map(|all| rates_hz(&all));
                modes.push(Mode { format, width, height, rates_hz: rates_hz.unwrap_or_default() });
            }
        }
    }
    Ok(Found { path: device.path()?, name: capabilities.card().to_owned(), modes })
}

/// The sizes in a list, or the largest one of a range.
fn sizes(sizes: &FrameSizes) -> Vec<(u32, u32)> {
    match sizes {
        FrameSizes::Discrete(list) => list.iter().map(|size| (size.width(), size.height())).collect(),
        FrameSizes::Stepwise(range) | FrameSizes::Continuous(range) => vec![(range.max_width(), range.max_height())],
    }
}

/// The rates in a list, or the fastest one of a range.
fn rates_hz(intervals: &FrameIntervals) -> Vec<f64> {
    let rate = |interval: &Fract| f64::from(interval.denominator()) / f64::from(interval.numerator().max(1));
    match intervals {
        FrameIntervals::Discrete(list) => list.iter().map(|each| rate(each.fract())).collect(),
        FrameIntervals::Stepwise(range) | FrameIntervals::Continuous(range) => vec![rate(range.min())],
    }
}
