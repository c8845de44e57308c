//! Lossless delivery: the sender keeps, on disk too, what is not acknowledged, and sends it again; the receiver takes messages
//! in their order. Where the newest wins, a window bounds what is under way instead.

#[cfg(test)]
mod model;
pub(crate) mod passed_on;
pub(crate) mod retransmit_queue;
pub(crate) mod send_log;
pub(crate) mod sequence;
pub(crate) mod window;
