//! The life of a bridge: opens its session, runs a thread per edge, sends heartbeats and keeps its records until all have
//! ended.

use crate::error::BridgeError;
use crate::handshakes;
use crate::peer::heartbeat::News;
use crate::peer::journal::Journal;
use crate::peer::links::Links;
use crate::peer::report::{BridgeReporter, EdgeHandle};
use crate::receiving::Receiving;
use crate::sending::Sending;
use crate::session::{Publisher, Sessions, Subscriber};
use crate::settings;
use crate::shared::Shared;
use crate::wire::seal::Seal;
use conicflow_dataflow::pipeline::check_host;
use conicflow_dataflow::relay::{MemoryTrim, Peers, SharedMemory, StageRuntime, StatusFile};
use conicflow_dataflow::{BridgePlan, BridgeRun, Life, NO_RUN, Stop, unix_ns};
use conicflow_messages::Hinted;
use std::sync::Arc;
use std::thread::{Scope, ScopedJoinHandle};
use std::time::{Duration, Instant};
use zenoh::bytes::ZBytes;
use zenoh::qos::Priority;

/// How long lossless edges wait for a machine that has gone, if the file does not set `outage_s`.
const OUTAGE: Duration = Duration::from_secs(30);
/// Period of the checks of edges and links, and pause between repetitions of the last heartbeat.
const TICK: Duration = Duration::from_millis(10);
/// The period of heartbeats without news.
const HEARTBEAT_PERIOD: Duration = Duration::from_millis(200);
/// Number of times that the last heartbeat is sent: nothing acknowledges it.
const FAREWELLS: usize = 5;

/// Carries the edges of a plan until all have ended, in a separate process.
pub(crate) fn run(
    bridge: &BridgePlan,
    run: BridgeRun<'_>,
    runtime: StageRuntime<SharedMemory>,
) -> Result<(), BridgeError> {
    let memory_trim = MemoryTrim::of(&runtime);
    let StageRuntime { transport, context, peers, record, .. } = runtime;
    carry(bridge, run, &transport, &peers, &context.stop, record, memory_trim)
}

/// Carries the edges over this shared memory until all have ended, or the run does; writes its progress to the record.
fn carry(
    bridge: &BridgePlan,
    run: BridgeRun<'_>,
    transport: &SharedMemory,
    peers: &Peers,
    stop: &Stop,
    record: StatusFile,
    memory_trim: MemoryTrim,
) -> Result<(), BridgeError> {
    let now = unix_ns();
    // A stage that was started by itself has no successor.
    let kept_in = (run.run != NO_RUN).then_some(run.folder);
    let journal = Journal::open(kept_in, if run.run == NO_RUN { now } else { run.run }, now);
    let session = journal.session();
    let seal = Seal::new(settings::key(&bridge.settings)?.as_ref(), session);
    let links = Arc::new(Links::new(journal, seal, bridge));
    let mut reporter = BridgeReporter::new(bridge, run, record, &links);
    reporter.report(false);
    let mut failed = || {
        handshakes::report();
        reporter.report(false);
    };
    warn_of_unknown_hosts(&bridge.settings.connect);
    let Some(sessions) = Sessions::open(&bridge.settings, stop, &mut failed)? else { return Ok(()) };
    let shared = Shared {
        sessions: &sessions,
        transport,
        links: &links,
        pipeline: run.pipeline,
        machine: &bridge.machine,
        session,
        log_folder: kept_in,
        outage: bridge.settings.outage_s.map_or(OUTAGE, Duration::from_secs_f64),
        peers,
        stop,
    };
    let own_key = heartbeat_key(run.pipeline, &bridge.machine);
    let publisher = sessions.publisher(&own_key, true, Priority::RealTime)?;
    let subscribers = subscribe_to_heartbeats(&shared, bridge)?;
    reporter.record.status.set_life(Life::Running);
    let sent = (Instant::now(), News::default());
    let mut watch =
        Watch { reporter, sessions: &sessions, links: &links, own_key, publisher, subscribers, sent, memory_trim };
    let result = watch.run(&shared);
    let life = if result.is_ok() && !stop.forced() { Life::Ended } else { Life::Starting };
    watch.reporter.record.status.set_life(life);
    watch.reporter.report(sessions.reaches_any_machine());
    result
}

/// Warns of hosts without an address, in a thread, because a look-up may take seconds.
fn warn_of_unknown_hosts(connect: &[String]) {
    let endpoints = connect.to_vec();
    std::thread::spawn(move || {
        let faults = endpoints.iter().filter_map(|endpoint| check_host(endpoint).err());
        faults.for_each(|Hinted { what, hint, .. }| tracing::warn!("{what}\n  hint: {hint}"));
    });
}

fn heartbeat_key(pipeline: &str, machine: &str) -> String {
    format!("conicflow/{pipeline}/@link/{machine}")
}

fn subscribe_to_heartbeats<'a>(shared: &Shared<'a>, bridge: &BridgePlan) -> Result<Vec<Subscriber<'a>>, BridgeError> {
    let subscribe = |peer: &str| {
        let (links, machine) = (Arc::clone(shared.links), peer.to_owned());
        let key = heartbeat_key(shared.pipeline, peer);
        let zenoh_key = key.clone();
        let on_heartbeat = move |bytes: ZBytes| links.receive_heartbeat(&machine, &zenoh_key, &bytes.to_bytes());
        shared.sessions.subscriber(&key, Some(3 * HEARTBEAT_PERIOD), on_heartbeat)
    };
    bridge.peers().into_iter().map(subscribe).collect()
}

/// The main thread: it starts the others and watches them.
struct Watch<'a> {
    reporter: BridgeReporter<'a>,
    sessions: &'a Sessions,
    links: &'a Links,
    own_key: String,
    publisher: Publisher<'a>,
    subscribers: Vec<Subscriber<'a>>,
    sent: (Instant, News),
    /// One step per second with a link.
    memory_trim: MemoryTrim,
}

type Handle<'scope> = ScopedJoinHandle<'scope, Result<(), BridgeError>>;

impl<'a> Watch<'a> {
    fn run(&mut self, shared: &Shared<'a>) -> Result<(), BridgeError> {
        std::thread::scope(|scope| {
            let edges = &self.reporter.edges;
            let started: Result<Vec<_>, _> = edges.iter().map(|edge| edge.start(scope, shared)).collect();
            let handles = started.inspect_err(|_| shared.stop.force())?;
            let result = self.watch(handles, shared.stop);
            (0..FAREWELLS).for_each(|_| {
                self.send_heartbeat(self.links.news());
                std::thread::sleep(TICK);
            });
            result
        })
    }

    /// Sends heartbeats and reports until all edges have ended; an edge that fails ends the others.
    fn watch(&mut self, mut handles: Vec<Handle<'_>>, stop: &Stop) -> Result<(), BridgeError> {
        let mut result = Ok(());
        while !handles.is_empty() {
            let news = self.links.news();
            if is_heartbeat_due(self.links.owes_answer(), &news, &self.sent, Instant::now()) {
                self.send_heartbeat(news);
            }
            if self.reporter.is_due(Instant::now()) {
                self.report();
            }
            self.subscribers
                .iter_mut()
                .try_for_each(|subscriber| subscriber.choose().map(drop))
                .inspect_err(|_| stop.force())?;
            for ended in handles.extract_if(.., |handle| handle.is_finished()) {
                let edge = ended.join().unwrap_or(Err(BridgeError::Panicked));
                result = result.and(edge.inspect_err(|_| stop.force()));
            }
            std::thread::sleep(TICK);
        }
        result
    }

    fn report(&mut self) {
        handshakes::report();
        let reachable = self.sessions.reaches_any_machine();
        self.reporter.report(reachable);
        if reachable {
            self.memory_trim.step();
        }
    }

    fn send_heartbeat(&mut self, news: News) {
        self.sent = (Instant::now(), news.clone());
        self.links.send_heartbeat(&self.own_key, news, |bytes| self.publisher.put(bytes));
    }
}

/// Whether a heartbeat is to be sent now: a peer waits for an answer, there is news since the last one, or the last one is too
/// old to show that the link is alive.
fn is_heartbeat_due(owes_answer: bool, news: &News, (sent, last): &(Instant, News), now: Instant) -> bool {
    owes_answer || news != last || now.duration_since(*sent) > HEARTBEAT_PERIOD
}

impl<'a> EdgeHandle<'a> {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::edge_tests::{Ending, edge, memory, read, wait_until, write};
    use crate::loopback::loopback;
    use crate::peer::heartbeat::Ack;
    use conicflow_dataflow::Status;
    use conicflow_dataflow::pipeline::{BRIDGE, Machine};
    use conicflow_dataflow::ports::{Delivery, Transport as _};
    use conicflow_messages::Object;
    use serde_json::Value as Json;
    use std::path::{Path, PathBuf};
    use std::thread;

    const RUN: u64 = 7;

    fn record(folder: &Path) -> PathBuf {
        folder.join("bridge.status")
    }

    /// The folder for a machine's shared memory, apart from the records, because shared memory empties its folder.
    fn in_memory(folder: &Path) -> PathBuf {
        let path = folder.join("memory");
        std::fs::create_dir_all(&path).unwrap();
        path
    }

    /// Runs a bridge until it ends; returns its last state. The record of `reader`, if there is one, tells it the state of that
    /// stage.
    fn ended(plan: &BridgePlan, run: u64, folder: &Path, stop: &Stop) -> Option<Life> {
        let peers = Peers::in_folder(folder.to_owned(), run, ["reader".to_owned()].into());
        let transport = SharedMemory::open(&in_memory(folder), "test", BRIDGE, stop.clone()).unwrap();
        let (own, record_file) = (BridgeRun { pipeline: "test", run, folder }, StatusFile::open(&record(folder), run));
        carry(plan, own, &transport, &peers, stop, record_file.unwrap(), MemoryTrim::default()).unwrap();
        Status::read(&record(folder)).map(|status| status.life())
    }

    /// The plans of `robot` and `base`, joined by one edge.
    fn plans() -> [BridgePlan; 2] {
        let (endpoint, settings) = (vec![loopback()], || Machine { insecure: true, ..Machine::default() });
        let plan = |machine: &str, settings| BridgePlan { machine: machine.into(), settings, ..BridgePlan::default() };
        let listening = plan("robot", Machine { listen: endpoint.clone(), ..settings() });
        let connecting = plan("base", Machine { connect: endpoint, ..settings() });
        let edge = |reader| vec![edge(Delivery::Lossless, reader)];
        [BridgePlan { outgoing: edge(BRIDGE), ..listening }, BridgePlan { incoming: edge("reader"), ..connecting }]
    }

    /// Whether the link is reported to be up.
    fn is_up(folder: &Path) -> bool {
        let told = std::fs::read(folder.join("bridge.links")).unwrap_or_default();
        serde_json::from_slice::<Json>(&told).is_ok_and(|told| told["links"][0]["state"] == "up")
    }

    #[test]
    fn two_bridges_report_their_link_and_carry_an_edge_to_its_end_and_the_journal_holds_it() {
        let folders = [tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap()];
        let (plans, [robot, base]) = (plans(), folders.each_ref().map(tempfile::TempDir::path));
        let edge = &plans[1].incoming[0];
        thread::scope(|scope| {
            let stops = [Stop::default(), Stop::default()];
            let _ending = Ending(stops.clone());
            let bridges = plans.iter().zip([robot, base]).zip(stops);
            let bridges = bridges.map(|((plan, folder), stop)| scope.spawn(move || ended(plan, RUN, folder, &stop)));
            let bridges: Vec<_> = bridges.collect();
            let reader = memory(&in_memory(base), "reader").reader::<Object>(&edge.topic, "reader").unwrap();
            [robot, base].iter().for_each(|folder| wait_until("the link is up", || is_up(folder)));
            scope.spawn(|| write(&memory(&in_memory(robot), "writer"), &plans[0].outgoing[0].topic, 20));
            assert_eq!(read(reader), ((0..20).collect(), 20));
            bridges.into_iter().for_each(|bridge| assert_eq!(bridge.join().unwrap(), Some(Life::Ended)));
        });
        let next = Journal::open(Some(robot), RUN, 0);
        assert!(next.has_heard("base") && next.finished().count() == 1, "{next:?}");
    }

    /// Returns the last state of a bridge whose readers have all ended, and to which no machine sends anything.
    fn ended_alone(stop: Stop) -> Option<Life> {
        let (folder, [_, base]) = (tempfile::tempdir().unwrap(), plans());
        let mut reader = StatusFile::open(&folder.path().join("reader.status"), RUN).unwrap();
        reader.status.set_life(Life::Ended);
        reader.write();
        thread::scope(|scope| {
            let _ending = Ending([stop.clone()]);
            let bridge = scope.spawn(|| ended(&base, RUN, folder.path(), &stop));
            wait_until("it has ended", || bridge.is_finished());
            bridge.join().unwrap()
        })
    }

    #[test]
    fn a_bridge_ends_when_all_readers_have_ended_although_no_other_machine_is_there() {
        assert_eq!(ended_alone(Stop::default()), Some(Life::Ended));
    }

    #[test]
    fn a_bridge_that_is_asked_to_end_in_order_while_it_starts_still_ends_in_order() {
        let stop = Stop::default();
        stop.request();
        assert_eq!(ended_alone(stop), Some(Life::Ended));
    }

    #[test]
    fn a_bridge_that_is_forced_to_end_has_not_ended_in_order_and_leaves_a_journal_if_another_may_replace_it() {
        for (run, is_kept) in [(RUN, true), (NO_RUN, false)] {
            let (folder, stop, [robot, _]) = (tempfile::tempdir().unwrap(), Stop::default(), plans());
            let is_running =
                || Status::read(&record(folder.path())).is_some_and(|status| status.life() == Life::Running);
            thread::scope(|scope| {
                let bridge = scope.spawn(|| ended(&robot, run, folder.path(), &stop));
                let ending = Ending([stop.clone()]);
                wait_until("it is at work", is_running);
                drop(ending);
                assert_eq!(bridge.join().unwrap(), Some(Life::Starting));
            });
            assert_eq!(folder.path().join("bridge.journal").is_file(), is_kept);
        }
    }

    #[test]
    fn heartbeats_of_a_machine_have_a_key_of_their_own_in_each_pipeline() {
        assert_eq!(heartbeat_key("tracking", "robot"), "conicflow/tracking/@link/robot");
    }

    #[test]
    fn a_heartbeat_is_sent_at_once_with_news_or_as_an_answer_and_otherwise_five_times_a_second() {
        let (none, some) = (News::default(), News { acks: vec![Ack::default()], ..News::default() });
        let begin = Instant::now();
        let is_due = |owes_answer: bool, news: &News, passed_ms: u64| {
            is_heartbeat_due(owes_answer, news, &(begin, none.clone()), begin + Duration::from_millis(passed_ms))
        };
        assert_eq!([0, 200, 201].map(|passed_ms| is_due(false, &none, passed_ms)), [false, false, true]);
        assert!(is_due(true, &none, 0), "somebody waits for it");
        assert!(is_due(false, &some, 0), "there is something new");
        assert!(!is_heartbeat_due(false, &some, &(begin, some.clone()), begin), "that was told already");
    }
}
