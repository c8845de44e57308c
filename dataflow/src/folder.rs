//! Where a run keeps its files: one folder per user, in it one per pipeline, and beside them the files of shared memory.

use crate::peers::status_path;
use crate::plan::Plan;
use std::fs::{self, File, TryLockError};
use std::io;
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

/// Environment variable: the user's folder, where the default does not suit.
pub const RUNTIME_DIR: &str = "CONICFLOW_RUNTIME_DIR";

/// Why a run has no folder.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    /// The folder could not be made, read or written.
    #[error("{}: {error}\n  hint: set CONICFLOW_RUNTIME_DIR to a short path that this user may write to", path.display())]
    Io {
        /// The file or folder.
        path: PathBuf,
        /// What the system said.
        error: io::Error,
    },
    /// The folder is open to others.
    #[error(
        "`{}` belongs to another user or is open to others\n  \
         hint: remove it, or set CONICFLOW_RUNTIME_DIR to a folder of your own with mode 700", path.display()
    )]
    NotPrivate {
        /// The folder.
        path: PathBuf,
    },
    /// A pipeline of this name runs already.
    #[error(
        "a pipeline named `{name}` is running already on this machine\n  \
         hint: end it first, or give this one another `name` in its file"
    )]
    Running {
        /// Its name.
        name: String,
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

/// The folder of one pipeline's run.
#[derive(Clone, Debug)]
pub struct RunFolder {
    path: PathBuf,
    shared_memory: PathBuf,
}

/// Held as long as a run lasts: no other of the same name can start.
#[derive(Debug)]
pub struct RunLock {
    _file: File,
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

    /// The folder that iceoryx2 keeps its files in, shared by all pipelines of this user.
    pub fn shared_memory(&self) -> &Path {
        &self.shared_memory
    }

    /// The folder itself.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The file of a stage's record.
    pub fn status(&self, stage: &str) -> PathBuf {
        status_path(&self.path, stage)
    }

    /// Takes the folder for a run of `name`.
    ///
    /// # Errors
    /// Another run has it.
    pub fn lock(&self, name: &str) -> Result<RunLock, FolderError> {
        let path = self.path.join("lock");
        let file = File::create(&path).map_err(|error| FolderError::Io { path: path.clone(), error })?;
        match file.try_lock() {
            Ok(()) => Ok(RunLock { _file: file }),
            Err(TryLockError::WouldBlock) => Err(FolderError::Running { name: name.to_owned() }),
            Err(TryLockError::Error(error)) => Err(FolderError::Io { path, error }),
        }
    }

    /// Writes the plan of a run and removes the records of earlier ones.
    ///
    /// # Errors
    /// The folder cannot be written.
    pub fn begin(&self, plan: &Plan) -> Result<(), FolderError> {
        let fault = |error| FolderError::Io { path: self.path.clone(), error };
        for entry in fs::read_dir(&self.path).map_err(fault)?.flatten() {
            if entry.path().extension().is_some_and(|extension| extension == "status") {
                fs::remove_file(entry.path()).map_err(fault)?;
            }
        }
        let path = self.plan_path();
        let text = serde_json::to_vec_pretty(plan).map_err(|error| FolderError::Plan { path: path.clone(), error })?;
        fs::write(&path, text).map_err(|error| FolderError::Io { path, error })
    }

    /// Reads the plan of the run.
    ///
    /// # Errors
    /// There is none, or it makes no sense.
    pub fn plan(&self) -> Result<Plan, FolderError> {
        let path = self.plan_path();
        let text = fs::read(&path).map_err(|error| FolderError::Io { path: path.clone(), error })?;
        serde_json::from_slice(&text).map_err(|error| FolderError::Plan { path, error })
    }

    fn plan_path(&self) -> PathBuf {
        self.path.join("plan.json")
    }
}

fn user_folder() -> PathBuf {
    if let Some(path) = std::env::var_os(RUNTIME_DIR) {
        return path.into();
    }
    match std::env::var_os("XDG_RUNTIME_DIR") {
        Some(path) if Path::new(&path).is_dir() => Path::new(&path).join("conicflow"),
        _ => PathBuf::from(format!("/tmp/conicflow-{}", rustix::process::getuid().as_raw())),
    }
}

/// Makes a folder that only this user can enter, and makes sure that it is one.
fn private_folder(path: &Path) -> Result<(), FolderError> {
    let fault = |error| FolderError::Io { path: path.to_owned(), error };
    fs::DirBuilder::new().recursive(true).mode(0o700).create(path).map_err(fault)?;
    let data = fs::metadata(path).map_err(fault)?;
    let own = data.uid() == rustix::process::getuid().as_raw();
    if own && data.permissions().mode() & 0o077 == 0 {
        Ok(())
    } else {
        Err(FolderError::NotPrivate { path: path.to_owned() })
    }
}
