//! Heartbeat of a waiting stage: the time, and the stage that it waits for, in its record, where the launcher reads them.

use crate::clock::monotonic_ns;
use conicflow_messages::Text;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::sync::atomic::{AtomicU64, Ordering};

/// Minimum interval between two heartbeats.
const PERIOD_NS: u64 = 100_000_000;

/// Writes heartbeats into the record of this process's stage.
#[derive(Debug)]
pub(crate) struct Heartbeat {
    record: File,
    alive_at: u64,
    waits_at: u64,
    given_ns: AtomicU64,
    told_ns: AtomicU64,
}

impl Heartbeat {
    /// Writes the time at the offset `alive_at` of a stage's record, and the stage that it waits for at `waits_at`.
    pub(crate) fn new(record: File, alive_at: usize, waits_at: usize) -> Self {
        let [given_ns, told_ns] = [AtomicU64::new(0), AtomicU64::new(0)];
        Self { record, alive_at: alive_at as u64, waits_at: waits_at as u64, given_ns, told_ns }
    }

    /// Writes the time, if the last heartbeat is old.
    pub(crate) fn beat(&self) {
        if let Some(now) = is_due(&self.given_ns) {
            // If the record cannot be written (a full disk), the counts are hidden, too.
            self.record.write_all_at(&now.to_ne_bytes(), self.alive_at).ok();
        }
    }

    /// Writes the stage that this one waits for; the next write of the record overwrites it.
    pub(crate) fn wait_for(&self, stage: &str) {
        if is_due(&self.told_ns).is_some() {
            self.record.write_all_at(bytemuck::bytes_of(&Text::<32>::new(stage)), self.waits_at).ok();
        }
    }
}

/// Returns and stores the current time, if the stored one is old.
fn is_due(noted_ns: &AtomicU64) -> Option<u64> {
    let now = monotonic_ns();
    let is_old = now.saturating_sub(noted_ns.load(Ordering::Relaxed)) >= PERIOD_NS;
    is_old.then(|| {
        noted_ns.store(now, Ordering::Relaxed);
        now
    })
}
