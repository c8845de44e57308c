//! Takes depth images from a camera with a Linux driver, through V4L2.
//!
//! V4L2 reports neither a camera's intrinsics nor the unit of its depths; the pipeline file gives them. [`grabber`] watches the
//! camera, [`device`] calls the kernel, [`format`] describes the layout of the pixels.

mod device;
mod format;
mod grabber;

pub use device::{Driver, Found, LinuxVideo, Mode, Stream};
pub use format::{DepthFormat, Layout};

use crate::faults::one_of_two;
use conicflow_dataflow::{ConfigFault, Context, Next, Output, SideInputs, Source, StageError, report_median, unix_ns};
use conicflow_detection::camera::Intrinsics;
use conicflow_detection::noise::NoiseConfig;
use conicflow_messages::{Camera, Header, NoiseModel, Text};
use grabber::{Grabber, Wanted};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::Path;
use std::time::Duration;

/// Parameters of [`V4l2Source`].
#[derive(Clone, Debug, Deserialize, Serialize, JsonSchema)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// The camera: its path, such as `/dev/video2` or one in /dev/v4l/by-id, or a part of its name; default: the only one with
    /// depths. `conicflow doctor` lists them.
    pub device: Option<String>,
    /// Pixel format; default: `z16`, else `inzi`. `y16` is grey, which some cameras use for depth.
    pub format: Option<DepthFormat>,
    /// Columns; default: as the camera prefers.
    #[schemars(range(min = 1, max = 16384))]
    pub width: Option<u32>,
    /// Rows; default: as the camera prefers.
    #[schemars(range(min = 1, max = 16384))]
    pub height: Option<u32>,
    /// Images per second that are asked of the camera; default: as it chooses.
    #[schemars(range(min = 1.0, max = 1000.0))]
    pub fps: Option<f64>,
    /// fx, fy, cx, cy in pixels, for images of `width` and `height`.
    pub intrinsics: Option<Intrinsics>,
    /// In place of `intrinsics`: the horizontal field of view of the rectified depth images, in degrees, of a camera with square
    /// pixels that looks through the middle of its images.
    #[schemars(range(min = 1.0, max = 170.0))]
    pub fov_deg: Option<f64>,
    /// Metres per unit of a pixel; V4L2 does not report it.
    #[schemars(range(min = 0.0))]
    pub depth_scale: f64,
    /// Depth noise of the sensor: a name (`kinect_v1`, `realsense_d435`, `time_of_flight`, `ideal`) or a table.
    pub noise: NoiseConfig,
    /// After so many seconds without an image the camera is opened anew.
    #[schemars(range(min = 0.1, max = 3600.0))]
    pub stall_s: f64,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            device: None,
            format: None,
            width: None,
            height: None,
            fps: None,
            intrinsics: None,
            fov_deg: None,
            depth_scale: 0.001,
            noise: NoiseConfig::default(),
            stall_s: 3.0,
        }
    }
}

impl Config {
    fn size(&self) -> Option<(u32, u32)> {
        self.width.zip(self.height)
    }

    fn faults(&self) -> Vec<ConfigFault> {
        let mut faults = Vec::new();
        faults.extend(one_of_two(self.width, self.height));
        match (self.intrinsics, self.fov_deg) {
            (None, None) => {
                let hint = "write `intrinsics = { fx = .., fy = .., cx = .., cy = .. }` with the numbers of your camera, or \
                            `fov_deg = ..` with its horizontal field of view; with the maker's SDK nobody types them: \
                            `realsense_source` and others";
                faults.push(ConfigFault::new("intrinsics", "are missing: V4L2 does not know them", hint));
            }
            (Some(_), Some(_)) => {
                faults.push(ConfigFault::new("fov_deg", "stands beside `intrinsics`", "give one of both"));
            }
            (Some(intrinsics), None) if !intrinsics.are_usable() => faults.extend(intrinsics.fault()),
            (Some(_), None) if self.size().is_none() => {
                let hint = "intrinsics scale with the image: write the `width` and `height` that they hold for";
                faults.push(ConfigFault::new("intrinsics", "are those of images of a size that is not given", hint));
            }
            _ => {}
        }
        faults.extend(ConfigFault::of_depth_scale(self.depth_scale));
        faults
    }

    fn wanted(&self) -> Wanted {
        let stall = Duration::from_secs_f64(self.stall_s);
        Wanted { device: self.device.clone(), format: self.format, size: self.size(), fps: self.fps, stall }
    }

    /// Returns the camera for images of this size.
    fn camera(&self, (width, height): (u32, u32)) -> Camera {
        if let Some(intrinsics) = self.intrinsics {
            return intrinsics.camera((width, height));
        }
        let half_view = (self.fov_deg.unwrap_or_default() / 2.0).to_radians();
        let focal = f64::from(width) / 2.0 / half_view.tan();
        let middle = |length: u32| (f64::from(length) - 1.0) / 2.0;
        Intrinsics { fx: focal, fy: focal, cx: middle(width), cy: middle(height) }.camera((width, height))
    }
}

/// Takes depth images from a video device.
pub struct V4l2Source {
    grabber: Grabber<LinuxVideo>,
    config: Config,
    noise: NoiseModel,
    is_reported: bool,
}

impl Source for V4l2Source {
    const NAME: &'static str = "v4l2_source";
    const SUMMARY: &'static str = "Takes depth images from a camera with a driver of Linux, by V4L2; tried with a stand-in for the \
                                   kernel, not with a camera";
    type Config = Config;
    type Output = u16;

    fn faults(config: &Config, _: &Path) -> Vec<ConfigFault> {
        config.faults()
    }

    fn new(config: Config, context: &Context) -> Result<Self, StageError> {
        let grabber = Grabber::new(LinuxVideo, config.wanted(), context.stop.clone());
        let noise = config.noise.into();
        Ok(Self { grabber, config, noise, is_reported: context.resume_at > 0 })
    }

    fn message_length(config: &Config, _: &Path) -> Option<usize> {
        config.size().map(|(width, height)| width as usize * height as usize)
    }

    fn next(&mut self, _: &SideInputs, output: &mut Output<u16>) -> Result<Next, StageError> {
        let Some(layout) = self.grabber.next(output)? else { return Ok(Next::End) };
        // `linuxvideo` does not give the kernel's time stamp; the time of arrival is slightly later.
        let stamp_ns = unix_ns();
        output.header = Header {
            camera: self.config.camera((layout.width, layout.height)),
            depth_scale: self.config.depth_scale,
            noise: self.noise,
            stamp_ns,
            source: Text::new(self.grabber.name()),
            ..Header::default()
        };
        if !self.is_reported
            && let Some(median) = self.grabber.median()
        {
            self.is_reported = true;
            let median_m = f64::from(median) * self.config.depth_scale;
            report_median("images", self.grabber.name(), &output.header.camera, median_m);
        }
        Ok(Next::Message)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_dataflow::testing::collect;

    fn fault_texts(config: &Config) -> Vec<String> {
        config.faults().into_iter().map(|fault| format!("{}: {}", fault.key, fault.what)).collect()
    }

    #[test]
    fn intrinsics_are_never_guessed() {
        assert_eq!(fault_texts(&Config::default()), ["intrinsics: are missing: V4L2 does not know them"]);
        let intrinsics = Some(Intrinsics { fx: 385.0, fy: 385.0, cx: 319.5, cy: 239.5 });
        let of_nothing = Config { intrinsics, ..Config::default() };
        assert_eq!(fault_texts(&of_nothing), ["intrinsics: are those of images of a size that is not given"]);
        let whole = Config { width: Some(640), height: Some(480), ..of_nothing };
        assert!(fault_texts(&whole).is_empty());
        assert_eq!(
            fault_texts(&Config { fov_deg: Some(80.0), ..whole.clone() }),
            ["fov_deg: stands beside `intrinsics`"]
        );
        assert_eq!(fault_texts(&Config { height: None, ..whole.clone() })[0], "width: is one of two");
        assert_eq!(fault_texts(&Config { depth_scale: 0.0, ..whole })[0], "depth_scale: is not from 1e-9 to 1");
        assert!(fault_texts(&Config { fov_deg: Some(80.0), ..Config::default() }).is_empty());
    }

    #[test]
    fn a_field_of_view_is_that_of_the_whole_image() {
        let camera = Config { fov_deg: Some(90.0), ..Config::default() }.camera((848, 480));
        assert!((camera.fx - 424.0).abs() < 1e-9 && camera.fx == camera.fy);
        assert_eq!((camera.cx, camera.cy, camera.width, camera.height), (423.5, 239.5, 848, 480));
        // The rays through the outer edges of the outer pixels are 90 degrees apart.
        assert!(((-0.5 - camera.cx) / camera.fx + 1.0).abs() < 1e-9);
    }

    #[test]
    fn a_run_without_a_camera_can_be_stopped() {
        let context = Context::default();
        let stop = context.stop.clone();
        let ended = std::thread::spawn(|| {
            let config = Config { device: Some("no such camera".to_owned()), fov_deg: Some(80.0), ..Config::default() };
            collect::<V4l2Source>(config, context, 3)
        });
        stop.request();
        assert!(ended.join().unwrap().unwrap().is_empty());
    }
}
