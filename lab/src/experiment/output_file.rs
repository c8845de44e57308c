//! The files of the results, with paths as in the pipeline file; missing folders are created.

use anyhow::Result;
use conicflow_messages::Hinted;
use std::fs::{self, OpenOptions};
use std::io;
use std::path::Path;

/// Checks that a file can be written, before hours are spent on its content; leaves it unchanged.
pub(super) fn check(base: &Path, path: &Path) -> Result<()> {
    let path = base.join(path);
    let is_new = !path.exists();
    let opened = make_folder(&path).and_then(|()| OpenOptions::new().append(true).create(true).open(&path));
    opened.and_then(|_| if is_new { fs::remove_file(&path) } else { Ok(()) }).map_err(cannot_write(&path))
}

/// Writes a whole file.
pub(super) fn write(base: &Path, path: &Path, bytes: impl AsRef<[u8]>) -> Result<()> {
    let path = base.join(path);
    make_folder(&path).and_then(|()| fs::write(&path, bytes)).map_err(cannot_write(&path))
}

fn make_folder(path: &Path) -> io::Result<()> {
    path.parent().map_or(Ok(()), fs::create_dir_all)
}

fn cannot_write(path: &Path) -> impl Fn(io::Error) -> anyhow::Error {
    move |error| Hinted::of_writing(format!("cannot write `{}`: {error}", path.display()), &error).into()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_cannot_be_written_is_told_before_and_what_is_there_stays() {
        let folder = tempfile::tempdir().unwrap();
        let (base, file) = (folder.path(), Path::new("results/table.csv"));
        check(base, file).unwrap();
        assert!(base.join("results").is_dir() && !base.join(file).exists());
        write(base, file, "a,b").unwrap();
        check(base, file).unwrap();
        assert_eq!(fs::read_to_string(base.join(file)).unwrap(), "a,b");
        for wrong in ["results", "results/table.csv/table.csv"] {
            for fault in [check(base, Path::new(wrong)), write(base, Path::new(wrong), "")] {
                let told = fault.unwrap_err().to_string();
                assert!(told.starts_with(&format!("cannot write `{}`: ", base.join(wrong).display())), "{told}");
            }
        }
    }
}
