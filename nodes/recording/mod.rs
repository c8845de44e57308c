//! Recordings: MCAP files with ROS 2 messages, which other programs read and write as well, and beside these our own messages
//! byte by byte, so that a run that was recorded can be replayed to the bit.

pub mod files;
mod indexed;
pub mod own;
pub mod recorder;
mod sequential;
mod summary;
mod zstd;
