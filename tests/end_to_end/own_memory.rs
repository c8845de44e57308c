//! A private /dev/shm for a test, which may be small or full, or contain files that other programs have left. It needs root,
//! `unshare` and `nsenter`.

use super::support::{Ended, Playground, Started, wait_until, within};
use rustix::process::geteuid;
use std::fs::{self, File};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, SystemTime};

/// A /dev/shm that no other process sees. It vanishes when this value is dropped.
pub struct OwnSharedMemory {
    holder: Child,
}

impl OwnSharedMemory {
    /// Creates a /dev/shm of this size. If this user cannot, prints that the test is skipped, and returns `None`.
    pub fn new(size: &str) -> Option<Self> {
        let script = format!("mount -t tmpfs -o size={size},mode=1777 tmpfs /dev/shm && exec sleep 1000");
        let mut command = Command::new("unshare");
        command.args(["--mount", "sh", "-c", &script]).stderr(Stdio::null());
        let holder = geteuid().is_root().then(|| command.spawn().ok()).flatten();
        let Some(holder) = holder else {
            eprintln!("SKIPPED: a /dev/shm of one's own needs root and `unshare`; nothing was shown");
            return None;
        };
        let program = format!("/proc/{}/comm", holder.id());
        wait_until("/dev/shm is mounted", || fs::read_to_string(&program).is_ok_and(|name| name == "sleep\n"));
        Some(Self { holder })
    }

    /// Returns a command that runs `inner` with this /dev/shm.
    pub fn around(&self, inner: &Command) -> Command {
        let folder = inner.get_current_dir().unwrap().to_str().unwrap();
        let mut command = Command::new("nsenter");
        command.args([&format!("--mount=/proc/{}/ns/mnt", self.holder.id()), &format!("--wd={folder}"), "--"]);
        within(command, inner)
    }

    pub fn start(&self, playground: &Playground, arguments: &[&str]) -> Started {
        Started::new(self.around(&playground.command(arguments)))
    }

    pub fn conicflow(&self, playground: &Playground, arguments: &[&str]) -> Ended {
        self.start(playground, arguments).wait()
    }

    pub fn folder(&self) -> PathBuf {
        PathBuf::from(format!("/proc/{}/root/dev/shm", self.holder.id()))
    }

    pub fn files(&self) -> Vec<String> {
        let entries = fs::read_dir(self.folder()).unwrap().flatten();
        let mut names: Vec<_> = entries.map(|entry| entry.file_name().into_string().unwrap()).collect();
        names.sort();
        names
    }

    /// Sets the times of all files to an hour ago.
    pub fn age(&self) {
        for name in self.files() {
            let file = File::options().write(true).open(self.folder().join(name)).unwrap();
            file.set_modified(SystemTime::now() - Duration::from_secs(3700)).unwrap();
        }
    }
}

impl Drop for OwnSharedMemory {
    fn drop(&mut self) {
        self.holder.kill().ok();
        self.holder.wait().ok();
    }
}
