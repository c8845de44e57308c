//! The output of `conicflow nodes`, made from the nodes' own descriptions.

use crate::NODES;
use anyhow::bail;
use conicflow_dataflow::pipeline::suggestion;
use conicflow_dataflow::{Node, Pairing};
use conicflow_messages::{Hinted, Item, Nothing};
use serde_json::Value as Json;
use std::fmt::Write;

/// Returns all nodes, one per line, or one node with its parameters.
///
/// # Errors
/// There is no such node.
pub fn nodes(name: Option<&str>) -> anyhow::Result<String> {
    let Some(name) = name else {
        let width = NODES.iter().map(|node| node.name.len()).max().unwrap_or(0);
        return Ok(NODES.iter().map(|node| format!("{:<width$}  {}\n", node.name, node.summary)).collect());
    };
    match NODES.iter().find(|node| node.name == name) {
        Some(node) => Ok(describe(node)?),
        None => {
            let hint = suggestion(name, NODES.iter().map(|node| node.name), "nodes");
            bail!(Hinted::new(format!("there is no node `{name}`"), hint))
        }
    }
}

fn describe(node: &Node) -> Result<String, std::fmt::Error> {
    let mut text = format!("{}: {}\n\n", node.name, node.summary);
    let inputs: Vec<_> = node.inputs().collect();
    if !inputs.is_empty() {
        writeln!(text, "input   {}", inputs.join(" | "))?;
    }
    for side in node.side_inputs() {
        let pairing = if side.pairing == Pairing::Latest { "the latest" } else { "of the same frame" };
        writeln!(text, "inputs  {} = {}, {pairing}", side.name, side.kind)?;
    }
    if node.writes_any() {
        writeln!(text, "output  depth, or what the readers of its topic take")?;
    } else if node.output() != Nothing::NAME {
        writeln!(text, "output  {}", node.output())?;
    }
    let schema = node.schema();
    text.push_str(&parameters(&schema, &schema, ""));
    Ok(text)
}

/// Returns the parameters of an object schema; the names of nested ones begin with that of their table.
fn parameters(schema: &Json, object: &Json, prefix: &str) -> String {
    let mut text = String::new();
    for (name, parameter) in object.get("properties").and_then(Json::as_object).into_iter().flatten() {
        // In a choice of tables, the description stands with the choice.
        let descriptions = [parameter, object].map(|described| field(described, "description"));
        let description = descriptions.into_iter().find(|text| !text.is_empty()).unwrap_or("").replace('\n', " ");
        let (default, range) = (default_of(parameter), range_of(parameter));
        text.push_str(&format!("\n{prefix}{name} = {default}{range}\n    {description}\n"));
        let words = choices(schema, parameter);
        if !words.is_empty() {
            text.push_str(&format!("    one of {}\n", words.join(", ")));
        }
        for table in branches(schema, parameter).iter().filter(|branch| branch.get("properties").is_some()) {
            text.push_str(&parameters(schema, table, &format!("{prefix}{name}.")));
        }
    }
    text
}

/// Returns the schemas that a parameter can have: its own, the type that it refers to, or the branches of a choice.
fn branches<'a>(schema: &'a Json, parameter: &'a Json) -> Vec<&'a Json> {
    let target = parameter.get("$ref").and_then(Json::as_str).and_then(|path| schema.pointer(path.strip_prefix('#')?));
    let parameter = target.unwrap_or(parameter);
    match ["oneOf", "anyOf"].iter().find_map(|key| parameter.get(*key)?.as_array()) {
        Some(list) => list.iter().flat_map(|branch| branches(schema, branch)).collect(),
        None => vec![parameter],
    }
}

fn field<'a>(parameter: &'a Json, name: &str) -> &'a str {
    parameter.get(name).and_then(Json::as_str).unwrap_or("")
}

fn default_of(parameter: &Json) -> String {
    match parameter.get("default") {
        Some(Json::Null) | None => "(no default)".to_owned(),
        Some(default) => default.to_string(),
    }
}

fn range_of(parameter: &Json) -> String {
    let bound = |name: &str| parameter.get(name).map(Json::to_string);
    match (bound("minimum"), bound("maximum")) {
        (Some(low), Some(high)) => format!("   ({low} to {high})"),
        (Some(low), None) if low != "0" => format!("   (at least {low})"),
        (None, Some(high)) => format!("   (at most {high})"),
        _ => String::new(),
    }
}

/// Returns the words that a parameter can be.
fn choices(schema: &Json, parameter: &Json) -> Vec<String> {
    let words = branches(schema, parameter).into_iter().flat_map(|branch| {
        let listed = branch.get("enum").and_then(Json::as_array).into_iter().flatten();
        listed.chain(branch.get("const")).map(Json::to_string)
    });
    words.collect()
}
