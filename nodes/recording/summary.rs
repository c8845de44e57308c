//! Reads the summary at the end of a recording's file: what the file has, and where.

use mcap::sans_io::summary_reader::{SummaryReadEvent, SummaryReader};
use mcap::{McapResult, Summary};
use std::fs::File;
use std::io::{Read, Seek};
use std::path::Path;

/// Longest record that is read, in bytes: the largest image of single precision has 256 MB.
pub(super) const MAX_RECORD_BYTES: u64 = 512 << 20;

/// Reads the summary of a file; `None` if it has none.
pub(super) fn summary(path: &Path) -> McapResult<Option<Summary>> {
    let (mut file, mut reader) = (File::open(path)?, SummaryReader::new());
    while let Some(event) = reader.next_event() {
        match event? {
            SummaryReadEvent::ReadRequest(bytes) => {
                let read = file.read(reader.insert(bytes.min(MAX_RECORD_BYTES as usize)))?;
                reader.notify_read(read);
            }
            SummaryReadEvent::SeekRequest(to) => reader.notify_seeked(file.seek(to)?),
        }
    }
    Ok(reader.finish().filter(|summary| summary.stats.is_some()))
}

/// Returns the topics that have messages; `None` if the summary does not name all of them, since it may leave out channels and
/// the counts of their messages.
pub(super) fn topics_with_messages(summary: &Summary) -> Option<Vec<String>> {
    let stats = summary.stats.as_ref()?;
    let counts = || stats.channel_message_counts.iter().filter(|(_, count)| **count > 0);
    let counted = counts().fold(0_u64, |sum, (_, count)| sum.saturating_add(*count));
    if counted < stats.message_count {
        return None;
    }
    counts().map(|(id, _)| Some(summary.channels.get(id)?.topic.clone())).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use mcap::Channel;
    use mcap::records::Statistics;
    use std::collections::BTreeMap;
    use std::sync::Arc;

    #[test]
    fn topics_are_returned_only_if_the_summary_names_all_of_them() {
        let channel = |id| Channel {
            id,
            topic: format!("/{id}"),
            schema: None,
            message_encoding: String::new(),
            metadata: BTreeMap::new(),
        };
        let topics = |message_count, counts: &[(u16, u64)], channels: &[u16]| {
            let channel_message_counts = counts.iter().copied().collect();
            let stats = Some(Statistics { message_count, channel_message_counts, ..Statistics::default() });
            let channels = channels.iter().map(|id| (*id, Arc::new(channel(*id)))).collect();
            topics_with_messages(&Summary { stats, channels, ..Summary::default() })
        };
        assert_eq!(topics(3, &[(1, 3), (2, 0)], &[1, 2]), Some(vec!["/1".to_owned()]));
        assert_eq!(topics(0, &[], &[1]), Some(Vec::new()));
        assert_eq!(topics(3, &[(1, 3)], &[]), None, "no channels");
        assert_eq!(topics(3, &[], &[1]), None, "no counts");
        assert_eq!(topics(3, &[(1, 2)], &[1]), None, "not all");
        assert_eq!(topics_with_messages(&Summary::default()), None);
    }
}
