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
use crate::told_once::ToldOnce;
use crate::wire::seal::Seal;
use crate::wire::{WireError, decode_note, encode_note, layouts};
use conicflow_dataflow::ports::Delivery;
use conicflow_dataflow::{BridgePlan, Edge, lock, monotonic_ns};
use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Mutex;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

/// A peer of which nothing was heard for so long is not connected.
const DISCONNECTED_AFTER: Duration = Duration::from_millis(1500);
/// Of a peer that has not come after this time the user is told.
const REPORT_MISSING_AFTER: Duration = Duration::from_secs(5);

/// So many sessions of a peer are told of: the present one, one that is about to prove itself, and as many again of which
/// somebody repeats what they said. Those give way to one another, so that a new session proves itself all the same.
const SESSIONS: usize = 4;

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
    refused: ToldOnce,
    /// When something was that came in its name.
    refused_at: Option<Instant>,
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
    /// Whether what comes in its name is refused.
    pub refused: bool,
    /// For how long that is so.
    pub time: Duration,
    pub clock: Option<Exchange>,
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
        let begun_ns = peer.proved_ns[1].saturating_add(REPORT_MISSING_AFTER.as_nanos() as u64);
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

    /// Notes that a writer of an edge to here has ended after so many messages. It is done before that is acknowledged: the other
    /// machine may leave then, and nobody else would tell a bridge that is started anew.
    pub(crate) fn note_end(&self, from: &str, topic: &str, writer: &str, count: u64) {
        lock(&self.journal).note_end(from, topic, writer, count);
    }

    /// Which writers of an edge to here have ended, as this process or an earlier one has noted, each with how many messages it sent.
    pub(crate) fn ends(&self, from: &str, topic: &str) -> BTreeMap<String, u64> {
        lock(&self.journal).ends(from, topic)
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
        self.heard_here(machine).or_else(|| lock(&self.journal).has_heard(machine).then_some(self.started))
    }

    /// For how long a peer is silent to a process that waits for its word since then: one that this process has never heard is
    /// silent since this process began.
    pub(crate) fn silence(&self, machine: &str, since: Instant) -> Duration {
        self.heard_here(machine).map_or(self.started, |heard| heard.max(since)).elapsed()
    }

    fn heard_here(&self, machine: &str) -> Option<Instant> {
        lock(&self.peers).get(machine)?.heard
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
                let comes = self.routes.iter().any(|route| route.from == *machine);
                let waits = if comes { "; what comes from there is waited for, also in its next run" } else { "" };
                tracing::warn!("the link to machine `{machine}` is down{waits}");
                peer.since = None;
            }
            if now.saturating_duration_since(self.started) > REPORT_MISSING_AFTER {
                miss(machine, peer);
            }
            let since = peer.since.or(peer.heard).unwrap_or(self.started);
            let (was_heard, connected) = (peer.heard.is_some(), peer.since.is_some());
            let refused = is_recent(peer.refused_at, now);
            let (time, clock) = (now.saturating_duration_since(since), peer.clock.best());
            states.insert(machine.clone(), PeerState { was_heard, connected, refused, time, clock });
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
    is_recent(peer.heard, now)
}

fn is_recent(time: Option<Instant>, now: Instant) -> bool {
    time.is_some_and(|time| now.saturating_duration_since(time) < DISCONNECTED_AFTER)
}

/// Says once that a peer has never been heard of, or does not hear this one, and was not refused either.
fn miss(machine: &str, peer: &mut Peer) {
    if peer.heard.is_some() || !peer.refused.texts().is_empty() || peer.missed {
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

/// Says once why a peer is not listened to.
fn refuse(machine: &str, peer: &mut Peer, error: &WireError) {
    let reason = error.to_string();
    peer.refused_at = Some(Instant::now());
    if peer.refused.admits(&reason) {
        tracing::error!("refused machine `{machine}`: {reason}");
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
mod tests;
