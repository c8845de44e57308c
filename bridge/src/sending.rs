//! The sending side of an edge: reads messages from shared memory, encodes them, puts them to Zenoh, and keeps them until they
//! are acknowledged on a lossless edge.

use crate::error::BridgeError;
use crate::peer::counts::{EdgeCounts, MalformedCounter};
use crate::peer::links::Links;
use crate::reliable::retransmit_queue::RetransmitQueue;
use crate::reliable::send_log::SendLog;
use crate::session::Publisher;
use crate::shared::Shared;
use crate::wire::codec::{Codec, codec_of};
use crate::wire::{StreamPosition, WireError, message_bytes};
use conicflow_dataflow::pipeline::BRIDGE;
use conicflow_dataflow::ports::{Delivery, Received, Transport};
use conicflow_dataflow::relay::{InputPort, Peers, SharedReader, end_of_stream};
use conicflow_dataflow::{Edge, InputCounts, Stop, monotonic_ns};
use conicflow_messages::{Header, Text};
use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};
use zenoh::qos::Priority;

/// How often an idle edge checks acknowledgements and ends.
const IDLE_CHECK_PERIOD: Duration = Duration::from_millis(20);
/// With `latest`, the longest wait of a list on a full link.
const LISTS_WAIT: Duration = Duration::from_millis(100);
/// With `latest`, the longest wait of an image on a full link: images yield to lists.
const IMAGES_WAIT: Duration = Duration::from_millis(40);
/// How often a full queue checks for acknowledgements.
const FULL_CHECK_PERIOD: Duration = Duration::from_millis(2);

/// The sending thread of one edge.
pub(super) struct Sending<'a> {
    edge: &'a Edge,
    input_port: InputPort<SharedReader>,
    encoder: Encoder<'a>,
    zenoh_key: String,
    publisher: Publisher<'a>,
    queue: RetransmitQueue,
    links: Arc<Links>,
    counts: Arc<EdgeCounts>,
    peers: Peers,
    stop: Stop,
    last: Header,
    ended: BTreeSet<String>,
}

impl<'a> Sending<'a> {
    /// Joins the topic and declares the key.
    pub(super) fn new(edge: &'a Edge, shared: &Shared<'a>, counts: Arc<EdgeCounts>) -> Result<Self, BridgeError> {
        let topic = &edge.topic;
        let reader = shared.transport.reader_of(&edge.item, topic, BRIDGE)?;
        let images = edge.item.is_image();
        let wait = if images { IMAGES_WAIT } else { LISTS_WAIT };
        let priority = if images { Priority::DataLow } else { Priority::InteractiveHigh };
        let lossy = edge.to.iter().any(|receiver| receiver.delivery == Delivery::Latest);
        let zenoh_key = shared.key(&edge.from, &topic.name);
        let publisher = shared.sessions.publisher(&zenoh_key, lossy && edge.item.is_short(), priority)?;
        let mut input_port = InputPort::new(reader, topic.delivery_to(BRIDGE), &topic.name, topic.writers.len());
        input_port.skip_finished();
        // On a lossless edge the reader knows how far an earlier process came.
        input_port.resume(*counts.input());
        let log =
            shared.log_folder.map(|folder| SendLog::in_folder(folder.to_owned(), &topic.name)).unwrap_or_default();
        Ok(Self {
            edge,
            input_port,
            encoder: Encoder::new(edge, Arc::clone(&counts)),
            zenoh_key,
            publisher,
            queue: RetransmitQueue::new(shared.session, log, &edge.to, [wait, shared.outage], Instant::now()),
            links: Arc::clone(shared.links),
            counts,
            peers: shared.peers.clone(),
            stop: shared.stop.clone(),
            last: Header::default(),
            ended: BTreeSet::new(),
        })
    }

    /// Carries messages until all writers have ended and all receivers have what they must have.
    pub(super) fn run(mut self) -> Result<(), BridgeError> {
        while !self.stop.forced() && !self.is_done() {
            self.settle();
            if self.ended.len() == self.edge.writers.len() || !self.may_send() {
                std::thread::sleep(FULL_CHECK_PERIOD);
                continue;
            }
            let forwarded = self.forward_next()? || self.forward_ends()?;
            // Messages that other machines have to acknowledge are in the log now, where the next bridge process finds them.
            self.input_port.acknowledge();
            if !forwarded {
                self.input_port.wait(IDLE_CHECK_PERIOD)?;
            }
        }
        if !self.stop.forced() {
            self.queue.close();
        }
        self.report_losses();
        Ok(())
    }

    fn is_done(&self) -> bool {
        self.ended.len() == self.edge.writers.len() && self.queue.is_settled(Instant::now())
    }

    fn may_send(&mut self) -> bool {
        self.queue.may_send(Instant::now(), |machine| self.links.round_trip(machine))
    }

    /// Whether there is a receiver: a machine of the pipeline, or another program that has subscribed.
    fn is_wanted(&self) -> bool {
        self.queue.is_wanted(|machine| self.links.is_connected(machine)) || self.publisher.has_subscriber()
    }

    /// Updates the queue with acknowledgements, and retransmits what is due.
    fn settle(&mut self) {
        let now = Instant::now();
        for machine in self.queue.machines() {
            let topic = &self.edge.topic.name;
            if self.links.has_finished(&machine, topic) {
                self.queue.finish(&machine, now);
            } else {
                let (ack, heard) = (self.links.ack_of(&machine, topic), self.links.last_heard(&machine));
                self.queue.acknowledge(&machine, ack.as_ref(), heard, now);
            }
            if self.queue.take_overstated() {
                self.encoder.left_out.add(format_args!(
                    "left out what machine `{machine}` acknowledges of topic `{topic}`, as it was not sent yet\n  \
                     hint: any machine that can connect can send; with the same `key` on all machines only these can"
                ));
            }
        }
        let links = Arc::clone(&self.links);
        for bytes in self.queue.due(now, |machine| links.is_connected(machine)) {
            EdgeCounts::add(&self.counts.resent, 1);
            self.put(bytes);
        }
        self.counts.lost.store(self.queue.lost(), Ordering::Relaxed);
    }

    /// Sends the next message, if there is one and a receiver for it. Messages that came from another machine are not sent again.
    /// Returns whether there was a message.
    fn forward_next(&mut self) -> Result<bool, BridgeError> {
        let taken = self.input_port.take()?;
        let is_lossless = self.edge.topic.delivery_to(BRIDGE) == Delivery::Lossless;
        let counts = self.input_port.counts();
        // The reader drops and reports malformed messages. On a lossless edge nothing else is dropped.
        let all_sent = || InputCounts { topic: counts.topic, malformed: counts.malformed, ..InputCounts::default() };
        *self.counts.input() = if is_lossless { all_sent() } else { counts };
        let Some(message) = taken else { return Ok(false) };
        let header = *message.header();
        let writer = header.writer().to_string();
        if !self.edge.writers.contains(&writer) {
            return Ok(true);
        }
        if !self.is_wanted() {
            EdgeCounts::add(&self.counts.unwanted, u64::from(!is_lossless));
            return Ok(true);
        }
        let encoded = self.encoder.message(self.queue.next_position(), &header, message.bytes());
        let memory_bytes = message.bytes().len() + size_of::<Header>();
        drop(message);
        self.last = header;
        if let Some(bytes) = encoded {
            self.count(&header, bytes.len(), memory_bytes);
            self.queue.sent(&bytes, Instant::now());
            self.put(bytes);
        }
        Ok(true)
    }

    /// Puts a message onto the link, with the session and the code of this process.
    fn put(&mut self, mut bytes: Vec<u8>) {
        self.links.seal().sign(&self.zenoh_key, &mut bytes);
        self.publisher.put(bytes);
    }

    fn count(&self, header: &Header, wire_bytes: usize, memory_bytes: usize) {
        EdgeCounts::add(&self.counts.messages, 1);
        EdgeCounts::add(&self.counts.wire_bytes, wire_bytes as u64);
        EdgeCounts::add(&self.counts.memory_bytes, memory_bytes as u64);
        let age = monotonic_ns().saturating_sub(header.sent_ns());
        self.counts.age_ns.store(age, Ordering::Relaxed);
    }

    /// Sends the ends of writers that have ended or are gone. Returns true if it forwarded one more message of the topic
    /// instead, as the last messages of a writer that is gone come before its end.
    fn forward_ends(&mut self) -> Result<bool, BridgeError> {
        let gone: Vec<_> = self.edge.writers.iter().filter(|writer| self.is_gone(writer)).cloned().collect();
        if !gone.is_empty() && self.forward_next()? {
            return Ok(true);
        }
        for writer in &self.edge.writers {
            let over = self.input_port.has_ended(writer) || gone.contains(writer);
            if over && self.input_port.is_idle() && self.ended.insert(writer.clone()) {
                let end = end_of_stream(&self.last, Text::new(writer), self.input_port.count_of(writer));
                let bytes = self.encoder.end(self.queue.next_position(), &end)?;
                self.queue.sent_end(writer, &bytes, Instant::now());
                self.put(bytes);
            }
        }
        Ok(false)
    }

    /// Whether a writer is over without having announced it to this process: an earlier process may have heard it.
    fn is_gone(&self, writer: &str) -> bool {
        !self.ended.contains(writer) && self.peers.is_over(writer)
    }

    fn report_losses(&self) {
        let lost = self.queue.lost_if_it_ends();
        self.counts.lost.store(lost, Ordering::Relaxed);
        loss(lost, &self.edge.topic.name).iter().for_each(|loss| tracing::error!("{loss}"));
    }
}

/// Encodes the messages of an edge.
struct Encoder<'a> {
    edge: &'a Edge,
    codec: Box<dyn Codec>,
    layout: String,
    left_out: MalformedCounter,
}

impl<'a> Encoder<'a> {
    fn new(edge: &'a Edge, counts: Arc<EdgeCounts>) -> Self {
        let (codec, layout) = (codec_of(&edge.item), edge.item.layout());
        Self { edge, codec, layout, left_out: MalformedCounter::new(counts) }
    }

    /// Encodes a message; `items` are its items as in memory. A malformed message is counted and dropped.
    fn message(&self, position: StreamPosition, header: &Header, items: &[u8]) -> Option<Vec<u8>> {
        let body = |bytes: &mut Vec<u8>| self.codec.encode(header, items, self.edge.compression, bytes);
        let encoded = message_bytes(position, &self.layout, header, body);
        let leave_out = |error: &WireError| {
            let topic = &self.edge.topic.name;
            self.left_out.lose(format_args!("a message of topic `{topic}` cannot leave this machine: {error}"));
        };
        encoded.inspect_err(leave_out).ok()
    }

    /// Encodes the end of a writer's stream.
    fn end(&self, position: StreamPosition, header: &Header) -> Result<Vec<u8>, WireError> {
        message_bytes(position, &self.layout, header, |_| Ok(()))
    }
}

/// The report of messages that lossless receivers did not get, if there are any.
fn loss(lost: u64, topic: &str) -> Option<String> {
    let text = || format!("{lost} messages of the lossless topic `{topic}` did not reach all machines that read it");
    (lost > 0).then(text)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::edge_tests::{Side, edge, header, memory, wait_until};
    use crate::reliable::send_log::CAPACITY;
    use crate::session::tests::joined;
    use crate::wire::decode_message;
    use conicflow_dataflow::ItemType;
    use conicflow_dataflow::pipeline::Compression;
    use conicflow_dataflow::ports::Writer;
    use conicflow_messages::{Camera, Object};

    #[test]
    fn an_image_that_is_too_large_or_incomplete_is_left_out_and_counted_and_others_are_sent() {
        for compression in [Compression::None, Compression::Lz4, Compression::Zstd] {
            let edge = Edge { item: ItemType::of::<u16>(), compression, ..edge(Delivery::Latest, BRIDGE) };
            let counts = Arc::<EdgeCounts>::default();
            let encoder = Encoder::new(&edge, Arc::clone(&counts));
            let of_size = |width, height| {
                let camera = Camera { width, height, fx: 500.0, fy: 500.0, cx: 0.5, cy: 0.5 };
                Header { camera, depth_scale: 0.001, ..Header::default() }
            };
            let (position, items) = (StreamPosition { stream: 1, number: 2, oldest: 1 }, [7, 0, 8, 0]);
            for (left_out, (width, height)) in [(1 << 16, 1 << 16), (1, 1), (2, 2), (0, 0)].into_iter().enumerate() {
                assert_eq!(encoder.message(position, &of_size(width, height), &items), None, "{compression:?}");
                assert_eq!(counts.malformed.load(Ordering::Relaxed), left_out as u64 + 1);
            }
            let bytes = encoder.message(position, &of_size(2, 1), &items).unwrap();
            let (decoded_position, _, decoded_items) = decode_message(&bytes, &edge.item).unwrap();
            assert_eq!((decoded_position, decoded_items), (position, items.to_vec()));
            assert_eq!(counts.malformed.load(Ordering::Relaxed), 4);
        }
    }

    #[test]
    fn sending_stops_when_the_log_of_unacknowledged_messages_is_full() {
        let folder = tempfile::tempdir().unwrap();
        let robot = Side::new("robot", edge(Delivery::Lossless, BRIDGE), folder.path(), None);
        let ([sessions, _], peers) = (joined(|address| address), Peers::default());
        let shared = robot.shared(&sessions, &peers);
        let mut sending = Sending::new(&robot.edge, &shared, Arc::clone(&robot.counts)).unwrap();
        for sent in 0..CAPACITY {
            assert!(sending.may_send(), "after {sent}");
            sending.queue.sent(&[], Instant::now());
        }
        assert!(!sending.may_send());
    }

    #[test]
    fn with_latest_messages_sent_between_two_bridges_of_a_run_count_as_dropped_and_missing() {
        let folder = tempfile::tempdir().unwrap();
        let robot = Side::new("robot", edge(Delivery::Latest, BRIDGE), folder.path(), None);
        let ([sessions, _], peers) = (joined(|address| address), Peers::default());
        let shared = robot.shared(&sessions, &peers);
        let mut writer = memory(folder.path(), "writer").writer::<Object>(&robot.edge.topic).unwrap();
        for number in [0, 3] {
            let mut sending = Sending::new(&robot.edge, &shared, Arc::clone(&robot.counts)).unwrap();
            writer.loan::<Object>(0).unwrap();
            writer.send(&header("writer", number)).unwrap();
            wait_until("it came", || sending.forward_next().unwrap());
        }
        let InputCounts { received, dropped, gaps, .. } = *robot.counts.input();
        assert_eq!([received, dropped, gaps], [2, 2, 2]);
    }

    #[test]
    fn with_latest_an_edge_is_wanted_by_any_subscriber_of_its_key() {
        let folder = tempfile::tempdir().unwrap();
        let robot = Side::new("robot", edge(Delivery::Latest, BRIDGE), folder.path(), None);
        let ([sessions, base], peers) = (joined(|address| address), Peers::default());
        let sending = Sending::new(&robot.edge, &robot.shared(&sessions, &peers), Arc::clone(&robot.counts)).unwrap();
        assert!(!sending.is_wanted());
        let _subscriber = base.subscriber("conicflow/test/robot/objects", None, |_| ()).unwrap();
        wait_until("it is wanted", || sending.is_wanted());
    }

    #[test]
    fn an_edge_that_is_forced_to_end_counts_unacknowledged_messages_as_lost() {
        let folder = tempfile::tempdir().unwrap();
        let robot = Side::new("robot", edge(Delivery::Lossless, BRIDGE), folder.path(), None);
        let ([sessions, _], peers) = (joined(|address| address), Peers::default());
        let shared = robot.shared(&sessions, &peers);
        let mut sending = Sending::new(&robot.edge, &shared, Arc::clone(&robot.counts)).unwrap();
        (0..3).for_each(|_| sending.queue.sent(&[], Instant::now()));
        shared.stop.force();
        sending.run().unwrap();
        assert_eq!(robot.counts.lost.load(Ordering::Relaxed), 3);
    }

    #[test]
    fn lost_messages_are_reported_and_nothing_when_all_arrived() {
        assert_eq!(loss(0, "objects"), None);
        assert!(loss(1, "objects").unwrap().starts_with("1 messages of the lossless topic `objects`"));
    }
}
