//! The difference between two machines' clocks.

use std::collections::VecDeque;

/// How many seconds exchanges are remembered: a queue on the link, which delays one direction, rarely lasts longer.
const SECONDS: u64 = 32;
/// The largest drift between two clocks within [`SECONDS`], in nanoseconds.
const DRIFT_NS: i64 = 10_000_000;

/// The difference between two machines' clocks, from exchanges of heartbeats.
///
/// The method is that of NTP: with t1, t4 the own times of sending and receiving and t2, t3 those of the peer, the offset is
/// `((t2 - t1) + (t3 - t4)) / 2`. Its error is at most half the asymmetry of the round trip. Among the exchanges of the last
/// seconds, the one with the shortest round trip counts.
#[derive(Debug, Default)]
pub(crate) struct Clock {
    /// The second, and its best exchange.
    best: VecDeque<(u64, Exchange)>,
}

/// One exchange.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Exchange {
    /// Time on the way, there and back, in nanoseconds.
    pub round_trip_ns: i64,
    /// The peer's clock minus the own clock, in nanoseconds.
    pub offset_ns: i64,
}

impl Clock {
    /// Adds an exchange; impossible times are ignored.
    pub(crate) fn add(&mut self, [t1, t2, t3, t4]: [u64; 4]) {
        let second = t4 / 1_000_000_000;
        let [t1, t2, t3, t4] = [t1, t2, t3, t4].map(i128::from);
        let exchange = (i64::try_from((t4 - t1) - (t3 - t2)), i64::try_from(((t2 - t1) + (t3 - t4)) / 2));
        let (Ok(round_trip_ns @ 0..), Ok(offset_ns)) = exchange else { return };
        let exchange = Exchange { round_trip_ns, offset_ns };
        if self.best().is_some_and(|best| best.contradicts(&exchange)) {
            self.clear();
        }
        match self.best.back_mut() {
            Some((last, best)) if *last == second => *best = quicker(*best, exchange),
            _ => self.best.push_back((second, exchange)),
        }
        while self.best.front().is_some_and(|(first, _)| first + SECONDS <= second) {
            self.best.pop_front();
        }
    }

    /// Forgets all exchanges: the peer may be another machine now, or one of the two was suspended.
    pub(crate) fn clear(&mut self) {
        self.best.clear();
    }

    /// The best exchange of the last seconds.
    pub(crate) fn best(&self) -> Option<Exchange> {
        self.best.iter().map(|(_, exchange)| *exchange).reduce(quicker)
    }
}

impl Exchange {
    /// Whether no offset between two running clocks explains both exchanges.
    fn contradicts(&self, other: &Self) -> bool {
        let apart = self.offset_ns.abs_diff(other.offset_ns);
        let explained = (self.round_trip_ns / 2).saturating_add(other.round_trip_ns / 2).saturating_add(DRIFT_NS);
        apart > explained.unsigned_abs()
    }
}

fn quicker(one: Exchange, other: Exchange) -> Exchange {
    if other.round_trip_ns < one.round_trip_ns { other } else { one }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: u64 = 1_000_000_000;

    #[test]
    fn the_quickest_exchange_gives_the_clock_offset() {
        let mut clock = Clock::default();
        assert_eq!(clock.best(), None);
        // The peer is 1000 ahead; 10 there and 10 back, then 10 there and 300 back.
        clock.add([100, 1110, 1150, 160]);
        clock.add([200, 1210, 1250, 550]);
        assert_eq!(clock.best(), Some(Exchange { round_trip_ns: 20, offset_ns: 1000 }));
        clock.add([u64::MAX, 0, u64::MAX, 0]);
        assert_eq!(clock.best().unwrap().offset_ns, 1000);
    }

    #[test]
    fn clocks_are_compared_again_after_one_stood_still() {
        let mut clock = Clock::default();
        clock.add([100, 1110, 1150, 160]);
        // The own clock stood still for a minute; the first exchange after that is slow.
        let minute = 60_000_000_000;
        clock.add([200, minute + 1210, minute + 1250, 5_000_550]);
        let offset = clock.best().unwrap().offset_ns;
        assert!((offset - minute as i64).abs() < 3_000_000, "{offset}");
    }

    /// An offset may differ by half of each round trip (10 and 50 ms) and by 10 ms of drift.
    #[test]
    fn clocks_are_compared_again_when_no_single_offset_explains_two_exchanges() {
        const MS: i64 = 1_000_000;
        let exchange = |round_trip_ms: i64, offset_ms: i64| {
            let (begin, end) = (1000 * MS, (1000 + round_trip_ms) * MS);
            let there = begin + (round_trip_ms / 2 + offset_ms) * MS;
            [begin, there, there, end].map(|time| time as u64)
        };
        for (offset_ms, best_ms) in [(70, 0), (71, 71), (-70, 0), (-71, -71)] {
            let mut clock = Clock::default();
            clock.add(exchange(20, 0));
            clock.add(exchange(100, offset_ms));
            assert_eq!(clock.best().unwrap().offset_ns, best_ms * MS, "{offset_ms} ms apart");
        }
    }

    #[test]
    fn a_quick_exchange_is_remembered_for_a_limited_time_whatever_number_of_slow_ones_follow() {
        let mut clock = Clock::default();
        clock.add([0, 10, 10, 20]);
        let slow = |time: u64| [time, time + 5000, time + 5000, time + 5010];
        (1..3100).for_each(|count| clock.add(slow(count * SECOND / 100)));
        assert_eq!(clock.best().unwrap().round_trip_ns, 20);
        assert!(clock.best.len() as u64 <= SECONDS, "one of each second is enough");
        (31..40).for_each(|second| clock.add(slow(second * SECOND)));
        assert_eq!(clock.best().unwrap().round_trip_ns, 5010);
    }

    #[test]
    fn the_time_for_which_an_exchange_is_remembered_begins_with_the_exchange() {
        let mut clock = Clock::default();
        for (second, back_ns) in [(0, 5010), (5, 20), (33, 5010)] {
            clock.add([second * SECOND, second * SECOND + 10, second * SECOND + 10, second * SECOND + back_ns]);
        }
        assert_eq!(clock.best().unwrap().round_trip_ns, 20, "of 28 seconds ago");
    }
}
