//! What a program has built in, that the pipeline files which it runs may use.

use crate::network::Network;
use crate::node::Node;

/// The nodes of a program, and its network part.
#[derive(Clone, Copy)]
pub struct Registry {
    /// The nodes that a pipeline file may name.
    pub nodes: &'static [Node],
    /// What carries edges between machines; without it all stages of a pipeline run on one.
    pub network: Option<Network>,
}
