//! Checks what `doctor` finds and removes, and that a run does not start on a machine on which it could not continue. Most tests
//! need their own /dev/shm, and for that root, `unshare` and `nsenter`; without these they print that they are skipped.

use super::bridge::{apart, loopback};
use super::own_memory::OwnSharedMemory;
use super::processes::{stages_of, wait_for_lines};
use super::support::{Ended, Playground, Started, TRACKING, copy_program, parent, signal, wait_until};
use rustix::process::{Signal, geteuid};
use std::fs::{self, File};
use std::io::ErrorKind;
use std::net::TcpListener;
use std::os::unix::fs::{PermissionsExt, chown};
use std::path::Path;
use std::process::{Command, Stdio};

/// Kills a run and all its stages at once, so that none of them can clean up after the others.
fn kill_all(run: Started) {
    let mut processes: Vec<_> = stages_of(run.id()).into_values().collect();
    assert_eq!(processes.len(), 5);
    processes.push(run.id());
    let stopped = |process: &u32| {
        let stat = fs::read_to_string(format!("/proc/{process}/stat"));
        stat.is_ok_and(|stat| stat.rsplit_once(") ").unwrap().1.starts_with('T'))
    };
    processes.iter().for_each(|process| signal(*process, Signal::STOP));
    wait_until("all are stopped", || processes.iter().all(stopped));
    processes.iter().for_each(|process| signal(*process, Signal::KILL));
    run.wait();
    wait_until("all are gone", || processes.iter().all(|process| parent(*process).is_none()));
}

/// A playground with the usual pipeline, for runs with their own /dev/shm.
fn tracking() -> Playground {
    Playground::outside_shared_memory().and_pipeline(TRACKING)
}

/// Starts a run, and waits until it delivers results.
fn working(memory: &OwnSharedMemory, playground: &Playground) -> Started {
    let mut run = memory.start(playground, &["run", "--set", "source.rate_hz=50"]);
    wait_for_lines(&mut run, playground);
    run
}

#[test]
fn doctor_changes_nothing_on_a_machine_without_faults() {
    let Some(memory) = OwnSharedMemory::new("64m") else { return };
    let playground = tracking();
    let ended = memory.conicflow(&playground, &["doctor"]).expect_code(0);
    assert!(ended.stdout.starts_with("nothing is wrong; `tracking` needs up to "), "{}", ended.stdout);
    assert_eq!(fs::read_dir(playground.runtime()).unwrap().count(), 0, "a look makes no folder");
    assert!(memory.files().is_empty());
}

#[test]
fn the_remains_of_a_killed_run_are_found_and_removed() {
    let Some(memory) = OwnSharedMemory::new("64m") else { return };
    let playground = tracking();
    kill_all(working(&memory, &playground));
    let found = memory.conicflow(&playground, &["doctor"]).expect_code(1);
    assert!(found.stdout.starts_with("problem: what 6 dead processes had in `"), "{}", found.stdout);
    assert!(found.stdout.contains("run/tracking` was cut off"), "{}", found.stdout);
    assert!(memory.files().len() > 10, "a look removes nothing");
    let cleaned = memory.conicflow(&playground, &["doctor", "--clean"]).expect_code(0);
    assert!(cleaned.stdout.starts_with("removed what 6 dead processes had in `"), "{}", cleaned.stdout);
    assert!(cleaned.stdout.contains("removed the records of a run that was cut off"), "{}", cleaned.stdout);
    assert_eq!(memory.files(), [""; 0], "nothing is left");
    memory.conicflow(&playground, &["doctor"]).expect_code(0);
}

#[test]
fn remains_that_no_run_would_find_are_removed_and_files_of_live_runs_are_not() {
    let Some(memory) = OwnSharedMemory::new("64m") else { return };
    let (dead, living) = (tracking(), tracking());
    kill_all(working(&memory, &dead));
    let left = memory.files();
    let mut run = working(&memory, &living);
    // The folder is removed after the second run has started: a folder that is created later could get the same inode number, and
    // with it the same names of files.
    fs::remove_dir_all(dead.runtime()).unwrap();
    memory.age();
    File::create(memory.folder().join("iox2_of_another_program.data")).unwrap();
    let theirs: Vec<_> = memory.files().into_iter().filter(|file| !left.contains(file)).collect();

    let other = tracking();
    let found = memory.conicflow(&other, &["doctor"]).expect_code(1);
    let count = left.len();
    assert!(found.stdout.starts_with(&format!("problem: {count} files (")), "{}", found.stdout);
    assert!(found.stdout.contains("up to 1 h old\n  hint: `conicflow doctor --clean`"), "{}", found.stdout);
    let cleaned = memory.conicflow(&other, &["doctor", "--clean"]).expect_code(0);
    assert!(cleaned.stdout.starts_with(&format!("removed {count} files (")), "{}", cleaned.stdout);

    let kept = memory.files();
    assert!(theirs.iter().all(|file| kept.contains(file)), "{theirs:?} against {kept:?}");
    wait_for_lines(&mut run, &living);
    let ended = run.end();
    assert_eq!(ended.stage("json").starts, 1, "{}", ended.stderr);
    assert_eq!(memory.files(), ["iox2_of_another_program.data"]);
}

#[test]
fn a_run_works_after_doctor() {
    let Some(memory) = OwnSharedMemory::new("64m") else { return };
    let (playground, other) = (tracking(), tracking());
    kill_all(working(&memory, &playground));
    memory.age();
    memory.conicflow(&other, &["doctor", "--clean"]).expect_code(0);
    memory.conicflow(&playground, &["run", "--frames", "20"]).expect_code(0);
    assert_eq!(playground.sequences("tracks.jsonl"), (0..20).collect::<Vec<_>>());
    memory.conicflow(&playground, &["doctor"]).expect_code(0);
}

#[test]
fn a_run_for_which_shared_memory_is_too_small_does_not_begin() {
    let Some(memory) = OwnSharedMemory::new("8m") else { return };
    let playground = tracking();
    let wide = ["--set", "source.width=1280", "--set", "source.height=720", "--set", "source.rate_hz=0"];
    let ended = memory.conicflow(&playground, &[&["run"], &wide[..]].concat()).expect_code(2);
    assert!(ended.stderr.starts_with("error: shared memory has 8."), "{}", ended.stderr);
    ended.expect_texts(&["most of it for the topic `depth`\n  hint: ", "`--shm-size=16m`"]);
    assert!(!playground.path("tracks.jsonl").exists(), "no stage was started");
    let found = memory.conicflow(&playground, &[&["doctor"], &wide[..]].concat()).expect_code(1);
    assert!(found.stdout.starts_with("problem: shared memory has 8."), "{}", found.stdout);
}

#[test]
fn a_run_for_which_shared_memory_is_just_large_enough_works() {
    let Some(memory) = OwnSharedMemory::new("16m") else { return };
    let playground = tracking();
    let wide =
        ["--frames", "30", "--set", "source.width=1280", "--set", "source.height=720", "--set", "source.noise=ideal"];
    memory.conicflow(&playground, &[&["run"], &wide[..]].concat()).expect_code(0);
    assert_eq!(playground.sequences("tracks.jsonl").len(), 30);
}

/// Runs `conicflow` in a shell, after another command.
fn after(playground: &Playground, command_before: &str, arguments: &[&str]) -> Ended {
    let program = playground.command(&[]).get_program().to_owned();
    let mut shell = Command::new("sh");
    shell.args(["-c", &format!("{command_before} && exec \"$0\" \"$@\"")]).arg(program).args(arguments);
    shell.current_dir(playground.path("")).env("CONICFLOW_RUNTIME_DIR", playground.runtime()).stdin(Stdio::null());
    Started::new(shell).wait()
}

#[test]
fn a_run_that_would_need_more_open_files_than_it_may_have_does_not_begin() {
    let playground = Playground::with_pipeline(TRACKING);
    let ended = after(&playground, "ulimit -n 40", &["run", "--frames", "3"]).expect_code(2);
    assert!(ended.stderr.starts_with("error: a process may have 40 files open, one of"), "{}", ended.stderr);
    ended.expect_texts(&["\n  hint: `ulimit -n "]);
    // With so few open files the program cannot even open shared memory.
    let ended = after(&playground, "ulimit -n 10", &["run", "--frames", "3"]).expect_code(2);
    assert!(ended.stderr.starts_with("error: a process may have 10 files open, one of"), "{}", ended.stderr);
    let found = after(&playground, "ulimit -n 40", &["doctor"]).expect_code(1);
    assert!(found.stdout.contains("problem: a process may have 40 files open"), "{}", found.stdout);
}

#[test]
fn a_port_that_is_taken_is_reported_with_the_machine_that_needs_it() {
    let endpoint = loopback();
    let holder = TcpListener::bind(&endpoint["tcp/".len()..]).unwrap();
    let playground = Playground::with_pipeline(&apart(&endpoint, &endpoint));
    let report = format!("problem: machine `robot` cannot listen on `{endpoint}`: Address already in use");
    let found = playground.conicflow(&["doctor"]).expect_code(1);
    assert!(found.stdout.contains(&report), "{}", found.stdout);
    let found = playground.conicflow(&["doctor", "--machine", "base"]);
    assert!(!found.stdout.contains("cannot listen"), "{}", found.stdout);
    drop(holder);
    // Processes that other tests start hold a copy of the listening socket between their `fork` and `exec`.
    wait_until("it is free", || !playground.conicflow(&["doctor"]).stdout.contains("cannot listen"));
}

#[test]
fn an_unusable_runtime_folder_is_reported_by_doctor_and_by_run() {
    let playground = Playground::with_pipeline(TRACKING);
    let (file, open) = (playground.path("file"), playground.path("open"));
    let long = playground.path(&"long".repeat(20));
    fs::write(&file, "").unwrap();
    fs::create_dir(&open).unwrap();
    fs::set_permissions(&open, PermissionsExt::from_mode(0o755)).unwrap();
    for (folder, expected) in [
        (file, "hint: set CONICFLOW_RUNTIME_DIR to a short path that this user may write to"),
        (open, "is open to others\n  hint: `chmod 700` it, or set CONICFLOW_RUNTIME_DIR"),
        (long, "shared memory can use 48 at most\n  hint: set CONICFLOW_RUNTIME_DIR to a shorter path"),
    ] {
        let conicflow = |arguments: &[&str]| {
            let mut command = playground.command(arguments);
            command.env("CONICFLOW_RUNTIME_DIR", &folder);
            Started::new(command).wait()
        };
        let (doctor, run) = (conicflow(&["doctor"]).expect_code(1), conicflow(&["run"]).expect_code(2));
        assert!(doctor.stdout.contains(expected), "{}", doctor.stdout);
        run.expect_texts(&[expected]);
    }
}

#[test]
fn a_runtime_folder_without_write_permission_is_reported() {
    let playground = Playground::with_pipeline(TRACKING);
    for arguments in [["doctor"], ["run"]] {
        let inner = playground.command(&arguments);
        let mut command = Command::new("setpriv");
        command.args(["--reuid=65534", "--regid=65534", "--clear-groups"]).arg(inner.get_program()).args(arguments);
        // The file of the playground would be in a folder that this user cannot enter, so the built-in pipeline is used.
        command.current_dir("/").env("CONICFLOW_RUNTIME_DIR", playground.runtime().join("folder")).stdin(Stdio::null());
        if !geteuid().is_root() || Command::new("setpriv").arg("--version").output().is_err() {
            eprintln!("SKIPPED: to be another user needs root and `setpriv`; nothing was shown");
            return;
        }
        let ended = Started::new(command).wait();
        let output = format!("{}{}", ended.stdout, ended.stderr);
        assert!(ended.code == Some(if arguments == ["run"] { 2 } else { 1 }), "{output}");
        assert!(
            output.contains("/folder: Permission denied (os error 13)\n  hint: set CONICFLOW_RUNTIME_DIR"),
            "{output}"
        );
    }
}

#[test]
fn the_remains_of_another_user_disturb_no_run_and_are_kept() {
    let Some(memory) = OwnSharedMemory::new("64m") else { return };
    let (playground, theirs) = (tracking(), tracking());
    // The other user has to reach the program and the file.
    fs::set_permissions(theirs.path(""), PermissionsExt::from_mode(0o777)).unwrap();
    let program = theirs.path("conicflow");
    copy_program(Path::new(theirs.command(&[]).get_program()), &program);
    chown(theirs.runtime(), Some(65534), Some(65534)).unwrap();
    let as_them = |arguments: &[&str]| {
        let mut command = Command::new("setpriv");
        command.args(["--reuid=65534", "--regid=65534", "--clear-groups"]).arg(&program).args(arguments);
        command.current_dir(theirs.path("")).env("CONICFLOW_RUNTIME_DIR", theirs.runtime());
        Started::new(memory.around(&command))
    };
    let mut run = as_them(&["run", "--set", "source.rate_hz=50"]);
    wait_for_lines(&mut run, &theirs);
    kill_all(run);
    memory.age();
    let left = memory.files();
    assert!(left.len() > 10, "{left:?}");

    memory.conicflow(&playground, &["run", "--frames", "3"]).expect_code(0);
    assert_eq!(playground.sequences("tracks.jsonl"), [0, 1, 2]);
    memory.conicflow(&playground, &["doctor", "--clean"]).expect_code(0);
    assert_eq!(memory.files(), left, "only they may remove it");
    let cleaned = as_them(&["doctor", "--clean"]).wait().expect_code(0);
    assert!(cleaned.stdout.starts_with("removed what 6 dead processes had in `"), "{}", cleaned.stdout);
    assert_eq!(memory.files(), [""; 0]);
    // No other user may enter the other user's folder: onlookers write their own files into it.
    for arguments in
        [&["run"][..], &["topic", "echo", "tracks"], &["swap", "tracker", "--set", "gate=9"], &["top", "--once"]]
    {
        let mut ours = playground.command(arguments);
        ours.env("CONICFLOW_RUNTIME_DIR", theirs.runtime());
        let log = Started::new(ours).wait().expect_code(2).stderr;
        let expected = "belongs to another user\n  hint: do this as that user (`sudo -u '#65534' ...`)";
        assert!(log.contains(expected), "{arguments:?}: {log}");
    }
}

#[test]
fn a_stage_without_its_launcher_is_reported() {
    let playground = Playground::with_pipeline(TRACKING);
    // A process whose parent is not the launcher that its environment names has lost its launcher.
    let mut command = Command::new("sleep");
    command.arg("100").env("CONICFLOW_RUNTIME_DIR", playground.runtime());
    command.envs([("CONICFLOW_PIPELINE", "tracking"), ("CONICFLOW_STAGE", "lonely"), ("CONICFLOW_LAUNCHER", "1")]);
    let orphan = Started::new(command);
    let found = playground.conicflow(&["doctor"]).expect_code(1);
    let report =
        format!("stage `lonely` of pipeline `tracking` runs on without its launcher, as process {}", orphan.id());
    assert!(found.stdout.contains(&report), "{}", found.stdout);
}

#[test]
fn a_stage_that_finds_shared_memory_full_is_named_and_comes_back_when_there_is_room() {
    let Some(memory) = OwnSharedMemory::new("16m") else { return };
    let playground = tracking();
    let mut run = working(&memory, &playground);
    let filler = memory.folder().join("filler");
    // The source may find too little room when it starts, or other processes may take the room while the source creates its
    // ports.
    let reports = ["shared memory has ", " was killed by SIGBUS: shared memory is full"];
    let mut delivered = 0;
    wait_until("the cause is named", || {
        let mut file = File::options().append(true).create(true).open(&filler).unwrap();
        assert_eq!(std::io::copy(&mut std::io::repeat(0), &mut file).unwrap_err().kind(), ErrorKind::StorageFull);
        // A killed source leaves room, and its successor can use that room if it starts before the filler takes it.
        let lines = playground.lines("tracks.jsonl").len();
        if let Some(source) = stages_of(run.id()).get("source").filter(|_| lines > delivered) {
            delivered = lines + 3;
            signal(*source, Signal::KILL);
        }
        reports.iter().any(|report| run.stderr().contains(report))
    });
    fs::remove_file(&filler).unwrap();
    wait_for_lines(&mut run, &playground);
    signal(run.id(), Signal::INT);
    run.wait().expect_survived();
}
