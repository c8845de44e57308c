//! Report of a running bridge on its links, in a file of the run's folder beside the records of the stages.

use serde::{Deserialize, Serialize};
use std::io;
use std::path::{Path, PathBuf};

/// The link to one other machine.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct LinkReport {
    /// Name of the other machine.
    pub machine: String,
    /// State of the link.
    pub state: LinkState,
    /// Duration of that state, in seconds; for a machine that was never heard, the time since the bridge started here.
    pub state_s: f64,
    /// Whether the machine was ever heard.
    pub was_heard: bool,
    /// Shortest recent round-trip time, in milliseconds.
    pub round_trip_ms: Option<f64>,
    /// Its monotonic clock minus this machine's, in seconds.
    pub clock_offset_s: Option<f64>,
    /// Topics that the link carries.
    pub edges: Vec<EdgeReport>,
}

/// State of a link to another machine.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LinkState {
    /// Messages of the machine come in.
    Up,
    /// The machine has become silent.
    Down,
    /// Messages in its name are refused, as with another key or another version.
    Refused,
    /// The machine was never heard, but another machine or a router is connected.
    Never,
    /// Nothing is connected: no machine, and no router.
    #[default]
    Unreachable,
}

impl std::fmt::Display for LinkState {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(match self {
            Self::Up => "up",
            Self::Down => "down",
            Self::Refused => "refused",
            Self::Never => "never",
            Self::Unreachable => "unreachable",
        })
    }
}

/// A topic that a link carries.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct EdgeReport {
    /// Its name.
    pub topic: String,
    /// `out` or `in`.
    pub direction: String,
    /// Number of messages sent, or received and passed on.
    pub messages: u64,
    /// Messages sent, or received and passed on, per second.
    pub rate_hz: f64,
    /// Bandwidth on the wire, in megabytes per second.
    pub bandwidth_mbps: f64,
    /// Total bytes on the wire.
    pub wire_bytes: u64,
    /// Total bytes of the same messages in shared memory.
    pub memory_bytes: u64,
    /// Number of messages that were lost on the way, or given up.
    pub lost: u64,
    /// Number of retransmissions.
    pub resent: u64,
    /// Number of messages that came too late to be of use.
    pub stale: u64,
    /// Number of malformed messages, which were skipped.
    pub malformed: u64,
    /// Number of malformed messages that had a place in the stream, and so are lost; the others were repeated, or came from
    /// another sender.
    pub refused: u64,
    /// Age of the last message at its arrival: time since its writer sent it, in milliseconds.
    pub age_ms: f64,
}

impl EdgeReport {
    /// Whether its messages come from the other machine.
    pub(crate) fn comes(&self) -> bool {
        self.direction == "in"
    }
}

/// Content of the file.
#[derive(Serialize, Deserialize)]
struct Report {
    run: u64,
    links: Vec<LinkReport>,
}

fn path(folder: &Path) -> PathBuf {
    folder.join("bridge.links")
}

/// Writes the report of a run atomically.
///
/// # Errors
/// The files cannot be written.
pub fn write_links(folder: &Path, run: u64, links: &[LinkReport]) -> io::Result<()> {
    let text = serde_json::to_vec(&Report { run, links: links.to_vec() })?;
    let new = folder.join("bridge.links.new");
    std::fs::write(&new, text)?;
    std::fs::rename(new, path(folder))
}

/// Reads the report of a run; empty if there is none.
pub fn read_links(folder: &Path, run: u64) -> Vec<LinkReport> {
    let text = std::fs::read(path(folder)).unwrap_or_default();
    let report = serde_json::from_slice::<Report>(&text).ok().filter(|report| report.run == run);
    report.map(|report| report.links).unwrap_or_default()
}
