//! Removes all that is left in shared memory when nobody uses it.
//!
//! iceoryx2 removes what a dead process has left as far as that had come to announce it. A process that is killed while it
//! joins or leaves may leave files that nothing leads to; they go when the last one that uses the folder is gone. Whoever
//! uses it holds a lock, which the kernel releases however a process ends; and what a folder's users have in shared memory
//! bears a prefix of its own, so that other users, folders and containers are never touched.

use crate::needs::SHARED_MEMORY;
use std::fs::{self, File, TryLockError};
use std::io::{self, ErrorKind};
use std::os::unix::fs::MetadataExt;
use std::path::Path;

const LOCK: &str = "lock";

/// What the names of all files in shared memory begin with that this program makes.
pub(super) const PREFIX: &str = "conicflow_";

/// What the names of all files begin with that users of the folder make.
///
/// # Errors
/// There is no such folder.
pub(super) fn prefix(root: &Path) -> io::Result<String> {
    let folder = fs::metadata(root)?;
    // FNV-1a: the same in every build, unlike the hashes of the standard library.
    let bytes = [folder.dev().to_le_bytes(), folder.ino().to_le_bytes()];
    let hash = bytes
        .as_flattened()
        .iter()
        .fold(0x811c_9dc5_u32, |hash, byte| (hash ^ u32::from(*byte)).wrapping_mul(0x0100_0193));
    Ok(format!("{PREFIX}{hash:08x}_"))
}

/// Says that this process uses the folder, for as long as the file is held.
pub(super) fn occupy(root: &Path) -> io::Result<File> {
    let file = File::create(root.join(LOCK))?;
    file.lock_shared()?;
    Ok(file)
}

/// Removes all that users of the folder have left in it and in shared memory, if nobody uses it.
pub(super) fn sweep(root: &Path) -> io::Result<()> {
    let file = File::create(root.join(LOCK))?;
    match file.try_lock() {
        Err(TryLockError::WouldBlock) => return Ok(()),
        Err(TryLockError::Error(error)) => return Err(error),
        Ok(()) => {}
    }
    let prefix = prefix(root)?;
    remove_all(root, |name| name != LOCK)?;
    remove_all(Path::new(SHARED_MEMORY), |name| name.starts_with(&prefix))
}

/// Whether something is left in the folder, and nobody uses it.
pub(super) fn is_littered(root: &Path) -> bool {
    let unused = File::open(root.join(LOCK)).is_ok_and(|file| file.try_lock().is_ok());
    let entries = || fs::read_dir(root).into_iter().flatten().flatten();
    unused && entries().any(|entry| entry.file_name() != LOCK)
}

fn remove_all(folder: &Path, which: impl Fn(&str) -> bool) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_name().to_str().is_some_and(&which) {
            let removed = if entry.file_type()?.is_dir() {
                fs::remove_dir_all(entry.path())
            } else {
                fs::remove_file(entry.path())
            };
            removed.or_else(|error| if error.kind() == ErrorKind::NotFound { Ok(()) } else { Err(error) })?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_nothing_leads_to_goes_with_the_last_one_who_uses_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let details = folder.path().join("nodes/42/conicflow_node.details");
        fs::create_dir_all(details.parent().unwrap()).unwrap();
        fs::write(&details, "half a node").unwrap();
        let segment = Path::new(SHARED_MEMORY).join(format!("{}half_a_segment", prefix(folder.path()).unwrap()));
        fs::write(&segment, "nothing").unwrap();
        let occupied = occupy(folder.path()).unwrap();
        sweep(folder.path()).unwrap();
        assert!(details.exists() && segment.exists(), "somebody uses the folder");
        drop(occupied);
        sweep(folder.path()).unwrap();
        assert!(!folder.path().join("nodes").exists() && !segment.exists());
    }
}
