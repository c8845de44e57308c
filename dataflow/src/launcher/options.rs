//! Options of a run that are not in the pipeline file.

use crate::node::Node;
use std::path::PathBuf;
use std::time::Duration;

/// Options of a run.
#[derive(Clone, Default)]
pub struct RunOptions {
    /// The program that runs stages; it needs the command `node STAGE`.
    pub program: PathBuf,
    /// Nodes, which give the message lengths of sources.
    pub nodes: &'static [Node],
    /// Time after which the run ends.
    pub duration: Option<Duration>,
    /// Whether to show no progress.
    pub quiet: bool,
    /// Log filter of the stages, as [`LOG`](crate::LOG) describes; `None`: the inherited one.
    pub log: Option<String>,
    /// Called at Ctrl-Z with a function that suspends the run and returns when it is resumed; it has to call that once.
    pub around_stop: Option<fn(&dyn Fn())>,
}
