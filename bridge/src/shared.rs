//! What all threads of a bridge use: the sessions, the shared memory, the state of the links, and the stop.

use crate::peer::links::Links;
use crate::session::Sessions;
use conicflow_dataflow::Stop;
use conicflow_dataflow::relay::{Peers, SharedMemory};
use std::path::Path;
use std::sync::Arc;
use std::time::Duration;

/// The state that the threads of a bridge share.
pub(super) struct Shared<'a> {
    pub sessions: &'a Sessions,
    pub transport: &'a SharedMemory,
    pub links: &'a Arc<Links>,
    pub pipeline: &'a str,
    pub machine: &'a str,
    /// Number of this start of the bridge.
    pub session: u64,
    /// The folder for the log of unacknowledged messages, if another process may replace this one.
    pub log_folder: Option<&'a Path>,
    /// How long a lossless edge waits for a machine that has gone.
    pub outage: Duration,
    pub peers: &'a Peers,
    pub stop: &'a Stop,
}

impl Shared<'_> {
    /// The Zenoh key of a topic that machine `from` writes.
    pub(super) fn key(&self, from: &str, topic: &str) -> String {
        format!("conicflow/{}/{from}/{topic}", self.pipeline)
    }
}
