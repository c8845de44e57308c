//! The program `conicflow-bridge`: carries topics between machines, as a stage that `conicflow run` starts for a pipeline file
//! with several machines, and runs the nodes that take part in ROS 2. It is a separate program so that no other stage contains
//! the network.
//!
//! `conicflow-bridge check`, `warnings` and `endpoints` answer questions of `conicflow` about a machine's table: they read the
//! table as JSON and print what is wrong with it, what may keep it from its links, or where it listens.

use conicflow_bridge::{NETWORK, NODES, handshake_layer};
use conicflow_dataflow::pipeline::Machine;
use conicflow_dataflow::{DEFAULT_LOG, LOG, ProcessError, Registry, error_text, log_beside, run_in_run};
use std::io::{self, Read, Write};
use std::process::ExitCode;

/// Exit code for wrong arguments.
const WRONG_INPUT: u8 = 2;

fn main() -> ExitCode {
    let filter = std::env::var(LOG).unwrap_or_else(|_| DEFAULT_LOG.to_owned());
    // This program reports the state of links itself; Zenoh's own log is for `CONICFLOW_LOG=zenoh=debug`.
    log_beside(&format!("zenoh=error,{filter}"), handshake_layer());
    let question = std::env::args().nth(1);
    let (ended, code) = match question.as_deref() {
        None => {
            let ended = run_in_run(&Registry { nodes: NODES, network: Some(NETWORK) });
            let code = ended.as_ref().err().map_or(0, ProcessError::exit_code);
            (ended.map_err(Into::into), code)
        }
        Some(question) => {
            let answer = answer(question, io::stdin().lock());
            (answer.and_then(|answer| Ok(writeln!(io::stdout(), "{answer}")?)), WRONG_INPUT)
        }
    };
    match ended {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // A failed write is ignored.
            writeln!(io::stderr(), "{}", error_text(&error)).ok();
            code.into()
        }
    }
}

/// Answers a question about a machine, as JSON; `table` is the machine's table in JSON.
fn answer(question: &str, table: impl Read) -> Result<String, Box<dyn std::error::Error>> {
    let machine = || serde_json::from_reader::<_, Machine>(table);
    match question {
        "check" => Ok(serde_json::to_string(&(NETWORK.check)(&machine()?))?),
        "warnings" => Ok(serde_json::to_string(&(NETWORK.warnings)(&machine()?))?),
        "endpoints" => Ok(serde_json::to_string(&(NETWORK.listen_endpoints)(&machine()?))?),
        _ => Err(format!(
            "`{question}` is nothing that can be asked\n  hint: this program is part of `conicflow run`, which starts it where a \
             pipeline file has several machines"
        )
        .into()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use conicflow_dataflow::Hinted;

    fn answer_about(machine: &Machine, question: &str) -> String {
        answer(question, serde_json::to_vec(machine).unwrap().as_slice()).unwrap()
    }

    #[test]
    fn the_faults_of_a_machine_and_its_listen_endpoints_are_printed() {
        let listening = |endpoint: &str| Machine { listen: vec![endpoint.to_owned()], ..Machine::default() };
        let endpoint = "tcp/127.0.0.1:7447";
        let checked =
            |machine: &Machine| serde_json::from_str::<Result<(), Hinted>>(&answer_about(machine, "check")).unwrap();
        checked(&listening(endpoint)).unwrap();
        checked(&listening("nowhere")).unwrap_err();
        let endpoints = answer_about(&listening(endpoint), "endpoints");
        let endpoints = serde_json::from_str::<Result<Vec<String>, Hinted>>(&endpoints).unwrap();
        assert_eq!(endpoints.unwrap(), [endpoint]);
        assert_eq!(answer_about(&listening(endpoint), "warnings"), "[]");
    }

    #[test]
    fn unknown_questions_and_broken_tables_are_refused() {
        let refused = |question: &str, table: &str| answer(question, table.as_bytes()).unwrap_err().to_string();
        assert!(refused("listen", "{}").contains("`listen` is nothing that can be asked\n  hint: "));
        assert!(refused("check", "[").contains("EOF") && refused("endpoints", "[").contains("EOF"));
    }
}
