//! ROS 2 messages as bytes in recordings and networks, in common data representation (CDR): reads and writes depth images with
//! their cameras and poses, and writes results as detections and as markers.
//!
//! Nothing here uses files, transports or ROS itself. In the order in which a reader of a recording meets them: [`Image`],
//! [`CompressedImage`] and [`PointCloud`] give [`Depths`], [`CameraInfo`] the intrinsics, [`Transforms`] the camera's pose;
//! [`detections`] writes a list of objects, [`write_list`] any list with all its numbers, [`markers`] a drawing for viewers, and
//! [`surface_points`] one for viewers without markers. [`definition`] has the definition of each foreign message type.
//!
//! Numbers in these messages come from other programs: sizes out of range, unknown encodings and non-finite numbers are errors.

mod camera_info;
mod cdr;
mod compressed_image;
mod definition;
mod detections;
mod image;
mod list;
mod markers;
mod point_cloud;
mod rvl;
mod surface;
mod transforms;

pub use camera_info::{CameraInfo, Unrectified, camera_info_topics, is_rectified};
pub use cdr::{Reader, Stamped, Undecodable, Writer};
pub use compressed_image::CompressedImage;
pub use definition::{
    CAMERA_INFO, COMPRESSED_IMAGE, DETECTION_ARRAY, Definition, IMAGE, MARKER_ARRAY, POINT_CLOUD, TF_MESSAGE,
};
pub use detections::detections;
pub use image::{Depths, Encoding, Image, Units, write_metres, write_units};
pub use list::{list_definition, write_list};
pub use markers::{Marked, Markers, markers};
pub use point_cloud::PointCloud;
pub use surface::surface_points;
pub use transforms::{Transforms, write_transform};
