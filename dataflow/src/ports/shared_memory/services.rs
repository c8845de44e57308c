//! The services of a run as one process uses them: creates or opens those of a topic, and knows where their files are.

use super::acknowledgements::Acknowledgements;
use super::cleanup::{self, Occupied};
use super::untyped::{Factory, Untyped, with_types};
use crate::item_type::ItemType;
use crate::ports::capacity::{ROOM_PER_PORT, in_words, room};
use crate::ports::{Delivery, MAX_KEPT, OTHER_BUILD, PortError, Topic, TopicReader};
use crate::stop::Stop;
use conicflow_messages::HEADER_TYPE_NAME;
use iceoryx2::node::NodeCreationFailure;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::*;
use iceoryx2::service::builder::publish_subscribe::{PublishSubscribeOpenError, PublishSubscribeOpenOrCreateError};
use iceoryx2::service::marker::{CustomHeaderMarker, CustomPayloadMarker};
use std::fmt::Debug;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

pub(super) type Ipc = ipc_threadsafe::Service;

/// Maximum length of the folder's path in bytes: it contains Unix sockets, whose paths are limited.
const ROOT_LIMIT: usize = 48;

/// Maximum number of onlookers: readers in addition to those of the pipeline file.
pub(super) const SPARE_READERS: usize = 8;
/// Maximum number of messages that one reader holds at a time: one for each source on a topic, or those that it keeps, and some
/// in use.
const MAX_HELD: usize = MAX_KEPT + 4;

/// Maximum wait for another process to finish creating a part of shared memory. It is shorter than the grace of a run that ends,
/// as that process may have been killed.
const CREATION_TIMEOUT: Duration = Duration::from_secs(5);

/// Access of this process to the topics of one run; its readers and writers need it as long as they exist.
pub struct SharedMemory {
    pub(super) node: Node<Ipc>,
    run: String,
    /// The run's folder, where lossless readers may restart.
    folder: Option<PathBuf>,
    pub(super) stop: Stop,
    /// Shared with the ports, and the last field of each: the folder is in use until all ports are dropped.
    pub(super) occupied: Arc<Occupied>,
}

impl SharedMemory {
    /// Joins the run `run` whose files are in the folder `root`.
    ///
    /// # Errors
    /// The folder cannot be used for shared memory.
    pub fn open(root: &Path, run: &str, stage: &str, stop: Stop) -> Result<Self, PortError> {
        set_log_level(LogLevel::Fatal);
        let config = configuration(root)?;
        let doing = || format!("stage `{stage}` cannot join the shared memory");
        let fault = |reason: &dyn Debug| PortError::of_shared_memory(root, doing(), reason);
        let occupied = Arc::new(Occupied::new(root, stop.clone()).map_err(|error| fault(&error))?);
        occupied.settle(CREATION_TIMEOUT).map_err(|error| fault(&error))?;
        let name = NodeName::new(stage).map_err(|error| fault(&error))?;
        let builder = NodeBuilder::new().name(&name).config(&config).signal_handling_mode(SignalHandlingMode::Disabled);
        let node = builder.create::<Ipc>().map_err(|error: NodeCreationFailure| fault(&error))?;
        cleanup::close_to_others(root).map_err(|error| fault(&error))?;
        Ok(Self { node, run: run.to_owned(), folder: None, stop, occupied })
    }

    /// Sets the `folder` of a run with a launcher; there the acknowledgements of lossless readers are kept. All processes of the
    /// run have to set it, except onlookers.
    pub fn kept_in(self, folder: &Path) -> Self {
        Self { folder: Some(folder.to_owned()), ..self }
    }

    /// The folder of a topic's acknowledgements, if messages are kept for any of its readers.
    pub(super) fn folder_of(&self, topic: &Topic) -> Option<&Path> {
        self.folder.as_deref().filter(|_| topic.is_lossless() && !topic.writers.is_empty())
    }

    /// Length of a reader's buffer. A restarted reader receives all kept messages before it first reads from its buffer and
    /// counts as connected; then come the messages for which the writer still has credit.
    pub(super) fn buffer_of(&self, topic: &Topic, reader: &TopicReader) -> usize {
        match self.folder_of(topic) {
            Some(_) if reader.delivery == Delivery::Lossless => topic.kept() + reader.credit(),
            _ => reader.queue,
        }
    }

    /// The acknowledgements of a topic, if any are kept.
    pub(super) fn acknowledgements(&self, topic: &Topic) -> Result<Option<Arc<Acknowledgements>>, PortError> {
        let Some(folder) = self.folder_of(topic) else { return Ok(None) };
        let opened = Acknowledgements::open(folder, topic);
        let fault = |error| self.fault(format!("what was finished of topic `{}` cannot be noted", topic.name), error);
        opened.map(|table| Some(Arc::new(table))).map_err(fault)
    }

    /// Removes leftovers of dead processes from shared memory.
    ///
    /// # Errors
    /// The folder cannot be used for shared memory.
    pub fn clean(root: &Path) -> Result<(), PortError> {
        let Self { node, occupied, .. } = Self::open(root, "", "launcher", Stop::default())?;
        node.try_cleanup_dead_nodes();
        drop(node);
        occupied.clean_up().map_err(|error| {
            let doing = "what dead processes left cannot be removed";
            PortError::of_shared_memory(root, doing, format_args!("{error}"))
        })
    }

    pub(super) fn fault(&self, doing: impl Into<String>, reason: impl Debug) -> PortError {
        PortError::of_shared_memory(self.occupied.root(), doing, reason)
    }

    fn service_name(&self, topic: &Topic, part: &str) -> Result<ServiceName, PortError> {
        let name = format!("conicflow/{}/{}{part}", self.run, topic.name);
        ServiceName::new(&name).map_err(|error| self.fault(format!("topic `{}` cannot be named", topic.name), error))
    }

    /// Checks that there is `room` for iceoryx2's data of a port, which is written when the port is created.
    fn look_for_room(&self, room: io::Result<(u64, u64)>, topic: &Topic) -> Result<(), PortError> {
        match room {
            Ok((free, _)) if free < ROOM_PER_PORT as u64 => {
                let doing = format!("topic `{}` cannot be joined", topic.name);
                Err(self.fault(doing, format_args!("shared memory has {} free", in_words(free))))
            }
            _ => Ok(()),
        }
    }

    /// Opens or creates the service of a topic's messages.
    pub(super) fn messages(&self, item: &ItemType, topic: &Topic) -> Result<Factory, PortError> {
        let opened = self.messages_builder(item, topic)?.open_or_create();
        opened.map_err(|error| self.messages_fault(item, topic, error))
    }

    /// Opens the service of a topic's messages without creating it, as an onlooker does not know the memory that it needs.
    pub(super) fn messages_of_others(&self, item: &ItemType, topic: &Topic) -> Result<Factory, PortError> {
        let opened = self.messages_builder(item, topic)?.open();
        opened.map_err(|error| {
            self.messages_fault(item, topic, PublishSubscribeOpenOrCreateError::PublishSubscribeOpenError(error))
        })
    }

    fn messages_builder(&self, item: &ItemType, topic: &Topic) -> Result<Untyped, PortError> {
        topic.expect(item)?;
        self.look_for_room(room(), topic)?;
        let fault = |reason: &dyn Debug| self.fault(format!("topic `{}` cannot be opened", topic.name), reason);
        let readers = topic.readers.len() + SPARE_READERS;
        let writers = topic.writers.len() + 2;
        let longest = topic.readers.iter().map(|reader| self.buffer_of(topic, reader)).max();
        let longest = longest.unwrap_or(topic.longest_queue());
        let service = self
            .node
            .service_builder(&self.service_name(topic, "")?)
            .publish_subscribe::<[CustomPayloadMarker]>()
            .user_header::<CustomHeaderMarker>()
            .enable_safe_overflow(!topic.is_lossless())
            .subscriber_max_buffer_size(longest)
            .subscriber_max_borrowed_samples(MAX_HELD)
            .max_publishers(writers)
            .max_subscribers(readers)
            .max_nodes(2 * (writers + readers))
            .history_size(self.folder_of(topic).map_or(0, |_| topic.kept()));
        with_types(service, item).map_err(|reason| fault(&reason))
    }

    fn messages_fault(&self, item: &ItemType, topic: &Topic, error: PublishSubscribeOpenOrCreateError) -> PortError {
        match error {
            PublishSubscribeOpenOrCreateError::PublishSubscribeOpenError(
                PublishSubscribeOpenError::IncompatibleTypes,
            ) => PortError::Incompatible {
                topic: topic.name.clone(),
                own: format!("{item}, behind a header `{HEADER_TYPE_NAME}`"),
                declared: String::new(),
                hint: OTHER_BUILD.to_owned(),
            },
            other => self.fault(format!("topic `{}` cannot be opened", topic.name), other),
        }
    }

    pub(super) fn event(&self, topic: &Topic, part: &str) -> Result<EventFactory, PortError> {
        let ports = topic.readers.len() + topic.writers.len() + SPARE_READERS;
        let builder = self.node.service_builder(&self.service_name(topic, part)?).event();
        let builder = builder.max_listeners(ports).max_notifiers(ports).max_nodes(2 * ports).event_id_max_value(ports);
        builder
            .open_or_create()
            .map_err(|error| self.fault(format!("the wake-up of topic `{}` cannot be opened", topic.name), error))
    }

    pub(super) fn listener(&self, topic: &Topic, part: &str) -> Result<Listener<Ipc>, PortError> {
        let created = self.event(topic, part)?.listener_builder().create();
        created.map_err(|error| self.fault(format!("topic `{}` cannot be listened to", topic.name), error))
    }

    pub(super) fn notifier(&self, topic: &Topic, part: &str, event: usize) -> Result<Notifier<Ipc>, PortError> {
        let service = self.event(topic, part)?;
        let created = service.notifier_builder().default_event_id(EventId::new(event)).create();
        created.map_err(|error| self.fault(format!("topic `{}` cannot wake anybody", topic.name), error))
    }
}

pub(super) type EventFactory = iceoryx2::service::port_factory::event::PortFactory<Ipc>;

pub(super) fn configuration(root: &Path) -> Result<Config, PortError> {
    let length = root.as_os_str().len();
    if length > ROOT_LIMIT {
        return Err(PortError::PathTooLong { path: root.to_owned(), length, limit: ROOT_LIMIT });
    }
    let unusable = || PortError::PathUnusable { path: root.to_owned() };
    let prefix = cleanup::prefix(root).map_err(|error| {
        let doing = "the folder of shared memory cannot be used";
        PortError::of_shared_memory(root, doing, format_args!("{error}"))
    })?;
    let mut config = Config::default();
    // Each slot is a connection per reader whose writer may have gone while the reader holds its messages.
    config.defaults.publish_subscribe.subscriber_expired_connection_buffer = MAX_HELD;
    let path = iceoryx2::prelude::Path::new(root.as_os_str().as_encoded_bytes()).map_err(|_| unusable())?;
    // A process may be delayed while it creates a part; those that wait must not give up before it goes on.
    config.global.creation_timeout = CREATION_TIMEOUT;
    config.global.set_root_path(&path);
    config.global.prefix = FileName::new(prefix.as_bytes()).map_err(|_| unusable())?;
    Ok(config)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_reader_that_may_be_started_anew_has_room_for_what_is_kept_and_for_what_follows() {
        let folder = tempfile::tempdir().unwrap();
        let memory = SharedMemory::open(folder.path(), "test", "stage", Stop::default()).unwrap();
        let reader = |stage: &str, delivery: Delivery| TopicReader { stage: stage.to_owned(), delivery, queue: 4 };
        let readers = vec![reader("all", Delivery::Lossless), reader("newest", Delivery::Latest)];
        let topic = Topic { name: "things".into(), writers: vec!["writer".into()], readers, ..Topic::default() };
        let without_writers = Topic { writers: vec![], ..topic.clone() };
        let newest_only = Topic { readers: topic.readers[1..].to_vec(), ..topic.clone() };
        let rooms = |memory: &SharedMemory, topic: &Topic| {
            topic.readers.iter().map(|reader| memory.buffer_of(topic, reader)).collect::<Vec<_>>()
        };
        assert_eq!(rooms(&memory, &topic), [4, 4], "nobody is started anew");
        let memory = memory.kept_in(folder.path());
        // Four in the queue, one being processed, and the end of the stream; then as many as may be unfinished.
        assert_eq!(rooms(&memory, &topic), [6 + 5, 4]);
        assert_eq!((rooms(&memory, &without_writers), rooms(&memory, &newest_only)), (vec![4, 4], vec![4]));
        let is_kept = |topic: &Topic| memory.folder_of(topic).is_some();
        assert_eq!([&topic, &without_writers, &newest_only].map(is_kept), [true, false, false]);
    }

    #[test]
    fn a_folder_whose_path_cannot_be_used_is_told_with_what_is_wrong_with_it() {
        let folder = tempfile::tempdir_in("/tmp").unwrap();
        let told = |name: &str| configuration(&folder.path().join(name)).err().map(|error| error.to_string());
        std::fs::create_dir(folder.path().join("a b")).unwrap();
        assert_eq!(told("a b"), None);
        for (name, named) in [("fr\u{fc}h", "has `\u{fc}` in its path"), ("a?\tb", "has `?`, `\\t` in its path")] {
            std::fs::create_dir(folder.path().join(name)).unwrap();
            let told = told(name).unwrap();
            assert!(told.contains(named) && told.contains("\n  hint: set CONICFLOW_RUNTIME_DIR"), "{told}");
        }
        assert!(told(&"a".repeat(60)).unwrap().contains("bytes long, shared memory can use 48 at most"));
    }

    #[test]
    fn a_topic_is_not_joined_where_a_port_has_no_room() {
        let folder = tempfile::tempdir().unwrap();
        let memory = SharedMemory::open(folder.path(), "test", "stage", Stop::default()).unwrap();
        let topic = Topic { name: "things".into(), ..Topic::default() };
        let look = |room| memory.look_for_room(room, &topic).map_err(|error| error.to_string());
        assert_eq!(look(Ok((24 * 1024, u64::MAX))), Ok(()));
        let told = look(Ok((24 * 1024 - 1, u64::MAX))).unwrap_err();
        assert!(told.starts_with("topic `things` cannot be joined: shared memory has 24.6 kB free\n"), "{told}");
        assert_eq!(look(Err(io::ErrorKind::NotFound.into())), Ok(()), "iceoryx2 says it better");
    }

    #[test]
    fn a_topic_has_places_for_its_readers_and_writers_and_those_who_come_beside_them() {
        let folder = tempfile::tempdir().unwrap();
        let memory = SharedMemory::open(folder.path(), "test", "stage", Stop::default()).unwrap();
        let reader = |stage: &str| TopicReader { stage: stage.to_owned(), delivery: Delivery::Latest, queue: 4 };
        let (readers, writers) = (["a", "b", "c"].map(reader).to_vec(), ["d", "e", "f"].map(str::to_owned).to_vec());
        let topic = Topic { name: "things".into(), writers, readers, ..Topic::default() };
        let service = memory.messages(&ItemType::of::<u16>(), &topic).unwrap();
        let places = service.static_config();
        // In addition to the file's, eight readers may be onlookers, and two writers may be replacements.
        assert_eq!((places.max_subscribers(), places.max_publishers()), (3 + 8, 3 + 2));
        assert_eq!(places.max_nodes(), 2 * (11 + 5), "each may be followed by another process");
        assert_eq!(places.subscriber_max_borrowed_samples(), 12 + 4, "messages that are kept, and some in use");
        let service = memory.event(&topic, "/wake").unwrap();
        let places = service.static_config();
        assert_eq!([places.max_listeners(), places.max_notifiers(), places.event_id_max_value()], [3 + 3 + 8; 3]);
        assert_eq!(places.max_nodes(), 2 * 14);
    }
}
