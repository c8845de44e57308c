//! The reading end of a topic in shared memory.

use super::acknowledgements::Acknowledgements;
use super::cleanup::Occupied;
use super::services::Ipc;
use super::untyped::{Sample, Subscriber, header_of, items_of};
use crate::item_type::ItemType;
use crate::ports::{PortError, Reader, Received};
use conicflow_messages::{Header, Text};
use iceoryx2::port::ReceiveError;
use iceoryx2::port::listener::{Listener, ListenerWaitError};
use iceoryx2::port::notifier::Notifier;
use std::fmt::Debug;
use std::sync::Arc;
use std::time::Duration;

/// Reads a topic in shared memory.
pub struct SharedReader {
    pub(super) port: Arc<ReadingPort>,
    pub(super) wake: Listener<Ipc>,
    pub(super) room: Option<Notifier<Ipc>>,
    /// Where it notes what it has finished, and its place there.
    pub(super) finished: Option<(Arc<Acknowledgements>, usize)>,
    /// The writer's end from which the last message came.
    pub(super) origin: Option<u128>,
    pub(super) item: ItemType,
    pub(super) topic: String,
    pub(super) occupied: Arc<Occupied>,
}

/// What messages come through. A writer takes the memory of messages back when the port through which they went is gone, so each
/// message keeps its port.
pub(super) struct ReadingPort {
    subscriber: Subscriber,
    /// Last: the folder is this process's until its ports have left it.
    _occupied: Arc<Occupied>,
}

impl ReadingPort {
    pub(super) fn new(subscriber: Subscriber, occupied: &Arc<Occupied>) -> Arc<Self> {
        Arc::new(Self { subscriber, _occupied: Arc::clone(occupied) })
    }

    /// The oldest message that waits, if any.
    pub(super) fn receive(self: &Arc<Self>) -> Result<Option<SharedMessage>, ReceiveError> {
        let received = self.subscriber.receive()?;
        Ok(received.map(|sample| SharedMessage { sample, _port: Arc::clone(self) }))
    }
}

/// A message in shared memory, which is not used for another one as long as this lives.
pub struct SharedMessage {
    sample: Sample,
    /// After the message.
    _port: Arc<ReadingPort>,
}

// SAFETY: who shares it reads header and items, which nobody writes as long as it lives; it is given back once, by its last
// owner, to a service that is safe for threads, which makes it `Send`.
unsafe impl Sync for SharedMessage {}

impl Received for SharedMessage {
    fn header(&self) -> &Header {
        header_of(&self.sample)
    }

    fn bytes(&self) -> &[u8] {
        items_of(&self.sample)
    }
}

impl Reader for SharedReader {
    type Message = SharedMessage;

    fn item(&self) -> &ItemType {
        &self.item
    }

    fn receive(&mut self) -> Result<Option<SharedMessage>, PortError> {
        let received = self.port.receive();
        let received = received.map_err(|error| self.fault(format!("topic `{}` cannot be read", self.topic), error))?;
        if let Some(message) = &received {
            let origin = Some(message.sample.header().publisher_id().value());
            // Where messages are kept, there is room for another one when one is finished; a new writer waits until it is seen.
            if self.finished.is_none() || self.origin != origin {
                self.wake_writer();
            }
            self.origin = origin;
        }
        Ok(received)
    }

    fn wait(&mut self, timeout: Duration) -> Result<(), PortError> {
        match self.wake.timed_wait(|_| {}, timeout) {
            // A signal ends the sleep early; the runner looks at its stop flag then.
            Ok(_) | Err(ListenerWaitError::InterruptSignal) => Ok(()),
            Err(error) => Err(self.fault(format!("waiting for topic `{}` failed", self.topic), error)),
        }
    }

    fn acknowledge(&mut self, writer: Text<32>, next: u64) {
        let Some((table, own)) = &self.finished else { return };
        let Some(place) = table.place_of(&writer) else { return };
        table.finish(*own, place, next);
        self.wake_writer();
    }

    fn acknowledged(&self) -> Option<Vec<(Text<32>, u64)>> {
        let (table, own) = self.finished.as_ref()?;
        Some(table.writers().iter().enumerate().map(|(place, writer)| (*writer, table.next(*own, place))).collect())
    }

    fn begin(&mut self, writer: Text<32>, number: u64) -> u64 {
        let place = self.finished.as_ref().and_then(|(table, own)| Some((table, *own, table.place_of(&writer)?)));
        place.map_or(1, |(table, own, place)| table.begin(own, place, number))
    }
}

impl SharedReader {
    fn fault(&self, doing: String, reason: impl Debug) -> PortError {
        PortError::of_shared_memory(self.occupied.root(), doing, reason)
    }

    fn wake_writer(&self) {
        // A writer that is not woken looks again by itself after `DEAD_READER_CHECK`.
        if let Some(room) = &self.room {
            room.notify().ok();
        }
    }
}
