//! The state of a bridge's peers: which are alive, what they have received, and how their clocks differ.
//!
//! Each start of a bridge is a session. Anybody who listens to a link can replay what was sent there, including the messages of
//! an earlier session. So a session is believed only after it has proved to be the present one: one of its heartbeats has to
//! report a heartbeat of this bridge's own session that was sent later than any that the session before has reported. Heartbeats
//! of a session are ordered in time, and messages count only if they belong to the session that has proved itself.
//!
//! Each machine runs once. If two runs use one name at the same time, the one that was heard first counts until it falls silent;
//! otherwise each would stop what the other has begun. Both runs learn of the conflict, because their peer hears both.

use super::clock::{Clock, Exchange};
use super::heartbeat::{Ack, ClockSample, Heartbeat, News, Route};
use super::journal::{FinishedEdge, Journal};
use crate::logged_once::LoggedOnce;
use crate::wire::seal::Seal;
use crate::wire::{WireError, decode_note, encode_note, layouts};
use conicflow_dataflow::ports::Delivery;
use conicflow_dataflow::{BridgePlan, Edge, lock, monotonic_ns};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// A peer that was not heard for this time is disconnected.
const DISCONNECTED_AFTER: Duration = Duration::from_millis(1500);
/// A peer that has not come after this time is reported to the user.
const REPORT_MISSING_AFTER: Duration = Duration::from_secs(5);

/// Number of sessions of a peer that a heartbeat reports: the present one, one that is about to prove itself, and two more that
/// a third party may replay. Replayed sessions displace one another, so a new session can still prove itself.
const SESSIONS: usize = 4;

/// The reason why a message of an earlier session is refused.
pub(crate) const OF_EARLIER_START: &str = "it is of an earlier start of the bridge there\n  \
                                           hint: it has come very late, or somebody repeats what was sent before";

/// The state of all peers, shared by the threads of a bridge.
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
    /// Whether a new peer session waits for a heartbeat that confirms it was heard.
    owes_answer: AtomicBool,
}

/// One other machine.
#[derive(Default)]
pub(crate) struct Peer {
    heard_at: Option<Instant>,
    connected_since: Option<Instant>,
    /// The last heartbeat of each session of the peer, proved or not, the newest last.
    samples: VecDeque<ClockSample>,
    /// By session: when the last of this bridge's heartbeats that the session has reported was sent.
    reported_ns: BTreeMap<u64, u64>,
    /// The session that has proved to be the present one.
    session: Option<u64>,
    /// When the heartbeat from here that proved the session was sent, by this clock, and received, by the peer's clock.
    proved_ns: [u64; 2],
    /// When the last heartbeat from here that the peer has reported was sent.
    answered_ns: u64,
    /// A session of another run that is heard at the same time as `session`.
    rival: Option<Rival>,
    /// Which double runs were reported to the user.
    reported_rivals: BTreeSet<Rivals>,
    /// Whether the peer has received a report of its present session, and so knows the session here.
    knows_this_session: bool,
    clock: Clock,
    /// The run of the peer's machine, once heard.
    run: Option<u64>,
    acks: BTreeMap<String, Ack>,
    /// The edges that the peer knows to be finished.
    finished: BTreeSet<FinishedEdge>,
    refused: LoggedOnce,
    /// When something in the peer's name was last refused.
    refused_at: Option<Instant>,
    unlike: Vec<Route>,
    missed: bool,
}

/// A session of a second run.
#[derive(Clone, Copy)]
struct Rival {
    session: u64,
    /// When the first heartbeat from here that it has reported was sent.
    reported_ns: u64,
}

/// Which machine runs twice.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Rivals {
    There,
    Here,
}

/// The state of a peer, for display.
pub(crate) struct PeerState {
    pub was_heard: bool,
    pub connected: bool,
    /// Whether messages in the peer's name are currently refused.
    pub refused: bool,
    /// How long the peer has been connected or, if it is not, silent.
    pub time: Duration,
    pub clock: Option<Exchange>,
}

impl Links {
    /// Returns the state before any peer was heard.
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

    /// Returns the seal, which makes and checks the codes of messages.
    pub(crate) fn seal(&self) -> &Seal {
        &self.seal
    }

    /// Processes a heartbeat that came under this Zenoh key.
    pub(crate) fn receive_heartbeat(&self, machine: &str, zenoh_key: &str, bytes: &[u8]) {
        let now_ns = monotonic_ns();
        let verified = self.seal.verify(zenoh_key, bytes).and_then(|_| decode_note::<Heartbeat>(bytes));
        let mut peers = lock(&self.peers);
        let Some(peer) = peers.get_mut(machine) else { return };
        match verified {
            Ok(Heartbeat { layouts: theirs, .. }) if theirs != layouts() => {
                refuse(machine, peer, &WireError::Layout { ours: layouts(), theirs });
            }
            Ok(heartbeat) => self.process_heartbeat(machine, peer, heartbeat, now_ns),
            Err(error) => refuse(machine, peer, &error),
        }
    }

    /// Updates a peer from a heartbeat. Heartbeats may come by two paths or be replayed: one that was overtaken is ignored.
    fn process_heartbeat(&self, machine: &str, peer: &mut Peer, heartbeat: Heartbeat, now_ns: u64) {
        let now = Instant::now();
        let sample = ClockSample {
            machine: machine.to_owned(),
            session: heartbeat.session,
            sent_ns: heartbeat.sent_ns,
            received_ns: now_ns,
        };
        let own = |sample: &&ClockSample| sample.machine == self.machine && sample.session == self.session;
        let (reported_samples, ahead) =
            heartbeat.samples.iter().filter(own).partition::<Vec<_>, _>(|own| own.sent_ns <= now_ns);
        if !ahead.is_empty() {
            // Either the heartbeat is forged, or the peer has believed a forged one of this machine: each has to hear the true
            // ones again.
            peer.samples.retain(|known| known.session != heartbeat.session);
            refuse(machine, peer, &WireError::Impossible("it has heard what this machine has not said yet"));
        }
        let Some(is_new_session) = peer.note(sample, reported_samples.first().map(|own| own.sent_ns)) else { return };
        if is_new_session {
            self.owes_answer.store(true, Ordering::Relaxed);
        }
        let Some(own) = reported_samples.first() else { return };
        let reported_ns = own.sent_ns;
        if !peer.believes(&heartbeat, reported_ns, now) {
            return;
        }
        peer.answered_ns = peer.answered_ns.max(reported_ns);
        if !is_connected(peer, now) {
            tracing::info!("the link to machine `{machine}` is up");
            peer.connected_since = Some(now);
        }
        peer.heard_at = Some(now);
        peer.run = Some(heartbeat.run);
        lock(&self.journal).note_heard(machine);
        self.report_differences(machine, peer, &heartbeat.routes);
        if peer.session.replace(heartbeat.session) != Some(heartbeat.session) {
            (peer.proved_ns, peer.rival) = ([reported_ns, own.received_ns], None);
            peer.knows_this_session = false;
            peer.clock.clear();
            peer.acks.clear();
        }
        self.report_rivals(machine, peer, &heartbeat.samples, reported_ns);
        peer.clock.add([own.sent_ns, own.received_ns, heartbeat.sent_ns, now_ns]);
        let News { acks, finished } = heartbeat.news;
        let acks = acks.into_iter().filter(|ack| ack.from == self.machine);
        peer.acks.extend(acks.map(|ack| (ack.topic.clone(), ack)));
        peer.finished = finished.into_iter().collect();
    }

    /// Reports once that the other machine, or this one, runs twice. A restarted run is no second run: nothing is heard of the
    /// run before it that was sent after the new one began.
    fn report_rivals(&self, machine: &str, peer: &mut Peer, samples: &[ClockSample], reported_ns: u64) {
        let is_twice_there = peer.rival.is_some_and(|rival| reported_ns > rival.reported_ns);
        if is_twice_there && peer.reported_rivals.insert(Rivals::There) {
            tracing::error!(
                "machine `{machine}` runs twice; what counts is the run that was heard first, as long as it is heard\n  \
                 hint: end one of the two"
            );
        }
        // Messages of the run before may have been under way for long.
        let begun_ns = peer.proved_ns[1].saturating_add(REPORT_MISSING_AFTER.as_nanos() as u64);
        let is_other = |sample: &ClockSample| sample.machine == self.machine && sample.session != self.session;
        let is_twice_here = samples.iter().any(|sample| is_other(sample) && sample.received_ns > begun_ns);
        if is_twice_here && peer.reported_rivals.insert(Rivals::Here) {
            tracing::error!(
                "machine `{machine}` hears another run of machine `{}`, too; what counts there is the run that it heard \
                 first\n  hint: end one of the two; somebody may also repeat what this machine once sent",
                self.machine
            );
        }
    }

    /// Reports once that the other machine's pipeline file differs from this one's: routes that only one of the two expects never
    /// work.
    fn report_differences(&self, machine: &str, peer: &mut Peer, theirs: &[Route]) {
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
        let (only_ours, only_theirs) = (only(&ours, &theirs), only(&theirs, &ours));
        if only_ours != only_theirs && peer.unlike != theirs {
            tracing::error!(
                "machine `{machine}` has another pipeline file; what crosses here: {only_ours}; there: {only_theirs}\n  \
                 hint: run the same file with the same --set on all machines"
            );
            peer.unlike = theirs;
        }
    }

    /// Notes how far an edge was received, for the next heartbeat.
    pub(crate) fn note_ack(&self, ack: Ack) {
        lock(&self.acks).insert((ack.from.clone(), ack.topic.clone()), ack);
    }

    /// Returns the news for the next heartbeat.
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

    /// Whether an edge from here is finished: the receiving machine has said so to this process or an earlier one, and has begun
    /// no other run since.
    pub(crate) fn has_finished(&self, to: &str, topic: &str) -> bool {
        let edge =
            FinishedEdge { from: self.machine.clone(), to: to.to_owned(), topic: topic.to_owned(), run: self.run };
        let (peers, mut journal) = (lock(&self.peers), lock(&self.journal));
        let Some(peer) = peers.get(to) else { return false };
        match peer.run {
            Some(run) if peer.finished.contains(&edge) => journal.note_finished(edge.clone(), run),
            // A peer reports a finished edge in each heartbeat of its run; this one does not, so the note was not its own.
            Some(run) => journal.forget_finished(&edge, run),
            None => {}
        }
        journal.finished().any(|(finished, by)| *finished == edge && peer.is_of_run(by))
    }

    /// Notes that an edge to here is finished, if the run of the sending machine is known.
    pub(crate) fn note_finished(&self, from: &str, topic: &str) {
        let Some(run) = lock(&self.peers).get(from).and_then(|peer| peer.run) else { return };
        let (from, to, topic) = (from.to_owned(), self.machine.clone(), topic.to_owned());
        lock(&self.journal).note_finished(FinishedEdge { from, to, topic, run }, self.run);
    }

    /// Whether an edge to here is finished, and whether the sending machine is known to know that.
    pub(crate) fn is_finished(&self, from: &str, topic: &str) -> (bool, bool) {
        let peers = lock(&self.peers);
        let journal = lock(&self.journal);
        let mut finished = journal.finished().map(|(edge, _)| edge);
        let edge = finished.find(|edge| edge.from == from && edge.to == self.machine && edge.topic == topic);
        let is_known = |edge: &FinishedEdge| peers.get(from).is_some_and(|peer| peer.finished.contains(edge));
        (edge.is_some(), edge.is_some_and(is_known))
    }

    /// Notes that a writer of an edge to here has ended after `count` messages. This has to happen before the end is
    /// acknowledged: after that the other machine may leave, and a restarted bridge could not learn it from anybody.
    pub(crate) fn note_end(&self, from: &str, topic: &str, writer: &str, count: u64) {
        lock(&self.journal).note_end(from, topic, writer, count);
    }

    /// Returns the writers of an edge to here that have ended, as noted by this process or an earlier one, with the number of
    /// messages of each.
    pub(crate) fn ends(&self, from: &str, topic: &str) -> BTreeMap<String, u64> {
        lock(&self.journal).ends(from, topic)
    }

    /// Whether, since the last call, a new session was heard, which the next heartbeat has to confirm.
    pub(crate) fn owes_answer(&self) -> bool {
        self.owes_answer.swap(false, Ordering::Relaxed)
    }

    /// Sends a heartbeat with this news under this Zenoh key, by calling `put`.
    pub(crate) fn send_heartbeat(&self, zenoh_key: &str, news: News, put: impl FnOnce(Vec<u8>)) {
        let heartbeat = self.heartbeat(news);
        let Ok(mut bytes) = encode_note(&heartbeat) else { return };
        self.seal.sign(zenoh_key, &mut bytes);
        put(bytes);
        for (machine, peer) in lock(&self.peers).iter_mut() {
            let confirms_peer =
                |sample: &ClockSample| sample.machine == *machine && Some(sample.session) == peer.session;
            peer.knows_this_session |= heartbeat.samples.iter().any(confirms_peer);
        }
    }

    /// Builds the heartbeat to send now.
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

    /// Returns the last acknowledgement of a peer for a topic.
    pub(crate) fn ack_of(&self, machine: &str, topic: &str) -> Option<Ack> {
        lock(&self.peers).get(machine)?.acks.get(topic).cloned()
    }

    /// When a peer was last heard. If only an earlier process of this bridge heard it, that counts as the start of this process.
    pub(crate) fn last_heard(&self, machine: &str) -> Option<Instant> {
        self.heard_by_this_process(machine).or_else(|| lock(&self.journal).has_heard(machine).then_some(self.started))
    }

    /// How long a peer has been silent, counted from `since` at the earliest; for a peer that this process has never heard, from
    /// the start of this process.
    pub(crate) fn silence(&self, machine: &str, since: Instant) -> Duration {
        self.heard_by_this_process(machine).map_or(self.started, |heard_at| heard_at.max(since)).elapsed()
    }

    fn heard_by_this_process(&self, machine: &str) -> Option<Instant> {
        lock(&self.peers).get(machine)?.heard_at
    }

    /// Whether a message belongs to the session of a machine that has proved to be the present one.
    ///
    /// # Errors
    /// The message belongs to an earlier session.
    pub(crate) fn is_present(&self, machine: &str, session: u64) -> Result<bool, &'static str> {
        let peers = lock(&self.peers);
        let Some(peer) = peers.get(machine) else { return Ok(false) };
        let is_rival = || peer.rival.is_some_and(|rival| rival.session == session);
        match peer.session {
            Some(present) if session < present && !is_rival() => Err(OF_EARLIER_START),
            present => Ok(present == Some(session)),
        }
    }

    /// Whether a peer is connected and accepts messages from here.
    pub(crate) fn is_connected(&self, machine: &str) -> bool {
        lock(&self.peers).get(machine).is_some_and(takes_messages)
    }

    /// Returns the round-trip time to a peer, if it is connected and accepts messages from here.
    pub(crate) fn round_trip(&self, machine: &str) -> Option<Duration> {
        let peers = lock(&self.peers);
        let peer = peers.get(machine).filter(|peer| takes_messages(peer))?;
        let nanoseconds = peer.clock.best().map_or(0, |exchange| exchange.round_trip_ns);
        Some(Duration::from_nanos(u64::try_from(nanoseconds).unwrap_or(0)))
    }

    /// Returns the offset of a peer's clock from this machine's clock, in nanoseconds.
    pub(crate) fn clock_offset(&self, machine: &str) -> Option<i64> {
        lock(&self.peers).get(machine)?.clock.best().map(|exchange| exchange.offset_ns)
    }

    /// Returns the state of all peers. Logs which have fallen silent since the last call, and once which never came.
    pub(crate) fn check_peers(&self) -> BTreeMap<String, PeerState> {
        let now = Instant::now();
        let mut states = BTreeMap::new();
        for (machine, peer) in lock(&self.peers).iter_mut() {
            if peer.connected_since.is_some() && !is_connected(peer, now) {
                let comes = self.routes.iter().any(|route| route.from == *machine);
                let consequence =
                    if comes { "; what comes from there is waited for, also in its next run" } else { "" };
                tracing::warn!("the link to machine `{machine}` is down{consequence}");
                peer.connected_since = None;
            }
            if now.saturating_duration_since(self.started) > REPORT_MISSING_AFTER {
                report_missing(machine, peer);
            }
            let state_since = peer.connected_since.or(peer.heard_at).unwrap_or(self.started);
            let (was_heard, connected) = (peer.heard_at.is_some(), peer.connected_since.is_some());
            let refused = is_recent(peer.refused_at, now);
            let (time, clock) = (now.saturating_duration_since(state_since), peer.clock.best());
            states.insert(machine.clone(), PeerState { was_heard, connected, refused, time, clock });
        }
        states
    }
}

impl Peer {
    /// Whether its machine is in this run, or its run is unknown.
    fn is_of_run(&self, run: u64) -> bool {
        self.run.is_none_or(|present| present == run)
    }

    /// Notes a heartbeat. Returns `None` if it is not later than another of its session, else whether its session is new. The
    /// later heartbeat is the one that reports a later heartbeat of this bridge (sent at `reported_ns`); only if these are equal
    /// does the peer's own time decide. So a forged time in the future does not block genuine heartbeats.
    fn note(&mut self, sample: ClockSample, reported_ns: Option<u64>) -> Option<bool> {
        let known = self.samples.iter().position(|known| known.session == sample.session);
        let last_reported_ns = self.reported_ns.get(&sample.session).copied().unwrap_or_default();
        let reported_ns = reported_ns.unwrap_or(last_reported_ns);
        if known.is_some_and(|at| (last_reported_ns, self.samples[at].sent_ns) >= (reported_ns, sample.sent_ns)) {
            return None;
        }
        // The session that has proved itself is never displaced.
        let other = || self.samples.iter().position(|known| Some(known.session) != self.session);
        let gives_way = known.or_else(|| other().filter(|_| self.samples.len() == SESSIONS));
        if let Some(sample) = gives_way.and_then(|at| self.samples.remove(at)) {
            self.reported_ns.remove(&sample.session);
        }
        self.reported_ns.insert(sample.session, reported_ns);
        self.samples.push_back(sample);
        Some(known.is_none())
    }

    /// Whether a heartbeat counts that reports one sent from here at `reported_ns`: it belongs to the present session, or proves
    /// by this report that its session is the present one. Another run has to wait until the present one is silent.
    fn believes(&mut self, heartbeat: &Heartbeat, reported_ns: u64, now: Instant) -> bool {
        let &Heartbeat { session, run, .. } = heartbeat;
        if self.session == Some(session) {
            return true;
        }
        if is_connected(self, now) && self.run != Some(run) {
            // A report of an earlier heartbeat may come from a run that has ended.
            if reported_ns > self.proved_ns[0] && self.rival.is_none_or(|rival| rival.session != session) {
                self.rival = Some(Rival { session, reported_ns });
            }
            return false;
        }
        reported_ns > self.answered_ns
    }
}

/// Whether a peer accepts messages from here: before the session here has proved itself, the peer drops them.
fn takes_messages(peer: &Peer) -> bool {
    peer.knows_this_session && is_connected(peer, Instant::now())
}

fn is_connected(peer: &Peer, now: Instant) -> bool {
    is_recent(peer.heard_at, now)
}

fn is_recent(time: Option<Instant>, now: Instant) -> bool {
    time.is_some_and(|time| now.saturating_duration_since(time) < DISCONNECTED_AFTER)
}

/// Reports once that a peer was never heard, or does not hear this one, unless it was refused.
fn report_missing(machine: &str, peer: &mut Peer) {
    if peer.heard_at.is_some() || !peer.refused.texts().is_empty() || peer.missed {
        return;
    }
    peer.missed = true;
    if peer.samples.is_empty() {
        tracing::warn!(
            "nothing was heard of machine `{machine}` in {} s\n  hint: is it started there with `--machine {machine}`, and \
             does one side `connect` to where the other listens? a router joins only what has mode: \"client\"",
            REPORT_MISSING_AFTER.as_secs()
        );
    } else {
        tracing::warn!(
            "machine `{machine}` is heard, and in {} s has not told that it hears this one\n  hint: what does it say there? \
             does an access control keep what this machine sends from it? somebody may also repeat what it once sent",
            REPORT_MISSING_AFTER.as_secs()
        );
    }
}

/// Reports once why a peer is refused.
fn refuse(machine: &str, peer: &mut Peer, error: &WireError) {
    let reason = error.to_string();
    peer.refused_at = Some(Instant::now());
    if peer.refused.admits(&reason) {
        tracing::error!("refused machine `{machine}`: {reason}");
    }
}

/// The routes of all edges of a bridge.
fn routes(bridge: &BridgePlan) -> Vec<Route> {
    bridge.outgoing.iter().chain(&bridge.incoming).flat_map(routes_of).collect()
}

/// The routes of one edge, one per receiving machine.
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
mod tests;
