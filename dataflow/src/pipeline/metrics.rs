//! Metrics settings of a pipeline file.

use std::net::SocketAddr;

/// Address at which the launcher serves the metrics of a run, and the token for access.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Metrics {
    /// Address to listen on.
    pub listen: SocketAddr,
    /// Token that a client needs to read them; `None`: no token.
    pub token: Option<String>,
}

impl Metrics {
    /// Whether anybody on the network may read them.
    pub fn is_open_to_others(&self) -> bool {
        self.token.is_none() && !self.listen.ip().is_loopback()
    }
}
