//! The bounded channel from Zenoh's threads to the thread of an edge; the sending side never waits.

use conicflow_dataflow::lock;
use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::Duration;

/// A bounded queue between threads.
pub(super) struct Channel<M> {
    messages: Mutex<VecDeque<M>>,
    arrived: Condvar,
    capacity: usize,
    newest_wins: bool,
}

impl<M> Channel<M> {
    /// Creates a queue of `capacity` messages. When it is full, `newest_wins` drops the oldest message; otherwise a new one is
    /// refused.
    pub(super) fn new(capacity: usize, newest_wins: bool) -> Self {
        Self { messages: Mutex::default(), arrived: Condvar::new(), capacity, newest_wins }
    }

    /// Adds a message; returns false if a message was lost.
    pub(super) fn send(&self, message: M) -> bool {
        let mut messages = lock(&self.messages);
        let full = messages.len() >= self.capacity;
        if full && self.newest_wins {
            messages.pop_front();
        }
        if !full || self.newest_wins {
            messages.push_back(message);
        }
        self.arrived.notify_one();
        !full
    }

    /// Waits for a message for at most `timeout` and returns the oldest one.
    pub(super) fn receive(&self, timeout: Duration) -> Option<M> {
        let messages = lock(&self.messages);
        let waited = self.arrived.wait_timeout_while(messages, timeout, |messages| messages.is_empty());
        waited.unwrap_or_else(PoisonError::into_inner).0.pop_front()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_full_channel_keeps_the_newest_or_the_oldest() {
        for (newest_wins, kept) in [(true, [2, 3]), (false, [0, 1])] {
            let channel = Channel::new(2, newest_wins);
            let sent: Vec<_> = (0..4).map(|message| channel.send(message)).collect();
            assert_eq!(sent, [true, true, false, false]);
            assert_eq!([(); 2].map(|()| channel.receive(Duration::ZERO).unwrap()), kept);
            assert_eq!(channel.receive(Duration::ZERO), None);
        }
    }
}
