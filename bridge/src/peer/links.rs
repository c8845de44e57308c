//! What one bridge knows of the others: who lives, what they have received, how their clocks differ.

use super::clock::{Clock, Exchange};
use super::heartbeat::{Ack, ClockSample, Heartbeat, Route};
use crate::wire::{WireError, decode_note, layouts};
use conicflow_dataflow::ports::Delivery;
use conicflow_dataflow::{BridgePlan, Edge, monotonic_ns};
use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// A peer of which nothing was heard for so long is not connected.
const SILENCE: Duration = Duration::from_millis(1500);
/// Of a peer that has not come after this time the user is told.
const PATIENCE: Duration = Duration::from_secs(5);

/// The other machines, as the threads of a bridge share them.
pub(crate) struct Links {
    machine: String,
    stream: u64,
    routes: Vec<Route>,
    started: Instant,
    peers: Mutex<BTreeMap<String, Peer>>,
    acks: Mutex<BTreeMap<(String, String), Ack>>,
}

/// One other machine.
#[derive(Default)]
pub(crate) struct Peer {
    heard: Option<Instant>,
    since: Option<Instant>,
    sample: ClockSample,
    clock: Clock,
    acks: BTreeMap<String, Ack>,
    refused: Option<String>,
    unlike: Vec<Route>,
    missed: bool,
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
    pub(crate) fn new(stream: u64, bridge: &BridgePlan) -> Self {
        let peers = bridge.peers().into_iter().map(|peer| (peer.to_owned(), Peer::default())).collect();
        let (machine, routes) = (bridge.machine.clone(), routes(bridge));
        Self { machine, stream, routes, started: Instant::now(), peers: Mutex::new(peers), acks: Mutex::default() }
    }

    /// Takes in a heartbeat.
    pub(crate) fn heard(&self, machine: &str, bytes: &[u8]) {
        let now_ns = monotonic_ns();
        let mut peers = lock(&self.peers);
        let Some(peer) = peers.get_mut(machine) else { return };
        match decode_note::<Heartbeat>(bytes) {
            Ok(Heartbeat { layouts: theirs, .. }) if theirs != layouts() => {
                refuse(machine, peer, &WireError::Layout { ours: layouts(), theirs });
            }
            Ok(heartbeat) => self.take_in(machine, peer, heartbeat, now_ns),
            Err(error) => refuse(machine, peer, &error),
        }
    }

    /// Beacons may come by two sessions: one that was overtaken tells nothing new.
    fn take_in(&self, machine: &str, peer: &mut Peer, heartbeat: Heartbeat, now_ns: u64) {
        let now = Instant::now();
        if heartbeat.stream == peer.sample.stream && heartbeat.sent_ns <= peer.sample.sent_ns {
            return;
        }
        if !is_connected(peer, now) {
            tracing::info!("the link to machine `{machine}` is up");
            peer.since = Some(now);
        }
        peer.heard = Some(now);
        self.compare(machine, peer, &heartbeat.routes);
        if heartbeat.stream != peer.sample.stream {
            peer.clock.clear();
            peer.acks.clear();
        }
        let own = |sample: &&ClockSample| sample.machine == self.machine && sample.stream == self.stream;
        if let Some(sample) = heartbeat.samples.iter().find(own) {
            peer.clock.add([sample.sent_ns, sample.received_ns, heartbeat.sent_ns, now_ns]);
        }
        peer.sample = ClockSample {
            machine: machine.to_owned(),
            stream: heartbeat.stream,
            sent_ns: heartbeat.sent_ns,
            received_ns: now_ns,
        };
        let acks = heartbeat.acks.into_iter().filter(|ack| ack.from == self.machine);
        peer.acks.extend(acks.map(|ack| (ack.topic.clone(), ack)));
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

    /// What has been received so far.
    pub(crate) fn acks(&self) -> Vec<Ack> {
        lock(&self.acks).values().cloned().collect()
    }

    /// The heartbeat that is due now.
    pub(crate) fn heartbeat(&self, acks: Vec<Ack>) -> Heartbeat {
        let peers = lock(&self.peers);
        let samples = peers.values().filter(|peer| peer.heard.is_some()).map(|peer| peer.sample.clone()).collect();
        Heartbeat {
            stream: self.stream,
            sent_ns: monotonic_ns(),
            layouts: layouts(),
            routes: self.routes.clone(),
            samples,
            acks,
        }
    }

    /// What a peer said it has of a topic, and when it was heard of last.
    pub(crate) fn ack_of(&self, machine: &str, topic: &str) -> (Option<Ack>, Option<Instant>) {
        let peers = lock(&self.peers);
        peers.get(machine).map_or((None, None), |peer| (peer.acks.get(topic).cloned(), peer.heard))
    }

    /// Whether a peer was heard of just now.
    pub(crate) fn is_connected(&self, machine: &str) -> bool {
        lock(&self.peers).get(machine).is_some_and(|peer| is_connected(peer, Instant::now()))
    }

    /// The time to a peer and back, if it was heard of just now; 0 before that has been measured.
    pub(crate) fn round_trip(&self, machine: &str) -> Option<Duration> {
        let peers = lock(&self.peers);
        let peer = peers.get(machine).filter(|peer| is_connected(peer, Instant::now()))?;
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

fn is_connected(peer: &Peer, now: Instant) -> bool {
    peer.heard.is_some_and(|heard| now.saturating_duration_since(heard) < SILENCE)
}

/// Says once that a peer has never been heard of, and was not refused either.
fn miss(machine: &str, peer: &mut Peer) {
    if peer.heard.is_none() && peer.refused.is_none() && !peer.missed {
        tracing::warn!(
            "nothing was heard of machine `{machine}` in {} s\n  hint: is it started there with `--machine {machine}`, and \
             does one side `connect` to where the other listens? a router joins only what has mode: \"client\"",
            PATIENCE.as_secs()
        );
        peer.missed = true;
    }
}

/// Says once why a peer is not listened to.
fn refuse(machine: &str, peer: &mut Peer, error: &WireError) {
    let reason = error.to_string();
    if peer.refused.as_ref() != Some(&reason) {
        tracing::error!("refused machine `{machine}`: {reason}");
        peer.refused = Some(reason);
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
