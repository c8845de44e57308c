//! The relations between bridges: heartbeats, clock comparison, acknowledgements, and reports on the links.

pub(crate) mod clock;
pub(crate) mod counts;
pub(crate) mod heartbeat;
pub(crate) mod journal;
pub(crate) mod links;
pub(crate) mod report;
