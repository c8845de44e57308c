//! Watches topics of a running pipeline from outside: every message that comes, checked, until the run is over.
//!
//! A watcher sleeps between looks instead of being woken, so that a writer does nothing for it but pass it a pointer.

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

/// Shorter than a writer that runs flat out takes to fill the queue of an ordinary topic is not worth the processor time.
const POLL_PERIOD: Duration = Duration::from_millis(1);
/// How often a watcher without messages looks whether the run still goes on.
const RUN_CHECK_PERIOD: Duration = Duration::from_millis(100);

/// A pipeline that runs now.
pub struct RunningPipeline {
    /// What its stages know of it.
    pub plan: Plan,
    folder: RunFolder,
}

/// Why a topic could not be watched.
#[derive(Debug, thiserror::Error)]
pub enum WatchError {
    /// Which pipeline or topic is meant, or that it cannot be done with it.
    #[error(transparent)]
    Unclear(Hinted),
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

/// Looks into topics of a running pipeline.
pub struct Watcher {
    topics: Vec<(ItemType, String, SharedOnlooker)>,
    order: Order<SharedMessage>,
    memory: SharedMemory,
    /// Forced when the run is over: whoever leaves last then sees to it that nothing is left.
    stop: Stop,
    folder: RunFolder,
    run: u64,
    checked: Instant,
    nonsense: ThrottledWarning,
}

impl Watcher {
    /// Looks into these topics, which have these items, from now on. What is made of messages of one of them goes behind that one.
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

    /// The next message, checked, with the number of its topic, in the order in which they were named; one that makes no sense is
    /// left out, with a warning. Where there is none yet, the next look is worth while after a millisecond; none will come where
    /// the run is over.
    ///
    /// # Errors
    /// A topic cannot be read.
    pub fn poll(&mut self) -> Result<Polled<(usize, SharedMessage)>, WatchError> {
        let check = self.checked.elapsed() > RUN_CHECK_PERIOD;
        if check {
            self.checked = Instant::now();
        }
        // The run is looked at first: what was sent before it was over is then sure to be found.
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

/// In which order topics are looked into: in turn, but what a message was made of comes before it.
struct Order<M> {
    /// How many messages wait in each topic at most.
    queues: Vec<usize>,
    /// The topic whose turn it is.
    next: usize,
    held: Option<Held<M>>,
}

/// A message that was found. When its topic was looked into, what it was made of was there, but may not have been a moment before,
/// when the topics in front of it were: these are looked into once more.
struct Held<M> {
    index: usize,
    message: M,
    /// So many messages of those topics may have been there.
    in_front: usize,
}

impl<M> Order<M> {
    fn new(queues: Vec<usize>) -> Self {
        Self { queues, next: 0, held: None }
    }

    /// The next message and the number of its topic, where `receive` brings the oldest that waits in a topic.
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
        let running = RunFolder::all(&user_folder())?.into_iter().filter(RunFolder::is_running);
        Ok(running.filter_map(|folder| Some(Self { plan: folder.plan().ok()?, folder })).collect())
    }

    /// The pipeline of this name, or the only one that runs; `how` says in an error how to tell which.
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

    /// What both ends of a topic agreed on, if a stage writes or reads one of this name.
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
        let terminated = termination_flag().map_err(WatchError::from)?;
        let mut watcher = match Watcher::new(self, topics) {
            // What there was to look into went with the run.
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

    /// Replaces `stage` by what stands in `plan`, which differs from the plan of this run in nothing else.
    ///
    /// # Errors
    /// Why it was not; the stage that was to be replaced is at work then.
    pub fn swap(&self, stage: &str, plan: Plan) -> Result<(), SwapError> {
        self.folder.ask_for_swap(stage, plan)
    }

    /// Its sources on this machine that are at work, and whether they are paused.
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

    /// Pauses its sources on this machine or lets them go on; which they are, and whether they are paused now.
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

/// Raised from now on by the signals that end a program, so that this one can leave its place in order.
///
/// # Errors
/// The system does not let them be received.
pub fn termination_flag() -> io::Result<Arc<AtomicBool>> {
    let told = Arc::new(AtomicBool::new(false));
    for signal in ending_signals() {
        signal_hook::flag::register(signal, Arc::clone(&told))?;
    }
    Ok(told)
}

/// Whether a message is to be seen: it makes sense, and is not the end of a stream.
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

    /// Numbers of the messages in the order in which they are seen, where a topic of images is followed by one of lists;
    /// `arrives` puts in what comes while topics are looked into, by the number of looks so far.
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
        // Both come between the look for an image and the one for a list.
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
