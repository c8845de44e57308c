//! Edges between machines, over Zenoh: the only place that knows it.
//!
//! Where a topic is written on one machine and read on another, the launcher of each starts one bridge process. What leaves
//! is read from shared memory, encoded ([`wire`]) and put under `conicflow/PIPELINE/MACHINE/TOPIC` ([`sending`]); what comes
//! is checked, decoded and written into shared memory ([`receiving`]). Each bridge also puts a small beacon under
//! `conicflow/PIPELINE/@link/MACHINE` ([`beacon`]): it acknowledges, measures the clocks, and shows that the link lives,
//! because Zenoh's `put` succeeds with nobody there. What is short and may be lost goes by datagrams, where the file names
//! endpoints for these ([`ways`]). [`outbox`] and [`sequence`] are the two ends of lossless delivery;
//! where the newest wins, [`window`] keeps what is under way from becoming a queue.

mod account;
mod beacon;
mod codec;
mod compression;
mod counts;
mod depth_codec;
mod ellipse_codec;
mod kept;
mod links;
mod mailbox;
mod outbox;
mod process;
mod receiving;
mod sending;
mod sequence;
mod settings;
mod ways;
mod window;
mod wire;
#[cfg(test)]
mod wire_tests;

pub use codec::Wire;
pub use wire::{MAX_MESSAGE, Place, WIRE_VERSION, WireError, decode_message, encode_message};

use conicflow_dataflow::ports::PortError;
use conicflow_dataflow::{Network, NetworkError, SettingsFault};

/// The network part of a program: it goes into its `Registry`.
pub const NETWORK: Network = Network {
    check: settings::check,
    listen_endpoints: settings::listen_endpoints,
    run: |bridge, run, around| {
        process::run(bridge, run, around).map_err(|error| {
            let is_final = error.is_final();
            if is_final { NetworkError::Refused(error.into()) } else { NetworkError::Failed(error.into()) }
        })
    },
};

/// Why a bridge ended before its edges did.
#[derive(Debug, thiserror::Error)]
enum BridgeError {
    /// The machine's table, or its Zenoh file.
    #[error("{0}")]
    Settings(#[from] SettingsFault),
    /// Shared memory.
    #[error(transparent)]
    Port(#[from] PortError),
    /// Bytes that cannot be made.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// Zenoh.
    #[error("{doing}: {reason}\n  hint: are the endpoints in the machine's table right, and free?")]
    Zenoh {
        /// What was being done.
        doing: String,
        /// What Zenoh said.
        reason: String,
    },
    /// A thread panicked.
    #[error("an edge of the bridge panicked; its message stands above")]
    Panicked,
}

impl BridgeError {
    /// Whether starting anew would not help.
    fn is_final(&self) -> bool {
        use PortError::{Incompatible, PathTooLong};
        matches!(self, Self::Settings(_) | Self::Port(Incompatible { .. } | PathTooLong { .. }))
    }

    fn zenoh(doing: &str, reason: impl std::fmt::Display) -> Self {
        Self::Zenoh { doing: doing.to_owned(), reason: reason.to_string() }
    }
}
