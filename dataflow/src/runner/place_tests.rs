//! Tests of stages and sources in their place in a run: what they record, for whom they wait, and how they take, leave and end it.

use super::handover::tests::successor;
use super::handover::{Handover, Successor, Watermark};
use super::peers::Peers;
use super::source_loop::run_source;
use super::stage_loop::run_stage;
use super::untyped::{NewSource, NewStage};
use super::{RunError, StageRuntime, is_stopped};
use crate::log::tests::logged;
use crate::pause::Pause;
use crate::ports::in_memory::{InMemory, MemoryReader, MemoryWriter};
use crate::ports::{Delivery, PortError, Reader, Received, Topic, TopicReader, Transport, Wiring, Writer};
use crate::runner::output_port::end_of_stream;
use crate::stage::Stop;
use crate::status::{InputCounts, Life, Status, StatusFile, status_path, used};
use crate::{Context, Next, NoConfig, Output, SideInput, SideInputs, Source, Stage, StageError};
use conicflow_messages::{Camera, Header, Hop, Message, Nothing, Object, ObjectKind, Text};
use serde_json::json;
use std::fs::{self, File};
use std::io::{ErrorKind, Read, Write};
use std::os::unix::net::UnixStream;
use std::thread;
use std::time::{Duration, Instant};
use tempfile::TempDir;
use tracing::Level;

const RUN: u64 = 7;
const STAMPS_APART: Duration = Duration::from_millis(40);

/// Notes in the file `made` that something was made ready, unless that is called `refused`.
fn note_made(context: &Context) -> Result<(), StageError> {
    if context.stage == "refused" {
        return Err("it is refused".into());
    }
    Ok(File::options().append(true).create(true).open(context.resolve("made".as_ref()))?.write_all(b"!")?)
}

/// Takes what it gets.
struct Taking;

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

/// Passes on what it gets, and counts the items of its side inputs; one that is called `full` has no room, and one that is called
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

/// Makes three balls, or none if it is called `empty`, and counts how often it had none, and the items of its side input; one that
/// is called `failing` cannot end, and one that is called `stamped` keeps to its stamps.
struct Making {
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

/// The head of the message `number` of a writer that makes the frames itself.
pub(super) fn from(writer: &str, number: u64) -> Header {
    let camera = Camera { width: 4, height: 3, fx: 5.0, fy: 5.0, cx: 1.5, cy: 1.0 };
    let mut header = Header { epoch: 1, sequence: number, number, camera, depth_scale: 0.001, ..Header::default() };
    header.add_hop(Hop { stage: Text::new(writer), ..Hop::default() });
    header
}

fn end_of(writer: &str, count: u64) -> Header {
    end_of_stream(&from(writer, 0), Text::new(writer), count)
}

pub(super) fn topic(name: &str, writers: &[&str], reader: &str, delivery: Delivery) -> Topic {
    let readers = vec![TopicReader { stage: reader.to_owned(), delivery, queue: 20 }];
    let writers = writers.iter().map(|writer| (*writer).to_owned()).collect();
    Topic { name: name.to_owned(), item: None, writers, readers }
}

/// Ends at once what a test has begun, also where that fails.
struct AtOnce(Stop);

impl Drop for AtOnce {
    fn drop(&mut self) {
        self.0.force();
    }
}

/// Waits until this is so.
fn until(mut is_so: impl FnMut() -> bool) -> bool {
    let deadline = Instant::now() + Duration::from_secs(10);
    while Instant::now() < deadline {
        if is_so() {
            return true;
        }
        thread::sleep(Duration::from_millis(1));
    }
    false
}

/// The run of one stage, whose messages are kept.
pub(super) struct Trial {
    folder: TempDir,
    memory: InMemory,
    stage: String,
    stop: Stop,
    /// What it knows of other stages.
    life: fn(&str) -> Option<Life>,
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

    /// What a viewer reads.
    fn output(&self) -> Topic {
        topic("out", &[&self.stage], "viewer", Delivery::Latest)
    }

    pub(super) fn runtime(&self, wiring: Wiring) -> StageRuntime<InMemory> {
        let (transport, peers, base) = (self.memory.clone(), Peers::modelled(self.life), self.folder.path().to_owned());
        let context = Context { stage: self.stage.clone(), stop: self.stop.clone(), base, ..Context::default() };
        let record = StatusFile::open(&status_path(self.folder.path(), &self.stage), RUN).unwrap();
        let (handover, pause) = (Some(self.handover()), Pause::default());
        StageRuntime { transport, wiring, context, peers, record, handover, successor: None, pause, lock: None }
    }

    fn handover(&self) -> Handover {
        Handover::of(self.folder.path(), &self.stage)
    }

    fn record(&self) -> Box<Status> {
        Box::new(Status::read(&status_path(self.folder.path(), &self.stage)).unwrap())
    }

    /// Whether no process has written anything into the record.
    fn is_unwritten(&self) -> bool {
        Status::read(&status_path(self.folder.path(), &self.stage)).is_none()
    }

    fn has_done(&self, steps: u64) -> bool {
        !self.is_unwritten() && self.record().steps == steps
    }

    fn counter(&self, name: &str) -> u64 {
        used(&self.record().counters).find(|(own, _)| *own == name).map_or(0, |(_, count)| count)
    }

    pub(super) fn writer(&self, topic: &Topic) -> MemoryWriter {
        self.memory.writer::<Object>(topic).unwrap()
    }

    fn viewer(&self) -> MemoryReader {
        self.memory.reader::<Object>(&self.output(), "viewer").unwrap()
    }

    /// Runs the stage until it ends by itself, and does something else meanwhile.
    fn run<R>(&self, wiring: Wiring, meanwhile: impl FnOnce() -> R) -> (Result<(), RunError>, R) {
        self.run_after::<Passing, R>(wiring, None, meanwhile)
    }

    /// The same of a process that replaces another.
    fn run_after<S: Stage, R>(
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

    fn run_source<R>(
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

/// Sends messages of one ball when the reader is there.
fn send(writer: &mut MemoryWriter, headers: impl IntoIterator<Item = Header>) {
    assert!(until(|| !writer.connected().is_empty()));
    for header in headers {
        send_items(writer, header, &[ball()][..usize::from(!header.ends_stream())]);
    }
}

pub(super) fn send_items(writer: &mut MemoryWriter, header: Header, items: &[Object]) {
    writer.loan(items.len()).unwrap().copy_from_slice(items);
    writer.send(&header).unwrap();
}

/// The numbers of the messages that have come, and whether the end has.
fn taken(viewer: &mut MemoryReader) -> (Vec<u64>, bool) {
    let messages = std::iter::from_fn(|| viewer.receive().unwrap());
    let (ends, messages): (Vec<_>, Vec<_>) = messages.partition(|message| message.header().ends_stream());
    (messages.iter().map(|message| message.header().number).collect(), !ends.is_empty())
}

/// The same of what comes until the end does.
fn taken_until_end(mut viewer: MemoryReader) -> Vec<u64> {
    let mut all = Vec::new();
    assert!(until(|| {
        let (numbers, has_ended) = taken(&mut viewer);
        all.extend(numbers);
        has_ended
    }));
    all
}

fn mark(number: u64) -> Watermark {
    Watermark { numbers: [(Text::new("upstream"), number)].into(), ..Watermark::default() }
}

#[test]
fn the_record_of_a_stage_tells_what_came_what_was_sent_and_how_long_it_took() {
    let trial = Trial::of("stage");
    let (input, output) = (trial.input(Delivery::Lossless), trial.output());
    let (mut writer, viewer) = (trial.writer(&input), trial.viewer());
    let wiring = Wiring { input: Some(input), output: Some(output), ..Wiring::default() };
    let (result, sent) = trial.run(wiring, || {
        send(&mut writer, (0..3).map(|number| from("upstream", number)).chain([end_of("upstream", 3)]));
        taken_until_end(viewer)
    });
    result.unwrap();
    assert_eq!((sent, writer.unfinished("stage")), (vec![0, 1, 2], 0));
    let record = trial.record();
    assert_eq!((record.life(), record.had_enough, record.steps, record.sent), (Life::Ended, 0, 3, 3));
    assert_eq!(record.inputs[0].received, 3);
    assert_eq!([record.compute.count(), record.hop.count(), record.latency.count()], [3; 3]);
    assert_eq!(used(&record.found).collect::<Vec<_>>(), [("sphere", 3)]);
}

#[test]
fn a_process_writes_itself_into_the_record_which_goes_on_with_each_start() {
    let trial = Trial::of("stage");
    let mut runtimes = [(); 2].map(|()| trial.runtime(Wiring { frames: Some(5), ..Wiring::default() }));
    runtimes[0].record.status.set_life(Life::Gone);
    runtimes[0].enter();
    let record = trial.record();
    assert_eq!((record.process, record.starts, record.life()), (std::process::id(), 1, Life::Starting));
    assert_eq!(record.stage, Text::new("stage"));
    runtimes[0].begin(Some(9));
    assert_eq!((trial.record().life(), trial.record().total), (Life::Running, 5));
    runtimes[1].enter();
    assert_eq!((trial.record().starts, trial.record().total), (2, 5));
}

#[test]
fn the_side_inputs_of_a_stage_are_told_apart_by_name_and_finished_with_the_step() {
    let trial = Trial::of("stage");
    let input = trial.input(Delivery::Lossless);
    let sides =
        ["partner", "newest"].map(|name| (name.to_owned(), topic(name, &["side"], "stage", Delivery::Lossless)));
    let [mut writer, mut partner, mut newest] = [&input, &sides[0].1, &sides[1].1].map(|topic| trial.writer(topic));
    let wiring = Wiring { input: Some(input), side_inputs: sides.into(), ..Wiring::default() };
    let (result, ()) = trial.run(wiring, || {
        assert!(until(|| [&writer, &partner, &newest].iter().all(|writer| !writer.connected().is_empty())));
        for number in 0..2 {
            send_items(&mut partner, from("upstream", number), &[ball()]);
            send_items(&mut newest, from("upstream", number), &[ball(); 2]);
        }
        send(&mut writer, [from("upstream", 0), from("upstream", 1), end_of("upstream", 2)]);
    });
    result.unwrap();
    assert_eq!(["partner", "newest"].map(|name| trial.counter(name)), [2, 4]);
    let record = trial.record();
    assert_eq!([0, 1, 2].map(|input| record.inputs[input].topic.to_string()), ["in", "newest", "partner"]);
    assert_eq!(record.inputs[2].received, 2);
}

#[test]
fn a_stage_ends_when_each_stage_before_it_has_said_so_or_is_gone() {
    let trial = Trial { life: |stage| (stage == "killed").then_some(Life::Gone), ..Trial::of("stage") };
    let input = topic("in", &["killed", "upstream"], "stage", Delivery::Lossless);
    let (mut writer, viewer) = (trial.writer(&input), trial.viewer());
    let wiring = Wiring { input: Some(input), output: Some(trial.output()), ..Wiring::default() };
    let (result, sent) = trial.run(wiring, || {
        send(&mut writer, [from("killed", 0), from("upstream", 0)]);
        assert!(until(|| trial.has_done(2)));
        assert_eq!(trial.record().life(), Life::Running, "one of them is at work");
        send(&mut writer, [end_of("upstream", 1)]);
        taken_until_end(viewer)
    });
    result.unwrap();
    assert_eq!(sent, [0, 1]);
    assert_eq!((trial.record().life(), trial.record().had_enough), (Life::Ended, 0));
}

#[test]
fn a_stage_that_is_to_leave_works_on_what_its_successor_does_not_get_and_tells_no_end() {
    let trial = Trial::of("stage");
    let input = trial.input(Delivery::Lossless);
    let (mut writer, mut viewer) = (trial.writer(&input), trial.viewer());
    let wiring = Wiring { input: Some(input), output: Some(trial.output()), ..Wiring::default() };
    let (mut next, _launcher) = successor(trial.folder.path(), "stage");
    next.is_ready(&mark(2)).unwrap();
    trial.stop.leave();
    let (result, ()) = trial.run(wiring, || send(&mut writer, (0..4).map(|number| from("upstream", number))));
    result.unwrap();
    assert_eq!(taken(&mut viewer), (vec![0, 1], false));
    assert_eq!(trial.handover().last().unwrap().numbers, mark(1).numbers);
    assert_eq!((trial.record().life(), trial.record().steps), (Life::Running, 2));
    assert_eq!(writer.unfinished("stage"), 2);
}

#[test]
fn a_stage_that_is_to_leave_when_its_input_has_ended_ends_itself() {
    let trial = Trial::of("stage");
    let input = trial.input(Delivery::Lossless);
    let (mut writer, viewer) = (trial.writer(&input), trial.viewer());
    let wiring = Wiring { input: Some(input), output: Some(trial.output()), ..Wiring::default() };
    let (mut next, _launcher) = successor(trial.folder.path(), "stage");
    next.is_ready(&mark(9)).unwrap();
    trial.stop.leave();
    let (result, sent) = trial.run(wiring, || {
        send(&mut writer, [from("upstream", 0), end_of("upstream", 1)]);
        taken_until_end(viewer)
    });
    result.unwrap();
    assert_eq!((sent, trial.record().life()), (vec![0], Life::Ended));
    assert_eq!(trial.handover().last(), None);
}

#[test]
fn a_stage_that_is_to_leave_when_the_run_ends_ends_itself() {
    let trial = Trial::of("stage");
    let input = trial.input(Delivery::Lossless);
    let (mut writer, viewer) = (trial.writer(&input), trial.viewer());
    let wiring = Wiring { input: Some(input), output: Some(trial.output()), ..Wiring::default() };
    let (mut next, _launcher) = successor(trial.folder.path(), "stage");
    next.is_ready(&mark(9)).unwrap();
    trial.stop.leave();
    let (result, sent) = trial.run(wiring, || {
        send(&mut writer, [from("upstream", 0)]);
        assert!(until(|| trial.has_done(1)));
        trial.stop.request();
        taken_until_end(viewer)
    });
    result.unwrap();
    assert_eq!((sent, trial.record().life(), trial.handover().last()), (vec![0], Life::Ended, None));
}

#[test]
fn a_stage_that_is_asked_to_end_has_had_enough_and_one_that_is_stopped_at_once_tells_no_end() {
    let trial = Trial::of("stage");
    let wiring =
        || Wiring { input: Some(trial.input(Delivery::Lossless)), output: Some(trial.output()), ..Wiring::default() };
    trial.stop.request();
    let viewer = trial.viewer();
    let (result, sent) = trial.run(wiring(), || taken_until_end(viewer));
    result.unwrap();
    assert_eq!((sent, trial.record().life(), trial.record().had_enough), (vec![], Life::Ended, 1));
    trial.stop.force();
    let mut viewer = trial.viewer();
    let (result, ()) = trial.run(wiring(), || ());
    result.unwrap();
    assert_eq!((taken(&mut viewer), trial.record().life()), ((vec![], false), Life::Running));
}

#[test]
fn only_a_failure_that_lasts_is_noted_in_the_record_so_that_nobody_starts_the_stage_anew() {
    let failure = |stage: &str| {
        let trial = Trial::of(stage);
        let input = trial.input(Delivery::Lossless);
        let mut writer = trial.writer(&input);
        let wiring = Wiring { input: Some(input), ..Wiring::default() };
        let (result, ()) = trial.run(wiring, || send(&mut writer, [from("upstream", 4)]));
        (matches!(result.unwrap_err(), RunError::Lasting { frame: 4, .. }), trial.record().life())
    };
    assert_eq!(["full", "failing"].map(failure), [(true, Life::Gone), (false, Life::Running)]);
}

#[test]
fn a_message_that_two_processes_died_of_is_finished_when_it_is_left_out() {
    let trial = Trial::of("stage");
    let input = trial.input(Delivery::Lossless);
    let mut writer = trial.writer(&input);
    let mut killed = trial.memory.reader::<Object>(&input, "stage").unwrap();
    (0..2).for_each(|_| _ = killed.begin(Text::new("upstream"), 0));
    drop(killed);
    let wiring = Wiring { input: Some(input), ..Wiring::default() };
    let (result, ()) = trial.run(wiring, || {
        send(&mut writer, [from("upstream", 0)]);
        assert!(until(|| writer.unfinished("stage") == 0));
        assert_eq!((trial.record().inputs[0].dropped, trial.record().steps), (1, 0));
        send(&mut writer, [from("upstream", 1), end_of("upstream", 2)]);
    });
    result.unwrap();
    assert_eq!((trial.record().inputs[0].received, trial.record().steps), (1, 1));
}

/// Waits until a successor says that it is ready.
fn is_ready(launcher: &mut UnixStream, patience: Duration) -> bool {
    launcher.set_read_timeout(Some(patience)).unwrap();
    launcher.read(&mut [0]).is_ok_and(|length| length == 1)
}

const LONG: Duration = Duration::from_secs(10);
const SHORT: Duration = Duration::from_millis(100);

#[test]
fn a_successor_is_ready_when_it_has_heard_each_writer_and_goes_on_after_its_predecessor() {
    let trial = Trial { life: |stage| (stage == "over").then_some(Life::Ended), ..Trial::of("stage") };
    let input = topic("in", &["upstream", "other", "over"], "stage", Delivery::Lossless);
    let (mut writer, viewer) = (trial.writer(&input), trial.viewer());
    let wiring = Wiring { input: Some(input), output: Some(trial.output()), ..Wiring::default() };
    let (next, mut launcher) = successor(trial.folder.path(), "stage");
    let (result, sent) = trial.run_after::<Passing, _>(wiring, Some(next), || {
        send(&mut writer, (3..6).map(|number| from("upstream", number)));
        assert!(!is_ready(&mut launcher, SHORT), "the other one has sent nothing");
        send(&mut writer, [from("other", 0)]);
        assert!(is_ready(&mut launcher, LONG));
        let first = ["upstream", "other"].map(Text::new).into_iter().zip([3, 0]).collect();
        assert_eq!(trial.handover().first().numbers, first);
        trial.handover().leave(&mark(4)).unwrap();
        assert!(trial.is_unwritten(), "it has not taken its place yet");
        launcher.write_all(b"t").unwrap();
        send(&mut writer, [end_of("upstream", 6), end_of("other", 1)]);
        taken_until_end(viewer)
    });
    result.unwrap();
    assert_eq!((sent.len(), trial.record().steps, trial.record().starts), (2, 2, 1));
    assert_eq!((trial.record().inputs[0].late, trial.record().inputs[0].dropped), (0, 0));
}

#[test]
fn a_successor_whose_predecessor_was_killed_works_on_all_that_was_not_finished() {
    let trial = Trial::of("stage");
    let input = trial.input(Delivery::Lossless);
    let mut writer = trial.writer(&input);
    let mut killed = trial.memory.reader::<Object>(&input, "stage").unwrap();
    send(&mut writer, (0..3).map(|number| from("upstream", number)));
    killed.acknowledge(Text::new("upstream"), 1);
    drop(killed);
    let mut record = StatusFile::open(&status_path(trial.folder.path(), "stage"), RUN).unwrap();
    record.status.steps = 1;
    record.status.inputs[0] = InputCounts { topic: Text::new("in"), received: 1, ..InputCounts::default() };
    record.write();
    let wiring = Wiring { input: Some(input), ..Wiring::default() };
    let (next, mut launcher) = successor(trial.folder.path(), "stage");
    let (result, ()) = trial.run_after::<Passing, _>(wiring, Some(next), || {
        send(&mut writer, [from("upstream", 3)]);
        assert!(is_ready(&mut launcher, LONG));
        launcher.write_all(b"t").unwrap();
        assert!(until(|| {
            writer.catch_up();
            trial.has_done(4)
        }));
        send(&mut writer, [end_of("upstream", 4)]);
    });
    result.unwrap();
    assert_eq!((writer.unfinished("stage"), trial.record().inputs[0].received), (0, 4));
}

#[test]
fn a_successor_for_which_nothing_is_kept_works_on_what_it_has_heard_where_its_predecessor_was_killed() {
    let trial = Trial::of("stage");
    let input = trial.input(Delivery::Latest);
    let mut writer = trial.writer(&input);
    let wiring = Wiring { input: Some(input), ..Wiring::default() };
    let (next, mut launcher) = successor(trial.folder.path(), "stage");
    let (result, ()) = trial.run_after::<Passing, _>(wiring, Some(next), || {
        send(&mut writer, [from("upstream", 5)]);
        assert!(is_ready(&mut launcher, LONG));
        launcher.write_all(b"t").unwrap();
        assert!(until(|| trial.has_done(1)));
        send(&mut writer, [end_of("upstream", 6)]);
    });
    result.unwrap();
}

#[test]
fn a_successor_waits_for_the_first_message_for_a_second_or_as_long_as_it_takes_where_none_may_be_lost() {
    let is_ready_at_once_and_then = |delivery| {
        let trial = Trial::of("stage");
        let wiring = Wiring { input: Some(trial.input(delivery)), ..Wiring::default() };
        let (next, mut launcher) = successor(trial.folder.path(), "stage");
        let (result, ready) = trial.run_after::<Passing, _>(wiring, Some(next), || {
            let ready = [SHORT, Duration::from_millis(1500)].map(|patience| is_ready(&mut launcher, patience));
            drop(launcher);
            ready
        });
        result.unwrap();
        assert!(trial.is_unwritten(), "it was not wanted any more");
        ready
    };
    thread::scope(|scope| {
        let lossless = scope.spawn(|| is_ready_at_once_and_then(Delivery::Lossless));
        assert_eq!(is_ready_at_once_and_then(Delivery::Latest), [false, true]);
        assert_eq!(lossless.join().unwrap(), [false, false]);
    });
}

#[test]
fn a_successor_takes_no_message_of_which_a_side_input_lacks_its_part() {
    let is_ready_with = |side_delivery, life: fn(&str) -> Option<Life>| {
        let trial = Trial { life, ..Trial::of("stage") };
        let input = trial.input(Delivery::Lossless);
        let side = topic("side", &["side"], "stage", side_delivery);
        let [mut writer, mut partner] = [&input, &side].map(|topic| trial.writer(topic));
        let wiring =
            Wiring { input: Some(input), side_inputs: vec![("partner".to_owned(), side)], ..Wiring::default() };
        let (next, mut launcher) = successor(trial.folder.path(), "stage");
        let (result, ready) = trial.run_after::<Passing, _>(wiring, Some(next), || {
            send(&mut writer, [from("upstream", 4)]);
            let before = is_ready(&mut launcher, SHORT);
            send_items(&mut partner, from("upstream", 5), &[ball()]);
            send(&mut writer, [from("upstream", 5)]);
            let then = before || is_ready(&mut launcher, LONG);
            let first = trial.handover().first().numbers[&Text::new("upstream")];
            drop(launcher);
            (before, then, first)
        });
        result.unwrap();
        ready
    };
    for delivery in [Delivery::Lossless, Delivery::Latest] {
        assert_eq!(is_ready_with(delivery, |_| None), (false, true, 5));
        let over = |stage: &str| (stage == "side").then_some(Life::Ended);
        assert_eq!(is_ready_with(delivery, over), (true, true, 4), "nothing more comes of it");
    }
}

#[test]
fn a_source_records_what_it_made_and_ends() {
    let trial = Trial::of("source");
    let wiring = Wiring { output: Some(trial.output()), ..Wiring::default() };
    let viewer = trial.viewer();
    let (result, sent) = trial.run_source(wiring, None, || taken_until_end(viewer));
    result.unwrap();
    assert_eq!(sent, [0, 1, 2]);
    let record = trial.record();
    assert_eq!((record.life(), record.steps, record.sent, record.total), (Life::Ended, 3, 3, 3));
    assert_eq!(record.compute.count(), 3);
    assert_eq!(used(&record.found).collect::<Vec<_>>(), [("sphere", 3)]);
    assert_eq!(trial.counter("none left"), 1, "what the last step counted, which made nothing, is kept, too");
}

#[test]
fn a_source_that_cannot_end_its_work_ends_its_stream_and_is_not_started_anew() {
    let trial = Trial::of("failing");
    let wiring = Wiring { output: Some(trial.output()), ..Wiring::default() };
    let viewer = trial.viewer();
    let (result, sent) = trial.run_source(wiring, None, || taken_until_end(viewer));
    assert!(matches!(result, Err(RunError::Unfinished(_))));
    assert_eq!((sent.len(), trial.record().life()), (3, Life::Gone));
}

#[test]
fn a_source_that_leaves_its_place_or_is_stopped_at_once_tells_no_end() {
    for (end, made) in [(Stop::leave as fn(&Stop), 3), (Stop::force, 0)] {
        let trial = Trial::of("source");
        let wiring = Wiring { output: Some(trial.output()), ..Wiring::default() };
        let mut viewer = trial.viewer();
        end(&trial.stop);
        trial.run_source(wiring, None, || ()).0.unwrap();
        let (numbers, has_ended) = taken(&mut viewer);
        assert_eq!((numbers.len(), has_ended, trial.record().life()), (made, false, Life::Running));
    }
}

#[test]
fn a_source_that_replaces_another_makes_nothing_before_its_turn_and_goes_on_behind_that() {
    let trial = Trial::of("source");
    let wiring = || Wiring { output: Some(trial.output()), ..Wiring::default() };
    let (next, mut launcher) = successor(trial.folder.path(), "source");
    let mut viewer = trial.viewer();
    let mut record = StatusFile::open(&status_path(trial.folder.path(), "source"), RUN).unwrap();
    let (result, sent) = trial.run_source(wiring(), Some(next), || {
        assert!(is_ready(&mut launcher, LONG));
        assert_eq!(taken(&mut viewer), (vec![], false));
        record.status.sent = 2;
        record.write();
        launcher.write_all(b"t").unwrap();
        taken_until_end(viewer)
    });
    result.unwrap();
    assert_eq!((sent, trial.record().starts, trial.record().sent), (vec![2], 1, 3));
    let (next, mut launcher) = successor(trial.folder.path(), "source");
    let mut viewer = trial.viewer();
    let (result, ()) = trial.run_source(wiring(), Some(next), || {
        assert!(is_ready(&mut launcher, LONG));
        drop(launcher);
    });
    result.unwrap();
    assert_eq!((taken(&mut viewer), trial.record().starts), ((vec![], false), 1), "it was not wanted any more");
}

#[test]
fn a_source_that_was_started_anew_warns_where_it_had_nothing_more_to_make() {
    let warns = |stage: &str, sent: u64, frames: Option<u64>, is_stopped: bool| {
        let trial = Trial::of(stage);
        let mut runtime = trial.runtime(Wiring { frames, ..Wiring::default() });
        runtime.record.status.sent = sent;
        if is_stopped {
            trial.stop.request();
        }
        let new = NewSource::of::<Making>(json!({})).unwrap();
        logged(Level::WARN, || run_source(&new, runtime).unwrap()).contains("ends with nothing made")
    };
    assert!(warns("source", 3, None, false) && warns("source", 3, Some(9), false));
    assert!(!warns("source", 2, None, false), "it has made one");
    assert!(!warns("source", 3, Some(3), false), "no more were wanted");
    assert!(!warns("source", 3, None, true), "it was stopped");
    assert!(!warns("empty", 0, None, false), "it is the first");
}

#[test]
fn a_run_that_ends_while_something_is_sent_is_no_fault_and_all_else_is() {
    assert!(!is_stopped(Ok(())).unwrap());
    assert!(is_stopped(Err(PortError::Stopped)).unwrap());
    let fault = PortError::TooManyOnlookers { topic: "objects".to_owned(), limit: 8 };
    assert!(is_stopped(Err(fault)).is_err());
}

#[test]
fn a_source_reads_its_side_inputs_before_each_message_and_finishes_what_it_has_read() {
    let trial = Trial::of("source");
    let side = topic("side", &["side"], "source", Delivery::Lossless);
    let mut writer = trial.writer(&side);
    // Its stream begins when somebody looks at it.
    let wiring =
        Wiring { side_inputs: vec![("newest".to_owned(), side)], output: Some(trial.output()), ..Wiring::default() };
    let (result, ()) = trial.run_source(wiring, None, || {
        send(&mut writer, [from("side", 0), from("side", 1)]);
        taken_until_end(trial.viewer());
    });
    result.unwrap();
    assert_eq!((trial.record().inputs[0].received, writer.unfinished("source")), (1, 0));
    assert!(trial.counter("newest") >= 3, "in the first step that follows, and in all others");
}

#[test]
fn a_source_that_keeps_to_its_stamps_sends_as_far_apart_as_these_are() {
    let trial = Trial::of("stamped");
    let begin = Instant::now();
    let (result, ()) = trial.run_source(Wiring::default(), None, || ());
    result.unwrap();
    assert!(begin.elapsed() >= 2 * STAMPS_APART);
    assert_eq!(trial.record().steps, 3);
}

#[test]
fn a_stage_that_is_to_replace_another_is_made_ready_before_and_a_sink_anew_in_its_place() {
    fn made<S: Stage>() -> [usize; 2] {
        let trial = Trial::of("stage");
        let input = trial.input(Delivery::Lossless);
        let mut writer = trial.writer(&input);
        let wiring = Wiring { input: Some(input), ..Wiring::default() };
        let (next, mut launcher) = successor(trial.folder.path(), "stage");
        let made = || fs::read(trial.folder.path().join("made")).unwrap().len();
        let (result, before) = trial.run_after::<S, _>(wiring, Some(next), || {
            send(&mut writer, [from("upstream", 0)]);
            assert!(is_ready(&mut launcher, LONG));
            let before = made();
            trial.handover().leave(&Watermark::default()).unwrap();
            launcher.write_all(b"t").unwrap();
            send(&mut writer, [end_of("upstream", 1)]);
            before
        });
        result.unwrap();
        [before, made()]
    }
    assert_eq!((made::<Passing>(), made::<Taking>()), ([1, 1], [1, 2]));
}

#[test]
fn a_stage_that_cannot_be_made_ready_never_takes_a_place() {
    let trial = Trial::of("refused");
    let wiring = Wiring { input: Some(trial.input(Delivery::Latest)), ..Wiring::default() };
    let (next, mut launcher) = successor(trial.folder.path(), "refused");
    let (result, ready) = trial.run_after::<Passing, _>(wiring, Some(next), || is_ready(&mut launcher, LONG));
    assert!(matches!(result, Err(RunError::Refused(_))) && !ready && trial.is_unwritten());
}
