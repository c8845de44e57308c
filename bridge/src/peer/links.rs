//! What one bridge knows of the others: who lives, what they have received, how their clocks differ.
//!
//! A start of a bridge is a session. Whoever listens to a link can repeat what was said there, also what an earlier session of a
//! bridge has said. So a session is believed only when it has proved to be the present one: by a heartbeat that tells of a
//! heartbeat of this bridge's own session, sent later than any that the session before has told of. Heartbeats of a session
//! follow each other in time, and messages count only if they are of the session that has proved itself.
//!
//! A machine runs once. Where two runs of one name are there at a time, the one counts that was heard first, until it falls
//! silent: else each would stop what the other one has begun. Each of them learns of the other by what is heard of both.

use super::clock::{Clock, Exchange};
use super::heartbeat::{Ack, ClockSample, Heartbeat, News, Route};
use super::journal::{FinishedEdge, Journal};
use crate::wire::seal::Seal;
use crate::wire::{WireError, decode_note, encode_note, layouts};
use conicflow_dataflow::ports::Delivery;
use conicflow_dataflow::{BridgePlan, Edge, monotonic_ns};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// A peer of which nothing was heard for so long is not connected.
const SILENCE: Duration = Duration::from_millis(1500);
/// Of a peer that has not come after this time the user is told.
const PATIENCE: Duration = Duration::from_secs(5);

/// So many sessions of a peer are told of: the present one, one that is about to prove itself, and as many again of which
/// somebody repeats what they said. Those give way to one another, so that a new session proves itself all the same.
const SESSIONS: usize = 4;
/// So many reasons are told for which a peer is refused, one of each kind of [`WireError`]; who comes with ever new texts fills
/// no log.
const REASONS: usize = 10;

/// What is said of a message of a session that has been.
pub(crate) const OF_EARLIER_START: &str = "it is of an earlier start of the bridge there\n  \
                                           hint: it has come very late, or somebody repeats what was sent before";

/// The other machines, as the threads of a bridge share them.
pub(crate) struct Links {
    machine: String,
    session: u64,
    run: u64,
    routes: Vec<Route>,
    started: Instant,
    peers: Mutex<BTreeMap<String, Peer>>,
    acks: Mutex<BTreeMap<(String, String), Ack>>,
    journal: Mutex<Journal>,
    seal: Seal,
    /// Whether a peer waits for a heartbeat, to know that it is heard.
    owes_answer: AtomicBool,
}

/// One other machine.
#[derive(Default)]
pub(crate) struct Peer {
    heard: Option<Instant>,
    since: Option<Instant>,
    /// The last heartbeat of each of its sessions, proved or not, the newest last.
    samples: VecDeque<ClockSample>,
    /// By session, when the last heartbeat from here was sent that those tell of.
    told_ns: BTreeMap<u64, u64>,
    /// The session that has proved to be the present one.
    session: Option<u64>,
    /// When the heartbeat from here was sent by which it has, and by that machine's clock when it came there.
    proved_ns: [u64; 2],
    /// When the last heartbeat from here was sent that the peer has told of.
    answered_ns: u64,
    /// A session of another run, heard beside that one.
    rival: Option<Rival>,
    /// Whether the user was told that there are two runs, there or here.
    told_of_rivals: BTreeSet<Rivals>,
    /// Whether it has been told of a heartbeat of that session, and so knows the present one here.
    knows_us: bool,
    clock: Clock,
    /// The run of its machine, when it has been heard.
    run: Option<u64>,
    acks: BTreeMap<String, Ack>,
    /// What it knows to be finished.
    finished: BTreeSet<FinishedEdge>,
    refused: BTreeSet<String>,
    unlike: Vec<Route>,
    missed: bool,
}

/// A session of a second run.
#[derive(Clone, Copy)]
struct Rival {
    session: u64,
    /// When the heartbeat from here was sent that it has told of first.
    told_ns: u64,
}

/// Which machine runs twice.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Rivals {
    There,
    Here,
}

/// What is shown of a peer.
pub(crate) struct PeerState {
    pub was_heard: bool,
    pub connected: bool,
    /// For how long that is so.
    pub time: Duration,
    pub clock: Option<Exchange>,
}

fn lock<V>(mutex: &Mutex<V>) -> MutexGuard<'_, V> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Links {
    /// What a bridge knows before it has heard of anybody.
    pub(crate) fn new(journal: Journal, seal: Seal, bridge: &BridgePlan) -> Self {
        let peers = bridge.peers().into_iter().map(|peer| (peer.to_owned(), Peer::default())).collect();
        let (machine, routes) = (bridge.machine.clone(), routes(bridge));
        Self {
            machine,
            session: journal.session(),
            run: journal.run(),
            routes,
            started: Instant::now(),
            peers: Mutex::new(peers),
            acks: Mutex::default(),
            journal: Mutex::new(journal),
            seal,
            owes_answer: AtomicBool::new(false),
        }
    }

    /// What makes and checks the codes of messages.
    pub(crate) fn seal(&self) -> &Seal {
        &self.seal
    }

    /// Takes in a heartbeat that came under this Zenoh key.
    pub(crate) fn heard(&self, machine: &str, zenoh_key: &str, bytes: &[u8]) {
        let now_ns = monotonic_ns();
        let opened = self.seal.open(zenoh_key, bytes).and_then(|_| decode_note::<Heartbeat>(bytes));
        let mut peers = lock(&self.peers);
        let Some(peer) = peers.get_mut(machine) else { return };
        match opened {
            Ok(Heartbeat { layouts: theirs, .. }) if theirs != layouts() => {
                refuse(machine, peer, &WireError::Layout { ours: layouts(), theirs });
            }
            Ok(heartbeat) => self.take_in(machine, peer, heartbeat, now_ns),
            Err(error) => refuse(machine, peer, &error),
        }
    }

    /// Heartbeats may come by two ways, and somebody may repeat them: one that was overtaken tells nothing new.
    fn take_in(&self, machine: &str, peer: &mut Peer, heartbeat: Heartbeat, now_ns: u64) {
        let now = Instant::now();
        let sample = ClockSample {
            machine: machine.to_owned(),
            session: heartbeat.session,
            sent_ns: heartbeat.sent_ns,
            received_ns: now_ns,
        };
        let own = |sample: &&ClockSample| sample.machine == self.machine && sample.session == self.session;
        let (said, ahead) = heartbeat.samples.iter().filter(own).partition::<Vec<_>, _>(|own| own.sent_ns <= now_ns);
        if !ahead.is_empty() {
            // Either it is forged, or one of this machine's is that it has taken for true: each has to hear the true ones again.
            peer.samples.retain(|known| known.session != heartbeat.session);
            refuse(machine, peer, &WireError::Impossible("it has heard what this machine has not said yet"));
        }
        let Some(is_new_session) = peer.note(sample, said.first().map(|own| own.sent_ns)) else { return };
        if is_new_session {
            self.owes_answer.store(true, Ordering::Relaxed);
        }
        let Some(own) = said.first() else { return };
        let told_ns = own.sent_ns;
        if !peer.believes(&heartbeat, told_ns, now) {
            return;
        }
        peer.answered_ns = peer.answered_ns.max(told_ns);
        if !is_connected(peer, now) {
            tracing::info!("the link to machine `{machine}` is up");
            peer.since = Some(now);
        }
        peer.heard = Some(now);
        peer.run = Some(heartbeat.run);
        lock(&self.journal).note_heard(machine);
        self.compare(machine, peer, &heartbeat.routes);
        if peer.session.replace(heartbeat.session) != Some(heartbeat.session) {
            (peer.proved_ns, peer.rival) = ([told_ns, own.received_ns], None);
            peer.knows_us = false;
            peer.clock.clear();
            peer.acks.clear();
        }
        self.look_for_rivals(machine, peer, &heartbeat.samples, told_ns);
        peer.clock.add([own.sent_ns, own.received_ns, heartbeat.sent_ns, now_ns]);
        let News { acks, finished } = heartbeat.news;
        let acks = acks.into_iter().filter(|ack| ack.from == self.machine);
        peer.acks.extend(acks.map(|ack| (ack.topic.clone(), ack)));
        peer.finished = finished.into_iter().collect();
    }

    /// Says once that there are two runs of the other machine, or of this one. A run that was begun anew is none of two: of the
    /// one before it nothing is heard that was said after this one had begun.
    fn look_for_rivals(&self, machine: &str, peer: &mut Peer, samples: &[ClockSample], told_ns: u64) {
        let is_twice_there = peer.rival.is_some_and(|rival| told_ns > rival.told_ns);
        if is_twice_there && peer.told_of_rivals.insert(Rivals::There) {
            tracing::error!(
                "machine `{machine}` runs twice; what counts is the run that was heard first, as long as it is heard\n  \
                 hint: end one of the two"
            );
        }
        // What the one before has said may have been long under way.
        let begun_ns = peer.proved_ns[1].saturating_add(PATIENCE.as_nanos() as u64);
        let is_other = |sample: &ClockSample| sample.machine == self.machine && sample.session != self.session;
        let is_twice_here = samples.iter().any(|sample| is_other(sample) && sample.received_ns > begun_ns);
        if is_twice_here && peer.told_of_rivals.insert(Rivals::Here) {
            tracing::error!(
                "machine `{machine}` hears another run of machine `{}`, too; what counts there is the run that it heard \
                 first\n  hint: end one of the two; somebody may also repeat what this machine once sent",
                self.machine
            );
        }
    }

    /// Says once where the other machine's pipeline file is not this one's: what only one of the two expects never comes.
    fn compare(&self, machine: &str, peer: &mut Peer, theirs: &[Route]) {
        let between = |routes: &[Route]| -> Vec<Route> {
            routes.iter().filter(|route| route.is_between(&self.machine, machine)).cloned().collect()
        };
        let (ours, theirs) = (between(&self.routes), between(theirs));
        let only = |some: &[Route], others: &[Route]| {
            let routes = some.iter().filter(|route| !others.contains(route));
            let words: Vec<_> =
                routes.map(|Route { from, to, what }| format!("{what}, from `{from}` to `{to}`")).collect();
            if words.is_empty() { "nothing more".to_owned() } else { words.join("; ") }
        };
        let (here, there) = (only(&ours, &theirs), only(&theirs, &ours));
        if here != there && peer.unlike != theirs {
            tracing::error!(
                "machine `{machine}` has another pipeline file; what crosses here: {here}; there: {there}\n  \
                 hint: run the same file with the same --set on all machines"
            );
            peer.unlike = theirs;
        }
    }

    /// Notes how far an edge was received, for the next heartbeat to say.
    pub(crate) fn received(&self, ack: Ack) {
        lock(&self.acks).insert((ack.from.clone(), ack.topic.clone()), ack);
    }

    /// What there is to tell.
    pub(crate) fn news(&self) -> News {
        let acks = lock(&self.acks).values().cloned().collect();
        let peers = lock(&self.peers);
        let is_of_present = |(edge, by): &(&FinishedEdge, u64)| {
            edge.to == self.machine || peers.get(&edge.to).is_some_and(|peer| peer.is_of_run(*by))
        };
        let journal = lock(&self.journal);
        let finished: BTreeSet<_> = journal.finished().filter(is_of_present).map(|(edge, _)| edge.clone()).collect();
        News { acks, finished: finished.into_iter().collect() }
    }

    /// Whether an edge from here is finished: the machine that receives it has said so, to this process or an earlier one, and
    /// has begun no other run since.
    pub(crate) fn has_finished(&self, to: &str, topic: &str) -> bool {
        let edge =
            FinishedEdge { from: self.machine.clone(), to: to.to_owned(), topic: topic.to_owned(), run: self.run };
        let (peers, mut journal) = (lock(&self.peers), lock(&self.journal));
        let Some(peer) = peers.get(to) else { return false };
        match peer.run {
            Some(run) if peer.finished.contains(&edge) => journal.note_finished(edge.clone(), run),
            // It says so as long as its run lasts: somebody else has said it.
            Some(run) => journal.forget_finished(&edge, run),
            None => {}
        }
        journal.finished().any(|(finished, by)| *finished == edge && peer.is_of_run(by))
    }

    /// Notes that an edge to here is finished, if the machine that sends it has been heard: which run of it that is.
    pub(crate) fn finish(&self, from: &str, topic: &str) {
        let Some(run) = lock(&self.peers).get(from).and_then(|peer| peer.run) else { return };
        let (from, to, topic) = (from.to_owned(), self.machine.clone(), topic.to_owned());
        lock(&self.journal).note_finished(FinishedEdge { from, to, topic, run }, self.run);
    }

    /// Whether an edge to here is finished, and whether the machine that sends it is known to know.
    pub(crate) fn is_finished(&self, from: &str, topic: &str) -> (bool, bool) {
        let peers = lock(&self.peers);
        let journal = lock(&self.journal);
        let mut finished = journal.finished().map(|(edge, _)| edge);
        let edge = finished.find(|edge| edge.from == from && edge.to == self.machine && edge.topic == topic);
        let is_known = |edge: &FinishedEdge| peers.get(from).is_some_and(|peer| peer.finished.contains(edge));
        (edge.is_some(), edge.is_some_and(is_known))
    }

    /// Whether somebody has come, who is told so by the next heartbeat; since this was asked last.
    pub(crate) fn owes_answer(&self) -> bool {
        self.owes_answer.swap(false, Ordering::Relaxed)
    }

    /// Says a heartbeat, with this news, under this Zenoh key.
    pub(crate) fn say(&self, zenoh_key: &str, news: News, put: impl FnOnce(Vec<u8>)) {
        let heartbeat = self.heartbeat(news);
        let Ok(mut bytes) = encode_note(&heartbeat) else { return };
        self.seal.close(zenoh_key, &mut bytes);
        put(bytes);
        for (machine, peer) in lock(&self.peers).iter_mut() {
            let told = |sample: &ClockSample| sample.machine == *machine && Some(sample.session) == peer.session;
            peer.knows_us |= heartbeat.samples.iter().any(told);
        }
    }

    /// The heartbeat that is due now.
    fn heartbeat(&self, news: News) -> Heartbeat {
        let samples = lock(&self.peers).values().flat_map(|peer| peer.samples.clone()).collect();
        Heartbeat {
            session: self.session,
            run: self.run,
            sent_ns: monotonic_ns(),
            layouts: layouts(),
            routes: self.routes.clone(),
            samples,
            news,
        }
    }

    /// What a peer said it has of a topic.
    pub(crate) fn ack_of(&self, machine: &str, topic: &str) -> Option<Ack> {
        lock(&self.peers).get(machine)?.acks.get(topic).cloned()
    }

    /// When a peer was heard of last; before this process began, by the one that was killed, counts as then.
    pub(crate) fn last_heard(&self, machine: &str) -> Option<Instant> {
        let heard = lock(&self.peers).get(machine).and_then(|peer| peer.heard);
        heard.or_else(|| lock(&self.journal).has_heard(machine).then_some(self.started))
    }

    /// Whether a message is of the session of a machine that has proved to be the present one.
    ///
    /// # Errors
    /// It is of an earlier one.
    pub(crate) fn is_present(&self, machine: &str, session: u64) -> Result<bool, &'static str> {
        let peers = lock(&self.peers);
        let Some(peer) = peers.get(machine) else { return Ok(false) };
        let is_rival = || peer.rival.is_some_and(|rival| rival.session == session);
        match peer.session {
            Some(present) if session < present && !is_rival() => Err(OF_EARLIER_START),
            present => Ok(present == Some(session)),
        }
    }

    /// Whether a peer was heard of just now, and takes what is sent to it.
    pub(crate) fn is_connected(&self, machine: &str) -> bool {
        lock(&self.peers).get(machine).is_some_and(takes_messages)
    }

    /// The time to a peer and back, if it was heard of just now and takes what is sent to it.
    pub(crate) fn round_trip(&self, machine: &str) -> Option<Duration> {
        let peers = lock(&self.peers);
        let peer = peers.get(machine).filter(|peer| takes_messages(peer))?;
        let nanoseconds = peer.clock.best().map_or(0, |exchange| exchange.round_trip_ns);
        Some(Duration::from_nanos(u64::try_from(nanoseconds).unwrap_or(0)))
    }

    /// A peer's clock less the own one, in nanoseconds.
    pub(crate) fn clock_offset(&self, machine: &str) -> Option<i64> {
        lock(&self.peers).get(machine)?.clock.best().map(|exchange| exchange.offset_ns)
    }

    /// All peers; says which have fallen silent since the last look, and once which never came.
    pub(crate) fn look(&self) -> BTreeMap<String, PeerState> {
        let now = Instant::now();
        let mut states = BTreeMap::new();
        for (machine, peer) in lock(&self.peers).iter_mut() {
            if peer.since.is_some() && !is_connected(peer, now) {
                tracing::warn!("the link to machine `{machine}` is down");
                peer.since = None;
            }
            if now.saturating_duration_since(self.started) > PATIENCE {
                miss(machine, peer);
            }
            let since = peer.since.or(peer.heard).unwrap_or(self.started);
            let (was_heard, connected) = (peer.heard.is_some(), peer.since.is_some());
            let (time, clock) = (now.saturating_duration_since(since), peer.clock.best());
            states.insert(machine.clone(), PeerState { was_heard, connected, time, clock });
        }
        states
    }
}

impl Peer {
    /// Whether its machine is in this run, as far as is known.
    fn is_of_run(&self, run: u64) -> bool {
        self.run.is_none_or(|present| present == run)
    }

    /// Notes a heartbeat; nothing if it is no later than another of its session, else whether that is a new one. Later is what
    /// tells of a later one that was sent here, at `told_ns`, and else by the time of that machine: a forged time that is yet to
    /// come shuts out none of the true ones.
    fn note(&mut self, sample: ClockSample, told_ns: Option<u64>) -> Option<bool> {
        let known = self.samples.iter().position(|known| known.session == sample.session);
        let last_told_ns = self.told_ns.get(&sample.session).copied().unwrap_or_default();
        let told_ns = told_ns.unwrap_or(last_told_ns);
        if known.is_some_and(|at| (last_told_ns, self.samples[at].sent_ns) >= (told_ns, sample.sent_ns)) {
            return None;
        }
        // Of the session that has proved itself is told in any case.
        let other = || self.samples.iter().position(|known| Some(known.session) != self.session);
        let gives_way = known.or_else(|| other().filter(|_| self.samples.len() == SESSIONS));
        if let Some(sample) = gives_way.and_then(|at| self.samples.remove(at)) {
            self.told_ns.remove(&sample.session);
        }
        self.told_ns.insert(sample.session, told_ns);
        self.samples.push_back(sample);
        Some(known.is_none())
    }

    /// Whether a heartbeat counts that tells of one which was sent here at `told_ns`: it is of the present session, or of one
    /// that proves by it to be that. Another run has to wait until nothing is heard of the present one.
    fn believes(&mut self, heartbeat: &Heartbeat, told_ns: u64, now: Instant) -> bool {
        let &Heartbeat { session, run, .. } = heartbeat;
        if self.session == Some(session) {
            return true;
        }
        if is_connected(self, now) && self.run != Some(run) {
            // What was said to this bridge before that one had proved itself may be of a run that is no more.
            if told_ns > self.proved_ns[0] && self.rival.is_none_or(|rival| rival.session != session) {
                self.rival = Some(Rival { session, told_ns });
            }
            return false;
        }
        told_ns > self.answered_ns
    }
}

/// Whether messages to a peer are not in vain: it takes them from nobody before the session here has proved itself to it.
fn takes_messages(peer: &Peer) -> bool {
    peer.knows_us && is_connected(peer, Instant::now())
}

fn is_connected(peer: &Peer, now: Instant) -> bool {
    peer.heard.is_some_and(|heard| now.saturating_duration_since(heard) < SILENCE)
}

/// Says once that a peer has never been heard of, or does not hear this one, and was not refused either.
fn miss(machine: &str, peer: &mut Peer) {
    if peer.heard.is_some() || !peer.refused.is_empty() || peer.missed {
        return;
    }
    peer.missed = true;
    if peer.samples.is_empty() {
        tracing::warn!(
            "nothing was heard of machine `{machine}` in {} s\n  hint: is it started there with `--machine {machine}`, and \
             does one side `connect` to where the other listens? a router joins only what has mode: \"client\"",
            PATIENCE.as_secs()
        );
    } else {
        tracing::warn!(
            "machine `{machine}` is heard, and in {} s has not told that it hears this one\n  hint: what does it say there? \
             does an access control keep what this machine sends from it? somebody may also repeat what it once sent",
            PATIENCE.as_secs()
        );
    }
}

/// Says once why a peer is not listened to; who comes with ever new reasons fills no log.
fn refuse(machine: &str, peer: &mut Peer, error: &WireError) {
    let reason = error.to_string();
    if peer.refused.len() < REASONS && !peer.refused.contains(&reason) {
        tracing::error!("refused machine `{machine}`: {reason}");
        peer.refused.insert(reason);
    }
}

/// What crosses.
fn routes(bridge: &BridgePlan) -> Vec<Route> {
    bridge.outgoing.iter().chain(&bridge.incoming).flat_map(routes_of).collect()
}

/// What an edge carries to each machine.
fn routes_of(edge: &Edge) -> impl Iterator<Item = Route> {
    edge.to.iter().map(|receiver| {
        let delivery = if receiver.delivery == Delivery::Lossless { "lossless" } else { "latest" };
        let (topic, writers) = (&edge.topic.name, edge.writers.join(", "));
        let kind = if edge.item.is_built_in() { edge.item.name().to_owned() } else { edge.item.layout() };
        let what = format!("topic `{topic}` with {kind} of {writers}, {delivery}");
        Route { from: edge.from.clone(), to: receiver.machine.clone(), what }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::edge_tests::edge;
    use crate::wire::seal::secret;
    use conicflow_dataflow::{LinkKey, Receiver};

    /// What a bridge knows that has one other machine.
    fn links_of(machine: &str, peer: &str, journal: Journal, secret: &LinkKey) -> Links {
        links_with(machine, peer, journal, secret, Vec::new())
    }

    /// The same, with these edges.
    fn links_with(machine: &str, peer: &str, journal: Journal, secret: &LinkKey, outgoing: Vec<Edge>) -> Links {
        let plan = BridgePlan { machine: machine.to_owned(), outgoing, ..BridgePlan::default() };
        let seal = Seal::new(Some(secret), journal.session());
        let links = Links::new(journal, seal, &plan);
        lock(&links.peers).insert(peer.to_owned(), Peer::default());
        links
    }

    fn robot(number: u64, secret: &LinkKey) -> Links {
        links_of("robot", "base", Journal::open(None, 7, number), secret)
    }

    fn base(number: u64, secret: &LinkKey) -> Links {
        links_of("base", "robot", Journal::open(None, 7, number), secret)
    }

    /// The next heartbeat of a bridge, with acknowledgements of the machine `base`, as it goes onto the link.
    fn beat(links: &Links) -> Vec<u8> {
        let ack = Ack { from: "base".to_owned(), topic: "objects".to_owned(), next: links.session, ..Ack::default() };
        let mut said = Vec::new();
        links.say(&links.machine, News { acks: vec![ack], ..links.news() }, |bytes| said = bytes);
        said
    }

    fn hear(links: &Links, machine: &str, beats: &[Vec<u8>]) {
        beats.iter().for_each(|bytes| links.heard(machine, machine, bytes));
    }

    /// Lets two bridges talk; what the robot has said.
    fn talk(robot: &Links, base: &Links) -> Vec<Vec<u8>> {
        let mut said = Vec::new();
        for _ in 0..3 {
            said.push(beat(robot));
            hear(base, "robot", &said[said.len() - 1..]);
            hear(robot, "base", &[beat(base)]);
        }
        said
    }

    /// The session of the robot that a base believes, by what it has acknowledged, too.
    fn believed(base: &Links) -> Option<u64> {
        let acknowledged = base.ack_of("robot", "objects").map(|ack| ack.next);
        let session = lock(&base.peers)["robot"].session;
        assert_eq!(acknowledged, session);
        assert!(session.is_none_or(|session| base.is_present("robot", session) == Ok(true)));
        session
    }

    #[test]
    fn a_bridge_is_believed_when_it_has_heard_who_asks_and_sent_to_when_it_believes() {
        let secret = secret();
        let (robot, base) = (robot(1, &secret), base(2, &secret));
        hear(&base, "robot", &[beat(&robot)]);
        assert_eq!((believed(&base), base.owes_answer(), base.owes_answer()), (None, true, false));
        hear(&robot, "base", &[beat(&base)]);
        assert_eq!(robot.is_present("base", 2), Ok(true));
        assert!(robot.owes_answer() && !robot.is_connected("base"), "the base would not take anything yet");
        let answer = beat(&robot);
        assert!(robot.is_connected("base") && robot.round_trip("base").is_some());
        hear(&base, "robot", &[answer]);
        assert_eq!(believed(&base), Some(1));
    }

    #[test]
    fn a_link_is_up_since_the_first_heartbeat_that_was_believed() {
        let secret = secret();
        let (robot, base) = (robot(1, &secret), base(2, &secret));
        let since = || lock(&robot.peers)["base"].since;
        assert_eq!((since(), robot.look()["base"].connected), (None, false));
        talk(&robot, &base);
        let up = since();
        talk(&robot, &base);
        assert!(up.is_some() && since() == up && robot.look()["base"].connected);
    }

    #[test]
    fn what_an_earlier_start_of_a_bridge_has_said_is_not_believed_again() {
        let secret = secret();
        let first_base = base(10, &secret);
        let first_robot = robot(1, &secret);
        let mut recorded = talk(&first_robot, &first_base);
        assert_eq!(believed(&first_base), Some(1));
        let held_back = beat(&first_robot);
        // The robot's clock is set back in between.
        for number in [7, 3] {
            let present = robot(number, &secret);
            recorded.extend(talk(&present, &first_base));
            hear(&first_base, "robot", &recorded);
            assert_eq!(believed(&first_base), Some(number));
        }
        hear(&first_base, "robot", &[held_back]);
        assert_eq!(believed(&first_base), Some(3));
        assert_eq!(first_base.is_present("robot", 1), Err(OF_EARLIER_START));
        assert_eq!(first_base.is_present("robot", 7), Ok(false));
        let second_base = base(11, &secret);
        hear(&second_base, "robot", &recorded);
        assert_eq!(believed(&second_base), None, "nothing of that was said to this start of the base");
        talk(&robot(4, &secret), &second_base);
        assert_eq!(believed(&second_base), Some(4));
    }

    #[test]
    fn an_edge_is_finished_when_both_ends_know_it_also_to_those_who_are_started_anew() {
        let (secret, robot_folder, base_folder) =
            (secret(), tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let start = |machine: &str, peer: &str, folder: &tempfile::TempDir, run: u64, number: u64| {
            let journal = Journal::open(Some(folder.path()), run, number);
            links_of(machine, peer, journal, &secret)
        };
        let robot = |number| start("robot", "base", &robot_folder, 7, number);
        let base = |number| start("base", "robot", &base_folder, 8, number);
        let (first_robot, first_base) = (robot(1), base(2));
        first_base.finish("robot", "objects");
        assert_eq!(first_base.is_finished("robot", "objects"), (false, false), "of which run is not known");
        talk(&first_robot, &first_base);
        first_base.finish("robot", "objects");
        assert_eq!(first_base.is_finished("robot", "objects"), (true, false));
        assert!(!first_robot.has_finished("base", "objects"));
        // The base is started anew before it has told.
        let second_base = base(3);
        assert_eq!(second_base.is_finished("robot", "objects"), (true, false));
        talk(&first_robot, &second_base);
        assert!(first_robot.has_finished("base", "objects") && !first_robot.has_finished("base", "tracks"));
        // The robot is started anew before it has told that it knows.
        let second_robot = robot(4);
        assert!(second_robot.has_finished("base", "objects"));
        talk(&second_robot, &second_base);
        assert_eq!(second_base.is_finished("robot", "objects"), (true, true));
        assert_eq!(second_base.is_finished("robot", "tracks"), (false, false));
        // Another run of the base wants what is sent from now on.
        let next_base = start("base", "robot", &base_folder, 10, 6);
        fall_silent(&second_robot, "base");
        talk(&second_robot, &next_base);
        assert!(!second_robot.has_finished("base", "objects"));
        next_base.finish("robot", "objects");
        talk(&second_robot, &next_base);
        assert_eq!(
            next_base.is_finished("robot", "objects"),
            (true, false),
            "the robot knows it of the run before alone"
        );
        assert!(second_robot.has_finished("base", "objects"));
        talk(&second_robot, &next_base);
        assert_eq!(next_base.is_finished("robot", "objects"), (true, true));
        // Another run of the robot sends anew.
        let other_run = start("robot", "base", &robot_folder, 9, 5);
        fall_silent(&second_base, "robot");
        talk(&other_run, &second_base);
        assert!(!other_run.has_finished("base", "objects"));
    }

    /// Lets it be long ago that a peer was heard.
    fn fall_silent(links: &Links, peer: &str) {
        lock(&links.peers).get_mut(peer).unwrap().heard = Instant::now().checked_sub(SILENCE);
    }

    /// The runs of which a bridge was told that there are two.
    fn rivals(links: &Links, peer: &str) -> [bool; 2] {
        [Rivals::There, Rivals::Here].map(|which| lock(&links.peers)[peer].told_of_rivals.contains(&which))
    }

    #[test]
    fn of_two_runs_of_a_machine_the_first_counts_while_it_is_heard_and_they_are_told_of() {
        let secret = secret();
        let robot = |run, session| links_of("robot", "base", Journal::open(None, run, session), &secret);
        let (first, second, base) = (robot(7, 3), robot(8, 2), base(1, &secret));
        talk(&first, &base);
        for _ in 0..3 {
            talk(&second, &base);
            talk(&first, &base);
            assert_eq!((believed(&base), base.is_present("robot", 2)), (Some(3), Ok(false)));
        }
        assert_eq!(rivals(&base, "robot"), [true, false]);
        // Each of the two is told when the other one was heard for long after it.
        assert_eq!((rivals(&first, "base"), rivals(&second, "base")), ([false; 2], [false; 2]));
        for robot in [&first, &second] {
            let mut peers = lock(&robot.peers);
            let proved_ns = &mut peers.get_mut("base").unwrap().proved_ns[1];
            *proved_ns = proved_ns.saturating_sub(2 * PATIENCE.as_nanos() as u64);
        }
        talk(&second, &base);
        talk(&first, &base);
        assert_eq!((rivals(&first, "base"), rivals(&second, "base")), ([false, true], [false, true]));
        fall_silent(&base, "robot");
        talk(&second, &base);
        assert_eq!(believed(&base), Some(2), "the second takes its place");
    }

    #[test]
    fn a_run_that_was_begun_anew_is_not_taken_for_a_second_one() {
        let secret = secret();
        let robot = |run, session| links_of("robot", "base", Journal::open(None, run, session), &secret);
        let (first, second, base) = (robot(7, 1), robot(8, 2), base(1, &secret));
        let mut said = talk(&first, &base);
        said.push(beat(&first));
        talk(&second, &base);
        assert_eq!(believed(&base), Some(1), "the first was heard just now");
        hear(&base, "robot", &said);
        fall_silent(&base, "robot");
        talk(&second, &base);
        hear(&base, "robot", &said);
        assert_eq!(
            (believed(&base), rivals(&base, "robot"), rivals(&second, "base")),
            (Some(2), [false; 2], [false; 2])
        );
    }

    /// A heartbeat of a bridge after a change.
    fn forged(links: &Links, change: impl FnOnce(&mut Heartbeat)) -> Vec<u8> {
        let mut heartbeat = links.heartbeat(links.news());
        change(&mut heartbeat);
        let mut bytes = encode_note(&heartbeat).unwrap();
        links.seal.close(&links.machine, &mut bytes);
        bytes
    }

    #[test]
    fn a_heartbeat_of_a_time_that_has_not_come_shuts_out_none_of_the_true_ones() {
        let secret = secret();
        let sent_ns = |links: &Links, peer: &str| lock(&links.peers)[peer].samples[0].sent_ns;
        for both in [false, true] {
            let (robot, base) = (robot(1, &secret), base(2, &secret));
            talk(&robot, &base);
            let yet_to_come = |links: &Links| forged(links, |heartbeat| heartbeat.sent_ns = u64::MAX);
            hear(&base, "robot", &[yet_to_come(&robot)]);
            assert_eq!(sent_ns(&base, "robot"), u64::MAX);
            if both {
                hear(&robot, "base", &[yet_to_come(&base)]);
                // Those tell of the forged ones.
                let told = [beat(&robot), beat(&base)];
                hear(&base, "robot", &told[..1]);
                hear(&robot, "base", &told[1..]);
            }
            let proved = [(&base, "robot"), (&robot, "base")].map(|(links, peer)| {
                fall_silent(links, peer);
                lock(&links.peers)[peer].answered_ns
            });
            talk(&robot, &base);
            for ((links, peer), before) in [(&base, "robot"), (&robot, "base")].into_iter().zip(proved) {
                assert!(sent_ns(links, peer) < u64::MAX, "{peer}, both: {both}");
                assert!(lock(&links.peers)[peer].answered_ns > before, "{peer} is believed, both: {both}");
            }
        }
    }

    #[test]
    fn a_heartbeat_that_tells_of_what_was_not_said_is_refused() {
        let secret = secret();
        let (robot, base) = (robot(1, &secret), base(2, &secret));
        talk(&robot, &base);
        let ahead = forged(&robot, |heartbeat| heartbeat.samples[0].sent_ns = u64::MAX);
        hear(&base, "robot", &[ahead]);
        assert_eq!(lock(&base.peers)["robot"].refused.len(), 1);
        talk(&self::robot(3, &secret), &base);
        assert_eq!(believed(&base), Some(3), "who is started anew proves itself all the same");
    }

    #[test]
    fn an_edge_that_somebody_else_has_said_to_be_finished_goes_on() {
        let secret = secret();
        let (robot, base) = (robot(1, &secret), base(2, &secret));
        talk(&robot, &base);
        let finished = FinishedEdge { from: "robot".into(), to: "base".into(), topic: "objects".into(), run: 7 };
        hear(&robot, "base", &[forged(&base, |heartbeat| heartbeat.news.finished.push(finished))]);
        assert!(robot.has_finished("base", "objects"));
        talk(&robot, &base);
        assert!(!robot.has_finished("base", "objects"));
    }

    #[test]
    fn a_machine_that_an_earlier_process_has_heard_counts_as_heard_when_this_one_began() {
        let (secret, folder) = (secret(), tempfile::tempdir().unwrap());
        let robot = |number| links_of("robot", "base", Journal::open(Some(folder.path()), 7, number), &secret);
        let first = robot(1);
        assert_eq!(first.last_heard("base"), None);
        talk(&first, &base(2, &secret));
        let second = robot(3);
        assert_eq!(second.last_heard("base"), Some(second.started));
        assert!(!second.is_connected("base"));
    }

    #[test]
    fn repeated_heartbeats_do_not_keep_the_present_session_from_being_told_of() {
        let secret = secret();
        let base = base(100, &secret);
        let recorded: Vec<_> =
            (1..8).flat_map(|number| talk(&robot(number, &secret), &self::base(99, &secret))).collect();
        talk(&robot(8, &secret), &base);
        hear(&base, "robot", &recorded);
        let samples = &lock(&base.peers)["robot"].samples;
        assert!(samples.len() == SESSIONS && samples.iter().any(|sample| sample.session == 8), "{samples:?}");
    }

    #[test]
    fn a_machine_with_another_pipeline_file_is_told_from_one_with_the_same() {
        let secret = secret();
        let to_base = |delivery| edge(delivery, "reader");
        let to_arm = Edge {
            to: vec![Receiver { machine: "arm".into(), delivery: Delivery::Latest }],
            ..to_base(Delivery::Latest)
        };
        let start = |machine: &str, peer: &str, edges: &[Edge]| {
            links_with(machine, peer, Journal::open(None, 7, 1), &secret, edges.to_vec())
        };
        let base = start("base", "robot", &[to_base(Delivery::Lossless)]);
        let unlike = |edges: &[Edge]| {
            let robot = start("robot", "base", edges);
            let base = start("base", "robot", &[to_base(Delivery::Lossless)]);
            talk(&robot, &base);
            lock(&base.peers)["robot"].unlike.iter().map(|route| route.what.clone()).collect::<Vec<_>>()
        };
        assert!(base.routes[0].what.ends_with("of writer, lossless"), "{}", base.routes[0].what);
        assert!(
            unlike(&[to_base(Delivery::Lossless), to_arm]).is_empty(),
            "what goes elsewhere is no concern of this one"
        );
        let other = unlike(&[to_base(Delivery::Latest)]);
        assert!(other.len() == 1 && other[0].ends_with("of writer, latest"), "{other:?}");
    }

    #[test]
    fn the_news_are_how_far_each_edge_was_received_last() {
        let links = base(1, &secret());
        let ack = |topic: &str, next| Ack { from: "robot".to_owned(), topic: topic.to_owned(), next, ..Ack::default() };
        [ack("objects", 1), ack("tracks", 1), ack("objects", 2)].into_iter().for_each(|ack| links.received(ack));
        assert_eq!(links.news().acks, [ack("objects", 2), ack("tracks", 1)]);
    }

    #[test]
    fn the_quickest_exchange_of_heartbeats_tells_round_trip_and_clock() {
        let secret = secret();
        let (robot, base) = (robot(1, &secret), base(2, &secret));
        assert_eq!((robot.round_trip("base"), robot.clock_offset("base")), (None, None));
        talk(&robot, &base);
        let mut clock = Clock::default();
        clock.add([100, 1110, 1150, 160]);
        lock(&robot.peers).get_mut("base").unwrap().clock = clock;
        assert_eq!(
            (robot.round_trip("base"), robot.clock_offset("base")),
            (Some(Duration::from_nanos(20)), Some(1000))
        );
    }

    #[test]
    fn a_machine_is_connected_until_it_has_been_silent_for_long() {
        let heard = Instant::now();
        let peer = Peer { heard: Some(heard), ..Peer::default() };
        assert!(
            is_connected(&peer, heard + SILENCE - Duration::from_nanos(1)) && !is_connected(&peer, heard + SILENCE)
        );
    }

    #[test]
    fn a_machine_that_has_not_come_after_a_while_is_missed_unless_it_was_heard_or_refused() {
        let is_missed = |waited: Duration, peer: Peer| {
            let mut links = robot(1, &secret());
            links.started = Instant::now().checked_sub(waited).unwrap();
            lock(&links.peers).insert("base".to_owned(), peer);
            links.look();
            lock(&links.peers)["base"].missed
        };
        assert!(is_missed(2 * PATIENCE, Peer::default()) && !is_missed(Duration::ZERO, Peer::default()));
        assert!(!is_missed(2 * PATIENCE, Peer { heard: Some(Instant::now()), ..Peer::default() }));
        let refused = BTreeSet::from([WireError::WrongCode.to_string()]);
        assert!(!is_missed(2 * PATIENCE, Peer { refused, ..Peer::default() }));
    }

    #[test]
    fn no_more_reasons_for_a_refusal_are_kept_than_there_are_kinds() {
        let mut peer = Peer::default();
        (0..2 * REASONS).for_each(|at| refuse("robot", &mut peer, &WireError::Broken(at.to_string())));
        assert_eq!(peer.refused.len(), REASONS);
    }

    #[test]
    fn a_machine_whose_messages_are_laid_out_otherwise_is_refused() {
        let secret = secret();
        let (robot, base) = (robot(1, &secret), base(2, &secret));
        let theirs = "conicflow.Header.v1".to_owned();
        let heartbeat = Heartbeat { layouts: theirs.clone(), ..robot.heartbeat(News::default()) };
        let mut bytes = encode_note(&heartbeat).unwrap();
        robot.seal.close("robot", &mut bytes);
        hear(&base, "robot", &[bytes]);
        let peer = &lock(&base.peers)["robot"];
        let reason = WireError::Layout { ours: layouts(), theirs }.to_string();
        assert_eq!((&peer.refused, peer.samples.len()), (&BTreeSet::from([reason]), 0));
    }

    #[test]
    fn a_forged_heartbeat_changes_nothing_and_is_told() {
        let secrets = [secret(), secret()];
        let base = base(10, &secrets[0]);
        let present = robot(1, &secrets[0]);
        let said = talk(&present, &base);
        let sent_ns = || lock(&base.peers)["robot"].samples[0].sent_ns;
        let before = sent_ns();
        let next = beat(&present);
        for at in [6, 20, 45, next.len() - 1] {
            let mut changed = next.clone();
            changed[at] ^= 1;
            hear(&base, "robot", &[changed]);
        }
        hear(&base, "robot", &[next[..next.len() - 1].to_vec()]);
        base.heard("robot", "base", &next);
        let (stranger, ear) = (robot(2, &secrets[1]), self::base(10, &secrets[1]));
        hear(&base, "robot", &talk(&stranger, &ear));
        hear(&base, "robot", &said);
        assert_eq!((believed(&base), sent_ns()), (Some(1), before));
        let refused = lock(&base.peers)["robot"].refused.clone();
        assert_eq!(refused, BTreeSet::from([WireError::WrongCode.to_string()]));
        hear(&base, "robot", &[next]);
        assert_ne!(sent_ns(), before, "the true one passes");
    }
}
