//! The camera of the images: from the parameters, or from the CameraInfo beside the images.

use conicflow_detection::camera::Intrinsics;
use conicflow_messages::{Camera, Hinted};
use conicflow_ros::{CameraInfo, Undecodable, is_rectified};

/// The hint when the camera is unknown.
pub(crate) const WRITE_INTRINSICS: &str =
    "write `intrinsics = { fx = .., fy = .., cx = .., cy = .. }` with the numbers of your camera";

/// The sources of the camera's intrinsics.
#[derive(Debug)]
pub(crate) struct Cameras {
    images: String,
    intrinsics: Option<Intrinsics>,
    /// The last CameraInfo, and its topic.
    info: Option<(String, CameraInfo)>,
}

impl Cameras {
    pub(crate) fn new(images: &str, intrinsics: Option<Intrinsics>) -> Self {
        Self { images: images.to_owned(), intrinsics, info: None }
    }

    /// Whether the parameters or a CameraInfo define the camera.
    pub(crate) fn are_known(&self) -> bool {
        self.intrinsics.is_some() || self.info.is_some()
    }

    /// Stores a CameraInfo that came on `topic`.
    pub(crate) fn learn(&mut self, topic: &str, message: &[u8]) -> Result<(), Undecodable> {
        self.info = Some((topic.to_owned(), CameraInfo::read(message)?));
        Ok(())
    }

    /// Returns the camera of images of this size.
    ///
    /// # Errors
    /// No CameraInfo has come, its images are distorted or of another size, or it is not calibrated.
    pub(crate) fn of(&self, size: (u32, u32)) -> Result<Camera, Hinted> {
        if let Some(intrinsics) = self.intrinsics {
            return Ok(intrinsics.camera(size));
        }
        let images = &self.images;
        let Some((topic, info)) = &self.info else {
            return Err(Hinted::new(format!("nothing tells the camera of `{images}`"), WRITE_INTRINSICS));
        };
        if let Err((width, height)) = info.fits(size) {
            let what =
                format!("`{topic}` is for images of {width}x{height}, those of `{images}` have {}x{}", size.0, size.1);
            return Err(Hinted::new(what, "intrinsics scale with the image; write `intrinsics` of these"));
        }
        let camera = info.camera(size, is_rectified(images)).map_err(|unrectified| {
            let distortion = unrectified.distortion;
            let what = format!(
                "the images of `{images}` are distorted (`{topic}`: {distortion:?}), expected those of a pinhole camera"
            );
            Hinted::new(what, "name the topic of rectified ones; image_proc of ROS makes them")
        })?;
        if camera.has_intrinsics() {
            return Ok(camera);
        }
        Err(Hinted::new(format!("`{topic}` has no intrinsics: the camera was not calibrated"), WRITE_INTRINSICS))
    }
}
