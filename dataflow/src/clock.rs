//! Clocks: the monotonic one for hop times, which all processes of one machine share, and the time of day.

use rustix::time::{ClockId, clock_gettime};
use std::time::UNIX_EPOCH;

/// Nanoseconds on this machine's monotonic clock.
pub fn monotonic_ns() -> u64 {
    let now = clock_gettime(ClockId::Monotonic);
    now.tv_sec.unsigned_abs() * 1_000_000_000 + now.tv_nsec.unsigned_abs()
}

/// Nanoseconds since the Unix epoch; 0 if the clock is set to an earlier time.
pub fn unix_ns() -> u64 {
    UNIX_EPOCH.elapsed().map_or(0, |since| since.as_nanos() as u64)
}

/// Waits until a condition holds, at most for 20 seconds. Returns whether it does.
#[cfg(test)]
pub(crate) fn until(mut is_so: impl FnMut() -> bool) -> bool {
    let begin = std::time::Instant::now();
    loop {
        match is_so() {
            false if begin.elapsed().as_secs() < 20 => std::thread::sleep(std::time::Duration::from_millis(1)),
            is_so => return is_so,
        }
    }
}
