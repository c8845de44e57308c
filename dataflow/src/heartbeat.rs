//! The sign of life of a stage that waits: a time in its record, where the launcher looks for it.

use crate::clock::monotonic_ns;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::sync::atomic::{AtomicU64, Ordering};

/// It is given this often at most.
const PERIOD_NS: u64 = 100_000_000;

/// Gives signs of life in the record of this process's stage.
#[derive(Debug)]
pub(crate) struct Heartbeat {
    record: File,
    offset: u64,
    given_ns: AtomicU64,
}

impl Heartbeat {
    /// Signs of life that go to this place in a stage's record.
    pub(crate) fn new(record: File, offset: usize) -> Self {
        Self { record, offset: offset as u64, given_ns: AtomicU64::new(0) }
    }

    /// Gives a sign of life, if the last one is old.
    pub(crate) fn beat(&self) {
        let now = monotonic_ns();
        if now.saturating_sub(self.given_ns.load(Ordering::Relaxed)) >= PERIOD_NS {
            self.given_ns.store(now, Ordering::Relaxed);
            // A record that cannot be written (a full disk) hides the counts as well.
            self.record.write_all_at(&now.to_ne_bytes(), self.offset).ok();
        }
    }
}
