//! The type of points and directions.

/// Points, directions and offsets in the camera frame, in metres.
pub type Vector3 = nalgebra::Vector3<f64>;
