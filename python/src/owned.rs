//! Values that belong to the process that made them: ports of a run, and lent memory. A fork copies the handle but not the
//! resource: if the child dropped its copy, the parent's port would end, or its image would be given back.

use crate::fault;
use pyo3::PyResult;
use std::mem::forget;
use std::process::id;

/// A value that only the process that made it uses and drops; forked processes leave it alone.
pub(crate) struct Owned<T> {
    value: Option<T>,
    process: u32,
}

impl<T> Owned<T> {
    /// Creates a value of this process.
    pub(crate) fn new(value: T) -> Self {
        Self { value: Some(value), process: id() }
    }

    /// Returns the value, in the process that made it.
    pub(crate) fn here(&self) -> Option<&T> {
        self.value.as_ref().filter(|_| self.process == id())
    }

    /// Returns the value; in another process an error that mentions `name`.
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
