//! Common parts of several commands: reading the pipeline file, the options to run its stages, and messages to the user.

use crate::{NODES, REGISTRY};
use anyhow::{Context, anyhow, bail};
use clap::Args;
use conicflow_dataflow::RunOptions;
use conicflow_dataflow::pipeline::{Pipeline, Report, SourceText};
use conicflow_messages::{Hinted, read_text};
use std::fmt::Display;
use std::io::{ErrorKind, Write, stderr};
use std::path::{Path, PathBuf};

const BUILT_IN: &str = include_str!("../../pipeline.toml");
const DEFAULT_FILE: &str = "pipeline.toml";
/// Longest pipeline file that is read, in bytes.
const MOST_BYTES: u64 = 1 << 24; // [algorithmic]

#[derive(Args, Default)]
pub struct FileArguments {
    /// The pipeline file [default: ./pipeline.toml, else the built-in one]
    pub file: Option<PathBuf>,
    /// Set a parameter, as if it stood in the file; may be repeated
    #[arg(long = "set", value_name = "STAGE.KEY=VALUE")]
    pub overrides: Vec<String>,
}

impl FileArguments {
    /// Reads the pipeline as the named machine needs it, or without a name, as all machines need it.
    pub fn read_for(&self, machine: Option<&str>) -> anyhow::Result<Pipeline> {
        let pipeline = self.read_on(machine)?;
        machine.map_or(Ok(()), |machine| check_machine(&pipeline, Some(machine)))?;
        Ok(pipeline)
    }

    /// Reads the pipeline as one of its machines needs it, and prints warnings.
    pub fn read_on(&self, machine: Option<&str>) -> anyhow::Result<Pipeline> {
        let (pipeline, warnings) = self.read_with(machine, &[])?;
        if !warnings.0.is_empty() {
            write_to_stderr(format_args!("{warnings}\n"));
        }
        Ok(pipeline)
    }

    /// Reads the pipeline with further parameters set; those of the command line take precedence.
    pub fn read_with(&self, machine: Option<&str>, further: &[String]) -> anyhow::Result<(Pipeline, Report)> {
        let (source, base) = self.text()?;
        Ok(Pipeline::read_on(machine, source, &base, &[further, &self.overrides].concat(), &REGISTRY)?)
    }

    /// Returns the text of the file and the base folder of its paths; for the built-in pipeline, the current folder.
    pub fn text(&self) -> anyhow::Result<(SourceText, PathBuf)> {
        let default = Path::new(DEFAULT_FILE);
        let file = self.file.as_deref().or(default.is_file().then_some(default));
        let Some(file) = file else {
            let source = SourceText { name: "built-in pipeline".to_owned(), text: BUILT_IN.to_owned() };
            return Ok((source, in_utf8(std::env::current_dir()?)?));
        };
        let text = read_text(file, MOST_BYTES).map_err(|error| {
            let hint = match error.kind() {
                // FILE is a folder or a recording.
                ErrorKind::IsADirectory | ErrorKind::InvalidData => {
                    "`conicflow detect` takes frames and recordings; a pipeline file names them with --set source.path=.."
                }
                _ => "without a file it is ./pipeline.toml, or else the built-in pipeline",
            };
            anyhow!(Hinted::new(format!("cannot read the pipeline file `{}`: {error}", file.display()), hint))
        })?;
        let folder = file.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."));
        Ok((SourceText { name: file.display().to_string(), text }, in_utf8(folder.canonicalize()?)?))
    }
}

/// Refuses a folder whose name is no text, as the stages get it as text.
fn in_utf8(folder: PathBuf) -> anyhow::Result<PathBuf> {
    let hint = "rename it, or put the pipeline file into another folder";
    let fault = || Hinted::new(format!("the name of the folder `{}` is not UTF-8", folder.display()), hint);
    if folder.to_str().is_some() { Ok(folder) } else { bail!(fault()) }
}

/// Checks that a machine is named if the pipeline has several, and that the pipeline has it.
pub fn check_machine(pipeline: &Pipeline, machine: Option<&str>) -> anyhow::Result<()> {
    let names: Vec<_> = pipeline.machines.keys().map(|name| format!("`{name}`")).collect();
    match machine {
        Some(machine) if names.is_empty() => {
            bail!(Hinted::new(
                format!("the pipeline has no machine `{machine}`, nor any"),
                "leave --machine out: all stages run on this one"
            ))
        }
        Some(machine) if !pipeline.machines.contains_key(machine) => {
            bail!(Hinted::new(
                format!("there is no machine `{machine}` in the pipeline"),
                format!("machines: {}", names.join(", "))
            ))
        }
        None if !names.is_empty() => bail!(Hinted::new(
            format!("the pipeline spans the machines {}", names.join(", ")),
            "say which of them this is, with --machine NAME"
        )),
        _ => {}
    }
    Ok(())
}

/// Returns the options to run stages with this program.
pub fn options(log: &str) -> anyhow::Result<RunOptions> {
    let program = std::env::current_exe().context("cannot find this program's own file, which runs the stages")?;
    Ok(RunOptions { program, nodes: NODES, log: Some(log.to_owned()), ..RunOptions::default() })
}

/// Writes a line to standard error; a closed standard error is ignored.
pub fn write_to_stderr(text: impl Display) {
    writeln!(stderr(), "{text}").ok();
}
