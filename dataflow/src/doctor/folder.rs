//! Checks whether a run could have its folder (private, writable, and with a path that is short enough for sockets) and shared
//! memory.

use super::finding::Finding;
use crate::launcher::{FolderError, check_private, user_folder};
use crate::ports::capacity::SHARED_MEMORY;
use crate::ports::shared_memory::leftovers::check_path;
use conicflow_messages::Hinted;
use rustix::fs::{Access, access};
use std::io;
use std::path::{Path, PathBuf};

/// Reports problems with the run's folder and with shared memory.
pub(super) fn examine() -> Vec<Finding> {
    let user = user_folder();
    let parts = [user.clone(), user.join("run"), user.join("shm")];
    let faults = parts.into_iter().filter_map(|path| fault(path).map(Finding::from));
    let too_long = check_path(&user.join("shm")).err();
    let mut findings: Vec<_> = too_long.into_iter().map(Finding::from).chain(faults).collect();
    // A problem with the first folder causes those with the folders in it.
    findings.truncate(1);
    findings.extend(writable(Path::new(SHARED_MEMORY)).err().map(no_shared_memory));
    findings
}

fn no_shared_memory(error: io::Error) -> Finding {
    let hint = "as root: `mount -o remount,rw,mode=1777 /dev/shm`";
    Hinted::new(format!("this user can make nothing in `{SHARED_MEMORY}`: {error}"), hint).into()
}

fn fault(path: PathBuf) -> Option<FolderError> {
    match check_private(&path) {
        Ok(()) => writable(&path).err().map(|error| FolderError::Io { path, error }),
        Err(FolderError::Io { error, .. }) if error.kind() == io::ErrorKind::NotFound => {
            let there = path.ancestors().find(|ancestor| ancestor.exists())?;
            writable(there).err().map(|error| FolderError::Io { path: there.to_owned(), error })
        }
        Err(error) => Some(error),
    }
}

fn writable(folder: &Path) -> io::Result<()> {
    Ok(access(folder, Access::WRITE_OK | Access::EXEC_OK)?)
}
