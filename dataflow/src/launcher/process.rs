//! Process of a stage: finds its place in the plan, opens its ports, and runs until its work is done or a signal ends it.

use super::folder::{FolderError, PLAN, RUNTIME_DIR, RunFolder, user_folder};
use super::options::RunOptions;
use crate::log::{DEFAULT_LOG, LOG, error_text, log_to_standard_error};
use crate::network::{BridgePlan, BridgeRun, Carrier, NO_NETWORK, NO_NETWORK_HINT, Network, NetworkError, RunBridge};
use crate::node::{Node, Variant};
use crate::pause::Pause;
use crate::pipeline::{fault_by, suggestion};
use crate::plan::{Plan, PlannedStage, Runs};
use crate::ports::PortError;
use crate::ports::shared_memory::SharedMemory;
use crate::registry::Registry;
use crate::runner::handover::{Handover, Successor};
use crate::runner::peers::Peers;
use crate::runner::pulled_source::PulledSource;
use crate::runner::pulled_stage::PulledStage;
use crate::runner::{RunError, StageRuntime};
use crate::stage::{Context, Source, Stage};
use crate::status::{NO_RUN, StatusFile};
use crate::stop::Stop;
use conicflow_messages::{ConfigFault, Hinted, Item, Nothing};
use rustix::io::Errno;
use rustix::process::{Pid, Signal, getppid, set_parent_process_death_signal, test_kill_process};
use serde_json::Value as Json;
use signal_hook::consts::{SIGINT, SIGTERM, SIGUSR1, SIGXFSZ};
use signal_hook::iterator::Signals;
use std::io::{self, Write};
use std::os::unix::process::CommandExt;
use std::path::Path;
use std::process::{Command, ExitCode};
use std::time::Duration;

/// Environment variable: name of the pipeline whose run a stage belongs to.
pub const PIPELINE: &str = "CONICFLOW_PIPELINE";
/// Environment variable: name of the stage.
pub(crate) const STAGE: &str = "CONICFLOW_STAGE";
/// Environment variable: process of the launcher; without it the stage was started by itself.
pub(crate) const LAUNCHER: &str = "CONICFLOW_LAUNCHER";
/// Environment variable: the file of the plan in the run's folder.
const PLAN_FILE: &str = "CONICFLOW_PLAN";

/// Exit code of a stage that could not be started: a restart would not help.
pub(crate) const REFUSED: u8 = 2;

/// A stage that has not ended this long after SIGTERM exits by force.
const LAST_GRACE: Duration = Duration::from_secs(3);

/// Reason why a stage's process could not start or go on.
#[derive(Debug, thiserror::Error)]
pub enum ProcessError {
    /// The run's folder cannot be used.
    #[error(transparent)]
    Folder(#[from] FolderError),
    /// The stage failed.
    #[error(transparent)]
    Run(#[from] RunError),
    /// The bridge failed.
    #[error(transparent)]
    Bridge(#[from] NetworkError),
    /// The program of a stage or of the bridge cannot be found or configured.
    #[error(transparent)]
    Settings(#[from] Hinted),
    /// There is no such stage in the plan.
    #[error("there is no stage `{0}` in this pipeline\n  hint: `conicflow graph` shows its stages")]
    NoStage(String),
    /// The plan names a node that this program does not have.
    #[error("this program has no node `{0}`\n  hint: it was built from another version than the launcher")]
    NoNode(String),
    /// The plan has edges to other machines.
    #[error("{NO_NETWORK}\n  hint: {NO_NETWORK_HINT}")]
    NoNetwork,
    /// Another process stands between the launcher and this one.
    #[error(
        "stage `{0}` was not started by its launcher itself, which would not hear of its end\n  hint: name the program itself: in \
         place of `uv run` the Python of its environment, `.venv/bin/python`; in a shell `exec`"
    )]
    Between(String),
    /// A system call failed.
    #[error("{doing}: {error}\n  hint: {}", hint_of(error))]
    System {
        /// What was being done.
        doing: String,
        /// Error of the system.
        error: io::Error,
    },
    /// The process is not part of a run.
    #[error(
        "the environment variable `{0}` is not set\n  \
         hint: this program is a stage; name it in a pipeline file as program = [\"..\"], and start it by `conicflow run`"
    )]
    NoRun(&'static str),
}

/// Hint for a process or a thread that cannot be started.
pub(super) fn hint_of(error: &io::Error) -> &'static str {
    match Errno::from_io_error(error) {
        Some(Errno::AGAIN) => {
            "this user or this container may have no more processes and threads: `ulimit -u`, in a systemd unit `TasksMax=`, for \
             a container `--pids-limit`"
        }
        Some(Errno::MFILE | Errno::NFILE) => "no more files may be open: `ulimit -n`, in a systemd unit `LimitNOFILE=`",
        Some(Errno::NOMEM) => {
            "there is no memory left, or no more may be taken: `ulimit -v`, in a systemd unit `MemoryMax=`"
        }
        _ => "is the program there, and may this user run it?",
    }
}

impl ProcessError {
    /// Exit code; from it the launcher knows whether a restart may help.
    pub fn exit_code(&self) -> u8 {
        use PortError::{Incompatible, PathTooLong, PathUnusable};
        match self {
            Self::Run(RunError::Port(Incompatible { .. } | PathTooLong { .. } | PathUnusable { .. })) => REFUSED,
            Self::Bridge(NetworkError::Failed(_)) => 1,
            Self::Run(
                RunError::Failed { .. } | RunError::Lasting { .. } | RunError::Unfinished(_) | RunError::Port(_),
            )
            | Self::System { .. } => 1,
            _ => REFUSED,
        }
    }
}

/// Command that runs a stage: `options.program`, with the stage and the file of its plan (`plan_file` in the run's folder) in its
/// environment. [`RUNTIME_DIR`] is made absolute, so that the stage finds that folder from any working directory.
pub(crate) fn as_stage(planned: &PlannedStage, plan: &Plan, plan_file: &str, options: &RunOptions) -> Command {
    let mut command = Command::new(&options.program);
    command
        .args(["node", &planned.name])
        .env(RUNTIME_DIR, user_folder())
        .env(PIPELINE, &plan.pipeline)
        .env(STAGE, &planned.name)
        .env(PLAN_FILE, plan_file)
        .envs(options.log.iter().map(|log| (LOG, log)))
        .envs(planned.env.iter().map(|(key, value)| (key, value)));
    command
}

/// Makes this process the stage `name` of a plan without a launcher, with the environment that a launcher would set. Returns only
/// on failure.
pub fn become_stage(plan: &Plan, name: &str, options: &RunOptions) -> ProcessError {
    match alone(plan, name, options) {
        Ok(mut command) => system(&format!("stage `{name}` cannot be started"), command.exec()),
        Err(error) => error,
    }
}

/// Writes the plan of a stage that runs without a launcher, and returns the command that runs it.
fn alone(plan: &Plan, name: &str, options: &RunOptions) -> Result<Command, ProcessError> {
    let planned = plan.stage(name).ok_or_else(|| ProcessError::NoStage(name.to_owned()))?;
    let folder = RunFolder::open(&plan.pipeline)?;
    if folder.is_running() {
        return Err(FolderError::Running { name: plan.pipeline.clone() }.into());
    }
    // Each stage has its own plan file, so that stages started at the same time do not overwrite each other's.
    let plan_file = format!("{name}.plan");
    folder.write_whole(&plan_file, plan)?;
    let mut command = as_stage(planned, plan, &plan_file, options);
    command.env_remove(LAUNCHER);
    Ok(command)
}

/// Work of a stage's process.
enum Work<'a> {
    /// The process runs a node of the table.
    Node(&'static Variant),
    /// The process carries edges to other machines.
    Bridge(RunBridge, &'a BridgePlan),
    /// The process becomes a program, with these arguments.
    Program(Vec<String>),
}

/// Finds the work of a stage for a program with these nodes and this network part.
fn work_of<'a>(
    planned: &'a PlannedStage,
    base: &Path,
    nodes: &[Node],
    network: Option<Network>,
) -> Result<Work<'a>, ProcessError> {
    match &planned.runs {
        Runs::Node { node, input } => {
            let none = || ProcessError::NoNode(node.clone());
            let row = nodes.iter().find(|row| row.name == *node).ok_or_else(none)?;
            if let Some(host) = row.host {
                return Ok(Work::Program((host.command)(&planned.parameters, base)?));
            }
            let fitting = row.variants.iter().find(|variant| variant.input == input).or(row.variants.first());
            fitting.map(Work::Node).ok_or_else(none)
        }
        Runs::Command(command) => Ok(Work::Program(command.clone())),
        Runs::Bridge(edges) => match network.ok_or(ProcessError::NoNetwork)?.carrier {
            Carrier::Here(run) => Ok(Work::Bridge(run, edges)),
            Carrier::Program(find) => Ok(Work::Program(vec![find()?.to_string_lossy().into_owned()])),
        },
    }
}

/// Runs the stage `name` of a plan in this process: a node of the table, or a program that takes the place of this one.
fn run_planned(
    plan: &Plan,
    folder: &RunFolder,
    name: &str,
    nodes: &[Node],
    network: Option<Network>,
) -> Result<(), ProcessError> {
    let planned = plan.stage(name).ok_or_else(|| ProcessError::NoStage(name.to_owned()))?;
    match work_of(planned, &plan.base, nodes, network)? {
        Work::Node(variant) => Ok((variant.run)(planned.parameters.clone(), stage_runtime(plan, folder, planned)?)?),
        Work::Bridge(run, edges) => {
            let own = BridgeRun { pipeline: &plan.pipeline, run: plan.run, folder: folder.path() };
            Ok(run(edges, own, stage_runtime(plan, folder, planned)?)?)
        }
        Work::Program(command) => Err(become_program(plan, planned, &command)),
    }
}

/// Runs the source `S` as the stage that the launcher started this program for; for a `main` outside this repository. It
/// logs to standard error, as `--log` of the run says, unless this program logs somewhere already.
pub fn run_source<S: Source>() -> ExitCode {
    exit_code(run_own(Node::source::<S>()))
}

/// Runs the stage or sink `S` as [`run_source`] runs a source.
pub fn run_stage<S: Stage>() -> ExitCode {
    exit_code(run_own(Node::stage::<S>()))
}

/// Joins the run as the stage that the launcher started this program for, and pulls its messages; see [`PulledStage`]. It logs as
/// [`run_stage`] does. `None`: this process is a successor that is no longer wanted.
///
/// # Errors
/// It cannot take its place, or this process is not part of a run.
pub fn join_as_stage(same_frame: &[String]) -> Result<Option<PulledStage>, ProcessError> {
    let (parameters, runtime) = join()?;
    Ok(PulledStage::open(runtime, parameters, same_frame)?)
}

/// Joins the run as a source, as [`join_as_stage`] does as a stage; see [`PulledSource`]. `total` is the number of its messages,
/// where known; its parameter `rate_hz`, where it has one, limits the rate.
///
/// # Errors
/// It cannot take its place, or this process is not part of a run.
pub fn join_as_source(total: Option<u64>) -> Result<Option<PulledSource>, ProcessError> {
    let (parameters, runtime) = join()?;
    Ok(PulledSource::open(runtime, parameters, total)?)
}

/// Parameters and runtime of the stage that this process was started for.
fn join() -> Result<(Json, StageRuntime<SharedMemory>), ProcessError> {
    let (plan, folder, stage) = own_place()?;
    log_to_standard_error(&std::env::var(LOG).unwrap_or_else(|_| DEFAULT_LOG.to_owned()));
    die_with_launcher(&stage, launcher())?;
    let planned = plan.stage(&stage).ok_or(ProcessError::NoStage(stage))?;
    Ok((planned.parameters.clone(), stage_runtime(&plan, &folder, planned)?))
}

fn exit_code(ended: Result<(), ProcessError>) -> ExitCode {
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // A closed standard error is not the stage's concern.
            writeln!(io::stderr(), "{}", error_text(&error)).ok();
            error.exit_code().into()
        }
    }
}

/// Runs a stage of the run that this process was started in.
///
/// # Errors
/// The stage could not start, or it failed; or this process is not part of a run.
pub fn run_in_run(registry: &Registry) -> Result<(), ProcessError> {
    let (plan, folder, stage) = own_place()?;
    die_with_launcher(&stage, launcher())?;
    run_planned(&plan, &folder, &stage, registry.nodes, registry.network)
}

fn run_own(node: Node) -> Result<(), ProcessError> {
    let (mut plan, folder, stage) = own_place()?;
    log_to_standard_error(&std::env::var(LOG).unwrap_or_else(|_| DEFAULT_LOG.to_owned()));
    die_with_launcher(&stage, launcher())?;
    let own = plan.stages.iter_mut().find(|planned| planned.name == stage);
    if let (Some(planned), Some(variant)) = (own, node.variants.first()) {
        if let Some(fault) = fault_of(&node, planned, &plan.base) {
            return Err(RunError::Refused(fault.into()).into());
        }
        planned.runs = Runs::Node { node: node.name.to_owned(), input: variant.input.to_owned() };
    }
    run_planned(&plan, &folder, &stage, &[node], None)
}

/// Finds a fault in the stage's parameters or further inputs that only the stage's own program can detect.
fn fault_of(node: &Node, planned: &PlannedStage, base: &Path) -> Option<Hinted> {
    let fault = fault_by(&node.schema(), "parameters", &planned.parameters);
    if fault.is_some() {
        return fault;
    }
    let faults = (node.check)(planned.parameters.clone(), base).unwrap_or_default();
    if let Some(ConfigFault { key, what, hint }) = faults.into_iter().next() {
        return Some(Hinted::new(format!("`{key}`: {what}"), hint));
    }
    let known = || node.side_inputs().iter().map(|side| side.name);
    let mut wired = planned.wiring.side_inputs.iter().map(|(name, _)| name.as_str());
    if let Some(unknown) = wired.find(|name| !known().any(|known| known == *name)) {
        let hint = suggestion(unknown, known().collect::<Vec<_>>(), "further inputs");
        return Some(Hinted::new(
            format!("this stage reads no `{unknown}` of its `inputs` in the pipeline file"),
            hint,
        ));
    }
    match (&planned.wiring.output, node.output()) {
        (Some(topic), Nothing::NAME) => {
            let what = format!("this stage makes nothing, and the pipeline file has it write `{}`", topic.name);
            Some(Hinted::new(what, "leave its `output` out"))
        }
        (None, kind) if kind != Nothing::NAME => {
            let what = format!("this stage makes {kind}, and the pipeline file gives it no `output`");
            Some(Hinted::new(what, "name a topic there, with what it carries"))
        }
        _ => None,
    }
}

fn own_place() -> Result<(Plan, RunFolder, String), ProcessError> {
    let variable = |name| std::env::var(name).map_err(|_| ProcessError::NoRun(name));
    let folder = RunFolder::open(&variable(PIPELINE)?)?;
    let plan_file = variable(PLAN_FILE).unwrap_or_else(|_| PLAN.to_owned());
    Ok((folder.read_plan(&plan_file)?, folder, variable(STAGE)?))
}

fn launcher() -> Option<Pid> {
    Pid::from_raw(std::env::var(LAUNCHER).ok()?.parse().ok()?)
}

/// Makes this process end with its launcher, even on SIGKILL of the launcher. A stage started by itself has no launcher.
fn die_with_launcher(stage: &str, launcher: Option<Pid>) -> Result<(), ProcessError> {
    let Some(launcher) = launcher else { return Ok(()) };
    // Without this signal the launcher could leave an orphan, but not a wrong result.
    set_parent_process_death_signal(Some(Signal::TERM)).ok();
    if getppid() == Some(launcher) {
        return Ok(());
    }
    if test_kill_process(launcher).is_err() {
        std::process::exit(i32::from(REFUSED)); // the launcher is gone, nobody reads an error
    }
    Err(ProcessError::Between(stage.to_owned()))
}

fn become_program(plan: &Plan, planned: &PlannedStage, command: &[String]) -> ProcessError {
    let Some((program, arguments)) = command.split_first() else {
        return ProcessError::NoNode(planned.name.clone());
    };
    if launcher().is_some() {
        // The program may not handle SIGTERM.
        set_parent_process_death_signal(Some(Signal::KILL)).ok();
    }
    let error = Command::new(program).args(arguments).current_dir(&plan.base).exec();
    ProcessError::System { doing: format!("stage `{}` cannot run `{program}`", planned.name), error }
}

fn stage_runtime(
    plan: &Plan,
    folder: &RunFolder,
    planned: &PlannedStage,
) -> Result<StageRuntime<SharedMemory>, ProcessError> {
    let lock = Some(folder.join()?);
    let stop = Stop::default();
    listen_for_signals(stop.clone(), planned.is_source())?;
    let transport = SharedMemory::open(folder.shared_memory(), &plan.namespace(), &planned.name, stop.clone());
    let handover = Handover::of(folder.path(), &planned.name);
    let successor = Successor::from_environment(&handover);
    let successor = successor.map_err(|error| system("the launcher cannot be spoken with", error))?;
    let path = folder.status(&planned.name);
    let record = StatusFile::open(&path, plan.run).map_err(FolderError::at(&path))?;
    let context = context_of(plan, planned, stop);
    let transport = transport.map(|memory| if plan.run == NO_RUN { memory } else { memory.kept_in(folder.path()) });
    let here = plan.stages.iter().map(|stage| stage.name.clone()).collect();
    let peers = Peers::in_folder(folder.path().to_owned(), plan.run, here);
    let mut runtime = StageRuntime {
        transport: transport.map_err(RunError::from)?,
        wiring: planned.wiring.clone(),
        context,
        peers,
        record,
        handover: Some(handover),
        successor,
        pause: Pause::obey(folder.pause_file(plan.run)),
        lock,
    };
    // The record belongs to the predecessor until the successor takes over.
    if runtime.successor.is_none() {
        runtime.enter();
    }
    Ok(runtime)
}

/// Context of a stage at its start, before its input is known.
fn context_of(plan: &Plan, planned: &PlannedStage, stop: Stop) -> Context {
    Context { stage: planned.name.clone(), base: plan.base.clone(), run: plan.run, stop, ..Context::default() }
}

fn system(doing: &str, error: io::Error) -> ProcessError {
    ProcessError::System { doing: doing.to_owned(), error }
}

/// Starts the thread that handles the launcher's signals and enforces SIGTERM. SIGXFSZ is caught so that a write beyond the limit
/// of file sizes returns an error.
fn listen_for_signals(stop: Stop, is_source: bool) -> Result<(), ProcessError> {
    let fault = |error| system("signals cannot be received", error);
    let mut signals = Signals::new([SIGINT, SIGTERM, SIGUSR1, SIGXFSZ]).map_err(fault)?;
    let listen = move || {
        for signal in signals.forever() {
            heed(signal, &stop, is_source);
            if signal == SIGTERM {
                std::thread::sleep(LAST_GRACE);
                std::process::exit(128 + SIGTERM); // exit code of a process that a signal has ended, as a shell reports it
            }
        }
    };
    let builder = std::thread::Builder::new().name("signals".to_owned());
    builder.spawn(listen).map(drop).map_err(fault)
}

/// SIGINT ends the stage in order, SIGTERM at once. SIGUSR1 makes it hand its place to a successor; a source then stops making
/// messages.
fn heed(signal: i32, stop: &Stop, is_source: bool) {
    if signal == SIGUSR1 {
        stop.leave();
    }
    if signal == SIGINT || (signal == SIGUSR1 && is_source) {
        stop.request();
    } else if signal == SIGTERM {
        stop.force();
    }
}

#[cfg(test)]
mod tests {
    use super::super::folder::tests::folder_at;
    use super::super::summary::tests::stage;
    use super::super::trial_run::plan_of;
    use super::*;
    use crate::node::Host;
    use crate::pipeline::tests::{node, variant};
    use crate::ports::Topic;
    use crate::side_inputs::{SideInput, SideInputs};
    use crate::stage::{Output, StageError};
    use conicflow_messages::{Message, Object};
    use rustix::process::getpid;
    use schemars::JsonSchema;
    use serde::{Deserialize, Serialize};
    use serde_json::json;

    /// Describes the work of a stage: the node's result, the machine of the bridge, or the program.
    fn done(runs: Runs, nodes: &[Node], carrier: Option<Carrier>) -> Result<String, String> {
        let planned = PlannedStage { runs, parameters: Json::from(5), ..stage::<Object>() };
        let network = carrier.map(|carrier| {
            let (warnings, listen_endpoints): (fn(&_) -> _, fn(&_) -> _) = (|_| Vec::new(), |_| Ok(Vec::new()));
            Network { check: |_| Ok(()), warnings, listen_endpoints, carrier }
        });
        match work_of(&planned, Path::new("/base"), nodes, network) {
            Ok(Work::Node(variant)) => Ok(format!("node that makes {}", variant.output)),
            Ok(Work::Bridge(_, edges)) => Ok(format!("bridge of {}", edges.machine)),
            Ok(Work::Program(command)) => Ok(format!("program {}", command.join(" "))),
            Err(error) => Err(error.to_string()),
        }
    }

    #[test]
    fn an_exit_code_tells_the_launcher_whether_another_try_could_help() {
        let error = || io::Error::from(io::ErrorKind::NotFound);
        let too_long = PortError::PathTooLong { path: "/".into(), length: 9, limit: 8 };
        for (error, is_refused) in [
            (ProcessError::NoNetwork, true),
            (ProcessError::NoRun(STAGE), true),
            (ProcessError::Bridge(NetworkError::Refused("a".into())), true),
            (ProcessError::Bridge(NetworkError::Failed("a".into())), false),
            (RunError::Refused("a".into()).into(), true),
            (RunError::Port(too_long).into(), true),
            (RunError::Port(PortError::Stopped).into(), false),
            (RunError::Failed { frame: 3, error: "a".into() }.into(), false),
            (RunError::Lasting { frame: 3, error: "a".into() }.into(), false),
            (RunError::Unfinished("a".into()).into(), false),
            (system("a", error()), false),
        ] {
            assert_eq!(error.exit_code(), if is_refused { REFUSED } else { 1 }, "{error:?}");
        }
    }

    #[test]
    fn what_keeps_a_process_from_starting_is_told_with_the_limit_that_does() {
        for (errno, hint) in [
            (Errno::AGAIN, "`ulimit -u`"),
            (Errno::MFILE, "`ulimit -n`"),
            (Errno::NOMEM, "`ulimit -v`"),
            (Errno::NOENT, "is the program there"),
        ] {
            let told = system("stage `a` cannot be started", errno.into()).to_string();
            let (_, hints) = told.split_once("\n  hint: ").unwrap();
            assert!(hints.contains(hint), "{told}");
        }
    }

    #[test]
    fn the_process_of_a_stage_is_told_its_place_by_its_environment() {
        let env = [("KEY", "value"), ("XDG_RUNTIME_DIR", "/elsewhere")].map(|(key, value)| (key.into(), value.into()));
        let planned = PlannedStage { env: env.to_vec(), ..stage::<Object>() };
        let options = RunOptions { program: "conicflow".into(), ..RunOptions::default() };
        let told = |log: Option<&str>| {
            let options = RunOptions { log: log.map(str::to_owned), ..options.clone() };
            let command = as_stage(&planned, &plan_of(7), "own.plan", &options);
            let said: Vec<_> = [command.get_program()].into_iter().chain(command.get_args()).collect();
            assert_eq!(said, ["conicflow", "node", "stage"]);
            let of = |name: &str| command.get_envs().find(|(key, _)| *key == name).and_then(|(_, value)| value);
            assert_eq!(of(RUNTIME_DIR), Some(user_folder().as_os_str()));
            assert_eq!(of("XDG_RUNTIME_DIR"), Some("/elsewhere".as_ref()), "what it needs for itself is its own");
            [PIPELINE, STAGE, PLAN_FILE, LOG, "KEY"]
                .map(|name| of(name).map(|value| value.to_str().unwrap().to_owned()))
        };
        let place = |log: Option<&str>| {
            [Some("test"), Some("stage"), Some("own.plan"), log, Some("value")].map(|text| text.map(str::to_owned))
        };
        assert_eq!(told(Some("debug")), place(Some("debug")));
        assert_eq!(told(None), place(None));
    }

    #[test]
    fn a_stage_is_told_its_name_its_folder_and_when_the_run_ends() {
        let plan = Plan { base: "/base".into(), ..plan_of(7) };
        let stop = Stop::default();
        let context = context_of(&plan, &stage::<Object>(), stop.clone());
        assert_eq!((&*context.stage, context.resolve(Path::new("scene.toml"))), ("stage", "/base/scene.toml".into()));
        assert!(!context.stop.requested());
        stop.request();
        assert!(context.stop.requested());
    }

    #[test]
    fn a_program_that_nobody_started_as_a_stage_is_told_so_and_does_not_count_as_done() {
        let registry = Registry { nodes: &[], network: None };
        let told = [
            run_in_run(&registry).err(),
            run_own(node("node", const { &[variant("depth", "tracks")] })).err(),
            join_as_stage(&[]).err(),
            join_as_source(None).err(),
        ];
        assert!(told.iter().all(|error| matches!(error, Some(ProcessError::NoRun(PIPELINE)))), "{told:?}");
        let codes = told.map(|error| format!("{:?}", exit_code(error.map_or(Ok(()), Err))));
        assert_eq!(codes, [(); 4].map(|()| format!("{:?}", ExitCode::from(REFUSED))));
        let files = tempfile::tempdir().unwrap();
        let other = run_planned(&plan_of(7), &folder_at(files.path()), "other", &[], None);
        assert!(matches!(other, Err(ProcessError::NoStage(name)) if name == "other"));
    }

    /// Stage for tests that checks its parameters.
    struct Sieve;

    #[derive(Clone, Debug, Default, Serialize, Deserialize, JsonSchema)]
    #[serde(default, deny_unknown_fields)]
    struct Mesh {
        /// In metres.
        #[schemars(range(min = 0.0, max = 2.0))]
        width: f64,
    }

    impl Stage for Sieve {
        const NAME: &'static str = "sieve";
        const SUMMARY: &'static str = "Keeps what is large";
        type Config = Mesh;
        type Input = Object;
        type Output = Object;

        fn new(_: Mesh, _: &Context) -> Result<Self, StageError> {
            Ok(Self)
        }

        fn faults(mesh: &Mesh, _: &Path) -> Vec<ConfigFault> {
            let fault = ConfigFault { key: "width", what: "no sieve has this mesh".into(), hint: "take 1".into() };
            (mesh.width == 1.5).then_some(fault).into_iter().collect()
        }

        fn side_inputs() -> &'static [SideInput] {
            const { &[SideInput::latest::<u16>("depth")] }
        }

        fn step(&mut self, _: &Message<Object>, _: &SideInputs, _: &mut Output<Object>) -> Result<(), StageError> {
            Ok(())
        }
    }

    #[test]
    fn a_program_checks_what_the_pipeline_file_says_of_its_stage() {
        let with = |parameters: Json, side: &str, output: bool| {
            let mut planned = PlannedStage { parameters, ..stage::<Object>() };
            planned.wiring.side_inputs = vec![(side.to_owned(), Topic::default())];
            planned.wiring.output = planned.wiring.output.filter(|_| output);
            planned
        };
        let told = |planned: &PlannedStage| fault_of(&Node::stage::<Sieve>(), planned, Path::new("/"));
        assert_eq!(told(&with(json!({ "width": 1.0 }), "depth", true)), None);
        for (planned, expected) in [
            (with(json!({ "width": -3.0 }), "depth", true), "`width`"),
            (with(json!({ "widht": 1.0 }), "depth", true), "did you mean `width`?"),
            (with(json!({ "width": 1.5 }), "depth", true), "no sieve has this mesh"),
            (with(json!({}), "dpeth", true), "did you mean `depth`?"),
            (with(json!({}), "depth", false), "this stage makes objects"),
        ] {
            let fault = told(&planned).unwrap().to_string();
            assert!(fault.contains(expected), "{fault}");
        }
    }

    #[test]
    fn a_stage_has_its_launcher_for_its_parent_if_it_has_one() {
        die_with_launcher("stage", None).unwrap();
        die_with_launcher("stage", getppid()).unwrap();
        let between = die_with_launcher("stage", Some(getpid()));
        assert!(matches!(between, Err(ProcessError::Between(stage)) if stage == "stage"));
    }

    #[test]
    fn signals_end_a_stage_or_make_it_leave_its_place_where_a_source_makes_no_further_message() {
        for (signal, is_source, (requested, forced, leaving)) in [
            (SIGINT, false, (true, false, false)),
            (SIGTERM, false, (true, true, false)),
            (SIGUSR1, false, (false, false, true)),
            (SIGUSR1, true, (true, false, true)),
            (SIGXFSZ, true, (false, false, false)),
        ] {
            let stop = Stop::default();
            heed(signal, &stop, is_source);
            assert_eq!((stop.requested(), stop.forced(), stop.leaving()), (requested, forced, leaving), "{signal}");
        }
    }

    #[test]
    fn a_node_is_run_as_its_row_says_for_what_drives_it() {
        const OTHER: &[Variant] = &[variant("depth", "tracks")];
        const OWN: &[Variant] = &[variant("depth", "ellipses"), variant("ellipses", "objects")];
        let nodes = [node("other", OTHER), node("node", OWN), node("unfinished", &[])];
        let done =
            |node: &str, input: &str| done(Runs::Node { node: node.to_owned(), input: input.to_owned() }, &nodes, None);
        for (input, output) in [("depth", "ellipses"), ("ellipses", "objects"), ("anything", "ellipses")] {
            assert_eq!(done("node", input), Ok(format!("node that makes {output}")), "driven by {input}");
        }
        for node in ["unknown", "unfinished"] {
            assert!(done(node, "depth").unwrap_err().contains(&format!("no node `{node}`")));
        }
    }

    #[test]
    fn a_program_takes_the_place_of_a_node_that_has_a_host_and_of_a_stage_that_is_one() {
        let command = |parameters: &Json, base: &Path| Ok(vec![base.display().to_string(), parameters.to_string()]);
        let refused = |_: &Json, _: &Path| Err(Hinted::new("it is not there", "install it"));
        let run_by = |name, command| {
            node(name, const { &[variant("depth", "tracks")] }).run_by(Host { command, check: |_, _, _| Ok(()) })
        };
        let nodes = [run_by("hosted", command), run_by("refused", refused)];
        let node = |node: &str| done(Runs::Node { node: node.to_owned(), input: "depth".to_owned() }, &nodes, None);
        assert_eq!(node("hosted"), Ok("program /base 5".to_owned()));
        assert!(node("refused").unwrap_err().contains("it is not there"));
        let command = vec!["grasp".to_owned(), "--fast".to_owned()];
        assert_eq!(done(Runs::Command(command), &nodes, None), Ok("program grasp --fast".to_owned()));
    }

    #[test]
    fn edges_are_carried_by_the_network_part_if_there_is_one() {
        let done = |carrier: Option<Carrier>| {
            let plan = BridgePlan { machine: "robot".to_owned(), ..BridgePlan::default() };
            done(Runs::Bridge(plan.into()), &[], carrier)
        };
        assert_eq!(done(Some(Carrier::Here(|_, _, _| Ok(())))), Ok("bridge of robot".to_owned()));
        let program = done(Some(Carrier::Program(|| Ok("/bin/bridge".into()))));
        assert_eq!(program, Ok("program /bin/bridge".to_owned()));
        assert!(done(None).unwrap_err().contains(NO_NETWORK));
        let missing = done(Some(Carrier::Program(|| Err(Hinted::new("it is not there", "install it")))));
        assert!(missing.unwrap_err().contains("it is not there"));
    }
}
