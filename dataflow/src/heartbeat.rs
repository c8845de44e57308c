//! The sign of life of a stage that waits: a time in its record, where the launcher looks for it, and for whom it waits.

use crate::clock::monotonic_ns;
use conicflow_messages::Text;
use std::fs::File;
use std::os::unix::fs::FileExt;
use std::sync::atomic::{AtomicU64, Ordering};

/// It is given this often at most.
const PERIOD_NS: u64 = 100_000_000;

/// Gives signs of life in the record of this process's stage.
#[derive(Debug)]
pub(crate) struct Heartbeat {
    record: File,
    alive_at: u64,
    waits_at: u64,
    given_ns: AtomicU64,
    told_ns: AtomicU64,
}

impl Heartbeat {
    /// Signs of life that go to the place `alive_at` in a stage's record, and at `waits_at` for whom it waits.
    pub(crate) fn new(record: File, alive_at: usize, waits_at: usize) -> Self {
        let [given_ns, told_ns] = [AtomicU64::new(0), AtomicU64::new(0)];
        Self { record, alive_at: alive_at as u64, waits_at: waits_at as u64, given_ns, told_ns }
    }

    /// Gives a sign of life, if the last one is old.
    pub(crate) fn beat(&self) {
        if let Some(now) = is_due(&self.given_ns) {
            // A record that cannot be written (a full disk) hides the counts as well.
            self.record.write_all_at(&now.to_ne_bytes(), self.alive_at).ok();
        }
    }

    /// Tells for which stage this one waits, until the record is written the next time.
    pub(crate) fn wait_for(&self, stage: &str) {
        if is_due(&self.told_ns).is_some() {
            self.record.write_all_at(bytemuck::bytes_of(&Text::<32>::new(stage)), self.waits_at).ok();
        }
    }
}

/// The present time, where the last one that was noted is old; it is noted then.
fn is_due(noted_ns: &AtomicU64) -> Option<u64> {
    let now = monotonic_ns();
    let is_old = now.saturating_sub(noted_ns.load(Ordering::Relaxed)) >= PERIOD_NS;
    is_old.then(|| {
        noted_ns.store(now, Ordering::Relaxed);
        now
    })
}
