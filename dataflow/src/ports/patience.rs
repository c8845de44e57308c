//! Timeout of a writer that waits for readers which finish no message.

use std::time::{Duration, Instant};

/// Maximum wait for connected lossless readers without progress, before the publisher is replaced for longer messages, and before
/// the end of the stream is sent to the other readers.
const LONGEST: Duration = Duration::from_secs(5);

/// The last observed state of the readers, and the time since which it has not changed.
pub(crate) struct Patience<S>(Option<(S, Instant)>);

impl<S: PartialEq> Patience<S> {
    /// State before the first check.
    pub(crate) const fn new() -> Self {
        Self(None)
    }

    /// Whether the state `seen` has not changed for too long by `now`.
    pub(crate) fn is_over(&mut self, seen: S, now: Instant) -> bool {
        match &self.0 {
            Some((last, since)) if *last == seen => now.duration_since(*since) > LONGEST,
            _ => {
                self.0 = Some((seen, now));
                false
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn readers_are_waited_for_until_nothing_has_become_of_what_they_have_to_finish_for_five_seconds() {
        let (mut patience, begin) = (Patience::new(), Instant::now());
        let mut is_over =
            |unfinished: usize, passed_ms: u64| patience.is_over(unfinished, begin + Duration::from_millis(passed_ms));
        assert_eq!([0, 100, 5000].map(|passed_ms| is_over(3, passed_ms)), [false; 3]);
        assert!(is_over(3, 5001));
        assert_eq!([6000, 11_000].map(|passed_ms| is_over(2, passed_ms)), [false; 2], "one was finished");
        assert!(is_over(2, 11_001));
        assert!(!is_over(4, 20_000), "there is more to finish");
    }
}
