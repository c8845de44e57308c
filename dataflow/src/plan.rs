//! The plan of a run: all that each process has to know of the pipeline, with every default filled in and every name resolved.
//!
//! The launcher writes it once; all stages of a run read the same plan, even if the pipeline file changes meanwhile.

use crate::file_use::FileUse;
use crate::network::BridgePlan;
use crate::network::bridge_plan::bridge_plan;
use crate::node::Node;
use crate::pipeline::{BRIDGE, Pipeline, Program, Report, Restart, SourceText, StageSpec};
use crate::ports::{Topic, Wiring};
use crate::registry::Registry;
use conicflow_messages::{Hinted, Item, Nothing};
use serde::{Deserialize, Serialize};
use serde_json::Value as Json;
use std::collections::HashSet;
use std::path::PathBuf;

/// Version of all that launcher and stages share: the plan, records, names in shared memory. Raised with each change of
/// any of them.
pub(crate) const LAYOUT: u32 = 6;

/// The plan of a run on one machine.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Plan {
    /// [`LAYOUT`] of the program that made it.
    pub(crate) layout: u32,
    /// Name of the pipeline.
    pub pipeline: String,
    /// Folder against which paths in parameters are resolved.
    pub base: PathBuf,
    /// Unique number of the run.
    pub run: u64,
    /// The stages, in the order of the file.
    pub stages: Vec<PlannedStage>,
    /// Its origin.
    pub origin: Origin,
}

/// Pipeline file, overrides and options that a plan was made from, so that one stage can be changed and checked while the others
/// run.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Origin {
    /// Text and name of the file.
    pub source: SourceText,
    /// The overrides, as `STAGE.KEY=VALUE`.
    pub overrides: Vec<String>,
    /// The machine whose stages are in the plan; `None`: all stages.
    pub machine: Option<String>,
    /// Number of messages after which sources end.
    pub frames: Option<u64>,
}

/// The plan of one stage.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PlannedStage {
    /// Its name.
    pub name: String,
    /// What it runs.
    pub runs: Runs,
    /// Parameters of its node.
    pub parameters: Json,
    /// Topics that connect it to the others.
    pub wiring: Wiring,
    /// When it is restarted.
    pub restart: Restart,
    /// Time without a heartbeat, in seconds, after which it is killed; `None`: it is only reported.
    pub hang_s: Option<f64>,
    /// Time after its start within which it has to join a lossless topic, in seconds; `None`: the default.
    pub join_s: Option<f64>,
    /// Its environment variables.
    pub env: Vec<(String, String)>,
}

/// What a stage runs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Runs {
    /// The variant of a built-in node that is driven by messages of the kind `input`.
    Node {
        /// Name of the node.
        node: String,
        /// Kind of its driving input, by [`Item::NAME`].
        input: String,
    },
    /// A program with its arguments.
    Command(Vec<String>),
    /// The edges to and from other machines.
    Bridge(Box<BridgePlan>),
}

impl Default for Runs {
    fn default() -> Self {
        Self::Command(Vec::new())
    }
}

impl Runs {
    /// The node or the program, by name.
    pub fn name(&self) -> &str {
        match self {
            Self::Node { node, .. } => node,
            Self::Command(command) => command.first().map_or("?", String::as_str),
            Self::Bridge(_) => "zenoh",
        }
    }
}

impl Plan {
    /// Plan of the stages of a pipeline that run on `machine`, or of all stages without one. Sources end after `frames` messages.
    pub fn of(pipeline: &Pipeline, machine: Option<&str>, frames: Option<u64>, run: u64) -> Self {
        let here = |stage: &&StageSpec| machine.is_none() || stage.machine.as_deref() == machine;
        let stages = pipeline.stages.iter().filter(here);
        let mut stages: Vec<_> = stages.map(|stage| PlannedStage::of(pipeline, stage, machine, frames)).collect();
        stages.extend(machine.and_then(|machine| bridge_plan(pipeline, machine)).map(PlannedStage::bridge));
        let (source, overrides) = pipeline.source.clone();
        let origin = Origin { source, overrides, machine: machine.map(str::to_owned), frames };
        Self { layout: LAYOUT, pipeline: pipeline.name.clone(), base: pipeline.base.clone(), run, stages, origin }
    }

    /// Plan of the same run with further overrides, as `STAGE.KEY=VALUE`; the report holds warnings.
    ///
    /// # Errors
    /// All faults of the changed pipeline, at once.
    pub fn with(&self, further: &[String], registry: &Registry) -> Result<(Self, Report), Report> {
        let Origin { source, overrides, machine, frames } = &self.origin;
        let overrides = [overrides.as_slice(), further].concat();
        let (pipeline, warnings) =
            Pipeline::read_on(machine.as_deref(), source.clone(), &self.base, &overrides, registry)?;
        Ok((Self::of(&pipeline, machine.as_deref(), *frames, self.run), warnings))
    }

    /// Finds a file that both this plan and the plan of another pipeline would write, and returns it as an error. `nodes` has the
    /// nodes of both.
    pub fn over_what_is_written_by(&self, other: &Self, nodes: &[Node]) -> Option<Hinted> {
        let others: Vec<_> = other.files_written(nodes).collect();
        self.files_written(nodes).find_map(|(writer, files)| {
            let beside = |writer: &str| format!("{writer} of the running pipeline `{}`", other.pipeline);
            others.iter().find_map(|(other, written)| files.conflict_with_written(&writer, written, &beside(other)))
        })
    }

    /// Finds a fault of the files that a stage would start to write if it replaced that of this plan. `nodes` has the nodes of
    /// both.
    pub fn conflict_with_existing(&self, successor: &PlannedStage, nodes: &[Node]) -> Option<Hinted> {
        let of = |stage| self.files_of(stage, nodes).map(|(_, files)| files);
        let before: Vec<_> = self.stage(&successor.name).into_iter().flat_map(of).collect();
        self.files_of(successor, nodes).find_map(|(writer, files)| files.conflict_with_existing(&writer, &before))
    }

    fn files_written<'a>(&'a self, nodes: &'a [Node]) -> impl Iterator<Item = (String, FileUse)> + 'a {
        self.stages.iter().flat_map(|stage| self.files_of(stage, nodes))
    }

    /// The files that a stage writes, each with a text that names the parameter and the stage.
    fn files_of(&self, stage: &PlannedStage, nodes: &[Node]) -> impl Iterator<Item = (String, FileUse)> + use<> {
        let node = nodes.iter().find(|node| matches!(&stage.runs, Runs::Node { node: name, .. } if *name == node.name));
        let files = node.map(|node| (node.writes)(stage.parameters.clone(), &self.base)).unwrap_or_default();
        let name = stage.name.clone();
        files.into_iter().map(move |files| (format!("`{}` of stage `{name}`", files.key), files))
    }

    /// The stages that differ in another plan.
    pub fn stages_unlike<'a>(&'a self, other: &'a Self) -> impl Iterator<Item = &'a PlannedStage> {
        self.stages.iter().filter(|stage| other.stage(&stage.name) != Some(stage))
    }

    /// All topics that stages write or read, each once.
    pub fn topics(&self) -> impl Iterator<Item = &Topic> {
        let mut names = HashSet::new();
        let joined = self.stages.iter().flat_map(|stage| stage.wiring.output.iter().chain(stage.wiring.inputs()));
        joined.filter(move |topic| names.insert(&topic.name))
    }

    /// Namespace of the topics of this run, which separates them from those of other runs and their leftovers.
    pub(crate) fn namespace(&self) -> String {
        format!("{}/{:x}", self.pipeline, self.run)
    }

    /// The plan of one stage.
    pub fn stage(&self, name: &str) -> Option<&PlannedStage> {
        self.stages.iter().find(|stage| stage.name == name)
    }
}

impl PlannedStage {
    fn of(pipeline: &Pipeline, stage: &StageSpec, machine: Option<&str>, frames: Option<u64>) -> Self {
        let topic = |name: &String| pipeline.topic_on(name, machine);
        let input_kind = stage.input.as_ref().and_then(|input| pipeline.kind_of(&input.topic));
        let runs = match &stage.program {
            Program::Node(node) => {
                let input = input_kind.or_else(|| node.inputs().next()).unwrap_or(Nothing::NAME);
                Runs::Node { node: node.name.to_owned(), input: input.to_owned() }
            }
            Program::Command(command) => Runs::Command(command.clone()),
            Program::Unknown => Runs::default(),
        };
        let parameters = stage.parameters.clone();
        let parameters = match &stage.program {
            // A node's host program may not know the defaults.
            Program::Node(node) if node.host.is_some() => (node.settle)(parameters.clone()).unwrap_or(parameters),
            _ => parameters,
        };
        let side_inputs = stage.inputs.iter().map(|(name, input)| (name.clone(), topic(&input.topic)));
        let wiring = Wiring {
            input: stage.input.as_ref().map(|input| topic(&input.topic)),
            side_inputs: side_inputs.collect(),
            output: stage.output.as_ref().map(topic),
            frames: frames.filter(|_| stage.is_source()),
        };
        Self {
            name: stage.name.clone(),
            runs,
            parameters,
            wiring,
            restart: stage.restart,
            hang_s: stage.hang_s,
            join_s: stage.join_s,
            env: stage.env.clone(),
        }
    }

    fn bridge(plan: BridgePlan) -> Self {
        Self { name: BRIDGE.to_owned(), runs: Runs::Bridge(Box::new(plan)), ..Self::default() }
    }

    /// Whether it carries the edges to and from other machines.
    pub fn is_bridge(&self) -> bool {
        matches!(self.runs, Runs::Bridge(_))
    }

    /// Whether it has no driving input.
    pub fn is_source(&self) -> bool {
        self.wiring.input.is_none()
    }

    /// Whether its input leaves this machine's stages: a sink, or a bridge that sends to other machines.
    pub fn is_sink(&self) -> bool {
        match &self.runs {
            Runs::Bridge(plan) => !plan.outgoing.is_empty(),
            _ => self.wiring.output.is_none(),
        }
    }
}
