//! Writes a recording: each message both in forms that other programs show, and as it is, byte by byte.
//!
//! For the messages of `topic` about frames of the source stage `origin`, the channels `/origin/topic/...` hold
//!
//! | channel | content |
//! |---|---|
//! | `message` | our own message, of a depth image the header alone |
//! | `image_rect_raw`, `camera_info` | the depth image, in millimetres where these are its units, else in metres |
//! | `markers` | objects and tracks as RViz and Foxglove draw them |
//! | `points` | points on their surfaces, for viewers without markers, such as Rerun |
//! | `list` | short lists with all numbers by name, those of the lines of `json_sink` |
//!
//! and `/tf` has the pose of the camera. All messages of a frame have its stamp. A message is in the file within a second, or
//! when the recorder is flushed, in whole chunks: a reader of the file of a killed recorder finds everything until then. An
//! earlier recording stays until the first message comes. Each file names the run that wrote it.

use super::files::with_length;
use super::own::{self, ENCODING, IMAGE, MESSAGE, SCHEMA};
use super::summary::MAX_RECORD_BYTES;
use anyhow::{Context as _, Error, Result};
use conicflow_dataflow::{AnyMessage, FileUse, ItemType, lock};
use conicflow_messages::{
    ABSENT, Fields, Header, Hinted, INVALID_FAR, INVALID_NEAR, LateFile, Object, Text, Track, is_special,
};
use conicflow_ros::{
    CAMERA_INFO, CameraInfo, Definition, IMAGE as IMAGE_TYPE, MARKER_ARRAY, Marked, Markers, POINT_CLOUD, Stamped,
    TF_MESSAGE, list_definition, markers, surface_points, write_list, write_metres, write_transform, write_units,
};
use mcap::records::{MessageHeader, Metadata, Record};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use mcap::write::NoSeek;
use mcap::{Compression, McapError, WriteOptions, Writer, parse_record};
use std::collections::{BTreeMap, VecDeque};
use std::fs::{self, File};
use std::io::{self, ErrorKind, Read as _, Write};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, Weak};
use std::thread;
use std::time::{Duration, Instant};

/// Longest time that a message waits in memory before it is in the file.
const FLUSH: Duration = Duration::from_millis(900);
/// Period of the checks whether something waits to be flushed.
const FLUSH_CHECK_PERIOD: Duration = Duration::from_millis(100);
/// The coordinate frame of the poses.
const WORLD: &str = "world";
/// Name for frames that no stage has put its name to.
const NAMELESS: &str = "camera";
/// Encoding of a schema that consists of a name only.
const NAME_ALONE: &str = "";
/// The name of the metadata record of a file.
const ABOUT: &str = "conicflow";
/// The key of the run in the metadata record of a file.
const RUN: &str = "run";
/// The unit of 16-bit depth images in ROS, in metres.
const MILLIMETRE: f64 = 0.001;

/// Limits on the length and size of the files.
#[derive(Clone, Copy, Debug, Default)]
pub struct Limits {
    /// Number of bytes after which another file begins.
    pub split_bytes: Option<u64>,
    /// Time span of the frames' stamps after which another file begins.
    pub split_ns: Option<u64>,
    /// Limit for all files together: the oldest is removed, or where there is but one, the recording ends.
    pub total_bytes: Option<u64>,
}

impl Limits {
    /// Whether a file may be followed by another.
    fn has_several_files(&self) -> bool {
        self.split_bytes.is_some() || self.split_ns.is_some()
    }
}

/// The outcome of writing a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Recorded {
    /// The message was written.
    Written,
    /// The recording has reached its limit.
    Full,
}

/// Writes a recording.
pub struct Recorder {
    files: Arc<Mutex<Files>>,
}

/// The files of a recording.
struct Files {
    path: PathBuf,
    limits: Limits,
    run: u64,
    /// The first file, until the first message comes.
    first: Option<FirstFile>,
    open: Option<OpenFile>,
    /// Number of the next file, from 0.
    next: u64,
    /// Complete files and their sizes in bytes.
    complete: VecDeque<(PathBuf, u64)>,
    is_full: bool,
    /// An error of flushing in the background, which the next call returns.
    failure: Option<Error>,
    memory: Vec<u8>,
}

/// The first file, opened for writing, with nothing written yet.
struct FirstFile {
    path: PathBuf,
    file: LateFile,
    /// The files of an earlier recording, which it replaces.
    earlier: Vec<PathBuf>,
}

/// A file that is being written.
struct OpenFile {
    path: PathBuf,
    writer: Writer<NoSeek<Counted>>,
    file: Arc<File>,
    bytes: Arc<AtomicU64>,
    /// Number of bytes in whole chunks.
    whole: u64,
    torn: Arc<AtomicBool>,
    channels: BTreeMap<String, u16>,
    /// Stamp of the first frame in the file.
    begin_ns: Option<u64>,
    /// Epoch and sequence number of the last frame of each origin whose pose was written.
    placed: BTreeMap<Text<32>, (u64, u64)>,
    /// Since when something waits to be flushed.
    unflushed_since: Option<Instant>,
}

/// A file that counts the bytes written into it.
struct Counted {
    file: Arc<File>,
    bytes: Arc<AtomicU64>,
    /// Set when a write has failed: nothing may follow.
    torn: Arc<AtomicBool>,
}

impl Write for Counted {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        if self.torn.load(Ordering::Relaxed) {
            return Err(ErrorKind::WriteZero.into());
        }
        let written = (&*self.file).write(bytes)?;
        self.bytes.fetch_add(written as u64, Ordering::Relaxed);
        Ok(written)
    }

    fn flush(&mut self) -> io::Result<()> {
        (&*self.file).flush()
    }
}

impl Recorder {
    /// Creates a recording of `run` at `path`, and its folder if that is missing. If `goes_on`, because an earlier process of
    /// that run has written files already, it continues behind these; else it begins anew. A recording that may have several
    /// files replaces all files of an earlier one with its first message.
    ///
    /// # Errors
    /// The file cannot be created or written.
    pub fn create(path: &Path, limits: Limits, run: u64, goes_on: bool) -> Result<Self> {
        let existing = files_at(path, goes_on || limits.has_several_files());
        let number = existing.last().filter(|_| goes_on).map_or(0, |last| last + 1);
        let existing = existing.into_iter().map(|number| numbered(path, number));
        let (complete, earlier) = if goes_on {
            (existing.filter(|file| run_of(file) == Some(run)).map(with_length).collect(), Vec::new())
        } else {
            (VecDeque::new(), existing.collect())
        };
        let first =
            FirstFile::open(numbered(path, number), earlier).map_err(|error| with_path_and_hint(error.into(), path))?;
        let files = Files {
            path: path.to_owned(),
            limits,
            run,
            first: Some(first),
            open: None,
            next: number + 1,
            complete,
            is_full: false,
            failure: None,
            memory: Vec::new(),
        };
        let files = Arc::new(Mutex::new(files));
        let flushed = Arc::downgrade(&files);
        thread::Builder::new().name("recorder".to_owned()).spawn(move || keep_flushed(&flushed))?;
        Ok(Self { files })
    }

    /// Writes a message of a topic.
    ///
    /// # Errors
    /// The message cannot be written, for example because the disk is full; earlier messages are in the file.
    pub fn write(&self, topic: &str, message: &AnyMessage<'_>, latency_ms: Option<f64>) -> Result<Recorded> {
        let mut files = lock(&self.files);
        let path = files.path.clone();
        files.write(topic, message, latency_ms).map_err(|error| with_path_and_hint(error, &path))
    }

    /// Writes everything to the file at once.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn flush(&self) -> Result<()> {
        let mut files = lock(&self.files);
        let path = files.path.clone();
        files.flush().map_err(|error| with_path_and_hint(error, &path))
    }

    /// Completes the file and returns the size of all files in bytes. Where no message came, an earlier recording stays.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(&self) -> Result<u64> {
        let mut files = lock(&self.files);
        let path = files.path.clone();
        if files.first.as_ref().is_some_and(|first| first.earlier.is_empty()) {
            files.begin().map_err(|error| with_path_and_hint(error, &path))?;
        } else if files.first.is_some() {
            tracing::warn!("nothing came to be recorded: `{}` is still that of an earlier run", path.display());
        }
        files.complete_open().map_err(|error| with_path_and_hint(error, &path))?;
        files.failure.take().map_or(Ok(()), |error| Err(with_path_and_hint(error, &path)))?;
        Ok(files.complete.iter().map(|(_, bytes)| bytes).sum())
    }
}

impl Drop for Recorder {
    /// Removes the new file if no message came, for example of a stage that was only created on trial. Otherwise completes the
    /// open file, if [`Self::finish`] has not done it: the thread that flushes may hold the files for a moment longer.
    fn drop(&mut self) {
        let mut files = lock(&self.files);
        if let Some(first) = files.first.take_if(|first| first.file.is_new()) {
            fs::remove_file(&first.path).ok();
        }
        files.complete_open().ok();
    }
}

/// Flushes in the background as long as the recorder exists, also when no further message comes.
fn keep_flushed(files: &Weak<Mutex<Files>>) {
    while let Some(files) = files.upgrade() {
        lock(&files).flush_if_due();
        drop(files);
        thread::sleep(FLUSH_CHECK_PERIOD);
    }
}

/// Adds the path and a hint to an error of writing.
fn with_path_and_hint(error: Error, path: &Path) -> Error {
    let io = error.chain().find_map(|cause| match cause.downcast_ref::<McapError>() {
        Some(McapError::Io(error)) => Some(error),
        _ => cause.downcast_ref::<io::Error>(),
    });
    let what = format!("cannot write the recording `{}`: {error:#}", path.display());
    match io {
        Some(io) => Hinted::of_writing(what, io).into(),
        None => Hinted::new(what, "name a file that can be written").into(),
    }
}

/// Returns the name of a file: `run.mcap`, `run_1.mcap`, ..
fn numbered(path: &Path, number: u64) -> PathBuf {
    if number == 0 {
        return path.to_owned();
    }
    let (prefix, ending) = around_number(path);
    path.with_file_name(format!("{prefix}{number}{ending}"))
}

/// Returns the numbers of the existing files of the recording at `path`, ascending.
fn files_at(path: &Path, may_be_several: bool) -> Vec<u64> {
    let mut numbers = Vec::from_iter(path.exists().then_some(0));
    if may_be_several {
        let (prefix, ending) = around_number(path);
        let folder = path.parent().filter(|folder| *folder != Path::new("")).unwrap_or(Path::new("."));
        let names = fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.file_name());
        let number_of = |name: &str| name.strip_prefix(&prefix)?.strip_suffix(&ending)?.parse::<u64>().ok();
        numbers.extend(names.filter_map(|name| {
            let number = number_of(name.to_str()?)?;
            // Skips similar names of other files, such as `run_01.mcap`.
            (number > 0 && numbered(path, number).file_name() == Some(&name)).then_some(number)
        }));
        numbers.sort_unstable();
    }
    numbers
}

/// Returns the first existing file of the recording at `path`.
pub fn file_at(path: &Path, limits: &Limits) -> Option<PathBuf> {
    files_at(path, limits.has_several_files()).first().map(|number| numbered(path, *number))
}

/// Returns what stands before and after the number in a file name: `run_` and `.mcap`.
fn around_number(path: &Path) -> (String, String) {
    let stem = path.file_stem().unwrap_or_default().to_string_lossy();
    let extension = path.extension().map(|extension| format!(".{}", extension.to_string_lossy())).unwrap_or_default();
    (format!("{stem}_"), extension)
}

/// Describes the files that may follow the one at `path`, which the parameter `key` names.
pub fn further_files(key: &'static str, path: &Path) -> FileUse {
    let (prefix, ending) = around_number(path);
    FileUse::numbered(key, path.parent().unwrap_or(Path::new("")).to_owned(), prefix, ending)
}

/// Returns the run that wrote a file, if the file names it at its beginning.
fn run_of(path: &Path) -> Option<u64> {
    if is_special(path) {
        return None;
    }
    // The chunks are not read: the run stands before the first one.
    let options = LinearReaderOptions::default().with_emit_chunks(true);
    let mut reader = LinearReader::new_with_options(options.with_record_length_limit(MAX_RECORD_BYTES as usize));
    let mut file = File::open(path).ok()?;
    loop {
        match reader.next_event()?.ok()? {
            LinearReadEvent::ReadRequest(bytes) => {
                let read = file.read(reader.insert(bytes)).ok()?;
                reader.notify_read(read);
            }
            LinearReadEvent::Record { opcode, data } => match parse_record(opcode, data).ok()? {
                Record::Header(_) => {}
                Record::Metadata(about) if about.name == ABOUT => return about.metadata.get(RUN)?.parse().ok(),
                _ => return None,
            },
        }
    }
}

impl FirstFile {
    fn open(path: PathBuf, earlier: Vec<PathBuf>) -> io::Result<Self> {
        let file = LateFile::open(&path)?;
        Ok(Self { path, file, earlier })
    }
}

impl Files {
    /// Replaces an earlier recording when the first message comes.
    fn begin(&mut self) -> Result<()> {
        let Some(FirstFile { path, file, earlier }) = &mut self.first else { return Ok(()) };
        earlier.iter().filter(|file| *file != path).try_for_each(fs::remove_file)?;
        self.open = Some(OpenFile::begin(path, file.begin()?.try_clone()?, self.run)?);
        self.first = None;
        Ok(())
    }

    fn open_next(&mut self) -> Result<()> {
        let path = numbered(&self.path, self.next);
        self.open = Some(OpenFile::begin(&path, File::create(&path)?, self.run)?);
        self.next += 1;
        Ok(())
    }

    fn write(&mut self, topic: &str, message: &AnyMessage<'_>, latency_ms: Option<f64>) -> Result<Recorded> {
        if let Some(error) = self.failure.take() {
            return Err(error);
        }
        if self.is_full {
            return Ok(Recorded::Full);
        }
        self.begin()?;
        self.split(message.header.stamp_ns)?;
        let Some(open) = &mut self.open else { return Ok(Recorded::Full) };
        let written = open.write(topic, message, latency_ms, std::mem::take(&mut self.memory));
        self.memory = open.settle(written)?;
        self.flush_if_due();
        self.failure.take().map_or(Ok(Recorded::Written), Err)
    }

    /// Begins another file when this one is long or large enough; keeps to the limit for all files.
    fn split(&mut self, stamp_ns: u64) -> Result<()> {
        let Some(open) = &mut self.open else { return Ok(()) };
        let begin_ns = *open.begin_ns.get_or_insert(stamp_ns);
        let is_long = self.limits.split_ns.is_some_and(|split_ns| stamp_ns.saturating_sub(begin_ns) >= split_ns);
        let is_large = self.limits.split_bytes.is_some_and(|split_bytes| open.size() >= split_bytes);
        if is_long || is_large {
            self.complete_open()?;
            self.open_next()?;
            if let Some(open) = &mut self.open {
                open.begin_ns = Some(stamp_ns);
            }
        }
        self.keep_to_limit()
    }

    fn keep_to_limit(&mut self) -> Result<()> {
        let Some(limit) = self.limits.total_bytes else { return Ok(()) };
        loop {
            let complete: u64 = self.complete.iter().map(|(_, bytes)| bytes).sum();
            if complete + self.open.as_ref().map_or(0, OpenFile::size) < limit {
                return Ok(());
            }
            let Some((oldest, _)) = self.complete.pop_front() else { break };
            fs::remove_file(&oldest).with_context(|| format!("the oldest file, `{}`", oldest.display()))?;
        }
        self.is_full = true;
        self.complete_open()
    }

    fn complete_open(&mut self) -> Result<()> {
        let Some(mut open) = self.open.take() else { return Ok(()) };
        let finished = open.writer.finish().map(drop).map_err(Error::from);
        open.settle(finished)?;
        self.complete.push_back((open.path.clone(), open.size()));
        Ok(())
    }

    fn flush_if_due(&mut self) {
        let unflushed_since = self.open.as_ref().and_then(|open| open.unflushed_since);
        if unflushed_since.is_some_and(|since| since.elapsed() >= FLUSH) {
            self.failure = self.flush().err();
        }
    }

    fn flush(&mut self) -> Result<()> {
        let Some(open) = self.open.as_mut().filter(|open| open.unflushed_since.is_some()) else { return Ok(()) };
        open.unflushed_since = None;
        let flushed = open.writer.flush().map_err(Error::from);
        open.settle(flushed)
    }
}

impl OpenFile {
    /// Begins a recording in an empty file.
    fn begin(path: &Path, file: File, run: u64) -> Result<Self> {
        let (file, bytes, torn) = (Arc::new(file), Arc::new(AtomicU64::new(0)), Arc::default());
        // A chunk is written as soon as it is whole.
        let options = WriteOptions::new()
            .profile("ros2")
            .library(concat!("conicflow ", env!("CARGO_PKG_VERSION")))
            .compression(Some(Compression::Lz4))
            .disable_seeking(true);
        let counted = Counted { file: Arc::clone(&file), bytes: Arc::clone(&bytes), torn: Arc::clone(&torn) };
        let mut writer = Writer::with_options(NoSeek::new(counted), options)?;
        let about = BTreeMap::from([(RUN.to_owned(), run.to_string())]);
        writer.write_metadata(&Metadata { name: ABOUT.to_owned(), metadata: about })?;
        let whole = bytes.load(Ordering::Relaxed);
        Ok(Self {
            path: path.to_owned(),
            writer,
            file,
            bytes,
            whole,
            torn,
            channels: BTreeMap::new(),
            begin_ns: None,
            placed: BTreeMap::new(),
            unflushed_since: None,
        })
    }

    /// Number of bytes in the file.
    fn size(&self) -> u64 {
        self.bytes.load(Ordering::Relaxed)
    }

    /// Ends an attempt to write: if it has failed, cuts its bytes off, so that the file ends with a whole chunk, and lets nothing
    /// follow.
    fn settle<T>(&mut self, written: Result<T>) -> Result<T> {
        if written.is_ok() {
            self.whole = self.size();
        } else if !self.torn.swap(true, Ordering::Relaxed) {
            // If that fails, too, readers skip the incomplete chunk at the end.
            self.file.set_len(self.whole).ok();
        }
        written
    }

    /// Writes a message in all its forms; uses `memory` as buffer and returns it.
    fn write(
        &mut self,
        topic: &str,
        message: &AnyMessage<'_>,
        latency_ms: Option<f64>,
        mut memory: Vec<u8>,
    ) -> Result<Vec<u8>> {
        let &AnyMessage { header, item, bytes } = message;
        let origin = header.origin();
        let frame_id = origin.as_str().filter(|name| !name.is_empty()).unwrap_or(NAMELESS);
        let stamped = Stamped { stamp_ns: header.stamp_ns, frame_id };
        let of = |part: &str| own::channel(frame_id, topic, part);
        memory = own::write(header, if item.is_image() { &[] } else { bytes }, memory);
        self.put_own(&of(MESSAGE), item, header, &memory)?;
        if let Some(pixels) = message.items::<u16>() {
            memory = CameraInfo::write(stamped, &header.camera, memory);
            self.put_ros(&of("camera_info"), CAMERA_INFO, header, &memory)?;
            memory = image(stamped, header, pixels, memory);
            self.put_ros(&of(IMAGE), IMAGE_TYPE, header, &memory)?;
        }
        let of_objects = message.items::<Object>().map(|objects| drawn(stamped, objects));
        let of_tracks = message.items::<Track>().map(|tracks| drawn(stamped, tracks));
        if let Some([markers, points]) = of_objects.or(of_tracks) {
            self.put_ros(&of("markers"), MARKER_ARRAY, header, &markers)?;
            self.put_ros(&of("points"), POINT_CLOUD, header, &points)?;
        }
        // A type without named fields is recorded only as it is.
        if let Some(items) = message.fields().filter(|_| item.is_short()) {
            let head = head(header, latency_ms);
            memory = write_list(stamped, &head, &items, memory);
            self.put_list(&of("list"), item, &head, header, &memory)?;
        }
        if let Some(pose) = header.pose()
            && self.placed.insert(origin, (header.epoch, header.sequence)) != Some((header.epoch, header.sequence))
        {
            let in_world = Stamped { stamp_ns: header.stamp_ns, frame_id: WORLD };
            memory = write_transform(in_world, frame_id, pose, memory);
            self.put_ros("/tf", TF_MESSAGE, header, &memory)?;
        }
        Ok(memory)
    }

    fn put_ros(&mut self, channel: &str, definition: Definition, header: &Header, data: &[u8]) -> Result<()> {
        self.put(channel, header, data, |writer| {
            let schema = writer.add_schema(definition.name, "ros2msg", definition.text.as_bytes())?;
            Ok(writer.add_channel(schema, channel, "cdr", &BTreeMap::new())?)
        })
    }

    fn put_own(&mut self, channel: &str, item: &ItemType, header: &Header, data: &[u8]) -> Result<()> {
        self.put(channel, header, data, |writer| {
            let named = writer.add_schema(item.type_name(), NAME_ALONE, &[])?;
            let schema = serde_json::to_string(&own::Schema::of(item))?;
            Ok(writer.add_channel(named, channel, ENCODING, &BTreeMap::from([(SCHEMA.to_owned(), schema)]))?)
        })
    }

    fn put_list(
        &mut self,
        channel: &str,
        item: &ItemType,
        head: &Fields<'_>,
        header: &Header,
        data: &[u8],
    ) -> Result<()> {
        self.put(channel, header, data, |writer| {
            // The list may be empty, so the fields are those of an item of zeros.
            let zeros = vec![0_u64; item.size().div_ceil(size_of::<u64>())];
            let bytes = &bytemuck::cast_slice(&zeros)[..item.size()];
            let items = AnyMessage { header, item, bytes }.fields().unwrap_or_default();
            let (name, text) = list_definition(item.name(), head, items.first().context("an item of no bytes")?);
            let schema = writer.add_schema(&name, "ros2msg", text.as_bytes())?;
            Ok(writer.add_channel(schema, channel, "cdr", &BTreeMap::new())?)
        })
    }

    /// Writes a message into a channel; creates the channel if it is new.
    fn put(
        &mut self,
        channel: &str,
        header: &Header,
        data: &[u8],
        make: impl FnOnce(&mut Writer<NoSeek<Counted>>) -> Result<u16>,
    ) -> Result<()> {
        let channel_id = match self.channels.get(channel) {
            Some(id) => *id,
            None => {
                let id = make(&mut self.writer)?;
                self.channels.insert(channel.to_owned(), id);
                id
            }
        };
        let (log_time, publish_time) = (header.stamp_ns, header.stamp_ns);
        let header = MessageHeader { channel_id, sequence: header.sequence as u32, log_time, publish_time };
        self.writer.write_to_known_channel(&header, data)?;
        self.unflushed_since.get_or_insert_with(Instant::now);
        Ok(())
    }
}

/// Returns the fields that a line of JSON has beside the items.
fn head(header: &Header, latency_ms: Option<f64>) -> Fields<'_> {
    let source = header.source.as_str().unwrap_or_default();
    let latency_ms = latency_ms.unwrap_or(ABSENT);
    Fields(vec![("sequence", header.sequence.into()), ("source", source.into()), ("latency_ms", latency_ms.into())])
}

/// Encodes the items for viewers: as markers, and as points for viewers without markers.
fn drawn<T: Marked>(stamped: Stamped<'_>, items: &[T]) -> [Vec<u8>; 2] {
    [markers(stamped, items, Markers::Replace, Vec::new()), surface_points(stamped, items, Vec::new())]
}

/// Encodes a depth image: in millimetres if these are its units; else in metres, where NaN means no measurement and infinity
/// means too far.
fn image(stamped: Stamped<'_>, header: &Header, pixels: &[u16], memory: Vec<u8>) -> Vec<u8> {
    let size = (header.camera.width, header.camera.height);
    if header.depth_scale == MILLIMETRE {
        return write_units(stamped, size, pixels, memory);
    }
    let metres = |pixel: &u16| match *pixel {
        INVALID_NEAR => f32::NAN,
        INVALID_FAR => f32::INFINITY,
        units => (f64::from(units) * header.depth_scale) as f32,
    };
    write_metres(stamped, size, pixels.iter().map(metres), memory)
}
