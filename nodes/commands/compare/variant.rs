//! One variant of a pipeline: runs the stages that produce its answers, each in a process as usual, without losing a frame, and
//! reads the recording of the answers.

use crate::recording::files::Files;
use crate::recording::own;
use crate::sinks::evaluation_sink::EvaluationConfig;
use crate::sinks::{EvaluationSink, McapSink};
use crate::sources::SyntheticSource;
use crate::sources::mcap_source::{self, Replay, has_own};
use anyhow::{Context as _, Result, ensure};
use conicflow_dataflow::pipeline::{Input, MAX_STAGE_NAME, Pipeline, Program, Restart, StageSpec};
use conicflow_dataflow::ports::{Delivery, Topic, TopicReader, Wiring};
use conicflow_dataflow::{ItemType, Pairing, Plan, PlannedStage, RunOptions, Runs, Source as _, Stage as _, Summary};
use conicflow_lab::score::{Answer, Claim, Evaluation};
use conicflow_messages::{AnyByte, Header, Hinted, Item, Object, Track};
use serde_json::json;
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};
use std::slice::from_ref;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{SystemTime, UNIX_EPOCH};
use tempfile::TempDir;

/// Name of the stage that records.
const RECORDER: &str = "compare";
/// Type of the answers of a pipeline that ends with objects.
const OBJECTS: ItemType = ItemType::shown::<Object>();
/// Type of the answers of a pipeline that ends with tracks.
const TRACKS: ItemType = ItemType::shown::<Track>();

/// Options for running variants.
pub(super) struct How<'a> {
    /// Number of frames after which sources end.
    pub(super) frames: Option<u64>,
    /// Whether the depth images are recorded, too.
    pub(super) with_depth: bool,
    /// The folder in which the recordings are kept.
    pub(super) keep: Option<&'a Path>,
    /// Whether a signal asked this process to end.
    pub(super) interrupted: Arc<AtomicBool>,
    pub(super) options: RunOptions,
}

/// A variant's answer to a frame.
pub(super) struct Frame {
    /// The header of the answer, with the times of the stages that it passed.
    pub(super) header: Header,
    pub(super) answers: Vec<Answer>,
}

/// The results of a variant that has run.
pub(super) struct Variant {
    pub(super) frames: Vec<Frame>,
    /// The evaluation against the truth, if that is known.
    pub(super) truth: Option<Evaluation>,
    recording: PathBuf,
    /// The temporary folder of the recording, unless it is kept.
    _folder: Option<TempDir>,
}

impl Variant {
    /// Runs a pipeline as far as it leads to `topic`; if the run was not finished, returns its summary.
    ///
    /// # Errors
    /// The pipeline cannot be run, or nothing was recorded.
    pub(super) fn run(
        letter: &str,
        mut pipeline: Pipeline,
        topic: &str,
        how: &How<'_>,
    ) -> Result<std::result::Result<Self, Summary>> {
        let truth = truth(&pipeline)?.map(|config| config.open(&pipeline.base)).transpose()?;
        let folder = match how.keep {
            Some(_) => None,
            None => Some(tempfile::tempdir().context("cannot make a temporary folder")?),
        };
        let path = how.keep.or(folder.as_ref().map(TempDir::path)).unwrap_or(Path::new(""));
        let recording = std::path::absolute(path)?.join(format!("{letter}.mcap"));
        pipeline.name = name_of(&pipeline.name, letter);
        keep_upstream_of(topic, &mut pipeline);
        let run = SystemTime::now().duration_since(UNIX_EPOCH)?.as_nanos() as u64;
        let mut plan = Plan::of(&pipeline, None, how.frames, run);
        record(&mut plan, topic, how.with_depth, &recording)?;
        let summary = conicflow_dataflow::run(&plan, &how.options)?;
        if !summary.is_complete() || summary.restarts() > 0 || how.interrupted.load(Ordering::Relaxed) {
            return Ok(Err(summary));
        }
        let frames = read(&recording)?;
        ensure!(
            !frames.is_empty(),
            Hinted::new(
                format!("variant {letter} made no answers in `{topic}`"),
                "the frames have to come from files, a recording or a simulated camera that has some"
            )
        );
        Ok(Ok(Self { frames, truth, recording, _folder: folder }))
    }

    /// Plays the depth images that were recorded with the answers.
    pub(super) fn depth(&self) -> Result<Replay> {
        let config = mcap_source::Config { path: Some(self.recording.clone()), ..mcap_source::Config::default() };
        Ok(Replay::open(&config, Path::new(""), &ItemType::of::<u16>())?.silent())
    }
}

/// Returns a name for a variant's run, which is short enough and differs from that of a running pipeline.
fn name_of(pipeline: &str, letter: &str) -> String {
    let ending = format!("-{letter}");
    format!("{}{ending}", &pipeline[..pipeline.len().min(MAX_STAGE_NAME - ending.len())])
}

/// Returns how to score the answers: with the parameters of an `evaluation_sink` in the file, or against the scene of a simulated
/// camera.
fn truth(pipeline: &Pipeline) -> Result<Option<EvaluationConfig>> {
    let of_node = |name: &str| {
        let is_node = |stage: &&StageSpec| matches!(&stage.program, Program::Node(node) if node.name == name);
        pipeline.stages.iter().find(is_node).map(|stage| stage.parameters.clone())
    };
    if let Some(parameters) = of_node(EvaluationSink::<Object>::NAME) {
        let config: EvaluationConfig = serde_json::from_value(parameters)?;
        return Ok(Some(config));
    }
    let Some(parameters) = of_node(SyntheticSource::NAME) else { return Ok(None) };
    // The name of a built-in scene is in its frames.
    let scene = parameters["scene"].as_str().map(Path::new).filter(|scene| pipeline.base.join(scene).is_file());
    Ok(Some(EvaluationConfig { scene: scene.map(Path::to_owned), ..EvaluationConfig::default() }))
}

/// Removes the stages that do not contribute to a topic, puts the others on this machine, and makes their inputs lossless.
fn keep_upstream_of(topic: &str, pipeline: &mut Pipeline) {
    let mut needed = BTreeSet::from([topic.to_owned()]);
    let mut known = 0;
    while known < needed.len() {
        known = needed.len();
        let writes = |stage: &&StageSpec| stage.output.as_ref().is_some_and(|output| needed.contains(output));
        let inputs = pipeline.stages.iter().filter(writes).flat_map(StageSpec::all_inputs);
        let further: Vec<_> = inputs.map(|input| input.topic.clone()).collect();
        needed.extend(further);
    }
    pipeline.stages.retain(|stage| stage.output.as_ref().is_some_and(|output| needed.contains(output)));
    pipeline.machines.clear();
    for stage in &mut pipeline.stages {
        stage.machine = None;
        let sides = if let Program::Node(node) = &stage.program { node.side_inputs() } else { &[] };
        stage.input.iter_mut().for_each(make_lossless);
        for (name, input) in &mut stage.inputs {
            if sides.iter().any(|side| side.name == name && side.pairing == Pairing::SameFrame) {
                make_lossless(input);
            }
        }
        // The truth file of the user's own run must not be overwritten.
        stage.parameters.as_object_mut().and_then(|parameters| parameters.remove("truth_path"));
    }
}

fn make_lossless(input: &mut Input) {
    input.delivery = Delivery::Lossless;
}

/// Adds a stage that records every message of the topic, and the depth images if `with_depth`.
fn record(plan: &mut Plan, topic: &str, with_depth: bool, path: &Path) -> Result<()> {
    let reader = TopicReader { stage: RECORDER.to_owned(), delivery: Delivery::Lossless, queue: 4 };
    let depth = plan.topics().find(|topic| topic.kind() == Some(u16::NAME)).map(|topic| topic.name.clone());
    let depth = depth.filter(|_| with_depth);
    let mut read = Vec::<(String, Topic)>::new();
    for stage in &mut plan.stages {
        let Wiring { input, side_inputs, output, .. } = &mut stage.wiring;
        let sides = side_inputs.iter_mut().map(|(_, topic)| topic);
        for known in input.iter_mut().chain(sides).chain(output.iter_mut()) {
            if known.name == topic || Some(&known.name) == depth.as_ref() {
                known.readers.push(reader.clone());
                read.push((known.name.clone(), known.clone()));
            }
        }
    }
    let topic_of = |name: &str| read.iter().find(|(known, _)| known == name).map(|(_, topic)| topic.clone());
    let input = topic_of(topic).with_context(|| format!("no stage writes the topic `{topic}`"))?;
    let kind = input.kind().unwrap_or(AnyByte::NAME).to_owned();
    let depth = depth.and_then(|name| Some(("depth".to_owned(), topic_of(&name)?)));
    plan.stages.push(PlannedStage {
        name: RECORDER.to_owned(),
        runs: Runs::Node { node: McapSink::<AnyByte>::NAME.to_owned(), input: kind },
        parameters: json!({ "path": path }),
        wiring: Wiring { input: Some(input), side_inputs: depth.into_iter().collect(), output: None, frames: None },
        restart: Restart::Never,
        ..PlannedStage::default()
    });
    Ok(())
}

/// Reads the answers of a recording, in the order of their frames.
fn read(path: &Path) -> Result<Vec<Frame>> {
    let files = Files::find(path)?;
    let channels = files.survey()?;
    let mut frames = Vec::new();
    for channel in channels {
        let topic = channel.channel.topic.clone();
        let read = match from_ref(&channel) {
            channel if has_own(channel, &OBJECTS) => frames_of::<Object>,
            channel if has_own(channel, &TRACKS) => frames_of::<Track>,
            _ => continue,
        };
        for message in files.messages(&[&topic]) {
            frames.push(read(&message?.data)?);
        }
    }
    frames.sort_by_key(|frame| (frame.header.origin().to_string(), frame.header.sequence));
    Ok(frames)
}

fn frames_of<T: Claim>(message: &[u8]) -> Result<Frame> {
    let (header, bytes) = own::read(message)?;
    let items = bytes.chunks_exact(size_of::<T>()).map(bytemuck::pod_read_unaligned::<T>);
    Ok(Frame { header, answers: items.filter_map(|item| item.answer()).collect() })
}
