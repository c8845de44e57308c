//! ROS 2 messages as the bytes that recordings and networks carry, in common data representation (CDR): depth images with
//! their cameras and poses to be read and written, and what was found as detections, and as markers to be looked at.
//!
//! Nothing here knows files, transports or ROS itself. In the order in which a reader of a recording meets them:
//! [`Image`], [`CompressedImage`] and [`PointCloud`] give [`Depths`], [`CameraInfo`] gives the intrinsics, [`Transforms`] the
//! camera's pose; [`detections`] tells a list of objects, [`write_list`] all numbers of any list, and [`markers`] draws it, as
//! [`surface_points`] does for viewers without markers. [`definition`] has the text of each message type that others made.
//!
//! Numbers in these messages are those of other programs: whatever is too long, of an unknown encoding or not finite is an
//! error.

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
