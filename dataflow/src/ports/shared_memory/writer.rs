//! Writer of a topic in shared memory, which waits for lossless readers.

use super::cleanup::Occupied;
use super::reserve::reserve;
use super::sent_messages::SentMessages;
use super::services::Ipc;
use super::untyped::{self, Factory, Loan, Publisher};
use crate::item_type::ItemType;
use crate::mutex::lock;
use crate::ports::capacity::{look_for_room, no_room, room};
use crate::ports::patience::Patience;
use crate::ports::{ConnectedReader, Delivery, PortError, Topic, Writer};
use crate::stop::Stop;
use conicflow_messages::Header;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::update_connections::UpdateConnections;
use iceoryx2::port::{BackpressureAction, BackpressureInfo};
use iceoryx2::prelude::{AllocationStrategy, CallbackProgression, Config, Node, NodeState, PortFactory};
use std::fmt::Debug;
use std::io::ErrorKind;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

/// A writer that waits for room checks this often whether the reader is still alive.
const DEAD_READER_CHECK: Duration = Duration::from_millis(100);

/// Writer of a topic in shared memory.
pub struct SharedWriter {
    pub(super) loan: Option<Loan>,
    pub(super) publisher: Option<Publisher>,
    /// Number of items of the longest message that the publisher has room for.
    pub(super) capacity: usize,
    pub(super) messages: Arc<Factory>,
    pub(super) wake: Notifier<Ipc>,
    pub(super) room: Arc<Listener<Ipc>>,
    /// Indices of the readers that have taken a message since the last one was sent, collected in each wait of this writer.
    pub(super) answers: Arc<Mutex<Vec<usize>>>,
    /// Ports of lossless readers that have taken their first message.
    pub(super) attached: Vec<u128>,
    /// Sent messages that may have to be sent again, where these are kept.
    pub(super) sent: Option<SentMessages>,
    pub(super) item: ItemType,
    pub(super) topic: Topic,
    pub(super) config: Config,
    pub(super) stop: Stop,
    pub(super) occupied: Arc<Occupied>,
}

impl SharedWriter {
    fn fault(&self, reason: impl Debug) -> PortError {
        let doing = format!("topic `{}` cannot be written", self.topic.name);
        PortError::of_shared_memory(self.occupied.root(), doing, reason)
    }

    /// Returns the publisher. It is created when the length of the first message is known, and replaced when a message does not
    /// fit. Messages of the old one stay with its readers, who take them before those of the new one. A segment that grows
    /// dynamically would need no second publisher, but costs each process that uses it a megabyte.
    fn publisher(&mut self, length: usize) -> Result<&Publisher, PortError> {
        if self.publisher.is_none() || length > self.capacity {
            let (longest, capacity) = if self.item.is_image() {
                (length.max(1), length.max(1))
            } else {
                let longest = length.max(self.item.usual_length());
                (longest, longest.next_power_of_two())
            };
            let needed = look_for_room(room(), &self.item, &self.topic, longest)?;
            self.await_finish();
            self.publisher = None;
            self.attached.clear();
            let builder = self.messages.publisher_builder().max_loaned_samples(1).initial_max_slice_len(capacity);
            let builder = builder.allocation_strategy(AllocationStrategy::Static);
            let builder = builder.set_backpressure_handler(self.wait_for_room());
            let publisher = builder.create().map_err(|error| self.fault(error))?;
            // A list seldom fills its place; to reserve all of that would take many times the memory that lists need.
            if self.item.is_image() {
                self.take_memory(publisher.id().value(), capacity, needed)?;
            }
            self.publisher = Some(publisher);
            self.capacity = capacity;
        }
        self.publisher.as_ref().ok_or(PortError::Stopped)
    }

    fn take_memory(&self, publisher: u128, capacity: usize, needed: u64) -> Result<(), PortError> {
        reserve(self.occupied.prefix(), publisher, needed).map_err(|error| match error.kind() {
            ErrorKind::StorageFull => no_room(&self.topic, capacity, needed),
            _ => self.fault(error),
        })
    }

    /// Reaction to a full queue: for a lossless reader of the pipeline the writer waits until there is room or the reader is
    /// dead; any other reader loses this message.
    fn wait_for_room(&self) -> impl Fn(&BackpressureInfo) -> BackpressureAction + Send + use<> + 'static {
        let (messages, topic, room) = (Arc::clone(&self.messages), self.topic.clone(), Arc::clone(&self.room));
        let (config, stop, answers) = (self.config.clone(), self.stop.clone(), Arc::clone(&self.answers));
        move |full| {
            if stop.forced() {
                return BackpressureAction::DiscardDataAndFail;
            }
            let readers = lossless_readers(&messages, &topic);
            let Some((_, place)) = readers.iter().find(|(port, _)| *port == full.receiver_port_id) else {
                return BackpressureAction::DiscardData;
            };
            let mut answers = lock(&answers);
            let woken = room.timed_wait(|event| answers.push(event.id.as_value()), DEAD_READER_CHECK);
            if !woken.is_ok_and(|events| events > 0) {
                stop.wait_for(&topic.readers[*place].stage);
                clean_dead_nodes(&config);
            }
            BackpressureAction::Retry
        }
    }
}

impl SharedWriter {
    /// Waits until all readers have finished the messages that this publisher keeps for them, or no longer make progress.
    fn await_finish(&mut self) {
        let Some(publisher) = &self.publisher else { return };
        let mut patience = Patience::new();
        while let Some(unfinished) = self.sent.as_ref().map(SentMessages::unfinished_by_all)
            && unfinished > 0
            && !self.stop.forced()
            && !patience.is_over(unfinished, Instant::now())
        {
            publisher.update_connections().ok();
            self.room.timed_wait(|_| {}, DEAD_READER_CHECK).ok();
        }
    }

    /// Lossless readers that have not taken a message yet; acknowledgements of their predecessors are dropped.
    fn new_lossless_readers(&mut self) -> Vec<(u128, usize)> {
        let mut readers = lossless_readers(&self.messages, &self.topic);
        self.attached.retain(|port| readers.iter().any(|(reader, _)| reader == port));
        readers.retain(|(port, _)| !self.attached.contains(port));
        if !readers.is_empty() {
            self.room.try_wait(|_| {}).ok();
        }
        lock(&self.answers).clear();
        readers
    }

    /// Waits until new readers have taken the message that was just sent. Until a reader first receives, iceoryx2 does not count
    /// it as connected, and drops messages that do not fit. Messages of a writer that is killed and cleaned up before that would
    /// be lost, too, although it was not their reader that died.
    fn await_first_sight(&mut self, mut new: Vec<(u128, usize)>) {
        while !new.is_empty() && !self.stop.forced() {
            let mut answers = std::mem::take(&mut *lock(&self.answers));
            if answers.is_empty() {
                self.room.timed_wait(|event| answers.push(event.id.as_value()), DEAD_READER_CHECK).ok();
            }
            let seen = new.extract_if(.., |(_, place)| answers.contains(place));
            self.attached.extend(seen.map(|(port, _)| port));
            if answers.is_empty() {
                new.iter().for_each(|(_, place)| self.stop.wait_for(&self.topic.readers[*place].stage));
                clean_dead_nodes(&self.config);
            }
            let there = lossless_readers(&self.messages, &self.topic);
            new.retain(|reader| there.contains(reader));
        }
    }
}

/// Port and index of the lossless readers that are connected now; ports are named after their stages.
fn lossless_readers(messages: &Factory, topic: &Topic) -> Vec<(u128, usize)> {
    let mut found = Vec::new();
    messages.dynamic_config().list_subscribers(|reader| {
        let stage = reader.subscriber_name.as_str();
        if let (Some(place), Delivery::Lossless) = (topic.place_of(stage), topic.delivery_to(stage)) {
            found.push((reader.subscriber_id.value(), place));
        }
        CallbackProgression::Continue
    });
    found
}

fn clean_dead_nodes(config: &Config) {
    // Failures are retried at the next check.
    Node::<Ipc>::list(config, |node| {
        if let NodeState::Dead(dead) = node {
            dead.try_remove_stale_resources().ok();
        }
        CallbackProgression::Continue
    })
    .ok();
}

impl Writer for SharedWriter {
    fn item(&self) -> &ItemType {
        &self.item
    }

    fn loan_bytes(&mut self, length: usize) -> Result<&mut [u8], PortError> {
        self.loan = None;
        let loaned = untyped::loan(self.publisher(length)?, length);
        let loaned = loaned.map_err(|error| self.fault(error))?;
        Ok(untyped::items_of_loan(self.loan.insert(loaned)))
    }

    fn send(&mut self, header: &Header) -> Result<usize, PortError> {
        if self.loan.is_none() {
            self.loan_bytes(0)?;
        }
        let Some(mut sample) = self.loan.take() else { return Err(PortError::Stopped) };
        let length = untyped::items_of_loan(&mut sample).len() / self.item.size();
        untyped::set_header(&mut sample, header);
        let new = self.new_lossless_readers();
        sample.send().map_err(|error| if self.stop.forced() { PortError::Stopped } else { self.fault(error) })?;
        // A reader that is not woken polls at its next tick.
        self.wake.notify().ok();
        self.sent.iter_mut().for_each(|sent| sent.add(header));
        self.await_first_sight(new);
        Ok(length)
    }

    fn connected(&self) -> Vec<ConnectedReader> {
        let mut readers = Vec::new();
        self.messages.dynamic_config().list_subscribers(|reader| {
            let (port, stage) = (reader.subscriber_id.value(), reader.subscriber_name.as_str().to_owned());
            readers.push(ConnectedReader { port, stage });
            CallbackProgression::Continue
        });
        readers.retain(|reader| self.topic.place_of(&reader.stage).is_some());
        readers
    }

    fn unfinished(&self, reader: &str) -> usize {
        let place = self.topic.place_of(reader);
        self.sent.as_ref().zip(place).map_or(0, |(sent, place)| sent.unfinished_by(place))
    }

    fn catch_up(&mut self) {
        if let (Some(publisher), Some(_)) = (&self.publisher, &self.sent) {
            // A failed connection is retried at the next call.
            publisher.update_connections().ok();
        }
    }

    fn wait(&mut self, timeout: Duration) -> bool {
        let woken = self.room.timed_wait(|_| {}, timeout).is_ok_and(|events| events > 0);
        if !woken {
            clean_dead_nodes(&self.config);
        }
        self.catch_up();
        woken
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::heartbeat::Heartbeat;
    use crate::ports::capacity::SHARED_MEMORY;
    use crate::ports::shared_memory::SharedMemory;
    use crate::ports::{TopicReader, Transport};
    use conicflow_messages::Text;
    use std::fs::{self, File};
    use std::os::unix::fs::FileExt;
    use std::path::Path;

    fn topic() -> Topic {
        let reader = TopicReader { stage: "reader".into(), delivery: Delivery::Lossless, queue: 3 };
        Topic { name: "things".into(), writers: vec!["writer".into()], readers: vec![reader], ..Topic::default() }
    }

    #[test]
    fn a_writer_that_nobody_wakes_tells_for_whom_it_waits() {
        let folder = tempfile::tempdir().unwrap();
        let record = tempfile::tempfile().unwrap();
        let stop = Stop::default();
        stop.show_life_by(Heartbeat::new(record.try_clone().unwrap(), 0, 8));
        let memory = SharedMemory::open(folder.path(), "test", "writer", stop).unwrap();
        let reader = memory.reader::<u16>(&topic(), "reader").unwrap();
        let writer = memory.writer::<u16>(&topic()).unwrap();
        let receiver_port_id = lossless_readers(&writer.messages, &topic())[0].0;
        let elapsed_time = Duration::ZERO;
        let full = BackpressureInfo { service_id: 0, sender_port_id: 0, receiver_port_id, retries: 0, elapsed_time };
        let wait_for_room = writer.wait_for_room();
        let waited_for = || {
            assert!(matches!(wait_for_room(&full), BackpressureAction::Retry));
            let mut told = [0; 32];
            record.read_at(&mut told, 8).unwrap();
            bytemuck::cast::<_, Text<32>>(told).to_string()
        };
        reader.room.as_ref().unwrap().notify().unwrap();
        assert_eq!(waited_for(), "", "it has taken a message");
        assert_eq!(waited_for(), "reader");
    }

    #[test]
    fn memory_for_images_that_is_not_there_is_told() {
        let folder = tempfile::tempdir().unwrap();
        let memory = SharedMemory::open(folder.path(), "test", "writer", Stop::default()).unwrap();
        let writer = memory.writer::<u16>(&topic()).unwrap();
        let segment = Path::new(SHARED_MEMORY).join(format!("{}segment_7.data", writer.occupied.prefix()));
        File::create(&segment).unwrap().set_len(1 << 40).unwrap();
        let error = writer.take_memory(7, 5, 1 << 40).unwrap_err();
        fs::remove_file(&segment).unwrap();
        assert!(matches!(error, PortError::NoRoom { length: 5, .. }), "{error}");
    }
}
