//! Files of pictures that nobody sees half written.

use anyhow::Result;
use conicflow_messages::Hinted;
use std::fs;
use std::path::Path;

/// Writes a file that has its name only when it is whole, into a folder that is made where it is missing.
///
/// # Errors
/// It cannot be written.
pub(super) fn write_whole(path: &Path, bytes: &[u8]) -> Result<()> {
    let part = path.with_extension("part");
    let folder = path.parent().map_or(Ok(()), fs::create_dir_all);
    folder.and_then(|()| fs::write(&part, bytes)).and_then(|()| fs::rename(&part, path)).map_err(|error| {
        // What cannot be removed either is left as a part.
        fs::remove_file(&part).ok();
        Hinted::of_writing(format!("`{}` cannot be written: {error}", path.display()), &error).into()
    })
}
