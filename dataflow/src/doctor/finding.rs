//! What an examination finds.

use std::fmt::{self, Display};

/// Something that is wrong, and what to do about it.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Finding {
    /// What is wrong, and where.
    pub what: String,
    /// What to do about it.
    pub hint: String,
}

impl Finding {
    pub(super) fn new(what: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { what: what.into(), hint: hint.into() }
    }

    /// An error is its text and its hint.
    pub(super) fn of(error: &impl Display) -> Self {
        let text = error.to_string();
        let (what, hint) = text.split_once("\n  hint: ").unwrap_or((&text, ""));
        Self::new(what, hint)
    }
}

impl Display for Finding {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}\n  hint: {}", self.what, self.hint)
    }
}
