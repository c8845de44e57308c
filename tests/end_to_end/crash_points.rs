//! A process of a run is killed before each of the calls by which it makes, shows or removes something that it shares: kills at
//! random moments seldom hit these. A few of them are tried; all, in five minutes, by
//! `CONICFLOW_CRASH_POINTS=1000 cargo test --test end_to_end -- crash_points --nocapture`.

#![allow(unsafe_code)] // the calls of another process are seen by `ptrace`

use crate::stress::{files, prefix};
use crate::support::{DEADLINE, Ended, Playground, TRACKING, TRACKING_STAGES, environment, signal, wait_until};
use rustix::process::Signal;
use std::collections::BTreeMap;
use std::ffi::{c_long, c_void};
use std::fs::{self, File};
use std::io;
use std::os::unix::process::CommandExt;
use std::process::Command;
use std::sync::mpsc::channel;

const POINTS: &str = "CONICFLOW_CRASH_POINTS";
/// How many calls of each process it is killed before.
const DEFAULT_POINTS: usize = 4;
const FRAMES: u64 = 20;

/// A stop of a traced thread is one before or after a call.
const CALL: i32 = libc::SIGTRAP | 0x80;

/// A run whose processes are traced, on their way to the one that is killed.
struct Tracer {
    launcher: i32,
    /// The stage that is watched; the launcher if none.
    stage: Option<&'static str>,
    /// Before which of its calls it is killed.
    point: Option<usize>,
    /// The process that is watched, once it is there, and how many calls it has made.
    watched: Option<i32>,
    calls: usize,
    /// The process of each thread.
    processes: BTreeMap<i32, i32>,
}

fn ptrace(request: u32, thread: i32, address: usize, data: usize) -> c_long {
    // SAFETY: the callers' requests write nothing here but what `data` points to, which is as large as `address` says.
    unsafe { libc::ptrace(request, thread, address as *mut c_void, data as *mut c_void) }
}

/// The number and the arguments of the call that a thread stands before, if it does not stand after one.
fn call_before(thread: i32) -> Option<(c_long, [u64; 6])> {
    // SAFETY: it consists of numbers.
    let mut about: libc::ptrace_syscall_info = unsafe { std::mem::zeroed() };
    let size = size_of_val(&about);
    ptrace(libc::PTRACE_GET_SYSCALL_INFO, thread, size, (&raw mut about).addr());
    if about.op != libc::PTRACE_SYSCALL_INFO_ENTRY {
        return None;
    }
    // SAFETY: this is what it is before a call.
    let entry = unsafe { about.u.entry };
    Some((entry.nr as c_long, entry.args))
}

/// Whether a call makes, shows or removes something that processes share.
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
    /// Lets a thread go on that stands; kills its process where that has come to the point.
    fn go_on(&mut self, thread: i32, status: i32) {
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
        let is_watched = self.watched == Some(self.processes[&thread]);
        let request = if is_watched { libc::PTRACE_SYSCALL } else { libc::PTRACE_CONT };
        let passed_on = if event != 0 || passed_on == CALL { 0 } else { passed_on };
        ptrace(request, thread, 0, passed_on.cast_unsigned() as usize);
    }

    /// A thread, or a process, that stands for the first time: the launcher has just become its program.
    fn begin(&mut self, thread: i32) {
        if thread == self.launcher {
            let seen = libc::PTRACE_O_TRACEFORK | libc::PTRACE_O_TRACEVFORK | libc::PTRACE_O_TRACECLONE;
            let options = seen | libc::PTRACE_O_TRACEEXEC | libc::PTRACE_O_TRACESYSGOOD | libc::PTRACE_O_EXITKILL;
            ptrace(libc::PTRACE_SETOPTIONS, thread, 0, options.cast_unsigned() as usize);
            self.watched = self.stage.is_none().then_some(thread);
        }
        let process = process_of(thread).unwrap_or(thread);
        self.processes.insert(thread, process);
    }
}

/// The process of a thread.
fn process_of(thread: i32) -> Option<i32> {
    let status = fs::read_to_string(format!("/proc/{thread}/status")).ok()?;
    status.lines().find_map(|line| line.strip_prefix("Tgid:")?.trim().parse().ok())
}

/// Runs a pipeline to its end, in which the launcher, or the first process of a stage, is killed before one of its calls; with
/// how many calls that made. `None`: this system lets nobody trace.
fn run(playground: &Playground, stage: Option<&'static str>, point: Option<usize>) -> Option<(Ended, usize)> {
    fs::remove_file(playground.path("tracks.jsonl")).ok();
    let frames = FRAMES.to_string();
    let mut command: Command = playground.command(&["run", "--frames", &frames, "--set", "source.rate_hz=100"]);
    command.stdout(File::create(playground.path("stdout")).unwrap());
    command.stderr(File::create(playground.path("stderr")).unwrap());
    let trace = || if ptrace(libc::PTRACE_TRACEME, 0, 0, 0) < 0 { Err(io::Error::last_os_error()) } else { Ok(()) };
    // SAFETY: it is a call to the system alone.
    let started = unsafe { command.pre_exec(trace) }.spawn();
    let launcher = match started {
        Err(error) if error.raw_os_error() == Some(libc::EPERM) => return None,
        started => started.unwrap().id().cast_signed(),
    };
    let mut tracer = Tracer { launcher, stage, point, watched: None, calls: 0, processes: BTreeMap::new() };
    let (over, is_over) = channel();
    let mut code = None;
    std::thread::scope(|scope| {
        scope.spawn(move || {
            if is_over.recv_timeout(DEADLINE).is_err() {
                playground.processes().into_iter().for_each(|process| signal(process, Signal::KILL));
            }
        });
        loop {
            let mut status = 0;
            // SAFETY: it writes the one number. Children of other tests are none of this thread.
            let thread = unsafe { libc::waitpid(-1, &raw mut status, libc::__WALL | libc::__WNOTHREAD) };
            if thread < 0 {
                break;
            } else if libc::WIFSTOPPED(status) {
                tracer.go_on(thread, status);
            } else if thread == launcher {
                code = libc::WIFEXITED(status).then(|| libc::WEXITSTATUS(status));
            }
        }
        over.send(()).ok();
    });
    let [stdout, stderr] = ["stdout", "stderr"].map(|name| fs::read_to_string(playground.path(name)).unwrap());
    Some((Ended { code, stdout, stderr }, tracer.calls))
}

#[test]
fn a_process_may_be_killed_before_any_call_by_which_it_shares_something() {
    let points = std::env::var(POINTS).map_or(DEFAULT_POINTS, |text| text.parse().unwrap());
    let playground = Playground::with_pipeline(TRACKING);
    let prefix = prefix(&playground);
    let (before, mut tried, mut killed) = (files(&playground, &prefix), 0, 0);
    for stage in [None].into_iter().chain(TRACKING_STAGES.map(Some)) {
        let who = stage.unwrap_or("launcher");
        let Some((ended, calls)) = run(&playground, stage, None) else {
            eprintln!("SKIPPED: this system lets nobody trace a process; nothing was shown");
            return;
        };
        ended.expect_code(0);
        assert!(calls > 20, "{who}: {calls}");
        for point in (1..=calls).step_by(calls.div_ceil(points)) {
            println!("{who}: before call {point} of {calls}");
            let (ended, made) = run(&playground, stage, Some(point)).unwrap();
            (tried, killed) = (tried + 1, killed + usize::from(made == point));
            wait_until("all processes are gone", || playground.processes().is_empty());
            if stage.is_some() {
                let ended = ended.expect_code(0);
                assert!(playground.sequences("tracks.jsonl").into_iter().eq(0..FRAMES), "{}", ended.stderr);
            } else {
                let next =
                    playground.conicflow(&["run", "--frames", "3", "--set", "json.path=next.jsonl"]).expect_code(0);
                assert_eq!(playground.sequences("next.jsonl"), [0, 1, 2], "{}", next.stderr);
            }
            let left: Vec<_> = files(&playground, &prefix).difference(&before).cloned().collect();
            assert_eq!(left, [""; 0], "{who}: left behind by the kill before call {point} of {calls}");
        }
    }
    println!("killed {killed} of {tried} times");
    assert!(killed > tried / 2, "the others were over before");
}
