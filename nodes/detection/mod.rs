//! Depth images to ellipses, ellipses to objects.

mod object_assembler;
mod ransac_ellipse_extractor;
mod row_ellipse_extractor;

pub use object_assembler::{Method, ObjectAssembler, ObjectAssemblerConfig};
pub use ransac_ellipse_extractor::RansacEllipseExtractor;
pub use row_ellipse_extractor::{ArcFinder, RowEllipseConfig, RowEllipseExtractor};
