//! Helpers for errors about files that cannot be read.

use conicflow_messages::Hinted;

/// Adds a hint to an error that has none.
pub(super) fn hinted(error: anyhow::Error, hint: &str) -> anyhow::Error {
    let has_hint = error.chain().any(|cause| cause.is::<Hinted>());
    if has_hint { error } else { Hinted::new(format!("{error:#}"), hint).into() }
}

/// Returns the beginning of a line, for an error.
pub(super) fn excerpt(line: &str) -> String {
    line.trim_end().chars().take(60).collect()
}
