//! Pauses the sources of a run by a file in the run's folder. Any process that may enter that folder can change the file, and
//! each source reads it before each message.
//!
//! A recording or a simulation can be paused; a camera cannot. Other stages go on, and process the messages in flight.

use bytemuck::{Pod, Zeroable};
use serde::Serialize;
use std::fs::{File, OpenOptions};
use std::io;
use std::os::unix::fs::FileExt;
use std::path::Path;

/// Name of the file in the folder of a run.
pub(crate) const PAUSE_FILE: &str = "run.pause";

/// Request to the sources of a run.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum PauseRequest {
    /// Pause.
    Pause,
    /// Resume.
    Resume,
    /// Pause if running, else resume.
    Toggle,
    /// Make one more message each, then pause.
    Step,
}

/// The sources of a run on this machine.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Sources {
    /// Sources that can be paused.
    pub can_pause: Vec<String>,
    /// Live sources, such as cameras, which cannot be paused.
    pub live: Vec<String>,
    /// Whether those that can be paused are paused.
    pub paused: bool,
}

/// Content of the file.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, Pod, Zeroable)]
struct Word {
    /// The run that it applies to.
    run: u64,
    /// Not 0 while the sources are paused.
    is_paused: u64,
    /// Total number of messages that each source may make while it is paused.
    steps: u64,
}

/// The pause file of one run.
#[derive(Debug)]
pub(crate) struct PauseFile {
    file: File,
    run: u64,
}

impl PauseFile {
    /// Creates the file at the start of a run, not paused.
    pub(crate) fn create(path: &Path, run: u64) -> io::Result<()> {
        std::fs::write(path, bytemuck::bytes_of(&Word { run, ..Word::default() }))
    }

    /// Opens the file of a run that has begun.
    pub(crate) fn open(path: &Path, run: u64) -> io::Result<Self> {
        Ok(Self { file: OpenOptions::new().read(true).write(true).open(path)?, run })
    }

    /// Reads the file; `None` if it belongs to another run.
    fn read(&self) -> Option<Word> {
        let mut word = Word::default();
        self.file.read_exact_at(bytemuck::bytes_of_mut(&mut word), 0).ok()?;
        (word.run == self.run).then_some(word)
    }

    /// Whether the sources of this run are to pause.
    pub(crate) fn is_paused(&self) -> bool {
        self.read().is_some_and(|word| word.is_paused != 0)
    }

    /// Changes the file as requested. A lock serialises concurrent requests.
    pub(crate) fn change(&self, request: PauseRequest) -> io::Result<()> {
        self.file.lock()?;
        let word = self.read().unwrap_or(Word { run: self.run, ..Word::default() });
        let is_paused = match request {
            PauseRequest::Pause | PauseRequest::Step => true,
            PauseRequest::Resume => false,
            PauseRequest::Toggle => word.is_paused == 0,
        };
        let steps = word.steps + u64::from(request == PauseRequest::Step);
        let word = Word { is_paused: u64::from(is_paused), steps, ..word };
        let written = self.file.write_all_at(bytemuck::bytes_of(&word), 0);
        self.file.unlock()?;
        written
    }
}

/// Next action of a source.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Turn {
    /// Go on at its pace.
    Go,
    /// Make one message, and check again.
    Step,
    /// Stay paused.
    Stand,
}

/// Pause state of one source.
#[derive(Debug, Default)]
pub(crate) struct Pause {
    /// `None` where it cannot be paused.
    file: Option<PauseFile>,
    /// Number of steps that it has made, or that were requested before it was paused.
    steps: u64,
}

impl Pause {
    /// Pause state of a source that follows this file.
    pub(crate) fn obey(file: Option<PauseFile>) -> Self {
        let steps = file.as_ref().and_then(PauseFile::read).map_or(0, |word| word.steps);
        Self { file, steps }
    }

    /// Next action of the source.
    pub(crate) fn turn(&mut self) -> Turn {
        match self.file.as_ref().and_then(PauseFile::read) {
            Some(word) if word.is_paused != 0 && word.steps > self.steps => {
                self.steps += 1;
                Turn::Step
            }
            Some(word) if word.is_paused != 0 => Turn::Stand,
            Some(word) => {
                self.steps = word.steps;
                Turn::Go
            }
            None => Turn::Go,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use PauseRequest::{Pause as Stop, Resume, Step, Toggle};

    #[test]
    fn a_source_stands_still_steps_and_goes_on_as_is_asked() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(PAUSE_FILE);
        PauseFile::create(&path, 7).unwrap();
        let word = PauseFile::open(&path, 7).unwrap();
        let mut pause = Pause::obey(PauseFile::open(&path, 7).ok());
        let mut turns = |requests: &[PauseRequest]| {
            requests.iter().for_each(|request| word.change(*request).unwrap());
            [pause.turn(), pause.turn(), pause.turn()]
        };
        assert_eq!(turns(&[]), [Turn::Go; 3]);
        assert_eq!(turns(&[Stop]), [Turn::Stand; 3]);
        assert_eq!(turns(&[Step, Step]), [Turn::Step, Turn::Step, Turn::Stand]);
        assert_eq!(turns(&[Step, Resume]), [Turn::Go; 3], "a step that was not made is not made later");
        assert_eq!(turns(&[Toggle]), [Turn::Stand; 3]);
        assert_eq!(
            turns(&[Toggle, Step]),
            [Turn::Step, Turn::Stand, Turn::Stand],
            "a step of a run that goes on pauses it"
        );
        let mut anew = Pause::obey(PauseFile::open(&path, 7).ok());
        assert_eq!(anew.turn(), Turn::Stand, "a source that is started anew has made the steps before it");
    }

    #[test]
    fn the_word_of_another_run_is_not_obeyed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(PAUSE_FILE);
        PauseFile::create(&path, 7).unwrap();
        let (former, own) = (PauseFile::open(&path, 7).unwrap(), PauseFile::open(&path, 8).unwrap());
        former.change(Stop).unwrap();
        assert!(former.is_paused() && !own.is_paused());
        assert_eq!(Pause::obey(Some(own)).turn(), Turn::Go);
        assert_eq!(Pause::default().turn(), Turn::Go);
    }

    #[test]
    fn no_step_is_lost_of_many_who_ask_at_the_same_time() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join(PAUSE_FILE);
        PauseFile::create(&path, 7).unwrap();
        std::thread::scope(|scope| {
            for _ in 0..4 {
                let own = PauseFile::open(&path, 7).unwrap();
                scope.spawn(move || (0..50).for_each(|_| own.change(Step).unwrap()));
            }
        });
        assert_eq!(PauseFile::open(&path, 7).unwrap().read().unwrap().steps, 200);
    }
}
