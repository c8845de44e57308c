//! Memory that a writer is sure of.
//!
//! iceoryx2 gives a segment its length, and the system gives memory for a page when that is first written: where other
//! programs have taken what was free, the writer is killed. So the pages that its images can come to need are asked for as
//! soon as the segment is there, when it can still be told that there are too few. They are the first of the segment: of the
//! places for messages that are free it takes the one that came back last, and a new one only where there is none.

use super::cleanup::for_each_entry;
use crate::ports::capacity::SHARED_MEMORY;
use rustix::fs::{FallocateFlags, fallocate};
use rustix::io::{Errno, retry_on_intr};
use std::fs::File;
use std::io;
use std::path::Path;

/// What the name of a segment of messages ends with.
const MESSAGES: &str = ".data";

/// Takes memory for the first bytes of the segment in which the port `publisher` of a folder's user has its messages.
///
/// # Errors
/// There is not so much. Where a file system cannot say, memory is given when it is written, as ever.
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

    /// A segment of a terabyte, of which nothing is written.
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
