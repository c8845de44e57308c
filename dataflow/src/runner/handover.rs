//! Handover of a stage to its successor, without losing a message or processing one twice.
//!
//! The successor opens its inputs while its predecessor works, and waits until it has received a message of each writer. It then
//! writes the numbers from which on it receives every message (`STAGE.first` in the run's folder). The predecessor processes all
//! messages before those, stops there without sending an end of stream, and writes how far it came (`STAGE.last`). The successor
//! begins when its launcher reports that the predecessor is gone. They communicate through a socket on the successor's standard
//! input: one byte in each direction; if either closes it, the other stops waiting.

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
/// Maximum wait of a successor for the first message of a writer whose topic it does not read losslessly.
const FIRST_MESSAGE_TIMEOUT: Duration = Duration::from_secs(1);
/// Period at which a waiting process checks whether it still has to wait.
const WAIT_CHECK_PERIOD: Duration = Duration::from_millis(20);

/// Position in the streams that a stage reads.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize)]
pub(crate) struct Watermark {
    /// By writer: number of a message.
    pub(crate) numbers: BTreeMap<Text<32>, u64>,
    /// By source: epoch and sequence number of the last frame.
    pub(crate) frames: BTreeMap<Text<32>, (u64, u64)>,
    /// Writers that have ended.
    pub(crate) ended: BTreeSet<String>,
}

/// Files through which the two processes of a stage exchange their positions.
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

    /// Removes the files of an earlier swap.
    pub(crate) fn clear(&self) {
        for path in [&self.first, &self.last] {
            // The files exist only if the stage was swapped before.
            fs::remove_file(path).ok();
        }
    }

    /// Position from which on the successor receives every message; by default the beginning.
    pub(crate) fn first(&self) -> Watermark {
        read(&self.first).unwrap_or_default()
    }

    /// Position that the predecessor reached; `None` if it died before it could write it.
    pub(crate) fn last(&self) -> Option<Watermark> {
        read(&self.last)
    }

    /// Writes the position that this stage reached.
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
    pub(super) patience: Duration,
}

impl Successor {
    /// The successor's side, if this process was started as a successor.
    pub(crate) fn from_environment(handover: &Handover) -> io::Result<Option<Self>> {
        if std::env::var_os(SUCCESSOR).is_none() {
            return Ok(None);
        }
        let launcher = UnixStream::from(io::stdin().as_fd().try_clone_to_owned()?);
        launcher.set_read_timeout(Some(WAIT_CHECK_PERIOD))?;
        Ok(Some(Self { handover: handover.clone(), launcher, patience: FIRST_MESSAGE_TIMEOUT }))
    }

    /// Reports that this process is ready, and receives every message from `first` on. A broken pipe is no error: the launcher no
    /// longer wants it, and [`Self::await_turn`] then returns `false`.
    pub(crate) fn report_ready(&mut self, first: &Watermark) -> io::Result<()> {
        write(&self.handover.first, first)?;
        match self.launcher.write_all(b"r") {
            Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(()),
            result => result,
        }
    }

    /// Waits for its turn. Returns `false` if it is `stopped`, or the launcher no longer wants it.
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

    /// Whether the launcher no longer wants it.
    pub(crate) fn wait_for_dismissal(&mut self) -> bool {
        !matches!(self.launcher.read(&mut [0]), Err(error) if is_timeout(&error))
    }
}

fn is_timeout(error: &io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted)
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use std::cell::Cell;

    /// A successor that waits without limit for the first message of each writer, and the launcher's end of its socket.
    pub(in super::super) fn successor(folder: &Path, stage: &str) -> (Successor, UnixStream) {
        let (launcher, end) = UnixStream::pair().unwrap();
        end.set_read_timeout(Some(WAIT_CHECK_PERIOD)).unwrap();
        let (handover, patience) = (Handover::of(folder, stage), Duration::from_secs(3600));
        (Successor { handover, launcher: end, patience }, launcher)
    }

    fn mark(number: u64) -> Watermark {
        Watermark { numbers: [(Text::new("camera"), number)].into(), ..Watermark::default() }
    }

    #[test]
    fn a_successor_that_is_wanted_no_more_ends_without_a_word() {
        let folder = tempfile::tempdir().unwrap();
        let (mut successor, launcher) = successor(folder.path(), "a");
        drop(launcher);
        successor.report_ready(&Watermark::default()).unwrap();
        assert!(successor.wait_for_dismissal());
        assert!(!successor.await_turn(|| false));
    }

    #[test]
    fn what_the_two_processes_of_a_stage_tell_each_other_is_of_this_swap_and_of_this_stage() {
        let folder = tempfile::tempdir().unwrap();
        let (mut successor, mut launcher) = successor(folder.path(), "a");
        let [of_stage, of_other] = ["a", "b"].map(|stage| Handover::of(folder.path(), stage));
        assert_eq!((of_stage.first(), of_stage.last()), (Watermark::default(), None), "nothing is told");
        successor.report_ready(&mark(4)).unwrap();
        let mut told = [0; 2];
        assert_eq!(launcher.read(&mut told).unwrap(), 1, "the launcher hears of it");
        of_stage.leave(&mark(3)).unwrap();
        assert_eq!((of_stage.first(), of_stage.last()), (mark(4), Some(mark(3))));
        assert_eq!((of_other.first(), of_other.last()), (Watermark::default(), None));
        of_stage.clear();
        assert_eq!((of_stage.first(), of_stage.last()), (Watermark::default(), None));
    }

    #[test]
    fn a_successor_waits_until_its_turn_has_come_or_it_is_stopped() {
        let folder = tempfile::tempdir().unwrap();
        let (mut successor, launcher) = successor(folder.path(), "a");
        assert!(!successor.wait_for_dismissal());
        let looks = Cell::new(0);
        let look = |last: u32| looks.replace(looks.get() + 1) == last;
        assert!(!successor.await_turn(|| look(3)), "it is stopped");
        looks.set(0);
        // The successor's turn comes after several checks.
        let turn = successor.await_turn(|| {
            if look(3) {
                (&launcher).write_all(b"t").unwrap();
            }
            looks.get() > 100
        });
        assert!(turn);
    }

    #[test]
    fn a_successor_whose_launcher_cannot_be_told_says_so() {
        let folder = tempfile::tempdir().unwrap();
        let (mut successor, _launcher) = successor(folder.path(), "a");
        successor.launcher.set_nonblocking(true).unwrap();
        while successor.launcher.write(&[0; 4096]).is_ok() {}
        assert_eq!(successor.report_ready(&mark(0)).unwrap_err().kind(), ErrorKind::WouldBlock, "it does not listen");
        let (mut successor, _launcher) = self::successor(&folder.path().join("nowhere"), "a");
        assert_eq!(successor.report_ready(&mark(0)).unwrap_err().kind(), ErrorKind::NotFound);
    }

    #[test]
    fn a_successor_whose_launcher_cannot_be_heard_has_no_turn() {
        let folder = tempfile::tempdir().unwrap();
        let (mut successor, _launcher) = successor(folder.path(), "a");
        // The write end of a pipe cannot be read.
        let (unread, _other) = io::pipe().map(|(reader, writer)| (writer, reader)).unwrap();
        successor.launcher = UnixStream::from(std::os::fd::OwnedFd::from(unread));
        let looks = Cell::new(0);
        assert!(!successor.await_turn(|| looks.replace(looks.get() + 1) == 100));
        assert_eq!(looks.get(), 1, "there is nothing to wait for");
        assert!(successor.wait_for_dismissal());
    }
}
