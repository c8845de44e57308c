//! The program `conicflow-bridge`: carries topics between machines, as a stage that `conicflow run` starts where the pipeline
//! file has several, and runs the nodes that take part in ROS 2. It is a program of its own so that no other stage has the
//! network in it.
//!
//! `conicflow-bridge check` and `conicflow-bridge endpoints` answer what `conicflow` asks of a machine's table: they read it
//! as JSON and write what is wrong with it, or where it listens.

use conicflow_bridge::{NETWORK, NODES};
use conicflow_dataflow::pipeline::Machine;
use conicflow_dataflow::{DEFAULT_LOG, LOG, ProcessError, Registry, error_text, log_to_standard_error, run_in_run};
use std::io::{self, Write};
use std::process::ExitCode;

/// Exit code for wrong arguments.
const WRONG_INPUT: u8 = 2;

fn main() -> ExitCode {
    log_to_standard_error(&std::env::var(LOG).unwrap_or_else(|_| DEFAULT_LOG.to_owned()));
    let question = std::env::args().nth(1);
    let (ended, code) = match question.as_deref() {
        None => {
            let ended = run_in_run(&Registry { nodes: NODES, network: Some(NETWORK) });
            let code = ended.as_ref().err().map_or(0, ProcessError::exit_code);
            (ended.map_err(Into::into), code)
        }
        Some(question) => (answer(question), WRONG_INPUT),
    };
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // Whether anybody reads it is not the bridge's concern.
            writeln!(io::stderr(), "{}", error_text(&error)).ok();
            code.into()
        }
    }
}

/// Answers what is asked of the machine on standard input.
fn answer(question: &str) -> Result<(), Box<dyn std::error::Error>> {
    let machine = || serde_json::from_reader::<_, Machine>(io::stdin().lock());
    let answer = match question {
        "check" => serde_json::to_string(&(NETWORK.check)(&machine()?))?,
        "endpoints" => serde_json::to_string(&(NETWORK.listen_endpoints)(&machine()?))?,
        _ => {
            return Err(format!(
                "`{question}` is nothing that can be asked\n  hint: this program is part of `conicflow run`, which starts it where \
                 a pipeline file has several machines"
            )
            .into());
        }
    };
    Ok(writeln!(io::stdout(), "{answer}")?)
}
