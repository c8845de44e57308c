//! Common parts of the benchmarks of messages between machines: a frame of a cluttered scene, runs of the benchmark's own
//! program, and a sink that records the age of messages.

use bytemuck::cast_slice;
use conicflow_dataflow::pipeline::{Pipeline, SourceText};
use conicflow_dataflow::testing::collect;
use conicflow_dataflow::{
    Context, NoConfig, Output, Plan, RUNTIME_DIR, Registry, RunOptions, SideInputs, Stage, StageError, monotonic_ns,
    run,
};
use conicflow_lab::simulator::SimulatorParameters;
use conicflow_messages::{Ellipse, Header, Item, Message, Nothing, Object};
use conicflow_nodes::sources::SyntheticSource;
use std::error::Error;
use std::marker::PhantomData;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Child, Command};

pub type Outcome<T> = Result<T, Box<dyn Error>>;

/// Number of first messages that are left out: they are slow, because caches and connections are cold.
const WARM_UP: usize = 60;
const FOLDER: &str = "BENCH_FOLDER";

/// One frame of a cluttered scene.
pub fn frame() -> Outcome<(Header, Vec<u16>)> {
    let config = SimulatorParameters { width: 640, height: 480, rate_hz: 0.0, ..SimulatorParameters::default() };
    let context = Context { stage: "source".to_owned(), ..Context::default() };
    Ok(collect::<SyntheticSource>(config, context, 1)?.pop().ok_or("the source made nothing")?)
}

/// Starts this program again, with these arguments and the folder of its files as the last argument. The first letter of `name`
/// is the name of its runtime folder.
pub fn start(arguments: &[&str], folder: &Path, name: &str) -> Outcome<Child> {
    // Unix sockets are in this folder and need short paths.
    let runtime = folder.join(&name[..1]);
    std::fs::create_dir(&runtime)?;
    std::fs::set_permissions(&runtime, std::fs::Permissions::from_mode(0o700))?;
    let mut command = Command::new(std::env::current_exe()?);
    command.args(arguments).arg(folder).env(RUNTIME_DIR, runtime).env(FOLDER, folder);
    Ok(command.spawn()?)
}

/// Runs the pipeline of a folder until its sources have made this number of messages.
pub fn run_pipeline(folder: &Path, machine: Option<&str>, messages: usize, registry: &Registry) -> Outcome<()> {
    let text = std::fs::read_to_string(folder.join("pipeline.toml"))?;
    let source = SourceText { name: "pipeline.toml".to_owned(), text };
    let (pipeline, _) = Pipeline::read(source, folder, &[], registry).map_err(|report| report.to_string())?;
    let plan = Plan::of(&pipeline, machine, Some(messages as u64), monotonic_ns());
    let program = std::env::current_exe()?;
    let options = RunOptions { program, quiet: true, nodes: registry.nodes, ..RunOptions::default() };
    if run(&plan, &options)?.is_complete() { Ok(()) } else { Err("the run was not finished".into()) }
}

/// The median and the 99th percentile, in milliseconds, of the ages that the sink in a folder has recorded.
pub fn written_in(folder: &Path) -> Outcome<[f64; 2]> {
    let bytes = std::fs::read(folder.join("ages"))?;
    let ages = bytes.chunks_exact(8).map(|age| u64::from_ne_bytes(age.try_into().unwrap_or_default()));
    percentiles(ages.collect())
}

/// The median and the 99th percentile, in milliseconds, of these ages without the first [`WARM_UP`].
pub fn percentiles(mut ages_ns: Vec<u64>) -> Outcome<[f64; 2]> {
    let mut ages_ns = ages_ns.split_off(WARM_UP.min(ages_ns.len()));
    ages_ns.sort_unstable();
    let last = ages_ns.len().checked_sub(1).ok_or("nothing arrived")?;
    Ok([0.5, 0.99].map(|share| ages_ns[(share * last as f64) as usize] as f64 * 1e-6))
}

/// A sink that records the age of each message at its arrival.
pub struct Ages<T>(Vec<u64>, PhantomData<T>);

/// An item type, with the name of its sink.
pub trait Aged: Item {
    const SINK: &'static str;
}

impl Aged for u16 {
    const SINK: &'static str = "frame_ages";
}

impl Aged for Ellipse {
    const SINK: &'static str = "list_ages";
}

impl Aged for Object {
    const SINK: &'static str = "object_ages";
}

impl<T: Aged> Stage for Ages<T> {
    const NAME: &'static str = T::SINK;
    const SUMMARY: &'static str = "Writes down how old messages are when they come";
    type Config = NoConfig;
    type Input = T;
    type Output = Nothing;

    fn new(_: NoConfig, _: &Context) -> Result<Self, StageError> {
        Ok(Self(Vec::new(), PhantomData))
    }

    fn step(&mut self, input: &Message<T>, _: &SideInputs, _: &mut Output<Nothing>) -> Result<(), StageError> {
        self.0.push(monotonic_ns().saturating_sub(input.header.stamp_ns));
        Ok(())
    }

    fn finish(&mut self) -> Result<(), StageError> {
        let folder = std::env::var(FOLDER)?;
        Ok(std::fs::write(Path::new(&folder).join("ages"), cast_slice(&self.0))?)
    }
}
