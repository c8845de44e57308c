//! The receiving end of an edge's numbering: which messages are taken, and how many are gone for good.
//!
//! Without a key, anybody can send under the name of the other machine. On a lossless edge that machine retransmits
//! unacknowledged messages; a forger most likely does not. So a message that the other machine sends only rarely (one that gives
//! messages up, ends a stream or begins another) is believed when it comes a second time, if no other message has contradicted it
//! by then.

use super::send_log::CAPACITY;
use crate::wire::StreamPosition;
use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Streams are numbered by the sender's clock, which may be set back. A stream with a lower number is followed once nothing of
/// the current one has come for this time.
const STREAM_TIMEOUT: Duration = Duration::from_secs(3);

/// A sender keeps this many messages and retransmits nothing older. A message farther behind shows that a message was taken whose
/// number the sender has not reached.
const FARTHEST_BEHIND: u64 = CAPACITY as u64;

/// A doubtful message is believed when it comes again after this time; the sender retransmits it by then, or soon after.
const CONFIRMED_AFTER: Duration = Duration::from_millis(200);
/// Number of doubtful messages that are remembered: more than a sender keeps.
const MOST_DOUBTS: usize = 2 * CAPACITY;

/// The receiver's decision on a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// The message is the next one.
    Take,
    /// The message came before.
    Old,
    /// Another message comes first, or this one has to come a second time; the sender retransmits all from the expected one on.
    Early,
}

/// The fields of a message that decide whether it is taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) struct Claim {
    /// Position of the message in the stream.
    pub position: StreamPosition,
    /// The session (start) of the bridge that sends it.
    pub session: u64,
    /// Number of the message among those of the stage that wrote it, if it can be read.
    pub number: Option<u64>,
    /// Whether that number follows the last number known of that stage.
    pub follows: bool,
    /// Whether its repetition is normal, as that of an end, which is sent until all receivers know it.
    pub may_be_repeated: bool,
}

impl Claim {
    /// The fields that identify a repetition of it. `oldest`, `session` and `follows` may differ then.
    fn identity(&self) -> Self {
        Self { position: StreamPosition { oldest: 0, ..self.position }, follows: false, session: 0, ..*self }
    }
}

/// The receiving state of an edge.
#[derive(Clone, Debug)]
pub(crate) struct Sequence {
    lossless: bool,
    /// Whether codes prove the origin of each message. Then no message is ahead of its sender, and one far behind was repeated by
    /// a third party.
    trusted: bool,
    stream: u64,
    next: u64,
    /// The session of the bridge that sent the last message of the stream.
    session: u64,
    /// Stream and number that were expected before the last leap.
    leapt_from: Option<(u64, u64)>,
    lost: u64,
    misled: bool,
    refuted: bool,
    /// Doubtful messages, which are believed when they come again, and when they first came.
    doubts: VecDeque<(Claim, Instant)>,
    /// When the last message of the stream came.
    last_message_at: Option<Instant>,
    /// When the last new message came.
    last_new_message_at: Option<Instant>,
}

impl Sequence {
    /// Returns the state before any message; `trusted` if codes prove the origin of each message.
    pub(crate) fn new(lossless: bool, trusted: bool) -> Self {
        Self {
            lossless,
            trusted,
            stream: 0,
            next: 0,
            session: 0,
            leapt_from: None,
            lost: 0,
            misled: false,
            refuted: false,
            doubts: VecDeque::new(),
            last_message_at: None,
            last_new_message_at: None,
        }
    }

    /// The parts that distinguish two states in a model: all but the times.
    #[cfg(test)]
    pub(super) fn essence(&self) -> impl std::hash::Hash + PartialEq + std::fmt::Debug + use<> {
        let doubts: Vec<_> =
            self.doubts.iter().map(|(claim, _)| (claim.position.stream, claim.position.number)).collect();
        (self.expected(), self.session, self.leapt_from, self.lost, self.last_message_at.is_some(), doubts)
    }

    /// The stream that is received, and the number that is expected next.
    pub(crate) fn expected(&self) -> (u64, u64) {
        (self.stream, self.next)
    }

    /// Whether a message is one of the stream that is received.
    pub(crate) fn is_of_stream(&self, position: StreamPosition) -> bool {
        position.stream == self.stream
    }

    /// Whether a message counts as an end, given the verdict on it. A repeated end counts, too: a bridge that was restarted has
    /// not heard it.
    pub(crate) fn counts_as_end(&self, position: StreamPosition, verdict: Verdict) -> bool {
        match verdict {
            Verdict::Take => true,
            Verdict::Old => self.is_of_stream(position),
            Verdict::Early => false,
        }
    }

    /// The number of messages that were sent and will not come any more.
    pub(crate) fn lost(&self) -> u64 {
        self.lost
    }

    /// Whether, since the last call, it has turned out that a message was taken whose number its sender had not reached.
    pub(crate) fn take_misled(&mut self) -> bool {
        std::mem::take(&mut self.misled)
    }

    /// Whether, since the last call, it has turned out that a doubtful message was not the sender's.
    pub(crate) fn take_refuted(&mut self) -> bool {
        std::mem::take(&mut self.refuted)
    }

    /// Decides whether a message is to be taken. It counts as received only after [`Sequence::taken`].
    pub(crate) fn judge(&mut self, claim: Claim, now: Instant) -> Verdict {
        let position = claim.position;
        if position.stream < self.stream && !is_silent(self.last_message_at, now) {
            return Verdict::Old;
        }
        let oldest = match (self.lossless, claim.may_be_repeated) {
            (true, false) => position.oldest.min(position.number),
            // An end is repeated even when the sender does not keep it any more.
            (true, true) => position.oldest,
            (false, _) => position.number,
        };
        let is_doubtful = self.is_doubtful(&claim, oldest);
        if is_doubtful && !self.is_confirmed(&claim, now) {
            return Verdict::Early;
        }
        (self.last_message_at, self.session) = (Some(now), claim.session);
        if position.stream != self.stream {
            let before = self.leapt_from.filter(|(stream, _)| *stream == position.stream);
            self.leap(position.stream, before.map_or(oldest, |(_, next)| oldest.max(next)));
        }
        // With `latest`, one path may be much slower than another; so also require that nothing new has come.
        if self.is_far_behind(&claim) && (self.lossless || is_silent(self.last_new_message_at, now)) {
            // Do not retake messages taken before the leap; do not count as lost messages that were not sent yet.
            let next = oldest.max(self.before_leap().filter(|next| *next < self.next).unwrap_or_default());
            self.lost = self.lost.saturating_sub(self.next - next);
            self.misled = true;
            self.leap(self.stream, next);
        }
        if position.number < self.next {
            return Verdict::Old;
        }
        self.last_new_message_at = Some(now);
        if oldest > self.next {
            let known = self.next.max(self.before_leap().filter(|next| *next <= oldest).unwrap_or_default());
            self.lost = self.lost.saturating_add(oldest - known);
            self.leap(self.stream, oldest);
        }
        if position.number != self.next {
            return Verdict::Early;
        }
        if !is_doubtful {
            self.refuted |= self.doubts.iter().any(|(doubt, _)| doubt.position.number >= self.next);
            self.doubts.clear();
        }
        Verdict::Take
    }

    /// Notes that the expected message has been passed on.
    pub(crate) fn taken(&mut self) {
        self.next = self.next.saturating_add(1);
    }

    /// Whether a message is so far behind that one must have been taken whose number the sender had not reached.
    fn is_far_behind(&self, claim: &Claim) -> bool {
        let is_far = self.next.saturating_sub(claim.position.number) > FARTHEST_BEHIND;
        is_far && !self.trusted && !claim.may_be_repeated
    }

    /// Whether a third party may have sent a message, because its sender sends such messages rarely.
    fn is_doubtful(&self, claim: &Claim, oldest: u64) -> bool {
        if self.trusted || !self.lossless || self.last_message_at.is_none() {
            return false;
        }
        let is_next = claim.position.number == self.next;
        match claim.position.stream == self.stream {
            // A bridge sends one stream per start.
            false => claim.session == self.session,
            true if claim.position.number < self.next => claim.may_be_repeated || self.is_far_behind(claim),
            true => oldest > self.next || is_next && (claim.may_be_repeated || !claim.follows),
        }
    }

    /// Whether a doubtful message came before, so long ago that genuine messages would have contradicted it.
    fn is_confirmed(&mut self, claim: &Claim, now: Instant) -> bool {
        let claim = claim.identity();
        let Some(at) = self.doubts.iter().position(|(doubt, _)| *doubt == claim) else {
            if self.doubts.len() == MOST_DOUBTS {
                self.doubts.pop_front();
            }
            self.doubts.push_back((claim, now));
            return false;
        };
        let is_confirmed = now.saturating_duration_since(self.doubts[at].1) > CONFIRMED_AFTER;
        if is_confirmed {
            self.doubts.remove(at);
        }
        is_confirmed
    }

    /// Expects this number of this stream next, and remembers what was expected before.
    fn leap(&mut self, stream: u64, next: u64) {
        self.leapt_from = Some((self.stream, self.next));
        (self.stream, self.next) = (stream, next);
        self.doubts.clear();
    }

    /// The number of the present stream that was expected before the last leap, if that was within the stream.
    fn before_leap(&self) -> Option<u64> {
        self.leapt_from.filter(|(stream, _)| *stream == self.stream).map(|(_, next)| next)
    }
}

fn is_silent(since: Option<Instant>, now: Instant) -> bool {
    since.is_none_or(|since| now.saturating_duration_since(since) > STREAM_TIMEOUT)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn take(sequence: &mut Sequence, stream: u64, number: u64, oldest: u64) -> Verdict {
        take_at(sequence, StreamPosition { stream, number, oldest }, Instant::now())
    }

    /// The claim of a genuine message at this position, whose bridge began with that stream.
    fn claim(position: StreamPosition) -> Claim {
        Claim {
            position,
            session: position.stream,
            number: Some(position.number),
            follows: true,
            may_be_repeated: false,
        }
    }

    /// The claim of an end of the stream.
    fn end(position: StreamPosition) -> Claim {
        Claim { may_be_repeated: true, ..claim(position) }
    }

    fn take_at(sequence: &mut Sequence, position: StreamPosition, now: Instant) -> Verdict {
        take_claim(sequence, claim(position), now)
    }

    fn take_claim(sequence: &mut Sequence, claim: Claim, now: Instant) -> Verdict {
        let verdict = sequence.judge(claim, now);
        if verdict == Verdict::Take {
            sequence.taken();
        }
        verdict
    }

    #[test]
    fn a_lossless_sequence_takes_each_message_once_and_in_order() {
        let mut sequence = Sequence::new(true, false);
        let verdicts = [3, 5, 4, 3, 5].map(|number| take(&mut sequence, 1, number, 3));
        assert_eq!(verdicts, [Verdict::Take, Verdict::Early, Verdict::Take, Verdict::Old, Verdict::Take]);
        assert_eq!((sequence.expected(), sequence.lost()), ((1, 6), 0));
    }

    #[test]
    fn a_repeated_end_counts_as_an_end_but_not_that_of_an_earlier_stream() {
        let mut sequence = Sequence::new(true, true);
        take(&mut sequence, 5, 0, 0);
        take(&mut sequence, 5, 1, 0);
        let mut judged = |stream: u64, number: u64| {
            let position = StreamPosition { stream, number, oldest: 0 };
            let verdict = sequence.judge(end(position), Instant::now());
            (sequence.is_of_stream(position), sequence.counts_as_end(position, verdict), verdict)
        };
        assert_eq!(judged(5, 1), (true, true, Verdict::Old));
        assert_eq!(judged(5, 2), (true, true, Verdict::Take));
        assert_eq!(judged(5, 3), (true, false, Verdict::Early), "others have to come before it");
        assert_eq!(judged(4, 1), (false, false, Verdict::Old));
    }

    #[test]
    fn messages_that_the_sender_has_given_up_are_counted_and_not_waited_for() {
        let mut sequence = Sequence::new(true, true);
        take(&mut sequence, 1, 0, 0);
        assert_eq!(take(&mut sequence, 1, 9, 8), Verdict::Early);
        assert_eq!(take(&mut sequence, 1, 8, 8), Verdict::Take);
        assert_eq!(sequence.lost(), 7);
    }

    #[test]
    fn a_repeated_end_counts_nothing_as_lost() {
        let now = Instant::now();
        for first in
            [StreamPosition { stream: 1, number: 2, oldest: 9 }, StreamPosition { stream: 1, number: 8, oldest: 9 }]
        {
            let mut sequence = Sequence::new(true, true);
            assert_eq!(sequence.judge(end(first), now), Verdict::Old, "what comes before it is finished");
            assert_eq!(take(&mut sequence, 1, 9, 9), Verdict::Take);
            assert_eq!(sequence.judge(end(first), now), Verdict::Old);
            assert_eq!((sequence.expected(), sequence.lost()), ((1, 10), 0));
        }
    }

    #[test]
    fn with_latest_the_newest_message_is_taken() {
        let mut sequence = Sequence::new(false, false);
        let verdicts = [4, 6, 5].map(|number| take(&mut sequence, 1, number, number));
        assert_eq!(verdicts, [Verdict::Take, Verdict::Take, Verdict::Old]);
        assert_eq!(sequence.lost(), 1);
    }

    #[test]
    fn a_restarted_sender_is_followed_and_its_predecessor_ignored() {
        for lossless in [true, false] {
            let mut sequence = Sequence::new(lossless, false);
            take(&mut sequence, 5, 7, 7);
            assert_eq!(take(&mut sequence, 6, 0, 0), Verdict::Take);
            assert_eq!(take(&mut sequence, 5, 8, 8), Verdict::Old);
            assert_eq!((sequence.expected(), sequence.lost()), ((6, 1), 0));
        }
    }

    const LATER: Duration = Duration::from_millis(201);

    /// An untrusted sequence that has taken the numbers 0 to 99 of stream 7.
    fn at_work(now: Instant) -> Sequence {
        let mut sequence = Sequence::new(true, false);
        let position = |number| StreamPosition { stream: 7, number, oldest: number };
        (0..100).for_each(|number| assert_eq!(take_at(&mut sequence, position(number), now), Verdict::Take));
        sequence
    }

    /// Messages that a sender of 0 to 99 has not sent: numbers not reached or long past, another stream, an end, an unreadable
    /// message, and one that does not follow the last of its writer.
    fn forged() -> Vec<Claim> {
        let position = |stream, number, oldest| StreamPosition { stream, number, oldest };
        let far = [100_000, 1 << 63, u64::MAX].map(|number| claim(position(7, number, number)));
        let next = claim(position(7, 100, 100));
        let others = [
            claim(position(7, 130, 130)),
            claim(position(7, 0, 0)),
            Claim { session: 7, ..claim(position(8, 0, 0)) },
            Claim { session: 7, ..claim(position(u64::MAX, u64::MAX, u64::MAX)) },
            end(position(7, 100, 100)),
            end(position(7, 3, 3)),
            Claim { number: None, follows: false, may_be_repeated: true, ..next },
            Claim { number: Some(1 << 40), follows: false, ..next },
        ];
        far.into_iter().chain(others).collect()
    }

    #[test]
    fn a_forged_message_is_not_taken_and_displaces_no_genuine_one() {
        let start = Instant::now();
        for forged in forged() {
            let mut sequence = at_work(start);
            let verdict = sequence.judge(forged, start);
            assert!(!sequence.counts_as_end(forged.position, verdict) && verdict != Verdict::Take, "{forged:?}");
            assert_eq!(sequence.expected(), (7, 100), "{forged:?}");
            let true_ones = [100, 101].map(|number| claim(StreamPosition { stream: 7, number, oldest: 98 }));
            assert_eq!(
                true_ones.map(|claim| take_claim(&mut sequence, claim, start)),
                [Verdict::Take; 2],
                "{forged:?}"
            );
            assert_eq!((sequence.expected(), sequence.lost()), ((7, 102), 0), "{forged:?}");
            assert_eq!(sequence.take_refuted(), forged.position.number >= 100, "{forged:?}");
            assert!(!sequence.take_refuted() && !sequence.take_misled(), "it is told once");
        }
    }

    #[test]
    fn a_forged_message_that_is_repeated_disturbs_the_edge_only_for_a_while() {
        let start = Instant::now();
        for forged in forged() {
            let (mut sequence, mut now, mut taken) = (at_work(start), start, Vec::new());
            for _ in 0..3 {
                take_claim(&mut sequence, forged, now);
                now += LATER;
            }
            // The sender has sent 100 to 163, gets no acknowledgement and retransmits all of them, and so on.
            let mut first = 100;
            for _ in 0..40 {
                now += Duration::from_millis(250);
                for number in first..first + FARTHEST_BEHIND {
                    let position = StreamPosition { stream: 7, number, oldest: first };
                    if take_at(&mut sequence, position, now) == Verdict::Take {
                        taken.push(number);
                    }
                }
                let (stream, next) = sequence.expected();
                first = if stream == 7 && next <= first + FARTHEST_BEHIND { first.max(next) } else { first };
            }
            let last = *taken.last().unwrap();
            assert!(taken.is_sorted_by(|one, next| one < next) && taken[0] >= 100, "{forged:?}: {taken:?}");
            assert!(last > 1000 && taken.len() as u64 + FARTHEST_BEHIND > last - 99, "{forged:?}: {taken:?}");
            assert_eq!(sequence.expected(), (7, last + 1), "{forged:?}");
            assert!(sequence.lost() <= FARTHEST_BEHIND, "{forged:?}: {} seem to be lost", sequence.lost());
        }
    }

    #[test]
    fn a_rare_kind_of_message_is_believed_when_it_is_repeated() {
        let start = Instant::now();
        let position = |stream, number, oldest| StreamPosition { stream, number, oldest };
        for (seldom, next, lost) in [
            (claim(position(7, 120, 120)), (7, 121), 20),
            (claim(position(7, 121, 120)), (7, 120), 20),
            (end(position(7, 100, 100)), (7, 101), 0),
            (Claim { number: Some(102), follows: false, ..claim(position(7, 100, 100)) }, (7, 101), 0),
            (Claim { number: None, ..end(position(7, 100, 100)) }, (7, 101), 0),
        ] {
            let mut sequence = at_work(start);
            let verdict = take_claim(&mut sequence, seldom, start);
            assert_eq!((verdict, sequence.expected()), (Verdict::Early, (7, 100)), "{seldom:?}");
            assert_eq!(take_claim(&mut sequence, seldom, start + CONFIRMED_AFTER), Verdict::Early, "{seldom:?}");
            // The sender may keep fewer messages by then.
            let again = Claim {
                position: StreamPosition { oldest: seldom.position.oldest.max(100), ..seldom.position },
                ..seldom
            };
            take_claim(&mut sequence, again, start + LATER);
            assert_eq!((sequence.expected(), sequence.lost()), (next, lost), "{seldom:?}");
            let follows = claim(position(7, next.1, next.1.min(120)));
            assert_eq!(take_claim(&mut sequence, follows, start + LATER), Verdict::Take, "{seldom:?}");
            assert!(!sequence.take_refuted() && !sequence.take_misled(), "{seldom:?}");
        }
        let mut sequence = at_work(start);
        let anew = claim(position(8, 0, 0));
        assert_eq!(take_claim(&mut sequence, anew, start), Verdict::Take, "its bridge was started anew");
    }

    /// A forged stream, or a forged number of the true stream, is left again.
    #[test]
    fn messages_taken_before_a_leap_are_not_taken_again_when_the_sender_continues_as_before() {
        let start = Instant::now();
        for forged in
            [StreamPosition { stream: 8, number: 0, oldest: 0 }, StreamPosition { stream: 7, number: 900, oldest: 900 }]
        {
            let mut sequence = at_work(start);
            let forged = Claim { session: 7, ..claim(forged) };
            let verdicts = [Duration::ZERO, LATER].map(|later| take_claim(&mut sequence, forged, start + later));
            assert_eq!(verdicts, [Verdict::Early, Verdict::Take], "{forged:?}");
            // The sender goes back to numbers before the leap; it is believed when these have come twice.
            let mut taken = Vec::new();
            for (number, later) in [(99, STREAM_TIMEOUT), (99, STREAM_TIMEOUT + LATER), (100, STREAM_TIMEOUT + LATER)] {
                let back = claim(StreamPosition { stream: 7, number, oldest: 95 });
                if take_claim(&mut sequence, back, start + LATER + LATER + later) == Verdict::Take {
                    taken.push(number);
                }
            }
            assert_eq!((taken, sequence.expected()), (vec![100], (7, 101)), "{forged:?}");
            assert_eq!(sequence.lost(), 0, "{forged:?}");
        }
    }

    #[test]
    fn an_end_from_before_a_leap_counts_when_it_is_repeated() {
        let (start, mut sequence) = (Instant::now(), Sequence::new(true, false));
        let old = StreamPosition { stream: 7, number: 3, oldest: 3 };
        take(&mut sequence, 7, 50, 50);
        let are_ends = [Duration::ZERO, LATER].map(|later| {
            let verdict = sequence.judge(end(old), start + later);
            sequence.counts_as_end(old, verdict)
        });
        assert_eq!((are_ends, sequence.expected(), sequence.take_refuted()), ([false, true], (7, 51), false));
    }

    #[test]
    fn the_number_of_doubtful_messages_that_are_kept_is_limited() {
        let (start, mut sequence) = (Instant::now(), Sequence::new(true, false));
        take(&mut sequence, 7, 0, 0);
        for number in 2..1000 {
            take(&mut sequence, 7, number, number);
        }
        assert_eq!((sequence.doubts.len(), sequence.expected()), (MOST_DOUBTS, (7, 1)));
        assert_eq!(take_at(&mut sequence, StreamPosition { stream: 7, number: 1, oldest: 0 }, start), Verdict::Take);
        assert!(sequence.doubts.is_empty() && sequence.take_refuted());
    }

    #[test]
    fn with_latest_a_forged_number_ahead_of_the_sender_does_not_stop_the_edge() {
        for forged in [1 << 63, 100_000] {
            let (mut sequence, start) = (Sequence::new(false, false), Instant::now());
            let mut take = |number: u64, oldest: u64, now: Instant| {
                take_at(&mut sequence, StreamPosition { stream: 1, number, oldest }, now)
            };
            assert_eq!([0, 1, 2].map(|number| take(number, 0, start)), [Verdict::Take; 3]);
            assert_eq!(take(forged, forged, start), Verdict::Take);
            assert_eq!(take(3, 3, start + STREAM_TIMEOUT), Verdict::Old, "it may have come by a slow way");
            let later = start + STREAM_TIMEOUT + Duration::from_millis(1);
            assert_eq!([3, 4].map(|number| take(number, 3, later)), [Verdict::Take; 2]);
            assert_eq!([sequence.take_misled(), sequence.take_misled()], [true, false], "it is told once");
            assert_eq!(sequence.expected(), (1, 5));
            assert!(sequence.lost() <= 1, "{} messages seem to be lost", sequence.lost());
        }
    }

    #[test]
    fn replayed_messages_of_a_trusted_sender_are_old_at_any_age() {
        for lossless in [true, false] {
            let (mut sequence, start) = (Sequence::new(lossless, true), Instant::now());
            let position = |number| StreamPosition { stream: 1, number, oldest: number };
            (0..300).for_each(|number| assert_eq!(take_at(&mut sequence, position(number), start), Verdict::Take));
            for later in [Duration::ZERO, 2 * STREAM_TIMEOUT] {
                for number in [299, 200, 0] {
                    assert_eq!(take_at(&mut sequence, position(number), start + later), Verdict::Old, "{number}");
                }
            }
            assert_eq!((sequence.expected(), sequence.lost(), sequence.take_misled()), ((1, 300), 0, false));
        }
    }

    #[test]
    fn late_messages_of_a_slower_path_are_old_as_long_as_new_ones_arrive() {
        let (mut sequence, start) = (Sequence::new(false, false), Instant::now());
        for number in 0..300_u64 {
            let now = start + Duration::from_millis(33 * number);
            assert_eq!(
                take_at(&mut sequence, StreamPosition { stream: 1, number, oldest: number }, now),
                Verdict::Take
            );
            let late = StreamPosition { stream: 1, number: number.saturating_sub(100), oldest: 0 };
            assert_eq!(take_at(&mut sequence, late, now), Verdict::Old);
        }
        assert_eq!((sequence.take_misled(), sequence.lost()), (false, 0));
    }

    #[test]
    fn a_message_retransmitted_after_a_lost_acknowledgement_is_old() {
        let mut sequence = Sequence::new(true, false);
        take(&mut sequence, 1, FARTHEST_BEHIND, FARTHEST_BEHIND);
        assert_eq!(take(&mut sequence, 1, 1, 1), Verdict::Old);
        take(&mut sequence, 1, FARTHEST_BEHIND + 1, FARTHEST_BEHIND + 1);
        let first = end(StreamPosition { stream: 1, number: 0, oldest: 0 });
        let verdicts = [Duration::ZERO, LATER].map(|later| sequence.judge(first, Instant::now() + later));
        assert_eq!(verdicts, [Verdict::Early, Verdict::Old], "an end is told until everybody knows it");
        assert_eq!((sequence.expected(), sequence.take_misled()), ((1, FARTHEST_BEHIND + 2), false));
    }

    #[test]
    fn a_sender_whose_clock_was_set_back_is_followed_when_its_predecessor_is_silent() {
        let (mut sequence, start) = (Sequence::new(true, false), Instant::now());
        let position = |stream, number| StreamPosition { stream, number, oldest: number };
        assert_eq!(take_at(&mut sequence, position(5, 7), start), Verdict::Take);
        assert_eq!(take_at(&mut sequence, position(4, 0), start + STREAM_TIMEOUT), Verdict::Old);
        let later = start + STREAM_TIMEOUT + Duration::from_millis(1);
        assert_eq!(take_at(&mut sequence, position(4, 0), later), Verdict::Take);
        assert_eq!((sequence.expected(), sequence.lost()), ((4, 1), 0));
    }
}
