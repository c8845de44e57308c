//! What went wrong, as C is told it: a text for each thread.

use conicflow_messages::Hinted;
use std::cell::RefCell;
use std::error::Error;
use std::ffi::{CString, c_char};
use std::panic::{AssertUnwindSafe, catch_unwind};

thread_local! {
    static LAST: RefCell<CString> = RefCell::default();
}

/// What `work` returns; if it fails or panics nothing, and the text is kept.
pub(crate) fn catch<T>(work: impl FnOnce() -> Result<T, Hinted>) -> Option<T> {
    // A detector begins each image anew: what a panic has left in its buffers is not looked at again.
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

/// An error of the detector, which has its hint in it.
pub(crate) fn told(error: &dyn Error) -> Hinted {
    let text = error.to_string();
    let (what, hint) = text.split_once("\n  hint: ").unwrap_or((&text, "conicflow.h says what is wanted"));
    Hinted::new(what, hint)
}

/// What went wrong last on this thread.
pub(crate) fn last() -> *const c_char {
    // Of a thread that is ending nothing is kept any more.
    LAST.try_with(|last| last.borrow().as_ptr()).unwrap_or(c"".as_ptr())
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::ffi::CStr;

    fn text() -> String {
        // SAFETY: it is a text of this thread, and nothing goes wrong meanwhile.
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
