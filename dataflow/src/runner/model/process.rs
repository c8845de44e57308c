//! A process of the model: the real ports of a stage, and the steps between which it can be killed.

use super::memory::{Fault, ModelMessage, ModelReader, ModelWriter, Record, STAGES, TOPICS, life, memory};
use crate::ports::{Delivery, Received, TopicReader};
use crate::runner::handover::Watermark;
use crate::runner::input_port::{InputPort, Step};
use crate::runner::output_port::{EndAnnouncement, OutputPort, end_of_stream};
use crate::runner::peers::Peers;
use crate::status::Life;
use crate::stop::Stop;
use conicflow_messages::{Camera, Header, Text};
use std::hash::{Hash, Hasher};
use std::time::{Duration, Instant};

/// How a process ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum Exit {
    InOrder,
    Killed,
}

/// Position of a process in its code.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum At {
    /// Before `stage_runtime`.
    Spawned,
    /// After `StageRuntime::enter` and the opening of the ports, in `Stage::new`.
    Opened,
    /// `StagePlace::poll`; of a source `SourcePlace::is_due`.
    Looking,
    /// Between `StagePlace::poll` and `OutputPort::send`.
    Working,
    /// Between `OutputPort::send` and the record in `keep_counts`.
    Sent,
    /// Between the record and `InputPort::acknowledge`.
    Recorded,
    /// `OutputPort::await_finish`, in `end_each`.
    Finishing,
    /// `OutputPort::announce_end`, in `end_each`.
    Announcing,
    /// Before `set_life(Ended)` is in the record.
    Announced,
    /// After `set_life(Ended)` is in the record.
    Ended,
    /// `OutputPort::await_finish`, in `StagePlace::end` of a stage that hands its place over.
    Left,
    /// `takeover::await_first_messages`.
    Buffering,
    /// `Successor::await_turn`.
    Ready,
    /// After `Successor::await_turn` has returned.
    HasTurn,
}

/// A process of a stage.
#[derive(Clone)]
pub(super) struct Process {
    stage: usize,
    pub(super) number: u8,
    pub(super) at: At,
    is_successor: bool,
    pub(super) is_asked_to_end: bool,
    pub(super) is_asked_to_leave: bool,
    leaves_at: Option<Watermark>,
    input: Option<InputPort<ModelReader>>,
    in_hand: Option<ModelMessage>,
    /// Whether it has sent a message, and waits in `SharedWriter::await_first_sight`.
    awaits_sight: bool,
    /// Number of messages that its output has sent; for a source also that of messages made.
    sent: u64,
    announcement: EndAnnouncement,
}

impl Hash for Process {
    fn hash<H: Hasher>(&self, hasher: &mut H) {
        (self.number, self.at, self.is_successor, self.is_asked_to_end, self.is_asked_to_leave).hash(hasher);
        (&self.leaves_at, &self.in_hand, self.awaits_sight, self.sent).hash(hasher);
        (&self.announcement.before, &self.announcement.reached).hash(hasher);
        self.input.iter().for_each(|input| input.hash_state(hasher));
    }
}

impl std::fmt::Debug for Process {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "process {} {:?}, sent {}", self.number, self.at, self.sent)
    }
}

/// Changes the record of a stage.
fn record<V>(stage: usize, change: impl FnOnce(&mut Record) -> V) -> V {
    memory(|memory| change(&mut memory.records[stage]))
}

impl Process {
    pub(super) fn spawn(stage: usize, number: u8, is_successor: bool) -> Self {
        // The deadline for absent readers is out of reach.
        let announcement = EndAnnouncement::until(Instant::now() + Duration::from_secs(1 << 20));
        Self {
            stage,
            number,
            at: At::Spawned,
            is_successor,
            is_asked_to_end: false,
            is_asked_to_leave: false,
            leaves_at: None,
            input: None,
            in_hand: None,
            awaits_sight: false,
            sent: 0,
            announcement,
        }
    }

    /// Makes the next step, unless it would block. Returns how the process ended, if it has.
    pub(super) fn step(&mut self, frames: u64) -> Option<Exit> {
        if self.awaits_sight && !memory(|memory| memory.topics[self.stage].is_seen(self.number)) {
            return None;
        }
        self.awaits_sight = false;
        match self.at {
            At::Spawned => self.open(),
            At::Opened => self.begin(),
            At::Looking if self.stage == 0 => self.make(frames),
            At::Looking => self.look(),
            At::Working => self.work(),
            At::Sent => self.keep_record(),
            At::Recorded => {
                self.acknowledge();
                self.at = At::Looking;
            }
            At::Finishing => self.go_on_when_finished(At::Announcing),
            At::Announcing => self.announce_end(),
            At::Announced => {
                record(self.stage, |own| own.life = Life::Ended);
                self.at = At::Ended;
            }
            At::Ended => return Some(Exit::InOrder),
            At::Left if self.is_waited_for() => self.output().catch_up(),
            At::Left => return Some(Exit::InOrder),
            At::Buffering => self.buffer(),
            At::Ready => {}
            At::HasTurn => self.take_place(),
        }
        None
    }

    /// Input of a process that reads messages; the source has none.
    fn input(&mut self) -> &mut InputPort<ModelReader> {
        self.input.as_mut().expect("only stages with an input come here")
    }

    /// A real output port. Its only state is the number of messages sent.
    fn output(&self) -> OutputPort<ModelWriter> {
        let writer = ModelWriter { stage: self.stage, process: self.number };
        let port = TOPICS.get(self.stage).map(|topic| (writer, topic.clone()));
        OutputPort::new(port, STAGES[self.stage], self.sent, Peers::modelled(life), Stop::default())
    }

    fn open_input(&mut self, is_again: bool) {
        if self.stage > 0 {
            let reader = ModelReader::open(self.stage, self.number, is_again);
            let topic = &TOPICS[self.stage - 1];
            self.input = Some(InputPort::new(reader, Delivery::Lossless, &topic.name, topic.writers.len()));
        }
    }

    /// `stage_runtime` and the opening of ports in `run_stage`. The creation of an iceoryx2 node cleans up dead processes.
    fn open(&mut self) {
        memory(|memory| memory.clear_away());
        if !self.is_successor {
            self.enter();
        }
        self.open_input(false);
        self.at = if self.is_successor { At::Buffering } else { At::Opened };
    }

    fn enter(&mut self) {
        record(self.stage, |own| (own.life, own.process) = (Life::Starting, self.number));
    }

    /// Models `StagePlace::begin` and `SourcePlace::begin`.
    fn begin(&mut self) {
        let counts = record(self.stage, |own| own.counts);
        let forgets = memory(|memory| memory.fault == Fault::ForgetsRecord);
        self.sent = if forgets { 0 } else { record(self.stage, |own| own.sent) };
        if let Some(input) = &mut self.input {
            input.drive(STAGES[self.stage]);
            input.expect_from_first();
            input.resume(counts);
        }
        record(self.stage, |own| own.life = Life::Running);
        self.at = At::Looking;
    }

    /// Makes the next frame and sends it, or starts to finish if there is none.
    fn make(&mut self, frames: u64) {
        if self.sent >= frames || self.is_asked_to_end {
            self.at = At::Finishing;
            return;
        }
        let camera = Camera { width: 2, height: 2, fx: 1.0, fy: 1.0, cx: 0.5, cy: 0.5 };
        let epoch = u64::from(self.number) + 1;
        let frame = Header { sequence: self.sent, epoch, camera, depth_scale: 0.001, ..Header::default() };
        self.send(frame);
    }

    /// Models `StagePlace::poll`, which checks first whether the writers are gone.
    fn look(&mut self) {
        if self.may_leave() {
            return self.end();
        }
        let writer = STAGES[self.stage - 1];
        let is_over = life(writer).is_some_and(Life::is_over);
        let last_call = self.input().is_idle() && (self.input().has_ended(writer) || is_over);
        match self.input().take_step().expect("the model's memory does not fail") {
            Step::Message(message) => {
                self.in_hand = Some(message);
                self.at = At::Working;
                if memory(|memory| memory.fault == Fault::AcknowledgesFirst) {
                    self.acknowledge();
                }
                return;
            }
            Step::LeftOut => return self.keep_record(),
            Step::Nothing => {}
        }
        self.acknowledge();
        self.output().catch_up();
        if last_call || self.input().ended() {
            self.end();
        }
    }

    fn may_leave(&mut self) -> bool {
        if !self.is_asked_to_leave {
            return false;
        }
        let first = || memory(|memory| memory.first_to_receive.clone()).unwrap_or_default();
        let leaves_at = self.leaves_at.get_or_insert_with(first).clone();
        self.input().has_passed(&leaves_at)
    }

    fn acknowledge(&mut self) {
        self.input.iter_mut().for_each(InputPort::acknowledge);
    }

    fn work(&mut self) {
        let Some(header) = self.in_hand.as_ref().map(|message| *message.header()) else { return };
        self.send(header);
        if self.at == At::Sent {
            memory(|memory| memory.topics[self.stage - 1].worked_on.push(header.number));
            self.in_hand = None;
        }
    }

    /// Models `OutputPort::send` if it would not block; `await_readers` then returns at once.
    fn send(&mut self, header: Header) {
        let mut output = self.output();
        if output.behind(TopicReader::credit).next().is_some() {
            output.catch_up();
            return;
        }
        if output.absent_readers(false).next().is_some() {
            // `await_readers` returns `PortError::Stopped`.
            self.at = if self.is_asked_to_end { At::Finishing } else { self.at };
            return;
        }
        output.send(header, 0, Some(&[])).expect("the model's memory does not fail");
        self.sent += 1;
        self.at = At::Sent;
        self.await_sight();
    }

    fn await_sight(&mut self) {
        let is_waited_for = memory(|memory| memory.fault != Fault::GoesOnUnseen);
        self.awaits_sight = self.stage < TOPICS.len() && is_waited_for;
    }

    fn keep_record(&mut self) {
        let counts = self.input.as_ref().map(InputPort::counts);
        record(self.stage, |own| {
            own.sent = self.sent;
            own.counts = counts.unwrap_or_default();
        });
        self.at = if self.stage == 0 { At::Looking } else { At::Recorded };
    }

    /// Models `StagePlace::end`.
    fn end(&mut self) {
        if self.leaves_at.is_some() && !self.input().ended() {
            let worked_on = self.input().position().clone();
            memory(|memory| memory.last_worked_on = Some(worked_on));
            self.at = At::Left;
            return;
        }
        let writer = STAGES[self.stage - 1];
        let is_end_heard = self.input().has_ended(writer);
        memory(|memory| memory.topics[self.stage - 1].is_end_heard = is_end_heard);
        self.keep_record();
        self.input = None;
        memory(|memory| memory.close_input(self.stage, self.number));
        self.at = if self.stage < TOPICS.len() { At::Finishing } else { At::Announced };
    }

    /// Whether a reader has not finished the messages that this process keeps for it.
    fn is_waited_for(&self) -> bool {
        self.output().behind(|_| 1).next().is_some()
    }

    /// Models `OutputPort::await_finish` without its timeout.
    fn go_on_when_finished(&mut self, next: At) {
        if self.is_waited_for() {
            self.output().catch_up();
        } else {
            self.at = next;
        }
    }

    fn announce_end(&mut self) {
        let forgets = memory(|memory| memory.fault == Fault::EndWithoutNumber);
        let count = if forgets { 0 } else { self.sent };
        let end = end_of_stream(&Header::default(), Text::new(STAGES[self.stage]), count);
        let announced = self
            .output()
            .announce_end(&[end], &mut self.announcement, Instant::now())
            .expect("the model's memory does not fail");
        self.at = if announced { At::Announced } else { self.at };
        self.await_sight();
    }

    /// Models `takeover::await_first_messages` and `Successor::is_ready`.
    fn buffer(&mut self) {
        self.input().buffer_newest().expect("the model's memory does not fail");
        let writer = STAGES[self.stage - 1];
        if self.input().has_buffered(writer) || life(writer).is_some_and(Life::is_over) {
            let first = self.input().first_buffered();
            memory(|memory| memory.first_to_receive = Some(first));
            self.at = At::Ready;
        }
    }

    /// Models the end of `takeover::take_place`, and what follows in `run_stage`.
    fn take_place(&mut self) {
        self.enter();
        match memory(|memory| memory.last_worked_on.clone()) {
            Some(last) => self.input().resume_from_handover(last),
            None => self.open_input(true),
        }
        self.at = At::Opened;
    }
}
