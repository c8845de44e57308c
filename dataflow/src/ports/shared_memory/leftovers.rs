//! Leftovers of dead processes in shared memory.
//!
//! As long as the runs' folder exists, leftovers are found through it. If it was deleted, only the files in `/dev/shm` remain,
//! and their names do not lead to the folder. At least one process of a live run always has each of its files open, so a file
//! that no process has open is dead. `/proc` does not show the processes of other containers, but the kernel knows them: it
//! grants a write lease only on a file that no process anywhere has open or mapped.

use super::cleanup::{COUNTER, PREFIX, is_littered, is_unused, open, remove_unused};
use super::services::{Ipc, SharedMemory, configuration};
use crate::ports::PortError;
use crate::ports::capacity::SHARED_MEMORY;
use iceoryx2::prelude::{CallbackProgression, LogLevel, Node, NodeState, set_log_level};
use std::fs;
use std::io;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

/// Minimum age of a leftover: a younger file may be under construction, or its owners may be about to be cleaned up.
const MIN_AGE: Duration = Duration::from_secs(60);
/// Number of digits in a file's name that identify its folder.
const DIGITS: usize = 8;

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
    /// Removes the file unless a process has opened it meanwhile. Returns whether it was removed.
    pub(crate) fn remove(&self) -> bool {
        remove_unused(&self.path).unwrap_or(false)
    }
}

/// Files of this program and this user in shared memory, at least a minute old, that no process has open or mapped.
pub(crate) fn leftovers() -> io::Result<Vec<Leftover>> {
    let paths = fs::read_dir(SHARED_MEMORY)?.flatten().map(|entry| entry.path());
    let (mut dead, mut in_use) = (Vec::new(), Vec::new());
    for path in paths.filter(|path| name_of(path).starts_with(PREFIX)) {
        match leftover(&path) {
            Some(leftover) => dead.push(leftover),
            None => in_use.push(path),
        }
    }
    // A counter is removed with the last file of its folder.
    let in_use: Vec<_> = in_use.iter().map(|path| family(name_of(path))).collect();
    let goes = |name: &str| !name.ends_with(COUNTER) || !in_use.contains(&family(name));
    dead.retain(|leftover| goes(name_of(&leftover.path)));
    Ok(dead)
}

fn name_of(path: &Path) -> &str {
    path.file_name().and_then(|name| name.to_str()).unwrap_or_default()
}

/// Common part of the names of all files of one folder. Names of earlier versions have none, and count as one family.
fn family(name: &str) -> Option<&str> {
    let (family, _) = name.strip_prefix(PREFIX)?.split_once('_')?;
    Some(family).filter(|family| family.len() == DIGITS)
}

fn leftover(path: &Path) -> Option<Leftover> {
    let file = open(path).ok()?;
    let about = file.metadata().ok()?;
    let age = SystemTime::now().duration_since(about.modified().ok()?).ok()?;
    // The kernel grants a lease only on a regular file, so folders, links and pipes are excluded.
    let own = about.uid() == rustix::process::geteuid().as_raw();
    let dead = own && age >= MIN_AGE && is_unused(&file);
    dead.then(|| Leftover { path: path.to_owned(), bytes: about.blocks() * 512, age })
}

/// Leftovers of dead processes in a folder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Litter {
    /// Nothing.
    None,
    /// Number of processes that joined its shared memory and died.
    Processes(usize),
    /// Unregistered files that no process uses.
    Files,
}

/// Finds leftovers of dead processes in a folder and its shared memory.
pub(crate) fn litter(root: &Path) -> Litter {
    set_log_level(LogLevel::Fatal);
    let mut dead = 0;
    // If listing fails, the check of the folder below still finds leftovers.
    configuration(root).ok().and_then(|config| {
        let count = |node: NodeState<Ipc>| {
            dead += usize::from(matches!(node, NodeState::Dead(_)));
            CallbackProgression::Continue
        };
        Node::<Ipc>::list(&config, count).ok()
    });
    match dead {
        0 if is_littered(root) => Litter::Files,
        0 => Litter::None,
        dead => Litter::Processes(dead),
    }
}

/// Removes leftovers of dead processes from a folder and its shared memory, and returns what they were.
///
/// # Errors
/// The folder cannot be used for shared memory.
pub(crate) fn clear(root: &Path) -> Result<Litter, PortError> {
    let litter = litter(root);
    if litter != Litter::None {
        SharedMemory::clean(root)?;
    }
    Ok(litter)
}

/// Checks that the path of a folder suits sockets and shared memory; the folder need not exist.
///
/// # Errors
/// The path is too long or, if the folder exists, has unusable characters.
pub(crate) fn check_path(root: &Path) -> Result<(), PortError> {
    match configuration(root) {
        Err(error @ (PortError::PathTooLong { .. } | PortError::PathUnusable { .. })) => Err(error),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::until;
    use crate::ports::Delivery;
    use crate::ports::shared_memory::tests::ReadingProcess;
    use crate::stop::Stop;
    use std::fs::File;

    #[test]
    fn a_file_that_somebody_has_open_is_not_left_over() {
        let folder = tempfile::tempdir_in(SHARED_MEMORY).unwrap();
        let path = folder.path().join("segment");
        let holder = File::create_new(&path).unwrap();
        assert!(!is_unused(&open(&path).unwrap()), "open elsewhere");
        drop(holder);
        let leftover = Leftover { path: path.clone(), bytes: 0, age: MIN_AGE };
        let holder = File::open(&path).unwrap();
        assert!(!leftover.remove() && path.exists(), "somebody reads it");
        drop(holder);
        // Processes that other tests fork hold copies of open files until they exec.
        assert!(until(|| leftover.remove()) && !path.exists());
        assert!(!leftover.remove(), "it is gone");
    }

    #[test]
    fn old_files_that_nobody_has_open_are_left_over_and_a_counter_goes_with_the_last_file_of_its_folder() {
        let [dead, live] = [0, 1].map(|bit| format!("{PREFIX}{:08x}_", 2 * std::process::id() + bit));
        let [of_dead, of_live] = [&dead, &live].map(|folder| format!("{folder}{COUNTER}"));
        let names = [of_dead, of_live, format!("{dead}old"), format!("{live}open"), format!("{live}young")];
        let paths = names.map(|name| Path::new(SHARED_MEMORY).join(name));
        paths.iter().for_each(|path| drop(File::create_new(path).unwrap()));
        fs::write(&paths[2], [1; 5000]).unwrap();
        let long_ago = SystemTime::now() - 2 * MIN_AGE;
        paths[..4].iter().for_each(|path| File::open(path).unwrap().set_modified(long_ago).unwrap());
        let holder = File::open(&paths[3]).unwrap();
        let mut left = Vec::new();
        let as_expected = until(|| {
            left = leftovers().unwrap();
            paths.each_ref().map(|path| left.iter().any(|leftover| leftover.path == *path))
                == [true, false, true, false, false]
        });
        drop(holder);
        paths.iter().for_each(|path| fs::remove_file(path).unwrap());
        assert!(as_expected, "{left:?}");
        let bytes = left.iter().find(|leftover| leftover.path == paths[2]).map(|leftover| leftover.bytes);
        assert!(bytes.is_some_and(|bytes| bytes >= 5000), "{bytes:?} of memory");
    }

    #[test]
    fn a_folder_that_nobody_has_used_or_all_have_left_in_order_has_no_litter() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(litter(folder.path()), Litter::None);
        drop(SharedMemory::open(folder.path(), "test", "stage", Stop::default()).unwrap());
        assert_eq!(clear(folder.path()).unwrap(), Litter::None);
        fs::write(folder.path().join("left"), "half").unwrap();
        assert_eq!(clear(folder.path()).unwrap(), Litter::Files);
        assert!(!folder.path().join("left").exists());
    }

    #[test]
    fn a_process_that_was_killed_is_litter_until_that_is_cleared_away() {
        let folder = tempfile::tempdir().unwrap();
        let process = ReadingProcess::start(folder.path(), Delivery::Lossless);
        assert_eq!(litter(folder.path()), Litter::None, "it lives");
        process.kill();
        assert_eq!(litter(folder.path()), Litter::Processes(1));
        assert_eq!(clear(folder.path()).unwrap(), Litter::Processes(1));
        assert_eq!(litter(folder.path()), Litter::None);
    }

    #[test]
    fn sockets_can_lie_in_a_folder_whose_path_is_short_enough() {
        let path = |length: usize| PathBuf::from(format!("/tmp/{}", "a".repeat(length - "/tmp/".len())));
        assert!(check_path(&path(48)).is_ok());
        let error = check_path(&path(49)).unwrap_err();
        assert!(matches!(error, PortError::PathTooLong { length: 49, limit: 48, .. }), "{error}");
    }

    #[test]
    fn the_files_of_a_folder_are_a_family() {
        assert_eq!(family("conicflow_0123abcd_0354a209029e7d094a819e2d4030ea331e6caaf0_1__0.data"), Some("0123abcd"));
        assert_eq!(
            family("conicflow_0123abcd_9204dd183d1c4d8e1ff592a30766ffa6765aa8b5_node.global_mgmt"),
            Some("0123abcd")
        );
        assert_eq!(family("conicflow_9204dd183d1c4d8e1ff592a30766ffa6765aa8b5_node.global_mgmt"), None);
        assert_eq!(family("iox2_0123abcd_1__0.data"), None);
    }
}
