//! A look into a topic from outside the pipeline: one reader more, which nobody waits for and which wakes nobody.
//!
//! It has no place among the pipeline's readers but one of those kept free for it, and no listener. An onlooker that is slow,
//! stopped or dead loses messages, and no writer notices.

use super::reader::{ReadingPort, SharedMessage};
use super::services::{SPARE_READERS, SharedMemory};
use crate::item_type::ItemType;
use crate::ports::{PortError, Topic};
use iceoryx2::port::subscriber::SubscriberCreateError;
use iceoryx2::prelude::PortName;
use std::sync::Arc;

/// No stage can have this name.
const NAME: &str = "(onlooker)";

/// Reads a topic that others read.
pub struct SharedOnlooker {
    port: Arc<ReadingPort>,
}

impl SharedMemory {
    /// Looks into a topic of these items, of which this process is no part: its run has made all that this needs.
    ///
    /// # Errors
    /// The topic carries something else, too many look on already, or shared memory failed.
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
    /// The oldest message that waits, if any.
    ///
    /// # Errors
    /// Shared memory failed.
    pub fn receive(&mut self, memory: &SharedMemory) -> Result<Option<SharedMessage>, PortError> {
        self.port.receive().map_err(|error| memory.fault("a topic cannot be looked into", error))
    }
}
