//! Faulty pipeline files: each file in `tests/faulty_pipelines` has its exact error text beside it, and starts nothing.
//! `UPDATE_EXPECT=1` writes the texts again; read them before you commit them.

use crate::support::{Ended, Playground, RECORDING, Started};
use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

const SOUND: &str = r#"
name = "sound"

[stage]
source    = { node = "synthetic_source", output = "depth", frames = 3 }
extractor = { node = "row_ellipse_extractor", input = "depth", output = "ellipses" }
json      = { node = "json_sink", input = "ellipses", path = "ellipses.jsonl" }
"#;

fn folder() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/faulty_pipelines")
}

fn faulty_files() -> Vec<PathBuf> {
    let entries = fs::read_dir(folder()).unwrap().map(|entry| entry.unwrap().path());
    let mut files: Vec<_> = entries.filter(|path| path.extension().is_some_and(|end| end == "toml")).collect();
    files.sort();
    assert!(!files.is_empty());
    files
}

/// All files in the folder of faulty files except the expected texts.
fn names_in_folder() -> BTreeSet<PathBuf> {
    let paths = fs::read_dir(folder()).unwrap().map(|entry| entry.unwrap().path());
    paths.filter(|path| path.extension().is_none_or(|end| end != "txt")).collect()
}

/// The result of `command` for a file in the folder of faulty files.
fn refused(playground: &Playground, command: &str, file: &Path) -> Ended {
    let mut command = playground.command(&[command, file.file_name().unwrap().to_str().unwrap()]);
    command.current_dir(folder());
    Started::new(command).wait()
}

/// The line numbers of the diagnostics `error: NAME:LINE:COLUMN: ..` in a text.
fn lines_of_errors(text: &str) -> Vec<usize> {
    let errors = text.lines().filter(|line| line.starts_with("error: "));
    errors.map(|line| line.split(':').nth(2).unwrap().parse().unwrap()).collect()
}

#[test]
fn all_faults_are_reported_at_once_with_place_and_hint_in_the_order_of_the_lines() {
    let playground = Playground::new();
    let folder_path = folder().canonicalize().unwrap();
    let mut differing = Vec::new();
    for file in faulty_files() {
        let ended = refused(&playground, "validate", &file);
        assert_eq!((ended.code, ended.stdout.as_str()), (Some(2), ""), "{}: {}", file.display(), ended.stderr);
        assert!(lines_of_errors(&ended.stderr).is_sorted(), "{}: {}", file.display(), ended.stderr);
        let text = ended.stderr.replace(folder_path.to_str().unwrap(), "[folder]");
        let expected = file.with_extension("txt");
        if std::env::var_os("UPDATE_EXPECT").is_some() {
            fs::write(expected, text).unwrap();
        } else if fs::read_to_string(&expected).unwrap_or_default() != text {
            differing.push(format!("{} expects something else than:\n{text}", expected.display()));
        }
    }
    assert!(differing.is_empty(), "{}", differing.join("\n"));
}

#[test]
fn a_faulty_file_starts_no_stage() {
    let playground = Playground::new();
    let before = names_in_folder();
    for file in faulty_files() {
        let (run, validate) = (refused(&playground, "run", &file), refused(&playground, "validate", &file));
        assert_eq!((run.code, run.stdout, run.stderr), (Some(2), String::new(), validate.stderr), "{}", file.display());
    }
    assert_eq!(fs::read_dir(playground.runtime()).unwrap().count(), 0, "a run has begun");
    assert_eq!(names_in_folder(), before, "something was written");
}

#[test]
fn a_sound_file_is_valid() {
    let playground = Playground::with_pipeline(SOUND);
    let ended = playground.conicflow(&["validate"]).expect_code(0);
    assert_eq!((ended.stdout.as_str(), ended.stderr.as_str()), ("`sound` is valid: 3 stages, 2 topics\n", ""));
    assert!(!playground.path("ellipses.jsonl").exists(), "to validate is not to run");
}

#[test]
fn settings_that_work_but_are_probably_mistakes_give_a_warning() {
    let (without_sink, _) = SOUND.split_once("json ").unwrap();
    let playground = Playground::with_pipeline(without_sink);
    let ended = playground.conicflow(&["validate"]).expect_code(0);
    let expected = "warning: pipeline.toml:6:73: nobody reads the topic `ellipses`
    6 | extractor = { node = \"row_ellipse_extractor\", input = \"depth\", output = \"ellipses\" }
      |                                                                         ^^^^^^^^^^
  hint: add a stage with this `input`, or leave it for tools that look on

`sound` is valid: 2 stages, 2 topics\n";
    assert_eq!(ended.stdout, expected);

    let again = "\n[stage.again]\nnode = \"row_ellipse_extractor\"\ninput = \"depth\"\noutput = \"ellipses\"\n";
    let playground = Playground::with_pipeline(&format!("{SOUND}{again}"));
    let ended = playground.conicflow(&["validate"]).expect_code(0);
    let warning = "`extractor` and `again` write the same frames of `source` into the topic `ellipses`";
    assert!(ended.stdout.starts_with("warning: ") && ended.stdout.contains(warning), "{}", ended.stdout);
}

#[test]
fn overrides_are_checked_as_the_file_is() {
    let playground = Playground::with_pipeline(SOUND);
    for (set, expected) in [
        (
            "sorce.frames=5",
            "error: --set:1:1: there is no stage `sorce`\n    1 | sorce.frames=5\n      | ^^^^^^^^^^^^^^\n  \
             hint: did you mean `source`?\n",
        ),
        (
            "source.frame=5",
            "error: --set:1:1: unknown key `frame` in stage `source`\n    1 | source.frame=5\n      | ^^^^^^^^^^^^^^\n  \
             hint: did you mean `frames`?\n",
        ),
        (
            "source.frames=five",
            "error: --set:1:15: `frames` wants an integer, this is a string\n    1 | source.frames=five\n      \
             |               ^^^^\n  hint: Number of frames; 0: without end, of random scenes one for each (default 0)\n",
        ),
        (
            "source.noise.floor_m=-1",
            "error: --set:1:22: `floor_m` is -1, allowed is 0 or more\n    1 | source.noise.floor_m=-1\n      \
             |                      ^^\n  hint: Noise at the knee, in metres (default 0.0012)\n",
        ),
        (
            "frames=5",
            "error: --set:1:1: `--set` wants STAGE.KEY=VALUE\n    1 | frames=5\n      | ^^^^^^^^\n  \
             hint: for example --set source.rate_hz=10\n",
        ),
    ] {
        let ended = playground.conicflow(&["validate", "--set", set]).expect_code(2);
        assert_eq!((ended.stdout.as_str(), ended.stderr.as_str()), ("", expected), "{set}");
    }
}

#[test]
fn parameters_of_the_papers_method_have_tables_of_their_own() {
    let playground = Playground::with_pipeline(SOUND);
    let sets = ["validate", "--set", "extractor.arcs=conic", "--set", "extractor.conic.min_arc_deg=45"];
    playground.conicflow(&sets).expect_code(0);
    let ended = playground.conicflow(&["validate", "--set", "extractor.min_arc_deg=45"]).expect_code(2);
    ended.expect_texts(&["unknown key `min_arc_deg` in stage `extractor`"]);
}

#[test]
fn overrides_replace_values_of_the_file() {
    let playground = Playground::with_pipeline(SOUND);
    let sets = ["source.width=64", "source.height=48", "source.noise.floor_m=0.002", "json.path=other.jsonl"];
    let small: Vec<_> = sets.iter().flat_map(|set| ["--set", set]).collect();
    let lossless = ["--set", "extractor.input={ topic = \"depth\", delivery = \"lossless\" }"];
    let more = ["--set", "json.input.topic=ellipses", "--set", "json.input.delivery=lossless"];
    let arguments = [&["run", "--set", "source.frames=7"][..], &small, &lossless, &more].concat();
    playground.conicflow(&arguments).expect_code(0);
    assert_eq!(playground.lines("other.jsonl").len(), 7);
    assert!(!playground.path("ellipses.jsonl").exists());
}

#[test]
fn more_stages_than_a_run_can_start_are_refused() {
    let source = |index: usize| format!("\n[stage.s{index}]\nnode = \"synthetic_source\"\noutput = \"depth{index}\"\n");
    let with = |stages: usize| format!("name = \"many\"\n{}", (0..stages).map(source).collect::<String>());
    let ended = Playground::with_pipeline(&with(501)).conicflow(&["validate"]).expect_code(2);
    ended.expect_texts(&["the pipeline has 501 stages, at most 500 can run"]);
    Playground::with_pipeline(&with(500)).conicflow(&["validate"]).expect_code(0);
}

/// Recordings often have dates as file names.
#[test]
fn the_hint_for_text_that_looks_like_a_number_or_a_date_says_how_to_write_it() {
    let playground = Playground::with_pipeline(RECORDING);
    for name in ["20240501_120000", "2024-05-01", "true"] {
        let set = format!("source.path={name}");
        let ended = playground.conicflow(&["validate", "--set", &set]).expect_code(2);
        ended.expect_texts(&[&format!("hint: text goes in quotes: --set 'source.path=\"{name}\"'; ")]);
        let quoted = format!("source.path=\"{name}\"");
        let ended = playground.conicflow(&["validate", "--set", &quoted]);
        assert!(!ended.stderr.contains("wants a string"), "{}", ended.stderr);
    }
}
