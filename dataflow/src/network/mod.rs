//! Interface to the program's network part. Nothing else in this package knows how machines reach each other.
//!
//! Where a topic is written on one machine and read on another, the launcher of each starts one bridge process, which carries the
//! [`Edge`]s of its [`BridgePlan`]. The functions of [`Network`] check the machine's table in the pipeline file, and run that
//! process.

pub(crate) mod bridge_plan;
pub(crate) mod link_key;
pub(crate) mod link_report;

use crate::item_type::ItemType;
use crate::pipeline::{Compression, Machine};
use crate::ports::shared_memory::SharedMemory;
use crate::ports::{Delivery, Topic};
use crate::runner::StageRuntime;
use crate::stage::StageError;
use conicflow_messages::Hinted;
use serde::{Deserialize, Serialize};
use std::collections::BTreeSet;
use std::path::{Path, PathBuf};

pub(crate) const NO_NETWORK: &str = "this program was built without its network part";
pub(crate) const NO_NETWORK_HINT: &str =
    "give it a network part, as `conicflow` has one, or let all stages run on one machine, without [machine.*]";

/// Network part of a program, which carries edges between machines.
#[derive(Clone, Copy)]
pub struct Network {
    /// Checks a machine's table; a missing file is reported elsewhere.
    pub check: fn(&Machine) -> Result<(), Hinted>,
    /// Warnings of problems that may prevent a machine's links today, although its table is valid.
    pub warnings: fn(&Machine) -> Vec<Hinted>,
    /// The endpoints at which a machine listens.
    pub listen_endpoints: fn(&Machine) -> Result<Vec<String>, Hinted>,
    /// Program that carries the edges of a plan, in its own process, until all have ended.
    pub carrier: Carrier,
}

/// Carries the edges of a plan for a run, until all have ended.
pub(crate) type RunBridge = fn(&BridgePlan, BridgeRun<'_>, StageRuntime<SharedMemory>) -> Result<(), NetworkError>;

/// Program that carries edges.
#[derive(Clone, Copy)]
pub enum Carrier {
    /// This program.
    Here(RunBridge),
    /// Another program, which takes the place of this process and calls `run_in_run`.
    Program(fn() -> Result<PathBuf, Hinted>),
}

/// The run that a bridge belongs to.
#[derive(Clone, Copy, Debug)]
pub struct BridgeRun<'a> {
    /// Name of the pipeline.
    pub pipeline: &'a str,
    /// The number of the run.
    pub run: u64,
    /// The folder of its records.
    pub folder: &'a Path,
}

/// Reason why a bridge ended before its edges did.
#[derive(Debug, thiserror::Error)]
pub enum NetworkError {
    /// A restart would not help.
    #[error("{0}")]
    Refused(StageError),
    /// A restart may help.
    #[error("{0}")]
    Failed(StageError),
}

/// Edges that the bridge of one machine carries.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BridgePlan {
    /// The machine's name.
    pub machine: String,
    /// Its table in the file.
    pub settings: Machine,
    /// Edges to other machines.
    pub outgoing: Vec<Edge>,
    /// Edges from other machines.
    pub incoming: Vec<Edge>,
}

/// A topic that one machine writes and others read.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Edge {
    /// The topic, as the stages of the machine that this plan is for see it.
    pub topic: Topic,
    /// Its item type.
    pub item: ItemType,
    /// Machine that writes it.
    pub from: String,
    /// The stages there that write it.
    pub writers: Vec<String>,
    /// The machines that read it.
    pub to: Vec<Receiver>,
    /// How its images or long lists are compressed.
    pub compression: Compression,
}

/// A machine that reads a topic from elsewhere.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Receiver {
    /// Its name.
    pub machine: String,
    /// Lossless if any of its stages reads losslessly.
    pub delivery: Delivery,
}

impl BridgePlan {
    /// The machines at the other ends.
    pub fn peers(&self) -> BTreeSet<&str> {
        let receivers = self.outgoing.iter().flat_map(|edge| &edge.to).map(|receiver| receiver.machine.as_str());
        receivers.chain(self.incoming.iter().map(|edge| edge.from.as_str())).collect()
    }
}

impl Edge {
    /// Delivery to a machine, if the edge goes there.
    pub fn delivery_to(&self, machine: &str) -> Option<Delivery> {
        self.to.iter().find(|receiver| receiver.machine == machine).map(|receiver| receiver.delivery)
    }
}
