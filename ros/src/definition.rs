//! The definitions of ROS 2 message types. Recordings contain them so that every program can decode the messages: the definition
//! of a type, then those of the types in it. From Iron on, ROS 2 programs compare a hash of the definition to check that they use
//! the same type.
//!
//! Source: common_interfaces, rcl_interfaces, geometry2 and vision_msgs (4.x) of ROS 2, without their comments; the same from
//! Humble on. The hashes are those of REP 2016, computed from these texts with `rosbags`.

/// A message type.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Definition {
    /// The name of the type, such as `sensor_msgs/msg/Image`.
    pub name: &'static str,
    /// Its fields and those of the types in it, in the schema encoding `ros2msg`.
    pub text: &'static str,
    /// Its `RIHS01` hash in hexadecimal digits.
    pub rihs01: &'static str,
}

/// An image, also of depths.
pub const IMAGE: Definition = Definition {
    name: "sensor_msgs/msg/Image",
    text: include_str!("../definitions/Image.msg"),
    rihs01: "d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47",
};

/// A compressed image.
pub const COMPRESSED_IMAGE: Definition = Definition {
    name: "sensor_msgs/msg/CompressedImage",
    text: include_str!("../definitions/CompressedImage.msg"),
    rihs01: "15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
};

/// The calibration of a camera.
pub const CAMERA_INFO: Definition = Definition {
    name: "sensor_msgs/msg/CameraInfo",
    text: include_str!("../definitions/CameraInfo.msg"),
    rihs01: "b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275",
};

/// A point cloud, also an organised one.
pub const POINT_CLOUD: Definition = Definition {
    name: "sensor_msgs/msg/PointCloud2",
    text: include_str!("../definitions/PointCloud2.msg"),
    rihs01: "9198cabf7da3796ae6fe19c4cb3bdd3525492988c70522628af5daa124bae2b5",
};

/// The poses of coordinate frames.
pub const TF_MESSAGE: Definition = Definition {
    name: "tf2_msgs/msg/TFMessage",
    text: include_str!("../definitions/TFMessage.msg"),
    rihs01: "e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
};

/// Markers for viewers.
pub const MARKER_ARRAY: Definition = Definition {
    name: "visualization_msgs/msg/MarkerArray",
    text: include_str!("../definitions/MarkerArray.msg"),
    rihs01: "86cb8800b6fb05b5eff1abd7a56f62a5641d3ae9a1c29e78e67e704f1d067dcf",
};

/// The detections of one frame.
pub const DETECTION_ARRAY: Definition = Definition {
    name: "vision_msgs/msg/Detection3DArray",
    text: include_str!("../definitions/Detection3DArray.msg"),
    rihs01: "793f5eab9595ac1c0da07873cc859db42eae51f0ee76056db8562515d830e018",
};
