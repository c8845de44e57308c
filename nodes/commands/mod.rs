//! The command line: the output of each command, and its exit code (0 done, 1 failed, 2 wrong file or arguments).

mod compare;
mod detect;
mod doctor;
mod experiment;
mod invocation;
mod keys;
mod metrics;
mod node_help;
mod record;
#[cfg(test)]
mod schema_tests;
mod shell;
mod swap;
mod top;
mod topic;
mod view;

use crate::{NODES, REGISTRY};
use anyhow::bail;
use clap::{Args, CommandFactory, Parser, Subcommand};
use conicflow_dataflow::pipeline::{Pipeline, Report, file_schema};
use conicflow_dataflow::{DEFAULT_LOG, LOG, LaunchError, LinkKey, NO_RUN, Plan, ProcessError, RunOptions, Summary};
use conicflow_dataflow::{
    FolderError, RunningPipeline, error_text, log_filter, log_to_standard_error, termination_flag,
};
use conicflow_lab::experiment::{Experiment, Results, Variation};
use conicflow_messages::{Hinted, lasts};
use doctor::doctor;
use experiment::Rows;
use invocation::{FileArguments, check_machine, options, write_to_stderr};
use keys::Keys;
use signal_hook::consts::SIGXFSZ;
use std::collections::BTreeSet;
use std::io::{self, ErrorKind, Write, stdout};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, SystemTime, UNIX_EPOCH};
use swap::SwapArguments;
use topic::{PipelineName, TopicCommand};

/// Exit code of a command that began and failed.
const FAILED: u8 = 1;
/// Exit code for a wrong file or wrong arguments.
const WRONG_INPUT: u8 = 2;

/// Finds spheres, cylinders and cones in depth frames and tracks them, as a dataflow of separate processes.
#[derive(Parser)]
#[command(version, about, after_help = "Without a command it runs ./pipeline.toml, or else its built-in pipeline.")]
struct CommandLine {
    #[command(subcommand)]
    command: Option<Command>,
    /// Log level, of each stage as well: error, warn, info, debug or trace; a filter such as conicflow_dataflow=debug works too
    #[arg(
        long,
        global = true,
        env = LOG,
        default_value = DEFAULT_LOG,
        value_name = "LEVEL",
        value_parser = log_filter
    )]
    log: String,
}

#[derive(Subcommand)]
enum Command {
    /// Run a pipeline, each stage as a process of its own
    ///
    /// At a terminal, space pauses a run of recorded or simulated frames and lets it go on; `.` or the right arrow makes one
    /// frame more.
    Run(RunArguments),
    /// Find the objects of a depth image, a folder of them or an MCAP recording, without a pipeline file
    Detect(detect::DetectArguments),
    /// Run two variants of a pipeline on the same frames, and print how their answers and their times differ
    ///
    /// Objects are matched one to one, frame by frame. Each variant runs as `conicflow run` would run it, but without a loss and
    /// without its sinks, one after the other; the times of its stages are those from taking a message until sending one.
    Compare(compare::CompareArguments),
    /// Run one stage of a pipeline in this process
    ///
    /// That is for a debugger, beside other stages that are run like this; what belongs in a service is `conicflow run`,
    /// which starts a stage anew when it dies.
    Node {
        /// Name of the stage
        stage: String,
        /// The pipeline file [default: ./pipeline.toml, else the built-in one]
        file: Option<PathBuf>,
        /// The machine that this is; there `bridge` is a stage, too
        #[arg(long, value_name = "NAME")]
        machine: Option<String>,
    },
    /// Report everything that is wrong with a pipeline file, without starting anything
    Validate {
        #[command(flatten)]
        source: FileArguments,
        /// Look for the files and programs of this machine's stages alone [default: of each]
        #[arg(long, value_name = "NAME")]
        machine: Option<String>,
    },
    /// Print the graph of a pipeline as Mermaid text
    Graph {
        #[command(flatten)]
        source: FileArguments,
        /// Look for the files and programs of this machine's stages alone [default: of each]
        #[arg(long, value_name = "NAME")]
        machine: Option<String>,
    },
    /// Show what running pipelines do, live
    Top {
        /// Print one look as JSON
        #[arg(long)]
        once: bool,
        #[command(flatten)]
        of: PipelineName,
    },
    /// Look at the topics of a running pipeline, with no change to it
    #[command(subcommand)]
    Topic(TopicCommand),
    /// Record topics of a running pipeline into an MCAP file, with no change to it
    ///
    /// Foxglove, Rerun and ROS 2 read the file; mcap_source replays it.
    Record(record::RecordArguments),
    /// Show running pipelines, or a recording, on a page for the browser: the depth image, the objects in space, the stages
    ///
    /// The address of the page is printed. It is only visible on this machine, unless `--listen` says otherwise.
    View(view::ViewArguments),
    /// Replace a stage of a running pipeline, with other parameters or another node; the others notice nothing
    Swap(SwapArguments),
    /// Report what is wrong with this machine for running a pipeline: leftovers of dead runs, limits, ports
    Doctor {
        #[command(flatten)]
        source: FileArguments,
        /// Look at what the stages of this machine need [default: of each]
        #[arg(long, value_name = "NAME")]
        machine: Option<String>,
        /// Remove first what dead runs have left
        #[arg(long)]
        clean: bool,
    },
    /// Make the key by which the machines of a pipeline know each other's messages
    ///
    /// Copy the file to all of them, and name it in each machine's table: key = "pipeline.key". Anyone who can read it can send.
    Key {
        /// The file, which must not be there yet
        #[arg(default_value = "pipeline.key")]
        file: PathBuf,
    },
    /// Print the JSON schema of pipeline files, by which editors complete and check them
    Schema,
    /// List the built-in nodes, or the parameters of one
    Nodes {
        /// Name of a node
        name: Option<String>,
    },
    /// Print a script with which a shell completes these commands
    Completions {
        /// The shell
        shell: clap_complete::Shell,
    },
    /// Print manual pages of all commands, for `man`
    Man,
    /// Read the keys of a run; started by it
    #[command(name = keys::NAME, hide = true)]
    Keys { pipeline: String, launcher: i32 },
}

#[derive(Args, Default)]
struct RunArguments {
    #[command(flatten)]
    source: FileArguments,
    /// Run the stages of this machine
    #[arg(long, value_name = "NAME")]
    machine: Option<String>,
    /// End after this time, such as 10s or 2min
    #[arg(long = "for", value_name = "TIME", value_parser = humantime::parse_duration)]
    duration: Option<Duration>,
    /// End after so many frames of each source
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    frames: Option<u64>,
    /// Show no progress and no summary
    #[arg(long)]
    quiet: bool,
}

/// Runs the program.
pub fn main() -> ExitCode {
    let arguments = CommandLine::parse();
    log_to_standard_error(&arguments.log);
    // A file that may not become larger is reported by the write that fails, and should not kill the process.
    signal_hook::flag::register(SIGXFSZ, Arc::default()).ok();
    let command = arguments.command.unwrap_or_else(|| Command::Run(RunArguments::default()));
    match dispatch(command, &arguments.log) {
        Ok(code) => code,
        // A reader of the output that goes away (`| head`) has seen enough.
        Err(error) if is_broken_pipe(&error) => ExitCode::SUCCESS,
        Err(error) => {
            write_to_stderr(describe(&error));
            exit_code(&error).into()
        }
    }
}

fn dispatch(command: Command, log: &str) -> anyhow::Result<ExitCode> {
    match command {
        Command::Run(arguments) => return run(&arguments, log),
        Command::Compare(arguments) => return compare::compare(&arguments, log),
        Command::Doctor { source, machine, clean } => {
            return doctor(&source.read_for(machine.as_deref())?, machine.as_deref(), clean);
        }
        Command::Detect(arguments) => detect::detect(&arguments)?,
        Command::Node { stage, file, machine } => node(&stage, file, machine.as_deref(), log)?,
        Command::Validate { source, machine } => validate(&source, machine.as_deref())?,
        Command::Graph { source, machine } => {
            write!(stdout(), "{}", source.read_for(machine.as_deref())?.mermaid())?;
        }
        Command::Top { once, of } => top::top(once, &of)?,
        Command::Topic(command) => topic::topic(&command)?,
        Command::Record(arguments) => record::record(&arguments)?,
        Command::View(arguments) => view::view(&arguments)?,
        Command::Swap(arguments) => swap::swap(&arguments)?,
        Command::Key { file } => {
            LinkKey::make(&file)?;
            writeln!(
                stdout(),
                "made `{}`: copy it to all machines, and name it in the table of each as `key`",
                file.display()
            )?;
        }
        Command::Schema => writeln!(stdout(), "{:#}", file_schema(REGISTRY.nodes))?,
        Command::Nodes { name } => write!(stdout(), "{}", node_help::nodes(name.as_deref())?)?,
        Command::Completions { shell } => shell::completions(shell, &mut CommandLine::command())?,
        Command::Man => shell::manual(CommandLine::command())?,
        Command::Keys { pipeline, launcher } => keys::read(&pipeline, launcher)?,
    }
    Ok(ExitCode::SUCCESS)
}

/// Returns the text of an error and its causes; a report is printed as it is.
fn describe(error: &anyhow::Error) -> String {
    if error.is::<Report>() { error.to_string() } else { error_text(format_args!("{error:#}")) }
}

/// Returns the exit code; an error of the system, such as a full disk, is no wrong input.
fn exit_code(error: &anyhow::Error) -> u8 {
    let refused = error.chain().any(|cause| cause.is::<io::Error>()) || lasts(error.as_ref());
    let of_stage = error.downcast_ref().map(ProcessError::exit_code);
    let of_run = error.downcast_ref().map(LaunchError::exit_code);
    of_stage.or(of_run).unwrap_or(if refused { FAILED } else { WRONG_INPUT })
}

fn is_broken_pipe(error: &anyhow::Error) -> bool {
    error.downcast_ref::<io::Error>().is_some_and(|error| error.kind() == ErrorKind::BrokenPipe)
}

fn validate(source: &FileArguments, machine: Option<&str>) -> anyhow::Result<()> {
    let (pipeline, warnings) = source.read_with(machine, &[])?;
    machine.map_or(Ok(()), |machine| check_machine(&pipeline, Some(machine)))?;
    metrics::listen(&pipeline, machine)?;
    if !warnings.0.is_empty() {
        writeln!(stdout(), "{warnings}\n")?;
    }
    if let Some(json) = &pipeline.experiment {
        let experiment = Experiment::read(json)?;
        experiment::check(&experiment, &pipeline)?;
        for variation in variations(&experiment, source)? {
            source.read_with(machine, &variation.overrides)?;
        }
    }
    let (stages, topics) = (pipeline.stages.len(), pipeline.topics().len());
    Ok(writeln!(stdout(), "`{}` is valid: {stages} stages, {topics} topics", pipeline.name)?)
}

fn run(arguments: &RunArguments, log: &str) -> anyhow::Result<ExitCode> {
    let pipeline = arguments.source.read_on(arguments.machine.as_deref())?;
    refuse_name_or_files_in_use(&Plan::of(&pipeline, arguments.machine.as_deref(), None, NO_RUN))?;
    let _metrics = metrics::offer(&pipeline, arguments.machine.as_deref())?;
    if let Some(json) = &pipeline.experiment {
        return run_experiment(&pipeline, &Experiment::read(json)?, arguments, log);
    }
    let keys = Keys::read_for(&pipeline.name);
    let summary = run_once(&pipeline, arguments, arguments.quiet, log)?;
    drop(keys);
    if !arguments.quiet {
        let in_detail = tracing::enabled!(tracing::Level::DEBUG);
        let text = if in_detail { summary.in_detail().to_string() } else { summary.to_string() };
        write_to_stderr(format_args!("\n{}", text.trim_end()));
    }
    Ok(if summary.is_complete() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Checks that no other running pipeline has the name of this one, or writes its files.
fn refuse_name_or_files_in_use(plan: &Plan) -> anyhow::Result<()> {
    // A folder that cannot be read is reported when the run begins.
    for other in RunningPipeline::all().unwrap_or_default() {
        if other.plan.pipeline == plan.pipeline {
            bail!(LaunchError::from(FolderError::Running { name: other.plan.pipeline }));
        }
        plan.over_what_is_written_by(&other.plan, NODES).map_or(Ok(()), Err)?;
    }
    Ok(())
}

/// Returns the variations of an experiment; refuses command-line parameters that would override them.
fn variations(experiment: &Experiment, source: &FileArguments) -> anyhow::Result<Vec<Variation>> {
    let variations = experiment.variations()?;
    let key = |set: &str| set.split_once('=').map_or(set, |(key, _)| key).trim().to_owned();
    let is_part =
        |part: &str, whole: &str| part.strip_prefix(whole).is_some_and(|rest| rest.is_empty() || rest.starts_with('.'));
    let varied: BTreeSet<_> =
        variations.iter().flat_map(|variation| &variation.overrides).map(|set| key(set)).collect();
    for set in source.overrides.iter().map(|set| key(set)) {
        if let Some(varied) = varied.iter().find(|varied| is_part(varied, &set) || is_part(&set, varied)) {
            bail!(Hinted::new(
                format!("the experiment varies `{varied}`: `--set {set}` would make all its runs the same"),
                "change `vary` in the file"
            ));
        }
    }
    Ok(variations)
}

/// Runs a pipeline for each variation of its experiment, and prints one table.
fn run_experiment(
    pipeline: &Pipeline,
    experiment: &Experiment,
    arguments: &RunArguments,
    log: &str,
) -> anyhow::Result<ExitCode> {
    experiment::check(experiment, pipeline)?;
    let variations = variations(experiment, &arguments.source)?;
    experiment.check_files(&pipeline.base)?;
    let (rows, mut results) = (Rows::of(pipeline)?, Results::new(experiment));
    let (interrupted, mut finished) = (termination_flag()?, 0);
    for (index, variation) in variations.iter().enumerate() {
        let overrides: Vec<String> = variation.overrides.iter().cloned().chain(rows.overrides()).collect();
        if !arguments.quiet {
            write_to_stderr(format_args!(
                "run {} of {}: {}",
                index + 1,
                variations.len(),
                variation.overrides.join(" ")
            ));
        }
        let (pipeline, _) = arguments.source.read_with(arguments.machine.as_deref(), &overrides)?;
        let summary = run_once(&pipeline, arguments, true, log)?;
        if let Some(what) = disturbance(&summary, interrupted.load(Ordering::Relaxed)) {
            write_to_stderr(format_args!("the run with `{}` {what}:\n{summary}", variation.overrides.join(" ")));
            break;
        }
        results.add(rows.read(variation, &summary)?);
        finished += 1;
    }
    let is_complete = finished == variations.len();
    if !is_complete && finished > 0 {
        write_to_stderr(format_args!("the tables and files have the first {finished} of {} runs", variations.len()));
    }
    if is_complete || finished > 0 {
        let printed = write!(stdout(), "{}{}", experiment::tables(experiment, &results), results.exponents());
        results.write(&pipeline.base)?;
        printed?;
    }
    Ok(if is_complete { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Returns the reason why the rows of a run do not count, if there is one.
fn disturbance(summary: &Summary, is_interrupted: bool) -> Option<&'static str> {
    if is_interrupted {
        Some("was ended from outside")
    } else if !summary.is_complete() {
        Some("was not finished")
    } else {
        (summary.restarts() > 0).then_some("was disturbed: a stage was started anew")
    }
}

fn run_once(pipeline: &Pipeline, arguments: &RunArguments, quiet: bool, log: &str) -> anyhow::Result<Summary> {
    check_machine(pipeline, arguments.machine.as_deref())?;
    let run = SystemTime::now().duration_since(UNIX_EPOCH)?.as_nanos() as u64;
    let plan = Plan::of(pipeline, arguments.machine.as_deref(), arguments.frames, run);
    let around_stop = Some(keys::stop_without as fn(&dyn Fn()));
    let options = RunOptions { duration: arguments.duration, quiet, around_stop, ..options(log)? };
    Ok(conicflow_dataflow::run(&plan, &options)?)
}

/// Runs one stage in this process: of the run that started this process, or of a file, for a debugger.
fn node(stage: &str, file: Option<PathBuf>, machine: Option<&str>, log: &str) -> anyhow::Result<()> {
    if file.is_none() && std::env::var_os(conicflow_dataflow::PIPELINE).is_some() {
        return Ok(conicflow_dataflow::run_in_run(&REGISTRY)?);
    }
    let pipeline = FileArguments { file, overrides: Vec::new() }.read_on(machine)?;
    check_machine(&pipeline, machine)?;
    let placed =
        pipeline.stages.iter().find(|placed| placed.name == stage).and_then(|placed| placed.machine.as_deref());
    if let Some(other) = placed.filter(|placed| Some(*placed) != machine) {
        bail!(Hinted::new(
            format!("stage `{stage}` is on another machine, `{other}`"),
            format!("run it there, with --machine {other}")
        ));
    }
    let plan = Plan::of(&pipeline, machine, None, NO_RUN);
    Err(conicflow_dataflow::become_stage(&plan, stage, &options(log)?).into())
}

#[cfg(test)]
mod tests {
    use super::*;
    use anyhow::anyhow;

    #[test]
    fn an_unknown_log_level_is_refused() {
        for good in ["debug", "WARN", "off", "conicflow_dataflow=debug", "info,zenoh=debug", "warn,[step]=trace"] {
            assert_eq!(log_filter(good).as_deref(), Ok(good));
        }
        for wrong in ["debgu", "info,debgu", "conicflow=debgu"] {
            assert!(log_filter(wrong).is_err(), "{wrong}");
        }
        assert!(log_filter("info,debgu").is_err_and(|error| error.starts_with("`debgu` is no level\n  hint: ")));
    }

    #[test]
    fn errors_of_the_system_have_another_exit_code_than_wrong_input() {
        let full = || anyhow::Error::from(io::Error::from(ErrorKind::StorageFull));
        assert_eq!(exit_code(&full().context("cannot write `results/table.csv`")), FAILED);
        let hinted = || Hinted::of_writing("cannot write to `out.jsonl`", &ErrorKind::StorageFull.into());
        assert_eq!(exit_code(&hinted().into()), FAILED, "also with a text of its own");
        assert_eq!(exit_code(&anyhow::Error::from(hinted()).context("pictures")), FAILED);
        assert_eq!(exit_code(&anyhow!("there is no machine `moon`")), WRONG_INPUT);
        let missing = || ProcessError::System { doing: "starting".to_owned(), error: ErrorKind::NotFound.into() };
        assert_eq!(exit_code(&missing().into()), FAILED);
        assert_eq!(exit_code(&LaunchError::from(missing()).into()), FAILED);
        assert!(is_broken_pipe(&io::Error::from(ErrorKind::BrokenPipe).into()) && !is_broken_pipe(&full()));
    }
}
