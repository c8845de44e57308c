//! The account that a bridge gives of itself while it runs: what `top` and the summary show of its links and edges.

use super::counts::EdgeCounts;
use super::links::{Links, PeerState};
use conicflow_dataflow::relay::{StatusFile, write_links};
use conicflow_dataflow::{BridgePlan, BridgeRun, Edge, EdgeReport, InputCounts, LinkReport, LinkState};
use conicflow_messages::Text;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

const PERIOD: Duration = Duration::from_secs(1);

/// An edge and its counts.
pub(super) struct Carried<'a> {
    pub edge: &'a Edge,
    pub outgoing: bool,
    pub counts: Arc<EdgeCounts>,
    reported: EdgeReport,
}

impl Carried<'_> {
    fn reaches(&self, machine: &str) -> bool {
        if self.outgoing { self.edge.delivery_to(machine).is_some() } else { self.edge.from == machine }
    }

    fn report(&mut self, seconds: f64) {
        let direction = if self.outgoing { "out" } else { "in" };
        self.reported = self.counts.report(&self.edge.topic.name, direction, &self.reported, seconds);
    }
}

/// What is told, and where.
pub(super) struct Account<'a> {
    run: BridgeRun<'a>,
    pub record: StatusFile,
    links: &'a Links,
    pub carried: Vec<Carried<'a>>,
    reported: Instant,
}

impl<'a> Account<'a> {
    pub(super) fn new(bridge: &'a BridgePlan, run: BridgeRun<'a>, record: StatusFile, links: &'a Links) -> Self {
        let carry =
            |edge, outgoing| Carried { edge, outgoing, counts: Arc::default(), reported: EdgeReport::default() };
        let outgoing = bridge.outgoing.iter().map(|edge| carry(edge, true));
        let carried = outgoing.chain(bridge.incoming.iter().map(|edge| carry(edge, false))).collect();
        Self { run, record, links, carried, reported: Instant::now() }
    }

    /// Whether it is time to report.
    pub(super) fn is_due(&self) -> bool {
        self.reported.elapsed() > PERIOD
    }

    /// Writes what `top` and the summary show; `reachable` says whether there is a link to anybody.
    pub(super) fn report(&mut self, reachable: bool) {
        let seconds = self.reported.elapsed().as_secs_f64();
        self.reported = Instant::now();
        self.carried.iter_mut().for_each(|carried| carried.report(seconds));
        let states = self.links.look();
        let links: Vec<_> = states.iter().map(|(machine, state)| self.link(machine, state, reachable)).collect();
        write_links(self.run.folder, self.run.run, &links).ok();
        self.keep_record();
    }

    fn link(&self, machine: &str, peer: &PeerState, reachable: bool) -> LinkReport {
        let state = match (peer.connected, reachable, peer.was_heard) {
            (true, _, _) => LinkState::Up,
            (false, false, _) => LinkState::Unreachable,
            (false, true, true) => LinkState::Down,
            (false, true, false) => LinkState::Never,
        };
        let edges = self.carried.iter().filter(|carried| carried.reaches(machine));
        LinkReport {
            machine: machine.to_owned(),
            state,
            state_s: peer.time.as_secs_f64(),
            was_heard: peer.was_heard,
            round_trip_ms: peer.clock.map(|clock| clock.round_trip_ns as f64 / 1e6),
            clock_offset_s: peer.clock.map(|clock| clock.offset_ns as f64 / 1e9),
            edges: edges.map(|carried| carried.reported.clone()).collect(),
        }
    }

    fn keep_record(&mut self) {
        let status = &mut *self.record.status;
        let count = |outgoing: bool, counter: fn(&EdgeCounts) -> &AtomicU64| -> u64 {
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
