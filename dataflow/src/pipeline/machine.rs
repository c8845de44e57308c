//! What a pipeline file says of its machines and of the edges between them.

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
    /// A file with a Zenoh configuration of one's own, which adds to this one and overrides it.
    pub zenoh: Option<PathBuf>,
    /// The secret that all machines of the pipeline share ([`LinkKey`](crate::LinkKey)).
    pub key: Option<PathBuf>,
    /// Endpoints that others can reach may be open to everyone, and whatever comes there is believed.
    pub insecure: bool,
    /// Lossless edges from here wait so long for a machine that has gone; `None`: the default, in seconds.
    pub outage_s: Option<f64>,
    /// Where its launcher offers the metrics of the run, in place of what the file says for all; no stage needs to know.
    #[serde(skip)]
    pub metrics: Option<Metrics>,
}

/// How depth images and long lists, such as ellipses, are compressed on their way to another machine, always without loss; short
/// lists would not gain by it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Compression {
    /// Not at all: a link that is faster than the processor.
    None,
    /// LZ4: a half to a quarter of an image's bytes at the least cost.
    Lz4,
    /// Zstandard, level 1: a third to a sixth of an image's bytes, half of a list's.
    #[default]
    Zstd,
}

/// Whether something can be an endpoint: one that cannot be opened would be tried for ever.
///
/// # Errors
/// It cannot.
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

/// Whether the host of an endpoint has an address, by its name or as it stands there. That may take seconds.
///
/// # Errors
/// It has none.
pub fn check_host(endpoint: &str) -> Result<(), Hinted> {
    let found = split_endpoint(endpoint).map(|(_, address)| address.to_socket_addrs());
    let Some(Err(error)) = found else { return Ok(()) };
    let hint = "is its name right? its address will do as well, such as tcp/192.168.0.2:7447";
    Err(Hinted::new(format!("the host of `{endpoint}` is not known here: {error}"), hint))
}

/// The protocol of an endpoint, and its host with the port.
pub fn split_endpoint(endpoint: &str) -> Option<(&str, &str)> {
    endpoint.split(['#', '?']).next()?.split_once('/')
}
