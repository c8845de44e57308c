//! Where Zenoh's threads leave what came for one edge: bounded, and never a reason for them to wait.

use std::collections::VecDeque;
use std::sync::{Condvar, Mutex, PoisonError};
use std::time::Duration;

/// A bounded queue between threads.
pub(super) struct Mailbox<M> {
    letters: Mutex<VecDeque<M>>,
    came: Condvar,
    capacity: usize,
    newest_wins: bool,
}

impl<M> Mailbox<M> {
    /// A queue of `capacity` messages. When it is full the oldest makes room if the newest wins, else what comes is refused.
    pub(super) fn new(capacity: usize, newest_wins: bool) -> Self {
        Self { letters: Mutex::default(), came: Condvar::new(), capacity, newest_wins }
    }

    /// Leaves a message; false if one was lost by that.
    pub(super) fn leave(&self, letter: M) -> bool {
        let mut letters = self.letters.lock().unwrap_or_else(PoisonError::into_inner);
        let full = letters.len() >= self.capacity;
        if full && self.newest_wins {
            letters.pop_front();
        }
        if !full || self.newest_wins {
            letters.push_back(letter);
        }
        self.came.notify_one();
        !full
    }

    /// The oldest message, as soon as there is one, at most after `timeout`.
    pub(super) fn take(&self, timeout: Duration) -> Option<M> {
        let letters = self.letters.lock().unwrap_or_else(PoisonError::into_inner);
        let waited = self.came.wait_timeout_while(letters, timeout, |letters| letters.is_empty());
        waited.unwrap_or_else(PoisonError::into_inner).0.pop_front()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn full_boxes_keep_the_newest_or_the_oldest() {
        for (newest_wins, kept) in [(true, [2, 3]), (false, [0, 1])] {
            let mailbox = Mailbox::new(2, newest_wins);
            let left: Vec<_> = (0..4).map(|letter| mailbox.leave(letter)).collect();
            assert_eq!(left, [true, true, false, false]);
            assert_eq!([(); 2].map(|()| mailbox.take(Duration::ZERO).unwrap()), kept);
            assert_eq!(mailbox.take(Duration::ZERO), None);
        }
    }
}
