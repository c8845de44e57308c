//! The receiving side of an edge: checks and decodes messages, and writes them into shared memory as if the writer were local.

use crate::authenticator::{Authenticator, Refusals};
use crate::channel::Channel;
use crate::error::BridgeError;
use crate::peer::counts::EdgeCounts;
use crate::peer::heartbeat::Ack;
use crate::peer::links::Links;
use crate::reliable::passed_on::PassedOn;
use crate::reliable::retransmit_queue::END_PATIENCE;
use crate::reliable::sequence::{Claim, Sequence, Verdict};
use crate::session::Subscriber;
use crate::shared::Shared;
use crate::wire::codec::{Codec, codec_of};
use crate::wire::seal::session_of;
use crate::wire::{StreamPosition, WireError, open_message, position_of};
use conicflow_dataflow::pipeline::BRIDGE;
use conicflow_dataflow::ports::{Delivery, PortError, Transport};
use conicflow_dataflow::relay::{OutputPort, Peers, SharedWriter};
use conicflow_dataflow::{Edge, Life, Stop, monotonic_ns};
use conicflow_messages::{Header, MAX_HOPS, Text};
use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use zenoh::bytes::ZBytes;

const IDLE_CHECK_PERIOD: Duration = Duration::from_millis(50);
/// Room for messages that wait to be decoded, on a lossless edge; messages that find no room are retransmitted.
const LOSSLESS_ROOM: usize = 64;
/// With `latest`, messages that were under way for longer than this are a useless backlog and are dropped.
const STALE: Duration = Duration::from_secs(1);
/// If datagrams come less often than this, the bridge subscribes to the stream as well.
const DATAGRAM_TIMEOUT: Duration = Duration::from_secs(2);

/// The receiving thread of one edge.
pub(super) struct Receiving<'a> {
    edge: &'a Edge,
    lossless: bool,
    channel: Arc<Channel<Vec<u8>>>,
    subscriber: Subscriber<'a>,
    output_port: OutputPort<SharedWriter>,
    sequence: Sequence,
    /// The number of messages that earlier processes counted as lost.
    lost_before: u64,
    /// By writer, the number that follows its last message of the stream.
    follow: BTreeMap<String, u64>,
    passed_on: PassedOn,
    codec: Box<dyn Codec>,
    layout: String,
    ended: BTreeSet<String>,
    /// Whether an earlier bridge process has acknowledged the ends of all writers.
    is_end_known: bool,
    /// How long a machine may be away before its retransmissions are given up.
    outage: Duration,
    links: Arc<Links>,
    counts: Arc<EdgeCounts>,
    peers: Peers,
    stop: Stop,
    refusals: Arc<Refusals>,
    logged_paths: BTreeSet<&'static str>,
}

impl<'a> Receiving<'a> {
    /// Joins the topic and subscribes to the key.
    pub(super) fn new(edge: &'a Edge, shared: &Shared<'a>, counts: Arc<EdgeCounts>) -> Result<Self, BridgeError> {
        let topic = edge.topic.clone();
        let lossless = edge.delivery_to(shared.machine) == Some(Delivery::Lossless);
        let room = if lossless { LOSSLESS_ROOM } else { edge.writers.len() + 1 };
        let channel = Arc::new(Channel::new(room, !lossless));
        let zenoh_key = shared.key(&edge.from, &topic.name);
        let refusals = Arc::new(Refusals::new(edge, Arc::clone(&counts)));
        let authenticator = Authenticator {
            zenoh_key: zenoh_key.clone(),
            from: edge.from.clone(),
            links: Arc::clone(shared.links),
            refusals: Arc::clone(&refusals),
        };
        let sender = Arc::clone(&channel);
        let silence = (!lossless && edge.item.is_short()).then_some(DATAGRAM_TIMEOUT);
        let subscriber = shared.sessions.subscriber(&zenoh_key, silence, move |bytes: ZBytes| {
            let bytes = bytes.to_bytes();
            if authenticator.admits(&bytes) {
                // If the channel has no room, a lossless message is retransmitted, and otherwise only older messages are dropped.
                sender.send(bytes.into_owned());
            }
        })?;
        let known = shared.links.ends(&edge.from, &topic.name);
        let port = Some((shared.transport.writer_of(&edge.item, &topic)?, topic));
        Ok(Self {
            edge,
            lossless,
            channel,
            subscriber,
            output_port: OutputPort::new(port, BRIDGE, 0, shared.peers.clone(), shared.stop.clone()),
            sequence: Sequence::new(lossless, shared.links.seal().has_key()),
            lost_before: counts.lost.load(Ordering::Relaxed),
            follow: BTreeMap::new(),
            passed_on: PassedOn::default(),
            codec: codec_of(&edge.item),
            layout: edge.item.layout(),
            is_end_known: known.len() == edge.writers.len(),
            // The messages before the end may not have been passed on: a lossless edge has to receive them first.
            ended: if lossless { BTreeSet::new() } else { known.into_keys().collect() },
            outage: shared.outage,
            links: Arc::clone(shared.links),
            counts,
            peers: shared.peers.clone(),
            stop: shared.stop.clone(),
            refusals,
            logged_paths: BTreeSet::new(),
        })
    }

    /// Carries messages until all writers or the run have ended, and stays until the other machine knows it.
    pub(super) fn run(mut self) -> Result<(), BridgeError> {
        let (from, topic) = (&self.edge.from, &self.edge.topic.name);
        let (is_finished, _) = self.links.is_finished(from, topic);
        if is_finished || self.carry()? {
            self.stay();
        }
        Ok(())
    }

    /// Carries messages until all writers, all readers or the run have ended. Returns whether nothing more is wanted of the other
    /// machine.
    pub(super) fn carry(&mut self) -> Result<bool, BridgeError> {
        let (began, mut checked, mut unread) = (Instant::now(), Instant::now(), Unread::default());
        while !self.stop.requested() && self.ended.len() < self.edge.writers.len() {
            if checked.elapsed() > IDLE_CHECK_PERIOD {
                checked = Instant::now();
                if unread.is_for_good(self.nobody_reads(), checked) {
                    break;
                }
                if self.is_rest_lost(began) {
                    self.ended.extend(self.edge.writers.iter().cloned());
                }
            }
            self.choose_path()?;
            let Some(bytes) = self.channel.receive(IDLE_CHECK_PERIOD) else {
                self.output_port.catch_up();
                self.acknowledge();
                continue;
            };
            match self.accept(&bytes) {
                Err(PortError::Stopped) => break,
                result => result?,
            }
        }
        // Messages may have been given up, or have come to an earlier bridge process: only the noted ends say how many there
        // were.
        for (writer, count) in self.links.ends(&self.edge.from, &self.edge.topic.name) {
            self.output_port.note_count(Text::new(&writer), count);
        }
        let writers: Vec<_> = self.edge.writers.iter().map(|writer| Text::new(writer)).collect();
        self.output_port.end_as(&writers)?;
        for writer in &self.ended {
            if let Err(error) = self.peers.note_end(writer) {
                tracing::warn!("who reads stage `{writer}` from now on will not know that it has ended: {error}");
            }
        }
        self.acknowledge();
        Ok(self.ended.len() == self.edge.writers.len() || self.nobody_reads())
    }

    /// Whether all readers here have ended: an earlier process may have announced the end to them. A reader that is restarted
    /// whenever it ends comes back in a moment.
    fn nobody_reads(&self) -> bool {
        let has_ended = |stage: &str| self.peers.life(stage) == Some(Life::Ended);
        self.edge.topic.readers.iter().all(|reader| has_ended(&reader.stage))
    }

    /// Whether retransmissions will not come any more: the end was acknowledged before this process began, and the other machine
    /// has been silent since for longer than the allowed outage.
    fn is_rest_lost(&self, began: Instant) -> bool {
        self.is_end_known && self.links.silence(&self.edge.from, began) > self.outage
    }

    /// Tells the other machine that nothing more is wanted of it. On a lossless edge it stays until the other machine knows: the
    /// bridge there may be restarted and has to hear it then. It stops waiting when the other machine is silent, which may have
    /// left while a bridge was restarted here.
    fn stay(&self) {
        let (from, topic) = (&self.edge.from, &self.edge.topic.name);
        let began = Instant::now();
        loop {
            self.links.note_finished(from, topic);
            let (_, is_known) = self.links.is_finished(from, topic);
            let silence = self.links.silence(from, began);
            if is_known || !self.lossless || self.stop.forced() || silence > END_PATIENCE {
                return;
            }
            std::thread::sleep(IDLE_CHECK_PERIOD);
        }
    }

    /// Subscribes to the stream where datagrams are too rare, and logs each path once.
    fn choose_path(&mut self) -> Result<(), BridgeError> {
        if let Some(path) = self.subscriber.choose()?.filter(|path| self.logged_paths.insert(path)) {
            let (topic, from) = (&self.edge.topic.name, &self.edge.from);
            tracing::info!("topic `{topic}` of machine `{from}` comes by {path}");
        }
        Ok(())
    }

    /// Checks a message, and passes it on if it is the next one.
    pub(super) fn accept(&mut self, bytes: &[u8]) -> Result<(), PortError> {
        let (position, header) = match self.decode(bytes) {
            Ok(message) => message,
            Err(error) => {
                self.refusals.leave_out(&error);
                // Only readable messages may begin another stream.
                let position = position_of(bytes).ok().filter(|position| self.sequence.is_of_stream(*position));
                position.into_iter().for_each(|position| self.pass_over(position, bytes));
                return Ok(());
            }
        };
        let writer = header.writer().to_string();
        if !self.edge.writers.contains(&writer) {
            self.refusals.leave_out(&format!("no stage `{writer}` of machine `{}` writes it", self.edge.from));
            self.pass_over(position, bytes);
            return Ok(());
        }
        let verdict = self.judge(Claim {
            position,
            session: session_of(bytes),
            number: Some(header.number),
            follows: self.follow.get(&writer).is_none_or(|follow| *follow == header.number),
            may_be_repeated: header.ends_stream(),
        });
        self.counts.lost.store(self.lost_before.saturating_add(self.sequence.lost()), Ordering::Relaxed);
        if verdict == Verdict::Take {
            match self.pass_on(header, bytes.len()) {
                // A lossless message is retransmitted; there may be room by then.
                Err(error @ PortError::NoRoom { .. }) => {
                    self.refusals.leave_out(&error);
                    if self.lossless {
                        return Ok(());
                    }
                }
                passed_on => passed_on?,
            }
            self.sequence.taken();
            self.follow.insert(writer.clone(), header.number.saturating_add(1));
        }
        if header.ends_stream() && self.sequence.counts_as_end(position, verdict) {
            self.links.note_end(&self.edge.from, &self.edge.topic.name, &writer, header.number);
            self.ended.insert(writer);
        }
        self.acknowledge();
        Ok(())
    }

    /// Decodes a message; its items stay in the codec.
    fn decode(&mut self, bytes: &[u8]) -> Result<(StreamPosition, Header), WireError> {
        let (position, header, body) = open_message(bytes, &self.layout, self.edge.item.name())?;
        if let Some(body) = body {
            self.codec.decode(&header, body)?;
        }
        Ok((position, header))
    }

    /// Decides whether a message is to be taken; reports messages that turn out to be forged.
    fn judge(&mut self, claim: Claim) -> Verdict {
        let (stream, _) = self.sequence.expected();
        let verdict = self.sequence.judge(claim, Instant::now());
        if self.sequence.expected().0 != stream {
            self.follow.clear();
        }
        if self.sequence.take_misled() {
            self.refusals.warn_of_forgery("took", "its number was one that has not been reached");
        }
        if self.sequence.take_refuted() {
            self.refusals.warn_of_forgery("left out", "what followed contradicts it");
        }
        verdict
    }

    /// Writes a message into shared memory, with its times by this machine's clock; with `latest`, drops it if it is stale.
    fn pass_on(&mut self, mut header: Header, wire_bytes: usize) -> Result<(), PortError> {
        if header.ends_stream() {
            return Ok(());
        }
        let age = to_own_clock(&mut header, self.links.clock_offset(&self.edge.from), monotonic_ns());
        self.counts.age_ns.store(age.as_nanos() as u64, Ordering::Relaxed);
        if !self.lossless && age > STALE {
            EdgeCounts::add(&self.counts.stale, 1);
            return Ok(());
        }
        self.output_port.relay(&header, self.codec.items())?;
        self.passed_on.add(self.sequence.expected());
        EdgeCounts::add(&self.counts.messages, 1);
        EdgeCounts::add(&self.counts.wire_bytes, wire_bytes as u64);
        EdgeCounts::add(&self.counts.memory_bytes, (self.codec.items().len() + size_of::<Header>()) as u64);
        Ok(())
    }

    /// Records for the next heartbeat what has come, and what of it the readers here have finished: unfinished messages are lost
    /// if this process is killed.
    fn acknowledge(&mut self) {
        let (stream, next) = self.sequence.expected();
        let finished = self.passed_on.finished(self.output_port.unfinished(), (stream, next));
        let ended = self.ended.iter().cloned().collect();
        let (from, topic) = (self.edge.from.clone(), self.edge.topic.name.clone());
        self.links.note_ack(Ack { from, topic, stream, next, finished, ended });
    }

    /// Skips an undecodable message: otherwise it would be retransmitted for ever and block all later ones.
    fn pass_over(&mut self, position: StreamPosition, bytes: &[u8]) {
        let position = StreamPosition { oldest: position.oldest.min(position.number), ..position };
        let claim = Claim { position, session: session_of(bytes), may_be_repeated: true, ..Claim::default() };
        if self.judge(claim) == Verdict::Take {
            self.sequence.taken();
            EdgeCounts::add(&self.counts.refused, 1);
        }
        self.acknowledge();
    }
}

/// Since when all readers of an edge have been absent.
#[derive(Debug, Default)]
struct Unread(Option<Instant>);

impl Unread {
    /// Whether all readers are absent, and have been for so long that a killed one would be back.
    fn is_for_good(&mut self, nobody_reads: bool, now: Instant) -> bool {
        self.0 = nobody_reads.then(|| self.0.unwrap_or(now));
        self.0.is_some_and(|since| now.saturating_duration_since(since) > END_PATIENCE)
    }
}

/// Converts the times of the trace to this machine's clock, which reads `now_ns`; the other machine's clock is ahead by
/// `offset_ns`. Returns how long the message was under way. While the offset is unknown (it takes a usable heartbeat), the
/// message counts as sent just now. No time lies after `now_ns`.
fn to_own_clock(header: &mut Header, offset_ns: Option<i64>, now_ns: u64) -> Duration {
    let sent_ns = header.sent_ns();
    let offset_ns = offset_ns.map_or(i128::from(sent_ns) - i128::from(now_ns), i128::from);
    let own = |time_ns: u64| (i128::from(time_ns) - offset_ns).clamp(0, i128::from(now_ns)) as u64;
    let used = (header.hop_count as usize).min(MAX_HOPS);
    for hop in &mut header.hops[..used] {
        (hop.received_ns, hop.sent_ns) = (own(hop.received_ns), own(hop.sent_ns));
    }
    Duration::from_nanos(now_ns - own(sent_ns))
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::Hop;

    /// Returns the hops `[received_ns, sent_ns]` of a message that two stages have sent, by this machine's clock, which reads
    /// 1000, and how long it was under way.
    fn own_times(offset_ns: Option<i64>, hops: [[u64; 2]; 2]) -> ([[u64; 2]; 2], u64) {
        let mut header = Header::default();
        for [received_ns, sent_ns] in hops {
            header.add_hop(Hop { received_ns, sent_ns, ..Hop::default() });
        }
        let age = to_own_clock(&mut header, offset_ns, 1000);
        ([0, 1].map(|hop| [header.hops[hop].received_ns, header.hops[hop].sent_ns]), age.as_nanos() as u64)
    }

    #[test]
    fn times_of_the_other_machine_are_converted_to_the_local_clock_and_never_lie_in_the_future() {
        let hops = [[5100, 5300], [5400, 5900]];
        assert_eq!(own_times(Some(5000), hops), ([[100, 300], [400, 900]], 100));
        assert_eq!(own_times(Some(4500), hops), ([[600, 800], [900, 1000]], 0), "it cannot be sent later than it came");
        assert_eq!(own_times(Some(5350), hops), ([[0, 0], [50, 550]], 450), "before this machine was started");
        assert_eq!(own_times(Some(-50), [[100, 200], [300, 400]]), ([[150, 250], [350, 450]], 550));
        let last = [[100, 200], [300, u64::MAX]];
        assert_eq!(own_times(Some(-50), last), ([[150, 250], [350, 1000]], 0), "beyond all times it is the same");
    }

    #[test]
    fn before_the_clocks_are_compared_a_message_was_sent_just_now_and_its_hops_keep_their_distances() {
        assert_eq!(own_times(None, [[5100, 5300], [5400, 5900]]), ([[200, 400], [500, 1000]], 0));
        assert_eq!(own_times(None, [[10, 20], [30, 40]]), ([[970, 980], [990, 1000]], 0));
        let mut never_sent = Header::default();
        assert_eq!(to_own_clock(&mut never_sent, None, 1000), Duration::ZERO);
    }

    #[test]
    fn readers_are_gone_for_good_after_a_time_without_any_however_long_the_pause_between_two_checks() {
        let start = Instant::now();
        let checks = |checks: &[(u64, bool)]| {
            let mut unread = Unread::default();
            let check =
                |&(after_s, nobody_reads)| unread.is_for_good(nobody_reads, start + Duration::from_secs(after_s));
            checks.iter().map(check).collect::<Vec<_>>()
        };
        assert_eq!(
            checks(&[(0, false), (60, false), (61, true)]),
            [false; 3],
            "a reader held the bridge up for a minute"
        );
        assert_eq!(checks(&[(0, true), (5, true), (6, true)]), [false, false, true]);
        assert_eq!(
            checks(&[(0, true), (4, false), (5, true), (10, true), (11, true)]),
            [false, false, false, false, true]
        );
    }
}
