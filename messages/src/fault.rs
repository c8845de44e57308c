//! Errors with a hint: the common form of errors in all packages.

use crate::DEPTH_SCALES_M;
use serde::{Deserialize, Serialize};
use std::error::Error;
use std::io::{self, ErrorKind};
use std::path::Path;

/// An error and what to do about it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
#[error("{what}\n  hint: {hint}")]
pub struct Hinted {
    /// What is wrong.
    pub what: String,
    /// What to do about it.
    pub hint: String,
    /// Whether a retry would fail in the same way.
    #[serde(default)]
    pub lasts: bool,
}

impl Hinted {
    /// An error with its hint.
    pub fn new(what: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { what: what.into(), hint: hint.into(), lasts: false }
    }

    /// An error that a retry would give again.
    pub fn lasting(what: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { lasts: true, ..Self::new(what, hint) }
    }

    /// An error that prevents a file from being written, with a hint for its cause.
    pub fn of_writing(what: impl Into<String>, error: &io::Error) -> Self {
        let hint = match error.kind() {
            ErrorKind::StorageFull | ErrorKind::QuotaExceeded => "free some space, or write to another disk",
            ErrorKind::FileTooLarge => "raise the limit of a file's size (`ulimit -f`), or write less",
            ErrorKind::PermissionDenied | ErrorKind::ReadOnlyFilesystem => "choose a place that you may write to",
            ErrorKind::IsADirectory => "name a file, not a folder",
            ErrorKind::NotADirectory | ErrorKind::AlreadyExists => "a part of the path before the last is a file",
            _ => "name a file that can be written",
        };
        Self { lasts: has_no_room(error), ..Self::new(what, hint) }
    }

    /// Joins an error and its causes into one line, with the hint of the innermost [`Hinted`] among them, else `otherwise`.
    pub fn of(error: &(dyn Error + 'static), otherwise: &str) -> Self {
        let (mut texts, mut hint, mut next) = (Vec::new(), otherwise, Some(error));
        while let Some(cause) = next {
            match cause.downcast_ref::<Self>() {
                Some(own) => {
                    texts.push(own.what.clone());
                    hint = &own.hint;
                }
                None => texts.push(cause.to_string()),
            }
            next = cause.source();
        }
        Self::new(texts.join(": "), hint)
    }
}

/// Whether a file has no room, or may not be written at all.
fn has_no_room(error: &io::Error) -> bool {
    use ErrorKind::{FileTooLarge, QuotaExceeded, ReadOnlyFilesystem, StorageFull};
    matches!(error.kind(), StorageFull | QuotaExceeded | FileTooLarge | ReadOnlyFilesystem)
}

/// Whether a retry would fail again, according to an error or one of its causes: for example, a full disk stays full.
pub fn lasts(error: &(dyn Error + 'static)) -> bool {
    let own = error.downcast_ref::<Hinted>().is_some_and(|hinted| hinted.lasts);
    own || error.downcast_ref().is_some_and(has_no_room) || error.source().is_some_and(lasts)
}

/// A parameter whose value cannot be used.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ConfigFault {
    /// Name of the parameter.
    pub key: &'static str,
    /// What is wrong with its value.
    pub what: String,
    /// What to do about it.
    pub hint: String,
}

impl ConfigFault {
    /// A fault of the parameter `key`, and what to do about it.
    pub fn new(key: &'static str, what: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { key, what: what.into(), hint: hint.into() }
    }

    /// Returns a fault if the parameter `key` names a file or folder that does not exist.
    pub fn of_missing(key: &'static str, path: &Path) -> Option<Self> {
        let what = || format!("`{}` does not exist", path.display());
        (!path.exists()).then(|| Self::new(key, what(), "relative paths start at the pipeline file's folder"))
    }

    /// Returns the fault of `depth_scale`, the parameter with the metres per unit of depth, if it is out of range.
    pub fn of_depth_scale(scale: f64) -> Option<Self> {
        let fault = || Self::new("depth_scale", "is not from 1e-9 to 1", "0.001 for millimetres");
        (!DEPTH_SCALES_M.contains(&scale)).then(fault)
    }

    /// A fault of the parameter `key` that names an unusable file.
    pub fn of_file(key: &'static str, error: &(dyn Error + 'static)) -> Self {
        let Hinted { what, hint, .. } = Hinted::of(error, "correct the file, or name another one");
        Self { key, what, hint }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, thiserror::Error)]
    #[error("truth file `a`")]
    struct Outer<E: Error>(#[source] E);

    #[test]
    fn a_full_disk_is_a_lasting_fault_and_a_missing_file_is_not() {
        let full = || io::Error::from(ErrorKind::StorageFull);
        assert!(lasts(&full()) && lasts(&Outer(full())) && lasts(&Outer(Hinted::of_writing("a", &full()))));
        assert!(lasts(&Outer(Hinted::lasting("a", "b"))));
        let gone = || io::Error::from(ErrorKind::NotFound);
        assert!(!lasts(&gone()) && !lasts(&Outer(Hinted::of_writing("a", &gone()))) && !lasts(&Hinted::new("a", "b")));
    }

    #[test]
    fn the_hint_of_a_cause_is_that_of_the_fault() {
        let fault = ConfigFault::of_file("truth", &Outer(Hinted::new("no such file", "name another")));
        let expected =
            ConfigFault { key: "truth", what: "truth file `a`: no such file".into(), hint: "name another".into() };
        assert_eq!(fault, expected);
        let fault = ConfigFault::of_file("truth", &Outer(std::fmt::Error));
        assert!(
            fault.what.starts_with("truth file `a`: an error") && fault.hint.starts_with("correct the"),
            "{fault:?}"
        );
        assert_eq!(Hinted::new("a", "b").to_string(), "a\n  hint: b");
    }

    #[test]
    fn a_depth_scale_is_above_0_and_at_most_1() {
        for (scale, is_fault) in
            [(0.001, false), (1.0, false), (0.0, true), (-0.001, true), (1.001, true), (f64::NAN, true)]
        {
            assert_eq!(
                ConfigFault::of_depth_scale(scale).is_some_and(|it| it.key == "depth_scale"),
                is_fault,
                "{scale}"
            );
        }
    }
}
