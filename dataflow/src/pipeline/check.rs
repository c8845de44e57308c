//! Checks the stages of a pipeline against each other: topics, kinds of message, cycles, machines.

use super::diagnostic::{Diagnostic, suggestion};
use super::{BRIDGE, Input, Pipeline, Program, StageSpec};
use crate::item_type::ItemType;
use crate::node::Node;
use crate::ports::Delivery;
use crate::side_inputs::Pairing;
use conicflow_messages::{AnyByte, Item, Nothing, Object};
use std::collections::BTreeSet;

/// Checks the connections between stages.
pub(super) fn connections(pipeline: &Pipeline, faults: &mut Vec<Diagnostic>) {
    for stage in &pipeline.stages {
        ends(stage, faults);
        inputs(pipeline, stage, faults);
        output(pipeline, stage, faults);
        machine(pipeline, stage, faults);
        bridged(pipeline, stage, faults);
    }
    cycles(pipeline, faults);
}

/// Checks that a stage has the input and the output that its node needs, and no other.
fn ends(stage: &StageSpec, faults: &mut Vec<Diagnostic>) {
    let Program::Node(node) = &stage.program else { return };
    let name = &stage.name;
    if let (Some(place), true) = (&stage.input_place, node.is_source()) {
        let what = format!("stage `{name}` has an `input`, but `{}` is a source", node.name);
        faults.push(Diagnostic::error(place, what, "remove the line"));
    }
    if !node.is_source() && stage.input_place.is_none() {
        let hint = format!("add `input = \"..\"`, a topic that carries {}", kinds(node));
        faults.push(Diagnostic::error(&stage.place, format!("stage `{name}` has no `input`"), hint));
    }
    let makes = node.output();
    match &stage.output_place {
        Some(place) if makes == Nothing::NAME => {
            let what = format!("stage `{name}` has an `output`, but `{}` is a sink", node.name);
            faults.push(Diagnostic::error(place, what, "remove the line"));
        }
        None if makes != Nothing::NAME => {
            let example = if node.writes_any() { u16::NAME } else { makes };
            let hint = format!("add `output = \"{example}\"`, the topic that it writes");
            faults.push(Diagnostic::error(&stage.place, format!("stage `{name}` has no `output`"), hint));
        }
        _ => {}
    }
}

fn kinds(node: &Node) -> String {
    node.inputs().collect::<Vec<_>>().join(" or ")
}

fn inputs(pipeline: &Pipeline, stage: &StageSpec, faults: &mut Vec<Diagnostic>) {
    for input in stage.all_inputs() {
        if !pipeline.topics().contains(&input.topic.as_str()) {
            let hint = suggestion(&input.topic, pipeline.topics(), "topics that are written");
            let what = format!("nobody writes the topic `{}`", input.topic);
            faults.push(Diagnostic::error(&input.place, what, hint));
        }
    }
    for input in stage.all_inputs() {
        if let (Some(declared), Some(kind)) = (&input.kind, pipeline.kind_of(&input.topic))
            && declared != kind
        {
            let what = format!("the topic `{}` carries {kind}, not {declared}", input.topic);
            faults.push(Diagnostic::error(&input.place, what, "remove `kind`: the stage that writes it tells"));
        }
    }
    for (index, input) in stage.all_inputs().enumerate() {
        if stage.all_inputs().take(index).any(|earlier| earlier.topic == input.topic) {
            let what = format!("stage `{}` reads the topic `{}` twice", stage.name, input.topic);
            faults.push(Diagnostic::error(&input.place, what, "one input per topic is enough"));
        }
    }
    let Program::Node(node) = &stage.program else { return };
    if let Some(input) = &stage.input {
        let accepted: Vec<_> = node.inputs().collect();
        fits(pipeline, node, input, &accepted, faults);
    }
    for (name, input) in &stage.inputs {
        if let Some(side) = node.side_inputs().iter().find(|side| side.name == name) {
            fits(pipeline, node, input, &[side.kind], faults);
        }
    }
}

fn fits(pipeline: &Pipeline, node: &Node, input: &Input, accepted: &[&str], faults: &mut Vec<Diagnostic>) {
    let Some(kind) = pipeline.kind_of(&input.topic) else {
        return kind_is_known(pipeline, node, input, accepted, faults);
    };
    let takes = |kind: &str| accepted.iter().any(|accepted| accepts(pipeline, accepted, kind));
    if accepted.is_empty() || kind == Nothing::NAME || takes(kind) {
        return;
    }
    let names = accepted.join(" or ");
    let what = format!("the topic `{}` carries {kind}, `{}` takes {names} here", input.topic, node.name);
    let fitting: Vec<_> = pipeline
        .topics()
        .into_iter()
        .filter(|topic| pipeline.kind_of(topic).is_some_and(takes))
        .map(|topic| format!("`{topic}`"))
        .collect();
    let hint = if fitting.is_empty() {
        "no stage writes such a topic".to_owned()
    } else {
        format!("topics that carry it: {}", fitting.join(", "))
    };
    faults.push(Diagnostic::error(&input.place, what, hint));
}

/// Whether an input that takes `accepted` takes a topic of the kind `kind`: the same kind, or a list for an input of any type.
fn accepts(pipeline: &Pipeline, accepted: &str, kind: &str) -> bool {
    accepted == kind || (accepted == AnyByte::NAME && pipeline.item(kind).is_some_and(|item| !item.is_image()))
}

/// Checks that the kind of an input is known, for a node that takes several kinds.
fn kind_is_known(pipeline: &Pipeline, node: &Node, input: &Input, accepted: &[&str], faults: &mut Vec<Diagnostic>) {
    let topic = &input.topic;
    let mut writers = pipeline.stages.iter().filter(|stage| stage.output.as_ref() == Some(topic));
    let example = match accepted {
        [AnyByte::NAME] => Some(Object::NAME),
        [first, _, ..] => Some(*first),
        _ => None,
    };
    if let Some(example) = example
        && writers.any(|writer| matches!(writer.program, Program::Command(_)))
    {
        let what = format!("nobody says what the topic `{topic}` carries, `{}` takes {}", node.name, kinds(node));
        let hint = format!("say it here, such as input = {{ topic = \"{topic}\", kind = \"{example}\" }}");
        faults.push(Diagnostic::error(&input.place, what, hint));
    }
}

fn output(pipeline: &Pipeline, stage: &StageSpec, faults: &mut Vec<Diagnostic>) {
    let (Some(topic), Some(place)) = (&stage.output, &stage.output_place) else { return };
    if let (Some(declared), Program::Node(node)) = (&stage.declared_output, &stage.program)
        && declared != node.output()
        && !node.writes_any()
    {
        let what = format!("`{}` writes {}, not {declared}", node.name, node.output());
        faults.push(Diagnostic::error(place, what, "remove `kind`: the node tells"));
    }
    if let (Some(kind), Some(first)) = (stage.output_kind(), pipeline.kind_of(topic))
        && kind != first
        && kind != Nothing::NAME
    {
        let what = format!("the topic `{topic}` carries {first}, stage `{}` would write {kind} into it", stage.name);
        faults.push(Diagnostic::error(place, what, "give it a topic of its own"));
    }
    if stage.output_kind() != Some(Nothing::NAME) && pipeline.topic(topic).readers.is_empty() {
        let hint = "add a stage with this `input`, or leave it for tools that look on";
        faults.push(Diagnostic::warning(place, format!("nobody reads the topic `{topic}`"), hint));
    }
    let earlier = pipeline.stages.iter().take_while(|other| other.name != stage.name);
    let mut rivals = earlier.filter(|other| other.output.as_ref() == Some(topic));
    let own = sources(pipeline, stage);
    if let Some((rival, source)) =
        rivals.find_map(|other| Some((other, own.intersection(&sources(pipeline, other)).next()?.to_owned())))
    {
        let (name, rival) = (&stage.name, &rival.name);
        let what = format!("`{rival}` and `{name}` write the same frames of `{source}` into the topic `{topic}`");
        let hint = "of each frame readers take what comes first: give one of the two a topic of its own";
        faults.push(Diagnostic::warning(place, what, hint));
    }
}

/// The sources of the frames that a stage processes.
fn sources<'a>(pipeline: &'a Pipeline, stage: &'a StageSpec) -> BTreeSet<&'a str> {
    let (mut found, mut seen, mut open) = (BTreeSet::new(), BTreeSet::new(), vec![stage]);
    while let Some(stage) = open.pop() {
        if !seen.insert(&stage.name) {
            continue;
        }
        let Some(input) = &stage.input else {
            found.insert(stage.name.as_str());
            continue;
        };
        open.extend(pipeline.stages.iter().filter(|other| other.output.as_ref() == Some(&input.topic)));
    }
    found
}

fn machine(pipeline: &Pipeline, stage: &StageSpec, faults: &mut Vec<Diagnostic>) {
    let names = || pipeline.machines.keys().map(String::as_str).collect::<Vec<_>>();
    let place = stage.machine_place.as_ref().unwrap_or(&stage.place);
    match &stage.machine {
        Some(machine) if !pipeline.machines.contains_key(machine) => {
            let hint = match names().is_empty() {
                true => format!("add a table [machine.{machine}], or remove the line"),
                false => suggestion(machine, names(), "machines"),
            };
            let what = format!("stage `{}` is on machine `{machine}`, which is not in the file", stage.name);
            faults.push(Diagnostic::error(place, what, hint));
        }
        None if !pipeline.machines.is_empty() && stage.machine_place.is_none() => {
            let what = format!("stage `{}` does not say on which machine it runs", stage.name);
            let hint = format!("add `machine = \"..\"`; machines: `{}`", names().join("`, `"));
            faults.push(Diagnostic::error(place, what, hint));
        }
        _ => {}
    }
}

/// Checks requirements of edges between machines: a free name for the bridge, and compression for long messages.
fn bridged(pipeline: &Pipeline, stage: &StageSpec, faults: &mut Vec<Diagnostic>) {
    if stage.name == BRIDGE && !pipeline.crossings().is_empty() {
        let what = format!("a stage cannot be called `{BRIDGE}` where edges cross machines");
        faults.push(Diagnostic::error(
            &stage.place,
            what,
            "that is the process that carries them: choose another name",
        ));
    }
    let short = |kind: &&str| pipeline.item(kind).is_some_and(ItemType::is_short);
    for input in stage.all_inputs().filter(|input| input.compression.is_some()) {
        let Some(kind) = pipeline.kind_of(&input.topic).filter(short) else { continue };
        let what = format!("`compression` is for images and ellipses, the topic `{}` carries {kind}", input.topic);
        faults.push(Diagnostic::error(&input.place, what, "remove `compression`"));
    }
    let unknown = |topic: &str| pipeline.kind_of(topic).is_none();
    if let Some(input) = stage.all_inputs().find(|input| {
        unknown(&input.topic) && pipeline.crossings().iter().any(|(crossing, ..)| *crossing == input.topic)
    }) {
        let what = format!("nobody says what the topic `{}` carries, and it crosses machines", input.topic);
        let hint = format!("say it here, such as input = {{ topic = \"{}\", kind = \"objects\" }}", input.topic);
        faults.push(Diagnostic::error(&input.place, what, hint));
    }
    let slashes = |topic: &String| topic.starts_with('/') || topic.ends_with('/') || topic.contains("//");
    if let (Some(topic), Some(place)) = (&stage.output, &stage.output_place)
        && slashes(topic)
        && pipeline.crossings().iter().any(|(crossing, ..)| crossing == topic)
    {
        let what = format!("the topic `{topic}` cannot cross machines: it has an empty part between slashes");
        faults.push(Diagnostic::error(place, what, "a name such as camera/depth"));
    }
}

/// Reports cycles in which each stage would wait for the next. An input that is read as latest value may close a cycle.
fn cycles(pipeline: &Pipeline, faults: &mut Vec<Diagnostic>) {
    let mut done = vec![false; pipeline.stages.len()];
    for start in 0..pipeline.stages.len() {
        let mut path = vec![start];
        if let Some(cycle) = find_cycle(pipeline, &mut path, &mut done) {
            let names: Vec<_> = cycle.iter().map(|&index| format!("`{}`", pipeline.stages[index].name)).collect();
            let stage = &pipeline.stages[cycle[0]];
            let place = stage.input.as_ref().map_or(&stage.place, |input| &input.place);
            let what = match names.as_slice() {
                [name] => format!("stage {name} waits for itself"),
                _ => format!("the stages {} wait for each other in a circle", names.join(" -> ")),
            };
            let hint = "a circle is closed by an input that is read as latest value: a further one, under `inputs`";
            faults.push(Diagnostic::error(place, what, hint));
        }
    }
}

/// Follows the inputs that a stage waits for. Returns a cycle in the direction of the data.
fn find_cycle(pipeline: &Pipeline, path: &mut Vec<usize>, done: &mut [bool]) -> Option<Vec<usize>> {
    let current = *path.last()?;
    if done[current] {
        return None;
    }
    for writer in waits_for(pipeline, &pipeline.stages[current]) {
        if let Some(start) = path.iter().position(|&index| index == writer) {
            path.iter().for_each(|&index| done[index] = true);
            return Some(path[start..].iter().rev().copied().collect());
        }
        path.push(writer);
        if let Some(cycle) = find_cycle(pipeline, path, done) {
            return Some(cycle);
        }
        path.pop();
    }
    done[current] = true;
    None
}

fn waits_for(pipeline: &Pipeline, stage: &StageSpec) -> Vec<usize> {
    let side_inputs = if let Program::Node(node) = &stage.program { node.side_inputs() } else { &[] };
    let latest = |name: &str| side_inputs.iter().all(|side| side.name != name || side.pairing == Pairing::Latest);
    let awaited = stage.inputs.iter().filter(|(name, input)| !latest(name) || input.delivery == Delivery::Lossless);
    let topics: Vec<_> = stage.input.iter().chain(awaited.map(|(_, input)| input)).map(|input| &input.topic).collect();
    let writes = |stage: &StageSpec| stage.output.as_ref().is_some_and(|output| topics.contains(&output));
    (0..pipeline.stages.len()).filter(|&index| writes(&pipeline.stages[index])).collect()
}
