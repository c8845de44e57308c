//! The messages that the receiving end of an edge has passed on and that lossless readers have not finished.

use std::collections::VecDeque;

/// Stream and number of messages that were passed on, the oldest first.
#[derive(Clone, Debug, Default)]
pub(crate) struct PassedOn {
    messages: VecDeque<(u64, u64)>,
}

impl PassedOn {
    /// Notes that the message at this position was passed on.
    pub(crate) fn add(&mut self, position: (u64, u64)) {
        self.messages.push_back(position);
    }

    /// Returns the number of the first message of the expected stream that may be needed again. The readers here have not
    /// finished the last `unfinished` messages; `next` is the expected number.
    pub(crate) fn finished(&mut self, unfinished: usize, (stream, next): (u64, u64)) -> u64 {
        let finished = self.messages.len().saturating_sub(unfinished);
        self.messages.drain(..finished);
        let unfinished = self.messages.iter().find(|(of, _)| *of == stream);
        unfinished.map_or(next, |(_, number)| next.min(*number))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn messages_of_the_stream_that_the_readers_have_not_finished_may_be_needed_again() {
        let mut passed_on = PassedOn::default();
        (3..7).for_each(|number| passed_on.add((5, number)));
        assert_eq!(passed_on.finished(2, (5, 7)), 5);
        assert_eq!(passed_on.finished(0, (5, 7)), 7, "all is finished");
        [(5, 7), (6, 0)].into_iter().for_each(|position| passed_on.add(position));
        assert_eq!(passed_on.finished(2, (6, 1)), 0, "what is of an earlier stream counts for nothing");
    }
}
