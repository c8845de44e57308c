//! The life of a bridge: opens its session, runs a thread per edge, sends beacons and keeps its records until all have
//! ended.

use super::BridgeError;
use super::account::{Account, Carried};
use super::beacon::Ack;
use super::links::Links;
use super::receiving::Receiving;
use super::sending::{Sending, Shared};
use super::ways::{Ear, Voice, Ways};
use super::wire::encode_note;
use conicflow_dataflow::relay::{Settling, SharedMemory, Surroundings};
use conicflow_dataflow::{BridgePlan, BridgeRun, Life, NO_RUN, Stop};
use std::sync::Arc;
use std::thread::{Scope, ScopedJoinHandle};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};
use zenoh::bytes::ZBytes;
use zenoh::qos::Priority;

/// How long lossless edges wait for a machine that has gone, where the file does not say.
const OUTAGE: Duration = Duration::from_secs(30);
const TICK: Duration = Duration::from_millis(10);
/// Without news a beacon is sent this often.
const BEACON_PERIOD: Duration = Duration::from_millis(200);
/// The last acknowledgement is repeated, because nothing acknowledges that one.
const FAREWELLS: usize = 5;

/// Carries the edges of a plan until all have ended.
pub(crate) fn run(
    bridge: &BridgePlan,
    run: BridgeRun<'_>,
    around: Surroundings<SharedMemory>,
) -> Result<(), BridgeError> {
    let (stop, settling) = (around.context.stop.clone(), Settling::of(&around));
    let stream = SystemTime::now().duration_since(UNIX_EPOCH).map_or(0, |since| since.as_nanos() as u64);
    let links = Arc::new(Links::new(stream, bridge));
    let mut account = Account::new(bridge, run, around.record, &links);
    account.report(false);
    let Some(ways) = Ways::open(&bridge.settings, &stop, || account.report(false))? else { return Ok(()) };
    let shared = Shared {
        ways: &ways,
        transport: &around.transport,
        links: &links,
        pipeline: run.pipeline,
        machine: &bridge.machine,
        stream,
        kept: (run.run != NO_RUN).then_some(run.folder),
        outage: bridge.settings.outage_s.map_or(OUTAGE, Duration::from_secs_f64),
        peers: &around.peers,
        stop: &stop,
    };
    let voice = ways.speak(&beacon_key(run.pipeline, &bridge.machine), true, Priority::RealTime)?;
    let ears = listen_for_beacons(&shared, bridge)?;
    account.record.status.set_life(Life::Running);
    let sent = (Instant::now(), Vec::new());
    let mut watch = Watch { account, ways: &ways, links: &links, voice, ears, sent, settling };
    let result = watch.run(&shared);
    let life = if result.is_ok() && !stop.forced() { Life::Ended } else { Life::Starting };
    watch.account.record.status.set_life(life);
    watch.account.report(ways.reach_anybody());
    result
}

fn beacon_key(pipeline: &str, machine: &str) -> String {
    format!("conicflow/{pipeline}/@link/{machine}")
}

fn listen_for_beacons<'a>(shared: &Shared<'a>, bridge: &BridgePlan) -> Result<Vec<Ear<'a>>, BridgeError> {
    let listen = |peer: &str| {
        let (links, machine) = (Arc::clone(shared.links), peer.to_owned());
        let hear = move |bytes: ZBytes| links.heard(&machine, &bytes.to_bytes());
        shared.ways.listen(&beacon_key(shared.pipeline, peer), Some(3 * BEACON_PERIOD), hear)
    };
    bridge.peers().into_iter().map(listen).collect()
}

/// The main thread: it starts the others, and watches.
struct Watch<'a> {
    account: Account<'a>,
    ways: &'a Ways,
    links: &'a Links,
    voice: Voice<'a>,
    ears: Vec<Ear<'a>>,
    sent: (Instant, Vec<Ack>),
    /// Counts seconds with a link.
    settling: Settling,
}

type Handle<'scope> = ScopedJoinHandle<'scope, Result<(), BridgeError>>;

impl<'a> Watch<'a> {
    fn run(&mut self, shared: &Shared<'a>) -> Result<(), BridgeError> {
        std::thread::scope(|scope| {
            let carried = &self.account.carried;
            let started: Result<Vec<_>, _> = carried.iter().map(|carried| carried.start(scope, shared)).collect();
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
            if self.account.is_due() {
                self.report();
            }
            self.ears.iter_mut().try_for_each(|ear| ear.choose().map(drop)).inspect_err(|_| stop.force())?;
            for ended in handles.extract_if(.., |handle| handle.is_finished()) {
                let edge = ended.join().unwrap_or(Err(BridgeError::Panicked));
                result = result.and(edge.inspect_err(|_| stop.force()));
            }
            std::thread::sleep(TICK);
        }
        result
    }

    fn report(&mut self) {
        let reachable = self.ways.reach_anybody();
        self.account.report(reachable);
        if reachable {
            self.settling.step();
        }
    }

    fn send_beacon(&mut self, acks: Vec<Ack>) {
        self.sent = (Instant::now(), acks.clone());
        if let Ok(bytes) = encode_note(&self.links.beacon(acks)) {
            self.voice.put(bytes);
        }
    }
}

impl<'a> Carried<'a> {
    fn start<'scope>(
        &self,
        scope: &'scope Scope<'scope, '_>,
        shared: &Shared<'a>,
    ) -> Result<Handle<'scope>, BridgeError>
    where
        'a: 'scope,
    {
        let counts = Arc::clone(&self.counts);
        if self.outgoing {
            let sending = Sending::new(self.edge, shared, counts)?;
            Ok(scope.spawn(move || sending.run()))
        } else {
            let receiving = Receiving::new(self.edge, shared, counts)?;
            Ok(scope.spawn(move || receiving.run()))
        }
    }
}
