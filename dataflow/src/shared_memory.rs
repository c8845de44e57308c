//! Topics in shared memory, by iceoryx2: the one file that knows it.
//!
//! A topic `t` of pipeline `p` is three services: `conicflow/p/t` carries the messages, `conicflow/p/t/wake` wakes the
//! readers when a message was sent, `conicflow/p/t/room` wakes a writer that waits because a lossless reader's queue is
//! full. All numbers of a service follow from the pipeline file, so that every stage asks for the same ones and the order
//! of their start does not matter.

#![allow(unsafe_code)] // layout promises for types in shared memory, and loans whose content is left over

use crate::ports::{Delivery, PortError, Reader, Received, Topic, Transport, Writer};
use crate::stage::Stop;
use bytemuck::TransparentWrapper;
use conicflow_messages::{HEADER_TYPE_NAME, Header, Item};
use iceoryx2::node::NodeCreationFailure;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::{BackpressureAction, BackpressureInfo};
use iceoryx2::prelude::*;
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::builder::publish_subscribe::{PublishSubscribeOpenError, PublishSubscribeOpenOrCreateError};
use iceoryx2::service::port_factory::publish_subscribe::PortFactory as TopicFactory;
use std::fmt::{Debug, Display};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

type Ipc = ipc_threadsafe::Service;
type Factory<T> = TopicFactory<Ipc, [WireItem<T>], WireHeader>;

/// Unix sockets lie in the folder, and their names leave no more room than this for folder and prefix together.
const ROOT_AND_PREFIX_LIMIT: usize = 71;
const PREFIX: &str = "conicflow_";

/// Readers that may join beside those of the pipeline file: tools that look on.
const SPARE_READERS: usize = 8;
/// Messages that one reader may hold at a time: one for each source on a topic, and those that wait for their frame.
const MAX_HELD: usize = 16;
/// A writer that waits for room looks this often whether the reader still lives.
const DEAD_READER_CHECK: Duration = Duration::from_millis(100);
/// Room for lists that no message has exceeded yet; longer ones grow the segment.
const INITIAL_LIST: usize = 1024;

/// An item in shared memory.
#[repr(transparent)]
#[derive(Clone, Copy, Debug, TransparentWrapper)]
struct WireItem<T>(T);

/// The header in shared memory.
#[repr(transparent)]
#[derive(Clone, Copy, Debug, Default, TransparentWrapper)]
struct WireHeader(Header);

// SAFETY: an `Item` is plain old data without pointers, and its type name carries the version of its layout.
unsafe impl<T: Item> ZeroCopySend for WireItem<T> {
    unsafe fn type_name() -> &'static str {
        T::TYPE_NAME
    }
}

// SAFETY: the header is plain old data without pointers, and its type name carries the version of its layout.
unsafe impl ZeroCopySend for WireHeader {
    unsafe fn type_name() -> &'static str {
        HEADER_TYPE_NAME
    }
}

/// This process's access to the topics of one pipeline.
pub struct SharedMemory {
    node: Node<Ipc>,
    pipeline: String,
    root: PathBuf,
    stop: Stop,
}

impl SharedMemory {
    /// Joins the pipeline `pipeline` whose files lie in the folder `root`, and cleans up after processes that died there.
    ///
    /// # Errors
    /// The folder cannot be used for shared memory.
    pub fn open(root: &Path, pipeline: &str, stage: &str, stop: Stop) -> Result<Self, PortError> {
        set_log_level(LogLevel::Fatal);
        let config = configuration(root)?;
        let fault = |reason: &dyn Debug| PortError::SharedMemory {
            doing: format!("stage `{stage}` cannot join the shared memory"),
            reason: format!("{reason:?}"),
            root: root.to_owned(),
        };
        let name = NodeName::new(stage).map_err(|error| fault(&error))?;
        let builder = NodeBuilder::new().name(&name).config(&config).signal_handling_mode(SignalHandlingMode::Disabled);
        let node = builder.create::<Ipc>().map_err(|error: NodeCreationFailure| fault(&error))?;
        Ok(Self { node, pipeline: pipeline.to_owned(), root: root.to_owned(), stop })
    }

    /// Removes what processes that died have left in shared memory.
    pub fn clean(&self) {
        self.node.try_cleanup_dead_nodes();
    }

    fn fault(&self, doing: impl Display, reason: impl Debug) -> PortError {
        PortError::SharedMemory { doing: doing.to_string(), reason: format!("{reason:?}"), root: self.root.clone() }
    }

    fn service_name(&self, topic: &Topic, part: &str) -> Result<ServiceName, PortError> {
        let name = format!("conicflow/{}/{}{part}", self.pipeline, topic.name);
        ServiceName::new(&name).map_err(|error| self.fault(format!("topic `{}` cannot be named", topic.name), error))
    }

    fn messages<T: Item>(&self, topic: &Topic) -> Result<Factory<T>, PortError> {
        let longest = topic.readers.iter().map(|reader| reader.queue).max().unwrap_or(2);
        let readers = topic.readers.len() + SPARE_READERS;
        let writers = topic.writers.len() + 2;
        let opened = self
            .node
            .service_builder(&self.service_name(topic, "")?)
            .publish_subscribe::<[WireItem<T>]>()
            .user_header::<WireHeader>()
            .enable_safe_overflow(!topic.is_lossless())
            .subscriber_max_buffer_size(longest)
            .subscriber_max_borrowed_samples(MAX_HELD)
            .max_publishers(writers)
            .max_subscribers(readers)
            .max_nodes(2 * (writers + readers))
            .history_size(0)
            .open_or_create();
        opened.map_err(|error| match error {
            PublishSubscribeOpenOrCreateError::PublishSubscribeOpenError(
                PublishSubscribeOpenError::IncompatibleTypes,
            ) => PortError::Incompatible {
                topic: topic.name.clone(),
                expected: format!("{HEADER_TYPE_NAME}, {}", T::TYPE_NAME),
            },
            other => self.fault(format!("topic `{}` cannot be opened", topic.name), other),
        })
    }

    fn event(&self, topic: &Topic, part: &str) -> Result<EventFactory, PortError> {
        let ports = topic.readers.len() + topic.writers.len() + SPARE_READERS;
        let builder = self.node.service_builder(&self.service_name(topic, part)?).event();
        let builder = builder.max_listeners(ports).max_notifiers(ports).max_nodes(2 * ports).event_id_max_value(ports);
        builder
            .open_or_create()
            .map_err(|error| self.fault(format!("the wake-up of topic `{}` cannot be opened", topic.name), error))
    }

    fn listener(&self, topic: &Topic, part: &str) -> Result<Listener<Ipc>, PortError> {
        let created = self.event(topic, part)?.listener_builder().create();
        created.map_err(|error| self.fault(format!("topic `{}` cannot be listened to", topic.name), error))
    }

    fn notifier(&self, topic: &Topic, part: &str, event: usize) -> Result<Notifier<Ipc>, PortError> {
        let service = self.event(topic, part)?;
        let created = service.notifier_builder().default_event_id(EventId::new(event)).create();
        created.map_err(|error| self.fault(format!("topic `{}` cannot wake anybody", topic.name), error))
    }
}

type EventFactory = iceoryx2::service::port_factory::event::PortFactory<Ipc>;

fn configuration(root: &Path) -> Result<Config, PortError> {
    let length = root.as_os_str().len() + PREFIX.len();
    let limit = ROOT_AND_PREFIX_LIMIT - PREFIX.len();
    let too_long = || PortError::PathTooLong { path: root.to_owned(), length: length - PREFIX.len(), limit };
    if length > ROOT_AND_PREFIX_LIMIT {
        return Err(too_long());
    }
    let mut config = Config::default();
    let path = iceoryx2::prelude::Path::new(root.as_os_str().as_encoded_bytes()).map_err(|_| too_long())?;
    config.global.set_root_path(&path);
    config.global.prefix = FileName::new(PREFIX.as_bytes()).map_err(|_| too_long())?;
    Ok(config)
}

impl Transport for SharedMemory {
    type Reader<T: Item> = SharedReader<T>;
    type Writer<T: Item> = SharedWriter<T>;

    fn reader<T: Item>(&self, topic: &Topic, stage: &str) -> Result<SharedReader<T>, PortError> {
        let fault = |error: &dyn Debug| self.fault(format!("topic `{}` cannot be read", topic.name), error);
        let reader = topic.readers.iter().find(|reader| reader.stage == stage);
        let queue = reader.map_or(2, |reader| reader.queue);
        let wake = self.listener(topic, "/wake")?;
        let room = match place_of(topic, stage) {
            Some(place) if topic.delivery_to(stage) == Delivery::Lossless => {
                Some(self.notifier(topic, "/room", place)?)
            }
            _ => None,
        };
        let name = PortName::new(stage).map_err(|error| fault(&error))?;
        let messages = self.messages::<T>(topic)?;
        let subscriber = messages.subscriber_builder().buffer_size(queue).name(&name).create();
        let subscriber = subscriber.map_err(|error| fault(&error))?;
        Ok(SharedReader { subscriber, wake, room, topic: topic.name.clone(), root: self.root.clone() })
    }

    fn writer<T: Item>(&self, topic: &Topic) -> Result<SharedWriter<T>, PortError> {
        Ok(SharedWriter {
            loan: None,
            publisher: None,
            messages: Arc::new(self.messages(topic)?),
            wake: self.notifier(topic, "/wake", 0)?,
            room: Arc::new(self.listener(topic, "/room")?),
            attached: Vec::new(),
            topic: topic.clone(),
            config: self.node.config().clone(),
            root: self.root.clone(),
            stop: self.stop.clone(),
        })
    }
}

/// Reads a topic in shared memory.
pub struct SharedReader<T: Item> {
    subscriber: Subscriber<Ipc, [WireItem<T>], WireHeader>,
    wake: Listener<Ipc>,
    room: Option<Notifier<Ipc>>,
    topic: String,
    root: PathBuf,
}

/// A message in shared memory.
#[derive(Debug)]
pub struct SharedMessage<T: Item>(Sample<Ipc, [WireItem<T>], WireHeader>);

impl<T: Item> Received<T> for SharedMessage<T> {
    fn header(&self) -> &Header {
        WireHeader::peel_ref(self.0.user_header())
    }

    fn items(&self) -> &[T] {
        WireItem::peel_slice(self.0.payload())
    }
}

impl<T: Item> Reader<T> for SharedReader<T> {
    type Message = SharedMessage<T>;

    fn receive(&mut self) -> Result<Option<SharedMessage<T>>, PortError> {
        let received = self.subscriber.receive().map_err(|error| PortError::SharedMemory {
            doing: format!("topic `{}` cannot be read", self.topic),
            reason: format!("{error:?}"),
            root: self.root.clone(),
        })?;
        if let (Some(_), Some(room)) = (&received, &self.room) {
            // A writer that is not woken looks again by itself after `DEAD_READER_CHECK`.
            room.notify().ok();
        }
        Ok(received.map(SharedMessage))
    }

    fn wait(&mut self, timeout: Duration) -> Result<(), PortError> {
        match self.wake.timed_wait(|_| {}, timeout) {
            // A signal ends the sleep early; the runner looks at its stop flag then.
            Ok(_) | Err(iceoryx2::port::listener::ListenerWaitError::InterruptSignal) => Ok(()),
            Err(error) => Err(PortError::SharedMemory {
                doing: format!("waiting for topic `{}` failed", self.topic),
                reason: format!("{error:?}"),
                root: self.root.clone(),
            }),
        }
    }
}

/// Writes a topic in shared memory.
pub struct SharedWriter<T: Item> {
    loan: Option<SampleMut<Ipc, [WireItem<T>], WireHeader>>,
    publisher: Option<Publisher<Ipc, [WireItem<T>], WireHeader>>,
    messages: Arc<Factory<T>>,
    wake: Notifier<Ipc>,
    room: Arc<Listener<Ipc>>,
    /// Ports of lossless readers that have taken their first message.
    attached: Vec<u128>,
    topic: Topic,
    config: Config,
    root: PathBuf,
    stop: Stop,
}

impl<T: Item> SharedWriter<T> {
    fn fault(&self, reason: impl Debug) -> PortError {
        PortError::SharedMemory {
            doing: format!("topic `{}` cannot be written", self.topic.name),
            reason: format!("{reason:?}"),
            root: self.root.clone(),
        }
    }

    /// The publisher, made when the length of the first message is known.
    fn publisher(&mut self, length: usize) -> Result<&Publisher<Ipc, [WireItem<T>], WireHeader>, PortError> {
        if self.publisher.is_none() {
            let builder = self.messages.publisher_builder().max_loaned_samples(2);
            let builder = builder.initial_max_slice_len(length.max(INITIAL_LIST));
            let builder = builder.allocation_strategy(AllocationStrategy::PowerOfTwo);
            let builder = builder.set_backpressure_handler(self.wait_for_room());
            self.publisher = Some(builder.create().map_err(|error| self.fault(error))?);
        }
        self.publisher.as_ref().ok_or(PortError::Stopped)
    }

    /// What a full queue leads to: for a lossless reader of the pipeline to waiting, until it has room or is dead; for any
    /// other to its loss of this message.
    fn wait_for_room(&self) -> impl Fn(&BackpressureInfo) -> BackpressureAction + Send + use<T> + 'static {
        let (messages, topic, room) = (Arc::clone(&self.messages), self.topic.clone(), Arc::clone(&self.room));
        let (config, stop) = (self.config.clone(), self.stop.clone());
        move |full| {
            if stop.forced() {
                return BackpressureAction::DiscardDataAndFail;
            }
            if !lossless_readers(&messages, &topic).iter().any(|(port, _)| *port == full.receiver_port_id) {
                return BackpressureAction::DiscardData;
            }
            let woken = room.timed_wait(|_| {}, DEAD_READER_CHECK);
            if !woken.is_ok_and(|events| events > 0) {
                clean_dead_nodes(&config);
            }
            BackpressureAction::Retry
        }
    }
}

impl<T: Item> SharedWriter<T> {
    /// Lossless readers that have not taken a message yet; what their predecessors answered is forgotten.
    fn new_lossless_readers(&mut self) -> Vec<(u128, usize)> {
        let mut readers = lossless_readers(&self.messages, &self.topic);
        self.attached.retain(|port| readers.iter().any(|(reader, _)| reader == port));
        readers.retain(|(port, _)| !self.attached.contains(port));
        if !readers.is_empty() {
            self.room.try_wait(|_| {}).ok();
        }
        readers
    }

    /// Waits until readers that are new have taken the message that was just sent. Before a reader looks into its queue
    /// for the first time iceoryx2 does not count it as connected, and would drop what does not fit.
    fn await_first_sight(&mut self, mut new: Vec<(u128, usize)>) {
        while !new.is_empty() && !self.stop.forced() {
            let mut answers = Vec::new();
            self.room.timed_wait(|event| answers.push(event.id.as_value()), DEAD_READER_CHECK).ok();
            let seen = new.extract_if(.., |(_, place)| answers.contains(place));
            self.attached.extend(seen.map(|(port, _)| port));
            if answers.is_empty() {
                clean_dead_nodes(&self.config);
            }
            let there = lossless_readers(&self.messages, &self.topic);
            new.retain(|reader| there.contains(reader));
        }
    }
}

/// The place of a reader among those of its topic: the number by which it answers.
fn place_of(topic: &Topic, stage: &str) -> Option<usize> {
    topic.readers.iter().position(|reader| reader.stage == stage)
}

/// Port and place of the lossless readers that are there now; ports are named after their stages.
fn lossless_readers<T: Item>(messages: &Factory<T>, topic: &Topic) -> Vec<(u128, usize)> {
    let mut found = Vec::new();
    messages.dynamic_config().list_subscribers(|reader| {
        let stage = reader.subscriber_name.as_str();
        if let (Some(place), Delivery::Lossless) = (place_of(topic, stage), topic.delivery_to(stage)) {
            found.push((reader.subscriber_id.value(), place));
        }
        CallbackProgression::Continue
    });
    found
}

fn clean_dead_nodes(config: &Config) {
    // What cannot be listed or cleaned now is tried again at the next look.
    Node::<Ipc>::list(config, |node| {
        if let NodeState::Dead(dead) = node {
            dead.try_remove_stale_resources().ok();
        }
        CallbackProgression::Continue
    })
    .ok();
}

impl<T: Item> Writer<T> for SharedWriter<T> {
    fn loan(&mut self, length: usize) -> Result<&mut [T], PortError> {
        self.loan = None;
        let loaned = self.publisher(length)?.loan_slice_uninit(length);
        let loaned = loaned.map_err(|error| self.fault(error))?;
        // SAFETY: `Item` is valid for all bit patterns, and the bytes of a shared segment are those that the kernel zeroed
        // or an earlier message wrote.
        let sample = unsafe { loaned.assume_init() };
        Ok(WireItem::peel_slice_mut(self.loan.insert(sample).payload_mut()))
    }

    fn send(&mut self, header: &Header) -> Result<(), PortError> {
        if self.loan.is_none() {
            self.loan(0)?;
        }
        let Some(mut sample) = self.loan.take() else { return Err(PortError::Stopped) };
        *WireHeader::peel_mut(sample.user_header_mut()) = *header;
        let new = self.new_lossless_readers();
        sample.send().map_err(|error| if self.stop.forced() { PortError::Stopped } else { self.fault(error) })?;
        // A reader that is not woken looks by itself at its next tick.
        self.wake.notify().ok();
        self.await_first_sight(new);
        Ok(())
    }

    fn connected(&self) -> Vec<String> {
        let mut stages = Vec::new();
        self.messages.dynamic_config().list_subscribers(|reader| {
            stages.push(reader.subscriber_name.as_str().to_owned());
            CallbackProgression::Continue
        });
        stages.retain(|stage| self.topic.readers.iter().any(|reader| reader.stage == *stage));
        stages
    }
}
