//! The phases in which a run comes to its end.

use std::time::Instant;

/// How hard the run presses for its end.
#[derive(Clone, Copy, Debug)]
pub(crate) enum Phase {
    Running,
    /// The sources were stopped; something was delivered last at that time.
    Delivering {
        delivered: u64,
        since: Instant,
    },
    /// All stages were told to end at once.
    Stopping {
        since: Instant,
    },
    Killing,
}
