//! The small message by which bridges tell each other that they live, what they have received, and what time it is there.

use super::journal::FinishedEdge;
use serde::{Deserialize, Serialize};

/// What a bridge puts under its link key a few times per second.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Heartbeat {
    /// One number per start of the bridge.
    pub session: u64,
    /// The run of its machine.
    pub run: u64,
    /// Its clock when this was sent.
    pub sent_ns: u64,
    /// How its messages are laid out.
    pub layouts: String,
    /// What crosses, by its pipeline file.
    pub routes: Vec<Route>,
    /// The last heartbeats of each peer, of which a peer knows that this one was made after it had sent them.
    pub samples: Vec<ClockSample>,
    /// What has come and what is finished, as far as it is known there.
    pub news: News,
}

/// What a bridge has to tell about its edges.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct News {
    /// What it has received, per edge.
    pub acks: Vec<Ack>,
    /// What it knows to be finished. The machine that receives an edge tells so first; when the other one tells it as well, both
    /// know, and neither is needed any more.
    pub finished: Vec<FinishedEdge>,
}

/// What one machine is to send to another.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Route {
    pub from: String,
    pub to: String,
    /// The topic, what it carries, who writes it, and whether any of it may be missed.
    pub what: String,
}

impl Route {
    pub(crate) fn is_between(&self, one: &str, other: &str) -> bool {
        [self.from.as_str(), &self.to] == [one, other] || [self.from.as_str(), &self.to] == [other, one]
    }
}

/// When a peer's last heartbeat was sent, by that peer's clock, and when it came, by the sender's.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct ClockSample {
    pub machine: String,
    pub session: u64,
    pub sent_ns: u64,
    pub received_ns: u64,
}

/// How far an edge was received.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Ack {
    /// The machine that sends it.
    pub from: String,
    pub topic: String,
    /// The stream that is received.
    pub stream: u64,
    /// Number of the message that is expected next.
    pub next: u64,
    /// Number of the first message that may be needed again: what comes before it, the readers that must not miss any have
    /// finished.
    pub finished: u64,
    /// The writers whose streams have ended.
    pub ended: Vec<String>,
}
