//! Where frames come from.

pub mod image_source;
pub mod mcap_source;
mod synthetic_source;

pub use image_source::ImageSource;
pub use mcap_source::McapSource;
pub use synthetic_source::SyntheticSource;
