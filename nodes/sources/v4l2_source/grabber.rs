//! Takes the images of a video device for a whole run: finds the device, opens it, and opens it again after a stall or loss.
//!
//! This file makes no calls to the kernel. A problem is logged once, until it changes.

use super::device::{Driver, Found, Mode, Stream};
use super::format::{DepthFormat, Layout};
use conicflow_dataflow::{Output, StageError, Stop};
use conicflow_messages::{Hinted, median_depth};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

const UNREADABLE: &str = "frames unreadable";
const OPENED: &str = "camera opened anew";

/// Longest wait for an image before the grabber checks for a stop or a stall.
const IMAGE_TIMEOUT: Duration = Duration::from_millis(50);
/// Period of attempts to open a missing device.
const TRY_AGAIN: Duration = Duration::from_secs(1);

/// The requested device and mode.
#[derive(Clone, Debug, Default)]
pub struct Wanted {
    /// The device's path or a part of its name; none: the only device with depths.
    pub device: Option<String>,
    /// Pixel format; none: a format that always holds depth.
    pub format: Option<DepthFormat>,
    /// Columns and rows; none: as the device prefers.
    pub size: Option<(u32, u32)>,
    /// Images per second; none: as the device chooses.
    pub fps: Option<f64>,
    /// Time without an image after which the device is opened again.
    pub stall: Duration,
}

/// Destination of the images and counts.
pub trait ImageOutput {
    /// Loans memory for this number of pixels.
    ///
    /// # Errors
    /// There is no memory left.
    fn loan(&mut self, pixels: usize) -> Result<&mut [u16], StageError>;

    /// Adds to a counter.
    fn count(&mut self, name: &'static str);
}

impl ImageOutput for Output<'_, u16> {
    fn loan(&mut self, pixels: usize) -> Result<&mut [u16], StageError> {
        Output::loan(self, pixels)
    }

    fn count(&mut self, name: &'static str) {
        Output::count(self, name, 1);
    }
}

/// An open device.
struct Opened<S> {
    found: Found,
    layout: Layout,
    stream: S,
}

/// Takes images from a device.
pub struct Grabber<D: Driver> {
    driver: D,
    wanted: Wanted,
    opened: Option<Opened<D::Stream>>,
    has_opened: bool,
    /// When the last image arrived.
    last_image_at: Instant,
    /// When to try again to open the device.
    next_attempt_at: Instant,
    last_warning: Option<String>,
    /// Median depth of the first image with valid depths.
    median: Option<u16>,
    try_again: Duration,
    stop: Stop,
}

impl<D: Driver> Grabber<D> {
    /// Creates a grabber; the device is opened when the first image is asked for.
    pub fn new(driver: D, wanted: Wanted, stop: Stop) -> Self {
        let now = Instant::now();
        let (opened, has_opened, last_warning, median, try_again) = (None, false, None, None, TRY_AGAIN);
        Self {
            driver,
            wanted,
            opened,
            has_opened,
            last_image_at: now,
            next_attempt_at: now,
            last_warning,
            median,
            try_again,
            stop,
        }
    }

    /// Writes the next image to `output` and returns its layout; none at the end of the run.
    ///
    /// # Errors
    /// There is no memory left, or the device does not offer the requested mode.
    pub fn next(&mut self, output: &mut dyn ImageOutput) -> Result<Option<Layout>, StageError> {
        // Time in which the pipeline had no room does not count as silence of the camera.
        self.last_image_at = Instant::now();
        while !self.stop.requested() {
            if self.opened.is_none() {
                self.open(output)?;
            } else if let Some(layout) = self.take(output)? {
                return Ok(Some(layout));
            }
        }
        Ok(None)
    }

    /// The name of the open device.
    pub fn name(&self) -> &str {
        self.opened.as_ref().map_or("", |opened| &opened.found.name)
    }

    /// The median depth of the first image with valid depths.
    pub fn median(&self) -> Option<u16> {
        self.median
    }

    fn open(&mut self, output: &mut dyn ImageOutput) -> Result<(), StageError> {
        let left = self.next_attempt_at.saturating_duration_since(Instant::now());
        if !left.is_zero() {
            std::thread::sleep(left.min(IMAGE_TIMEOUT));
            return Ok(());
        }
        self.next_attempt_at = Instant::now() + self.try_again;
        match self.find_and_open() {
            Ok(opened) => {
                let (Layout { width, height, format, .. }, found) = (opened.layout, &opened.found);
                let (path, word) = (found.path.display(), format.word());
                tracing::info!("`{path}` ({}): images of {width}x{height}, {word}", found.name);
                if self.has_opened {
                    output.count(OPENED);
                }
                (self.opened, self.has_opened, self.last_image_at) = (Some(opened), true, Instant::now());
                Ok(())
            }
            // A lasting fault ends the stage, unless a camera was open before: another one may have been plugged in meanwhile.
            Err(fault) if fault.lasts && !self.has_opened => Err(fault.into()),
            Err(fault) => {
                self.warn(&format!("{fault}\n  the stage waits for the camera"));
                Ok(())
            }
        }
    }

    fn find_and_open(&self) -> Result<Opened<D::Stream>, Hinted> {
        let found = self.find()?;
        let mode = self.mode(&found)?;
        let path = found.path.display();
        let (layout, stream) = self.driver.open(&found.path, &mode).map_err(|error| {
            let hint = "does another program have it, and may this user open it (group `video`)?";
            Hinted::new(format!("`{path}` ({}) cannot be opened: {error}", found.name), hint)
        })?;
        let size = (layout.width, layout.height);
        if size != (mode.width, mode.height) || layout.format != mode.format {
            let (width, height) = size;
            let what = format!("`{path}` sends {} {width}x{height} in place of {mode}", layout.format.word());
            return Err(Hinted::lasting(what, format!("it has {}", listed(&found.modes))));
        }
        Ok(Opened { found, layout, stream })
    }

    /// Finds the requested device; it is an error if several fit.
    fn find(&self) -> Result<Found, Hinted> {
        let mut devices = self.driver.devices();
        let fits = |found: &Found| found.modes.iter().any(|mode| self.is_format(mode));
        let names: Vec<_> = devices.iter().map(Found::to_string).collect();
        let hint = if names.is_empty() {
            "no video device here has a format with depths that this user may open: is it plugged in, is the user in the group \
             `video`?"
                .to_owned()
        } else {
            format!("with depths there are {}", names.join(", "))
        };
        let name = self.wanted.device.as_deref();
        devices.retain(|found| name.map_or(fits(found), |name| is_named(found, name)));
        match (devices.len(), name) {
            (1, _) => Ok(devices.remove(0)),
            (0, Some(name)) => Err(Hinted::new(format!("there is no camera `{name}`"), hint)),
            (0, None) => Err(Hinted::new("there is no depth camera", hint)),
            _ => Err(Hinted::lasting(
                format!("{} cameras fit", devices.len()),
                format!("name one by `device`, its path or a part of its name; {hint}"),
            )),
        }
    }

    fn is_format(&self, mode: &Mode) -> bool {
        match self.wanted.format {
            Some(format) => mode.format == format,
            None => DepthFormat::CERTAIN.contains(&mode.format),
        }
    }

    /// Returns the mode to request: the first with the wanted size and rate, in the best of its formats.
    fn mode(&self, found: &Found) -> Result<Mode, Hinted> {
        let is_size = |mode: &&Mode| self.wanted.size.is_none_or(|size| size == (mode.width, mode.height));
        let is_rate = |rate: f64| self.wanted.fps.is_none_or(|fps| (fps - rate).abs() < 0.5);
        let has_rate = |mode: &&Mode| mode.rates_hz.is_empty() || mode.rates_hz.iter().any(|rate| is_rate(*rate));
        let modes = found.modes.iter().filter(|mode| self.is_format(mode));
        let mut fitting: Vec<_> = modes.filter(is_size).filter(has_rate).collect();
        fitting.sort_by_key(|mode| DepthFormat::CERTAIN.iter().position(|format| *format == mode.format));
        let Some(mode) = fitting.first() else {
            let size = self.wanted.size.map_or("any size".to_owned(), |(width, height)| format!("{width}x{height}"));
            let rate = self.wanted.fps.map_or(String::new(), |fps| format!(" at {fps} Hz"));
            let what = format!("`{}` ({}) has no depth images of {size}{rate}", found.path.display(), found.name);
            let y16 = "; `format = \"y16\"` takes grey for depth";
            let hint = if self.wanted.format.is_none() { y16 } else { "" };
            return Err(Hinted::lasting(what, format!("it has {}{hint}", listed(&found.modes))));
        };
        Ok(Mode { rates_hz: self.wanted.fps.into_iter().collect(), ..(*mode).clone() })
    }

    /// Takes an image if one comes within the timeout.
    fn take(&mut self, output: &mut dyn ImageOutput) -> Result<Option<Layout>, StageError> {
        let Some(Opened { found, layout, stream }) = &mut self.opened else { return Ok(None) };
        let (layout, name) = (*layout, found.name.clone());
        let (mut result, median) = (Ok(Ok(())), &mut self.median);
        let has_image = stream.next(IMAGE_TIMEOUT, &mut |buffer, is_damaged| {
            result = output.loan(layout.pixels()).map(|image| match layout.unpack(buffer, image) {
                Ok(()) if is_damaged => Err("an image that its driver calls damaged".to_owned()),
                Ok(()) => {
                    *median = median.or_else(|| median_depth(image));
                    Ok(())
                }
                Err(short) => Err(short.to_string()),
            });
        });
        match has_image {
            Err(error) => self.close(&format!("{name} is lost: {error}")),
            Ok(false) => {
                let silence = self.last_image_at.elapsed();
                if silence > self.wanted.stall {
                    self.close(&format!("{name} is lost: no image for {:.1} s", silence.as_secs_f64()));
                }
            }
            Ok(true) => {
                self.last_image_at = Instant::now();
                match result? {
                    Ok(()) => {
                        self.last_warning = None;
                        return Ok(Some(layout));
                    }
                    Err(fault) => {
                        output.count(UNREADABLE);
                        self.warn(&format!("{name} sends {fault}; it is passed over"));
                    }
                }
            }
        }
        Ok(None)
    }

    fn close(&mut self, what: &str) {
        self.opened = None;
        self.warn(&format!("{what}\n  it is opened anew as soon as it is there"));
    }

    /// Logs a warning, unless it differs from the last one only in its numbers.
    fn warn(&mut self, text: &str) {
        let key: String = text.chars().filter(|letter| !letter.is_ascii_digit()).collect();
        if self.last_warning.as_ref() != Some(&key) {
            tracing::warn!("{text}");
            self.last_warning = Some(key);
        }
    }
}

fn listed(modes: &[Mode]) -> String {
    modes.iter().map(Mode::to_string).collect::<Vec<_>>().join("; ")
}

/// Whether a device has this path, also through a link as in /dev/v4l/by-id, or this text in its name.
fn is_named(found: &Found, name: &str) -> bool {
    if !name.contains('/') {
        return found.name.to_lowercase().contains(&name.to_lowercase());
    }
    let path = Path::new(name).canonicalize().unwrap_or_else(|_| PathBuf::from(name));
    found.path == path
}

#[cfg(test)]
#[path = "grabber_tests.rs"]
mod tests;
