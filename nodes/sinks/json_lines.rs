//! A file of whole lines: each is passed to the system at once, so that a crash loses no finished line and leaves no torn one for
//! the next start.

use anyhow::{Context as _, anyhow};
use conicflow_dataflow::CLEAR_LINE;
use conicflow_messages::{Hinted, LateFile};
use serde::Serialize;
use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, IsTerminal as _, Read, Seek, SeekFrom, Write};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};

/// Writes values as lines of JSON.
pub struct JsonLines {
    destination: Destination,
    line: Vec<u8>,
}

enum Destination {
    StandardOutput,
    /// A regular file has a length of whole lines, to which it is cut after an error; a pipe or device has none.
    File {
        file: LateFile,
        path: PathBuf,
        whole: Option<u64>,
    },
}

/// The outcome of writing a line.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Wrote {
    /// The line was written.
    Line,
    /// The reader at the other end of the pipe is gone (`| head`).
    ReaderGone,
}

impl JsonLines {
    /// Writes lines to standard output.
    pub fn standard_output() -> Self {
        Self::to(Destination::StandardOutput)
    }

    /// Writes lines to the file at `path`; creates its folder if that is missing. With `append` its content is kept except for a
    /// torn last line; else it stays until the first line is written.
    ///
    /// # Errors
    /// The folder or the file cannot be created or written.
    pub fn open(path: &Path, append: bool) -> anyhow::Result<Self> {
        let open = || {
            let late = LateFile::open(path)?;
            let (file, whole) = if append {
                let file = OpenOptions::new().read(true).write(true).open(path)?;
                let whole = cut_torn_line(&file)?;
                (file.into(), whole)
            } else {
                (late, path.is_file().then_some(0))
            };
            Ok(Destination::File { file, path: path.to_owned(), whole })
        };
        open().map(Self::to).map_err(|error| {
            anyhow!(Hinted::of_writing(format!("cannot open `{}` for writing: {error}", path.display()), &error))
        })
    }

    fn to(destination: Destination) -> Self {
        Self { destination, line: Vec::new() }
    }

    /// Returns the last line of a file opened with `append`.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn last(&self) -> anyhow::Result<Option<Vec<u8>>> {
        let Destination::File { file, whole: Some(whole), .. } = &self.destination else { return Ok(None) };
        let Some(end) = whole.checked_sub(1) else { return Ok(None) };
        let read = || {
            let mut file = file.file();
            let start = end_of_last_line(file, end)?;
            let mut line = vec![0; (end - start) as usize];
            file.read_exact_at(&mut line, start)?;
            // The position for the next line.
            file.seek(SeekFrom::Start(*whole))?;
            Ok(line)
        };
        read().map(Some).map_err(|error| self.fault(&error))
    }

    /// Writes one value as one line.
    ///
    /// # Errors
    /// The line cannot be written, for example because the disk is full; no part of it remains in a file.
    pub fn write(&mut self, value: &impl Serialize) -> anyhow::Result<Wrote> {
        self.write_with(|line| serde_json::to_writer(line, value))
    }

    /// Writes one line with the text that `express` appends.
    ///
    /// # Errors
    /// The line cannot be expressed or written; no part of it remains in a file.
    pub fn write_with(
        &mut self,
        express: impl FnOnce(&mut Vec<u8>) -> serde_json::Result<()>,
    ) -> anyhow::Result<Wrote> {
        self.line.clear();
        express(&mut self.line).context("cannot express the message as JSON")?;
        self.line.push(b'\n');
        match self.destination.write(&self.line) {
            Ok(()) => Ok(Wrote::Line),
            Err(error) if error.kind() == ErrorKind::BrokenPipe => Ok(Wrote::ReaderGone),
            Err(error) => Err(self.fault(&error)),
        }
    }

    /// Deletes the content of an earlier run, even if no line follows.
    ///
    /// # Errors
    /// The content cannot be deleted.
    pub fn begin(&mut self) -> anyhow::Result<()> {
        let Destination::File { file, .. } = &mut self.destination else { return Ok(()) };
        let begun = file.begin().map(drop);
        begun.map_err(|error| self.fault(&error))
    }

    /// Warns if the file still has the content of an earlier run, as nothing was written.
    pub fn warn_if_earlier(&self) {
        if let Destination::File { file, path, .. } = &self.destination
            && file.is_earlier()
        {
            tracing::warn!("nothing came to be written: `{}` still holds what an earlier run wrote", path.display());
        }
    }

    fn fault(&self, error: &io::Error) -> anyhow::Error {
        let path = match &self.destination {
            Destination::StandardOutput => Path::new("standard output"),
            Destination::File { path, .. } => path,
        };
        anyhow!(Hinted::of_writing(format!("cannot write to `{}`: {error}", path.display()), error))
    }
}

impl Destination {
    fn write(&mut self, line: &[u8]) -> io::Result<()> {
        match self {
            Self::StandardOutput => {
                let mut output = io::stdout().lock();
                if output.is_terminal() {
                    // The progress of the run may be in this line.
                    output.write_all(CLEAR_LINE.as_bytes())?;
                }
                output.write_all(line)?;
                output.flush()
            }
            Self::File { file, whole, .. } => {
                let file = file.begin()?;
                let result = file.write_all(line);
                settle(file, whole, line.len(), result)
            }
        }
    }
}

/// Ends the writing of a line of `length` bytes; if it failed, cuts off what was written of it. If that fails, too, the next
/// start cuts it off.
fn settle(file: &mut File, whole: &mut Option<u64>, length: usize, result: io::Result<()>) -> io::Result<()> {
    let Some(whole) = whole else { return result };
    if result.is_ok() {
        *whole += length as u64;
    } else if file.set_len(*whole).is_ok() {
        file.seek(SeekFrom::Start(*whole))?;
    }
    result
}

/// Length of a regular file; `None` for a pipe or device.
fn length(file: &File) -> io::Result<Option<u64>> {
    let about = file.metadata()?;
    Ok(about.is_file().then_some(about.len()))
}

/// Cuts off what follows the last line feed, moves to the end, and returns the length.
fn cut_torn_line(mut file: &File) -> io::Result<Option<u64>> {
    let Some(length) = length(file)? else { return Ok(None) };
    let whole = end_of_last_line(file, length)?;
    if whole < length {
        // Only if needed, so as not to cut off lines added meanwhile: a successor opens the file while the stage still writes.
        file.set_len(whole)?;
    }
    file.seek(SeekFrom::Start(whole))?;
    Ok(Some(whole))
}

/// Returns the position after the last line feed, searched from the end.
fn end_of_last_line(mut file: &File, length: u64) -> io::Result<u64> {
    let mut buffer = [0; 4096];
    let mut end = length;
    while end > 0 {
        let start = end.saturating_sub(buffer.len() as u64);
        let block = &mut buffer[..(end - start) as usize];
        file.seek(SeekFrom::Start(start))?;
        file.read_exact(block)?;
        if let Some(at) = block.iter().rposition(|&byte| byte == b'\n') {
            return Ok(start + at as u64 + 1);
        }
        end = start;
    }
    Ok(0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs;

    fn write(path: &Path, append: bool, values: &[u32]) {
        let mut lines = JsonLines::open(path, append).unwrap();
        for value in values {
            assert_eq!(lines.write(value).unwrap(), Wrote::Line);
        }
    }

    #[test]
    fn every_line_is_written_at_once() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("new/folder/out.jsonl");
        let mut lines = JsonLines::open(&path, false).unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "");
        for (value, content) in [("a", "\"a\"\n"), ("b", "\"a\"\n\"b\"\n")] {
            lines.write(&value).unwrap();
            assert_eq!(fs::read_to_string(&path).unwrap(), content);
        }
    }

    #[test]
    fn a_new_run_replaces_the_file_with_its_first_line_and_a_restart_appends() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.jsonl");
        write(&path, true, &[1, 2]);
        write(&path, true, &[3]);
        assert_eq!(fs::read_to_string(&path).unwrap(), "1\n2\n3\n");
        write(&path, false, &[]);
        assert_eq!(fs::read_to_string(&path).unwrap(), "1\n2\n3\n", "it had nothing to write");
        write(&path, false, &[4, 5]);
        assert_eq!(fs::read_to_string(&path).unwrap(), "4\n5\n");
        JsonLines::open(&path, false).unwrap().begin().unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "");
    }

    #[test]
    fn an_appended_file_yields_its_last_whole_line() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.jsonl");
        for (content, last) in [("", None), ("1\n", Some("1")), ("1\n[2, 3]\n{\"to", Some("[2, 3]"))] {
            fs::write(&path, content).unwrap();
            let mut lines = JsonLines::open(&path, true).unwrap();
            assert_eq!(lines.last().unwrap(), last.map(|line| line.as_bytes().to_vec()));
            lines.write(&7).unwrap();
            assert!(
                fs::read_to_string(&path).unwrap().ends_with(&last.map_or("7\n".into(), |last| format!("{last}\n7\n")))
            );
        }
    }

    #[test]
    fn a_torn_line_is_cut_off_however_long_it_is() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.jsonl");
        for (before, kept) in [
            ("{\"a\":1}\n{\"b\":".to_owned(), "{\"a\":1}\n"),
            (format!("1\n{}", "x".repeat(4095)), "1\n"),
            (format!("1\n{}", "x".repeat(9000)), "1\n"),
            ("x".repeat(5000), ""),
            ("1\n".to_owned(), "1\n"),
        ] {
            fs::write(&path, &before).unwrap();
            write(&path, true, &[7]);
            assert_eq!(fs::read_to_string(&path).unwrap(), format!("{kept}7\n"));
        }
    }

    #[test]
    fn a_line_that_was_written_in_part_is_removed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("out.jsonl");
        let mut file = File::create(&path).unwrap();
        let mut whole = Some(0);
        file.write_all(b"1\n").unwrap();
        settle(&mut file, &mut whole, 2, Ok(())).unwrap();
        file.write_all(b"{\"torn").unwrap();
        assert!(settle(&mut file, &mut whole, 20, Err(ErrorKind::StorageFull.into())).is_err());
        assert_eq!(fs::read_to_string(&path).unwrap(), "1\n");
        file.write_all(b"2\n").unwrap();
        assert_eq!(fs::read_to_string(&path).unwrap(), "1\n2\n");
    }

    #[test]
    fn a_full_disk_is_reported_with_a_hint() {
        let device = Path::new("/dev/full");
        if !device.exists() {
            eprintln!("skipped: this system has no /dev/full");
            return;
        }
        let mut lines = JsonLines::open(device, false).unwrap();
        let error = lines.write(&1).unwrap_err().to_string();
        assert!(error.starts_with("cannot write to `/dev/full`: No space left"), "{error}");
        assert!(error.ends_with("hint: free some space, or write to another disk"), "{error}");
    }

    #[test]
    fn a_file_in_place_of_a_folder_is_reported() {
        let folder = tempfile::tempdir().unwrap();
        fs::write(folder.path().join("file"), "").unwrap();
        let error = JsonLines::open(&folder.path().join("file/out.jsonl"), false).err().unwrap().to_string();
        assert!(error.contains("hint: a part of the path before the last is a file"), "{error}");
    }
}
