//! Kills a process of a run before each system call that creates, publishes or removes a shared resource, which kills at random
//! moments seldom hit. The test tries a few of these calls. `CONICFLOW_CRASH_POINTS=1000 cargo test --test end_to_end --
//! crash_points --nocapture` tries all of them, in nine minutes on two cores.

#![allow(unsafe_code)] // the calls of another process are seen by `ptrace`

use crate::bridge::{finding_apart, loopback, machines};
use crate::processes::{files_in_shared_memory, shared_prefix};
use crate::stress::{files, prefix};
use crate::support::{DEADLINE, Ended, FINDING, FINDING_STAGES, Playground, environment, signal, wait_until};
use rustix::process::Signal;
use std::collections::BTreeMap;
use std::ffi::{c_long, c_void};
use std::fs::{self, File};
use std::io;
use std::os::unix::process::CommandExt;
use std::process::Command;
use std::sync::mpsc::channel;

const POINTS: &str = "CONICFLOW_CRASH_POINTS";
/// Number of calls of each process before which the test kills it.
const DEFAULT_POINTS: usize = 4;
/// Number of frames of a run.
const FRAMES: u64 = 20;
const RUN: [&str; 5] = ["run", "--frames", "20", "--set", "source.rate_hz=100"];

/// Signal with which `ptrace` reports that a thread has stopped before or after a system call.
const CALL: i32 = libc::SIGTRAP | 0x80;

/// Traces the processes of a run, and kills one of them.
#[derive(Default)]
struct Tracer {
    launcher: i32,
    /// The stage to kill; the launcher if `None`.
    stage: Option<&'static str>,
    /// Index of the call before which it is killed.
    point: Option<usize>,
    /// The process to kill, once it exists, and the number of calls that it has made.
    watched: Option<i32>,
    calls: usize,
    /// The process of each thread.
    processes: BTreeMap<i32, i32>,
}

fn ptrace(request: u32, thread: i32, address: usize, data: usize) -> c_long {
    // SAFETY: with the requests of the callers, the system writes only to `data`, which points to as many bytes as `address`
    // says.
    unsafe { libc::ptrace(request, thread, address as *mut c_void, data as *mut c_void) }
}

/// Returns the number and the arguments of the system call before which a thread has stopped; `None` if it has stopped after a
/// call.
fn call_before(thread: i32) -> Option<(c_long, [u64; 6])> {
    // SAFETY: the struct consists of integers, for which zero is valid.
    let mut about: libc::ptrace_syscall_info = unsafe { std::mem::zeroed() };
    let size = size_of_val(&about);
    ptrace(libc::PTRACE_GET_SYSCALL_INFO, thread, size, (&raw mut about).addr());
    if about.op != libc::PTRACE_SYSCALL_INFO_ENTRY {
        return None;
    }
    // SAFETY: `op` says that this member of the union was written.
    let entry = unsafe { about.u.entry };
    Some((entry.nr as c_long, entry.args))
}

/// Returns whether a system call creates, publishes or removes a resource that processes share.
fn shares((number, arguments): (c_long, [u64; 6])) -> bool {
    let has = |argument: usize, flag: i32| arguments[argument] & flag as u64 != 0;
    #[cfg(target_arch = "x86_64")]
    match number {
        libc::SYS_open => return has(1, libc::O_CREAT),
        libc::SYS_mkdir | libc::SYS_rmdir | libc::SYS_unlink | libc::SYS_rename | libc::SYS_chmod | libc::SYS_link => {
            return true;
        }
        _ => {}
    }
    match number {
        libc::SYS_openat => has(2, libc::O_CREAT),
        libc::SYS_mmap => has(3, libc::MAP_SHARED) && !has(3, libc::MAP_ANONYMOUS),
        libc::SYS_bind | libc::SYS_fchmod | libc::SYS_fchmodat | libc::SYS_ftruncate | libc::SYS_linkat => true,
        libc::SYS_mkdirat | libc::SYS_renameat2 | libc::SYS_unlinkat => true,
        _ => false,
    }
}

impl Tracer {
    /// Runs the launcher until it and all processes that it has started are gone. Returns its exit code, if it was not killed.
    fn run(&mut self, mut launcher: Command) -> io::Result<Option<i32>> {
        let begin = || if ptrace(libc::PTRACE_TRACEME, 0, 0, 0) < 0 { Err(io::Error::last_os_error()) } else { Ok(()) };
        // SAFETY: `begin` makes only a system call, which is safe after a fork.
        self.launcher = unsafe { launcher.pre_exec(begin) }.spawn()?.id().cast_signed();
        let (mut code, mut status) = (None, 0);
        loop {
            // SAFETY: the system writes only to `status`.
            let thread = unsafe { libc::waitpid(-1, &raw mut status, libc::__WALL | libc::__WNOTHREAD) };
            if thread < 0 {
                return Ok(code);
            } else if libc::WIFSTOPPED(status) {
                self.go_on(thread, status);
            } else if thread == self.launcher {
                code = libc::WIFEXITED(status).then(|| libc::WEXITSTATUS(status));
            }
        }
    }

    /// Continues a stopped thread. If the thread is about to make the call of index `point`, its process is killed.
    fn go_on(&mut self, thread: i32, status: i32) {
        // Stops that `ptrace` causes are no signals of the process, so they are not passed on.
        let (mut passed_on, event) = (libc::WSTOPSIG(status), status >> 16);
        if !self.processes.contains_key(&thread) {
            self.begin(thread);
            passed_on = 0;
        } else if event == libc::PTRACE_EVENT_EXEC {
            let is_stage =
                |stage: &str| environment(thread.cast_unsigned(), "CONICFLOW_STAGE").as_deref() == Some(stage);
            if self.watched.is_none() && self.stage.is_some_and(is_stage) {
                self.watched = Some(thread);
            }
        } else if passed_on == CALL && call_before(thread).is_some_and(shares) {
            self.calls += 1;
            if self.point == Some(self.calls) {
                signal(self.processes[&thread].cast_unsigned(), Signal::KILL);
            }
        }
        if event != 0 || passed_on == CALL {
            passed_on = 0;
        }
        let is_watched = self.watched == Some(self.processes[&thread]);
        let request = if is_watched { libc::PTRACE_SYSCALL } else { libc::PTRACE_CONT };
        ptrace(request, thread, 0, passed_on.cast_unsigned() as usize);
    }

    /// Handles the first stop of a thread or process. The first one of all is the launcher after its `exec`.
    fn begin(&mut self, thread: i32) {
        if thread == self.launcher {
            let options = libc::PTRACE_O_TRACEFORK | libc::PTRACE_O_TRACEVFORK | libc::PTRACE_O_TRACECLONE;
            let options = options | libc::PTRACE_O_TRACEEXEC | libc::PTRACE_O_TRACESYSGOOD | libc::PTRACE_O_EXITKILL;
            ptrace(libc::PTRACE_SETOPTIONS, thread, 0, options.cast_unsigned() as usize);
            self.watched = self.stage.is_none().then_some(thread);
        }
        let process = process_of(thread).unwrap_or(thread);
        self.processes.insert(thread, process);
    }
}

/// Returns the process of a thread.
fn process_of(thread: i32) -> Option<i32> {
    let status = fs::read_to_string(format!("/proc/{thread}/status")).ok()?;
    status.lines().find_map(|line| line.strip_prefix("Tgid:")?.trim().parse().ok())
}

/// Runs `conicflow` with these arguments to the end of the run, and kills the launcher or the first process of a stage before one
/// of its calls. Returns how the run ended and the number of calls; `None` if this system does not permit tracing.
fn traced(
    playground: &Playground,
    arguments: &[&str],
    stage: Option<&'static str>,
    point: Option<usize>,
) -> Option<(Ended, usize)> {
    let mut command = playground.command(arguments);
    command.stdout(File::create(playground.path("stdout")).unwrap());
    command.stderr(File::create(playground.path("stderr")).unwrap());
    let mut tracer = Tracer { stage, point, ..Tracer::default() };
    let (over, is_over) = channel();
    let ran = std::thread::scope(|scope| {
        // The tracing thread has no children except the traced ones.
        let tracing = scope.spawn(|| {
            let ran = tracer.run(command);
            over.send(()).unwrap();
            ran
        });
        if is_over.recv_timeout(DEADLINE).is_err() {
            playground.processes().into_iter().for_each(|process| signal(process, Signal::KILL));
        }
        tracing.join().unwrap()
    });
    let code = match ran {
        Err(error) if error.raw_os_error() == Some(libc::EPERM) => return None,
        ran => ran.unwrap(),
    };
    let [stdout, stderr] = ["stdout", "stderr"].map(|name| fs::read_to_string(playground.path(name)).unwrap());
    Some((Ended { code, stdout, stderr }, tracer.calls))
}

/// Kills the launcher or the first process of a stage before some of its calls, each in another run. `run` gets the index of the
/// call, or `None` to kill nothing, and returns the number of calls.
fn kill_at_points(who: &str, mut run: impl FnMut(Option<usize>) -> Option<usize>) {
    let points = std::env::var(POINTS).map_or(DEFAULT_POINTS, |text| text.parse().unwrap());
    let Some(calls) = run(None) else {
        eprintln!("SKIPPED: this system lets nobody trace a process; nothing was shown");
        return;
    };
    assert!(calls > 20, "{who}: {calls}");
    let (mut tried, mut killed) = (0, 0);
    for point in (1..=calls).step_by(calls.div_ceil(points)) {
        println!("{who}: before call {point} of {calls}");
        (tried, killed) = (tried + 1, killed + usize::from(run(Some(point)) == Some(point)));
    }
    println!("{who}: killed {killed} of {tried} times");
    assert!(killed > tried / 2, "the others were over before");
}

#[test]
fn a_process_may_be_killed_before_any_call_that_changes_a_shared_resource() {
    let playground = Playground::with_pipeline(FINDING);
    let prefix = prefix(&playground);
    let before = files(&playground, &prefix);
    for stage in [None].into_iter().chain(FINDING_STAGES.map(Some)) {
        kill_at_points(stage.unwrap_or("launcher"), |point| {
            fs::remove_file(playground.path("tracks.jsonl")).ok();
            let (ended, calls) = traced(&playground, &RUN, stage, point)?;
            wait_until("all processes are gone", || playground.processes().is_empty());
            if stage.is_some() || point.is_none() {
                let ended = ended.expect_code(0);
                assert!(playground.sequences("tracks.jsonl").into_iter().eq(0..FRAMES), "{}", ended.stderr);
            } else {
                let next = playground.conicflow(&["run", "--frames", "3", "--set", "json.path=next.jsonl"]);
                let next = next.expect_code(0);
                assert_eq!(playground.sequences("next.jsonl"), [0, 1, 2], "{}", next.stderr);
            }
            let left: Vec<_> = files(&playground, &prefix).difference(&before).cloned().collect();
            assert_eq!(left, [""; 0], "{stage:?}: left behind by the kill before call {point:?}");
            Some(calls)
        });
    }
}

#[test]
fn a_bridge_may_be_killed_before_any_call_that_changes_a_shared_resource() {
    let endpoint = loopback();
    let [robot, base] = machines(&finding_apart(&endpoint));
    for (machines, names) in [([&robot, &base], ["robot", "base"]), ([&base, &robot], ["base", "robot"])] {
        kill_at_points(names[0], |point| {
            fs::remove_file(base.path("tracks.jsonl")).ok();
            let arguments = names.map(|name| [&RUN[..], &["--machine", name]].concat());
            let other = machines[1].start(&arguments[1]);
            let (ended, calls) = traced(machines[0], &arguments[0], Some("bridge"), point)?;
            let logs = [ended, other.wait()].map(|ended| ended.expect_code(0).stderr);
            assert!(base.sequences("tracks.jsonl").into_iter().eq(0..FRAMES), "{logs:?}");
            for machine in machines {
                wait_until("all processes are gone", || machine.processes().is_empty());
                assert_eq!(files_in_shared_memory(&shared_prefix(machine)), [""; 0]);
            }
            Some(calls)
        });
    }
}
