//! iceoryx2 leaves the descriptors that it opens to all processes that are started afterwards. These have no use for them, and each
//! counts against what they may have open.

use std::collections::BTreeSet;

/// Descriptors that processes get which this one starts.
pub(crate) struct Descriptors(BTreeSet<i32>);

impl Descriptors {
    /// Those of now: they may be meant for what is started.
    pub(crate) fn now() -> Self {
        let listed = std::fs::read_dir("/proc/self/fd").into_iter().flatten().flatten();
        let numbers: Vec<i32> = listed.filter_map(|entry| entry.file_name().to_str()?.parse().ok()).collect();
        // Not the one by which they were listed: that is closed by now.
        Self(numbers.into_iter().filter(|number| is_passed_on(*number)).collect())
    }

    /// Keeps all that were opened since to this process.
    pub(crate) fn keep_later_ones(&self) {
        for descriptor in Self::now().0.difference(&self.0) {
            // SAFETY: it changes no more than a flag; a descriptor that was closed meanwhile is refused.
            unsafe { libc::fcntl(*descriptor, libc::F_SETFD, libc::FD_CLOEXEC) };
        }
    }
}

/// Whether this is a descriptor that processes get which this one starts.
fn is_passed_on(descriptor: i32) -> bool {
    // SAFETY: it asks for a flag; where there is no such descriptor it is refused.
    unsafe { libc::fcntl(descriptor, libc::F_GETFD) == 0 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::fs::File;
    use std::os::fd::{AsRawFd, FromRawFd, OwnedFd};

    /// A descriptor of a file that processes get which are started, with a number that no other test has.
    fn passed_on(file: &File) -> OwnedFd {
        // SAFETY: the descriptor is new, and nobody else's.
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
