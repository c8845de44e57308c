//! Watches topics of a running pipeline from outside: every message that comes, checked, until the run is over.
//!
//! A watcher sleeps between looks instead of being woken, so that a writer does nothing for it but pass it a pointer.

use crate::item_type::{AnyMessage, ItemType};
use crate::launcher::{FolderError, RunFolder, SwapError};
use crate::log::ThrottledWarning;
use crate::plan::Plan;
use crate::ports::shared_memory::{SharedMemory, SharedOnlooker};
use crate::ports::{PortError, Received, Topic};
use crate::stage::Stop;
use signal_hook::consts::{SIGHUP, SIGINT, SIGTERM};
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

/// Shorter than a writer that runs flat out takes to fill the queue of an ordinary topic is not worth the processor time.
const LOOK: Duration = Duration::from_millis(1);
/// How often a watcher without messages looks whether the run still goes on.
const RUN_CHECK: Duration = Duration::from_millis(100);

/// A pipeline that runs now.
pub struct RunningPipeline {
    /// What its stages know of it.
    pub plan: Plan,
    folder: RunFolder,
}

/// Why a topic could not be watched.
#[derive(Debug, thiserror::Error)]
pub enum WatchError {
    /// The run's folder.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// The shared memory.
    #[error(transparent)]
    Port(#[from] PortError),
    /// Signals.
    #[error("signals cannot be received: {0}")]
    Signals(#[from] io::Error),
}

/// Whether a watcher wants more.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Watching {
    /// It does.
    GoOn,
    /// It has seen enough.
    Enough,
}

impl RunningPipeline {
    /// All pipelines of this user that run now.
    ///
    /// # Errors
    /// The user's folder cannot be read.
    pub fn all() -> Result<Vec<Self>, FolderError> {
        let running = RunFolder::all()?.into_iter().filter(RunFolder::is_running);
        Ok(running.filter_map(|folder| Some(Self { plan: folder.plan().ok()?, folder })).collect())
    }

    /// What both ends of a topic agreed on, if a stage writes or reads one of this name.
    pub fn topic(&self, name: &str) -> Option<&Topic> {
        self.topics().find(|topic| topic.name == name)
    }

    /// All topics, once for each stage that writes or reads one.
    pub fn topics(&self) -> impl Iterator<Item = &Topic> {
        self.plan.topics()
    }

    /// Calls `see` with each message of these topics, which have these items, from now on, until it has seen enough, the run is
    /// over, or this process is told to end. Messages that make no sense are left out, with a warning.
    ///
    /// # Errors
    /// A topic cannot be read, or `see` failed.
    pub fn watch<'a, E: From<WatchError>>(
        &self,
        topics: &[(&'a ItemType, &'a Topic)],
        see: impl FnMut(&'a Topic, AnyMessage<'_>) -> Result<Watching, E>,
    ) -> Result<(), E> {
        self.watch_while(topics, || Watching::GoOn, see)
    }

    /// The same, where the watcher is asked from time to time, also when no message comes, whether it wants more.
    ///
    /// # Errors
    /// A topic cannot be read, or `see` failed.
    pub fn watch_while<'a, E: From<WatchError>>(
        &self,
        topics: &[(&'a ItemType, &'a Topic)],
        mut wants: impl FnMut() -> Watching,
        mut see: impl FnMut(&'a Topic, AnyMessage<'_>) -> Result<Watching, E>,
    ) -> Result<(), E> {
        let told = told_to_end().map_err(WatchError::from)?;
        let (memory, mut onlookers) = self.onlookers(topics)?;
        let (mut checked, mut nonsense) = (Instant::now(), ThrottledWarning::default());
        while !told.load(Ordering::Relaxed) {
            let check = checked.elapsed() > RUN_CHECK;
            // The run is looked at first: what was sent before it was over is then sure to be found.
            let over = check && !self.still_runs();
            let mut is_idle = true;
            for ((item, topic), onlooker) in topics.iter().zip(&mut onlookers) {
                let Some(received) = onlooker.receive(&memory).map_err(WatchError::from)? else { continue };
                is_idle = false;
                let message = AnyMessage { header: received.header(), item, bytes: received.bytes() };
                if is_sound(topic, &message, &mut nonsense) && see(topic, message)? == Watching::Enough {
                    return Ok(());
                }
            }
            match is_idle {
                true if over => return Ok(()),
                true => sleep(LOOK),
                false => {}
            }
            if check {
                if wants() == Watching::Enough {
                    return Ok(());
                }
                checked = Instant::now();
            }
        }
        Ok(())
    }

    fn onlookers(&self, topics: &[(&ItemType, &Topic)]) -> Result<(SharedMemory, Vec<SharedOnlooker>), WatchError> {
        let memory =
            SharedMemory::open(self.folder.shared_memory(), &self.plan.namespace(), "(onlooker)", Stop::default())?;
        let onlookers = topics.iter().map(|(item, topic)| memory.onlooker(item, topic)).collect::<Result<_, _>>()?;
        Ok((memory, onlookers))
    }

    /// Replaces `stage` by what stands in `plan`, which differs from the plan of this run in nothing else.
    ///
    /// # Errors
    /// Why it was not; the stage that was to be replaced is at work then.
    pub fn swap(&self, stage: &str, plan: Plan) -> Result<(), SwapError> {
        self.folder.ask_for_swap(stage, plan)
    }

    /// Whether this run has not ended yet.
    pub fn still_runs(&self) -> bool {
        self.folder.is_running() && self.folder.plan().is_ok_and(|plan| plan.run == self.plan.run)
    }
}

/// Raised by the signals that end a program, so that this one can leave its place in order.
fn told_to_end() -> io::Result<Arc<AtomicBool>> {
    let told = Arc::new(AtomicBool::new(false));
    for signal in [SIGINT, SIGTERM, SIGHUP] {
        signal_hook::flag::register(signal, Arc::clone(&told))?;
    }
    Ok(told)
}

/// Whether a message is to be seen: it makes sense, and is not the end of a stream.
fn is_sound(topic: &Topic, message: &AnyMessage<'_>, nonsense: &mut ThrottledWarning) -> bool {
    if message.header.ends_stream() {
        return false;
    }
    let checked = message.item.check(message.header, message.bytes);
    if let Err(error) = &checked {
        nonsense.warn(format_args!("left out a message of topic `{}`: {error}", topic.name));
    }
    checked.is_ok()
}
