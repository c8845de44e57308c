//! Stands between Zenoh and the thread of an incoming edge: lets through the messages that the present session of the other
//! machine's bridge has made, and counts and reports those that are refused.

use crate::peer::counts::{EdgeCounts, MalformedCounter};
use crate::peer::links::Links;
use conicflow_dataflow::Edge;
use std::sync::Arc;

/// Admits the messages that come under the Zenoh key of an edge. It stands before the [`Channel`](super::channel::Channel), so
/// that refused messages take no room there.
pub(super) struct Authenticator {
    pub zenoh_key: String,
    pub from: String,
    pub links: Arc<Links>,
    pub refusals: Arc<Refusals>,
}

impl Authenticator {
    /// Whether a message was made by the present session of the other machine's bridge. Messages of a session that has not proved
    /// itself yet are dropped without being counted: they come again, or are not wanted yet.
    pub(super) fn admits(&self, bytes: &[u8]) -> bool {
        let verified = self.links.seal().verify(&self.zenoh_key, bytes);
        let present = verified.map(|session| self.links.is_present(&self.from, session));
        match present {
            Ok(Ok(is_present)) => return is_present,
            Ok(Err(reason)) => self.refusals.leave_out(&reason),
            Err(error) => self.refusals.leave_out(&error),
        }
        false
    }
}

/// Counts the refused messages of an edge, and logs them now and then.
pub(super) struct Refusals {
    topic: String,
    from: String,
    left_out: MalformedCounter,
    /// Counted separately: otherwise a flood of undecodable messages would suppress the reports of forged ones.
    forged: MalformedCounter,
}

impl Refusals {
    pub(super) fn new(edge: &Edge, counts: Arc<EdgeCounts>) -> Self {
        let (topic, from) = (edge.topic.name.clone(), edge.from.clone());
        let left_out = MalformedCounter::new(Arc::clone(&counts));
        Self { topic, from, left_out, forged: MalformedCounter::new(counts) }
    }

    pub(super) fn warn_of_forgery(&self, did: &str, why: &str) {
        let Self { topic, from, .. } = self;
        self.forged.add(format_args!(
            "{did} a message of topic `{topic}` that machine `{from}` has not sent: {why}\n  \
             hint: any machine that can connect can send; with the same `key` on all machines only these can"
        ));
    }

    pub(super) fn leave_out(&self, reason: &dyn std::fmt::Display) {
        let Self { topic, from, .. } = self;
        self.left_out.add(format_args!("left out a message of topic `{topic}` from machine `{from}`: {reason}"));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::edge_tests;
    use crate::peer::heartbeat::News;
    use crate::peer::journal::Journal;
    use crate::wire::seal::{Seal, secret};
    use crate::wire::{StreamPosition, encode_message};
    use conicflow_dataflow::pipeline::{BRIDGE, Compression};
    use conicflow_dataflow::ports::Delivery;
    use conicflow_dataflow::{BridgePlan, ItemType};
    use conicflow_messages::{Header, Object};
    use std::sync::atomic::Ordering;

    const ZENOH_KEY: &str = "conicflow/tracking/robot/objects";

    fn edge(from: &str) -> Edge {
        Edge { from: from.to_owned(), ..edge_tests::edge(Delivery::Latest, BRIDGE) }
    }

    fn sealed(seal: &Seal, zenoh_key: &str) -> Vec<u8> {
        let (item, header) = (ItemType::of::<Object>(), Header::default());
        let mut bytes = encode_message(StreamPosition::default(), &item, &header, &[], Compression::None).unwrap();
        seal.sign(zenoh_key, &mut bytes);
        bytes
    }

    #[test]
    fn only_messages_of_the_present_session_of_the_other_bridge_pass_and_others_are_counted() {
        let secrets = [secret(), secret()];
        let links = |machine: &str, peer: &str, session: u64| {
            let plan = BridgePlan { machine: machine.into(), incoming: vec![edge(peer)], ..BridgePlan::default() };
            Arc::new(Links::new(Journal::open(None, 7, session), Seal::new(Some(&secrets[0]), session), &plan))
        };
        let (theirs, ours) = (links("robot", "base", 5), links("base", "robot", 9));
        let counts = Arc::<EdgeCounts>::default();
        let refusals = Arc::new(Refusals::new(&edge("robot"), Arc::clone(&counts)));
        let (zenoh_key, from) = (ZENOH_KEY.to_owned(), "robot".to_owned());
        let authenticator = Authenticator { zenoh_key, from, links: Arc::clone(&ours), refusals };
        let good = sealed(theirs.seal(), ZENOH_KEY);
        assert!(!authenticator.admits(&good), "it has not proved to be the present one");
        assert_eq!(counts.malformed.load(Ordering::Relaxed), 0);
        for _ in 0..2 {
            theirs.send_heartbeat("@robot", News::default(), |bytes| ours.receive_heartbeat("robot", "@robot", &bytes));
            ours.send_heartbeat("@base", News::default(), |bytes| theirs.receive_heartbeat("base", "@base", &bytes));
        }
        assert!(authenticator.admits(&good));
        let changed = |at: usize| [&good[..at], &[good[at] ^ 1], &good[at + 1..]].concat();
        let mut refused: Vec<Vec<u8>> = (0..good.len()).map(changed).collect();
        refused.extend([
            sealed(theirs.seal(), "conicflow/tracking/robot/tracks"),
            sealed(&Seal::new(Some(&secrets[0]), 4), ZENOH_KEY),
            sealed(&Seal::new(Some(&secrets[1]), 5), ZENOH_KEY),
            sealed(&Seal::new(None, 5), ZENOH_KEY),
            b"garbage".to_vec(),
        ]);
        let passed: Vec<_> = refused.iter().filter(|bytes| authenticator.admits(bytes)).collect();
        assert!(passed.is_empty(), "{passed:?}");
        assert_eq!(counts.malformed.load(Ordering::Relaxed), refused.len() as u64);
    }
}
