//! The reports of a running bridge: `top` and the summary show its links and edges.

use super::counts::EdgeCounts;
use super::links::{Links, PeerState};
use conicflow_dataflow::relay::{StatusFile, read_links, write_links};
use conicflow_dataflow::{BridgePlan, BridgeRun, Edge, EdgeReport, InputCounts, LinkReport, LinkState, NO_RUN, Status};
use conicflow_messages::Text;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::{Duration, Instant};

const PERIOD: Duration = Duration::from_secs(1);

/// An edge and its counts.
pub(crate) struct EdgeHandle<'a> {
    pub edge: &'a Edge,
    pub outgoing: bool,
    pub counts: Arc<EdgeCounts>,
    reported: EdgeReport,
}

impl<'a> EdgeHandle<'a> {
    /// Returns an edge whose counts continue from the links and the record of an earlier bridge process of the run.
    fn new(edge: &'a Edge, outgoing: bool, links: &[LinkReport], record: &Status) -> Self {
        let mut links = links.iter().filter(|link| reaches(edge, outgoing, &link.machine));
        let is_it =
            |report: &&EdgeReport| report.topic == edge.topic.name && report.direction == direction_word(outgoing);
        let reported = links.find_map(|link| link.edges.iter().find(is_it)).cloned().unwrap_or_default();
        let is_its_input = |input: &&InputCounts| outgoing && input.topic == Text::new(&edge.topic.name);
        let input = record.used_inputs().find(is_its_input).copied().unwrap_or_default();
        Self { edge, outgoing, counts: Arc::new(EdgeCounts::after(&reported, input)), reported }
    }

    fn report(&mut self, seconds: f64) {
        self.reported =
            self.counts.report(&self.edge.topic.name, direction_word(self.outgoing), &self.reported, seconds);
    }
}

/// Whether an edge leads to or from a machine.
fn reaches(edge: &Edge, outgoing: bool, machine: &str) -> bool {
    if outgoing { edge.delivery_to(machine).is_some() } else { edge.from == machine }
}

/// The word for the direction of an edge.
fn direction_word(outgoing: bool) -> &'static str {
    if outgoing { "out" } else { "in" }
}

/// Writes the record and the links of a bridge.
pub(crate) struct BridgeReporter<'a> {
    run: BridgeRun<'a>,
    pub record: StatusFile,
    links: &'a Links,
    pub edges: Vec<EdgeHandle<'a>>,
    reported: Instant,
}

impl<'a> BridgeReporter<'a> {
    pub(crate) fn new(bridge: &'a BridgePlan, run: BridgeRun<'a>, record: StatusFile, links: &'a Links) -> Self {
        // Bridges that were started by themselves share no run.
        let before = if run.run == NO_RUN { Vec::new() } else { read_links(run.folder, run.run) };
        let handle = |edge, outgoing| EdgeHandle::new(edge, outgoing, &before, &record.status);
        let outgoing = bridge.outgoing.iter().map(|edge| handle(edge, true));
        let edges: Vec<_> = outgoing.chain(bridge.incoming.iter().map(|edge| handle(edge, false))).collect();
        Self { run, record, links, edges, reported: Instant::now() }
    }

    /// Whether it is time to report.
    pub(crate) fn is_due(&self, now: Instant) -> bool {
        now.saturating_duration_since(self.reported) > PERIOD
    }

    /// Writes the reports for `top` and the summary; `reachable` says whether there is any link.
    pub(crate) fn report(&mut self, reachable: bool) {
        let seconds = self.reported.elapsed().as_secs_f64();
        self.reported = Instant::now();
        self.edges.iter_mut().for_each(|edge| edge.report(seconds));
        let states = self.links.check_peers();
        let links: Vec<_> = states.iter().map(|(machine, state)| self.link(machine, state, reachable)).collect();
        write_links(self.run.folder, self.run.run, &links).ok();
        self.keep_record();
    }

    fn link(&self, machine: &str, peer: &PeerState, reachable: bool) -> LinkReport {
        let state = match peer {
            PeerState { connected: true, .. } => LinkState::Up,
            PeerState { refused: true, .. } => LinkState::Refused,
            _ if !reachable => LinkState::Unreachable,
            PeerState { was_heard: true, .. } => LinkState::Down,
            _ => LinkState::Never,
        };
        let edges = self.edges.iter().filter(|handle| reaches(handle.edge, handle.outgoing, machine));
        LinkReport {
            machine: machine.to_owned(),
            state,
            state_s: peer.time.as_secs_f64(),
            was_heard: peer.was_heard,
            round_trip_ms: peer.clock.map(|clock| clock.round_trip_ns as f64 / 1e6),
            clock_offset_s: peer.clock.map(|clock| clock.offset_ns as f64 / 1e9),
            edges: edges.map(|edge| edge.reported.clone()).collect(),
        }
    }

    fn keep_record(&mut self) {
        let status = &mut *self.record.status;
        let count = |outgoing: bool, counter: fn(&EdgeCounts) -> &AtomicU64| -> u64 {
            let edges = self.edges.iter().filter(|edge| edge.outgoing == outgoing);
            edges.map(|edge| counter(&edge.counts).load(Ordering::Relaxed)).sum()
        };
        status.steps = count(true, |counts| &counts.messages) + count(false, |counts| &counts.messages);
        status.sent = count(false, |counts| &counts.messages);
        status.sent_bytes = count(false, |counts| &counts.memory_bytes);
        let outgoing = self.edges.iter().filter(|edge| edge.outgoing);
        for (slot, handle) in status.inputs.iter_mut().zip(outgoing) {
            let (input, unwanted) = (*handle.counts.input(), handle.counts.unwanted.load(Ordering::Relaxed));
            let (topic, dropped) = (Text::new(&handle.edge.topic.name), input.dropped.saturating_add(unwanted));
            let EdgeReport { messages: received, malformed, .. } = handle.reported;
            *slot = InputCounts { topic, received, dropped, malformed, ..input };
        }
        self.record.write();
    }
}

#[cfg(test)]
mod tests {
    use super::super::clock::Exchange;
    use super::super::journal::Journal;
    use super::*;
    use crate::edge_tests;
    use crate::wire::seal::Seal;
    use conicflow_dataflow::Receiver;
    use conicflow_dataflow::ports::{Delivery, Topic};
    use std::path::Path;

    fn plan(outgoing: Vec<Edge>, incoming: Vec<Edge>) -> BridgePlan {
        BridgePlan { machine: "base".to_owned(), outgoing, incoming, ..BridgePlan::default() }
    }

    /// The edge that carries topic `name` to machine `to`.
    fn edge(to: &str, name: &str) -> Edge {
        let edge = edge_tests::edge(Delivery::Latest, "reader");
        let topic = Topic { name: name.to_owned(), ..edge.topic };
        Edge { topic, to: vec![Receiver { machine: to.to_owned(), delivery: Delivery::Latest }], ..edge }
    }

    fn links(plan: &BridgePlan) -> Links {
        Links::new(Journal::open(None, 7, 1), Seal::new(None, 1), plan)
    }

    fn reporter<'a>(plan: &'a BridgePlan, folder: &'a Path, links: &'a Links) -> BridgeReporter<'a> {
        let record = StatusFile::open(&folder.join("bridge.status"), 7).unwrap();
        BridgeReporter::new(plan, BridgeRun { pipeline: "tracking", run: 7, folder }, record, links)
    }

    #[test]
    fn the_state_of_a_link_follows_from_its_peer_and_its_times_have_the_right_units() {
        let (folder, plan) = (tempfile::tempdir().unwrap(), plan(Vec::new(), Vec::new()));
        let links = links(&plan);
        let reporter = reporter(&plan, folder.path(), &links);
        let clock = Some(Exchange { round_trip_ns: 2_500_000, offset_ns: -1_500_000_000 });
        for ([connected, refused, reachable, was_heard], state) in [
            ([true, false, true, true], LinkState::Up),
            ([true, true, true, true], LinkState::Up),
            ([false, true, true, true], LinkState::Refused),
            ([false, true, false, false], LinkState::Refused),
            ([false, false, false, true], LinkState::Unreachable),
            ([false, false, true, true], LinkState::Down),
            ([false, false, true, false], LinkState::Never),
        ] {
            let peer = PeerState { was_heard, connected, refused, time: Duration::from_millis(1500), clock };
            let link = reporter.link("robot", &peer, reachable);
            assert_eq!((link.state, link.state_s), (state, 1.5));
            assert_eq!((link.round_trip_ms, link.clock_offset_s), (Some(2.5), Some(-1.5)));
        }
    }

    #[test]
    fn a_report_is_due_when_the_last_one_is_older_than_a_second() {
        let (folder, plan) = (tempfile::tempdir().unwrap(), plan(Vec::new(), Vec::new()));
        let links = links(&plan);
        let reporter = reporter(&plan, folder.path(), &links);
        let after = |passed_ms: u64| reporter.reported + Duration::from_millis(passed_ms);
        assert_eq!([0, 1000, 1001].map(|passed_ms| reporter.is_due(after(passed_ms))), [false, false, true]);
    }

    #[test]
    fn a_link_shows_the_edges_to_and_from_its_machine() {
        let outgoing = Edge { from: "base".to_owned(), ..edge("robot", "objects") };
        let incoming = Edge { from: "arm".to_owned(), ..edge("base", "tracks") };
        let (folder, plan) = (tempfile::tempdir().unwrap(), plan(vec![outgoing], vec![incoming]));
        let links = links(&plan);
        let mut reporter = reporter(&plan, folder.path(), &links);
        EdgeCounts::add(&reporter.edges[0].counts.messages, 3);
        EdgeCounts::add(&reporter.edges[1].counts.messages, 5);
        reporter.report(true);
        let shown = |machine: &str| {
            let peer =
                PeerState { was_heard: true, connected: true, refused: false, time: Duration::ZERO, clock: None };
            let edges = reporter.link(machine, &peer, true).edges.into_iter();
            edges.map(|edge| format!("{} {}: {}", edge.topic, edge.direction, edge.messages)).collect::<Vec<_>>()
        };
        assert_eq!(["robot", "arm", "hall"].map(shown), [vec!["objects out: 3"], vec!["tracks in: 5"], vec![]]);
    }

    #[test]
    fn outgoing_messages_count_as_received_by_the_bridge_and_incoming_ones_as_sent_by_it() {
        let (outgoing, incoming) = (vec![edge("robot", "objects")], vec![edge("base", "tracks")]);
        let (folder, plan) = (tempfile::tempdir().unwrap(), plan(outgoing, incoming));
        let links = links(&plan);
        let mut reporter = reporter(&plan, folder.path(), &links);
        EdgeCounts::add(&reporter.edges[0].counts.messages, 3);
        EdgeCounts::add(&reporter.edges[1].counts.messages, 5);
        reporter.edges[0].counts.input().dropped = 20;
        EdgeCounts::add(&reporter.edges[0].counts.unwanted, 100);
        reporter.report(true);
        let status = &reporter.record.status;
        assert_eq!((status.steps, status.sent), (8, 5));
        let inputs: Vec<_> =
            status.used_inputs().map(|input| (input.topic.to_string(), input.received, input.dropped)).collect();
        assert_eq!(inputs, [("objects".to_owned(), 3, 120)]);
    }

    #[test]
    fn the_next_bridge_of_a_run_continues_all_counts_of_each_edge_and_that_of_another_run_starts_at_zero() {
        let from = |machine: &str| Edge { from: machine.to_owned(), ..edge("base", "tracks") };
        let (folder, plan) =
            (tempfile::tempdir().unwrap(), plan(vec![edge("robot", "objects")], vec![from("arm"), from("robot")]));
        let links = links(&plan);
        let mut first = reporter(&plan, folder.path(), &links);
        for (index, handle) in first.edges.iter().enumerate() {
            let EdgeCounts { messages, lost, stale, malformed, unwanted, .. } = &*handle.counts;
            let counters = [messages, lost, stale, malformed, unwanted];
            (1..).zip(counters).for_each(|(nth, counter)| EdgeCounts::add(counter, 10 * index as u64 + nth));
        }
        let counted = InputCounts { dropped: 20, gaps: 21, late: 22, malformed: 23, ..InputCounts::default() };
        *first.edges[0].counts.input() = counted;
        let counts_after_report = |reporter: &mut BridgeReporter<'_>| {
            reporter.report(true);
            let [input, ..] = reporter.record.status.inputs;
            let report = |EdgeReport { messages, lost, stale, malformed, .. }: &EdgeReport| {
                [*messages, *lost, *stale, *malformed]
            };
            let reports: Vec<_> = reporter.edges.iter().map(|handle| report(&handle.reported)).collect();
            (reports, [input.received, input.dropped, input.gaps, input.late, input.malformed])
        };
        let before = counts_after_report(&mut first);
        let expected = (vec![[1, 2, 3, 4 + 23], [11, 12, 13, 14], [21, 22, 23, 24]], [1, 20 + 5, 21, 22, 4 + 23]);
        assert_eq!(before, expected);
        for _ in 0..2 {
            assert_eq!(counts_after_report(&mut reporter(&plan, folder.path(), &links)), before);
        }
        let record = StatusFile::open(&folder.path().join("bridge.status"), 8).unwrap();
        let run = BridgeRun { pipeline: "tracking", run: 8, folder: folder.path() };
        assert_eq!(
            counts_after_report(&mut BridgeReporter::new(&plan, run, record, &links)),
            (vec![[0; 4]; 3], [0; 5])
        );
    }
}
