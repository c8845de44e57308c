//! What dead processes have left in shared memory.
//!
//! Where the run's folder is still there, iceoryx2 finds the nodes that died by it and removes what was theirs. Of a run
//! whose folder was deleted only the files in `/dev/shm` are left, and their names tell the process that made them but not
//! the folder. No file of a live run is ever closed by all of its processes, so one that nobody has open is dead. `/proc`
//! cannot tell that of processes in other containers, but the kernel can: it grants a lease for writing only where no
//! one, wherever it runs, has the file open or mapped.

use super::{Ipc, PREFIX, configuration};
use crate::needs::SHARED_MEMORY;
use crate::ports::PortError;
use iceoryx2::prelude::{CallbackProgression, LogLevel, Node, NodeState, set_log_level};
use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::fd::AsRawFd;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// A younger file may be one that is just being made, or whose owners are about to be looked after.
const MIN_AGE: Duration = Duration::from_secs(60);
/// From Linux's `fcntl.h`; the `libc` crate does not have it.
const F_SETSIG: libc::c_int = 10;
/// The counter of nodes, shared by all runs of all users, stays when nobody runs.
const SHARED_BY_ALL: &str = ".global_mgmt";

/// A file in shared memory that no process has open.
#[derive(Debug)]
pub(crate) struct Leftover {
    path: PathBuf,
    /// Bytes of memory that it takes.
    pub(crate) bytes: u64,
    /// Time since it was last written.
    pub(crate) age: Duration,
}

impl Leftover {
    /// Removes the file, unless a process has opened it meanwhile; whether it was removed.
    pub(crate) fn remove(&self) -> bool {
        // The file is held, and with it the lease, until its name is gone.
        open(&self.path).is_ok_and(|file| is_unused(&file) && fs::remove_file(&self.path).is_ok())
    }
}

/// Files of this program and this user in shared memory, at least a minute old, that no process has open or mapped.
pub(crate) fn leftovers() -> io::Result<Vec<Leftover>> {
    let paths = fs::read_dir(SHARED_MEMORY)?.flatten().map(|entry| entry.path());
    Ok(paths.filter(|path| is_ours(path)).filter_map(leftover).collect())
}

fn is_ours(path: &Path) -> bool {
    let name = path.file_name().and_then(|name| name.to_str());
    name.is_some_and(|name| name.starts_with(PREFIX) && !name.ends_with(SHARED_BY_ALL))
}

fn leftover(path: PathBuf) -> Option<Leftover> {
    let file = open(&path).ok()?;
    let about = file.metadata().ok()?;
    let age = SystemTime::now().duration_since(about.modified().ok()?).ok()?;
    let own = about.is_file() && about.uid() == rustix::process::geteuid().as_raw();
    let dead = own && age >= MIN_AGE && is_unused(&file);
    dead.then(|| Leftover { path, bytes: about.blocks() * 512, age })
}

fn open(path: &Path) -> io::Result<File> {
    OpenOptions::new().read(true).write(true).custom_flags(libc::O_NOFOLLOW | libc::O_NONBLOCK).open(path)
}

/// Whether nobody else has the file open or mapped, in whatever container; it stays so until the file is closed here,
/// because whoever opens it meanwhile waits for that. Where the kernel cannot tell, somebody has.
fn is_unused(file: &File) -> bool {
    let descriptor = file.as_raw_fd();
    // SAFETY: the calls take an open descriptor and numbers, and touch no memory. The signal that tells of somebody who
    // waits is one that is ignored unless asked for.
    unsafe {
        libc::fcntl(descriptor, F_SETSIG, libc::SIGURG) == 0
            && libc::fcntl(descriptor, libc::F_SETLEASE, libc::F_WRLCK) == 0
    }
}

/// How many processes have joined the shared memory of a folder and died there.
///
/// # Errors
/// The folder's path is too long.
pub(crate) fn dead_nodes(root: &Path) -> Result<usize, PortError> {
    let mut dead = 0;
    each_dead_node(root, |_| dead += 1)?;
    Ok(dead)
}

/// Removes what the dead processes of a folder have left; tells how many of them that were.
///
/// # Errors
/// The folder's path is too long.
pub(crate) fn remove_dead_nodes(root: &Path) -> Result<usize, PortError> {
    let mut removed = 0;
    each_dead_node(root, |dead| removed += usize::from(dead.try_remove_stale_resources().is_ok()))?;
    Ok(removed)
}

fn each_dead_node(root: &Path, mut see: impl FnMut(iceoryx2::node::DeadNodeView<Ipc>)) -> Result<(), PortError> {
    set_log_level(LogLevel::Fatal);
    let listed = Node::<Ipc>::list(&configuration(root)?, |node| {
        if let NodeState::Dead(dead) = node {
            see(dead);
        }
        CallbackProgression::Continue
    });
    // What cannot be listed is told by what cannot be opened: the folder is looked at, too.
    listed.or(Ok(()))
}

/// Whether sockets can lie in a folder of this path.
///
/// # Errors
/// It is too long.
pub(crate) fn check_path(root: &Path) -> Result<(), PortError> {
    configuration(root).map(drop)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_file_that_somebody_has_open_is_not_left_over() {
        let folder = tempfile::tempdir_in(SHARED_MEMORY).unwrap();
        let path = folder.path().join("segment");
        let holder = File::create_new(&path).unwrap();
        assert!(!is_unused(&open(&path).unwrap()), "open elsewhere");
        drop(holder);
        assert!(is_unused(&open(&path).unwrap()));
        let leftover = Leftover { path: path.clone(), bytes: 0, age: MIN_AGE };
        let holder = File::open(&path).unwrap();
        assert!(!leftover.remove() && path.exists(), "somebody reads it");
        drop(holder);
        assert!(leftover.remove() && !path.exists());
        assert!(!leftover.remove(), "it is gone");
    }

    #[test]
    fn only_files_of_this_program_are_its_leftovers() {
        for (name, ours) in [
            ("conicflow_0354a209_1__0.data", true),
            ("conicflow_9204dd18_node.0_10_0.global_mgmt", false),
            ("iox2_0354a209_1__0.data", false),
            ("3842671441.zenoh", false),
        ] {
            assert_eq!(is_ours(&Path::new(SHARED_MEMORY).join(name)), ours, "{name}");
        }
    }
}
