//! Equivalent of shared memory inside one process, with the same queues and the same waiting, for tests.

use crate::item_type::ItemType;
use crate::mutex::lock;
use crate::ports::{ConnectedReader, Delivery, PortError, Reader, Received, Topic, Transport, Writer};
use crate::stop::Stop;
use bytemuck::{cast_slice, cast_slice_mut};
use conicflow_messages::{Header, Text};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::Duration;

/// All topics of one pipeline, inside this process.
#[derive(Clone, Default)]
pub struct InMemory {
    topics: Arc<Mutex<BTreeMap<String, Arc<Channel>>>>,
    stop: Stop,
    keeps: bool,
}

impl InMemory {
    /// Topics whose waits end when `stop` is set.
    pub fn new(stop: Stop) -> Self {
        Self { topics: Arc::default(), stop, keeps: false }
    }

    /// Topics whose writers keep unfinished messages for lossless readers, and resend them to the next reader of the stage.
    #[must_use]
    pub fn keeping(self) -> Self {
        Self { keeps: true, ..self }
    }

    fn channel(&self, name: &str) -> Arc<Channel> {
        Arc::clone(lock(&self.topics).entry(name.to_owned()).or_default())
    }
}

#[derive(Default)]
struct Channel {
    queues: Mutex<Vec<Queue>>,
    kept: Mutex<Kept>,
    /// Number of readers opened so far.
    opened: AtomicU64,
    changed: Condvar,
}

/// Progress of lossless readers, by the names of reader and writer; it outlives them.
#[derive(Default)]
struct Kept {
    /// Number of the first unfinished message.
    next: BTreeMap<(String, Text<32>), u64>,
    /// The message begun last, and how often it was begun.
    begun: BTreeMap<(String, Text<32>), (u64, u64)>,
    /// Number of acknowledgements.
    answers: u64,
}

impl Kept {
    fn next(&self, reader: &str, writer: Text<32>) -> u64 {
        self.next.get(&(reader.to_owned(), writer)).copied().unwrap_or_default()
    }
}

struct Queue {
    port: u64,
    stage: String,
    delivery: Delivery,
    capacity: usize,
    messages: VecDeque<Arc<MemoryMessage>>,
}

/// Bytes with the maximum alignment of items.
#[derive(Debug, Default)]
struct Aligned {
    words: Vec<u64>,
    length: usize,
}

impl Aligned {
    fn new(length: usize) -> Self {
        Self { words: vec![0; length.div_ceil(size_of::<u64>())], length }
    }

    fn bytes(&self) -> &[u8] {
        &cast_slice(&self.words)[..self.length]
    }

    fn bytes_mut(&mut self) -> &mut [u8] {
        &mut cast_slice_mut(&mut self.words)[..self.length]
    }
}

/// A message in this process.
#[derive(Debug)]
pub struct MemoryMessage {
    header: Header,
    items: Aligned,
}

impl Received for Arc<MemoryMessage> {
    fn header(&self) -> &Header {
        &self.header
    }

    fn bytes(&self) -> &[u8] {
        self.items.bytes()
    }
}

/// Reader of a topic of [`InMemory`].
pub struct MemoryReader {
    item: ItemType,
    channel: Arc<Channel>,
    port: u64,
    stage: String,
    /// The writers of the topic, if they keep unfinished messages of this stage.
    keepers: Option<Vec<Text<32>>>,
}

impl Drop for MemoryReader {
    fn drop(&mut self) {
        lock(&self.channel.queues).retain(|queue| queue.port != self.port);
        self.channel.changed.notify_all();
    }
}

impl Reader for MemoryReader {
    type Message = Arc<MemoryMessage>;

    fn item(&self) -> &ItemType {
        &self.item
    }

    fn receive(&mut self) -> Result<Option<Self::Message>, PortError> {
        let mut queues = lock(&self.channel.queues);
        let queue = queues.iter_mut().find(|queue| queue.port == self.port);
        let message = queue.and_then(|queue| queue.messages.pop_front());
        self.channel.changed.notify_all();
        Ok(message)
    }

    fn wait(&mut self, timeout: Duration) -> Result<(), PortError> {
        let queues = lock(&self.channel.queues);
        let empty = |queue: &Queue| queue.port == self.port && queue.messages.is_empty();
        if queues.iter().any(empty) {
            drop(self.channel.changed.wait_timeout(queues, timeout));
        }
        Ok(())
    }

    fn acknowledge(&mut self, writer: Text<32>, next: u64) {
        if self.keepers.is_some() {
            let mut kept = lock(&self.channel.kept);
            kept.next.insert((self.stage.clone(), writer), next);
            kept.answers += 1;
        }
    }

    fn acknowledged(&self) -> Option<Vec<(Text<32>, u64)>> {
        let kept = lock(&self.channel.kept);
        Some(self.keepers.as_ref()?.iter().map(|writer| (*writer, kept.next(&self.stage, *writer))).collect())
    }

    fn begin(&mut self, writer: Text<32>, number: u64) -> u64 {
        if self.keepers.is_none() {
            return 1;
        }
        let mut kept = lock(&self.channel.kept);
        let (begun, times) = kept.begun.entry((self.stage.clone(), writer)).or_default();
        *times = if *begun == number { *times + 1 } else { 1 };
        *begun = number;
        *times
    }
}

/// Writer of a topic of [`InMemory`].
pub struct MemoryWriter {
    item: ItemType,
    channel: Arc<Channel>,
    loan: Aligned,
    stop: Stop,
    topic: Topic,
    /// The last sent messages, up to `kept` of them; `joined` are the readers that have received them.
    sent: VecDeque<Arc<MemoryMessage>>,
    kept: usize,
    joined: BTreeSet<u64>,
    answers: u64,
}

impl Writer for MemoryWriter {
    fn item(&self) -> &ItemType {
        &self.item
    }

    fn loan_bytes(&mut self, length: usize) -> Result<&mut [u8], PortError> {
        self.loan = Aligned::new(length * self.item.size());
        Ok(self.loan.bytes_mut())
    }

    fn send(&mut self, header: &Header) -> Result<usize, PortError> {
        let message = Arc::new(MemoryMessage { header: *header, items: std::mem::take(&mut self.loan) });
        self.catch_up();
        let mut queues = lock(&self.channel.queues);
        let full = |queue: &Queue| queue.delivery == Delivery::Lossless && queue.messages.len() >= queue.capacity;
        while queues.iter().any(full) {
            if self.stop.forced() {
                return Err(PortError::Stopped);
            }
            let waited = self.channel.changed.wait_timeout(queues, Duration::from_millis(20));
            queues = waited.unwrap_or_else(PoisonError::into_inner).0;
        }
        for queue in queues.iter_mut() {
            if queue.messages.len() >= queue.capacity {
                queue.messages.pop_front();
            }
            queue.messages.push_back(Arc::clone(&message));
        }
        self.channel.changed.notify_all();
        let length = message.items.length / self.item.size();
        self.sent.push_back(message);
        while self.sent.len() > self.kept {
            self.sent.pop_front();
        }
        Ok(length)
    }

    fn connected(&self) -> Vec<ConnectedReader> {
        let reader = |queue: &Queue| ConnectedReader { port: queue.port.into(), stage: queue.stage.clone() };
        lock(&self.channel.queues).iter().map(reader).collect()
    }

    fn unfinished(&self, reader: &str) -> usize {
        if self.topic.delivery_to(reader) == Delivery::Latest {
            return 0;
        }
        let (kept, messages) = (lock(&self.channel.kept), self.sent.iter().filter(|sent| !sent.header.ends_stream()));
        let is_unfinished = |sent: &&Arc<MemoryMessage>| sent.header.number >= kept.next(reader, sent.header.writer());
        messages.skip_while(|sent| !is_unfinished(sent)).count()
    }

    fn catch_up(&mut self) {
        let mut queues = lock(&self.channel.queues);
        for queue in queues.iter_mut().filter(|queue| queue.delivery == Delivery::Lossless) {
            if self.joined.insert(queue.port) {
                queue.messages.extend(self.sent.iter().cloned());
            }
        }
    }

    fn wait(&mut self, timeout: Duration) -> bool {
        std::thread::sleep(timeout);
        self.catch_up();
        let answers = lock(&self.channel.kept).answers;
        std::mem::replace(&mut self.answers, answers) != answers
    }
}

impl Transport for InMemory {
    type Reader = MemoryReader;
    type Writer = MemoryWriter;

    fn reader_of(&self, item: &ItemType, topic: &Topic, stage: &str) -> Result<MemoryReader, PortError> {
        topic.expect(item)?;
        let channel = self.channel(&topic.name);
        let reader = topic.readers.iter().find(|reader| reader.stage == stage);
        let (delivery, queue) = reader.map_or((Delivery::Latest, 2), |reader| (reader.delivery, reader.queue));
        // A restarted reader receives all kept messages at once.
        let capacity = if self.keeps && delivery == Delivery::Lossless { queue + topic.kept() + 1 } else { queue };
        let port = channel.opened.fetch_add(1, Ordering::Relaxed);
        let queue = Queue { port, stage: stage.to_owned(), delivery, capacity, messages: VecDeque::new() };
        lock(&channel.queues).push(queue);
        let writers = topic.writers.iter().map(|writer| Text::new(writer)).collect();
        let keepers = Some(writers).filter(|_| self.keeps && delivery == Delivery::Lossless);
        Ok(MemoryReader { item: item.clone(), channel, port, stage: stage.to_owned(), keepers })
    }

    fn writer_of(&self, item: &ItemType, topic: &Topic) -> Result<MemoryWriter, PortError> {
        topic.expect(item)?;
        let channel = self.channel(&topic.name);
        Ok(MemoryWriter {
            item: item.clone(),
            channel,
            loan: Aligned::default(),
            stop: self.stop.clone(),
            topic: topic.clone(),
            sent: VecDeque::new(),
            kept: if self.keeps { topic.kept() } else { 0 },
            joined: BTreeSet::new(),
            answers: 0,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ports::TopicReader;
    use conicflow_messages::Object;

    fn topic() -> Topic {
        let reader = |stage: &str, delivery, queue| TopicReader { stage: stage.to_owned(), delivery, queue };
        let readers = vec![reader("all", Delivery::Lossless, 2), reader("newest", Delivery::Latest, 1)];
        Topic { name: "things".into(), readers, ..Topic::default() }
    }

    #[test]
    fn a_writer_whose_run_ends_at_once_sends_what_has_room_and_waits_for_nobody() {
        let stop = Stop::default();
        stop.force();
        let memory = InMemory::new(stop);
        let [_all, mut newest] = ["all", "newest"].map(|stage| memory.reader::<Object>(&topic(), stage).unwrap());
        let mut writer = memory.writer::<Object>(&topic()).unwrap();
        let mut send = |sequence| writer.send(&Header { sequence, ..Header::default() });
        assert!(send(0).is_ok() && send(1).is_ok(), "two wait for the reader that wants all");
        assert!(matches!(send(2), Err(PortError::Stopped)));
        assert_eq!(newest.receive().unwrap().map(|message| message.header().sequence), Some(1));
    }

    #[test]
    fn who_leaves_a_topic_is_no_reader_of_it_any_more() {
        let memory = InMemory::default();
        let [all, _newest] = ["all", "newest"].map(|stage| memory.reader::<Object>(&topic(), stage).unwrap());
        let writer = memory.writer::<Object>(&topic()).unwrap();
        let connected = || writer.connected().into_iter().map(|reader| reader.stage).collect::<Vec<_>>();
        assert_eq!(connected(), ["all", "newest"]);
        drop(all);
        assert_eq!(connected(), ["newest"]);
    }
}
