//! What a stage can know of the other stages of its run: whether they still live.

use crate::status::{Life, NO_RUN, Status, status_path};
use std::path::PathBuf;

/// The other stages of a run, by the records in its folder.
#[derive(Clone, Debug, Default)]
pub struct Peers {
    run: Option<(PathBuf, u64)>,
    /// What a model of a run knows in place of records.
    #[cfg(test)]
    modelled: Option<fn(&str) -> Option<Life>>,
}

impl Peers {
    /// The stages of the run `run` whose records lie in `folder`; of stages that were started one by one nothing is known.
    pub(crate) fn in_folder(folder: PathBuf, run: u64) -> Self {
        Self {
            run: (run != NO_RUN).then_some((folder, run)),
            #[cfg(test)]
            modelled: None,
        }
    }

    #[cfg(test)]
    pub(super) fn modelled(life: fn(&str) -> Option<Life>) -> Self {
        Self { modelled: Some(life), ..Self::default() }
    }

    /// Where a stage is in its life; `None` if nothing is known of it.
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
