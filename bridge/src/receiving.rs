//! An edge that comes: checked, decoded, and written into shared memory as if its writer were on this machine.

use crate::channel::Channel;
use crate::error::BridgeError;
use crate::peer::counts::EdgeCounts;
use crate::peer::heartbeat::Ack;
use crate::peer::links::Links;
use crate::reliable::sequence::{Sequence, Verdict};
use crate::sending::Shared;
use crate::session::Subscriber;
use crate::wire::codec::{Codec, codec_of};
use crate::wire::{Place, WireError, open_message, place_of};
use conicflow_dataflow::pipeline::BRIDGE;
use conicflow_dataflow::ports::{Delivery, PortError, Transport};
use conicflow_dataflow::relay::{OutputPort, SharedWriter, ThrottledWarning};
use conicflow_dataflow::{Edge, Stop, monotonic_ns};
use conicflow_messages::{Header, MAX_HOPS, Text};
use std::collections::{BTreeSet, VecDeque};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use zenoh::bytes::ZBytes;

const TICK: Duration = Duration::from_millis(50);
/// Messages that wait to be decoded, where none may be missed; what is refused comes again.
const LOSSLESS_ROOM: usize = 64;
/// Where the newest wins, what was under way for longer is a backlog that nobody wants.
const STALE: Duration = Duration::from_secs(1);
/// Where datagrams come less often than this, the stream is listened to as well.
const SILENCE: Duration = Duration::from_secs(2);

/// The thread of one edge that comes.
pub(super) struct Receiving<'a> {
    edge: &'a Edge,
    lossless: bool,
    channel: Arc<Channel<ZBytes>>,
    subscriber: Subscriber<'a>,
    output_port: OutputPort<SharedWriter>,
    sequence: Sequence,
    /// Stream and number of messages that were passed on, the last those that a reader may not have finished.
    passed_on: VecDeque<(u64, u64)>,
    codec: Box<dyn Codec>,
    layout: String,
    ended: BTreeSet<String>,
    links: Arc<Links>,
    counts: Arc<EdgeCounts>,
    stop: Stop,
    nonsense: ThrottledWarning,
    told: BTreeSet<&'static str>,
}

impl<'a> Receiving<'a> {
    /// Joins the topic and subscribes to the key.
    pub(super) fn new(edge: &'a Edge, shared: &Shared<'a>, counts: Arc<EdgeCounts>) -> Result<Self, BridgeError> {
        let topic = edge.topic.clone();
        let lossless = edge.delivery_to(shared.machine) == Some(Delivery::Lossless);
        let room = if lossless { LOSSLESS_ROOM } else { edge.writers.len() + 1 };
        let channel = Arc::new(Channel::new(room, !lossless));
        let sender = Arc::clone(&channel);
        let silence = (!lossless && edge.item.is_short()).then_some(SILENCE);
        let subscriber = shared.sessions.subscriber(&shared.key(&edge.from, &topic.name), silence, move |bytes| {
            // What finds no room comes again, or was not the newest.
            sender.send(bytes);
        })?;
        let port = Some((shared.transport.writer_of(&edge.item, &topic)?, topic));
        Ok(Self {
            edge,
            lossless,
            channel,
            subscriber,
            output_port: OutputPort::new(port, BRIDGE, 0, shared.peers.clone(), shared.stop.clone()),
            sequence: Sequence::new(lossless),
            passed_on: VecDeque::new(),
            codec: codec_of(&edge.item),
            layout: edge.item.layout(),
            ended: BTreeSet::new(),
            links: Arc::clone(shared.links),
            counts,
            stop: shared.stop.clone(),
            nonsense: ThrottledWarning::default(),
            told: BTreeSet::new(),
        })
    }

    /// Carries messages until all writers have ended, or the run does.
    pub(super) fn run(mut self) -> Result<(), BridgeError> {
        while !self.stop.requested() && self.ended.len() < self.edge.writers.len() {
            self.choose_way()?;
            let Some(bytes) = self.channel.receive(TICK) else {
                self.output_port.catch_up();
                self.acknowledge();
                continue;
            };
            match self.accept(&bytes.to_bytes()) {
                Err(PortError::Stopped) => break,
                result => result?,
            }
        }
        let writers: Vec<_> = self.edge.writers.iter().map(|writer| Text::new(writer)).collect();
        self.output_port.end_as(&writers)?;
        self.acknowledge();
        Ok(())
    }

    /// Sees to it that messages come, and says once by which way.
    fn choose_way(&mut self) -> Result<(), BridgeError> {
        if let Some(way) = self.subscriber.choose()?.filter(|way| self.told.insert(way)) {
            let (topic, from) = (&self.edge.topic.name, &self.edge.from);
            tracing::info!("topic `{topic}` of machine `{from}` comes by {way}");
        }
        Ok(())
    }

    /// Checks a message, and passes it on if it is the next.
    fn accept(&mut self, bytes: &[u8]) -> Result<(), PortError> {
        let (place, header) = match self.decode(bytes) {
            Ok(message) => message,
            Err(error) => {
                self.leave_out(&error);
                // Of another stream only what can be read tells.
                let place = place_of(bytes).ok().filter(|place| place.stream == self.sequence.expected().0);
                place.into_iter().for_each(|place| self.pass_over(place));
                return Ok(());
            }
        };
        let writer = header.trace().last().map(|hop| hop.stage.to_string()).unwrap_or_default();
        if !self.edge.writers.contains(&writer) {
            self.leave_out(&format!("no stage `{writer}` of machine `{}` writes it", self.edge.from));
            self.pass_over(place);
            return Ok(());
        }
        let repeated_end = header.ends_stream() && !self.lossless && place.stream >= self.sequence.expected().0;
        let verdict = self.sequence.judge(place, header.ends_stream(), Instant::now());
        if self.sequence.was_misled() {
            self.warn_of_forgery();
        }
        self.counts.lost.store(self.sequence.lost(), Ordering::Relaxed);
        if verdict == Verdict::Take {
            match self.pass_on(header, bytes.len()) {
                // It comes again where it must not be missed; there may be room by then.
                Err(error @ PortError::NoRoom { .. }) => {
                    self.leave_out(&error);
                    if self.lossless {
                        return Ok(());
                    }
                }
                passed_on => passed_on?,
            }
            self.sequence.taken();
        }
        if header.ends_stream() && (verdict == Verdict::Take || repeated_end) {
            self.output_port.note_count(Text::new(&writer), header.number);
            self.ended.insert(writer);
        }
        self.acknowledge();
        Ok(())
    }

    /// Reads a message; its items stay with the codec.
    fn decode(&mut self, bytes: &[u8]) -> Result<(Place, Header), WireError> {
        let (place, header, body) = open_message(bytes, &self.layout, self.edge.item.name())?;
        if let Some(body) = body {
            self.codec.decode(&header, body)?;
        }
        Ok((place, header))
    }

    fn pass_on(&mut self, mut header: Header, wire_bytes: usize) -> Result<(), PortError> {
        if header.ends_stream() {
            return Ok(());
        }
        let age = self.to_own_clock(&mut header);
        self.counts.age_ns.store(age.as_nanos() as u64, Ordering::Relaxed);
        if !self.lossless && age > STALE {
            EdgeCounts::add(&self.counts.stale, 1);
            return Ok(());
        }
        self.output_port.relay(&header, self.codec.items())?;
        self.passed_on.push_back(self.sequence.expected());
        EdgeCounts::add(&self.counts.messages, 1);
        EdgeCounts::add(&self.counts.wire_bytes, wire_bytes as u64);
        EdgeCounts::add(&self.counts.memory_bytes, (self.codec.items().len() + size_of::<Header>()) as u64);
        Ok(())
    }

    /// Turns the times of the trace into times of this machine's clock, and tells how long the message was under way.
    /// Before the clocks have been compared it counts as sent just now; never as sent later than it came.
    fn to_own_clock(&self, header: &mut Header) -> Duration {
        let now = monotonic_ns();
        let sent = header.trace().last().map_or(0, |hop| hop.sent_ns);
        let offset = self.links.clock_offset(&self.edge.from).map(i128::from);
        let offset = offset.unwrap_or(i128::from(sent) - i128::from(now));
        let own = |time: u64| u64::try_from(i128::from(time) - offset).unwrap_or(0).min(now);
        let used = (header.hop_count as usize).min(MAX_HOPS);
        for hop in &mut header.hops[..used] {
            (hop.received_ns, hop.sent_ns) = (own(hop.received_ns), own(hop.sent_ns));
        }
        Duration::from_nanos(now.saturating_sub(own(sent)))
    }

    /// Tells what has come, and what of that the readers here have finished: the rest is gone if this process is killed.
    fn acknowledge(&mut self) {
        let (stream, next) = self.sequence.expected();
        let finished = self.passed_on.len().saturating_sub(self.output_port.unfinished());
        self.passed_on.drain(..finished);
        let unfinished = self.passed_on.iter().find(|(of, _)| *of == stream);
        let finished = unfinished.map_or(next, |(_, number)| next.min(*number));
        let ended = self.ended.iter().cloned().collect();
        let (from, topic) = (self.edge.from.clone(), self.edge.topic.name.clone());
        self.links.received(Ack { from, topic, stream, next, finished, ended });
    }

    /// What will never make sense would be sent again for ever, and nothing after it.
    fn pass_over(&mut self, place: Place) {
        if self.sequence.judge(place, true, Instant::now()) == Verdict::Take {
            self.sequence.taken();
        }
        self.acknowledge();
    }

    fn warn_of_forgery(&mut self) {
        EdgeCounts::add(&self.counts.malformed, 1);
        let (topic, from) = (&self.edge.topic.name, &self.edge.from);
        self.nonsense.warn(format_args!(
            "took a message of topic `{topic}` that machine `{from}` has not sent: its number was one that has not been reached\n  \
             hint: whoever can connect can send; with `tls/` and certificates only the machines of the pipeline can"
        ));
    }

    fn leave_out(&mut self, reason: &dyn std::fmt::Display) {
        EdgeCounts::add(&self.counts.malformed, 1);
        let (topic, from) = (&self.edge.topic.name, &self.edge.from);
        self.nonsense.warn(format_args!("left out a message of topic `{topic}` from machine `{from}`: {reason}"));
    }
}
