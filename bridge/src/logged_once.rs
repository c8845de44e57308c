//! A set of messages for the user that are each logged only once.

use std::collections::BTreeSet;

/// At most this many texts are logged, so that a peer with ever new ones cannot fill the log.
const MOST: usize = 16; // [algorithmic]

/// The texts that were logged.
#[derive(Debug, Default)]
pub(crate) struct LoggedOnce(BTreeSet<String>);

impl LoggedOnce {
    pub(crate) const fn new() -> Self {
        Self(BTreeSet::new())
    }

    /// Whether this text is to be logged now: it was not logged before, and the limit is not reached.
    pub(crate) fn admits(&mut self, text: &str) -> bool {
        self.0.len() < MOST && self.0.insert(text.to_owned())
    }

    /// All texts that were logged.
    pub(crate) fn texts(&self) -> &BTreeSet<String> {
        &self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_text_is_logged_once_up_to_a_maximum_number_of_texts() {
        let mut logged = LoggedOnce::new();
        assert_eq!(["a", "a", "b", "a"].map(|text| logged.admits(text)), [true, false, true, false]);
        assert!(logged.texts().iter().eq(["a", "b"]));
        let more = (0..2 * MOST).filter(|number| logged.admits(&number.to_string())).count();
        assert_eq!(more, MOST - 2);
        assert!(!logged.admits("a"));
    }
}
