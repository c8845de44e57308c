//! The program `conicflow`; all of it is in [`conicflow_nodes`].

use std::process::ExitCode;

fn main() -> ExitCode {
    conicflow_nodes::commands::main()
}
