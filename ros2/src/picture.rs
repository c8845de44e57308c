//! The message types that contain a depth image.

use conicflow_ros::{
    COMPRESSED_IMAGE, CompressedImage, Definition, Depths, IMAGE, Image, POINT_CLOUD, PointCloud, Stamped, Undecodable,
};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

/// The message type of a topic.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize, Serialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Kind {
    /// `sensor_msgs/Image`.
    Image,
    /// `sensor_msgs/CompressedImage`, as `compressedDepth` of image_transport writes it.
    CompressedDepth,
    /// `sensor_msgs/PointCloud2` in rows and columns.
    PointCloud,
}

impl Kind {
    /// Guesses the type of a topic from its name, by convention.
    pub(crate) fn of(topic: &str) -> Self {
        match topic.rsplit('/').next() {
            Some("compressedDepth") => Self::CompressedDepth,
            Some(name) if name.contains("points") => Self::PointCloud,
            _ => Self::Image,
        }
    }

    pub(crate) fn definition(self) -> Definition {
        match self {
            Self::Image => IMAGE,
            Self::CompressedDepth => COMPRESSED_IMAGE,
            Self::PointCloud => POINT_CLOUD,
        }
    }

    /// The word for the type in a pipeline file.
    pub(crate) fn word(self) -> &'static str {
        match self {
            Self::Image => "image",
            Self::CompressedDepth => "compressed_depth",
            Self::PointCloud => "point_cloud",
        }
    }

    /// Returns the kind of a ROS message type.
    pub(crate) fn of_type(name: &str) -> Option<Self> {
        [Self::Image, Self::CompressedDepth, Self::PointCloud].into_iter().find(|kind| kind.definition().name == name)
    }
}

/// A message whose pixels are not decoded yet.
pub(crate) enum Picture<'a> {
    Image(Image<'a>),
    Compressed(CompressedImage<'a>),
    Cloud(PointCloud<'a>),
}

impl<'a> Picture<'a> {
    pub(crate) fn read(kind: Kind, message: &'a [u8]) -> Result<Self, Undecodable> {
        Ok(match kind {
            Kind::Image => Self::Image(Image::read(message)?),
            Kind::CompressedDepth => Self::Compressed(CompressedImage::read(message)?),
            Kind::PointCloud => Self::Cloud(PointCloud::read(message)?),
        })
    }

    pub(crate) fn stamped(&self) -> Stamped<'a> {
        match self {
            Self::Image(image) => image.stamped,
            Self::Compressed(image) => image.stamped,
            Self::Cloud(cloud) => cloud.stamped,
        }
    }

    /// Returns the size (width, height) and the depths.
    pub(crate) fn depths(&self) -> Result<((u32, u32), Depths), Undecodable> {
        match self {
            Self::Image(image) => Ok(((image.width, image.height), image.depths()?)),
            Self::Compressed(image) => image.depths(),
            Self::Cloud(cloud) => Ok(((cloud.width, cloud.height), cloud.depths())),
        }
    }
}
