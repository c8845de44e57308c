//! Output of a running stage: provides memory for messages, stamps their headers, and sends them.

use super::peers::Peers;
use super::source_warnings::SourceWarnings;
use crate::clock::monotonic_ns;
use crate::item_type::ItemType;
use crate::pipeline::BRIDGE;
use crate::ports::patience::Patience;
use crate::ports::{ConnectedReader, Delivery, PortError, Topic, TopicReader, Writer};
use crate::stage::{Memory, StageError, UntypedOutput};
use crate::status::Status;
use crate::stop::Stop;
use conicflow_messages::{END_OF_STREAM, Header, Hop, Text};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::{self, Display, Formatter};
use std::time::{Duration, Instant};

/// Maximum wait of the first message for readers with [`Delivery::Latest`].
pub(super) const PATIENCE_WITH_LIVE_READERS: Duration = Duration::from_secs(5);
/// Period at which a writer checks whether readers have come or gone.
const READER_CHECK_PERIOD: Duration = Duration::from_millis(10);
/// Period at which the end is sent again to readers whose full queue may not have taken it, and at which a waiting writer checks
/// whether a reader was killed or restarted.
const ANNOUNCEMENT_PERIOD: Duration = Duration::from_millis(100);

/// Writer of the messages of one stage.
pub struct OutputPort<W: Writer> {
    port: Option<(W, Topic)>,
    stage: Text<32>,
    counts: BTreeMap<&'static str, u64>,
    number: u64,
    bytes: u64,
    sent_ns: Option<u64>,
    interval_ns: Option<u64>,
    last: Header,
    source_warnings: SourceWarnings,
    /// By stage of another machine: number of messages that it has sent, as far as is known here.
    relayed: BTreeMap<Text<32>, u64>,
    peers: Peers,
    stop: Stop,
}

impl<W: Writer> Memory for Option<(W, Topic)> {
    fn loan(&mut self, length: usize) -> Result<&mut [u8], StageError> {
        match self {
            Some((writer, _)) => Ok(writer.loan_bytes(length)?),
            None => Err("this stage has no `output` in the pipeline file".into()),
        }
    }
}

impl<W: Writer> OutputPort<W> {
    /// Output of `stage` into a topic, if it has one; `number` messages were sent before.
    pub fn new(port: Option<(W, Topic)>, stage: &str, number: u64, peers: Peers, stop: Stop) -> Self {
        Self {
            port,
            stage: Text::new(stage),
            counts: BTreeMap::new(),
            number,
            bytes: 0,
            sent_ns: None,
            interval_ns: None,
            last: Header::default(),
            source_warnings: SourceWarnings::default(),
            relayed: BTreeMap::new(),
            peers,
            stop,
        }
    }

    /// Continues after an earlier process of the same stage, which had sent `number` messages.
    pub(crate) fn resume(&mut self, number: u64) {
        self.number = number;
    }

    /// Output for a message with this header.
    pub(crate) fn untyped_output(&mut self, header: Header) -> UntypedOutput<'_> {
        UntypedOutput { header, memory: &mut self.port, counts: &mut self.counts }
    }

    /// Sends a message. The bytes of a `list` are copied into shared memory first; `None`: an image, which is there already.
    pub(crate) fn send(&mut self, mut header: Header, received_ns: u64, list: Option<&[u8]>) -> Result<(), PortError> {
        if self.port.is_none() {
            return Ok(());
        }
        self.await_readers()?;
        if let Some(bytes) = list {
            self.write(bytes)?;
        }
        let Some((writer, _)) = &mut self.port else { return Ok(()) };
        if header.hop_count == 0 {
            let warnings = self.source_warnings.about(&header, writer.item().name());
            warnings.iter().for_each(|warning| tracing::warn!("stage `{}` {warning}", self.stage));
        }
        header.number = self.number;
        let sent_ns = monotonic_ns();
        header.add_hop(Hop { stage: self.stage, received_ns, sent_ns });
        let length = writer.send(&header)?;
        self.number += 1;
        self.interval_ns = self.sent_ns.replace(sent_ns).map(|before| sent_ns.saturating_sub(before));
        self.bytes += (length * writer.item().size() + size_of::<Header>()) as u64;
        self.last = header;
        Ok(())
    }

    /// Writes the bytes of items into the memory of the next message, which [`Self::send`] sends without a list.
    pub(crate) fn write(&mut self, bytes: &[u8]) -> Result<(), PortError> {
        let Some((writer, _)) = &mut self.port else { return Ok(()) };
        let length = bytes.len() / writer.item().size();
        writer.loan_bytes(length)?.copy_from_slice(bytes);
        Ok(())
    }

    /// Type of its items; `None` without a topic.
    pub(crate) fn item(&self) -> Option<&ItemType> {
        self.port.as_ref().map(|(writer, _)| writer.item())
    }

    /// Adds the counts of the last step, which processed `frame`, to the record.
    pub(crate) fn tally(&mut self, status: &mut Status, frame: u64) {
        status.sent = self.number;
        status.sent_bytes += std::mem::take(&mut self.bytes);
        self.interval_ns.take().into_iter().for_each(|ns| status.intervals.add(ns));
        self.counts.iter().for_each(|(name, count)| status.count(name, *count));
        if !self.counts.is_empty() {
            tracing::debug!("stage `{}`, frame {frame}: {}", self.stage, Counts(&self.counts));
        }
        self.counts.clear();
    }

    /// Forwards a message of a stage on another machine unchanged.
    ///
    /// # Errors
    /// The transport failed, or the run ended while this process waited.
    pub fn relay(&mut self, header: &Header, bytes: &[u8]) -> Result<(), PortError> {
        self.await_readers()?;
        self.write(bytes)?;
        let Some((writer, _)) = &mut self.port else { return Ok(()) };
        writer.send(header)?;
        self.number += 1;
        self.bytes += (bytes.len() + size_of::<Header>()) as u64;
        self.last = *header;
        self.note_count(header.writer(), header.number.saturating_add(1));
        Ok(())
    }

    /// Records the number of messages that a stage of another machine has sent.
    pub fn note_count(&mut self, writer: Text<32>, count: u64) {
        self.relayed.insert(writer, count);
    }

    /// Resends kept messages to restarted readers, without waiting for the next message.
    pub fn catch_up(&mut self) {
        self.port.iter_mut().for_each(|(writer, _)| writer.catch_up());
    }

    /// Number of messages sent since the first one that a lossless reader has not finished, inclusive; the maximum over the
    /// readers.
    pub fn unfinished(&self) -> usize {
        self.behind(|_| 1).map(|(_, count)| count).max().unwrap_or(0)
    }

    /// Waits until the lossless readers have finished all sent messages, for as long as they make progress: messages kept for
    /// them are lost when this process ends.
    pub(crate) fn await_finish(&mut self) {
        let mut patience = Patience::new();
        while !self.stop.forced() {
            let unfinished: Vec<_> = self.behind(|_| 1).map(|(reader, count)| (reader.stage.clone(), count)).collect();
            let Some((reader, _)) = unfinished.first() else { break };
            self.stop.wait_for(reader);
            let Some((writer, _)) = &mut self.port else { break };
            // A reader that is away is about to be restarted.
            if patience.is_over((writer.connected(), unfinished), Instant::now()) {
                break;
            }
            writer.wait(ANNOUNCEMENT_PERIOD);
        }
    }

    /// Readers with at least `least` unfinished messages that will continue, each with that number.
    pub(super) fn behind(&self, least: impl Fn(&TopicReader) -> usize) -> impl Iterator<Item = (&TopicReader, usize)> {
        let readers = self
            .port
            .iter()
            .flat_map(|(writer, topic)| topic.readers.iter().map(|reader| (reader, writer.unfinished(&reader.stage))));
        readers.filter(move |(reader, count)| *count >= least(reader) && !self.peers.is_over(&reader.stage))
    }

    /// Sends the end of the stream to all readers, and waits until they have taken everything.
    pub(crate) fn end(&mut self) -> Result<(), PortError> {
        self.end_each(&[end_of_stream(&self.last, self.stage, self.number)])
    }

    /// Sends the ends of the streams of stages of another machine to all readers, and waits until they have taken everything.
    ///
    /// # Errors
    /// The transport failed.
    pub fn end_as(&mut self, writers: &[Text<32>]) -> Result<(), PortError> {
        let count = |writer: &Text<32>| self.relayed.get(writer).copied().unwrap_or_default();
        let ends: Vec<_> = writers.iter().map(|writer| end_of_stream(&self.last, *writer, count(writer))).collect();
        self.end_each(&ends)
    }

    fn end_each(&mut self, ends: &[Header]) -> Result<(), PortError> {
        // Ends would replace messages that are kept.
        self.await_finish();
        let (mut announcement, mut last_check) =
            (EndAnnouncement::until(Instant::now() + PATIENCE_WITH_LIVE_READERS), Instant::now());
        while !self.stop.forced() && !self.announce_end(ends, &mut announcement, Instant::now())? {
            match &mut self.port {
                // A reader that was killed, and is not restarted, counts as connected until its port is cleaned up.
                Some((writer, _)) if last_check.elapsed() > ANNOUNCEMENT_PERIOD => {
                    last_check = Instant::now();
                    writer.wait(READER_CHECK_PERIOD);
                }
                _ => std::thread::sleep(READER_CHECK_PERIOD),
            }
        }
        Ok(())
    }

    /// Sends the ends to readers that are new since the last check. Returns whether all that need the ends have received them and
    /// have gone by `now`.
    pub(super) fn announce_end(
        &mut self,
        ends: &[Header],
        announcement: &mut EndAnnouncement,
        now: Instant,
    ) -> Result<bool, PortError> {
        let Some((writer, topic)) = &mut self.port else { return Ok(true) };
        let connected = writer.connected();
        // A stage that restarted between two checks has the same name, but has not received the end.
        let is_new = connected.iter().any(|reader| !announcement.before.contains(reader));
        // A queue drops messages only if no reader of the topic is lossless. If one is, the other readers may miss the end.
        let may_have_missed = |reader: &ConnectedReader| topic.delivery_to(&reader.stage) == Delivery::Latest;
        let is_due = topic.is_lossless()
            && connected.iter().any(may_have_missed)
            && announcement.last.is_some_and(|last| now.duration_since(last) > ANNOUNCEMENT_PERIOD);
        if is_new || is_due {
            announcement.last = Some(now);
            ends.iter().try_for_each(|end| writer.send(end).map(drop))?;
        }
        announcement.reached.extend(connected.iter().map(|reader| reader.stage.clone()));
        // A reader that received the end and is not over was killed, and will be restarted. If its state is unknown, it has most
        // likely ended. The bridge is over only when all its topics are, but leaves each topic once it has forwarded the end; if
        // it was killed it does not need the end again.
        let ends_alone = |stage: &str| stage == BRIDGE || self.peers.life(stage).is_none();
        let is_reported =
            |reader: &TopicReader| ends_alone(&reader.stage) && announcement.reached.contains(&reader.stage);
        let all_told = self.absent_readers(false).all(is_reported);
        let is_waited_for = self.behind(|_| 1).next().is_some();
        if connected.is_empty() && !is_waited_for && (all_told || now > announcement.deadline) {
            return Ok(true);
        }
        connected.iter().for_each(|reader| self.stop.wait_for(&reader.stage));
        announcement.before = connected;
        Ok(false)
    }

    /// Waits until the lossless readers are connected and have room; before the first message it waits for the other readers,
    /// too, for a limited time.
    fn await_readers(&mut self) -> Result<(), PortError> {
        self.await_room()?;
        let deadline = Instant::now() + PATIENCE_WITH_LIVE_READERS;
        let mut warned = false;
        loop {
            let first = self.number == 0 && Instant::now() < deadline;
            let Some(absent) = self.absent_readers(!first).next() else { return Ok(()) };
            self.stop.wait_for(&absent.stage);
            if self.stop.requested() {
                return Err(PortError::Stopped);
            }
            if Instant::now() > deadline && !warned {
                tracing::warn!("waiting for `{}`, which must not miss a message", absent.stage);
                warned = true;
            }
            std::thread::sleep(READER_CHECK_PERIOD);
        }
    }

    /// Waits until no reader has so many unfinished messages that another one would replace a kept message.
    fn await_room(&mut self) -> Result<(), PortError> {
        loop {
            let full = self.behind(TopicReader::credit).next().map(|(reader, _)| reader.stage.clone());
            let (Some(full), Some((writer, _))) = (full, &mut self.port) else { return Ok(()) };
            if self.stop.forced() {
                return Err(PortError::Stopped);
            }
            if !writer.wait(ANNOUNCEMENT_PERIOD) {
                self.stop.wait_for(&full);
            }
        }
    }

    /// Readers of the pipeline that are not connected and still to come; only the lossless ones, or all.
    pub(super) fn absent_readers(&self, only_lossless: bool) -> impl Iterator<Item = &TopicReader> {
        let (connected, topic) = self.port.as_ref().map(|(writer, topic)| (writer.connected(), topic)).unzip();
        let connected: Vec<ConnectedReader> = connected.unwrap_or_default();
        let readers = topic.into_iter().flat_map(|topic| &topic.readers);
        let wanted = readers.filter(move |reader| !only_lossless || reader.delivery == Delivery::Lossless);
        let is_there = move |stage: &str| connected.iter().any(|reader| reader.stage == stage);
        let absent = wanted.filter(move |reader| !is_there(&reader.stage));
        absent.filter(|reader| !self.peers.is_over(&reader.stage))
    }
}

/// Progress of announcing a writer's end.
#[derive(Clone, Debug)]
pub(super) struct EndAnnouncement {
    /// The readers that were connected at the last check.
    pub(super) before: Vec<ConnectedReader>,
    pub(super) reached: BTreeSet<String>,
    last: Option<Instant>,
    /// Time until which readers that never connected are waited for.
    deadline: Instant,
}

impl EndAnnouncement {
    pub(super) const fn until(deadline: Instant) -> Self {
        Self { before: Vec::new(), reached: BTreeSet::new(), last: None, deadline }
    }
}

/// Counts of a step as text, formatted only when it is logged.
struct Counts<'a>(&'a BTreeMap<&'static str, u64>);

impl Display for Counts<'_> {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        for (index, (name, count)) in self.0.iter().enumerate() {
            write!(f, "{}{name}: {count}", if index == 0 { "" } else { ", " })?;
        }
        Ok(())
    }
}

/// End of a stage's stream: a message without items, with a header like the last one, whose number is the number of messages
/// sent.
pub fn end_of_stream(last: &Header, stage: Text<32>, count: u64) -> Header {
    let mut header = Header { flags: END_OF_STREAM, number: count, hop_count: 0, ..*last };
    header.add_hop(Hop { stage, received_ns: 0, sent_ns: monotonic_ns() });
    header
}
