//! What is wrong with messages: each sort is counted always, and told once.

use conicflow_messages::Hinted;
use conicflow_ros::Undecodable;
use std::collections::BTreeSet;

/// Something that is wrong: the counter of its sort, and what there is to tell.
pub(crate) type Fault = (&'static str, Hinted);

/// The sorts that were told.
#[derive(Debug, Default)]
pub(crate) struct Notices(BTreeSet<&'static str>);

impl Notices {
    /// Tells it, unless something of its sort was told before.
    pub(crate) fn tell(&mut self, (sort, Hinted { what, hint, .. }): &Fault) {
        if self.0.insert(sort) {
            tracing::warn!("{what}; more of that is counted as `{sort}`\n  hint: {hint}");
        }
    }
}

/// A message that cannot be read.
pub(crate) fn unreadable(sort: &'static str, topic: &str, error: &Undecodable) -> Fault {
    let usual = "do both sides mean the same type? `ros2 topic info --verbose` tells that of the other";
    let (what, hint) = error.0.split_once("\n  hint: ").unwrap_or((&error.0, usual));
    (sort, Hinted::new(format!("passed over a message of `{topic}`: {what}"), hint))
}
