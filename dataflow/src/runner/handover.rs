//! How a stage that is replaced hands over to its successor, so that no message is lost and none is worked on twice.
//!
//! The successor opens its inputs while its predecessor works, waits until it has received a message of each writer, and says
//! from which messages on it receives everything (`STAGE.first` in the run's folder). The predecessor goes on until it has worked
//! on all before those, and leaves at that message, without an end of stream, saying how far it came (`STAGE.last`). The
//! successor begins when its launcher says that the predecessor is gone. It speaks with the launcher through a socket on
//! its standard input: a byte each way, and the end of one of the two ends the other's waiting.

use conicflow_messages::Text;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::io::{self, ErrorKind, Read, Write};
use std::os::fd::AsFd;
use std::os::unix::net::UnixStream;
use std::path::{Path, PathBuf};
use std::time::Duration;

/// Environment variable: this process is to replace another of the same stage.
pub(crate) const SUCCESSOR: &str = "CONICFLOW_SUCCESSOR";
/// How often one who waits looks whether it is still to wait.
const LOOK: Duration = Duration::from_millis(20);

/// A place in the streams that a stage reads.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub(crate) struct Watermark {
    /// By writer: the number of a message.
    pub(crate) numbers: BTreeMap<Text<32>, u64>,
    /// By source: epoch and sequence number of the last frame.
    pub(crate) frames: BTreeMap<Text<32>, (u64, u64)>,
    /// Writers that have ended.
    pub(crate) ended: BTreeSet<String>,
}

/// The files by which the two processes of a stage tell each other their places.
#[derive(Clone, Debug)]
pub(crate) struct Handover {
    first: PathBuf,
    last: PathBuf,
}

impl Handover {
    pub(crate) fn of(folder: &Path, stage: &str) -> Self {
        let path = |part: &str| folder.join(format!("{stage}.{part}"));
        Self { first: path("first"), last: path("last") }
    }

    /// Forgets what was said in an earlier swap.
    pub(crate) fn clear(&self) {
        for path in [&self.first, &self.last] {
            // It is there only if the stage was swapped before.
            fs::remove_file(path).ok();
        }
    }

    /// From which messages on the successor receives everything; all, if it did not say.
    pub(crate) fn first(&self) -> Watermark {
        read(&self.first).unwrap_or_default()
    }

    /// How far the predecessor came; `None` if it died before it could tell.
    pub(crate) fn last(&self) -> Option<Watermark> {
        read(&self.last)
    }

    /// Says how far this stage came.
    pub(crate) fn leave(&self, mark: &Watermark) -> io::Result<()> {
        write(&self.last, mark)
    }
}

fn read(path: &Path) -> Option<Watermark> {
    serde_json::from_slice(&fs::read(path).ok()?).ok()
}

fn write(path: &Path, mark: &Watermark) -> io::Result<()> {
    fs::write(path, serde_json::to_vec(mark)?)
}

/// The successor's side of a swap.
#[derive(Debug)]
pub(crate) struct Successor {
    pub(crate) handover: Handover,
    launcher: UnixStream,
}

impl Successor {
    /// The part that this process was started for, if it is that of a successor.
    pub(crate) fn from_environment(handover: &Handover) -> io::Result<Option<Self>> {
        if std::env::var_os(SUCCESSOR).is_none() {
            return Ok(None);
        }
        let launcher = UnixStream::from(io::stdin().as_fd().try_clone_to_owned()?);
        launcher.set_read_timeout(Some(LOOK))?;
        Ok(Some(Self { handover: handover.clone(), launcher }))
    }

    /// Says that it is ready, and receives everything from `first` on. A launcher that wants it no more does not listen; who
    /// then waits for its turn learns that.
    pub(crate) fn is_ready(&mut self, first: &Watermark) -> io::Result<()> {
        write(&self.handover.first, first)?;
        match self.launcher.write_all(b"r") {
            Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
            told => told,
        }
    }

    /// Waits for its turn, unless it is `stopped` or the launcher wants it no more; whether the turn came.
    pub(crate) fn await_turn(&mut self, stopped: impl Fn() -> bool) -> bool {
        let mut turn = [0];
        while !stopped() {
            match self.launcher.read(&mut turn) {
                Ok(length) => return length > 0,
                Err(error) if is_timeout(&error) => {}
                Err(_) => return false,
            }
        }
        false
    }

    /// Whether the launcher wants it no more.
    pub(crate) fn is_dismissed(&mut self) -> bool {
        !matches!(self.launcher.read(&mut [0]), Err(error) if is_timeout(&error))
    }
}

fn is_timeout(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_successor_that_is_wanted_no_more_ends_without_a_word() {
        let folder = tempfile::tempdir().unwrap();
        let (launcher, end) = UnixStream::pair().unwrap();
        let mut successor = Successor { handover: Handover::of(folder.path(), "a"), launcher: end };
        drop(launcher);
        successor.is_ready(&Watermark::default()).unwrap();
        assert!(!successor.await_turn(|| false));
    }
}
