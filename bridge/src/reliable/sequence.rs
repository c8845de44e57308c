//! The receiving end of an edge's numbering: which messages are taken, and how many are gone for good.

use super::send_log::CAPACITY;
use crate::wire::Place;
use std::time::{Duration, Instant};

/// Streams are numbered by the sender's clock, which may be set back: a stream that seems to be an earlier one is followed
/// when nothing has come of the current one for so long.
const SILENCE: Duration = Duration::from_secs(3);

/// A sender sends nothing again that is older than what it keeps: a message that is farther behind shows that one was taken
/// before which that sender has not made.
const FARTHEST_BEHIND: u64 = CAPACITY as u64;

/// What is done with a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// It is next.
    Take,
    /// It came before.
    Old,
    /// Others have to come before it; the sender will send all of them again.
    Early,
}

/// What was received of an edge.
#[derive(Debug)]
pub(crate) struct Sequence {
    lossless: bool,
    stream: u64,
    next: u64,
    lost: u64,
    forged: u64,
    came: Option<Instant>,
}

impl Sequence {
    pub(crate) fn new(lossless: bool) -> Self {
        Self { lossless, stream: 0, next: 0, lost: 0, forged: 0, came: None }
    }

    /// The stream that is received, and the number that is expected next.
    pub(crate) fn expected(&self) -> (u64, u64) {
        (self.stream, self.next)
    }

    /// Messages that were sent and will not come any more.
    pub(crate) fn lost(&self) -> u64 {
        self.lost
    }

    /// How often a message was taken whose number its sender cannot have reached.
    pub(crate) fn forged(&self) -> u64 {
        self.forged
    }

    /// Whether a message is to be taken; it counts as received only by [`Sequence::taken`]. An end may be sent again at any time.
    pub(crate) fn judge(&mut self, place: Place, is_end: bool, now: Instant) -> Verdict {
        let silent = self.came.is_none_or(|came| now.saturating_duration_since(came) > SILENCE);
        if place.stream < self.stream && !silent {
            return Verdict::Old;
        }
        self.came = Some(now);
        let oldest = if self.lossless { place.oldest.min(place.number) } else { place.number };
        if place.stream != self.stream {
            (self.stream, self.next) = (place.stream, oldest);
        }
        if self.next.saturating_sub(place.number) > FARTHEST_BEHIND && !is_end {
            // What seemed to be lost up to that number has not been sent yet.
            self.lost = self.lost.saturating_sub(self.next - oldest);
            self.forged += 1;
            self.next = oldest;
        }
        if place.number < self.next {
            return Verdict::Old;
        }
        self.lost = self.lost.saturating_add(oldest.saturating_sub(self.next));
        self.next = self.next.max(oldest);
        if place.number == self.next { Verdict::Take } else { Verdict::Early }
    }

    /// The message that was expected has been passed on.
    pub(crate) fn taken(&mut self) {
        self.next = self.next.saturating_add(1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn take(sequence: &mut Sequence, stream: u64, number: u64, oldest: u64) -> Verdict {
        take_at(sequence, Place { stream, number, oldest }, Instant::now())
    }

    fn take_at(sequence: &mut Sequence, place: Place, now: Instant) -> Verdict {
        let verdict = sequence.judge(place, false, now);
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
    fn a_number_that_the_sender_never_reached_stops_nothing() {
        for (lossless, forged) in [(true, 1 << 63), (false, 1 << 63), (true, u64::MAX), (false, 100_000)] {
            let mut sequence = Sequence::new(lossless);
            assert_eq!([0, 1, 2].map(|number| take(&mut sequence, 1, number, 0)), [Verdict::Take; 3]);
            assert_eq!(take(&mut sequence, 1, forged, forged), Verdict::Take);
            assert_eq!([3, 4].map(|number| take(&mut sequence, 1, number, 3)), [Verdict::Take; 2]);
            assert_eq!((sequence.expected(), sequence.forged()), ((1, 5), 1));
            assert!(sequence.lost() <= 1, "{} messages seem to be lost", sequence.lost());
        }
    }

    #[test]
    fn what_is_sent_again_because_its_acknowledgement_was_lost_is_old() {
        let mut sequence = Sequence::new(true);
        take(&mut sequence, 1, FARTHEST_BEHIND, FARTHEST_BEHIND);
        assert_eq!(take(&mut sequence, 1, 1, 1), Verdict::Old);
        take(&mut sequence, 1, FARTHEST_BEHIND + 1, FARTHEST_BEHIND + 1);
        let end = Place { stream: 1, number: 0, oldest: 0 };
        assert_eq!(sequence.judge(end, true, Instant::now()), Verdict::Old, "an end is told until everybody knows it");
        assert_eq!((sequence.expected(), sequence.forged()), ((1, FARTHEST_BEHIND + 2), 0));
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
