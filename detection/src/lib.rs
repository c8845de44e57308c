//! Spheres, cylinders and cones in depth images, and their tracks from image to image.
//!
//! ```
//! use conicflow_detection::{Camera, Detector, NoiseModel, Tracker};
//!
//! let camera = Camera { width: 640, height: 480, fx: 525.0, fy: 525.0, cx: 319.5, cy: 239.5 };
//! let mut detector = Detector::new(camera).noise(NoiseModel::KINECT_V1).depth_scale(0.001);
//! let mut tracker = Tracker::default();
//! let depth = vec![1500_u16; 640 * 480]; // in millimetres, row by row
//! let objects = detector.detect(&depth);
//! let tracks = tracker.update(&objects, 33_000_000);
//! assert!(objects.is_empty() && tracks.is_empty(), "a wall is none of them");
//! ```
//!
//! [`Detector`] is the entry point; `method.rs` shows the whole method in one place: a depth image becomes ellipses
//! ([`extract`]), ellipses become objects ([`assemble`]). [`Tracker::update`] makes objects into tracks ([`track`]). The files of
//! each folder are listed in the order of its steps.
//!
//! Units are SI: metres, radians, seconds. The camera frame is the optical frame: x right, y down, z forward.

pub mod assemble;
pub mod camera;
mod detector;
pub mod extract;
pub mod gravity;
mod method;
pub mod noise;
mod rejections;
pub mod track;

pub use assemble::{Assembler, AssemblerParameters};
pub use conicflow_messages::{Camera, Ellipse, Header, NoiseModel, Object, ObjectKind, ObjectSigma, Track, TrackState};
pub use detector::{DetectError, Detector};
pub use extract::{Extractor, ExtractorParameters, ScanLines};
pub use track::{NoPose, Tracker, TrackerParameters};
