//! Requests for swaps: a request in the run's folder, which only this user can enter, and the launcher's answer there.
//!
//! The requester writes `swap.request` atomically, and holds `swap.lock` until it has read `swap.answer`. The launcher checks for
//! a request as often as it checks its stages.

use super::folder::{FolderError, RunFolder};
use crate::plan::Plan;
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use std::fs::{self, File};
use std::thread::sleep;
use std::time::Duration;

const ANSWER_CHECK_PERIOD: Duration = Duration::from_millis(10);

/// Reason why a stage was not replaced; the old one then works on.
#[derive(Debug, thiserror::Error)]
pub enum SwapError {
    /// The run's folder cannot be used.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// Another swap is under way.
    #[error("another swap is under way in this pipeline\n  hint: wait until it is done")]
    Busy,
    /// The run ended meanwhile.
    #[error("the run ended before the stage was replaced\n  hint: start the pipeline anew with `conicflow run`")]
    Over,
    /// The launcher refused the swap, or it failed.
    #[error("{0}")]
    Refused(String),
}

/// A request for a swap.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(crate) struct Request {
    pub(crate) id: u64,
    /// Name of the stage.
    pub(crate) stage: String,
    /// The plan of the run after the swap.
    pub(crate) plan: Plan,
}

/// Result of a swap.
#[derive(Debug, Serialize, Deserialize)]
struct Answer {
    id: u64,
    fault: Option<String>,
}

impl RunFolder {
    /// Asks the launcher of this run to replace `stage` by its version in `plan`, and waits for the result.
    pub(crate) fn ask_for_swap(&self, stage: &str, plan: Plan) -> Result<(), SwapError> {
        let path = self.path().join("swap.lock");
        let lock = File::create(&path).map_err(FolderError::at(&path))?;
        lock.try_lock().map_err(|_| SwapError::Busy)?;
        let id = crate::clock::monotonic_ns();
        self.write_whole("swap.request", &Request { id, stage: stage.to_owned(), plan })?;
        loop {
            let over = !self.is_running();
            match self.read_json::<Answer>("swap.answer").filter(|answer| answer.id == id) {
                Some(Answer { fault: None, .. }) => return Ok(()),
                Some(Answer { fault: Some(fault), .. }) => return Err(SwapError::Refused(fault)),
                None if over => return Err(SwapError::Over),
                None => sleep(ANSWER_CHECK_PERIOD),
            }
        }
    }

    /// Takes a request that was not taken yet.
    pub(crate) fn take_request(&self) -> Option<Request> {
        let request = self.read_json("swap.request")?;
        fs::remove_file(self.path().join("swap.request")).ok();
        Some(request)
    }

    /// Writes the result of the request `id`.
    pub(crate) fn answer(&self, id: u64, outcome: &Result<(), String>) -> Result<(), FolderError> {
        self.write_whole("swap.answer", &Answer { id, fault: outcome.as_ref().err().cloned() })
    }

    fn read_json<T: DeserializeOwned>(&self, name: &str) -> Option<T> {
        serde_json::from_slice(&fs::read(self.path().join(name)).ok()?).ok()
    }

    /// Writes a file atomically: a reader sees its old or its new content, never a part.
    pub(crate) fn write_whole(&self, name: &str, content: &impl Serialize) -> Result<(), FolderError> {
        let (path, draft) = (self.path().join(name), self.path().join(format!("{name}.new")));
        let text =
            serde_json::to_vec_pretty(content).map_err(|error| FolderError::Plan { path: path.clone(), error })?;
        let written = fs::write(&draft, text).and_then(|()| fs::rename(&draft, &path));
        written.inspect_err(|_| drop(fs::remove_file(&draft))).map_err(FolderError::at(&path))
    }
}

#[cfg(test)]
mod tests {
    use super::super::folder::tests::folder_at;
    use super::super::trial_run::plan_of;
    use super::*;
    use std::time::Instant;

    #[test]
    fn what_cannot_be_written_leaves_no_part_of_it() {
        let files = tempfile::tempdir().unwrap();
        let (folder, path) = (folder_at(files.path()), files.path().join("swap.request"));
        fs::create_dir(&path).unwrap();
        assert!(matches!(folder.write_whole("swap.request", &1), Err(FolderError::Io { .. })));
        let left: Vec<_> = fs::read_dir(files.path()).unwrap().map(|entry| entry.unwrap().path()).collect();
        assert_eq!(left, [path]);
    }

    #[test]
    fn who_asks_for_a_swap_is_told_what_became_of_it() {
        let files = tempfile::tempdir().unwrap();
        let folder = folder_at(files.path());
        let ask = || folder.ask_for_swap("tracker", plan_of(7));
        assert!(matches!(ask(), Err(SwapError::Over)), "nobody runs");
        folder.take_request().unwrap();
        let _run = folder.lock("test").unwrap();
        // Processes that other tests fork hold a copy of the lock until they exec.
        let is_early = |begin: Instant| begin.elapsed() < Duration::from_secs(20);
        let ask_in_turn = |begin: Instant| loop {
            match ask() {
                Err(SwapError::Busy) if is_early(begin) => std::thread::yield_now(),
                told => break told,
            }
        };
        let answered = |outcome: Result<(), String>| {
            std::thread::scope(|scope| {
                let begin = Instant::now();
                let asks = scope.spawn(move || ask_in_turn(begin));
                let request = loop {
                    assert!(is_early(begin), "nobody asks");
                    if let Some(request) = folder.take_request() {
                        break request;
                    }
                };
                assert_eq!((&*request.stage, request.plan.run), ("tracker", 7));
                folder.answer(request.id.wrapping_add(1), &Err("another one's".to_owned())).unwrap();
                assert!(matches!(ask(), Err(SwapError::Busy)), "one at a time");
                folder.answer(request.id, &outcome).unwrap();
                asks.join().unwrap()
            })
        };
        answered(Ok(())).unwrap();
        let refused = answered(Err("it is not at work".to_owned()));
        assert!(matches!(&refused, Err(SwapError::Refused(why)) if why == "it is not at work"), "{refused:?}");
    }
}
