//! Reads a file of a recording from some time on, by the index at its end, in the order of time.
//!
//! `mcap` does not check the checksum of a chunk here, since it stands in the chunk's header. It is checked before the chunk is
//! used.

use super::sequential::{LeftOut, Reader, of_content};
use super::zstd::Zstd;
use mcap::records::MessageHeader;
use mcap::sans_io::indexed_reader::{IndexedReadEvent, IndexedReader, IndexedReaderOptions};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{McapError, McapResult, Message, Summary};
use std::borrow::Cow;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;
use std::sync::Arc;

/// A file that is being read.
pub(super) struct Indexed {
    file: File,
    file_bytes: u64,
    summary: Summary,
    wanted: Wanted,
    reader: IndexedReader,
    chunk: Vec<u8>,
    /// Log time of the last message, and the number of messages with that time.
    last: (u64, usize),
    /// Number of messages with that time to skip after the reader was replaced.
    again: usize,
    left_out: LeftOut,
}

/// The part of a file that is read.
struct Wanted {
    topics: Vec<String>,
    /// Longest record, in bytes.
    limit: usize,
}

impl Wanted {
    fn reader(&self, summary: &Summary, from_ns: u64) -> McapResult<IndexedReader> {
        let options = IndexedReaderOptions::new()
            .include_topics(self.topics.iter().cloned())
            .starting_at(from_ns)
            .with_record_length_limit(self.limit);
        let mut reader = IndexedReader::new_with_options(summary, options)?;
        reader.add_decompressor(Zstd::default())?;
        Ok(reader)
    }
}

impl Indexed {
    /// Opens the file for the messages of some topics from `from_ns` on, by log time.
    pub(super) fn open(
        path: &Path,
        summary: Summary,
        topics: &[String],
        from_ns: u64,
        limit: usize,
    ) -> McapResult<Self> {
        let wanted = Wanted { topics: topics.to_vec(), limit };
        let reader = wanted.reader(&summary, from_ns)?;
        let file = File::open(path)?;
        Ok(Self {
            file_bytes: file.metadata()?.len(),
            file,
            summary,
            wanted,
            reader,
            chunk: Vec::new(),
            last: (from_ns, 0),
            again: 0,
            left_out: LeftOut::default(),
        })
    }

    fn read(&mut self) -> McapResult<Option<Message<'static>>> {
        loop {
            let (offset, length) = match self.reader.next_event().transpose().map_err(of_content)? {
                None => return Ok(None),
                Some(IndexedReadEvent::ReadChunkRequest { offset, length }) => (offset, length),
                Some(IndexedReadEvent::Message { .. }) if self.again > 0 => {
                    self.again -= 1;
                    continue;
                }
                Some(IndexedReadEvent::Message { header, data }) => {
                    let MessageHeader { channel_id, sequence, log_time, publish_time } = header;
                    let before = if self.last.0 == log_time { self.last.1 } else { 0 };
                    self.last = (log_time, before + 1);
                    let channel = self.summary.channels.get(&channel_id);
                    let channel = Arc::clone(channel.ok_or(McapError::UnknownChannel(sequence, channel_id))?);
                    let data = Cow::Owned(data.to_vec());
                    return Ok(Some(Message { channel, sequence, log_time, publish_time, data }));
                }
            };
            if let Err(damage) = self.read_chunk(offset, length)? {
                self.leave_out(offset, damage)?;
            }
        }
    }

    /// Reads the chunk whose content is at `offset`. The outer error is one of the file, the inner one is one of its content.
    fn read_chunk(&mut self, offset: u64, length: usize) -> McapResult<McapResult<()>> {
        let mut chunks = self.summary.chunk_indexes.iter();
        let chunk = chunks.find(|chunk| chunk.compressed_data_offset().ok() == Some(offset));
        let start = chunk.map_or(offset, |chunk| chunk.chunk_start_offset);
        let Some(end) = offset.checked_add(length as u64).filter(|end| *end <= self.file_bytes) else {
            return Ok(Err(McapError::UnexpectedEof));
        };
        self.file.seek(SeekFrom::Start(start))?;
        self.chunk.resize((end - start) as usize, 0);
        self.file.read_exact(&mut self.chunk)?;
        let content = &self.chunk[(offset - start) as usize..];
        let checked = check_sum(&self.chunk, self.wanted.limit);
        Ok(checked.and_then(|()| self.reader.insert_chunk_record_data(offset, content)).map_err(of_content))
    }

    /// Continues without a damaged chunk.
    fn leave_out(&mut self, offset: u64, damage: McapError) -> McapResult<()> {
        self.summary.chunk_indexes.retain(|chunk| chunk.compressed_data_offset().ok() != Some(offset));
        self.reader = self.wanted.reader(&self.summary, self.last.0)?;
        self.again = self.last.1;
        self.left_out.add(damage);
        Ok(())
    }
}

/// Checks the checksum of a chunk, if it has one and is not too long.
fn check_sum(chunk: &[u8], limit: usize) -> McapResult<()> {
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_validate_chunk_crcs(true)
        .with_prevalidate_chunk_crcs(true)
        .with_record_length_limit(limit);
    let (mut reader, mut left) = (LinearReader::new_with_options(options), chunk);
    reader.add_decompressor(Zstd::default())?;
    loop {
        match reader.next_event() {
            Some(Ok(LinearReadEvent::ReadRequest(bytes))) => {
                let read = left.read(reader.insert(bytes))?;
                reader.notify_read(read);
            }
            // Records of a chunk come only after all of it was checked.
            Some(Ok(LinearReadEvent::Record { .. }) | Err(McapError::ChunkTooLarge(_))) | None => return Ok(()),
            Some(Err(error)) => return Err(error),
        }
    }
}

impl Reader for Indexed {
    fn left_out(&self) -> &LeftOut {
        &self.left_out
    }

    fn is_in_order(&self) -> bool {
        true
    }
}

impl Iterator for Indexed {
    type Item = McapResult<Message<'static>>;

    fn next(&mut self) -> Option<Self::Item> {
        self.read().transpose()
    }
}
