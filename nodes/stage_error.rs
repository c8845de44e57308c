//! The errors of the adapters as those of stages.

use conicflow_dataflow::StageError;

/// An error as that of a stage, with what it says of itself; `?` would hide from the run whether it lasts.
pub(crate) fn stage_error(error: anyhow::Error) -> StageError {
    error.reallocate_into_boxed_dyn_error_without_backtrace()
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_messages::{Hinted, lasts};

    #[test]
    fn an_error_that_lasts_is_known_as_one_by_the_run() {
        assert!(lasts(&*stage_error(Hinted::lasting("full", "free some space").into())));
        assert!(lasts(&*stage_error(std::io::Error::from(std::io::ErrorKind::StorageFull).into())));
        assert!(!lasts(&*stage_error(Hinted::new("gone", "wait").into())));
    }
}
