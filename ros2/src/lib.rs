//! The nodes `ros2_source` and `ros2_sink`: a robot's depth images into a pipeline, and what it finds back to the robot, with no
//! ROS on this machine.
//!
//! A [`Participant`] is what a node of ROS 2 is to the others: a name, and ends of topics. What carries its messages is a
//! [`Middleware`], which a program hands in; here nothing speaks to a network. The program that has none lists the nodes by
//! [`Elsewhere`], and another one runs them.

mod cameras;
mod link;
mod middleware;
mod notices;
mod participant;
mod picture;
mod sink;
mod source;
#[cfg(test)]
mod tests;

pub use middleware::{Elsewhere, Middleware, Published};
pub use participant::{Distro, End, Participant, Via, Way};
pub use sink::{Ros2Sink, SinkConfig};
pub use source::{Ros2Source, SourceConfig};
