//! The receiving end of an edge's numbering: which messages are taken, and how many are gone for good.

use super::wire::Place;
use std::time::{Duration, Instant};

/// Streams are numbered by the sender's clock, which may be set back: a stream that seems to be an earlier one is followed
/// when nothing has come of the current one for so long.
const SILENCE: Duration = Duration::from_secs(3);

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
    came: Option<Instant>,
}

impl Sequence {
    pub(super) fn new(lossless: bool) -> Self {
        Self { lossless, stream: 0, next: 0, lost: 0, came: None }
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
    pub(super) fn judge(&mut self, place: Place, now: Instant) -> Verdict {
        let silent = self.came.is_none_or(|came| now.saturating_duration_since(came) > SILENCE);
        if place.stream < self.stream && !silent {
            return Verdict::Old;
        }
        self.came = Some(now);
        let oldest = if self.lossless { place.oldest.min(place.number) } else { place.number };
        if place.stream != self.stream {
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
        take_at(sequence, Place { stream, number, oldest }, Instant::now())
    }

    fn take_at(sequence: &mut Sequence, place: Place, now: Instant) -> Verdict {
        let verdict = sequence.judge(place, now);
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

    #[test]
    fn a_sender_whose_clock_was_set_back_is_followed_when_its_predecessor_is_silent() {
        let (mut sequence, start) = (Sequence::new(true), Instant::now());
        let place = |stream, number| Place { stream, number, oldest: number };
        assert_eq!(take_at(&mut sequence, place(5, 7), start), Verdict::Take);
        assert_eq!(take_at(&mut sequence, place(4, 0), start + SILENCE), Verdict::Old);
        let later = start + SILENCE + Duration::from_millis(1);
        assert_eq!(take_at(&mut sequence, place(4, 0), later), Verdict::Take);
        assert_eq!((sequence.expected(), sequence.lost()), ((4, 1), 0));
    }
}
