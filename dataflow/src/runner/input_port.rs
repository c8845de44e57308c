//! Input of a stage: decides which of the received messages is processed, and counts the others.

use super::handover::Watermark;
use crate::item_type::ItemType;
use crate::log::ThrottledWarning;
use crate::ports::{Delivery, MAX_KEPT, PortError, Reader, Received};
use crate::status::{InputCounts, LastMessage};
use conicflow_messages::{Header, Text};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

/// Maximum number of messages that are taken in a row.
const MOST_AT_ONCE: usize = 64;
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
    writers: usize,
    ended: BTreeSet<String>,
    pending: VecDeque<R::Message>,
    last_frame: BTreeMap<Text<32>, (u64, u64)>,
    last_number: BTreeMap<Text<32>, u64>,
    counts: InputCounts,
    /// Position of this process.
    worked_on: Watermark,
    /// Position of its predecessor.
    predecessor: Watermark,
    /// Writer and number of the last message that an earlier process counted, if this one has received it, too.
    counted: Option<(Text<32>, u64)>,
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
    nonsense: ThrottledWarning,
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
            worked_on: Watermark::default(),
            predecessor: Watermark::default(),
            counted: None,
            next_numbers: BTreeMap::new(),
            unacknowledged: BTreeSet::new(),
            acknowledged: BTreeMap::new(),
            has_all_from_first: false,
            driven: None,
            nonsense: ThrottledWarning::default(),
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
        (&self.worked_on, &self.predecessor, &self.counted).hash(hasher);
        (&self.next_numbers, &self.unacknowledged, &self.acknowledged).hash(hasher);
    }

    /// Type of its items.
    pub(crate) fn item(&self) -> &ItemType {
        self.reader.item()
    }

    /// Takes the next message, if there is one.
    ///
    /// # Errors
    /// The transport failed.
    pub fn take(&mut self) -> Result<Option<R::Message>, PortError> {
        let Some((message, which)) = self.next()? else { return Ok(None) };
        self.count_taken(which, false);
        Ok(Some(message))
    }

    /// Takes the next message that the driven stage is to process.
    ///
    /// # Errors
    /// The transport failed.
    pub(crate) fn take_step(&mut self) -> Result<Step<R::Message>, PortError> {
        let Some((message, which)) = self.next()? else { return Ok(Step::Nothing) };
        let is_deadly = self.reader.begin(which.writer, which.number) > MOST_DEATHS;
        self.count_taken(which, is_deadly);
        if !is_deadly {
            return Ok(Step::Message(message));
        }
        let (stage, topic, frame) = (self.driven.unwrap_or_default(), &self.counts.topic, which.sequence);
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
        self.worked_on.numbers.insert(writer, number);
        self.worked_on.frames.insert(source, (epoch, sequence));
        Ok(Some((message, LastMessage { writer, number, source, epoch, sequence })))
    }

    /// Sets the stage that this input drives.
    pub(crate) fn drive(&mut self, stage: &str) {
        self.driven = Some(Text::new(stage));
    }

    /// Declares that its writers belong to this run: messages that they sent before the first received one count as lost.
    pub(crate) fn expect_from_first(&mut self) {
        self.has_all_from_first = self.delivery == Delivery::Lossless;
    }

    /// Acknowledges all received messages except those that are pending here or in `kept`: a restart of this stage does not need
    /// them.
    pub(crate) fn acknowledge_but<'a>(&mut self, kept: impl Iterator<Item = &'a Header> + Clone) {
        for writer in std::mem::take(&mut self.unacknowledged) {
            let own = |headers: &mut dyn Iterator<Item = &Header>| {
                headers.filter(|header| header.writer() == writer).map(|header| header.number).min()
            };
            let waits = own(&mut kept.clone()).into_iter().chain(own(&mut self.buffered())).min();
            let came = self.next_numbers.get(&writer).copied().unwrap_or_default();
            let next = waits.map_or(came, |first| first.min(came));
            // Released messages are not requested again. A restarted stage of another machine may number from 0 again.
            if self.acknowledged.get(&writer).is_none_or(|said| *said < next || *said > came) {
                self.acknowledged.insert(writer, next);
                self.reader.acknowledge(writer, next);
            }
            if waits.is_some() {
                self.unacknowledged.insert(writer);
            }
        }
    }

    /// Acknowledges all received messages except those that are pending here.
    pub fn acknowledge(&mut self) {
        self.acknowledge_but(std::iter::empty());
    }

    /// Whether its writers keep the messages that this stage has not finished.
    pub(crate) fn is_kept(&self) -> bool {
        self.reader.acknowledged().is_some()
    }

    /// Continues after the messages that an earlier process of this stage, which kept no counts, has finished.
    pub fn go_on(&mut self) {
        let finished = self.reader.acknowledged().unwrap_or_default();
        self.resume_from_acknowledged(finished, LastMessage::default());
    }

    /// Counts a message, unless an earlier process of this stage has counted it.
    fn count_taken(&mut self, message: LastMessage, is_left_out: bool) {
        let is_known = |(writer, last): &(Text<32>, u64)| message.writer == *writer && message.number <= *last;
        if self.counted.as_ref().is_some_and(is_known) {
            return;
        }
        self.counted = None;
        self.counts.last = message;
        if is_left_out {
            self.count_gap(1);
        } else {
            self.counts.received += 1;
        }
    }

    /// Position of this process.
    pub(crate) fn worked_on(&mut self) -> &Watermark {
        self.worked_on.ended.clone_from(&self.ended);
        &self.worked_on
    }

    /// Whether all messages before `first` were processed or can no longer come.
    pub(crate) fn has_passed(&self, first: &Watermark) -> bool {
        first.numbers.iter().all(|(writer, first)| {
            let seen = self.last_number.get(writer).map_or(0, |last| last.saturating_add(1)) >= *first;
            let is_before =
                |message: &R::Message| message.header().writer() == *writer && message.header().number < *first;
            (seen || self.ended.contains(writer.as_str().unwrap_or_default())) && !self.pending.iter().any(is_before)
        })
    }

    /// Buffers received messages until this process's turn comes.
    pub(crate) fn buffer_ahead(&mut self) -> Result<(), PortError> {
        while self.pending.len() < MAX_KEPT {
            let Some(message) = self.reader.receive()? else { break };
            self.pending.push_back(message);
        }
        Ok(())
    }

    /// Buffers all received messages, so that no writer is blocked while another one has not sent yet. If the buffer is full, it
    /// drops the first message of a writer of which a later one is buffered, and leaves it to the predecessor.
    pub(crate) fn buffer_newest(&mut self) -> Result<(), PortError> {
        for _ in 0..MOST_AT_ONCE {
            let Some(message) = self.reader.receive()? else { break };
            self.pending.push_back(message);
            let Some(dispensable) = self.dispensable().filter(|_| self.pending.len() >= MAX_KEPT) else {
                continue;
            };
            self.pending.remove(dispensable);
        }
        Ok(())
    }

    /// Index of the first message whose writer has a later one in the buffer.
    fn dispensable(&self) -> Option<usize> {
        let headers: Vec<_> = self.buffered().collect();
        (0..headers.len()).find(|&index| {
            let writer = headers[index].writer();
            !headers[index].ends_stream() && headers[index + 1..].iter().any(|later| later.writer() == writer)
        })
    }

    /// Headers of the buffered messages.
    pub(crate) fn buffered(&self) -> impl Iterator<Item = &Header> {
        self.pending.iter().map(Received::header)
    }

    /// Drops buffered messages, which the predecessor processes; never the end of a stream.
    pub(crate) fn drop_buffered(&mut self, forget: impl Fn(&Header) -> bool) {
        self.pending.retain(|message| message.header().ends_stream() || !forget(message.header()));
    }

    /// Whether a message of this writer is buffered.
    pub(crate) fn has_buffered(&self, writer: &str) -> bool {
        self.pending.iter().any(|message| message.header().writer() == Text::new(writer))
    }

    /// By writer: number of the first buffered message. An end of stream has the number that the next message would have.
    pub(crate) fn first_buffered(&self) -> Watermark {
        let mut first = Watermark::default();
        for header in self.buffered() {
            first.numbers.entry(header.writer()).or_insert(header.number);
        }
        first
    }

    /// Continues after the last message that the predecessor processed, with the buffered messages.
    pub(crate) fn resume_from_handover(&mut self, last: Watermark) {
        self.last_number.clone_from(&last.numbers);
        self.last_frame.clone_from(&last.frames);
        self.ended.clone_from(&last.ended);
        self.worked_on = last.clone();
        self.predecessor = last;
        self.admit_buffered();
    }

    /// Checks the buffered messages and queues them.
    pub(crate) fn admit_buffered(&mut self) {
        for message in std::mem::take(&mut self.pending) {
            if self.admit(&message) {
                self.enqueue(message);
            }
        }
    }

    /// Whether the predecessor has processed a message. After the first new message of a writer all are new.
    fn is_known(&mut self, header: &Header, writer: Text<32>) -> bool {
        let known = self.predecessor.numbers.get(&writer).is_some_and(|last| header.number <= *last);
        if !known {
            self.predecessor.numbers.remove(&writer);
        }
        known
    }

    /// Sleeps until a message may have come, at most for `timeout`.
    ///
    /// # Errors
    /// The transport failed.
    pub fn wait(&mut self, timeout: Duration) -> Result<(), PortError> {
        self.reader.wait(timeout)
    }

    /// Whether every writer has ended its stream, and no message is pending.
    pub(crate) fn ended(&self) -> bool {
        self.ended.len() >= self.writers && self.pending.is_empty()
    }

    /// Whether this writer has ended its stream.
    pub fn has_ended(&self, writer: &str) -> bool {
        self.ended.contains(writer)
    }

    /// Whether no received message is pending.
    pub fn is_idle(&self) -> bool {
        self.pending.is_empty()
    }

    /// Counts of this input.
    pub fn counts(&self) -> InputCounts {
        self.counts
    }

    /// Continues the counts of an earlier process, and continues after the messages that it finished, where the rest is sent
    /// again. Elsewhere its received but unprocessed messages are lost; their numbers show that if all messages come from one
    /// writer.
    pub fn resume(&mut self, counts: InputCounts) {
        if counts.topic != self.counts.topic {
            return;
        }
        self.counts = counts;
        let LastMessage { writer, number, source, epoch, sequence } = counts.last;
        if let Some(finished) = self.reader.acknowledged() {
            self.resume_from_acknowledged(finished, counts.last);
            return;
        }
        if self.writers == 1 && writer != Text::default() {
            self.last_number.entry(writer).or_insert(number);
            if self.buffered().any(|header| header.writer() == writer && header.number <= number) {
                self.counted = Some((writer, number));
            } else {
                self.last_frame.entry(source).or_insert((epoch, sequence));
            }
        }
    }

    /// Continues after the messages that an earlier process finished; `finished` has for each writer the number of the first
    /// unfinished message. A side input may have been read further than that, up to `last`.
    fn resume_from_acknowledged(&mut self, finished: Vec<(Text<32>, u64)>, last: LastMessage) {
        for (writer, next) in finished {
            // A process that has recorded this message has finished it, even if it died right afterwards.
            let is_done = self.driven.is_some() && writer == last.writer;
            let next = if is_done { next.max(last.number.saturating_add(1)) } else { next };
            let Some(number) = next.checked_sub(1) else { continue };
            self.note_came(writer, next);
            self.last_number.entry(writer).or_insert(number);
            self.predecessor.numbers.entry(writer).or_insert(number);
            // If this process is replaced before it has processed a message, its successor must not repeat these either.
            self.worked_on.numbers.entry(writer).or_insert(number);
            if writer == last.writer && last.number <= number {
                self.last_frame.entry(last.source).or_insert((last.epoch, last.sequence));
                self.worked_on.frames.entry(last.source).or_insert((last.epoch, last.sequence));
            }
        }
        self.counted = (last.writer != Text::default()).then_some((last.writer, last.number));
    }

    /// Whether a message is to be processed: it is well-formed and new, and not the end of a stream.
    fn admit(&mut self, message: &R::Message) -> bool {
        let header = message.header();
        let (source, writer) = (header.origin(), header.writer());
        if let Err(error) = self.reader.item().check(header, message.bytes()) {
            self.counts.malformed += 1;
            self.nonsense.warn(format_args!("left out a message of topic `{}`: {error}", self.counts.topic));
            self.note_came(writer, header.number.saturating_add(1));
            return false;
        }
        if header.ends_stream() {
            self.note_end(header, writer);
            return false;
        }
        if self.is_known(header, writer) {
            return false;
        }
        self.note_came(writer, header.number.saturating_add(1));
        if self.is_repeated(header, source, writer) {
            self.counts.late += 1;
            return false;
        }
        self.count_lost(header, writer);
        let is_news = self.in_sequence(header, source);
        if is_news {
            // A restarted stage of another machine numbers from 0 again.
            self.next_numbers.insert(writer, header.number.saturating_add(1));
        }
        is_news
    }

    /// Records that the messages of `writer` with numbers below `next` were received.
    fn note_came(&mut self, writer: Text<32>, next: u64) {
        let came = self.next_numbers.entry(writer).or_default();
        *came = next.max(*came);
        self.unacknowledged.insert(writer);
    }

    /// Whether a message repeats the last one: its writer was killed after it had sent the message and before it had recorded
    /// that, so its next process sent it again.
    fn is_repeated(&self, header: &Header, source: Text<32>, writer: Text<32>) -> bool {
        let is_same_frame = |(_, sequence): &(u64, u64)| *sequence == header.sequence;
        self.last_number.get(&writer) == Some(&header.number) && self.last_frame.get(&source).is_some_and(is_same_frame)
    }

    /// Records the end of a writer's stream, and counts its last messages that were never received.
    fn note_end(&mut self, end: &Header, writer: Text<32>) {
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

    /// Number of messages that a writer has sent, as far as is known here.
    pub fn count_of(&self, writer: &str) -> u64 {
        self.last_number.get(&Text::new(writer)).map_or(0, |last| last.saturating_add(1))
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
}
