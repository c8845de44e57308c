//! What `conicflow nodes` prints, out of the nodes' own descriptions.

use crate::NODES;
use anyhow::bail;
use conicflow_dataflow::{Node, Pick};
use conicflow_messages::Kind;
use serde_json::Value as Json;
use std::fmt::Write;

/// All nodes in a line each, or one with its parameters.
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
            let names: Vec<_> = NODES.iter().map(|node| node.name).collect();
            bail!("there is no node `{name}`\n  hint: nodes: {}", names.join(", "))
        }
    }
}

fn describe(node: &Node) -> Result<String, std::fmt::Error> {
    let mut text = format!("{}: {}\n\n", node.name, node.summary);
    let inputs: Vec<_> = node.inputs().map(Kind::name).collect();
    if !inputs.is_empty() {
        writeln!(text, "input   {}", inputs.join(" | "))?;
    }
    for side in node.sides() {
        let pick = if side.pick == Pick::Latest { "the latest" } else { "of the same frame" };
        writeln!(text, "inputs  {} = {}, {pick}", side.name, side.kind)?;
    }
    if node.output() != Kind::Nothing {
        writeln!(text, "output  {}", node.output())?;
    }
    let schema = node.schema();
    let parameters = schema.get("properties").and_then(Json::as_object).into_iter().flatten();
    for (name, parameter) in parameters {
        let description = field(parameter, "description").replace('\n', " ");
        writeln!(text, "\n{name} = {}{}\n    {description}", default_of(parameter), range_of(parameter))?;
        let words = choices(&schema, parameter);
        if !words.is_empty() {
            writeln!(text, "    one of {}", words.join(", "))?;
        }
    }
    Ok(text)
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

/// The words that a parameter can be, through the type that it refers to.
fn choices(schema: &Json, parameter: &Json) -> Vec<String> {
    let target = parameter.get("$ref").and_then(Json::as_str).and_then(|path| schema.pointer(path.strip_prefix('#')?));
    let parameter = target.unwrap_or(parameter);
    let branches = ["oneOf", "anyOf"].iter().filter_map(|key| parameter.get(*key)?.as_array()).flatten();
    let nested = branches.flat_map(|branch| choices(schema, branch));
    let words = parameter.get("enum").and_then(Json::as_array).into_iter().flatten().chain(parameter.get("const"));
    words.map(Json::to_string).chain(nested).collect()
}
