//! A stage's process, with what it has started: when the one is over, so is the other.
//!
//! A program of one's own may start others and leave them behind. They are in its process group, if they have not left that to be
//! on their own. A shell in the same group waits until its standard input is closed and the program has ended, and then kills the
//! group. The launcher closes that input when the program has ended, and the system does so when the launcher was killed. While
//! the shell is there, nobody else's process or group has the number of this one.

use crate::plan::{PlannedStage, Runs};
use rustix::process::{Pid, Signal, kill_process};
use std::io;
use std::os::unix::process::CommandExt;
use std::process::{Child, Command, Stdio};

/// Waits for the end of its input, and up to five seconds, in which a stage ends by itself when its launcher was killed, for that
/// of the process that it is told; then it kills the group that it is in.
const KILL_GROUP_AT_END: &str = "read -r _; looks=0; \
    while [ $looks -lt 50 ] && kill -s 0 \"$1\" 2>/dev/null; do sleep 0.1; looks=$((looks + 1)); done; kill -s KILL 0";

/// A stage's process; what it has started ends when this is dropped.
pub(crate) struct Guarded {
    pub(crate) child: Child,
    _guard: Option<Guard>,
}

impl Guarded {
    /// Starts the process of a stage, which is to lead a group of its own.
    ///
    /// # Errors
    /// It, or what guards it, cannot be started; then neither runs.
    pub(crate) fn start(command: &mut Command, planned: &PlannedStage) -> io::Result<Self> {
        let mut child = command.spawn()?;
        // Built-in nodes start nothing.
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
            // The group may be stopped.
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

    /// A program that says `ready` when it has started another one, which keeps its output open; and that output.
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
