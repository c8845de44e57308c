//! How much shared memory a topic's messages take, and how much there is.
//!
//! A writer uses again what came back to it last. So a topic takes as many messages as its readers can keep waiting and hold
//! at once.

use crate::item_type::ItemType;
use crate::ports::{PortError, Topic};
use conicflow_messages::Header;
use std::path::Path;

/// Where the system keeps shared memory.
pub(crate) const SHARED_MEMORY: &str = "/dev/shm";

/// Messages that a reader holds beside its queue: the one that is worked on, and the next.
pub(crate) const HELD: usize = 2;
/// Messages that a writer has in hand.
pub(crate) const LOANED: usize = 1;
const PAGE: usize = 4096;
/// What iceoryx2 keeps for each pair of a writer and a reader, and for each end of a topic.
pub(crate) const ROOM_PER_PORT: usize = 24 * 1024;

/// Bytes of shared memory that are free, and that there are.
pub(crate) fn room() -> std::io::Result<(u64, u64)> {
    let about = rustix::fs::statvfs(Path::new(SHARED_MEMORY))?;
    Ok((about.f_bavail * about.f_frsize, about.f_blocks * about.f_frsize))
}

/// A number of bytes as people read it.
pub(crate) fn in_words(bytes: u64) -> String {
    match bytes {
        0..1_000_000 => format!("{:.1} kB", bytes as f64 * 1e-3),
        1_000_000..1_000_000_000 => format!("{:.1} MB", bytes as f64 * 1e-6),
        _ => format!("{:.1} GB", bytes as f64 * 1e-9),
    }
}

/// The bytes of a message of `length` items, or of as many as are usual.
pub(crate) fn message_bytes(item: &ItemType, length: Option<usize>) -> usize {
    let items = length.unwrap_or(item.usual_length()) * item.size();
    // A message seldom begins where a page does.
    (size_of::<Header>() + items).next_multiple_of(PAGE) + PAGE
}

/// Bytes that a writer's messages take, of which its readers hold and keep waiting so many at most.
pub(crate) fn taken(topic: &Topic, bytes: usize, with_readers: usize) -> u64 {
    ((with_readers + LOANED) * bytes) as u64 + taken_by_ports(topic)
}

/// Bytes that iceoryx2 keeps for a writer and its readers, beside their messages.
fn taken_by_ports(topic: &Topic) -> u64 {
    ((topic.readers.len() + 1) * ROOM_PER_PORT) as u64
}

/// Makes sure that a topic's messages find room if they are up to `length` items long; the bytes that they take at most.
pub(crate) fn look_for_room(item: &ItemType, topic: &Topic, length: usize) -> Result<u64, PortError> {
    let with_readers = topic.readers.iter().map(|reader| reader.queue + HELD).sum();
    let needed = taken(topic, message_bytes(item, Some(length)), with_readers);
    match room() {
        Ok((free, _)) if free < needed => Err(no_room(topic, length, needed)),
        // Where there is no such folder iceoryx2 says it better.
        _ => Ok(needed - taken_by_ports(topic)),
    }
}

/// Why messages of `length` items have no room.
pub(crate) fn no_room(topic: &Topic, length: usize, needed: u64) -> PortError {
    let free = room().map_or(0, |(free, _)| free);
    PortError::NoRoom { topic: topic.name.clone(), length, free, needed }
}
