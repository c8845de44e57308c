//! Reads a file of a recording from some time on, by what its end tells of where its messages are: in the order of their times.

use super::zstd::Zstd;
use mcap::sans_io::indexed_reader::{IndexedReadEvent, IndexedReader, IndexedReaderOptions};
use mcap::{McapError, McapResult, Message, Summary};
use std::borrow::Cow;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::Arc;

/// A file that is being read.
pub(super) struct Indexed {
    file: File,
    summary: Summary,
    reader: IndexedReader,
    chunk: Vec<u8>,
}

impl Indexed {
    /// The messages of some topics from `from_ns` on, by the time when they were written.
    pub(super) fn open(
        path: &Path,
        summary: Summary,
        topics: &[String],
        from_ns: u64,
        limit: usize,
    ) -> McapResult<Self> {
        let options = IndexedReaderOptions::new()
            .include_topics(topics.iter().cloned())
            .starting_at(from_ns)
            .with_record_length_limit(limit);
        let mut reader = IndexedReader::new_with_options(&summary, options)?;
        reader.add_decompressor(Zstd::default())?;
        Ok(Self { file: File::open(path)?, summary, reader, chunk: Vec::new() })
    }

    fn read(&mut self) -> McapResult<Option<Message<'static>>> {
        loop {
            let (offset, length) = match self.reader.next_event().transpose()? {
                None => return Ok(None),
                Some(IndexedReadEvent::ReadChunkRequest { offset, length }) => (offset, length),
                Some(IndexedReadEvent::Message { header, data }) => {
                    let channel = self.summary.channels.get(&header.channel_id);
                    let channel = channel.ok_or(McapError::UnknownChannel(header.sequence, header.channel_id))?;
                    return Ok(Some(Message {
                        channel: Arc::clone(channel),
                        sequence: header.sequence,
                        log_time: header.log_time,
                        publish_time: header.publish_time,
                        data: Cow::Owned(data.to_vec()),
                    }));
                }
            };
            self.file.seek(SeekFrom::Start(offset))?;
            self.chunk.resize(length, 0);
            self.file.read_exact(&mut self.chunk)?;
            self.reader.insert_chunk_record_data(offset, &self.chunk)?;
        }
    }
}

impl Iterator for Indexed {
    type Item = McapResult<Message<'static>>;

    fn next(&mut self) -> Option<Self::Item> {
        self.read().transpose()
    }
}
