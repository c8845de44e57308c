//! Shared memory that a topic's messages take, and shared memory that is available.
//!
//! A writer reuses the memory that was returned to it last. A topic therefore takes as many messages as its readers can queue and
//! hold at once.

use crate::item_type::ItemType;
use crate::ports::{PortError, Topic};
use conicflow_messages::Header;
use std::path::Path;

/// The system's folder of shared memory.
pub(crate) const SHARED_MEMORY: &str = "/dev/shm";

/// Number of messages that a reader holds in addition to its queue: the one being processed, and the next.
pub(crate) const HELD: usize = 2;
/// Number of messages that a writer has on loan.
pub(crate) const LOANED: usize = 1;
/// Size of a page in bytes.
const PAGE: usize = 4096;
/// Bytes that iceoryx2 needs for each pair of a writer and a reader, and for each port of a topic.
pub(crate) const ROOM_PER_PORT: usize = 24 * 1024;

/// Free bytes and total bytes of shared memory.
pub(crate) fn room() -> std::io::Result<(u64, u64)> {
    let about = rustix::fs::statvfs(Path::new(SHARED_MEMORY))?;
    Ok((about.f_bavail * about.f_frsize, about.f_blocks * about.f_frsize))
}

/// Formats a number of bytes with a decimal unit.
pub(crate) fn in_words(bytes: u64) -> String {
    match bytes {
        0..1_000_000 => format!("{:.1} kB", bytes as f64 * 1e-3),
        1_000_000..1_000_000_000 => format!("{:.1} MB", bytes as f64 * 1e-6),
        _ => format!("{:.1} GB", bytes as f64 * 1e-9),
    }
}

/// Size in bytes of a message of `length` items, or of the usual number.
pub(crate) fn message_bytes(item: &ItemType, length: Option<usize>) -> usize {
    let items = length.unwrap_or(item.usual_length()) * item.size();
    // A message seldom begins on a page boundary.
    (size_of::<Header>() + items).next_multiple_of(PAGE) + PAGE
}

/// Maximum number of bytes of a writer's messages; `with_readers` is the maximum number that its readers queue and hold.
pub(crate) fn taken(topic: &Topic, bytes: usize, with_readers: usize) -> u64 {
    ((with_readers + LOANED) * bytes) as u64 + taken_by_ports(topic)
}

/// Bytes that iceoryx2 needs for a writer and its readers, in addition to their messages.
fn taken_by_ports(topic: &Topic) -> u64 {
    ((topic.readers.len() + 1) * ROOM_PER_PORT) as u64
}

/// Checks that a topic's messages of up to `length` items fit in the free memory (`room`). Returns the maximum number of bytes
/// that they take.
pub(crate) fn look_for_room(
    room: std::io::Result<(u64, u64)>,
    item: &ItemType,
    topic: &Topic,
    length: usize,
) -> Result<u64, PortError> {
    let with_readers = topic.readers.iter().map(|reader| reader.queue + HELD).sum();
    let needed = taken(topic, message_bytes(item, Some(length)), with_readers);
    match room {
        Ok((free, _)) if free < needed => Err(no_room(topic, length, needed)),
        // If shared memory is missing, iceoryx2 reports that better.
        _ => Ok(needed - taken_by_ports(topic)),
    }
}

/// Error for messages of `length` items that do not fit.
pub(crate) fn no_room(topic: &Topic, length: usize, needed: u64) -> PortError {
    let free = room().map_or(0, |(free, _)| free);
    PortError::NoRoom { topic: topic.name.clone(), length, free, needed }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ports::{Delivery, TopicReader};
    use conicflow_messages::Object;
    use std::io::Write;

    fn topic(queues: &[usize]) -> Topic {
        let reader = |&queue: &usize| TopicReader { stage: "reader".into(), delivery: Delivery::Latest, queue };
        let item = Some(ItemType::of::<Object>());
        Topic { name: "objects".into(), item, readers: queues.iter().map(reader).collect(), ..Topic::default() }
    }

    #[test]
    fn bytes_are_told_as_people_read_them() {
        let told = [0, 1_500, 999_949, 1_000_000, 2_540_000, 999_940_000, 1_000_000_000, 8_200_000_000].map(in_words);
        assert_eq!(told, ["0.0 kB", "1.5 kB", "999.9 kB", "1.0 MB", "2.5 MB", "999.9 MB", "1.0 GB", "8.2 GB"]);
    }

    #[test]
    fn a_message_takes_whole_pages_and_one_that_it_may_begin_within() {
        let item = ItemType::of::<Object>();
        let bytes = |length: usize| message_bytes(&item, Some(length));
        let fits = (4096 - size_of::<Header>()) / size_of::<Object>();
        assert_eq!([bytes(0), bytes(fits), bytes(fits + 1)], [8192, 8192, 12_288]);
        assert_eq!(message_bytes(&item, None), bytes(item.usual_length()));
    }

    #[test]
    fn a_topic_takes_what_its_readers_keep_and_hold_and_one_more_message_and_the_ports() {
        assert_eq!(taken(&topic(&[4, 2]), 10_000, 10), 11 * 10_000 + 3 * 24 * 1024);
        // For each reader, its queue and two that it holds.
        let taken = look_for_room(room(), &ItemType::of::<Object>(), &topic(&[4, 2]), 1).unwrap();
        assert_eq!(taken, (4 + 2 + 2 + 2 + 1) * 8192);
        let (needed, all) = (taken + 3 * 24 * 1024, u64::MAX);
        let is_enough = |free| look_for_room(Ok((free, all)), &ItemType::of::<Object>(), &topic(&[4, 2]), 1).is_ok();
        assert_eq!([needed - 1, needed, needed + 1].map(is_enough), [false, true, true]);
    }

    #[test]
    fn what_has_no_room_is_told_with_what_there_is() {
        // Takes a page, so that the free memory is not a round number.
        let mut page = tempfile::tempfile_in(SHARED_MEMORY).unwrap();
        page.write_all(&[1]).unwrap();
        let (free, all) = room().unwrap();
        assert!(0 < free && free <= all, "{free} of {all}");
        assert_eq!([free, all].map(|bytes| bytes % PAGE as u64), [0, 0], "it is handed out in pages");
        let length = all as usize / size_of::<Object>() + 1;
        let error = look_for_room(room(), &ItemType::of::<Object>(), &topic(&[1]), length).unwrap_err();
        let PortError::NoRoom { topic, length: told, free, needed } = error else { panic!("{error}") };
        assert_eq!((&*topic, told), ("objects", length));
        assert!(0 < free && free <= all && needed > 4 * all, "{needed} where {free} of {all} are free");
    }
}
