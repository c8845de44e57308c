//! Files of a run: one folder per user, in it one per pipeline, and beside them the files of shared memory.

use crate::file_lock::{Locked, is_shared, lock_within};
use crate::pause::{PAUSE_FILE, PauseFile};
use crate::plan::{LAYOUT, Plan};
use crate::ports::shared_memory::acknowledgements::ENDING as ACKNOWLEDGEMENTS;
use crate::runner::peers::END;
use crate::status::{Life, Status, StatusFile, status_path};
use rustix::io::Errno;
use serde::Deserialize;
use std::fs::{self, File, TryLockError};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::thread::sleep;
use std::time::Duration;

/// Environment variable: the user's folder, in place of the default.
pub const RUNTIME_DIR: &str = "CONICFLOW_RUNTIME_DIR";

/// Name of the plan's file in the folder of a run.
pub(crate) const PLAN: &str = "plan.json";
/// Name of the file that keeps the previous plan after a change, to restore it.
const PLAN_BEFORE: &str = "plan.json.kept";

/// Stages end by themselves within this time after their launcher was killed.
pub(crate) const LAST_STAGES_GRACE: Duration = Duration::from_secs(5);

/// A process that only checks whether a run has the folder holds its lock for a moment; at most this long, if it is delayed then.
const CHECK_GRACE: Duration = Duration::from_secs(5);

/// Reason why a run has no usable folder.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    /// The folder could not be made, read or written.
    #[error("{}: {error}\n  hint: {}", path.display(), hint_of(error))]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// Error of the system.
        error: io::Error,
    },
    /// The folder belongs to another user: files written there would be in that user's way, and files read could contain
    /// anything.
    #[error(
        "`{}` belongs to another user\n  hint: do this as that user (`sudo -u '#{owner}' ...`), or set \
         CONICFLOW_RUNTIME_DIR to a folder of your own with mode 700", path.display()
    )]
    OfAnother {
        /// The folder.
        path: PathBuf,
        /// Numeric id of its user.
        owner: u32,
    },
    /// The folder is open to others.
    #[error(
        "`{}` is open to others\n  hint: `chmod 700` it, or set CONICFLOW_RUNTIME_DIR to a folder with that mode", path.display()
    )]
    NotPrivate {
        /// The folder.
        path: PathBuf,
    },
    /// A pipeline of this name runs already.
    #[error(
        "a pipeline named `{name}` is running already on this machine\n  \
         hint: end it first, give this one another `name` in its file, or, if it is another machine's part of the same \
         pipeline, another CONICFLOW_RUNTIME_DIR"
    )]
    Running {
        /// Its name.
        name: String,
    },
    /// Stages of an earlier run, or stages that were started one by one, still run.
    #[error(
        "stages of a pipeline named `{name}` are still running on this machine\n  \
         hint: end them (`pgrep -af \"conicflow node\"` lists them), or give this pipeline another `name`"
    )]
    Occupied {
        /// Its name.
        name: String,
    },
    /// The launcher was built from another version than this program.
    #[error(
        "this program and the launcher of its run were built from different versions of conicflow (layout {own}, {launcher})\n  \
         hint: build both from the same version"
    )]
    OtherVersion {
        /// Layout of this program.
        own: u32,
        /// Layout of the launcher; 0 if it does not say.
        launcher: u32,
    },
    /// The plan of a run cannot be parsed.
    #[error("{}: {error}\n  hint: start the pipeline anew with `conicflow run`", path.display())]
    Plan {
        /// The file.
        path: PathBuf,
        /// Error of the parser.
        error: serde_json::Error,
    },
}

/// The part of a plan that every version can read.
#[derive(Deserialize)]
struct Agreed {
    #[serde(default)]
    layout: u32,
}

/// The folder of one pipeline's run.
#[derive(Clone, Debug)]
pub struct RunFolder {
    path: PathBuf,
    shared_memory: PathBuf,
}

/// Lock of a run, held as long as the run lasts: no other run of the same name can start.
#[derive(Debug)]
pub struct RunLock {
    file: Locked,
    plan: PathBuf,
}

impl RunLock {
    /// Whether the locked folder still exists with the plan of its run. Only that run removes them, or somebody from outside.
    pub(crate) fn is_there(&self) -> bool {
        let is_linked = self.file.0.metadata().is_ok_and(|about| about.nlink() > 0);
        is_linked && self.plan.exists()
    }
}

/// Hint for an error of the system with a file or a folder.
fn hint_of(error: &io::Error) -> &'static str {
    match error.kind() {
        io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded => {
            "make room there, or set CONICFLOW_RUNTIME_DIR to a folder where there is some"
        }
        io::ErrorKind::FileTooLarge => "files may not become that long: `ulimit -f`, in a systemd unit `LimitFSIZE=`",
        _ if matches!(Errno::from_io_error(error), Some(Errno::MFILE | Errno::NFILE)) => {
            "no more files may be open: `ulimit -n`, in a systemd unit `LimitNOFILE=`"
        }
        _ => "set CONICFLOW_RUNTIME_DIR to a short path that this user may write to",
    }
}

impl FolderError {
    /// Wraps an error of the system with a file or folder.
    pub(crate) fn at(path: &Path) -> impl Fn(io::Error) -> Self {
        |error| Self::Io { path: path.to_owned(), error }
    }
}

impl RunFolder {
    /// Opens the folder of the pipeline `name`, and creates it if need be.
    ///
    /// # Errors
    /// It cannot be created, or is open to others.
    pub fn open(name: &str) -> Result<Self, FolderError> {
        let user = user_folder();
        private_folder(&user)?;
        let (path, shared_memory) = (user.join("run").join(name), user.join("shm"));
        private_folder(&path)?;
        private_folder(&shared_memory)?;
        Ok(Self { path, shared_memory })
    }

    /// The folders of all pipelines that were ever run, in the folder of their user ([`user_folder`]).
    ///
    /// # Errors
    /// The user's folder cannot be read, or is open to others.
    pub fn all(user: &Path) -> Result<Vec<Self>, FolderError> {
        let (runs, shared_memory) = (user.join("run"), user.join("shm"));
        match check_private(user) {
            Err(FolderError::Io { error, .. }) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            checked => checked?,
        }
        let entries = match fs::read_dir(&runs) {
            Ok(entries) => entries,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Vec::new()),
            Err(error) => return Err(FolderError::Io { path: runs, error }),
        };
        let mut paths: Vec<_> = entries.flatten().map(|entry| entry.path()).collect();
        paths.sort();
        Ok(paths.into_iter().map(|path| Self { path, shared_memory: shared_memory.clone() }).collect())
    }

    /// The folder of iceoryx2's files, shared by all pipelines of this user.
    pub fn shared_memory(&self) -> &Path {
        &self.shared_memory
    }

    /// Path of the folder.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Sets the state of a stage in its record, so that the other stages know that it will not come back.
    pub(crate) fn set_life(&self, run: u64, stage: &str, life: Life) {
        if let Ok(mut record) = StatusFile::open(&self.status(stage), run) {
            record.status.set_life(life);
            record.write();
        }
    }

    /// Path of a stage's record.
    pub fn status(&self, stage: &str) -> PathBuf {
        status_path(&self.path, stage)
    }

    /// The record of a stage, if it belongs to this run.
    pub(crate) fn record(&self, stage: &str, run: u64) -> Option<Status> {
        Status::read(&self.status(stage)).filter(|record| record.run == run)
    }

    /// Locks the folder for a run of `name`, as soon as the stages of an earlier, aborted run are gone.
    ///
    /// # Errors
    /// Another run has the lock, or stages of another run keep running.
    pub fn lock(&self, name: &str) -> Result<RunLock, FolderError> {
        self.lock_pausing(name, || sleep(Duration::from_millis(10)))
    }

    /// Locks the folder as [`Self::lock`] does; calls `pause` before each new attempt.
    fn lock_pausing(&self, name: &str, mut pause: impl FnMut()) -> Result<RunLock, FolderError> {
        let (path, file) = self.open_lock("lock")?;
        let run = RunLock { file: Locked(file), plan: self.path.join(PLAN) };
        // Processes that only check share the lock.
        if !lock_within(CHECK_GRACE, &run.file.0, is_shared, &mut pause).map_err(FolderError::at(&path))? {
            return Err(FolderError::Running { name: name.to_owned() });
        }
        let (path, stages) = self.open_lock("stages.lock")?;
        let stages = Locked(stages);
        if !lock_within(LAST_STAGES_GRACE, &stages.0, |_| true, pause).map_err(FolderError::at(&path))? {
            return Err(FolderError::Occupied { name: name.to_owned() });
        }
        Ok(run)
    }

    /// Whether a run has the folder's lock now.
    pub(crate) fn is_running(&self) -> bool {
        let file = File::open(self.path.join("lock"));
        file.is_ok_and(|file| matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock)))
    }

    /// The plan of an aborted run that left this folder behind; `None` if its run is still going, or ended in order.
    pub(crate) fn cut_off(&self) -> Option<Plan> {
        let plan = self.plan().ok().filter(|_| !self.is_running())?;
        let mut records = plan.stages.iter().filter_map(|stage| self.record(&stage.name, plan.run));
        records.any(|record| matches!(record.life(), Life::Starting | Life::Running)).then_some(plan)
    }

    /// Registers this process as a stage of this pipeline, for as long as the file is held.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub(crate) fn join(&self) -> Result<File, FolderError> {
        let (path, file) = self.open_lock("stages.lock")?;
        file.lock_shared().map_err(FolderError::at(&path))?;
        Ok(file)
    }

    fn open_lock(&self, name: &str) -> Result<(PathBuf, File), FolderError> {
        let path = self.path.join(name);
        let file = File::create(&path).map_err(FolderError::at(&path))?;
        Ok((path, file))
    }

    /// Removes the plan and the records of earlier runs, so that no process takes them for those of the run that has the lock.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub(crate) fn empty(&self) -> Result<(), FolderError> {
        self.remove_records()?;
        let path = self.path.join(PLAN);
        match fs::remove_file(&path) {
            Err(error) if error.kind() != io::ErrorKind::NotFound => Err(FolderError::Io { path, error }),
            _ => Ok(()),
        }
    }

    /// Creates the pause file, then writes the plan, by which other processes see that the run has begun.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn begin(&self, plan: &Plan) -> Result<(), FolderError> {
        let path = self.path.join(PAUSE_FILE);
        PauseFile::create(&path, plan.run).map_err(FolderError::at(&path))?;
        self.write_whole(PLAN, plan)
    }

    /// The pause switch of a run's sources, where there is one.
    pub(crate) fn pause_file(&self, run: u64) -> Option<PauseFile> {
        PauseFile::open(&self.path.join(PAUSE_FILE), run).ok()
    }

    /// Records that a run is over as its launcher saw it: its stages then do not count as aborted, and are not restarted. Where
    /// that cannot be written, the next run does it.
    pub(crate) fn settle(&self, plan: &Plan) {
        for stage in &plan.stages {
            let record = self.record(&stage.name, plan.run);
            if record.is_some_and(|record| matches!(record.life(), Life::Starting | Life::Running)) {
                self.set_life(plan.run, &stage.name, Life::Gone);
            }
        }
        for entry in fs::read_dir(&self.path).into_iter().flatten().flatten() {
            if entry.path().extension().is_some_and(|extension| extension == "kept") {
                fs::remove_file(entry.path()).ok();
            }
        }
    }

    /// Removes the plan and the records of a run that is over; the locks stay.
    ///
    /// # Errors
    /// A run has the folder, or it cannot be written.
    pub(crate) fn discard(&self) -> Result<(), FolderError> {
        let name = self.path.file_name().unwrap_or_default().to_string_lossy();
        let _lock = self.lock(&name)?;
        self.empty()
    }

    fn remove_records(&self) -> Result<(), FolderError> {
        let fault = FolderError::at(&self.path);
        for entry in fs::read_dir(&self.path).map_err(&fault)?.flatten() {
            let ends =
                ["status", END, ACKNOWLEDGEMENTS, "first", "last", "request", "answer", "new", "kept", "plan", "pause"];
            if entry.path().extension().is_some_and(|extension| ends.iter().any(|end| extension == *end)) {
                fs::remove_file(entry.path()).map_err(&fault)?;
            }
        }
        Ok(())
    }

    /// Replaces the plan, and keeps the previous one; on an error that one stays in place.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub(crate) fn change_plan(&self, plan: &Plan) -> Result<(), FolderError> {
        let (path, before) = (self.path.join(PLAN), self.path.join(PLAN_BEFORE));
        fs::remove_file(&before).ok();
        fs::hard_link(&path, &before).map_err(FolderError::at(&before))?;
        self.write_whole(PLAN, plan)
    }

    /// Restores the plan from before the last change, which needs no room on the disk.
    ///
    /// # Errors
    /// There is none.
    pub(crate) fn take_plan_back(&self) -> Result<(), FolderError> {
        let (path, before) = (self.path.join(PLAN), self.path.join(PLAN_BEFORE));
        fs::rename(before, &path).map_err(FolderError::at(&path))
    }

    /// Reads the plan of the run.
    ///
    /// # Errors
    /// There is none, or it cannot be parsed.
    pub fn plan(&self) -> Result<Plan, FolderError> {
        self.read_plan(PLAN)
    }

    /// Reads the plan in a file of the folder.
    ///
    /// # Errors
    /// There is none, or it cannot be parsed.
    pub(crate) fn read_plan(&self, file: &str) -> Result<Plan, FolderError> {
        let path = self.path.join(file);
        let text = fs::read(&path).map_err(FolderError::at(&path))?;
        let fault = |error| FolderError::Plan { path, error };
        match serde_json::from_slice::<Agreed>(&text).map_err(fault.clone())?.layout {
            LAYOUT => serde_json::from_slice(&text).map_err(fault),
            launcher => Err(FolderError::OtherVersion { own: LAYOUT, launcher }),
        }
    }
}

/// The folder that has all runs of this user, whether it exists or not.
pub fn user_folder() -> PathBuf {
    let path_in = |variable: &str| std::env::var_os(variable).map(PathBuf::from);
    let path = user_folder_of(path_in(RUNTIME_DIR), path_in("XDG_RUNTIME_DIR"));
    std::path::absolute(&path).unwrap_or(path)
}

/// Chooses the user's folder: the configured one, else one in the system's folder of this login, else one in /tmp.
fn user_folder_of(wanted: Option<PathBuf>, of_login: Option<PathBuf>) -> PathBuf {
    if let Some(path) = wanted.filter(|path| !path.as_os_str().is_empty()) {
        return path;
    }
    match of_login {
        Some(path) if path.is_dir() => path.join("conicflow"),
        _ => PathBuf::from(format!("/tmp/conicflow-{}", rustix::process::getuid().as_raw())),
    }
}

/// Creates a folder that only this user can enter, and checks that it is one.
fn private_folder(path: &Path) -> Result<(), FolderError> {
    fs::DirBuilder::new().recursive(true).mode(0o700).create(path).map_err(FolderError::at(path))?;
    check_private(path)
}

/// Checks that only this user can enter a folder.
///
/// # Errors
/// It does not exist, is not a folder, or is open to others.
pub(crate) fn check_private(path: &Path) -> Result<(), FolderError> {
    let data = fs::metadata(path).map_err(FolderError::at(path))?;
    if !data.is_dir() {
        return Err(FolderError::at(path)(io::ErrorKind::NotADirectory.into()));
    }
    let (path, owner) = (path.to_owned(), data.uid());
    if owner != rustix::process::getuid().as_raw() {
        return Err(FolderError::OfAnother { path, owner });
    }
    if data.permissions().mode() & 0o077 != 0 {
        return Err(FolderError::NotPrivate { path });
    }
    Ok(())
}

#[cfg(test)]
pub(super) mod tests {
    use super::super::trial_run::plan_of;
    use super::*;
    use crate::pause::PauseRequest;

    /// The run's folder at this path.
    pub fn folder_at(path: &Path) -> RunFolder {
        RunFolder { path: path.to_owned(), shared_memory: path.join("shm") }
    }

    #[test]
    fn who_looks_for_long_keeps_no_run_from_starting_and_a_run_does() {
        let files = tempfile::tempdir().unwrap();
        let folder = folder_at(files.path());
        let (_, looker) = folder.open_lock("lock").unwrap();
        looker.lock_shared().unwrap();
        let mut looks = 0..5;
        let lock = folder.lock_pausing("tracking", || {
            if looks.next().is_none() {
                looker.unlock().unwrap();
            }
        });
        let lock = lock.unwrap();
        assert!(looks.is_empty());
        assert!(folder.is_running());
        assert!(matches!(folder.lock("tracking"), Err(FolderError::Running { name }) if name == "tracking"));
        drop(lock);
        folder.lock("tracking").unwrap();
    }

    #[test]
    fn all_runs_of_a_user_are_found_by_name_none_where_there_was_none_and_it_is_told_where_that_cannot_be_read() {
        let files = tempfile::tempdir().unwrap();
        let mode = |mode| fs::set_permissions(files.path(), fs::Permissions::from_mode(mode)).unwrap();
        let all = || RunFolder::all(files.path());
        mode(0o700);
        assert!(all().unwrap().is_empty());
        let runs = files.path().join("run");
        fs::write(&runs, "no folder").unwrap();
        assert!(matches!(all(), Err(FolderError::Io { path, .. }) if path == runs));
        fs::remove_file(&runs).unwrap();
        ["tracking", "fruits"].iter().for_each(|name| fs::create_dir_all(runs.join(name)).unwrap());
        mode(0o750);
        assert!(matches!(all(), Err(FolderError::NotPrivate { path }) if path == files.path()));
        mode(0o700);
        let all = all().unwrap();
        assert!(all.iter().map(RunFolder::path).eq([runs.join("fruits"), runs.join("tracking")]));
        assert!(all.iter().all(|folder| folder.shared_memory() == files.path().join("shm")));
    }

    #[test]
    fn what_earlier_runs_have_left_goes_and_locks_and_what_is_not_theirs_stay() {
        let files = tempfile::tempdir().unwrap();
        let folder = folder_at(files.path());
        let all = ["a%b.acks", "lock", "notes.txt", "plan.json", "plan.json.kept", "stages.lock", "tracker.status"];
        all.iter().for_each(|name| fs::write(files.path().join(name), "left").unwrap());
        folder.empty().unwrap();
        let is_there = |name: &&str| files.path().join(name).exists();
        assert!(all.into_iter().filter(is_there).eq(["lock", "notes.txt", "stages.lock"]));
        folder.empty().unwrap();
        fs::create_dir(files.path().join(PLAN)).unwrap();
        assert!(matches!(folder.empty(), Err(FolderError::Io { path, .. }) if path == files.path().join(PLAN)));
    }

    #[test]
    fn a_lock_is_there_as_long_as_its_folder_is_and_has_a_plan_whoever_makes_it_anew() {
        let files = tempfile::tempdir().unwrap();
        let folder = folder_at(files.path());
        let lock = folder.lock("tracking").unwrap();
        assert!(!lock.is_there(), "no run has begun");
        folder.begin(&plan_of(7)).unwrap();
        assert!(lock.is_there());
        fs::remove_file(files.path().join("plan.json")).unwrap();
        assert!(!lock.is_there());
        folder.begin(&plan_of(7)).unwrap();
        fs::remove_file(files.path().join("lock")).unwrap();
        let another = folder.lock("tracking").unwrap();
        assert_eq!((lock.is_there(), another.is_there()), (false, true));
    }

    #[test]
    fn a_run_waits_for_the_last_stages_of_one_that_was_cut_off() {
        let files = tempfile::tempdir().unwrap();
        let folder = folder_at(files.path());
        let stage = folder.join().unwrap();
        let mut is_waited_for = false;
        let lock = folder.lock_pausing("tracking", || {
            is_waited_for = true;
            stage.unlock().unwrap();
        });
        assert!(lock.is_ok() && is_waited_for);
    }

    #[test]
    fn a_run_that_has_begun_can_be_paused_and_none_other() {
        let files = tempfile::tempdir().unwrap();
        let folder = folder_at(files.path());
        folder.begin(&plan_of(7)).unwrap();
        folder.pause_file(7).unwrap().change(PauseRequest::Pause).unwrap();
        assert_eq!([7, 8].map(|run| folder.pause_file(run).unwrap().is_paused()), [true, false]);
    }

    #[test]
    fn a_plan_that_was_changed_can_be_taken_back_once() {
        let files = tempfile::tempdir().unwrap();
        let folder = folder_at(files.path());
        folder.begin(&plan_of(7)).unwrap();
        folder.change_plan(&plan_of(8)).unwrap();
        assert_eq!(folder.plan().unwrap().run, 8);
        folder.take_plan_back().unwrap();
        assert_eq!(folder.plan().unwrap().run, 7);
        folder.take_plan_back().unwrap_err();
        assert_eq!(folder.plan().unwrap().run, 7);
    }

    #[test]
    fn a_run_was_cut_off_if_it_has_no_launcher_and_a_stage_that_was_at_work() {
        let files = tempfile::tempdir().unwrap();
        let folder = folder_at(files.path());
        let cut_off = || folder.cut_off().map(|plan| plan.run);
        assert_eq!(cut_off(), None, "there was none");
        folder.begin(&plan_of(7)).unwrap();
        assert_eq!(cut_off(), None, "no stage had begun");
        for (life, expected) in
            [(Life::Starting, Some(7)), (Life::Running, Some(7)), (Life::Ended, None), (Life::Gone, None)]
        {
            folder.set_life(7, "stage", life);
            assert_eq!(cut_off(), expected, "{life:?}");
        }
        folder.set_life(7, "stage", Life::Running);
        let lock = folder.lock("test").unwrap();
        assert_eq!(cut_off(), None, "it goes on");
        drop(lock);
        folder.settle(&plan_of(7));
        assert_eq!((cut_off(), folder.record("stage", 7).unwrap().life()), (None, Life::Gone));
    }

    #[test]
    fn the_folder_of_a_user_is_the_one_that_was_asked_for_then_that_of_the_login_then_one_by_number() {
        let files = tempfile::tempdir().unwrap();
        let path = |text: &str| Some(PathBuf::from(text));
        let (login, by_number) = (files.path().join("conicflow"), user_folder_of(None, None));
        assert!(by_number.to_str().unwrap().starts_with("/tmp/conicflow-"), "{by_number:?}");
        for (wanted, of_login, expected) in [
            (path("/own"), Some(files.path().into()), Path::new("/own")),
            (path(""), Some(files.path().into()), &login),
            (None, Some(files.path().into()), &login),
            (None, path("/nowhere/at/all"), &by_number),
        ] {
            assert_eq!(user_folder_of(wanted, of_login), expected);
        }
        assert!(!user_folder().as_os_str().is_empty());
    }

    #[test]
    fn what_the_system_refuses_is_told_with_what_to_do_about_that() {
        for (errno, hint) in [
            (Errno::NOSPC, "make room there"),
            (Errno::DQUOT, "make room there"),
            (Errno::FBIG, "`ulimit -f`"),
            (Errno::MFILE, "`ulimit -n`"),
            (Errno::ACCESS, "set CONICFLOW_RUNTIME_DIR to a short path"),
        ] {
            let told = FolderError::at(Path::new("/run"))(errno.into()).to_string();
            assert!(told.split_once("\n  hint: ").unwrap().1.contains(hint), "{told}");
        }
    }

    #[test]
    fn a_folder_that_others_may_enter_is_not_private() {
        let files = tempfile::tempdir().unwrap();
        let path = files.path().join("new");
        private_folder(&path).unwrap();
        for mode in [0o750, 0o701, 0o777] {
            fs::set_permissions(&path, fs::Permissions::from_mode(mode)).unwrap();
            assert!(matches!(check_private(&path), Err(FolderError::NotPrivate { .. })), "{mode:o}");
        }
        fs::set_permissions(&path, fs::Permissions::from_mode(0o700)).unwrap();
        check_private(&path).unwrap();
        fs::write(path.join("file"), "").unwrap();
        for no_folder in ["file", "nothing"] {
            assert!(matches!(check_private(&path.join(no_folder)), Err(FolderError::Io { .. })), "{no_folder}");
        }
    }

    #[test]
    fn what_a_run_that_is_over_has_left_is_discarded_and_nothing_of_one_that_goes_on() {
        let files = tempfile::tempdir().unwrap();
        let folder = folder_at(files.path());
        ["plan.json", "tracker.status"].iter().for_each(|name| fs::write(files.path().join(name), "left").unwrap());
        let left = || ["plan.json", "tracker.status", "lock"].map(|name| files.path().join(name).exists());
        let lock = folder.lock("tracking").unwrap();
        assert!(matches!(folder.discard(), Err(FolderError::Running { .. })));
        assert_eq!(left(), [true; 3]);
        drop(lock);
        folder.discard().unwrap();
        assert_eq!(left(), [false, false, true]);
    }
}
