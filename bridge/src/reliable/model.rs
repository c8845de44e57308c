//! A model of a lossless edge between two bridges, which `stateright` walks through in every order in which messages, heartbeats,
//! kills, restarts and ends can come. It drives what numbers, keeps and judges messages in earnest; what reads and writes shared
//! memory, the link and the files is modelled. Time matters only where somebody is waited for: who is there is heard now, and who has
//! left was heard long ago.

use super::passed_on::PassedOn;
use super::retransmit_queue::RetransmitQueue;
use super::send_log::SendLog;
use super::sequence::{Claim, Sequence, Verdict};
use crate::edge_tests::edge;
use crate::peer::heartbeat::Ack;
use crate::wire::{Place, encode_message, place_of};
use conicflow_dataflow::pipeline::Compression;
use conicflow_dataflow::ports::Delivery;
use conicflow_messages::Header;
use stateright::{Checker, HasDiscoveries, Model, Property};
use std::collections::{HashMap, VecDeque};
use std::fmt::{self, Debug, Formatter};
use std::hash::{Hash, Hasher};
use std::time::{Duration, Instant};

const ROBOT: usize = 0;
const BASE: usize = 1;
const WRITER: &str = "writer";
/// Longer than anything is waited for.
const LONG: Duration = Duration::from_secs(100);

/// What is left out of the protocol, to see that the model finds it out.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    None,
    /// What was not acknowledged goes with the process that sent it.
    KeepsNoLog,
    /// What has come counts as finished, although the readers have not.
    FinishesFirst,
    /// The end counts as known there before its readers know it.
    TellsEndFirst,
    /// The other bridge's farewell is not waited for.
    LeavesAtOnce,
    /// What the base wants nothing more of is not noted by the robot.
    NotesNothing,
}

/// What is walked through.
#[derive(Clone, Debug)]
struct Trial {
    messages: u64,
    /// How often each bridge may be killed.
    kills: [u8; 2],
    /// Whether there is a key, by which each knows who has made what comes.
    has_key: bool,
    fault: Fault,
    start: Instant,
}

/// When a process is killed while it sends something.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Killed {
    Not,
    /// What it sends lies in the log, and has not gone out.
    Logged,
    /// It has gone out, and the writer does not know that it needs it no more.
    Sent,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Event {
    /// The robot's bridge sends the next message, or the end.
    Send(Killed),
    /// What is first on the link comes.
    Come,
    /// What is not acknowledged is sent again.
    SendAgain,
    /// The base is heard by the robot.
    HearBase,
    /// The robot is heard by the base.
    HearRobot,
    /// The reader finishes a message.
    Finish,
    /// The reader is told the end.
    TellEnd,
    /// The base's bridge notes that nothing more is wanted.
    NoteFinished,
    Kill(usize),
    /// A bridge has done all its work.
    Leave(usize),
    /// The robot's bridge is killed when it has removed its log, before it has noted that it has ended.
    KillAtEnd,
}

impl Event {
    fn kills(self) -> bool {
        matches!(self, Self::Send(Killed::Logged | Killed::Sent) | Self::Kill(_) | Self::KillAtEnd)
    }
}

/// The bridge that sends.
#[derive(Clone)]
struct Sender {
    queue: RetransmitQueue,
    /// Number of the writer's message that it takes next; that behind the last one is the end.
    next: u64,
    /// What this process has heard that the base has.
    ack: Option<Ack>,
}

/// The bridge that receives.
#[derive(Clone)]
struct Receiver {
    sequence: Sequence,
    passed_on: PassedOn,
    /// The number that follows the last one that was passed on.
    follow: Option<u64>,
    has_ended: bool,
    /// Whether this process has heard that the robot knows that nothing more is wanted.
    is_known: bool,
}

/// The edge, with what lies in files and in shared memory.
#[derive(Clone)]
struct Edge {
    now: Instant,
    kills: [u8; 2],
    starts: u64,
    robot: Option<Sender>,
    base: Option<Receiver>,
    /// What the robot's writer need not keep any more.
    acknowledged: u64,
    /// What lies in the log of the robot's bridge.
    log: Vec<Vec<u8>>,
    /// What the robot's journal has: the base was heard, and wants nothing more.
    has_heard: bool,
    knows_finished: bool,
    /// What the base's journal has.
    is_finished: bool,
    link: VecDeque<Vec<u8>>,
    /// What was passed on, and is not finished.
    held: VecDeque<u64>,
    /// What the reader has finished.
    finished: Vec<u64>,
    /// How many there are, as the reader is told.
    told: Option<u64>,
    /// What the robot tells as lost at its end.
    lost: u64,
}

impl Edge {
    /// What tells two states apart: not the time, nor what follows from the rest.
    fn essence(&self) -> impl Hash + PartialEq + Debug {
        let place = |bytes: &Vec<u8>| {
            let Place { stream, number, oldest } = place_of(bytes).unwrap();
            (stream, number, oldest, content(bytes))
        };
        let robot = self.robot.as_ref().map(|robot| {
            let ack = robot.ack.as_ref().map(|ack| (ack.stream, ack.next, ack.finished, ack.ended.len()));
            (robot.queue.essence(), robot.next, ack)
        });
        let base = self.base.as_ref().map(|base| {
            let finished = base.passed_on.clone().finished(self.held.len(), base.sequence.expected());
            (base.sequence.essence(), finished, base.follow, base.has_ended, base.is_known)
        });
        let noted = (self.acknowledged, self.has_heard, self.knows_finished, self.is_finished, self.told, self.lost);
        let under_way: Vec<_> = self.link.iter().chain(&self.log).map(place).collect();
        let read = (self.held.clone(), self.finished.clone(), self.link.len());
        (self.kills, robot, base, noted, under_way, read)
    }
}

impl PartialEq for Edge {
    fn eq(&self, other: &Self) -> bool {
        self.essence() == other.essence()
    }
}

impl Eq for Edge {}

impl Hash for Edge {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.essence().hash(state);
    }
}

impl Debug for Edge {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        self.essence().fmt(f)
    }
}

/// A message as it goes onto the link, and behind it what the reader is to see of it.
fn message(place: Place, number: u64, ends: bool) -> Vec<u8> {
    let item = edge(Delivery::Lossless, "reader").item;
    let mut bytes = encode_message(place, &item, &Header::default(), &[], Compression::None).unwrap();
    bytes.extend(number.to_le_bytes());
    bytes.push(u8::from(ends));
    bytes
}

/// The writer's number of a message, and whether it is the end, which tells how many there were.
fn content(bytes: &[u8]) -> (u64, bool) {
    let (rest, ends) = bytes.split_at(bytes.len() - 1);
    let number = rest.last_chunk().map(|number| u64::from_le_bytes(*number));
    (number.unwrap(), ends == [1])
}

impl Edge {
    fn new(trial: &Trial) -> Self {
        let mut edge = Self {
            now: trial.start,
            kills: [0; 2],
            starts: 0,
            robot: None,
            base: None,
            acknowledged: 0,
            log: Vec::new(),
            has_heard: false,
            knows_finished: false,
            is_finished: false,
            link: VecDeque::new(),
            held: VecDeque::new(),
            finished: Vec::new(),
            told: None,
            lost: 0,
        };
        edge.start_robot();
        edge.start_base(trial);
        edge
    }

    fn start_robot(&mut self) {
        self.starts += 1;
        let receivers = edge(Delivery::Lossless, "reader").to;
        let queue = RetransmitQueue::new(self.starts, SendLog::of(&self.log), &receivers, [LONG; 2], self.now);
        self.robot = Some(Sender { queue, next: self.acknowledged, ack: None });
    }

    fn start_base(&mut self, trial: &Trial) {
        let (sequence, passed_on) = (Sequence::new(true, trial.has_key), PassedOn::default());
        self.base = Some(Receiver { sequence, passed_on, follow: None, has_ended: false, is_known: false });
    }

    /// What the base's bridge acknowledges.
    fn ack(&mut self, fault: Fault) -> Option<Ack> {
        let base = self.base.as_mut()?;
        let (stream, next) = base.sequence.expected();
        let unfinished = if fault == Fault::FinishesFirst { 0 } else { self.held.len() };
        let finished = base.passed_on.finished(unfinished, (stream, next));
        let ended = if base.has_ended { vec![WRITER.to_owned()] } else { Vec::new() };
        Some(Ack { from: "robot".into(), topic: "objects".into(), stream, next, finished, ended })
    }

    /// What the robot's bridge makes of what it knows, as it does before each step.
    fn settle(&mut self) {
        let heard = if self.base.is_some() { self.now } else { self.now - 10 * LONG };
        let heard = self.has_heard.then_some(heard);
        let Some(robot) = &mut self.robot else { return };
        if self.knows_finished {
            robot.queue.finish("base", self.now);
        } else {
            robot.queue.acknowledge("base", robot.ack.as_ref(), heard, self.now);
        }
        self.log = robot.queue.kept();
    }

    /// Sends the next message, or the end.
    fn send(&mut self, killed: Killed, trial: &Trial) -> Option<()> {
        let robot = self.robot.as_mut().filter(|robot| robot.next <= trial.messages)?;
        if !robot.queue.may_send(self.now, |_| None) {
            return None;
        }
        let (number, ends) = (robot.next, robot.next == trial.messages);
        let bytes = message(robot.queue.place(), number, ends);
        if ends {
            robot.queue.sent_end(WRITER, &bytes, self.now);
        } else {
            robot.queue.sent(&bytes, self.now);
        }
        robot.next += 1;
        self.log = robot.queue.kept();
        if killed == Killed::Logged {
            return self.kill(ROBOT, trial);
        }
        self.link.push_back(bytes);
        if killed == Killed::Sent {
            return self.kill(ROBOT, trial);
        }
        // The end of a writer that is over is told by every process.
        self.acknowledged = self.acknowledged.max(self.robot.as_ref()?.next).min(trial.messages);
        Some(())
    }

    /// Takes what is first on the link.
    fn come(&mut self) -> Option<()> {
        let bytes = self.link.pop_front()?;
        let base = self.base.as_mut()?;
        if self.is_finished {
            // Nobody looks at it.
            return Some(());
        }
        let (place, (number, ends)) = (place_of(&bytes).unwrap(), content(&bytes));
        let claim = Claim {
            place,
            session: self.starts,
            number: Some(number),
            follows: base.follow.is_none_or(|follow| follow == number),
            may_be_repeated: ends,
        };
        let verdict = base.sequence.judge(claim, self.now);
        if verdict == Verdict::Take {
            if !ends {
                self.held.push_back(number);
                base.passed_on.add(base.sequence.expected());
            }
            base.sequence.taken();
            base.follow = Some(number + 1);
        }
        base.has_ended |= ends && base.sequence.is_end_to_hear(place, verdict);
        Some(())
    }

    fn send_again(&mut self) -> Option<()> {
        // What is on its way comes first.
        if !self.link.is_empty() || self.base.is_none() {
            return None;
        }
        let again = self.robot.as_mut()?.queue.due(self.now, |_| true);
        self.link.extend(again);
        Some(())
    }

    /// A killed process loses what it knows and what is on its way; with the base's bridge goes what was not finished, too.
    fn kill(&mut self, bridge: usize, trial: &Trial) -> Option<()> {
        if self.kills[bridge] >= trial.kills[bridge] {
            return None;
        }
        self.kills[bridge] += 1;
        self.link.clear();
        if bridge == ROBOT {
            self.robot.take()?;
            if trial.fault == Fault::KeepsNoLog {
                self.log.clear();
            }
            self.start_robot();
        } else {
            self.base.take()?;
            self.held.clear();
            if let Some(robot) = &mut self.robot {
                robot.ack = None;
            }
            self.start_base(trial);
        }
        Some(())
    }

    fn leave(&mut self, bridge: usize, trial: &Trial) -> Option<()> {
        if bridge == BASE {
            let base = self.base.as_ref().filter(|_| self.is_finished)?;
            // It stays until the other one knows, or has left.
            if !base.is_known && self.robot.is_some() && trial.fault != Fault::LeavesAtOnce {
                return None;
            }
            self.base = None;
            return Some(());
        }
        let is_done = |robot: &&Sender| robot.next > trial.messages && robot.queue.is_settled(self.now);
        self.lost = self.robot.as_ref().filter(is_done)?.queue.lost_if_it_ends();
        self.robot = None;
        self.log.clear();
        Some(())
    }

    fn kill_at_end(&mut self, trial: &Trial) -> Option<()> {
        if self.kills[ROBOT] >= trial.kills[ROBOT] {
            return None;
        }
        self.kills[ROBOT] += 1;
        self.leave(ROBOT, trial)?;
        self.link.clear();
        self.start_robot();
        Some(())
    }

    /// What follows from an event; nothing where it cannot be.
    fn after(&self, event: Event, trial: &Trial) -> Option<Self> {
        let mut next = Self { now: self.now + 10 * Duration::from_secs(1), ..self.clone() };
        next.settle();
        match event {
            Event::Send(killed) => next.send(killed, trial)?,
            Event::Come => next.come()?,
            Event::SendAgain => next.send_again()?,
            Event::HearBase => {
                let ack = next.ack(trial.fault)?;
                let robot = next.robot.as_mut()?;
                robot.ack = Some(ack);
                next.has_heard = true;
                next.knows_finished |= next.is_finished && trial.fault != Fault::NotesNothing;
            }
            Event::HearRobot => {
                next.robot.as_ref()?;
                let knows_finished = next.knows_finished;
                next.base.as_mut()?.is_known = knows_finished;
            }
            Event::Finish => {
                let number = next.held.pop_front()?;
                // What comes again is dropped by its number.
                if next.finished.last().is_none_or(|last| *last < number) {
                    next.finished.push(number);
                }
            }
            Event::TellEnd => {
                let is_due = next.base.as_ref()?.has_ended && next.held.is_empty() && next.told.is_none();
                next.told = is_due.then_some(trial.messages);
                next.told?;
            }
            Event::NoteFinished => {
                let base = next.base.as_ref()?;
                // A reader that a process before this one has told the end is over.
                let is_due = next.told.is_some() || (trial.fault == Fault::TellsEndFirst && base.has_ended);
                if !is_due || next.is_finished {
                    return None;
                }
                next.is_finished = true;
            }
            Event::Kill(bridge) => next.kill(bridge, trial)?,
            Event::Leave(bridge) => next.leave(bridge, trial)?,
            Event::KillAtEnd => next.kill_at_end(trial)?,
        }
        next.settle();
        (next != *self).then_some(next)
    }

    fn is_over(&self) -> bool {
        self.robot.is_none() && self.base.is_none()
    }
}

const EVENTS: [Event; 15] = [
    Event::Send(Killed::Not),
    Event::Send(Killed::Logged),
    Event::Send(Killed::Sent),
    Event::Come,
    Event::SendAgain,
    Event::HearBase,
    Event::HearRobot,
    Event::Finish,
    Event::TellEnd,
    Event::NoteFinished,
    Event::Kill(ROBOT),
    Event::Kill(BASE),
    Event::Leave(ROBOT),
    Event::Leave(BASE),
    Event::KillAtEnd,
];

impl Model for Trial {
    type State = Edge;
    type Action = Event;

    fn init_states(&self) -> Vec<Edge> {
        vec![Edge::new(self)]
    }

    fn actions(&self, edge: &Edge, events: &mut Vec<Event>) {
        events.extend(EVENTS.into_iter().filter(|event| edge.after(*event, self).is_some()));
    }

    fn next_state(&self, edge: &Edge, event: Event) -> Option<Edge> {
        edge.after(event, self)
    }

    fn properties(&self) -> Vec<Property<Self>> {
        vec![
            Property::always("both bridges come to their end", |trial: &Self, edge: &Edge| {
                edge.is_over() || EVENTS.into_iter().any(|event| edge.after(event, trial).is_some())
            }),
            Property::always("messages are finished in their order, each once", |_, edge: &Edge| {
                edge.finished.iter().copied().eq(0..edge.finished.len() as u64)
            }),
            Property::always("none is told as lost", |_, edge: &Edge| edge.lost == 0),
            Property::always("all are finished in the end", |trial: &Self, edge: &Edge| {
                !edge.is_over() || edge.finished.len() as u64 == trial.messages
            }),
            Property::sometimes("the edge ends", |_, edge: &Edge| edge.is_over()),
        ]
    }
}

impl Trial {
    fn new(messages: u64, kills: [u8; 2]) -> Self {
        Self { messages, kills, has_key: true, fault: Fault::None, start: Instant::now() + 100 * LONG }
    }

    /// Walks through all states, and prints how each property that does not hold is broken; which ones these are.
    fn broken(self) -> (Vec<&'static str>, usize) {
        let checker = self.clone().checker().threads(2).finish_when(HasDiscoveries::AnyFailures).spawn_bfs().join();
        let states = checker.unique_state_count();
        println!("{self:?}: {states} states");
        let mut broken = Vec::new();
        for (name, path) in checker.discoveries() {
            if name != "the edge ends" {
                println!("not so: {name}\n  {:?}\n  {:?}", path.clone().into_actions(), path.last_state());
                broken.push(name);
            }
        }
        assert!(checker.discovery("the edge ends").is_some() || !broken.is_empty(), "no edge comes to its end");
        (broken, states)
    }

    /// A state from which no events but kills lead to the end, if there is one: bridges that go on talking for ever.
    fn endless(&self) -> Option<Edge> {
        let mut states = vec![Edge::new(self)];
        let mut numbers = HashMap::from([(states[0].clone(), 0)]);
        let mut before: Vec<Vec<usize>> = vec![Vec::new()];
        let mut looked_at = 0;
        while looked_at < states.len() {
            for event in EVENTS {
                let Some(next) = states[looked_at].after(event, self) else { continue };
                let number = *numbers.entry(next).or_insert_with_key(|next| {
                    states.push(next.clone());
                    before.push(Vec::new());
                    states.len() - 1
                });
                if !event.kills() {
                    before[number].push(looked_at);
                }
            }
            looked_at += 1;
        }
        let mut left: Vec<usize> = (0..states.len()).filter(|number| states[*number].is_over()).collect();
        let mut ends = vec![false; states.len()];
        while let Some(number) = left.pop() {
            if !std::mem::replace(&mut ends[number], true) {
                left.append(&mut before[number]);
            }
        }
        ends.iter().position(|ends| !ends).map(|number| states.swap_remove(number))
    }

    fn expect_to_hold(self, floor: usize) {
        let (broken, states) = self.clone().broken();
        assert!(broken.is_empty(), "{broken:?}: {self:?}");
        assert_eq!(self.endless(), None, "{self:?}");
        assert!(states > floor, "{states} states are too few: {self:?}");
    }
}

#[test]
fn no_order_of_events_loses_anything_or_keeps_a_bridge_waiting() {
    for has_key in [true, false] {
        for (messages, kills) in [(3, [0, 0]), (2, [1, 0]), (2, [0, 1]), (1, [1, 1])] {
            Trial { has_key, ..Trial::new(messages, kills) }.expect_to_hold(1000);
        }
    }
}

/// The same for longer: as long as it takes.
#[test]
#[ignore = "takes minutes"]
fn no_longer_order_of_events_loses_anything_or_keeps_a_bridge_waiting() {
    for has_key in [true, false] {
        for (messages, kills) in [(2, [1, 1]), (1, [2, 1]), (1, [1, 2])] {
            Trial { has_key, ..Trial::new(messages, kills) }.expect_to_hold(10_000);
        }
    }
}

#[test]
fn what_a_lossless_edge_stands_on_cannot_be_left_out() {
    for (fault, kills) in [
        (Fault::KeepsNoLog, [1, 0]),
        (Fault::FinishesFirst, [0, 1]),
        (Fault::TellsEndFirst, [0, 1]),
        (Fault::LeavesAtOnce, [1, 0]),
    ] {
        assert!(!Trial { fault, ..Trial::new(2, kills) }.broken().0.is_empty(), "{fault:?} is not found out");
    }
    let trial = Trial { fault: Fault::NotesNothing, ..Trial::new(2, [0, 0]) };
    assert!(trial.endless().is_some(), "that they go on talking for ever is not found out");
}
