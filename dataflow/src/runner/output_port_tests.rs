//! Tests of an output: which readers it waits for, what it counts, and how it ends its stream.

use super::output_port::{EndAnnouncement, OutputPort, PATIENCE_WITH_LIVE_READERS, end_of_stream};
use super::peers::Peers;
use super::place_trial::AtOnce;
use crate::clock::until;
use crate::heartbeat::Heartbeat;
use crate::item_type::ItemType;
use crate::log::tests::logged;
use crate::ports::in_memory::{InMemory, MemoryReader, MemoryWriter};
use crate::ports::{Delivery, PortError, Reader, Received, Topic, TopicReader, Transport};
use crate::stage::Output;
use crate::status::{Life, Status, used};
use crate::stop::Stop;
use bytemuck::cast_slice;
use conicflow_messages::{Camera, Header, Hop, Object, Text};
use std::fs::File;
use std::iter::from_fn;
use std::os::unix::fs::FileExt;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};
use tracing::Level;

/// Queue length of a reader.
const QUEUE: usize = 2;

/// An output, its topic, and the memory.
struct Trial {
    memory: InMemory,
    topic: Topic,
    output_port: OutputPort<MemoryWriter>,
    stop: Stop,
}

impl Trial {
    /// The output of a stage that has sent `sent` messages before, with these readers.
    fn new(readers: &[(&str, Delivery)], sent: u64) -> Self {
        Self::among(Peers::default(), readers, sent)
    }

    fn among(peers: Peers, readers: &[(&str, Delivery)], sent: u64) -> Self {
        let stop = Stop::default();
        let memory = InMemory::new(stop.clone()).keeping();
        let reader = |(stage, delivery): &(&str, Delivery)| TopicReader {
            stage: (*stage).to_owned(),
            delivery: *delivery,
            queue: QUEUE,
        };
        let readers = readers.iter().map(reader).collect();
        let topic = Topic { name: "objects".into(), item: None, writers: vec!["stage".into()], readers };
        let port = Some((memory.writer::<Object>(&topic).unwrap(), topic.clone()));
        let output_port = OutputPort::new(port, "stage", sent, peers, stop.clone());
        Self { memory, topic, output_port, stop }
    }

    fn reader(&self, stage: &str) -> MemoryReader {
        self.memory.reader::<Object>(&self.topic, stage).unwrap()
    }

    /// Sends an empty list.
    fn send(&mut self) -> Result<(), PortError> {
        self.output_port.send(header(), 0, Some(&[]))
    }
}

fn header() -> Header {
    let camera = Camera { width: 2, height: 2, fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5 };
    Header { camera, depth_scale: 0.001, ..Header::default() }
}

/// Header of a message of a stage of another machine.
fn written_by(writer: &str, number: u64) -> Header {
    let mut header = Header { number, sequence: number, ..header() };
    header.add_hop(Hop { stage: Text::new(writer), ..Hop::default() });
    header
}

#[test]
fn a_source_is_told_once_what_it_most_likely_did_not_mean_and_who_passes_it_on_is_not() {
    let mut trial = Trial::new(&[], 0);
    let without_camera = Header { camera: Camera::default(), ..header() };
    let told = |header: Header, trial: &mut Trial| {
        logged(Level::WARN, || trial.output_port.send(header, 0, Some(&[])).unwrap())
    };
    let passed_on = Header { camera: Camera::default(), ..written_by("source", 0) };
    assert_eq!(told(passed_on, &mut trial), "");
    let first = told(without_camera, &mut trial);
    assert!(
        first.contains("stage `stage` sends messages that no reader takes: malformed objects: an image of 0x0"),
        "{first}"
    );
    assert_eq!(told(without_camera, &mut trial), "");
}

/// Numbers of the messages in the queue of this reader.
fn waiting(reader: &mut MemoryReader) -> Vec<u64> {
    from_fn(|| reader.receive().unwrap()).map(|message| message.header().number).collect()
}

/// Ends of streams in the queue of this reader: writer, and number of its messages.
fn ends(reader: &mut MemoryReader) -> Vec<(String, u64)> {
    let ends = from_fn(|| reader.receive().unwrap()).filter(|message| message.header().ends_stream());
    ends.map(|end| (end.header().trace()[0].stage.to_string(), end.header().number)).collect()
}

#[test]
fn the_first_message_waits_for_all_readers_and_those_that_follow_for_those_that_must_not_miss_one() {
    // At the end of a run a waiting writer gives up and does not send.
    let waits = |delivery, sent, is_there| {
        let mut trial = Trial::new(&[("sink", delivery)], sent);
        let _reader = Some(trial.reader("sink")).filter(|_| is_there);
        trial.stop.request();
        match trial.send() {
            Ok(()) => false,
            Err(PortError::Stopped) => true,
            Err(error) => panic!("{error}"),
        }
    };
    for (delivery, sent, expected) in
        [(Delivery::Lossless, 0, true), (Delivery::Lossless, 3, true), (Delivery::Latest, 0, true)]
    {
        assert_eq!([false, true].map(|is_there| waits(delivery, sent, is_there)), [expected, false]);
    }
    assert!(!waits(Delivery::Latest, 3, false));
}

#[test]
fn a_reader_that_has_ended_is_not_waited_for() {
    let mut trial = Trial::among(Peers::modelled(|_| Some(Life::Ended)), &[("sink", Delivery::Lossless)], 0);
    trial.stop.request();
    trial.send().unwrap();
}

#[test]
fn what_was_to_be_sent_is_sent_when_the_reader_comes_that_was_waited_for() {
    let mut trial = Trial::new(&[("sink", Delivery::Lossless)], 0);
    let record = watched(&trial);
    let (memory, topic, stop) = (trial.memory.clone(), trial.topic.clone(), trial.stop.clone());
    thread::scope(|scope| {
        let _end = AtOnce(stop.clone());
        let sending = scope.spawn(|| trial.send());
        assert!(until(|| waits_for(&record) == "sink"));
        let mut reader = memory.reader::<Object>(&topic, "sink").unwrap();
        sending.join().unwrap().unwrap();
        assert_eq!(waiting(&mut reader), [0]);
    });
}

#[test]
fn who_waits_for_a_reader_for_a_moment_warns_nobody() {
    let mut trial = Trial::new(&[("sink", Delivery::Lossless)], 3);
    let record = watched(&trial);
    let (memory, topic, stop) = (trial.memory.clone(), trial.topic.clone(), trial.stop.clone());
    thread::scope(|scope| {
        let _end = AtOnce(stop);
        let reading = scope.spawn(move || {
            assert!(until(|| waits_for(&record) == "sink"));
            memory.reader::<Object>(&topic, "sink").unwrap()
        });
        assert_eq!(logged(Level::WARN, || trial.send().unwrap()), "");
        assert_eq!(waiting(&mut reading.join().unwrap()), [3]);
    });
}

#[test]
fn a_reader_has_no_more_unfinished_messages_than_are_kept_for_it() {
    let mut trial = Trial::new(&[("sink", Delivery::Lossless), ("viewer", Delivery::Latest)], 0);
    let [mut reader, _viewer] = ["sink", "viewer"].map(|stage| trial.reader(stage));
    trial.stop.force();
    // The messages in the queue, and one being processed.
    (0..=QUEUE).for_each(|_| trial.send().unwrap());
    assert_eq!(trial.output_port.unfinished(), QUEUE + 1);
    assert!(matches!(trial.send(), Err(PortError::Stopped)), "it would wait");
    assert_eq!(waiting(&mut reader), [0, 1, 2]);
    assert!(trial.send().is_err(), "it has taken them, and finished none");
    reader.acknowledge(Text::new("stage"), 1);
    trial.send().unwrap();
    assert!(trial.send().is_err());
    reader.acknowledge(Text::new("stage"), 4);
    assert_eq!(trial.output_port.unfinished(), 0);
}

#[test]
fn what_a_reader_that_has_ended_did_not_finish_is_nobodys() {
    static IS_OVER: AtomicBool = AtomicBool::new(false);
    let life = |_: &str| Some(if IS_OVER.load(Ordering::Relaxed) { Life::Ended } else { Life::Running });
    let mut trial = Trial::among(Peers::modelled(life), &[("sink", Delivery::Lossless)], 0);
    let reader = trial.reader("sink");
    (0..=QUEUE).for_each(|_| trial.send().unwrap());
    drop(reader);
    assert_eq!(trial.output_port.unfinished(), QUEUE + 1);
    IS_OVER.store(true, Ordering::Relaxed);
    assert_eq!(trial.output_port.unfinished(), 0);
    trial.send().unwrap();
}

/// The stage that this stage waits for, according to its record.
fn waits_for(record: &File) -> String {
    let mut told = [0; 32];
    record.read_at(&mut told, 8).unwrap();
    bytemuck::cast::<_, Text<32>>(told).to_string()
}

/// Returns the file in which the stage of this trial records which stage it waits for.
fn watched(trial: &Trial) -> File {
    let record = tempfile::tempfile().unwrap();
    record.set_len(64).unwrap();
    trial.stop.show_life_by(Heartbeat::new(record.try_clone().unwrap(), 0, 8));
    record
}

#[test]
fn a_stage_that_waits_for_a_reader_to_come_or_to_finish_something_tells_so() {
    let mut trial = Trial::new(&[("sink", Delivery::Lossless)], 0);
    let record = watched(&trial);
    trial.stop.request();
    assert!(trial.send().is_err());
    assert_eq!(waits_for(&record), "sink");
    let mut trial = Trial::new(&[("sink", Delivery::Lossless)], 0);
    let (record, stop, _reader) = (watched(&trial), trial.stop.clone(), trial.reader("sink"));
    (0..=QUEUE).for_each(|_| trial.send().unwrap());
    assert_eq!(waits_for(&record), "");
    thread::scope(|scope| {
        let _end = AtOnce(stop.clone());
        let sending = scope.spawn(|| trial.send());
        let is_reported = until(|| waits_for(&record) == "sink");
        stop.force();
        assert!(is_reported && sending.join().unwrap().is_err());
    });
}

#[test]
fn messages_are_numbered_on_from_where_an_earlier_process_left() {
    let mut trial = Trial::new(&[("sink", Delivery::Lossless)], 3);
    let mut reader = trial.reader("sink");
    trial.output_port.resume(7);
    (0..2).for_each(|_| trial.send().unwrap());
    assert_eq!(waiting(&mut reader), [7, 8]);
}

#[test]
fn a_reader_that_was_started_anew_is_handed_what_is_kept_before_there_is_anything_to_send() {
    let mut trial = Trial::new(&[("sink", Delivery::Lossless)], 0);
    let killed = trial.reader("sink");
    (0..2).for_each(|_| trial.send().unwrap());
    drop(killed);
    let mut next = trial.reader("sink");
    assert_eq!(waiting(&mut next), [0; 0]);
    trial.output_port.catch_up();
    assert_eq!(waiting(&mut next), [0, 1]);
}

#[test]
fn an_output_that_is_wired_to_nothing_sends_nothing_and_has_no_items() {
    let mut output_port = OutputPort::new(None::<(MemoryWriter, Topic)>, "stage", 3, Peers::default(), Stop::default());
    output_port.send(header(), 0, Some(&[0; 7])).unwrap();
    let mut status = Box::new(Status::default());
    output_port.tally(&mut status, 0);
    assert_eq!((status.sent, status.sent_bytes, output_port.item()), (3, 0, None));
    let trial = Trial::new(&[], 0);
    assert_eq!(trial.output_port.item().map(ItemType::name), Some("objects"));
}

#[test]
fn a_step_is_counted_once_and_logged_where_it_has_counted_anything() {
    let mut trial = Trial::new(&[("sink", Delivery::Latest)], 1);
    let (mut status, mut list) = (Box::new(Status::default()), Vec::<Object>::new());
    let mut step = |counts: &[(&'static str, u64)], frame: u64| {
        let mut output = Output::new(trial.output_port.untyped_output(header()), &mut list);
        output.count_all(counts.iter().copied());
        trial.send().unwrap();
        let log = logged(Level::DEBUG, || trial.output_port.tally(&mut status, frame));
        let counted: Vec<_> = used(&status.counters).map(|(name, count)| (name.to_owned(), count)).collect();
        (log, counted, status.intervals.mean_s().is_some())
    };
    let told = |name: &str, count| (name.to_owned(), count);
    let (log, counted, has_interval) = step(&[("too small", 2), ("too far", 1)], 5);
    assert!(log.contains("stage `stage`, frame 5: too far: 1, too small: 2"), "{log}");
    assert_eq!((counted, has_interval), (vec![told("too far", 1), told("too small", 2)], false));
    let (log, counted, has_interval) = step(&[], 6);
    assert!(log.is_empty(), "{log}");
    assert_eq!((counted, has_interval), (vec![told("too far", 1), told("too small", 2)], true));
    let (_, counted, _) = step(&[("too far", 3)], 7);
    assert_eq!(counted, [told("too far", 4), told("too small", 2)]);
    assert_eq!((status.sent, status.intervals.standard_deviation_s().is_some()), (4, true));
}

#[test]
fn the_end_is_told_when_all_that_was_sent_is_finished() {
    let mut trial = Trial::new(&[("sink", Delivery::Lossless)], 0);
    let mut reader = trial.reader("sink");
    (0..2).for_each(|_| trial.send().unwrap());
    assert_eq!(waiting(&mut reader), [0, 1]);
    let (record, stop) = (watched(&trial), trial.stop.clone());
    thread::scope(|scope| {
        let _end = AtOnce(stop.clone());
        let ending = scope.spawn(|| trial.output_port.end());
        assert!(until(|| waits_for(&record) == "sink"));
        assert_eq!(ends(&mut reader), [], "what is kept for a reader goes with this process");
        reader.acknowledge(Text::new("stage"), 2);
        let mut told = Vec::new();
        assert!(until(|| {
            told.extend(ends(&mut reader));
            !told.is_empty()
        }));
        assert_eq!(told, [("stage".to_owned(), 2)]);
        drop(reader);
        ending.join().unwrap().unwrap();
    });
}

#[test]
fn a_stage_that_is_stopped_at_once_tells_no_end_and_waits_for_nobody() {
    let mut trial = Trial::new(&[("sink", Delivery::Lossless)], 0);
    let mut reader = trial.reader("sink");
    trial.send().unwrap();
    trial.stop.force();
    trial.output_port.end().unwrap();
    assert_eq!(ends(&mut reader), []);
    assert_eq!(trial.output_port.unfinished(), 1);
}

#[test]
fn stages_of_another_machine_end_after_as_many_messages_as_each_is_known_to_have_sent() {
    let mut trial = Trial::new(&[("sink", Delivery::Latest)], 0);
    trial.topic.readers[0].queue = 9;
    let mut reader = trial.reader("sink");
    for header in [written_by("left", 0), written_by("right", 4), written_by("left", 1)] {
        trial.output_port.relay(&header, &[]).unwrap();
    }
    trial.output_port.note_count(Text::new("other"), 9);
    let (names, stop) = (["left", "right", "other", "silent"], trial.stop.clone());
    thread::scope(|scope| {
        let _end = AtOnce(stop.clone());
        let ending = scope.spawn(|| trial.output_port.end_as(&names.map(Text::new)));
        let mut told = Vec::new();
        assert!(until(|| {
            told.extend(ends(&mut reader));
            told.len() >= names.len()
        }));
        drop(reader);
        ending.join().unwrap().unwrap();
        let expected = names.map(str::to_owned).into_iter().zip([2, 5, 9, 0]);
        assert!(told.into_iter().eq(expected));
    });
}

#[test]
fn what_is_relayed_is_what_the_stage_of_the_other_machine_wrote() {
    let mut trial = Trial::new(&[("sink", Delivery::Lossless)], 3);
    let mut reader = trial.reader("sink");
    let objects = [Object { radius: 0.5, ..Object::default() }];
    trial.output_port.relay(&written_by("left", 8), cast_slice(&objects)).unwrap();
    let message = reader.receive().unwrap().unwrap();
    assert_eq!((message.header().number, message.header().trace().len()), (8, 1));
    assert_eq!(message.items::<Object>()[0].radius, 0.5);
    let mut status = Box::new(Status::default());
    trial.output_port.tally(&mut status, 0);
    assert_eq!(status.sent, 4);
}

/// Beside a lossless reader the others lose messages that do not fit into their queue, ends included.
#[test]
fn the_end_is_told_again_now_and_then_where_it_may_have_been_lost() {
    let told = |readers: &[(&str, Delivery)], present: &str| {
        let mut trial = Trial::new(readers, 0);
        let mut reader = trial.reader(present);
        let end = [end_of_stream(&header(), Text::new("stage"), 0)];
        let begin = Instant::now();
        let mut announcement = EndAnnouncement::until(begin);
        [0, 100, 101].map(|passed_ms| {
            let now = begin + Duration::from_millis(passed_ms);
            assert!(!trial.output_port.announce_end(&end, &mut announcement, now).unwrap(), "it is there");
            ends(&mut reader).len()
        })
    };
    let (all, newest) = (("sink", Delivery::Lossless), ("viewer", Delivery::Latest));
    assert_eq!(told(&[all, newest], "viewer"), [1, 0, 1]);
    assert_eq!(told(&[all, newest], "sink"), [1, 0, 0], "it loses nothing");
    assert_eq!(told(&[newest], "viewer"), [1, 0, 0], "its queue overflows, and keeps the newest");
}

#[test]
fn who_never_came_is_waited_for_until_the_deadline_and_who_has_not_finished_beyond_that() {
    let end = [end_of_stream(&header(), Text::new("stage"), 0)];
    let deadline = Instant::now();
    let times = [deadline, deadline + Duration::from_nanos(1)];
    let mut trial = Trial::new(&[("sink", Delivery::Latest)], 3);
    let mut is_over = |now| trial.output_port.announce_end(&end, &mut EndAnnouncement::until(deadline), now).unwrap();
    assert_eq!(times.map(&mut is_over), [false, true]);
    let mut trial = Trial::new(&[("sink", Delivery::Lossless)], 0);
    let killed = trial.reader("sink");
    trial.send().unwrap();
    drop(killed);
    let mut is_over = |now| trial.output_port.announce_end(&end, &mut EndAnnouncement::until(deadline), now).unwrap();
    assert_eq!(times.map(&mut is_over), [false, false]);
}

#[test]
fn who_ends_waits_for_a_while_for_a_reader_that_never_came() {
    let mut trial = Trial::new(&[("sink", Delivery::Latest)], 3);
    let stop = trial.stop.clone();
    thread::scope(|scope| {
        let _end = AtOnce(stop.clone());
        let begin = Instant::now();
        let ending = scope.spawn(|| trial.output_port.end());
        thread::sleep(Duration::from_millis(100));
        // On a machine that delays this test by that long, the wait may rightly be over.
        assert!(!ending.is_finished() || begin.elapsed() >= PATIENCE_WITH_LIVE_READERS);
        stop.force();
        ending.join().unwrap().unwrap();
    });
}
