//! Acknowledgements of a topic's lossless readers, in memory that outlives them.
//!
//! Each topic has a table, in a file of the run's folder. For each pair of reader and writer it has the number of the first
//! message that the reader has not finished, and the number of the message begun last with a count of its beginnings. Each is one
//! word, written atomically, so that a kill leaves no partial value. From the first word the writer knows which messages it still
//! has to keep, and a restarted reader where to continue. From the second a restarted reader knows on which message its
//! predecessors died.

use crate::ports::Topic;
use conicflow_messages::Text;
use std::fs::{self, File};
use std::io;
use std::os::fd::AsRawFd;
use std::path::{Path, PathBuf};
use std::ptr::NonNull;
use std::sync::atomic::{AtomicU64, Ordering};

/// Suffix of the tables' files.
pub(crate) const ENDING: &str = "acks";

/// Number of words for each pair of reader and writer.
const WORDS: usize = 2;
/// Maximum count of beginnings, which the second word has in its lowest bits.
const MOST_BEGINNINGS: u64 = 15;

/// The table of a topic, shared with all processes that read or write it.
pub(super) struct Acknowledgements {
    words: NonNull<AtomicU64>,
    length: usize,
    writers: Vec<Text<32>>,
}

// SAFETY: the pointer refers to atomic words, which stay in place during the lifetime of this value.
unsafe impl Send for Acknowledgements {}
// SAFETY: all access through the pointer is to atomic words, which stay in place during the lifetime of this value.
unsafe impl Sync for Acknowledgements {}

impl Acknowledgements {
    /// Creates the table of a topic in the folder of a run, before any process reads or writes the topic.
    ///
    /// # Errors
    /// The file cannot be written.
    pub(super) fn create(folder: &Path, topic: &Topic) -> io::Result<()> {
        // Zeros rather than a hole: a page that finds no room on the disk later would kill a stage.
        fs::write(path(folder, topic), vec![0; length(topic) * size_of::<AtomicU64>()])
    }

    /// Opens the table that the launcher has created.
    ///
    /// # Errors
    /// It does not exist, or cannot be mapped.
    pub(super) fn open(folder: &Path, topic: &Topic) -> io::Result<Self> {
        let (file, length) = (File::options().read(true).write(true).open(path(folder, topic))?, length(topic));
        let bytes = length * size_of::<AtomicU64>();
        if file.metadata()?.len() < bytes as u64 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        let (access, shared) = (libc::PROT_READ | libc::PROT_WRITE, libc::MAP_SHARED);
        // SAFETY: a new mapping of a file of at least this length; no process truncates it while its run lasts.
        let mapped = unsafe { libc::mmap(std::ptr::null_mut(), bytes, access, shared, file.as_raw_fd(), 0) };
        let words = NonNull::new(mapped.cast()).filter(|_| mapped != libc::MAP_FAILED);
        let words = words.ok_or_else(io::Error::last_os_error)?;
        Ok(Self { words, length, writers: topic.writers.iter().map(|writer| Text::new(writer)).collect() })
    }

    /// The writers of the topic, in the order of the table.
    pub(super) fn writers(&self) -> &[Text<32>] {
        &self.writers
    }

    /// Index of a writer in the table.
    pub(super) fn place_of(&self, writer: &Text<32>) -> Option<usize> {
        self.writers.iter().position(|own| own == writer)
    }

    /// Number of the first message of `writer` that `reader` has not finished.
    pub(super) fn next(&self, reader: usize, writer: usize) -> u64 {
        self.cell(reader, writer)[0].load(Ordering::Acquire)
    }

    /// Records that `reader` has finished the messages of `writer` with numbers below `next`.
    pub(super) fn finish(&self, reader: usize, writer: usize, next: u64) {
        self.cell(reader, writer)[0].store(next, Ordering::Release);
    }

    /// Records that `reader` begins a message of `writer`. Returns how often it has begun that message, this time included.
    pub(super) fn begin(&self, reader: usize, writer: usize, number: u64) -> u64 {
        let (word, message) = (&self.cell(reader, writer)[1], number.wrapping_mul(MOST_BEGINNINGS + 1));
        let before = word.load(Ordering::Relaxed);
        let earlier = if before & !MOST_BEGINNINGS == message { before & MOST_BEGINNINGS } else { 0 };
        let beginnings = (earlier + 1).min(MOST_BEGINNINGS);
        word.store(message | beginnings, Ordering::Relaxed);
        beginnings
    }

    fn cell(&self, reader: usize, writer: usize) -> &[AtomicU64; WORDS] {
        let index = WORDS * (reader * self.writers.len() + writer);
        assert!(index + WORDS <= self.length, "no stage of this topic");
        // SAFETY: the cell lies within the mapping, whose words are aligned, valid for all bit patterns, and only used as
        // atomics.
        unsafe { &*self.words.as_ptr().add(index).cast() }
    }
}

impl Drop for Acknowledgements {
    fn drop(&mut self) {
        // SAFETY: this is the mapping that was made in `open`, and nothing refers to it any more.
        unsafe { libc::munmap(self.words.as_ptr().cast(), self.length * size_of::<AtomicU64>()) };
    }
}

fn length(topic: &Topic) -> usize {
    WORDS * topic.readers.len() * topic.writers.len()
}

/// Path of a topic's table, with a unique name.
fn path(folder: &Path, topic: &Topic) -> PathBuf {
    folder.join(format!("{}.{ENDING}", topic.name.replace('/', "%")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ports::{Delivery, TopicReader};

    fn topic() -> Topic {
        let reader = |name: &str| TopicReader { stage: name.to_owned(), delivery: Delivery::Lossless, queue: 4 };
        let writers = vec!["left".into(), "right".into()];
        Topic { name: "a/b".into(), item: None, writers, readers: vec![reader("one"), reader("other")] }
    }

    #[test]
    fn what_a_process_was_done_with_outlives_it() {
        let folder = tempfile::tempdir().unwrap();
        assert!(Acknowledgements::open(folder.path(), &topic()).is_err(), "nobody has made it");
        // For each of two readers and two writers, a word for what was finished, and one for what was begun.
        fs::write(path(folder.path(), &topic()), [0; 8 * 8 - 1]).unwrap();
        assert!(Acknowledgements::open(folder.path(), &topic()).is_err(), "it is cut off");
        Acknowledgements::create(folder.path(), &topic()).unwrap();
        let right = Text::new("right");
        let table = Acknowledgements::open(folder.path(), &topic()).unwrap();
        let writer = table.place_of(&right).unwrap();
        table.finish(1, writer, 7);
        drop(table);
        let table = Acknowledgements::open(folder.path(), &topic()).unwrap();
        assert_eq!([(0, 0), (0, 1), (1, 0), (1, 1)].map(|(reader, writer)| table.next(reader, writer)), [0, 0, 0, 7]);
        assert_eq!(table.place_of(&Text::new("nobody")), None);
    }

    #[test]
    fn beginnings_are_counted_of_one_message_at_a_time() {
        let folder = tempfile::tempdir().unwrap();
        Acknowledgements::create(folder.path(), &topic()).unwrap();
        let table = Acknowledgements::open(folder.path(), &topic()).unwrap();
        assert_eq!([0, 0, 1, 1, 0].map(|number| table.begin(0, 0, number)), [1, 2, 1, 2, 1]);
        assert_eq!(table.begin(0, 1, 0), 1, "of another writer");
        (0..40).for_each(|_| _ = table.begin(1, 1, 9));
        assert_eq!(table.begin(1, 1, 9), MOST_BEGINNINGS);
        assert_eq!(table.next(1, 1), 0);
    }

    #[test]
    fn a_table_that_is_closed_is_mapped_no_longer() {
        let folder = tempfile::tempdir().unwrap();
        let names: Vec<_> = (0..20).map(|place| place.to_string()).collect();
        let reader = |stage: &String| TopicReader { stage: stage.clone(), delivery: Delivery::Lossless, queue: 4 };
        let topic = Topic { readers: names.iter().map(reader).collect(), writers: names, ..topic() };
        assert!(length(&topic) * size_of::<u64>() > 4096, "more than a page");
        Acknowledgements::create(folder.path(), &topic).unwrap();
        let path = path(folder.path(), &topic).into_os_string().into_string().unwrap();
        let is_mapped = || fs::read_to_string("/proc/self/maps").unwrap().contains(&path);
        let table = Acknowledgements::open(folder.path(), &topic).unwrap();
        assert!(is_mapped());
        drop(table);
        assert!(!is_mapped());
    }
}
