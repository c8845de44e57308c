//! What a stage's runner needs of a transport: to take messages out of a topic and to write messages into one.
//!
//! [`shared_memory`] is the transport between processes, [`in_memory`] its twin for tests.

pub(crate) mod capacity;
pub mod in_memory;
pub mod shared_memory;

use capacity::in_words;
use conicflow_messages::{Header, Item, Kind};
use serde::{Deserialize, Serialize};
use std::path::PathBuf;
use std::time::Duration;

/// Messages that a stage keeps of one input at most until their frame has come, or its own turn.
pub(crate) const MAX_KEPT: usize = 12;

/// Which messages an input sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Delivery {
    /// The newest; what it overwrites is counted.
    Latest,
    /// Every one; the writer waits.
    Lossless,
}

/// One end of a topic, as the pipeline file describes it: what both sides have to agree on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Topic {
    /// Its name in the pipeline file.
    pub name: String,
    /// What it carries, where that is known.
    pub kind: Option<Kind>,
    /// Names of the stages that write it.
    pub writers: Vec<String>,
    /// The stages that read it, and how.
    pub readers: Vec<TopicReader>,
}

/// A stage that reads a topic.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TopicReader {
    /// Name of the stage.
    pub stage: String,
    /// Which messages it sees.
    pub delivery: Delivery,
    /// How many messages wait for it at most.
    pub queue: usize,
}

impl Topic {
    /// How the messages reach the stage `reader`.
    pub fn delivery_to(&self, reader: &str) -> Delivery {
        self.readers.iter().find(|entry| entry.stage == reader).map_or(Delivery::Latest, |entry| entry.delivery)
    }

    /// The place of a reader among those of the topic: the number by which it answers.
    pub(crate) fn place_of(&self, reader: &str) -> Option<usize> {
        self.readers.iter().position(|entry| entry.stage == reader)
    }

    /// The length of the longest queue of a reader.
    pub(crate) fn longest_queue(&self) -> usize {
        self.readers.iter().map(|reader| reader.queue).max().unwrap_or(2)
    }

    /// Whether any reader wants every message.
    pub fn is_lossless(&self) -> bool {
        self.readers.iter().any(|reader| reader.delivery == Delivery::Lossless)
    }
}

/// How a stage is joined to the others.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Wiring {
    /// The topic that drives it, if it is no source.
    pub input: Option<Topic>,
    /// Its further inputs, by their names.
    pub sides: Vec<(String, Topic)>,
    /// The topic that it writes.
    pub output: Option<Topic>,
    /// A source ends after so many messages.
    pub frames: Option<u64>,
}

/// Why a port could not be opened or used.
#[derive(Debug, thiserror::Error)]
pub enum PortError {
    /// The path of the shared memory's folder is too long for the sockets in it.
    #[error(
        "the folder `{}` is {length} bytes long, shared memory can use {limit} at most\n  \
         hint: set CONICFLOW_RUNTIME_DIR to a shorter path", path.display()
    )]
    PathTooLong {
        /// The folder.
        path: PathBuf,
        /// Its length in bytes.
        length: usize,
        /// The longest that works.
        limit: usize,
    },
    /// Somebody wrote this topic with other types.
    #[error(
        "topic `{topic}` carries another type of message than `{expected}`\n  \
         hint: its stages were built from different versions of conicflow, or one of them is no stage for this topic"
    )]
    Incompatible {
        /// The topic.
        topic: String,
        /// Type names of header and item that this stage uses.
        expected: String,
    },
    /// All places for those who look on are taken.
    #[error(
        "topic `{topic}` has {limit} onlookers already, there is no place for another\n  \
         hint: end one of them (`pgrep -af \"conicflow topic\"` lists them)"
    )]
    TooManyTaps {
        /// The topic.
        topic: String,
        /// How many it has places for.
        limit: usize,
    },
    /// The messages that may be under way at once would not find room in shared memory.
    #[error(
        "topic `{topic}` has a message of {length} items: shared memory has {} free, the topic needs up to {}\n  hint: \
         `conicflow doctor` says how to enlarge it", in_words(*.free), in_words(*.needed)
    )]
    NoRoom {
        /// The topic.
        topic: String,
        /// Items of the message.
        length: usize,
        /// Bytes that are free.
        free: u64,
        /// Bytes that the topic takes at most, with messages as long as this.
        needed: u64,
    },
    /// Shared memory failed.
    #[error(
        "{doing}: {reason}\n  hint: is there room in /dev/shm, may this user write to `{}`, and are there file \
         descriptors left?", root.display()
    )]
    SharedMemory {
        /// What was being done.
        doing: String,
        /// What iceoryx2 said.
        reason: String,
        /// The folder of the shared memory's files.
        root: PathBuf,
    },
    /// The run ended while the port waited.
    #[error("the run ended")]
    Stopped,
}

/// A message taken out of a topic, kept in the writer's memory as long as this lives.
pub trait Received<T: Item> {
    /// Its header.
    fn header(&self) -> &Header;
    /// Its items.
    fn items(&self) -> &[T];
}

/// Takes messages out of a topic.
pub trait Reader<T: Item> {
    /// A message in the writer's memory.
    type Message: Received<T>;

    /// The oldest message that waits, if any.
    ///
    /// # Errors
    /// The transport failed.
    fn receive(&mut self) -> Result<Option<Self::Message>, PortError>;

    /// Sleeps until a message may have come, at most for `timeout`.
    ///
    /// # Errors
    /// The transport failed.
    fn wait(&mut self, timeout: Duration) -> Result<(), PortError>;
}

/// Writes messages into a topic.
pub trait Writer<T: Item> {
    /// Memory for a message of `length` items, with the content of an earlier one. It is sent by [`Writer::send`];
    /// a loan that follows another replaces it.
    ///
    /// # Errors
    /// The transport failed.
    fn loan(&mut self, length: usize) -> Result<&mut [T], PortError>;

    /// Sends the loaned memory, or an empty message without one, and tells how many items that were. Waits for room where
    /// a reader wants every message.
    ///
    /// # Errors
    /// The transport failed, or the run ended while it waited.
    fn send(&mut self, header: &Header) -> Result<usize, PortError>;

    /// The stages of the pipeline that read this topic now.
    fn connected(&self) -> Vec<String>;
}

/// Opens the ends of topics.
pub trait Transport {
    /// How it reads.
    type Reader<T: Item>: Reader<T>;
    /// How it writes.
    type Writer<T: Item>: Writer<T>;

    /// Opens a topic for `stage` to read.
    ///
    /// # Errors
    /// The transport failed.
    fn reader<T: Item>(&self, topic: &Topic, stage: &str) -> Result<Self::Reader<T>, PortError>;

    /// Opens a topic to write.
    ///
    /// # Errors
    /// The transport failed.
    fn writer<T: Item>(&self, topic: &Topic) -> Result<Self::Writer<T>, PortError>;
}
