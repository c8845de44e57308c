//! Edges between machines over Zenoh, and participation in ROS 2 ([`ros2`]): the only package that uses Zenoh.
//!
//! Where a topic is written on one machine and read on another, the launcher of each machine starts one bridge process
//! ([`process`]). Outgoing messages are read from shared memory, encoded ([`wire`]) and put under
//! `conicflow/PIPELINE/MACHINE/TOPIC` ([`sending`]). Incoming messages are admitted only from the present session of the other
//! bridge ([`authenticator`]); then they are checked, decoded and written into shared memory ([`receiving`]). Each bridge also puts a
//! small heartbeat under `conicflow/PIPELINE/@link/MACHINE` ([`peer`]): it acknowledges messages, compares the clocks, and shows
//! that the link is alive, because Zenoh's `put` succeeds without any receiver. Where the machines share a key, a message counts
//! only if it was made with that key by the present start of the other bridge (`wire::seal`, `peer::links`). Short messages that
//! may be lost go by datagrams, if the file names endpoints for them ([`session`]). [`reliable`] holds the two ends of lossless
//! delivery, and the window that keeps messages under way from queueing with `latest`. For TLS links, faulty certificates are
//! reported at the start (`certificates`), and failed handshakes when they occur ([`handshake_layer`]).
//!
//! Lossless delivery is implemented here rather than with `zenoh-ext` (`AdvancedPublisher`, `AdvancedSubscriber`), which has a
//! cache, detects misses and retransmits, but is marked unstable and has no back-pressure. A lossless edge has to make its writer
//! wait as soon as a receiver lags, to keep unacknowledged messages for the process that replaces a killed one, and to report the
//! number of lost messages in the end.

mod authenticator;
mod certificates;
mod channel;
#[cfg(test)]
mod edge_tests;
mod error;
mod handshakes;
mod logged_once;
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
mod shared;
mod wire;

pub use handshakes::handshake_layer;
pub use ros2::NODES;
pub use wire::{MAX_MESSAGE, StreamPosition, WIRE_VERSION, WireError, decode_message, encode_message};

use conicflow_dataflow::{Carrier, Network, NetworkError};

/// The network part of a program, for its `Registry`.
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
