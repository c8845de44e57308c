//! The stages of a pipeline file: what they run, when they are restarted, and their parameters.

use super::{MAX_STAGE_NAME, MAX_TOPIC_NAME, Reader};
use crate::log::LOG;
use crate::node::Variables;
use crate::pipeline::diagnostic::{SourceSpan, closest, suggestion};
use crate::pipeline::schema;
use crate::pipeline::spec::{Program, Restart, StageSpec};
use crate::pipeline::value::{Content, Entry, Table};
use crate::ports::Delivery;
use crate::side_inputs::Pairing;
use conicflow_messages::Hinted;
use std::ops::RangeInclusive;
use std::path::{Path, PathBuf};

pub const STAGE_KEYS: [&str; 8] = ["node", "program", "input", "inputs", "output", "machine", "restart", "env"];
pub const RESTARTS: [(&str, Restart); 3] =
    [("never", Restart::Never), ("on_failure", Restart::OnFailure), ("always", Restart::Always)];
/// Maximum number of stages. Each is a process: on two cores 100 stages start, see a frame and end in 5 s, 400 in 42 s; 500 that
/// run for 20 s take 147 s.
const MAX_STAGES: usize = 500;
/// Prefix of the environment variables that tie a stage to its run.
const OWN_VARIABLES: &str = "CONICFLOW_";
/// Allowed `hang_s`. The minimum is well above the heartbeat's period of 0.1 s.
pub const HANG_S: RangeInclusive<f64> = 1.0..=86_400.0;
/// Default time after its start within which a program has to join a lossless topic, which is blocked without it. Python loads a
/// neural network within a minute on the computers of robots.
pub const TIME_TO_JOIN_S: f64 = 120.0;
/// Allowed `join_s`.
pub const JOIN_S: RangeInclusive<f64> = 1.0..=86_400.0;
const OUTPUT_EXAMPLE: &str = "output = { topic = \"found\", kind = \"objects\" }";
const HANG_HINT: &str = "a stage without a sign of life for so long counts as dead";
const JOIN_HINT: &str = "a program that has not joined a lossless topic so long after its start ends the run";

impl Reader<'_> {
    pub(super) fn stages(&mut self, entry: Entry) -> Vec<StageSpec> {
        let table = self.table(entry, "[stage.source]").unwrap_or_default();
        if let Some(further) = table.0.get(MAX_STAGES) {
            let what = format!("the pipeline has {} stages, at most {MAX_STAGES} can run", table.0.len());
            self.fault(&further.key_place, what, "each is a process; let fewer of them do more");
            return Vec::new();
        }
        table.0.into_iter().filter_map(|entry| self.stage(entry)).collect()
    }

    fn stage(&mut self, entry: Entry) -> Option<StageSpec> {
        let (name, place) = (entry.key.clone(), entry.key_place.clone());
        self.check_name(&name, &place, "stage", MAX_STAGE_NAME, "_-");
        let mut table = self.table(entry, "[stage.source]")?;
        let place_of = |key| table.get(key).map(|entry| entry.value.place.clone());
        let [input_place, output_place, machine_place] = ["input", "output", "machine"].map(place_of);
        self.go_to(table.get("machine").and_then(|entry| entry.value.as_str()));
        let program = self.program(&mut table, &name, &place);
        let input = table.take("input").and_then(|entry| self.input(&entry.value, Pairing::Latest, Delivery::Latest));
        let driving = input.as_ref().map_or(Delivery::Latest, |input| input.delivery);
        let inputs = table.take("inputs").map(|entry| self.inputs(entry, &program, driving)).unwrap_or_default();
        let (output, declared_output) = table.take("output").map(|entry| self.output(entry)).unwrap_or_default();
        let machine = table.take("machine").and_then(|entry| self.string(&entry));
        let restart = table.take("restart").map(|entry| self.restart(entry));
        let (restart, hang_s, join_s) = restart.unwrap_or_default();
        let env = table.take("env").map(|entry| self.env(entry)).unwrap_or_default();
        self.parameters(&table, &program, &name, &place, &env);
        let parameters = table.to_json();
        let places = table.0.into_iter().map(|entry| (entry.key, entry.value.place));
        Some(StageSpec {
            name,
            program,
            input,
            inputs,
            output,
            declared_output,
            machine,
            restart,
            hang_s,
            join_s,
            env,
            parameters,
            place,
            input_place,
            output_place,
            machine_place,
            parameter_places: places.collect(),
        })
    }

    /// Reads `restart` in its short or its long form. Returns when a stage is restarted, `hang_s`, and `join_s`.
    fn restart(&mut self, entry: Entry) -> (Restart, Option<f64>, Option<f64>) {
        let Content::Table(mut table) = entry.value.content else {
            return (self.word(&entry, RESTARTS).unwrap_or_default(), None, None);
        };
        let when = table.take("when").and_then(|entry| self.word(&entry, RESTARTS)).unwrap_or_default();
        let hang_s = table.take("hang_s").and_then(|entry| self.seconds(&entry, HANG_S, HANG_HINT));
        let join_s = table.take("join_s").and_then(|entry| self.seconds(&entry, JOIN_S, JOIN_HINT));
        self.unknown_keys(&table, &["when", "hang_s", "join_s"], "`restart`");
        (when, hang_s, join_s)
    }

    fn program(&mut self, table: &mut Table, stage: &str, place: &SourceSpan) -> Program {
        match (table.take("node"), table.take("program")) {
            (Some(node), None) => self.node(&node),
            (None, Some(program)) => self.command(&program),
            (None, None) => {
                let hint = match table.0.iter().find_map(|entry| closest(&entry.key, ["node", "program"])) {
                    Some(key) => format!("did you mean `{key}`?"),
                    None => "add `node = \"..\"`; `conicflow nodes` lists them".to_owned(),
                };
                self.fault(place, format!("stage `{stage}` has neither `node` nor `program`"), hint);
                Program::Unknown
            }
            (Some(_), Some(program)) => {
                let what = format!("stage `{stage}` has both `node` and `program`");
                self.fault(&program.key_place, what, "keep the one that shall run");
                Program::Unknown
            }
        }
    }

    fn node(&mut self, entry: &Entry) -> Program {
        let Some(name) = self.string(entry) else { return Program::Unknown };
        if let Some(node) = self.context.registry.nodes.iter().find(|node| node.name == name) {
            return Program::Node(*node);
        }
        let hint = suggestion(&name, self.context.registry.nodes.iter().map(|node| node.name), "nodes");
        self.fault(&entry.value.place, format!("there is no node `{name}`"), hint);
        Program::Unknown
    }

    fn command(&mut self, entry: &Entry) -> Program {
        let Some(mut command) = self.strings(entry) else { return Program::Unknown };
        if command.iter().any(|part| part.contains('\0')) {
            self.fault(&entry.value.place, "`program` has a zero byte in it", "an argument is a text without one");
            return Program::Unknown;
        }
        let Some(program) = command.first_mut() else {
            self.fault(&entry.value.place, "`program` is empty", "for example program = [\"./my_stage\", \"--flag\"]");
            return Program::Unknown;
        };
        let place =
            if let Content::Array(values) = &entry.value.content { &values[0].place } else { &entry.value.place };
        match find_program(self.context.base, program) {
            Some(path) if is_executable(&path) => *program = path.to_string_lossy().into_owned(),
            _ if self.elsewhere => {}
            Some(_) => {
                let what = format!("`{program}` may not be run");
                self.fault(place, what, format!("if it is a program: chmod +x {program}"));
            }
            None => {
                let what = format!("there is no program `{program}`");
                let hint = "with a slash it is relative to the pipeline file, without one it is looked for in PATH";
                self.fault(place, what, hint);
            }
        }
        Program::Command(command)
    }

    /// Reads an output in its short or its long form. Returns the topic, and the kind.
    fn output(&mut self, entry: Entry) -> (Option<String>, Option<String>) {
        if !matches!(entry.value.content, Content::Table(_)) {
            return (self.topic_name(&entry), None);
        }
        let place = entry.value.place.clone();
        let mut table = self.table(entry, OUTPUT_EXAMPLE).unwrap_or_default();
        let topic = table.take("topic").map(|entry| self.topic_name(&entry));
        let kind = table.take("kind").and_then(|entry| self.kind(&entry));
        self.unknown_keys(&table, &["topic", "kind"], "the output");
        if topic.is_none() {
            self.fault(&place, "the output has no topic", format!("for example {OUTPUT_EXAMPLE}"));
        }
        (topic.flatten(), kind)
    }

    fn topic_name(&mut self, entry: &Entry) -> Option<String> {
        let name = self.string(entry)?;
        self.check_name(&name, &entry.value.place, "topic", MAX_TOPIC_NAME, "_-/");
        Some(name)
    }

    fn env(&mut self, entry: Entry) -> Vec<(String, String)> {
        let table = self.table(entry, "env = { RUST_LOG = \"debug\" }").unwrap_or_default();
        table.0.iter().filter_map(|entry| self.variable(entry)).collect()
    }

    /// Reads an environment variable of a stage; its name has to be valid, and must not be one that ties the stage to its run.
    fn variable(&mut self, entry: &Entry) -> Option<(String, String)> {
        let (name, value) = (&entry.key, self.string(entry)?);
        let (what, hint) = if name.is_empty() || name.contains(['=', '\0']) {
            (
                format!("`{name}` cannot be the name of a variable"),
                "it may be neither empty nor have `=` or a zero byte in it",
            )
        } else if value.contains('\0') {
            (format!("the value of `{name}` has a zero byte in it"), "a variable is a text without one")
        } else if name.starts_with(OWN_VARIABLES) && name != LOG {
            let hint = "by such variables a stage finds its place; of these only `CONICFLOW_LOG` is free";
            (format!("`{name}` is set by the run itself"), hint)
        } else {
            return Some((name.clone(), value));
        };
        self.fault(&entry.key_place, what, hint);
        None
    }

    /// Checks the remaining keys, which are those of the node. The node itself checks their values only on the machine where it
    /// runs.
    fn parameters(&mut self, table: &Table, program: &Program, stage: &str, place: &SourceSpan, env: &Variables) {
        let Program::Node(node) = program else { return };
        let found = schema::check_table(table, &node.schema(), &STAGE_KEYS, &format!("stage `{stage}`"));
        if !found.is_empty() {
            self.faults.extend(found);
            return;
        }
        if self.elsewhere {
            return;
        }
        let hosted = node.host.map_or(Ok(()), |host| (host.check)(&table.to_json(), self.context.base, env));
        if let Err(Hinted { what, hint, .. }) = hosted {
            self.fault(place, format!("stage `{stage}` cannot be run: {what}"), hint);
        }
        match (node.check)(table.to_json(), self.context.base) {
            Ok(faults) => {
                for fault in faults {
                    let at = table.get(fault.key).map_or(place, |entry| &entry.value.place);
                    self.fault(at, format!("`{}`: {}", fault.key, fault.what), fault.hint);
                }
            }
            Err(error) => {
                self.fault(place, format!("the parameters of stage `{stage}` cannot be used: {error}"), "");
            }
        }
    }
}

/// Finds a program by a path relative to the pipeline file, or by a name in PATH.
fn find_program(base: &Path, program: &str) -> Option<PathBuf> {
    if program.contains('/') {
        let path = base.join(program);
        return path.exists().then_some(path);
    }
    let folders = std::env::var_os("PATH")?;
    std::env::split_paths(&folders).map(|folder| folder.join(program)).find(|path| is_executable(path))
}

fn is_executable(path: &Path) -> bool {
    use std::os::unix::fs::PermissionsExt;
    path.metadata().is_ok_and(|data| data.is_file() && data.permissions().mode() & 0o111 != 0)
}
