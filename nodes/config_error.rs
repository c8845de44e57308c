//! What goes wrong in the same way with several stages: a restart has lost sums.

use conicflow_dataflow::{Context, StageError};
use conicflow_messages::Hinted;

/// Refuses the restart of a stage that keeps its sums in memory; `summed` says what it did with its input ("counted").
///
/// # Errors
/// It was started anew in the same run.
pub fn refuse_restart(context: &Context, summed: &str) -> Result<(), StageError> {
    if context.resume_at == 0 {
        return Ok(());
    }
    Err(Hinted::new(format!("what was {summed} before this stage was started anew is lost"), "run it from the start")
        .into())
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
