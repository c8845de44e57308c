//! Interface between a stage's runner and a transport: reads messages from a topic and writes messages into one.
//!
//! Ports carry bytes of an [`ItemType`], so that a process can carry types that it does not know. A process that knows the type
//! reads and writes items by [`Received::items`] and [`Writer::loan`]. [`shared_memory`] is the transport between processes,
//! [`in_memory`] its equivalent for tests.

pub(crate) mod capacity;
pub mod in_memory;
pub(crate) mod patience;
pub mod shared_memory;

use crate::item_type::ItemType;
use bytemuck::{try_cast_slice, try_cast_slice_mut};
use capacity::in_words;
use conicflow_messages::{Header, Hinted, Item, Text};
use rustix::process::{Resource, getrlimit};
use serde::{Deserialize, Serialize};
use std::fmt::Debug;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Maximum number of messages of one input that a stage buffers until the message of their frame has come, or, as a successor,
/// until its turn.
pub(crate) const MAX_KEPT: usize = 12;

/// Hint for a topic that carries another type of message.
const OTHER_BUILD: &str =
    "its stages were built from different versions of conicflow, or one of them is no stage for this topic";

/// Which messages an input sees.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Delivery {
    /// The newest; overwritten ones are counted.
    Latest,
    /// Every one; the writer waits.
    Lossless,
}

/// A topic as the pipeline file describes it. Readers and writers have to agree on it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Topic {
    /// Its name in the pipeline file.
    pub name: String,
    /// Its item type, where known.
    pub item: Option<ItemType>,
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
    /// Maximum number of messages in its queue.
    pub queue: usize,
}

impl TopicReader {
    /// Maximum number of messages that a writer sends to this lossless reader before one is finished: those in the queue and the
    /// one being processed.
    pub(crate) const fn credit(&self) -> usize {
        self.queue + 1
    }
}

impl Topic {
    /// Delivery to the stage `reader`.
    pub fn delivery_to(&self, reader: &str) -> Delivery {
        self.readers.iter().find(|entry| entry.stage == reader).map_or(Delivery::Latest, |entry| entry.delivery)
    }

    /// Index of a reader among those of the topic; its acknowledgements carry this number.
    pub(crate) fn place_of(&self, reader: &str) -> Option<usize> {
        self.readers.iter().position(|entry| entry.stage == reader)
    }

    /// Number of messages that a writer keeps for lossless readers that may restart: the longest queue, the message being
    /// processed, and the end of the stream.
    pub(crate) fn kept(&self) -> usize {
        let lossless = self.readers.iter().filter(|reader| reader.delivery == Delivery::Lossless);
        lossless.map(|reader| reader.credit() + 1).max().unwrap_or(0)
    }

    /// Length of the longest queue of a reader.
    pub(crate) fn longest_queue(&self) -> usize {
        self.readers.iter().map(|reader| reader.queue).max().unwrap_or(2)
    }

    /// Name of its item type.
    pub fn kind(&self) -> Option<&str> {
        self.item.as_ref().map(ItemType::name)
    }

    /// Its item type.
    ///
    /// # Errors
    /// The pipeline file does not say.
    pub fn expect_item(&self) -> Result<&ItemType, Hinted> {
        self.item.as_ref().ok_or_else(|| {
            let name = &self.name;
            let hint = format!(
                "say it where a program writes it, such as output = {{ topic = \"{name}\", kind = \"objects\" }}"
            );
            Hinted::new(format!("nothing tells what topic `{name}` carries"), hint)
        })
    }

    /// Makes sure that a stage may read or write items of the type `item`.
    ///
    /// # Errors
    /// The topic carries another type, according to the pipeline file.
    fn expect(&self, item: &ItemType) -> Result<(), PortError> {
        match &self.item {
            Some(declared) if !declared.fits(item) => {
                let hint = if declared.is_built_in() {
                    OTHER_BUILD.to_owned()
                } else {
                    format!("let `type` and `fields` under [item.{}] be those of the program", declared.name())
                };
                let declared = format!(": the pipeline file says {declared}");
                Err(PortError::Incompatible { topic: self.name.clone(), own: item.to_string(), declared, hint })
            }
            _ => Ok(()),
        }
    }

    /// Whether any reader is lossless.
    pub fn is_lossless(&self) -> bool {
        self.readers.iter().any(|reader| reader.delivery == Delivery::Lossless)
    }
}

/// Topics that connect a stage to the others.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Wiring {
    /// The topic that drives it, if it is no source.
    pub input: Option<Topic>,
    /// Its side inputs, by their names.
    pub side_inputs: Vec<(String, Topic)>,
    /// The topic that it writes.
    pub output: Option<Topic>,
    /// Number of messages after which a source ends.
    pub frames: Option<u64>,
}

impl Wiring {
    /// The topics that it reads, the driving one first.
    pub fn inputs(&self) -> impl Iterator<Item = &Topic> {
        self.input.iter().chain(self.side_inputs.iter().map(|(_, topic)| topic))
    }
}

/// Reason why a port could not be opened or used.
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
    /// The path of the shared memory's folder has characters that names in shared memory may not have.
    #[error(
        "the folder `{}` has {} in its path, which shared memory cannot use\n  hint: set CONICFLOW_RUNTIME_DIR to a path of \
         letters from a to z, digits and `/._-`", path.display(), in_quotes(path)
    )]
    PathUnusable {
        /// The folder.
        path: PathBuf,
    },
    /// The topic carries another type of message.
    #[error("topic `{topic}` carries another type of message than {own}{declared}\n  hint: {hint}")]
    Incompatible {
        /// The topic.
        topic: String,
        /// The type that this stage has.
        own: String,
        /// Text that names the other type, where it is known.
        declared: String,
        /// Hint.
        hint: String,
    },
    /// The topic has no place for another onlooker.
    #[error(
        "topic `{topic}` has {limit} onlookers already, there is no place for another\n  \
         hint: end one of them (`pgrep -af \"conicflow topic\"` lists them)"
    )]
    TooManyOnlookers {
        /// The topic.
        topic: String,
        /// Number of onlookers that it has places for.
        limit: usize,
    },
    /// Shared memory has no room for the messages that may be in use at once.
    #[error(
        "topic `{topic}` has a message of {length} items: shared memory has {} free, the topic needs up to {}\n  hint: \
         `conicflow doctor` says how to enlarge it", in_words(*.free), in_words(*.needed)
    )]
    NoRoom {
        /// The topic.
        topic: String,
        /// Number of items of the message.
        length: usize,
        /// Bytes that are free.
        free: u64,
        /// Maximum number of bytes that the topic takes with messages of this length.
        needed: u64,
    },
    /// Shared memory failed.
    #[error(
        "{doing}: {reason}\n  hint: is there room in /dev/shm, may this user write to `{}`, and are there file \
         descriptors left?{}", root.display(), of_limits(|resource| getrlimit(resource).current)
    )]
    SharedMemory {
        /// What was being done.
        doing: String,
        /// Error of iceoryx2.
        reason: String,
        /// The folder of the shared memory's files.
        root: PathBuf,
    },
    /// The run ended while the port waited.
    #[error("the run ended")]
    Stopped,
}

/// Quotes the characters of a path that names in shared memory may not have.
fn in_quotes(path: &Path) -> String {
    let path = path.to_string_lossy();
    let mut unusable: Vec<_> =
        path.chars().filter(|c| !c.is_ascii_graphic() && *c != ' ' || "<>\"|?*".contains(*c)).collect();
    unusable.dedup();
    unusable.iter().map(|c| format!("`{}`", c.escape_debug())).collect::<Vec<_>>().join(", ")
}

/// Further hint where the memory or the file size of a process is limited (`ulimit`): shared memory counts as both.
fn of_limits(limit: impl Fn(Resource) -> Option<u64>) -> String {
    let memory =
        limit(Resource::As).map(|bytes| format!(" `ulimit -v` lets a process have {} in all", in_words(bytes)));
    let file = limit(Resource::Fsize).map(|bytes| format!(" `ulimit -f` lets a file have {}", in_words(bytes)));
    memory.into_iter().chain(file).collect::<Vec<_>>().join(",")
}

impl PortError {
    /// Error of an operation (`doing`) in the shared memory of this folder.
    fn of_shared_memory(root: &Path, doing: impl Into<String>, reason: impl Debug) -> Self {
        Self::SharedMemory { doing: doing.into(), reason: format!("{reason:?}"), root: root.to_owned() }
    }
}

/// A received message. Its memory stays the writer's, and is held until this is dropped.
pub trait Received {
    /// Its header.
    fn header(&self) -> &Header;
    /// Its items, as bytes aligned like the items.
    fn bytes(&self) -> &[u8];

    /// Its items; empty if the bytes are not a whole number of items.
    fn items<T: Item>(&self) -> &[T]
    where
        Self: Sized,
    {
        try_cast_slice(self.bytes()).unwrap_or_default()
    }
}

/// Result of a poll for a message.
pub enum Polled<M> {
    /// The next message.
    Message(M),
    /// None yet.
    Pending,
    /// None, and none will come.
    Over,
}

/// Reader of a topic.
pub trait Reader {
    /// A message in the writer's memory.
    type Message: Received + Send + Sync + 'static;

    /// Type of the items.
    fn item(&self) -> &ItemType;

    /// Takes the oldest message from the queue, if any.
    ///
    /// # Errors
    /// The transport failed.
    fn receive(&mut self) -> Result<Option<Self::Message>, PortError>;

    /// Sleeps until a message may have come, at most for `timeout`.
    ///
    /// # Errors
    /// The transport failed.
    fn wait(&mut self, timeout: Duration) -> Result<(), PortError>;

    /// Acknowledges the messages of `writer` with numbers below `next`: this stage will not need them again, even after a
    /// restart. The default, for a transport that keeps no messages, does nothing.
    fn acknowledge(&mut self, writer: Text<32>, next: u64) {
        let _ = (writer, next);
    }

    /// By writer, the number of the first message that this stage has not finished, in any of its processes; `None` where no
    /// messages are kept.
    fn acknowledged(&self) -> Option<Vec<(Text<32>, u64)>> {
        None
    }

    /// Records the start of work on a message. Returns how often this stage has started on it, this time included.
    fn begin(&mut self, writer: Text<32>, number: u64) -> u64 {
        let _ = (writer, number);
        1
    }
}

/// Writer of a topic.
pub trait Writer {
    /// Type of the items.
    fn item(&self) -> &ItemType;

    /// Loans memory for a message of `length` items; it holds the content of an earlier message. [`Writer::send`] sends it; a
    /// second loan replaces the first.
    ///
    /// # Errors
    /// The transport failed.
    fn loan_bytes(&mut self, length: usize) -> Result<&mut [u8], PortError>;

    /// Loans memory as [`Writer::loan_bytes`] does, typed; empty if the topic's items are of another type.
    ///
    /// # Errors
    /// The transport failed.
    fn loan<T: Item>(&mut self, length: usize) -> Result<&mut [T], PortError> {
        Ok(try_cast_slice_mut(self.loan_bytes(length)?).unwrap_or_default())
    }

    /// Sends the loaned memory, or an empty message without a loan, and returns its number of items. Blocks while a lossless
    /// reader has no room.
    ///
    /// # Errors
    /// The transport failed, or the run ended while it waited.
    fn send(&mut self, header: &Header) -> Result<usize, PortError>;

    /// The readers of the pipeline that are connected now.
    fn connected(&self) -> Vec<ConnectedReader>;

    /// Number of messages sent by this end since the first one that the stage `reader` has not finished, inclusive; 0 where no
    /// messages are kept for it.
    fn unfinished(&self, reader: &str) -> usize {
        let _ = reader;
        0
    }

    /// Resends kept messages to readers that have restarted.
    fn catch_up(&mut self) {}

    /// Sleeps until a reader has finished a message, at most for `timeout`, and resends kept messages to readers that have
    /// restarted. Returns whether a reader has finished one.
    fn wait(&mut self, timeout: Duration) -> bool {
        std::thread::sleep(timeout);
        false
    }
}

/// A connected reader; a restarted stage is a new one.
#[derive(Clone, Debug, PartialEq, Eq, Hash)]
pub struct ConnectedReader {
    /// Unique number of its port.
    pub port: u128,
    /// Name of the stage.
    pub stage: String,
}

/// Opens readers and writers of topics.
pub trait Transport {
    /// Type of its readers.
    type Reader: Reader + Send + 'static;
    /// Type of its writers.
    type Writer: Writer + Send + 'static;

    /// Opens a topic with items of this type for the stage `stage` to read.
    ///
    /// # Errors
    /// The transport failed, or the topic carries something else.
    fn reader_of(&self, item: &ItemType, topic: &Topic, stage: &str) -> Result<Self::Reader, PortError>;

    /// Opens a topic with items of this type to write.
    ///
    /// # Errors
    /// The transport failed, or the topic carries something else.
    fn writer_of(&self, item: &ItemType, topic: &Topic) -> Result<Self::Writer, PortError>;

    /// Opens a topic with items of the Rust type `T` for the stage `stage` to read.
    ///
    /// # Errors
    /// The transport failed, or the topic carries something else.
    fn reader<T: Item>(&self, topic: &Topic, stage: &str) -> Result<Self::Reader, PortError> {
        self.reader_of(const { &ItemType::of::<T>() }, topic, stage)
    }

    /// Opens a topic with items of the Rust type `T` to write.
    ///
    /// # Errors
    /// The transport failed, or the topic carries something else.
    fn writer<T: Item>(&self, topic: &Topic) -> Result<Self::Writer, PortError> {
        self.writer_of(const { &ItemType::of::<T>() }, topic)
    }
}

#[cfg(test)]
mod tests {
    use super::in_memory::InMemory;
    use super::*;
    use conicflow_messages::{Object, Track};
    use std::time::Instant;

    #[test]
    fn who_has_other_items_than_the_pipeline_file_says_does_not_open_a_topic() {
        let topic = |item| Topic { name: "things".into(), item, ..Topic::default() };
        let (objects, untold, memory) = (topic(Some(ItemType::of::<Object>())), topic(None), InMemory::default());
        assert!(memory.writer::<Object>(&objects).is_ok() && memory.writer::<Track>(&untold).is_ok());
        for error in [memory.writer::<Track>(&objects).err(), memory.reader::<Track>(&objects, "reader").err()] {
            let error = error.unwrap();
            let told = error.to_string();
            assert!(
                matches!(error, PortError::Incompatible { .. }) && told.contains("the pipeline file says"),
                "{told}"
            );
        }
        assert_eq!(objects.expect_item().map(ItemType::name), Ok(Object::NAME));
        let told = untold.expect_item().unwrap_err().what;
        assert_eq!((told.as_str(), untold.kind()), ("nothing tells what topic `things` carries", None));
    }

    #[test]
    fn limits_that_keep_shared_memory_from_being_made_are_named_where_they_are_set() {
        let told = |memory: Option<u64>, file: Option<u64>| {
            of_limits(|resource| if resource == Resource::Fsize { file } else { memory })
        };
        assert_eq!(told(None, None), "");
        assert_eq!(told(None, Some(64 << 10)), " `ulimit -f` lets a file have 65.5 kB");
        assert_eq!(
            told(Some(3_000_000_000), Some(2_000_000)),
            " `ulimit -v` lets a process have 3.0 GB in all, `ulimit -f` lets a file have 2.0 MB"
        );
    }

    #[test]
    fn where_nothing_is_kept_each_message_is_begun_for_the_first_time_and_none_is_unfinished() {
        let (topic, memory) = (Topic::default(), InMemory::default());
        let mut reader = memory.reader::<Object>(&topic, "reader").unwrap();
        let writer = Text::new("writer");
        assert_eq!(([3, 3].map(|number| reader.begin(writer, number)), reader.acknowledged()), ([1, 1], None));
        assert_eq!(memory.writer::<Object>(&topic).unwrap().unfinished("reader"), 0);
    }

    #[test]
    fn who_waits_sleeps_until_something_comes_and_no_longer_than_told() {
        let (topic, memory) = (Topic::default(), InMemory::default());
        let [mut reader, mut other] = ["reader", "other"].map(|stage| memory.reader::<Object>(&topic, stage).unwrap());
        let mut writer = memory.writer::<Object>(&topic).unwrap();
        let (begin, while_nothing_comes) = (Instant::now(), Duration::from_millis(20));
        reader.wait(while_nothing_comes).unwrap();
        assert!(begin.elapsed() >= while_nothing_comes);
        assert!(!writer.wait(while_nothing_comes), "no reader has finished anything");
        assert!(begin.elapsed() >= 2 * while_nothing_comes);
        writer.loan::<Object>(3).unwrap();
        assert_eq!(writer.send(&Header::default()).unwrap(), 3, "items");
        assert!(other.receive().unwrap().is_some());
        // The message that the other reader has taken is still there for this one, so the wait ends at once.
        reader.wait(Duration::from_secs(3600)).unwrap();
        assert_eq!(reader.receive().unwrap().unwrap().items::<Object>().len(), 3);
    }

    #[test]
    fn a_topic_knows_its_readers_and_how_much_is_kept_for_them() {
        let reader = |stage: &str, delivery, queue| TopicReader { stage: stage.into(), delivery, queue };
        let (all, newest) = (Delivery::Lossless, Delivery::Latest);
        let readers = vec![reader("a", newest, 9), reader("b", all, 4), reader("c", all, 2)];
        let topic = |readers| Topic { readers, ..Topic::default() };
        let (with_readers, without) = (topic(readers.clone()), topic(vec![]));
        assert_eq!(["a", "b", "unknown"].map(|stage| with_readers.delivery_to(stage)), [newest, all, newest]);
        assert_eq!(["a", "c", "unknown"].map(|stage| with_readers.place_of(stage)), [Some(0), Some(2), None]);
        assert_eq!((with_readers.longest_queue(), without.longest_queue()), (9, 2));
        assert_eq!((with_readers.kept(), without.kept()), (6, 0), "four that wait, one in its hands, and the end");
        assert!(with_readers.is_lossless() && !without.is_lossless() && !topic(readers[..1].to_vec()).is_lossless());
    }
}
