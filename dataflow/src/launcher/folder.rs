//! Where a run keeps its files: one folder per user, in it one per pipeline, and beside them the files of shared memory.

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

/// Environment variable: the user's folder, where the default does not suit.
pub const RUNTIME_DIR: &str = "CONICFLOW_RUNTIME_DIR";

/// Name of the plan's file, ...
pub(crate) const PLAN: &str = "plan.json";
/// ... and of the plan that was there before a change.
const PLAN_BEFORE: &str = "plan.json.kept";

/// Stages end by themselves within this time after their launcher was killed.
pub(crate) const LAST_STAGES_GRACE: Duration = Duration::from_secs(5);

/// Whoever only looks whether a run has the folder holds its lock for a moment; so long if held up in that moment.
const CHECK_GRACE: Duration = Duration::from_secs(5);

/// Why a run has no folder.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    /// The folder could not be made, read or written.
    #[error("{}: {error}\n  hint: {}", path.display(), hint_of(error))]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        error: io::Error,
    },
    /// The folder is another user's: what is written there would be in that one's way, and what is read could be anything.
    #[error(
        "`{}` belongs to another user\n  hint: do this as that user (`sudo -u '#{owner}' ...`), or set \
         CONICFLOW_RUNTIME_DIR to a folder of your own with mode 700", path.display()
    )]
    OfAnother {
        /// The folder.
        path: PathBuf,
        /// The number of its user.
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
    /// Stages of an earlier run, or stages that were started one by one, are still there.
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
        /// What this program was built with.
        own: u32,
        /// What the launcher was built with; 0 if it does not say.
        launcher: u32,
    },
    /// The plan of a run makes no sense.
    #[error("{}: {error}\n  hint: start the pipeline anew with `conicflow run`", path.display())]
    Plan {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
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

/// Held as long as a run lasts: no other of the same name can start.
#[derive(Debug)]
pub struct RunLock {
    file: Locked,
    plan: PathBuf,
}

impl RunLock {
    /// Whether the folder that it locks is there with the plan of its run: nobody but that run removes either.
    pub(crate) fn is_there(&self) -> bool {
        let is_linked = self.file.0.metadata().is_ok_and(|about| about.nlink() > 0);
        is_linked && self.plan.exists()
    }
}

/// What to do where the system refuses a file or a folder.
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
    /// What the system says of a file or folder.
    pub(crate) fn at(path: &Path) -> impl Fn(io::Error) -> Self {
        |error| Self::Io { path: path.to_owned(), error }
    }
}

impl RunFolder {
    /// The folder of the pipeline `name`, made if it is not there.
    ///
    /// # Errors
    /// It cannot be made, or is open to others.
    pub fn open(name: &str) -> Result<Self, FolderError> {
        let user = user_folder();
        private_folder(&user)?;
        let (path, shared_memory) = (user.join("run").join(name), user.join("shm"));
        private_folder(&path)?;
        private_folder(&shared_memory)?;
        Ok(Self { path, shared_memory })
    }

    /// The folders of all pipelines that were run, in the folder of their user ([`user_folder`]).
    ///
    /// # Errors
    /// The user's folder cannot be read, or is not this user's alone.
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

    /// The folder that iceoryx2 keeps its files in, shared by all pipelines of this user.
    pub fn shared_memory(&self) -> &Path {
        &self.shared_memory
    }

    /// The folder itself.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Makes it known to the other stages that one will not come back.
    pub(crate) fn set_life(&self, run: u64, stage: &str, life: Life) {
        if let Ok(mut record) = StatusFile::open(&self.status(stage), run) {
            record.status.set_life(life);
            record.write();
        }
    }

    /// The file of a stage's record.
    pub fn status(&self, stage: &str) -> PathBuf {
        status_path(&self.path, stage)
    }

    /// A stage's record, if it is of this run.
    pub(crate) fn record(&self, stage: &str, run: u64) -> Option<Status> {
        Status::read(&self.status(stage)).filter(|record| record.run == run)
    }

    /// Takes the folder for a run of `name`, as soon as the stages of an earlier run that was cut off are gone.
    ///
    /// # Errors
    /// Another run has it, or stages of another run stay.
    pub fn lock(&self, name: &str) -> Result<RunLock, FolderError> {
        self.lock_pausing(name, || sleep(Duration::from_millis(10)))
    }

    /// The same, with the pause after which it looks again whether others have let go of it.
    fn lock_pausing(&self, name: &str, mut pause: impl FnMut()) -> Result<RunLock, FolderError> {
        let (path, file) = self.open_lock("lock")?;
        let run = RunLock { file: Locked(file), plan: self.path.join(PLAN) };
        // Those who only look share it.
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

    /// Whether a run has the folder now.
    pub(crate) fn is_running(&self) -> bool {
        let file = File::open(self.path.join("lock"));
        file.is_ok_and(|file| matches!(file.try_lock_shared(), Err(TryLockError::WouldBlock)))
    }

    /// What cut a run off that left this folder behind: its plan, if that run neither lasts nor came to its end.
    pub(crate) fn cut_off(&self) -> Option<Plan> {
        let plan = self.plan().ok().filter(|_| !self.is_running())?;
        let mut records = plan.stages.iter().filter_map(|stage| self.record(&stage.name, plan.run));
        records.any(|record| matches!(record.life(), Life::Starting | Life::Running)).then_some(plan)
    }

    /// Says that a stage of this pipeline lives in this process, for as long as the file is held.
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

    /// Removes what earlier runs have left: from now on nobody takes their plan for that of the run that has the lock.
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

    /// Writes the plan of a run, by which others see that it runs: all that they may look into has to be there.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn begin(&self, plan: &Plan) -> Result<(), FolderError> {
        let path = self.path.join(PAUSE_FILE);
        PauseFile::create(&path, plan.run).map_err(FolderError::at(&path))?;
        self.write_whole(PLAN, plan)
    }

    /// The word by which the sources of a run are paused, where there is one.
    pub(crate) fn pause_file(&self, run: u64) -> Option<PauseFile> {
        PauseFile::open(&self.path.join(PAUSE_FILE), run).ok()
    }

    /// Notes that a run is over as its launcher saw it: what is left was not cut off, and nobody comes back for it. Where
    /// that cannot be written the next run sees to it.
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

    /// Removes what a run has left that is over; the locks stay.
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

    /// Writes another plan, and keeps the one that is there; where it cannot be written, that one stays.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub(crate) fn change_plan(&self, plan: &Plan) -> Result<(), FolderError> {
        let (path, before) = (self.path.join(PLAN), self.path.join(PLAN_BEFORE));
        fs::remove_file(&before).ok();
        fs::hard_link(&path, &before).map_err(FolderError::at(&before))?;
        self.write_whole(PLAN, plan)
    }

    /// Brings the plan from before the last change back, which takes no room on a disk.
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
    /// There is none, or it makes no sense.
    pub fn plan(&self) -> Result<Plan, FolderError> {
        self.read_plan(PLAN)
    }

    /// Reads the plan in a file of the folder.
    ///
    /// # Errors
    /// There is none, or it makes no sense.
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

/// The folder of this user in which all runs have theirs, whether it is there or not.
pub fn user_folder() -> PathBuf {
    let path_in = |variable: &str| std::env::var_os(variable).map(PathBuf::from);
    let path = user_folder_of(path_in(RUNTIME_DIR), path_in("XDG_RUNTIME_DIR"));
    std::path::absolute(&path).unwrap_or(path)
}

/// The user's folder: the one that was asked for, or one in that which the system has for this login, where there is one.
fn user_folder_of(wanted: Option<PathBuf>, of_login: Option<PathBuf>) -> PathBuf {
    if let Some(path) = wanted.filter(|path| !path.as_os_str().is_empty()) {
        return path;
    }
    match of_login {
        Some(path) if path.is_dir() => path.join("conicflow"),
        _ => PathBuf::from(format!("/tmp/conicflow-{}", rustix::process::getuid().as_raw())),
    }
}

/// Makes a folder that only this user can enter, and makes sure that it is one.
fn private_folder(path: &Path) -> Result<(), FolderError> {
    fs::DirBuilder::new().recursive(true).mode(0o700).create(path).map_err(FolderError::at(path))?;
    check_private(path)
}

/// Makes sure that only this user can enter a folder.
///
/// # Errors
/// It is not there, is no folder, or is open to others.
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

    /// The run's folder at this place.
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
