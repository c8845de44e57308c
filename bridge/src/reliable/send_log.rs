//! The messages of a lossless edge that were sent and are not acknowledged yet. Each is also written to a file in the run's
//! folder before it goes out, so that the process that replaces a killed one retransmits it. The number of messages that were
//! given up is kept there, too; it decides the exit code of the run.

use crate::wire::{StreamPosition, position_of};
use std::collections::VecDeque;
use std::fs::File;
use std::io;
use std::os::unix::fs::FileExt;
use std::path::PathBuf;

/// Maximum number of messages in the log; when it is full, lossless writers wait.
pub(crate) const CAPACITY: usize = 64;
/// Size of the messages in the log, in bytes, from which it counts as full.
const CAPACITY_BYTES: usize = 16 << 20;

/// Bytes at the beginning of a file for the length of the message in it, which is written last.
const LENGTH: usize = size_of::<u64>();

/// Messages, the oldest first.
#[derive(Default)]
pub(crate) struct SendLog {
    messages: VecDeque<(u64, Vec<u8>)>,
    lost: u64,
    files: Option<Files>,
}

impl SendLog {
    /// Opens the log of a topic in this folder, with the messages that an earlier process has left.
    pub(crate) fn in_folder(folder: PathBuf, topic: &str) -> Self {
        let files = Files { folder, topic: topic.replace('/', "."), open: [const { None }; CAPACITY] };
        let mut found: Vec<(StreamPosition, Vec<u8>)> =
            (0..CAPACITY as u64).filter_map(|slot| files.read(slot)).collect();
        let stream = found.iter().map(|(position, _)| position.stream).max();
        found.retain(|(position, _)| Some(position.stream) == stream);
        found.sort_by_key(|(position, _)| position.number);
        let messages = found.into_iter().map(|(position, bytes)| (position.number, bytes)).collect();
        Self { messages, lost: files.lost(), files: Some(files) }
    }

    /// A log with these messages, in memory only.
    #[cfg(test)]
    pub(super) fn of(messages: &[Vec<u8>]) -> Self {
        let position = |bytes: &Vec<u8>| Some((position_of(bytes).ok()?.number, bytes.clone()));
        Self { messages: messages.iter().filter_map(position).collect(), ..Self::default() }
    }

    /// The position of the last message.
    pub(crate) fn last(&self) -> Option<StreamPosition> {
        self.messages.back().and_then(|(_, bytes)| position_of(bytes).ok())
    }

    /// Number of the first message.
    pub(crate) fn oldest(&self) -> Option<u64> {
        self.messages.front().map(|(number, _)| *number)
    }

    pub(crate) fn len(&self) -> usize {
        self.messages.len()
    }

    pub(crate) fn has_room(&self) -> bool {
        let bytes: usize = self.messages.iter().map(|(_, bytes)| bytes.len()).sum();
        self.messages.len() < CAPACITY && bytes < CAPACITY_BYTES
    }

    /// The messages from number `first` on.
    pub(crate) fn since(&self, first: u64) -> impl Iterator<Item = &Vec<u8>> {
        self.messages.iter().filter(move |(number, _)| *number >= first).map(|(_, bytes)| bytes)
    }

    pub(crate) fn add(&mut self, number: u64, bytes: &[u8]) {
        self.with_files(|files| files.write(number, bytes));
        self.messages.push_back((number, bytes.to_vec()));
    }

    /// Forgets the first message and returns its number.
    pub(crate) fn forget_first(&mut self) -> Option<u64> {
        let (number, _) = self.messages.pop_front()?;
        self.with_files(|files| files.clear(number));
        Some(number)
    }

    /// The number of messages that were given up, including those of earlier processes.
    pub(crate) fn lost(&self) -> u64 {
        self.lost
    }

    /// Counts messages that are given up.
    pub(crate) fn lose(&mut self, count: u64) {
        self.lost += count;
        let lost = self.lost;
        if count > 0 {
            self.with_files(|files| files.note_lost(lost));
        }
    }

    /// Removes the message files, so that no later process sends them again.
    pub(crate) fn remove_files(&mut self) {
        if let Some(files) = self.files.take() {
            (0..CAPACITY as u64).for_each(|slot| drop(std::fs::remove_file(files.path(slot))));
        }
    }

    /// Does `work` on the files. If that fails, the log goes on in memory, and its messages are lost if the process is killed.
    fn with_files(&mut self, work: impl FnOnce(&mut Files) -> io::Result<()>) {
        if let Some(Err(error)) = self.files.as_mut().map(work) {
            tracing::warn!("what is not acknowledged is kept in memory alone: {error}");
            self.remove_files();
        }
    }
}

#[cfg(test)]
impl Clone for SendLog {
    fn clone(&self) -> Self {
        Self { messages: self.messages.clone(), lost: self.lost, files: None }
    }
}

/// One file per message.
struct Files {
    folder: PathBuf,
    topic: String,
    open: [Option<File>; CAPACITY],
}

impl Files {
    fn path(&self, number: u64) -> PathBuf {
        self.folder.join(format!("bridge.{}.{}.kept", self.topic, number % CAPACITY as u64))
    }

    fn path_of_lost(&self) -> PathBuf {
        self.folder.join(format!("bridge.{}.lost.kept", self.topic))
    }

    /// The number of messages that earlier processes gave up.
    fn lost(&self) -> u64 {
        let noted = std::fs::read(self.path_of_lost()).ok();
        noted.and_then(|bytes| bytes.try_into().ok()).map_or(0, u64::from_le_bytes)
    }

    /// Writes the number in one write, so that a process killed meanwhile leaves the number before.
    fn note_lost(&self, lost: u64) -> io::Result<()> {
        let file = File::options().write(true).create(true).truncate(false).open(self.path_of_lost())?;
        file.write_all_at(&lost.to_le_bytes(), 0)
    }

    /// Returns the message in a file, or `None` if it is incomplete.
    fn read(&self, slot: u64) -> Option<(StreamPosition, Vec<u8>)> {
        let bytes = std::fs::read(self.path(slot)).ok()?;
        let (length, message) = bytes.split_first_chunk::<LENGTH>()?;
        let whole = u64::from_le_bytes(*length) == message.len() as u64;
        let position = position_of(message).ok().filter(|_| whole)?;
        Some((position, message.to_vec()))
    }

    fn write(&mut self, number: u64, bytes: &[u8]) -> io::Result<()> {
        let file = self.file(number)?;
        file.set_len(0)?;
        file.write_all_at(bytes, LENGTH as u64)?;
        file.write_all_at(&(bytes.len() as u64).to_le_bytes(), 0)
    }

    fn clear(&mut self, number: u64) -> io::Result<()> {
        self.file(number)?.set_len(0)
    }

    fn file(&mut self, number: u64) -> io::Result<&File> {
        let path = self.path(number);
        let slot = &mut self.open[(number % CAPACITY as u64) as usize];
        if slot.is_none() {
            *slot = Some(File::options().write(true).create(true).truncate(false).open(path)?);
        }
        slot.as_ref().ok_or_else(|| io::ErrorKind::NotFound.into())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::wire::encode_message;
    use conicflow_dataflow::ItemType;
    use conicflow_dataflow::pipeline::Compression;
    use conicflow_messages::{Header, Object};

    fn message(number: u64) -> Vec<u8> {
        let position = StreamPosition { stream: 7, number, oldest: 0 };
        encode_message(position, &ItemType::of::<Object>(), &Header::default(), &[], Compression::None).unwrap()
    }

    #[test]
    fn the_next_process_finds_the_messages_that_were_not_forgotten() {
        let folder = tempfile::tempdir().unwrap();
        let open = || SendLog::in_folder(folder.path().to_owned(), "cameras/front");
        let mut log = open();
        assert_eq!((log.last(), log.oldest()), (None, None));
        (60..70).for_each(|number| log.add(number, &message(number)));
        assert_eq!([(); 3].map(|()| log.forget_first().unwrap()), [60, 61, 62]);
        drop(log);
        let mut log = open();
        assert_eq!(
            (log.last().map(|position| (position.stream, position.number)), log.oldest()),
            (Some((7, 69)), Some(63))
        );
        assert!(log.since(63).eq((63..70).map(message).collect::<Vec<_>>().iter()));
        log.remove_files();
        assert_eq!(folder.path().read_dir().unwrap().count(), 0);
    }

    #[test]
    fn the_next_process_knows_the_number_given_up_even_when_no_message_is_kept() {
        let folder = tempfile::tempdir().unwrap();
        let open = || SendLog::in_folder(folder.path().to_owned(), "cameras/front");
        for lost in [0, 2, 5] {
            let mut log = open();
            log.lose(lost - log.lost());
            log.remove_files();
            assert_eq!(open().lost(), lost);
        }
    }

    #[test]
    fn the_log_has_room_for_a_limited_number_of_bytes() {
        let mut log = SendLog::default();
        log.add(0, &vec![0; CAPACITY_BYTES - 1]);
        assert!(log.has_room());
        log.add(1, &[0]);
        assert!(!log.has_room());
    }

    #[test]
    fn a_message_that_was_written_in_part_is_ignored() {
        let folder = tempfile::tempdir().unwrap();
        let open = || SendLog::in_folder(folder.path().to_owned(), "objects");
        (0..3).for_each(|number| open().add(number, &message(number)));
        let path = folder.path().join("bridge.objects.2.kept");
        let whole = std::fs::read(&path).unwrap();
        for torn in [&whole[..whole.len() - 1], &[[0; LENGTH].as_slice(), &whole[LENGTH..]].concat(), b"short"] {
            std::fs::write(&path, torn).unwrap();
            assert_eq!(open().last().map(|position| position.number), Some(1));
        }
    }
}
