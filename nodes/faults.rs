//! What goes wrong in the same way with several stages: a parameter names a file that cannot be used, a restart has lost sums.

use conicflow_dataflow::{ConfigFault, Context, StageError};

/// What is wrong with the file that a parameter names; the error may bring its own `hint:`.
pub fn of_file(key: &'static str, error: &anyhow::Error) -> ConfigFault {
    let text = format!("{error:#}");
    let (what, hint) = text.split_once("\n  hint: ").unwrap_or((&text, "correct the file, or name another one"));
    ConfigFault { key, what: what.into(), hint: hint.into() }
}

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
    use anyhow::anyhow;

    #[test]
    fn the_hint_of_an_error_is_that_of_the_fault() {
        let told = |error: anyhow::Error| {
            let ConfigFault { key, what, hint } = of_file("scene", &error);
            format!("{key}: {what}; {hint}")
        };
        let error = anyhow!("no such file\n  hint: name another").context("truth file `a`");
        assert_eq!(told(error), "scene: truth file `a`: no such file; name another");
        assert_eq!(told(anyhow!("line 3")), "scene: line 3; correct the file, or name another one");
    }

    #[test]
    fn only_the_first_start_is_not_refused() {
        assert!(refuse_restart(&Context::default(), "counted").is_ok());
        let context = Context { resume_at: 3, ..Context::default() };
        let told = refuse_restart(&context, "counted").unwrap_err().to_string();
        assert!(told.starts_with("what was counted before") && told.contains("\n  hint: "), "{told}");
    }
}
