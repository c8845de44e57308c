//! Tests of an edge from end to end within one process: two machines, each with shared memory of its own, joined by a stream.

use crate::peer::counts::EdgeCounts;
use crate::peer::journal::Journal;
use crate::peer::links::Links;
use crate::receiving::Receiving;
use crate::sending::{Sending, Shared};
use crate::session::Sessions;
use crate::session::tests::joined;
use crate::wire::seal::Seal;
use conicflow_dataflow::pipeline::{BRIDGE, Compression, Machine};
use conicflow_dataflow::ports::{Delivery, Reader, Received, Topic, TopicReader, Transport, Writer};
use conicflow_dataflow::relay::{Peers, SharedMemory, end_of_stream};
use conicflow_dataflow::{BridgePlan, Edge, ItemType, Receiver, Stop, monotonic_ns};
use conicflow_messages::{Camera, Header, Hop, Object, Text};
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread;
use std::time::{Duration, Instant};

const DEADLINE: Duration = Duration::from_secs(60);
const OUTAGE: Duration = Duration::from_secs(30);

/// The edge from `robot` to `base`, as it is on the machine where `reader` reads the topic.
pub fn edge(delivery: Delivery, reader: &str) -> Edge {
    let (item, writers) = (ItemType::of::<Object>(), vec!["writer".to_owned()]);
    let readers = vec![TopicReader { stage: reader.to_owned(), delivery, queue: 4 }];
    let topic = Topic { name: "objects".into(), item: Some(item.clone()), writers: writers.clone(), readers };
    let to = vec![Receiver { machine: "base".into(), delivery }];
    Edge { topic, item, from: "robot".into(), writers, to, compression: Compression::None }
}

/// A machine with the part of the edge that is on it.
pub struct Side {
    name: &'static str,
    pub edge: Edge,
    links: Arc<Links>,
    memory: SharedMemory,
    pub counts: Arc<EdgeCounts>,
    stop: Stop,
}

impl Side {
    pub fn new(name: &'static str, edge: Edge, folder: &Path) -> Self {
        let (session, stop) = (if name == "robot" { 5 } else { 9 }, Stop::default());
        let [outgoing, incoming] = ["robot", "base"].map(|of| if of == name { vec![edge.clone()] } else { vec![] });
        let plan = BridgePlan { machine: name.to_owned(), settings: Machine::default(), outgoing, incoming };
        let links = Arc::new(Links::new(Journal::open(None, 7, session), Seal::new(None, session), &plan));
        let memory = SharedMemory::open(folder, "test", BRIDGE, stop.clone()).unwrap();
        Self { name, edge, links, memory, counts: Arc::default(), stop }
    }

    /// What the threads of its bridge share, with these sessions.
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

fn header(writer: &str, number: u64) -> Header {
    let camera = Camera { width: 4, height: 3, fx: 5.0, fy: 5.0, cx: 2.0, cy: 1.0 };
    let mut header = Header { number, sequence: 100 + number, camera, depth_scale: 0.001, ..Header::default() };
    header.add_hop(Hop { stage: Text::new(writer), received_ns: monotonic_ns(), sent_ns: monotonic_ns() });
    header
}

/// As many objects as the number of the message says, each with that number in it.
fn objects(number: u64) -> Vec<Object> {
    vec![Object { radius: number as f64, ..Object::default() }; number as usize]
}

/// Writes messages, among them some of a stage that has no part in the edge, and their end.
fn write(memory: &SharedMemory, topic: &Topic, count: u64) {
    let mut writer = memory.writer::<Object>(topic).unwrap();
    for number in 0..count {
        for stage in ["stranger", "writer"] {
            let objects = objects(number);
            writer.loan(objects.len()).unwrap().copy_from_slice(&objects);
            writer.send(&header(stage, number)).unwrap();
        }
    }
    writer.send(&end_of_stream(&header("writer", count), Text::new("writer"), count)).unwrap();
    let begin = Instant::now();
    while !writer.connected().is_empty() && begin.elapsed() < DEADLINE {
        thread::sleep(Duration::from_millis(1));
    }
}

/// The numbers of the messages that come until the end, whose items are looked at, and how many the end says that there were.
fn read(mut reader: impl Reader) -> (Vec<u64>, u64) {
    let (mut came, begin) = (Vec::new(), Instant::now());
    while begin.elapsed() < DEADLINE {
        let Some(message) = reader.receive().unwrap() else {
            reader.wait(Duration::from_millis(20)).unwrap();
            continue;
        };
        let Header { number, sequence, .. } = *message.header();
        if message.header().ends_stream() {
            return (came, number);
        }
        assert_eq!((sequence, message.items::<Object>()), (100 + number, &objects(number)[..]));
        came.push(number);
    }
    panic!("the end does not come, after {came:?}");
}

/// Carries so many messages over an edge: those that came, how many there were, and both sides afterwards.
fn carry(delivery: Delivery, count: u64) -> (Vec<u64>, u64, [Side; 2]) {
    let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
    let robot = Side::new("robot", edge(delivery, BRIDGE), folders[0].path());
    let base = Side::new("base", edge(delivery, "reader"), folders[1].path());
    let ([robot_sessions, base_sessions], peers, over) =
        (joined(|address| address), Peers::default(), AtomicBool::new(false));
    let open =
        |folder: &tempfile::TempDir, stage| SharedMemory::open(folder.path(), "test", stage, Stop::default()).unwrap();
    let (sharing_there, sharing_here) = (robot.shared(&robot_sessions, &peers), base.shared(&base_sessions, &peers));
    let (came, told) = thread::scope(|scope| {
        scope.spawn(|| {
            while !over.load(Ordering::Relaxed) {
                robot.links.say("@robot", robot.links.news(), |bytes| base.links.heard("robot", "@robot", &bytes));
                base.links.say("@base", base.links.news(), |bytes| robot.links.heard("base", "@base", &bytes));
                thread::sleep(Duration::from_millis(10));
            }
        });
        let reader = open(&folders[1], "reader").reader::<Object>(&base.edge.topic, "reader").unwrap();
        let receiving = Receiving::new(&base.edge, &sharing_here, Arc::clone(&base.counts)).unwrap();
        let sending = Sending::new(&robot.edge, &sharing_there, Arc::clone(&robot.counts)).unwrap();
        let carries = [scope.spawn(move || receiving.run()), scope.spawn(move || sending.run())];
        let begin = Instant::now();
        while !robot.links.is_connected("base") && begin.elapsed() < DEADLINE {
            thread::sleep(Duration::from_millis(5));
        }
        scope.spawn(|| write(&open(&folders[0], "writer"), &robot.edge.topic, count));
        let read = read(reader);
        carries.into_iter().for_each(|carries| carries.join().unwrap().unwrap());
        over.store(true, Ordering::Relaxed);
        read
    });
    (came, told, [robot, base])
}

#[test]
fn a_lossless_edge_carries_each_message_of_its_writers_and_their_end_and_both_machines_know_that_it_is_finished() {
    let (came, told, [robot, base]) = carry(Delivery::Lossless, 40);
    assert_eq!((came, told), ((0..40).collect(), 40));
    for counts in [&robot.counts, &base.counts] {
        let [messages, lost, malformed] =
            [&counts.messages, &counts.lost, &counts.malformed].map(|it| it.load(Ordering::Relaxed));
        assert_eq!([messages, lost, malformed], [40, 0, 0]);
    }
    assert!(robot.links.has_finished("base", "objects") && base.links.is_finished("robot", "objects").0);
}

#[test]
fn an_edge_where_the_newest_wins_carries_messages_in_their_order_and_the_end() {
    let (came, told, [robot, base]) = carry(Delivery::Latest, 40);
    assert!(came.is_sorted_by(|a, b| a < b) && told == 40, "{came:?} of {told}");
    assert!(base.counts.messages.load(Ordering::Relaxed) <= robot.counts.messages.load(Ordering::Relaxed));
    assert!(base.links.is_finished("robot", "objects").0);
}
