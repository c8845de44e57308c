//! Where frames come from.

pub mod image_source;
mod synthetic_source;

pub use image_source::ImageSource;
pub use synthetic_source::SyntheticSource;
