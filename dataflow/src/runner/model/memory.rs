//! The part of the model that outlives its processes: topics as iceoryx2 implements them, the table of acknowledgements, and the
//! records. The real input and output ports work on it through the same traits as on shared memory.
//!
//! It models those properties of iceoryx2 that the protocol relies on, as read in its source. A writer connects to readers when
//! it sends or updates its connections, and sends its history to new ones. A reader finds writers when it is opened and whenever
//! it receives: messages of a writer that died and was cleaned up before that are lost. Ports of dead processes stay until a
//! process cleans them up. A reader first takes the remaining messages of cleaned-up writers, then those of one writer after the
//! other, in the order of their slots, which are reused.

use crate::item_type::ItemType;
use crate::ports::{ConnectedReader, PortError, Reader, Received, Topic, Writer};
use crate::runner::handover::Watermark;
use crate::status::{InputCounts, Life};
use conicflow_messages::{Header, Object, Text};
use std::cell::RefCell;
use std::collections::{BTreeSet, VecDeque};
use std::hash::{Hash, Hasher};
use std::sync::{Arc, LazyLock};
use std::time::Duration;

/// The stages, from source to sink.
pub(super) const STAGES: [&str; 3] = ["source", "stage", "sink"];
/// Queue length of a reader. Its credit is then two, and its writer keeps three messages.
const QUEUE: usize = 1;

/// The topics: the first is written by the first stage, the second by the second.
pub(super) static TOPICS: LazyLock<[Topic; 2]> = LazyLock::new(|| [0, 1].map(topic));

static ITEM: ItemType = ItemType::of::<Object>();

thread_local! {
    /// The state on which the current step of this thread works.
    static MEMORY: RefCell<Memory> = RefCell::default();
}

fn topic(place: usize) -> Topic {
    let delivery = crate::ports::Delivery::Lossless;
    let readers = vec![crate::ports::TopicReader { stage: STAGES[place + 1].to_owned(), delivery, queue: QUEUE }];
    Topic { name: place.to_string(), item: None, writers: vec![STAGES[place].to_owned()], readers }
}

/// Variants of the protocol with one part left out. The model has to find a counterexample for each.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub(super) enum Fault {
    #[default]
    None,
    /// Readers never acknowledge.
    NeverAcknowledges,
    /// Readers acknowledge a message before they have sent their output for it.
    AcknowledgesFirst,
    /// The end of a stream does not carry the number of messages.
    EndWithoutNumber,
    /// Writers keep no messages for restarted readers.
    KeepsNothing,
    /// Writers do not wait until a new reader has received a message from them.
    GoesOnUnseen,
    /// A restarted process does not continue the numbers of its predecessor.
    ForgetsRecord,
}

/// State that outlives the processes.
#[derive(Clone, Debug, Default, Hash)]
pub(super) struct Memory {
    pub(super) topics: [Channel; 2],
    pub(super) records: [Record; 3],
    /// `Handover::first` and `Handover::last`.
    pub(super) first_to_receive: Option<Watermark>,
    pub(super) last_worked_on: Option<Watermark>,
    /// Whether a message found no room in a queue. `left_out` counts messages that were skipped because a stage died on them
    /// twice.
    pub(super) has_overflown: bool,
    pub(super) left_out: u8,
    pub(super) fault: Fault,
    /// Order in which a reader takes from several writers that were not cleaned up: newest first, or oldest first.
    pub(super) newest_first: bool,
}

/// A topic.
#[derive(Clone, Debug, Default, Hash)]
pub(super) struct Channel {
    publishers: Vec<Publisher>,
    queues: Vec<Queue>,
    /// Number of the first message that its reader has not finished.
    pub(super) finished: u64,
    /// Number of the message that was begun last, and how often it was begun.
    begun: (u64, u8),
    /// Numbers of the processed messages, in the order of processing.
    pub(super) worked_on: Vec<u64>,
    /// Whether the last process that read it received its end.
    pub(super) is_end_heard: bool,
}

/// The record of a stage.
#[derive(Clone, Debug)]
pub(super) struct Record {
    pub(super) life: Life,
    pub(super) process: u8,
    pub(super) sent: u64,
    pub(super) counts: InputCounts,
}

impl Default for Record {
    fn default() -> Self {
        Self { life: Life::Starting, process: 0, sent: 0, counts: InputCounts::default() }
    }
}

impl Hash for Record {
    fn hash<H: Hasher>(&self, hasher: &mut H) {
        (self.life, self.process, self.sent, bytemuck::bytes_of(&self.counts)).hash(hasher);
    }
}

/// Writer's port of a topic.
#[derive(Clone, Debug, Hash)]
struct Publisher {
    port: u8,
    is_dead: bool,
    history: VecDeque<ModelMessage>,
    joined: BTreeSet<u8>,
    /// Numbers of the last messages, except ends of the stream.
    sent: VecDeque<u64>,
}

/// Reader's port of a topic.
#[derive(Clone, Debug, Hash)]
struct Queue {
    port: u8,
    is_dead: bool,
    seen: BTreeSet<u8>,
    connections: Vec<Connection>,
}

/// Queue between two ports.
#[derive(Clone, Debug, Hash)]
struct Connection {
    publisher: u8,
    is_cleared: bool,
    /// Whether the reader has taken a message from it.
    is_seen: bool,
    messages: VecDeque<ModelMessage>,
}

/// A message without items and times.
#[derive(Clone, Debug)]
pub(super) struct ModelMessage(Arc<Header>);

impl Hash for ModelMessage {
    fn hash<H: Hasher>(&self, hasher: &mut H) {
        (self.0.number, self.0.sequence, self.0.epoch, self.0.flags).hash(hasher);
    }
}

impl Received for ModelMessage {
    fn header(&self) -> &Header {
        &self.0
    }

    fn bytes(&self) -> &[u8] {
        &[]
    }
}

/// Runs a step on this memory.
pub(super) fn on<V>(memory: &mut Memory, step: impl FnOnce() -> V) -> V {
    MEMORY.replace(std::mem::take(memory));
    let value = step();
    *memory = MEMORY.take();
    value
}

/// Accesses the memory within a step.
pub(super) fn memory<V>(use_it: impl FnOnce(&mut Memory) -> V) -> V {
    MEMORY.with_borrow_mut(use_it)
}

/// State of a stage as other stages see it.
pub(super) fn life(stage: &str) -> Option<Life> {
    let place = STAGES.iter().position(|name| *name == stage)?;
    Some(memory(|memory| memory.records[place].life))
}

impl Memory {
    /// A killed process leaves its ports as they are.
    pub(super) fn abandon(&mut self, stage: usize, process: u8) {
        if let Some(input) = stage.checked_sub(1) {
            let queues = self.topics[input].queues.iter_mut().filter(|queue| queue.port / 2 == process);
            queues.for_each(|queue| queue.is_dead = true);
        }
        if let Some(channel) = self.topics.get_mut(stage) {
            let publishers = channel.publishers.iter_mut().filter(|publisher| publisher.port == process);
            publishers.for_each(|publisher| publisher.is_dead = true);
        }
    }

    /// A process that ends in order closes its ports.
    pub(super) fn close(&mut self, stage: usize, process: u8) {
        self.close_input(stage, process);
        self.abandon(stage, process);
        self.topics.iter_mut().for_each(|channel| channel.clear_away_if(|port| port == process));
    }

    /// Closes only the input of a process.
    pub(super) fn close_input(&mut self, stage: usize, process: u8) {
        if let Some(input) = stage.checked_sub(1) {
            self.topics[input].queues.retain(|queue| queue.port / 2 != process);
        }
    }

    /// Whether dead processes have left ports.
    pub(super) fn has_dead(&self) -> bool {
        let is_dead = |channel: &Channel| {
            channel.queues.iter().any(|queue| queue.is_dead)
                || channel.publishers.iter().any(|publisher| publisher.is_dead)
        };
        self.topics.iter().any(is_dead)
    }

    /// Cleans up the ports of dead processes.
    pub(super) fn clear_away(&mut self) {
        for channel in &mut self.topics {
            channel.queues.retain(|queue| !queue.is_dead);
            channel.clear_away_if(|_| true);
        }
    }
}

impl Channel {
    /// Whether the history of each living writer has all messages that it has sent and its reader has not finished.
    pub(super) fn keeps_all(&self) -> bool {
        let holds = |publisher: &Publisher, number: u64| publisher.history.iter().any(|kept| kept.0.number == number);
        let living = self.publishers.iter().filter(|publisher| !publisher.is_dead);
        let mut all = living.flat_map(|publisher| publisher.sent.iter().map(move |number| (publisher, *number)));
        all.all(|(publisher, number)| number < self.finished || holds(publisher, number))
    }

    /// Cleans up dead writers: the messages of a writer are lost for readers that have not found it yet.
    fn clear_away_if(&mut self, which: impl Fn(u8) -> bool) {
        let is_cleared = |publisher: &Publisher| publisher.is_dead && which(publisher.port);
        let cleared: Vec<u8> = self.publishers.iter().filter(|own| is_cleared(own)).map(|own| own.port).collect();
        self.publishers.retain(|publisher| !cleared.contains(&publisher.port));
        for queue in &mut self.queues {
            let seen = &queue.seen;
            queue.connections.retain(|own| !cleared.contains(&own.publisher) || seen.contains(&own.publisher));
            let connections = queue.connections.iter_mut().filter(|own| cleared.contains(&own.publisher));
            connections.for_each(|connection| connection.is_cleared = true);
            queue.seen.retain(|port| !cleared.contains(port));
        }
    }

    /// Whether all readers that a writer has connected to have taken a message from it.
    pub(super) fn is_seen(&self, port: u8) -> bool {
        let mut connections = self.queues.iter().flat_map(|queue| &queue.connections);
        connections.all(|connection| connection.publisher != port || connection.is_seen)
    }

    /// Connects a writer to new readers, and sends them its history. Returns whether a queue overflowed.
    fn join(&mut self, port: u8, capacity: usize) -> bool {
        let Some(publisher) = self.publishers.iter_mut().find(|publisher| publisher.port == port) else { return false };
        let mut has_overflown = false;
        for queue in self.queues.iter_mut().filter(|queue| !queue.is_dead) {
            if publisher.joined.insert(queue.port) {
                let messages = publisher.history.clone();
                has_overflown |= messages.len() > capacity;
                queue.connections.push(Connection { publisher: port, is_cleared: false, is_seen: false, messages });
            }
        }
        let queues = &self.queues;
        publisher.joined.retain(|port| queues.iter().any(|queue| queue.port == *port));
        has_overflown
    }
}

/// Length of a reader's buffer, as in [`SharedMemory::buffer_of`](crate::ports::shared_memory::SharedMemory).
fn capacity(topic: &Topic) -> usize {
    topic.kept() + topic.readers[0].credit()
}

/// Appends an item, and removes the oldest ones beyond `most`.
fn push_last<T>(last: &mut VecDeque<T>, item: T, most: usize) {
    last.push_back(item);
    last.drain(..last.len().saturating_sub(most));
}

/// Reader of a topic of the model.
#[derive(Clone, Debug)]
pub(super) struct ModelReader {
    topic: usize,
    port: u8,
}

impl ModelReader {
    /// Opens the input of a process, for the first time or again.
    pub(super) fn open(stage: usize, process: u8, is_again: bool) -> Self {
        let (topic, port) = (stage - 1, 2 * process + u8::from(is_again));
        memory(|memory| {
            let channel = &mut memory.topics[topic];
            channel.queues.retain(|queue| queue.port / 2 != process);
            let seen = channel.publishers.iter().map(|publisher| publisher.port).collect();
            channel.queues.push(Queue { port, is_dead: false, seen, connections: Vec::new() });
        });
        Self { topic, port }
    }
}

impl Reader for ModelReader {
    type Message = ModelMessage;

    fn item(&self) -> &ItemType {
        &ITEM
    }

    fn receive(&mut self) -> Result<Option<ModelMessage>, PortError> {
        Ok(memory(|memory| {
            let channel = &mut memory.topics[self.topic];
            let queue = channel.queues.iter_mut().find(|queue| queue.port == self.port)?;
            queue.seen.extend(channel.publishers.iter().map(|publisher| publisher.port));
            queue.connections.retain(|connection| !(connection.is_cleared && connection.messages.is_empty()));
            let mut waiting: Vec<_> = queue.connections.iter_mut().filter(|own| !own.messages.is_empty()).collect();
            if memory.newest_first {
                waiting.reverse();
            }
            waiting.sort_by_key(|connection| !connection.is_cleared);
            let connection = waiting.first_mut()?;
            connection.is_seen = true;
            connection.messages.pop_front()
        }))
    }

    fn wait(&mut self, _: Duration) -> Result<(), PortError> {
        Ok(())
    }

    fn acknowledge(&mut self, _: Text<32>, next: u64) {
        memory(|memory| {
            if memory.fault != Fault::NeverAcknowledges {
                memory.topics[self.topic].finished = next;
            }
        });
    }

    fn acknowledged(&self) -> Option<Vec<(Text<32>, u64)>> {
        Some(vec![(Text::new(STAGES[self.topic]), memory(|memory| memory.topics[self.topic].finished))])
    }

    fn begin(&mut self, _: Text<32>, number: u64) -> u64 {
        memory(|memory| {
            let begun = &mut memory.topics[self.topic].begun;
            let earlier = if begun.0 == number { begun.1 } else { 0 };
            *begun = (number, earlier + 1);
            memory.left_out += u8::from(earlier >= 2);
            u64::from(earlier + 1)
        })
    }
}

/// Writer of a topic of the model.
#[derive(Clone, Copy, Debug)]
pub(super) struct ModelWriter {
    /// The stage that writes it.
    pub(super) stage: usize,
    pub(super) process: u8,
}

impl Writer for ModelWriter {
    fn item(&self) -> &ItemType {
        &ITEM
    }

    fn loan_bytes(&mut self, _: usize) -> Result<&mut [u8], PortError> {
        Ok(&mut [])
    }

    /// As [`SharedWriter`](crate::ports::shared_memory::SharedWriter) does, it creates the publisher for the first message.
    fn send(&mut self, header: &Header) -> Result<usize, PortError> {
        let (topic, port) = (&TOPICS[self.stage], self.process);
        let mut header = *header;
        header.hops.iter_mut().for_each(|hop| (hop.received_ns, hop.sent_ns) = (0, 0));
        memory(|memory| {
            let channel = &mut memory.topics[self.stage];
            if channel.publishers.iter().all(|publisher| publisher.port != port) {
                let (history, joined, sent) = (VecDeque::new(), BTreeSet::new(), VecDeque::new());
                channel.publishers.push(Publisher { port, is_dead: false, history, joined, sent });
            }
            memory.has_overflown |= channel.join(port, capacity(topic));
            let message = ModelMessage(Arc::new(header));
            for publisher in channel.publishers.iter_mut().filter(|publisher| publisher.port == port) {
                if memory.fault != Fault::KeepsNothing {
                    push_last(&mut publisher.history, message.clone(), topic.kept());
                }
                if !header.ends_stream() {
                    push_last(&mut publisher.sent, header.number, topic.kept());
                }
            }
            let connections = channel.queues.iter_mut().flat_map(|queue| &mut queue.connections);
            for connection in connections.filter(|connection| connection.publisher == port) {
                connection.messages.push_back(message.clone());
                memory.has_overflown |= connection.messages.len() > capacity(topic);
            }
        });
        Ok(0)
    }

    fn connected(&self) -> Vec<ConnectedReader> {
        let reader = |queue: &Queue| ConnectedReader { port: queue.port.into(), stage: STAGES[self.stage + 1].into() };
        memory(|memory| memory.topics[self.stage].queues.iter().map(reader).collect())
    }

    /// As [`SentMessages`](crate::ports::shared_memory) counts them.
    fn unfinished(&self, _: &str) -> usize {
        memory(|memory| {
            let channel = &memory.topics[self.stage];
            let Some(own) = channel.publishers.iter().find(|own| own.port == self.process) else { return 0 };
            let first = own.sent.iter().position(|number| *number >= channel.finished);
            first.map_or(0, |first| own.sent.len() - first)
        })
    }

    fn catch_up(&mut self) {
        memory(|memory| {
            memory.has_overflown |= memory.topics[self.stage].join(self.process, capacity(&TOPICS[self.stage]));
        });
    }

    fn wait(&mut self, _: Duration) -> bool {
        self.catch_up();
        true
    }
}
