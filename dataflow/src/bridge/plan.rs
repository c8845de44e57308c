//! The edges of one machine to and from the others, as the pipeline file places its stages.

use super::Compression;
use super::beacon::Lane;
use crate::item_type::ItemType;
use crate::pipeline::{Input, Machine, Pipeline};
use crate::ports::{Delivery, Topic};
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, BTreeSet};

/// What the bridge of one machine carries.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BridgePlan {
    /// The machine's name.
    pub machine: String,
    /// Its table in the file.
    pub settings: Machine,
    /// What leaves.
    pub outgoing: Vec<Edge>,
    /// What comes.
    pub incoming: Vec<Edge>,
}

/// What one machine writes into a topic that others read.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Edge {
    /// The topic, as the stages of the machine that this plan is for see it.
    pub topic: Topic,
    /// What it carries.
    pub item: ItemType,
    /// Where it is written.
    pub from: String,
    /// The stages there that write it.
    pub writers: Vec<String>,
    /// The machines that read it.
    pub to: Vec<Receiver>,
    /// How images are compressed.
    pub compression: Compression,
}

/// A machine that reads a topic from elsewhere.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Receiver {
    /// Its name.
    pub machine: String,
    /// Lossless if any of its stages wants every message.
    pub delivery: Delivery,
}

impl BridgePlan {
    /// The edges of `machine`; `None` where nothing crosses.
    pub fn of(pipeline: &Pipeline, machine: &str) -> Option<Self> {
        let edges = || pipeline.machines.keys().flat_map(|from| edges_from(pipeline, from, machine));
        let plan = Self {
            machine: machine.to_owned(),
            settings: pipeline.machines.get(machine)?.clone(),
            outgoing: edges().filter(|edge| edge.from == machine).collect(),
            incoming: edges().filter(|edge| edge.delivery_to(machine).is_some()).collect(),
        };
        let crosses = !plan.outgoing.is_empty() || !plan.incoming.is_empty();
        crosses.then_some(plan)
    }

    /// What crosses.
    pub(super) fn lanes(&self) -> Vec<Lane> {
        self.outgoing.iter().chain(&self.incoming).flat_map(Edge::lanes).collect()
    }

    /// The machines at the other ends.
    pub fn peers(&self) -> BTreeSet<&str> {
        let receivers = self.outgoing.iter().flat_map(|edge| &edge.to).map(|receiver| receiver.machine.as_str());
        receivers.chain(self.incoming.iter().map(|edge| edge.from.as_str())).collect()
    }
}

impl Edge {
    /// What it carries to each machine.
    fn lanes(&self) -> impl Iterator<Item = Lane> {
        self.to.iter().map(|receiver| {
            let delivery = if receiver.delivery == Delivery::Lossless { "lossless" } else { "latest" };
            let (topic, kind, writers) = (&self.topic.name, self.item.name(), self.writers.join(", "));
            let what = format!("topic `{topic}` with {kind} of {writers}, {delivery}");
            Lane { from: self.from.clone(), to: receiver.machine.clone(), what }
        })
    }

    /// Whether its messages are mostly as short as a packet on a network: most survive where some packets are lost.
    pub(super) fn is_short(&self) -> bool {
        self.item.is_short()
    }

    /// How it reaches a machine, if it does.
    pub fn delivery_to(&self, machine: &str) -> Option<Delivery> {
        self.to.iter().find(|receiver| receiver.machine == machine).map(|receiver| receiver.delivery)
    }
}

/// The edges that begin on the machine `from`, as `machine` sees their topics.
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

/// The machines that read a topic which is written on `from`, and the strongest compression that any of them asks for.
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
