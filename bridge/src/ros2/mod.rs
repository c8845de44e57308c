//! Participation in ROS 2 over Zenoh, with the conventions of `rmw_zenoh_cpp` and `zenoh-plugin-ros2dds` ([`keys`],
//! [`attachment`]).
//!
//! The session is a client of the robot's router: it listens nowhere and reaches only the routers that the file names. A thread
//! opens it and retries until that works; Zenoh reopens a lost link.

mod attachment;
mod keys;

use crate::channel::Channel;
use crate::session::has_link;
use crate::settings;
use attachment::Attachment;
use conicflow_dataflow::{Node, StageError, Variant, lock, unix_ns};
use conicflow_messages::{Object, Track};
use conicflow_ros2::{Middleware, Participant, Published, Ros2Sink, Ros2Source, Way};
use keys::{Keys, comes_below, key_of_caches};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, AtomicI64, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, OnceLock, Weak};
use std::time::Duration;
use zenoh::bytes::ZBytes;
use zenoh::liveliness::LivelinessToken;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::CongestionControl;
use zenoh::query::{ConsolidationMode, QueryTarget, ReplyKeyExpr};
use zenoh::sample::Sample;
use zenoh::{Session, Wait};

/// The ROS 2 nodes, which this program runs for the program that only lists them.
pub const NODES: &[Node] = &[
    Node::source::<Ros2Source<ZenohMiddleware>>(),
    Node::stages::<Ros2Sink<Track, ZenohMiddleware>>(&[
        Variant::stage::<Ros2Sink<Track, ZenohMiddleware>>(),
        Variant::stage::<Ros2Sink<Object, ZenohMiddleware>>(),
    ]),
];

/// A session that cannot be opened is tried again after this time.
const OPEN_AGAIN: Duration = Duration::from_secs(1);
/// How often the connection to the router is checked.
const ROUTER_CHECK_PERIOD: Duration = Duration::from_millis(100);
/// Timeout for the answers of publishers.
const ANSWER: Duration = Duration::from_secs(1);
/// Maximum number of publishers of a topic whose message numbers are compared; messages of further publishers are accepted
/// without a comparison.
const MOST_COMPARED: usize = 64;
/// A step in a publisher's numbers that is longer than this does not count as lost messages: the publisher numbers differently.
const LONGEST_STEP: u64 = 100_000;
/// Maximum number of tokens that are read.
const MOST_TOKENS: usize = 10_000;

/// A participant that communicates over Zenoh.
pub struct ZenohMiddleware {
    participant: Arc<Participant>,
    inboxes: Arc<Vec<Inbox>>,
    joined: Arc<Joined>,
}

/// The session, once it is open.
#[derive(Default)]
struct Joined {
    session: OnceLock<Ends>,
    is_reached: AtomicBool,
}

impl Joined {
    /// Notes whether the router is reached; returns whether that is new.
    fn note(&self, is_reached: bool) -> bool {
        let was_reached = self.is_reached.swap(is_reached, Ordering::Relaxed);
        is_reached && !was_reached
    }
}

/// The Zenoh objects of a participant. The session is dropped last, which closes it.
struct Ends {
    publishers: Vec<Option<Outbox>>,
    _subscribers: Vec<Subscriber<()>>,
    _tokens: Vec<LivelinessToken>,
    session: Session,
}

/// The publisher of a topic.
struct Outbox {
    publisher: Publisher<'static>,
    sequence: AtomicI64,
    end: [u8; 16],
}

/// The received messages of an endpoint.
struct Inbox {
    messages: Channel<ZBytes>,
    lost: AtomicU64,
    /// The number of the last message of each publisher; `None` if that message was not numbered one by one.
    numbers: Mutex<BTreeMap<[u8; 16], Option<i64>>>,
}

impl Inbox {
    fn new(way: Way) -> Self {
        let (Way::Subscribe(capacity) | Way::SubscribeLatched(capacity)) = way else { return Self::with_room(1) };
        Self::with_room(capacity)
    }

    fn with_room(capacity: usize) -> Self {
        Self { messages: Channel::new(capacity, true), lost: AtomicU64::new(0), numbers: Mutex::default() }
    }

    /// Takes a message. Threads of Zenoh call this, so it must not block.
    fn take(&self, sample: &Sample) {
        let attachment = sample.attachment().and_then(|bytes| Attachment::read(&bytes.to_bytes()));
        let is_numbered = !comes_below(sample.key_expr());
        let missing = attachment.map_or(0, |attachment| self.missing_before(attachment, is_numbered));
        let is_overwritten = !self.messages.send(sample.payload().clone());
        self.lost.fetch_add(missing + u64::from(is_overwritten), Ordering::Relaxed);
    }

    /// Returns how many messages of the same publisher are missing since the last one that came. Messages below the key of the
    /// topic are not numbered one by one: the publisher also numbers those for subscribers with a memory backend, at other keys.
    fn missing_before(&self, Attachment { sequence, end, .. }: Attachment, is_numbered: bool) -> u64 {
        let mut numbers = lock(&self.numbers);
        if numbers.len() >= MOST_COMPARED && !numbers.contains_key(&end) {
            return 0;
        }
        let number = is_numbered.then_some(sequence);
        let last = numbers.insert(end, number).flatten();
        let step = number
            .zip(last)
            .and_then(|(number, last)| number.checked_sub(last))
            .and_then(|step| u64::try_from(step).ok());
        step.filter(|step| *step <= LONGEST_STEP).map_or(0, |step| step.saturating_sub(1))
    }
}

impl Middleware for ZenohMiddleware {
    fn join(participant: Participant) -> Result<Self, StageError> {
        let config = settings::client(&participant.connect)?;
        let participant = Arc::new(participant);
        let inboxes: Vec<_> = participant.ends.iter().map(|end| Inbox::new(end.way)).collect();
        let (inboxes, joined) = (Arc::new(inboxes), Arc::<Joined>::default());
        let keeper = Keeper {
            participant: Arc::clone(&participant),
            inboxes: Arc::clone(&inboxes),
            joined: Arc::downgrade(&joined),
        };
        std::thread::Builder::new().name("ros2".to_owned()).spawn(move || keeper.keep(&config))?;
        Ok(Self { participant, inboxes, joined })
    }

    fn is_joined(&self) -> bool {
        self.joined.is_reached.load(Ordering::Relaxed)
    }

    fn receive(&self, end: usize, timeout: Duration) -> Option<Vec<u8>> {
        Some(self.inboxes[end].messages.receive(timeout)?.to_bytes().into_owned())
    }

    fn take_lost(&self, end: usize) -> u64 {
        self.inboxes[end].lost.swap(0, Ordering::Relaxed)
    }

    fn publish(&self, end: usize, message: Vec<u8>) {
        let ends = self.joined.session.get();
        let Some(outbox) = ends.and_then(|ends| ends.publishers[end].as_ref()) else { return };
        let sequence = outbox.sequence.fetch_add(1, Ordering::Relaxed);
        let attachment = Attachment { sequence, sent_ns: unix_ns().cast_signed(), end: outbox.end };
        // A put succeeds without any receiver; a closed session shows in `is_joined`.
        outbox.publisher.put(message).attachment(attachment.to_bytes()).wait().ok();
    }

    fn published(&self) -> Vec<Published> {
        let Some(ends) = self.joined.session.get() else { return Vec::new() };
        let keys = Keys(&self.participant);
        let answers = ends.session.liveliness().get(keys.tokens_of_publishers()).timeout(ANSWER).wait();
        let Ok(answers) = answers else { return Vec::new() };
        let tokens = answers.iter().take(MOST_TOKENS).filter_map(|answer| {
            let token = answer.into_result().ok()?.key_expr().as_str().to_owned();
            keys.published(&token)
        });
        tokens.collect()
    }
}

/// The thread that opens the session and watches it, as long as the middleware exists.
struct Keeper {
    participant: Arc<Participant>,
    inboxes: Arc<Vec<Inbox>>,
    joined: Weak<Joined>,
}

impl Keeper {
    fn keep(&self, config: &zenoh::Config) {
        while let Some(joined) = self.joined.upgrade() {
            if let Some(ends) = joined.session.get() {
                self.check_router(&joined, ends);
            } else {
                match zenoh::open(config.clone()).wait().and_then(|session| self.declare(session)) {
                    Ok(ends) => drop(joined.session.set(ends)),
                    Err(error) => {
                        tracing::debug!("the session is not open: {error}");
                        drop(joined);
                        std::thread::sleep(OPEN_AGAIN);
                    }
                }
                continue;
            }
            drop(joined);
            std::thread::sleep(ROUTER_CHECK_PERIOD);
        }
    }

    /// Checks whether the router is reached; once it is reached again, asks for earlier messages.
    fn check_router(&self, joined: &Joined, ends: &Ends) {
        if joined.note(has_link(&ends.session)) {
            self.ask_for_latched(&ends.session);
        }
    }

    fn declare(&self, session: Session) -> zenoh::Result<Ends> {
        let (keys, zid) = (Keys(&self.participant), session.zid());
        let (mut publishers, mut subscribers, mut tokens) = (Vec::new(), Vec::new(), Vec::new());
        for (number, end) in self.participant.ends.iter().enumerate() {
            if end.way == Way::Publish {
                let publisher =
                    session.declare_publisher(keys.key(end)).congestion_control(CongestionControl::Drop).wait()?;
                let mut end = zid.to_le_bytes();
                end[0] ^= number as u8 + 1;
                publishers.push(Some(Outbox { publisher, sequence: AtomicI64::new(1), end }));
            } else {
                for key in keys.keys_to_take(end) {
                    let inboxes = Arc::clone(&self.inboxes);
                    let take = move |sample: Sample| inboxes[number].take(&sample);
                    subscribers.push(session.declare_subscriber(key).callback(take).wait()?);
                }
                publishers.push(None);
            }
        }
        for token in keys.tokens(&zid.to_string()) {
            tokens.push(session.liveliness().declare_token(token).wait()?);
        }
        Ok(Ends { publishers, _subscribers: subscribers, _tokens: tokens, session })
    }

    /// Queries the caches of publishers for messages sent before this session.
    fn ask_for_latched(&self, session: &Session) {
        for (number, end) in self.participant.ends.iter().enumerate() {
            if !matches!(end.way, Way::SubscribeLatched(_)) {
                continue;
            }
            let inboxes = Arc::clone(&self.inboxes);
            let key = key_of_caches(&Keys(&self.participant).key(end));
            let query = session.get(key).target(QueryTarget::All).consolidation(ConsolidationMode::None);
            // The replies are messages of the topic, whose key is not below the queried one.
            let query = query.accept_replies(ReplyKeyExpr::Any);
            let declared = query.timeout(ANSWER).callback(move |reply| {
                if let Ok(sample) = reply.into_result() {
                    inboxes[number].take(&sample);
                }
            });
            // A failed query is ignored: new messages come by themselves.
            declared.wait().ok();
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::edge_tests::wait_until;
    use crate::loopback::loopback;
    use conicflow_dataflow::pipeline::Machine;
    use conicflow_ros::IMAGE;
    use conicflow_ros2::{Distro, End, Via};
    use zenoh::key_expr::KeyExpr;
    use zenoh::sample::SampleBuilder;

    fn numbered(sequence: i64, end: u8) -> Attachment {
        Attachment { sequence, sent_ns: 0, end: [end; 16] }
    }

    #[test]
    fn numbers_that_a_publisher_skips_count_as_missing() {
        let inbox = Inbox::new(Way::Subscribe(1));
        let missing = [(5, 1), (6, 1), (9, 1), (1, 2), (2, 2), (9, 1), (3, 1), (4, 1)];
        let counted = missing.map(|(sequence, end)| inbox.missing_before(numbered(sequence, end), true));
        assert_eq!(counted, [0, 0, 2, 0, 0, 0, 0, 0]);
        for forged in [i64::MAX, i64::MIN, 0, i64::MAX] {
            assert_eq!(inbox.missing_before(numbered(forged, 1), true), 0, "{forged}");
        }
        for end in 0..=u8::MAX {
            inbox.missing_before(numbered(1, end), true);
        }
        assert_eq!(lock(&inbox.numbers).len(), MOST_COMPARED);
    }

    /// A middleware with one endpoint and no session yet.
    fn middleware(way: Way) -> ZenohMiddleware {
        let (topic, definition) = ("/camera/depth/image".to_owned(), IMAGE);
        let participant = Participant {
            connect: Vec::new(),
            domain: 0,
            distro: Distro::Jazzy,
            via: Via::RmwZenoh,
            name: "conicflow".to_owned(),
            ends: vec![End { topic, definition, way }],
        };
        let inboxes = Arc::new(vec![Inbox::new(way)]);
        ZenohMiddleware { participant: Arc::new(participant), inboxes, joined: Arc::default() }
    }

    #[test]
    fn each_publisher_has_an_identifier_of_its_own() {
        let end = |way| End { topic: "/camera/depth/image".to_owned(), definition: IMAGE, way };
        let participant = Participant {
            ends: [Way::Publish, Way::Subscribe(1), Way::Publish].map(end).into(),
            ..Participant::clone(&middleware(Way::Subscribe(1)).participant)
        };
        let inboxes: Arc<Vec<_>> = Arc::new(participant.ends.iter().map(|end| Inbox::new(end.way)).collect());
        let keeper = Keeper { participant: Arc::new(participant), inboxes, joined: Weak::new() };
        let mut alone = zenoh::Config::default();
        for (name, value) in [("scouting/multicast/enabled", "false"), ("listen/endpoints", "[]")] {
            alone.insert_json5(name, value).unwrap();
        }
        let ends = keeper.declare(zenoh::open(alone).wait().unwrap()).unwrap();
        let marks: Vec<_> = ends.publishers.iter().map(|outbox| outbox.as_ref().map(|outbox| outbox.end)).collect();
        let [Some(one), None, Some(other)] = marks[..] else { panic!("{marks:?}") };
        let first_byte = ends.session.zid().to_le_bytes()[0];
        assert_eq!(
            [one, other].map(|mark| mark[0]),
            [1, 3].map(|number| first_byte ^ number),
            "each has one of its own"
        );
    }

    #[test]
    fn a_participant_lists_and_receives_the_topics_of_another() {
        let endpoint = vec![loopback()];
        let listening = Machine { listen: endpoint.clone(), insecure: true, ..Machine::default() };
        let connecting = Machine { connect: endpoint, ..Machine::default() };
        let [camera, detector] = [(Way::Publish, listening), (Way::Subscribe(4), connecting)].map(|(way, machine)| {
            let middleware = middleware(way);
            assert_eq!(middleware.published(), [], "nobody is reached yet");
            let session = zenoh::open(settings::configurations(&machine).unwrap().0).wait().unwrap();
            let (participant, inboxes) = (Arc::clone(&middleware.participant), Arc::clone(&middleware.inboxes));
            let ends = Keeper { participant, inboxes, joined: Weak::new() }.declare(session).unwrap();
            assert!(middleware.joined.session.set(ends).is_ok());
            middleware
        });
        let mut received = None;
        wait_until("an image comes, and who publishes it is seen", || {
            camera.publish(0, b"image".to_vec());
            received = received.take().or(detector.receive(0, Duration::from_millis(20)));
            received.is_some() && !detector.published().is_empty()
        });
        assert_eq!(received.as_deref(), Some(&b"image"[..]));
        assert_eq!(detector.published(), [("/camera/depth/image".to_owned(), IMAGE.name.to_owned())]);
    }

    fn sample(sequence: i64, payload: u8) -> Sample {
        let key = KeyExpr::new("0/camera/depth/image/type/hash").unwrap();
        let sample = SampleBuilder::put(key, vec![payload]);
        sample.attachment(numbered(sequence, 1).to_bytes()).into()
    }

    #[test]
    fn messages_lost_in_transit_or_for_lack_of_room_are_counted_once() {
        let middleware = middleware(Way::Subscribe(2));
        assert_eq!(middleware.take_lost(0), 0);
        [(1, b'a'), (2, b'b'), (6, b'c')]
            .into_iter()
            .for_each(|(sequence, payload)| middleware.inboxes[0].take(&sample(sequence, payload)));
        assert_eq!(
            [(); 2].map(|()| middleware.take_lost(0)),
            [3 + 1, 0],
            "3, 4 and 5 never came, and the first had to go"
        );
        let received = [(); 3].map(|()| middleware.receive(0, Duration::ZERO));
        assert_eq!(received, [Some(b"b".to_vec()), Some(b"c".to_vec()), None]);
    }

    #[test]
    fn a_router_counts_as_new_only_after_it_was_unreachable() {
        let middleware = middleware(Way::Subscribe(1));
        assert!(!middleware.is_joined());
        let reached = [false, true, true, false, false, true];
        let noted = reached.map(|is_reached| (middleware.joined.note(is_reached), middleware.is_joined()));
        let is_anew = [false, true, false, false, false, true];
        assert_eq!(noted.map(|(anew, _)| anew), is_anew);
        assert_eq!(noted.map(|(_, is_joined)| is_joined), reached);
    }

    /// A publisher of Lyrical uses three numbers per message if two other subscribers take it with memory backends.
    #[test]
    fn numbers_used_for_other_keys_do_not_count_as_missing() {
        let inbox = Inbox::new(Way::Subscribe(1));
        let messages =
            [(1, false), (4, false), (7, false), (10, true), (11, true), (13, true), (14, false), (17, false)];
        let counted = messages.map(|(sequence, is_numbered)| inbox.missing_before(numbered(sequence, 1), is_numbered));
        assert_eq!(counted, [0, 0, 0, 0, 0, 1, 0, 0]);
    }
}
