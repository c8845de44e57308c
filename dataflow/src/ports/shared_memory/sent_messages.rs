//! Messages that a writer has sent and its lossless readers have not finished, which it must still keep.

use super::acknowledgements::Acknowledgements;
use crate::ports::{Delivery, Topic};
use conicflow_messages::Header;
use std::collections::VecDeque;
use std::sync::Arc;

/// The last messages of a writer, up to the number that it keeps.
pub(super) struct SentMessages {
    /// Index of the writer in the table, and number of each message. A process that forwards messages of another machine has
    /// several writers.
    last: VecDeque<(usize, u64)>,
    limit: usize,
    finished: Arc<Acknowledgements>,
    /// Indices of the lossless readers.
    readers: Vec<usize>,
}

impl SentMessages {
    pub(super) fn new(finished: Arc<Acknowledgements>, topic: &Topic) -> Self {
        let is_lossless = |place: &usize| topic.readers[*place].delivery == Delivery::Lossless;
        let readers = (0..topic.readers.len()).filter(is_lossless).collect();
        Self { last: VecDeque::new(), limit: topic.kept(), finished, readers }
    }

    /// Records a sent message.
    pub(super) fn add(&mut self, header: &Header) {
        let writer = header.trace().last().and_then(|hop| self.finished.place_of(&hop.stage));
        let Some(writer) = writer.filter(|_| !header.ends_stream()) else { return };
        // A restarted stage of another machine numbers from 0 again: acknowledgements of its new numbers do not apply to its
        // earlier messages.
        if self.last.iter().any(|(of, number)| *of == writer && *number >= header.number) {
            self.last.retain(|(of, _)| *of != writer);
        }
        while self.last.len() >= self.limit {
            self.last.pop_front();
        }
        self.last.push_back((writer, header.number));
    }

    /// Number of messages since the first one that the reader with this index has not finished, inclusive.
    pub(super) fn unfinished_by(&self, reader: usize) -> usize {
        if !self.readers.contains(&reader) {
            return 0;
        }
        let is_unfinished = |(writer, number): &(usize, u64)| *number >= self.finished.next(reader, *writer);
        self.last.iter().position(is_unfinished).map_or(0, |first| self.last.len() - first)
    }

    /// Sum of that number over all lossless readers.
    pub(super) fn unfinished_by_all(&self) -> usize {
        self.readers.iter().map(|reader| self.unfinished_by(*reader)).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ports::TopicReader;
    use conicflow_messages::{Hop, Text};

    fn lossless() -> Topic {
        let reader = TopicReader { stage: "reader".into(), delivery: Delivery::Lossless, queue: 4 };
        Topic { name: "things".into(), writers: vec!["writer".into()], readers: vec![reader], ..Topic::default() }
    }

    /// Header of a message with this number.
    fn message(number: u64) -> Header {
        let mut header = Header { number, ..Header::default() };
        header.add_hop(Hop { stage: Text::new("writer"), ..Hop::default() });
        header
    }

    #[test]
    fn a_message_is_unfinished_until_each_reader_that_wants_all_has_finished_it() {
        let reader = |stage: &str, delivery: Delivery| TopicReader { stage: stage.to_owned(), delivery, queue: 4 };
        let readers = vec![
            reader("quick", Delivery::Lossless),
            reader("viewer", Delivery::Latest),
            reader("slow", Delivery::Lossless),
        ];
        let topic = Topic { name: "things".into(), writers: vec!["writer".into()], readers, ..Topic::default() };
        let folder = tempfile::tempdir().unwrap();
        Acknowledgements::create(folder.path(), &topic).unwrap();
        let finished = Arc::new(Acknowledgements::open(folder.path(), &topic).unwrap());
        let mut sent = SentMessages::new(Arc::clone(&finished), &topic);
        assert_eq!(sent.unfinished_by_all(), 0);
        (0..3).for_each(|number| sent.add(&message(number)));
        finished.finish(0, 0, 2);
        assert_eq!([0, 1, 2].map(|place| sent.unfinished_by(place)), [1, 0, 3]);
        assert_eq!(sent.unfinished_by_all(), 4);
        finished.finish(2, 0, 3);
        assert_eq!(sent.unfinished_by_all(), 1);
    }

    #[test]
    fn what_a_writer_sent_before_it_began_to_count_anew_is_not_waited_for() {
        let (topic, folder) = (lossless(), tempfile::tempdir().unwrap());
        Acknowledgements::create(folder.path(), &topic).unwrap();
        let finished = Arc::new(Acknowledgements::open(folder.path(), &topic).unwrap());
        let mut sent = SentMessages::new(Arc::clone(&finished), &topic);
        (5..8).for_each(|number| sent.add(&message(number)));
        finished.finish(0, 0, 8);
        sent.add(&message(0));
        finished.finish(0, 0, 1);
        assert_eq!(sent.unfinished_by_all(), 0);
        sent.add(&message(1));
        assert_eq!(sent.unfinished_by_all(), 1, "the first of the new count alone is finished");
    }
}
