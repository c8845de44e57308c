//! The tree of a pipeline file into stages: keys, types, nodes and their parameters.

use super::diagnostic::{Diagnostic, Place, SourceText, closest, suggestion};
use super::schema;
use super::value::{Content, Entry, Table, Value};
use super::{Input, Machine, Pipeline, Program, Restart, StageSpec};
use crate::bridge::{Compression, settings};
use crate::node::Node;
use crate::ports::Delivery;
use crate::sides::Pick;
use conicflow_messages::Kind;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::Arc;

const STAGE_KEYS: [&str; 8] = ["node", "program", "input", "inputs", "output", "machine", "restart", "env"];
const INPUT_KEYS: [&str; 5] = ["topic", "delivery", "queue", "kind", "compression"];
const COMPRESSIONS: [(&str, Compression); 3] =
    [("none", Compression::None), ("lz4", Compression::Lz4), ("zstd", Compression::Zstd)];
const KINDS: [Kind; 4] = [Kind::Depth, Kind::Ellipses, Kind::Objects, Kind::Tracks];
const DELIVERIES: [(&str, Delivery); 2] = [("latest", Delivery::Latest), ("lossless", Delivery::Lossless)];
const RESTARTS: [(&str, Restart); 3] =
    [("never", Restart::Never), ("on_failure", Restart::OnFailure), ("always", Restart::Always)];
const MACHINE_KEYS: [&str; 5] = ["listen", "connect", "zenoh", "insecure", "outage_s"];

/// Names travel in headers of fixed size, as far as the terminating zero.
const MAX_STAGE_NAME: usize = 31;
const MAX_TOPIC_NAME: usize = 63;

const QUEUE_LATEST: usize = 2;
const QUEUE_SAME_FRAME: usize = 8;
const QUEUE_LOSSLESS: usize = 4;
const MAX_QUEUE: i64 = 64;
const MAX_OUTAGE_S: f64 = 86_400.0;

/// Reads a document; what cannot be read is reported and left out.
pub(super) fn pipeline(
    mut document: Table,
    source: &Arc<SourceText>,
    base: &Path,
    nodes: &[Node],
    faults: &mut Vec<Diagnostic>,
) -> Pipeline {
    let start = Place { source: Arc::clone(source), span: 0..0 };
    let mut reader = Reader { base, nodes, faults };
    let name = reader.name(&mut document, &start);
    let machines = document.take("machine").map(|entry| reader.machines(entry)).unwrap_or_default();
    let experiment = document.take("experiment").map(|entry| entry.value.to_json());
    let stages = document.take("stage").map(|entry| reader.stages(entry));
    reader.unknown_keys(&document, &["name", "machine", "stage", "experiment"], "the pipeline");
    let stages = stages.unwrap_or_else(|| {
        reader.no_stages(&document, &start);
        Vec::new()
    });
    let source = Default::default();
    Pipeline { name, base: base.to_owned(), machines, stages, experiment, source }
}

/// What the file says of an input.
#[derive(Default)]
struct SaidInput {
    topic: String,
    delivery: Option<Delivery>,
    queue: Option<usize>,
    kind: Option<Kind>,
    compression: Option<Compression>,
}

struct Reader<'a> {
    base: &'a Path,
    nodes: &'a [Node],
    faults: &'a mut Vec<Diagnostic>,
}

impl Reader<'_> {
    fn fault(&mut self, place: &Place, what: impl Into<String>, hint: impl Into<String>) {
        self.faults.push(Diagnostic::error(place, what, hint));
    }

    fn unknown_keys(&mut self, table: &Table, known: &[&str], owner: &str) {
        for entry in &table.0 {
            let hint = suggestion(&entry.key, known.iter().copied(), "keys");
            self.fault(&entry.key_place, format!("unknown key `{}` in {owner}", entry.key), hint);
        }
    }

    fn string(&mut self, entry: &Entry) -> Option<String> {
        if entry.value.as_str().is_none() {
            let what = format!("`{}` wants a string, this is {}", entry.key, entry.value.type_name());
            self.fault(&entry.value.place, what, format!("for example {} = \"..\"", entry.key));
        }
        entry.value.as_str().map(str::to_owned)
    }

    fn strings(&mut self, entry: &Entry) -> Option<Vec<String>> {
        let wrong = match &entry.value.content {
            Content::Array(values) => match values.iter().map(|value| value.as_str().map(str::to_owned)).collect() {
                Some(strings) => return Some(strings),
                None => values.iter().find(|value| value.as_str().is_none()),
            },
            _ => None,
        };
        let wrong = wrong.unwrap_or(&entry.value);
        let what = format!("`{}` wants an array of strings, this is {}", entry.key, wrong.type_name());
        self.fault(&wrong.place, what, format!("for example {} = [\"..\", \"..\"]", entry.key));
        None
    }

    fn table(&mut self, entry: Entry, example: &str) -> Option<Table> {
        if let Content::Table(table) = entry.value.content {
            return Some(table);
        }
        let what = format!("`{}` wants a table, this is {}", entry.key, entry.value.type_name());
        self.fault(&entry.value.place, what, format!("for example {example}"));
        None
    }

    /// A name that can stand in paths, ports and JSON.
    fn check_name(&mut self, name: &str, place: &Place, what: &str, longest: usize, allowed: &str) {
        let good = |c: char| c.is_ascii_alphanumeric() || allowed.contains(c);
        if name.is_empty() || name.len() > longest || !name.chars().all(good) {
            let hint = format!("1 to {longest} letters, digits or one of {allowed}");
            self.fault(place, format!("`{name}` cannot be the name of a {what}"), hint);
        }
    }

    fn name(&mut self, document: &mut Table, start: &Place) -> String {
        let Some(entry) = document.take("name") else {
            if !is_misspelt("name", document) {
                self.fault(start, "the pipeline has no name", "add a line such as name = \"tabletop\" at the top");
            }
            return String::new();
        };
        let Some(name) = self.string(&entry) else { return String::new() };
        self.check_name(&name, &entry.value.place, "pipeline", MAX_STAGE_NAME, "_-");
        name
    }

    fn no_stages(&mut self, document: &Table, start: &Place) {
        if !is_misspelt("stage", document) {
            let hint = "add one, such as [stage.source] with `node` and `output`";
            self.fault(start, "the pipeline has no stages", hint);
        }
    }

    fn machines(&mut self, entry: Entry) -> BTreeMap<String, Machine> {
        let table = self.table(entry, "[machine.robot]").unwrap_or_default();
        table.0.into_iter().map(|entry| (entry.key.clone(), self.machine(entry))).collect()
    }

    fn machine(&mut self, entry: Entry) -> Machine {
        let (owner, place) = (format!("machine `{}`", entry.key), entry.key_place.clone());
        self.check_name(&entry.key, &place, "machine", MAX_STAGE_NAME, "_-");
        let mut table = self.table(entry, "[machine.robot]").unwrap_or_default();
        let mut endpoints = |reader: &mut Self, key| table.take(key).and_then(|entry| reader.strings(&entry));
        let listen = endpoints(self, "listen").unwrap_or_default();
        let connect = endpoints(self, "connect").unwrap_or_default();
        let zenoh = table.take("zenoh").and_then(|entry| self.existing_file(&entry));
        let insecure = table.take("insecure").and_then(|entry| self.boolean(&entry)).unwrap_or_default();
        let outage_s = table.take("outage_s").and_then(|entry| self.seconds(&entry));
        self.unknown_keys(&table, &MACHINE_KEYS, &owner);
        let machine = Machine { listen, connect, zenoh, insecure, outage_s };
        if let Err(error) = settings::check(&machine) {
            self.fault(&place, format!("{owner}: {}", error.what), error.hint);
        }
        machine
    }

    fn boolean(&mut self, entry: &Entry) -> Option<bool> {
        if let Content::Boolean(said) = entry.value.content {
            return Some(said);
        }
        let what = format!("`{}` wants true or false, this is {}", entry.key, entry.value.type_name());
        self.fault(&entry.value.place, what, format!("for example {} = true", entry.key));
        None
    }

    fn seconds(&mut self, entry: &Entry) -> Option<f64> {
        let seconds = match entry.value.content {
            Content::Integer(seconds) => seconds as f64,
            Content::Float(seconds) => seconds,
            _ => f64::NAN,
        };
        if (0.0..=MAX_OUTAGE_S).contains(&seconds) {
            return Some(seconds);
        }
        let what = format!("`{}` wants seconds, from 0 to {MAX_OUTAGE_S}", entry.key);
        self.fault(&entry.value.place, what, "how long lossless edges wait for a machine that has gone");
        None
    }

    fn existing_file(&mut self, entry: &Entry) -> Option<PathBuf> {
        let path = self.base.join(self.string(entry)?);
        if !path.is_file() {
            let hint = "paths are relative to the pipeline file";
            self.fault(&entry.value.place, format!("there is no file `{}`", path.display()), hint);
        }
        Some(path)
    }

    fn stages(&mut self, entry: Entry) -> Vec<StageSpec> {
        let table = self.table(entry, "[stage.source]").unwrap_or_default();
        table.0.into_iter().filter_map(|entry| self.stage(entry)).collect()
    }

    fn stage(&mut self, entry: Entry) -> Option<StageSpec> {
        let (name, place) = (entry.key.clone(), entry.key_place.clone());
        self.check_name(&name, &place, "stage", MAX_STAGE_NAME, "_-");
        let mut table = self.table(entry, "[stage.source]")?;
        let place_of = |key| table.get(key).map(|entry| entry.value.place.clone());
        let [input_place, output_place, machine_place] = ["input", "output", "machine"].map(place_of);
        let program = self.program(&mut table, &name, &place);
        let input = table.take("input").and_then(|entry| self.input(&entry.value, Pick::Latest, Delivery::Latest));
        let driving = input.as_ref().map_or(Delivery::Latest, |input| input.delivery);
        let inputs = table.take("inputs").map(|entry| self.inputs(entry, &program, driving)).unwrap_or_default();
        let output = table.take("output").and_then(|entry| self.topic_name(&entry));
        let machine = table.take("machine").and_then(|entry| self.string(&entry));
        let restart = table.take("restart").and_then(|entry| self.word(&entry, RESTARTS)).unwrap_or_default();
        let env = table.take("env").map(|entry| self.env(entry)).unwrap_or_default();
        self.parameters(&table, &program, &name, &place);
        let parameters = table.to_json();
        Some(StageSpec {
            name,
            program,
            input,
            inputs,
            output,
            machine,
            restart,
            env,
            parameters,
            place,
            input_place,
            output_place,
            machine_place,
        })
    }

    fn program(&mut self, table: &mut Table, stage: &str, place: &Place) -> Program {
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
        if let Some(node) = self.nodes.iter().find(|node| node.name == name) {
            return Program::Node(*node);
        }
        let hint = suggestion(&name, self.nodes.iter().map(|node| node.name), "nodes");
        self.fault(&entry.value.place, format!("there is no node `{name}`"), hint);
        Program::Unknown
    }

    fn command(&mut self, entry: &Entry) -> Program {
        let Some(mut command) = self.strings(entry) else { return Program::Unknown };
        let Some(program) = command.first_mut() else {
            self.fault(&entry.value.place, "`program` is empty", "for example program = [\"./my_stage\", \"--flag\"]");
            return Program::Unknown;
        };
        let place =
            if let Content::Array(values) = &entry.value.content { &values[0].place } else { &entry.value.place };
        match find_program(self.base, program) {
            Some(path) if is_executable(&path) => *program = path.to_string_lossy().into_owned(),
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

    fn topic_name(&mut self, entry: &Entry) -> Option<String> {
        let name = self.string(entry)?;
        self.check_name(&name, &entry.value.place, "topic", MAX_TOPIC_NAME, "_-/");
        Some(name)
    }

    /// An input in its short or its long form; `pick` and `delivery` set what is not said.
    fn input(&mut self, value: &Value, pick: Pick, delivery: Delivery) -> Option<Input> {
        let place = value.place.clone();
        let said = match &value.content {
            Content::String(topic) => SaidInput { topic: topic.clone(), ..SaidInput::default() },
            Content::Table(table) => self.long_input(table.clone(), &place)?,
            _ => {
                let what = format!("an input is a topic or a table, this is {}", value.type_name());
                self.fault(&place, what, "\"depth\" or { topic = \"depth\", delivery = \"lossless\", queue = 4 }");
                return None;
            }
        };
        let delivery = said.delivery.unwrap_or(delivery);
        let default_queue = match (delivery, pick) {
            (Delivery::Lossless, _) => QUEUE_LOSSLESS,
            (Delivery::Latest, Pick::SameFrame) => QUEUE_SAME_FRAME,
            (Delivery::Latest, Pick::Latest) => QUEUE_LATEST,
        };
        // Two places keep the last frame beside the message that ends the stream.
        let queue = said.queue.unwrap_or(default_queue).max(2);
        let SaidInput { topic, kind, compression, .. } = said;
        Some(Input { topic, delivery, queue, kind, compression, place })
    }

    fn long_input(&mut self, mut table: Table, place: &Place) -> Option<SaidInput> {
        let topic = table.take("topic").and_then(|entry| self.string(&entry));
        let delivery = table.take("delivery").and_then(|entry| self.word(&entry, DELIVERIES));
        let queue = table.take("queue").and_then(|entry| self.queue(&entry));
        let kind = table.take("kind").and_then(|entry| self.word(&entry, KINDS.map(|kind| (kind.name(), kind))));
        let compression = table.take("compression").and_then(|entry| self.word(&entry, COMPRESSIONS));
        self.unknown_keys(&table, &INPUT_KEYS, "the input");
        if topic.is_none() {
            self.fault(place, "the input has no topic", "for example { topic = \"depth\", delivery = \"lossless\" }");
        }
        Some(SaidInput { topic: topic?, delivery, queue, kind, compression })
    }

    /// The meaning of one of a few words.
    fn word<T: Copy, const N: usize>(&mut self, entry: &Entry, words: [(&str, T); N]) -> Option<T> {
        let word = self.string(entry)?;
        let meaning = words.iter().find(|(known, _)| *known == word).map(|(_, meaning)| *meaning);
        if meaning.is_none() {
            let hint = suggestion(&word, words.map(|(known, _)| known), "allowed");
            self.fault(&entry.value.place, format!("`{}` cannot be `{word}`", entry.key), hint);
        }
        meaning
    }

    fn queue(&mut self, entry: &Entry) -> Option<usize> {
        match entry.value.content {
            Content::Integer(length @ 1..=MAX_QUEUE) => usize::try_from(length).ok(),
            _ => {
                let what = match entry.value.content {
                    Content::Integer(length) => format!("`queue` is {length}, allowed is from 1 to {MAX_QUEUE}"),
                    _ => format!("`queue` wants an integer, this is {}", entry.value.type_name()),
                };
                self.fault(&entry.value.place, what, "how many messages wait for this input at most");
                None
            }
        }
    }

    fn inputs(&mut self, entry: Entry, program: &Program, driving: Delivery) -> Vec<(String, Input)> {
        let table = self.table(entry, "inputs = { depth = \"depth\" }").unwrap_or_default();
        let mut inputs = Vec::new();
        for entry in table.0 {
            let pick = self.pick_of(&entry, program);
            let default = if pick == Pick::SameFrame { driving } else { Delivery::Latest };
            inputs.extend(self.input(&entry.value, pick, default).map(|input| (entry.key, input)));
        }
        inputs
    }

    /// Which message of a further input a node wants; a fault if it has no such input.
    fn pick_of(&mut self, entry: &Entry, program: &Program) -> Pick {
        let Program::Node(node) = program else { return Pick::Latest };
        if let Some(side) = node.sides().iter().find(|side| side.name == entry.key) {
            return side.pick;
        }
        let hint = suggestion(&entry.key, node.sides().iter().map(|side| side.name), "further inputs");
        self.fault(&entry.key_place, format!("node `{}` has no further input `{}`", node.name, entry.key), hint);
        Pick::Latest
    }

    fn env(&mut self, entry: Entry) -> Vec<(String, String)> {
        let table = self.table(entry, "env = { RUST_LOG = \"debug\" }").unwrap_or_default();
        table.0.iter().filter_map(|entry| Some((entry.key.clone(), self.string(entry)?))).collect()
    }

    /// Checks the keys that are left: those of the node.
    fn parameters(&mut self, table: &Table, program: &Program, stage: &str, place: &Place) {
        let Program::Node(node) = program else { return };
        let found = schema::check_table(table, &node.schema(), &STAGE_KEYS, &format!("stage `{stage}`"));
        if !found.is_empty() {
            self.faults.extend(found);
            return;
        }
        match (node.check)(table.to_json(), self.base) {
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

/// Whether the table has an entry that most likely means `key`.
fn is_misspelt(key: &str, table: &Table) -> bool {
    table.0.iter().any(|entry| closest(&entry.key, [key]).is_some())
}

/// A program by a path, relative to the pipeline file, or by a name in PATH.
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
