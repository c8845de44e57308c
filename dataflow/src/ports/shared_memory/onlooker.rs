//! Onlooker of a topic: an additional reader from outside the pipeline. No writer waits for it, and it wakes none.
//!
//! It has no place among the pipeline's readers but a spare one, and no listener. A slow, suspended or dead onlooker loses
//! messages, and no writer is affected.

use super::reader::{ReadingPort, SharedMessage};
use super::services::{SPARE_READERS, SharedMemory};
use crate::item_type::ItemType;
use crate::ports::{PortError, Topic};
use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::prelude::PortName;
use std::sync::Arc;

/// A name that no stage can have.
const NAME: &str = "(onlooker)";

/// Reads a topic as an onlooker.
pub struct SharedOnlooker {
    port: Arc<ReadingPort>,
}

impl SharedMemory {
    /// Opens a topic with items of this type as an onlooker; the run has created all that this needs.
    ///
    /// # Errors
    /// The topic carries another type, there are too many onlookers, or shared memory failed.
    pub fn onlooker(&self, item: &ItemType, topic: &Topic) -> Result<SharedOnlooker, PortError> {
        let fault = |reason: String| self.fault(format!("topic `{}` cannot be looked into", topic.name), reason);
        let name = PortName::new(NAME).map_err(|error| fault(format!("{error:?}")))?;
        let queue = topic.longest_queue();
        let messages = self.messages_of_others(item, topic)?;
        let created = messages.subscriber_builder().buffer_size(queue).history_request(0).name(&name).create();
        let subscriber = created.map_err(|error| match error {
            SubscriberCreateError::ExceedsMaxSupportedSubscribers => {
                PortError::TooManyOnlookers { topic: topic.name.clone(), limit: SPARE_READERS }
            }
            other => fault(format!("{other:?}")),
        })?;
        Ok(SharedOnlooker { port: ReadingPort::new(subscriber, &self.occupied) })
    }
}

impl SharedOnlooker {
    /// Takes the oldest message from the queue, if any.
    ///
    /// # Errors
    /// Shared memory failed.
    pub fn receive(&mut self, memory: &SharedMemory) -> Result<Option<SharedMessage>, PortError> {
        self.port.receive().map_err(|error| memory.fault("a topic cannot be looked into", error))
    }
}
