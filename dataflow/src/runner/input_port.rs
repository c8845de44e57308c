//! An input of a stage: decides which of the messages that came is worked on, and counts the others.

use super::handover::Watermark;
use crate::item_type::ItemType;
use crate::log::ThrottledWarning;
use crate::ports::{Delivery, MAX_KEPT, PortError, Reader, Received};
use crate::status::{InputCounts, LastMessage};
use conicflow_messages::{Header, Text};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::time::Duration;

/// Messages that are taken at a time before something else is looked at.
const MOST_AT_ONCE: usize = 64;
/// A stage that has died of a message so often is not given it again.
const MOST_DEATHS: u64 = 2;

/// What a stage is to do next.
pub(crate) enum Step<M> {
    /// To work on this message.
    Message(M),
    /// To note that the next message is finished: it has died of that too often.
    LeftOut,
    /// To wait: no message is there.
    Nothing,
}

/// Takes messages from a reader: checked, in order, the newest only where that is wanted.
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
    /// How far this process came.
    worked_on: Watermark,
    /// How far its predecessor came.
    predecessor: Watermark,
    /// Writer and number of the last message that an earlier process counted, where this one has received it as well.
    counted: Option<(Text<32>, u64)>,
    /// By writer, the number that follows the last message which came.
    came: BTreeMap<Text<32>, u64>,
    /// The writers of messages that came since it was last said what is finished.
    unsaid: BTreeSet<Text<32>>,
    /// By writer, what was said last.
    said: BTreeMap<Text<32>, u64>,
    /// Whether its writers began to count when this run did.
    has_all_from_first: bool,
    /// The stage that it drives, which is not given again what it has died of too often.
    driven: Option<Text<32>>,
    nonsense: ThrottledWarning,
}

impl<R: Reader> InputPort<R> {
    /// An input from `topic`, which `writers` stages write.
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
            came: BTreeMap::new(),
            unsaid: BTreeSet::new(),
            said: BTreeMap::new(),
            has_all_from_first: false,
            driven: None,
            nonsense: ThrottledWarning::default(),
        }
    }

    /// All that decides what it does, so that the model of the protocol can tell its states apart.
    #[cfg(test)]
    pub(super) fn hash_state(&self, hasher: &mut impl std::hash::Hasher) {
        use std::hash::Hash;
        for header in self.buffered() {
            (header.number, header.sequence, header.epoch, header.flags).hash(hasher);
        }
        (&self.ended, &self.last_frame, &self.last_number, bytemuck::bytes_of(&self.counts)).hash(hasher);
        (&self.worked_on, &self.predecessor, &self.counted).hash(hasher);
        (&self.came, &self.unsaid, &self.said).hash(hasher);
    }

    /// What the items of its messages are.
    pub(crate) fn item(&self) -> &ItemType {
        self.reader.item()
    }

    /// The next message, if one is there.
    ///
    /// # Errors
    /// The transport failed.
    pub fn take(&mut self) -> Result<Option<R::Message>, PortError> {
        let Some((message, which)) = self.next()? else { return Ok(None) };
        self.count_taken(which, false);
        Ok(Some(message))
    }

    /// The message that the stage which this drives is to work on next.
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

    /// The next message, and which it is.
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

    /// Says that this is what drives `stage`.
    pub(crate) fn drive(&mut self, stage: &str) {
        self.driven = Some(Text::new(stage));
    }

    /// Says that its writers are of this run: what they have sent before the first message that comes is lost.
    pub(crate) fn expect_from_first(&mut self) {
        self.has_all_from_first = self.delivery == Delivery::Lossless;
    }

    /// Says that all messages which came are finished, but for those that wait here or in `kept`: should this stage be started
    /// anew, it needs them no more.
    pub(crate) fn acknowledge_but<'a>(&mut self, kept: impl Iterator<Item = &'a Header> + Clone) {
        for writer in std::mem::take(&mut self.unsaid) {
            let own = |headers: &mut dyn Iterator<Item = &Header>| {
                headers.filter(|header| header.writer() == writer).map(|header| header.number).min()
            };
            let waits = own(&mut kept.clone()).into_iter().chain(own(&mut self.buffered())).min();
            let came = self.came.get(&writer).copied().unwrap_or_default();
            let next = waits.map_or(came, |first| first.min(came));
            // What was let go of is not asked for again; a stage of another machine may have begun anew.
            if self.said.get(&writer).is_none_or(|said| *said < next || *said > came) {
                self.said.insert(writer, next);
                self.reader.acknowledge(writer, next);
            }
            if waits.is_some() {
                self.unsaid.insert(writer);
            }
        }
    }

    /// The same of all but those that wait here.
    pub fn acknowledge(&mut self) {
        self.acknowledge_but(std::iter::empty());
    }

    /// Whether its writers keep what this stage has not finished.
    pub(crate) fn is_kept(&self) -> bool {
        self.reader.acknowledged().is_some()
    }

    /// Goes on after what an earlier process of this stage has finished, which has kept no counts.
    pub fn go_on(&mut self) {
        let finished = self.reader.acknowledged().unwrap_or_default();
        self.go_on_after(finished, LastMessage::default());
    }

    /// Counts a message, unless an earlier process of the same stage has.
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

    /// How far this process came.
    pub(crate) fn worked_on(&mut self) -> &Watermark {
        self.worked_on.ended.clone_from(&self.ended);
        &self.worked_on
    }

    /// Whether all messages before `first` were worked on, and none of them can come any more.
    pub(crate) fn has_passed(&self, first: &Watermark) -> bool {
        first.numbers.iter().all(|(writer, first)| {
            let seen = self.last_number.get(writer).map_or(0, |last| last.saturating_add(1)) >= *first;
            let is_before =
                |message: &R::Message| message.header().writer() == *writer && message.header().number < *first;
            (seen || self.ended.contains(writer.as_str().unwrap_or_default())) && !self.pending.iter().any(is_before)
        })
    }

    /// Keeps what has come, for when this process's turn has come.
    pub(crate) fn buffer_ahead(&mut self) -> Result<(), PortError> {
        while self.pending.len() < MAX_KEPT {
            let Some(message) = self.reader.receive()? else { break };
            self.pending.push_back(message);
        }
        Ok(())
    }

    /// Takes all that has come, so that no writer waits for room while another one has not sent yet: where there is no room
    /// for more, the first message of a writer of which a later one is buffered is left to the predecessor.
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

    /// The first message of whose writer a later one is buffered.
    fn dispensable(&self) -> Option<usize> {
        let headers: Vec<_> = self.buffered().collect();
        (0..headers.len()).find(|&index| {
            let writer = headers[index].writer();
            !headers[index].ends_stream() && headers[index + 1..].iter().any(|later| later.writer() == writer)
        })
    }

    /// The headers of what is buffered.
    pub(crate) fn buffered(&self) -> impl Iterator<Item = &Header> {
        self.pending.iter().map(Received::header)
    }

    /// Leaves buffered messages to the predecessor; never the end of a stream.
    pub(crate) fn drop_buffered(&mut self, forget: impl Fn(&Header) -> bool) {
        self.pending.retain(|message| message.header().ends_stream() || !forget(message.header()));
    }

    /// Whether a message of this writer is buffered.
    pub(crate) fn has_buffered(&self, writer: &str) -> bool {
        self.pending.iter().any(|message| message.header().writer() == Text::new(writer))
    }

    /// By writer, the number of the first message that is buffered; an end has the number that would follow.
    pub(crate) fn first_buffered(&self) -> Watermark {
        let mut first = Watermark::default();
        for header in self.buffered() {
            first.numbers.entry(header.writer()).or_insert(header.number);
        }
        first
    }

    /// Goes on after the last message that the predecessor has worked on, with what was buffered meanwhile.
    pub(crate) fn begin_after(&mut self, last: Watermark) {
        self.last_number.clone_from(&last.numbers);
        self.last_frame.clone_from(&last.frames);
        self.ended.clone_from(&last.ended);
        self.worked_on = last.clone();
        self.predecessor = last;
        self.admit_buffered();
    }

    /// Queues what was buffered.
    pub(crate) fn admit_buffered(&mut self) {
        for message in std::mem::take(&mut self.pending) {
            if self.admit(&message) {
                self.enqueue(message);
            }
        }
    }

    /// Whether the predecessor has worked on a message; once one is news, all that follow are.
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

    /// Whether every writer has said that it sends nothing more, and nothing waits.
    pub(crate) fn ended(&self) -> bool {
        self.ended.len() >= self.writers && self.pending.is_empty()
    }

    /// Whether this writer has said that it sends nothing more.
    pub fn has_ended(&self, writer: &str) -> bool {
        self.ended.contains(writer)
    }

    /// Whether nothing that came before still waits.
    pub fn is_idle(&self) -> bool {
        self.pending.is_empty()
    }

    /// What was counted of this input.
    pub fn counts(&self) -> InputCounts {
        self.counts
    }

    /// Continues the counts of an earlier process, and goes on after what that has finished, where it is handed the rest again.
    /// Elsewhere what had come and was not worked on is lost, which shows in the numbers where all messages come from one writer.
    pub fn resume(&mut self, counts: InputCounts) {
        if counts.topic != self.counts.topic {
            return;
        }
        self.counts = counts;
        let LastMessage { writer, number, source, epoch, sequence } = counts.last;
        if let Some(finished) = self.reader.acknowledged() {
            self.go_on_after(finished, counts.last);
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

    /// Goes on after what an earlier process has finished, by writer the number of the first message that it has not. Of a side
    /// input it may have taken more than that, up to `last`.
    fn go_on_after(&mut self, finished: Vec<(Text<32>, u64)>, last: LastMessage) {
        for (writer, next) in finished {
            // Who has written it to the record has finished it, even if that was the last that it did.
            let is_done = self.driven.is_some() && writer == last.writer;
            let next = if is_done { next.max(last.number.saturating_add(1)) } else { next };
            let Some(number) = next.checked_sub(1) else { continue };
            self.note_came(writer, next);
            self.last_number.entry(writer).or_insert(number);
            self.predecessor.numbers.entry(writer).or_insert(number);
            // Should it leave its place before it has worked on anything, its successor need not do it again either.
            self.worked_on.numbers.entry(writer).or_insert(number);
            if writer == last.writer && last.number <= number {
                self.last_frame.entry(last.source).or_insert((last.epoch, last.sequence));
                self.worked_on.frames.entry(last.source).or_insert((last.epoch, last.sequence));
            }
        }
        self.counted = (last.writer != Text::default()).then_some((last.writer, last.number));
    }

    /// Whether a message is to be worked on: it makes sense, is news, and is not the end of a stream.
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
            // A stage of another machine that was started anew counts from the beginning.
            self.came.insert(writer, header.number.saturating_add(1));
        }
        is_news
    }

    /// Notes that the messages of `writer` before the number `next` came.
    fn note_came(&mut self, writer: Text<32>, next: u64) {
        let came = self.came.entry(writer).or_default();
        *came = next.max(*came);
        self.unsaid.insert(writer);
    }

    /// Whether a message is the last one again: its writer was killed between sending it and noting that it had, so that
    /// the next process of that stage sent it once more.
    fn is_repeated(&self, header: &Header, source: Text<32>, writer: Text<32>) -> bool {
        let is_same_frame = |(_, sequence): &(u64, u64)| *sequence == header.sequence;
        self.last_number.get(&writer) == Some(&header.number) && self.last_frame.get(&source).is_some_and(is_same_frame)
    }

    /// Notes that a writer has ended, and counts what it had sent last and never came.
    fn note_end(&mut self, end: &Header, writer: Text<32>) {
        self.ended.insert(writer.to_string());
        let last = self.last_number.get(&writer).copied();
        // Where several write, an earlier process of this stage may have had what this one knows nothing of.
        let first = if self.writers == 1 && self.delivery == Delivery::Lossless { Some(0) } else { None };
        let Some(next) = last.map(|last| last.saturating_add(1)).or(first) else { return };
        let lost = end.number.saturating_sub(next);
        if lost > 0 {
            self.count_gap(lost);
            self.last_number.insert(writer, end.number - 1);
        }
    }

    /// Counts messages that are lost, and their frames with them.
    fn count_gap(&mut self, lost: u64) {
        self.counts.dropped = self.counts.dropped.saturating_add(lost);
        self.counts.gaps = self.counts.gaps.saturating_add(lost);
    }

    /// How many messages a writer has sent, as far as is known here.
    pub fn count_of(&self, writer: &str) -> u64 {
        self.last_number.get(&Text::new(writer)).map_or(0, |last| last.saturating_add(1))
    }

    /// Counts what was lost on the way from the writer to here.
    fn count_lost(&mut self, header: &Header, writer: Text<32>) {
        let last = self.last_number.insert(writer, header.number);
        let first = if self.has_all_from_first { Some(0) } else { None };
        let Some(next) = last.map(|last| last.saturating_add(1)).or(first) else { return };
        let lost = header.number.saturating_sub(next);
        self.counts.dropped = self.counts.dropped.saturating_add(lost);
        if last.is_none() {
            // The frames before the first one of a source are nobody's gap.
            self.counts.gaps = self.counts.gaps.saturating_add(lost);
        }
    }

    /// Whether a frame is newer than the last one of its source; counts those between them.
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

    /// Puts a message at the end, in place of an older one of the same source where only the newest is wanted.
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
