//! The errors of a bridge.

use crate::wire::WireError;
use conicflow_dataflow::Hinted;
use conicflow_dataflow::ports::PortError;

/// Why a bridge ended before its edges did.
#[derive(Debug, thiserror::Error)]
pub(crate) enum BridgeError {
    /// A fault in the machine's table or its Zenoh file.
    #[error("{0}")]
    Settings(#[from] Hinted),
    /// An error of shared memory.
    #[error(transparent)]
    Port(#[from] PortError),
    /// A message that cannot be encoded.
    #[error(transparent)]
    Wire(#[from] WireError),
    /// An error of Zenoh.
    #[error("{doing}: {reason}\n  hint: are the endpoints in the machine's table right, and free?")]
    Zenoh {
        /// The action that failed.
        doing: String,
        /// The reason that Zenoh gives.
        reason: String,
    },
    /// A thread panicked.
    #[error("an edge of the bridge panicked; its message stands above")]
    Panicked,
}

impl BridgeError {
    /// Whether a restart would not help.
    pub(crate) fn is_final(&self) -> bool {
        use PortError::{Incompatible, PathTooLong};
        matches!(self, Self::Settings(_) | Self::Port(Incompatible { .. } | PathTooLong { .. }))
    }

    pub(crate) fn zenoh(doing: &str, reason: impl std::fmt::Display) -> Self {
        Self::Zenoh { doing: doing.to_owned(), reason: reason.to_string() }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::path::PathBuf;

    #[test]
    fn a_bridge_is_restarted_unless_only_other_files_would_help() {
        let too_long = PortError::PathTooLong { path: PathBuf::new(), length: 200, limit: 100 };
        for is_lasting in [BridgeError::Settings(Hinted::new("no endpoint", "name one")), too_long.into()] {
            assert!(is_lasting.is_final(), "{is_lasting}");
        }
        for passes in
            [BridgeError::zenoh("cannot declare a key", "closed"), BridgeError::Panicked, PortError::Stopped.into()]
        {
            assert!(!passes.is_final(), "{passes}");
        }
    }
}
