//! What a pipeline file says of the metrics of its run.

use std::net::SocketAddr;

/// Where the launcher offers the metrics of a run, and to whom.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Metrics {
    /// The address.
    pub listen: SocketAddr,
    /// What has to be known to read them; `None`: nothing.
    pub token: Option<String>,
}

impl Metrics {
    /// Whether anyone on the network may read them.
    pub fn is_open_to_others(&self) -> bool {
        self.token.is_none() && !self.listen.ip().is_loopback()
    }
}
