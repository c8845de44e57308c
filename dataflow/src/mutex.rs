//! Mutexes whose threads may panic.

use std::sync::{Mutex, MutexGuard, PoisonError};

/// Locks a mutex, also where a thread panicked that held it: that thread's error is reported where it is joined, and what the
/// others share is used as it was left.
pub fn lock<T: ?Sized>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mutex_is_locked_also_after_a_thread_panicked_that_held_it() {
        let mutex = Mutex::new(1);
        std::thread::scope(|scope| {
            let holder = scope.spawn(|| {
                let mut held = lock(&mutex);
                *held = 2;
                panic!("while it is held");
            });
            assert!(holder.join().is_err());
        });
        assert_eq!((mutex.is_poisoned(), *lock(&mutex)), (true, 2));
    }
}
