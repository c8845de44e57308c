//! Topics in shared memory, by iceoryx2: only this module uses it.
//!
//! A topic `t` of run `r` has three services: `conicflow/r/t` carries the messages, `conicflow/r/t/wake` wakes the readers when a
//! message was sent, `conicflow/r/t/room` wakes a writer that waits because a lossless reader's queue is full. All sizes of a
//! service follow from the pipeline file, so that all stages request the same ones and the order of their start does not matter.
//!
//! In a run with a launcher a kill of a lossless reader loses no message. Its writer keeps sent messages in iceoryx2's history
//! until the reader has [acknowledged](acknowledgements) them, and sends no more than fit there. A restarted reader receives the
//! history, and continues after the last acknowledgement.

#![allow(unsafe_code)] // layouts in shared memory, loans with old content, leases on files, pages returned to the system

pub(crate) mod acknowledgements;
mod cleanup;
mod descriptors;
pub(crate) mod leftovers;
mod onlooker;
mod reader;
mod reserve;
mod sent_messages;
mod service_keeper;
mod services;
#[cfg(test)]
pub(crate) mod tests;
pub(crate) mod trim_rss;
mod untyped;
mod writer;

pub(crate) use descriptors::Descriptors;
pub use onlooker::SharedOnlooker;
pub use reader::{SharedMessage, SharedReader};
pub use service_keeper::ServiceKeeper;
pub use services::SharedMemory;
pub use writer::SharedWriter;

use crate::item_type::ItemType;
use crate::ports::{Delivery, PortError, Topic, Transport};
use iceoryx2::prelude::PortName;
use reader::ReadingPort;
use sent_messages::SentMessages;
use std::fmt::Debug;
use std::sync::Arc;

impl Transport for SharedMemory {
    type Reader = SharedReader;
    type Writer = SharedWriter;

    fn reader_of(&self, item: &ItemType, topic: &Topic, stage: &str) -> Result<SharedReader, PortError> {
        let fault = |error: &dyn Debug| self.fault(format!("topic `{}` cannot be read", topic.name), error);
        let reader = topic.readers.iter().find(|reader| reader.stage == stage);
        let buffer = reader.map_or(2, |reader| self.buffer_of(topic, reader));
        let wake = self.listener(topic, "/wake")?;
        let lossless = topic.place_of(stage).filter(|_| topic.delivery_to(stage) == Delivery::Lossless);
        let room = lossless.map(|place| self.notifier(topic, "/room", place)).transpose()?;
        let table = lossless.and_then(|place| Some((self.acknowledgements(topic).transpose()?, place)));
        let finished = table.map(|(table, place)| Ok::<_, PortError>((table?, place))).transpose()?;
        let history = if finished.is_some() { topic.kept() } else { 0 };
        let name = PortName::new(stage).map_err(|error| fault(&error))?;
        let messages = self.messages(item, topic)?;
        let subscriber =
            messages.subscriber_builder().buffer_size(buffer).history_request(history).name(&name).create();
        let subscriber = subscriber.map_err(|error| fault(&error))?;
        let (item, topic, occupied) = (item.clone(), topic.name.clone(), Arc::clone(&self.occupied));
        let port = ReadingPort::new(subscriber, &self.occupied);
        Ok(SharedReader { port, wake, room, finished, origin: None, item, topic, occupied })
    }

    fn writer_of(&self, item: &ItemType, topic: &Topic) -> Result<SharedWriter, PortError> {
        Ok(SharedWriter {
            loan: None,
            publisher: None,
            capacity: 0,
            messages: Arc::new(self.messages(item, topic)?),
            wake: self.notifier(topic, "/wake", 0)?,
            room: Arc::new(self.listener(topic, "/room")?),
            answers: Arc::default(),
            attached: Vec::new(),
            sent: self.acknowledgements(topic)?.map(|finished| SentMessages::new(finished, topic)),
            item: item.clone(),
            topic: topic.clone(),
            config: self.node.config().clone(),
            stop: self.stop.clone(),
            occupied: Arc::clone(&self.occupied),
        })
    }
}
