//! Serves the metrics of a run for Prometheus at the address in the pipeline file: the content of `top`, as counters and
//! histograms in the text format of OpenMetrics.
//!
//! The stages are not disturbed: the server reads the records that they keep anyway. Neither is the launcher: the server has its
//! own threads, of low priority.

use anyhow::Context;
use conicflow_dataflow::pipeline::Pipeline;
use conicflow_dataflow::{
    Durations, EdgeReport, InputCounts, LinkReport, LinkState, RunRecord, StageRecord, lock, records, used,
};
use conicflow_view::{Answer, Listen, Request, Response, Server};
use prometheus_client::collector::Collector;
use prometheus_client::encoding::text::encode;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric, NoLabelSet};
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::metrics::{MetricType, TypedMetric};
use prometheus_client::registry::{Registry, Unit};
use std::fmt;
use std::sync::Mutex;
use std::time::{Duration, Instant};

const PATH: &str = "/metrics";
/// The subject of errors.
const OF_FILE: &str = "`metrics` of the pipeline file";
/// Content type of an answer.
const KIND: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
/// Requests within this time get the same answer, without another look at the records.
const FRESH: Duration = Duration::from_millis(200);
/// Smallest end of a histogram's bucket, in seconds; shorter times count in the first bucket.
const SHORTEST_S: f64 = 60e-6;
/// Largest finite end of a histogram's bucket, in seconds; longer times count in the last bucket.
const LONGEST_S: f64 = 10.0;

/// Serves the metrics of a pipeline's run, if its file says so for this machine, until the server is dropped.
///
/// # Errors
/// The address cannot be used, or the token is not valid.
pub fn offer(pipeline: &Pipeline, machine: Option<&str>) -> anyhow::Result<Option<Server>> {
    let Some(listen) = listen(pipeline, machine)? else { return Ok(None) };
    let metrics = Metrics { pipeline: pipeline.name.clone(), last: Mutex::default() };
    let server = Server::start(&listen, metrics).context(OF_FILE)?;
    // The token is in the file, and should not be in a log.
    let address = server.url().split("/?").next().unwrap_or_default().trim_end_matches('/');
    tracing::info!("metrics are at {address}{PATH}");
    Ok(Some(server))
}

/// Returns the address at which this machine serves metrics according to the file.
///
/// # Errors
/// The token is not valid.
pub fn listen(pipeline: &Pipeline, machine: Option<&str>) -> anyhow::Result<Option<Listen>> {
    let Some(metrics) = pipeline.metrics_on(machine) else { return Ok(None) };
    let listen = match &metrics.token {
        Some(token) => Listen::read(Some(&metrics.listen.to_string()), Some(token)).context(OF_FILE)?,
        None => Listen::open(metrics.listen),
    };
    Ok(Some(listen))
}

struct Metrics {
    pipeline: String,
    last: Mutex<Option<(Instant, String)>>,
}

impl Answer for Metrics {
    fn answer(&self, request: &Request) -> Response {
        match (request.method.as_str(), request.path.as_str()) {
            ("GET", PATH) => self.text_response(),
            ("GET", _) => Response::refusal(404, "there is nothing here; the metrics are at /metrics"),
            _ => Response::refusal(405, "this is not done here"),
        }
    }
}

impl Metrics {
    fn text_response(&self) -> Response {
        let mut last = lock(&self.last);
        if let Some((_, text)) = last.as_ref().filter(|(since, _)| since.elapsed() < FRESH) {
            return Response::new(200, KIND, text.clone().into_bytes());
        }
        match records(&self.pipeline) {
            Ok(record) => {
                let text = text(&self.pipeline, Run(record));
                *last = Some((Instant::now(), text.clone()));
                Response::new(200, KIND, text.into_bytes())
            }
            Err(error) => Response::refusal(500, &error.to_string()),
        }
    }
}

/// Returns the metrics of a pipeline in the text format.
fn text(pipeline: &str, metrics: impl Collector) -> String {
    let labels = [("pipeline".into(), pipeline.to_owned().into())];
    let mut registry = Registry::with_prefix_and_labels("conicflow", labels.into_iter());
    registry.register_collector(Box::new(metrics));
    let mut text = String::new();
    // Writing to a string cannot fail.
    encode(&mut text, &registry).ok();
    text
}

/// Labels that distinguish the samples of a metric.
type Labels = Vec<(&'static str, String)>;

struct Run(RunRecord);

impl fmt::Debug for Run {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Run").finish_non_exhaustive()
    }
}

impl Collector for Run {
    fn encode(&self, encoder: DescriptorEncoder<'_>) -> fmt::Result {
        let mut families = Families(encoder);
        let Self(run) = self;
        families.of_program()?;
        families.of_stages(&run.stages)?;
        families.of_processes(&run.stages)?;
        families.of_topics(&run.stages)?;
        families.of_edges(&run.stages)?;
        families.of_times(&run.stages)?;
        families.of_links(&run.links)
    }
}

struct Families<'a>(DescriptorEncoder<'a>);

impl Families<'_> {
    fn of_program(&mut self) -> fmt::Result {
        let version = vec![("version", env!("CARGO_PKG_VERSION").to_owned())];
        self.gauge("build_info", "The program that runs the pipeline", None, [(version, 1.0)])
    }

    fn of_stages(&mut self, stages: &[StageRecord]) -> fmt::Result {
        let up = |stage: &StageRecord| f64::from(stage.usage.is_some());
        let node =
            |stage: &StageRecord| [of_stage(stage), vec![("node", stage.planned.runs.name().to_owned())]].concat();
        self.gauge(
            "stage_up",
            "Whether the stage is at work",
            None,
            stages.iter().map(|stage| (node(stage), up(stage))),
        )?;
        let count = |number: fn(&StageRecord) -> u64| stages.iter().map(move |stage| (of_stage(stage), number(stage)));
        self.counter(
            "frames",
            "Messages that the stage has worked on, or a source has made",
            count(|stage| stage.status.steps),
        )?;
        let again = |stage: &StageRecord| stage.status.starts.saturating_sub(1);
        self.counter("restarts", "How often the stage was started anew, in a swap as well", count(again))?;
        let found = stages.iter().flat_map(|stage| named(stage, "kind", &stage.status.found));
        self.counter("found", "Items that the stage has sent, by what they are called", found)?;
        let events = stages.iter().flat_map(|stage| named(stage, "event", &stage.status.counters));
        self.counter("events", "What the stage counts itself, such as why something was not found", events)
    }

    fn of_processes(&mut self, stages: &[StageRecord]) -> fmt::Result {
        let living = stages.iter().filter_map(|stage| Some((stage, stage.usage?)));
        let cpu = living.clone().map(|(stage, usage)| (of_stage(stage), usage.cpu.as_secs_f64()));
        self.counter_of("cpu", "Processor time of the stage's process", Some(Unit::Seconds), cpu)?;
        let memory = living.clone().map(|(stage, usage)| (of_stage(stage), usage.resident_bytes as f64));
        self.gauge(
            "memory",
            "Resident memory of the stage's process, shared memory included",
            Some(Unit::Bytes),
            memory,
        )?;
        let silent = living.clone().map(|(stage, usage)| (of_stage(stage), usage.silent.as_secs_f64()));
        self.gauge("silent", "Time since the stage's last sign of life", Some(Unit::Seconds), silent)?;
        let is_waiting = |stage: &StageRecord| f64::from(!stage.status.waits_for.to_string().is_empty());
        let waiting = living.map(|(stage, _)| (of_stage(stage), is_waiting(stage)));
        self.gauge("waiting", "Whether the stage waits for another to take its messages", None, waiting)
    }

    fn of_topics(&mut self, stages: &[StageRecord]) -> fmt::Result {
        let count = |number: fn(&StageRecord) -> u64| {
            let writers = stages.iter().filter_map(|stage| Some((stage, stage.planned.wiring.output.as_ref()?)));
            writers.map(move |(stage, topic)| (of_edge(&topic.name, stage), number(stage)))
        };
        self.counter(
            "sent_messages",
            "Messages that the stage has sent into the topic",
            count(|stage| stage.status.sent),
        )?;
        let bytes = count(|stage| stage.status.sent_bytes);
        self.counter_of("sent", "The same, in bytes of shared memory", Some(Unit::Bytes), bytes)
    }

    fn of_edges(&mut self, stages: &[StageRecord]) -> fmt::Result {
        let count = |number: fn(&InputCounts) -> u64| {
            let edges = stages.iter().flat_map(|stage| stage.status.used_inputs().map(move |input| (stage, input)));
            edges.map(move |(stage, input)| (of_edge(&input.topic.to_string(), stage), number(input)))
        };
        let received = count(|input| input.received);
        self.counter("received_messages", "Messages of the topic that the stage has worked on", received)?;
        let dropped = count(|input| input.dropped);
        self.counter("dropped_messages", "Messages of the topic that the stage has lost to newer ones", dropped)?;
        let gaps = count(|input| input.gaps);
        self.counter("missing_frames", "Frames that are missing in the sequence, wherever they were lost", gaps)?;
        let late = count(|input| input.late);
        self.counter("late_messages", "Messages that came twice or out of order, and were left out", late)?;
        let malformed = count(|input| input.malformed);
        self.counter("malformed_messages", "Messages that made no sense, and were left out", malformed)
    }

    fn of_times(&mut self, stages: &[StageRecord]) -> fmt::Result {
        let steps = stages.iter().map(|stage| (of_stage(stage), &stage.status.compute));
        self.histogram("step", "Time that the stage has worked on a message", steps)?;
        let driven = |times: fn(&StageRecord) -> &Durations| {
            let driven = stages.iter().filter(|stage| !stage.planned.is_source());
            let first = driven.filter_map(|stage| Some((stage, stage.status.used_inputs().next()?)));
            first.map(move |(stage, input)| (of_edge(&input.topic.to_string(), stage), times(stage)))
        };
        self.histogram(
            "hop",
            "Time from the writer's sending to the stage's receiving",
            driven(|stage| &stage.status.hop),
        )?;
        let latency = driven(|stage| &stage.status.latency);
        self.histogram(
            "latency",
            "Time from the source's having a frame to the stage's receiving what became of it",
            latency,
        )
    }

    fn of_links(&mut self, links: &[LinkReport]) -> fmt::Result {
        let of_link = |link: &LinkReport| vec![("machine", link.machine.clone())];
        let up = links.iter().map(|link| (of_link(link), f64::from(link.state == LinkState::Up)));
        self.gauge("link_up", "Whether the other machine is heard of", None, up)?;
        let round_trip = links.iter().filter_map(|link| Some((of_link(link), link.round_trip_ms? * 1e-3)));
        self.gauge("link_round_trip", "Shortest time there and back, of late", Some(Unit::Seconds), round_trip)?;
        let edges = links.iter().flat_map(|link| link.edges.iter().map(move |edge| (link, edge)));
        let count = |number: fn(&EdgeReport) -> u64| {
            edges.clone().map(move |(link, edge)| {
                let topic = [("topic", edge.topic.clone()), ("direction", edge.direction.clone())];
                ([of_link(link), topic.to_vec()].concat(), number(edge))
            })
        };
        self.counter("link_messages", "Messages that went over the link, out or in", count(|edge| edge.messages))?;
        self.counter_of("link", "The same, in bytes on the wire", Some(Unit::Bytes), count(|edge| edge.wire_bytes))?;
        self.counter("link_lost_messages", "Messages that were lost on the way, or given up", count(|edge| edge.lost))?;
        self.counter("link_resent_messages", "Messages that were sent again", count(|edge| edge.resent))?;
        self.counter("link_stale_messages", "Messages that came too late to be of use", count(|edge| edge.stale))?;
        self.counter("link_malformed_messages", "Messages that made no sense", count(|edge| edge.malformed))
    }

    fn gauge(
        &mut self,
        name: &str,
        help: &str,
        unit: Option<Unit>,
        rows: impl IntoIterator<Item = (Labels, f64)>,
    ) -> fmt::Result {
        self.family(name, help, unit, rows.into_iter().map(|(labels, value)| (labels, ConstGauge::new(value))))
    }

    fn counter(&mut self, name: &str, help: &str, rows: impl IntoIterator<Item = (Labels, u64)>) -> fmt::Result {
        self.counter_of(name, help, None, rows)
    }

    fn counter_of<N>(
        &mut self,
        name: &str,
        help: &str,
        unit: Option<Unit>,
        rows: impl IntoIterator<Item = (Labels, N)>,
    ) -> fmt::Result
    where
        ConstCounter<N>: EncodeMetric + TypedMetric,
    {
        self.family(name, help, unit, rows.into_iter().map(|(labels, value)| (labels, ConstCounter::new(value))))
    }

    fn family<M: EncodeMetric + TypedMetric>(
        &mut self,
        name: &str,
        help: &str,
        unit: Option<Unit>,
        rows: impl Iterator<Item = (Labels, M)>,
    ) -> fmt::Result {
        let mut family = self.0.encode_descriptor(name, help, unit.as_ref(), M::TYPE)?;
        for (labels, metric) in rows {
            metric.encode(family.encode_family(&labels)?)?;
        }
        Ok(())
    }

    fn histogram<'t>(
        &mut self,
        name: &str,
        help: &str,
        rows: impl Iterator<Item = (Labels, &'t Durations)>,
    ) -> fmt::Result {
        let mut family = self.0.encode_descriptor(name, help, Some(&Unit::Seconds), MetricType::Histogram)?;
        for (labels, times) in rows {
            let buckets = buckets(times);
            family.encode_family(&labels)?.encode_histogram::<NoLabelSet>(
                times.sum_s(),
                times.count(),
                &buckets,
                None,
            )?;
        }
        Ok(())
    }
}

/// Returns the upper ends of a histogram's buckets, with the number of times in each.
fn buckets(times: &Durations) -> Vec<(f64, u64)> {
    let (mut buckets, mut shorter) = (Vec::new(), 0);
    for (end, count) in times.octaves() {
        shorter += count;
        if (SHORTEST_S..=LONGEST_S).contains(&end) {
            buckets.push((end, std::mem::take(&mut shorter)));
        }
    }
    buckets.push((f64::INFINITY, shorter));
    buckets
}

fn of_stage(stage: &StageRecord) -> Labels {
    vec![("stage", stage.planned.name.clone())]
}

fn of_edge(topic: &str, stage: &StageRecord) -> Labels {
    vec![("topic", topic.to_owned()), ("stage", stage.planned.name.clone())]
}

/// Returns the named counts of a stage.
fn named<'s>(
    stage: &'s StageRecord,
    label: &'static str,
    counters: &'s [conicflow_dataflow::Counter],
) -> impl Iterator<Item = (Labels, u64)> + 's {
    used(counters).map(move |(name, count)| ([of_stage(stage), vec![(label, name.to_owned())]].concat(), count))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug)]
    struct Odd;

    impl Collector for Odd {
        fn encode(&self, encoder: DescriptorEncoder<'_>) -> fmt::Result {
            Families(encoder).counter("events", "What is odd", [(vec![("event", "a \"b\\c\nd".to_owned())], 3)])
        }
    }

    #[test]
    fn names_of_counts_of_other_programs_are_escaped() {
        let expected = "# HELP conicflow_events What is odd\n# TYPE conicflow_events counter\n\
                        conicflow_events_total{pipeline=\"odd\",event=\"a \\\"b\\\\c\\nd\"} 3\n# EOF\n";
        assert_eq!(text("odd", Odd), expected);
    }

    #[test]
    fn each_duration_is_in_exactly_one_bucket() {
        let mut times = Durations::default();
        [1, 70, 1000, 1000, 8_000_000, 100_000_000].into_iter().for_each(|us: u64| times.add(us * 1000));
        let buckets = buckets(&times);
        assert!(buckets.is_sorted_by(|(one, _), (next, _)| one < next));
        let up_to =
            |end: f64| buckets.iter().take_while(|(upper, _)| *upper <= end).map(|(_, count)| count).sum::<u64>();
        assert_eq!([66e-6, 132e-6, 0.0011, 9.0, f64::INFINITY].map(up_to), [1, 2, 4, 5, 6]);
    }
}
