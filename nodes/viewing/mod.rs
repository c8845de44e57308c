//! What feeds the page of package `conicflow-view`: a running pipeline, seen from outside or from a sink, or a recording.

pub mod graph;
pub mod live;
pub mod pausing;
pub mod player;
