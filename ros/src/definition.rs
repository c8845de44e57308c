//! The message types in the words of ROS 2, which recordings carry with them so that every program can read them: the definition
//! of a type, then those of the types in it.
//!
//! Source: common_interfaces, rcl_interfaces and geometry2 of ROS 2, without their comments; the same from Humble on.

/// A message type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Definition {
    /// Its name, such as `sensor_msgs/msg/Image`.
    pub name: &'static str,
    /// Its fields and those of the types in it, as the schema encoding `ros2msg` has them.
    pub text: &'static str,
}

/// A picture, also of depths.
pub const IMAGE: Definition =
    Definition { name: "sensor_msgs/msg/Image", text: include_str!("../definitions/Image.msg") };
/// A picture in a code of its own.
pub const COMPRESSED_IMAGE: Definition =
    Definition { name: "sensor_msgs/msg/CompressedImage", text: include_str!("../definitions/CompressedImage.msg") };
/// What a camera is.
pub const CAMERA_INFO: Definition =
    Definition { name: "sensor_msgs/msg/CameraInfo", text: include_str!("../definitions/CameraInfo.msg") };
/// Where frames of coordinates lie.
pub const TF_MESSAGE: Definition =
    Definition { name: "tf2_msgs/msg/TFMessage", text: include_str!("../definitions/TFMessage.msg") };
/// What viewers draw.
pub const MARKER_ARRAY: Definition =
    Definition { name: "visualization_msgs/msg/MarkerArray", text: include_str!("../definitions/MarkerArray.msg") };
