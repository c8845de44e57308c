//! Shows running pipelines on the page, as an onlooker for whom no stage waits: attached while somebody looks, and not else.

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

/// How often is looked for pipelines, and whether somebody looks.
const PIPELINE_CHECK_PERIOD: Duration = Duration::from_millis(200);
/// How often the stages are looked at.
const PERIOD: Duration = Duration::from_secs(1);

/// What is to be shown.
#[derive(Clone, Debug, Default, PartialEq)]
struct Wanted {
    pipeline: Option<String>,
    depth_topic: Option<String>,
}

/// Shows pipelines as they run.
pub struct Live {
    display: Arc<Display>,
    wanted: Arc<Mutex<Wanted>>,
    /// The pipeline that is shown now.
    shown: Arc<Mutex<Option<String>>>,
}

impl Live {
    /// Shows the pipeline of this name, or else the first that runs until another one is asked for.
    ///
    /// # Errors
    /// No thread can be started.
    pub fn start(display: Arc<Display>, pipeline: Option<String>) -> Result<Self> {
        let wanted = Arc::new(Mutex::new(Wanted { pipeline, depth_topic: None }));
        let live = Self { display, wanted, shown: Arc::default() };
        let (display, wanted, shown) = (Arc::clone(&live.display), Arc::clone(&live.wanted), Arc::clone(&live.shown));
        thread::Builder::new().name("wishes".to_owned()).spawn(move || take_wishes(&display, &wanted, &shown))?;
        let (display, shown) = (Arc::clone(&live.display), Arc::clone(&live.shown));
        thread::Builder::new().name("graph".to_owned()).spawn(move || show_graph(&display, &shown))?;
        Ok(live)
    }

    /// Shows what runs until this program is told to end.
    ///
    /// # Errors
    /// The runs cannot be looked for.
    pub fn show(&self, told: &AtomicBool) -> Result<()> {
        while !told.load(Ordering::Relaxed) {
            let wanted = lock(&self.wanted).clone();
            let running = look_for_pipelines(&self.display)?;
            let chosen = match &wanted.pipeline {
                Some(name) => running.into_iter().find(|running| running.plan.pipeline == *name),
                None => running.into_iter().next(),
            };
            *lock(&self.shown) = chosen.as_ref().map(|chosen| chosen.plan.pipeline.clone());
            match chosen {
                None => self.tell_waiting(wanted.pipeline.as_deref()),
                // Whoever was away for a moment when the run was paused is to see its next step.
                Some(chosen) if self.display.is_watched() || chosen.sources().paused => self.attach(&chosen, &wanted),
                Some(_) => {}
            }
            sleep(PIPELINE_CHECK_PERIOD);
        }
        Ok(())
    }

    fn tell_waiting(&self, pipeline: Option<&str>) {
        let notice = match pipeline {
            Some(name) => format!("no pipeline `{name}` runs; it is waited for"),
            None => "no pipeline runs; it is waited for one: start it with `conicflow run`".to_owned(),
        };
        self.display.tell(|about| {
            about.notice = Some(notice);
            about.graph = serde_json::Value::Null;
            about.run = None;
        });
    }

    /// Shows a pipeline until another one is wanted, nobody looks, or the run is over.
    fn attach(&self, running: &RunningPipeline, wanted: &Wanted) {
        let view = Topics::of(running, wanted.depth_topic.as_deref());
        let names = view.depths.iter().map(|topic| topic.name.clone()).collect();
        let depth_topic = view.depth.map(|topic| topic.name.clone());
        self.display.tell(|about| {
            about.title.clone_from(&running.plan.pipeline);
            about.depth_topics = names;
            about.depth_topic = depth_topic;
            about.notice = view.notice();
        });
        // What stands still costs nothing to look at, and whoever was away for a moment is to see its next step.
        let is_watched = || self.display.is_watched() || running.sources().paused;
        let goes_on = || is_watched() && *lock(&self.wanted) == *wanted;
        if let Err(error) = self.watch(running, &view, goes_on) {
            self.display.tell(|about| about.notice = Some(format!("{error:#}; it is tried again")));
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

/// The topics of a pipeline that are shown.
struct Topics<'a> {
    /// All with depth images.
    depths: Vec<&'a Topic>,
    /// The one whose images are shown.
    depth: Option<&'a Topic>,
    /// Those with tracks, or where there are none, with objects.
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

/// Takes what browsers wish.
fn take_wishes(display: &Display, wanted: &Mutex<Wanted>, shown: &Mutex<Option<String>>) {
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

/// The pipelines that run, by their names, of which the page is told.
fn look_for_pipelines(display: &Display) -> Result<Vec<RunningPipeline>> {
    let mut running = RunningPipeline::all()?;
    running.sort_by(|a, b| a.plan.pipeline.cmp(&b.plan.pipeline));
    let names = running.iter().map(|running| running.plan.pipeline.clone()).collect();
    display.tell(|about| about.pipelines = names);
    Ok(running)
}

/// Tells once a second what runs and what the stages of the pipeline that is shown do, while somebody looks.
fn show_graph(display: &Display, shown: &Mutex<Option<String>>) {
    let mut watch = GraphWatch::default();
    loop {
        sleep(PERIOD);
        if !display.is_watched() {
            watch.rest();
            continue;
        }
        // An error is told as soon as the run that is shown is over.
        look_for_pipelines(display).ok();
        let shown = lock(shown).clone();
        if let Some((graph, sources)) = watch.look(|activity| Some(&activity.pipeline) == shown.as_ref()) {
            display.tell(|about| about.graph = graph);
            pausing::tell(sources, display);
        }
    }
}
