//! State of the other stages of a run, as one stage can see it.

use crate::pipeline::BRIDGE;
use crate::status::{Life, NO_RUN, Status, status_path};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::{fs, io};

/// Suffix of the file that records the end of a stream from another machine.
pub(crate) const END: &str = "end";

/// The other stages of a run, read from the records in its folder.
#[derive(Clone, Debug, Default)]
pub struct Peers {
    run: Option<(PathBuf, u64)>,
    /// Names of the stages of this machine.
    here: Arc<BTreeSet<String>>,
    /// States in a model of a run, in place of records.
    #[cfg(test)]
    modelled: Option<fn(&str) -> Option<Life>>,
}

impl Peers {
    /// The stages of the run `run` with records in `folder`; those in `here` are on this machine. Without a run (stages started
    /// one by one) nothing is known of other stages.
    pub fn in_folder(folder: PathBuf, run: u64, here: BTreeSet<String>) -> Self {
        Self {
            run: (run != NO_RUN).then_some((folder, run)),
            here: Arc::new(here),
            #[cfg(test)]
            modelled: None,
        }
    }

    #[cfg(test)]
    pub(super) fn modelled(life: fn(&str) -> Option<Life>) -> Self {
        Self { modelled: Some(life), ..Self::default() }
    }

    /// Whether no more messages can come from a stage: it has ended, or is gone for good. For a stage of another machine: its
    /// stream has ended ([`Peers::note_end`]), or the bridge to it.
    pub fn is_over(&self, stage: &str) -> bool {
        let elsewhere = self.run.as_ref().filter(|_| !self.here.contains(stage));
        let Some((folder, run)) = elsewhere else { return self.life(stage).is_some_and(Life::is_over) };
        let noted = fs::read_to_string(end_path(folder, stage)).ok();
        noted.is_some_and(|of_run| of_run == run.to_string()) || self.life(BRIDGE).is_some_and(Life::is_over)
    }

    /// Records that the stream of a stage of another machine has ended, for readers that come after its end was sent.
    ///
    /// # Errors
    /// The run's folder cannot be written.
    pub fn note_end(&self, stage: &str) -> io::Result<()> {
        let Some((folder, run)) = &self.run else { return Ok(()) };
        fs::write(end_path(folder, stage), run.to_string())
    }

    /// State of a stage of this machine; `None` if unknown.
    pub fn life(&self, stage: &str) -> Option<Life> {
        #[cfg(test)]
        if let Some(life) = self.modelled {
            return life(stage);
        }
        let (folder, run) = self.run.as_ref()?;
        let status = Status::read(&status_path(folder, stage))?;
        (status.run == *run).then(|| status.life())
    }
}

/// Path of the file that records the end of a stream from another machine; its content is the run.
fn end_path(folder: &Path, stage: &str) -> PathBuf {
    folder.join(format!("{stage}.{END}"))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::status::StatusFile;

    #[test]
    fn of_a_stage_of_another_machine_nothing_more_comes_when_the_bridge_is_over() {
        let folder = tempfile::tempdir().unwrap();
        let here = Arc::new(["sink", "late", BRIDGE].map(str::to_owned).into());
        let peers = Peers { run: Some((folder.path().to_owned(), 7)), here, ..Peers::default() };
        let set_life = |stage: &str, life| {
            let mut record = StatusFile::open(&status_path(folder.path(), stage), 7).unwrap();
            record.status.set_life(life);
            record.write();
        };
        set_life("sink", Life::Ended);
        set_life(BRIDGE, Life::Running);
        let over = || ["sink", "late", "camera"].map(|stage| peers.is_over(stage));
        assert_eq!(over(), [true, false, false]);
        set_life(BRIDGE, Life::Ended);
        assert_eq!(over(), [true, false, true], "the one that has not begun is of this machine");
        assert!(!Peers::default().is_over("camera"), "nothing is known");
    }

    #[test]
    fn of_a_stage_of_another_machine_nothing_more_comes_when_its_stream_has_ended_in_this_run() {
        let folder = tempfile::tempdir().unwrap();
        let of_run = |run| Peers::in_folder(folder.path().to_owned(), run, ["sink".to_owned()].into());
        let over = |run| ["camera", "lidar", "sink"].map(|stage| of_run(run).is_over(stage));
        assert_eq!(over(7), [false; 3]);
        of_run(7).note_end("camera").unwrap();
        assert_eq!([over(7), over(70)], [[true, false, false], [false; 3]]);
        let nowhere = Peers::in_folder("/nowhere".into(), 7, BTreeSet::new());
        assert!(nowhere.note_end("camera").is_err() && Peers::default().note_end("camera").is_ok());
    }
}
