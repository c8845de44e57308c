//! Process of a stage, with the processes that it has started: when it ends, so do they.
//!
//! A program may start other processes and leave them behind. They are in its process group, unless they have left it. A shell in
//! the same group waits until its standard input is closed and the program has ended, and then kills the group. The launcher
//! closes that input when the program has ended, and the system does when the launcher is killed. While the shell exists, no
//! other process or group can get the id of this one.

use crate::plan::{PlannedStage, Runs};
use rustix::process::{Pid, Signal, kill_process};
use std::io;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};

/// Shell script: waits for the end of its input, then up to five seconds for the process with the id `$1`, as a stage ends by
/// itself when its launcher was killed; then kills its own group.
const KILL_GROUP_AT_END: &str = "read -r _; looks=0; \
    while [ $looks -lt 50 ] && kill -s 0 \"$1\" 2>/dev/null; do sleep 0.1; looks=$((looks + 1)); done; kill -s KILL 0";

/// Process of a stage; processes that it has started end when this is dropped.
pub(crate) struct Guarded {
    pub(crate) child: Child,
    _guard: Option<Guard>,
}

impl Guarded {
    /// Starts the process of a stage, which has to lead its own process group.
    ///
    /// # Errors
    /// The process or its guard cannot be started; then neither runs.
    pub(crate) fn start(command: &mut Command, planned: &PlannedStage) -> io::Result<Self> {
        let mut child = command.spawn()?;
        // Built-in nodes start no processes.
        let guard = matches!(planned.runs, Runs::Command(_)).then(|| Guard::of(&child)).transpose();
        match guard {
            Ok(guard) => Ok(Self { child, _guard: guard }),
            Err(error) => {
                child.kill().ok();
                child.wait().ok();
                Err(error)
            }
        }
    }
}

#[cfg(test)]
impl From<Child> for Guarded {
    fn from(child: Child) -> Self {
        Self { child, _guard: None }
    }
}

/// The shell in the group of a program.
struct Guard(Child);

impl Guard {
    fn of(leader: &Child) -> io::Result<Self> {
        let mut shell = Command::new("/bin/sh");
        shell.args(["-c", KILL_GROUP_AT_END, "sh", &leader.id().to_string()]);
        shell.env_clear().process_group(leader.id().cast_signed());
        shell.stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::null()).spawn().map(Self)
    }
}

impl Drop for Guard {
    fn drop(&mut self) {
        drop(self.0.stdin.take());
        if let Some(guard) = Pid::from_raw(self.0.id().cast_signed()) {
            // The group may be suspended.
            kill_process(guard, Signal::CONT).ok();
        }
        self.0.wait().ok();
    }
}

#[cfg(test)]
mod tests {
    use super::super::summary::tests::stage;
    use super::*;
    use conicflow_messages::Object;
    use rustix::process::kill_process_group;
    use std::io::{BufRead, BufReader, Read};
    use std::process::ChildStdout;

    /// Starts a program that prints `ready` when it has started another process, which keeps its output open. Returns that
    /// output, too.
    fn parent() -> (Guarded, BufReader<ChildStdout>) {
        let planned = PlannedStage { runs: Runs::Command(vec!["sh".into()]), ..stage::<Object>() };
        let mut command = Command::new("sh");
        command.args(["-c", "sleep 1000 & echo ready"]).process_group(0).stdin(Stdio::null()).stdout(Stdio::piped());
        let mut program = Guarded::start(&mut command, &planned).unwrap();
        let mut output = BufReader::new(program.child.stdout.take().unwrap());
        let mut line = String::new();
        output.read_line(&mut line).unwrap();
        assert_eq!(line, "ready\n");
        (program, output)
    }

    #[test]
    fn what_a_program_has_started_ends_with_it_also_where_it_is_stopped() {
        for is_stopped in [false, true] {
            let (mut program, mut output) = parent();
            if is_stopped {
                kill_process_group(Pid::from_child(&program.child), Signal::STOP).unwrap();
                program.child.kill().unwrap();
            }
            program.child.wait().unwrap();
            drop(program);
            let mut rest = Vec::new();
            output.read_to_end(&mut rest).unwrap();
            assert_eq!(rest, b"", "nobody has it open any more");
        }
    }
}
