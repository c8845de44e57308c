//! Tests of the two loops, over the in-memory equivalent of shared memory.

use super::alone::{Owned, collect, pass, step};
use super::output_port::{EndAnnouncement, OutputPort};
use super::peers::Peers;
use super::untyped::NewStage;
use crate::ports::in_memory::{InMemory, MemoryReader, MemoryWriter};
use crate::ports::shared_memory::SharedMemory;
use crate::ports::shared_memory::tests::{ReadingProcess, topic as shared_topic};
use crate::ports::{Delivery, Reader, Received, Topic, TopicReader, Transport, Writer};
use crate::relay::end_of_stream;
use crate::status::{Life, Status};
use crate::stop::Stop;
use crate::{Context, ItemType, Next, NoConfig, Output, RunError, SideInputs, Source, Stage, StageError};
use bytemuck::cast_slice;
use conicflow_messages::{AnyByte, Camera, END_OF_STREAM, Header, Message, Nothing, Object, ObjectKind, Text};
use serde_json::json;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::channel;
use std::thread;
use std::time::{Duration, Instant};

fn context(stage: &str) -> Context {
    Context { stage: stage.to_owned(), ..Context::default() }
}

fn header(sequence: u64) -> Header {
    let camera = Camera { width: 2, height: 2, fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5 };
    Header { epoch: 7, sequence, number: sequence, camera, depth_scale: 0.001, ..Header::default() }
}

fn ball(radius: f64) -> Object {
    Object { kind: ObjectKind::Sphere.code(), radius, ..Object::default() }
}

/// Passes on objects larger than 0.1 m; fails on objects without a size.
struct Large;

impl Stage for Large {
    const NAME: &'static str = "large";
    const SUMMARY: &'static str = "Passes on large objects";
    type Config = NoConfig;
    type Input = Object;
    type Output = Object;

    fn new(_: NoConfig, _: &Context) -> Result<Self, StageError> {
        Ok(Self)
    }

    fn step(&mut self, input: &Message<Object>, _: &SideInputs, output: &mut Output<Object>) -> Result<(), StageError> {
        assert!(input.items.iter().all(|object| object.radius < 9.0), "an object of a giant");
        if input.items.iter().any(|object| object.radius == 0.0) {
            return Err("an object without a size".into());
        }
        input.items.iter().filter(|object| object.radius > 0.1).for_each(|object| output.push(*object));
        Ok(())
    }
}

/// Shows its delivery in the radius of its objects: 1 for the newest message, 2 for each.
struct Delivered(Option<Delivery>);

impl Stage for Delivered {
    const NAME: &'static str = "delivered";
    const SUMMARY: &'static str = "Says how its messages come";
    type Config = NoConfig;
    type Input = Object;
    type Output = Object;

    fn new(_: NoConfig, context: &Context) -> Result<Self, StageError> {
        Ok(Self(context.delivery))
    }

    fn step(&mut self, _: &Message<Object>, _: &SideInputs, output: &mut Output<Object>) -> Result<(), StageError> {
        output.push(ball(self.0.map_or(0.0, |delivery| if delivery == Delivery::Latest { 1.0 } else { 2.0 })));
        Ok(())
    }
}

/// Makes three images whose pixels all have the number of the frame.
struct Counting(u16);

impl Source for Counting {
    const NAME: &'static str = "counting";
    const SUMMARY: &'static str = "Makes three images";
    type Config = NoConfig;
    type Output = u16;

    fn new(_: NoConfig, context: &Context) -> Result<Self, StageError> {
        Ok(Self(u16::try_from(context.resume_at)?))
    }

    fn next(&mut self, _: &SideInputs, output: &mut Output<u16>) -> Result<Next, StageError> {
        if self.0 == 3 {
            return Ok(Next::End);
        }
        output.header = header(0);
        output.loan(4)?.fill(self.0);
        self.0 += 1;
        Ok(Next::Message)
    }
}

#[test]
fn a_stage_makes_one_message_of_each_and_keeps_its_header() {
    let messages: Vec<Owned<Object>> = vec![(header(4), vec![ball(0.2), ball(0.05)]), (header(5), vec![])];
    let sent = pass::<Large>(NoConfig::default(), context("large"), &messages).unwrap();
    assert_eq!(sent.iter().map(|(_, objects)| objects.len()).collect::<Vec<_>>(), [1, 0]);
    let (first, _) = &sent[0];
    assert_eq!((first.epoch, first.sequence, first.number), (7, 4, 0));
    let stages: Vec<_> = first.trace().iter().map(|hop| hop.stage.to_string()).collect();
    assert_eq!(stages, ["upstream", "large"]);
}

#[test]
fn bytes_that_are_no_whole_items_are_an_error_and_not_an_empty_message() {
    let mut stage = NewStage::of::<Large>(json!({})).unwrap().make(&context("large")).unwrap();
    let (peers, header, objects) = (Peers::default(), header(0), [ball(0.2)]);
    let mut output = OutputPort::new(None::<(MemoryWriter, Topic)>, "large", 0, peers, Stop::default());
    let mut step = |bytes| {
        let made = stage.step((&header, bytes), &SideInputs::default(), output.untyped_output(header));
        made.map(|made| made.list.map(<[u8]>::len)).map_err(|error| error.to_string())
    };
    let bytes = cast_slice(&objects);
    assert_eq!(step(bytes), Ok(Some(bytes.len())));
    assert_eq!(step(&[]), Ok(Some(0)));
    for wrong in [&bytes[1..], &bytes[..8]] {
        let told = step(wrong).unwrap_err();
        assert!(told.contains(&format!("{} bytes are no items of objects", wrong.len())), "{told}");
    }
}

#[test]
fn a_stage_knows_whether_it_gets_the_newest_message_or_each() {
    let radius = |delivery| {
        let context = Context { delivery, ..context("delivered") };
        let sent = pass::<Delivered>(NoConfig::default(), context, &[(header(0), vec![])]).unwrap();
        sent[0].1[0].radius
    };
    assert_eq!([Some(Delivery::Latest), Some(Delivery::Lossless), None].map(radius), [1.0, 2.0, 2.0]);
}

/// A writer that has sent three messages and is about to end, with the memory and the topic for its one reader, called `reader`.
fn ending(reader: &str, peers: Peers) -> (InMemory, Topic, OutputPort<impl Writer>) {
    let memory = InMemory::default();
    let readers = vec![TopicReader { stage: reader.into(), delivery: Delivery::Lossless, queue: 4 }];
    let topic = Topic { name: "objects".into(), item: None, writers: vec!["stage".into()], readers };
    let writer = memory.writer::<Object>(&topic).unwrap();
    let output_port = OutputPort::new(Some((writer, topic.clone())), "stage", 3, peers, Stop::default());
    (memory, topic, output_port)
}

#[test]
fn what_was_sent_is_counted_in_messages_and_in_bytes_of_their_headers_and_items() {
    let (memory, topic, mut output_port) = ending("sink", Peers::default());
    let _reader = memory.reader::<Object>(&topic, "sink").unwrap();
    let objects = [ball(0.1), ball(0.2)];
    let mut status = Box::new(Status::default());
    let mut sent = |objects: &[Object], is_relayed: bool| {
        let bytes = cast_slice(objects);
        if is_relayed {
            output_port.relay(&header(0), bytes).unwrap();
        } else {
            output_port.write(bytes).unwrap();
            output_port.send(header(0), 0, None).unwrap();
        }
        output_port.tally(&mut status, 0);
        (status.sent, status.sent_bytes as usize)
    };
    let message = |objects: usize| size_of::<Header>() + objects * size_of::<Object>();
    assert_eq!(sent(&objects, false), (4, message(2)), "three were sent by the process before");
    assert_eq!(sent(&[], false), (5, message(2) + message(0)));
    assert_eq!(sent(&objects[1..], true), (6, message(2) + message(0) + message(1)));
}

/// Number of messages according to the end that this reader receives.
fn until_the_end(mut reader: MemoryReader) -> u64 {
    let deadline = Instant::now() + Duration::from_secs(20);
    while Instant::now() < deadline {
        match reader.receive().unwrap() {
            Some(message) if message.header().ends_stream() => return message.header().number,
            _ => reader.wait(Duration::from_millis(1)).unwrap(),
        }
    }
    panic!("the end is not told");
}

#[test]
fn a_reader_that_comes_anew_between_two_looks_is_told_the_end_too() {
    let (memory, topic, mut output_port) = ending("sink", Peers::default());
    let (end, now) = ([end_of_stream(&header(3), Text::new("stage"), 3)], Instant::now());
    let mut announcement = EndAnnouncement::until(now);
    for process in ["first", "second"] {
        let present = memory.reader::<Object>(&topic, "sink").unwrap();
        assert!(!output_port.announce_end(&end, &mut announcement, now).unwrap(), "the {process} is there");
        assert_eq!(until_the_end(present), 3);
    }
    assert!(output_port.announce_end(&end, &mut announcement, now).unwrap());
}

#[test]
fn a_reader_that_was_told_the_end_and_killed_is_waited_for_and_told_again() {
    static IS_OVER: AtomicBool = AtomicBool::new(false);
    let life = |_: &str| Some(if IS_OVER.load(Ordering::Relaxed) { Life::Ended } else { Life::Running });
    let (memory, topic, mut output_port) = ending("sink", Peers::modelled(life));
    let (end, now) = ([end_of_stream(&header(3), Text::new("stage"), 3)], Instant::now());
    let mut announcement = EndAnnouncement::until(now + Duration::from_secs(3600));
    for process in ["first", "second"] {
        let present = memory.reader::<Object>(&topic, "sink").unwrap();
        assert!(!output_port.announce_end(&end, &mut announcement, now).unwrap(), "the {process} is there");
        assert_eq!(until_the_end(present), 3);
        assert!(
            !output_port.announce_end(&end, &mut announcement, now).unwrap(),
            "the launcher is about to start that stage anew"
        );
    }
    IS_OVER.store(true, Ordering::Relaxed);
    assert!(output_port.announce_end(&end, &mut announcement, now).unwrap());
}

#[test]
fn the_bridge_which_may_have_other_topics_is_not_waited_for_when_it_was_told_the_end_and_has_left() {
    let leaves_at_once = |reader: &str| {
        let (memory, topic, mut output_port) = ending(reader, Peers::modelled(|_| Some(Life::Running)));
        let (end, now) = ([end_of_stream(&header(3), Text::new("stage"), 3)], Instant::now());
        let mut announcement = EndAnnouncement::until(now + Duration::from_secs(3600));
        assert!(!output_port.announce_end(&end, &mut announcement, now).unwrap(), "it has not come");
        let present = memory.reader::<Object>(&topic, reader).unwrap();
        assert!(!output_port.announce_end(&end, &mut announcement, now).unwrap(), "it is there");
        assert_eq!(until_the_end(present), 3);
        output_port.announce_end(&end, &mut announcement, now).unwrap()
    };
    assert_eq!(["bridge", "sink"].map(leaves_at_once), [true, false]);
}

#[test]
fn a_reader_that_was_killed_and_does_not_come_again_is_not_waited_for() {
    let (folder, topic) = (tempfile::tempdir().unwrap(), shared_topic(Delivery::Latest, 3));
    let memory = SharedMemory::open(folder.path(), "test", "writer", Stop::default()).unwrap();
    let writer = memory.writer::<u16>(&topic).unwrap();
    let reader = ReadingProcess::start(folder.path(), Delivery::Latest);
    let peers = Peers::modelled(|_| Some(Life::Ended));
    let mut output_port = OutputPort::new(Some((writer, topic)), "writer", 0, peers, Stop::default());
    let (end, is_over) = channel();
    let ending = thread::spawn(move || end.send(output_port.end().is_ok()));
    assert!(is_over.recv_timeout(Duration::from_millis(300)).is_err(), "it is there");
    reader.kill();
    assert_eq!(is_over.recv_timeout(Duration::from_secs(20)), Ok(true));
    ending.join().unwrap().unwrap();
}

#[test]
fn an_error_and_a_panic_name_the_frame() {
    let failing = |radius| vec![(header(0), vec![ball(0.2)]), (header(1), vec![ball(radius)])];
    let error = pass::<Large>(NoConfig::default(), context("large"), &failing(0.0)).unwrap_err();
    assert_eq!(error.to_string(), "at frame 1: an object without a size");
    let error = pass::<Large>(NoConfig::default(), context("large"), &failing(10.0)).unwrap_err();
    assert_eq!(error.to_string(), "at frame 1: panicked: an object of a giant");
    assert!(matches!(error, RunError::Failed { frame: 1, .. }));
}

#[test]
fn a_source_numbers_its_frames_and_ends() {
    let frames = collect::<Counting>(NoConfig::default(), context("counting"), 10).unwrap();
    assert_eq!(frames.iter().map(|(header, _)| header.sequence).collect::<Vec<_>>(), [0, 1, 2]);
    assert_eq!(frames[2].1, [2; 4]);
    assert_eq!(collect::<Counting>(NoConfig::default(), context("counting"), 2).unwrap().len(), 2);
}

/// A sink for images of four pixels, which fails to end its work before it has seen two.
#[derive(Default)]
struct Quiet {
    seen: u32,
}

impl Stage for Quiet {
    const NAME: &'static str = "quiet";
    const SUMMARY: &'static str = "Takes two images or more";
    type Config = NoConfig;
    type Input = u16;
    type Output = Nothing;

    fn new(_: NoConfig, _: &Context) -> Result<Self, StageError> {
        Ok(Self::default())
    }

    fn step(&mut self, input: &Message<u16>, _: &SideInputs, _: &mut Output<Nothing>) -> Result<(), StageError> {
        self.seen += 1;
        if input.items.len() == 4 { Ok(()) } else { Err("not four pixels".into()) }
    }

    fn finish(&mut self) -> Result<(), StageError> {
        if self.seen >= 2 { Ok(()) } else { Err("too little was seen".into()) }
    }
}

/// A test of a stage with such messages would pass for the wrong reason: in a pipeline no reader takes them.
#[test]
fn who_tests_with_messages_that_no_reader_takes_is_told() {
    let told = |frames: &[_]| pass::<Quiet>(NoConfig::default(), context("quiet"), frames).map_err(|e| e.to_string());
    assert!(told(&[(header(0), vec![1; 4]), (header(2), vec![1; 4])]).is_ok());
    let five_pixels = told(&[(header(0), vec![1; 4]), (header(1), vec![1; 5])]).unwrap_err();
    assert!(five_pixels.contains("malformed depth"), "{five_pixels}");
    let twice = told(&[(header(1), vec![1; 4]), (header(1), vec![1; 4])]).unwrap_err();
    assert!(twice.contains("`sequence`"), "{twice}");
}

/// Makes its header anew, and an image of its own size.
struct Careless;

impl Stage for Careless {
    const NAME: &'static str = "careless";
    const SUMMARY: &'static str = "Keeps nothing of the header";
    type Config = NoConfig;
    type Input = u16;
    type Output = u16;

    fn new(_: NoConfig, _: &Context) -> Result<Self, StageError> {
        Ok(Self)
    }

    fn step(&mut self, input: &Message<u16>, _: &SideInputs, output: &mut Output<u16>) -> Result<(), StageError> {
        output.header = Header { flags: END_OF_STREAM, camera: input.header.camera, ..header(0) };
        output.loan(input.items.len())?.copy_from_slice(input.items);
        Ok(())
    }
}

#[test]
fn no_stage_changes_which_frame_it_is_that_it_makes_something_of() {
    let frames: Vec<_> = (3..9).map(|number| (header(number), vec![number as u16; 4])).collect();
    let passed = pass::<Careless>(NoConfig::default(), context("careless"), &frames).unwrap();
    let numbers = |frames: &[(Header, Vec<u16>)]| frames.iter().map(|(header, _)| header.sequence).collect::<Vec<_>>();
    assert_eq!(numbers(&passed), numbers(&frames));
    let (made, pixels) = step(&mut Careless, &frames[2], &SideInputs::default()).unwrap();
    assert_eq!((made.sequence, made.ends_stream(), pixels), (5, false, vec![5; 4]));
}

#[test]
fn a_failure_at_the_end_is_that_of_no_frame() {
    let error = pass::<Quiet>(NoConfig::default(), context("quiet"), &[(header(0), vec![1; 4])]).unwrap_err();
    assert!(matches!(error, RunError::Unfinished(_)));
    assert_eq!(error.to_string(), "too little was seen");
}

/// Replays recorded objects with the numbers of their frames.
struct Replay(std::vec::IntoIter<(u64, f64)>);

impl Source for Replay {
    const NAME: &'static str = "replay";
    const SUMMARY: &'static str = "Sends what was recorded";
    type Config = NoConfig;
    type Output = AnyByte;

    fn new(_: NoConfig, context: &Context) -> Result<Self, StageError> {
        assert_eq!(context.output.as_ref().map(ItemType::name), Some("objects"));
        Ok(Self(vec![(4, 0.1), (5, 0.2), (9, 0.3), (2, 0.4)].into_iter()))
    }

    fn next(&mut self, _: &SideInputs, output: &mut Output<AnyByte>) -> Result<Next, StageError> {
        let Some((sequence, radius)) = self.0.next() else { return Ok(Next::End) };
        output.header = header(sequence);
        bytemuck::cast_slice_mut(output.loan(1)?).copy_from_slice(bytemuck::bytes_of(&ball(radius)));
        Ok(Next::Message)
    }
}

#[test]
fn a_recording_keeps_its_items_and_the_numbers_of_its_frames_as_long_as_they_rise() {
    let context = Context { output: Some(ItemType::of::<Object>()), ..context("replay") };
    let sent: Vec<Owned<AnyByte>> = collect::<Replay>(NoConfig::default(), context, 4).unwrap();
    let told = |(header, bytes): &Owned<AnyByte>| {
        let object: Object = bytemuck::pod_read_unaligned(cast_slice(bytes));
        (header.sequence, header.number, object.radius)
    };
    assert_eq!(sent.iter().map(told).collect::<Vec<_>>(), [(4, 0, 0.1), (5, 1, 0.2), (9, 2, 0.3), (10, 3, 0.4)]);
}
