//! The messages of MCAP files, in the order in which they were written: of one file, or of a folder of them as `rosbag2` makes it.
//!
//! A file that ends in the middle, because who wrote it was killed, is read up to its last whole message, and that is said.

use super::zstd::Zstd;
use crate::sources::image_source::natural;
use anyhow::{Context as _, Result, bail};
use conicflow_messages::Hinted;
use mcap::sans_io::linear_reader::LinearReaderOptions;
use mcap::sans_io::summary_reader::{SummaryReadEvent, SummaryReader};
use mcap::{Channel, McapError, McapResult, Message, Summary};
use std::collections::BTreeMap;
use std::fmt::Display;
use std::fs::{self, File};
use std::io::{BufReader, ErrorKind, Read, Seek};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// Longest record: the largest image of single precision has 256 MB.
const MAX_RECORD_BYTES: u64 = 512 << 20;
/// No compression makes more of a byte than lz4's 255.
const MAX_EXPANSION: u64 = 256;
/// Read at once.
const BUFFER_BYTES: usize = 1 << 20;
/// How a file that is compressed as a whole ends.
const COMPRESSED: [&str; 2] = ["zstd", "lz4"];

/// The files of a recording.
#[derive(Clone, Debug)]
pub struct Files(Vec<PathBuf>);

/// A channel of a recording.
#[derive(Clone, Debug)]
pub struct Seen {
    /// What it tells of itself.
    pub channel: Arc<Channel<'static>>,
    /// Its first message.
    pub first: Vec<u8>,
}

impl Seen {
    /// The name of its message type.
    pub fn schema(&self) -> &str {
        self.channel.schema.as_ref().map_or("", |schema| &schema.name)
    }
}

impl Files {
    /// The files at `path`: one, or those of a folder in natural order.
    ///
    /// # Errors
    /// There are none, or they are of another format.
    pub fn find(path: &Path) -> Result<Self> {
        if !path.is_dir() {
            refuse_other_formats(path)?;
            return Ok(Self(vec![path.to_owned()]));
        }
        let entries = fs::read_dir(path).with_context(|| format!("the folder `{}`", path.display()))?;
        let mut paths = entries.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>()?;
        let name =
            |path: &PathBuf| path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        paths.sort_by(|a, b| natural::compare(&name(a), &name(b)));
        let recordings: Vec<_> = paths.iter().filter(|path| is_recording(path)).cloned().collect();
        if recordings.is_empty() {
            paths.iter().try_for_each(|path| refuse_other_formats(path))?;
            bail!(Hinted::new(
                format!("no MCAP files in `{}`", path.display()),
                "name a file, or a folder that `ros2 bag record -s mcap` wrote"
            ));
        }
        Ok(Self(recordings))
    }

    /// Each channel that has messages, with the first of them, by topic.
    ///
    /// # Errors
    /// A file cannot be read, or holds no MCAP.
    pub fn survey(&self) -> Result<Vec<Seen>> {
        let mut seen = BTreeMap::<String, Seen>::new();
        for path in &self.0 {
            // Where the file says what it has, it need not be read to its end.
            let topics = summary(path).ok().flatten().map(|summary| topics_with_messages(&summary));
            for (count, message) in (0..).zip(OpenFile::open(path)?) {
                if topics.as_ref().is_some_and(|topics| topics.iter().all(|topic| seen.contains_key(topic))) {
                    break;
                }
                match message {
                    Ok(Message { channel, data, .. }) => {
                        let topic = channel.topic.clone();
                        seen.entry(topic).or_insert_with(|| Seen { channel, first: data.into_owned() });
                    }
                    // It is said when the file is played.
                    Err(error) => {
                        damage(&error, &path.display(), count, self.0.len() == 1)?;
                        break;
                    }
                }
            }
        }
        Ok(seen.into_values().collect())
    }

    /// The messages of some topics.
    pub fn messages(&self, topics: &[&str]) -> Messages {
        let topics = topics.iter().map(|&topic| topic.to_owned()).collect();
        let is_only = self.0.len() == 1;
        Messages { left: self.0.clone().into_iter(), open: None, topics, is_only, is_told: false }
    }

    /// The same, with not a word on files that end in the middle.
    pub fn messages_again(&self, topics: &[&str]) -> Messages {
        Messages { is_told: true, ..self.messages(topics) }
    }
}

/// Whether this is a file that [`Files`] reads.
pub fn is_recording(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("mcap"))
}

/// Whether this is a recording of robots, in a format that is read, or in one of which is told how it is converted.
pub fn looks_like_recording(path: &Path) -> bool {
    let is_one = |path: &Path| is_recording(path) || refuse_other_formats(path).is_err();
    is_one(path) || fs::read_dir(path).is_ok_and(|entries| entries.flatten().any(|entry| is_one(&entry.path())))
}

/// The command that makes an MCAP file of what is none.
fn refuse_other_formats(path: &Path) -> Result<()> {
    let shown = path.display();
    let (stem, folder) = (path.with_extension(""), path.parent().filter(|folder| *folder != Path::new("")));
    let (kind, from) = match path.extension().and_then(|extension| extension.to_str()) {
        Some("db3") => ("a rosbag2 recording in SQLite", folder.unwrap_or(Path::new("."))),
        Some("bag") => ("a ROS 1 recording", path),
        Some(code) if COMPRESSED.contains(&code) && is_recording(&stem) => {
            bail!(Hinted::new(format!("`{shown}` is compressed as a whole"), format!("{code} -d '{shown}'")));
        }
        _ => return Ok(()),
    };
    let to = if kind.contains("rosbag2") { from.with_extension("mcap") } else { stem };
    bail!(Hinted::new(
        format!("`{shown}` is {kind}, expected MCAP"),
        format!(
            "pip install rosbags && rosbags-convert --src '{}' --dst '{}' --dst-storage mcap",
            from.display(),
            to.display()
        )
    ))
}

/// What the end of a file tells of it; none where it tells nothing.
fn summary(path: &Path) -> McapResult<Option<Summary>> {
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

fn topics_with_messages(summary: &Summary) -> Vec<String> {
    let counts = summary.stats.iter().flat_map(|stats| &stats.channel_message_counts);
    let with_messages = counts.filter(|(_, count)| **count > 0);
    with_messages.filter_map(|(id, _)| Some(summary.channels.get(id)?.topic.clone())).collect()
}

/// A file that is being read.
struct OpenFile {
    path: PathBuf,
    reader: mcap::io::MessageReader<BufReader<File>>,
}

impl OpenFile {
    fn open(path: &Path) -> Result<Self> {
        let open = || {
            let file = File::open(path)?;
            let limit = (file.metadata()?.len().saturating_mul(MAX_EXPANSION)).min(MAX_RECORD_BYTES);
            let options = LinearReaderOptions::default()
                .with_validate_chunk_crcs(true)
                .with_record_length_limit(usize::try_from(limit).unwrap_or(usize::MAX));
            let source = BufReader::with_capacity(BUFFER_BYTES, file);
            let mut reader = mcap::io::MessageReader::new_with_options(source, options);
            reader.add_decompressor(Zstd::default())?;
            Ok::<_, McapError>(Self { path: path.to_owned(), reader })
        };
        open().with_context(|| format!("`{}`", path.display()))
    }
}

impl Iterator for OpenFile {
    type Item = McapResult<Message<'static>>;

    fn next(&mut self) -> Option<Self::Item> {
        self.reader.next()
    }
}

/// Messages of some topics, file after file.
pub struct Messages {
    left: std::vec::IntoIter<PathBuf>,
    open: Option<(OpenFile, u64)>,
    topics: Vec<String>,
    /// Whether there is but one file.
    is_only: bool,
    /// Whether it was said that a file ends in the middle.
    is_told: bool,
}

impl Messages {
    fn read(&mut self) -> Result<Option<Message<'static>>> {
        loop {
            let Some((file, count)) = &mut self.open else {
                let Some(path) = self.left.next() else { return Ok(None) };
                self.open = Some((OpenFile::open(&path)?, 0));
                continue;
            };
            match file.next() {
                Some(Ok(message)) => {
                    *count += 1;
                    if self.topics.contains(&message.channel.topic) {
                        return Ok(Some(message));
                    }
                }
                None => self.open = None,
                Some(Err(error)) => {
                    let damage = damage(&error, &file.path.display(), *count, self.is_only)?;
                    if !self.is_told {
                        tracing::warn!("{damage}");
                    }
                    self.open = None;
                }
            }
        }
    }
}

impl Iterator for Messages {
    type Item = Result<Message<'static>>;

    fn next(&mut self) -> Option<Self::Item> {
        self.read().transpose()
    }
}

/// What is said of a file that ends or is broken in the middle; it is an error where it is no MCAP, or the only one and nothing
/// of it can be read.
fn damage(error: &McapError, path: &impl Display, count: u64, is_only: bool) -> Result<String> {
    let what = match error {
        McapError::BadMagic if count == 0 => {
            bail!(Hinted::new(format!("`{path}` is no MCAP file"), "does its name say what it is?"))
        }
        McapError::Io(error) if error.kind() != ErrorKind::UnexpectedEof => {
            bail!(Hinted::new(format!("`{path}` cannot be read: {error}"), "may this user read it?"))
        }
        McapError::UnsupportedCompression(name) => {
            bail!(Hinted::new(
                format!("`{path}` is compressed by `{name}`, expected `lz4` or `zstd`"),
                "mcap compress --compression zstd"
            ))
        }
        McapError::UnexpectedEof | McapError::UnexpectedEoc | McapError::Io(_) | McapError::BadMagic => {
            "ends in the middle".to_owned()
        }
        other => format!("is damaged ({other})"),
    };
    match count {
        0 if is_only => {
            bail!(Hinted::new(format!("`{path}` {what}, before its first message"), "record it anew, or copy it again"))
        }
        0 => Ok(format!("`{path}` {what}, before its first message: it is left out")),
        _ => Ok(format!("`{path}` {what}: its first {count} messages are used")),
    }
}
