//! Sources of the page of package `conicflow-view`: a running pipeline, observed from outside or by a sink, or a recording.

pub mod graph;
pub mod live;
pub mod pausing;
pub mod player;

use conicflow_dataflow::AnyMessage;
use conicflow_messages::{Object, Track};
use conicflow_view::List;

/// Returns a message's tracks or objects for the page; `None` for other items.
pub fn list_of(message: &AnyMessage<'_>) -> Option<List> {
    let tracks = message.items::<Track>().map(|tracks| List::Tracks(tracks.to_vec()));
    tracks.or_else(|| message.items::<Object>().map(|objects| List::Objects(objects.to_vec())))
}
