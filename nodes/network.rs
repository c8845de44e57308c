//! The network part of the program: the program `conicflow-bridge` beside this one.
//!
//! What speaks to other machines is a program of its own: stages have no network in them, and who needs one machine alone
//! builds and runs none.

use conicflow_dataflow::pipeline::Machine;
use conicflow_dataflow::{Carrier, Hinted, Host, Network};
use serde::de::DeserializeOwned;
use std::path::PathBuf;
use std::process::{Command, Stdio};

/// The network part, for the registry.
pub(crate) const NETWORK: Network = Network {
    check: |machine| ask("check", machine).flatten(),
    // Only a file of Zenoh's settings names certificates.
    warnings: |machine| machine.zenoh.as_ref().and_then(|_| ask("warnings", machine).ok()).unwrap_or_default(),
    listen_endpoints: |machine| ask("endpoints", machine).flatten(),
    carrier: Carrier::Program(program),
};

/// What runs the nodes that speak to others.
pub(crate) const HOST: Host =
    Host { command: |_, _| Ok(vec![program()?.to_string_lossy().into_owned()]), check: |_, _, _| program().map(drop) };

/// Environment variable: the program that carries topics between machines, where it is not beside this one.
const BRIDGE_PROGRAM: &str = "CONICFLOW_BRIDGE";

const NAME: &str = "conicflow-bridge";

/// The program that carries topics between machines, and runs the nodes that speak to others.
pub(crate) fn program() -> Result<PathBuf, Hinted> {
    let program: PathBuf = match std::env::var_os(BRIDGE_PROGRAM) {
        Some(program) => program.into(),
        None => {
            let here = std::env::current_exe();
            here.map_err(|error| fault(&format!("this program cannot be found: {error}")))?.with_file_name(NAME)
        }
    };
    // A name without a folder is looked for in PATH.
    let is_name = program.components().count() == 1;
    if is_name || program.is_file() { Ok(program) } else { Err(fault(&format!("there is no `{}`", program.display()))) }
}

fn fault(what: &str) -> Hinted {
    let hint = "several machines and ROS 2 need the program `conicflow-bridge` beside this one: `cargo build --release` makes both, \
                copy both, or name it in CONICFLOW_BRIDGE";
    Hinted::new(what, hint)
}

/// What that program answers of a machine.
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
    fn settled_parameters_are_read_as_they_were_written() {
        fn check<C: Default + Serialize + DeserializeOwned>() {
            let settled = to_value(C::default()).unwrap();
            assert_eq!(to_value(serde_json::from_value::<C>(settled.clone()).unwrap()).unwrap(), settled);
        }
        check::<SourceConfig>();
        check::<SinkConfig>();
    }
}
