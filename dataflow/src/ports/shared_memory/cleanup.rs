//! Removes leftovers from shared memory when no process uses it.
//!
//! iceoryx2 removes only what a dead process had registered. A process that is killed while it joins or leaves may leave
//! unregistered files, and iceoryx2 never removes its counter of processes. These files are removed by the last process that uses
//! the folder. Each user of the folder holds a lock, which the kernel releases however the process ends. The files of a folder's
//! users in shared memory share a unique prefix, so that other users, folders and containers are never touched. A file whose
//! maker died before it was complete would block every process that opens it: it is removed before a process joins, and while a
//! run lasts.

use crate::file_lock::{Locked, is_shared, lock_within};
use crate::ports::capacity::SHARED_MEMORY;
use crate::stop::Stop;
use rustix::fs::Mode;
use std::fs::{self, File, Metadata, OpenOptions, Permissions};
use std::io::{self, ErrorKind};
use std::os::fd::AsRawFd;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::{Duration, Instant};

/// Maximum time for which a killed process on a busy machine still holds its locks and files, and for which a process that checks
/// for leftovers holds the lock.
const LETTING_GO: Duration = Duration::from_secs(1);

const LOCK: &str = "lock";

/// `F_SETSIG` of Linux's `fcntl.h`, which the `libc` crate does not have.
const F_SETSIG: libc::c_int = 10;

/// Prefix of all files of this program in shared memory.
pub(super) const PREFIX: &str = "conicflow_";

/// File name suffix of the counter of a folder's processes, the only file that none of them keeps open.
pub(super) const COUNTER: &str = ".global_mgmt";

/// Prefix of all files of a folder's users in shared memory.
///
/// # Errors
/// There is no such folder.
pub(super) fn prefix(root: &Path) -> io::Result<String> {
    let folder = fs::metadata(root)?;
    let bytes = [folder.dev(), folder.ino(), folder.uid().into()].map(u64::to_le_bytes);
    Ok(format!("{PREFIX}{:08x}_", fnv_1a(bytes.as_flattened())))
}

/// The hash FNV-1a: the same in every build, unlike those of the standard library.
fn fnv_1a(bytes: &[u8]) -> u32 {
    bytes.iter().fold(0x811c_9dc5, |hash, byte| (hash ^ u32::from(*byte)).wrapping_mul(0x0100_0193))
}

/// Use of a folder by this process, for the lifetime of this value; the last user leaves nothing in the folder.
#[derive(Debug)]
pub(super) struct Occupied {
    root: PathBuf,
    prefix: String,
    lock: Locked,
    stop: Stop,
}

impl Occupied {
    /// Registers this process as a user of the folder. If `stop` is forced when it leaves, the other users may have been killed
    /// and cannot clean up: it then waits until they are gone.
    pub(super) fn new(root: &Path, stop: Stop) -> io::Result<Self> {
        let lock = Locked(File::create(root.join(LOCK))?);
        lock.0.lock_shared()?;
        Ok(Self { root: root.to_owned(), prefix: prefix(root)?, lock, stop })
    }

    /// The folder.
    pub(super) fn root(&self) -> &Path {
        &self.root
    }

    /// Prefix of all files of the folder's users in shared memory.
    pub(super) fn prefix(&self) -> &str {
        &self.prefix
    }

    /// Whether the folder and its shared memory still exist. Only the last user removes them, or somebody from outside.
    pub(super) fn is_there(&self) -> bool {
        self.root.join(LOCK).exists() && has_entry(Path::new(SHARED_MEMORY), is_counter(&self.prefix))
    }

    /// Removes incomplete files of dead makers from shared memory, and waits up to `patience` for files under construction.
    /// iceoryx2 gives up on an incomplete counter of processes, and waits for ever for a file without a size.
    pub(super) fn settle(&self, patience: Duration) -> io::Result<()> {
        let deadline = Instant::now() + patience;
        for_each_entry(
            Path::new(SHARED_MEMORY),
            |name| name.starts_with(&self.prefix),
            |path, _| {
                while is_begun(path)? && !settle(path)? && Instant::now() < deadline {
                    sleep(Duration::from_millis(1));
                }
                Ok(())
            },
        )
    }

    /// Removes all files of the folder's users, in it and in shared memory, if no other process uses it. Called just before this
    /// process leaves, as it may lose its lock.
    pub(super) fn clean_up(&self) -> io::Result<()> {
        self.clean_up_within(LETTING_GO, || sleep(Duration::from_millis(1)))
    }

    /// Cleans up as [`Self::clean_up`] does; waits up to `grace` for other processes, and calls `pause` before each new attempt.
    fn clean_up_within(&self, grace: Duration, mut pause: impl FnMut()) -> io::Result<()> {
        // To turn a shared lock into an exclusive one, a process has to release it first, and a process that checks for leftovers
        // may get it in between. Holders of a shared lock either use the folder, or check in the same moment and release it soon.
        let mut shared = 0;
        let is_worth_waiting = |lock: &File| {
            shared += u32::from(is_shared(lock));
            self.stop.forced() || shared < 2 // [derived]
        };
        if !lock_within(grace, &self.lock.0, is_worth_waiting, &mut pause)? {
            return Ok(());
        }
        let remove = |path: &Path, is_folder| if is_folder { fs::remove_dir_all(path) } else { fs::remove_file(path) };
        for_each_entry(&self.root, |name| name != LOCK, remove)?;
        // A folder that was deleted under a live run may have passed its inode number, and so its prefix, to this one.
        let (own, deadline) = (|name: &str| name.starts_with(&self.prefix), Instant::now() + grace);
        for_each_entry(Path::new(SHARED_MEMORY), own, |path, _| {
            while is_own(path)? && !remove_unused(path)? && Instant::now() < deadline {
                pause();
            }
            Ok(())
        })
    }
}

impl Drop for Occupied {
    fn drop(&mut self) {
        // Files that cannot be removed are found by the next run, or by `doctor`.
        self.clean_up().ok();
    }
}

/// Makes the counter of processes (16 bytes) private: the one file that iceoryx2 leaves open to all users.
pub(super) fn close_to_others(root: &Path) -> io::Result<()> {
    for_each_entry(Path::new(SHARED_MEMORY), is_counter(&prefix(root)?), |path, _| {
        if is_own(path)? { fs::set_permissions(path, Permissions::from_mode(0o600)) } else { Ok(()) }
    })
}

/// Whether a name in shared memory is that of the counter of a folder's processes.
fn is_counter(prefix: &str) -> impl Fn(&str) -> bool {
    move |name| name.starts_with(prefix) && name.ends_with(COUNTER)
}

/// Whether a file in shared memory is complete, or was removed here because its maker is gone.
fn settle(path: &Path) -> io::Result<bool> {
    // As long as this process holds the file and its lease, no other process can continue with it.
    let Some(file) = open_unless_held(path)? else { return Ok(false) };
    let (unused, is_whole) = (is_unused(&file), is_whole(&file.metadata()?));
    if unused && !is_whole {
        fs::remove_file(path)?;
    }
    Ok(unused || is_whole)
}

/// Whether a file in shared memory is complete: until then its maker makes it unreadable.
fn is_whole(about: &Metadata) -> bool {
    about.mode() & Mode::RUSR.bits() != 0
}

/// Whether a file in shared memory belongs to this user: anybody can put files there, under any name.
fn is_own(path: &Path) -> io::Result<bool> {
    Ok(is_file_of_this_user(&fs::symlink_metadata(path)?))
}

/// Whether a file in shared memory belongs to this user and is incomplete.
fn is_begun(path: &Path) -> io::Result<bool> {
    let about = fs::symlink_metadata(path)?;
    Ok(is_file_of_this_user(&about) && !is_whole(&about))
}

fn is_file_of_this_user(about: &Metadata) -> bool {
    about.is_file() && about.uid() == rustix::process::getuid().as_raw()
}

/// Removes a file in shared memory unless a process has it open. Returns whether it was removed.
pub(super) fn remove_unused(path: &Path) -> io::Result<bool> {
    // This process holds the file and its lease until the name is removed.
    let Some(file) = open_unless_held(path)? else { return Ok(false) };
    let unused = is_unused(&file);
    if unused { fs::remove_file(path).map(|()| true) } else { Ok(false) }
}

/// Opens a file in shared memory, without trust in what its name refers to. It opens for writing, because iceoryx2 makes
/// incomplete files unreadable even for their owner.
pub(super) fn open(path: &Path) -> io::Result<File> {
    OpenOptions::new().write(true).custom_flags(libc::O_NOFOLLOW | libc::O_NONBLOCK).open(path)
}

/// Opens a file as [`open`] does; `None` while another process holds the lease to check whether the file is in use, as all
/// joining processes do.
fn open_unless_held(path: &Path) -> io::Result<Option<File>> {
    match open(path) {
        Err(error) if error.kind() == ErrorKind::WouldBlock => Ok(None),
        opened => opened.map(Some),
    }
}

/// Whether no other process, in any container, has the file open or mapped. It stays so until the file is closed here, because an
/// `open` elsewhere blocks until then. If the kernel cannot tell, the file counts as used.
pub(super) fn is_unused(file: &File) -> bool {
    let descriptor = file.as_raw_fd();
    // SAFETY: the calls take an open descriptor and numbers, and touch no memory. The signal for a blocked `open` elsewhere is
    // ignored by default.
    unsafe {
        libc::fcntl(descriptor, F_SETSIG, libc::SIGURG) == 0
            && libc::fcntl(descriptor, libc::F_SETLEASE, libc::F_WRLCK) == 0
    }
}

/// Whether the folder or its shared memory has leftovers, and no process uses it.
pub(super) fn is_littered(root: &Path) -> bool {
    let Ok(lock) = File::open(root.join(LOCK)).map(Locked) else { return false };
    lock.0.try_lock().is_ok()
        && (has_entry(root, |name| name != LOCK) || prefix(root).is_ok_and(|own| has_shared_file(&own)))
}

fn has_shared_file(prefix: &str) -> bool {
    has_entry(Path::new(SHARED_MEMORY), |name| name.starts_with(prefix))
}

fn has_entry(folder: &Path, which: impl Fn(&str) -> bool) -> bool {
    let mut entries = fs::read_dir(folder).into_iter().flatten().flatten();
    entries.any(|entry| entry.file_name().to_str().is_some_and(&which))
}

/// Calls `act` with each entry of these names; entries, or a folder, that vanish meanwhile are no error.
pub(super) fn for_each_entry(
    folder: &Path,
    which: impl Fn(&str) -> bool,
    mut act: impl FnMut(&Path, bool) -> io::Result<()>,
) -> io::Result<()> {
    let unless_gone = |error: io::Error| if error.kind() == ErrorKind::NotFound { Ok(()) } else { Err(error) };
    let entries = match fs::read_dir(folder) {
        Ok(entries) => entries,
        Err(error) => return unless_gone(error),
    };
    for entry in entries {
        let entry = entry?;
        if entry.file_name().to_str().is_some_and(&which) {
            act(&entry.path(), entry.file_type()?.is_dir()).or_else(unless_gone)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::clock::until;
    use rustix::thread::{CapabilitySet, capabilities, set_capabilities};

    const LONG: Duration = Duration::from_secs(20);

    /// Leftovers of a killed process: half a node in the folder, half a segment in shared memory.
    fn litter(root: &Path) -> [PathBuf; 2] {
        let details = root.join("nodes/42/conicflow_node.details");
        fs::create_dir_all(details.parent().unwrap()).unwrap();
        let segment = Path::new(SHARED_MEMORY).join(format!("{}half_a_segment", prefix(root).unwrap()));
        let left = [details, segment];
        left.iter().for_each(|path| fs::write(path, "half").unwrap());
        left
    }

    #[test]
    fn only_a_file_of_this_user_is_an_own_one_and_no_folder_or_link() {
        let folder = tempfile::tempdir().unwrap();
        let [file, link] = ["file", "link"].map(|name| folder.path().join(name));
        fs::write(&file, "").unwrap();
        std::os::unix::fs::symlink(&file, &link).unwrap();
        assert_eq!([&file, &link, folder.path()].map(|path| is_own(path).unwrap()), [true, false, false]);
        assert!(is_own(&folder.path().join("nothing")).is_err());
        assert!(open(&file).is_ok() && open(&link).is_err(), "no link is followed");
    }

    #[test]
    fn the_names_of_a_folders_files_are_the_same_in_every_build() {
        // Test vectors of draft-eastlake-fnv.
        assert_eq!([&b""[..], b"a", b"foobar"].map(fnv_1a), [0x811c_9dc5, 0xe40c_292c, 0xbf9c_f968]);
        let folder = tempfile::tempdir().unwrap();
        let occupied = Occupied::new(folder.path(), Stop::default()).unwrap();
        assert_eq!((occupied.root(), occupied.prefix()), (folder.path(), &*prefix(folder.path()).unwrap()));
    }

    #[test]
    fn the_counter_of_a_folder_is_closed_to_others_and_nothing_else_is_touched() {
        let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
        let [own, other] = folders.each_ref().map(|folder| prefix(folder.path()).unwrap());
        let names = [format!("{own}1{COUNTER}"), format!("{own}1.data"), format!("{other}1{COUNTER}")];
        let files = names.map(|name| Path::new(SHARED_MEMORY).join(name));
        for file in &files {
            fs::write(file, "").unwrap();
            fs::set_permissions(file, Permissions::from_mode(0o666)).unwrap();
        }
        close_to_others(folders[0].path()).unwrap();
        let modes = files.each_ref().map(|file| fs::metadata(file).unwrap().permissions().mode() & 0o777);
        files.iter().for_each(|file| fs::remove_file(file).unwrap());
        assert_eq!(modes, [0o600, 0o666, 0o666]);
    }

    /// A file in a folder's shared memory whose creation has begun.
    fn begin(root: &Path) -> (PathBuf, File) {
        let path = Path::new(SHARED_MEMORY).join(format!("{}1.dynamic", prefix(root).unwrap()));
        let maker = OpenOptions::new().write(true).create_new(true).mode(0o200).open(&path).unwrap();
        (path, maker)
    }

    #[test]
    fn what_its_maker_died_over_is_removed_and_what_is_being_made_is_waited_for() {
        let folder = tempfile::tempdir().unwrap();
        let occupied = Occupied::new(folder.path(), Stop::default()).unwrap();
        let (path, maker) = begin(folder.path());
        occupied.settle(Duration::from_millis(20)).unwrap();
        assert!(path.exists(), "it is nobody else's yet, and not for ever waited for");
        drop(maker);
        // Processes that other tests fork hold copies of open files until they exec.
        occupied.settle(LONG).unwrap();
        assert!(!path.exists(), "its maker is gone");

        let (path, maker) = begin(folder.path());
        let making = std::thread::spawn(move || {
            sleep(Duration::from_millis(50));
            maker.set_permissions(Permissions::from_mode(0o600)).unwrap();
        });
        occupied.settle(LONG).unwrap();
        assert_eq!(fs::metadata(&path).unwrap().mode() & 0o777, 0o600, "waited for until it is whole");
        making.join().unwrap();
        occupied.settle(Duration::ZERO).unwrap();
        assert!(until(|| settle(&path).unwrap()) && path.exists(), "nobody has it open, and it is whole");
    }

    #[test]
    fn a_file_that_another_one_looks_at_is_looked_at_after_that() {
        let folder = tempfile::tempdir().unwrap();
        let occupied = Occupied::new(folder.path(), Stop::default()).unwrap();
        let (path, maker) = begin(folder.path());
        drop(maker);
        let held = open(&path).unwrap();
        assert!(until(|| is_unused(&held)));
        assert!(!settle(&path).unwrap() && !remove_unused(&path).unwrap() && path.exists());
        let looking = std::thread::spawn(move || {
            sleep(Duration::from_millis(50));
            drop(held);
        });
        occupied.settle(LONG).unwrap();
        looking.join().unwrap();
        assert!(!path.exists(), "its maker is gone");
    }

    #[test]
    fn what_was_only_begun_is_removed_by_who_may_not_read_it() {
        let folder = tempfile::tempdir().unwrap();
        let (path, maker) = begin(folder.path());
        drop(maker);
        // Root may read everything: this thread drops that capability.
        let removed = std::thread::spawn(move || {
            let mut sets = capabilities(None).unwrap();
            sets.effective -= CapabilitySet::DAC_OVERRIDE | CapabilitySet::DAC_READ_SEARCH;
            set_capabilities(None, sets).unwrap();
            assert!(File::open(&path).is_err(), "nobody may read it");
            until(|| remove_unused(&path).unwrap())
        });
        assert!(removed.join().unwrap());
    }

    #[test]
    fn what_nothing_leads_to_goes_with_the_last_one_who_uses_the_folder() {
        let folder = tempfile::tempdir().unwrap();
        let (first, last) = (
            Occupied::new(folder.path(), Stop::default()).unwrap(),
            Occupied::new(folder.path(), Stop::default()).unwrap(),
        );
        let left = litter(folder.path());
        drop(first);
        assert!(left.iter().all(|path| path.exists()), "somebody uses the folder");
        assert!(!is_littered(folder.path()), "it may be somebody's");
        drop(last);
        assert!(left.iter().all(|path| !path.exists()));
        assert!(!folder.path().join("nodes").exists() && folder.path().join(LOCK).exists());
    }

    #[test]
    fn who_leaves_a_run_that_is_over_waits_for_those_who_are_just_killed() {
        let folder = tempfile::tempdir().unwrap();
        let stop = Stop::default();
        let killed = File::create(folder.path().join(LOCK)).unwrap();
        killed.lock_shared().unwrap();
        let last = Occupied::new(folder.path(), stop.clone()).unwrap();
        let left = litter(folder.path());
        last.clean_up_within(LONG, || ()).unwrap();
        assert!(left.iter().all(|path| path.exists()), "somebody uses the folder");
        stop.force();
        let mut looks = 0..5;
        let pause = || {
            if looks.next().is_none() {
                killed.unlock().unwrap();
            }
        };
        last.clean_up_within(LONG, pause).unwrap();
        assert!(left.iter().all(|path| !path.exists()));
    }

    #[test]
    fn who_leaves_at_the_moment_when_somebody_looks_for_litter_waits_for_that() {
        let folder = tempfile::tempdir().unwrap();
        let last = Occupied::new(folder.path(), Stop::default()).unwrap();
        let left = litter(folder.path());
        // As if somebody checks while this process turns its shared lock into an exclusive one.
        last.lock.0.unlock().unwrap();
        let looker = File::open(folder.path().join(LOCK)).unwrap();
        looker.lock().unwrap();
        last.clean_up_within(LONG, || looker.unlock().unwrap()).unwrap();
        assert!(left.iter().all(|path| !path.exists()));
    }

    #[test]
    fn what_one_who_was_just_killed_has_open_is_removed_when_he_lets_it_go() {
        let folder = tempfile::tempdir().unwrap();
        let last = Occupied::new(folder.path(), Stop::default()).unwrap();
        let [_, segment] = litter(folder.path());
        let mut held = Some(File::open(&segment).unwrap());
        last.clean_up_within(LONG, || drop(held.take())).unwrap();
        assert!(held.is_none() && !segment.exists());
    }

    #[test]
    fn what_another_one_keeps_open_is_left_to_him() {
        let folder = tempfile::tempdir().unwrap();
        let last = Occupied::new(folder.path(), Stop::default()).unwrap();
        let [_, segment] = litter(folder.path());
        let held = File::open(&segment).unwrap();
        let begin = Instant::now();
        let pause = || assert!(begin.elapsed() < LONG, "it is waited for as long as it is open");
        last.clean_up_within(Duration::from_millis(20), pause).unwrap();
        assert!(segment.exists());
        drop(held);
        // Processes that other tests fork hold copies of open files until they exec.
        last.clean_up_within(LONG, || ()).unwrap();
        assert!(!segment.exists());
    }

    #[test]
    fn what_is_left_in_shared_memory_alone_is_litter_too() {
        let folder = tempfile::tempdir().unwrap();
        drop(Occupied::new(folder.path(), Stop::default()).unwrap());
        assert!(!is_littered(folder.path()));
        let [_, segment] = litter(folder.path());
        fs::remove_dir_all(folder.path().join("nodes")).unwrap();
        assert!(is_littered(folder.path()));
        drop(Occupied::new(folder.path(), Stop::default()).unwrap());
        assert!(!is_littered(folder.path()) && !segment.exists());
    }

    #[test]
    fn who_leaves_a_folder_that_was_deleted_leaves_nothing_in_shared_memory() {
        let folder = tempfile::tempdir().unwrap();
        let occupied = Occupied::new(folder.path(), Stop::default()).unwrap();
        let [_, segment] = litter(folder.path());
        drop(folder);
        drop(occupied);
        assert!(!segment.exists());
    }
}
