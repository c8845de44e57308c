//! Tests of a source and a stage that pull their messages, over shared memory.

use super::StageRuntime;
use super::peers::Peers;
use super::pulled_source::PulledSource;
use super::pulled_stage::PulledStage;
use crate::item_type::ItemType;
use crate::pause::Pause;
use crate::ports::shared_memory::{SharedMemory, SharedReader};
use crate::ports::{Delivery, Polled, Reader, Received, Topic, TopicReader, Transport, Wiring};
use crate::stage::Context;
use crate::status::{Life, Status, StatusFile, status_path, used};
use crate::stop::Stop;
use bytemuck::bytes_of;
use conicflow_messages::{Camera, Header, Item, Object, ObjectKind};
use serde_json::json;
use std::iter::from_fn;
use std::path::Path;
use std::thread;
use std::time::Duration;

const PATIENCE: Duration = Duration::from_secs(10);

fn topic<T: Item>(name: &str, writer: &str, reader: &str) -> Topic {
    let readers = vec![TopicReader { stage: reader.to_owned(), delivery: Delivery::Latest, queue: 4 }];
    Topic { name: name.to_owned(), item: Some(ItemType::of::<T>()), writers: vec![writer.to_owned()], readers }
}

fn objects() -> Topic {
    topic::<Object>("objects", "source", "stage")
}

fn runtime(root: &Path, stage: &str, wiring: Wiring) -> StageRuntime<SharedMemory> {
    let stop = Stop::default();
    let transport = SharedMemory::open(root, "test", stage, stop.clone()).unwrap();
    let context = Context { stage: stage.to_owned(), stop, ..Context::default() };
    let record = StatusFile::open(&status_path(root, stage), 7).unwrap();
    let (peers, pause, handover, successor, lock) = (Peers::default(), Pause::default(), None, None, None);
    StageRuntime { transport, wiring, context, peers, record, handover, successor, pause, lock }
}

fn source(root: &Path, frames: u64) -> PulledSource {
    let wiring = Wiring { output: Some(objects()), frames: Some(frames), ..Wiring::default() };
    PulledSource::open(runtime(root, "source", wiring), json!({}), Some(9)).unwrap().unwrap()
}

/// A stage that turns objects into the viewer's messages.
fn stage(root: &Path, output: &Topic) -> PulledStage {
    let wiring = Wiring { input: Some(objects()), output: Some(output.clone()), ..Wiring::default() };
    PulledStage::open(runtime(root, "stage", wiring), json!({}), &[]).unwrap().unwrap()
}

fn viewer<T: Item>(root: &Path, output: &Topic) -> SharedReader {
    SharedMemory::open(root, "test", "viewer", Stop::default()).unwrap().reader::<T>(output, "viewer").unwrap()
}

fn ball() -> Object {
    Object { kind: ObjectKind::Sphere.code(), radius: 0.1, ..Object::default() }
}

fn header() -> Header {
    let camera = Camera { width: 4, height: 3, fx: 5.0, fy: 5.0, cx: 1.5, cy: 1.0 };
    Header { camera, depth_scale: 0.001, ..Header::default() }
}

/// Number and size in bytes of the received messages.
fn came(viewer: &mut SharedReader) -> Vec<(u64, usize)> {
    let messages = from_fn(|| viewer.receive().unwrap()).filter(|message| !message.header().ends_stream());
    messages.map(|message| (message.header().number, message.bytes().len())).collect()
}

fn pull(stage: &mut PulledStage) -> Option<u64> {
    loop {
        match stage.pull(PATIENCE).unwrap() {
            Polled::Message((message, received_ns)) => {
                assert!(received_ns >= message.header().trace()[0].sent_ns);
                return Some(message.header().sequence);
            }
            Polled::Pending => {}
            Polled::Over => return None,
        }
    }
}

fn make(source: &mut PulledSource) -> Option<u64> {
    let number = source.next_number().unwrap()?;
    assert_eq!(source.frame(), Some(number));
    source.send(header(), bytes_of(&ball())).unwrap();
    Some(number)
}

#[test]
fn a_stage_sends_one_message_for_each_that_it_takes_and_an_empty_list_where_it_says_nothing() {
    let folder = tempfile::tempdir().unwrap();
    // The last process to leave would remove the folder's files.
    let _launcher = SharedMemory::open(folder.path(), "test", "launcher", Stop::default()).unwrap();
    let output = topic::<Object>("out", "stage", "viewer");
    let (mut stage, mut viewer) = (stage(folder.path(), &output), viewer::<Object>(folder.path(), &output));
    let mut source = source(folder.path(), 3);
    assert_eq!((source.frame(), source.has_begun(), stage.frame(), stage.has_begun()), (None, false, None, false));
    let error = stage.send(|_| {}, &[]).unwrap_err().to_string();
    assert!(error.starts_with("a stage sends in answer to a message, and it has none\n  hint: "), "{error}");
    assert_eq!((make(&mut source), pull(&mut stage)), (Some(0), Some(0)));
    assert_eq!((stage.frame(), source.has_begun(), stage.has_begun()), (Some(0), true, true));
    stage.send(|_| {}, bytes_of(&ball())).unwrap();
    let error = stage.send(|_| {}, bytes_of(&ball())).unwrap_err().to_string();
    assert!(error.starts_with("a stage sends one message for each that it takes\n  hint: "), "{error}");
    assert_eq!(came(&mut viewer), [(0, size_of::<Object>())]);
    assert_eq!((make(&mut source), pull(&mut stage)), (Some(1), Some(1)));
    let error = stage.send(|_| {}, bytes_of(&Object { radius: -0.1, ..ball() })).unwrap_err().to_string();
    assert!(error.starts_with("malformed objects: item 0 has a negative size\n  hint: "), "{error}");
    assert_eq!(came(&mut viewer), []);
    assert_eq!((make(&mut source), pull(&mut stage)), (Some(2), Some(2)));
    assert_eq!(came(&mut viewer), [(1, 0)], "of the step before");
    assert_eq!(source.next_number().unwrap(), None, "three are enough");
    source.count("seen", 2);
    source.count("unseen", 0);
    stage.count("seen", 3);
    stage.count("unseen", 0);
    thread::scope(|scope| {
        let ending = scope.spawn(|| source.end().unwrap());
        assert_eq!(pull(&mut stage), None);
        assert_eq!(came(&mut viewer), [(2, 0)]);
        scope.spawn(move || {
            while viewer.receive().unwrap().is_none_or(|message| !message.header().ends_stream()) {
                viewer.wait(Duration::from_millis(10)).unwrap();
            }
        });
        stage.end().unwrap();
        ending.join().unwrap();
    });
    for (stage, seen) in [("source", 2), ("stage", 3)] {
        let record = Box::new(Status::read(&status_path(folder.path(), stage)).unwrap());
        assert_eq!((record.life(), record.steps, record.sent), (Life::Ended, 3, 3), "{stage}");
        assert_eq!(used(&record.counters).collect::<Vec<_>>(), [("seen", seen)], "{stage}");
    }
}

#[test]
fn a_stage_of_images_that_says_nothing_sends_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let output = topic::<u16>("out", "stage", "viewer");
    let (mut stage, mut viewer) = (stage(folder.path(), &output), viewer::<u16>(folder.path(), &output));
    let mut source = source(folder.path(), 2);
    assert_eq!((make(&mut source), pull(&mut stage)), (Some(0), Some(0)));
    assert_eq!((make(&mut source), pull(&mut stage)), (Some(1), Some(1)));
    assert_eq!(came(&mut viewer), []);
    stage.send(|_| {}, &[0; 24]).unwrap();
    assert_eq!(came(&mut viewer), [(0, 24)], "four columns and three rows");
}

#[test]
fn what_the_pipeline_file_does_not_say_is_told_before_a_stage_begins() {
    let folder = tempfile::tempdir().unwrap();
    let runtime = |wiring| runtime(folder.path(), "stage", wiring);
    let source = |wiring| PulledSource::open(runtime(wiring), json!({}), None).err().unwrap().to_string();
    assert!(source(Wiring::default()).contains("no `output`"));
    let (input, output) = (Some(objects()), Some(topic::<Object>("out", "stage", "viewer")));
    assert!(source(Wiring { input: input.clone(), output, ..Wiring::default() }).contains("has an `input`"));
    let side_inputs = vec![("reference".to_owned(), topic::<Object>("side", "source", "stage"))];
    let wiring = || Wiring { input: input.clone(), side_inputs: side_inputs.clone(), ..Wiring::default() };
    let open = |name: &str| PulledStage::open(runtime(wiring()), json!({}), &[name.to_owned()]);
    let told = open("referense").err().unwrap().to_string();
    assert!(told.contains("no `referense` among its `inputs`") && told.contains("`reference`"), "{told}");
    assert!(open("reference").unwrap().is_some());
}
