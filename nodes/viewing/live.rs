//! Shows running pipelines on the page, as an onlooker for which no stage waits; attached only while a browser is connected.

use super::graph::GraphWatch;
use super::{list_of, pausing};
use crate::NODES;
use anyhow::Result;
use conicflow_dataflow::ports::Topic;
use conicflow_dataflow::{ItemType, Requirements, RunningPipeline, Watching, lock, monotonic_ns};
use conicflow_messages::{Item, Object, Track};
use conicflow_view::{Command, Display, Gatherer};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex};
use std::thread::{self, sleep};
use std::time::{Duration, Instant};

/// Period of the search for pipelines, and of the check whether a browser is connected.
const PIPELINE_CHECK_PERIOD: Duration = Duration::from_millis(200);
/// Period of the graph's updates.
const PERIOD: Duration = Duration::from_secs(1);

/// The pipeline and depth topic that a browser has asked for.
#[derive(Clone, Debug, Default, PartialEq)]
struct Wanted {
    pipeline: Option<String>,
    depth_topic: Option<String>,
}

/// Shows running pipelines.
pub struct Live {
    display: Arc<Display>,
    wanted: Arc<Mutex<Wanted>>,
    /// The pipeline that is shown now.
    shown: Arc<Mutex<Option<String>>>,
}

impl Live {
    /// Shows the pipeline of this name, or the first one that runs, until another one is asked for.
    ///
    /// # Errors
    /// A thread cannot be started.
    pub fn start(display: Arc<Display>, pipeline: Option<String>) -> Result<Self> {
        let wanted = Arc::new(Mutex::new(Wanted { pipeline, depth_topic: None }));
        let live = Self { display, wanted, shown: Arc::default() };
        let (display, wanted, shown) = (Arc::clone(&live.display), Arc::clone(&live.wanted), Arc::clone(&live.shown));
        thread::Builder::new().name("commands".to_owned()).spawn(move || take_commands(&display, &wanted, &shown))?;
        let (display, shown) = (Arc::clone(&live.display), Arc::clone(&live.shown));
        thread::Builder::new().name("graph".to_owned()).spawn(move || show_graph(&display, &shown))?;
        Ok(live)
    }

    /// Shows running pipelines until `stop` is set.
    ///
    /// # Errors
    /// The search for running pipelines fails.
    pub fn show(&self, stop: &AtomicBool) -> Result<()> {
        while !stop.load(Ordering::Relaxed) {
            let wanted = lock(&self.wanted).clone();
            let running = list_pipelines(&self.display)?;
            let chosen = match &wanted.pipeline {
                Some(name) => running.into_iter().find(|running| running.plan.pipeline == *name),
                None => running.into_iter().next(),
            };
            *lock(&self.shown) = chosen.as_ref().map(|chosen| chosen.plan.pipeline.clone());
            match chosen {
                None => self.show_waiting(wanted.pipeline.as_deref()),
                // A paused run is shown also without a browser, so that one that comes back sees its next step.
                Some(chosen) if self.display.is_watched() || chosen.sources().paused => self.attach(&chosen, &wanted),
                Some(_) => {}
            }
            sleep(PIPELINE_CHECK_PERIOD);
        }
        Ok(())
    }

    fn show_waiting(&self, pipeline: Option<&str>) {
        let notice = match pipeline {
            Some(name) => format!("no pipeline `{name}` runs; it is waited for"),
            None => "no pipeline runs; it is waited for one: start it with `conicflow run`".to_owned(),
        };
        self.display.change_about(|about| {
            about.notice = Some(notice);
            about.graph = serde_json::Value::Null;
            about.run = None;
        });
    }

    /// Shows a pipeline until another one is wanted, no browser is connected, or the run is over.
    fn attach(&self, running: &RunningPipeline, wanted: &Wanted) {
        let view = Topics::of(running, wanted.depth_topic.as_deref());
        let names = view.depths.iter().map(|topic| topic.name.clone()).collect();
        let depth_topic = view.depth.map(|topic| topic.name.clone());
        self.display.change_about(|about| {
            about.title.clone_from(&running.plan.pipeline);
            about.depth_topics = names;
            about.depth_topic = depth_topic;
            about.notice = view.notice();
        });
        // A paused run costs nothing to watch, and a browser that comes back is to see its next step.
        let is_watched = || self.display.is_watched() || running.sources().paused;
        let goes_on = || is_watched() && *lock(&self.wanted) == *wanted;
        if let Err(error) = self.watch(running, &view, goes_on) {
            self.display.change_about(|about| about.notice = Some(format!("{error:#}; it is tried again")));
        }
    }

    fn watch(&self, running: &RunningPipeline, view: &Topics, goes_on: impl Fn() -> bool) -> Result<()> {
        let watched = view.watched();
        let needs = Requirements::of(&running.plan, NODES);
        watched.iter().try_for_each(|(_, topic)| needs.look_for_onlooker(topic))?;
        let mut gatherer = Gatherer::new(!view.lists.is_empty());
        let wants = || if goes_on() { Watching::GoOn } else { Watching::Enough };
        running.watch_while::<anyhow::Error>(&watched, wants, |_, message| {
            let (header, now) = (message.header, Instant::now());
            let frame = match (list_of(&message), message.items::<u16>()) {
                (Some(list), _) => gatherer.list(header, list, header.latency_ms(monotonic_ns()), now),
                (None, Some(pixels)) => gatherer.depth(header, pixels, now),
                (None, None) => None,
            };
            if let Some(frame) = frame {
                self.display.show(frame);
            }
            Ok(Watching::GoOn)
        })
    }
}

/// The topics of the pipeline on the page.
struct Topics<'a> {
    /// All topics with depth images.
    depths: Vec<&'a Topic>,
    /// The depth topic that is shown.
    depth: Option<&'a Topic>,
    /// The topics with tracks, or where there are none, with objects.
    lists: Vec<&'a Topic>,
}

impl<'a> Topics<'a> {
    fn of(running: &'a RunningPipeline, wanted: Option<&str>) -> Self {
        let of_kind = |kind: &str| {
            let mut found: Vec<&Topic> = running.topics().filter(|topic| topic.kind() == Some(kind)).collect();
            found.sort_by(|a, b| a.name.cmp(&b.name));
            found
        };
        let depths = of_kind(u16::NAME);
        let named = depths.iter().find(|topic| Some(topic.name.as_str()) == wanted);
        let depth = named.or(depths.first()).copied();
        let tracks = of_kind(Track::NAME);
        let lists = if tracks.is_empty() { of_kind(Object::NAME) } else { tracks };
        Self { depths, depth, lists }
    }

    fn watched(&self) -> Vec<(&'a ItemType, &'a Topic)> {
        let topics = self.depth.iter().chain(&self.lists);
        topics.filter_map(|topic| Some((topic.item.as_ref()?, *topic))).collect()
    }

    fn notice(&self) -> Option<String> {
        match (self.depth, &self.lists[..]) {
            (None, []) => Some("the pipeline has neither depth images nor objects nor tracks".to_owned()),
            (None, _) => Some("the pipeline has no depth images on this machine".to_owned()),
            _ => None,
        }
    }
}

/// Takes the commands of browsers.
fn take_commands(display: &Display, wanted: &Mutex<Wanted>, shown: &Mutex<Option<String>>) {
    loop {
        match display.next_command(PERIOD) {
            Some(Command::Pipeline { name }) => {
                *lock(wanted) = Wanted { pipeline: Some(name), depth_topic: None };
            }
            Some(Command::DepthTopic { name }) => lock(wanted).depth_topic = Some(name),
            Some(command) => {
                let shown = lock(shown).clone();
                shown.into_iter().for_each(|pipeline| pausing::obey(&pipeline, &command, display));
            }
            None => {}
        }
    }
}

/// Returns the running pipelines, sorted by name, and shows their names on the page.
fn list_pipelines(display: &Display) -> Result<Vec<RunningPipeline>> {
    let mut running = RunningPipeline::all()?;
    running.sort_by(|a, b| a.plan.pipeline.cmp(&b.plan.pipeline));
    let names = running.iter().map(|running| running.plan.pipeline.clone()).collect();
    display.change_about(|about| about.pipelines = names);
    Ok(running)
}

/// Shows the running pipelines and the state of the shown one's stages on the page, once a second while a browser is connected.
fn show_graph(display: &Display, shown: &Mutex<Option<String>>) {
    let mut watch = GraphWatch::default();
    loop {
        sleep(PERIOD);
        if !display.is_watched() {
            watch.rest();
            continue;
        }
        // `show` reports the error as soon as the shown run is over.
        list_pipelines(display).ok();
        let shown = lock(shown).clone();
        if let Some((graph, sources)) = watch.observe_graph(|activity| Some(&activity.pipeline) == shown.as_ref()) {
            display.change_about(|about| about.graph = graph);
            pausing::show_run(sources, display);
        }
    }
}
