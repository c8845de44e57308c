//! End-to-end tests of an edge within one process: two machines, each with its own shared memory, joined by a stream.

use crate::peer::counts::EdgeCounts;
use crate::peer::heartbeat::Ack;
use crate::peer::journal::Journal;
use crate::peer::links::Links;
use crate::receiving::Receiving;
use crate::sending::Sending;
use crate::session::Sessions;
use crate::session::tests::joined;
use crate::shared::Shared;
use crate::wire::seal::{Seal, secret};
use crate::wire::{StreamPosition, encode_message};
use conicflow_dataflow::pipeline::{BRIDGE, Compression};
use conicflow_dataflow::ports::{Delivery, Reader, Received, Topic, TopicReader, Transport, Writer};
use conicflow_dataflow::relay::{Peers, SharedMemory, end_of_stream};
use conicflow_dataflow::{BridgePlan, Edge, ItemType, LinkKey, Receiver, Stop, monotonic_ns};
use conicflow_messages::{Camera, Header, Hop, Object, Text};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread;
use std::time::{Duration, Instant};

const DEADLINE: Duration = Duration::from_secs(60);
const OUTAGE: Duration = Duration::from_secs(30);

/// Waits until `holds` returns true.
pub fn wait_until(what: &str, mut holds: impl FnMut() -> bool) {
    let begin = Instant::now();
    while !holds() {
        assert!(begin.elapsed() < DEADLINE, "never came true: {what}");
        thread::sleep(Duration::from_millis(1));
    }
}

/// The edge from `robot` to `base`, as on the machine where `reader` reads the topic.
pub fn edge(delivery: Delivery, reader: &str) -> Edge {
    let (item, writers) = (ItemType::of::<Object>(), vec!["writer".to_owned()]);
    let readers = vec![TopicReader { stage: reader.to_owned(), delivery, queue: 4 }];
    let topic = Topic { name: "objects".into(), item: Some(item.clone()), writers: writers.clone(), readers };
    let to = vec![Receiver { machine: "base".into(), delivery }];
    Edge { topic, item, from: "robot".into(), writers, to, compression: Compression::None }
}

/// Forces these stops when the test is over, even if it fails; otherwise it would wait for their threads for ever.
pub struct Ending<const N: usize>(pub [Stop; N]);

impl<const N: usize> Drop for Ending<N> {
    fn drop(&mut self) {
        self.0.iter().for_each(Stop::force);
    }
}

/// A machine with its part of the edge.
pub struct Side {
    name: &'static str,
    pub edge: Edge,
    links: Arc<Links>,
    memory: SharedMemory,
    pub counts: Arc<EdgeCounts>,
    stop: Stop,
}

impl Side {
    pub fn new(name: &'static str, edge: Edge, folder: &Path, key: Option<&LinkKey>) -> Self {
        Self::of_run(name, edge, folder, key, None)
    }

    /// One side of an edge, with a folder for the notes of its bridge.
    fn of_run(name: &'static str, edge: Edge, folder: &Path, key: Option<&LinkKey>, run_folder: Option<&Path>) -> Self {
        let (session, stop) = (if name == "robot" { 5 } else { 9 }, Stop::default());
        let [outgoing, incoming] = ["robot", "base"].map(|of| if of == name { vec![edge.clone()] } else { vec![] });
        let plan = BridgePlan { machine: name.to_owned(), outgoing, incoming, ..BridgePlan::default() };
        let links = Arc::new(Links::new(Journal::open(run_folder, 7, session), Seal::new(key, session), &plan));
        let memory = SharedMemory::open(folder, "test", BRIDGE, stop.clone()).unwrap();
        Self { name, edge, links, memory, counts: Arc::default(), stop }
    }

    /// The state that the threads of its bridge share, with these sessions.
    pub fn shared<'a>(&'a self, sessions: &'a Sessions, peers: &'a Peers) -> Shared<'a> {
        let session = if self.name == "robot" { 5 } else { 9 };
        let (transport, links, machine, stop) = (&self.memory, &self.links, self.name, &self.stop);
        Shared {
            sessions,
            transport,
            links,
            pipeline: "test",
            machine,
            session,
            log_folder: None,
            outage: OUTAGE,
            peers,
            stop,
        }
    }
}

pub fn header(writer: &str, number: u64) -> Header {
    let camera = Camera { width: 4, height: 3, fx: 5.0, fy: 5.0, cx: 2.0, cy: 1.0 };
    let mut header = Header { number, sequence: 100 + number, camera, depth_scale: 0.001, ..Header::default() };
    header.add_hop(Hop { stage: Text::new(writer), received_ns: monotonic_ns(), sent_ns: monotonic_ns() });
    header
}

/// As many objects as the number of the message, each with that number as its radius.
fn objects(number: u64) -> Vec<Object> {
    vec![Object { radius: number as f64, ..Object::default() }; number as usize]
}

/// The shared memory of a machine, as a stage on it opens it.
pub fn memory(folder: &Path, stage: &str) -> SharedMemory {
    SharedMemory::open(folder, "test", stage, Stop::default()).unwrap()
}

/// Writes messages and their end, with some messages of a stage that has no part in the edge in between.
pub fn write(memory: &SharedMemory, topic: &Topic, count: u64) {
    let mut writer = memory.writer::<Object>(topic).unwrap();
    for number in 0..count {
        for stage in ["stranger", "writer"] {
            let objects = objects(number);
            writer.loan(objects.len()).unwrap().copy_from_slice(&objects);
            writer.send(&header(stage, number)).unwrap();
        }
    }
    writer.send(&end_of_stream(&header("writer", count), Text::new("writer"), count)).unwrap();
    wait_until("all of it was taken", || writer.connected().is_empty());
}

/// Reads messages until the end and checks their items. Returns their numbers, and how many there were according to the end.
pub fn read(mut reader: impl Reader) -> (Vec<u64>, u64) {
    let (mut numbers, begin) = (Vec::new(), Instant::now());
    while begin.elapsed() < DEADLINE {
        let Some(message) = reader.receive().unwrap() else {
            reader.wait(Duration::from_millis(20)).unwrap();
            continue;
        };
        let Header { number, sequence, .. } = *message.header();
        if message.header().ends_stream() {
            return (numbers, number);
        }
        assert_eq!((sequence, message.items::<Object>()), (100 + number, &objects(number)[..]));
        numbers.push(number);
    }
    panic!("the end does not come, after {numbers:?}");
}

/// Exchanges one heartbeat in each direction.
fn exchange_heartbeats(robot: &Side, base: &Side) {
    robot
        .links
        .send_heartbeat("@robot", robot.links.news(), |bytes| base.links.receive_heartbeat("robot", "@robot", &bytes));
    base.links
        .send_heartbeat("@base", base.links.news(), |bytes| robot.links.receive_heartbeat("base", "@base", &bytes));
}

/// Hands messages to `base`, whose bridge has met that of `robot`. Returns the counts of messages that were passed on, stale,
/// malformed and refused, and the acknowledgement.
fn accepted(delivery: Delivery, messages: &[Vec<u8>]) -> ([u64; 4], Ack) {
    accepted_with(Some(&secret()), delivery, messages)
}

/// Hands messages to `base` as [`accepted`] does, with or without a key; without one, each message is sent until it is
/// acknowledged.
fn accepted_with(key: Option<&LinkKey>, delivery: Delivery, messages: &[Vec<u8>]) -> ([u64; 4], Ack) {
    let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let robot = Side::new("robot", edge(delivery, BRIDGE), folders[0].path(), key);
    let base = Side::new("base", edge(delivery, "reader"), folders[1].path(), key);
    let ([_, sessions], peers) = (joined(|address| address), Peers::default());
    (0..2).for_each(|_| exchange_heartbeats(&robot, &base));
    let mut reader = memory(folders[1].path(), "reader").reader::<Object>(&base.edge.topic, "reader").unwrap();
    let mut receiving = Receiving::new(&base.edge, &base.shared(&sessions, &peers), Arc::clone(&base.counts)).unwrap();
    let over = Stop::default();
    thread::scope(|scope| {
        let _ending = Ending([over.clone()]);
        scope.spawn(|| {
            while !over.forced() {
                reader.receive().unwrap();
                reader.wait(Duration::from_millis(5)).unwrap();
            }
        });
        for bytes in messages {
            let before = base.links.news();
            wait_until("it is acknowledged", || {
                receiving.accept(bytes).unwrap();
                key.is_some() || base.links.news() != before
            });
        }
    });
    let EdgeCounts { messages, stale, malformed, refused, .. } = &*base.counts;
    let counts = [messages, stale, malformed, refused].map(|count| count.load(Ordering::Relaxed));
    (counts, base.links.news().acks.remove(0))
}

/// The message of this number as it goes onto the link.
fn on_the_wire(header: &Header, number: u64, oldest: u64) -> Vec<u8> {
    let (position, item) = (StreamPosition { stream: 5, number, oldest }, ItemType::of::<Object>());
    encode_message(position, &item, header, bytemuck::cast_slice(&objects(number)), Compression::None).unwrap()
}

/// Carries `count` messages over an edge. Returns the numbers that came, how many there were, and both sides.
fn carry(key: Option<&LinkKey>, delivery: Delivery, count: u64) -> (Vec<u64>, u64, [Side; 2]) {
    let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let robot = Side::new("robot", edge(delivery, BRIDGE), folders[0].path(), key);
    let base = Side::new("base", edge(delivery, "reader"), folders[1].path(), key);
    let ([robot_sessions, base_sessions], peers, over) = (joined(|address| address), Peers::default(), Stop::default());
    let (robot_shared, base_shared) = (robot.shared(&robot_sessions, &peers), base.shared(&base_sessions, &peers));
    let (numbers, announced) = thread::scope(|scope| {
        let _ending = Ending([over.clone(), robot.stop.clone(), base.stop.clone()]);
        scope.spawn(|| {
            while !over.forced() {
                exchange_heartbeats(&robot, &base);
                thread::sleep(Duration::from_millis(10));
            }
        });
        let reader = memory(folders[1].path(), "reader").reader::<Object>(&base.edge.topic, "reader").unwrap();
        let receiving = Receiving::new(&base.edge, &base_shared, Arc::clone(&base.counts)).unwrap();
        let sending = Sending::new(&robot.edge, &robot_shared, Arc::clone(&robot.counts)).unwrap();
        let carries = [scope.spawn(move || receiving.run()), scope.spawn(move || sending.run())];
        wait_until("the base is heard", || robot.links.is_connected("base"));
        scope.spawn(|| write(&memory(folders[0].path(), "writer"), &robot.edge.topic, count));
        let read = read(reader);
        carries.into_iter().for_each(|carries| carries.join().unwrap().unwrap());
        read
    });
    (numbers, announced, [robot, base])
}

#[test]
fn a_lossless_edge_carries_each_message_and_the_end_and_both_machines_know_that_it_is_finished() {
    for key in [Some(&secret()), None] {
        let (numbers, announced, [robot, base]) = carry(key, Delivery::Lossless, 40);
        assert_eq!((numbers, announced), ((0..40).collect(), 40));
        for counts in [&robot.counts, &base.counts] {
            let [messages, lost, malformed] =
                [&counts.messages, &counts.lost, &counts.malformed].map(|count| count.load(Ordering::Relaxed));
            assert_eq!([messages, lost, malformed], [40, 0, 0]);
            let bytes = (0..40).sum::<usize>() * size_of::<Object>() + 40 * size_of::<Header>();
            assert_eq!(counts.memory_bytes.load(Ordering::Relaxed), bytes as u64);
        }
        assert!(robot.links.has_finished("base", "objects") && base.links.is_finished("robot", "objects").0);
    }
}

#[test]
fn a_latest_edge_carries_messages_in_order_and_the_end() {
    let (numbers, announced, [robot, base]) = carry(None, Delivery::Latest, 40);
    assert!(numbers.is_sorted_by(|a, b| a < b) && announced == 40, "{numbers:?} of {announced}");
    assert!(base.counts.messages.load(Ordering::Relaxed) <= robot.counts.messages.load(Ordering::Relaxed));
    assert!(base.links.is_finished("robot", "objects").0);
}

#[test]
fn a_stale_message_is_passed_on_over_a_lossless_edge_and_dropped_with_latest() {
    let sent_at = |number: u64, sent_ns: u64| {
        let mut header = header("writer", number);
        header.hops[0].sent_ns = sent_ns;
        header
    };
    let (late, just_sent) = (sent_at(0, 0), sent_at(1, u64::MAX));
    let messages = [on_the_wire(&late, 0, 0), on_the_wire(&just_sent, 1, 0)];
    assert_eq!(accepted(Delivery::Lossless, &messages).0, [2, 0, 0, 0]);
    assert_eq!(accepted(Delivery::Latest, &messages).0, [1, 1, 0, 0]);
}

#[test]
fn malformed_messages_are_skipped_and_acknowledged_so_that_later_ones_arrive() {
    let of_writer = |number| on_the_wire(&header("writer", number), number, 0);
    let (cut, ahead) = (of_writer(2).len() - 1, on_the_wire(&header("writer", 3), 3, 9));
    let messages = [
        of_writer(0),
        on_the_wire(&header("stranger", 1), 1, 0),
        of_writer(2)[..cut].to_vec(),
        ahead[..ahead.len() - 1].to_vec(),
        of_writer(4),
    ];
    let (counts, ack) = accepted(Delivery::Lossless, &messages);
    assert_eq!((counts, ack.stream, ack.next), ([2, 0, 3, 3], 5, 5));
}

#[test]
fn a_forged_message_with_a_number_not_yet_reached_is_reported_when_genuine_ones_arrive() {
    let messages = [300, 1].map(|number| on_the_wire(&header("writer", number), number, number));
    let (counts, ack) = accepted_with(None, Delivery::Lossless, &messages);
    assert_eq!((counts, ack.next), ([2, 0, 1, 0], 2));
}

#[test]
fn a_message_that_does_not_follow_the_last_of_its_writer_is_left_out_and_reported_when_the_genuine_one_arrives() {
    let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let robot = Side::new("robot", edge(Delivery::Lossless, BRIDGE), folders[0].path(), None);
    let base = Side::new("base", edge(Delivery::Lossless, "reader"), folders[1].path(), None);
    let ([_, sessions], peers) = (joined(|address| address), Peers::default());
    (0..2).for_each(|_| exchange_heartbeats(&robot, &base));
    let reader = memory(folders[1].path(), "reader").reader::<Object>(&base.edge.topic, "reader").unwrap();
    let mut receiving = Receiving::new(&base.edge, &base.shared(&sessions, &peers), Arc::clone(&base.counts)).unwrap();
    let of_number = |number| on_the_wire(&header("writer", number), 1, 0);
    thread::scope(|scope| {
        scope.spawn(|| read(reader));
        let end = end_of_stream(&header("writer", 1), Text::new("writer"), 1);
        for bytes in [&on_the_wire(&header("writer", 0), 0, 0), &of_number(1 << 40), &on_the_wire(&end, 1, 0)] {
            receiving.accept(bytes).unwrap();
        }
        assert_eq!((base.counts.messages.load(Ordering::Relaxed), base.links.news().acks[0].next), (1, 1));
        receiving.accept(&of_number(1)).unwrap();
        let [messages, malformed] =
            [&base.counts.messages, &base.counts.malformed].map(|count| count.load(Ordering::Relaxed));
        assert_eq!((messages, malformed, base.links.news().acks[0].next), (2, 1, 2));
        base.stop.request();
        assert!(!receiving.carry().unwrap(), "its writer goes on");
    });
}

/// The first bridge is killed after it has acknowledged the end and before it has announced it to a reader. Of the other machine,
/// only the first of three messages comes again; the end accounts for the other two.
#[test]
fn a_bridge_that_replaces_one_which_acknowledged_the_end_announces_it_with_its_count_and_notes_it_for_later_readers() {
    for (delivery, outage) in [(Delivery::Latest, OUTAGE), (Delivery::Lossless, Duration::from_millis(300))] {
        let folders = [0, 1, 2].map(|_| tempfile::tempdir().unwrap());
        let [of_robot, of_base, of_run] = folders.each_ref().map(|folder| folder.path());
        let robot = Side::new("robot", edge(delivery, BRIDGE), of_robot, None);
        let base = || Side::of_run("base", edge(delivery, "reader"), of_base, None, Some(of_run));
        let peers = Peers::in_folder(of_run.to_owned(), 7, ["reader".to_owned()].into());
        let [_, sessions] = joined(|address| address);
        let shared = |side| Shared { outage, ..Side::shared(side, &sessions, &peers) };
        let first = base();
        (0..2).for_each(|_| exchange_heartbeats(&robot, &first));
        let mut receiving = Receiving::new(&first.edge, &shared(&first), Arc::clone(&first.counts)).unwrap();
        let end = end_of_stream(&header("writer", 3), Text::new("writer"), 3);
        wait_until("the end is acknowledged", || {
            receiving.accept(&on_the_wire(&end, 0, 0)).unwrap();
            first.links.news().acks.iter().any(|ack| ack.ended == ["writer"])
        });
        drop(receiving);
        assert!(!peers.is_over("writer"), "its end was told to nobody");
        let next = base();
        let mut receiving = Receiving::new(&next.edge, &shared(&next), Arc::clone(&next.counts)).unwrap();
        let reader = memory(of_base, "reader").reader::<Object>(&next.edge.topic, "reader").unwrap();
        let received = thread::scope(|scope| {
            let _ending = Ending([next.stop.clone()]);
            let carries = scope.spawn(move || {
                receiving.accept(&on_the_wire(&header("writer", 0), 0, 0)).unwrap();
                receiving.carry()
            });
            let received = read(reader);
            carries.join().unwrap().unwrap();
            received
        });
        assert_eq!((received, peers.is_over("writer")), ((vec![0], 3), true), "{delivery:?}");
    }
}

#[test]
fn an_edge_is_not_finished_where_the_run_ends_before_its_writers_and_readers() {
    let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let robot = Side::new("robot", edge(Delivery::Latest, BRIDGE), folders[0].path(), None);
    let base = Side::new("base", edge(Delivery::Latest, "reader"), folders[1].path(), None);
    let ([_, sessions], peers) = (joined(|address| address), Peers::default());
    (0..2).for_each(|_| exchange_heartbeats(&robot, &base));
    let receiving = Receiving::new(&base.edge, &base.shared(&sessions, &peers), Arc::clone(&base.counts)).unwrap();
    base.stop.request();
    receiving.run().unwrap();
    assert_eq!(base.links.is_finished("robot", "objects"), (false, false));
}
