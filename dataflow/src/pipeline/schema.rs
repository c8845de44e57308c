//! Checks a node's parameters against the JSON schema of its configuration, and reports the position of each fault.
//!
//! The schema is generated from the configuration's type, which is the only source of names, types, ranges, defaults and
//! descriptions.

use super::diagnostic::{Diagnostic, SourceSpan, closest, suggestion};
use super::value::{Content, Table, Value};
use conicflow_messages::Hinted;
use schemars::JsonSchema;
use serde_json::Value as Json;

/// Checks the entries of `table` against the object schema `schema`; `owner` names the owner of the parameters. `reserved` are
/// keys that were read before, which an unknown key may misspell.
pub(crate) fn check_table(table: &Table, schema: &Json, reserved: &[&str], owner: &str) -> Vec<Diagnostic> {
    let mut checker = Checker { root: schema, faults: Vec::new() };
    checker.table(table, schema, reserved, owner);
    checker.faults
}

/// Returns the first fault of a value against the schema of `T`: a name, a type or a range. The value has the form of one in a
/// pipeline file, but comes from elsewhere, such as a Python program, where it is called `name`.
pub fn value_fault<T: JsonSchema>(name: &str, value: &Json) -> Option<Hinted> {
    fault_by(&schema_of::<T>(), name, value)
}

/// Returns the first fault of a value against a schema; errors call the value `name`.
pub(crate) fn fault_by(schema: &Json, name: &str, value: &Json) -> Option<Hinted> {
    let mut checker = Checker { root: schema, faults: Vec::new() };
    checker.value(name, &Value::without_place(value), schema);
    let Diagnostic { what, hint, .. } = checker.faults.into_iter().next()?;
    Some(Hinted::new(what, hint))
}

/// The JSON schema of a type.
pub(crate) fn schema_of<T: JsonSchema>() -> Json {
    schemars::SchemaGenerator::default().into_root_schema_for::<T>().to_value()
}

struct Checker<'a> {
    root: &'a Json,
    faults: Vec<Diagnostic>,
}

impl<'a> Checker<'a> {
    fn fault(&mut self, place: &SourceSpan, what: String, hint: String) {
        self.faults.push(Diagnostic::error(place, what, hint));
    }

    /// Resolves a schema that only refers to another one.
    fn resolve(&self, schema: &'a Json) -> &'a Json {
        let target = schema.get("$ref").and_then(Json::as_str).and_then(|reference| {
            let path = reference.strip_prefix('#')?;
            self.root.pointer(path)
        });
        target.unwrap_or(schema)
    }

    fn table(&mut self, table: &Table, schema: &'a Json, reserved: &[&str], owner: &str) {
        let properties = schema.get("properties").and_then(Json::as_object);
        // schema of all values, for a map with free keys
        let any = schema.get("additionalProperties").filter(|any| any.is_object());
        if properties.is_none() && schema.get("additionalProperties").is_none() {
            return; // a table of any content
        }
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

    fn missing(&mut self, place: &SourceSpan, table: &Table, schema: &'a Json, owner: &str) {
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
            let number = format!("{number:?}"); // `1e308` in place of 309 digits, but `65.0`, too
            let number = number.trim_end_matches(".0");
            self.fault(&value.place, format!("`{key}` is {number}, allowed is {allowed}"), described);
        }
    }

    /// The schemas that a property may match: the branches of a choice, or the schema itself.
    fn alternatives(&self, property: &'a Json) -> Vec<&'a Json> {
        let property = self.resolve(property);
        let branches = property.get("anyOf").or_else(|| property.get("oneOf")).and_then(Json::as_array);
        match branches {
            Some(branches) => branches.iter().flat_map(|branch| self.alternatives(branch)).collect(),
            None => vec![property],
        }
    }
}

/// Description of a parameter, with its default; the hint for all faults of its value.
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

#[cfg(test)]
mod tests {
    use super::*;
    use serde_json::json;

    #[derive(JsonSchema)]
    #[expect(dead_code, reason = "its schema alone is looked at")]
    struct Limits {
        /// How many.
        #[schemars(range(min = 1, max = 64))]
        count: Option<u32>,
        inner: Inner,
        anything: Option<Json>,
    }

    #[derive(JsonSchema)]
    #[expect(dead_code, reason = "its schema alone is looked at")]
    struct Inner {
        word: String,
    }

    #[test]
    fn a_value_from_elsewhere_is_checked_as_one_of_a_file() {
        let fault = |value: Json| value_fault::<Limits>("limits", &value).map(|fault| fault.what);
        for good in [
            json!({ "count": 64, "inner": { "word": "a" } }),
            json!({ "count": null, "inner": { "word": "" } }),
            json!({ "inner": { "word": "" }, "anything": { "one": [2, { "three": 4.0 }] } }),
        ] {
            assert_eq!(fault(good), None);
        }
        for (wrong, told) in [
            (json!(7), "`limits` wants a table, this is an integer"),
            (json!({ "count": 65, "inner": { "word": "a" } }), "`count` is 65, allowed is from 1 to 64"),
            (json!({ "count": 1e30, "inner": { "word": "a" } }), "`count` wants an integer, this is a number"),
            (json!({ "cuont": 1, "inner": { "word": "a" } }), "unknown key `cuont` in `limits`"),
            (json!({ "inner": {} }), "`inner` lacks `word`"),
            (json!({ "inner": { "word": [] } }), "`word` wants a string, this is an array"),
        ] {
            assert_eq!(fault(wrong).as_deref(), Some(told));
        }
        let told = value_fault::<Limits>("limits", &json!({ "count": 0 })).unwrap();
        assert_eq!(told.hint, "How many.");
    }
}
