//! What is wrong, with what to do about it: the form that every package gives its errors.

use serde::{Deserialize, Serialize};
use std::error::Error;

/// An error and what to do about it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
#[error("{what}\n  hint: {hint}")]
pub struct Hinted {
    /// What is wrong.
    pub what: String,
    /// What to do about it.
    pub hint: String,
}

impl Hinted {
    /// An error with its hint.
    pub fn new(what: impl Into<String>, hint: impl Into<String>) -> Self {
        Self { what: what.into(), hint: hint.into() }
    }

    /// An error and its causes in one line, with the hint that one of them brings, or else this one.
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
    /// The parameter `key` names a file that cannot be used.
    pub fn of_file(key: &'static str, error: &(dyn Error + 'static)) -> Self {
        let Hinted { what, hint } = Hinted::of(error, "correct the file, or name another one");
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
}
