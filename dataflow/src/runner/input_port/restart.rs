//! Restart of a stage: which received messages its writers need not keep any longer, and where a new process continues.

use super::InputPort;
use crate::ports::Reader;
use crate::status::{InputCounts, LastMessage};
use conicflow_messages::{Header, Text};

impl<R: Reader> InputPort<R> {
    /// Acknowledges all received messages except those that are pending here.
    pub fn acknowledge(&mut self) {
        self.acknowledge_but(std::iter::empty());
    }

    /// Acknowledges all received messages except those that are pending here or in `kept`: a restart of this stage does not need
    /// them.
    pub(crate) fn acknowledge_but<'a>(&mut self, kept: impl Iterator<Item = &'a Header> + Clone) {
        for writer in std::mem::take(&mut self.unacknowledged) {
            let first_of_writer = |headers: &mut dyn Iterator<Item = &Header>| {
                headers.filter(|header| header.writer() == writer).map(|header| header.number).min()
            };
            let kept_ones = first_of_writer(&mut kept.clone());
            let first_unfinished = kept_ones.into_iter().chain(first_of_writer(&mut self.buffered())).min();
            let received = self.next_numbers.get(&writer).copied().unwrap_or_default();
            let next = first_unfinished.map_or(received, |first| first.min(received));
            // Released messages are not requested again. A restarted stage of another machine may number from 0 again.
            if self.acknowledged.get(&writer).is_none_or(|before| *before < next || *before > received) {
                self.acknowledged.insert(writer, next);
                self.reader.acknowledge(writer, next);
            }
            if first_unfinished.is_some() {
                self.unacknowledged.insert(writer);
            }
        }
    }

    /// Whether its writers keep the messages that this stage has not finished.
    pub(crate) fn is_kept(&self) -> bool {
        self.reader.acknowledged().is_some()
    }

    /// Continues after the messages that an earlier process of this stage, which kept no counts, has finished.
    pub fn skip_finished(&mut self) {
        let finished = self.reader.acknowledged().unwrap_or_default();
        self.resume_from_acknowledged(finished, LastMessage::default());
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
                self.last_counted = Some((writer, number));
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
            self.record_received(writer, next);
            self.last_number.entry(writer).or_insert(number);
            self.predecessor_position.numbers.entry(writer).or_insert(number);
            // If this process is replaced before it has processed a message, its successor must not repeat these either.
            self.position.numbers.entry(writer).or_insert(number);
            if writer == last.writer && last.number <= number {
                self.last_frame.entry(last.source).or_insert((last.epoch, last.sequence));
                self.position.frames.entry(last.source).or_insert((last.epoch, last.sequence));
            }
        }
        self.last_counted = (last.writer != Text::default()).then_some((last.writer, last.number));
    }
}
