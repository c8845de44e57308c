//! The Zenoh sessions of a machine: one over streams for everything and, if the file names endpoints for datagrams, another over
//! those, for short messages with `latest`.
//!
//! A stream over a lossy radio holds back everything after a lost packet until that was retransmitted; a lost datagram delays
//! nothing. Nothing tells a peer that datagrams do not reach it, and Zenoh's own declarations may be lost, too. So a sender
//! publishes a message in both sessions while the receiver subscribes to both, and the receiver stays subscribed to the stream
//! until datagrams come. While none come, it renews its subscription, in a way that does not rely on an earlier declaration,
//! which may be lost ([`key_for_datagrams`]).

use crate::error::BridgeError;
use crate::settings;
use conicflow_dataflow::pipeline::Machine;
use conicflow_dataflow::{Stop, lock};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};
use zenoh::bytes::ZBytes;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait, pubsub};

/// A session that cannot be opened, because no peer is there yet, is retried after this time.
const OPEN_AGAIN: Duration = Duration::from_secs(1);
/// While no datagrams come, the subscription is renewed after this time.
const ASK_AGAIN: Duration = Duration::from_secs(5);

/// The open sessions of a machine.
pub(super) struct Sessions {
    streams: Session,
    datagrams: Arc<OnceLock<Session>>,
}

/// The callback for received messages.
type Take = Arc<dyn Fn(ZBytes) + Send + Sync>;

impl Sessions {
    /// Opens the sessions, retrying until that works. Returns `None` if the run is forced to end first. A run that ends in order
    /// goes on trying: even a bridge that is only starting may have to tell the other machines. `failed` is called after each
    /// attempt.
    pub(super) fn open(machine: &Machine, stop: &Stop, mut failed: impl FnMut()) -> Result<Option<Self>, BridgeError> {
        let (streams, datagrams) = settings::configurations(machine)?;
        let mut is_reported = false;
        while !stop.forced() {
            match zenoh::open(streams.clone()).wait() {
                Ok(streams) => {
                    let sessions = Self { streams, datagrams: Arc::default() };
                    datagrams.iter().for_each(|config| sessions.open_datagrams(config, stop));
                    return Ok(Some(sessions));
                }
                Err(error) if !is_reported => tracing::warn!(
                    "the link cannot be opened yet, and is tried again: {}\n  \
                     hint: does another program listen there, and do the files of the `zenoh` configuration exist?",
                    in_short(&*error)
                ),
                Err(_) => {}
            }
            is_reported = true;
            failed();
            std::thread::sleep(OPEN_AGAIN);
        }
        Ok(None)
    }

    /// Opens the session for datagrams, in a thread if that does not work at once: the endpoints of a peer may be taken, and a
    /// client needs an answer of its router. The stream carries everything meanwhile.
    fn open_datagrams(&self, config: &zenoh::Config, stop: &Stop) {
        if !settings::is_client(config) {
            match zenoh::open(config.clone()).wait() {
                Ok(session) => return drop(self.datagrams.set(session)),
                Err(error) => {
                    let error = in_short(&*error);
                    tracing::warn!("the endpoints for datagrams cannot be opened yet, and are tried again: {error}");
                }
            }
        }
        let (datagrams, config, stop) = (Arc::clone(&self.datagrams), config.clone(), stop.clone());
        std::thread::spawn(move || {
            while datagrams.get().is_none() && !stop.requested() {
                match zenoh::open(config.clone()).wait() {
                    Ok(session) => drop(datagrams.set(session)),
                    Err(_) => std::thread::sleep(OPEN_AGAIN),
                }
            }
        });
    }

    /// Whether there is a link to any other machine or router.
    pub(super) fn reaches_any_machine(&self) -> bool {
        [Some(&self.streams), self.datagrams.get()].into_iter().flatten().any(has_link)
    }

    /// Declares a key for publishing, also over datagrams if messages are `short`.
    pub(super) fn publisher(&self, key: &str, short: bool, priority: Priority) -> Result<Publisher<'_>, BridgeError> {
        let stream = declare(&self.streams, key, priority)?;
        Ok(Publisher { sessions: self, key: key.to_owned(), short, priority, stream, datagrams: None })
    }

    /// Subscribes to a key. With a longest `silence` between datagrams, only datagrams are used as long as they come. Threads of
    /// Zenoh call `take`, which must not block.
    pub(super) fn subscriber(
        &self,
        key: &str,
        silence: Option<Duration>,
        take: impl Fn(ZBytes) + Send + Sync + 'static,
    ) -> Result<Subscriber<'_>, BridgeError> {
        let take: Take = Arc::new(take);
        let mut subscriber =
            Subscriber { sessions: self, key: key.to_owned(), take, silence, stream: None, datagrams: None };
        subscriber.stream = Some(subscriber.subscribe_to_stream()?);
        subscriber.ask_for_datagrams()?;
        Ok(subscriber)
    }
}

/// Whether a session has a link to a router or a peer.
pub(crate) fn has_link(session: &Session) -> bool {
    let info = session.info();
    info.routers_zid().wait().chain(info.peers_zid().wait()).next().is_some()
}

/// An error of Zenoh without the places in its source.
fn in_short(error: &dyn std::error::Error) -> String {
    let text = error.to_string();
    text.split(" at /").next().unwrap_or_default().to_owned()
}

/// The publisher of a key.
pub(super) struct Publisher<'a> {
    sessions: &'a Sessions,
    key: String,
    short: bool,
    priority: Priority,
    stream: pubsub::Publisher<'static>,
    /// The publisher over datagrams, and when it was declared.
    datagrams: Option<(pubsub::Publisher<'static>, Instant)>,
}

impl Publisher<'_> {
    /// Publishes a message in each session. It does not report whether the message arrives.
    pub(super) fn put(&mut self, bytes: Vec<u8>) {
        self.ask_who_listens();
        let bytes = ZBytes::from(bytes);
        self.publishers().for_each(|publisher| drop(publisher.put(bytes.clone()).wait()));
    }

    /// Declares the key to the session for datagrams, if there is one. Repeats that while no subscriber is known: Zenoh asks for
    /// subscribers only once, and the question may be lost.
    fn ask_who_listens(&mut self) {
        let Some(session) = self.sessions.datagrams.get().filter(|_| self.short) else { return };
        let has_answer = |(publisher, asked): &(_, Instant)| asked.elapsed() < ASK_AGAIN || has_subscriber(publisher);
        if !self.datagrams.as_ref().is_some_and(has_answer) {
            self.datagrams = None;
            self.datagrams =
                declare(session, &self.key, self.priority).ok().map(|publisher| (publisher, Instant::now()));
        }
    }

    fn publishers(&self) -> impl Iterator<Item = &pubsub::Publisher<'static>> {
        std::iter::once(&self.stream).chain(self.datagrams.as_ref().map(|(publisher, _)| publisher))
    }

    /// Whether there is a subscriber.
    pub(super) fn has_subscriber(&self) -> bool {
        self.publishers().any(has_subscriber)
    }
}

fn declare(session: &Session, key: &str, priority: Priority) -> Result<pubsub::Publisher<'static>, BridgeError> {
    let publisher = session.declare_publisher(key.to_owned()).priority(priority);
    let publisher = publisher.congestion_control(CongestionControl::Drop).express(priority != Priority::DataLow);
    publisher.wait().map_err(|error| BridgeError::zenoh("cannot declare a key to Zenoh", error))
}

/// The key expression for subscribing over datagrams. Zenoh declares a key to a peer only once and uses a number for it
/// afterwards, in subscriptions too; if the declaration was lost, the peer understands no later subscription. An expression that
/// begins with a wildcard gets no number: each subscription contains it in full.
fn key_for_datagrams(key: &str) -> String {
    let after_first_part = key.split_once('/').map_or(key, |(_, rest)| rest);
    format!("*/{after_first_part}")
}

fn has_subscriber(publisher: &pubsub::Publisher) -> bool {
    publisher.matching_status().wait().is_ok_and(|status| status.matching())
}

fn subscribe(session: &Session, key: String, take: Take) -> Result<pubsub::Subscriber<()>, BridgeError> {
    let declared = session.declare_subscriber(key).callback(move |sample| take(sample.payload().clone())).wait();
    declared.map_err(|error| BridgeError::zenoh("cannot subscribe to a key of Zenoh", error))
}

/// The subscriber of a key.
pub(super) struct Subscriber<'a> {
    sessions: &'a Sessions,
    key: String,
    take: Take,
    /// The longest time between datagrams, if they are used.
    silence: Option<Duration>,
    stream: Option<pubsub::Subscriber<()>>,
    datagrams: Option<Datagrams>,
}

/// The part of a subscriber for datagrams.
struct Datagrams {
    silence: Duration,
    asked: Instant,
    last_datagram_at: Arc<Mutex<Option<Instant>>>,
    _subscriber: pubsub::Subscriber<()>,
}

impl Datagrams {
    fn come(&self) -> bool {
        let last_datagram_at = *lock(&self.last_datagram_at);
        last_datagram_at.is_some_and(|last_datagram_at| last_datagram_at.elapsed() < self.silence)
    }
}

impl Subscriber<'_> {
    fn subscribe_to_stream(&self) -> Result<pubsub::Subscriber<()>, BridgeError> {
        subscribe(&self.sessions.streams, self.key.clone(), Arc::clone(&self.take))
    }

    /// Subscribes to datagrams, if they are used and their session is open.
    fn ask_for_datagrams(&mut self) -> Result<(), BridgeError> {
        let (Some(session), Some(silence)) = (self.sessions.datagrams.get(), self.silence) else { return Ok(()) };
        let (take, last_datagram_at) = (Arc::clone(&self.take), Arc::<Mutex<Option<Instant>>>::default());
        let clock = Arc::clone(&last_datagram_at);
        let note_and_take = move |bytes| {
            *lock(&clock) = Some(Instant::now());
            take(bytes);
        };
        let subscriber = subscribe(session, key_for_datagrams(&self.key), Arc::new(note_and_take))?;
        self.datagrams = Some(Datagrams { silence, asked: Instant::now(), last_datagram_at, _subscriber: subscriber });
        Ok(())
    }

    /// Selects the session, and has to be called now and then. Returns the name of the new one if it has changed.
    pub(super) fn choose(&mut self) -> Result<Option<&'static str>, BridgeError> {
        let Some(datagrams) = &self.datagrams else {
            return self.ask_for_datagrams().map(|()| None);
        };
        if datagrams.come() {
            return Ok(self.stream.take().map(|_| "datagrams"));
        }
        if datagrams.asked.elapsed() > ASK_AGAIN {
            self.datagrams = None;
            self.ask_for_datagrams()?;
        }
        if self.stream.is_some() {
            return Ok(None);
        }
        self.stream = Some(self.subscribe_to_stream()?);
        Ok(Some("the stream, while no datagrams come"))
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use crate::edge_tests::wait_until;
    use crate::loopback::loopback;
    use std::net::{SocketAddr, UdpSocket};
    use std::sync::mpsc::channel;

    const KEY: &str = "conicflow/test/robot/objects";
    const PART_OF_KEY: &[u8] = b"robot/objects";

    /// Two machines joined by a stream and by datagrams; `between` maps the address of the datagrams to that of a proxy.
    pub fn joined(between: fn(SocketAddr) -> SocketAddr) -> [Sessions; 2] {
        let (stream, datagrams) = (loopback(), loopback()["tcp/".len()..].parse::<SocketAddr>().unwrap());
        let endpoints = |datagrams| vec![stream.clone(), format!("udp/{datagrams}")];
        let listening = Machine { listen: endpoints(datagrams), ..Machine::default() };
        let connecting = Machine { connect: endpoints(between(datagrams)), ..Machine::default() };
        [listening, connecting].map(|machine| Sessions::open(&machine, &Stop::default(), || ()).unwrap().unwrap())
    }

    /// Starts a proxy to an address that loses the first datagram with a part of the key in it.
    fn losing_the_first_with_the_key(address: SocketAddr) -> SocketAddr {
        let (front, back) = (UdpSocket::bind("127.0.0.1:0").unwrap(), UdpSocket::bind("127.0.0.1:0").unwrap());
        let proxy_address = front.local_addr().unwrap();
        back.connect(address).unwrap();
        std::thread::spawn(move || {
            let (mut buffer, mut is_lost) = (vec![0; 65536], false);
            let (length, client) = front.recv_from(&mut buffer).unwrap();
            back.send(&buffer[..length]).unwrap();
            front.connect(client).unwrap();
            let (answers, questions) = (back.try_clone().unwrap(), front.try_clone().unwrap());
            std::thread::spawn(move || {
                let mut buffer = vec![0; 65536];
                while let Ok(length) = answers.recv(&mut buffer) {
                    questions.send(&buffer[..length]).ok();
                }
            });
            while let Ok(length) = front.recv(&mut buffer) {
                let datagram = &buffer[..length];
                if !is_lost && datagram.windows(PART_OF_KEY.len()).any(|part| part == PART_OF_KEY) {
                    is_lost = true;
                } else {
                    back.send(datagram).ok();
                }
            }
        });
        proxy_address
    }

    #[test]
    fn short_messages_use_datagrams_even_after_a_lost_subscription_and_the_stream_when_no_datagrams_come() {
        for between in [|address: SocketAddr| address, losing_the_first_with_the_key] {
            let [robot, base] = joined(between);
            let (take, received) = channel();
            let mut publisher = robot.publisher(KEY, true, Priority::InteractiveHigh).unwrap();
            let mut subscriber =
                base.subscriber(KEY, Some(Duration::from_secs(1)), move |bytes| drop(take.send(bytes))).unwrap();
            let mut publish_until_it_comes = |by_the_stream: bool| {
                wait_until("a message comes as it is to come", || {
                    subscriber.choose().unwrap();
                    publisher.put(b"objects".to_vec());
                    let has_subscriber = received.recv_timeout(Duration::from_millis(20)).is_ok();
                    has_subscriber && subscriber.stream.is_some() == by_the_stream
                });
            };
            publish_until_it_comes(false);
            robot.datagrams.get().unwrap().close().wait().unwrap();
            while received.try_recv().is_ok() {}
            publish_until_it_comes(true);
        }
    }

    #[test]
    fn a_publisher_asks_for_datagram_subscribers_again_after_a_while_and_not_with_each_message() {
        let [robot, _base] = joined(|address| address);
        let mut publisher = robot.publisher(KEY, true, Priority::InteractiveHigh).unwrap();
        wait_until("there are datagrams", || {
            publisher.ask_who_listens();
            publisher.datagrams.is_some()
        });
        let mut asked_after = |time: Duration| {
            let (_, asked) = publisher.datagrams.as_mut().unwrap();
            *asked = Instant::now().checked_sub(time).unwrap();
            let before = *asked;
            publisher.ask_who_listens();
            publisher.datagrams.as_ref().unwrap().1 != before
        };
        assert_eq!([Duration::ZERO, ASK_AGAIN, Duration::ZERO].map(&mut asked_after), [false, true, false]);
    }

    #[test]
    fn a_subscriber_asks_for_datagrams_again_after_a_while_and_not_with_each_check() {
        let [_robot, base] = joined(|address| address);
        let mut subscriber = base.subscriber(KEY, Some(Duration::from_secs(1)), |_| ()).unwrap();
        wait_until("there are datagrams", || {
            subscriber.choose().unwrap();
            subscriber.datagrams.is_some()
        });
        let mut asked_after = |time: Duration| {
            let asked = &mut subscriber.datagrams.as_mut().unwrap().asked;
            *asked = Instant::now().checked_sub(time).unwrap();
            let before = *asked;
            subscriber.choose().unwrap();
            subscriber.datagrams.as_ref().unwrap().asked != before
        };
        assert_eq!([Duration::ZERO, 2 * ASK_AGAIN, Duration::ZERO].map(&mut asked_after), [false, true, false]);
    }

    #[test]
    fn it_is_known_whether_a_machine_is_reached_and_whether_it_subscribes() {
        let alone = Sessions::open(&Machine::default(), &Stop::default(), || ()).unwrap().unwrap();
        let [robot, base] = joined(|address| address);
        let publisher = robot.publisher(KEY, false, Priority::DataLow).unwrap();
        assert!(!alone.reaches_any_machine() && !publisher.has_subscriber());
        let _subscriber = base.subscriber(KEY, None, |_| ()).unwrap();
        let is_known = || robot.reaches_any_machine() && base.reaches_any_machine() && publisher.has_subscriber();
        wait_until("somebody is there and listens", is_known);
    }

    #[test]
    fn errors_of_zenoh_are_reported_without_their_place_in_its_source() {
        let error = std::io::Error::other("Can not bind a listener at /root/zenoh/src/orchestrator.rs:123.");
        assert_eq!(in_short(&error), "Can not bind a listener");
    }

    #[test]
    fn long_or_lossless_messages_use_only_the_stream() {
        let [robot, base] = joined(|address| address);
        let (take, received) = channel();
        let mut publisher = robot.publisher(KEY, false, Priority::DataLow).unwrap();
        let mut subscriber = base.subscriber(KEY, None, move |bytes| drop(take.send(bytes))).unwrap();
        wait_until("a message comes by the stream", || {
            subscriber.choose().unwrap();
            publisher.put(b"objects".to_vec());
            let has_subscriber = received.recv_timeout(Duration::from_millis(20)).is_ok();
            has_subscriber && subscriber.stream.is_some() && subscriber.datagrams.is_none()
        });
        assert!(publisher.datagrams.is_none());
    }
}
