//! A pipeline as its file describes it: the stages, their machines, and the topics between them.

use super::diagnostic::{SourceSpan, SourceText};
use super::machine::{BRIDGE, Compression, Machine};
use super::metrics::Metrics;
use crate::item_type::{BUILT_IN, ItemType};
use crate::node::Node;
use crate::ports::{Delivery, Topic, TopicReader};
use conicflow_messages::{AnyByte, Item};
use serde::{Deserialize, Serialize};
use serde_json::Value as Json;
use std::collections::BTreeMap;
use std::path::PathBuf;

/// A pipeline, read and checked.
pub struct Pipeline {
    /// Its name. It is a namespace: pipelines with different names on one machine are separate.
    pub name: String,
    /// Folder of the file; relative paths are resolved against it.
    pub base: PathBuf,
    /// The machines, where there is more than one.
    pub machines: BTreeMap<String, Machine>,
    /// The item types that the file describes, in its order.
    pub items: Vec<ItemType>,
    /// The stages, in the order of the file.
    pub stages: Vec<StageSpec>,
    /// Endpoint of the run's metrics for machines that have none of their own; `None`: the metrics are not served.
    pub metrics: Option<Metrics>,
    /// The file's `experiment` table. It is for the user of the pipeline; no stage sees it.
    pub experiment: Option<Json>,
    /// The text that it was read from, and the overrides (`--set`).
    pub source: (SourceText, Vec<String>),
}

/// One stage of a pipeline.
pub struct StageSpec {
    /// Its name.
    pub name: String,
    /// What it runs.
    pub program: Program,
    /// Its driving input.
    pub input: Option<Input>,
    /// Its side inputs, by name.
    pub inputs: Vec<(String, Input)>,
    /// The topic that it writes.
    pub output: Option<String>,
    /// Kind of its output, where the file gives it: a program has no node that determines it.
    pub declared_output: Option<String>,
    /// Machine that it runs on.
    pub machine: Option<String>,
    /// When it is restarted.
    pub restart: Restart,
    /// Time without a heartbeat, in seconds, after which it is killed; `None`: it is only reported.
    pub hang_s: Option<f64>,
    /// Time after its start within which it has to join a lossless topic, in seconds; `None`: the default.
    pub join_s: Option<f64>,
    /// Its environment variables.
    pub env: Vec<(String, String)>,
    /// Parameters of its node.
    pub parameters: Json,
    pub(super) place: SourceSpan,
    pub(super) input_place: Option<SourceSpan>,
    pub(super) output_place: Option<SourceSpan>,
    pub(super) machine_place: Option<SourceSpan>,
    /// Position of each parameter in the file.
    pub(super) parameter_places: BTreeMap<String, SourceSpan>,
}

/// What a stage runs.
pub enum Program {
    /// A node of the table.
    Node(Node),
    /// A program with its arguments.
    Command(Vec<String>),
    /// Neither; the error has been reported.
    Unknown,
}

/// One input of a stage.
#[derive(Clone, Debug)]
pub struct Input {
    /// The topic that it reads.
    pub topic: String,
    /// Which messages it gets.
    pub delivery: Delivery,
    /// Length of its queue.
    pub queue: usize,
    /// Kind of the topic, where the file gives it: no node determines the output of a program.
    pub kind: Option<String>,
    /// How images and long lists for it are compressed on their way from another machine.
    pub compression: Option<Compression>,
    pub(super) place: SourceSpan,
}

/// When a dead stage is restarted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Restart {
    /// Never.
    Never,
    /// After a failure.
    #[default]
    OnFailure,
    /// However it ended, until the run ends.
    Always,
}

impl Pipeline {
    /// The stage of this name.
    pub fn stage(&self, name: &str) -> Option<&StageSpec> {
        self.stages.iter().find(|stage| stage.name == name)
    }

    /// Endpoint of the run's metrics on this machine; `None`: they are not served.
    pub fn metrics_on(&self, machine: Option<&str>) -> Option<&Metrics> {
        let own = machine.and_then(|machine| self.machines.get(machine)?.metrics.as_ref());
        own.or(self.metrics.as_ref())
    }

    /// Description of a topic that its readers and writers agree on.
    pub fn topic(&self, name: &str) -> Topic {
        let writers = self.stages.iter().filter(|stage| stage.output.as_deref() == Some(name));
        let readers = self.stages.iter().flat_map(|stage| {
            let inputs = stage.all_inputs().filter(|input| input.topic == name);
            inputs.map(|input| TopicReader { stage: stage.name.clone(), delivery: input.delivery, queue: input.queue })
        });
        Topic {
            name: name.to_owned(),
            item: self.kind_of(name).and_then(|kind| self.item(kind)).cloned(),
            writers: writers.map(|stage| stage.name.clone()).collect(),
            readers: readers.collect(),
        }
    }

    /// The topic as the stages of `machine` see it. Its writers are the same, on whichever machine. Its readers are those on this
    /// machine, and the bridge where a writer is here and a reader is not.
    pub fn topic_on(&self, name: &str, machine: Option<&str>) -> Topic {
        let mut topic = self.topic(name);
        let Some(machine) = machine else { return topic };
        let (here, away): (Vec<_>, Vec<_>) =
            topic.readers.into_iter().partition(|reader| self.is_on(&reader.stage, machine));
        topic.readers = here;
        let leaves = topic.writers.iter().any(|writer| self.is_on(writer, machine));
        if let (true, Some(queue)) = (leaves, away.iter().map(|reader| reader.queue).max()) {
            let lossless = away.iter().any(|reader| reader.delivery == Delivery::Lossless);
            let delivery = if lossless { Delivery::Lossless } else { Delivery::Latest };
            topic.readers.push(TopicReader { stage: BRIDGE.to_owned(), delivery, queue });
        }
        topic
    }

    /// Whether a stage runs on a machine.
    pub(crate) fn is_on(&self, stage: &str, machine: &str) -> bool {
        self.stage(stage).is_some_and(|stage| stage.machine.as_deref() == Some(machine))
    }

    /// The item type of this name: a built-in one, or one that the file describes.
    pub fn item(&self, name: &str) -> Option<&ItemType> {
        BUILT_IN.iter().chain(&self.items).find(|item| item.name() == name)
    }

    /// Kind of a topic, by the nodes that write it. If only programs do, or nodes that write any type, it is the kind that the
    /// file gives for an output or input, or else the only kind that one of the reading nodes takes. Without any of these, a node
    /// that writes any type writes depth.
    pub fn kind_of(&self, topic: &str) -> Option<&str> {
        let writers = self.stages.iter().filter(|stage| stage.output.as_deref() == Some(topic));
        let mut inputs = self.stages.iter().flat_map(StageSpec::all_inputs).filter(|input| input.topic == topic);
        let declared = || inputs.find_map(|input| input.kind.as_deref());
        let needed = || self.stages.iter().find_map(|stage| stage.needed_kind(topic));
        let replayed = || writers.clone().any(StageSpec::writes_any).then_some(u16::NAME);
        writers.clone().find_map(StageSpec::output_kind).or_else(declared).or_else(needed).or_else(replayed)
    }

    /// The names of all topics, in the order of the stages that write them.
    pub fn topics(&self) -> Vec<&str> {
        let mut names: Vec<&str> = Vec::new();
        for topic in self.stages.iter().filter_map(|stage| stage.output.as_deref()) {
            if !names.contains(&topic) {
                names.push(topic);
            }
        }
        names
    }

    /// The topics that are written on one machine and read on another, with both machines.
    pub fn crossings(&self) -> Vec<(&str, &str, &str)> {
        let mut crossings = Vec::new();
        for writer in &self.stages {
            for reader in &self.stages {
                let joined = reader.all_inputs().any(|input| Some(&input.topic) == writer.output.as_ref());
                let machines = (writer.machine.as_deref(), reader.machine.as_deref());
                if let (true, (Some(from), Some(to)), Some(topic)) = (joined, machines, writer.output.as_deref())
                    && from != to
                {
                    crossings.push((topic, from, to));
                }
            }
        }
        crossings
    }
}

impl StageSpec {
    /// The driving input and the further ones.
    pub fn all_inputs(&self) -> impl Iterator<Item = &Input> {
        self.input.iter().chain(self.inputs.iter().map(|(_, input)| input))
    }

    /// Kind that the node requires of an input from this topic, where it accepts only one.
    fn needed_kind(&self, topic: &str) -> Option<&'static str> {
        let Program::Node(node) = &self.program else { return None };
        if self.input.as_ref().is_some_and(|input| input.topic == topic) {
            let mut kinds = node.inputs();
            return kinds.next().filter(|kind| kinds.next().is_none() && *kind != AnyByte::NAME);
        }
        let (name, _) = self.inputs.iter().find(|(_, input)| input.topic == topic)?;
        node.side_inputs().iter().find(|side| side.name == name).map(|side| side.kind)
    }

    /// Kind of its output; `None` for a program, or a node that writes any type, where the file does not give it.
    pub fn output_kind(&self) -> Option<&str> {
        match &self.program {
            Program::Node(node) if !node.writes_any() => Some(node.output()),
            _ => self.declared_output.as_deref(),
        }
    }

    /// Whether it is a node that can write any type.
    fn writes_any(&self) -> bool {
        matches!(&self.program, Program::Node(node) if node.writes_any())
    }

    /// Whether it has no driving input.
    pub fn is_source(&self) -> bool {
        self.input.is_none()
    }
}
