//! Reads a file of a recording from beginning to end, and skips damaged parts.
//!
//! Each record begins with its length. So a damaged record, mostly a chunk, is skipped, and reading continues after it.

use super::summary::{summary, topics_with_messages};
use super::zstd::Zstd;
use mcap::read::ChannelAccumulator;
use mcap::records::{MessageHeader, Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::{MAGIC, McapError, McapResult, Message, parse_record};
use std::borrow::Cow;
use std::fs::File;
use std::io::{BufReader, ErrorKind, Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Size of the read buffer.
const BUFFER_BYTES: usize = 1 << 20;
/// Length of a record's header: its kind and length.
const RECORD_HEADER_BYTES: u64 = 9;

/// A file that is being read.
pub(super) struct Sequential {
    path: PathBuf,
    file: BufReader<File>,
    file_bytes: u64,
    reader: LinearReader,
    /// Longest record, in bytes.
    limit: usize,
    channels: ChannelAccumulator<'static>,
    /// Number of bytes read so far.
    at: u64,
    /// Offset of the record that contains this position, or of an earlier one.
    record: u64,
    /// Whether the checksum of a chunk is checked before its messages are used.
    is_checked: bool,
    /// Whether all messages were read, so that only the end of the file follows.
    is_past_data: bool,
    is_done: bool,
    messages: u64,
    /// Value of `at` when the last message was found.
    message_at: u64,
    left_out: LeftOut,
}

/// Reads the messages of a file.
pub(super) trait Reader: Iterator<Item = McapResult<Message<'static>>> + Send {
    /// Returns the damaged places so far.
    fn left_out(&self) -> &LeftOut;

    /// Whether messages come in the order of time.
    fn is_in_order(&self) -> bool;
}

/// The damaged places of a file, which were skipped.
#[derive(Default)]
pub(super) struct LeftOut {
    /// Error of the first one.
    pub first: Option<McapError>,
    pub count: u64,
}

impl LeftOut {
    pub fn add(&mut self, damage: McapError) {
        self.first.get_or_insert(damage);
        self.count += 1;
    }
}

impl Sequential {
    /// Opens a file for reading messages; records may have `limit` bytes at most.
    pub(super) fn open(path: &Path, limit: usize) -> McapResult<Self> {
        let file = File::open(path)?;
        Ok(Self {
            path: path.to_owned(),
            file_bytes: file.metadata()?.len(),
            file: BufReader::with_capacity(BUFFER_BYTES, file),
            reader: reader(limit, false, true)?,
            limit,
            channels: ChannelAccumulator::default(),
            at: 0,
            record: MAGIC.len() as u64,
            is_checked: true,
            is_past_data: false,
            is_done: false,
            messages: 0,
            message_at: 0,
            left_out: LeftOut::default(),
        })
    }

    fn read(&mut self) -> McapResult<Option<Message<'static>>> {
        loop {
            let read = match self.reader.next_event() {
                None => return Ok(None),
                Some(Ok(LinearReadEvent::ReadRequest(bytes))) => {
                    let read = read_some(&mut self.file, self.reader.insert(bytes))?;
                    self.reader.notify_read(read);
                    self.at += read as u64;
                    continue;
                }
                Some(Ok(LinearReadEvent::Record { opcode: op::DATA_END, .. })) => {
                    self.is_past_data = true;
                    continue;
                }
                // The end of the file repeats schemas and channels.
                Some(Ok(_)) if self.is_past_data => continue,
                Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                    take(opcode, data, &mut self.channels, self.left_out.count > 0)
                }
                Some(Err(error)) => Err(error),
            };
            match read {
                Ok(None) => {}
                Ok(Some(message)) => {
                    self.messages += 1;
                    self.message_at = self.at;
                    return Ok(Some(message));
                }
                Err(error) => self.pass_over(of_content(error))?,
            }
        }
    }

    /// Continues after a damaged record; returns the damage as the error if that record's length is not known.
    fn pass_over(&mut self, damage: McapError) -> McapResult<()> {
        if self.at <= MAGIC.len() as u64 || self.is_past_data {
            return Err(damage);
        }
        let Some((kind, end)) = self.find_record()? else { return Err(damage) };
        // The whole messages of a truncated chunk are used, and so are those of a chunk too long to be checked first. If some of
        // its messages were already returned, all were.
        let is_long = match damage {
            McapError::UnexpectedEof => self.at < end,
            McapError::ChunkTooLarge(_) => true,
            _ => false,
        };
        if kind == op::CHUNK && is_long && self.is_checked && self.message_at <= self.record {
            return self.go_on(self.record, false);
        }
        let summary = summary(&self.path).ok().flatten();
        let next = if end <= self.file_bytes {
            Some(end)
        } else {
            let chunks = summary.iter().flat_map(|summary| &summary.chunk_indexes);
            chunks.map(|chunk| chunk.chunk_start_offset).filter(|start| *start > self.record).min()
        };
        let Some(next) = next.filter(|next| *next < self.file_bytes) else { return Err(damage) };
        if self.left_out.count == 0 {
            // The skipped record may have described channels.
            if let Some(summary) = summary.filter(|summary| topics_with_messages(summary).is_some()) {
                self.channels = ChannelAccumulator::from_summary(&summary);
            }
        }
        self.left_out.add(damage);
        self.go_on(next, true)
    }

    /// Finds the record in which reading stopped, and returns its kind and end; `None` if the file ends in its header.
    fn find_record(&mut self) -> McapResult<Option<(u8, u64)>> {
        loop {
            self.file.seek(SeekFrom::Start(self.record))?;
            let mut header = [0; RECORD_HEADER_BYTES as usize];
            match self.file.read_exact(&mut header) {
                Err(error) if error.kind() == ErrorKind::UnexpectedEof => return Ok(None),
                read => read?,
            }
            let [kind, length @ ..] = header;
            let end = (self.record + RECORD_HEADER_BYTES).saturating_add(u64::from_le_bytes(length));
            if end >= self.at {
                return Ok(Some((kind, end)));
            }
            self.record = end;
        }
    }

    /// Continues reading at a record.
    fn go_on(&mut self, record: u64, is_checked: bool) -> McapResult<()> {
        self.file.seek(SeekFrom::Start(record))?;
        self.reader = reader(self.limit, true, is_checked)?;
        (self.at, self.record, self.is_checked) = (record, record, is_checked);
        Ok(())
    }
}

impl Reader for Sequential {
    fn left_out(&self) -> &LeftOut {
        &self.left_out
    }

    fn is_in_order(&self) -> bool {
        false
    }
}

impl Iterator for Sequential {
    type Item = McapResult<Message<'static>>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.is_done {
            return None;
        }
        let mut next = self.read();
        self.is_done = !matches!(next, Ok(Some(_)));
        // If the file has no readable message, the first damage is returned as its error.
        if self.is_done
            && self.messages == 0
            && let Some(damage) = self.left_out.first.take()
        {
            next = Err(damage);
        }
        next.transpose()
    }
}

/// Returns the message of a record, if it has one. After damage, its channel may be unknown; it is skipped then.
fn take(
    opcode: u8,
    data: &[u8],
    channels: &mut ChannelAccumulator<'static>,
    is_damaged: bool,
) -> McapResult<Option<Message<'static>>> {
    match parse_record(opcode, data)? {
        Record::Schema { header, data } => channels.add_schema(header, Cow::Owned(data.into_owned()))?,
        Record::Channel(channel) => channels.add_channel(channel)?,
        Record::Message { header, data } => {
            let MessageHeader { channel_id, sequence, log_time, publish_time } = header;
            let Some(channel) = channels.get(channel_id) else {
                let unknown = McapError::UnknownChannel(sequence, channel_id);
                return if is_damaged { Ok(None) } else { Err(unknown) };
            };
            let data = Cow::Owned(data.into_owned());
            return Ok(Some(Message { channel, sequence, log_time, publish_time, data }));
        }
        _ => {}
    }
    Ok(None)
}

/// Creates a reader for the beginning of a file, or if `is_inside` for records in the middle.
fn reader(limit: usize, is_inside: bool, is_checked: bool) -> McapResult<LinearReader> {
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(is_inside)
        .with_validate_chunk_crcs(true)
        .with_prevalidate_chunk_crcs(is_checked)
        .with_record_length_limit(limit);
    let mut reader = LinearReader::new_with_options(options);
    reader.add_decompressor(Zstd::default())?;
    Ok(reader)
}

fn read_some(file: &mut impl Read, target: &mut [u8]) -> std::io::Result<usize> {
    loop {
        match file.read(target) {
            Err(error) if error.kind() == ErrorKind::Interrupted => {}
            read => return read,
        }
    }
}

/// Turns an I/O error into one of the content: lz4 reports damaged data as an I/O error.
pub(super) fn of_content(error: McapError) -> McapError {
    match error {
        McapError::Io(error) => McapError::DecompressionError(error.to_string()),
        other => other,
    }
}
