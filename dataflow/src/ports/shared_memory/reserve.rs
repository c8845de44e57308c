//! Reserves shared memory for a writer.
//!
//! iceoryx2 sets the length of a segment, but the system allocates a page only at the first write: if memory is exhausted then,
//! the writer is killed. The pages that a writer's images can need are therefore allocated as soon as the segment exists, when a
//! lack of memory can still be reported. These are the first pages of the segment, as the allocator reuses the slot that was
//! returned last, and takes a new one only if none is free.

use super::cleanup::for_each_entry;
use crate::ports::capacity::SHARED_MEMORY;
use rustix::fs::{FallocateFlags, fallocate};
use rustix::io::{Errno, retry_on_intr};
use std::fs::File;
use std::io;
use std::path::Path;

/// Suffix of the name of a segment with messages.
const MESSAGES: &str = ".data";

/// Allocates the first bytes of the segment in which the port `publisher` of a folder's user has its messages.
///
/// # Errors
/// There is too little memory. A file system without such allocation is no error: memory is allocated at the first write.
pub(super) fn reserve(prefix: &str, publisher: u128, bytes: u64) -> io::Result<()> {
    let end = format!("_{publisher}{MESSAGES}");
    let is_own = |name: &str| name.starts_with(prefix) && name.ends_with(&end);
    for_each_entry(Path::new(SHARED_MEMORY), is_own, |path, _| {
        let segment = File::options().write(true).open(path)?;
        let bytes = bytes.min(segment.metadata()?.len());
        match retry_on_intr(|| fallocate(&segment, FallocateFlags::KEEP_SIZE, 0, bytes)) {
            Err(Errno::OPNOTSUPP) => Ok(()),
            taken => Ok(taken?),
        }
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::unix::fs::MetadataExt;
    use std::path::PathBuf;

    /// A sparse segment of a terabyte.
    struct Segment(PathBuf);

    impl Segment {
        fn new(prefix: &str) -> Self {
            let path = Path::new(SHARED_MEMORY).join(format!("{prefix}service_7{MESSAGES}"));
            File::create(&path).unwrap().set_len(1 << 40).unwrap();
            Self(path)
        }
    }

    impl Drop for Segment {
        fn drop(&mut self) {
            std::fs::remove_file(&self.0).unwrap();
        }
    }

    #[test]
    fn memory_is_there_before_it_is_written_or_its_want_is_told() {
        let prefix = format!("conicflow_test_{}_", std::process::id());
        let segment = Segment::new(&prefix);
        reserve(&prefix, 8, 1 << 20).unwrap();
        assert_eq!(segment.0.metadata().unwrap().blocks(), 0, "it is another port's");
        reserve(&prefix, 7, 1 << 20).unwrap();
        assert_eq!(segment.0.metadata().unwrap().blocks() * 512, 1 << 20);
        let error = reserve(&prefix, 7, 1 << 40).unwrap_err();
        assert_eq!(error.kind(), io::ErrorKind::StorageFull, "{error}");
        assert_eq!(segment.0.metadata().unwrap().blocks() * 512, 1 << 20, "what was asked for in vain is given back");
    }
}
