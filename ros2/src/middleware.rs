//! What carries the messages of ROS 2; a program that speaks to a network hands it in.

use crate::Participant;
use conicflow_dataflow::StageError;
use conicflow_messages::Hinted;
use std::time::Duration;

/// A topic that somebody publishes, and the name of its type, such as `sensor_msgs/msg/Image`.
pub type Published = (String, String);

/// Carries the messages of a participant.
pub trait Middleware: Sized {
    /// Takes part as soon as that works, and again where the router was lost; comes back at once.
    ///
    /// # Errors
    /// It can never work.
    fn join(participant: Participant) -> Result<Self, StageError>;

    /// Whether the router is reached.
    fn is_joined(&self) -> bool;

    /// The next message at an end, as soon as there is one, at most after `timeout`.
    fn receive(&self, end: usize, timeout: Duration) -> Option<Vec<u8>>;

    /// Messages at an end that were lost since this was asked last, on the way or because nobody took them.
    fn take_lost(&self, end: usize) -> u64;

    /// Sends a message from an end; where nobody listens it is gone.
    fn publish(&self, end: usize, message: Vec<u8>);

    /// What others publish.
    fn published(&self) -> Vec<Published>;
}

/// The nodes are run by another program: here they are listed and checked.
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
