//! The receiving end of an edge's numbering: which messages are taken, and how many are gone for good.

use super::wire::Place;

/// What is done with a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    /// It is next.
    Take,
    /// It came before.
    Old,
    /// Others have to come before it; the sender will send all of them again.
    Early,
}

/// What was received of an edge.
#[derive(Debug)]
pub(super) struct Sequence {
    lossless: bool,
    stream: u64,
    next: u64,
    lost: u64,
}

impl Sequence {
    pub(super) fn new(lossless: bool) -> Self {
        Self { lossless, stream: 0, next: 0, lost: 0 }
    }

    /// The stream that is received, and the number that is expected next.
    pub(super) fn expected(&self) -> (u64, u64) {
        (self.stream, self.next)
    }

    /// Messages that were sent and will not come any more.
    pub(super) fn lost(&self) -> u64 {
        self.lost
    }

    /// Whether a message is to be taken; it counts as received only by [`Sequence::taken`].
    pub(super) fn judge(&mut self, place: Place) -> Verdict {
        if place.stream < self.stream {
            return Verdict::Old;
        }
        let oldest = if self.lossless { place.oldest.min(place.number) } else { place.number };
        if place.stream > self.stream {
            (self.stream, self.next) = (place.stream, oldest);
        }
        if place.number < self.next {
            return Verdict::Old;
        }
        self.lost += oldest.saturating_sub(self.next);
        self.next = self.next.max(oldest);
        if place.number == self.next { Verdict::Take } else { Verdict::Early }
    }

    /// The message that was expected has been passed on.
    pub(super) fn taken(&mut self) {
        self.next += 1;
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn take(sequence: &mut Sequence, stream: u64, number: u64, oldest: u64) -> Verdict {
        let verdict = sequence.judge(Place { stream, number, oldest });
        if verdict == Verdict::Take {
            sequence.taken();
        }
        verdict
    }

    #[test]
    fn lossless_takes_each_once_and_in_order() {
        let mut sequence = Sequence::new(true);
        let verdicts = [3, 5, 4, 3, 5].map(|number| take(&mut sequence, 1, number, 3));
        assert_eq!(verdicts, [Verdict::Take, Verdict::Early, Verdict::Take, Verdict::Old, Verdict::Take]);
        assert_eq!((sequence.expected(), sequence.lost()), ((1, 6), 0));
    }

    #[test]
    fn what_the_sender_has_given_up_is_counted_and_not_waited_for() {
        let mut sequence = Sequence::new(true);
        take(&mut sequence, 1, 0, 0);
        assert_eq!(take(&mut sequence, 1, 9, 8), Verdict::Early);
        assert_eq!(take(&mut sequence, 1, 8, 8), Verdict::Take);
        assert_eq!(sequence.lost(), 7);
    }

    #[test]
    fn the_newest_wins_where_that_is_wanted() {
        let mut sequence = Sequence::new(false);
        let verdicts = [4, 6, 5].map(|number| take(&mut sequence, 1, number, number));
        assert_eq!(verdicts, [Verdict::Take, Verdict::Take, Verdict::Old]);
        assert_eq!(sequence.lost(), 1);
    }

    #[test]
    fn a_sender_that_starts_anew_is_followed_and_its_predecessor_not() {
        for lossless in [true, false] {
            let mut sequence = Sequence::new(lossless);
            take(&mut sequence, 5, 7, 7);
            assert_eq!(take(&mut sequence, 6, 0, 0), Verdict::Take);
            assert_eq!(take(&mut sequence, 5, 8, 8), Verdict::Old);
            assert_eq!((sequence.expected(), sequence.lost()), ((6, 1), 0));
        }
    }
}
