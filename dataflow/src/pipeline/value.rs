//! A TOML document as a tree in which every key and value has its position, and which `--set` can change.

use super::diagnostic::{Diagnostic, SourceSpan, SourceText};
use std::collections::BTreeSet;
use std::ops::Range;
use std::sync::Arc;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

/// The command line option that sets a parameter.
const OVERRIDE: &str = "--set";
/// Keys of a stage that stay when it gets another node.
const KEYS_OF_ANY_STAGE: [&str; 6] = ["input", "inputs", "output", "machine", "restart", "env"];

/// A value and its position.
#[derive(Clone, Debug)]
pub(crate) struct Value {
    pub(crate) content: Content,
    pub(crate) place: SourceSpan,
}

/// Content of a value.
#[derive(Clone, Debug)]
pub(crate) enum Content {
    String(String),
    Integer(i64),
    Float(f64),
    Boolean(bool),
    Datetime(String),
    Array(Vec<Value>),
    Table(Table),
}

/// The entries of a table, in the order of the text.
#[derive(Clone, Debug, Default)]
pub(crate) struct Table(pub(crate) Vec<Entry>);

/// A key with its value.
#[derive(Clone, Debug)]
pub(crate) struct Entry {
    pub(crate) key: String,
    pub(crate) key_place: SourceSpan,
    pub(crate) value: Value,
}

impl Table {
    pub(crate) fn get(&self, key: &str) -> Option<&Entry> {
        self.0.iter().find(|entry| entry.key == key)
    }

    /// Removes an entry and returns it.
    pub(crate) fn take(&mut self, key: &str) -> Option<Entry> {
        let index = self.0.iter().position(|entry| entry.key == key)?;
        Some(self.0.remove(index))
    }

    fn set(&mut self, path: &[&str], key_place: &SourceSpan, value: Value) {
        let Some((first, rest)) = path.split_first() else { return };
        if rest.is_empty() {
            self.take(first);
            self.0.push(Entry { key: (*first).to_owned(), key_place: key_place.clone(), value });
            return;
        }
        if !matches!(self.get(first), Some(Entry { value: Value { content: Content::Table(_), .. }, .. })) {
            let before = self.take(first);
            let mut table = Self::default();
            // `input = "depth"` is short for `input = { topic = "depth" }`.
            if *first == "input"
                && let Some(topic) = before.filter(|entry| entry.value.as_str().is_some())
            {
                table.0.push(Entry { key: "topic".to_owned(), ..topic });
            }
            let table = Value { content: Content::Table(table), place: key_place.clone() };
            self.0.push(Entry { key: (*first).to_owned(), key_place: key_place.clone(), value: table });
        }
        let entry = self.0.iter_mut().find(|entry| entry.key == *first);
        if let Some(table) = entry.and_then(|entry| entry.value.table_mut()) {
            table.set(rest, key_place, value);
        }
    }

    /// Removes the parameters of a stage's node if the stage gets another node, which does not know them.
    fn forget_other_node(&mut self, stage: &str, node: &str) {
        let stages = self.0.iter_mut().filter(|entry| entry.key == "stage").flat_map(|entry| entry.value.table_mut());
        let stage = stages.flat_map(|stages| &mut stages.0).find(|entry| entry.key == stage);
        let Some(keys) = stage.and_then(|entry| entry.value.table_mut()) else { return };
        let same = keys.get("node").is_some_and(|entry| entry.value.as_str() == Some(node));
        if !same {
            keys.0.retain(|entry| KEYS_OF_ANY_STAGE.contains(&entry.key.as_str()));
        }
    }

    /// Converts the table to JSON, without the positions in the file.
    pub(crate) fn to_json(&self) -> serde_json::Value {
        let entries = self.0.iter().map(|entry| (entry.key.clone(), entry.value.to_json()));
        serde_json::Value::Object(entries.collect())
    }
}

impl Value {
    fn table_mut(&mut self) -> Option<&mut Table> {
        if let Content::Table(table) = &mut self.content { Some(table) } else { None }
    }

    /// A value without a position in a file.
    pub(crate) fn without_place(value: &serde_json::Value) -> Self {
        use serde_json::Value as Json;
        let nowhere = || SourceSpan { source: Arc::default(), span: 0..0 };
        let entry = |(key, value): (&String, &Json)| Entry {
            key: key.clone(),
            key_place: nowhere(),
            value: Self::without_place(value),
        };
        let content = match value {
            Json::Null => Content::Float(f64::NAN),
            Json::Bool(truth) => Content::Boolean(*truth),
            Json::Number(number) => {
                number.as_i64().map_or_else(|| Content::Float(number.as_f64().unwrap_or(f64::NAN)), Content::Integer)
            }
            Json::String(text) => Content::String(text.clone()),
            Json::Array(values) => Content::Array(values.iter().map(Self::without_place).collect()),
            // TOML has no null: an absent value has its default.
            Json::Object(entries) => {
                Content::Table(Table(entries.iter().filter(|(_, value)| !value.is_null()).map(entry).collect()))
            }
        };
        Self { content, place: nowhere() }
    }

    /// Name of its type in errors.
    pub(crate) fn type_name(&self) -> &'static str {
        match self.content {
            Content::String(_) => "a string",
            Content::Integer(_) => "an integer",
            Content::Float(number) if !number.is_finite() => "a number out of range",
            Content::Float(_) => "a number",
            Content::Boolean(_) => "a boolean",
            Content::Datetime(_) => "a date",
            Content::Array(_) => "an array",
            Content::Table(_) => "a table",
        }
    }

    pub(crate) fn as_str(&self) -> Option<&str> {
        if let Content::String(text) = &self.content { Some(text) } else { None }
    }

    /// Hint with the value in quotes, for a number, a date or the like that was meant as text.
    pub(crate) fn quoted(&self) -> Option<String> {
        if matches!(self.content, Content::String(_) | Content::Array(_) | Content::Table(_)) {
            return None;
        }
        let SourceSpan { source, span } = &self.place;
        let (key, text) = (&source.text[..span.start], source.text[span.clone()].trim());
        Some(match source.name.as_str() {
            OVERRIDE => format!("text goes in quotes: {OVERRIDE} '{key}\"{text}\"'"),
            _ => format!("text goes in quotes: \"{text}\""),
        })
    }

    /// Converts the value to JSON, without the positions in the file.
    pub(crate) fn to_json(&self) -> serde_json::Value {
        match &self.content {
            Content::String(text) | Content::Datetime(text) => text.as_str().into(),
            Content::Integer(number) => (*number).into(),
            Content::Float(number) => (*number).into(),
            Content::Boolean(truth) => (*truth).into(),
            Content::Array(values) => values.iter().map(Self::to_json).collect(),
            Content::Table(table) => table.to_json(),
        }
    }
}

/// Parses a whole document; syntax errors are reported, and their entries left out.
pub(crate) fn parse(source: &Arc<SourceText>, faults: &mut Vec<Diagnostic>) -> Table {
    let (document, errors) = DeTable::parse_recoverable(&source.text);
    let mut spoilt = BTreeSet::new();
    for error in &errors {
        let span = error.span().unwrap_or(0..0);
        // An error spoils the rest of its table: further errors there are mostly consequences.
        if spoilt.insert(table_start(&source.text, span.start)) {
            faults.push(syntax_fault(source, span, error.message()));
        }
    }
    convert_table(source, document.get_ref())
}

/// Offset of the table that the text at `offset` belongs to: the last line that opens one.
fn table_start(text: &str, offset: usize) -> usize {
    let lines = text.split_inclusive('\n').scan(0, |end, line| {
        let start = *end;
        *end += line.len();
        Some((start, line))
    });
    let headers =
        lines.take_while(|(start, _)| *start <= offset).filter(|(_, line)| line.trim_start().starts_with('['));
    headers.last().map_or(0, |(start, _)| start)
}

fn syntax_fault(source: &Arc<SourceText>, span: Range<usize>, message: &str) -> Diagnostic {
    let hint = match message {
        "duplicate key" => "each key stands once in its table, and each stage has a name of its own",
        _ if message.contains("array") => "an array ends with `]`, and commas stand between what is in it",
        _ => "the file is not valid TOML here; strings stand in quotes, tables in [brackets]",
    };
    Diagnostic::error(&SourceSpan { source: Arc::clone(source), span }, message, hint)
}

fn convert_table(source: &Arc<SourceText>, table: &DeTable<'_>) -> Table {
    let mut entries: Vec<_> = table
        .iter()
        .map(|(key, value)| Entry {
            key: key.get_ref().to_string(),
            key_place: SourceSpan { source: Arc::clone(source), span: key.span() },
            value: convert(source, value),
        })
        .collect();
    entries.sort_by_key(|entry| entry.key_place.span.start);
    Table(entries)
}

fn convert(source: &Arc<SourceText>, value: &Spanned<DeValue<'_>>) -> Value {
    let content = match value.get_ref() {
        DeValue::String(text) => Content::String(text.to_string()),
        DeValue::Integer(number) => {
            i64::from_str_radix(number.as_str(), number.radix()).map_or(Content::Float(f64::INFINITY), Content::Integer)
        }
        DeValue::Float(number) => Content::Float(number.as_str().parse().unwrap_or(f64::NAN)),
        DeValue::Boolean(truth) => Content::Boolean(*truth),
        DeValue::Datetime(date) => Content::Datetime(date.to_string()),
        DeValue::Array(values) => Content::Array(values.iter().map(|value| convert(source, value)).collect()),
        DeValue::Table(table) => Content::Table(convert_table(source, table)),
    };
    Value { content, place: SourceSpan { source: Arc::clone(source), span: value.span() } }
}

/// Applies `STAGE.KEY=VALUE` to a document. A value that is not TOML is taken as a string, so that quotes need not be escaped in
/// a shell.
pub(crate) fn apply_override(document: &mut Table, text: &str, faults: &mut Vec<Diagnostic>) {
    let source = Arc::new(SourceText { name: OVERRIDE.to_owned(), text: text.to_owned() });
    let whole = SourceSpan { source: Arc::clone(&source), span: 0..text.len() };
    let path_and_value = text.split_once('=').map(|(path, value)| (path.split('.').map(str::trim).collect(), value));
    let Some((path, value)): Option<(Vec<_>, _)> = path_and_value.filter(|(path, _): &(Vec<_>, _)| path.len() >= 2)
    else {
        let what = "`--set` wants STAGE.KEY=VALUE";
        faults.push(Diagnostic::error(&whole, what, "for example --set source.rate_hz=10"));
        return;
    };
    let stage = path[0];
    let known = document.get("stage").and_then(|entry| match &entry.value.content {
        Content::Table(stages) => stages.get(stage),
        _ => None,
    });
    if known.is_none() {
        let names: Vec<&str> = stage_names(document);
        let hint = super::diagnostic::suggestion(stage, names.iter().copied(), "stages");
        faults.push(Diagnostic::error(&whole, format!("there is no stage `{stage}`"), hint));
        return;
    }
    let offset = text.len() - value.len();
    let content = override_value(&source, value);
    let place = SourceSpan { source, span: offset..text.len() };
    if let ([_, "node"], Content::String(node)) = (path.as_slice(), &content) {
        document.forget_other_node(stage, node);
    }
    let full: Vec<&str> = std::iter::once("stage").chain(path.iter().copied()).collect();
    document.set(&full, &whole, Value { content, place });
}

fn stage_names(document: &Table) -> Vec<&str> {
    match document.get("stage").map(|entry| &entry.value.content) {
        Some(Content::Table(stages)) => stages.0.iter().map(|entry| entry.key.as_str()).collect(),
        _ => Vec::new(),
    }
}

fn override_value(source: &Arc<SourceText>, text: &str) -> Content {
    match DeValue::parse(text.trim()) {
        Ok(value) => convert(source, &value).content,
        Err(_) => Content::String(text.trim().to_owned()),
    }
}
