//! Keeps the services of a run alive, independent of its stages.
//!
//! Processes that open a service at the same time decide among themselves which of them creates it. If that one is killed
//! meanwhile, the service is stuck, and no process can open it any more. The launcher therefore creates all services before it
//! starts a stage.

use super::acknowledgements::Acknowledgements;
use super::services::{EventFactory, SharedMemory};
use super::untyped::Factory;
use crate::ports::{PortError, Topic};
use std::time::Duration;

/// The services of a run's topics, kept alive for the lifetime of this value.
pub struct ServiceKeeper {
    _messages: Vec<Factory>,
    _events: Vec<EventFactory>,
    memory: SharedMemory,
}

impl ServiceKeeper {
    /// Whether the run's shared memory still exists. If not, its processes go on, but new ones do not find them.
    pub(crate) fn is_there(&self) -> bool {
        self.memory.occupied.is_there()
    }

    /// Removes incomplete files whose maker was killed, so that processes that wait for them go on. Files that cannot be removed
    /// are removed with the run.
    pub(crate) fn settle(&self) {
        self.memory.occupied.settle(Duration::ZERO).ok();
    }
}

impl SharedMemory {
    /// Creates the services of these topics. If the type of a topic is unknown here, the service of its messages is left to its
    /// programs.
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
