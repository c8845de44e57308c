//! The table of nodes: those that a pipeline file may name, and the functions that check and run them.

use crate::file_use::FileUse;
use crate::pipeline::schema_of;
use crate::ports::shared_memory::SharedMemory;
use crate::runner::source_loop::run_source;
use crate::runner::stage_loop::run_stage;
use crate::runner::untyped::{NewSource, NewStage};
use crate::runner::{RunError, StageRuntime};
use crate::side_inputs::SideInput;
use crate::stage::{Config, Source, Stage};
use conicflow_messages::{AnyByte, ConfigFault, Hinted, Item, Nothing};
use serde_json::Value as Json;
use std::path::Path;

/// One row of the table: a node that a stage of a pipeline file can run.
#[derive(Clone, Copy)]
pub struct Node {
    /// Its name in the pipeline file.
    pub name: &'static str,
    /// Summary in one sentence.
    pub summary: &'static str,
    /// Its kinds of input, each with its output; the documentation shows the first one.
    pub variants: &'static [Variant],
    pub(crate) side_inputs: fn() -> &'static [SideInput],
    pub(crate) schema: fn() -> Json,
    pub(crate) check: fn(Json, &Path) -> Result<Vec<ConfigFault>, serde_json::Error>,
    pub(crate) reads: fn(Json, &Path) -> Vec<FileUse>,
    pub(crate) writes: fn(Json, &Path) -> Vec<FileUse>,
    pub(crate) message_length: fn(Json, &Path) -> Option<usize>,
    pub(crate) settle: fn(Json) -> Result<Json, serde_json::Error>,
    /// The program that runs it; `None`: this one.
    pub(crate) host: Option<Host>,
}

/// The program that runs a node in place of the one that has it in its table.
#[derive(Clone, Copy)]
pub struct Host {
    /// Returns its command and arguments, for the parameters of the stage and the folder of the pipeline file.
    pub command: fn(&Json, &Path) -> Result<Vec<String>, Hinted>,
    /// Finds a reason why it cannot run the stage on this machine, with these environment variables.
    pub check: fn(&Json, &Path, &Variables) -> Result<(), Hinted>,
}

/// Variables of a stage's environment: names and values.
pub type Variables = [(String, String)];

/// A node for one kind of input.
#[derive(Clone, Copy)]
pub struct Variant {
    /// Kind of its driving input, by [`Item::NAME`]; [`Nothing`] for a source.
    pub input: &'static str,
    /// Kind of its output; [`Nothing`] for a sink.
    pub output: &'static str,
    pub(crate) run: fn(Json, StageRuntime<SharedMemory>) -> Result<(), RunError>,
}

impl Node {
    /// Row of a source.
    pub const fn source<S: Source>() -> Self {
        Self {
            name: S::NAME,
            summary: S::SUMMARY,
            variants: const { &[Variant::source::<S>()] },
            side_inputs: S::side_inputs,
            schema: schema_of::<S::Config>,
            check: |parameters, base| Ok(S::faults(&serde_json::from_value(parameters)?, base)),
            reads: |parameters, base| files(parameters, base, S::reads),
            writes: |parameters, base| files(parameters, base, S::writes),
            message_length: message_length::<S>,
            settle: settle::<S::Config>,
            host: None,
        }
    }

    /// Row of a stage or sink that takes one kind of input.
    pub const fn stage<S: Stage>() -> Self {
        Self::stages::<S>(const { &[Variant::stage::<S>()] })
    }

    /// Row of a stage or sink that takes several kinds of input, one variant for each; `S` is the first of them.
    pub const fn stages<S: Stage>(variants: &'static [Variant]) -> Self {
        Self {
            name: S::NAME,
            summary: S::SUMMARY,
            variants,
            side_inputs: S::side_inputs,
            schema: schema_of::<S::Config>,
            check: |parameters, base| Ok(S::faults(&serde_json::from_value(parameters)?, base)),
            reads: |parameters, base| files(parameters, base, S::reads),
            writes: |parameters, base| files(parameters, base, S::writes),
            message_length: |_, _| None,
            settle: settle::<S::Config>,
            host: None,
        }
    }

    /// Sets another program as the host of the node; it replaces this program in the stage's process. The host joins the run as
    /// any program does, or has the row too and calls `run_in_run`. It gets the parameters with all defaults filled in.
    #[must_use]
    pub const fn run_by(self, host: Host) -> Self {
        Self { host: Some(host), ..self }
    }

    /// Kinds of its driving input.
    pub fn inputs(&self) -> impl Iterator<Item = &'static str> {
        self.variants.iter().map(|variant| variant.input).filter(|kind| *kind != Nothing::NAME)
    }

    /// Kind of its output, the same for all variants.
    pub fn output(&self) -> &'static str {
        self.variants.first().map_or(Nothing::NAME, |variant| variant.output)
    }

    /// Whether it writes items of any type, as its readers need: a source that plays a recording.
    pub fn writes_any(&self) -> bool {
        self.output() == AnyByte::NAME
    }

    /// Whether it has no driving input.
    pub fn is_source(&self) -> bool {
        self.inputs().next().is_none()
    }

    /// Its side inputs.
    pub fn side_inputs(&self) -> &'static [SideInput] {
        (self.side_inputs)()
    }

    /// Its parameters as a JSON schema: names, types, ranges, defaults and descriptions.
    pub fn schema(&self) -> Json {
        (self.schema)()
    }
}

impl Variant {
    const fn source<S: Source>() -> Self {
        Self { input: Nothing::NAME, output: S::Output::NAME, run: start_source::<S> }
    }

    /// Variant of a stage for its kind of input.
    pub const fn stage<S: Stage>() -> Self {
        Self { input: S::Input::NAME, output: S::Output::NAME, run: start_stage::<S> }
    }
}

fn settle<C: Config>(parameters: Json) -> Result<Json, serde_json::Error> {
    serde_json::to_value(serde_json::from_value::<C>(parameters)?)
}

/// The files of a stage; empty if its parameters are invalid.
fn files<C: Config>(parameters: Json, base: &Path, of: fn(&C, &Path) -> Vec<FileUse>) -> Vec<FileUse> {
    serde_json::from_value(parameters).map(|config| of(&config, base)).unwrap_or_default()
}

fn message_length<S: Source>(parameters: Json, base: &Path) -> Option<usize> {
    S::message_length(&serde_json::from_value(parameters).ok()?, base)
}

fn start_source<S: Source>(parameters: Json, runtime: StageRuntime<SharedMemory>) -> Result<(), RunError> {
    run_new_source(&NewSource::of::<S>(parameters)?, runtime)
}

fn start_stage<S: Stage>(parameters: Json, runtime: StageRuntime<SharedMemory>) -> Result<(), RunError> {
    run_new_stage(&NewStage::of::<S>(parameters)?, runtime)
}

/// Not generic in the source, so that the loop is compiled only once, in this package.
fn run_new_source(source: &NewSource<'_>, runtime: StageRuntime<SharedMemory>) -> Result<(), RunError> {
    run_source(source, runtime)
}

/// Not generic in the stage, so that the loop is compiled only once, in this package.
fn run_new_stage(stage: &NewStage<'_>, runtime: StageRuntime<SharedMemory>) -> Result<(), RunError> {
    run_stage(stage, runtime)
}
