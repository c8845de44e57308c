//! Edges between machines, over Zenoh, and taking part in ROS 2 ([`ros2`]): the only place that knows Zenoh.
//!
//! Where a topic is written on one machine and read on another, the launcher of each starts one bridge process ([`process`]).
//! What leaves is read from shared memory, encoded ([`wire`]) and put under `conicflow/PIPELINE/MACHINE/TOPIC` ([`sending`]);
//! what comes is checked, decoded and written into shared memory ([`receiving`]). Each bridge also puts a small heartbeat
//! under `conicflow/PIPELINE/@link/MACHINE` ([`peer`]): it acknowledges, measures the clocks, and shows that the link lives,
//! because Zenoh's `put` succeeds with nobody there. Where the machines share a key, nothing counts that was not made with it by
//! the present start of the other bridge (`wire::seal`, `peer::links`). What is short and may be lost goes by datagrams, where
//! the file names endpoints for these ([`session`]). [`reliable`] holds the two ends of lossless delivery, and the window that
//! keeps what is under way from becoming a queue where the newest wins. Where links are TLS, a certificate that does not do is
//! told before (`certificates`), and one that is refused when that happens ([`ear`]).
//!
//! Lossless delivery is written here, and not taken from `zenoh-ext` (`AdvancedPublisher`, `AdvancedSubscriber`), which has a
//! cache, finds misses and sends again: it is marked unstable, and it has no back-pressure. A lossless edge has to let its
//! writer wait as soon as a receiver lags, to keep what is not acknowledged for the process that takes the place of a killed
//! one, and to say how many messages are lost in the end.

mod certificates;
mod channel;
#[cfg(test)]
mod edge_tests;
mod error;
mod handshakes;
#[cfg(test)]
mod loopback;
mod peer;
mod process;
mod receiving;
mod reliable;
mod ros2;
mod sending;
mod session;
mod settings;
mod told_once;
mod wire;

pub use handshakes::ear;
pub use ros2::NODES;
pub use wire::{MAX_MESSAGE, StreamPosition, WIRE_VERSION, WireError, decode_message, encode_message};

use conicflow_dataflow::{Carrier, Network, NetworkError};

/// The network part of a program: it goes into its `Registry`.
pub const NETWORK: Network = Network {
    check: settings::check,
    warnings: settings::warnings,
    listen_endpoints: settings::listen_endpoints,
    carrier: Carrier::Here(|bridge, run, runtime| {
        process::run(bridge, run, runtime).map_err(|error| {
            let is_final = error.is_final();
            if is_final { NetworkError::Refused(error.into()) } else { NetworkError::Failed(error.into()) }
        })
    }),
};
