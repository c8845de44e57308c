//! Reports of faulty messages: each kind of fault is always counted, and reported once.

use conicflow_messages::Hinted;
use conicflow_ros::Undecodable;
use std::collections::BTreeSet;

/// A fault: the counter of its kind, and its description.
pub(crate) type Fault = (&'static str, Hinted);

/// The kinds that were reported.
#[derive(Debug, Default)]
pub(crate) struct Notices(BTreeSet<&'static str>);

impl Notices {
    /// Reports a fault, unless one of its kind was reported before.
    pub(crate) fn tell(&mut self, (sort, Hinted { what, hint, .. }): &Fault) {
        if self.0.insert(sort) {
            tracing::warn!("{what}; more of that is counted as `{sort}`\n  hint: {hint}");
        }
    }
}

/// Returns the fault of an unreadable message.
pub(crate) fn unreadable(sort: &'static str, topic: &str, error: &Undecodable) -> Fault {
    let usual = "do both sides mean the same type? `ros2 topic info --verbose` tells that of the other";
    let hint = error.hint.as_deref().unwrap_or(usual);
    (sort, Hinted::new(format!("passed over a message of `{topic}`: {}", error.what), hint))
}
