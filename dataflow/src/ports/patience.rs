//! How long a writer waits for readers that finish nothing.

use std::time::{Duration, Instant};

/// Readers that want every message, and finish none for so long while they are there, are not waited for any longer: neither
/// before longer messages need another place, nor before the end is told to the others.
const LONGEST: Duration = Duration::from_secs(5);

/// What a writer saw of its readers last, and since when that has not changed.
pub(crate) struct Patience<S>(Option<(S, Instant)>);

impl<S: PartialEq> Patience<S> {
    /// Before the first look.
    pub(crate) const fn new() -> Self {
        Self(None)
    }

    /// Whether what is seen `now` has been so for too long.
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
