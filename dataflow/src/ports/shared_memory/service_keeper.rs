//! Keeps the services of a run in being, whichever of its stages come and go.
//!
//! Processes that open a service at the same time settle who of them creates it. If that one is killed meanwhile the service
//! is stuck, and nobody can open it any more. So the launcher creates all of them before it starts a stage.

use super::acknowledgements::Acknowledgements;
use super::services::{EventFactory, SharedMemory};
use super::untyped::Factory;
use crate::ports::{PortError, Topic};
use std::time::Duration;

/// The services of topics, for as long as this is held.
pub struct ServiceKeeper {
    _messages: Vec<Factory>,
    _events: Vec<EventFactory>,
    memory: SharedMemory,
}

impl ServiceKeeper {
    /// Whether the run's part of shared memory is there. If it is not, those who are in it go on, but nobody finds them any more.
    pub(crate) fn is_there(&self) -> bool {
        self.memory.occupied.is_there()
    }

    /// Removes from it what a stage was killed over while it made that: who waits for it goes on. What cannot be removed goes with
    /// the run.
    pub(crate) fn settle(&self) {
        self.memory.occupied.settle(Duration::ZERO).ok();
    }
}

impl SharedMemory {
    /// Creates the services of these topics. Where nothing tells what a topic carries, its programs alone know, and its
    /// messages' service is theirs to create.
    ///
    /// # Errors
    /// Shared memory failed.
    pub fn keep_services<'a>(self, topics: impl Iterator<Item = &'a Topic>) -> Result<ServiceKeeper, PortError> {
        let (mut messages, mut events) = (Vec::new(), Vec::new());
        for topic in topics {
            if let Some(folder) = self.folder_of(topic) {
                let fault = |error| self.fault(format!("topic `{}` cannot be noted of", topic.name), error);
                Acknowledgements::create(folder, topic).map_err(fault)?;
            }
            if let Some(item) = &topic.item {
                messages.push(self.messages(item, topic)?);
            }
            events.extend([self.event(topic, "/wake")?, self.event(topic, "/room")?]);
        }
        Ok(ServiceKeeper { _messages: messages, _events: events, memory: self })
    }
}
