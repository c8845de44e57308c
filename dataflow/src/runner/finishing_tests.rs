//! Tests of an input's acknowledgements, and of how the next process of its stage continues after them.

use super::handover::Watermark;
use super::input_port::{InputPort, Step};
use crate::ports::in_memory::{InMemory, MemoryReader, MemoryWriter};
use crate::ports::{Delivery, MAX_KEPT, Reader, Received, Topic, TopicReader, Transport, Writer};
use crate::runner::output_port::end_of_stream;
use crate::status::InputCounts;
use conicflow_messages::{Camera, Header, Hop, Object, Text};
use std::collections::BTreeMap;
use std::iter::from_fn;
use std::time::{Duration, Instant};

const WRITER: &str = "writer";

/// A topic whose writers keep the messages that its reader has not finished.
struct Kept {
    memory: InMemory,
    topic: Topic,
    writer: MemoryWriter,
}

impl Kept {
    fn by(writers: &[&str]) -> Self {
        Self::in_memory(InMemory::default().keeping(), writers)
    }

    fn in_memory(memory: InMemory, writers: &[&str]) -> Self {
        let readers = vec![TopicReader { stage: "reader".into(), delivery: Delivery::Lossless, queue: 40 }];
        let writers = writers.iter().map(|writer| (*writer).to_owned()).collect();
        let topic = Topic { name: "objects".into(), item: None, writers, readers };
        let writer = memory.writer::<Object>(&topic).unwrap();
        Self { memory, topic, writer }
    }

    /// A side input in a new process of the reading stage, which has received the kept messages.
    fn side_input(&mut self) -> InputPort<MemoryReader> {
        let reader = self.memory.reader::<Object>(&self.topic, "reader").unwrap();
        self.writer.catch_up();
        InputPort::new(reader, Delivery::Lossless, "objects", self.topic.writers.len())
    }

    /// A driving input in a new process of the reading stage, which has received the kept messages.
    fn input(&mut self) -> InputPort<MemoryReader> {
        let mut input_port = self.side_input();
        input_port.drive("reader");
        input_port
    }

    fn send(&mut self, headers: impl IntoIterator<Item = Header>) {
        headers.into_iter().for_each(|header| _ = self.writer.send(&header).unwrap());
    }

    /// Number of messages that its writer has to keep.
    fn unfinished(&self) -> usize {
        self.writer.unfinished("reader")
    }

    /// By writer: number of the first unfinished message.
    fn finished(&self) -> BTreeMap<String, u64> {
        let reader = self.memory.reader::<Object>(&self.topic, "reader").unwrap();
        reader.acknowledged().unwrap().into_iter().map(|(writer, next)| (writer.to_string(), next)).collect()
    }
}

/// Header of the message `number` of a writer that is also the source.
fn by(writer: &str, number: u64) -> Header {
    let camera = Camera { width: 4, height: 3, fx: 5.0, fy: 5.0, cx: 1.5, cy: 1.0 };
    let mut header = Header { epoch: 1, sequence: number, number, camera, depth_scale: 0.001, ..Header::default() };
    header.add_hop(Hop { stage: Text::new(writer), ..Hop::default() });
    header
}

fn message(number: u64) -> Header {
    by(WRITER, number)
}

fn take(input_port: &mut InputPort<MemoryReader>) -> Option<u64> {
    input_port.take().unwrap().map(|message| message.header().number)
}

fn take_all(input_port: &mut InputPort<MemoryReader>) -> Vec<u64> {
    from_fn(|| take(input_port)).collect()
}

fn buffered(input_port: &InputPort<MemoryReader>) -> Vec<u64> {
    input_port.buffered().map(|header| header.number).collect()
}

/// Received, dropped, gaps and late.
fn counted(counts: &InputCounts) -> [u64; 4] {
    [counts.received, counts.dropped, counts.gaps, counts.late]
}

#[test]
fn what_was_taken_is_finished_but_not_what_waits_in_the_input_or_where_the_stage_keeps_it() {
    let mut kept = Kept::by(&[WRITER]);
    let mut input_port = kept.input();
    kept.send((0..4).map(message));
    input_port.acknowledge();
    assert_eq!(kept.unfinished(), 4, "nothing has come in yet");
    input_port.buffer_ahead().unwrap();
    input_port.admit_buffered();
    input_port.acknowledge();
    assert_eq!(kept.unfinished(), 4, "all of it waits");
    assert_eq!((take(&mut input_port), take(&mut input_port)), (Some(0), Some(1)));
    input_port.acknowledge_but([message(1)].iter());
    assert_eq!(kept.unfinished(), 3, "the stage keeps the second");
    assert_eq!(take_all(&mut input_port), [2, 3]);
    input_port.acknowledge_but([message(3), message(1)].iter());
    assert_eq!(kept.unfinished(), 3, "it still does");
    input_port.acknowledge_but([by("other", 0)].iter());
    assert_eq!(kept.unfinished(), 0, "what it keeps of another writer is not theirs");
}

#[test]
fn a_writer_is_told_what_is_finished_once() {
    let mut kept = Kept::by(&[WRITER]);
    let mut input_port = kept.input();
    kept.send((0..3).map(message));
    assert_eq!(take_all(&mut input_port), [0, 1, 2]);
    input_port.acknowledge_but([message(2)].iter());
    assert!(kept.writer.wait(Duration::ZERO));
    input_port.acknowledge_but([message(2)].iter());
    assert!(!kept.writer.wait(Duration::ZERO), "the same as before");
    input_port.acknowledge();
    assert!(kept.writer.wait(Duration::ZERO));
    input_port.acknowledge();
    assert!(!kept.writer.wait(Duration::ZERO), "nothing has come since");
}

#[test]
fn what_was_let_go_of_is_not_asked_for_again_whatever_comes_then() {
    let mut kept = Kept::by(&[WRITER]);
    let mut input_port = kept.side_input();
    let waiting: Vec<_> = (0..3).map(message).collect();
    kept.send(waiting.clone());
    assert_eq!(take_all(&mut input_port), [0, 1, 2]);
    input_port.acknowledge_but(waiting.iter());
    assert_eq!(kept.unfinished(), 3);
    input_port.acknowledge();
    assert_eq!(kept.unfinished(), 0);
    kept.memory.writer::<Object>(&kept.topic).unwrap().send(&message(2)).unwrap();
    assert_eq!((take(&mut input_port), input_port.counts().late), (None, 1));
    input_port.acknowledge_but(waiting.iter());
    assert_eq!(kept.unfinished(), 0, "one of them came again");
    kept.send([message(3)]);
    assert_eq!(take(&mut input_port), Some(3));
    input_port.acknowledge_but(waiting.iter());
    assert_eq!(kept.unfinished(), 1, "a new one came, and is kept with the others");
}

#[test]
fn a_stage_of_another_machine_that_counts_anew_is_told_what_is_finished_by_its_new_numbers() {
    let mut kept = Kept::by(&[WRITER]);
    let mut input_port = kept.input();
    kept.send((0..3).map(message));
    assert_eq!(take_all(&mut input_port), [0, 1, 2]);
    input_port.acknowledge();
    kept.send([Header { epoch: 2, ..message(0) }]);
    assert_eq!(take(&mut input_port), Some(0));
    input_port.acknowledge();
    drop(input_port);
    assert_eq!(kept.finished(), [(WRITER.to_owned(), 1)].into());
}

#[test]
fn nonsense_is_finished_when_it_is_left_out() {
    let mut kept = Kept::by(&[WRITER]);
    let mut input_port = kept.input();
    kept.send([message(0), Header { depth_scale: f64::NAN, ..message(1) }]);
    assert_eq!(take_all(&mut input_port), [0]);
    input_port.acknowledge();
    assert_eq!((kept.unfinished(), input_port.counts().malformed), (0, 1));
}

#[test]
fn only_an_input_that_wants_every_message_has_them_kept() {
    let mut kept = Kept::by(&[WRITER]);
    assert!(kept.input().is_kept());
    kept.topic.readers[0].delivery = Delivery::Latest;
    assert!(!kept.input().is_kept());
    assert!(!Kept::in_memory(InMemory::default(), &[WRITER]).input().is_kept());
}

#[test]
fn who_is_started_anew_works_on_what_was_not_finished_and_counts_each_message_once() {
    let mut kept = Kept::by(&[WRITER]);
    let mut killed = kept.input();
    kept.send((0..5).map(message));
    (0..2).for_each(|number| {
        assert_eq!(take(&mut killed), Some(number));
        killed.acknowledge();
    });
    let record = killed.counts();
    assert_eq!(take(&mut killed), Some(2), "in its hands when it is killed");
    drop(killed);
    let mut next = kept.input();
    next.resume(record);
    assert_eq!(next.position().numbers, [(Text::new(WRITER), 1)].into(), "its successor need not do them again either");
    assert_eq!(next.position().frames, [(Text::new(WRITER), (1, 1))].into());
    assert_eq!(take_all(&mut next), [2, 3, 4]);
    assert_eq!(counted(&next.counts()), [5, 0, 0, 0]);
    next.acknowledge();
    assert_eq!(kept.unfinished(), 0);
}

#[test]
fn frames_that_are_missing_between_what_two_processes_worked_on_are_counted() {
    let mut kept = Kept::by(&[WRITER]);
    let mut killed = kept.input();
    kept.send((0..2).map(message));
    assert_eq!(take_all(&mut killed), [0, 1]);
    killed.acknowledge();
    let record = killed.counts();
    drop(killed);
    kept.send([Header { sequence: 6, ..message(2) }]);
    let mut next = kept.input();
    next.resume(record);
    assert_eq!(take_all(&mut next), [2]);
    assert_eq!(counted(&next.counts()), [3, 0, 4, 0]);
}

#[test]
fn what_stands_in_the_record_is_not_worked_on_again_even_if_its_writer_was_not_told() {
    let mut kept = Kept::by(&["left", "right"]);
    let mut killed = kept.input();
    kept.send([by("right", 0), by("left", 5), by("left", 6), by("right", 1)]);
    for number in [0, 5] {
        assert_eq!(take(&mut killed), Some(number));
        killed.acknowledge();
    }
    assert_eq!(take(&mut killed), Some(6));
    let record = killed.counts();
    drop(killed);
    let mut next = kept.input();
    next.resume(record);
    let again = from_fn(|| next.take().unwrap().map(|message| *message.header()));
    let again: Vec<_> = again.map(|header| (header.trace()[0].stage.to_string(), header.number)).collect();
    assert_eq!(again, [("right".to_owned(), 1)]);
    assert_eq!(counted(&next.counts()), [4, 0, 0, 0]);
}

#[test]
fn what_a_side_input_took_and_kept_is_taken_again_and_counted_once() {
    let mut kept = Kept::by(&[WRITER]);
    let mut killed = kept.side_input();
    kept.send((0..4).map(message));
    assert_eq!([take(&mut killed), take(&mut killed), take(&mut killed)], [Some(0), Some(1), Some(2)]);
    killed.acknowledge_but([message(1)].iter());
    let record = killed.counts();
    drop(killed);
    let mut next = kept.side_input();
    next.resume(record);
    assert_eq!(take_all(&mut next), [1, 2, 3]);
    assert_eq!(counted(&next.counts()), [4, 0, 0, 0]);
}

#[test]
fn what_other_writers_send_is_counted_although_one_hands_again_what_was_counted() {
    let mut kept = Kept::by(&["left", "right"]);
    let mut killed = kept.side_input();
    kept.send([by("left", 0), by("left", 1)]);
    assert_eq!(take_all(&mut killed), [0, 1]);
    killed.acknowledge_but([by("left", 1)].iter());
    let record = killed.counts();
    drop(killed);
    let mut next = kept.side_input();
    kept.send([by("right", 0), by("left", 2)]);
    next.resume(record);
    assert_eq!(take_all(&mut next), [1, 0, 2]);
    assert_eq!(counted(&next.counts()), [4, 0, 0, 0]);
}

#[test]
fn who_has_kept_no_counts_goes_on_after_what_was_finished() {
    let mut kept = Kept::by(&[WRITER]);
    let mut killed = kept.input();
    kept.send((0..4).map(message));
    assert_eq!((take(&mut killed), take(&mut killed)), (Some(0), Some(1)));
    killed.acknowledge();
    drop(killed);
    let mut next = kept.input();
    next.skip_finished();
    assert_eq!(take_all(&mut next), [2, 3]);
    assert_eq!(counted(&next.counts()), [2, 0, 0, 0]);
}

#[test]
fn counts_of_another_topic_are_not_continued() {
    let mut kept = Kept::by(&[WRITER]);
    let mut input_port = kept.input();
    input_port.resume(InputCounts { topic: Text::new("depth"), received: 7, ..InputCounts::default() });
    assert_eq!(input_port.counts().received, 0);
    input_port.resume(InputCounts { topic: Text::new("objects"), received: 7, ..InputCounts::default() });
    assert_eq!(input_port.counts().received, 7);
}

#[test]
fn a_message_that_two_processes_died_of_is_left_out_by_all_that_follow() {
    let mut kept = Kept::by(&[WRITER]);
    kept.send((0..2).map(message));
    let step = |input_port: &mut InputPort<MemoryReader>| match input_port.take_step().unwrap() {
        Step::Message(message) => Some(message.header().number),
        Step::LeftOut => None,
        Step::Nothing => panic!("nothing is there"),
    };
    let begun: Vec<_> = (0..4).map(|_| step(&mut kept.input())).collect();
    assert_eq!(begun, [Some(0), Some(0), None, None]);
    let mut last = kept.input();
    assert_eq!([step(&mut last), step(&mut last)], [None, Some(1)]);
    assert_eq!(counted(&last.counts()), [1, 1, 1, 0]);
    assert!(matches!(last.take_step().unwrap(), Step::Nothing));
}

#[test]
fn a_predecessor_has_passed_what_it_has_worked_on_and_nothing_that_waits() {
    let mut kept = Kept::by(&["left", "right"]);
    let mut input_port = kept.input();
    let until = |left: u64| Watermark { numbers: [(Text::new("left"), left)].into(), ..Watermark::default() };
    let passed = |input_port: &InputPort<MemoryReader>| [0, 1, 2, 3].map(|left| input_port.has_passed(&until(left)));
    assert_eq!(passed(&input_port), [true, false, false, false]);
    kept.send([by("left", 0), by("left", 1), by("right", 0)]);
    input_port.buffer_ahead().unwrap();
    input_port.admit_buffered();
    assert_eq!(passed(&input_port), [true, false, false, false], "all of it waits");
    assert_eq!(take(&mut input_port), Some(0));
    assert_eq!(passed(&input_port), [true, true, false, false]);
    assert_eq!(take(&mut input_port), Some(1));
    assert_eq!(passed(&input_port), [true, true, true, false], "what waits of another writer is another matter");
    assert_eq!(take(&mut input_port), Some(0));
    kept.send([by("left", 2), end_of_stream(&by("left", 2), Text::new("left"), 3)]);
    input_port.buffer_ahead().unwrap();
    input_port.admit_buffered();
    assert!(input_port.has_ended("left"));
    assert!(!input_port.has_passed(&until(9)), "the last message waits");
    assert_eq!(take_all(&mut input_port), [2]);
    assert!(input_port.has_passed(&until(9)), "no more of them can come");
    let both = Watermark { numbers: ["left", "right"].map(|writer| (Text::new(writer), 3)).into(), ..until(3) };
    assert!(!input_port.has_passed(&both), "each writer counts");
}

#[test]
fn what_is_buffered_ahead_is_so_much_and_no_more() {
    let mut kept = Kept::by(&[WRITER]);
    let mut input_port = kept.input();
    let sent = 2 * MAX_KEPT as u64;
    kept.send((0..sent).map(message));
    input_port.buffer_ahead().unwrap();
    input_port.buffer_ahead().unwrap();
    assert!(buffered(&input_port).into_iter().eq(0..MAX_KEPT as u64));
    input_port.admit_buffered();
    assert!(take_all(&mut input_port).into_iter().eq(0..sent), "the rest follows");
}

#[test]
fn of_each_writer_the_newest_message_and_the_end_are_never_left_to_the_predecessor() {
    let mut kept = Kept::by(&["rare", "often", "ended"]);
    let mut input_port = kept.input();
    let end = end_of_stream(&by("ended", 0), Text::new("ended"), 1);
    kept.send([by("rare", 3), by("ended", 0), end, by("ended", 1)]);
    kept.send((0..30).map(|number| by("often", number)));
    input_port.buffer_newest().unwrap();
    assert_eq!(input_port.buffered().count(), MAX_KEPT - 1);
    assert!(input_port.has_buffered("rare") && !input_port.has_buffered("nobody"));
    assert_eq!(input_port.first_buffered().numbers[&Text::new("rare")], 3);
    let of = |input_port: &InputPort<MemoryReader>, name: &str| {
        let own = input_port.buffered().filter(|header| header.trace()[0].stage == Text::new(name));
        own.map(|header| (header.number, header.ends_stream())).collect::<Vec<_>>()
    };
    assert_eq!(of(&input_port, "ended"), [(1, true), (1, false)]);
    input_port.drop_buffered(|header| header.number < 25);
    assert_eq!(of(&input_port, "ended"), [(1, true)]);
    assert!(buffered(&input_port).ends_with(&[25, 26, 27, 28, 29]));
}

#[test]
fn a_successor_works_on_what_its_predecessor_did_not_and_on_nothing_else() {
    let last = Watermark {
        numbers: [(Text::new("left"), 3)].into(),
        frames: [(Text::new("left"), (1, 3))].into(),
        ended: ["right".to_owned()].into(),
    };
    let mut kept = Kept::by(&["left", "right"]);
    let mut input_port = kept.input();
    kept.send((2..6).map(|number| by("left", number)));
    input_port.buffer_newest().unwrap();
    input_port.resume_from_handover(last.clone());
    assert_eq!(*input_port.position(), last);
    assert_eq!(take_all(&mut input_port), [4, 5]);
    assert_eq!(counted(&input_port.counts()), [2, 0, 0, 0]);
    assert_eq!(input_port.position().numbers[&Text::new("left")], 5);
    // A restarted stage of another machine.
    kept.send([Header { epoch: 2, ..by("left", 0) }]);
    assert_eq!(take(&mut input_port), Some(0));
    kept.send([end_of_stream(&by("left", 0), Text::new("left"), 1)]);
    assert!(take(&mut input_port).is_none() && input_port.ended(), "the other one has ended before");
}

#[test]
fn what_is_lost_between_predecessor_and_successor_is_counted() {
    let last = Watermark {
        numbers: [(Text::new(WRITER), 1)].into(),
        frames: [(Text::new(WRITER), (1, 1))].into(),
        ..Watermark::default()
    };
    let mut kept = Kept::by(&[WRITER]);
    let mut input_port = kept.input();
    kept.send([message(4)]);
    input_port.buffer_newest().unwrap();
    input_port.resume_from_handover(last);
    assert_eq!(take(&mut input_port), Some(4));
    assert_eq!(counted(&input_port.counts()), [1, 2, 2, 0]);
}

#[test]
fn a_stream_has_not_ended_while_a_message_waits() {
    let mut kept = Kept::by(&[WRITER]);
    let mut input_port = kept.input();
    assert!(input_port.is_idle() && !input_port.ended());
    kept.send([message(0), end_of_stream(&message(0), Text::new(WRITER), 1)]);
    input_port.buffer_ahead().unwrap();
    assert!(!input_port.is_idle());
    input_port.admit_buffered();
    assert!(input_port.has_ended(WRITER) && !input_port.ended());
    assert_eq!(take(&mut input_port), Some(0));
    assert!(input_port.is_idle() && input_port.ended());
}

#[test]
fn who_waits_for_a_message_sleeps_while_none_comes() {
    let mut kept = Kept::by(&[WRITER]);
    let mut input_port = kept.input();
    let (begin, patience) = (Instant::now(), Duration::from_millis(20));
    input_port.wait(patience).unwrap();
    assert!(begin.elapsed() >= patience);
    kept.send([message(0)]);
    input_port.wait(Duration::from_secs(3600)).unwrap();
    assert_eq!(take(&mut input_port), Some(0));
}
