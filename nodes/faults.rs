//! Errors and faults that several nodes share: conversion to a stage's error, refusal of a restart that has lost sums, images
//! with only one side given.

use conicflow_dataflow::{ConfigFault, Context, StageError};
use conicflow_messages::Hinted;

/// Converts an error to one of a stage; `?` would hide from the runner whether it is permanent.
pub fn stage_error(error: anyhow::Error) -> StageError {
    error.reallocate_into_boxed_dyn_error_without_backtrace()
}

/// Refuses the restart of a stage that keeps its sums in memory; `summed` is the participle for its work ("counted").
///
/// # Errors
/// The stage was restarted in the same run.
pub fn refuse_restart(context: &Context, summed: &str) -> Result<(), StageError> {
    if context.resume_at == 0 {
        return Ok(());
    }
    Err(Hinted::new(format!("what was {summed} before this stage was started anew is lost"), "run it from the start")
        .into())
}

/// Returns the fault of giving only one side of an image.
pub fn one_of_two(width: Option<u32>, height: Option<u32>) -> Option<ConfigFault> {
    let key = if width.is_some() { "width" } else { "height" };
    let fault = || ConfigFault::new(key, "is one of two", "give both `width` and `height`, or none");
    (width.is_some() != height.is_some()).then(fault)
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::lasts;

    #[test]
    fn the_run_recognises_a_lasting_error() {
        assert!(lasts(&*stage_error(Hinted::lasting("full", "free some space").into())));
        assert!(lasts(&*stage_error(std::io::Error::from(std::io::ErrorKind::StorageFull).into())));
        assert!(!lasts(&*stage_error(Hinted::new("gone", "wait").into())));
    }

    #[test]
    fn a_restart_is_refused_and_the_first_start_is_not() {
        assert!(refuse_restart(&Context::default(), "counted").is_ok());
        let context = Context { resume_at: 3, ..Context::default() };
        let error = refuse_restart(&context, "counted").unwrap_err().to_string();
        assert!(error.starts_with("what was counted before") && error.contains("\n  hint: "), "{error}");
    }
}
