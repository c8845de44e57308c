//! Files at paths that users write: these may be special files, or files with content that is still needed.

use std::fs::{self, File};
use std::io::{self, ErrorKind, Read as _};
use std::path::Path;

/// A mark that some programs write before a text.
const BYTE_ORDER_MARK: char = '\u{feff}';

/// Reads a text of at most `most_bytes`, without a byte order mark.
///
/// # Errors
/// The file cannot be read, is longer, or is not UTF-8.
pub fn read_text(path: &Path, most_bytes: u64) -> io::Result<String> {
    let mut text = String::new();
    File::open(path)?.take(most_bytes.saturating_add(1)).read_to_string(&mut text)?;
    if text.len() as u64 > most_bytes {
        return Err(io::Error::new(ErrorKind::InvalidData, format!("it is longer than {most_bytes} bytes")));
    }
    if text.starts_with(BYTE_ORDER_MARK) {
        text.drain(..BYTE_ORDER_MARK.len_utf8());
    }
    Ok(text)
}

/// A file to be rewritten that keeps the content of an earlier run until the first write: a run that fails earlier destroys
/// nothing.
#[derive(Debug)]
pub struct LateFile {
    file: File,
    is_new: bool,
    is_earlier: bool,
}

impl LateFile {
    /// Opens the file at `path` for writing; creates it and its folder if they do not exist.
    ///
    /// # Errors
    /// The folder or the file cannot be created, or the file cannot be written.
    pub fn open(path: &Path) -> io::Result<Self> {
        path.parent().map_or(Ok(()), fs::create_dir_all)?;
        let is_new = !path.exists();
        let file = File::options().write(true).create(true).truncate(false).open(path)?;
        // A device or a pipe has no content.
        let is_earlier = file.metadata()?.len() > 0;
        Ok(Self { file, is_new, is_earlier })
    }

    /// The file in its present state.
    pub fn file(&self) -> &File {
        &self.file
    }

    /// Whether the file did not exist before.
    pub fn is_new(&self) -> bool {
        self.is_new
    }

    /// Whether it still has its earlier content.
    pub fn is_earlier(&self) -> bool {
        self.is_earlier
    }

    /// Returns the file for writing; empties it the first time.
    ///
    /// # Errors
    /// It cannot be emptied.
    pub fn begin(&mut self) -> io::Result<&mut File> {
        if self.is_earlier {
            self.file.set_len(0)?;
            self.is_earlier = false;
        }
        Ok(&mut self.file)
    }
}

impl From<File> for LateFile {
    /// Continues a file: its content is not of an earlier run.
    fn from(file: File) -> Self {
        Self { file, is_new: false, is_earlier: false }
    }
}

/// Whether a path leads to something other than a file or a folder: a device, a pipe or a socket, whose opening may block for
/// ever.
pub fn is_special(path: &Path) -> bool {
    path.metadata().is_ok_and(|about| !about.is_file() && !about.is_dir())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Write as _;

    #[test]
    fn a_late_file_is_emptied_only_when_something_is_written() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("new/file");
        for (before, is_new) in [(None, true), (Some(""), false), (Some("earlier"), false)] {
            before.iter().for_each(|before| fs::write(&path, before).unwrap());
            let mut file = LateFile::open(&path).unwrap();
            assert_eq!((file.is_new(), file.is_earlier()), (is_new, before == Some("earlier")));
            assert_eq!(fs::read_to_string(&path).unwrap(), before.unwrap_or_default());
            for text in ["one", "two"] {
                file.begin().unwrap().write_all(text.as_bytes()).unwrap();
            }
            assert_eq!((fs::read_to_string(&path).unwrap().as_str(), file.is_earlier()), ("onetwo", false));
        }
        assert!(!LateFile::open(Path::new("/dev/null")).unwrap().is_earlier());
    }

    #[test]
    fn a_text_is_read_up_to_its_limit_and_not_beyond() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("text");
        fs::write(&path, "1234").unwrap();
        assert_eq!(read_text(&path, 4).unwrap(), "1234");
        fs::write(&path, "\u{feff}1").unwrap();
        assert_eq!(read_text(&path, 4).unwrap(), "1");
        assert_eq!(read_text(&path, 3).unwrap_err().to_string(), "it is longer than 3 bytes");
        assert!(read_text(Path::new("/dev/zero"), 1000).is_err());
        assert!(is_special(Path::new("/dev/zero")) && ![folder.path(), &path].into_iter().any(is_special));
    }
}
