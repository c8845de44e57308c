//! Tests of topics in shared memory, within one process: each side opens them as a process of its own would.

use crate::clock::until;
use crate::heartbeat::Heartbeat;
use crate::item_type::ItemType;
use crate::ports::capacity::SHARED_MEMORY;
use crate::ports::shared_memory::{SharedMemory, SharedMessage, SharedWriter, cleanup};
use crate::ports::{Delivery, PortError, Reader, Received, Topic, TopicReader, Transport, Writer};
use crate::stop::Stop;
use conicflow_messages::{Header, Hop, Object, Text, Track};
use std::fs::OpenOptions;
use std::io::{BufRead, BufReader, Read};
use std::os::unix::fs::{FileExt, MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::sync::mpsc::channel;
use std::time::{Duration, Instant};
use std::{env, fs, io, thread};

pub(crate) fn topic(delivery: Delivery, queue: usize) -> Topic {
    let reader = TopicReader { stage: "reader".into(), delivery, queue };
    Topic { name: "things".into(), item: None, writers: vec!["writer".into()], readers: vec![reader] }
}

/// A lossless topic of numbers with a known type.
fn lossless() -> Topic {
    Topic { item: Some(ItemType::of::<u16>()), ..topic(Delivery::Lossless, 3) }
}

fn open(root: &Path, stage: &str) -> SharedMemory {
    SharedMemory::open(root, "test", stage, Stop::default()).unwrap()
}

/// Memory of a process, and a function that returns whether the process now records that it waits for the reader.
fn watched(root: &Path, stage: &str, stop: &Stop) -> (SharedMemory, impl Fn() -> bool + use<>) {
    let record = tempfile::tempfile().unwrap();
    record.set_len(64).unwrap();
    stop.show_life_by(Heartbeat::new(record.try_clone().unwrap(), 0, 8));
    let waits = move || {
        let mut told = [0; 32];
        record.read_at(&mut told, 8).unwrap();
        bytemuck::cast::<_, Text<32>>(told) == Text::new("reader")
    };
    (SharedMemory::open(root, "test", stage, stop.clone()).unwrap(), waits)
}

fn send<T: conicflow_messages::Item>(writer: &mut impl Writer, sequence: u64, items: &[T]) {
    writer.loan(items.len()).unwrap().copy_from_slice(items);
    assert_eq!(writer.send(&Header { sequence, ..Header::default() }).unwrap(), items.len());
}

fn sequences(reader: &mut impl Reader) -> Vec<u64> {
    std::iter::from_fn(|| reader.receive().unwrap().map(|message| message.header().sequence)).collect()
}

/// Sends a message of one item as the topic's writer.
fn send_as_writer(writer: &mut SharedWriter, number: u64) {
    writer.loan(1).unwrap().copy_from_slice(&[number as u16]);
    let mut header = Header { number, sequence: number, ..Header::default() };
    header.add_hop(Hop { stage: Text::new("writer"), ..Hop::default() });
    writer.send(&header).unwrap();
}

/// Waits for the next message and returns its sequence number.
fn wait_for(reader: &mut impl Reader) -> u64 {
    let deadline = Instant::now() + Duration::from_secs(20);
    while Instant::now() < deadline {
        if let Some(message) = reader.receive().unwrap() {
            return message.header().sequence;
        }
        reader.wait(Duration::from_millis(10)).unwrap();
    }
    panic!("no message comes");
}

/// A process that is killed while it creates the counter of a folder's processes leaves an unreadable one.
#[test]
fn a_folder_can_be_joined_and_cleared_after_a_process_died_that_was_the_first_to_join() {
    let folder = tempfile::tempdir().unwrap();
    let first = open(folder.path(), "launcher");
    let begins = first.occupied.prefix().to_owned();
    let shared = fs::read_dir(SHARED_MEMORY).unwrap().map(|entry| entry.unwrap().path());
    let is_counter = |path: &PathBuf| {
        path.to_string_lossy().contains(&begins) && path.extension().is_some_and(|end| end == "global_mgmt")
    };
    let counter = shared.into_iter().find(is_counter).unwrap();
    drop(first);
    assert!(!counter.exists(), "all have left in order");
    for size in [16, 0] {
        let begin = || {
            let half = OpenOptions::new().write(true).create_new(true).mode(0o200).open(&counter).unwrap();
            half.set_len(size).unwrap();
        };
        begin();
        drop(open(folder.path(), "launcher"));
        begin();
        SharedMemory::clean(folder.path()).unwrap();
        assert!(!counter.exists());
    }
}

#[test]
fn a_run_goes_on_where_a_process_died_that_had_begun_what_another_one_waits_for() {
    let folder = tempfile::tempdir().unwrap();
    let services = open(folder.path(), "launcher").keep_services([&lossless()].into_iter()).unwrap();
    let waiting = open(folder.path(), "reader");
    let begins = waiting.occupied.prefix().to_owned();
    let shared = fs::read_dir(SHARED_MEMORY).unwrap().map(|entry| entry.unwrap().path());
    let is_of_a_service = |path: &PathBuf| {
        path.to_string_lossy().contains(&begins) && path.extension().is_some_and(|end| end == "dynamic")
    };
    for path in shared.filter(is_of_a_service) {
        fs::remove_file(&path).unwrap();
        OpenOptions::new().write(true).create_new(true).mode(0o200).open(&path).unwrap();
    }
    let (opened, is_opened) = channel();
    let opening = thread::spawn(move || opened.send(waiting.messages(&ItemType::of::<u16>(), &lossless()).is_err()));
    is_opened.recv_timeout(Duration::from_millis(100)).unwrap_err();
    let goes_on = (0..1000).find_map(|_| {
        services.settle();
        is_opened.recv_timeout(Duration::from_millis(10)).ok()
    });
    assert_eq!(goes_on, Some(true), "it waits for ever, or found what is not there");
    opening.join().unwrap().unwrap();
}

/// A separate process that is reading a topic: this program, which runs only the test below.
pub(crate) struct ReadingProcess(Child);

impl ReadingProcess {
    const FOLDER: &str = "CONICFLOW_TEST_FOLDER";
    const LATEST: &str = "CONICFLOW_TEST_LATEST";
    const READS: &str = "it reads";

    pub(crate) fn start(root: &Path, delivery: Delivery) -> Self {
        let test = "ports::shared_memory::tests::it_reads_until_it_is_killed";
        let mut command = Command::new(env::current_exe().unwrap());
        command.args(["--exact", test, "--ignored", "--nocapture"]).env(Self::FOLDER, root);
        if delivery == Delivery::Latest {
            command.env(Self::LATEST, "");
        }
        let mut child = command.stdin(Stdio::piped()).stdout(Stdio::piped()).spawn().unwrap();
        let mut told = BufReader::new(child.stdout.take().unwrap()).lines().map_while(Result::ok);
        assert!(told.any(|line| line.ends_with(Self::READS)));
        Self(child)
    }

    pub(crate) fn kill(mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }
}

#[test]
#[ignore = "a process that other tests kill"]
fn it_reads_until_it_is_killed() {
    let Some(root) = env::var_os(ReadingProcess::FOLDER) else { return };
    let delivery = if env::var_os(ReadingProcess::LATEST).is_some() { Delivery::Latest } else { Delivery::Lossless };
    let _reader = open(Path::new(&root), "reader").reader::<u16>(&topic(delivery, 3), "reader").unwrap();
    println!("{}", ReadingProcess::READS);
    // The parent process writes nothing, and closes the pipe at its own end at the latest.
    io::stdin().read_to_end(&mut Vec::new()).unwrap();
}

#[test]
fn what_was_sent_is_not_gone_with_its_writer_before_a_reader_looks_for_the_first_time() {
    let folder = tempfile::tempdir().unwrap();
    let topic = lossless();
    let open = |stage: &str| open(folder.path(), stage).kept_in(folder.path());
    let _services = open("launcher").keep_services([&topic].into_iter()).unwrap();
    // The reader has joined the topic, but has not received yet.
    let mut reader = open("reader").reader::<u16>(&topic, "reader").unwrap();
    let (done, is_done) = channel();
    let (memory, waits) = watched(folder.path(), "writer", &Stop::default());
    let memory = memory.kept_in(folder.path());
    thread::scope(|scope| {
        scope.spawn(|| {
            let mut writer = memory.writer::<u16>(&topic).unwrap();
            send_as_writer(&mut writer, 0);
            // The writer's memory is cleaned up as after a kill.
            drop(writer);
            done.send(()).unwrap();
        });
        assert!(until(waits));
        is_done.try_recv().unwrap_err();
        assert_eq!(wait_for(&mut reader), 0);
        is_done.recv_timeout(Duration::from_secs(20)).unwrap();
    });
}

#[test]
fn what_a_lossless_reader_has_not_finished_is_handed_to_the_next_one_and_to_nobody_else() {
    let folder = tempfile::tempdir().unwrap();
    let mut topic = lossless();
    topic.readers.push(TopicReader { stage: "viewer".into(), delivery: Delivery::Latest, queue: 2 });
    let open = |stage: &str| open(folder.path(), stage).kept_in(folder.path());
    let _services = open("launcher").keep_services([&topic].into_iter()).unwrap();
    let mut writer = open("writer").writer::<u16>(&topic).unwrap();
    let mut first = open("reader").reader::<u16>(&topic, "reader").unwrap();
    assert_eq!(first.acknowledged(), Some(vec![(Text::new("writer"), 0)]));
    thread::scope(|scope| {
        // The writer waits with the first one until the reader has received it.
        let sending = scope.spawn(|| (0..2).for_each(|number| send_as_writer(&mut writer, number)));
        assert_eq!(wait_for(&mut first), 0);
        sending.join().unwrap();
    });
    assert_eq!(sequences(&mut first), [1]);
    first.acknowledge(Text::new("writer"), 2);
    (2..6).for_each(|number| send_as_writer(&mut writer, number));
    assert_eq!((writer.unfinished("reader"), writer.unfinished("viewer")), (4, 0));
    assert_eq!(first.receive().unwrap().unwrap().header().sequence, 2, "in its hands when it dies");
    assert_eq!(first.begin(Text::new("writer"), 2), 1);
    drop(first);
    for deaths in 1..4 {
        let mut next = open("reader").reader::<u16>(&topic, "reader").unwrap();
        assert_eq!(next.acknowledged(), Some(vec![(Text::new("writer"), 2)]));
        assert_eq!(sequences(&mut next), [0; 0], "nobody has handed it anything yet");
        writer.catch_up();
        assert!(sequences(&mut next).ends_with(&[2, 3, 4, 5]));
        assert_eq!(next.begin(Text::new("writer"), 2), deaths + 1, "how often it was begun is known to the next one");
    }
    let mut onlooker = open("onlooker").onlooker(&ItemType::of::<u16>(), &topic).unwrap();
    let mut viewer = open("viewer").reader::<u16>(&topic, "viewer").unwrap();
    writer.catch_up();
    assert!(sequences(&mut viewer).is_empty() && onlooker.receive(&open("onlooker")).unwrap().is_none());
    let mut last = open("reader").reader::<u16>(&topic, "reader").unwrap();
    last.acknowledge(Text::new("writer"), 6);
    assert_eq!(writer.unfinished("reader"), 0);
}

/// A longer message needs a new segment, and messages in the old one may have to be resent to a restarted reader.
#[test]
fn a_longer_message_waits_until_what_came_before_it_is_finished() {
    let folder = tempfile::tempdir().unwrap();
    let topic = lossless();
    let open = |stage: &str| open(folder.path(), stage).kept_in(folder.path());
    let _services = open("launcher").keep_services([&topic].into_iter()).unwrap();
    let mut reader = open("reader").reader::<u16>(&topic, "reader").unwrap();
    let (done, is_done) = channel();
    thread::scope(|scope| {
        scope.spawn(|| {
            let mut writer = open("writer").writer::<u16>(&topic).unwrap();
            send_as_writer(&mut writer, 0);
            writer.loan::<u16>(100_000).unwrap();
            done.send(()).unwrap();
        });
        assert_eq!(wait_for(&mut reader), 0);
        is_done.recv_timeout(Duration::from_millis(300)).unwrap_err();
        reader.acknowledge(Text::new("writer"), 1);
        is_done.recv_timeout(Duration::from_secs(20)).unwrap();
    });
}

#[test]
fn a_longer_message_does_not_wait_where_all_is_finished() {
    let folder = tempfile::tempdir().unwrap();
    let topic = lossless();
    let open = |stage: &str| open(folder.path(), stage).kept_in(folder.path());
    let _services = open("launcher").keep_services([&topic].into_iter()).unwrap();
    let mut reader = open("reader").reader::<u16>(&topic, "reader").unwrap();
    let mut writer = open("writer").writer::<u16>(&topic).unwrap();
    thread::scope(|scope| {
        scope.spawn(|| send_as_writer(&mut writer, 0));
        assert_eq!(wait_for(&mut reader), 0);
    });
    reader.acknowledge(Text::new("writer"), 1);
    writer.loan::<u16>(100_000).unwrap();
    assert!(writer.wait(Duration::from_secs(20)), "what the reader told is heard by who waits for that alone");
}

#[test]
fn who_waits_sleeps_until_something_comes_and_no_longer_than_told() {
    let folder = tempfile::tempdir().unwrap();
    let topic = topic(Delivery::Lossless, 3);
    let mut reader = open(folder.path(), "reader").reader::<u16>(&topic, "reader").unwrap();
    let mut writer = open(folder.path(), "writer").writer::<u16>(&topic).unwrap();
    let (begin, while_nothing_comes) = (Instant::now(), Duration::from_millis(20));
    reader.wait(while_nothing_comes).unwrap();
    assert!(begin.elapsed() >= while_nothing_comes);
    assert!(!writer.wait(while_nothing_comes), "no reader has finished anything");
    assert!(begin.elapsed() >= 2 * while_nothing_comes);
    thread::scope(|scope| {
        scope.spawn(|| (0..2).for_each(|sequence| send(&mut writer, sequence, &[1])));
        reader.wait(Duration::from_secs(3600)).unwrap();
        assert_eq!([wait_for(&mut reader), wait_for(&mut reader)], [0, 1]);
    });
    assert!(writer.wait(Duration::from_secs(3600)), "there is room for another one");
}

#[test]
fn a_reader_that_was_killed_is_cleared_away_by_a_writer_that_waits_for_it() {
    let folder = tempfile::tempdir().unwrap();
    let process = ReadingProcess::start(folder.path(), Delivery::Lossless);
    let stop = Stop::default();
    let memory = SharedMemory::open(folder.path(), "test", "writer", stop.clone()).unwrap();
    let mut writer = memory.writer::<u16>(&topic(Delivery::Lossless, 3)).unwrap();
    process.kill();
    assert_eq!(writer.connected().len(), 1, "nobody has noticed it yet");
    let (done, is_done) = channel();
    thread::scope(|scope| {
        scope.spawn(|| {
            send(&mut writer, 0, &[1]);
            done.send(()).unwrap();
        });
        let has_sent = is_done.recv_timeout(Duration::from_secs(20));
        stop.force();
        has_sent.unwrap();
    });
    assert!(writer.connected().is_empty());
}

#[test]
fn a_reader_that_was_killed_is_cleared_away_by_a_writer_that_has_nothing_to_do() {
    let folder = tempfile::tempdir().unwrap();
    let process = ReadingProcess::start(folder.path(), Delivery::Lossless);
    let mut writer = open(folder.path(), "writer").writer::<u16>(&topic(Delivery::Lossless, 3)).unwrap();
    process.kill();
    assert_eq!(writer.connected().len(), 1, "nobody has noticed it yet");
    // The writer checks only after a wait without success, and may check too early.
    assert!(until(|| !writer.wait(Duration::from_millis(1)) && writer.connected().is_empty()));
}

#[test]
fn who_looks_on_too_early_does_not_keep_the_run_from_beginning() {
    let folder = tempfile::tempdir().unwrap();
    let topic = lossless();
    let (early, item) = (open(folder.path(), "onlooker"), ItemType::of::<u16>());
    assert!(early.onlooker(&item, &topic).is_err(), "there is nothing yet");
    let launcher = open(folder.path(), "launcher").kept_in(folder.path());
    let _services = launcher.keep_services([&topic].into_iter()).unwrap();
    let mut onlooker = early.onlooker(&item, &topic).unwrap();
    let mut writer = open(folder.path(), "writer").writer::<u16>(&topic).unwrap();
    send(&mut writer, 7, &[5]);
    let message = onlooker.receive(&early).unwrap().unwrap();
    assert_eq!((message.header().sequence, message.items::<u16>()), (7, &[5][..]));
}

#[test]
fn a_reader_that_wants_the_newest_never_holds_up_its_writer() {
    let folder = tempfile::tempdir().unwrap();
    let topic = topic(Delivery::Latest, 2);
    let mut reader = open(folder.path(), "reader").reader::<u16>(&topic, "reader").unwrap();
    let mut writer = open(folder.path(), "writer").writer::<u16>(&topic).unwrap();
    (0..100).for_each(|sequence| send(&mut writer, sequence, &[7; 10]));
    assert_eq!(sequences(&mut reader), [98, 99]);
}

#[test]
fn lists_grow_and_may_be_empty() {
    let folder = tempfile::tempdir().unwrap();
    let topic = topic(Delivery::Latest, 8);
    let mut reader = open(folder.path(), "reader").reader::<u16>(&topic, "reader").unwrap();
    let mut writer = open(folder.path(), "writer").writer::<u16>(&topic).unwrap();
    let mut held = Vec::new();
    for (sequence, length) in [(0, 3), (1, 0), (2, 5000), (3, 7), (4, 60_000)] {
        send(&mut writer, sequence, &vec![length as u16; length]);
        held.extend(reader.receive().unwrap());
    }
    let lengths: Vec<_> = held.iter().map(|message| message.items::<u16>().len()).collect();
    assert_eq!(lengths, [3, 0, 5000, 7, 60_000]);
    let own = |message: &SharedMessage| {
        let items = message.items::<u16>();
        items.iter().all(|&item| item as usize == items.len())
    };
    assert!(held.iter().all(own), "what is held stays as it was");
}

#[test]
fn a_slow_lossless_reader_misses_nothing_while_lists_grow_not_even_before_its_first_look() {
    let folder = tempfile::tempdir().unwrap();
    let topic = topic(Delivery::Lossless, 2);
    let mut reader = open(folder.path(), "reader").reader::<Object>(&topic, "reader").unwrap();
    let list = |index: usize| vec![Object { radius: index as f64, ..Object::default() }; (index * index) % 1000];
    let lists = || (0..60).map(|index| (index as u64, list(index)));
    thread::scope(|scope| {
        scope.spawn(|| {
            let mut writer = open(folder.path(), "writer").writer::<Object>(&topic).unwrap();
            lists().for_each(|(sequence, list)| send(&mut writer, sequence, &list));
            while !writer.connected().is_empty() {
                thread::sleep(Duration::from_millis(1));
            }
        });
        let mut taken = Vec::new();
        while taken.len() < 60 {
            reader.wait(Duration::from_millis(100)).unwrap();
            let message = reader.receive().unwrap();
            taken.extend(message.map(|message| (message.header().sequence, message.items::<Object>().to_vec())));
        }
        assert!(taken.into_iter().eq(lists()));
        drop(reader);
    });
}

#[test]
fn a_message_for_which_there_is_no_room_is_told_rather_than_written() {
    let folder = tempfile::tempdir().unwrap();
    let mut topic = topic(Delivery::Latest, 2);
    topic.readers[0].queue = 1 << 30;
    let mut writer = open(folder.path(), "writer").writer::<Track>(&topic).unwrap();
    let error = writer.loan::<Track>(5).err().unwrap();
    assert!(matches!(error, PortError::NoRoom { .. }), "{error}");
    assert!(error.to_string().starts_with("topic `things` has a message of 64 items: shared memory has "), "{error}");
}

#[test]
fn memory_for_images_is_taken_before_they_are_written() {
    let folder = tempfile::tempdir().unwrap();
    let mut writer = open(folder.path(), "writer").writer::<u16>(&topic(Delivery::Latest, 2)).unwrap();
    writer.loan::<u16>(100_000).unwrap();
    let prefix = cleanup::prefix(folder.path()).unwrap();
    let files = fs::read_dir(SHARED_MEMORY).unwrap().map(|entry| entry.unwrap().path());
    let is_own = |path: &Path| {
        let name = path.file_name().unwrap().to_str().unwrap();
        name.starts_with(&prefix) && name.ends_with(".data")
    };
    let taken: u64 = files.filter(|path| is_own(path)).map(|path| path.metadata().unwrap().blocks() * 512).sum();
    // Two in the queue, two held by a reader, and one being written.
    assert!(taken >= 5 * 200_000, "{taken} bytes");
}

#[test]
fn another_type_of_message_is_refused_by_name() {
    let folder = tempfile::tempdir().unwrap();
    let topic = topic(Delivery::Latest, 2);
    let _writer = open(folder.path(), "writer").writer::<Object>(&topic).unwrap();
    let error = open(folder.path(), "reader").reader::<Track>(&topic, "reader").err().unwrap();
    let text = error.to_string();
    assert!(matches!(error, PortError::Incompatible { .. }), "{text}");
    assert!(text.contains("conicflow.Track.v2") && text.contains("hint:"), "{text}");
}

#[test]
fn a_folder_with_too_long_a_path_is_told() {
    let folder = Path::new("/tmp").join("long".repeat(20));
    let error = SharedMemory::open(&folder, "test", "stage", Stop::default()).err().unwrap();
    assert!(matches!(error, PortError::PathTooLong { length: 85, limit: 48, .. }), "{error}");
}

#[test]
fn a_stopped_writer_does_not_wait_for_a_reader_that_never_reads() {
    let folder = tempfile::tempdir().unwrap();
    let topic = topic(Delivery::Lossless, 2);
    let _reader = open(folder.path(), "reader").reader::<u16>(&topic, "reader").unwrap();
    let stop = Stop::default();
    let (memory, waits) = watched(folder.path(), "writer", &stop);
    let mut writer = memory.writer::<u16>(&topic).unwrap();
    thread::scope(|scope| {
        let stopping = scope.spawn(|| {
            let waits = until(waits);
            stop.force();
            waits
        });
        send(&mut writer, 0, &[1]);
        assert!(stopping.join().unwrap());
    });
}
