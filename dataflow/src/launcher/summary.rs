//! Summary of a run: reads the records of its stages, for the progress of a running one and for the report at its end.

use super::folder::RunFolder;
use crate::item_type::ItemType;
use crate::network::Edge;
use crate::network::link_report::{EdgeReport, LinkReport, read_links};
use crate::plan::{Plan, PlannedStage, Runs};
use crate::ports::Delivery;
use crate::standstill;
use crate::status::{Durations, InputCounts, Life, Pausing, Status, used};
use crate::table::Table;
use conicflow_messages::plain;
use std::fmt::{self, Display};
use std::time::Duration;

/// The records of a run's stages at one moment.
pub struct Summary {
    /// Name of the pipeline.
    pub pipeline: String,
    /// Time since the run began.
    pub elapsed: Duration,
    /// The stages, in the order of the file.
    pub stages: Vec<StageSummary>,
    /// The links to other machines.
    pub links: Vec<LinkReport>,
    ending: Ending,
}

/// The launcher's knowledge of how a run ended, in addition to the records.
#[derive(Clone, Debug)]
pub(crate) struct Ending {
    /// Whether no stage was lost.
    pub(crate) complete: bool,
    /// Whether the user ended the run without waiting for messages in flight.
    pub(crate) hurried: bool,
    /// Reason why the stages were ended although not all was delivered.
    pub(crate) stalled: Option<String>,
}

/// Messages that a lossless reader did not get.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LostMessages {
    /// Name of the topic.
    pub topic: String,
    /// Reader that lost them: a stage, the stages of another machine, or the bridge of this one.
    pub reader: String,
    /// Number of lost messages, and of all messages sent.
    pub count: [u64; 2],
    /// Number of lost messages that arrived malformed.
    pub malformed: u64,
}

impl Display for LostMessages {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { topic, reader, count: [lost, sent], malformed } = self;
        write!(f, "{reader} lost {lost} of {sent} messages of the lossless topic `{topic}`")?;
        if *malformed > 0 { write!(f, ", {malformed} of them because they made no sense") } else { Ok(()) }
    }
}

/// A stage and its record.
pub struct StageSummary {
    /// Its plan.
    pub planned: PlannedStage,
    /// Its record, once it has one.
    pub status: Option<Box<Status>>,
}

impl Summary {
    pub(crate) fn read(plan: &Plan, folder: &RunFolder, elapsed: Duration, ending: Ending) -> Self {
        let stages = plan.stages.iter().map(|planned| StageSummary {
            planned: planned.clone(),
            status: folder.record(&planned.name, plan.run).map(Box::new),
        });
        let links = read_links(folder.path(), plan.run);
        Self { pipeline: plan.pipeline.clone(), elapsed, stages: stages.collect(), links, ending }
    }

    /// Whether the run lost no stage and no message of a lossless reader, and did not stall at its end.
    pub fn is_complete(&self) -> bool {
        self.ending.complete && self.ending.stalled.is_none() && self.lost().is_empty()
    }

    /// Number of messages processed by all stages together.
    pub(crate) fn worked_on(&self) -> u64 {
        self.statuses().map(|(_, status)| status.steps).sum()
    }

    /// Describes what each unfinished stage waits for.
    pub(crate) fn who_waits(&self) -> Vec<String> {
        standstill::who_waits(&self.statuses().collect::<Vec<_>>())
    }

    /// Whether any stage waits for another one to take its messages.
    pub(crate) fn is_held_up(&self) -> bool {
        standstill::is_held_up(&self.statuses().collect::<Vec<_>>())
    }

    /// Whether a source could be paused, and whether one is paused.
    pub(crate) fn pausing(&self) -> (bool, bool) {
        let sources = || self.statuses().map(|(_, status)| status).filter(|status| status.life() == Life::Running);
        let is = |pausing: Pausing| sources().any(|status| status.pausing() == pausing);
        (is(Pausing::Goes), is(Pausing::Stands))
    }

    /// Messages that lossless readers lost in a run that has ended. Empty where the user ended the run before all was delivered,
    /// or the reader wanted no more. A stage that is killed loses the messages in its queue.
    pub fn lost(&self) -> Vec<LostMessages> {
        let lost = self.statuses().flat_map(|(planned, status)| {
            planned.wiring.inputs().enumerate().filter_map(move |(index, topic)| {
                let count = self.lost_by(planned, status, index).filter(|[lost, _]| *lost > 0)?;
                // Malformed messages of other senders may not be among those sent.
                let malformed = status.inputs[index].malformed.min(count[0]);
                Some(LostMessages {
                    topic: topic.name.clone(),
                    reader: format!("`{}`", planned.name),
                    count,
                    malformed,
                })
            })
        });
        lost.chain(self.lost_on_the_way()).collect()
    }

    /// Messages of lossless edges that were lost between machines: those that the bridge of this machine sent without an
    /// acknowledgement, and those that it could not send or pass on. Other losses are counted by the stages that miss them.
    fn lost_on_the_way(&self) -> impl Iterator<Item = LostMessages> {
        let links = self.links.iter().filter(|_| !self.ending.hurried);
        links.flat_map(|link| {
            let lossless = link.edges.iter().filter(|edge| self.is_lossless(edge, &link.machine));
            let lost = lossless.map(|edge| {
                let (lost, reader) = match edge.comes() {
                    true => (0, "the bridge".to_owned()),
                    false => (edge.lost, format!("machine `{}`", link.machine)),
                };
                let count = [lost, edge.messages].map(|count| count.saturating_add(edge.refused));
                LostMessages { topic: edge.topic.clone(), reader, count, malformed: edge.refused }
            });
            lost.filter(|lost| lost.count[0] > 0)
        })
    }

    /// Whether an edge is lossless for the machine that receives it: the other end of a link, or this machine for an incoming
    /// edge.
    fn is_lossless(&self, report: &EdgeReport, machine: &str) -> bool {
        let mut bridges = self.stages.iter().filter_map(|stage| match &stage.planned.runs {
            Runs::Bridge(bridge) => Some(bridge),
            _ => None,
        });
        let is_it = |edge: &&Edge| edge.topic.name == report.topic;
        bridges.any(|bridge| match report.comes() {
            true => {
                let mut edges = bridge.incoming.iter().filter(is_it).filter(|edge| edge.from == machine);
                edges.any(|edge| edge.delivery_to(&bridge.machine) == Some(Delivery::Lossless))
            }
            false => {
                let mut edges = bridge.outgoing.iter().filter(is_it);
                edges.any(|edge| edge.delivery_to(machine) == Some(Delivery::Lossless))
            }
        })
    }

    /// Number of messages that a lossless reader missed of an input, and number of messages sent; `None` if it did not want all.
    fn lost_by(&self, planned: &PlannedStage, status: &Status, index: usize) -> Option<[u64; 2]> {
        let topic = planned.wiring.inputs().nth(index)?;
        let wants_all = topic.delivery_to(&planned.name) == Delivery::Lossless && status.had_enough == 0;
        if self.ending.hurried || !wants_all {
            return None;
        }
        let InputCounts { received, dropped, late, malformed, .. } = status.inputs[index];
        // How many messages a stage of another machine has sent is known only from their numbers. These come from outside.
        let sent = topic.writers.iter().map(|writer| self.sent_by(writer)).sum::<Option<u64>>();
        let sent = sent.unwrap_or(0).max(received.saturating_add(dropped));
        let missing = sent.saturating_sub(received.saturating_add(late)).max(dropped);
        // A side input is wanted only as long as the driving input lasts.
        let wanted = if index == 0 { missing } else { missing.min(dropped.saturating_add(malformed)) };
        Some([wanted, sent])
    }

    /// Number of messages that an input lost: those that its stage counted and, once the stage is over, those that no process
    /// received because the stage was killed after its writers had ended.
    fn dropped_by(&self, planned: &PlannedStage, status: &Status, index: usize) -> u64 {
        let is_over = status.life().is_over();
        let lost = self.lost_by(planned, status, index).filter(|_| is_over);
        // A process that dies on each message counts none.
        let is_hopeless = is_over && status.starts > 1 && status.inputs[index].received == 0;
        let topic = planned.wiring.inputs().nth(index).filter(|_| is_hopeless);
        let sent = topic.into_iter().flat_map(|topic| &topic.writers).filter_map(|writer| self.sent_by(writer)).sum();
        status.inputs[index].dropped.max(lost.map_or(0, |[lost, _]| lost)).max(sent)
    }

    /// Number of messages that a stage has sent; `None` without a record here.
    fn sent_by(&self, stage: &str) -> Option<u64> {
        self.statuses().find(|(planned, _)| planned.name == stage).map(|(_, status)| status.sent)
    }

    /// Number of frames that the sources have made, and the total where all of them know theirs.
    pub fn frames(&self) -> (u64, Option<u64>) {
        let alone = self.stages.iter().all(|stage| stage.planned.is_bridge() || !stage.planned.is_source());
        let sources = self.statuses().filter(|(planned, _)| planned.is_source() && (alone || !planned.is_bridge()));
        let (mut made, mut total) = (0, Some(0));
        for (_, status) in sources {
            made += status.sent;
            total = total.filter(|_| status.total > 0).map(|sum: u64| sum + status.total);
        }
        (made, total.filter(|total| *total > 0))
    }

    /// Number of frames that have reached the end of the pipeline: those of the busiest sink.
    pub fn finished(&self) -> u64 {
        self.statuses().filter(|(planned, _)| planned.is_sink()).map(|(_, status)| status.steps).max().unwrap_or(0)
    }

    /// Number of messages that inputs dropped.
    pub fn dropped(&self) -> u64 {
        let inputs = self.statuses().flat_map(|(planned, status)| {
            let used = status.used_inputs().enumerate();
            used.map(move |(index, _)| self.dropped_by(planned, status, index))
        });
        inputs.fold(0, u64::saturating_add)
    }

    /// Number of restarts of stages.
    pub fn restarts(&self) -> u64 {
        self.statuses().map(|(_, status)| status.starts.saturating_sub(1)).sum()
    }

    /// Number of objects found so far.
    pub fn objects(&self) -> u64 {
        let writers = self.statuses().filter(|(planned, _)| !planned.is_sink());
        writers.map(|(_, status)| used(&status.found).map(|(_, count)| count).sum()).max().unwrap_or(0)
    }

    fn statuses(&self) -> impl Iterator<Item = (&PlannedStage, &Status)> {
        self.stages.iter().filter_map(|stage| Some((&stage.planned, stage.status.as_deref()?)))
    }

    fn stage_table(&self) -> Table {
        let mut table = Table::new(&["stage", "node", "messages", "compute p50", "p99", "starts"]);
        for (planned, status) in self.statuses() {
            let node = planned.runs.name().to_owned();
            let times = &status.compute;
            let row = [planned.name.clone(), node, status.steps.to_string(), time(times, 0.5), time(times, 0.99)];
            table.row(row.into_iter().chain([status.starts.to_string()]));
        }
        table
    }

    fn input_table(&self) -> Table {
        let mut table = Table::new(&["topic", "reader", "received", "dropped", "gaps", "late", "hop p50", "p99"]);
        for (planned, status) in self.statuses() {
            for (index, input) in status.used_inputs().enumerate() {
                let driving = index == 0 && !planned.is_source();
                let hop = |quantile| if driving { time(&status.hop, quantile) } else { String::new() };
                let dropped = self.dropped_by(planned, status, index);
                let counts = [input.received, dropped, input.gaps, input.late].map(|count| count.to_string());
                let names = [input.topic.to_string(), planned.name.clone()];
                table.row(names.into_iter().chain(counts).chain([hop(0.5), hop(0.99)]));
            }
        }
        table
    }
}

/// Describes what a stage found in how many frames; `None` for a stage that does not find objects.
fn found(planned: &PlannedStage, status: &Status) -> Option<String> {
    let item = planned.wiring.output.as_ref().and_then(|topic| topic.item.as_ref());
    // A source passes on what others have found.
    let finds =
        item.is_some_and(ItemType::is_counted) && !planned.is_bridge() && !planned.is_source() && status.steps > 0;
    let found: Vec<_> = used(&status.found).map(|(label, count)| format!("{} {count}", plain(label))).collect();
    match found.is_empty() {
        true => finds.then(|| format!("nothing in {} frames", status.steps)),
        false => Some(format!("in {} frames: {}", status.steps, found.join(", "))),
    }
}

/// Table of the links to other machines and their traffic.
pub fn link_table(links: &[LinkReport]) -> Table {
    let mut table = Table::new(&["link", "topic", "way", "messages", "Hz", "MB/s", "lost", "resent", "age", "state"]);
    for link in links {
        let state = format!("{} {:.0} s", link.state, link.state_s);
        for edge in &link.edges {
            let names = [&link.machine, &edge.topic, &edge.direction].map(String::clone);
            let rates = [format!("{:.1}", edge.rate_hz), format!("{:.2}", edge.bandwidth_mbps)];
            let lost = (edge.lost + edge.stale + edge.malformed).to_string();
            let times = [format!("{:.1} ms", edge.age_ms), state.clone()];
            let counts = [lost, edge.resent.to_string()];
            let row = names.into_iter().chain([edge.messages.to_string()]).chain(rates).chain(counts);
            table.row(row.chain(times));
        }
    }
    table
}

fn time(durations: &Durations, quantile: f64) -> String {
    durations.quantile(quantile).map_or("-".to_owned(), |time| format!("{:.3} ms", time.as_secs_f64() * 1e3))
}

impl Summary {
    /// The summary with all counters, including the reasons for rejected candidates.
    pub fn in_detail(&self) -> impl Display {
        Text { summary: self, in_detail: true }
    }

    /// Whether any message was sent or processed.
    fn has_begun(&self) -> bool {
        self.statuses().any(|(_, status)| status.sent + status.steps > 0)
    }

    fn links(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.links.is_empty() { Ok(()) } else { write!(f, "\n{}", link_table(&self.links)) }
    }

    /// Writes what was found and counted. Counters of stages in the middle say why candidates were rejected: without `in_detail`
    /// they are shown only where nothing was found.
    fn findings(&self, f: &mut fmt::Formatter<'_>, in_detail: bool) -> fmt::Result {
        let with_reasons = in_detail || self.objects() == 0;
        for (planned, status) in self.statuses() {
            if let Some(found) = found(planned, status) {
                writeln!(f, "{} found {found}", planned.name)?;
            }
            if planned.is_source() || planned.is_sink() || with_reasons {
                for (name, count) in used(&status.counters) {
                    writeln!(f, "  {}: {}: {count}", planned.name, plain(name))?;
                }
            }
        }
        Ok(())
    }
}

/// A summary as text.
struct Text<'a> {
    summary: &'a Summary,
    in_detail: bool,
}

impl Display for Summary {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        Text { summary: self, in_detail: false }.fmt(f)
    }
}

impl Display for Text<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { summary, in_detail } = *self;
        let (frames, _) = summary.frames();
        let seconds = summary.elapsed.as_secs_f64();
        let rate = frames as f64 / seconds.max(1e-9);
        writeln!(
            f,
            "{}: {frames} frames in {seconds:.1} s ({rate:.1} Hz), {} dropped",
            summary.pipeline,
            summary.dropped()
        )?;
        if summary.has_begun() {
            summary.findings(f, in_detail)?;
            writeln!(f)?;
            for (planned, status) in summary.statuses().filter(|(stage, _)| stage.is_sink() && !stage.is_bridge()) {
                let (median, late) = (time(&status.latency, 0.5), time(&status.latency, 0.99));
                writeln!(f, "latency from the source to `{}`: p50 {median}, p99 {late}", planned.name)?;
            }
            write!(f, "\n{}\n{}", summary.stage_table(), summary.input_table())?;
        }
        summary.links(f)?;
        summary.lost().iter().try_for_each(|lost| writeln!(f, "\nnot complete: {lost}"))?;
        summary.ending.stalled.iter().try_for_each(|why| writeln!(f, "\nnot complete: {why}"))?;
        if summary.ending.complete { Ok(()) } else { writeln!(f, "\nnot complete: a stage was lost, see above") }
    }
}

#[cfg(test)]
pub(super) mod tests {
    use super::*;
    use crate::network::{BridgePlan, Receiver};
    use crate::pipeline::{Compression, Restart};
    use crate::ports::{Topic, TopicReader, Wiring};
    use conicflow_messages::{Ellipse, Item, Object, Track};

    pub fn stage<T: Item>() -> PlannedStage {
        let output = Topic { name: "out".into(), item: Some(ItemType::of::<T>()), ..Topic::default() };
        let wiring = Wiring { output: Some(output), ..Wiring::default() };
        PlannedStage { name: "stage".into(), wiring, restart: Restart::Never, ..PlannedStage::default() }
    }

    /// A stage that counted_starts ellipses into items of this type.
    fn finder<T: Item>() -> PlannedStage {
        let mut planned = stage::<T>();
        let input = Topic { name: "in".into(), item: Some(ItemType::of::<Ellipse>()), ..Topic::default() };
        planned.wiring.input = Some(input);
        planned
    }

    #[test]
    fn that_nothing_was_found_is_told_of_those_that_look_for_it() {
        let mut status = Box::new(Status::default());
        assert_eq!(found(&finder::<Object>(), &status), None, "no frame came");
        status.steps = 12;
        assert_eq!(found(&finder::<Object>(), &status).as_deref(), Some("nothing in 12 frames"));
        assert_eq!(found(&stage::<Object>(), &status), None, "a source hands on what others found");
        assert_eq!(found(&finder::<Ellipse>(), &status), None, "ellipses are not counted");
        status.count_found("cone");
        assert_eq!(found(&finder::<Track>(), &status).as_deref(), Some("in 12 frames: cone 1"));
    }

    fn summary(status: Box<Status>) -> Summary {
        let stages = vec![StageSummary { planned: finder::<Object>(), status: Some(status) }];
        Summary {
            pipeline: "test".into(),
            elapsed: Duration::from_secs(1),
            stages,
            links: vec![],
            ending: Ending { complete: true, hurried: false, stalled: None },
        }
    }

    #[test]
    fn reasons_are_told_where_nothing_was_found_or_all_is_asked_for() {
        let mut status = Box::new(Status::default());
        status.steps = 12;
        status.count("candidates too short", 7);
        let reason = "stage: candidates too short: 7";
        assert!(summary(status.clone()).to_string().contains(reason));
        status.count_found("cone");
        let found = summary(status);
        assert!(found.to_string().contains("cone 1") && !found.to_string().contains(reason), "{found}");
        assert!(found.in_detail().to_string().contains(reason));
    }

    #[test]
    fn what_was_found_comes_first() {
        let mut status = Box::new(Status::default());
        status.steps = 12;
        status.count_found("cone");
        let text = summary(status).to_string();
        assert_eq!(text.lines().nth(1), Some("stage found in 12 frames: cone 1"), "{text}");
    }

    /// A run in which `reader` has these counts on a lossless topic to which another stage sent 40 messages.
    pub fn lossless(counts: InputCounts, writer: &str) -> Summary {
        let (mut reading, mut writing) = (Box::new(Status::default()), Box::new(Status::default()));
        (reading.inputs[0], writing.sent) = (counts, 40);
        let mut run = summary(reading);
        let readers = vec![TopicReader { stage: "stage".into(), delivery: Delivery::Lossless, queue: 4 }];
        let topic = Topic { name: "in".into(), writers: vec![writer.to_owned()], readers, ..Topic::default() };
        run.stages[0].planned.wiring.input = Some(topic);
        let planned = PlannedStage { name: "writer".into(), ..stage::<Ellipse>() };
        run.stages.push(StageSummary { planned, status: Some(writing) });
        run
    }

    #[test]
    fn what_a_lossless_reader_did_not_get_makes_a_run_incomplete() {
        let topic = conicflow_messages::Text::new("in");
        let counts = |received: u64, dropped: u64| InputCounts { topic, received, dropped, ..InputCounts::default() };
        let lost_of = |run: &Summary| run.lost().into_iter().map(|lost| lost.count).collect::<Vec<_>>();
        let lost = |run: Summary| lost_of(&run);
        assert_eq!(lost(lossless(counts(40, 0), "writer")), [[0; 2]; 0]);
        assert_eq!(lost(lossless(counts(37, 0), "writer")), [[3, 40]]);
        assert_eq!(lost(lossless(counts(37, 3), "writer")), [[3, 40]]);
        assert_eq!(lost(lossless(InputCounts { late: 3, ..counts(37, 0) }, "writer")), [[0; 2]; 0], "they came twice");
        let malformed = InputCounts { malformed: 3, ..counts(37, 0) };
        let run = lossless(malformed, "writer");
        let sentence = "of the lossless topic `in`, 3 of them because they made no sense\n";
        assert!(!run.is_complete() && run.to_string().contains(sentence), "{run}");
        assert_eq!(lost(run), [[3, 40]], "they came, but nobody could work on them");
        let forged = InputCounts { malformed: 3, ..counts(40, 0) };
        assert_eq!(lost(lossless(forged, "writer")), [[0; 2]; 0], "its writer has sent none of them");
        assert_eq!(lost(lossless(counts(37, 2), "elsewhere")), [[2, 39]], "its record is on another machine");
        assert_eq!(lost(lossless(counts(37, u64::MAX), "writer")), [[u64::MAX; 2]], "a number from outside");
        let run = lossless(counts(37, 0), "writer");
        let sentence = "not complete: `stage` lost 3 of 40 messages of the lossless topic `in`";
        assert!(!run.is_complete() && run.to_string().contains(sentence), "{run}");
        assert_eq!(run.dropped(), 0, "they may be under way");
        let mut over = lossless(counts(37, 0), "writer");
        over.stages[0].status.as_mut().unwrap().set_life(Life::Gone);
        over.stages[0].status.as_mut().unwrap().inputs[1].topic = conicflow_messages::Text::new("aside");
        assert_eq!(over.dropped(), 3, "nobody is left to count them, and of another input none is missing");
        let text = over.to_string();
        let dropped = |topic: &str| text.lines().find(|line| line.starts_with(topic))?.split_whitespace().nth(3);
        assert_eq!([dropped("in "), dropped("aside ")], [Some("3"), Some("0")], "{text}");
        let mut hopeless = lossless(counts(0, 0), "writer");
        hopeless.stages[0].planned.wiring.input.as_mut().unwrap().readers[0].delivery = Delivery::Latest;
        hopeless.stages[0].status.as_mut().unwrap().set_life(Life::Gone);
        assert_eq!((hopeless.dropped(), lost_of(&hopeless)), (0, vec![]), "it may have come too late for all of them");
        hopeless.stages[0].status.as_mut().unwrap().starts = 3;
        assert_eq!((hopeless.dropped(), lost_of(&hopeless)), (40, vec![]), "each process died of its first message");
        let mut sated = lossless(counts(37, 0), "writer");
        sated.stages[0].status.as_mut().unwrap().had_enough = 1;
        assert_eq!(lost(sated), [[0; 2]; 0], "it wanted no more");
        let ending = Ending { hurried: true, ..run.ending.clone() };
        assert_eq!(lost(Summary { ending, ..run }), [[0; 2]; 0], "nobody waited for them");
    }

    #[test]
    fn what_another_machine_did_not_get_of_a_lossless_topic_makes_a_run_incomplete() {
        let with = |delivery: Delivery, direction: &str, [lost, refused]: [u64; 2]| {
            let receiver = Receiver { machine: "base".into(), delivery };
            let edge = Edge {
                topic: Topic { name: "depth".into(), ..Topic::default() },
                item: ItemType::of::<u16>(),
                from: "robot".into(),
                writers: vec!["source".into()],
                to: vec![receiver],
                compression: Compression::None,
            };
            let incoming =
                Edge { from: "base".into(), to: vec![Receiver { machine: "robot".into(), delivery }], ..edge.clone() };
            let bridge = BridgePlan {
                machine: "robot".into(),
                outgoing: vec![edge],
                incoming: vec![incoming],
                ..BridgePlan::default()
            };
            let mut run = summary(Box::default());
            run.stages[0].planned.runs = Runs::Bridge(Box::new(bridge));
            let [topic, direction] = ["depth", direction].map(str::to_owned);
            let edge = EdgeReport { topic, direction, messages: 40, lost, refused, ..EdgeReport::default() };
            run.links = vec![LinkReport { machine: "base".into(), edges: vec![edge], ..LinkReport::default() }];
            run
        };
        let run = |delivery: Delivery, direction: &str| with(delivery, direction, [3, 0]);
        let lost = |run: &Summary| run.lost().iter().map(LostMessages::to_string).collect::<Vec<_>>();
        let lossy = run(Delivery::Lossless, "out");
        assert_eq!(lost(&lossy), ["machine `base` lost 3 of 40 messages of the lossless topic `depth`"]);
        assert!(!lossy.is_complete());
        assert!(lost(&run(Delivery::Latest, "out")).is_empty() && lost(&run(Delivery::Lossless, "in")).is_empty());
        let ending = Ending { hurried: true, ..lossy.ending.clone() };
        assert!(lost(&Summary { ending, ..lossy }).is_empty(), "nobody waited for them");
        let of_topic = "messages of the lossless topic `depth`, 2 of them because they made no sense";
        assert_eq!(lost(&with(Delivery::Lossless, "out", [3, 2])), [format!("machine `base` lost 5 of 42 {of_topic}")]);
        assert_eq!(lost(&with(Delivery::Lossless, "in", [3, 2])), [format!("the bridge lost 2 of 42 {of_topic}")]);
        assert!(["in", "out"].iter().all(|way| lost(&with(Delivery::Latest, way, [3, 2])).is_empty()));
    }

    #[test]
    fn of_what_comes_aside_only_what_was_dropped_or_made_no_sense_is_lost() {
        let topic = conicflow_messages::Text::new;
        let lost = |aside: InputCounts| {
            let mut run =
                lossless(InputCounts { topic: topic("in"), received: 40, ..InputCounts::default() }, "writer");
            let StageSummary { planned, status } = &mut run.stages[0];
            let driving = planned.wiring.input.clone().unwrap();
            planned.wiring.side_inputs.push(("known".into(), Topic { name: "aside".into(), ..driving }));
            status.as_mut().unwrap().inputs[1] = InputCounts { topic: topic("aside"), ..aside };
            run.lost().iter().map(LostMessages::to_string).collect::<Vec<_>>()
        };
        let came = |received| InputCounts { received, ..InputCounts::default() };
        assert!(lost(came(30)).is_empty(), "its driving input had ended");
        let told = "`stage` lost 2 of 40 messages of the lossless topic `aside`, 2 of them because they made no sense";
        assert_eq!(lost(InputCounts { malformed: 2, ..came(30) }), [told]);
        let told = "`stage` lost 3 of 40 messages of the lossless topic `aside`";
        assert_eq!(lost(InputCounts { dropped: 3, ..came(30) }), [told]);
        assert!(lost(InputCounts { malformed: 2, ..came(40) }).is_empty(), "its writer has sent none of them");
    }

    #[test]
    fn each_start_but_the_first_is_one_anew() {
        let mut run = lossless(InputCounts::default(), "writer");
        assert_eq!(run.restarts(), 0);
        for (stage, starts) in run.stages.iter_mut().zip([3, 1]) {
            stage.status.as_mut().unwrap().starts = starts;
        }
        assert_eq!(run.restarts(), 2);
    }

    #[test]
    fn a_link_has_a_line_for_each_topic_which_tells_all_that_did_not_come_as_lost() {
        let edge = EdgeReport { topic: "depth".into(), lost: 5, stale: 20, malformed: 300, ..EdgeReport::default() };
        let link = LinkReport { machine: "robot".into(), edges: vec![edge], ..LinkReport::default() };
        let run = Summary { links: vec![link], ..summary(Box::default()) };
        let text = run.to_string();
        let line = text.lines().find(|line| line.starts_with("robot")).unwrap();
        assert!(line.contains("depth") && line.split_whitespace().any(|cell| cell == "325"), "{text}");
    }

    #[test]
    fn the_latency_is_that_of_the_sinks() {
        let mut run = lossless(InputCounts::default(), "writer");
        run.stages[0].planned.wiring.output = None;
        let text = run.to_string();
        assert!(text.contains("latency from the source to `stage`") && !text.contains("to `writer`"), "{text}");
    }

    #[test]
    fn a_run_is_held_up_where_a_stage_waits_for_another_one() {
        let mut run = lossless(InputCounts::default(), "writer");
        assert!(!run.is_held_up());
        run.stages[1].status.as_mut().unwrap().waits_for = conicflow_messages::Text::new("stage");
        assert!(run.is_held_up());
        let waits = run.who_waits();
        assert!(waits.iter().any(|waits| waits.starts_with("`writer` has given no sign of life")), "{waits:?}");
    }

    #[test]
    fn a_run_that_was_ended_where_it_stood_still_is_not_complete() {
        let run = summary(Box::default());
        assert!(run.is_complete());
        let ending = Ending { stalled: Some("waited for `a`".into()), ..run.ending.clone() };
        let run = Summary { ending, ..run };
        assert!(!run.is_complete() && run.to_string().contains("\nnot complete: waited for `a`"), "{run}");
    }

    #[test]
    fn frames_are_those_of_the_sources_and_how_many_come_is_known_where_each_knows_its_own() {
        let mut run = lossless(InputCounts::default(), "writer");
        assert_eq!(run.frames(), (40, None));
        assert_eq!(summary(Box::default()).frames(), (0, None), "no source has begun");
        run.stages[1].status.as_mut().unwrap().total = 50;
        assert_eq!(run.frames(), (40, Some(50)));
        let planned = PlannedStage { name: "other".into(), ..stage::<Ellipse>() };
        let mut status = Box::new(Status::default());
        (status.sent, status.total) = (3, 10);
        run.stages.push(StageSummary { planned, status: Some(status) });
        assert_eq!(run.frames(), (43, Some(60)));
        run.stages[2].status.as_mut().unwrap().total = 0;
        assert_eq!(run.frames(), (43, None));
    }

    /// A bridge that has sent this many messages of other machines.
    fn bridge(sent: u64) -> StageSummary {
        let runs = Runs::Bridge(BridgePlan::default().into());
        let planned = PlannedStage { name: "bridge".into(), runs, ..stage::<Object>() };
        let mut status = Box::new(Status::default());
        (status.sent, status.steps) = (sent, sent);
        StageSummary { planned, status: Some(status) }
    }

    #[test]
    fn frames_of_other_machines_are_counted_where_none_are_made_here_and_what_is_found_there_is_not() {
        let mut run = lossless(InputCounts::default(), "writer");
        run.stages[0].status.as_mut().unwrap().sent = 3;
        run.stages.push(bridge(7));
        assert_eq!(run.frames(), (40, None));
        assert!(!run.to_string().contains("bridge found"), "{run}");
        run.stages.remove(1);
        assert_eq!(run.frames(), (7, None));
    }

    #[test]
    fn the_counters_of_sources_and_sinks_are_told_in_any_case_and_objects_are_those_before_a_sink() {
        let mut run = lossless(InputCounts::default(), "writer");
        let mut sink = StageSummary { planned: run.stages[0].planned.clone(), status: Some(Box::default()) };
        (sink.planned.name, sink.planned.wiring.output) = ("sink".into(), None);
        run.stages.push(sink);
        for (stage, objects) in run.stages.iter_mut().zip([3, 0, 9]) {
            let status = stage.status.as_mut().unwrap();
            status.count("noted", 5);
            (0..objects).for_each(|_| status.count_found("cone"));
        }
        assert_eq!(run.objects(), 3);
        let text = run.to_string();
        let is_reported = ["stage", "writer", "sink"].map(|name| text.contains(&format!("{name}: noted: 5")));
        assert_eq!(is_reported, [false, true, true], "{text}");
    }

    #[test]
    fn a_summary_begins_with_the_rate_and_has_a_line_for_each_stage_with_its_times() {
        let mut run = Summary { elapsed: Duration::from_secs(4), ..lossless(InputCounts::default(), "writer") };
        let status = run.stages[0].status.as_mut().unwrap();
        (status.steps, status.starts) = (38, 2);
        status.compute.add(1_000_000);
        let text = run.to_string();
        assert!(text.starts_with("test: 40 frames in 4.0 s (10.0 Hz), 0 dropped\n"), "{text}");
        let line = |name: &str| text.lines().rfind(|line| line.starts_with(name)).unwrap();
        let cells: Vec<_> = line("stage ").split_whitespace().collect();
        assert!(cells.contains(&"38") && cells.contains(&"ms") && cells.last() == Some(&"2"), "{text}");
        assert!(line("writer ").split_whitespace().any(|cell| cell == "-"), "no time was taken: {text}");
    }

    #[test]
    fn the_time_of_a_hop_stands_beside_the_input_that_drives_a_stage() {
        let mut status = Box::new(Status::default());
        status.steps = 1;
        status.inputs[0].topic = conicflow_messages::Text::new("in");
        status.inputs[1].topic = conicflow_messages::Text::new("aside");
        status.hop.add(1_000_000);
        let text = summary(status).to_string();
        let has_time = |topic: &str| text.lines().find(|line| line.starts_with(topic)).unwrap().ends_with(" ms");
        assert!(has_time("in ") && !has_time("aside "), "{text}");
    }

    #[test]
    fn a_run_that_never_began_has_no_tables() {
        let text = summary(Box::default()).to_string();
        assert_eq!(text, "test: 0 frames in 1.0 s (0.0 Hz), 0 dropped\n");
    }
}
