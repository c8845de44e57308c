//! What is told once, however often it comes.

use std::collections::BTreeSet;

/// So many texts are told: who comes with ever new ones fills no log.
const MOST: usize = 16; // [algorithmic]

/// The texts that were told.
#[derive(Debug, Default)]
pub(crate) struct ToldOnce(BTreeSet<String>);

impl ToldOnce {
    pub(crate) const fn new() -> Self {
        Self(BTreeSet::new())
    }

    /// Whether this is to be told now: it was not before, and not too many others were.
    pub(crate) fn admits(&mut self, text: &str) -> bool {
        self.0.len() < MOST && self.0.insert(text.to_owned())
    }

    /// All that was told.
    pub(crate) fn texts(&self) -> &BTreeSet<String> {
        &self.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_text_is_told_once_and_no_more_than_so_many() {
        let mut told = ToldOnce::new();
        assert_eq!(["a", "a", "b", "a"].map(|text| told.admits(text)), [true, false, true, false]);
        assert!(told.texts().iter().eq(["a", "b"]));
        let more = (0..2 * MOST).filter(|number| told.admits(&number.to_string())).count();
        assert_eq!(more, MOST - 2);
        assert!(!told.admits("a"));
    }
}
