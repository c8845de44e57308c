//! Watches topics of a running pipeline from outside: delivers every message, checked, until the run is over.
//!
//! A watcher polls instead of being woken, so that a writer does nothing for it but pass a pointer.

use crate::hangup::ending_signals;
use crate::item_type::{AnyMessage, ItemType};
use crate::launcher::{FolderError, RunFolder, SwapError, user_folder};
use crate::log::ThrottledWarning;
use crate::pause::{PauseRequest, Sources};
use crate::pipeline::suggestion;
use crate::plan::Plan;
use crate::ports::shared_memory::{SharedMemory, SharedMessage, SharedOnlooker};
use crate::ports::{Polled, PortError, Received, Topic};
use crate::status::{Life, Pausing};
use crate::stop::Stop;
use conicflow_messages::Hinted;
use std::io;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::sleep;
use std::time::{Duration, Instant};

/// Poll period. A writer at full speed takes longer to fill the queue of an ordinary topic; a shorter period would waste CPU
/// time.
const POLL_PERIOD: Duration = Duration::from_millis(1);
/// Period at which a watcher without messages checks whether the run still goes on.
const RUN_CHECK_PERIOD: Duration = Duration::from_millis(100);

/// A running pipeline.
pub struct RunningPipeline {
    /// Plan of the run.
    pub plan: Plan,
    folder: RunFolder,
}

/// Reason why a topic could not be watched.
#[derive(Debug, thiserror::Error)]
pub enum WatchError {
    /// The pipeline or topic is ambiguous or missing, or does not allow the operation.
    #[error(transparent)]
    Unclear(Hinted),
    /// The run's folder cannot be used.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// The shared memory cannot be used.
    #[error(transparent)]
    Port(#[from] PortError),
    /// Signals cannot be received.
    #[error("signals cannot be received: {0}")]
    Signals(#[from] io::Error),
}

/// Reads topics of a running pipeline as an onlooker.
pub struct Watcher {
    topics: Vec<(ItemType, String, SharedOnlooker)>,
    order: Order<SharedMessage>,
    memory: SharedMemory,
    /// Forced when the run is over: the last process to leave then waits for killed ones, and cleans up.
    stop: Stop,
    folder: RunFolder,
    run: u64,
    checked: Instant,
    nonsense: ThrottledWarning,
}

impl Watcher {
    /// Starts to read these topics, which have these item types. A topic has to come after the topics from which it is computed.
    ///
    /// # Errors
    /// A topic cannot be read.
    pub fn new(running: &RunningPipeline, topics: &[(&ItemType, &Topic)]) -> Result<Self, WatchError> {
        let (folder, run) = (running.folder.clone(), running.plan.run);
        let (stop, shared) = (Stop::default(), folder.shared_memory());
        let memory = SharedMemory::open(shared, &running.plan.namespace(), "(onlooker)", stop.clone())?;
        let onlooker = |(item, topic): &(&ItemType, &Topic)| {
            Ok::<_, PortError>(((*item).clone(), topic.name.clone(), memory.onlooker(item, topic)?))
        };
        let order = Order::new(topics.iter().map(|(_, topic)| topic.longest_queue()).collect());
        let topics = topics.iter().map(onlooker).collect::<Result<_, _>>()?;
        let (checked, nonsense) = (Instant::now(), ThrottledWarning::default());
        Ok(Self { topics, order, memory, stop, folder, run, checked, nonsense })
    }

    /// Returns the next message, checked, with the index of its topic in the list given to [`Watcher::new`]. Malformed messages
    /// are skipped with a warning. `Pending`: poll again after a millisecond. `Over`: the run has ended.
    ///
    /// # Errors
    /// A topic cannot be read.
    pub fn poll(&mut self) -> Result<Polled<(usize, SharedMessage)>, WatchError> {
        let check = self.checked.elapsed() > RUN_CHECK_PERIOD;
        if check {
            self.checked = Instant::now();
        }
        // The run is checked first: all messages that were sent before it was over are then found.
        let over = check && !still_runs(&self.folder, self.run);
        let Self { topics, order, memory, nonsense, .. } = self;
        let found = order.next(|index| {
            let (item, topic, onlooker) = &mut topics[index];
            while let Some(received) = onlooker.receive(memory)? {
                if is_sound(topic, item, &received, nonsense) {
                    return Ok(Some(received));
                }
            }
            Ok::<_, PortError>(None)
        })?;
        if let Some((index, received)) = found {
            return Ok(Polled::Message((index, received)));
        }
        if over {
            self.stop.force();
        }
        Ok(if over { Polled::Over } else { Polled::Pending })
    }
}

/// Order in which topics are polled: in turn, but a message is returned after the messages from which it was computed.
struct Order<M> {
    /// Queue length of each topic.
    queues: Vec<usize>,
    /// Index of the next topic to poll.
    next: usize,
    held: Option<Held<M>>,
}

/// A message that is held back. Those from which it was computed have been sent, but perhaps only after their topics were polled:
/// these are polled once more before it is returned.
struct Held<M> {
    index: usize,
    message: M,
    /// Maximum number of messages that those topics may still hold.
    in_front: usize,
}

impl<M> Order<M> {
    fn new(queues: Vec<usize>) -> Self {
        Self { queues, next: 0, held: None }
    }

    /// Returns the next message and the index of its topic; `receive` takes the oldest message of a topic.
    fn next<E>(&mut self, mut receive: impl FnMut(usize) -> Result<Option<M>, E>) -> Result<Option<(usize, M)>, E> {
        let (number, turn) = (self.queues.len(), self.next);
        for index in (0..number).map(|offset| (turn + offset) % number) {
            if self.held.is_some() {
                break;
            }
            if let Some(message) = receive(index)? {
                let in_front = self.queues[..index].iter().sum();
                (self.held, self.next) = (Some(Held { index, message, in_front }), (index + 1) % number);
            }
        }
        let Some(held) = &mut self.held else { return Ok(None) };
        for index in (0..held.index).filter(|_| held.in_front > 0) {
            if let Some(message) = receive(index)? {
                held.in_front -= 1;
                return Ok(Some((index, message)));
            }
        }
        Ok(self.held.take().map(|held| (held.index, held.message)))
    }
}

fn still_runs(folder: &RunFolder, run: u64) -> bool {
    folder.is_running() && folder.plan().is_ok_and(|plan| plan.run == run)
}

/// Whether a watcher wants more messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Watching {
    /// Yes.
    GoOn,
    /// No.
    Enough,
}

impl RunningPipeline {
    /// All pipelines of this user that run now.
    ///
    /// # Errors
    /// The user's folder cannot be read.
    pub fn all() -> Result<Vec<Self>, FolderError> {
        let running = RunFolder::all(&user_folder())?.into_iter().filter(RunFolder::is_running);
        Ok(running.filter_map(|folder| Some(Self { plan: folder.plan().ok()?, folder })).collect())
    }

    /// The pipeline of this name, or the only one that runs; `how` is the error's hint on how to name one.
    ///
    /// # Errors
    /// There is none, or there are several.
    pub fn find(name: Option<&str>, how: &str) -> Result<Self, WatchError> {
        let mut running = Self::all()?;
        let names: Vec<_> = running.iter().map(|running| running.plan.pipeline.clone()).collect();
        let unclear = |what: String, hint: String| WatchError::Unclear(Hinted::new(what, hint));
        if names.is_empty() {
            let what = format!("no pipeline runs that has its files in `{}`", user_folder().display());
            let hint = "start one with `conicflow run`, or set CONICFLOW_RUNTIME_DIR as it is where one runs";
            return Err(unclear(what, hint.to_owned()));
        }
        let Some(name) = name else {
            if names.len() > 1 {
                let what = format!("several pipelines run: {}", names.join(", "));
                return Err(unclear(what, format!("say which, with {how}")));
            }
            return Ok(running.swap_remove(0));
        };
        let found = names.iter().position(|running| running == name).ok_or_else(|| {
            let hint = suggestion(name, names.iter().map(String::as_str), "pipelines that run");
            unclear(format!("no pipeline `{name}` runs"), hint)
        })?;
        Ok(running.swap_remove(found))
    }

    /// The topic of this name, if a stage writes or reads it.
    pub fn topic(&self, name: &str) -> Option<&Topic> {
        self.topics().find(|topic| topic.name == name)
    }

    /// The topic of this name.
    ///
    /// # Errors
    /// There is none.
    pub fn expect_topic(&self, name: &str) -> Result<&Topic, WatchError> {
        self.topic(name).ok_or_else(|| {
            let mut names: Vec<_> = self.topics().map(|topic| topic.name.as_str()).collect();
            names.sort_unstable();
            let what = format!("pipeline `{}` has no topic `{name}`", self.plan.pipeline);
            WatchError::Unclear(Hinted::new(what, suggestion(name, names, "topics")))
        })
    }

    /// All topics that stages write or read, each once.
    pub fn topics(&self) -> impl Iterator<Item = &Topic> {
        self.plan.topics()
    }

    /// Calls `see` with each new message of these topics, which have these item types, until it returns [`Watching::Enough`], the
    /// run is over, or a signal ends this process. Malformed messages are skipped with a warning.
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

    /// Watches topics as [`Self::watch`] does, and calls `wants` regularly, even without messages, to ask whether to go on.
    ///
    /// # Errors
    /// A topic cannot be read, or `see` failed.
    pub fn watch_while<'a, E: From<WatchError>>(
        &self,
        topics: &[(&'a ItemType, &'a Topic)],
        mut wants: impl FnMut() -> Watching,
        mut see: impl FnMut(&'a Topic, AnyMessage<'_>) -> Result<Watching, E>,
    ) -> Result<(), E> {
        let terminated = termination_flag().map_err(WatchError::from)?;
        let mut watcher = match Watcher::new(self, topics) {
            // The topics vanished with the run.
            Err(_) if !self.still_runs() => return Ok(()),
            made => made?,
        };
        let mut asked = Instant::now();
        while !terminated.load(Ordering::Relaxed) {
            if asked.elapsed() > RUN_CHECK_PERIOD {
                if wants() == Watching::Enough {
                    return Ok(());
                }
                asked = Instant::now();
            }
            match watcher.poll()? {
                Polled::Message((index, received)) => {
                    let (item, topic) = topics[index];
                    let message = AnyMessage { header: received.header(), item, bytes: received.bytes() };
                    if see(topic, message)? == Watching::Enough {
                        return Ok(());
                    }
                }
                Polled::Pending => sleep(POLL_PERIOD),
                Polled::Over => return Ok(()),
            }
        }
        Ok(())
    }

    /// Replaces `stage` by its version in `plan`, which differs from the plan of this run in nothing else.
    ///
    /// # Errors
    /// The reason why it was not replaced; the old stage then works on.
    pub fn swap(&self, stage: &str, plan: Plan) -> Result<(), SwapError> {
        self.folder.ask_for_swap(stage, plan)
    }

    /// Its sources that are at work on this machine, and whether they are paused.
    pub fn sources(&self) -> Sources {
        let mut sources = Sources::default();
        for planned in self.plan.stages.iter().filter(|planned| planned.is_source() && !planned.is_bridge()) {
            let record = self.folder.record(&planned.name, self.plan.run);
            match record.filter(|record| record.life() == Life::Running).map(|record| record.pausing()) {
                Some(Pausing::Cannot) => sources.live.push(planned.name.clone()),
                Some(Pausing::Goes | Pausing::Stands) => sources.can_pause.push(planned.name.clone()),
                None => {}
            }
        }
        let word = self.folder.pause_file(self.plan.run);
        sources.paused = !sources.can_pause.is_empty() && word.is_some_and(|word| word.is_paused());
        sources
    }

    /// Pauses or resumes its sources on this machine, and returns them.
    ///
    /// # Errors
    /// None of them can be paused, or the run's folder cannot be written.
    pub fn pause(&self, request: PauseRequest) -> Result<Sources, WatchError> {
        let sources = self.sources();
        if sources.can_pause.is_empty() {
            let live = sources.live.iter().map(|name| format!("`{name}`")).collect::<Vec<_>>().join(", ");
            let why = if live.is_empty() { "no source is at work here".to_owned() } else { format!("{live} is live") };
            let what = format!("`{}` cannot be paused: {why}", self.plan.pipeline);
            return Err(WatchError::Unclear(Hinted::new(what, "recordings, files and the simulated camera can be")));
        }
        let no_word = || io::Error::from(io::ErrorKind::NotFound);
        let word = self.folder.pause_file(self.plan.run).ok_or_else(no_word);
        let changed = word.and_then(|word| word.change(request));
        changed.map_err(FolderError::at(self.folder.path()))?;
        Ok(self.sources())
    }

    /// Whether this run has not ended yet.
    pub fn still_runs(&self) -> bool {
        still_runs(&self.folder, self.plan.run)
    }
}

/// Returns a flag that the signals that end a program set from now on, so that this one can leave in order.
///
/// # Errors
/// The system refuses to deliver signals.
pub fn termination_flag() -> io::Result<Arc<AtomicBool>> {
    let interrupted = Arc::new(AtomicBool::new(false));
    for signal in ending_signals() {
        signal_hook::flag::register(signal, Arc::clone(&interrupted))?;
    }
    Ok(interrupted)
}

/// Whether a message is to be returned: it is well-formed, and is not the end of a stream.
fn is_sound(topic: &str, item: &ItemType, message: &SharedMessage, nonsense: &mut ThrottledWarning) -> bool {
    if message.header().ends_stream() {
        return false;
    }
    let checked = item.check(message.header(), message.bytes());
    if let Err(error) = &checked {
        nonsense.warn(format_args!("left out a message of topic `{topic}`: {error}"));
    }
    checked.is_ok()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::VecDeque;
    use std::convert::Infallible;

    /// Returns the numbers of the messages in the order in which they are returned, for a topic of images followed by one of
    /// lists. `arrives` adds messages while topics are polled; its first argument is the number of polls so far.
    fn seen(arrives: impl Fn(usize, &mut [VecDeque<u32>; 2]), queues: [usize; 2], number: usize) -> Vec<(usize, u32)> {
        let (mut order, mut topics, mut looks) = (Order::new(queues.to_vec()), <[VecDeque<u32>; 2]>::default(), 0);
        let mut receive = |index: usize| {
            let found = topics[index].pop_front();
            looks += 1;
            arrives(looks, &mut topics);
            Ok::<_, Infallible>(found)
        };
        (0..number).filter_map(|_| order.next(&mut receive).unwrap_or_else(|never| match never {})).collect()
    }

    #[test]
    fn an_image_comes_before_the_list_that_was_made_of_it() {
        // Image and list come between the poll of the images and that of the lists.
        let arrives = |looks: usize, topics: &mut [VecDeque<u32>; 2]| {
            if looks == 1 {
                topics.iter_mut().for_each(|topic| topic.push_back(7));
            }
        };
        assert_eq!(seen(arrives, [4, 4], 3), [(0, 7), (1, 7)]);
    }

    #[test]
    fn no_topic_waits_for_ever_behind_one_that_never_rests() {
        let arrives = |_: usize, topics: &mut [VecDeque<u32>; 2]| {
            topics.iter_mut().enumerate().for_each(|(number, topic)| topic.push_back(number as u32));
        };
        let lists = seen(arrives, [4, 4], 60).iter().filter(|(index, _)| *index == 1).count();
        assert!(lists >= 10, "{lists} of 60");
    }
}
