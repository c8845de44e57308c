//! The Zenoh sessions of a machine: one over streams for everything, and where the file names endpoints for datagrams another
//! over these, for short messages of which the newest wins.
//!
//! A stream on a radio that loses packets holds back all that follows a loss until it was sent again; a datagram that is lost
//! is lost, and the next comes in time. Nothing tells a peer that datagrams do not reach it, and Zenoh's own declarations may
//! be among those that are lost: so a message goes by both sessions while the receiver listens to both, and it listens to the
//! stream as long as no datagrams come. Where none come the receiver subscribes to them anew, and nothing in that relies on
//! an earlier declaration, which may be lost ([`key_for_datagrams`]).

use crate::error::BridgeError;
use crate::settings;
use conicflow_dataflow::pipeline::Machine;
use conicflow_dataflow::{Stop, lock};
use std::sync::{Arc, Mutex, OnceLock};
use std::time::{Duration, Instant};
use zenoh::bytes::ZBytes;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait, pubsub};

/// A session that cannot be opened, because nobody is there yet, is tried again after this time.
const OPEN_AGAIN: Duration = Duration::from_secs(1);
/// Where no datagrams come, they are asked for again after so long.
const ASK_AGAIN: Duration = Duration::from_secs(5);

/// The open sessions of a machine.
pub(super) struct Sessions {
    streams: Session,
    datagrams: Arc<OnceLock<Session>>,
}

/// What is done with what comes.
type Take = Arc<dyn Fn(ZBytes) + Send + Sync>;

impl Sessions {
    /// Opens the sessions, as soon as that works; nothing if the run is made to end at once before. One that ends in order may have
    /// to be told of on the other machines, also by a bridge that is only just starting. `failed` is called after each attempt.
    pub(super) fn open(machine: &Machine, stop: &Stop, mut failed: impl FnMut()) -> Result<Option<Self>, BridgeError> {
        let (streams, datagrams) = settings::configurations(machine)?;
        let mut told = false;
        while !stop.forced() {
            match zenoh::open(streams.clone()).wait() {
                Ok(streams) => {
                    let sessions = Self { streams, datagrams: Arc::default() };
                    datagrams.iter().for_each(|config| sessions.open_datagrams(config, stop));
                    return Ok(Some(sessions));
                }
                Err(error) if !told => tracing::warn!(
                    "the link cannot be opened yet, and is tried again: {}\n  \
                     hint: does another program listen there, and do the files of the `zenoh` configuration exist?",
                    in_short(&*error)
                ),
                Err(_) => {}
            }
            told = true;
            failed();
            std::thread::sleep(OPEN_AGAIN);
        }
        Ok(None)
    }

    /// A peer has a session even where nobody is there, unless its endpoints are taken; a client has one when its router
    /// answers. The stream carries everything meanwhile.
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

    /// Whether there is a link to any other machine, or to a router.
    pub(super) fn reach_anybody(&self) -> bool {
        [Some(&self.streams), self.datagrams.get()].into_iter().flatten().any(reaches_anybody)
    }

    /// Makes a key ready to be written, also by datagrams if messages are `short`.
    pub(super) fn publisher(&self, key: &str, short: bool, priority: Priority) -> Result<Publisher<'_>, BridgeError> {
        let stream = declare(&self.streams, key, priority)?;
        Ok(Publisher { sessions: self, key: key.to_owned(), short, priority, stream, datagrams: None })
    }

    /// Listens to a key; if there is a longest `silence` between datagrams, to these alone as long as they come. `take` is
    /// called by threads of Zenoh, which must not wait.
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

/// Whether a session has a link to a router, or to anybody else.
pub(crate) fn reaches_anybody(session: &Session) -> bool {
    let info = session.info();
    info.routers_zid().wait().chain(info.peers_zid().wait()).next().is_some()
}

/// What Zenoh says, without the places in its source.
fn in_short(error: &dyn std::error::Error) -> String {
    let text = error.to_string();
    text.split(" at /").next().unwrap_or_default().to_owned()
}

/// A key that is written.
pub(super) struct Publisher<'a> {
    sessions: &'a Sessions,
    key: String,
    short: bool,
    priority: Priority,
    stream: pubsub::Publisher<'static>,
    /// That for datagrams, and when it was declared.
    datagrams: Option<(pubsub::Publisher<'static>, Instant)>,
}

impl Publisher<'_> {
    /// Puts a message into each session in which somebody listens; whether it arrives has to be learnt otherwise.
    pub(super) fn put(&mut self, bytes: Vec<u8>) {
        self.ask_who_listens();
        let bytes = ZBytes::from(bytes);
        self.publishers().for_each(|publisher| drop(publisher.put(bytes.clone()).wait()));
    }

    /// Declares the key to the session for datagrams, if there is one for it; anew where nobody answered: Zenoh asks who
    /// listens but once, and that may have been lost.
    fn ask_who_listens(&mut self) {
        let Some(session) = self.sessions.datagrams.get().filter(|_| self.short) else { return };
        let has_answer = |(publisher, asked): &(_, Instant)| asked.elapsed() < ASK_AGAIN || is_heard(publisher);
        if !self.datagrams.as_ref().is_some_and(has_answer) {
            self.datagrams = None;
            self.datagrams =
                declare(session, &self.key, self.priority).ok().map(|publisher| (publisher, Instant::now()));
        }
    }

    fn publishers(&self) -> impl Iterator<Item = &pubsub::Publisher<'static>> {
        std::iter::once(&self.stream).chain(self.datagrams.as_ref().map(|(publisher, _)| publisher))
    }

    /// Whether anybody listens.
    pub(super) fn is_heard(&self) -> bool {
        self.publishers().any(is_heard)
    }
}

fn declare(session: &Session, key: &str, priority: Priority) -> Result<pubsub::Publisher<'static>, BridgeError> {
    let publisher = session.declare_publisher(key.to_owned()).priority(priority);
    let publisher = publisher.congestion_control(CongestionControl::Drop).express(priority != Priority::DataLow);
    publisher.wait().map_err(|error| BridgeError::zenoh("cannot declare a key to Zenoh", error))
}

/// The expression by which a key is listened to over datagrams. To a peer Zenoh says a key but once, and from then on, in
/// subscriptions too, a number that stands for it; where that first word was lost, no later subscription is understood. What
/// begins with a wildcard gets no number: each subscription says it in full.
fn key_for_datagrams(key: &str) -> String {
    let after_first_part = key.split_once('/').map_or(key, |(_, rest)| rest);
    format!("*/{after_first_part}")
}

fn is_heard(publisher: &pubsub::Publisher) -> bool {
    publisher.matching_status().wait().is_ok_and(|status| status.matching())
}

fn subscribe(session: &Session, key: String, take: Take) -> Result<pubsub::Subscriber<()>, BridgeError> {
    let declared = session.declare_subscriber(key).callback(move |sample| take(sample.payload().clone())).wait();
    declared.map_err(|error| BridgeError::zenoh("cannot subscribe to a key of Zenoh", error))
}

/// A key that is listened to.
pub(super) struct Subscriber<'a> {
    sessions: &'a Sessions,
    key: String,
    take: Take,
    /// The longest between datagrams, if they are listened to.
    silence: Option<Duration>,
    stream: Option<pubsub::Subscriber<()>>,
    datagrams: Option<Datagrams>,
}

/// Its part for datagrams.
struct Datagrams {
    silence: Duration,
    asked: Instant,
    came: Arc<Mutex<Option<Instant>>>,
    _subscriber: pubsub::Subscriber<()>,
}

impl Datagrams {
    fn come(&self) -> bool {
        let came = *lock(&self.came);
        came.is_some_and(|came| came.elapsed() < self.silence)
    }
}

impl Subscriber<'_> {
    fn subscribe_to_stream(&self) -> Result<pubsub::Subscriber<()>, BridgeError> {
        subscribe(&self.sessions.streams, self.key.clone(), Arc::clone(&self.take))
    }

    /// Subscribes to datagrams, where they are listened to and there is a session for them.
    fn ask_for_datagrams(&mut self) -> Result<(), BridgeError> {
        let (Some(session), Some(silence)) = (self.sessions.datagrams.get(), self.silence) else { return Ok(()) };
        let (take, came) = (Arc::clone(&self.take), Arc::<Mutex<Option<Instant>>>::default());
        let clock = Arc::clone(&came);
        let note_and_take = move |bytes| {
            *lock(&clock) = Some(Instant::now());
            take(bytes);
        };
        let subscriber = subscribe(session, key_for_datagrams(&self.key), Arc::new(note_and_take))?;
        self.datagrams = Some(Datagrams { silence, asked: Instant::now(), came, _subscriber: subscriber });
        Ok(())
    }

    /// Chooses the session anew; to be called now and then. What it is over, if that has changed.
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

    /// Two machines that are joined by a stream and by datagrams, which `between` takes from one address to the other.
    pub fn joined(between: fn(SocketAddr) -> SocketAddr) -> [Sessions; 2] {
        let (stream, datagrams) = (loopback(), loopback()["tcp/".len()..].parse::<SocketAddr>().unwrap());
        let endpoints = |datagrams| vec![stream.clone(), format!("udp/{datagrams}")];
        let listening = Machine { listen: endpoints(datagrams), ..Machine::default() };
        let connecting = Machine { connect: endpoints(between(datagrams)), ..Machine::default() };
        [listening, connecting].map(|machine| Sessions::open(&machine, &Stop::default(), || ()).unwrap().unwrap())
    }

    /// A way to an address on which the first datagram with a part of the key in it is lost.
    fn losing_the_first_with_the_key(address: SocketAddr) -> SocketAddr {
        let (front, back) = (UdpSocket::bind("127.0.0.1:0").unwrap(), UdpSocket::bind("127.0.0.1:0").unwrap());
        let way = front.local_addr().unwrap();
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
        way
    }

    #[test]
    fn short_messages_come_by_datagrams_though_the_question_for_them_is_lost_and_by_the_stream_where_none_come() {
        for between in [|address: SocketAddr| address, losing_the_first_with_the_key] {
            let [robot, base] = joined(between);
            let (take, heard) = channel();
            let mut publisher = robot.publisher(KEY, true, Priority::InteractiveHigh).unwrap();
            let mut subscriber =
                base.subscriber(KEY, Some(Duration::from_secs(1)), move |bytes| drop(take.send(bytes))).unwrap();
            let mut publish_until_it_comes = |by_the_stream: bool| {
                wait_until("a message comes as it is to come", || {
                    subscriber.choose().unwrap();
                    publisher.put(b"objects".to_vec());
                    let is_heard = heard.recv_timeout(Duration::from_millis(20)).is_ok();
                    is_heard && subscriber.stream.is_some() == by_the_stream
                });
            };
            publish_until_it_comes(false);
            robot.datagrams.get().unwrap().close().wait().unwrap();
            while heard.try_recv().is_ok() {}
            publish_until_it_comes(true);
        }
    }

    #[test]
    fn who_listens_to_datagrams_is_asked_anew_after_a_while_and_not_with_each_message() {
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
    fn who_sends_no_datagrams_is_asked_anew_after_a_while_and_not_with_each_look() {
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
    fn it_is_known_whether_anybody_is_there_and_whether_anybody_listens() {
        let alone = Sessions::open(&Machine::default(), &Stop::default(), || ()).unwrap().unwrap();
        let [robot, base] = joined(|address| address);
        let publisher = robot.publisher(KEY, false, Priority::DataLow).unwrap();
        assert!(!alone.reach_anybody() && !publisher.is_heard());
        let _subscriber = base.subscriber(KEY, None, |_| ()).unwrap();
        let is_known = || robot.reach_anybody() && base.reach_anybody() && publisher.is_heard();
        wait_until("somebody is there and listens", is_known);
    }

    #[test]
    fn what_zenoh_says_is_told_without_the_place_in_its_source() {
        let error = std::io::Error::other("Can not bind a listener at /root/zenoh/src/orchestrator.rs:123.");
        assert_eq!(in_short(&error), "Can not bind a listener");
    }

    #[test]
    fn what_is_long_or_must_not_be_lost_goes_by_the_stream_alone() {
        let [robot, base] = joined(|address| address);
        let (take, heard) = channel();
        let mut publisher = robot.publisher(KEY, false, Priority::DataLow).unwrap();
        let mut subscriber = base.subscriber(KEY, None, move |bytes| drop(take.send(bytes))).unwrap();
        wait_until("a message comes by the stream", || {
            subscriber.choose().unwrap();
            publisher.put(b"objects".to_vec());
            let is_heard = heard.recv_timeout(Duration::from_millis(20)).is_ok();
            is_heard && subscriber.stream.is_some() && subscriber.datagrams.is_none()
        });
        assert!(publisher.datagrams.is_none());
    }
}
