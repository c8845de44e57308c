//! Reads the messages of MCAP files in the order in which they were written: of one file, or of a folder of files as `rosbag2`
//! makes it.
//!
//! A file that ends in the middle, because its writer was killed, is read up to its last whole message, and that is logged. So
//! are damaged parts that are skipped.

use super::indexed::Indexed;
use super::sequential::{Reader, Sequential};
use super::summary::{MAX_RECORD_BYTES, summary, topics_with_messages};
use anyhow::{Context as _, Error, Result, bail};
use conicflow_dataflow::{Stop, lock};
use conicflow_messages::{Hinted, is_special};
use mcap::{Channel, McapError, Message, Summary};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Display;
use std::fs::{self, File};
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

/// Largest ratio of the sizes before and after compression: lz4 makes 255 bytes of one.
const MAX_EXPANSION: u64 = 256;
/// Endings of files that are compressed as a whole.
const COMPRESSED: [&str; 2] = ["zstd", "lz4"];

/// The files of a recording.
#[derive(Clone, Debug)]
pub struct Files {
    /// The paths, and the length of each file when it was found, in bytes.
    files: Vec<(PathBuf, u64)>,
    /// Asked while reading, to show that the stage is alive: the next message may be gigabytes away.
    stop: Stop,
}

/// A channel of a recording.
#[derive(Clone, Debug)]
pub struct SurveyedChannel {
    /// Its description in the file.
    pub channel: Arc<Channel<'static>>,
    /// Its first message.
    pub first: Vec<u8>,
}

impl SurveyedChannel {
    /// The name of its message type.
    pub fn schema(&self) -> &str {
        self.channel.schema.as_ref().map_or("", |schema| &schema.name)
    }
}

impl Files {
    /// Finds the files at `path`: a single one, or those of a folder in natural order.
    ///
    /// # Errors
    /// There are no files, or they are of another format.
    pub fn find(path: &Path) -> Result<Self> {
        if !path.is_dir() {
            refuse_special(path)?;
            refuse_other_formats(path)?;
            return Ok(Self { files: vec![with_length(path.to_owned())], stop: Stop::default() });
        }
        let entries = fs::read_dir(path).with_context(|| format!("the folder `{}`", path.display()))?;
        let mut paths = entries.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>()?;
        alphanumeric_sort::sort_path_slice(&mut paths);
        let recordings: Vec<_> = paths.iter().filter(|path| is_recording(path)).cloned().collect();
        if recordings.is_empty() {
            paths.iter().try_for_each(|path| refuse_other_formats(path))?;
            bail!(Hinted::new(
                format!("no MCAP files in `{}`", path.display()),
                "name a file, or a folder that `ros2 bag record -s mcap` wrote"
            ));
        }
        recordings.iter().try_for_each(|path| refuse_special(path))?;
        Ok(Self { files: recordings.into_iter().map(with_length).collect(), stop: Stop::default() })
    }

    /// Returns the files for a stage, which shows that it is alive while it reads.
    #[must_use]
    pub fn of_stage(self, stop: &Stop) -> Self {
        Self { stop: stop.clone(), ..self }
    }

    /// Returns the paths of the files.
    pub fn paths(&self) -> impl Iterator<Item = &PathBuf> {
        self.files.iter().map(|(path, _)| path)
    }

    /// Returns each channel that has messages, with its first message, by topic.
    ///
    /// # Errors
    /// A file cannot be read, or is no MCAP file.
    pub fn survey(&self) -> Result<Vec<SurveyedChannel>> {
        let mut seen = BTreeMap::<String, SurveyedChannel>::new();
        for path in self.paths() {
            // A file whose summary names its topics need not be read to its end.
            let topics = summary(path).ok().flatten().and_then(|summary| topics_with_messages(&summary));
            for (count, message) in (0..).zip(OpenFile::open(path)?.reader) {
                self.stop.requested();
                if topics.as_ref().is_some_and(|topics| topics.iter().all(|topic| seen.contains_key(topic))) {
                    break;
                }
                match message {
                    Ok(Message { channel, data, .. }) => {
                        let topic = channel.topic.clone();
                        seen.entry(topic).or_insert_with(|| SurveyedChannel { channel, first: data.into_owned() });
                    }
                    // The damage is logged when the file is played.
                    Err(error) => {
                        damage(&error, &path.display(), count, self.files.len() == 1)?;
                        break;
                    }
                }
            }
        }
        Ok(seen.into_values().collect())
    }

    /// Returns the channels if every file has a summary, so that little of it has to be read.
    pub fn survey_of_complete(&self) -> Option<Vec<SurveyedChannel>> {
        let is_complete = |path: &PathBuf| summary(path).is_ok_and(|summary| summary.is_some());
        if self.paths().all(is_complete) { self.survey().ok() } else { None }
    }

    /// Returns the messages of some topics.
    pub fn messages(&self, topics: &[&str]) -> Messages {
        let topics = topics.iter().map(|&topic| topic.to_owned()).collect();
        let is_only = self.files.len() == 1;
        let left = self.files.clone().into_iter();
        let stop = self.stop.clone();
        Messages {
            left,
            open: None,
            topics,
            from_ns: None,
            until_ns: None,
            is_only,
            is_reported: false,
            damaged: 0,
            stop,
        }
    }

    /// Returns the same messages, without log lines about damaged files.
    pub fn messages_again(&self, topics: &[&str]) -> Messages {
        Messages { is_reported: true, ..self.messages(topics) }
    }

    /// Returns the log times of the first and the last message; `None` if there are no messages.
    ///
    /// # Errors
    /// A file cannot be read, or is no MCAP file.
    pub fn span_ns(&self) -> Result<Option<(u64, u64)>> {
        let mut span: Option<(u64, u64)> = None;
        let mut reach = |begin: u64, end: u64| {
            let (first, last) = span.unwrap_or((begin, end));
            span = Some((first.min(begin), last.max(end)));
        };
        for path in self.paths() {
            let stats = summary(path).ok().flatten().and_then(|summary| summary.stats);
            if let Some(stats) = stats.filter(|stats| stats.message_count > 0) {
                reach(stats.message_start_time, stats.message_end_time);
                continue;
            }
            for (count, message) in (0..).zip(OpenFile::open(path)?.reader) {
                match message {
                    Ok(message) => reach(message.log_time, message.log_time),
                    Err(error) => {
                        damage(&error, &path.display(), count, self.files.len() == 1)?;
                        break;
                    }
                }
            }
        }
        Ok(span)
    }
}

/// Returns a file with its length in bytes.
pub(super) fn with_length(path: PathBuf) -> (PathBuf, u64) {
    // A file that cannot be opened is reported when it is read.
    let length = path.metadata().map_or(0, |about| about.len());
    (path, length)
}

/// Whether this is a file that [`Files`] reads.
pub fn is_recording(path: &Path) -> bool {
    path.extension().is_some_and(|extension| extension.eq_ignore_ascii_case("mcap"))
}

/// Whether this is a recording of a robot, in MCAP or in a format for which the error names a converter.
pub fn looks_like_recording(path: &Path) -> bool {
    let is_one = |path: &Path| is_recording(path) || refuse_other_formats(path).is_err();
    is_one(path) || fs::read_dir(path).is_ok_and(|entries| entries.flatten().any(|entry| is_one(&entry.path())))
}

/// Refuses a device or a pipe, which may have no end.
fn refuse_special(path: &Path) -> Result<()> {
    if is_special(path) {
        bail!(Hinted::new(format!("`{}` is no file", path.display()), "a recording is a file, or a folder of files"));
    }
    Ok(())
}

/// Refuses files of other formats, with the command that converts them to MCAP as the hint.
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
    // `.` has no name to add an ending to.
    let named = if from.file_name().is_some() { from.to_owned() } else { fs::canonicalize(from)? };
    let to = if kind.contains("rosbag2") { named.with_extension("mcap") } else { stem };
    bail!(Hinted::new(
        format!("`{shown}` is {kind}, expected MCAP"),
        format!(
            "pip install rosbags && rosbags-convert --src '{}' --dst '{}' --dst-storage mcap",
            from.display(),
            to.display()
        )
    ))
}

/// A file that is being read: from beginning to end, or from some time on by its index.
struct OpenFile {
    path: PathBuf,
    reader: Box<dyn Reader>,
}

impl OpenFile {
    fn open(path: &Path) -> Result<Self> {
        let open = || Sequential::open(path, longest_record(&File::open(path)?)?);
        let reader = open().with_context(|| format!("`{}`", path.display()))?;
        Ok(Self { path: path.to_owned(), reader: Box::new(reader) })
    }

    /// Opens a file for the messages of some topics from `from_ns` on; without an index, for all messages.
    fn open_from(path: &Path, topics: &[String], from_ns: u64) -> Result<Self> {
        let is_indexed =
            |summary: &Summary| !summary.chunk_indexes.is_empty() && topics_with_messages(summary).is_some();
        let Some(summary) = summary(path).ok().flatten().filter(is_indexed) else { return Self::open(path) };
        let limit = longest_record(&File::open(path)?)?;
        let reader = Indexed::open(path, summary, topics, from_ns, limit);
        let reader = reader.with_context(|| format!("`{}`", path.display()))?;
        Ok(Self { path: path.to_owned(), reader: Box::new(reader) })
    }
}

/// Returns the length limit for records, in bytes: no record of this file can be longer.
fn longest_record(file: &File) -> std::io::Result<usize> {
    let limit = (file.metadata()?.len().saturating_mul(MAX_EXPANSION)).min(MAX_RECORD_BYTES);
    Ok(usize::try_from(limit).unwrap_or(usize::MAX))
}

/// Messages of some topics, file after file.
pub struct Messages {
    left: std::vec::IntoIter<(PathBuf, u64)>,
    /// The current file, its length when it was found, and the number of its messages so far.
    open: Option<(OpenFile, u64, u64)>,
    topics: Vec<String>,
    /// Messages that were written before this time are left out.
    from_ns: Option<u64>,
    /// Messages that were written at this time or later are left out.
    until_ns: Option<u64>,
    /// Whether there is only one file.
    is_only: bool,
    /// Whether damage was already logged.
    is_reported: bool,
    /// Number of damaged places in the files before this one.
    damaged: u64,
    stop: Stop,
}

impl Messages {
    /// Restricts the messages to those written at `from_ns` or later, and before `until_ns`. Of a file with an index only the
    /// necessary parts are read, in the order of time.
    #[must_use]
    pub fn between(self, from_ns: u64, until_ns: Option<u64>) -> Self {
        Self { from_ns: Some(from_ns), until_ns, ..self }
    }

    /// Number of damaged places skipped so far.
    pub fn damaged(&self) -> u64 {
        self.damaged + self.open.as_ref().map_or(0, |(file, ..)| file.reader.left_out().count)
    }

    fn read(&mut self) -> Result<Option<Message<'static>>> {
        loop {
            let Some((file, length, count)) = &mut self.open else {
                let Some((path, length)) = self.left.next() else { return Ok(None) };
                let file = match self.from_ns {
                    Some(from_ns) => OpenFile::open_from(&path, &self.topics, from_ns),
                    None => OpenFile::open(&path),
                };
                let is_gone = || gone(&format!("`{}` is not there any more", path.display()));
                let file = file.map_err(|error| if path.exists() { error } else { is_gone() })?;
                self.open = Some((file, length, 0));
                continue;
            };
            self.stop.requested();
            let next = file.reader.next();
            if let Some(damage) = &file.reader.left_out().first
                && is_first_of(&file.path)
            {
                tracing::warn!("`{}` is damaged ({damage}): what is whole in it is used", file.path.display());
            }
            match next {
                Some(Ok(message)) => {
                    *count += 1;
                    let is_early = self.from_ns.is_some_and(|from_ns| message.log_time < from_ns);
                    let is_late = self.until_ns.is_some_and(|until_ns| message.log_time >= until_ns);
                    if is_late && file.reader.is_in_order() {
                        self.close();
                    } else if !is_early && !is_late && self.topics.contains(&message.channel.topic) {
                        return Ok(Some(message));
                    }
                }
                None => self.close(),
                Some(Err(_)) if file.path.metadata().is_ok_and(|about| about.len() < *length) => {
                    let (path, count) = (file.path.display(), *count);
                    return Err(gone(&format!("`{path}` has become shorter, and ends after {count} messages")));
                }
                Some(Err(error)) => {
                    // The messages before `from_ns` were not read, so that the file may have some.
                    let is_only = self.is_only && self.from_ns.is_none();
                    let damage = damage(&error, &file.path.display(), *count, is_only)?;
                    if !self.is_reported {
                        tracing::warn!("{damage}");
                    }
                    self.close();
                }
            }
        }
    }

    /// Closes the file, so that the next one is opened.
    fn close(&mut self) {
        self.damaged = self.damaged();
        self.open = None;
    }
}

impl Iterator for Messages {
    type Item = Result<Message<'static>>;

    fn next(&mut self) -> Option<Self::Item> {
        self.read().transpose()
    }
}

/// Returns the error for a file that was complete when the recording was opened; reading it again would not help.
fn gone(what: &impl Display) -> Error {
    Hinted::lasting(format!("{what:#}"), "leave a recording as it is while it is played, and its disk in its place")
        .into()
}

/// Whether damage in a file was not logged yet: a file is read anew for each jump, and by several readers.
fn is_first_of(path: &Path) -> bool {
    static TOLD: Mutex<BTreeSet<PathBuf>> = Mutex::new(BTreeSet::new());
    lock(&TOLD).insert(path.to_owned())
}

/// Returns the log line about a file that ends or is damaged in the middle. It is an error if the file is no MCAP file, or if it
/// is the only one and nothing of it can be read.
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
