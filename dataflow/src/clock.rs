//! The clock of hop times: monotonic, shared by all processes of one machine.

use rustix::time::{ClockId, clock_gettime};

/// Nanoseconds on this machine's monotonic clock.
pub fn monotonic_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec.unsigned_abs() * 1_000_000_000 + now.tv_nsec.unsigned_abs()
}
