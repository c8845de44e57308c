//! Recordings: MCAP files with ROS 2 messages, which other programs can read and write, and beside these the messages of
//! conicflow byte by byte, so that a recorded run can be replayed exactly.

pub mod files;
mod indexed;
pub mod own;
pub mod recorder;
mod sequential;
mod summary;
mod zstd;
