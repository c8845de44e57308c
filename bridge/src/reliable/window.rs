//! How much may be under way on an edge where the newest wins: as much as the link carries without a queue.
//!
//! What waits in a queue is old when it comes, and whatever else takes that link waits behind it. So the number of messages
//! under way grows by one with each that is acknowledged in time, and is halved when one took longer than the link's own
//! round trip, a retransmission and a short wait explain.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// More than this is never under way.
const MAX_MESSAGES: usize = 64;
/// What was not acknowledged after this time is lost.
const SURELY_LOST: Duration = Duration::from_secs(1);
/// No round trip is taken to be longer.
const MAX_ROUND_TRIP: Duration = Duration::from_millis(400);

/// The messages of one edge that are under way.
#[cfg_attr(test, derive(Clone))]
pub(crate) struct Window {
    under_way: VecDeque<(u64, Instant)>,
    size: usize,
    /// How long a message may wait on the way.
    wait: Duration,
    /// Messages before this one say nothing new about the queue.
    judged_from: u64,
}

impl Window {
    /// Messages that may wait for `wait`; those that may wait for less give way to the others.
    pub(crate) fn new(wait: Duration) -> Self {
        Self { under_way: VecDeque::new(), size: 1, wait, judged_from: 0 }
    }

    pub(crate) fn sent(&mut self, number: u64, now: Instant) {
        self.under_way.push_back((number, now));
    }

    /// All messages before `next` have arrived, over a link of this round trip, or are lost.
    pub(crate) fn acknowledge(&mut self, next: u64, round_trip: Duration, now: Instant) {
        let limit = 2 * round_trip.min(MAX_ROUND_TRIP) + self.wait;
        while let Some(&(number, sent)) = self.under_way.front() {
            let took = now.saturating_duration_since(sent);
            if number >= next && took < SURELY_LOST {
                break;
            }
            self.under_way.pop_front();
            self.judge(number, took <= limit);
        }
    }

    fn judge(&mut self, number: u64, in_time: bool) {
        if in_time {
            self.size = (self.size + 1).min(MAX_MESSAGES);
        } else if number >= self.judged_from {
            self.size = (self.size / 2).max(1);
            self.judged_from = self.under_way.back().map_or(number, |(last, _)| *last) + 1;
        }
    }

    /// Nobody is there: whatever is under way will not arrive.
    pub(crate) fn clear(&mut self) {
        self.under_way.clear();
        self.size = 1;
    }

    /// Whether another message may be sent.
    pub(crate) fn is_open(&self) -> bool {
        self.under_way.len() < self.size
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WAIT: Duration = Duration::from_millis(100);
    const ROUND_TRIP: Duration = Duration::from_millis(200);
    const SOON: Duration = Duration::from_millis(500);
    const LATE: Duration = Duration::from_millis(501);

    /// Sends as many as may be sent; returns the number of the next.
    fn fill(window: &mut Window, mut number: u64, now: Instant) -> u64 {
        while window.is_open() {
            window.sent(number, now);
            number += 1;
        }
        number
    }

    #[test]
    fn it_opens_while_messages_arrive_in_time_and_closes_when_they_wait() {
        let (mut window, mut now) = (Window::new(WAIT), Instant::now());
        let mut next = fill(&mut window, 0, now);
        let mut sizes = Vec::new();
        for delay in [SOON, SOON, SOON, LATE, LATE, LATE, SOON] {
            now += delay;
            window.acknowledge(next, ROUND_TRIP, now);
            sizes.push(window.size);
            next = fill(&mut window, next, now);
        }
        assert_eq!(sizes, [2, 4, 8, 4, 2, 1, 2]);
    }

    #[test]
    fn what_is_lost_is_not_waited_for() {
        let (mut window, start) = (Window::new(WAIT), Instant::now());
        fill(&mut window, 0, start);
        window.acknowledge(0, ROUND_TRIP, start + SURELY_LOST - Duration::from_millis(1));
        assert!(!window.is_open());
        window.acknowledge(0, ROUND_TRIP, start + SURELY_LOST);
        assert!(window.is_open());
    }
}
