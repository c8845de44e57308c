//! Edges of one machine to and from the others, derived from the placement of the stages.

use crate::network::{BridgePlan, Edge, Receiver};
use crate::pipeline::{Compression, Input, Pipeline};
use crate::ports::Delivery;
use std::collections::BTreeMap;

/// Plan of the bridge of `machine`; `None` if no topic crosses its border.
pub(crate) fn bridge_plan(pipeline: &Pipeline, machine: &str) -> Option<BridgePlan> {
    let edges = || pipeline.machines.keys().flat_map(|from| edges_from(pipeline, from, machine));
    let plan = BridgePlan {
        machine: machine.to_owned(),
        settings: pipeline.machines.get(machine)?.clone(),
        outgoing: edges().filter(|edge| edge.from == machine).collect(),
        incoming: edges().filter(|edge| edge.delivery_to(machine).is_some()).collect(),
    };
    let crosses = !plan.outgoing.is_empty() || !plan.incoming.is_empty();
    crosses.then_some(plan)
}

/// The edges from the machine `from`, with their topics as `machine` sees them.
fn edges_from(pipeline: &Pipeline, from: &str, machine: &str) -> Vec<Edge> {
    let edge = |name: &str| {
        let topic = pipeline.topic_on(name, Some(machine));
        let writers: Vec<_> = topic.writers.iter().filter(|writer| pipeline.is_on(writer, from)).cloned().collect();
        let (to, compression) = receivers(pipeline, name, from);
        let crosses = !writers.is_empty() && !to.is_empty();
        let item = topic.item.clone().filter(|_| crosses)?;
        Some(Edge { topic, item, from: from.to_owned(), writers, to, compression })
    };
    pipeline.topics().into_iter().filter_map(edge).collect()
}

/// The machines that read a topic written on `from`, and the strongest compression that any of them asks for.
fn receivers(pipeline: &Pipeline, topic: &str, from: &str) -> (Vec<Receiver>, Compression) {
    let mut machines = BTreeMap::new();
    let mut compression = None;
    for stage in pipeline.stages.iter().filter(|stage| stage.machine.as_deref() != Some(from)) {
        let inputs: Vec<&Input> = stage.all_inputs().filter(|input| input.topic == topic).collect();
        for (input, machine) in inputs.into_iter().zip(&stage.machine) {
            let delivery = machines.entry(machine.clone()).or_insert(input.delivery);
            if input.delivery == Delivery::Lossless {
                *delivery = Delivery::Lossless;
            }
            compression = compression.max(input.compression);
        }
    }
    let receivers = machines.into_iter().map(|(machine, delivery)| Receiver { machine, delivery });
    (receivers.collect(), compression.unwrap_or_default())
}
