//! The last error for C: a text per thread.

use conicflow_messages::Hinted;
use std::cell::RefCell;
use std::ffi::{CString, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};

thread_local! {
    static LAST: RefCell<CString> = RefCell::default();
}

/// Runs `work` and returns its result; after an error or a panic keeps the text and returns `None`.
pub(crate) fn catch<T>(work: impl FnOnce() -> Result<T, Hinted>) -> Option<T> {
    // A detector starts afresh with each image: it does not read what a panic has left in its buffers.
    let done = catch_unwind(AssertUnwindSafe(work));
    let fault = match done {
        Ok(Ok(value)) => return Some(value),
        Ok(Err(fault)) => fault,
        Err(panic) => {
            let text = panic.downcast_ref::<String>().map(String::as_str).or(panic.downcast_ref().copied());
            let what = format!("a fault within the detector: {}", text.unwrap_or("it says no more"));
            Hinted::new(what, "please report it, with the image")
        }
    };
    let text = fault.to_string().replace('\0', "?");
    LAST.set(CString::new(text).unwrap_or_default());
    None
}

/// Returns the last error of this thread.
pub(crate) fn last() -> *const c_char {
    // A thread that is ending has lost its text.
    LAST.try_with(|last| last.borrow().as_ptr()).unwrap_or(c"".as_ptr())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::ffi::CStr;

    fn text() -> String {
        // SAFETY: it is a text of this thread, and no error replaces it meanwhile.
        unsafe { CStr::from_ptr(last()) }.to_str().unwrap().to_owned()
    }

    #[test]
    fn each_thread_has_its_text_and_keeps_it_while_nothing_goes_wrong() {
        assert_eq!(text(), "");
        assert_eq!(catch(|| Err::<(), _>(Hinted::new("no\0thing", "some"))), None);
        assert_eq!(catch(|| Ok(3)), Some(3));
        assert_eq!(text(), "no?thing\n  hint: some");
        std::thread::spawn(|| assert_eq!(text(), "")).join().unwrap();
    }

    #[test]
    fn a_panic_does_not_leave() {
        assert_eq!(catch::<()>(|| panic!("of {}", 3)), None);
        assert_eq!(text(), "a fault within the detector: of 3\n  hint: please report it, with the image");
        assert_eq!(catch::<()>(|| std::panic::panic_any(3)), None);
        assert!(text().starts_with("a fault within the detector: it says no more"));
    }
}
