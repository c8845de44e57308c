//! Input of a stage: decides which of the received messages is processed, and counts the others.

mod restart;
mod swap;

use super::handover::Watermark;
use crate::item_type::ItemType;
use crate::log::ThrottledWarning;
use crate::ports::{Delivery, PortError, Reader, Received};
use crate::status::{InputCounts, LastMessage};
use conicflow_messages::{Header, Text};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

/// Number of deaths on a message after which the stage does not get it again.
const MOST_DEATHS: u64 = 2;

/// Next action of a stage.
pub(crate) enum Step<M> {
    /// Process this message.
    Message(M),
    /// Acknowledge the next message without processing it: the stage has died on it too often.
    LeftOut,
    /// Wait: there is no message.
    Nothing,
}

/// Takes messages from a reader: checked, in order, and with [`Delivery::Latest`] only the newest.
#[cfg_attr(test, derive(Clone))]
pub struct InputPort<R: Reader> {
    reader: R,
    delivery: Delivery,
    /// Number of writers of the topic.
    writers: usize,
    /// Writers that have ended their stream.
    ended: BTreeSet<String>,
    /// Received messages that were not taken yet.
    pending: VecDeque<R::Message>,
    /// By source: epoch and sequence number of the last frame.
    last_frame: BTreeMap<Text<32>, (u64, u64)>,
    /// By writer: number of the last message.
    last_number: BTreeMap<Text<32>, u64>,
    counts: InputCounts,
    /// Position of this process.
    position: Watermark,
    /// Position of its predecessor.
    predecessor_position: Watermark,
    /// Writer and number of the last message that an earlier process counted, if this one has received it, too.
    last_counted: Option<(Text<32>, u64)>,
    /// By writer: number after the last received message.
    next_numbers: BTreeMap<Text<32>, u64>,
    /// Writers of messages that were received since the last acknowledgement.
    unacknowledged: BTreeSet<Text<32>>,
    /// By writer: last acknowledged position.
    acknowledged: BTreeMap<Text<32>, u64>,
    /// Whether the writers have counted their messages from the start of this run.
    has_all_from_first: bool,
    /// The stage that it drives, which does not get messages again that it has died on too often.
    driven: Option<Text<32>>,
    malformed_warning: ThrottledWarning,
}

impl<R: Reader> InputPort<R> {
    /// Input from `topic`, which has `writers` writers.
    pub fn new(reader: R, delivery: Delivery, topic: &str, writers: usize) -> Self {
        Self {
            reader,
            delivery,
            writers,
            ended: BTreeSet::new(),
            pending: VecDeque::new(),
            last_frame: BTreeMap::new(),
            last_number: BTreeMap::new(),
            counts: InputCounts { topic: Text::new(topic), ..InputCounts::default() },
            position: Watermark::default(),
            predecessor_position: Watermark::default(),
            last_counted: None,
            next_numbers: BTreeMap::new(),
            unacknowledged: BTreeSet::new(),
            acknowledged: BTreeMap::new(),
            has_all_from_first: false,
            driven: None,
            malformed_warning: ThrottledWarning::default(),
        }
    }

    /// Hashes all state that determines its behaviour, so that the model of the protocol can distinguish states.
    #[cfg(test)]
    pub(super) fn hash_state(&self, hasher: &mut impl std::hash::Hasher) {
        use std::hash::Hash;
        for header in self.buffered() {
            (header.number, header.sequence, header.epoch, header.flags).hash(hasher);
        }
        (&self.ended, &self.last_frame, &self.last_number, bytemuck::bytes_of(&self.counts)).hash(hasher);
        (&self.position, &self.predecessor_position, &self.last_counted).hash(hasher);
        (&self.next_numbers, &self.unacknowledged, &self.acknowledged).hash(hasher);
    }

    /// Type of its items.
    pub(crate) fn item(&self) -> &ItemType {
        self.reader.item()
    }

    /// Sets the stage that this input drives.
    pub(crate) fn drive(&mut self, stage: &str) {
        self.driven = Some(Text::new(stage));
    }

    /// Declares that its writers belong to this run: messages that they sent before the first received one count as lost.
    pub(crate) fn expect_from_first(&mut self) {
        self.has_all_from_first = self.delivery == Delivery::Lossless;
    }

    /// Sleeps until a message may have come, at most for `timeout`.
    ///
    /// # Errors
    /// The transport failed.
    pub fn wait(&mut self, timeout: Duration) -> Result<(), PortError> {
        self.reader.wait(timeout)
    }

    /// Takes the next message, if there is one.
    ///
    /// # Errors
    /// The transport failed.
    pub fn take(&mut self) -> Result<Option<R::Message>, PortError> {
        let Some((message, identity)) = self.next()? else { return Ok(None) };
        self.count_taken(identity, false);
        Ok(Some(message))
    }

    /// Takes the next message that the driven stage is to process.
    ///
    /// # Errors
    /// The transport failed.
    pub(crate) fn take_step(&mut self) -> Result<Step<R::Message>, PortError> {
        let Some((message, identity)) = self.next()? else { return Ok(Step::Nothing) };
        let is_deadly = self.reader.begin(identity.writer, identity.number) > MOST_DEATHS;
        self.count_taken(identity, is_deadly);
        if !is_deadly {
            return Ok(Step::Message(message));
        }
        let (stage, topic, frame) = (self.driven.unwrap_or_default(), &self.counts.topic, identity.sequence);
        tracing::error!(
            "stage `{stage}` leaves out frame {frame} of topic `{topic}`, which it has died of {MOST_DEATHS} times"
        );
        Ok(Step::LeftOut)
    }

    /// The next message and its identity.
    fn next(&mut self) -> Result<Option<(R::Message, LastMessage)>, PortError> {
        while self.delivery == Delivery::Latest || self.pending.is_empty() {
            let Some(message) = self.reader.receive()? else { break };
            if self.admit(&message) {
                self.enqueue(message);
            }
        }
        let Some(message) = self.pending.pop_front() else { return Ok(None) };
        let header = message.header();
        let (source, writer) = (header.origin(), header.writer());
        let &Header { number, epoch, sequence, .. } = header;
        self.position.numbers.insert(writer, number);
        self.position.frames.insert(source, (epoch, sequence));
        Ok(Some((message, LastMessage { writer, number, source, epoch, sequence })))
    }

    /// Whether a message is to be processed: it is well-formed and new, and not the end of a stream.
    fn admit(&mut self, message: &R::Message) -> bool {
        let header = message.header();
        let (source, writer) = (header.origin(), header.writer());
        if let Err(error) = self.reader.item().check(header, message.bytes()) {
            self.counts.malformed += 1;
            self.malformed_warning.warn(format_args!("left out a message of topic `{}`: {error}", self.counts.topic));
            self.record_received(writer, header.number.saturating_add(1));
            return false;
        }
        if header.ends_stream() {
            self.record_end(header, writer);
            return false;
        }
        if self.predecessor_processed(header, writer) {
            return false;
        }
        self.record_received(writer, header.number.saturating_add(1));
        if self.is_repeated(header, source, writer) {
            self.counts.late += 1;
            return false;
        }
        self.count_lost(header, writer);
        let is_new = self.in_sequence(header, source);
        if is_new {
            // A restarted stage of another machine numbers from 0 again.
            self.next_numbers.insert(writer, header.number.saturating_add(1));
        }
        is_new
    }

    /// Whether a message repeats the last one: its writer was killed after it had sent the message and before it had recorded
    /// that, so its next process sent it again.
    fn is_repeated(&self, header: &Header, source: Text<32>, writer: Text<32>) -> bool {
        let is_same_frame = |(_, sequence): &(u64, u64)| *sequence == header.sequence;
        self.last_number.get(&writer) == Some(&header.number) && self.last_frame.get(&source).is_some_and(is_same_frame)
    }

    /// Whether the predecessor has processed a message. After the first new message of a writer all are new.
    fn predecessor_processed(&mut self, header: &Header, writer: Text<32>) -> bool {
        let known = self.predecessor_position.numbers.get(&writer).is_some_and(|last| header.number <= *last);
        if !known {
            self.predecessor_position.numbers.remove(&writer);
        }
        known
    }

    /// Records that the messages of `writer` with numbers below `next` were received.
    fn record_received(&mut self, writer: Text<32>, next: u64) {
        let received = self.next_numbers.entry(writer).or_default();
        *received = next.max(*received);
        self.unacknowledged.insert(writer);
    }

    /// Counts the messages of a writer that were lost before this one.
    fn count_lost(&mut self, header: &Header, writer: Text<32>) {
        let last = self.last_number.insert(writer, header.number);
        let first = if self.has_all_from_first { Some(0) } else { None };
        let Some(next) = last.map(|last| last.saturating_add(1)).or(first) else { return };
        let lost = header.number.saturating_sub(next);
        self.counts.dropped = self.counts.dropped.saturating_add(lost);
        if last.is_none() {
            // `in_sequence` does not count the frames before the first one of a source.
            self.counts.gaps = self.counts.gaps.saturating_add(lost);
        }
    }

    /// Whether a frame is newer than the last one of its source. Counts the missing frames in between.
    fn in_sequence(&mut self, header: &Header, source: Text<32>) -> bool {
        let last = self.last_frame.get(&source).copied();
        if let Some((epoch, sequence)) = last {
            if epoch == header.epoch && header.sequence <= sequence {
                self.counts.late += 1;
                return false;
            }
            let missing = header.sequence.saturating_sub(sequence.saturating_add(1));
            self.counts.gaps = self.counts.gaps.saturating_add(missing);
        }
        self.last_frame.insert(source, (header.epoch, header.sequence));
        true
    }

    /// Queues a message; with [`Delivery::Latest`] it replaces an older one of the same source.
    fn enqueue(&mut self, message: R::Message) {
        if self.delivery == Delivery::Latest {
            let source = message.header().origin();
            let before = self.pending.len();
            self.pending.retain(|older| older.header().origin() != source);
            self.count_gap((before - self.pending.len()) as u64);
        }
        self.pending.push_back(message);
    }

    /// Counts a message, unless an earlier process of this stage has counted it.
    fn count_taken(&mut self, message: LastMessage, is_left_out: bool) {
        let has_counted = |(writer, last): &(Text<32>, u64)| message.writer == *writer && message.number <= *last;
        if self.last_counted.as_ref().is_some_and(has_counted) {
            return;
        }
        self.last_counted = None;
        self.counts.last = message;
        if is_left_out {
            self.count_gap(1);
        } else {
            self.counts.received += 1;
        }
    }

    /// Records the end of a writer's stream, and counts its last messages that were never received.
    fn record_end(&mut self, end: &Header, writer: Text<32>) {
        self.ended.insert(writer.to_string());
        let last = self.last_number.get(&writer).copied();
        // With several writers, an earlier process of this stage may have received messages that this one does not know of.
        let first = if self.writers == 1 && self.delivery == Delivery::Lossless { Some(0) } else { None };
        let Some(next) = last.map(|last| last.saturating_add(1)).or(first) else { return };
        let lost = end.number.saturating_sub(next);
        if lost > 0 {
            self.count_gap(lost);
            self.last_number.insert(writer, end.number - 1);
        }
    }

    /// Counts lost messages, and their frames as gaps.
    fn count_gap(&mut self, lost: u64) {
        self.counts.dropped = self.counts.dropped.saturating_add(lost);
        self.counts.gaps = self.counts.gaps.saturating_add(lost);
    }

    /// Position of this process.
    pub(crate) fn position(&mut self) -> &Watermark {
        self.position.ended.clone_from(&self.ended);
        &self.position
    }

    /// Headers of the buffered messages.
    pub(crate) fn buffered(&self) -> impl Iterator<Item = &Header> {
        self.pending.iter().map(Received::header)
    }

    /// Whether no received message is pending.
    pub fn is_idle(&self) -> bool {
        self.pending.is_empty()
    }

    /// Whether every writer has ended its stream, and no message is pending.
    pub(crate) fn ended(&self) -> bool {
        self.ended.len() >= self.writers && self.pending.is_empty()
    }

    /// Whether this writer has ended its stream.
    pub fn has_ended(&self, writer: &str) -> bool {
        self.ended.contains(writer)
    }

    /// Number of messages that a writer has sent, as far as is known here.
    pub fn count_of(&self, writer: &str) -> u64 {
        self.last_number.get(&Text::new(writer)).map_or(0, |last| last.saturating_add(1))
    }

    /// Counts of this input.
    pub fn counts(&self) -> InputCounts {
        self.counts
    }
}
