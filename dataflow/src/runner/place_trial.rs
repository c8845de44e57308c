//! A run of one stage or source in memory, for tests of how these start, hand over and end.

use super::handover::{Handover, Successor, Watermark};
use super::peers::Peers;
use super::source_loop::run_source;
use super::stage_loop::run_stage;
use super::untyped::{NewSource, NewStage};
use super::{RunError, StageRuntime};
use crate::clock::until;
use crate::pause::Pause;
use crate::ports::in_memory::{InMemory, MemoryReader, MemoryWriter};
use crate::ports::{Delivery, Reader, Received, Topic, TopicReader, Transport, Wiring, Writer};
use crate::runner::output_port::end_of_stream;
use crate::status::{Life, Status, StatusFile, status_path, used};
use crate::stop::Stop;
use crate::{Context, Next, NoConfig, Output, SideInput, SideInputs, Source, Stage, StageError};
use conicflow_messages::{Camera, Header, Hop, Message, Nothing, Object, ObjectKind, Text};
use serde_json::json;
use std::fs::File;
use std::io::Read;
use std::io::{ErrorKind, Write};
use std::os::unix::net::UnixStream;
use std::thread;
use std::time::Duration;
use tempfile::TempDir;

pub(super) const RUN: u64 = 7;
pub(super) const STAMPS_APART: Duration = Duration::from_millis(40);

/// Appends to the file `made` whenever a stage is created; fails for one called `refused`.
fn note_made(context: &Context) -> Result<(), StageError> {
    if context.stage == "refused" {
        return Err("it is refused".into());
    }
    Ok(File::options().append(true).create(true).open(context.resolve("made".as_ref()))?.write_all(b"!")?)
}

/// A sink that ignores its messages.
pub(super) struct Taking;

impl Stage for Taking {
    const NAME: &'static str = "taking";
    const SUMMARY: &'static str = "Takes what it gets";
    type Config = NoConfig;
    type Input = Object;
    type Output = Nothing;

    fn new(_: NoConfig, context: &Context) -> Result<Self, StageError> {
        note_made(context)?;
        Ok(Self)
    }

    fn step(&mut self, _: &Message<Object>, _: &SideInputs, _: &mut Output<Nothing>) -> Result<(), StageError> {
        Ok(())
    }
}

/// A stage that passes its input on, and counts the items of its side inputs. One called `full` finds no memory, and one called
/// `failing` fails.
pub(super) struct Passing {
    name: String,
}

impl Stage for Passing {
    const NAME: &'static str = "passing";
    const SUMMARY: &'static str = "Passes on what it gets";
    type Config = NoConfig;
    type Input = Object;
    type Output = Object;

    fn new(_: NoConfig, context: &Context) -> Result<Self, StageError> {
        note_made(context)?;
        Ok(Self { name: context.stage.clone() })
    }

    fn side_inputs() -> &'static [SideInput] {
        const { &[SideInput::latest::<Object>("newest"), SideInput::same_frame::<Object>("partner")] }
    }

    fn step(
        &mut self,
        input: &Message<Object>,
        sides: &SideInputs,
        output: &mut Output<Object>,
    ) -> Result<(), StageError> {
        match &*self.name {
            "full" => return Err(std::io::Error::from(ErrorKind::StorageFull).into()),
            "failing" => return Err("it fails".into()),
            _ => output.extend(input.items),
        }
        for side in ["newest", "partner"] {
            output.count(side, sides.get::<Object>(side).map_or(0, |message| message.items.len() as u64));
        }
        Ok(())
    }
}

/// A source that makes three balls, or none if it is called `empty`, and counts how often it had none, and the items of its side
/// input. One called `failing` cannot end, and one called `stamped` keeps the intervals of its stamps.
pub(super) struct Making {
    made: u64,
    total: u64,
    name: String,
}

impl Source for Making {
    const NAME: &'static str = "making";
    const SUMMARY: &'static str = "Makes three balls";
    type Config = NoConfig;
    type Output = Object;

    fn new(_: NoConfig, context: &Context) -> Result<Self, StageError> {
        let total = if context.stage == "empty" { 0 } else { 3 };
        Ok(Self { made: context.resume_at, total, name: context.stage.clone() })
    }

    fn side_inputs() -> &'static [SideInput] {
        const { &[SideInput::latest::<Object>("newest")] }
    }

    fn total(&self) -> Option<u64> {
        Some(self.total)
    }

    fn keeps_stamps(&self) -> bool {
        self.name == "stamped"
    }

    fn next(&mut self, sides: &SideInputs, output: &mut Output<Object>) -> Result<Next, StageError> {
        output.count("newest", sides.get::<Object>("newest").map_or(0, |message| message.items.len() as u64));
        if self.made == self.total {
            output.count("none left", 1);
            return Ok(Next::End);
        }
        output.header = Header { hop_count: 0, stamp_ns: self.made * STAMPS_APART.as_nanos() as u64, ..from("", 0) };
        output.push(ball());
        self.made += 1;
        Ok(Next::Message)
    }

    fn finish(&mut self) -> Result<(), StageError> {
        if self.name == "failing" { Err("it cannot end".into()) } else { Ok(()) }
    }
}

pub(super) fn ball() -> Object {
    Object { kind: ObjectKind::Sphere.code(), radius: 0.1, ..Object::default() }
}

/// Header of the message `number` of a writer that is also the source.
pub(super) fn from(writer: &str, number: u64) -> Header {
    let camera = Camera { width: 4, height: 3, fx: 5.0, fy: 5.0, cx: 1.5, cy: 1.0 };
    let mut header = Header { epoch: 1, sequence: number, number, camera, depth_scale: 0.001, ..Header::default() };
    header.add_hop(Hop { stage: Text::new(writer), ..Hop::default() });
    header
}

pub(super) fn end_of(writer: &str, count: u64) -> Header {
    end_of_stream(&from(writer, 0), Text::new(writer), count)
}

pub(super) fn topic(name: &str, writers: &[&str], reader: &str, delivery: Delivery) -> Topic {
    let readers = vec![TopicReader { stage: reader.to_owned(), delivery, queue: 20 }];
    let writers = writers.iter().map(|writer| (*writer).to_owned()).collect();
    Topic { name: name.to_owned(), item: None, writers, readers }
}

/// Forces the end of a test's threads when dropped, also if the test fails.
pub(super) struct AtOnce(pub Stop);

impl Drop for AtOnce {
    fn drop(&mut self) {
        self.0.force();
    }
}

/// A run of one stage, whose writers keep messages.
pub(super) struct Trial {
    pub(super) folder: TempDir,
    pub(super) memory: InMemory,
    pub(super) stage: String,
    pub(super) stop: Stop,
    /// State of other stages as this one sees it.
    pub(super) life: fn(&str) -> Option<Life>,
}

impl Trial {
    pub(super) fn of(stage: &str) -> Self {
        let stop = Stop::default();
        let (folder, memory) = (tempfile::tempdir().unwrap(), InMemory::new(stop.clone()).keeping());
        Self { folder, memory, stage: stage.to_owned(), stop, life: |_| None }
    }

    pub(super) fn input(&self, delivery: Delivery) -> Topic {
        topic("in", &["upstream"], &self.stage, delivery)
    }

    /// The output topic, with a viewer as its reader.
    pub(super) fn output(&self) -> Topic {
        topic("out", &[&self.stage], "viewer", Delivery::Latest)
    }

    pub(super) fn runtime(&self, wiring: Wiring) -> StageRuntime<InMemory> {
        let (transport, peers, base) = (self.memory.clone(), Peers::modelled(self.life), self.folder.path().to_owned());
        let context = Context { stage: self.stage.clone(), stop: self.stop.clone(), base, ..Context::default() };
        let record = StatusFile::open(&status_path(self.folder.path(), &self.stage), RUN).unwrap();
        let (handover, pause) = (Some(self.handover()), Pause::default());
        StageRuntime { transport, wiring, context, peers, record, handover, successor: None, pause, lock: None }
    }

    pub(super) fn handover(&self) -> Handover {
        Handover::of(self.folder.path(), &self.stage)
    }

    pub(super) fn record(&self) -> Box<Status> {
        Box::new(Status::read(&status_path(self.folder.path(), &self.stage)).unwrap())
    }

    /// Whether no process has written the record.
    pub(super) fn is_unwritten(&self) -> bool {
        Status::read(&status_path(self.folder.path(), &self.stage)).is_none()
    }

    pub(super) fn has_done(&self, steps: u64) -> bool {
        !self.is_unwritten() && self.record().steps == steps
    }

    pub(super) fn counter(&self, name: &str) -> u64 {
        used(&self.record().counters).find(|(own, _)| *own == name).map_or(0, |(_, count)| count)
    }

    pub(super) fn writer(&self, topic: &Topic) -> MemoryWriter {
        self.memory.writer::<Object>(topic).unwrap()
    }

    pub(super) fn viewer(&self) -> MemoryReader {
        self.memory.reader::<Object>(&self.output(), "viewer").unwrap()
    }

    /// Runs the stage until it ends by itself, and `meanwhile` beside it.
    pub(super) fn run<R>(&self, wiring: Wiring, meanwhile: impl FnOnce() -> R) -> (Result<(), RunError>, R) {
        self.run_after::<Passing, R>(wiring, None, meanwhile)
    }

    /// Runs the stage as [`Self::run`] does, in a process that replaces another if `successor` is given.
    pub(super) fn run_after<S: Stage, R>(
        &self,
        wiring: Wiring,
        successor: Option<Successor>,
        meanwhile: impl FnOnce() -> R,
    ) -> (Result<(), RunError>, R) {
        let run = || {
            let runtime = StageRuntime { successor, ..self.runtime(wiring) };
            run_stage(&NewStage::of::<S>(json!({}))?, runtime)
        };
        self.until_end(run, meanwhile)
    }

    pub(super) fn run_source<R>(
        &self,
        wiring: Wiring,
        successor: Option<Successor>,
        meanwhile: impl FnOnce() -> R,
    ) -> (Result<(), RunError>, R) {
        let run = || {
            let runtime = StageRuntime { successor, ..self.runtime(wiring) };
            run_source(&NewSource::of::<Making>(json!({}))?, runtime)
        };
        self.until_end(run, meanwhile)
    }

    fn until_end<R>(
        &self,
        run: impl FnOnce() -> Result<(), RunError> + Send,
        meanwhile: impl FnOnce() -> R,
    ) -> (Result<(), RunError>, R) {
        thread::scope(|scope| {
            let end = AtOnce(self.stop.clone());
            let running = scope.spawn(run);
            let told = meanwhile();
            let has_ended = until(|| running.is_finished());
            drop(end);
            let result = running.join().unwrap();
            assert!(has_ended, "it does not end by itself");
            (result, told)
        })
    }
}

/// Sends messages of one ball once the reader is connected.
pub(super) fn send(writer: &mut MemoryWriter, headers: impl IntoIterator<Item = Header>) {
    assert!(until(|| !writer.connected().is_empty()));
    for header in headers {
        send_items(writer, header, &[ball()][..usize::from(!header.ends_stream())]);
    }
}

pub(super) fn send_items(writer: &mut MemoryWriter, header: Header, items: &[Object]) {
    writer.loan(items.len()).unwrap().copy_from_slice(items);
    writer.send(&header).unwrap();
}

/// Numbers of the messages that have come, and whether the end has.
pub(super) fn taken(viewer: &mut MemoryReader) -> (Vec<u64>, bool) {
    let messages = std::iter::from_fn(|| viewer.receive().unwrap());
    let (ends, messages): (Vec<_>, Vec<_>) = messages.partition(|message| message.header().ends_stream());
    (messages.iter().map(|message| message.header().number).collect(), !ends.is_empty())
}

/// Numbers of the messages that come until the end does.
pub(super) fn taken_until_end(mut viewer: MemoryReader) -> Vec<u64> {
    let mut all = Vec::new();
    assert!(until(|| {
        let (numbers, has_ended) = taken(&mut viewer);
        all.extend(numbers);
        has_ended
    }));
    all
}

pub(super) fn mark(number: u64) -> Watermark {
    Watermark { numbers: [(Text::new("upstream"), number)].into(), ..Watermark::default() }
}

/// Waits until a successor reports that it is ready.
pub(super) fn is_ready(launcher: &mut UnixStream, patience: Duration) -> bool {
    launcher.set_read_timeout(Some(patience)).unwrap();
    launcher.read(&mut [0]).is_ok_and(|length| length == 1)
}

pub(super) const LONG: Duration = Duration::from_secs(10);
pub(super) const SHORT: Duration = Duration::from_millis(100);
