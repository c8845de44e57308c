//! Files by paths that users write, which may lead anywhere.

use std::fs::File;
use std::io::{self, ErrorKind, Read as _};
use std::path::Path;

/// What some programs write before a text.
const BYTE_ORDER_MARK: char = '\u{feff}';

/// Reads a text of so many bytes at most, without a byte order mark.
///
/// # Errors
/// It cannot be read, is longer, or is no UTF-8.
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

/// Whether a path leads to something that is neither a file nor a folder: a device, a pipe or a socket, which may wait for ever to
/// be opened.
pub fn is_special(path: &Path) -> bool {
    path.metadata().is_ok_and(|about| !about.is_file() && !about.is_dir())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_text_is_read_up_to_its_limit_and_not_beyond() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("text");
        std::fs::write(&path, "1234").unwrap();
        assert_eq!(read_text(&path, 4).unwrap(), "1234");
        std::fs::write(&path, "\u{feff}1").unwrap();
        assert_eq!(read_text(&path, 4).unwrap(), "1");
        assert_eq!(read_text(&path, 3).unwrap_err().to_string(), "it is longer than 3 bytes");
        assert!(read_text(Path::new("/dev/zero"), 1000).is_err());
        assert!(is_special(Path::new("/dev/zero")) && ![folder.path(), &path].into_iter().any(is_special));
    }
}
