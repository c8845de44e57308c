//! What bridges know of one another: they send each other heartbeats, compare their clocks, and report how each link is.

pub(crate) mod clock;
pub(crate) mod counts;
pub(crate) mod heartbeat;
pub(crate) mod journal;
pub(crate) mod links;
pub(crate) mod report;
