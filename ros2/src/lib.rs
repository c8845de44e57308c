//! The nodes `ros2_source` and `ros2_sink`: bring a robot's depth images into a pipeline, and send the results back to the robot,
//! without a ROS installation on this machine.
//!
//! A [`Participant`] is a ROS 2 node as the others see it: a name and endpoints of topics. A [`Middleware`], which the program
//! provides, carries its messages; this package uses no network. A program without a middleware lists the nodes with
//! [`Elsewhere`], and another program runs them.

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
