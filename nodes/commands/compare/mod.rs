//! `conicflow compare`: runs two variants of a pipeline on the same frames, and reports how their answers and times differ.
//!
//! The variants run one after the other, unchanged, without losing a frame. Their objects are recorded, matched frame by frame
//! ([`variant`]), counted ([`tally`]) and printed ([`report`]).

mod pictures;
mod report;
mod tally;
mod variant;

use super::invocation::{FileArguments, options, write_to_stderr};
use anyhow::{Context as _, Result, bail, ensure};
use clap::Args;
use conicflow_dataflow::pipeline::{Pipeline, Report};
use conicflow_dataflow::{FileUse, termination_flag};
use conicflow_messages::Hinted;
use report::Variants;
use std::io::{Write as _, stdout};
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::Ordering;
use tally::Tally;
use variant::{How, Variant};

/// The variants to compare, and the outputs.
#[derive(Args)]
pub struct CompareArguments {
    #[command(flatten)]
    source: FileArguments,
    /// Parameters of the first variant [default: none, it is the file as it stands]
    #[arg(long, value_name = "STAGE.KEY=VALUE", num_args = 1..)]
    a: Vec<String>,
    /// Parameters of the second variant [default: none, it is the file as it stands]
    #[arg(long, value_name = "STAGE.KEY=VALUE", num_args = 1..)]
    b: Vec<String>,
    /// The topic with the answers, objects or tracks [default: the only one with objects, else with tracks]
    #[arg(long, value_name = "TOPIC")]
    topic: Option<String>,
    /// End after so many frames of each source [default: when the sources end]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    frames: Option<u64>,
    /// Writes a picture of each frame into this folder: what A found beside what B found
    #[arg(long, value_name = "DIR")]
    pictures: Option<PathBuf>,
    /// Size of each half of a picture, as a multiple of the frames' size
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..=8))]
    zoom: u32,
    /// Keeps the answers of both in this folder, as `a.mcap` and `b.mcap`; `conicflow view` shows them together
    #[arg(long, value_name = "DIR")]
    record: Option<PathBuf>,
    /// Print JSON in place of the tables, with the objects of each frame in which the variants differ
    #[arg(long)]
    json: bool,
}

/// Runs both variants and prints their differences.
///
/// # Errors
/// A variant cannot run, or the variants did not get the same frames.
pub fn compare(arguments: &CompareArguments, log: &str) -> Result<ExitCode> {
    ensure!(
        arguments.a != arguments.b,
        Hinted::new(
            "the variants are the same",
            "say what one of them sets, such as --b extractor.scan=rows; the other may be the file as it stands"
        )
    );
    let (a, b) = read(arguments)?;
    refuse_to_overwrite(arguments, [&a, &b])?;
    let topic = answers(&a, arguments.topic.as_deref())?;
    let (frames, keep) = (arguments.frames, arguments.record.as_deref());
    let with_depth = arguments.pictures.is_some() || keep.is_some();
    if let Some(folder) = keep {
        std::fs::create_dir_all(folder).with_context(|| format!("cannot make the folder `{}`", folder.display()))?;
    }
    let how = How { frames, with_depth, keep, interrupted: termination_flag()?, options: options(log)? };
    let mut variants = Vec::new();
    for (letter, pipeline, set) in [("a", a, &arguments.a), ("b", b, &arguments.b)] {
        write_to_stderr(format_args!("variant {letter}: {}", report::words(set)));
        match Variant::run(letter, pipeline, &topic, &how)? {
            Ok(variant) => variants.push(variant),
            Err(summary) => {
                write_to_stderr(format_args!("variant {letter} was disturbed, or not finished:\n{summary}"));
                if frames.is_none() && how.interrupted.load(Ordering::Relaxed) {
                    write_to_stderr(
                        "hint: `--frames N` ends both variants by themselves, also where the sources go on for ever",
                    );
                }
                return Ok(ExitCode::FAILURE);
            }
        }
    }
    let [a, b] = &mut variants[..] else { bail!("two variants were to be run") };
    let tally = Tally::of(a, b)?;
    let both = Variants { topic: &topic, sets: [&arguments.a, &arguments.b], tally: &tally };
    if let Some(folder) = &arguments.pictures {
        pictures::write(folder, arguments.zoom, [a, b], both.sets)?;
    }
    if arguments.json {
        writeln!(stdout(), "{}", serde_json::to_string_pretty(&both.json())?)?;
    } else {
        write!(stdout(), "{both}")?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Refuses outputs that the variants read.
fn refuse_to_overwrite(arguments: &CompareArguments, variants: [&Pipeline; 2]) -> Result<()> {
    let recording = |folder: &PathBuf| ["a.mcap", "b.mcap"].map(|name| FileUse::one("--record", folder.join(name)));
    let pictures = |folder: &PathBuf| FileUse::ending("--pictures", folder.clone(), ".png");
    let recordings = arguments.record.iter().flat_map(recording);
    let written: Vec<_> = recordings.chain(arguments.pictures.iter().map(pictures)).collect();
    let over = |pipeline: &Pipeline| {
        written.iter().find_map(|files| pipeline.over_what_it_reads(files, &format!("`{}`", files.key)))
    };
    variants.into_iter().find_map(over).map_or(Ok(()), |fault| Err(fault.into()))
}

/// Reads both variants of the file. A fault of both is reported as for any file, one of a single variant by its letter.
fn read(arguments: &CompareArguments) -> Result<(Pipeline, Pipeline)> {
    let source = &arguments.source;
    let read = |set: &Vec<String>| {
        let all = FileArguments { file: source.file.clone(), overrides: [&source.overrides[..], set].concat() };
        all.read_with(None, &[])
    };
    let name_variant = |letter: &str, set: &[String], error: anyhow::Error| {
        if error.is::<Report>() {
            write_to_stderr(format_args!("variant {letter}, {}:", report::words(set)));
        }
        error
    };
    match (read(&arguments.a), read(&arguments.b)) {
        (Ok((a, _)), Ok((b, _))) => Ok((a, b)),
        (Err(a), Err(b)) if a.to_string() == b.to_string() => Err(a),
        (Err(a), _) => Err(name_variant("a", &arguments.a, a)),
        (_, Err(b)) => Err(name_variant("b", &arguments.b, b)),
    }
}

/// Returns the topic whose messages are compared.
fn answers(pipeline: &Pipeline, wanted: Option<&str>) -> Result<String> {
    let with = |kind: &str| -> Vec<&str> {
        pipeline.topics().into_iter().filter(|topic| pipeline.kind_of(topic) == Some(kind)).collect()
    };
    let (objects, tracks) = (with("objects"), with("tracks"));
    let all: Vec<&str> = objects.iter().chain(&tracks).copied().collect();
    let named = all.iter().map(|topic| format!("`{topic}`")).collect::<Vec<_>>().join(", ");
    let usual = if objects.is_empty() { &tracks } else { &objects };
    match (wanted, &usual[..]) {
        (Some(wanted), _) if all.contains(&wanted) => Ok(wanted.to_owned()),
        (Some(wanted), _) => bail!(Hinted::new(
            format!("no stage writes objects or tracks to a topic `{wanted}`"),
            format!("topics with such: {}", if named.is_empty() { "there are none" } else { &named })
        )),
        (None, [only]) => Ok((*only).to_owned()),
        (None, []) => bail!(Hinted::new(
            format!("pipeline `{}` has no topic with objects or tracks", pipeline.name),
            "compare a pipeline that finds something"
        )),
        (None, _) => bail!(Hinted::new(format!("several topics carry answers: {named}"), "choose one with --topic")),
    }
}
