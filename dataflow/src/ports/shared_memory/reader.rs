//! Reader of a topic in shared memory.

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

/// Reader of a topic in shared memory.
pub struct SharedReader {
    pub(super) port: Arc<ReadingPort>,
    pub(super) wake: Listener<Ipc>,
    pub(super) room: Option<Notifier<Ipc>>,
    /// Table of acknowledgements, and this reader's index in it.
    pub(super) finished: Option<(Arc<Acknowledgements>, usize)>,
    /// Port of the last message's writer.
    pub(super) origin: Option<u128>,
    pub(super) item: ItemType,
    pub(super) topic: String,
    pub(super) occupied: Arc<Occupied>,
}

/// Port for messages. A writer takes the memory of messages back when the port that received them is dropped, so each message
/// holds its port.
pub(super) struct ReadingPort {
    subscriber: Subscriber,
    /// The last field: the folder is in use until the ports are dropped.
    _occupied: Arc<Occupied>,
}

impl ReadingPort {
    pub(super) fn new(subscriber: Subscriber, occupied: &Arc<Occupied>) -> Arc<Self> {
        Arc::new(Self { subscriber, _occupied: Arc::clone(occupied) })
    }

    /// Takes the oldest message from the queue, if any.
    pub(super) fn receive(self: &Arc<Self>) -> Result<Option<SharedMessage>, ReceiveError> {
        let received = self.subscriber.receive()?;
        Ok(received.map(|sample| SharedMessage { sample, _port: Arc::clone(self) }))
    }
}

/// A message in shared memory, which is not reused for the lifetime of this value.
pub struct SharedMessage {
    sample: Sample,
    /// Dropped after the message.
    _port: Arc<ReadingPort>,
}

// SAFETY: threads that share it only read header and items, which nobody writes during its lifetime. Its last owner returns it
// once, to a service that is safe for threads and so makes it `Send`.
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
            // If messages are kept, a writer gets room only when one is finished; but a new writer waits until its first message
            // is taken.
            if self.finished.is_none() || self.origin != origin {
                self.wake_writer();
            }
            self.origin = origin;
        }
        Ok(received)
    }

    fn wait(&mut self, timeout: Duration) -> Result<(), PortError> {
        match self.wake.timed_wait(|_| {}, timeout) {
            // A signal ends the sleep early; the runner then checks its stop flag.
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
        // A writer that is not woken checks again after `DEAD_READER_CHECK`.
        if let Some(room) = &self.room {
            room.notify().ok();
        }
    }
}
