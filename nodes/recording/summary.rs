//! What stands at the end of a file of a recording: what is in it, and where.

use mcap::sans_io::summary_reader::{SummaryReadEvent, SummaryReader};
use mcap::{McapResult, Summary};
use std::fs::File;
use std::io::{Read, Seek};
use std::path::Path;

/// Longest record: the largest image of single precision has 256 MB.
pub(super) const MAX_RECORD_BYTES: u64 = 512 << 20;

/// What the end of a file tells of it; none where it tells nothing.
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
