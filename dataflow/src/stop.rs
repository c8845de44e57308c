//! The request to end: a flag by which a stage learns that its run ends, or that it has to hand over its place.

use crate::heartbeat::Heartbeat;
use std::sync::atomic::{AtomicBool, AtomicU8, Ordering};
use std::sync::{Arc, OnceLock};

/// A flag that is set when the run is to end: in order, or at once.
///
/// Each query also sends a heartbeat, by which the launcher distinguishes a waiting stage from one that hangs. A step that may
/// take seconds should therefore query it now and then.
#[derive(Clone, Debug, Default)]
pub struct Stop(Arc<Flags>);

#[derive(Debug, Default)]
struct Flags {
    end: AtomicU8,
    leave: AtomicBool,
    heartbeat: OnceLock<Heartbeat>,
}

const IN_ORDER: u8 = 1;
const AT_ONCE: u8 = 2;

impl Stop {
    /// Whether the run is to end.
    pub fn requested(&self) -> bool {
        self.show_life();
        self.0.end.load(Ordering::Relaxed) >= IN_ORDER
    }

    /// Whether the run is to end at once, without waiting for anything.
    pub fn forced(&self) -> bool {
        self.show_life();
        self.0.end.load(Ordering::Relaxed) >= AT_ONCE
    }

    /// Ends the run in order: sources stop, and frames in flight are finished.
    pub fn request(&self) {
        self.0.end.fetch_max(IN_ORDER, Ordering::Relaxed);
    }

    /// Ends the run at once.
    pub fn force(&self) {
        self.0.end.fetch_max(AT_ONCE, Ordering::Relaxed);
    }

    fn show_life(&self) {
        self.0.heartbeat.get().into_iter().for_each(Heartbeat::beat);
    }

    /// Records in the heartbeat that this stage waits for the stage `stage` to take its messages.
    pub(crate) fn wait_for(&self, stage: &str) {
        self.0.heartbeat.get().into_iter().for_each(|heartbeat| heartbeat.wait_for(stage));
    }

    /// Sets the heartbeat that queries update.
    pub(crate) fn show_life_by(&self, heartbeat: Heartbeat) {
        // A process runs one stage, with one record.
        self.0.heartbeat.set(heartbeat).ok();
    }

    /// Whether this stage is to hand its place to another process.
    pub(crate) fn leaving(&self) -> bool {
        self.0.leave.load(Ordering::Relaxed)
    }

    /// Asks this stage to hand its place to another process; the run goes on.
    pub(crate) fn leave(&self) {
        self.0.leave.store(true, Ordering::Relaxed);
    }
}
