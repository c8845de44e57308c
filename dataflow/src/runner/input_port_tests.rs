//! Tests of an input: which messages it takes or skips, and how it counts both.

use super::input_port::InputPort;
use crate::ports::in_memory::InMemory;
use crate::ports::{Delivery, MAX_KEPT, Received, Topic, TopicReader, Transport, Writer};
use crate::runner::output_port::end_of_stream;
use crate::status::InputCounts;
use conicflow_messages::{Camera, END_OF_STREAM, Header, Hop, Object, Text};

fn topic(delivery: Delivery) -> Topic {
    let reader = TopicReader { stage: "reader".into(), delivery, queue: 8 };
    Topic { name: "objects".into(), item: None, writers: vec!["writer".into()], readers: vec![reader] }
}

fn header(sequence: u64) -> Header {
    let camera = Camera { width: 4, height: 3, fx: 5.0, fy: 5.0, cx: 1.5, cy: 1.0 };
    let mut header = Header { sequence, number: sequence, camera, depth_scale: 0.001, ..Header::default() };
    header.add_hop(Hop { stage: Text::new("writer"), ..Hop::default() });
    header
}

/// Sends the frames. Returns those that were taken, the counts, and whether the stream has ended.
fn pass(delivery: Delivery, headers: &[Header]) -> (Vec<u64>, InputCounts, bool) {
    let memory = InMemory::default();
    let topic = topic(delivery);
    let reader = memory.reader::<Object>(&topic, "reader").unwrap();
    let mut writer = memory.writer::<Object>(&topic).unwrap();
    for header in headers {
        writer.send(header).unwrap();
    }
    let mut input_port = InputPort::new(reader, delivery, "objects", 1);
    let taken = std::iter::from_fn(|| input_port.take().unwrap().map(|message| message.header().sequence)).collect();
    (taken, input_port.counts(), input_port.ended())
}

#[test]
fn lossless_takes_each_and_latest_the_newest() {
    let headers: Vec<_> = (0..4).map(header).collect();
    assert_eq!(pass(Delivery::Lossless, &headers).0, [0, 1, 2, 3]);
    let (taken, counts, ended) = pass(Delivery::Latest, &headers);
    assert_eq!(taken, [3]);
    assert_eq!((counts.received, counts.dropped, counts.gaps, ended), (1, 3, 3, false));
}

#[test]
fn the_last_frame_survives_the_end_of_the_stream() {
    let end = Header { flags: END_OF_STREAM, ..header(0) };
    let (taken, _, ended) = pass(Delivery::Latest, &[header(0), header(1), end]);
    assert_eq!((taken, ended), (vec![1], true));
}

#[test]
fn frames_come_once_and_in_order_and_gaps_are_counted() {
    let (taken, counts, _) = pass(Delivery::Lossless, &[0, 2, 1, 2, 5].map(header));
    assert_eq!(taken, [0, 2, 5]);
    assert_eq!((counts.gaps, counts.late), (3, 2));
}

#[test]
fn what_was_lost_before_the_first_message_is_counted_where_the_writer_is_of_this_run() {
    let (lossless, latest) = (Delivery::Lossless, Delivery::Latest);
    for (delivery, is_of_this_run, lost) in [(lossless, true, 2), (lossless, false, 0), (latest, true, 0)] {
        let memory = InMemory::default();
        let topic = topic(delivery);
        let reader = memory.reader::<Object>(&topic, "reader").unwrap();
        let mut writer = memory.writer::<Object>(&topic).unwrap();
        let mut input_port = InputPort::new(reader, delivery, "objects", 1);
        if is_of_this_run {
            input_port.expect_from_first();
        }
        for header in [2, 3].map(header) {
            writer.send(&header).unwrap();
            assert!(input_port.take().unwrap().is_some());
        }
        let counts = input_port.counts();
        assert_eq!((counts.received, counts.dropped, counts.gaps), (2, lost, lost));
    }
}

#[test]
fn what_a_killed_source_sent_just_before_is_not_taken_again_from_the_next_one() {
    let anew = |sequence: u64| Header { epoch: 1, ..header(sequence) };
    let (taken, counts, _) = pass(Delivery::Lossless, &[header(0), header(1), anew(1), anew(2)]);
    assert_eq!((taken, counts.late, counts.gaps), (vec![0, 1, 2], 1, 0));
    let (taken, counts, _) = pass(Delivery::Lossless, &[header(0), header(1), header(2), anew(0), anew(1)]);
    assert_eq!((taken, counts.late), (vec![0, 1, 2, 0, 1], 0), "another run from its first frame on");
    // Another frame under the same number, and another number for a frame with the same sequence number as the last.
    for other in [Header { number: 1, ..anew(5) }, Header { number: 2, ..anew(1) }] {
        let (taken, counts, _) = pass(Delivery::Lossless, &[header(0), header(1), other]);
        assert_eq!((taken, counts.late), (vec![0, 1, other.sequence], 0));
    }
}

#[test]
fn what_was_lost_with_an_earlier_process_is_counted() {
    let (_, earlier, _) = pass(Delivery::Lossless, &[0, 1].map(header));
    let memory = InMemory::default();
    let topic = topic(Delivery::Lossless);
    let reader = memory.reader::<Object>(&topic, "reader").unwrap();
    let mut input_port = InputPort::new(reader, Delivery::Lossless, "objects", 1);
    input_port.resume(earlier);
    memory.writer::<Object>(&topic).unwrap().send(&header(5)).unwrap();
    assert_eq!(input_port.take().unwrap().map(|message| message.header().sequence), Some(5));
    let counts = input_port.counts();
    assert_eq!((counts.received, counts.dropped, counts.gaps), (3, 3, 3));
}

/// A header of the writer `writer`.
fn written_by(writer: &str, sequence: u64) -> Header {
    let mut header = Header { hops: Header::default().hops, hop_count: 0, ..header(sequence) };
    header.add_hop(Hop { stage: Text::new(writer), ..Hop::default() });
    header
}

#[test]
fn a_successor_hears_a_rare_writer_beside_one_that_sends_a_lot() {
    let memory = InMemory::default();
    let mut topic = topic(Delivery::Lossless);
    topic.readers[0].queue = 64;
    let reader = memory.reader::<Object>(&topic, "reader").unwrap();
    let mut writer = memory.writer::<Object>(&topic).unwrap();
    let mut input_port = InputPort::new(reader, Delivery::Lossless, "objects", 2);
    (0..40).for_each(|sequence| _ = writer.send(&written_by("often", sequence)).unwrap());
    writer.send(&written_by("rare", 3)).unwrap();
    input_port.buffer_newest().unwrap();
    let numbers = input_port.first_buffered().numbers;
    assert_eq!(numbers[&Text::new("rare")], 3);
    assert_eq!(numbers[&Text::new("often")], 40 + 2 - MAX_KEPT as u64, "older ones are the predecessor's");
}

#[test]
fn where_several_write_nobody_knows_what_an_earlier_process_had_of_each() {
    let (_, earlier, _) = pass(Delivery::Lossless, &[0, 1].map(header));
    let memory = InMemory::default();
    let topic = topic(Delivery::Lossless);
    let reader = memory.reader::<Object>(&topic, "reader").unwrap();
    let mut writer = memory.writer::<Object>(&topic).unwrap();
    let mut input_port = InputPort::new(reader, Delivery::Lossless, "objects", 2);
    input_port.resume(earlier);
    writer.send(&end_of_stream(&header(0), Text::new("writer"), 4)).unwrap();
    writer.send(&end_of_stream(&header(0), Text::new("other"), 4)).unwrap();
    assert!(input_port.take().unwrap().is_none() && input_port.ended());
    assert_eq!(input_port.counts().dropped, 0);
}

#[test]
fn frames_between_what_an_earlier_process_took_and_what_its_successor_heard_are_gaps() {
    let (_, earlier, _) = pass(Delivery::Lossless, &[0, 1].map(header));
    let memory = InMemory::default();
    let topic = topic(Delivery::Lossless);
    let reader = memory.reader::<Object>(&topic, "reader").unwrap();
    let mut writer = memory.writer::<Object>(&topic).unwrap();
    let mut input_port = InputPort::new(reader, Delivery::Lossless, "objects", 1);
    (4..6).for_each(|sequence| _ = writer.send(&header(sequence)).unwrap());
    input_port.buffer_ahead().unwrap();
    input_port.resume(earlier);
    input_port.admit_buffered();
    while input_port.take().unwrap().is_some() {}
    let counts = input_port.counts();
    assert_eq!((counts.received, counts.dropped, counts.gaps), (4, 2, 2));
}

#[test]
fn how_many_messages_a_writer_has_sent_is_known_by_the_last_that_came_and_by_the_end() {
    let memory = InMemory::default();
    let topic = topic(Delivery::Lossless);
    let reader = memory.reader::<Object>(&topic, "reader").unwrap();
    let mut writer = memory.writer::<Object>(&topic).unwrap();
    let mut input_port = InputPort::new(reader, Delivery::Lossless, "objects", 1);
    let mut count_after = |header| {
        writer.send(&header).unwrap();
        input_port.take().unwrap();
        ["writer", "other"].map(|writer| input_port.count_of(writer))
    };
    assert_eq!(count_after(header(2)), [3, 0]);
    assert_eq!(count_after(end_of_stream(&header(2), Text::new("writer"), 6)), [6, 0]);
}

#[test]
fn what_predecessor_and_successor_both_heard_is_counted_once() {
    let (_, earlier, _) = pass(Delivery::Lossless, &[0, 1, 2].map(header));
    let memory = InMemory::default();
    let topic = topic(Delivery::Lossless);
    let reader = memory.reader::<Object>(&topic, "reader").unwrap();
    let mut writer = memory.writer::<Object>(&topic).unwrap();
    let mut input_port = InputPort::new(reader, Delivery::Lossless, "objects", 1);
    (1..5).for_each(|sequence| _ = writer.send(&header(sequence)).unwrap());
    input_port.buffer_ahead().unwrap();
    input_port.resume(earlier);
    input_port.admit_buffered();
    let taken: Vec<_> =
        std::iter::from_fn(|| input_port.take().unwrap().map(|message| message.header().number)).collect();
    let counts = input_port.counts();
    assert_eq!(taken, [1, 2, 3, 4], "what belongs to a later frame is still needed");
    assert_eq!((counts.received, counts.dropped, counts.gaps, counts.late), (5, 0, 0, 0));
}

#[test]
fn the_newest_of_each_source_is_kept() {
    let other = written_by("other", 7);
    let (taken, counts, _) = pass(Delivery::Latest, &[header(0), other, header(1)]);
    assert_eq!((taken, counts.received, counts.dropped), (vec![7, 1], 2, 1));
}

#[test]
fn nonsense_is_counted_and_left_out() {
    let broken = Header { depth_scale: f64::NAN, ..header(1) };
    let (taken, counts, _) = pass(Delivery::Lossless, &[header(0), broken]);
    assert_eq!((taken, counts.malformed), (vec![0], 1));
}

#[test]
fn a_stream_has_ended_when_each_of_its_writers_has() {
    let memory = InMemory::default();
    let topic = topic(Delivery::Latest);
    let mut input_port =
        InputPort::new(memory.reader::<Object>(&topic, "reader").unwrap(), Delivery::Latest, "objects", 2);
    let mut writer = memory.writer::<Object>(&topic).unwrap();
    writer.send(&header(0)).unwrap();
    writer.send(&end_of_stream(&header(0), Text::new("writer"), 1)).unwrap();
    assert!(input_port.take().unwrap().is_some() && input_port.take().unwrap().is_none());
    assert!(input_port.has_ended("writer") && !input_port.has_ended("other") && !input_port.ended());
    writer.send(&end_of_stream(&header(0), Text::new("other"), 0)).unwrap();
    assert!(input_port.take().unwrap().is_none() && input_port.ended());
}

#[test]
fn what_is_missing_at_the_end_is_counted_once() {
    let end = end_of_stream(&header(1), Text::new("writer"), 5);
    for (sent, lost) in [(&[header(0), header(1), end][..], 3), (&[header(0), header(1), end, end], 3), (&[end], 5)] {
        let (_, counts, ended) = pass(Delivery::Lossless, sent);
        assert_eq!((counts.dropped, counts.gaps, ended), (lost, lost, true));
    }
    assert_eq!(pass(Delivery::Lossless, &[end_of_stream(&header(0), Text::new("writer"), 0)]).1.dropped, 0);
    let complete = end_of_stream(&header(1), Text::new("writer"), 2);
    assert_eq!(pass(Delivery::Lossless, &[header(0), header(1), complete]).1.dropped, 0);
    assert_eq!(pass(Delivery::Latest, &[end]).1.dropped, 0, "who came late to a live stream has lost nothing");
    let forged = end_of_stream(&header(1), Text::new("writer"), u64::MAX);
    assert_eq!(pass(Delivery::Lossless, &[header(0), forged]).1.received, 1);
}

#[test]
fn numbers_that_no_writer_reaches_do_no_harm() {
    let broken = Header { number: u64::MAX, ..header(1) };
    let (taken, counts, _) = pass(Delivery::Lossless, &[header(0), broken, header(2)]);
    assert_eq!((taken.as_slice(), counts.received), ([0, 1, 2].as_slice(), 3));
}
