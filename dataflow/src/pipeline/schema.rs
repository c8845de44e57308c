//! Checks a node's parameters against the JSON schema of its configuration, and says where each fault stands.
//!
//! The schema comes from the configuration's type, so that names, types, ranges, defaults and descriptions have one home.

use super::diagnostic::{Diagnostic, Place, closest, suggestion};
use super::value::{Content, Table, Value};
use serde_json::Value as Json;

/// Checks the entries of `table` against the object schema `schema`; `owner` names whose parameters they are.
/// `reserved` are keys that have been read already, and may have been misspelt.
pub(crate) fn check_table(table: &Table, schema: &Json, reserved: &[&str], owner: &str) -> Vec<Diagnostic> {
    let mut checker = Checker { root: schema, faults: Vec::new() };
    checker.table(table, schema, reserved, owner);
    checker.faults
}

struct Checker<'a> {
    root: &'a Json,
    faults: Vec<Diagnostic>,
}

impl<'a> Checker<'a> {
    fn fault(&mut self, place: &Place, what: String, hint: String) {
        self.faults.push(Diagnostic::error(place, what, hint));
    }

    /// The schema itself where `schema` only refers to it.
    fn resolve(&self, schema: &'a Json) -> &'a Json {
        let target = schema.get("$ref").and_then(Json::as_str).and_then(|reference| {
            let path = reference.strip_prefix('#')?;
            self.root.pointer(path)
        });
        target.unwrap_or(schema)
    }

    fn table(&mut self, table: &Table, schema: &'a Json, reserved: &[&str], owner: &str) {
        let properties = schema.get("properties").and_then(Json::as_object);
        // of a map, whose keys are free, the schema of all values
        let any = schema.get("additionalProperties").filter(|any| any.is_object());
        for entry in &table.0 {
            if let Some(property) = properties.and_then(|properties| properties.get(&entry.key)).or(any) {
                self.value(&entry.key, &entry.value, property);
                continue;
            }
            let names: Vec<&str> =
                properties.into_iter().flat_map(|properties| properties.keys().map(String::as_str)).collect();
            let hint = match closest(&entry.key, names.iter().chain(reserved).copied()) {
                Some(name) => format!("did you mean `{name}`?"),
                None => suggestion(&entry.key, names.iter().copied(), "parameters"),
            };
            self.fault(&entry.key_place, format!("unknown key `{}` in {owner}", entry.key), hint);
        }
    }

    fn missing(&mut self, place: &Place, table: &Table, schema: &'a Json, owner: &str) {
        for name in schema.get("required").and_then(Json::as_array).into_iter().flatten().filter_map(Json::as_str) {
            if table.get(name).is_none() {
                self.fault(place, format!("{owner} lacks `{name}`"), format!("add `{name} = ..`"));
            }
        }
    }

    fn value(&mut self, key: &str, value: &Value, property: &'a Json) {
        let described = describe(property);
        let alternatives = self.alternatives(property);
        let fitting: Vec<_> = alternatives.iter().copied().filter(|schema| fits_type(value, schema)).collect();
        if fitting.is_empty() {
            let what = format!("`{key}` wants {}, this is {}", expected(&alternatives), value.type_name());
            let is_text = |kind: &str| kind == "string" || kind == "null";
            let is_free_text =
                |schema: &Json| type_names(schema).into_iter().all(is_text) && allowed_words(schema).is_empty();
            let wants_text = alternatives.iter().all(|schema| is_free_text(schema));
            let hint = value.quoted().filter(|_| wants_text).map(|quoted| format!("{quoted}; {described}"));
            return self.fault(&value.place, what, hint.unwrap_or(described));
        }
        let words: Vec<&str> = fitting.iter().flat_map(|schema| allowed_words(schema)).collect();
        if let (Some(word), false) = (value.as_str(), words.is_empty()) {
            if !words.contains(&word) {
                let what = format!("`{key}` cannot be `{word}`");
                self.fault(&value.place, what, suggestion(word, words.iter().copied(), "allowed"));
            }
            return;
        }
        self.content(key, value, fitting[0], described);
    }

    fn content(&mut self, key: &str, value: &Value, schema: &'a Json, described: String) {
        match &value.content {
            Content::Table(table) => {
                self.table(table, schema, &[], &format!("`{key}`"));
                self.missing(&value.place, table, schema, &format!("`{key}`"));
            }
            Content::Array(values) => {
                if let Some(items) = schema.get("items") {
                    values.iter().for_each(|value| self.value(key, value, items));
                }
            }
            Content::Integer(number) => self.range(key, value, *number as f64, schema, described),
            Content::Float(number) => self.range(key, value, *number, schema, described),
            _ => {}
        }
    }

    fn range(&mut self, key: &str, value: &Value, number: f64, schema: &Json, described: String) {
        let bound = |name: &str| schema.get(name).and_then(Json::as_f64);
        let (low, high) = (bound("minimum"), bound("maximum"));
        let inside = number.is_finite()
            && low.is_none_or(|low| number >= low)
            && high.is_none_or(|high| number <= high)
            && bound("exclusiveMinimum").is_none_or(|low| number > low);
        if !inside {
            let allowed = match (low, bound("exclusiveMinimum"), high) {
                (_, Some(below), Some(high)) => format!("more than {below}, up to {high}"),
                (_, Some(below), None) => format!("more than {below}"),
                (Some(low), None, Some(high)) => format!("from {low} to {high}"),
                (Some(low), None, None) => format!("{low} or more"),
                (None, None, Some(high)) => format!("up to {high}"),
                (None, None, None) => "a finite number".to_owned(),
            };
            self.fault(&value.place, format!("`{key}` is {number}, allowed is {allowed}"), described);
        }
    }

    /// What a property may be: the branches of a choice, or the schema alone.
    fn alternatives(&self, property: &'a Json) -> Vec<&'a Json> {
        let property = self.resolve(property);
        let branches = property.get("anyOf").or_else(|| property.get("oneOf")).and_then(Json::as_array);
        match branches {
            Some(branches) => branches.iter().flat_map(|branch| self.alternatives(branch)).collect(),
            None => vec![property],
        }
    }
}

/// What a parameter is for, and its default: the hint of all that is wrong with its value.
fn describe(property: &Json) -> String {
    let text = property.get("description").and_then(Json::as_str).unwrap_or("").replace('\n', " ");
    let default = property.get("default").filter(|default| !default.is_null());
    match default {
        Some(default) => format!("{} (default {default})", text.trim_end_matches('.')),
        None => text,
    }
}

fn type_names(schema: &Json) -> Vec<&str> {
    match schema.get("type") {
        Some(Json::String(name)) => vec![name],
        Some(Json::Array(names)) => names.iter().filter_map(Json::as_str).collect(),
        _ => Vec::new(),
    }
}

fn fits_type(value: &Value, schema: &Json) -> bool {
    let names = type_names(schema);
    if names.is_empty() {
        return schema.get("const").is_none() || value.as_str().is_some();
    }
    let fitting: &[&str] = match value.content {
        Content::String(_) => &["string"],
        Content::Integer(_) => &["integer", "number"],
        Content::Float(_) => &["number"],
        Content::Boolean(_) => &["boolean"],
        Content::Datetime(_) => &[],
        Content::Array(_) => &["array"],
        Content::Table(_) => &["object"],
    };
    names.iter().any(|name| fitting.contains(name))
}

fn expected(alternatives: &[&Json]) -> String {
    let mut words: Vec<&str> = Vec::new();
    for name in alternatives.iter().flat_map(|schema| type_names(schema)) {
        let word = match name {
            "string" => "a string",
            "integer" => "an integer",
            "number" => "a number",
            "boolean" => "true or false",
            "array" => "an array",
            "object" => "a table",
            _ => continue,
        };
        if !words.contains(&word) {
            words.push(word);
        }
    }
    words.join(" or ")
}

fn allowed_words(schema: &Json) -> Vec<&str> {
    let list = schema.get("enum").and_then(Json::as_array).into_iter().flatten();
    list.chain(schema.get("const")).filter_map(Json::as_str).collect()
}
