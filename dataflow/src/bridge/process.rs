//! The life of a bridge: opens its session, runs a thread per edge, sends beacons and keeps its records until all have
//! ended.

use super::beacon::Ack;
use super::links::Links;
use super::plan::{BridgePlan, Edge};
use super::receiving::Receiving;
use super::report::{self, EdgeCounts, EdgeReport, LinkReport};
use super::sending::{Sending, Shared};
use super::wire::encode_note;
use super::{BridgeError, Wire, settings};
use crate::launcher::RunFolder;
use crate::plan::Plan;
use crate::ports::shared_memory::SharedMemory;
use crate::runner::Surroundings;
use crate::stage::Stop;
use crate::status::{InputCounts, Life, StatusFile};
use conicflow_messages::{Ellipse, Kind, Object, Text, Track};
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::{Scope, ScopedJoinHandle};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};
use zenoh::Wait;
use zenoh::pubsub::{Publisher, Subscriber};
use zenoh::qos::{CongestionControl, Priority};

/// How long lossless edges wait for a machine that has gone, where the file does not say.
const OUTAGE: Duration = Duration::from_secs(30);
const TICK: Duration = Duration::from_millis(10);
/// Without news a beacon is sent this often.
const BEACON_PERIOD: Duration = Duration::from_millis(200);
const REPORT_PERIOD: Duration = Duration::from_secs(1);
/// A session that cannot be opened, because nobody is there yet, is tried again after this time.
const OPEN_AGAIN: Duration = Duration::from_secs(1);
/// The last acknowledgement is repeated, because nothing acknowledges that one.
const FAREWELLS: usize = 5;

/// Carries the edges of a plan until all have ended.
pub(crate) fn run(
    bridge: &BridgePlan,
    plan: &Plan,
    folder: &RunFolder,
    mut around: Surroundings<SharedMemory>,
) -> Result<(), BridgeError> {
    let stop = around.context.stop.clone();
    let Some(session) = open_session(bridge, &stop)? else { return Ok(()) };
    let stream = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_nanos() as u64);
    let links = Arc::new(Links::new(&bridge.machine, stream, bridge.peers().into_iter()));
    let shared = Shared {
        session: &session,
        transport: &around.transport,
        links: &links,
        pipeline: &plan.pipeline,
        machine: &bridge.machine,
        stream,
        outage: bridge.settings.outage_s.map_or(OUTAGE, Duration::from_secs_f64),
        peers: &around.peers,
        stop: &stop,
    };
    let (beacons, _ears) = (declare_beacon(&shared)?, listen_for_beacons(&shared, bridge)?);
    around.record.status.set_life(Life::Running);
    let mut watch = Watch::new(bridge, plan, folder, around.record, &links, beacons);
    let result = watch.run(&shared);
    watch.record.status.set_life(if result.is_ok() && !stop.forced() { Life::Ended } else { Life::Starting });
    watch.report();
    result
}

/// Opens the session, as soon as that works; nothing if the run ends before.
fn open_session(bridge: &BridgePlan, stop: &Stop) -> Result<Option<zenoh::Session>, BridgeError> {
    let config = settings::configuration(&bridge.settings)?;
    let mut told = false;
    while !stop.requested() {
        match zenoh::open(config.clone()).wait() {
            Ok(session) => return Ok(Some(session)),
            Err(error) if !told => tracing::warn!("Zenoh cannot be opened yet, and is tried again: {error}"),
            Err(_) => {}
        }
        told = true;
        std::thread::sleep(OPEN_AGAIN);
    }
    Ok(None)
}

fn beacon_key(pipeline: &str, machine: &str) -> String {
    format!("conicflow/{pipeline}/@link/{machine}")
}

fn declare_beacon<'a>(shared: &Shared<'a>) -> Result<Publisher<'a>, BridgeError> {
    let declared = shared
        .session
        .declare_publisher(beacon_key(shared.pipeline, shared.machine))
        .congestion_control(CongestionControl::Drop)
        .priority(Priority::RealTime)
        .express(true)
        .wait();
    declared.map_err(|error| BridgeError::zenoh("cannot declare the link to Zenoh", error))
}

fn listen_for_beacons(shared: &Shared<'_>, bridge: &BridgePlan) -> Result<Vec<Subscriber<()>>, BridgeError> {
    let listen = |peer: &str| {
        let (links, machine) = (Arc::clone(shared.links), peer.to_owned());
        let hear = move |sample: zenoh::sample::Sample| links.heard(&machine, &sample.payload().to_bytes());
        shared.session.declare_subscriber(beacon_key(shared.pipeline, peer)).callback(hear).wait()
    };
    let declared: zenoh::Result<Vec<_>> = bridge.peers().into_iter().map(listen).collect();
    declared.map_err(|error| BridgeError::zenoh("cannot listen to the other machines", error))
}

/// An edge and its counts.
struct Carried<'a> {
    edge: &'a Edge,
    outgoing: bool,
    counts: Arc<EdgeCounts>,
    reported: EdgeReport,
}

/// The main thread: it starts the others, and watches.
struct Watch<'a> {
    plan: &'a Plan,
    folder: &'a RunFolder,
    record: StatusFile,
    links: &'a Links,
    beacons: Publisher<'a>,
    carried: Vec<Carried<'a>>,
    reported: Instant,
    sent: (Instant, Vec<Ack>),
}

type Handle<'scope> = ScopedJoinHandle<'scope, Result<(), BridgeError>>;

impl<'a> Watch<'a> {
    fn new(
        bridge: &'a BridgePlan,
        plan: &'a Plan,
        folder: &'a RunFolder,
        record: StatusFile,
        links: &'a Links,
        beacons: Publisher<'a>,
    ) -> Self {
        let carry =
            |edge, outgoing| Carried { edge, outgoing, counts: Arc::default(), reported: EdgeReport::default() };
        let outgoing = bridge.outgoing.iter().map(|edge| carry(edge, true));
        let carried = outgoing.chain(bridge.incoming.iter().map(|edge| carry(edge, false))).collect();
        let now = Instant::now();
        Self { plan, folder, record, links, beacons, carried, reported: now, sent: (now, Vec::new()) }
    }

    fn run(&mut self, shared: &Shared<'a>) -> Result<(), BridgeError> {
        self.report();
        std::thread::scope(|scope| {
            let started: Result<Vec<_>, _> = self.carried.iter().map(|carried| carried.start(scope, shared)).collect();
            let handles = started.inspect_err(|_| shared.stop.force())?;
            let result = self.watch(handles, shared.stop);
            (0..FAREWELLS).for_each(|_| {
                self.send_beacon(self.links.acks());
                std::thread::sleep(TICK);
            });
            result
        })
    }

    /// Sends beacons and reports until all edges have ended; one that fails ends the others.
    fn watch(&mut self, mut handles: Vec<Handle<'_>>, stop: &Stop) -> Result<(), BridgeError> {
        let mut result = Ok(());
        while !handles.is_empty() {
            let acks = self.links.acks();
            if acks != self.sent.1 || self.sent.0.elapsed() > BEACON_PERIOD {
                self.send_beacon(acks);
            }
            if self.reported.elapsed() > REPORT_PERIOD {
                self.report();
            }
            for ended in handles.extract_if(.., |handle| handle.is_finished()) {
                let edge = ended.join().unwrap_or(Err(BridgeError::Panicked));
                result = result.and(edge.inspect_err(|_| stop.force()));
            }
            std::thread::sleep(TICK);
        }
        result
    }

    fn send_beacon(&mut self, acks: Vec<Ack>) {
        self.sent = (Instant::now(), acks.clone());
        if let Ok(bytes) = encode_note(&self.links.beacon(acks)) {
            // Whether it arrives shows in what the others send.
            self.beacons.put(bytes).wait().ok();
        }
    }

    /// Writes what `top` and the summary show.
    fn report(&mut self) {
        let seconds = self.reported.elapsed().as_secs_f64();
        self.reported = Instant::now();
        self.carried.iter_mut().for_each(|carried| carried.report(seconds));
        let peers = self.links.look();
        let links = peers.into_iter().map(|(machine, state)| {
            let reaches = |carried: &&Carried<'_>| match carried.outgoing {
                true => carried.edge.delivery_to(&machine).is_some(),
                false => carried.edge.from == machine,
            };
            LinkReport {
                was_heard: state.was_heard,
                connected: state.connected_for.is_some(),
                connected_s: state.connected_for.map(|time| time.as_secs_f64()),
                round_trip_ms: state.clock.map(|clock| clock.round_trip_ns as f64 / 1e6),
                clock_offset_s: state.clock.map(|clock| clock.offset_ns as f64 / 1e9),
                edges: self.carried.iter().filter(reaches).map(|carried| carried.reported.clone()).collect(),
                machine,
            }
        });
        report::write(self.folder.path(), self.plan.run, &links.collect::<Vec<_>>()).ok();
        self.keep_record();
    }

    fn keep_record(&mut self) {
        let status = &mut *self.record.status;
        let count = |outgoing: bool, counter: fn(&EdgeCounts) -> &std::sync::atomic::AtomicU64| -> u64 {
            let edges = self.carried.iter().filter(|carried| carried.outgoing == outgoing);
            edges.map(|carried| counter(&carried.counts).load(Ordering::Relaxed)).sum()
        };
        status.steps = count(true, |counts| &counts.messages) + count(false, |counts| &counts.messages);
        status.sent = count(false, |counts| &counts.messages);
        status.sent_bytes = count(false, |counts| &counts.memory_bytes);
        let outgoing = self.carried.iter().filter(|carried| carried.outgoing);
        for (slot, carried) in status.inputs.iter_mut().zip(outgoing) {
            let received = carried.counts.messages.load(Ordering::Relaxed);
            *slot = InputCounts { topic: Text::new(&carried.edge.topic.name), received, ..InputCounts::default() };
        }
        self.record.write();
    }
}

impl<'a> Carried<'a> {
    fn report(&mut self, seconds: f64) {
        let direction = if self.outgoing { "out" } else { "in" };
        self.reported = self.counts.report(&self.edge.topic.name, direction, &self.reported, seconds);
    }

    fn start<'scope>(
        &self,
        scope: &'scope Scope<'scope, '_>,
        shared: &Shared<'a>,
    ) -> Result<Handle<'scope>, BridgeError>
    where
        'a: 'scope,
    {
        match self.edge.kind {
            Kind::Ellipses => self.start_kind::<Ellipse>(scope, shared),
            Kind::Objects => self.start_kind::<Object>(scope, shared),
            Kind::Tracks => self.start_kind::<Track>(scope, shared),
            Kind::Depth | Kind::Nothing => self.start_kind::<u16>(scope, shared),
        }
    }

    fn start_kind<'scope, T: Wire>(
        &self,
        scope: &'scope Scope<'scope, '_>,
        shared: &Shared<'a>,
    ) -> Result<Handle<'scope>, BridgeError>
    where
        'a: 'scope,
    {
        let counts = Arc::clone(&self.counts);
        if self.outgoing {
            let sending = Sending::<T>::new(self.edge, shared, counts)?;
            Ok(scope.spawn(move || sending.run()))
        } else {
            let receiving = Receiving::<T>::new(self.edge, shared, counts)?;
            Ok(scope.spawn(move || receiving.run()))
        }
    }
}
