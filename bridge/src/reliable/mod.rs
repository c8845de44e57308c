//! Lossless delivery: the sender keeps unacknowledged messages, also on disk, and retransmits them; the receiver takes messages
//! in order. With `latest`, a window limits the messages under way instead.

#[cfg(test)]
mod model;
pub(crate) mod passed_on;
pub(crate) mod retransmit_queue;
pub(crate) mod send_log;
pub(crate) mod sequence;
pub(crate) mod window;
