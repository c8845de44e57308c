//! The reading end of a topic in shared memory.

use super::cleanup::Occupied;
use super::services::Ipc;
use super::untyped::{Sample, Subscriber, header_of, items_of};
use crate::item_type::ItemType;
use crate::ports::{PortError, Reader, Received};
use conicflow_messages::Header;
use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use std::sync::Arc;
use std::time::Duration;

/// Reads a topic in shared memory.
pub struct SharedReader {
    pub(super) subscriber: Subscriber,
    pub(super) wake: Listener<Ipc>,
    pub(super) room: Option<Notifier<Ipc>>,
    pub(super) item: ItemType,
    pub(super) topic: String,
    pub(super) occupied: Arc<Occupied>,
}

/// A message in shared memory.
#[derive(Debug)]
pub struct SharedMessage(pub(super) Sample);

impl Received for SharedMessage {
    fn header(&self) -> &Header {
        header_of(&self.0)
    }

    fn bytes(&self) -> &[u8] {
        items_of(&self.0)
    }
}

impl Reader for SharedReader {
    type Message = SharedMessage;

    fn item(&self) -> &ItemType {
        &self.item
    }

    fn receive(&mut self) -> Result<Option<SharedMessage>, PortError> {
        let received = self.subscriber.receive().map_err(|error| PortError::SharedMemory {
            doing: format!("topic `{}` cannot be read", self.topic),
            reason: format!("{error:?}"),
            root: self.occupied.root().to_owned(),
        })?;
        if let (Some(_), Some(room)) = (&received, &self.room) {
            // A writer that is not woken looks again by itself after `DEAD_READER_CHECK`.
            room.notify().ok();
        }
        Ok(received.map(SharedMessage))
    }

    fn wait(&mut self, timeout: Duration) -> Result<(), PortError> {
        match self.wake.timed_wait(|_| {}, timeout) {
            // A signal ends the sleep early; the runner looks at its stop flag then.
            Ok(_) | Err(ListenerWaitError::InterruptSignal) => Ok(()),
            Err(error) => Err(PortError::SharedMemory {
                doing: format!("waiting for topic `{}` failed", self.topic),
                reason: format!("{error:?}"),
                root: self.occupied.root().to_owned(),
            }),
        }
    }
}
