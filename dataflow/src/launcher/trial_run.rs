//! A run in its own folder without a launcher, for tests of the code that supervises its stages.

use super::child::RunState;
use super::folder::RunFolder;
use super::folder::tests::folder_at;
use super::options::RunOptions;
use super::phase::Phase;
use super::summary::tests::stage;
use crate::log::tests;
use crate::plan::{LAYOUT, Origin, Plan};
use crate::status::{Life, Status, StatusFile};
use conicflow_messages::Object;
use tempfile::TempDir;
use tracing::Level;

/// Run number 7.
pub struct TrialRun {
    pub files: TempDir,
    pub folder: RunFolder,
    pub plan: Plan,
    options: RunOptions,
}

impl TrialRun {
    pub fn new() -> Self {
        let files = tempfile::tempdir().unwrap();
        Self { folder: folder_at(files.path()), files, plan: plan_of(7), options: RunOptions::default() }
    }

    /// State of the run in this phase.
    pub fn state(&mut self, phase: Phase) -> RunState<'_> {
        let Self { folder, plan, options, .. } = self;
        RunState { plan, folder, options, phase, is_removed: false }
    }

    /// Writes a stage's record as a process of the stage would.
    pub fn write_record(&self, stage: &str, process: u32, life: Life) {
        change_record(&self.folder, stage, |status| {
            status.process = process;
            status.set_life(life);
        });
    }
}

/// The plan of a run of one stage.
pub fn plan_of(run: u64) -> Plan {
    let (pipeline, base, stages) = ("test".to_owned(), "/".into(), vec![stage::<Object>()]);
    Plan { layout: LAYOUT, pipeline, base, run, stages, origin: Origin::default() }
}

/// Changes the record of a stage in run 7.
pub fn change_record(folder: &RunFolder, stage: &str, change: impl FnOnce(&mut Status)) {
    let mut record = StatusFile::open(&folder.status(stage), 7).unwrap();
    change(&mut record.status);
    record.write();
}

/// Runs `act` and returns what this thread logs meanwhile.
pub fn logged(act: impl FnOnce()) -> String {
    tests::logged(Level::INFO, act)
}
