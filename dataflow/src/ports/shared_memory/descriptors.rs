//! iceoryx2 opens descriptors without close-on-exec, so that child processes inherit them. They do not need them, and each counts
//! against their limit of open files.

use std::collections::BTreeSet;

/// Descriptors that child processes inherit.
pub(crate) struct Descriptors(BTreeSet<i32>);

impl Descriptors {
    /// Returns the descriptors that are open now: they may be meant for child processes.
    pub(crate) fn now() -> Self {
        let listed = std::fs::read_dir("/proc/self/fd").into_iter().flatten().flatten();
        let numbers: Vec<i32> = listed.filter_map(|entry| entry.file_name().to_str()?.parse().ok()).collect();
        // Without the one used for the listing, which is closed by now.
        Self(numbers.into_iter().filter(|number| is_passed_on(*number)).collect())
    }

    /// Sets close-on-exec for all that were opened since.
    pub(crate) fn keep_later_ones(&self) {
        for descriptor in Self::now().0.difference(&self.0) {
            // SAFETY: the call changes only a flag; for a closed descriptor it fails.
            unsafe { libc::fcntl(*descriptor, libc::F_SETFD, libc::FD_CLOEXEC) };
        }
    }
}

/// Whether child processes inherit this descriptor.
fn is_passed_on(descriptor: i32) -> bool {
    // SAFETY: the call reads a flag; for a closed descriptor it fails.
    unsafe { libc::fcntl(descriptor, libc::F_GETFD) == 0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;
    use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};

    /// An inheritable descriptor of a file, with a number that no other test uses.
    fn passed_on(file: &File) -> OwnedFd {
        // SAFETY: the descriptor is new, and owned only here.
        unsafe { OwnedFd::from_raw_fd(libc::fcntl(file.as_raw_fd(), libc::F_DUPFD, 900)) }
    }

    #[test]
    fn what_is_started_gets_what_was_open_before_and_nothing_that_was_opened_since() {
        let file = tempfile::tempfile().unwrap();
        let early = passed_on(&file);
        let before = Descriptors::now();
        let late = passed_on(&file);
        let are_passed_on = || [&early, &late].map(|it| is_passed_on(it.as_raw_fd()));
        assert_eq!(are_passed_on(), [true, true]);
        before.keep_later_ones();
        assert_eq!(are_passed_on(), [true, false]);
    }
}
