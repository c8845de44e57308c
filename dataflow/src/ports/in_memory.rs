//! The twin of shared memory inside one process: the same queues and the same waiting, for tests.

use crate::ports::{Delivery, PortError, Reader, Received, Topic, Transport, Writer};
use crate::stage::Stop;
use conicflow_messages::{Header, Item};
use std::any::Any;
use std::collections::{BTreeMap, VecDeque};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
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

    fn send(&mut self, header: &Header) -> Result<usize, PortError> {
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
        Ok(message.items.len())
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
