//! The messages between stages: one fixed [`Header`] and a flat slice of items.
//!
//! In the order of processing, the items are depth images (`u16` pixels), [`Ellipse`] lists, [`Object`] lists, [`Track`] lists
//! and [`Velocity`] commands; programs may define further types ([`Layout`]). All of them are plain old data with an explicit,
//! versioned type name, so that separately built processes can write and read them in place in shared memory. [`Item::check`]
//! checks everything that comes from another process before a stage sees it.
//!
//! Units are SI: metres, radians, seconds; times in nanoseconds. The camera frame is the optical frame:
//! x right, y down, z forward.

mod coded;
mod depth;
mod ellipse;
mod fault;
mod files;
mod header;
mod item;
mod json;
mod layout;
mod object;
mod plain;
mod quantise;
mod text;
mod track;
mod value;
mod velocity;

pub use depth::{INVALID_FAR, INVALID_NEAR, is_measured, median_depth};
pub use ellipse::{END_POINTS, Ellipse, MOMENTS, Scan};
pub use fault::{ConfigFault, Hinted, lasts};
pub use files::{LateFile, is_special, read_text};
pub use header::{
    Camera, DEPTH_SCALES_M, END_OF_STREAM, FARTHEST_PRINCIPAL_POINT_PX, FOCAL_LENGTHS_PX, HAS_POSE, HEADER_TYPE_NAME,
    Header, Hop, MAX_HOPS, MAX_PIXELS, MAX_SIDE_PX, MAX_SOURCE_BYTES, NoiseModel, RECORDED, is_rotation,
};
pub use item::{AnyByte, Item, Malformed, Message, Nothing, ToJson};
pub use json::{LINE_KEYS, Line};
pub use layout::{Field, Layout, LayoutFault, MAX_ITEM_BYTES};
pub use object::{Object, ObjectKind, ObjectSigma};
pub use plain::{is_harmless, plain};
pub use quantise::{COARSEST_SCALE, finest_scale, is_too_far, quantise};
pub use text::Text;
pub use track::{Track, TrackState};
pub use value::{ABSENT, Element, Fields, Named, Value};
pub use velocity::{Frame, Velocity};
