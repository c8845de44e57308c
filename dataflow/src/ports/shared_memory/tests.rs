//! Tests of the topics in shared memory, within one process: each side opens them as a process of its own would.

use crate::ports::shared_memory::{SharedMemory, SharedMessage};
use crate::ports::{Delivery, PortError, Reader, Received, Topic, TopicReader, Transport, Writer};
use crate::stage::Stop;
use conicflow_messages::{Header, Object, Track};
use std::path::Path;
use std::thread;
use std::time::Duration;

fn topic(delivery: Delivery, queue: usize) -> Topic {
    let reader = TopicReader { stage: "reader".into(), delivery, queue };
    Topic { name: "things".into(), item: None, writers: vec!["writer".into()], readers: vec![reader] }
}

fn open(root: &Path, stage: &str) -> SharedMemory {
    SharedMemory::open(root, "test", stage, Stop::default()).unwrap()
}

fn send<T: conicflow_messages::Item>(writer: &mut impl Writer, sequence: u64, items: &[T]) {
    writer.loan(items.len()).unwrap().copy_from_slice(items);
    writer.send(&Header { sequence, ..Header::default() }).unwrap();
}

fn sequences(reader: &mut impl Reader) -> Vec<u64> {
    std::iter::from_fn(|| reader.receive().unwrap().map(|message| message.header().sequence)).collect()
}

#[test]
fn a_slow_lossless_reader_loses_nothing_not_even_before_its_first_look() {
    let folder = tempfile::tempdir().unwrap();
    let topic = topic(Delivery::Lossless, 2);
    let mut reader = open(folder.path(), "reader").reader::<u16>(&topic, "reader").unwrap();
    thread::scope(|scope| {
        scope.spawn(|| {
            let mut writer = open(folder.path(), "writer").writer::<u16>(&topic).unwrap();
            (0..50).for_each(|sequence| send(&mut writer, sequence, &[sequence as u16; 1000]));
            while !writer.connected().is_empty() {
                thread::sleep(Duration::from_millis(1));
            }
        });
        let mut taken = Vec::new();
        while taken.len() < 50 {
            if let Some(message) = reader.receive().unwrap() {
                assert!(message.items::<u16>().iter().all(|&pixel| u64::from(pixel) == message.header().sequence));
                taken.push(message.header().sequence);
            } else {
                reader.wait(Duration::from_millis(100)).unwrap();
            }
        }
        assert_eq!(taken, (0..50).collect::<Vec<_>>());
        drop(reader);
    });
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
fn a_lossless_reader_misses_nothing_while_lists_grow() {
    let folder = tempfile::tempdir().unwrap();
    let topic = topic(Delivery::Lossless, 3);
    let mut reader = open(folder.path(), "reader").reader::<Object>(&topic, "reader").unwrap();
    let lengths = || (0..60_usize).map(|index| (index * index) % 1000);
    thread::scope(|scope| {
        scope.spawn(|| {
            let mut writer = open(folder.path(), "writer").writer::<Object>(&topic).unwrap();
            let lists = lengths().map(|length| vec![Object::default(); length]).enumerate();
            lists.for_each(|(sequence, list)| send(&mut writer, sequence as u64, &list));
            while !writer.connected().is_empty() {
                thread::sleep(Duration::from_millis(1));
            }
        });
        let mut taken = Vec::new();
        while taken.len() < 60 {
            reader.wait(Duration::from_millis(100)).unwrap();
            taken.extend(
                reader.receive().unwrap().map(|message| (message.header().sequence, message.items::<Object>().len())),
            );
        }
        assert!(taken.into_iter().eq((0..).zip(lengths())));
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
    let memory = SharedMemory::open(folder.path(), "test", "writer", stop.clone()).unwrap();
    let mut writer = memory.writer::<u16>(&topic).unwrap();
    thread::scope(|scope| {
        scope.spawn(|| {
            thread::sleep(Duration::from_millis(50));
            stop.force();
        });
        send(&mut writer, 0, &[1]);
    });
}
