//! Removes all that is left in shared memory when nobody uses it.
//!
//! iceoryx2 removes what a dead process has left as far as that had come to announce it. A process that is killed while it
//! joins or leaves may leave files that nothing leads to, and nobody removes the counter of processes; they go with the last
//! one that uses the folder. Whoever uses it holds a lock, which the kernel releases however a process ends; and what a
//! folder's users have in shared memory bears a prefix of its own, so that other users, folders and containers are never
//! touched. What its maker died over before it was whole would stop for ever who opens it: it is removed before a process joins,
//! and while a run lasts.

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

/// A process that was killed still has its locks and its files for so long, on a machine with much to do, and one that looks for
/// litter the lock.
const LETTING_GO: Duration = Duration::from_secs(1);

const LOCK: &str = "lock";

/// From Linux's `fcntl.h`; the `libc` crate does not have it.
const F_SETSIG: libc::c_int = 10;

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
    let bytes = [folder.dev(), folder.ino(), folder.uid().into()].map(u64::to_le_bytes);
    Ok(format!("{PREFIX}{:08x}_", fnv_1a(bytes.as_flattened())))
}

/// The hash FNV-1a: the same in every build, unlike those of the standard library.
fn fnv_1a(bytes: &[u8]) -> u32 {
    bytes.iter().fold(0x811c_9dc5, |hash, byte| (hash ^ u32::from(*byte)).wrapping_mul(0x0100_0193))
}

/// A folder that this process uses as long as this lives; the last of its users leaves nothing in it.
#[derive(Debug)]
pub(super) struct Occupied {
    root: PathBuf,
    prefix: String,
    lock: Locked,
    stop: Stop,
}

impl Occupied {
    /// Says that this process uses the folder. Where `stop` is forced by the time that it leaves, those who use the folder then
    /// may have been killed, and would leave nothing in order any more: it waits until they are gone.
    pub(super) fn new(root: &Path, stop: Stop) -> io::Result<Self> {
        let lock = Locked(File::create(root.join(LOCK))?);
        lock.0.lock_shared()?;
        Ok(Self { root: root.to_owned(), prefix: prefix(root)?, lock, stop })
    }

    /// The folder.
    pub(super) fn root(&self) -> &Path {
        &self.root
    }

    /// What the names of all files in shared memory begin with that its users make.
    pub(super) fn prefix(&self) -> &str {
        &self.prefix
    }

    /// Whether the folder and what its users share is still there: nothing but the last of them removes it, or somebody from outside.
    pub(super) fn is_there(&self) -> bool {
        self.root.join(LOCK).exists() && has_entry(Path::new(SHARED_MEMORY), is_counter(&self.prefix))
    }

    /// Removes from shared memory what its maker died over before it was whole, and waits so long for what is being made: iceoryx2
    /// gives up on a counter of processes that is not whole, and waits for ever for what has no size yet.
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

    /// Removes all that users of the folder have left in it and in shared memory, if no other uses it: for one that is about
    /// to leave, because it may have lost its lock afterwards.
    pub(super) fn clean_up(&self) -> io::Result<()> {
        self.clean_up_within(LETTING_GO, || sleep(Duration::from_millis(1)))
    }

    /// The same, with how long it waits for others, and the pause after which it looks again.
    fn clean_up_within(&self, grace: Duration, mut pause: impl FnMut()) -> io::Result<()> {
        // Who exchanges his share of the lock for the whole gives it back first, and one that just looks for litter may have got
        // it. Those who share it use the folder, or find out the same at the same time, and have let go of it a moment later.
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
        // A folder that was deleted under a live run may have left its number to this one.
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
        // What cannot be removed is found by the next run, or by `doctor`.
        self.clean_up().ok();
    }
}

/// Closes to others the one file in shared memory that iceoryx2 leaves open to everybody, a counter of 16 bytes.
pub(super) fn close_to_others(root: &Path) -> io::Result<()> {
    for_each_entry(Path::new(SHARED_MEMORY), is_counter(&prefix(root)?), |path, _| {
        if is_own(path)? { fs::set_permissions(path, Permissions::from_mode(0o600)) } else { Ok(()) }
    })
}

/// Whether a name in shared memory is that of the counter of a folder's processes.
fn is_counter(prefix: &str) -> impl Fn(&str) -> bool {
    move |name| name.starts_with(prefix) && name.ends_with(COUNTER)
}

/// Whether a file in shared memory is whole, or was removed here because it never will be: its maker is gone.
fn settle(path: &Path) -> io::Result<bool> {
    // While the file is held, and with it the lease, nobody can go on with it.
    let Some(file) = open_unless_held(path)? else { return Ok(false) };
    let (unused, is_whole) = (is_unused(&file), is_whole(&file.metadata()?));
    if unused && !is_whole {
        fs::remove_file(path)?;
    }
    Ok(unused || is_whole)
}

/// Whether what a file in shared memory is to be is there: before that its maker lets nobody read it.
fn is_whole(about: &Metadata) -> bool {
    about.mode() & Mode::RUSR.bits() != 0
}

/// Whether a file in shared memory is one of this user: anybody can put files there, under any name.
fn is_own(path: &Path) -> io::Result<bool> {
    Ok(is_file_of_this_user(&fs::symlink_metadata(path)?))
}

/// Whether a file in shared memory is one of this user, and not whole.
fn is_begun(path: &Path) -> io::Result<bool> {
    let about = fs::symlink_metadata(path)?;
    Ok(is_file_of_this_user(&about) && !is_whole(&about))
}

fn is_file_of_this_user(about: &Metadata) -> bool {
    about.is_file() && about.uid() == rustix::process::getuid().as_raw()
}

/// Removes a file in shared memory, unless a process has it open; whether it was removed.
pub(super) fn remove_unused(path: &Path) -> io::Result<bool> {
    // The file is held, and with it the lease, until its name is gone.
    let Some(file) = open_unless_held(path)? else { return Ok(false) };
    let unused = is_unused(&file);
    if unused { fs::remove_file(path).map(|()| true) } else { Ok(false) }
}

/// Opens a file in shared memory, whoever may have put what under its name: for writing, because iceoryx2 lets nobody, not even
/// its owner, read what is not whole.
pub(super) fn open(path: &Path) -> io::Result<File> {
    OpenOptions::new().write(true).custom_flags(libc::O_NOFOLLOW | libc::O_NONBLOCK).open(path)
}

/// The same; none where another one just looks whether somebody uses it, as all do that join at a time.
fn open_unless_held(path: &Path) -> io::Result<Option<File>> {
    match open(path) {
        Err(error) if error.kind() == ErrorKind::WouldBlock => Ok(None),
        opened => opened.map(Some),
    }
}

/// Whether nobody else has the file open or mapped, in whatever container; it stays so until the file is closed here,
/// because whoever opens it meanwhile waits for that. Where the kernel cannot tell, somebody has.
pub(super) fn is_unused(file: &File) -> bool {
    let descriptor = file.as_raw_fd();
    // SAFETY: the calls take an open descriptor and numbers, and touch no memory. The signal that tells of somebody who
    // waits is one that is ignored unless asked for.
    unsafe {
        libc::fcntl(descriptor, F_SETSIG, libc::SIGURG) == 0
            && libc::fcntl(descriptor, libc::F_SETLEASE, libc::F_WRLCK) == 0
    }
}

/// Whether something of the folder's users is left, in it or in shared memory, and nobody uses it.
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

/// Does something with the entries of these names, unless they, or the folder, are gone meanwhile.
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

    /// What a process that was killed may leave: half a node in the folder, half a segment in shared memory.
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

    /// A part of a folder's shared memory as its maker begins it.
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
        // The processes that other tests start have what is open here open until they are other programs.
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
        // As root everybody may read it: this thread gives that up.
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
        // As where somebody looks while this one exchanges its share of the lock for the whole.
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
        // The processes that other tests start have what is open here open until they are other programs.
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
