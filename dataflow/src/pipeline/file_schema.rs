//! The JSON schema of a pipeline file, with which editors complete and check it.
//!
//! Schemas of a node's parameters are generated from the types of their configurations; this module adds the keys of the file
//! itself. `conicflow validate` checks more: whether topics fit together, files exist, and endpoints can be used.

use super::read::MAX_STAGE_NAME;
use super::read::inputs::{COMPRESSIONS, DELIVERIES, MAX_QUEUE};
use super::read::items::USUAL_LENGTH;
use super::read::machines::OUTAGE_S;
use super::read::stages::{HANG_S, JOIN_S, RESTARTS, TIME_TO_JOIN_S};
use crate::item_type::BUILT_IN;
use crate::node::Node;
use conicflow_messages::{Item, Nothing};
use serde_json::{Map, Value as Json, json};

/// Key of the definitions in this schema.
const DEFINITIONS: &str = "definitions";
/// Key of the definitions in the schemas of nodes.
const OF_NODE: &str = "$defs";

/// Key of a stage that runs a program, and name of the schema of its table.
const PROGRAM: &str = "program";

/// Keys of the table of every stage; each is a definition of the same name.
const OF_EACH_STAGE: [&str; 3] = ["machine", "restart", "env"];

/// Schema of files whose stages may use these nodes.
pub fn file_schema<'a>(nodes: impl IntoIterator<Item = &'a Node>) -> Json {
    let mut definitions = of_stages();
    let nodes: Vec<&Node> = nodes.into_iter().collect();
    for node in &nodes {
        let schema = of_node(node, &mut definitions);
        definitions.insert(node.name.to_owned(), schema);
    }
    definitions.insert(PROGRAM.to_owned(), of_program());
    let names: Vec<_> = nodes.iter().map(|node| node.name).collect();
    json!({
        "$schema": "http://json-schema.org/draft-07/schema#",
        "title": "pipeline of conicflow",
        "type": "object",
        "required": ["name", "stage"],
        "additionalProperties": false,
        "properties": {
            "name": {
                "description": "Two pipelines of different names on one machine do not meet.",
                "type": "string", "pattern": format!("^[A-Za-z0-9_-]{{1,{MAX_STAGE_NAME}}}$"),
            },
            "stage": { "description": "The stages, each a process.", "type": "object", "additionalProperties": stage(&names) },
            "machine": {
                "description": "The machines, where there is more than one.",
                "type": "object", "additionalProperties": machine(),
            },
            "item": {
                "description": "Item types that only programs of one's own know.",
                "type": "object", "additionalProperties": item(),
            },
            "metrics": metrics("Where the metrics of the run are offered, ADDRESS:PORT in numbers; without it, nowhere."),
            "experiment": { "description": "What `conicflow run` varies and plots; stages do not see it.", "type": "object" },
        },
        DEFINITIONS: definitions,
    })
}

/// Schema of a stage. Its `node`, or the presence of `program`, selects the schema that it has to match, so that errors name the
/// actual fault. taplo, which editors use for completion, ignores `then`, but looks into each branch of a choice: so there is a
/// further choice, which every table matches.
fn stage(nodes: &[&str]) -> Json {
    let of_node =
        |name| json!({ "if": { "required": ["node"], "properties": { "node": { "const": name } } }, "then": to(name) });
    let one = json!({ "required": ["node"], "properties": { "node": { "enum": nodes } } });
    let either = json!({ "if": { "required": [PROGRAM] }, "then": to(PROGRAM), "else": one });
    let faults: Vec<_> = std::iter::once(either).chain(nodes.iter().map(|name| of_node(*name))).collect();
    let completions: Vec<_> =
        std::iter::once(json!({})).chain(nodes.iter().chain([&PROGRAM]).map(|name| to(name))).collect();
    json!({ "type": "object", "allOf": faults, "anyOf": completions })
}

/// Schema of a stage that is a node. Its definitions go into `definitions`, where nodes share equal ones.
fn of_node(node: &Node, definitions: &mut Map<String, Json>) -> Json {
    let mut schema = node.schema();
    without_null(&mut schema);
    let types = schema.clone();
    with_named_faults(&mut schema, &types);
    refer(&mut schema, &format!("#/{OF_NODE}/"), &format!("#/{DEFINITIONS}/"));
    let has_other = |(name, own): (&String, &Json)| definitions.get(name).is_some_and(|other| other != own);
    let mut prefix = String::new();
    if schema.get(OF_NODE).and_then(Json::as_object).is_some_and(|own| own.iter().any(has_other)) {
        prefix = format!("{}.", node.name);
        refer(&mut schema, &format!("#/{DEFINITIONS}/"), &format!("#/{DEFINITIONS}/{prefix}"));
    }
    if let Some(Json::Object(own)) = schema.get_mut(OF_NODE).map(Json::take) {
        definitions.extend(own.into_iter().map(|(name, schema)| (format!("{prefix}{name}"), schema)));
    }
    let mut properties = Map::new();
    properties.insert("node".to_owned(), json!({ "description": node.summary, "const": node.name }));
    if !node.is_source() {
        properties.insert("input".to_owned(), reference("input", "What drives the stage."));
    }
    let side_inputs: Map<_, _> =
        node.side_inputs().iter().map(|side| (side.name.to_owned(), reference("input", side.kind))).collect();
    if !side_inputs.is_empty() {
        let inputs = json!({ "type": "object", "properties": side_inputs, "additionalProperties": false });
        properties.insert("inputs".to_owned(), inputs);
    }
    if node.output() != Nothing::NAME {
        properties.insert("output".to_owned(), to("output"));
    }
    properties.extend(OF_EACH_STAGE.map(|key| (key.to_owned(), to(key))));
    if let Some(Json::Object(parameters)) = schema.get_mut("properties").map(Json::take) {
        properties.extend(parameters);
    }
    let title = node.name;
    json!({ "title": title, "type": "object", "required": ["node"], "properties": properties, "additionalProperties": false })
}

/// Schema of a stage that runs a program: further keys are the program's own.
fn of_program() -> Json {
    let mut properties = Map::new();
    let program = json!({
        "description": "The program with its arguments; with a slash its path is relative to the file.",
        "type": "array", "items": { "type": "string" }, "minItems": 1,
    });
    properties.insert(PROGRAM.to_owned(), program);
    properties.insert("input".to_owned(), reference("input", "What drives the stage."));
    let inputs = json!({ "description": "Side inputs.", "type": "object", "additionalProperties": to("input") });
    properties.insert("inputs".to_owned(), inputs);
    properties.insert("output".to_owned(), to("output"));
    properties.extend(OF_EACH_STAGE.map(|key| (key.to_owned(), to(key))));
    let not = json!({ "required": ["node"] });
    json!({ "title": PROGRAM, "type": "object", "required": [PROGRAM], "properties": properties, "not": not })
}

/// Definitions for the tables of stages.
fn of_stages() -> Map<String, Json> {
    let when = json!({ "type": "string", "enum": RESTARTS.map(|(word, _)| word), "default": "on_failure" });
    let hang_s = json!({
        "description": "Without a sign of life for so many seconds it is killed and started anew.",
        "type": "number", "minimum": HANG_S.start(), "maximum": HANG_S.end(),
    });
    let join_s = json!({
        "description": "Seconds after its start by which a program takes part in a lossless topic, else the run ends.",
        "type": "number", "minimum": JOIN_S.start(), "maximum": JOIN_S.end(), "default": TIME_TO_JOIN_S,
    });
    let properties = json!({ "when": when, "hang_s": hang_s, "join_s": join_s });
    let table = json!({ "type": "object", "additionalProperties": false, "properties": properties });
    let mut restart = json!({ "description": "When it is started anew.", "anyOf": [when, table] });
    by_type(&mut restart, &Json::Null);
    let env = json!({
        "description": "Environment variables of its process.",
        "type": "object", "additionalProperties": { "type": "string" },
    });
    let machine = json!({ "description": "The machine on which it runs.", "type": "string" });
    let all = [("input", input()), ("output", output()), ("machine", machine), ("restart", restart), ("env", env)];
    all.map(|(name, schema)| (name.to_owned(), schema)).into_iter().collect()
}

fn input() -> Json {
    let kinds: Vec<_> = BUILT_IN.iter().map(|item| item.name()).collect();
    json!({
        "description": "A topic, or a table that also says how it is read.",
        "type": ["string", "object"], "required": ["topic"], "additionalProperties": false,
        "properties": {
            "topic": { "type": "string" },
            "delivery": {
                "description": "The newest message, or all of them: then the writer waits.",
                "enum": DELIVERIES.map(|(word, _)| word), "default": "latest",
            },
            "queue": {
                "description": "How many messages wait at most.",
                "type": "integer", "minimum": 1, "maximum": MAX_QUEUE,
            },
            "kind": {
                "description": "What a program of one's own writes there.",
                "type": "string", "examples": kinds,
            },
            "compression": {
                "description": "Of images and long lists from another machine.",
                "enum": COMPRESSIONS.map(|(word, _)| word), "default": "zstd",
            },
        },
    })
}

fn output() -> Json {
    json!({
        "description": "The topic that it writes; of a program of one's own also what it writes there.",
        "type": ["string", "object"], "required": ["topic"], "additionalProperties": false,
        "properties": { "topic": { "type": "string" }, "kind": { "type": "string" } },
    })
}

fn machine() -> Json {
    let endpoints = |what: &str| json!({ "description": what, "type": "array", "items": { "type": "string" } });
    json!({
        "type": "object", "additionalProperties": false,
        "properties": {
            "listen": endpoints("Zenoh endpoints to listen on, such as `tcp/192.168.0.2:7447`; none: nothing listens."),
            "connect": endpoints("Zenoh endpoints to connect to."),
            "zenoh": { "description": "A Zenoh configuration that adds to ours.", "type": "string" },
            "key": {
                "description": "The file of the secret that all machines share, as `conicflow key` makes it: nothing else is \
                                believed.",
                "type": "string",
            },
            "insecure": {
                "description": "Whether an endpoint that others can reach may be open to everyone, who are then believed.",
                "type": "boolean", "default": false,
            },
            "outage_s": {
                "description": "Seconds that lossless edges from here wait for a machine that has gone.",
                "type": "number", "minimum": OUTAGE_S.start(), "maximum": OUTAGE_S.end(), "default": 30,
            },
            "metrics": metrics("Where this machine offers the metrics of the run, in place of what the file says for all."),
        },
    })
}

fn metrics(description: &str) -> Json {
    let address = json!({ "type": "string", "examples": ["127.0.0.1:9464"] });
    let token = json!({ "description": "What has to be known to read them.", "type": "string" });
    json!({
        "description": description, "type": ["string", "object"], "examples": address["examples"],
        "required": ["listen"], "additionalProperties": false,
        "properties": { "listen": address, "token": token },
    })
}

fn item() -> Json {
    json!({
        "type": "object", "required": ["type", "fields"], "additionalProperties": false,
        "properties": {
            "type": { "description": "Name and version of the layout, such as `acme.Grasp.v1`.", "type": "string" },
            "fields": {
                "description": "Fields in their order, such as `position = \"f64[3]\"`.",
                "type": "object", "additionalProperties": { "type": "string" }, "minProperties": 1,
            },
            "usual_length": {
                "description": "Items of a message, which few exceed.",
                "type": "integer", "minimum": USUAL_LENGTH.start(), "maximum": USUAL_LENGTH.end(),
            },
        },
    })
}

fn to(definition: &str) -> Json {
    json!({ "$ref": format!("#/{DEFINITIONS}/{definition}") })
}

fn reference(definition: &str, description: &str) -> Json {
    // Validators ignore keys beside a `$ref`, but not beside an `allOf` that contains one.
    json!({ "description": description, "allOf": [to(definition)] })
}

/// Removes `null` from types and choices: in TOML such a key is absent. If a choice has one branch left, errors name its actual
/// fault.
fn without_null(schema: &mut Json) {
    match schema {
        Json::Object(entries) => {
            entries.retain(|key, value| key != "default" || !value.is_null());
            if let Some(Json::Array(kinds)) = entries.get_mut("type") {
                kinds.retain(|kind| kind != "null");
                if let [kind] = &kinds[..] {
                    let kind = kind.clone();
                    entries.insert("type".to_owned(), kind);
                }
            }
            if let Some(Json::Array(branches)) = entries.get_mut("anyOf") {
                branches.retain(|branch| branch.get("type").is_none_or(|kind| kind != "null"));
                if branches.len() == 1
                    && let Some(branch) = entries.remove("anyOf")
                {
                    entries.insert("allOf".to_owned(), branch);
                }
            }
            entries.values_mut().for_each(without_null);
        }
        Json::Array(values) => values.iter_mut().for_each(without_null),
        _ => {}
    }
}

/// Rewrites choices so that errors name the faulty word or key; for a choice, a validator says only that no branch matches.
fn with_named_faults(schema: &mut Json, types: &Json) {
    words(schema);
    one_of_several_tables(schema);
    by_type(schema, types);
    match schema {
        Json::Object(entries) => entries.values_mut().for_each(|entry| with_named_faults(entry, types)),
        Json::Array(values) => values.iter_mut().for_each(|value| with_named_faults(value, types)),
        _ => {}
    }
}

/// Turns a choice of words into an `enum`. Their descriptions stay for editors, in a choice with a first branch that everything
/// matches.
fn words(schema: &mut Json) {
    let Some(branches) = schema.get("oneOf").and_then(Json::as_array) else { return };
    let words: Option<Vec<_>> = branches.iter().map(|branch| branch.get("const").cloned()).collect();
    if let (Some(words), Some(schema)) = (words, schema.as_object_mut()) {
        schema.insert("type".to_owned(), json!("string"));
        schema.insert("enum".to_owned(), json!(words));
        if let Some(Json::Array(mut meanings)) = schema.remove("oneOf") {
            meanings.insert(0, json!({}));
            schema.insert("anyOf".to_owned(), Json::Array(meanings));
        }
    }
}

/// Turns a choice of tables with one key each, all different, into one table with exactly one of these keys.
fn one_of_several_tables(schema: &mut Json) {
    let Some(branches) = schema.get("oneOf").and_then(Json::as_array) else { return };
    let properties =
        |branch: &Json| branch.get("properties").and_then(Json::as_object).filter(|all| all.len() == 1).cloned();
    let properties: Option<Vec<_>> = branches.iter().map(properties).collect();
    if let (Some(properties), Some(schema)) = (properties, schema.as_object_mut()) {
        schema.remove("oneOf");
        let properties: Map<_, _> = properties.into_iter().flatten().collect();
        let table = json!({
            "type": "object", "minProperties": 1, "maxProperties": 1, "additionalProperties": false, "properties": properties,
        });
        schema.extend(table.as_object().cloned().into_iter().flatten());
    }
}

/// Turns a choice between types into conditions: the branch of the value's type has to match. `types` resolves references. The
/// choice itself stays for editors, with a first branch that everything matches.
fn by_type(schema: &mut Json, types: &Json) {
    let Some(branches) = schema.get("anyOf").and_then(Json::as_array) else { return };
    let kinds: Option<Vec<_>> = branches.iter().map(|branch| type_of(branch, types)).collect();
    let is_clear = |kinds: &Vec<Json>| (1..kinds.len()).all(|index| !kinds[..index].contains(&kinds[index]));
    if let Some(kinds) = kinds.filter(is_clear) {
        let fits = |(kind, branch): (&Json, &Json)| json!({ "if": { "type": kind }, "then": branch });
        let faults: Vec<_> = kinds.iter().zip(branches).map(fits).collect();
        let branches: Vec<_> = std::iter::once(json!({})).chain(branches.iter().cloned()).collect();
        schema["anyOf"] = json!(branches);
        schema["allOf"] = json!(faults);
        schema["type"] = json!(kinds);
    }
}

/// The type of all values that match a schema, if there is only one.
fn type_of<'a>(schema: &'a Json, types: &'a Json) -> Option<Json> {
    if let Some(target) = schema.get("$ref").and_then(Json::as_str) {
        return type_of(types.pointer(target.strip_prefix('#')?)?, types);
    }
    let branches = schema.get("oneOf").and_then(Json::as_array);
    let of_first = || branches?.first().and_then(|branch| type_of(branch, types));
    schema.get("type").filter(|kind| kind.is_string()).cloned().or_else(of_first)
}

/// Replaces the prefix `old` of all references by `new`.
fn refer(schema: &mut Json, old: &str, new: &str) {
    match schema {
        Json::Object(entries) => {
            for (key, value) in entries {
                match value {
                    Json::String(target) if key == "$ref" => {
                        if let Some(name) = target.strip_prefix(old) {
                            *target = format!("{new}{name}");
                        }
                    }
                    _ => refer(value, old, new),
                }
            }
        }
        Json::Array(values) => values.iter_mut().for_each(|value| refer(value, old, new)),
        _ => {}
    }
}

#[cfg(test)]
mod tests {
    use super::super::read::PIPELINE_KEYS;
    use super::super::read::inputs::INPUT_KEYS;
    use super::super::read::items::ITEM_KEYS;
    use super::super::read::machines::MACHINE_KEYS;
    use super::super::read::metrics::METRICS_KEYS;
    use super::super::read::stages::STAGE_KEYS;
    use super::super::tests::{NODES, node};
    use super::*;
    use std::collections::BTreeSet;

    fn keys(schema: &Json, pointer: &str) -> BTreeSet<String> {
        schema.pointer(pointer).and_then(Json::as_object).unwrap().keys().cloned().collect()
    }

    #[test]
    fn the_keys_of_the_schema_are_those_that_are_read() {
        let schema = file_schema([]);
        let of = |keys: &[&str]| keys.iter().map(|key| (*key).to_owned()).collect::<BTreeSet<_>>();
        assert_eq!(keys(&schema, "/properties"), of(&PIPELINE_KEYS));
        assert_eq!(keys(&schema, "/properties/machine/additionalProperties/properties"), of(&MACHINE_KEYS));
        assert_eq!(keys(&schema, "/properties/metrics/properties"), of(&METRICS_KEYS));
        assert_eq!(keys(&schema, "/properties/item/additionalProperties/properties"), of(&ITEM_KEYS));
        assert_eq!(keys(&schema, "/definitions/input/properties"), of(&INPUT_KEYS));
        let mut of_program = keys(&schema, "/definitions/program/properties");
        assert!(of_program.insert("node".to_owned()));
        assert_eq!(of_program, of(&STAGE_KEYS));
    }

    #[test]
    fn what_may_be_nothing_is_a_key_that_may_be_left_out() {
        let mut schema = json!({ "properties": {
            "count": { "type": ["integer", "null"], "default": null },
            "size": { "anyOf": [{ "$ref": "#/$defs/size" }, { "type": "null" }], "default": null },
            "either": { "anyOf": [{ "type": "integer" }, { "type": "string" }, { "type": "null" }], "default": 5 },
            "pair": { "type": "array", "prefixItems": [{ "type": ["integer", "null"] }, { "type": ["integer", "string"] }] },
        } });
        without_null(&mut schema);
        let expected = json!({ "properties": {
            "count": { "type": "integer" },
            "size": { "allOf": [{ "$ref": "#/$defs/size" }] },
            "either": { "anyOf": [{ "type": "integer" }, { "type": "string" }], "default": 5 },
            "pair": { "type": "array", "prefixItems": [{ "type": "integer" }, { "type": ["integer", "string"] }] },
        } });
        assert_eq!(schema, expected);
    }

    #[test]
    fn what_is_wrong_with_a_choice_is_told_by_name() {
        let [fast, slow] = ["fast", "slow"].map(|word| json!({ "const": word, "description": "how it moves" }));
        let table = |keys: &[&str]| {
            let keys: Map<_, _> = keys.iter().map(|key| ((*key).to_owned(), json!({ "type": "number" }))).collect();
            json!({ "type": "object", "properties": keys })
        };
        let types = json!({ "$defs": { "word": { "oneOf": [{ "type": "string", "const": "auto" }] } } });
        let (number, word) = (json!({ "type": "integer" }), json!({ "$ref": "#/$defs/word" }));
        let mut schema = json!({
            "list": [{ "oneOf": [fast, slow] }],
            "of_one_key": { "oneOf": [table(&["a"]), table(&["b"])] },
            "of_two_keys": { "oneOf": [table(&["a"]), table(&["b", "c"])] },
            "by_type": { "anyOf": [number, word] },
            "unclear": { "anyOf": [number, number] },
        });
        let untouched = ["of_two_keys", "unclear"].map(|key| schema[key].clone());
        with_named_faults(&mut schema, &types);
        assert_eq!(schema["list"][0], json!({ "type": "string", "enum": ["fast", "slow"], "anyOf": [{}, fast, slow] }));
        let of_one_key = json!({
            "type": "object", "minProperties": 1, "maxProperties": 1, "additionalProperties": false,
            "properties": { "a": { "type": "number" }, "b": { "type": "number" } },
        });
        assert_eq!(schema["of_one_key"], of_one_key);
        let by_type = json!({
            "type": ["integer", "string"], "anyOf": [{}, number, word],
            "allOf": [{ "if": { "type": "integer" }, "then": number }, { "if": { "type": "string" }, "then": word }],
        });
        assert_eq!(schema["by_type"], by_type);
        assert_eq!(["of_two_keys", "unclear"].map(|key| schema[key].clone()), untouched);
    }

    #[test]
    fn references_alone_are_moved() {
        let schema = |place: &str| {
            let to = |name: &str| format!("{place}{name}");
            json!({ "$ref": to("a"), "list": [{ "$ref": to("b") }], "other": "#/$defs/c", "in": { "$ref": "#/x/d" } })
        };
        let mut moved = schema("#/$defs/");
        refer(&mut moved, "#/$defs/", "#/definitions/");
        assert_eq!(moved, schema("#/definitions/"));
    }

    #[test]
    fn a_stage_has_the_keys_that_its_node_takes() {
        let schema = file_schema(NODES);
        let of = |node: &str| keys(&schema, &format!("/definitions/{node}/properties"));
        let has = |node: &str| ["input", "inputs", "output"].map(|key| of(node).contains(key));
        assert_eq!(has("camera"), [false, false, true]);
        assert_eq!((has("detector"), has("printer")), ([true, true, true], [true, false, false]));
        assert!(of("camera").contains("rate_hz") && !of("detector").contains("rate_hz"));
        let sides = keys(&schema, "/definitions/detector/properties/inputs/properties");
        assert!(sides.iter().eq(["known", "mask", "same"]));
        let input = json!({ "description": "What drives the stage.", "allOf": [{ "$ref": "#/definitions/input" }] });
        assert_eq!(schema["definitions"]["detector"]["properties"]["input"], input);
        assert!(keys(&schema, "/definitions/output/properties").iter().eq(["kind", "topic"]));
        let stage = &schema["properties"]["stage"]["additionalProperties"];
        let of_camera = json!({
            "if": { "required": ["node"], "properties": { "node": { "const": "camera" } } },
            "then": { "$ref": "#/definitions/camera" },
        });
        assert_eq!(stage["allOf"][1], of_camera);
        assert_eq!(stage["allOf"].as_array().map(Vec::len), Some(1 + NODES.len()));
    }

    #[test]
    fn nodes_share_definitions_that_are_the_same_and_no_others() {
        const DEFINED: [fn() -> Json; 3] = [|| defined("string"), || defined("string"), || defined("integer")];
        fn defined(kind: &str) -> Json {
            let properties = json!({ "size": { "$ref": "#/$defs/size" } });
            json!({ "properties": properties, "$defs": { "size": { "type": kind } } })
        }
        let nodes: Vec<_> = ["first", "same", "other"]
            .into_iter()
            .zip(DEFINED)
            .map(|(name, schema)| Node { schema, ..node(name, &[]) })
            .collect();
        let schema = file_schema(&nodes);
        let size = |node: &str| schema["definitions"][node]["properties"]["size"]["$ref"].as_str().unwrap();
        assert_eq!(["first", "same"].map(size), ["#/definitions/size"; 2]);
        assert_eq!(size("other"), "#/definitions/other.size");
        let kinds = ["size", "other.size"].map(|name| schema["definitions"][name]["type"].as_str());
        assert_eq!(kinds, [Some("string"), Some("integer")]);
    }
}
