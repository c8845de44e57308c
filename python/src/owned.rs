//! What belongs to the process that made it: ports of a run, and memory that a writer lends. A fork copies them, but they stay
//! one: a copy that the child drops would end the port of its parent, or give the parent's image back.

use crate::fault;
use pyo3::PyResult;
use std::mem::forget;
use std::process::id;

/// A value that only the process that made it uses and drops; one that was forked from it leaves it alone.
pub(crate) struct Owned<T> {
    value: Option<T>,
    process: u32,
}

impl<T> Owned<T> {
    /// A value of this process.
    pub(crate) fn new(value: T) -> Self {
        Self { value: Some(value), process: id() }
    }

    /// The value, in the process that made it.
    pub(crate) fn here(&self) -> Option<&T> {
        self.value.as_ref().filter(|_| self.process == id())
    }

    /// The value; in another process an error, which calls it by this name.
    pub(crate) fn expect(&self, name: &str) -> PyResult<&T> {
        self.here().ok_or_else(|| {
            let what = format!("this {name} was made in another process, from which this one was forked");
            fault::run(&conicflow_messages::Hinted::new(what, "open it after the fork, in the process that uses it"))
        })
    }
}

impl<T> Drop for Owned<T> {
    fn drop(&mut self) {
        if self.process != id() {
            forget(self.value.take());
        }
    }
}
