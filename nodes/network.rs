//! The network part of the program: the program `conicflow-bridge` beside this one.
//!
//! The code for other machines is a separate program: stages contain no network code, and on a single machine it is neither built
//! nor run.

use conicflow_dataflow::pipeline::Machine;
use conicflow_dataflow::{Carrier, Hinted, Host, Network};
use serde::de::DeserializeOwned;
use std::path::PathBuf;
use std::process::{Command, Stdio};

/// The network part, for the registry.
pub(crate) const NETWORK: Network = Network {
    check: |machine| ask("check", machine).flatten(),
    // Only a configuration file of Zenoh names certificates.
    warnings: |machine| machine.zenoh.as_ref().and_then(|_| ask("warnings", machine).ok()).unwrap_or_default(),
    listen_endpoints: |machine| ask("endpoints", machine).flatten(),
    carrier: Carrier::Program(program),
};

/// Runs the nodes that communicate with other machines.
pub(crate) const HOST: Host =
    Host { command: |_, _| Ok(vec![program()?.to_string_lossy().into_owned()]), check: |_, _, _| program().map(drop) };

/// Environment variable with the path of the bridge program, if that is not beside this one.
const BRIDGE_PROGRAM: &str = "CONICFLOW_BRIDGE";

const NAME: &str = "conicflow-bridge";

/// Returns the program that carries topics between machines and runs the nodes that communicate with them.
pub(crate) fn program() -> Result<PathBuf, Hinted> {
    let program: PathBuf = match std::env::var_os(BRIDGE_PROGRAM) {
        Some(program) => program.into(),
        None => {
            let own_program = std::env::current_exe();
            own_program.map_err(|error| fault(&format!("this program cannot be found: {error}")))?.with_file_name(NAME)
        }
    };
    // A name without a folder is searched for in PATH.
    let is_name = program.components().count() == 1;
    if is_name || program.is_file() { Ok(program) } else { Err(fault(&format!("there is no `{}`", program.display()))) }
}

fn fault(what: &str) -> Hinted {
    let hint = "several machines and ROS 2 need the program `conicflow-bridge` beside this one: `cargo build --release` makes both, \
                copy both, or name it in CONICFLOW_BRIDGE";
    Hinted::new(what, hint)
}

/// Asks that program a question about a machine, and returns its answer.
fn ask<T: DeserializeOwned>(question: &str, machine: &Machine) -> Result<T, Hinted> {
    let program = program()?;
    let answer = || -> anyhow::Result<T> {
        let mut child = Command::new(&program).arg(question).stdin(Stdio::piped()).stdout(Stdio::piped()).spawn()?;
        if let Some(stdin) = child.stdin.take() {
            serde_json::to_writer(stdin, machine)?;
        }
        Ok(serde_json::from_slice(&child.wait_with_output()?.stdout)?)
    };
    answer().map_err(|error| fault(&format!("`{}` does not answer: {error}", program.display())))
}

#[cfg(test)]
mod tests {
    use conicflow_ros2::{SinkConfig, SourceConfig};
    use serde::Serialize;
    use serde::de::DeserializeOwned;
    use serde_json::to_value;

    #[test]
    fn parameters_that_are_written_and_read_are_the_same() {
        fn check<C: Default + Serialize + DeserializeOwned>() {
            let settled = to_value(C::default()).unwrap();
            assert_eq!(to_value(serde_json::from_value::<C>(settled.clone()).unwrap()).unwrap(), settled);
        }
        check::<SourceConfig>();
        check::<SinkConfig>();
    }
}
