//! What whoever runs a pipeline says beside its file.

use crate::node::Node;
use std::path::PathBuf;
use std::time::Duration;

/// How a run is to be.
#[derive(Clone, Default)]
pub struct RunOptions {
    /// The program that runs stages: it has to know `node STAGE`.
    pub program: PathBuf,
    /// What tells how much room the messages of its sources need.
    pub nodes: &'static [Node],
    /// It ends after this time.
    pub duration: Option<Duration>,
    /// No progress is shown.
    pub quiet: bool,
    /// What its stages log, as they understand [`LOG`](crate::LOG); `None`: what they inherit.
    pub log: Option<String>,
    /// Called at Ctrl-Z with what stops the run and returns when it goes on, to be called once.
    pub around_stop: Option<fn(&dyn Fn())>,
}
