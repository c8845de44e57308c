//! Converts the tree of a pipeline file into stages: keys, types, nodes and their parameters.

pub(super) mod inputs;
pub(super) mod items;
pub(super) mod machines;
pub(super) mod metrics;
pub(super) mod stages;

use super::diagnostic::{Diagnostic, SourceSpan, SourceText, closest, suggestion};
use super::spec::Pipeline;
use super::value::{Content, Entry, Table};
use crate::item_type::{BUILT_IN, ItemType};
use crate::registry::Registry;
use std::ops::RangeInclusive;
use std::path::Path;
use std::sync::Arc;

/// Maximum length of the name of a pipeline, a stage or a machine, in bytes: headers have fields of fixed size for names, with a
/// terminating zero.
pub const MAX_STAGE_NAME: usize = 31;
/// Maximum length of the name of a topic, in bytes.
const MAX_TOPIC_NAME: usize = 63;
pub const PIPELINE_KEYS: [&str; 6] = ["name", "machine", "item", "stage", "metrics", "experiment"];

/// Reads a document; invalid entries are reported and left out.
pub(super) fn pipeline(
    mut document: Table,
    source: &Arc<SourceText>,
    context: &ReadContext<'_>,
    faults: &mut Vec<Diagnostic>,
) -> Pipeline {
    let start = SourceSpan { source: Arc::clone(source), span: 0..0 };
    let mut reader = Reader { context, elsewhere: false, items: Vec::new(), faults };
    let name = reader.name(&mut document, &start);
    reader.items = document.take("item").map(|entry| reader.items(entry)).unwrap_or_default();
    let machines = document.take("machine").map(|entry| reader.machines(entry)).unwrap_or_default();
    let metrics = document.take("metrics").and_then(|entry| reader.metrics(entry));
    let experiment = document.take("experiment").map(|entry| entry.value.to_json());
    let stages = document.take("stage").map(|entry| reader.stages(entry));
    reader.unknown_keys(&document, &PIPELINE_KEYS, "the pipeline");
    let stages = stages.unwrap_or_else(|| {
        reader.no_stages(&document, &start);
        Vec::new()
    });
    let (items, source) = (reader.items, Default::default());
    Pipeline { name, base: context.base.to_owned(), machines, items, stages, metrics, experiment, source }
}

/// Context in which a file is read.
pub(super) struct ReadContext<'a> {
    /// Folder of the file.
    pub base: &'a Path,
    /// The machine, where known.
    pub machine: Option<&'a str>,
    /// Nodes and network part that its stages may use.
    pub registry: &'a Registry,
}

struct Reader<'a> {
    context: &'a ReadContext<'a>,
    /// Whether the current table belongs to another machine, where alone its files can be checked.
    elsewhere: bool,
    /// The item types that the file describes.
    items: Vec<ItemType>,
    faults: &'a mut Vec<Diagnostic>,
}

impl Reader<'_> {
    /// Sets the machine to which the next table belongs.
    fn go_to(&mut self, machine: Option<&str>) {
        self.elsewhere = self.context.machine.is_some() && self.context.machine != machine;
    }

    fn fault(&mut self, place: &SourceSpan, what: impl Into<String>, hint: impl Into<String>) {
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

    fn boolean(&mut self, entry: &Entry) -> Option<bool> {
        if let Content::Boolean(value) = entry.value.content {
            return Some(value);
        }
        let what = format!("`{}` wants true or false, this is {}", entry.key, entry.value.type_name());
        self.fault(&entry.value.place, what, format!("for example {} = true", entry.key));
        None
    }

    /// Reads a time in seconds within a range; `what_for` is the hint.
    fn seconds(&mut self, entry: &Entry, range: RangeInclusive<f64>, what_for: &str) -> Option<f64> {
        let seconds = match entry.value.content {
            Content::Integer(seconds) => seconds as f64,
            Content::Float(seconds) => seconds,
            _ => f64::NAN,
        };
        if range.contains(&seconds) {
            return Some(seconds);
        }
        let what = format!("`{}` wants seconds, from {} to {}", entry.key, range.start(), range.end());
        self.fault(&entry.value.place, what, what_for);
        None
    }

    /// Reads the name of an item type.
    fn kind(&mut self, entry: &Entry) -> Option<String> {
        let kind = self.string(entry)?;
        let names: Vec<_> = BUILT_IN.iter().chain(&self.items).map(|item| item.name().to_owned()).collect();
        if !names.contains(&kind) {
            let hint = suggestion(&kind, names.iter().map(String::as_str), "allowed");
            self.fault(&entry.value.place, format!("`{}` cannot be `{kind}`", entry.key), hint);
            return None;
        }
        Some(kind)
    }

    /// Reads one of a few words, and returns its meaning.
    fn word<T: Copy, const N: usize>(&mut self, entry: &Entry, words: [(&str, T); N]) -> Option<T> {
        let word = self.string(entry)?;
        let meaning = words.iter().find(|(known, _)| *known == word).map(|(_, meaning)| *meaning);
        if meaning.is_none() {
            let hint = suggestion(&word, words.map(|(known, _)| known), "allowed");
            self.fault(&entry.value.place, format!("`{}` cannot be `{word}`", entry.key), hint);
        }
        meaning
    }

    fn table(&mut self, entry: Entry, example: &str) -> Option<Table> {
        if let Content::Table(table) = entry.value.content {
            return Some(table);
        }
        let what = format!("`{}` wants a table, this is {}", entry.key, entry.value.type_name());
        self.fault(&entry.value.place, what, format!("for example {example}"));
        None
    }

    /// Checks a name, which has to be usable in paths, ports and JSON.
    fn check_name(&mut self, name: &str, place: &SourceSpan, what: &str, longest: usize, allowed: &str) {
        let good = |c: char| c.is_ascii_alphanumeric() || allowed.contains(c);
        if name.is_empty() || name.len() > longest || !name.chars().all(good) {
            let hint = format!("1 to {longest} letters, digits or one of {allowed}");
            self.fault(place, format!("`{name}` cannot be the name of a {what}"), hint);
        }
    }

    fn name(&mut self, document: &mut Table, start: &SourceSpan) -> String {
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

    fn no_stages(&mut self, document: &Table, start: &SourceSpan) {
        if !is_misspelt("stage", document) {
            let hint = "add one, such as [stage.source] with `node` and `output`";
            self.fault(start, "the pipeline has no stages", hint);
        }
    }
}

/// Whether the table has an entry that is probably a misspelling of `key`.
fn is_misspelt(key: &str, table: &Table) -> bool {
    table.0.iter().any(|entry| closest(&entry.key, [key]).is_some())
}
