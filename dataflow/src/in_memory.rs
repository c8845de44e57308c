//! The twin of shared memory inside one process: the same queues and the same waiting, for tests.
//!
//! [`pass`] and [`collect`] run one stage or source as it runs in a pipeline, with nothing around it.

use crate::peers::Peers;
use crate::plan::Wiring;
use crate::ports::{Delivery, PortError, Reader, Received, Topic, TopicReader, Transport, Writer};
use crate::runner::{RunError, Surroundings};
use crate::source_loop::run_source;
use crate::stage::{Context, Source, Stage, Stop};
use crate::stage_loop::run_stage;
use crate::status::StatusFile;
use conicflow_messages::{END_OF_STREAM, Header, Hop, Item, Text};
use std::any::Any;
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread;
use std::time::Duration;

/// All topics of one pipeline, inside this process.
#[derive(Clone, Default)]
pub struct InMemory {
    topics: Arc<Mutex<BTreeMap<String, Arc<dyn Any + Send + Sync>>>>,
    stop: Stop,
}

impl InMemory {
    /// Topics whose waiting ends when `stop` is raised.
    pub fn new(stop: Stop) -> Self {
        Self { topics: Arc::default(), stop }
    }

    fn channel<T: Item>(&self, name: &str) -> Arc<Channel<T>> {
        let mut topics = lock(&self.topics);
        let channel = topics.entry(name.to_owned()).or_insert_with(|| Arc::new(Channel::<T>::default()));
        Arc::clone(channel).downcast().unwrap_or_default()
    }
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

struct Channel<T> {
    queues: Mutex<Vec<Queue<T>>>,
    changed: Condvar,
}

impl<T> Default for Channel<T> {
    fn default() -> Self {
        Self { queues: Mutex::default(), changed: Condvar::new() }
    }
}

struct Queue<T> {
    stage: String,
    delivery: Delivery,
    capacity: usize,
    messages: VecDeque<Arc<Held<T>>>,
}

/// A message in this process.
#[derive(Debug)]
pub struct Held<T> {
    header: Header,
    items: Vec<T>,
}

impl<T: Item> Received<T> for Arc<Held<T>> {
    fn header(&self) -> &Header {
        &self.header
    }

    fn items(&self) -> &[T] {
        &self.items
    }
}

/// Reads a topic of [`InMemory`].
pub struct MemoryReader<T> {
    channel: Arc<Channel<T>>,
    stage: String,
}

impl<T> Drop for MemoryReader<T> {
    fn drop(&mut self) {
        lock(&self.channel.queues).retain(|queue| queue.stage != self.stage);
        self.channel.changed.notify_all();
    }
}

impl<T: Item> Reader<T> for MemoryReader<T> {
    type Message = Arc<Held<T>>;

    fn receive(&mut self) -> Result<Option<Self::Message>, PortError> {
        let mut queues = lock(&self.channel.queues);
        let queue = queues.iter_mut().find(|queue| queue.stage == self.stage);
        let message = queue.and_then(|queue| queue.messages.pop_front());
        self.channel.changed.notify_all();
        Ok(message)
    }

    fn wait(&mut self, timeout: Duration) -> Result<(), PortError> {
        let queues = lock(&self.channel.queues);
        let empty = |queue: &Queue<T>| queue.stage == self.stage && queue.messages.is_empty();
        if queues.iter().any(empty) {
            drop(self.channel.changed.wait_timeout(queues, timeout));
        }
        Ok(())
    }
}

/// Writes a topic of [`InMemory`].
pub struct MemoryWriter<T> {
    channel: Arc<Channel<T>>,
    loan: Vec<T>,
    stop: Stop,
}

impl<T: Item> Writer<T> for MemoryWriter<T> {
    fn loan(&mut self, length: usize) -> Result<&mut [T], PortError> {
        self.loan = vec![T::zeroed(); length];
        Ok(&mut self.loan)
    }

    fn send(&mut self, header: &Header) -> Result<(), PortError> {
        let message = Arc::new(Held { header: *header, items: std::mem::take(&mut self.loan) });
        let mut queues = lock(&self.channel.queues);
        let full = |queue: &Queue<T>| queue.delivery == Delivery::Lossless && queue.messages.len() >= queue.capacity;
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
        Ok(())
    }

    fn connected(&self) -> Vec<String> {
        lock(&self.channel.queues).iter().map(|queue| queue.stage.clone()).collect()
    }
}

impl Transport for InMemory {
    type Reader<T: Item> = MemoryReader<T>;
    type Writer<T: Item> = MemoryWriter<T>;

    fn reader<T: Item>(&self, topic: &Topic, stage: &str) -> Result<MemoryReader<T>, PortError> {
        let channel = self.channel::<T>(&topic.name);
        let reader = topic.readers.iter().find(|reader| reader.stage == stage);
        let (delivery, capacity) = reader.map_or((Delivery::Latest, 2), |reader| (reader.delivery, reader.queue));
        let queue = Queue { stage: stage.to_owned(), delivery, capacity, messages: VecDeque::new() };
        lock(&channel.queues).push(queue);
        Ok(MemoryReader { channel, stage: stage.to_owned() })
    }

    fn writer<T: Item>(&self, topic: &Topic) -> Result<MemoryWriter<T>, PortError> {
        Ok(MemoryWriter { channel: self.channel(&topic.name), loan: Vec::new(), stop: self.stop.clone() })
    }
}

/// A message of one's own: its header and its items.
pub type Owned<T> = (Header, Vec<T>);

const UPSTREAM: &str = "upstream";
const DOWNSTREAM: &str = "downstream";

/// Runs the stage `S` over `messages`, none of which is lost, and returns what it sent.
///
/// # Errors
/// What the stage refused or failed at.
pub fn pass<S: Stage>(
    config: S::Config,
    context: Context,
    messages: &[Owned<S::Input>],
) -> Result<Vec<Owned<S::Output>>, RunError>
where
    S::Config: Send,
{
    let memory = InMemory::new(context.stop.clone());
    let input = topic("input", UPSTREAM, &context.stage, messages.len() + 1);
    let output = topic("output", &context.stage, DOWNSTREAM, messages.len() + 1);
    let mut writer = memory.writer::<S::Input>(&input)?;
    let wiring = Wiring { input: Some(input), output: Some(output.clone()), ..Wiring::default() };
    run_alone(
        &memory,
        wiring,
        context,
        &output,
        |around| run_stage::<S, _>(config, around),
        |is_over| {
            while writer.connected().is_empty() && !is_over() {
                thread::yield_now();
            }
            for (header, items) in messages {
                writer.loan(items.len())?.copy_from_slice(items);
                writer.send(&from_upstream(*header))?;
            }
            writer.send(&from_upstream(Header { flags: END_OF_STREAM, ..Header::default() }))
        },
    )
}

/// Runs the source `S` until it has made `frames` messages, or has no more, and returns them.
///
/// # Errors
/// What the source refused or failed at.
pub fn collect<S: Source>(config: S::Config, context: Context, frames: u64) -> Result<Vec<Owned<S::Output>>, RunError>
where
    S::Config: Send,
{
    let memory = InMemory::new(context.stop.clone());
    let output = topic("output", &context.stage, DOWNSTREAM, 4);
    let wiring = Wiring { output: Some(output.clone()), frames: Some(frames), ..Wiring::default() };
    run_alone(&memory, wiring, context, &output, |around| run_source::<S, _>(config, around), |_| Ok(()))
}

fn topic(name: &str, writer: &str, reader: &str, queue: usize) -> Topic {
    let reader = TopicReader { stage: reader.to_owned(), delivery: Delivery::Lossless, queue };
    Topic { name: name.to_owned(), writers: vec![writer.to_owned()], readers: vec![reader] }
}

fn from_upstream(header: Header) -> Header {
    let mut header = Header { hop_count: 0, ..header };
    header.add_hop(Hop { stage: Text::new(UPSTREAM), ..Hop::default() });
    header
}

/// Runs one loop on a thread of its own, feeds it, and gathers what it sends until it is over.
fn run_alone<T: Item>(
    memory: &InMemory,
    wiring: Wiring,
    context: Context,
    output: &Topic,
    run: impl FnOnce(Surroundings<InMemory>) -> Result<(), RunError> + Send,
    feed: impl FnOnce(&dyn Fn() -> bool) -> Result<(), PortError>,
) -> Result<Vec<Owned<T>>, RunError> {
    let mut reader = memory.reader::<T>(output, DOWNSTREAM)?;
    let record = StatusFile::nowhere();
    let around =
        Surroundings { transport: memory.clone(), wiring, context, peers: Peers::default(), record, lock: None };
    thread::scope(|scope| {
        let running = scope.spawn(|| run(around));
        let fed = feed(&|| running.is_finished());
        let sent = gather(&mut reader, || running.is_finished());
        drop(reader);
        running.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic))?;
        fed?;
        Ok(sent?)
    })
}

/// All messages up to the end of the stream, or until nobody is left to send more.
fn gather<T: Item>(reader: &mut MemoryReader<T>, is_over: impl Fn() -> bool) -> Result<Vec<Owned<T>>, PortError> {
    let mut messages = Vec::new();
    loop {
        let over = is_over();
        match reader.receive()? {
            Some(message) if message.header.ends_stream() => return Ok(messages),
            Some(message) => messages.push((message.header, message.items.clone())),
            None if over => return Ok(messages),
            None => reader.wait(Duration::from_millis(10))?,
        }
    }
}
