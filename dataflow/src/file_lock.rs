//! Locks of files, which the kernel releases however a process ends.

use std::fs::{File, TryLockError};
use std::io;
use std::time::{Duration, Instant};

/// A file whose lock is released on drop. Closing the file is not enough: a process that another thread forks holds a copy of the
/// descriptor until it execs.
#[derive(Debug)]
pub(crate) struct Locked(pub(crate) File);

impl Drop for Locked {
    fn drop(&mut self) {
        self.0.unlock().ok();
    }
}

/// Takes an exclusive lock. While other processes hold it and `is_worth_waiting`, it calls `pause` and retries, up to `grace`.
/// Returns whether the lock was taken.
pub(crate) fn lock_within(
    grace: Duration,
    lock: &File,
    mut is_worth_waiting: impl FnMut(&File) -> bool,
    mut pause: impl FnMut(),
) -> io::Result<bool> {
    let deadline = Instant::now() + grace;
    loop {
        match lock.try_lock() {
            Ok(()) => return Ok(true),
            Err(TryLockError::WouldBlock) if Instant::now() < deadline && is_worth_waiting(lock) => pause(),
            Err(TryLockError::WouldBlock) => return Ok(false),
            Err(TryLockError::Error(error)) => return Err(error),
        }
    }
}

/// Whether the lock is held as a shared one. The shared lock taken for the check is released.
pub(crate) fn is_shared(lock: &File) -> bool {
    lock.try_lock_shared().is_ok_and(|()| lock.unlock().is_ok())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_lock_is_given_back_although_a_process_that_just_starts_has_a_copy() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let locked = Locked(file.reopen().unwrap());
        locked.0.lock().unwrap();
        let _copy = locked.0.try_clone().unwrap();
        let next = file.reopen().unwrap();
        assert!(next.try_lock().is_err());
        drop(locked);
        next.try_lock().unwrap();
    }

    #[test]
    fn a_lock_is_waited_for_where_that_is_worth_it_and_not_for_ever() {
        let file = tempfile::NamedTempFile::new().unwrap();
        let [lock, other] = [0; 2].map(|_| file.reopen().unwrap());
        other.lock_shared().unwrap();
        let hour = Duration::from_secs(3600);
        let never = || panic!("it waits");
        assert!(!lock_within(hour, &lock, |_| false, never).unwrap());
        assert!(!lock_within(Duration::ZERO, &lock, |_| true, never).unwrap());
        assert!(lock_within(hour, &lock, |_| true, || other.unlock().unwrap()).unwrap());
    }
}
