//! Swap of a stage: the successor buffers messages while its predecessor works, and continues where that has stopped.

use super::InputPort;
use crate::ports::{MAX_KEPT, PortError, Reader, Received};
use crate::runner::handover::Watermark;
use conicflow_messages::{Header, Text};

/// Maximum number of messages that are taken in a row.
const MOST_AT_ONCE: usize = 64;

impl<R: Reader> InputPort<R> {
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

    /// Whether all messages before `first` were processed or can no longer come.
    pub(crate) fn has_passed(&self, first: &Watermark) -> bool {
        first.numbers.iter().all(|(writer, first)| {
            let seen = self.last_number.get(writer).map_or(0, |last| last.saturating_add(1)) >= *first;
            let is_before =
                |message: &R::Message| message.header().writer() == *writer && message.header().number < *first;
            (seen || self.ended.contains(writer.as_str().unwrap_or_default())) && !self.pending.iter().any(is_before)
        })
    }

    /// Continues after the last message that the predecessor processed, with the buffered messages.
    pub(crate) fn resume_from_handover(&mut self, last: Watermark) {
        self.last_number.clone_from(&last.numbers);
        self.last_frame.clone_from(&last.frames);
        self.ended.clone_from(&last.ended);
        self.position = last.clone();
        self.predecessor_position = last;
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
}
