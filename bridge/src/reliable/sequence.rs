//! The receiving end of an edge's numbering: which messages are taken, and how many are gone for good.

use super::send_log::CAPACITY;
use crate::wire::Place;
use std::time::{Duration, Instant};

/// Streams are numbered by the sender's clock, which may be set back: a stream that seems to be an earlier one is followed
/// when nothing has come of the current one for so long.
const SILENCE: Duration = Duration::from_secs(3);

/// A sender keeps so many messages, and sends nothing older again: what is farther behind shows that a message was taken before
/// it whose number the sender has not reached.
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
    /// Whether its sender made whatever comes: then nothing that comes is ahead of that sender, and what is far behind is
    /// repeated by somebody else.
    trusted: bool,
    stream: u64,
    next: u64,
    lost: u64,
    misled: bool,
    /// When something came of the stream.
    came: Option<Instant>,
    /// When something came that was new.
    new_came: Option<Instant>,
}

impl Sequence {
    /// Of an edge of which nothing has come; `trusted` if codes show who made what comes.
    pub(crate) fn new(lossless: bool, trusted: bool) -> Self {
        Self { lossless, trusted, stream: 0, next: 0, lost: 0, misled: false, came: None, new_came: None }
    }

    /// The stream that is received, and the number that is expected next.
    pub(crate) fn expected(&self) -> (u64, u64) {
        (self.stream, self.next)
    }

    /// Whether a message is one of the stream that is received.
    pub(crate) fn is_of_stream(&self, place: Place) -> bool {
        place.stream == self.stream
    }

    /// Whether a message counts, by the verdict on it, although it may have come before: an end that is told again does, for who
    /// was started anew and has not heard it.
    pub(crate) fn is_end_to_hear(&self, place: Place, verdict: Verdict) -> bool {
        match verdict {
            Verdict::Take => true,
            Verdict::Old => self.is_of_stream(place),
            Verdict::Early => false,
        }
    }

    /// Messages that were sent and will not come any more.
    pub(crate) fn lost(&self) -> u64 {
        self.lost
    }

    /// Whether it has turned out, since this was asked last, that a message was taken whose number its sender had not reached.
    pub(crate) fn was_misled(&mut self) -> bool {
        std::mem::take(&mut self.misled)
    }

    /// Whether a message is to be taken; it counts as received only by [`Sequence::taken`]. What `may_be_repeated`, as an end is
    /// until everybody knows it, tells nothing by being old.
    pub(crate) fn judge(&mut self, place: Place, may_be_repeated: bool, now: Instant) -> Verdict {
        let is_silent =
            |since: Option<Instant>| since.is_none_or(|since| now.saturating_duration_since(since) > SILENCE);
        if place.stream < self.stream && !is_silent(self.came) {
            return Verdict::Old;
        }
        self.came = Some(now);
        let oldest = match (self.lossless, may_be_repeated) {
            (true, false) => place.oldest.min(place.number),
            // It is told again also when it is not kept any more.
            (true, true) => place.oldest,
            (false, _) => place.number,
        };
        if place.stream != self.stream {
            (self.stream, self.next) = (place.stream, oldest);
        }
        let is_far_behind = !self.trusted && self.next.saturating_sub(place.number) > FARTHEST_BEHIND;
        // Where the newest wins, one way may be much slower than another: there nothing new must have come as well.
        if is_far_behind && !may_be_repeated && (self.lossless || is_silent(self.new_came)) {
            // What seemed to be lost up to that number has not been sent yet.
            self.lost = self.lost.saturating_sub(self.next - oldest);
            (self.next, self.misled) = (oldest, true);
        }
        if place.number < self.next {
            return Verdict::Old;
        }
        self.new_came = Some(now);
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
        let mut sequence = Sequence::new(true, false);
        let verdicts = [3, 5, 4, 3, 5].map(|number| take(&mut sequence, 1, number, 3));
        assert_eq!(verdicts, [Verdict::Take, Verdict::Early, Verdict::Take, Verdict::Old, Verdict::Take]);
        assert_eq!((sequence.expected(), sequence.lost()), ((1, 6), 0));
    }

    #[test]
    fn an_end_is_heard_also_when_it_is_told_again_but_not_that_of_an_earlier_stream() {
        let mut sequence = Sequence::new(true, false);
        take(&mut sequence, 5, 0, 0);
        take(&mut sequence, 5, 1, 0);
        let mut told = |stream: u64, number: u64| {
            let place = Place { stream, number, oldest: 0 };
            let verdict = sequence.judge(place, true, Instant::now());
            (sequence.is_of_stream(place), sequence.is_end_to_hear(place, verdict), verdict)
        };
        assert_eq!(told(5, 1), (true, true, Verdict::Old));
        assert_eq!(told(5, 2), (true, true, Verdict::Take));
        assert_eq!(told(5, 3), (true, false, Verdict::Early), "others have to come before it");
        assert_eq!(told(4, 1), (false, false, Verdict::Old));
    }

    #[test]
    fn what_the_sender_has_given_up_is_counted_and_not_waited_for() {
        let mut sequence = Sequence::new(true, false);
        take(&mut sequence, 1, 0, 0);
        assert_eq!(take(&mut sequence, 1, 9, 8), Verdict::Early);
        assert_eq!(take(&mut sequence, 1, 8, 8), Verdict::Take);
        assert_eq!(sequence.lost(), 7);
    }

    #[test]
    fn an_end_that_is_told_again_counts_nothing_as_lost() {
        let now = Instant::now();
        for first in [Place { stream: 1, number: 2, oldest: 9 }, Place { stream: 1, number: 8, oldest: 9 }] {
            let mut sequence = Sequence::new(true, false);
            assert_eq!(sequence.judge(first, true, now), Verdict::Old, "what comes before it is finished");
            assert_eq!(take(&mut sequence, 1, 9, 9), Verdict::Take);
            assert_eq!(sequence.judge(first, true, now), Verdict::Old);
            assert_eq!((sequence.expected(), sequence.lost()), ((1, 10), 0));
        }
    }

    #[test]
    fn the_newest_wins_where_that_is_wanted() {
        let mut sequence = Sequence::new(false, false);
        let verdicts = [4, 6, 5].map(|number| take(&mut sequence, 1, number, number));
        assert_eq!(verdicts, [Verdict::Take, Verdict::Take, Verdict::Old]);
        assert_eq!(sequence.lost(), 1);
    }

    #[test]
    fn a_sender_that_starts_anew_is_followed_and_its_predecessor_not() {
        for lossless in [true, false] {
            let mut sequence = Sequence::new(lossless, false);
            take(&mut sequence, 5, 7, 7);
            assert_eq!(take(&mut sequence, 6, 0, 0), Verdict::Take);
            assert_eq!(take(&mut sequence, 5, 8, 8), Verdict::Old);
            assert_eq!((sequence.expected(), sequence.lost()), ((6, 1), 0));
        }
    }

    #[test]
    fn a_number_that_the_sender_never_reached_stops_nothing() {
        for (lossless, forged) in [(true, 1 << 63), (false, 1 << 63), (true, u64::MAX), (false, 100_000)] {
            let (mut sequence, start) = (Sequence::new(lossless, false), Instant::now());
            let mut take = |number: u64, oldest: u64, now: Instant| {
                take_at(&mut sequence, Place { stream: 1, number, oldest }, now)
            };
            assert_eq!([0, 1, 2].map(|number| take(number, 0, start)), [Verdict::Take; 3]);
            assert_eq!(take(forged, forged, start), Verdict::Take);
            if !lossless {
                assert_eq!(take(3, 3, start + SILENCE), Verdict::Old, "it may have come by a slow way");
            }
            let later = start + SILENCE + Duration::from_millis(1);
            assert_eq!([3, 4].map(|number| take(number, 3, later)), [Verdict::Take; 2]);
            assert_eq!([sequence.was_misled(), sequence.was_misled()], [true, false], "it is told once");
            assert_eq!(sequence.expected(), (1, 5));
            assert!(sequence.lost() <= 1, "{} messages seem to be lost", sequence.lost());
        }
    }

    #[test]
    fn what_somebody_repeats_of_a_trusted_sender_is_old_however_old_it_is() {
        for lossless in [true, false] {
            let (mut sequence, start) = (Sequence::new(lossless, true), Instant::now());
            let place = |number| Place { stream: 1, number, oldest: number };
            (0..300).for_each(|number| assert_eq!(take_at(&mut sequence, place(number), start), Verdict::Take));
            for later in [Duration::ZERO, 2 * SILENCE] {
                for number in [299, 200, 0] {
                    assert_eq!(take_at(&mut sequence, place(number), start + later), Verdict::Old, "{number}");
                }
            }
            assert_eq!((sequence.expected(), sequence.lost(), sequence.was_misled()), ((1, 300), 0, false));
        }
    }

    #[test]
    fn what_comes_late_by_a_slow_way_is_old_as_long_as_new_ones_come() {
        let (mut sequence, start) = (Sequence::new(false, false), Instant::now());
        for number in 0..300_u64 {
            let now = start + Duration::from_millis(33 * number);
            assert_eq!(take_at(&mut sequence, Place { stream: 1, number, oldest: number }, now), Verdict::Take);
            let late = Place { stream: 1, number: number.saturating_sub(100), oldest: 0 };
            assert_eq!(take_at(&mut sequence, late, now), Verdict::Old);
        }
        assert_eq!((sequence.was_misled(), sequence.lost()), (false, 0));
    }

    #[test]
    fn what_is_sent_again_because_its_acknowledgement_was_lost_is_old() {
        let mut sequence = Sequence::new(true, false);
        take(&mut sequence, 1, FARTHEST_BEHIND, FARTHEST_BEHIND);
        assert_eq!(take(&mut sequence, 1, 1, 1), Verdict::Old);
        take(&mut sequence, 1, FARTHEST_BEHIND + 1, FARTHEST_BEHIND + 1);
        let end = Place { stream: 1, number: 0, oldest: 0 };
        assert_eq!(sequence.judge(end, true, Instant::now()), Verdict::Old, "an end is told until everybody knows it");
        assert_eq!((sequence.expected(), sequence.was_misled()), ((1, FARTHEST_BEHIND + 2), false));
    }

    #[test]
    fn a_sender_whose_clock_was_set_back_is_followed_when_its_predecessor_is_silent() {
        let (mut sequence, start) = (Sequence::new(true, false), Instant::now());
        let place = |stream, number| Place { stream, number, oldest: number };
        assert_eq!(take_at(&mut sequence, place(5, 7), start), Verdict::Take);
        assert_eq!(take_at(&mut sequence, place(4, 0), start + SILENCE), Verdict::Old);
        let later = start + SILENCE + Duration::from_millis(1);
        assert_eq!(take_at(&mut sequence, place(4, 0), later), Verdict::Take);
        assert_eq!((sequence.expected(), sequence.lost()), ((4, 1), 0));
    }
}
