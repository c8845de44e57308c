//! What a bridge tells of its links while it runs, in a file of the run's folder beside the records of the stages.

use serde::{Deserialize, Serialize};
use std::io;
use std::path::{Path, PathBuf};

/// The link to one other machine.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct LinkReport {
    /// The other machine.
    pub machine: String,
    /// Whether it is there.
    pub state: LinkState,
    /// For how long that is so, in seconds; of a machine that was never heard of, since this one's bridge started.
    pub state_s: f64,
    /// Whether it was ever heard of.
    pub was_heard: bool,
    /// Shortest time there and back, of late, in milliseconds.
    pub round_trip_ms: Option<f64>,
    /// Its monotonic clock less this machine's, in seconds.
    pub clock_offset_s: Option<f64>,
    /// What goes over it.
    pub edges: Vec<EdgeReport>,
}

/// What is known of another machine.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LinkState {
    /// It was heard of just now.
    Up,
    /// It has fallen silent.
    Down,
    /// Something comes in its name that is refused, as with another key or another version.
    Refused,
    /// It was never heard of, but somebody, another machine or a router, is there.
    Never,
    /// Nobody at all is there: none of the machines, nor a router.
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

/// A topic that goes over a link.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct EdgeReport {
    /// Its name.
    pub topic: String,
    /// `out` or `in`.
    pub direction: String,
    /// Messages sent, or received and passed on.
    pub messages: u64,
    /// The same per second.
    pub rate_hz: f64,
    /// Megabytes per second on the wire.
    pub bandwidth_mbps: f64,
    /// Bytes on the wire, in all.
    pub wire_bytes: u64,
    /// The same messages in shared memory.
    pub memory_bytes: u64,
    /// Messages that were lost on the way, or given up.
    pub lost: u64,
    /// Messages that were sent again.
    pub resent: u64,
    /// Messages that came too late to be of use.
    pub stale: u64,
    /// Messages that made no sense, and were left out.
    pub malformed: u64,
    /// Those of them that had a place in the stream, and so are lost; the others were put in by somebody else, or come again.
    pub refused: u64,
    /// Time from the writer's sending to the arrival of the last message, in milliseconds.
    pub age_ms: f64,
}

impl EdgeReport {
    /// Whether it comes from the other machine.
    pub(crate) fn comes(&self) -> bool {
        self.direction == "in"
    }
}

/// The file's content.
#[derive(Serialize, Deserialize)]
struct Report {
    run: u64,
    links: Vec<LinkReport>,
}

fn path(folder: &Path) -> PathBuf {
    folder.join("bridge.links")
}

/// Writes the report of a run, whole or not at all.
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
