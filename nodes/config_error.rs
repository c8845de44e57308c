//! What goes wrong in the same way with several stages: a parameter names a file that cannot be used, a restart has lost sums.

use conicflow_dataflow::{Context, StageError};
pub use conicflow_lab::simulator::fault_of_file as of_file;

/// Refuses the restart of a stage that keeps its sums in memory; `summed` says what it did with its input ("counted").
///
/// # Errors
/// It was started anew in the same run.
pub fn refuse_restart(context: &Context, summed: &str) -> Result<(), StageError> {
    if context.resume_at == 0 {
        return Ok(());
    }
    Err(format!("what was {summed} before this stage was started anew is lost\n  hint: run it from the start").into())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_first_start_is_not_refused() {
        assert!(refuse_restart(&Context::default(), "counted").is_ok());
        let context = Context { resume_at: 3, ..Context::default() };
        let told = refuse_restart(&context, "counted").unwrap_err().to_string();
        assert!(told.starts_with("what was counted before") && told.contains("\n  hint: "), "{told}");
    }
}
