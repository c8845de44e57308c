//! Keeps the services of a run in being, whichever of its stages come and go.
//!
//! Processes that open a service at the same time settle who of them creates it. If that one is killed meanwhile the service
//! is stuck, and nobody can open it any more. So the launcher creates all of them before it starts a stage.

use super::services::{EventFactory, SharedMemory};
use crate::ports::{PortError, Topic};
use conicflow_messages::{Ellipse, Item, Kind, Object, Track};
use std::any::Any;

/// The services of topics, for as long as this is held.
pub struct Held {
    _messages: Vec<Box<dyn Any>>,
    _events: Vec<EventFactory>,
    _memory: SharedMemory,
}

impl SharedMemory {
    /// Creates the services of these topics. What a topic carries that only programs of one's own write and read is known to
    /// them alone; its messages' service is theirs to create.
    ///
    /// # Errors
    /// Shared memory failed.
    pub fn hold<'a>(self, topics: impl Iterator<Item = &'a Topic>) -> Result<Held, PortError> {
        let (mut messages, mut events) = (Vec::new(), Vec::new());
        for topic in topics {
            messages.extend(self.messages_of_kind(topic)?);
            events.extend([self.event(topic, "/wake")?, self.event(topic, "/room")?]);
        }
        Ok(Held { _messages: messages, _events: events, _memory: self })
    }

    fn messages_of_kind(&self, topic: &Topic) -> Result<Option<Box<dyn Any>>, PortError> {
        Ok(match topic.kind {
            Some(Kind::Depth) => Some(self.boxed::<u16>(topic)?),
            Some(Kind::Ellipses) => Some(self.boxed::<Ellipse>(topic)?),
            Some(Kind::Objects) => Some(self.boxed::<Object>(topic)?),
            Some(Kind::Tracks) => Some(self.boxed::<Track>(topic)?),
            Some(Kind::Nothing) | None => None,
        })
    }

    fn boxed<T: Item>(&self, topic: &Topic) -> Result<Box<dyn Any>, PortError> {
        Ok(Box::new(self.messages::<T>(topic)?))
    }
}
