//! The window of an edge with `latest`: limits the messages under way to what the link carries without a queue.
//!
//! Messages in a queue are old when they arrive, and other traffic on the link waits behind them. So the window grows by one for
//! each message that is acknowledged in time. It is halved when a message took longer than two round trips of the link and a
//! short wait.

use std::collections::VecDeque;
use std::time::{Duration, Instant};

/// Upper limit of the window.
const MAX_MESSAGES: usize = 64;
/// A message that was not acknowledged after this time counts as lost.
const SURELY_LOST: Duration = Duration::from_secs(1);
/// Upper limit of the round trip that is assumed.
const MAX_ROUND_TRIP: Duration = Duration::from_millis(400);

/// The messages of one edge that are under way.
#[cfg_attr(test, derive(Clone))]
pub(crate) struct Window {
    under_way: VecDeque<(u64, Instant)>,
    size: usize,
    /// How long a message may wait on the way, besides two round trips.
    wait: Duration,
    /// Messages before this one say nothing new about the queue.
    judged_from: u64,
}

impl Window {
    /// Returns a window for messages that may wait for `wait`; edges with a shorter wait yield to those with a longer one.
    pub(crate) fn new(wait: Duration) -> Self {
        Self { under_way: VecDeque::new(), size: 1, wait, judged_from: 0 }
    }

    pub(crate) fn sent(&mut self, number: u64, now: Instant) {
        self.under_way.push_back((number, now));
    }

    /// Notes that all messages before `next` have arrived or are lost, over a link of this round trip.
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

    /// Empties the window, because no receiver is connected and nothing under way will arrive.
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

    /// Sends messages until the window is full; returns the next number.
    fn fill(window: &mut Window, mut number: u64, now: Instant) -> u64 {
        while window.is_open() {
            window.sent(number, now);
            number += 1;
        }
        number
    }

    #[test]
    fn the_window_grows_while_messages_arrive_in_time_and_shrinks_when_they_are_late() {
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
    fn a_lost_message_is_not_waited_for() {
        let (mut window, start) = (Window::new(WAIT), Instant::now());
        fill(&mut window, 0, start);
        window.acknowledge(0, ROUND_TRIP, start + SURELY_LOST - Duration::from_millis(1));
        assert!(!window.is_open());
        window.acknowledge(0, ROUND_TRIP, start + SURELY_LOST);
        assert!(window.is_open());
    }
}
