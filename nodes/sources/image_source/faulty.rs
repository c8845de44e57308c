//! What is said of files that cannot be read.

use conicflow_messages::Hinted;

/// An error with what to do about it, where it does not say so itself.
pub(super) fn hinted(error: anyhow::Error, hint: &str) -> anyhow::Error {
    let has_hint = error.chain().any(|cause| cause.is::<Hinted>());
    if has_hint { error } else { Hinted::new(format!("{error:#}"), hint).into() }
}

/// The beginning of a line, for an error.
pub(super) fn excerpt(line: &str) -> String {
    line.trim_end().chars().take(60).collect()
}
