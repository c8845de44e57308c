//! Writes files of pictures so that no reader sees half of one.

use anyhow::Result;
use conicflow_messages::{Hinted, is_special};
use std::path::Path;
use std::{fs, io};

/// Writes a file under a temporary name and renames it when it is complete; creates its folder if that is missing. A link stays a
/// link, and a device is written into.
///
/// # Errors
/// The file cannot be written.
pub(super) fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    let path = &path.canonicalize().unwrap_or_else(|_| path.to_owned());
    let folder = path.parent().map_or(Ok(()), fs::create_dir_all);
    let written = folder.and_then(|()| if is_special(path) { fs::write(path, bytes) } else { replace(path, bytes) });
    written
        .map_err(|error| Hinted::of_writing(format!("`{}` cannot be written: {error}", path.display()), &error).into())
}

fn replace(path: &Path, bytes: &[u8]) -> io::Result<()> {
    let part = path.with_extension("part");
    let replaced = fs::write(&part, bytes).and_then(|()| fs::rename(&part, path));
    if replaced.is_err() {
        // If removing it fails, too, the incomplete file stays.
        fs::remove_file(&part).ok();
    }
    replaced
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::symlink;

    #[test]
    fn a_file_is_replaced_and_a_link_or_a_device_is_written_into() {
        let folder = tempfile::tempdir().unwrap();
        let [file, link, device] = ["new/a.png", "link.png", "device.png"].map(|name| folder.path().join(name));
        symlink(&file, &link).unwrap();
        symlink("/dev/null", &device).unwrap();
        write_whole(&file, b"1").unwrap();
        write_whole(&link, b"2").unwrap();
        write_whole(&device, b"3").unwrap();
        assert_eq!(fs::read(&file).unwrap(), b"2");
        assert!(link.is_symlink() && is_special(&device));
        let folder = file.parent().unwrap();
        assert!(write_whole(folder, b"4").unwrap_err().to_string().contains("cannot be written"));
        assert_eq!(fs::read_dir(folder).unwrap().count(), 1, "no part is left");
    }
}
