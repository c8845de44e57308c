//! Settings of a pipeline file for its machines and the edges between them.

use super::metrics::Metrics;
use conicflow_messages::Hinted;
use serde::{Deserialize, Serialize};
use std::net::ToSocketAddrs;
use std::path::PathBuf;

/// Name of the bridge among the stages of a machine.
pub const BRIDGE: &str = "bridge";

/// A machine of a pipeline that spans several.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Machine {
    /// Zenoh endpoints that it listens on.
    pub listen: Vec<String>,
    /// Zenoh endpoints that it connects to.
    pub connect: Vec<String>,
    /// A file with a Zenoh configuration, which extends and overrides these settings.
    pub zenoh: Option<PathBuf>,
    /// File of the key that all machines of the pipeline share ([`LinkKey`](crate::LinkKey)).
    pub key: Option<PathBuf>,
    /// Whether endpoints that others can reach may be used without authentication.
    pub insecure: bool,
    /// Time for which lossless edges from here wait for a lost machine, in seconds; `None`: the default.
    pub outage_s: Option<f64>,
    /// Metrics endpoint of its launcher, in place of the file's common one; no stage needs it.
    #[serde(skip)]
    pub metrics: Option<Metrics>,
}

/// Lossless compression of depth images and long lists, such as ellipses, on their way to another machine. Short lists are never
/// compressed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Compression {
    /// None, for a link that is faster than the processor.
    None,
    /// LZ4: a half to a quarter of an image's bytes at the least cost.
    Lz4,
    /// Zstandard, level 1: a third to a sixth of an image's bytes, half of a list's.
    #[default]
    Zstd,
}

/// Checks whether a text is an endpoint: a connection to an invalid one would be retried for ever.
///
/// # Errors
/// It is not.
pub fn check_endpoint(endpoint: &str) -> Result<(), Hinted> {
    let parts = split_endpoint(endpoint).and_then(|(protocol, address)| Some((protocol, address.rsplit_once(':')?)));
    let is_known = |protocol| matches!(protocol, "tcp" | "udp" | "tls" | "quic");
    let is_host = |host: &str| !host.is_empty() && !host.contains('/');
    let in_brackets = |host: &str| host.starts_with('[') && host.ends_with(']');
    let hint = match parts {
        Some((protocol, (host, port))) if is_known(protocol) && is_host(host) && port.parse::<u16>().is_ok() => {
            if !host.contains(':') || in_brackets(host) {
                return Ok(());
            }
            "an address of IPv6 stands in brackets: tcp/[fe80::1]:7447"
        }
        _ => "an endpoint looks like tcp/192.168.0.2:7447; other protocols are udp, tls and quic",
    };
    Err(Hinted::new(format!("`{endpoint}` is no endpoint"), hint))
}

/// Checks whether the host of an endpoint has an address. Looking up a name may take seconds.
///
/// # Errors
/// It has none.
pub fn check_host(endpoint: &str) -> Result<(), Hinted> {
    let found = split_endpoint(endpoint).map(|(_, address)| address.to_socket_addrs());
    let Some(Err(error)) = found else { return Ok(()) };
    let hint = "is its name right? its address will do as well, such as tcp/192.168.0.2:7447";
    Err(Hinted::new(format!("the host of `{endpoint}` is not known here: {error}"), hint))
}

/// Splits an endpoint into its protocol and its host with port.
pub fn split_endpoint(endpoint: &str) -> Option<(&str, &str)> {
    endpoint.split(['#', '?']).next()?.split_once('/')
}
