//! The reading end of a topic in shared memory.

use super::cleanup::Occupied;
use super::services::{Ipc, WireHeader, WireItem};
use crate::ports::{PortError, Reader, Received};
use bytemuck::TransparentWrapper;
use conicflow_messages::{Header, Item};
use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::sample::Sample;
use std::sync::Arc;
use std::time::Duration;

/// Reads a topic in shared memory.
pub struct SharedReader<T: Item> {
    pub(super) subscriber: Subscriber<Ipc, [WireItem<T>], WireHeader>,
    pub(super) wake: Listener<Ipc>,
    pub(super) room: Option<Notifier<Ipc>>,
    pub(super) topic: String,
    pub(super) occupied: Arc<Occupied>,
}

/// A message in shared memory.
#[derive(Debug)]
pub struct SharedMessage<T: Item>(pub(super) Sample<Ipc, [WireItem<T>], WireHeader>);

impl<T: Item> Received<T> for SharedMessage<T> {
    fn header(&self) -> &Header {
        WireHeader::peel_ref(self.0.user_header())
    }

    fn items(&self) -> &[T] {
        WireItem::peel_slice(self.0.payload())
    }
}

impl<T: Item> Reader<T> for SharedReader<T> {
    type Message = SharedMessage<T>;

    fn receive(&mut self) -> Result<Option<SharedMessage<T>>, PortError> {
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
