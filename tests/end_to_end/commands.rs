//! The commands that start no run (`graph`, `nodes`, help), and the errors for wrong arguments.

use crate::support::{Playground, Started, TRACKING, python_with};
use conicflow_nodes::NODES;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

#[test]
fn the_default_pipeline_is_printed_as_a_graph() {
    let expected = r#"flowchart LR
  source["source<br/>synthetic_source"]
  extractor["extractor<br/>row_ellipse_extractor"]
  assembler["assembler<br/>object_assembler"]
  tracker["tracker<br/>kalman_tracker"]
  console["console<br/>console_sink"]
  source -->|"depth"| extractor
  extractor -->|"ellipses"| assembler
  assembler -->|"objects"| tracker
  tracker -->|"tracks"| console
"#;
    let ended = Playground::new().conicflow(&["graph"]).expect_code(0);
    assert_eq!((ended.stdout.as_str(), ended.stderr.as_str()), (expected, ""));
}

#[test]
fn a_graph_shows_machines_further_inputs_and_programs() {
    let playground = Playground::with_pipeline(
        r#"
name = "two"

[machine.robot]
[machine.base]

[stage]
camera    = { machine = "robot", program = ["sh"], output = "depth" }
extractor = { machine = "robot", node = "row_ellipse_extractor", input = { topic = "depth", delivery = "lossless" }, output = "ellipses" }
pictures  = { machine = "base", node = "picture_sink", input = "ellipses", inputs = { depth = "depth" }, path = "pictures/" }
"#,
    );
    let ended = playground.conicflow(&["graph"]).expect_code(0);
    let (before, after) = ended.stdout.split_once("sh\"]").unwrap();
    assert!(before.starts_with("flowchart LR\n  subgraph base\n    pictures[\"pictures<br/>picture_sink\"]\n  end\n"));
    let expected = r#"
    extractor["extractor<br/>row_ellipse_extractor"]
  end
  camera -->|"depth, lossless"| extractor
  extractor -->|"ellipses"| pictures
  camera -.->|"depth"| pictures
"#;
    assert_eq!(after, expected);
}

#[test]
fn all_nodes_are_listed() {
    let ended = Playground::new().conicflow(&["nodes"]).expect_code(0);
    let rows: Vec<_> = ended.stdout.lines().map(|line| line.split_once(' ').unwrap()).collect();
    assert!(rows.iter().map(|(name, _)| *name).eq(NODES.iter().map(|node| node.name)), "{}", ended.stdout);
    assert!(rows.iter().all(|(_, summary)| summary.trim().len() > 10), "one has no summary: {}", ended.stdout);
}

/// The parameters in the output of `conicflow nodes NAME`: name, default and description.
fn parameters<'a>(text: &'a str) -> Vec<(&'a str, &'a str, &'a str)> {
    let paragraphs = text.split("\n\n").filter(|paragraph| !paragraph.starts_with("input"));
    let split = |paragraph: &'a str| {
        let (head, rest) = paragraph.split_once('\n')?;
        let (name, default) = head.split_once(" = ")?;
        Some((name, default, rest.lines().next()?))
    };
    paragraphs.filter_map(split).collect()
}

#[test]
fn each_node_shows_its_parameters_with_default_and_description() {
    let playground = Playground::new();
    let listed = playground.conicflow(&["nodes"]).stdout;
    for node in listed.lines().map(|line| line.split_whitespace().next().unwrap()) {
        let text = playground.conicflow(&["nodes", node]).expect_code(0).stdout;
        assert!(text.starts_with(&format!("{node}: ")), "{text}");
        let parameters = parameters(&text);
        assert!(!parameters.is_empty(), "{text}");
        for (name, default, description) in parameters {
            let described = description.strip_prefix("    ").is_some_and(|text| text.trim().len() > 10);
            assert!(described, "`{name}` of {node} has no description:\n{text}");
            assert!(!default.is_empty(), "`{name}` of {node} has no default");
        }
    }
}

#[test]
fn the_parameters_of_a_node_are_described_in_full() {
    let expected = r#"console_sink: Shows ellipses, objects or tracks as text on standard output

input   tracks | objects | ellipses

every = 1   (at least 1)
    Show one message in this many, of each camera; 1 shows all.

tentative = false
    Show tracks that are not confirmed yet.

brief = false
    Show each message in one line.

period_s = 0.0   (0.0 to 3600.0)
    Show no more than one message in so many seconds, of each camera, and the last at the end; 0 shows all.
"#;
    assert_eq!(Playground::new().conicflow(&["nodes", "console_sink"]).expect_code(0).stdout, expected);
}

#[test]
fn unknown_nodes_are_refused_with_a_suggestion() {
    let playground = Playground::new();
    let ended = playground.conicflow(&["nodes", "kalman_traker"]).expect_code(2);
    let expected = "error: there is no node `kalman_traker`\n  hint: did you mean `kalman_tracker`?\n";
    assert_eq!((ended.stdout.as_str(), ended.stderr.as_str()), ("", expected));
    let ended = playground.conicflow(&["nodes", "nonsense"]).expect_code(2);
    assert!(ended.stderr.starts_with("error: there is no node `nonsense`\n  hint: nodes: `synthetic_source`, "));
}

#[test]
fn help_names_the_commands() {
    let ended = Playground::new().conicflow(&["--help"]).expect_code(0);
    for command in ["run", "node", "validate", "graph", "nodes"] {
        let begins = |line: &&str| line.trim_start().starts_with(&format!("{command} "));
        assert!(ended.stdout.lines().any(|line| begins(&line)), "{command}: {}", ended.stdout);
    }
    let ended = Playground::new().conicflow(&["run", "--help"]).expect_code(0);
    for option in ["--set", "--for", "--frames", "--machine", "--quiet"] {
        assert!(ended.stdout.contains(option), "{option}: {}", ended.stdout);
    }
}

#[test]
fn wrong_arguments_are_refused() {
    let playground = Playground::with_pipeline(TRACKING);
    for (arguments, expected) in [
        (&["walk"][..], "unrecognized subcommand 'walk'"),
        (&["graph", "--log", "debgu"], "`debgu` is no level\n  hint: error, warn, info, debug or trace"),
        (&["run", "--frames", "0"], "invalid value '0' for '--frames <N>'"),
        (&["run", "--for", "soon"], "invalid value 'soon' for '--for <TIME>'"),
        (&["run", "--machine", "robot"], "the pipeline has no machine `robot`, nor any\n  hint: leave --machine out"),
        (&["node", "sourc"], "there is no stage `sourc` in this pipeline\n  hint: "),
    ] {
        let ended = playground.conicflow(arguments).expect_code(2);
        assert!(ended.stderr.contains(expected), "{arguments:?}: {}", ended.stderr);
    }
}

/// A full disk behind standard output is an error, but not one of the arguments. A closed standard output is no error.
#[test]
fn a_closed_or_full_output_ends_a_command() {
    let playground = Playground::new();
    for arguments in
        [&["graph"][..], &["nodes"], &["nodes", "follower"], &["validate"], &["doctor"], &["top", "--once"]]
    {
        let (reader, writer) = std::io::pipe().unwrap();
        drop(reader);
        let ended = playground.command(arguments).stdout(writer).stderr(Stdio::piped()).output().unwrap();
        let log = String::from_utf8_lossy(&ended.stderr);
        assert!(ended.status.success() && log.is_empty(), "{arguments:?}: {log}");
        let Ok(full) = File::options().write(true).open("/dev/full") else {
            eprintln!("skipped: this system has no /dev/full");
            continue;
        };
        let ended = playground.command(arguments).stdout(full).stderr(Stdio::piped()).output().unwrap();
        let log = String::from_utf8_lossy(&ended.stderr);
        assert!(ended.status.code() == Some(1) && log.contains("No space left on device"), "{arguments:?}: {log}");
    }
}

#[test]
fn files_that_are_missing_are_named() {
    let playground = Playground::with_pipeline(TRACKING);
    for command in ["run", "validate", "graph"] {
        let ended = playground.conicflow(&[command, "elsewhere/no.toml"]).expect_code(2);
        assert_eq!(
            ended.stderr,
            "error: cannot read the pipeline file `elsewhere/no.toml`: No such file or directory (os error 2)\n  \
             hint: without a file it is ./pipeline.toml, or else the built-in pipeline\n"
        );
    }
}

#[test]
fn machines_have_to_be_chosen() {
    let text = TRACKING.replace("node ", "machine = \"robot\"\nnode ");
    let playground = Playground::with_pipeline(&format!("{text}\n[machine.robot]\n[machine.base]\n"));
    let ended = playground.conicflow(&["run"]).expect_code(2);
    assert!(ended.stderr.starts_with("error: the pipeline spans the machines `base`, `robot`\n  hint: "));
    let ended = playground.conicflow(&["run", "--machine", "robt"]).expect_code(2);
    assert!(
        ended.stderr.starts_with("error: there is no machine `robt` in the pipeline\n  hint: "),
        "{}",
        ended.stderr
    );
    for (arguments, expected) in [
        (&["node", "json"][..], "the pipeline spans the machines `base`, `robot`\n  hint: "),
        (&["node", "json", "--machine", "robt"], "there is no machine `robt` in the pipeline\n  hint: "),
        (
            &["node", "json", "--machine", "base"],
            "stage `json` is on another machine, `robot`\n  hint: run it there, with --machine robot\n",
        ),
    ] {
        let ended = playground.conicflow(arguments).expect_code(2);
        assert!(ended.stderr.starts_with(&format!("error: {expected}")), "{arguments:?}: {}", ended.stderr);
    }
    playground.conicflow(&["run", "--machine", "robot", "--frames", "3"]).expect_code(0);
    assert_eq!(playground.sequences("tracks.jsonl"), [0, 1, 2]);
}

#[test]
fn a_shell_and_man_know_every_command() {
    let playground = Playground::new();
    let script = playground.conicflow(&["completions", "bash"]).expect_code(0).stdout;
    let pages = playground.conicflow(&["man"]).expect_code(0).stdout;
    for command in ["run", "detect", "validate", "top", "swap", "view", "record", "doctor", "completions", "man"] {
        assert!(script.contains(&format!("conicflow,{command})")), "{command}: {script}");
        assert!(pages.contains(&format!(".TH conicflow-{command} 1")), "{command}: {pages}");
    }
    assert!(script.contains("--frames") && pages.contains("frames"), "arguments are known, too");
    playground.conicflow(&["completions", "cmd"]).expect_code(2);
}

/// Editors check the file with JSON Schema validators of others; this test uses one of them.
#[test]
fn another_validator_names_the_fault() {
    let lacks = "has no jsonschema, or is older than 3.11; what it tells of a pipeline file is not shown";
    let Some(python) = python_with("jsonschema, tomllib", lacks) else { return };
    let playground = Playground::new();
    playground.write("schema.json", &playground.conicflow(&["schema"]).expect_code(0).stdout);
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let is_toml = |path: &PathBuf| path.extension().is_some_and(|extension| extension == "toml");
    let of = |folder: &str| fs::read_dir(root.join(folder)).unwrap().map(|entry| entry.unwrap().path()).filter(is_toml);
    let mut command = Command::new(python);
    command.arg(root.join("tests/end_to_end/schema.py")).arg(playground.path("schema.json"));
    command.arg(root.join("pipeline.toml")).args(of("examples")).args(of("experiments"));
    let output = Started::new(command).wait().expect_code(0).stdout;
    assert!(output.ends_with(" files\n"), "{output}");
}
