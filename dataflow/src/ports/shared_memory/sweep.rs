//! Removes all that is left in shared memory when nobody uses it.
//!
//! iceoryx2 removes what a dead process has left as far as that had come to announce it. A process that is killed while it
//! joins or leaves may leave files that nothing leads to; they go when the last one that uses the folder is gone. Whoever
//! uses it holds a lock, which the kernel releases however a process ends; and what a folder's users have in shared memory
//! bears a prefix of its own, so that other users, folders and containers are never touched.

use crate::needs::SHARED_MEMORY;
use std::fs::{self, File, Permissions, TryLockError};
use std::io::{self, ErrorKind};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::Path;

const LOCK: &str = "lock";

/// What the names of all files in shared memory begin with that this program makes.
pub(super) const PREFIX: &str = "conicflow_";

/// The counter of a folder's processes is the one file that none of them keeps open.
pub(super) const COUNTER: &str = ".global_mgmt";

/// What the names of all files begin with that users of the folder make.
///
/// # Errors
/// There is no such folder.
pub(super) fn prefix(root: &Path) -> io::Result<String> {
    let folder = fs::metadata(root)?;
    // FNV-1a: the same in every build, unlike the hashes of the standard library.
    let bytes = [folder.dev(), folder.ino(), folder.uid().into()].map(u64::to_le_bytes);
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

/// Closes to others the one file in shared memory that iceoryx2 leaves open to everybody, a counter of 16 bytes.
pub(super) fn close_to_others(root: &Path) -> io::Result<()> {
    let prefix = prefix(root)?;
    let is_counter = |name: &str| name.starts_with(&prefix) && name.ends_with(COUNTER);
    for_each_entry(Path::new(SHARED_MEMORY), is_counter, |path, _| {
        fs::set_permissions(path, Permissions::from_mode(0o600))
    })
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
    let remove = |path: &Path, is_folder| if is_folder { fs::remove_dir_all(path) } else { fs::remove_file(path) };
    for_each_entry(folder, which, remove)
}

/// Does something with the entries of these names, unless they are gone meanwhile.
fn for_each_entry(
    folder: &Path,
    which: impl Fn(&str) -> bool,
    act: impl Fn(&Path, bool) -> io::Result<()>,
) -> io::Result<()> {
    for entry in fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_name().to_str().is_some_and(&which) {
            let done = act(&entry.path(), entry.file_type()?.is_dir());
            done.or_else(|error| if error.kind() == ErrorKind::NotFound { Ok(()) } else { Err(error) })?;
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
