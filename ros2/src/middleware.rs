//! The interface to the transport of ROS 2 messages, which a program with a network implements.

use crate::Participant;
use conicflow_dataflow::StageError;
use conicflow_messages::Hinted;
use std::time::Duration;

/// A published topic, and the name of its type, such as `sensor_msgs/msg/Image`.
pub type Published = (String, String);

/// Carries the messages of a participant.
pub trait Middleware: Sized {
    /// Joins as soon as that is possible, and again after the router was lost; returns at once.
    ///
    /// # Errors
    /// The settings can never work.
    fn join(participant: Participant) -> Result<Self, StageError>;

    /// Whether the router is reached.
    fn is_joined(&self) -> bool;

    /// Waits for a message at an endpoint for at most `timeout`, and returns it.
    fn receive(&self, end: usize, timeout: Duration) -> Option<Vec<u8>>;

    /// Returns the number of messages lost at an endpoint since the last call, on the way or by a full queue.
    fn take_lost(&self, end: usize) -> u64;

    /// Publishes a message at an endpoint; without a subscriber it is lost.
    fn publish(&self, end: usize, message: Vec<u8>);

    /// The topics that other nodes publish.
    fn published(&self) -> Vec<Published>;
}

/// A middleware that does nothing: another program runs the nodes, and this one only lists and checks them.
#[derive(Clone, Copy, Debug)]
pub enum Elsewhere {}

impl Middleware for Elsewhere {
    fn join(_: Participant) -> Result<Self, StageError> {
        Err(Hinted::new("this program does not speak to ROS 2", "`conicflow-bridge` runs this node").into())
    }

    fn is_joined(&self) -> bool {
        match *self {}
    }

    fn receive(&self, _: usize, _: Duration) -> Option<Vec<u8>> {
        match *self {}
    }

    fn take_lost(&self, _: usize) -> u64 {
        match *self {}
    }

    fn publish(&self, _: usize, _: Vec<u8>) {
        match *self {}
    }

    fn published(&self) -> Vec<Published> {
        match *self {}
    }
}
