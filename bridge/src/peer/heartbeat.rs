//! The heartbeat between bridges: shows that the sender is alive, acknowledges messages, and carries the sender's time.

use super::journal::FinishedEdge;
use serde::{Deserialize, Serialize};

/// The message that a bridge puts under its link key a few times per second.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Heartbeat {
    /// Number of this start of the bridge.
    pub session: u64,
    /// The run of the sending machine.
    pub run: u64,
    /// The sender's clock when this was sent.
    pub sent_ns: u64,
    /// The layouts of the sender's messages.
    pub layouts: String,
    /// The routes between machines in the sender's pipeline file.
    pub routes: Vec<Route>,
    /// The last heartbeats from each peer. They prove to that peer that this heartbeat is newer than its own.
    pub samples: Vec<ClockSample>,
    /// The acknowledgements and finished edges that the sender knows.
    pub news: News,
}

/// The news of a bridge about its edges.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct News {
    /// The acknowledgements of what it has received, one per edge.
    pub acks: Vec<Ack>,
    /// The edges that it knows to be finished. The receiving machine reports an edge first; once the sending machine reports it
    /// as well, both know, and neither has to stay for the other.
    pub finished: Vec<FinishedEdge>,
}

/// A topic that one machine sends to another.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Route {
    pub from: String,
    pub to: String,
    /// The topic, its item type, its writers and its delivery.
    pub what: String,
}

impl Route {
    pub(crate) fn is_between(&self, one: &str, other: &str) -> bool {
        [self.from.as_str(), &self.to] == [one, other] || [self.from.as_str(), &self.to] == [other, one]
    }
}

/// When a peer's last heartbeat was sent, by that peer's clock, and received, by the clock of the machine that reports it.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct ClockSample {
    pub machine: String,
    pub session: u64,
    pub sent_ns: u64,
    pub received_ns: u64,
}

/// The acknowledgement of an edge.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Ack {
    /// The machine that sends it.
    pub from: String,
    pub topic: String,
    /// The stream that is received.
    pub stream: u64,
    /// Number of the message that is expected next.
    pub next: u64,
    /// Number of the first message that may be needed again: the lossless readers have finished all earlier ones.
    pub finished: u64,
    /// The writers whose streams have ended.
    pub ended: Vec<String>,
}
