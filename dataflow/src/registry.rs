//! Nodes and network part of a program, which its pipeline files may use.

use crate::network::Network;
use crate::node::Node;

/// The nodes of a program, and its network part.
#[derive(Clone, Copy)]
pub struct Registry {
    /// The nodes that a pipeline file may name.
    pub nodes: &'static [Node],
    /// Transport between machines; without it all stages of a pipeline run on one machine.
    pub network: Option<Network>,
}
