//! Where results go: to people, files, pictures, and what is measured of them.

mod console_sink;
mod decimator;
pub mod evaluation_sink;
pub(crate) mod json_lines;
pub mod json_sink;
pub mod mcap_sink;
pub mod measurement_sink;
mod noise_estimator;
pub mod picture_sink;
pub mod section_sink;

pub use console_sink::ConsoleSink;
pub use evaluation_sink::EvaluationSink;
pub use json_sink::JsonSink;
pub use mcap_sink::McapSink;
pub use measurement_sink::MeasurementSink;
pub use noise_estimator::NoiseEstimator;
pub use picture_sink::PictureSink;
pub use section_sink::SectionSink;
