//! The stages of conicflow, one file each, in the order in which a frame meets them.

pub mod noise_config;

pub mod synthetic_source;

pub mod image_source;

pub mod row_ellipse_extractor;

pub mod object_assembler;

pub mod kalman_tracker;

pub mod console_sink;
pub mod json_sink;
pub mod picture_sink;
