//! `sensor_msgs/CameraInfo`: the intrinsics of a camera, of its raw image and of the rectified one.

use crate::{Reader, Stamped, Undecodable, Writer};
use conicflow_messages::Camera;

/// The calibration of a camera.
#[derive(Clone, Debug, PartialEq)]
pub struct CameraInfo {
    /// Size of the full image, in pixels.
    pub width: u32,
    /// Size of the full image, in pixels.
    pub height: u32,
    /// Distortion coefficients of the raw image.
    pub distortion: Vec<f64>,
    /// Intrinsics of the raw image, row-major: fx 0 cx, 0 fy cy, 0 0 1.
    pub k: [f64; 9],
    /// Projection to the rectified image, row-major 3x4: fx 0 cx .., 0 fy cy .., 0 0 1 ..
    pub p: [f64; 12],
    /// Pixels of the full image per pixel of the image, horizontally and vertically; 0 stands for 1.
    pub binning: [u32; 2],
    /// Origin (x, y) in the full image of the region that the image shows.
    pub offset: [u32; 2],
    /// Size of that region (width, height); 0 stands for the rest of the full image.
    pub region: [u32; 2],
}

/// An image that is distorted, and so not that of a pinhole camera.
#[derive(Clone, Debug, PartialEq)]
pub struct Unrectified {
    /// The distortion coefficients.
    pub distortion: Vec<f64>,
}

impl CameraInfo {
    /// Maximum number of distortion coefficients; ROS has models with 4, 5 and 8, and OpenCV's with 14.
    const MOST_COEFFICIENTS: u32 = 64;

    /// Reads a message.
    ///
    /// # Errors
    /// It is no such message.
    pub fn read(message: &[u8]) -> Result<Self, Undecodable> {
        let mut reader = Reader::new(message)?;
        reader.stamped()?;
        let (height, width) = (reader.u32()?, reader.u32()?);
        reader.text()?;
        let coefficients = reader.u32()?;
        if coefficients > Self::MOST_COEFFICIENTS {
            return Err(Undecodable::new(format!("a distortion of {coefficients} coefficients")));
        }
        let distortion = (0..coefficients).map(|_| reader.f64()).collect::<Result<_, _>>()?;
        let (k, _, p) = (reader.f64s()?, reader.f64s::<9>()?, reader.f64s()?);
        let binning = [reader.u32()?, reader.u32()?];
        let offset = [reader.u32()?, reader.u32()?];
        let [region_height, region_width] = [reader.u32()?, reader.u32()?];
        Ok(Self { width, height, distortion, k, p, binning, offset, region: [region_width, region_height] })
    }

    /// Whether the camera is calibrated: a driver that is not ready, or not calibrated, leaves numbers at zero.
    pub fn is_calibrated(&self) -> bool {
        let has_focal_lengths = |matrix: &[f64]| matrix[0] > 0.0 && matrix[matrix.len() / 3 + 1] > 0.0;
        self.width > 0 && self.height > 0 && (has_focal_lengths(&self.k) || has_focal_lengths(&self.p))
    }

    /// Returns the camera of images of this size: for rectified images from the projection, for raw ones from the intrinsics, if
    /// these have no distortion.
    ///
    /// # Errors
    /// The raw image is distorted.
    pub fn camera(&self, (width, height): (u32, u32), is_rectified: bool) -> Result<Camera, Unrectified> {
        let [fx, _, cx, _, _, fy, cy, ..] = self.p;
        let has_projection = fx != 0.0 && fy != 0.0;
        let [fx, fy, cx, cy] = if is_rectified && has_projection {
            [fx, fy, cx, cy]
        } else if self.distortion.iter().all(|coefficient| *coefficient == 0.0) {
            [self.k[0], self.k[4], self.k[2], self.k[5]]
        } else {
            return Err(Unrectified { distortion: self.distortion.clone() });
        };
        let [bin_x, bin_y] = self.binning.map(|pixels| f64::from(pixels.max(1)));
        let [x, y] = self.offset.map(f64::from);
        // Like `image_geometry` of ROS, which everybody uses: a bin is represented by its first pixel.
        Ok(Camera { width, height, fx: fx / bin_x, fy: fy / bin_y, cx: (cx - x) / bin_x, cy: (cy - y) / bin_y })
    }

    /// Whether images of this size match the camera: its full image or its region, after binning. A partial bin at the edge may
    /// be included or not.
    ///
    /// # Errors
    /// The images have another size; returns the expected width and height.
    pub fn fits(&self, (width, height): (u32, u32)) -> Result<(), (u32, u32)> {
        let along = |full: u32, axis: usize| match self.region[axis] {
            0 => full.saturating_sub(self.offset[axis]),
            pixels => pixels,
        };
        let pixels = [along(self.width, 0), along(self.height, 1)];
        let bins = self.binning.map(|pixels| pixels.max(1));
        let is_one =
            |axis: usize, size: u32| (pixels[axis] / bins[axis]..=pixels[axis].div_ceil(bins[axis])).contains(&size);
        let expected = (pixels[0] / bins[0], pixels[1] / bins[1]);
        if is_one(0, width) && is_one(1, height) { Ok(()) } else { Err(expected) }
    }

    /// Encodes a message for the rectified image of a camera.
    pub fn write(stamped: Stamped<'_>, camera: &Camera, memory: Vec<u8>) -> Vec<u8> {
        let &Camera { width, height, fx, fy, cx, cy } = camera;
        let mut writer = Writer::new(memory);
        writer.stamped(stamped).u32(height).u32(width).text("plumb_bob").length(5).f64s(&[0.0; 5]);
        writer.f64s(&[fx, 0.0, cx, 0.0, fy, cy, 0.0, 0.0, 1.0]);
        writer.f64s(&[1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]);
        writer.f64s(&[fx, 0.0, cx, 0.0, 0.0, fy, cy, 0.0, 0.0, 0.0, 1.0, 0.0]);
        // Neither binning nor a region of interest.
        writer.u32(0).u32(0).u32(0).u32(0).u32(0).u32(0).u8(0);
        writer.finish()
    }
}

/// The topics where the CameraInfo of an image topic may be: beside the images, beside the images that a compressed one was made
/// from, and below the image topic.
pub fn camera_info_topics(topic: &str) -> [String; 3] {
    let above = |topic: &str| topic.rsplit_once('/').map_or("", |(above, _)| above).to_owned();
    let folder = above(topic);
    [format!("{folder}/camera_info"), format!("{}/camera_info", above(&folder)), format!("{topic}/camera_info")]
}

/// Whether the name of a topic says that its images are rectified, by the convention of image_proc and drivers.
pub fn is_rectified(topic: &str) -> bool {
    topic.split('/').any(|part| part.contains("rect"))
}

#[cfg(test)]
mod tests {
    use super::*;

    const CAMERA: Camera = Camera { width: 64, height: 48, fx: 52.5, fy: 52.0, cx: 31.5, cy: 23.25 };

    fn info() -> CameraInfo {
        CameraInfo::read(&CameraInfo::write(Stamped::default(), &CAMERA, Vec::new())).unwrap()
    }

    #[test]
    fn a_written_camera_info_is_read_back() {
        let info = info();
        assert_eq!((info.width, info.height, info.distortion.len()), (64, 48, 5));
        for is_rectified in [false, true] {
            assert_eq!(info.camera((64, 48), is_rectified), Ok(CAMERA));
        }
    }

    #[test]
    fn a_distorted_image_has_no_camera_but_the_rectified_one_has() {
        let mut info = CameraInfo { distortion: vec![0.0, 0.1], ..info() };
        info.p[0] = 50.0;
        assert_eq!(info.camera((64, 48), false), Err(Unrectified { distortion: vec![0.0, 0.1] }));
        assert_eq!(info.camera((64, 48), true), Ok(Camera { fx: 50.0, ..CAMERA }));
        info.p = [0.0; 12];
        assert!(info.camera((64, 48), true).is_err(), "a camera that was not calibrated for rectification");
    }

    #[test]
    fn bins_and_regions_move_the_principal_point() {
        let info = CameraInfo { binning: [2, 0], offset: [4, 8], ..info() };
        let expected = Camera { width: 30, height: 40, fx: 26.25, fy: 52.0, cx: 13.75, cy: 15.25 };
        assert_eq!(info.camera((30, 40), false), Ok(expected));
    }

    #[test]
    fn images_are_as_large_as_the_binned_region_or_without_one_as_the_whole_image() {
        let all = info();
        assert_eq!(
            (all.fits((64, 48)), all.fits((32, 24)), all.fits((65, 48))),
            (Ok(()), Err((64, 48)), Err((64, 48)))
        );
        let rest = CameraInfo { binning: [2, 0], offset: [4, 8], ..info() };
        assert_eq!((rest.fits((30, 40)), rest.fits((32, 48))), (Ok(()), Err((30, 40))));
        let region = CameraInfo { region: [21, 10], ..rest };
        assert_eq!([(10, 10), (11, 10)].map(|size| region.fits(size)), [Ok(()); 2]);
        assert_eq!([(9, 10), (10, 9), (12, 10)].map(|size| region.fits(size)), [Err((10, 10)); 3]);
    }

    #[test]
    fn the_region_is_read_as_width_and_height() {
        let mut message = CameraInfo::write(Stamped::default(), &CAMERA, Vec::new());
        // The last numbers are x, y, height and width of the region, and the flag for rectification.
        let at = message.len() - 17;
        for (place, number) in (at..).step_by(4).zip([1_u32, 2, 3, 4]) {
            message[place..place + 4].copy_from_slice(&number.to_le_bytes());
        }
        let info = CameraInfo::read(&message).unwrap();
        assert_eq!((info.offset, info.region), ([1, 2], [4, 3]));
    }

    #[test]
    fn malformed_camera_infos_are_refused() {
        let message = CameraInfo::write(Stamped::default(), &CAMERA, Vec::new());
        assert!(CameraInfo::read(&message[..message.len() - 10]).is_err());
        let mut writer = Writer::new(Vec::new());
        writer.stamped(Stamped::default()).u32(1).u32(1).text("").u32(u32::MAX);
        assert_eq!(
            CameraInfo::read(&writer.finish()).unwrap_err().to_string(),
            "a distortion of 4294967295 coefficients"
        );
    }
}
